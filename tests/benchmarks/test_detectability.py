"""How likely a detector finds a vehicle, learnt: hits, curve and fit on made-up data, the file, the command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks.detectability import __main__ as command
from benchmarks.detectability import examples, figures, fitting, writing
from benchmarks.detectability.fitting import Examples
from benchmarks.validity import junctions, study

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core.grid import Grid
from egvs.scoring import target_scores
from egvs.scoring.target_scores import DETECTORS, FEATURES, DetectabilityModel
from egvs.scoring.targets import TargetRecord
from tests.conftest import write_mini

GRID = Grid((0.0, 0.0, 0.0), 1.0, (60, 60, 5))


def car(x: float, length: float = 4.0, z: float = 0.75, height: float = 1.5) -> tuple[float, ...]:
    """Along x, 2 m wide."""
    return (x, 30.0, z, length, 2.0, height, 0.0)


def record_of(*frames: list[tuple[float, ...]]) -> TargetRecord:
    """Passenger cars alone."""
    made = [
        TrafficFrame(n, tuple(f"v{i}" for i in range(len(its))), ("passenger",) * len(its),
                     np.array(its, dtype=np.float64).reshape(-1, 7), np.zeros(len(its)))
        for n, its in enumerate(frames)
    ]  # fmt: skip
    return TargetRecord.of(made, GRID)


def boxes(*its: tuple[float, ...]) -> np.ndarray:
    return np.array(its, dtype=np.float64).reshape(-1, 7)


# what was found


@pytest.mark.slow
def test_hits_by_hand() -> None:
    record = record_of([car(10.0), car(20.0)], [], [car(30.0), car(40.0), car(50.0)])
    found = [
        boxes(car(20.0)),
        boxes(car(10.0)),  # nobody is there in this frame
        boxes(
            car(30.0 + 0.5),  # 3.5 of 4.5 m are common: 0.78
            car(40.0 + 0.75),  # 3.25 of 4.75 m: 0.68
            car(50.0, z=1.0),  # the same from above; 1.25 of 1.75 m of height: 0.71
            car(50.0, z=1.1),  # nor does a second one take the hit away
        ),
    ]
    assert examples.hits_of(record, found).tolist() == [0.0, 1.0, 1.0, 0.0, 1.0]


@pytest.mark.slow
def test_a_box_too_high_is_found_from_above_alone_and_the_bound_itself_is_not_enough() -> None:
    record = record_of([car(10.0), car(20.0, length=10.0), car(40.0, length=10.0)])
    found = [boxes(car(10.0, z=1.25), car(20.0, length=7.0), car(40.0, length=7.001))]  # 0.5 in space; 0.7 and more
    assert examples.hits_of(record, found).tolist() == [0.5, 0.0, 1.0]


def test_no_detections_and_no_vehicles() -> None:
    assert examples.hits_of(record_of([car(10.0)]), [boxes()]).tolist() == [0.0]
    assert examples.hits_of(record_of([], []), [boxes(car(10.0)), boxes()]).tolist() == []


# what is learnt


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small models for little data; on one thread, else scikit-learn starts a program that counts the cores."""
    monkeypatch.setattr(fitting, "TREES", 20)
    monkeypatch.setattr(fitting, "MIN_SAMPLES", 20)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


def test_the_curve_by_hand() -> None:
    chances, hits = np.array([0.04, 0.06, 0.5, 1.0, 0.99]), np.array([0.0, 0.5, 1.0, 1.0, 0.5])
    assert fitting.curve(chances, hits) == [
        {"chance": 0.05, "found": 0.25, "vehicle_frames": 2},
        {"chance": 0.5, "found": 1.0, "vehicle_frames": 1},
        {"chance": 0.995, "found": 0.75, "vehicle_frames": 2},
    ]


def random_detections(seed: int, sites: int = 4, rows: int = 500) -> Examples:
    """Found with a chance that rises with points, and half as likely where a neighbour is near."""
    rng = np.random.default_rng(seed)
    features, hits, ap = [], [], []
    for site in range(sites):
        x = rng.integers(0, 65, (rows, len(FEATURES))) / 64  # few values: that is quicker to learn from
        x[:, 0] *= 4.0 + site
        x[:, FEATURES.index("gap_m")] *= 20.0
        hit = rng.random((2, rows)) < truth(x)
        features.append(x)
        hits.append(hit.mean(axis=0))
        ap.append(float(hit.mean()))
    return Examples(features, hits, ap)


def truth(x: np.ndarray) -> np.ndarray:
    return x[:, 0] / 8.0 * np.where(x[:, FEATURES.index("gap_m")] < 5.0, 0.5, 1.0)


@pytest.mark.slow
def test_a_planted_dependence_is_found_and_holds_elsewhere() -> None:
    given = {name: random_detections(seed) for seed, name in enumerate(("one", "two", "three"), start=1)}
    learnt = fitting.fit_model(list(given.values()))
    assert learnt == fitting.fit_model(list(given.values())) and len(learnt["trees"]) == fitting.TREES
    model = DetectabilityModel.of(learnt)
    x = np.full((50, len(FEATURES)), 0.5)
    x[:, 0], x[:, FEATURES.index("gap_m")] = np.linspace(0.0, 7.0, 50), 12.0
    alone = model.chances(x)
    assert (np.diff(alone) >= 0.0).all() and np.abs(alone - truth(x)).mean() < 0.05
    x[:, FEATURES.index("gap_m")] = 2.0
    assert np.abs(model.chances(x) - truth(x)).mean() < 0.05

    held = fitting.cross_validate(given)
    assert list(held["rho_with_ap"]) == list(given) and min(held["rho_with_ap"].values()) == 1.0
    parts = held["calibration"]
    assert sum(part["vehicle_frames"] for part in parts) == 3 * 4 * 500
    assert sum(part["vehicle_frames"] * abs(part["chance"] - part["found"]) for part in parts) < 0.03 * 3 * 4 * 500


# the file


def about_of(shipped: dict) -> writing.TrainingMetadata:
    its = shipped["about"]
    on = {
        n: writing.TrainingJunction(j["sites"], tuple(j["sensors"]), j["vehicle_frames"])
        for n, j in its["learnt_on"].items()
    }
    return writing.TrainingMetadata(on, its["frames"], its["settings"], its["scikit_learn"])


def test_the_shipped_file_is_as_it_would_be_written_again() -> None:
    text = target_scores.MODEL_FILE.read_text(encoding="utf-8")
    shipped = json.loads(text)
    assert writing.text(about_of(shipped), shipped["detectors"]) == text
    for name, its in shipped["detectors"].items():
        counts = {n: j["sites"][name] * j["vehicle_frames"] for n, j in shipped["about"]["learnt_on"].items()}
        assert sum(part["vehicle_frames"] for part in its["elsewhere"]["calibration"]) == sum(counts.values())


def test_the_shipped_models_are_of_the_detectors_that_are_shipped() -> None:
    from egvs.core import files
    from egvs.validation.detectors import base

    shipped = json.loads(target_scores.MODEL_FILE.read_text(encoding="utf-8"))["about"]["settings"]
    assert shipped == {name: files.hash_json(base.make_detector(name).settings) for name in DETECTORS}


def test_the_picture_shows_every_part_of_the_curves(tmp_path: Path) -> None:
    shipped = json.loads(target_scores.MODEL_FILE.read_text(encoding="utf-8"))
    above, below = figures.calibration(shipped).axes
    lines = {line.get_label().partition(",")[0]: line.get_xydata().tolist() for line in above.lines}
    for name, its in shipped["detectors"].items():
        assert lines[name] == [[part["chance"], part["found"]] for part in its["elsewhere"]["calibration"]]
    assert sum(bar.get_height() for bar in below.patches) == pytest.approx(len(DETECTORS))
    figures.draw(tmp_path / "its.png", target_scores.MODEL_FILE)
    assert (tmp_path / "its.png").read_bytes().startswith(b"\x89PNG")


# the command


def test_wrong_arguments_are_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = ["--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")]
    for options, said in {
        ("--junction", "nishishinjuku"): "got 'nishishinjuku'. Use some of ingolstadt, hill, roundabout",
        ("--junction", "hill"): "--junction: expected at least 2 junctions, got hill",
        ("--junction", "hill", "--osm-training", str(tmp_path / "no.osm")): "--osm-training: no such file",
        ("--osm-training-at", "50.1,9.2"): "--osm-training-at: used without --osm-training",
        ("--osm-training-at", "here", "--osm-training", "east.osm"): "here",
        ("--only-draw",): "--only-draw: no such file",
    }.items():
        assert command.main([*paths, *options]) == 2
        assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_complete_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    (tmp_path / "scenarios").mkdir()
    for name in ("ingolstadt", "hill"):
        write_mini(tmp_path / "scenarios" / name)
    monkeypatch.setattr(junctions, "SCENARIOS", tmp_path / "scenarios")
    monkeypatch.setattr(junctions, "check_unseen", lambda scenario: None)  # these have a finished file
    monkeypatch.setattr(study, "APART_S", 2.0)
    monkeypatch.setattr(command, "DETECTORS", ("cluster",))
    options = ["--frames", "10", "--places", "1", "--jobs", "1", "--data", str(tmp_path / "data")]
    assert command.main([*options, "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out" / "detectability.png").is_file()
    learnt = json.loads((tmp_path / "out" / "target_scores.json").read_text(encoding="utf-8"))
    its = learnt["about"]["learnt_on"]["hill"]
    assert its["sites"] == {"cluster": 6} and its["sensors"] == ["small"] and learnt["about"]["frames"] == 10
    curve = learnt["detectors"]["cluster"]["elsewhere"]["calibration"]
    assert sum(part["vehicle_frames"] for part in curve) == 2 * 6 * its["vehicle_frames"] > 0
    said = capsys.readouterr().out
    assert "hill: 10 frames 2 s apart, cluster from 6" in said and "cluster: rho with AP at other junctions" in said
