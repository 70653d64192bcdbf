"""How likely a detector finds a vehicle, learnt: hits, curve and fit on made-up data, the file, the picture."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from benchmarks.across_junctions.detections import hits_of
from benchmarks.across_junctions.models import figures, fitting, model_file
from benchmarks.across_junctions.models.fitting import Examples

from egvs.scoring import target_scores
from egvs.scoring.target_scores import FEATURES, MODELLED, DetectabilityModel


def car(x: float, length: float = 4.0, z: float = 0.75, height: float = 1.5) -> tuple[float, ...]:
    """Along x, 2 m wide."""
    return (x, 30.0, z, length, 2.0, height, 0.0)


def boxes(*its: tuple[float, ...]) -> np.ndarray:
    return np.array(its, dtype=np.float64).reshape(-1, 7)


# what was found


@pytest.mark.slow
def test_hits_by_hand() -> None:
    vehicles = [boxes(car(10.0), car(20.0)), boxes(), boxes(car(30.0), car(40.0), car(50.0))]
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
    assert hits_of(vehicles, found).tolist() == [0.0, 1.0, 1.0, 0.0, 1.0]


def test_a_box_too_high_is_found_from_above_alone_and_the_bound_itself_is_not_enough() -> None:
    vehicles = [boxes(car(10.0), car(20.0, length=10.0), car(40.0, length=10.0))]
    found = [boxes(car(10.0, z=1.25), car(20.0, length=7.0), car(40.0, length=7.001))]  # 0.5 in space; 0.7 and more
    assert hits_of(vehicles, found).tolist() == [0.5, 0.0, 1.0]


def test_no_detections_and_no_vehicles() -> None:
    assert hits_of([boxes(car(10.0))], [boxes()]).tolist() == [0.0]
    assert hits_of([boxes(), boxes()], [boxes(car(10.0)), boxes()]).tolist() == []


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
    count = sum(part["vehicle_frames"] for part in parts)
    assert sum(part["vehicle_frames"] * abs(part["chance"] - part["found"]) for part in parts) < 0.03 * count


@pytest.mark.slow
def test_vehicles_without_points_and_busy_junctions_do_not_change_a_model() -> None:
    """Those without points have probability 0 in the program; ten times as much of the same traffic counts as one."""
    first, second = random_detections(1), random_detections(2)
    hidden = np.zeros((900, len(FEATURES)))  # no points, but always found
    with_hidden = Examples([*first.features, hidden], [*first.hits, np.ones(900)], [*first.ap, 1.0])
    assert fitting.fit_model([with_hidden, second]) == fitting.fit_model([first, second])

    never = Examples(second.features * 10, [np.zeros(len(hits)) for hits in second.hits] * 10, second.ap * 10)
    always = Examples(first.features, [np.ones(len(hits)) for hits in first.hits], first.ap)
    x = np.full((1, len(FEATURES)), 0.5)
    assert DetectabilityModel.of(fitting.fit_model([always, never])).chances(x)[0] == pytest.approx(0.5, abs=0.05)

    left_out = fitting.cross_validate({"one": with_hidden, "two": second, "three": random_detections(3)})
    assert sum(part["vehicle_frames"] for part in left_out["calibration"]) == sum(
        int(fitting.has_points(x).sum()) for seed in (1, 2, 3) for x in random_detections(seed).features
    )


def test_thresholds_are_not_rounded_below_a_value_of_the_data() -> None:
    assert fitting._short_above(math.log(2.0)) == 0.693148  # 0.69314718: one point stays below or on it
    assert fitting._short_above(2.5) == 2.5 and fitting._short_above(-0.1234564) == -0.123456


# the file


def about_of(shipped: dict) -> model_file.TrainingMetadata:
    its = shipped["about"]
    on = {
        n: model_file.TrainingJunction(j["sites"], tuple(j["sensors"]), j["vehicle_frames"])
        for n, j in its["learnt_on"].items()
    }
    return model_file.TrainingMetadata(on, its["frames"], its["settings"], its["scikit_learn"])


def test_the_shipped_file_is_as_it_would_be_written_again() -> None:
    text = target_scores.MODEL_FILE.read_text(encoding="utf-8")
    shipped = json.loads(text)
    assert model_file.text(about_of(shipped), shipped["detectors"]) == text
    for name, its in shipped["detectors"].items():
        counts = {n: j["sites"][name] * j["vehicle_frames"] for n, j in shipped["about"]["learnt_on"].items()}
        seen = sum(part["vehicle_frames"] for part in its["elsewhere"]["calibration"])  # those with points
        assert 0.3 * sum(counts.values()) < seen < sum(counts.values())


def test_the_shipped_models_are_of_the_detectors_that_are_shipped() -> None:
    from benchmarks.across_junctions import study_detectors

    from egvs.core import files

    shipped = json.loads(target_scores.MODEL_FILE.read_text(encoding="utf-8"))["about"]["settings"]
    assert shipped == {name: files.hash_json(study_detectors.make(name).settings) for name in MODELLED}


@pytest.mark.slow
def test_the_picture_shows_every_part_of_the_curves(tmp_path: Path) -> None:
    shipped = json.loads(target_scores.MODEL_FILE.read_text(encoding="utf-8"))
    above, below = figures.calibration(shipped).axes
    lines = {line.get_label().partition(",")[0]: line.get_xydata().tolist() for line in above.lines}
    for name, its in shipped["detectors"].items():
        assert lines[name] == [[part["chance"], part["found"]] for part in its["elsewhere"]["calibration"]]
    assert sum(bar.get_height() for bar in below.patches) == pytest.approx(len(MODELLED))
    figures.draw(tmp_path / "its.png", target_scores.MODEL_FILE)
    assert (tmp_path / "its.png").read_bytes().startswith(b"\x89PNG")
