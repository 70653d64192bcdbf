"""The whole of ``egvs validate`` on a small scenario: what comes out, twice the same; and what it refuses."""

import json
import math
import shutil

import numpy as np
import pytest

from egvs import load
from egvs.artefacts import parquet
from egvs.artefacts.readers import read_validation
from egvs.core.errors import InputError
from egvs.sensors.sites import Pose, Site
from egvs.validation.correlation import CorrelationStudy, JunctionScores, MeasureValues
from egvs.validation.detection_metrics import ALL_OBJECTS, BLOCKS, MEASURES, JackknifeEstimate, SiteDetection
from egvs.validation.detectors import base
from egvs.validation.kitti_results import KittiFiles
from egvs.validation.results import CORRELATED_BOX_MEASURES, CORRELATED_POINT_MEASURES, ScoreName
from egvs.validation.site_validation import correlate_scores, validate_sites
from egvs.validation.surrogates import SurrogateRow, Surrogates
from egvs.validation.sweeps import POINT_COUNTS_NAME
from tests.validation.detecting import Middle

ARTEFACTS = ("correlation.parquet", "detection.parquet", "surrogates.parquet", "validation.png", "validation.sha256")
WANTED = ("validate", "--frames", "10", "--detector", "points", "--jobs", "1")


@pytest.fixture
def middle(monkeypatch):
    """A detector beside those that are installed."""
    monkeypatch.setattr(base, "make_detector", lambda name: {"middle": Middle()}[name])


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A scenario with six sites, and its first validation."""
    folder = tmp_path_factory.mktemp("whole")
    from tests.conftest import write_mini

    mini = write_mini(folder / "mini")
    places = [(10, 12, 3), (30.5, -12, 3), (20, 12, 4), (5, -12, 2), (38, 11, 6), (16, -11, 5)]
    lines = [f"p{n},{x},{y},{z}" for n, (x, y, z) in enumerate(places)]
    (mini / "sites.csv").write_text("\n".join(["site,x_m,y_m,z_m", *lines]) + "\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(base, "make_detector", lambda name: {"middle": Middle()}[name])
        done = validate_sites(load(mini), folder / "out", frames=10, detectors=["middle"], jobs=1)
    return mini, folder / "out", done


def test_what_comes_out(whole):
    _, out, done = whole
    assert sorted(path.name for path in out.iterdir() if path.name != ".lock") == sorted(ARTEFACTS)
    table, about = parquet.read_artefact(out / "detection.parquet", "detection")
    assert table.num_rows == 6 * 2 * 5 and about["frames"] == 10 and about["seed"] == 7
    assert about["shown"] == {POINT_COUNTS_NAME: CORRELATED_POINT_MEASURES[0], "middle": CORRELATED_BOX_MEASURES[0]}
    rows = parquet.read_artefact(out / "correlation.parquet", "correlation")[0].to_pylist()
    assert len(rows) == len(done.scores) * (len(CORRELATED_POINT_MEASURES) + len(CORRELATED_BOX_MEASURES))
    assert all(-1 <= row["spearman"] <= 1 or math.isnan(row["spearman"]) for row in rows)
    (own,) = (
        row
        for row in rows
        if about["own_score"].items() <= row.items() and row["measure"] == CORRELATED_POINT_MEASURES[0]
    )
    assert own["n"] == 6 and own["kendall_low"] <= own["kendall"] <= own["kendall_high"]
    assert json.loads(own["parameters"]) == {"gamma": 4, "voxel_m": 0.5, "moving_occlusion": False}


def test_a_flipped_bit_of_a_validation_is_told(whole, tmp_path):
    out = shutil.copytree(whole[1], tmp_path / "out")
    paths = out / "detection.parquet", out / "correlation.parquet"
    assert read_validation(*paths) is not None
    data = paths[0].read_bytes()
    paths[0].write_bytes(data[:99] + bytes([data[99] ^ 1]) + data[100:])
    told = r"detection\.parquet: does not match its checksum in validation\.sha256; remove it, or run egvs val"
    with pytest.raises(InputError, match=told):
        read_validation(*paths)


def test_traffic_that_was_seen_is_told(whole):
    doubt = next(doubt for doubt in whole[2].warnings if doubt.rule == "traffic not held out")
    assert "sites are evaluated with the frames that the TPOG was computed from" in str(doubt)
    about = parquet.read_metadata(whole[1] / "detection.parquet", "detection")
    assert any(its["where"] == "scenario.toml: traffic.fcd" for its in about["warnings"])  # wherever that is


@pytest.mark.slow
def test_twice_the_same_bytes(whole, middle, tmp_path):
    mini, out, _ = whole
    elsewhere = shutil.copytree(mini, tmp_path / "moved" / mini.name)  # the store of this test is empty
    validate_sites(load(elsewhere), tmp_path / "again", frames=10, detectors=["middle"], jobs=1)
    for name in ARTEFACTS:
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes(), name


@pytest.mark.slow
def test_what_is_kept_comes_back_as_the_results_of_another_detector(mini, middle, tmp_path):
    scenario = load(mini)
    first = validate_sites(
        scenario, tmp_path / "a", frames=10, detectors=["middle"], kitti=KittiFiles(keep=True), jobs=1
    )
    kept = tmp_path / "a" / "validation_kitti"
    with pytest.raises(InputError, match="--detections: the folder has results of 'middle', which also runs here"):
        validate_sites(scenario, tmp_path / "b", frames=10, detectors=["middle"], kitti=KittiFiles(kept), jobs=1)
    for site in ("pole_a", "pole_b"):
        frames = sorted(path.name for path in (kept / site / "middle").iterdir())
        assert frames == sorted(path.name for path in (kept / site / "label_2").iterdir())
        assert len(frames) == 10
        (kept / site / "middle").rename(kept / site / "theirs")
    again = validate_sites(scenario, tmp_path / "b", frames=10, kitti=KittiFiles(kept, keep=True), jobs=1)
    told = {(row.site, row.detector, row.objects_of): row.measures for row in [*first.detections, *again.detections]}
    for (site, detector, objects_of), measures in told.items():
        if detector == "middle":
            for name, estimate in measures.items():
                np.testing.assert_equal(told[site, "theirs", objects_of][name].value, estimate.value)
    objects = sum(row.objects for row in first.detections if (row.detector, row.objects_of) == ("middle", ALL_OBJECTS))
    labels = [line for path in kept.rglob("label_2/*.txt") for line in path.read_text().splitlines()]
    assert len(labels) == objects and all(line.startswith("Car ") for line in labels)
    (kept / "pole_b" / "theirs" / "000000.txt").unlink()
    with pytest.raises(InputError, match=r"pole_b/theirs/000000\.txt: no such file"):
        validate_sites(scenario, tmp_path / "b", frames=10, kitti=KittiFiles(kept), jobs=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sets", "parameters"),
    [
        (["score.gamma=inf", "roi.voxel_m=2.5"], {"gamma": "inf", "voxel_m": 2.5, "moving_occlusion": False}),
        (["effects.moving_occlusion={}"], {"gamma": 4.0, "voxel_m": 0.5, "moving_occlusion": True}),
    ],
)
def test_the_scenarios_own_score_is_among_those_tried(mini, tmp_path, sets, parameters):
    scenario = load(mini, sets)
    done = validate_sites(scenario, tmp_path / "out", frames=10, jobs=1)
    own = done.egvs_score(scenario)
    assert own.score == "egvs" and json.loads(own.parameters) == parameters
    assert set(done.values_of(own)) == {"pole_a", "pole_b"} and min(done.values_of(own).values()) > 0
    assert any(its.score == own for its in done.agreements)


def _made_up(values):
    measured = {name: JackknifeEstimate(value, np.full(BLOCKS, value), 0.0) for name in MEASURES for value in [0.0]}
    return [
        SiteDetection(
            f"s{n}",
            POINT_COUNTS_NAME,
            ALL_OBJECTS,
            10,
            5,
            {},
            measured | {"seen_20": JackknifeEstimate(v, np.full(BLOCKS, v), 0.0)},
        )
        for n, v in enumerate(values)
    ]


def test_scores_of_which_less_is_better_are_turned(mini):
    rows = _made_up([0.1, 0.5, 0.3, 0.9, 0.7])
    more = [SurrogateRow(f"s{n}", "more", {}, 1, v, 0.0) for n, v in enumerate([1.0, 3.0, 2.0, 5.0, 4.0])]
    less = [SurrogateRow(f"s{n}", "less", {}, -1, v, 0.0) for n, v in enumerate([1.0, 3.0, 2.0, 5.0, 4.0])]
    some = [SurrogateRow(f"s{n}", "some", {}, 1, v, 0.0) for n, v in enumerate([math.nan, 3.0, 2.0, 5.0, 4.0])]
    found = correlate_scores(_sites(range(5)), load(mini), rows, Surrogates((*more, *less, *some), (), "x"))
    kendall = {its.score.score: its.by_kind["kendall"] for its in found if its.measure == "seen_20"}
    assert kendall["more"].value == pytest.approx(1.0) and kendall["less"].value == pytest.approx(-1.0)
    assert kendall["some"].sites == 4 and kendall["some"].dropped == (f"{load(mini).name} s0",)
    assert all(math.isnan(its.by_kind["kendall"].value) for its in found if its.measure == "seen_1")  # all the same


def test_sites_of_a_pole_are_drawn_together(mini):
    values = [0.1, 0.2, 0.5, 0.3, 0.3, 0.6, 0.9, 0.4]
    rows = _made_up(values)
    scores = [SurrogateRow(f"s{n}", "score", {}, 1, v, 0.0) for n, v in enumerate([1.0, 3, 2, 5, 4, 7, 6, 8])]
    surrogates = Surrogates(tuple(scores), (), "x")
    alone = correlate_scores(_sites(range(8)), load(mini), rows, surrogates)
    pairs = correlate_scores(_sites([0, 0, 1, 1, 2, 2, 3, 3]), load(mini), rows, surrogates)
    first, second = (next(f for f in found if f.measure == "seen_20").by_kind["spearman"] for found in (alone, pairs))
    junction = JunctionScores(
        load(mini).name, tuple(f"s{n}" for n in range(8)), {"score": np.array([1.0, 3, 2, 5, 4, 7, 6, 8])},
        {"seen_20": MeasureValues(np.array(values), np.tile(np.array(values)[:, None], BLOCKS))},
        tuple("aabbccdd"),
    )  # fmt: skip
    right = CorrelationStudy([junction], load(mini).seed).correlation("score", "seen_20", "spearman").interval
    assert second.value == first.value
    assert second.interval != first.interval and second.interval == right


def _sites(poles):
    return [Site(f"s{n}", Pose(0.0, 0.0, 3.0), "small", pole=f"pole {pole}") for n, pole in enumerate(poles)]


def test_a_score_is_named_with_what_it_was_tried_with():
    assert str(ScoreName("egvs", '{"gamma":"inf","moving_occlusion":true,"voxel_m":0.5}')) == (
        "egvs (gamma inf, moving occlusion, voxel 0.5)"
    )
    assert str(ScoreName("coverage", "{}")) == "coverage"


# ---- through the command line


@pytest.mark.slow
def test_a_second_run_says_that_all_was_kept(run_egvs, mini, tmp_path):
    (tmp_path / "out" / ".validate-killed" / "unseen").mkdir(parents=True)  # what a kill leaves
    code, out, error = run_egvs(*WANTED, mini, "--out", tmp_path / "out")
    assert code == 0, error
    assert "10 frames from 2 sites, points, 1 process: about" in error and "s   pole_b: points" in error
    assert "18 vehicles in 10 frames" in out and "warning: " in out
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [".lock", *ARTEFACTS]
    first = {name: (tmp_path / "out" / name).read_bytes() for name in ARTEFACTS}
    code, again, error = run_egvs(*WANTED, mini, "--out", tmp_path / "out")
    assert code == 0 and again == out
    assert error == "all detections from 2 sites were cached\n"
    assert {name: (tmp_path / "out" / name).read_bytes() for name in ARTEFACTS} == first


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--frames", "11"], r"--frames: expected at most 10 frames at least 2 s apart, got 11"),
        (["--frames", "9"], r"greater than or equal to 10"),
        (["--detector", "nosuch"], r"--detector: unknown detector 'nosuch'. Use one of points, "),
        (
            ["--set", "roi.center_m=[20, 28, 2.5]"],
            r"no vehicle's centre is in the region in any of 10 frames of held-out",
        ),
        (["--set", "sites.file='measured.csv'"], r"site pole_a: its empty scan was measured"),
    ],
)
def test_what_cannot_be_done_is_told(run_egvs, mini, tmp_path, arguments, message):
    (mini / "cloud.csv").write_text("x_m,y_m,z_m\n12,3,0\n20,1,0\n")
    (mini / "measured.csv").write_text("site,x_m,y_m,z_m,points\npole_a,10,12,3,cloud.csv\npole_b,30.5,-12,3,\n")
    code, _, error = run_egvs(*WANTED, mini, "--out", tmp_path / "out", *arguments)
    assert code == 2 and message in error, error
    assert error.count("egvs: ") <= 1 and "Traceback" not in error
    assert not any((tmp_path / "out" / name).exists() for name in ARTEFACTS)
    assert [path.name for path in (tmp_path / "out").glob("*")] in ([], [".lock"])


def test_a_file_in_place_of_the_folder_is_left_alone(run_egvs, mini, tmp_path):
    (tmp_path / "out").write_text("mine")
    code, _, error = run_egvs(*WANTED, mini, "--out", tmp_path / "out")
    assert code == 2 and f"{tmp_path / 'out'}: cannot be written" in error
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.slow
def test_a_site_that_sees_no_vehicle_is_told(run_egvs, mini, tmp_path):
    with (mini / "scenario.toml").open("a") as file:
        file.write("\n[sensors.up]\nelevations_deg = [20, 40]\nchannels = 4\nazimuth_step_deg = 2.0\nrange_m = 100\n")
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,sensor\npole_a,10,12,3,small\nsky,20,8,4.5,up\n")
    code, out, error = run_egvs(*WANTED, mini, "--out", tmp_path / "out")
    assert code == 0, error
    rows = parquet.read_artefact(tmp_path / "out" / "detection.parquet", "detection")[0].to_pylist()
    by = {row["objects_of"]: row for row in rows if row["site"] == "sky"}
    assert by["vehicles"]["seen_1"] == 0.0 and by["points_1"]["objects"] == 0
    assert math.isnan(by["points_1"]["log_points"])
    assert " 0.0 ± 0.0" in next(line for line in out.splitlines() if line.startswith("sky"))
