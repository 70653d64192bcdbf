"""``egvs validate --plan`` on a small scenario: artefacts and messages."""

import json
import math

import numpy as np
import pytest

from egvs import load
from egvs.artefacts import parquet
from egvs.clouds.sweeps import SiteView, Sweep
from egvs.extensions.validation import held_out_traffic
from egvs.extensions.validation.detection_metrics import ALL_OBJECTS
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME
from egvs.extensions.validation.detector_runs import SiteDetectionTask
from egvs.extensions.validation.detectors import base
from egvs.extensions.validation.detectors.cluster import Cluster
from egvs.extensions.validation.detectors.pointpillars import INTENSITY, HeightOrigin, PillarPoints
from egvs.extensions.validation.plan_validation import FusedDetectionTask, SensorGroup
from tests.extensions.validation.stub_detectors import MiddleDetector

FRAMES = 10
OPTIONS = ("--frames", FRAMES, "--jobs", 1, "--detector", "points,cluster")


@pytest.fixture
def planned(mini, tmp_path, run_egvs):
    """A scenario, and the folder with a plan of both its sites."""
    code, _, error = run_egvs("place", mini, "--count", 2, "--out", tmp_path / "out")
    assert code == 0, error
    return mini, tmp_path / "out"


@pytest.mark.slow
def test_validates_plan_of_run(run_egvs, planned, tmp_path, monkeypatch):
    mini, out = planned
    code, output, error = run_egvs("validate", mini, "--plan", "--out", out, *OPTIONS)
    assert code == 0, error
    assert f"{FRAMES} frames from 2 groups, points, cluster, 1 process\n" in error
    assert output.startswith("2 different vehicles in held-out traffic: 18 vehicles in 10 frames, at least 2 s apart;")
    assert "fused clouds of the plan by egvs in " in output
    table, metadata = parquet.read_artefact(out / "fused.parquet", "fused")
    order = [row["site"] for row in parquet.read_artefact(out / "placement.parquet", "placement")[0].to_pylist()]
    rows = [row for row in table.to_pylist() if row["objects_of"] == ALL_OBJECTS]
    assert [(row["sensors"], json.loads(row["sites"])) for row in rows if row["detector"] == POINT_COUNTS_NAME] == [
        (1, order[:1]), (2, order)
    ]  # fmt: skip
    assert [entry["site"] for entry in metadata["plan"]["sensors"]] == order and metadata["plan"]["score"] == "egvs"
    one, two = (row for row in rows if row["detector"] == "cluster")
    assert math.isclose(two["gain"], two["ap_mean_r40_iou70"] - one["ap_mean_r40_iou70"])
    assert one["gain"] == one["ap_mean_r40_iou70"] and one["gain_se"] == one["ap_mean_r40_iou70_se"]
    first = (out / "fused.parquet").read_bytes()
    monkeypatch.setenv("EGVS_STORE", "")  # no cached results
    code, _, error = run_egvs("validate", mini, "--plan-from", out, "--out", tmp_path / "again", *OPTIONS)
    assert code == 0, error
    assert (tmp_path / "again" / "fused.parquet").read_bytes() == first
    assert not (tmp_path / "again" / "placement.parquet").exists()


@pytest.mark.slow
def test_group_of_one_equals_site_and_points_add_up(mini, tmp_path):
    record = held_out_traffic.prepare_held_out_traffic(load(mini), tmp_path / "unseen", FRAMES)
    detectors, sites, names = {"cluster": Cluster()}, record.scene.sites, [POINT_COUNTS_NAME, "cluster"]
    fused, alone = FusedDetectionTask(record, detectors), SiteDetectionTask(record, detectors)
    each = [alone.at(site, names) for site in sites]
    for site, entry in zip(sites, each, strict=True):
        same = fused.at(SensorGroup((site,)), names)
        for one, other in zip(same["cluster"].frames, entry["cluster"].frames, strict=True):
            np.testing.assert_array_equal(one.boxes, other.boxes)
            np.testing.assert_array_equal(one.scores, other.scores)
        assert [p.tolist() for p in same[POINT_COUNTS_NAME].points] == [
            p.tolist() for p in entry[POINT_COUNTS_NAME].points
        ]
    both = fused.at(SensorGroup(sites), names)[POINT_COUNTS_NAME].points
    for total, *parts in zip(both, *(entry[POINT_COUNTS_NAME].points for entry in each), strict=True):
        np.testing.assert_array_equal(total, sum(parts))
    keys = {fused.key(SensorGroup(entry), "cluster") for entry in (sites, sites[::-1], sites[:1], sites[1:])}
    assert len(keys) == 4 and alone.key(sites[0], "cluster") not in keys


def test_pillar_points_are_relative_to_their_own_sensor(mini):
    scenario = load(mini)
    record_sensor = _sensor(scenario)
    ranges = np.full(record_sensor.beams, 20.0)
    views = [SiteView(name, pose, record_sensor, ranges) for name, pose in _poses()]
    sweep = Sweep(np.array([[5.0, 0.0, 0.0, 0.5], [20.0, 0.0, 0.0, 0.25]], np.float32), np.array([0, 1], np.uint32))
    zero = HeightOrigin("sensor", views, scenario.roi.box)
    points = PillarPoints.from_sweeps([sweep, sweep], views, zero)
    np.testing.assert_allclose(points.xy_m, [[5, 0], [20, 0], [25, 0], [10, 0]], atol=1e-9)  # the second looks back
    np.testing.assert_allclose(points.height_m, [0, 0, 1, 1])  # from the first one's sensor
    np.testing.assert_array_equal(points.is_foreground, [True, False, True, False])
    np.testing.assert_allclose(points.range_m, [5, 20, 5, 20])
    np.testing.assert_allclose(points.intensity, [INTENSITY] * 4)
    own = PillarPoints.from_sweeps([sweep, sweep], views, zero, None)
    np.testing.assert_allclose(own.intensity, [0.5, 0.25, 0.5, 0.25])
    unknown = Sweep(sweep.points * np.array([1.0, 1.0, 1.0, np.nan], np.float32), sweep.beam)
    same = PillarPoints.from_sweeps([unknown, sweep], views, zero)
    np.testing.assert_array_equal(same.intensity, points.intensity)
    with pytest.raises(ValueError, match="no intensity"):
        PillarPoints.from_sweeps([unknown, sweep], views, zero, None)


def _sensor(scenario):
    from egvs.sensors import sensor

    return sensor.scenario_sensor("small", scenario, "test")


def _poses():
    from egvs.sensors.sites import Pose

    return ("a", Pose(0.0, 0.0, 3.0)), ("b", Pose(30.0, 0.0, 4.0, yaw_deg=180.0))


# ---- invalid input


def _refused_error(run_egvs, mini, out, *arguments):
    code, output, error = run_egvs("validate", mini, "--out", out, *OPTIONS, *arguments)
    assert code == 2 and output == "" and error.count("egvs: ") == 1 and "Traceback" not in error, error
    assert not (out / "fused.parquet").exists()
    return error


def test_rejects_folder_without_plan(run_egvs, mini, tmp_path):
    error = _refused_error(run_egvs, mini, tmp_path / "out", "--plan")
    assert "out/placement.parquet: no such file: the folder contains no plan. Run egvs place mini --count 3" in error
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_rejects_options_and_detectors_of_single_sites(run_egvs, planned, monkeypatch, tmp_path):
    mini, out = planned
    for option in (["--keep"], ["--detections", tmp_path]):
        error = _refused_error(run_egvs, mini, out, "--plan", *option)
        assert f"{option[0]}: not available with a plan" in error
    monkeypatch.setattr(base, "make_detector", lambda name: MiddleDetector())
    error = _refused_error(run_egvs, mini, out, "--plan")
    assert "--detector: 'cluster' can only process sweeps of single sensors" in error
    assert base is base


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"order": [1, 3]}, "expected sensors in the order 1, 2, ..., got [1, 3]"),
        ({"x_m": [math.inf, 0.0]}, "expected a pose of finite numbers, got Pose(x_m=inf"),
        ({"sensor": ["none", "none"]}, "unknown sensor 'none'"),
        ({"x_m": [16.0, 16.0], "y_m": [6.5, 6.5]}, "is inside house (building)"),
    ],
)
def test_rejects_altered_plan(run_egvs, planned, change, message):
    mini, out = planned
    table, metadata = parquet.read_artefact(out / "placement.parquet", "placement")
    (out / "placement.sha256").unlink()
    parquet.write_artefact(out / "placement.parquet", "placement", {**table.to_pydict(), **change}, metadata)
    assert message in _refused_error(run_egvs, mini, out, "--plan")


@pytest.mark.slow
def test_rejects_plan_of_other_scenario_and_warns_of_other_world(run_egvs, planned, mini, tmp_path):
    _, out = planned
    other = mini.rename(mini.with_name("other"))
    error = _refused_error(run_egvs, other, tmp_path / "x", "--plan-from", out)
    assert "placement.parquet: expected a plan for other, got a plan for 'mini'" in error
    same = other.rename(mini)
    code, output, error = run_egvs(
        "validate", same, "--plan-from", out, "--out", tmp_path / "x", *OPTIONS, "--set", "statics.footprints=[]"
    )
    assert code == 0, error
    assert "warning: placement.parquet: the plan was computed with a different static world" in output


def test_rejects_site_with_measured_scan(run_egvs, planned, tmp_path):
    mini, out = planned
    (mini / "cloud.csv").write_text("x_m,y_m,z_m\n12,3,0\n20,1,0\n")
    (mini / "measured.csv").write_text("site,x_m,y_m,z_m,points\npole_a,10,12,3,cloud.csv\npole_b,30.5,-12,3,\n")
    error = _refused_error(run_egvs, mini, tmp_path / "x", "--plan-from", out, "--set", "sites.file='measured.csv'")
    assert "site pole_a: its empty scan was measured" in error
