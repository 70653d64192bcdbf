"""``egvs validate`` on a small scenario: artefacts, reproducibility, messages."""

import json
import math
import shutil

import numpy as np
import pytest

from egvs import load
from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.core.errors import InputError
from egvs.extensions.validation.correlation import CorrelationStudy, JunctionScores, MeasureValues
from egvs.extensions.validation.detection_metrics import (
    ALL_OBJECTS,
    BLOCKS,
    MEASURES,
    JackknifeEstimate,
    SiteDetection,
)
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME
from egvs.extensions.validation.detectors import base
from egvs.extensions.validation.held_out_traffic import FrameSampling
from egvs.extensions.validation.kitti_results import KittiFiles
from egvs.extensions.validation.report_section import read_validation
from egvs.extensions.validation.results import CORRELATED_BOX_MEASURES, CORRELATED_POINT_MEASURES, ScoreName
from egvs.extensions.validation.site_validation import correlate_scores, validate_sites
from egvs.extensions.validation.surrogates import SurrogateRow, Surrogates
from egvs.sensors.sites import Pose, Site
from tests.extensions.validation.stub_detectors import MiddleDetector

ARTEFACTS = ("correlation.parquet", "detection.parquet", "surrogates.parquet", "validation.png", "validation.sha256")
OPTIONS = ("validate", "--frames", "10", "--detector", "points", "--jobs", "1")


@pytest.fixture
def middle(monkeypatch):
    """A detector beside those that are installed."""
    monkeypatch.setattr(base, "make_detector", lambda name: {"middle": MiddleDetector()}[name])


@pytest.fixture(scope="module")
def validated(tmp_path_factory):
    """A scenario with six sites, and its first validation."""
    folder = tmp_path_factory.mktemp("whole")
    from tests.conftest import write_mini

    mini = write_mini(folder / "mini")
    places = [(10, 12, 3), (30.5, -12, 3), (20, 12, 4), (5, -12, 2), (38, 11, 6), (16, -11, 5)]
    lines = [f"p{n},{x},{y},{z}" for n, (x, y, z) in enumerate(places)]
    (mini / "sites.csv").write_text("\n".join(["site,x_m,y_m,z_m", *lines]) + "\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(base, "make_detector", lambda name: {"middle": MiddleDetector()}[name])
        done = validate_sites(load(mini), folder / "out", sampling=FrameSampling(10), detectors=["middle"], jobs=1)
    return mini, folder / "out", done


@pytest.mark.slow
def test_writes_artefacts(validated):
    _, out, done = validated
    assert sorted(path.name for path in out.iterdir() if path.name != ".lock") == sorted(ARTEFACTS)
    table, metadata = parquet.read_artefact(out / "detection.parquet", "detection")
    assert table.num_rows == 6 * 2 * 5 and metadata["frames"] == 10 and metadata["seed"] == 7
    assert metadata["shown"] == {POINT_COUNTS_NAME: CORRELATED_POINT_MEASURES[0], "middle": CORRELATED_BOX_MEASURES[0]}
    rows = parquet.read_artefact(out / "correlation.parquet", "correlation")[0].to_pylist()
    assert len(rows) == len(done.scores) * (len(CORRELATED_POINT_MEASURES) + len(CORRELATED_BOX_MEASURES))
    assert all(-1 <= row["spearman"] <= 1 or math.isnan(row["spearman"]) for row in rows)
    (egvs_row,) = (
        row
        for row in rows
        if metadata["own_score"].items() <= row.items() and row["measure"] == CORRELATED_POINT_MEASURES[0]
    )
    assert egvs_row["n"] == 6 and egvs_row["kendall_low"] <= egvs_row["kendall"] <= egvs_row["kendall_high"]
    assert json.loads(egvs_row["parameters"]) == {"gamma": 4, "voxel_m": 0.5, "moving_occlusion": False}


@pytest.mark.slow
def test_detects_flipped_bit(validated, tmp_path):
    out = shutil.copytree(validated[1], tmp_path / "out")
    assert read_validation(RunFolder(out)) is not None
    path = out / "detection.parquet"
    data = path.read_bytes()
    path.write_bytes(data[:99] + bytes([data[99] ^ 1]) + data[100:])
    message = r"detection\.parquet: does not match its checksum in validation\.sha256\. Remove it, or run egvs val"
    with pytest.raises(InputError, match=message):
        read_validation(RunFolder(out))


def test_warns_if_traffic_is_not_held_out(validated):
    warning = next(warning for warning in validated[2].warnings if warning.rule == "traffic not held out")
    assert "sites are evaluated with the frames that the TPOG was computed from" in str(warning)
    metadata = parquet.read_metadata(validated[1] / "detection.parquet", "detection")
    assert any(entry["where"] == "scenario.toml: traffic" for entry in metadata["warnings"])  # wherever that is


@pytest.mark.slow
def test_bytes_are_reproducible(validated, middle, tmp_path):
    mini, out, _ = validated
    elsewhere = shutil.copytree(mini, tmp_path / "moved" / mini.name)  # the store of this test is empty
    validate_sites(load(elsewhere), tmp_path / "again", sampling=FrameSampling(10), detectors=["middle"], jobs=1)
    for name in ARTEFACTS:
        assert (tmp_path / "again" / name).read_bytes() == (out / name).read_bytes(), name


@pytest.mark.slow
def test_written_kitti_files_can_be_read_as_results(mini, middle, tmp_path):
    scenario = load(mini)
    first = validate_sites(
        scenario, tmp_path / "a", sampling=FrameSampling(10), detectors=["middle"], kitti=KittiFiles(keep=True), jobs=1
    )
    kitti_folder = tmp_path / "a" / "validation_kitti"
    with pytest.raises(InputError, match="--detections: the folder has results of 'middle', which also runs here"):
        validate_sites(
            scenario,
            tmp_path / "b",
            sampling=FrameSampling(10),
            detectors=["middle"],
            kitti=KittiFiles(kitti_folder),
            jobs=1,
        )
    for site in ("pole_a", "pole_b"):
        frames = sorted(path.name for path in (kitti_folder / site / "middle").iterdir())
        assert frames == sorted(path.name for path in (kitti_folder / site / "label_2").iterdir())
        assert len(frames) == 10
        (kitti_folder / site / "middle").rename(kitti_folder / site / "theirs")
    again = validate_sites(
        scenario, tmp_path / "b", sampling=FrameSampling(10), kitti=KittiFiles(kitti_folder, keep=True), jobs=1
    )
    measures_by_row = {
        (row.site, row.detector, row.objects_of): row.measures for row in [*first.detections, *again.detections]
    }
    for (site, detector, objects_of), measures in measures_by_row.items():
        if detector == "middle":
            for name, estimate in measures.items():
                np.testing.assert_equal(measures_by_row[site, "theirs", objects_of][name].value, estimate.value)
    objects = sum(row.objects for row in first.detections if (row.detector, row.objects_of) == ("middle", ALL_OBJECTS))
    labels = [line for path in kitti_folder.rglob("label_2/*.txt") for line in path.read_text().splitlines()]
    assert len(labels) == objects and all(line.startswith("Car ") for line in labels)
    (kitti_folder / "pole_b" / "theirs" / "000000.txt").unlink()
    with pytest.raises(InputError, match=r"pole_b/theirs/000000\.txt: no such file"):
        validate_sites(scenario, tmp_path / "b", sampling=FrameSampling(10), kitti=KittiFiles(kitti_folder), jobs=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sets", "parameters"),
    [
        (["score.gamma=inf", "roi.voxel_m=2.5"], {"gamma": "inf", "voxel_m": 2.5, "moving_occlusion": False}),
        (["effects.moving_occlusion={}"], {"gamma": 4.0, "voxel_m": 0.5, "moving_occlusion": True}),
    ],
)
def test_egvs_score_has_parameters_of_scenario(mini, tmp_path, sets, parameters):
    scenario = load(mini, sets)
    done = validate_sites(scenario, tmp_path / "out", sampling=FrameSampling(10), jobs=1)
    egvs_row = done.egvs_score(scenario)
    assert egvs_row.score == "egvs" and json.loads(egvs_row.parameters) == parameters
    assert set(done.values_of(egvs_row)) == {"pole_a", "pole_b"} and min(done.values_of(egvs_row).values()) > 0
    assert any(entry.score == egvs_row for entry in done.agreements)


def _site_detections(values):
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


def test_changes_sign_of_scores_where_less_is_better(mini):
    rows = _site_detections([0.1, 0.5, 0.3, 0.9, 0.7])
    more = [SurrogateRow(f"s{n}", "more", {}, 1, v, 0.0) for n, v in enumerate([1.0, 3.0, 2.0, 5.0, 4.0])]
    less = [SurrogateRow(f"s{n}", "less", {}, -1, v, 0.0) for n, v in enumerate([1.0, 3.0, 2.0, 5.0, 4.0])]
    some = [SurrogateRow(f"s{n}", "some", {}, 1, v, 0.0) for n, v in enumerate([math.nan, 3.0, 2.0, 5.0, 4.0])]
    agreements = correlate_scores(_sites(range(5)), load(mini), rows, Surrogates((*more, *less, *some), (), "x"))
    kendall = {entry.score.score: entry.by_kind["kendall"] for entry in agreements if entry.measure == "seen_20"}
    assert kendall["more"].value == pytest.approx(1.0) and kendall["less"].value == pytest.approx(-1.0)
    assert kendall["some"].sites == 4 and kendall["some"].dropped == (f"{load(mini).name} s0",)
    assert all(
        math.isnan(entry.by_kind["kendall"].value) for entry in agreements if entry.measure == "seen_1"
    )  # all the same


def test_draws_sites_of_one_pole_together(mini):
    values = [0.1, 0.2, 0.5, 0.3, 0.3, 0.6, 0.9, 0.4]
    rows = _site_detections(values)
    scores = [SurrogateRow(f"s{n}", "score", {}, 1, v, 0.0) for n, v in enumerate([1.0, 3, 2, 5, 4, 7, 6, 8])]
    surrogates = Surrogates(tuple(scores), (), "x")
    alone = correlate_scores(_sites(range(8)), load(mini), rows, surrogates)
    pairs = correlate_scores(_sites([0, 0, 1, 1, 2, 2, 3, 3]), load(mini), rows, surrogates)
    first, second = (
        next(f for f in agreements if f.measure == "seen_20").by_kind["spearman"] for agreements in (alone, pairs)
    )
    junction = JunctionScores(
        load(mini).name, tuple(f"s{n}" for n in range(8)), {"score": np.array([1.0, 3, 2, 5, 4, 7, 6, 8])},
        {"seen_20": MeasureValues(np.array(values), np.tile(np.array(values)[:, None], BLOCKS))},
        tuple("aabbccdd"),
    )  # fmt: skip
    expected = CorrelationStudy([junction], load(mini).seed).correlation("score", "seen_20", "spearman").interval
    assert second.value == first.value
    assert second.interval != first.interval and second.interval == expected


def _sites(poles):
    return [Site(f"s{n}", Pose(0.0, 0.0, 3.0), "small", pole=f"pole {pole}") for n, pole in enumerate(poles)]


def test_score_name_has_parameters():
    assert str(ScoreName("egvs", '{"gamma":"inf","moving_occlusion":true,"voxel_m":0.5}')) == (
        "egvs (gamma inf, moving occlusion, voxel 0.5)"
    )
    assert str(ScoreName("coverage", "{}")) == "coverage"


# ---- through the command line


@pytest.mark.slow
def test_second_run_reports_cached_detections(run_egvs, mini, tmp_path):
    (tmp_path / "out" / ".validate-killed" / "unseen").mkdir(parents=True)  # left by a killed run
    code, out, error = run_egvs(*OPTIONS, mini, "--out", tmp_path / "out")
    assert code == 0, error
    assert "10 frames from 2 sites, points, 1 process\n" in error and "s   pole_b: points" in error
    assert "about" not in error  # two sites are too few to estimate a time from
    assert "18 vehicles in 10 frames" in out and "warning: " in out
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [".lock", *ARTEFACTS]
    first = {name: (tmp_path / "out" / name).read_bytes() for name in ARTEFACTS}
    code, again, error = run_egvs(*OPTIONS, mini, "--out", tmp_path / "out")
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
def test_rejects_invalid_options(run_egvs, mini, tmp_path, arguments, message):
    (mini / "cloud.csv").write_text("x_m,y_m,z_m\n12,3,0\n20,1,0\n")
    (mini / "measured.csv").write_text("site,x_m,y_m,z_m,points\npole_a,10,12,3,cloud.csv\npole_b,30.5,-12,3,\n")
    code, _, error = run_egvs(*OPTIONS, mini, "--out", tmp_path / "out", *arguments)
    assert code == 2 and message in error, error
    assert error.count("egvs: ") <= 1 and "Traceback" not in error
    assert not any((tmp_path / "out" / name).exists() for name in ARTEFACTS)
    assert [path.name for path in (tmp_path / "out").glob("*")] in ([], [".lock"])


def test_does_not_overwrite_file_with_name_of_folder(run_egvs, mini, tmp_path):
    (tmp_path / "out").write_text("mine")
    code, _, error = run_egvs(*OPTIONS, mini, "--out", tmp_path / "out")
    assert code == 2 and f"{tmp_path / 'out'}: cannot be written" in error
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.slow
def test_site_without_visible_vehicle(run_egvs, mini, tmp_path):
    with (mini / "scenario.toml").open("a") as file:
        file.write("\n[sensors.up]\nelevations_deg = [20, 40]\nchannels = 4\nazimuth_step_deg = 2.0\nrange_m = 100\n")
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,sensor\npole_a,10,12,3,small\nsky,20,8,4.5,up\n")
    code, out, error = run_egvs(*OPTIONS, mini, "--out", tmp_path / "out")
    assert code == 0, error
    rows = parquet.read_artefact(tmp_path / "out" / "detection.parquet", "detection")[0].to_pylist()
    by = {row["objects_of"]: row for row in rows if row["site"] == "sky"}
    assert by["vehicles"]["seen_1"] == 0.0 and by["points_1"]["objects"] == 0
    assert math.isnan(by["points_1"]["log_points"])
    assert " 0.0 ± 0.0" in next(line for line in out.splitlines() if line.startswith("sky"))
