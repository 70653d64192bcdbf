"""The whole of ``egvs validate --plan`` on a small scenario: what comes out, and what it refuses."""

import json
import math

import numpy as np
import pytest

from pipeline import load
from pipeline.artefacts import tables
from pipeline.validation import unseen_record, validating
from pipeline.validation.detection import ALL
from pipeline.validation.detectors import registry
from pipeline.validation.detectors.cluster.detector import Cluster
from pipeline.validation.detectors.pointpillars.encoding import HeightZero, SeenPoints
from pipeline.validation.fused.looking import FusedLook
from pipeline.validation.fused.plans import Group
from pipeline.validation.looking import Look
from pipeline.validation.site_findings import POINTS
from pipeline.validation.sweeps import SiteView, Sweep
from tests.validation.detecting import Middle

FRAMES = 10
WANTED = ("--frames", FRAMES, "--jobs", 1, "--detector", "points,cluster")


@pytest.fixture
def planned(mini, tmp_path, egvs):
    """A scenario, and the folder with a plan of both its sites."""
    code, _, error = egvs("place", mini, "--count", 2, "--out", tmp_path / "out")
    assert code == 0, error
    return mini, tmp_path / "out"


@pytest.mark.slow
def test_the_plan_of_a_run(egvs, planned, tmp_path, monkeypatch):
    mini, out = planned
    code, told, error = egvs("validate", mini, "--plan", "--out", out, *WANTED)
    assert code == 0, error
    assert f"{FRAMES} frames from 2 groups, points, cluster, 1 process: about" in error
    assert "18 vehicles in 10 frames of traffic" in told and "fused clouds of the plan by egvs in " in told
    table, about = tables.read(out / "fused.parquet", "fused")
    order = [row["site"] for row in tables.read(out / "placement.parquet", "placement")[0].to_pylist()]
    rows = [row for row in table.to_pylist() if row["objects_of"] == ALL]
    assert [(row["sensors"], json.loads(row["sites"])) for row in rows if row["detector"] == POINTS] == [
        (1, order[:1]), (2, order)
    ]  # fmt: skip
    assert [its["site"] for its in about["plan"]["sensors"]] == order and about["plan"]["score"] == "egvs"
    one, two = (row for row in rows if row["detector"] == "cluster")
    assert math.isclose(two["gain"], two["ap_combined_r40_iou70"] - one["ap_combined_r40_iou70"])
    assert one["gain"] == one["ap_combined_r40_iou70"] and one["gain_se"] == one["ap_combined_r40_iou70_se"]
    first = (out / "fused.parquet").read_bytes()
    monkeypatch.setenv("EGVS_STORE", "")  # so that all is looked at again
    code, _, error = egvs("validate", mini, "--plan-from", out, "--out", tmp_path / "again", *WANTED)
    assert code == 0, error
    assert (tmp_path / "again" / "fused.parquet").read_bytes() == first
    assert not (tmp_path / "again" / "placement.parquet").exists()


@pytest.mark.slow
def test_one_sensor_finds_what_it_finds_alone_and_points_add_up(mini, tmp_path):
    record = unseen_record.prepare(load(mini), tmp_path / "unseen", FRAMES)
    detectors, sites, names = {"cluster": Cluster()}, record.scene.sites, [POINTS, "cluster"]
    fused, alone = FusedLook(record, detectors), Look(record, detectors)
    each = [alone.at(site, names) for site in sites]
    for site, its in zip(sites, each, strict=True):
        same = fused.at(Group((site,)), names)
        for one, other in zip(same["cluster"].frames, its["cluster"].frames, strict=True):
            np.testing.assert_array_equal(one.boxes, other.boxes)
            np.testing.assert_array_equal(one.scores, other.scores)
        assert [p.tolist() for p in same[POINTS].points] == [p.tolist() for p in its[POINTS].points]
    both = fused.at(Group(sites), names)[POINTS].points
    for whole, *parts in zip(both, *(its[POINTS].points for its in each), strict=True):
        np.testing.assert_array_equal(whole, sum(parts))
    keys = {fused.key(Group(its), "cluster") for its in (sites, sites[::-1], sites[:1], sites[1:])}
    assert len(keys) == 4 and alone.key(sites[0], "cluster") not in keys


def test_pillars_have_what_each_sensor_says_of_its_own_points(mini):
    scenario = load(mini)
    record_sensor = _sensor(scenario)
    ranges = np.full(record_sensor.beams, 20.0)
    views = [SiteView(name, pose, record_sensor, ranges) for name, pose in _poses()]
    sweep = Sweep(np.array([[5.0, 0.0, 0.0, 0.5], [20.0, 0.0, 0.0, 0.25]], np.float32), np.array([0, 1], np.uint32))
    zero = HeightZero("sensor", views[0], scenario.roi.box, views[1:])
    found = SeenPoints.together([sweep, sweep], views, zero)
    np.testing.assert_allclose(found.xy_m, [[5, 0], [20, 0], [25, 0], [10, 0]], atol=1e-9)  # the second looks back
    np.testing.assert_allclose(found.height_m, [0, 0, 1, 1])  # from the first one's sensor
    np.testing.assert_array_equal(found.new, [True, False, True, False])
    np.testing.assert_allclose(found.range_m, [5, 20, 5, 20])
    np.testing.assert_allclose(found.intensity, [0.5, 0.25, 0.5, 0.25])


def _sensor(scenario):
    from pipeline.sensing import sensors

    return sensors.of_scenario("small", scenario, "test")


def _poses():
    from pipeline.sensing.sites import Pose

    return ("a", Pose(0.0, 0.0, 3.0)), ("b", Pose(30.0, 0.0, 4.0, yaw_deg=180.0))


# ---- what is refused


def _refused(egvs, mini, out, *arguments):
    code, told, error = egvs("validate", mini, "--out", out, *WANTED, *arguments)
    assert code == 2 and told == "" and error.count("egvs: ") == 1 and "Traceback" not in error, error
    assert not (out / "fused.parquet").exists()
    return error


def test_no_plan_was_made(egvs, mini, tmp_path):
    error = _refused(egvs, mini, tmp_path / "out", "--plan")
    assert "out/placement.parquet: no such file: no plan was made there; egvs place mini --count 3 makes one" in error
    assert not (tmp_path / "out").exists()


def test_single_detectors_and_results_of_sites(egvs, planned, monkeypatch, tmp_path):
    mini, out = planned
    for option in (["--keep"], ["--detections", tmp_path]):
        error = _refused(egvs, mini, out, "--plan", *option)
        assert f"{option[0]}: given with a plan; one of them: results are those of single sites" in error
    monkeypatch.setattr(registry, "make", lambda name: Middle())
    error = _refused(egvs, mini, out, "--plan")
    assert "--detector: 'cluster', which looks at sweeps of single sensors" in error
    assert validating.registry is registry


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"order": [1, 3]}, "its sensors have the orders [1, 3]; 1, 2, ... in turn"),
        ({"x_m": [math.inf, 0.0]}, "its pose is Pose(x_m=inf"),
        ({"sensor": ["none", "none"]}, "unknown sensor 'none'"),
        ({"x_m": [16.0, 16.0], "y_m": [6.5, 6.5]}, "stands inside house (building)"),
    ],
)
def test_a_plan_that_was_altered(egvs, planned, change, message):
    mini, out = planned
    table, about = tables.read(out / "placement.parquet", "placement")
    (out / "placement.sha256").unlink()
    tables.write(out / "placement.parquet", "placement", {**table.to_pydict(), **change}, about)
    assert message in _refused(egvs, mini, out, "--plan")


@pytest.mark.slow
def test_a_plan_of_another_scenario_or_of_another_world(egvs, planned, mini, tmp_path):
    _, out = planned
    other = mini.rename(mini.with_name("other"))
    error = _refused(egvs, other, tmp_path / "x", "--plan-from", out)
    assert "placement.parquet: a plan for 'mini'; one for other" in error
    same = other.rename(mini)
    code, told, error = egvs(
        "validate", same, "--plan-from", out, "--out", tmp_path / "x", *WANTED, "--set", "statics.footprints=[]"
    )
    assert code == 0, error
    assert "warning: placement.parquet: the plan was made in another static world than the one" in told


def test_a_site_with_a_measured_scan_cannot_look_at_traffic(egvs, planned, tmp_path):
    mini, out = planned
    (mini / "cloud.csv").write_text("x_m,y_m,z_m\n12,3,0\n20,1,0\n")
    (mini / "measured.csv").write_text("site,x_m,y_m,z_m,points\npole_a,10,12,3,cloud.csv\npole_b,30.5,-12,3,\n")
    error = _refused(egvs, mini, tmp_path / "x", "--plan-from", out, "--set", "sites.file='measured.csv'")
    assert "site pole_a: an empty scan that was measured" in error
