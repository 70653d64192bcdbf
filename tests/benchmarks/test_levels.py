"""The level on simulated streets: levels and corrections of rows made by hand, fleets, and the tables of the docs."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.across_junctions import levels, streets
from benchmarks.across_junctions.__main__ import main
from benchmarks.across_junctions.protocol import Junction, Protocol, read_protocol
from benchmarks.across_junctions.streets import StreetRows

from egvs.results.study_results import STUDY
from egvs.scenario.score_config import UNCORRECTED
from egvs.scoring import target_scores
from egvs.scoring.target_scores import CORRECTION_FEATURES, DETECTORS, FEATURES, DetectabilityModel
from tests.scoring.target_scenes import frame, seen
from tests.scoring.test_visible_targets import AT, car, fan

DATA = Path(__file__).parents[2] / "docs" / "data"

STUMP = {"base": 0.4, "trees": [[[0, 2.0, 1, 2], [-1.5], [1.0]]]}
"""Finds those with more than 2 of the first feature."""


def street(hits: np.ndarray, log_points: np.ndarray, group: np.ndarray | None = None) -> StreetRows:
    """Vehicle-frames of 4.5 x 1.8 x 1.5 m, each in a block of its own; log_points (m, n) is the only feature."""
    m, n = hits.shape
    features = np.zeros((m, n, len(FEATURES)))
    features[:, :, 0] = log_points
    names = tuple(f"c{i}" for i in range(m))
    return StreetRows(
        "made", names, names, features, {"cluster": hits}, {"cluster": hits.mean(axis=1)},
        np.zeros(n, dtype=np.int64) if group is None else group, np.arange(n) * 10 // n,
        np.tile([4.5, 1.8, 1.5], (n, 1)), np.expm1(log_points),
    )  # fmt: skip


def test_level_errors_by_hand() -> None:
    hits = np.array([[1.0, 0.5, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    expected = np.array([[0.9, 0.9, 0.2, 0.6], [0.1, 0.0, 0.0, 0.1]])
    each = levels.level_errors(street(hits, np.ones((2, 4)), np.array([0, 0, 0, 1])), "cluster", expected)
    by_name = {level.road_users: level for level in each}
    whole = by_name["all"]
    assert (whole.expected, whole.found, whole.error) == pytest.approx((35.0, 18.75, 16.25))
    assert whole.upper_rms == pytest.approx(27.5)  # of the first candidate: 65 expected, 37.5 found
    assert whole.rho == pytest.approx(1.0)
    differences = np.array([-0.1 + 0.1, 0.4, 0.2, 0.6 + 0.1]) / 2  # of each block
    left_out = (differences.sum() - differences) / 3
    assert whole.se == pytest.approx(100 * math.sqrt(3 / 4 * ((left_out - left_out.mean()) ** 2).sum()))
    assert by_name["larger vehicles"].error == pytest.approx(35.0) and math.isnan(by_name["cars"].rho)


def test_scaling_recovers_the_scale_and_shift_that_hits_were_made_with() -> None:
    log_points = np.repeat([1.0, 3.0], 5000)[None]
    logit = np.where(log_points > 2.0, 1.4, -1.1)
    chance = 1.0 / (1.0 + np.exp(-(0.3 + 0.5 * logit)))
    model = levels.scaled(STUMP, levels.Examples.of([street(chance, log_points)], "cluster"))
    assert model["correction"]["scale"] == pytest.approx(0.5, abs=1e-3)
    assert model["correction"]["base"] == pytest.approx(0.3 + 0.5 * 0.4, abs=1e-3)
    np.testing.assert_allclose(levels.chances(model, street(chance, log_points)), chance, atol=1e-3)


def test_further_trees_learn_the_size_of_larger_vehicles_and_keep_monotonicity() -> None:
    """Half of the larger vehicles, the low ones, are never found; scaling alone cannot tell."""
    random = np.random.default_rng(1)
    n = 6000
    group = np.arange(n) % 2
    rows = street(np.zeros((1, n)), random.uniform(0.1, 6.0, (1, n)), group)
    is_low = (np.arange(n) % 4 == 1) & (group == 1)
    rows.size_m[group == 1] = 9.0, 2.5, 3.5
    rows.size_m[is_low, 2] = 2.0
    rows.hits["cluster"][:] = np.where(is_low, 0.0, random.random((1, n)) < 0.1 + 0.14 * rows.features[:, :, 0])
    examples = levels.Examples.of([rows], "cluster")
    scaled, continued = levels.scaled(STUMP, examples), levels.continued(STUMP, examples)
    of_low = [levels.chances(model, rows)[0, is_low].mean() for model in (scaled, continued)]
    assert of_low[0] > 0.3 and of_low[1] < 0.1
    assert abs(levels.level_errors(rows, "cluster", levels.chances(continued, rows))[0].error) < 1.0
    x = np.tile(levels.features_of(rows)[:1], (50, 1))
    x[:, 0] = np.linspace(0.1, 6.0, 50)
    assert (np.diff(DetectabilityModel.of(dict(continued)).chances(x)) >= 0.0).all()


def test_the_file_of_corrections_is_what_the_program_applies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hits = np.array([[1.0] * 600 + [0.0] * 600])
    rows = street(hits, np.linspace(0.1, 5.0, 1200)[None])
    models = levels.models_by("continued", [rows], ["cluster"])
    text = levels.corrections_text(models, [rows])
    correction = json.loads(text)["detectors"]["cluster"]
    entry = target_scores.corrected_entry(levels.shipped_model("cluster"), correction)
    expected = levels.chances(models["cluster"], rows)
    np.testing.assert_array_equal(levels.chances(entry, rows), expected)


@pytest.mark.slow
@pytest.mark.system
def test_a_trial_writes_into_its_own_folder_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measured = set()

    def measure(protocol: Protocol, junction: Junction, folder: Path, *, candidates: int, **_: object) -> StreetRows:
        folder.mkdir(exist_ok=True)
        measured.add((folder, candidates, protocol.frames_of(junction)))
        rows = street(np.array([[0.0] * 300 + [1.0] * 300] * 2), np.linspace([0.1, 0.1], [5.0, 2.0], 600, axis=1))
        return replace(
            rows, hits=dict.fromkeys(DETECTORS, rows.hits["cluster"]), ap=dict.fromkeys(DETECTORS, np.arange(2.0))
        )

    monkeypatch.setattr(streets, "measure", measure)
    monkeypatch.setattr(levels, "shipped_model", lambda _: STUMP)
    before = target_scores.CORRECTIONS_FILE.read_bytes()
    options = [
        "--fit",
        "--frames",
        "20",
        "--candidates",
        "2",
        "--data",
        str(tmp_path),
        "--out",
        str(tmp_path / "tables"),
    ]
    assert main(["levels", *options]) == 0
    ((folder, *shortened),) = measured
    assert shortened == [2, 20]
    assert {path.name for path in folder.iterdir()} == {"street_levels.csv", "street_corrections.json"}
    assert target_scores.CORRECTIONS_FILE.read_bytes() == before and list(tmp_path.iterdir()) == [folder]


def test_features_of_streets_are_those_of_the_program() -> None:
    truck = (AT[0] + 20.0, AT[1], 1.5, 9.0, 2.5, 3.0, math.pi / 2)
    visible = seen([frame([car(10.0, 0.0), truck], kinds=["passenger", "truck"])], fan())
    expected = target_scores.correction_features(visible)
    assert expected.shape[1] == len(CORRECTION_FEATURES)
    assert expected[:, -3:].tolist() == [[0.0, 0.0, 0.0], [9.0, 2.5, 3.0]]
    features = target_scores.detectability_features(visible)[None]
    rows = StreetRows("made", ("c",), ("s",), features, {}, {}, np.array([0, 1]), np.zeros(2, dtype=np.int64),
                      visible.record.boxes[:, 3:6], visible.points[None])  # fmt: skip
    np.testing.assert_array_equal(levels.features_of(rows), expected)


# ---- fleets


def test_fleets_have_the_sizes_of_the_labelled_street_and_none_in_common() -> None:
    fleets = read_protocol(streets.STREETS_FILE).fleets
    published = {"car": ((4.22, 0.27), (1.89, 0.13), (1.58, 0.11)), "van": ((6.00, 0.74), None, (2.49, 0.44))}
    for fleet in fleets.values():
        for name, sizes in published.items():
            kinds = [kind for kind in fleet if kind.name.startswith(name)]
            for axis, size in zip(("length_m", "width_m", "height_m"), sizes, strict=True):
                values = [getattr(kind, axis) for kind in kinds]
                if size is not None:
                    assert (np.mean(values), np.std(values)) == pytest.approx(size, abs=0.01)
        assert max(kind.width_m for kind in fleet) <= 2.55 and max(kind.height_m for kind in fleet) <= 4.0
    boxes = [
        {(k.length_m, k.width_m, k.height_m) for k in fleet if k.name != "motorcycle"} for fleet in fleets.values()
    ]
    assert not boxes[0] & boxes[1]


# ---- tables of the docs


def _street_levels(model: str, detector: str, road_users: str = "all") -> Iterator[dict[str, str]]:
    with (DATA / "street_levels.csv").open(encoding="utf-8", newline="") as lines:
        for row in csv.DictReader(lines):
            if (row["model"], row["detector"], row["road_users"]) == (model, detector, road_users):
                yield row


def test_the_printed_error_is_the_measured_one() -> None:
    names = {"corrected": "", "uncorrected": UNCORRECTED}
    for model, ending in names.items():
        for detector in DETECTORS:
            for group, points in STUDY.street_levels.error_points[detector + ending].items():
                errors = [float(row["upper_rms"]) for row in _street_levels(model, detector, group)]
                assert points == math.ceil(math.sqrt(np.mean(np.square(errors))))
            errors = [float(row["upper_rms"]) for row in _street_levels(model, detector)]
            assert STUDY.street_levels.street_error_points[detector + ending] == (
                round(min(errors)),
                round(max(errors)),
            )
    other = [float(row["upper_rms"]) for row in _street_levels("corrected", "range_image")]
    assert STUDY.street_levels.other_detector_error_points == (round(min(other)), round(max(other)))
    for detector, groups in STUDY.street_levels.groups.items():
        for group in groups:
            errors = [float(row["error"]) for row in _street_levels("corrected", detector, group)]
            assert abs(np.mean(errors)) < 5.0 and max(map(abs, errors)) < 10.0


def test_the_order_at_held_out_junctions_stays_within_its_interval() -> None:
    interval = {}
    with (DATA / "larger_study" / "2-by-junction.csv").open(encoding="utf-8", newline="") as lines:
        for row in csv.DictReader(lines):
            if row.get("score") == "expected_detections (detectors cluster+pointpillars)":
                interval[row["junction"], row["detector"]] = float(row["rho low"]), float(row["rho high"])
    with (DATA / "street_levels_order.csv").open(encoding="utf-8", newline="") as lines:
        rows = [row for row in csv.DictReader(lines) if row["losses"] == "no"]
    assert len(rows) == 3 * STUDY.street_levels.junctions_of_larger_study
    rho = [float(row["corrected"]) for row in rows]
    assert (round(min(rho), 2), round(max(rho), 2)) == STUDY.street_levels.rho_in_larger_study
    for row in rows:
        low, high = interval[row["junction"], row["detector"]]
        assert low < float(row["corrected"]) < high
        assert low < float(row["uncorrected"]) < high
