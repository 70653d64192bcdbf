"""Fitting and comparing additive models: known models, by hand, the table, the figure, arguments."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from benchmarks.across_junctions.models import additive_fitting, comparison, figures, fitting
from benchmarks.across_junctions.models.additive_fitting import TrainingRows, choose_knots, fit_additive, ramps
from benchmarks.across_junctions.models.additive_model import DIRECTIONS, TargetFeatures
from benchmarks.across_junctions.models.comparison import ModelForm, SiteRows
from benchmarks.across_junctions.protocol import read_protocol

from egvs.core.errors import EgvsError

POINTS, SHADOW = ModelForm("additive", comparison.POINTS), ModelForm("additive", comparison.SHADOW)
TREES = ModelForm("trees", ("log_points", "hidden_share"), trees=10)


def rows(seed: int, truth, count: int = 4000) -> TrainingRows:
    """Vehicles with random features, detected with a known probability."""
    rng = np.random.default_rng(seed)
    columns = {name: rng.uniform(0.0, 1.0, count) for name in DIRECTIONS}
    columns["log_points"] = rng.uniform(0.1, 6.0, count)
    features = TargetFeatures(columns, rng.integers(0, 2, count))
    return TrainingRows(features, (rng.random((2, count)) < truth(features)).mean(axis=0))


def known_probability(x: TargetFeatures) -> np.ndarray:
    logit = 1.5 * (x.columns["log_points"] - 3.0) - 2.0 * x.columns["hidden_share"] + x.vehicle_class
    return 1.0 / (1.0 + np.exp(-logit))


def test_ramps_by_hand():
    knots = np.array([0.0, 1.0, 3.0])
    np.testing.assert_array_equal(ramps(np.array([-1.0, 0.5, 2.0, 9.0]), knots), [[0, 0], [0.5, 0], [1, 0.5], [1, 1]])
    np.testing.assert_allclose(choose_knots(np.arange(101.0), 3), [1.0, 50.0, 99.0])
    assert choose_knots(np.append(np.zeros(999), 1.0)).tolist() == [0.0, 1.0] and len(choose_knots(np.ones(5))) == 1


def test_fit_recovers_a_known_model_on_new_data():
    model = fit_additive([rows(1, known_probability), rows(2, known_probability)], ["log_points", "hidden_share"])
    other = rows(3, known_probability)
    assert np.abs(model.chances(other.features) - known_probability(other.features)).mean() < 0.03
    assert model.class_offsets[1] - model.class_offsets[0] == pytest.approx(1.0, abs=0.25)


def test_a_dependence_against_physics_is_not_learnt():
    def inverted(x: TargetFeatures) -> np.ndarray:
        return 1.0 / (1.0 + np.exp(1.5 * (x.columns["log_points"] - 3.0)))

    model = fit_additive([rows(1, inverted)], ["log_points", "range_m"])
    assert (np.diff(model.curves["log_points"][1]) == 0.0).all()  # flat rather than falling


def test_minimum_has_no_slope():
    """Any admissible small step from the fitted model raises the loss, evaluated by itself."""
    data, name = rows(4, known_probability, 800), "log_points"
    model = fit_additive([data], [name], with_classes=False)
    knots, values = model.curves[name]

    def loss(intercept, values) -> float:
        logit = intercept + np.interp(data.features.columns[name], knots, values)
        p = 1.0 / (1.0 + np.exp(-logit))
        ridge = 0.5 * additive_fitting.RIDGE * (np.diff(values) ** 2).sum()
        return float(-(data.hits * np.log(p) + (1 - data.hits) * np.log(1 - p)).mean() + ridge)

    best = loss(model.intercept, values)
    for k in range(len(values)):
        step = 0.03 * (np.arange(len(values)) >= k)
        for sign in (1, -1):
            moved = values + sign * step
            if k == 0:
                assert loss(model.intercept + sign * 0.03, values) > best
            elif (np.diff(moved) >= 0.0).all():
                assert loss(model.intercept, moved) > best


def test_a_fit_that_does_not_converge_is_an_error(monkeypatch):
    monkeypatch.setattr(additive_fitting, "MAX_ITERATIONS", 1)
    with pytest.raises(EgvsError, match="the additive model of log_points, hidden_share was not fitted: L-BFGS-B: "):
        fit_additive([rows(1, known_probability)], ["log_points", "hidden_share"])


# ---- the comparison


def sites(seed: int, noise: float = 0.0) -> list[SiteRows]:
    """Eight sites at two heights that see more and more; AP is the share found, or half of it at random."""
    rng = np.random.default_rng(seed)
    result = []
    for number in range(8):
        count = 400
        columns = {name: rng.uniform(0.0, 1.0, count) for name in DIRECTIONS}
        columns["log_points"] = rng.uniform(0.0, 2.0 + 0.5 * number, count) * (rng.random(count) > 0.1)
        features = TargetFeatures(columns, np.zeros(count, dtype=np.int64))
        hits = (rng.random((2, count)) < known_probability(features)).mean(axis=0) * (columns["log_points"] > 0.0)
        ap = float(hits.mean()) + noise * rng.normal()
        result.append(SiteRows(f"g0{number}h3", f"{number % 2} m", features, hits, known_probability(features), ap))
    return result


def test_results_by_hand():
    each = sites(1)[:4]
    ap = [0.1, 0.2, 0.3, 0.4]
    each = [
        SiteRows(s.site, "3 m", TargetFeatures({"log_points": np.array([1.0, 0.0])}, np.zeros(2, dtype=np.int64)),
                 np.array([1.0, 0.0]), np.array([0.5, 0.0]), a)
        for s, a in zip(each, ap, strict=True)
    ]  # fmt: skip
    values = [np.array([0.5, 0.0]), np.array([0.7, 0.0]), np.array([0.6, 0.0]), np.array([0.8, 0.0])]
    result = comparison.evaluate(each, values)
    assert result.rho == pytest.approx(0.8) and result.rho_in_group == pytest.approx(0.8)  # 1 - 6 * 2 / (4 * 15)
    # the vehicle without a point does not count
    assert result.loss == pytest.approx(-math.log(0.5 * 0.7 * 0.6 * 0.8) / 4)
    assert comparison.mean_and_error([0.5, 0.7, math.nan]) == "0.6000 ± 0.1000"
    assert comparison.mean_and_error([0.5]) == "0.5000 ± nan" and comparison.mean_and_error([math.nan]) == ""


def test_each_junction_is_predicted_by_the_others(monkeypatch):
    monkeypatch.setattr(comparison, "MODELS", {"points": POINTS, "shadow": SHADOW, comparison.SHIPPED_FORM: SHADOW})
    by_junction = {name: sites(seed) for seed, name in enumerate(("one", "two"), start=1)}
    fitted = []
    whole = comparison.fit
    monkeypatch.setattr(comparison, "fit", lambda rows, model: fitted.append(rows) or whole(rows, model))
    results = comparison.compare(by_junction)
    assert [len(rows) for rows in fitted] == [1] * 6  # never on the junction itself
    first = comparison.training_rows(by_junction["one"])
    assert np.array_equal(fitted[-1][0].hits, first.hits) and (first.features.columns["log_points"] > 0.0).all()
    assert results["shadow"]["one"].rho > 0.85
    assert results["shadow"]["one"].loss < results["points"]["one"].loss
    lines = list(comparison.table(results))  # the shipped score was trained at neither
    assert len(lines) == 2 + 5 and all(line.count("|") == lines[0].count("|") for line in lines)
    assert "| 0.0000 ± 0.0000 |" in lines[2]  # points_on_target minus itself


def test_table_marks_where_the_shipped_score_is_in_sample():
    """Trained at one of three junctions: 0.9 there is marked, and the means are of 0.5 and 0.7."""
    rhos = dict(zip(("seen", "one", "two"), (0.9, 0.5, 0.7), strict=True))
    by_junction = {name: comparison.ModelResult(rho, rho, 1.0 - rho) for name, rho in rhos.items()}
    results = dict.fromkeys((comparison.COUNT_SCORE, comparison.SHIPPED_SCORE, comparison.SHIPPED_FORM), by_junction)
    lines = list(comparison.table(results, {"seen", "elsewhere"}))
    assert lines[2].startswith("| points_on_target | 0.900 | 0.500 | 0.700 | 0.7000 ± 0.1155 |")
    same = "0.0000 ± 0.0000"
    shipped = (
        f"| expected_detections (shipped) | 0.900 (in-sample) | 0.500 | 0.700 | 0.6000 ± 0.1000 | {same} | {same} "
    )
    assert lines[3] == f"{shipped}| 0.6000 ± 0.1000 | 0.4000 ± 0.1000 | {same} |"
    assert lines[5:] == ["", "In-sample: the shipped score was trained at seen; its means leave them out."]
    assert list(comparison.table(results, ()))[3] == lines[2].replace(
        "points_on_target", "expected_detections (shipped)"
    )


def test_differences_are_from_the_shipped_form():
    results = {
        name: {"one": comparison.ModelResult(rho, rho, loss), "two": comparison.ModelResult(rho, rho, loss + 0.1)}
        for name, rho, loss in (
            (comparison.COUNT_SCORE, 0.5, math.nan), (comparison.SHIPPED_FORM, 0.8, 0.3), ("larger", 0.9, 0.28)
        )
    }  # fmt: skip
    cells = list(comparison.table(results, ()))[4].split(" | ")
    assert cells[4:6] == ["0.4000 ± 0.0000", "0.1000 ± 0.0000"] and cells[-1].startswith("-0.0200 ± 0.0000")


def test_shipped_training_junctions_are_those_of_the_file():
    training = {junction.name for junction in read_protocol().junctions if junction.role == "training"}
    assert comparison.shipped_training_junctions() == training


@pytest.mark.slow
def test_trees_keep_the_directions_and_weight_junctions_equally(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # else scikit-learn starts a program that counts the cores
    # the same features; found always at the small junction, never at the one of ten times as many vehicles
    small, large = rows(1, lambda x: 2.0, 400), rows(2, lambda x: -1.0, 4000)
    model = comparison.fit([small, large], TREES)
    assert model.chances(rows(3, known_probability).features).mean() == pytest.approx(0.5, abs=0.05)
    monkeypatch.setattr(fitting, "MIN_SAMPLES", 50)
    model = comparison.fit([rows(1, known_probability), rows(2, known_probability)], TREES)
    x = rows(3, known_probability).features
    fewer = TargetFeatures({**x.columns, "log_points": 0.5 * x.columns["log_points"]}, x.vehicle_class)
    assert (model.chances(x) >= model.chances(fewer)).all()
    assert (model.chances(x) - model.chances(fewer)).mean() > 0.1


@pytest.mark.slow
def test_reliability_diagram_shows_every_bin(tmp_path: Path):
    curves = comparison.reliability({"one": sites(1), "two": sites(2)}, SHADOW)
    for number, parts in enumerate(curves.values(), start=1):
        assert sum(part["vehicle_frames"] for part in parts) == sum(int(s.has_points.sum()) for s in sites(number))
        # models of the same truth: within a few standard errors, sqrt(0.25 / 2 / 100), of well filled bins
        assert all(abs(part["chance"] - part["found"]) < 0.2 for part in parts if part["vehicle_frames"] > 100)
    figure = figures.reliability_diagrams("cluster", curves)
    drawn = {axes.get_title().partition(":")[0]: axes for axes in figure.axes if axes.get_title()}
    for name, parts in curves.items():
        offsets = drawn[name].collections[-1].get_offsets()
        np.testing.assert_allclose(offsets, [[part["chance"], part["found"]] for part in parts])
    figures.draw_reliability(tmp_path / "its.png", "cluster", curves)
    assert (tmp_path / "its.png").read_bytes().startswith(b"\x89PNG")


def test_title_has_the_difference_in_level_by_hand():
    parts = [{"chance": 0.2, "found": 0.1, "vehicle_frames": 30}, {"chance": 0.9, "found": 0.8, "vehicle_frames": 10}]
    figure = figures.reliability_diagrams("cluster", {"one": parts})
    assert figure.axes[0].get_title() == "one: +10.0 points predicted"
