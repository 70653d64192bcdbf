r"""Level errors of models on simulated streets (:mod:`benchmarks.across_junctions.streets`), and corrections of them.

*Level error*: expected minus found, in points of 100, of all vehicle-frames from all candidates of a junction. Its
standard error comes from leaving out one block of frames at a time.

*Corrections* keep the form of a model, boosted trees:

``scaled``
    The logit of the model becomes :math:`a + b\,l`, fitted by logistic loss. The order of vehicle-frames stays.
``continued``
    Further trees are boosted on what the scaled model leaves, with the same monotonicity: Newton steps, each a small
    regression tree (Friedman 2001, Annals of Statistics 29(5), 1189-1232). They know the size of vehicles that are not
    cars, but not the length of cars.
``refitted``
    New trees from the streets alone.

Which one is used was decided on the junctions to fit at, each predicted by the corrections of the others
(:func:`compare`); the others are for quoting only.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import spearmanr
from sklearn.tree import DecisionTreeRegressor

from benchmarks.across_junctions.candidates import read_candidates, with_sites
from benchmarks.across_junctions.detections import AP
from benchmarks.across_junctions.models.fitting import _short, _short_above, equal_weights, fit_trees
from benchmarks.across_junctions.protocol import CANDIDATES_FILE, Junction, Protocol, of_junction
from benchmarks.across_junctions.records import read_junction
from benchmarks.across_junctions.streets import GROUPS, StreetRows, visible_from_sites
from benchmarks.across_junctions.worlds import make_world
from egvs.core.grid import FloatArray
from egvs.runs.run import ensure_stages
from egvs.runs.run_context import open_folder
from egvs.scenario.loading import load
from egvs.scenario.score_config import UNCORRECTED_DETECTORS
from egvs.scoring.target_scores import (
    CORRECTION_FEATURES,
    CORRECTIONS_FILE,
    DETECTORS,
    FEATURES,
    MODEL_FILE,
    MONOTONICITY,
    DetectabilityModel,
    corrected_entry,
    expected_detections,
)
from egvs.scoring.targets import TargetRecord

POINTS = 100.0

LOG_POINTS = FEATURES.index("log_points")

TREES, DEPTH, RATE, MIN_SAMPLES = 20, 3, 0.3, 400
"""Trees that are added, their depth, learning rate, and vehicle-frames per leaf."""

Model = Mapping[str, Any]
"""``base`` and ``trees``, as in the program's file; of a corrected model also its ``correction``."""


def shipped_model(detector: str) -> Model:
    """Return the entry of the program's file."""
    model: Model = json.loads(MODEL_FILE.read_text(encoding="utf-8"))["detectors"][detector]
    return model


def uncorrected_models(detectors: Sequence[str] = DETECTORS) -> dict[str, Model]:
    """Return the models without correction, by detector."""
    return {name: shipped_model(name) for name in detectors}


def corrected_models(detectors: Sequence[str] = DETECTORS) -> dict[str, Model]:
    """Return the models with the program's corrections, by detector."""
    corrections = json.loads(CORRECTIONS_FILE.read_text(encoding="utf-8"))["detectors"]
    return {name: corrected(shipped_model(name), corrections[name]) for name in detectors}


def chances(model: Model, rows: StreetRows) -> FloatArray:
    """Return the probability of each vehicle-frame from each candidate, (m, n) float64; 0 without a point."""
    flat = features_of(rows)
    values = DetectabilityModel.of(dict(model)).chances(flat)
    return np.where(flat[:, LOG_POINTS] > 0.0, values, 0.0).reshape(rows.features.shape[:2])


def features_of(rows: StreetRows) -> FloatArray:
    """Return the features of corrected models of all vehicle-frames from all candidates, (m n, g) float64."""
    sizes_m = np.where((rows.group == GROUPS.index("cars"))[:, None], 0.0, rows.size_m)
    sites = rows.features.shape[0]
    return np.column_stack([rows.features.reshape(-1, len(FEATURES)), np.tile(sizes_m, (sites, 1))])


# ---- corrections


@dataclass(frozen=True, eq=False)
class Examples:
    """Vehicle-frames with points of some junctions: features (k, f), hits (k,), and a weight that junctions share."""

    x: FloatArray
    hits: FloatArray
    weight: FloatArray

    @classmethod
    def of(cls, each: Sequence[StreetRows], detector: str) -> Examples:
        """Collect those of one detector; all junctions have equal weight."""
        features, hits = [], []
        for rows in each:
            flat = features_of(rows)
            seen = flat[:, LOG_POINTS] > 0.0
            features.append(flat[seen])
            hits.append(rows.hits[detector].ravel()[seen])
        return cls(np.concatenate(features), np.concatenate(hits), equal_weights([len(h) for h in hits]))


def corrected(model: Model, correction: Model) -> Model:
    """Return a model with a correction: scale, base and further trees, as the program applies it."""
    return corrected_entry(model, correction) | {"correction": correction}


def unchanged(model: Model, _: Examples) -> Model:
    """Return the model."""
    return model


def scaled(model: Model, examples: Examples) -> Model:
    """Return the model with its logit scaled and shifted."""
    logit = _logit(model, examples.x)

    def loss(values: FloatArray) -> float:
        fitted = values[0] + values[1] * logit
        return float(np.mean(examples.weight * (np.logaddexp(0.0, fitted) - examples.hits * fitted)))

    shift, scale = minimize(loss, np.array([0.0, 1.0]), method="Nelder-Mead").x
    correction = {"scale": _short(scale), "base": _short(shift + scale * model["base"]), "trees": []}
    return corrected(model, correction)


def continued(model: Model, examples: Examples) -> Model:
    """Return the scaled model with further trees."""
    correction = dict(scaled(model, examples)["correction"])
    directions = [MONOTONICITY.get(name, 0) for name in CORRECTION_FEATURES]
    x = examples.x.copy()
    x[:, FEATURES.index("length_m")] = 0.0  # there are few lengths of cars, which trees would learn by heart
    logit = _logit(corrected(model, correction), examples.x)
    for _ in range(TREES):
        chance = expit(logit)
        curvature = np.maximum(chance * (1.0 - chance), 1e-3) * examples.weight
        step = DecisionTreeRegressor(
            max_depth=DEPTH, min_samples_leaf=MIN_SAMPLES, monotonic_cst=directions, random_state=0
        ).fit(x, examples.weight * (examples.hits - chance) / curvature, sample_weight=curvature)
        correction["trees"] = [*correction["trees"], _nodes(step)]
        logit = _logit(corrected(model, correction), examples.x)
    return corrected(model, correction)


def refitted(_: Model, examples: Examples) -> Model:
    """Return a model that is fitted from the examples alone."""
    return fit_trees(examples.x[:, : len(FEATURES)], examples.hits, examples.weight, list(MONOTONICITY.values()))


CORRECTIONS: Mapping[str, Callable[[Model, Examples], Model]] = {
    "unchanged": unchanged,
    "scaled": scaled,
    "continued": continued,
    "refitted": refitted,
}

CHOSEN = "continued"
"""The correction that the program has."""


def _logit(model: Model, x: FloatArray) -> FloatArray:
    chance = DetectabilityModel.of(dict(model)).chances(x)
    return np.log(chance) - np.log1p(-chance)


def _nodes(fitted: DecisionTreeRegressor) -> list[list[float | int]]:
    """Return a tree in the format of the program's file."""
    tree = fitted.tree_
    nodes: list[list[float | int]] = []
    for number in range(tree.node_count):
        if tree.children_left[number] < 0:
            nodes.append([_short(RATE * float(tree.value[number, 0, 0]))])
        else:
            threshold = _short_above(float(tree.threshold[number]))
            children = int(tree.children_left[number]), int(tree.children_right[number])
            nodes.append([int(tree.feature[number]), threshold, *children])
    return nodes


# ---- levels


@dataclass(frozen=True)
class LevelError:
    """Expected and found share of a detector at a junction, in points of 100.

    Attributes
    ----------
    road_users
        A name of :data:`GROUPS`, or ``all``.
    expected, found, error, se
        Means over candidates and vehicle-frames, their difference, and its standard error.
    upper_rms
        Root mean square of the errors of the candidates, of the half with the highest expected shares: a candidate that
        sees nothing is expected to find nothing, and finds nothing. It contains the noise of the share found.
    rho
        Spearman's coefficient of expected share and AP over the candidates, for all road users; else NaN.
    """

    junction: str
    detector: str
    road_users: str
    expected: float
    found: float
    error: float
    se: float
    upper_rms: float
    rho: float


def level_errors(rows: StreetRows, detector: str, expected: FloatArray) -> list[LevelError]:
    """Return the level errors of a detector at a junction, of all vehicles and of each group.

    Parameters
    ----------
    expected
        Probability of each vehicle-frame from each candidate, (m, n) float64.
    """
    hits = rows.hits[detector]
    errors = []
    for name, members in [("all", rows.group >= -1), *((g, rows.group == i) for i, g in enumerate(GROUPS))]:
        if not members.any():
            continue
        difference, block = (expected - hits)[:, members], rows.block[members]
        of_candidates = difference.mean(axis=1)
        upper = np.argsort(-expected[:, members].mean(axis=1), kind="stable")[: math.ceil(len(of_candidates) / 2)]
        blocks = np.unique(block)
        se = float("nan")
        if len(blocks) > 1:
            left_out = np.array([difference[:, block != b].mean() for b in blocks])
            se = float(np.sqrt((len(blocks) - 1) * np.mean((left_out - left_out.mean()) ** 2)))
        rho = float("nan")
        if name == "all":
            rho = float(spearmanr(expected.mean(axis=1), rows.ap[detector], nan_policy="omit").statistic)
        errors.append(
            LevelError(
                rows.junction, detector, name, POINTS * float(expected[:, members].mean()),
                POINTS * float(hits[:, members].mean()), POINTS * float(difference.mean()), POINTS * se,
                POINTS * float(np.sqrt((of_candidates[upper] ** 2).mean())), rho,
            )
        )  # fmt: skip
    return errors


# ---- comparison, at the junctions to fit at


@dataclass(frozen=True)
class Comparison:
    """A correction at a junction that it was not fitted at: level of all vehicles, and logistic loss."""

    correction: str
    detector: str
    level: LevelError
    loss: float


def models_by(correction: str, each: Sequence[StreetRows], detectors: Sequence[str] = DETECTORS) -> dict[str, Model]:
    """Return the corrected model of each detector, from the rows of some junctions."""
    correct = CORRECTIONS[correction]
    return {name: correct(shipped_model(name), Examples.of(each, name)) for name in detectors}


def compare(fitting: Sequence[StreetRows], detectors: Sequence[str] = DETECTORS) -> list[Comparison]:
    """Return how well each correction predicts each junction to fit at, from the others."""
    results = []
    for name in CORRECTIONS:
        for left_out in fitting:
            models = models_by(name, [rows for rows in fitting if rows is not left_out], detectors)
            for detector, model in models.items():
                expected = chances(model, left_out)
                level = level_errors(left_out, detector, expected)[0]
                hits = left_out.hits[detector]
                shares = np.clip(expected, 1e-6, 1.0 - 1e-6)
                loss = -float(np.mean(hits * np.log(shares) + (1.0 - hits) * np.log1p(-shares)))
                results.append(Comparison(name, detector, level, loss))
    return results


# ---- order of sites at held-out junctions of the larger study


@dataclass(frozen=True)
class StudyOrder:
    """Spearman's coefficient of the score with the AP that the larger study recorded, at one of its junctions.

    Attributes
    ----------
    losses
        Whether the score has losses of returns. The recorded sweeps have none.
    rho
        By the name of the models.
    """

    junction: str
    detector: str
    losses: bool
    rho: Mapping[str, float]


def study_orders(protocol: Protocol, junction: Junction, records: Path, worlds: Path) -> list[StudyOrder]:
    """Compute the score of the candidates of a junction again, and compare it with the recorded AP of each detector."""
    world = make_world(protocol, junction, None, worlds)
    record = read_junction(records, junction.name)
    orders = []
    for losses in (False, True):
        with tempfile.TemporaryDirectory(prefix=".work-", dir=worlds) as temporary:
            sites = list(of_junction(read_candidates(), junction, CANDIDATES_FILE))
            overrides = [] if losses else ["effects.range_limit=false"]
            scenario = with_sites(load(world, overrides), sites, Path(temporary) / "sites.csv")
            context = open_folder(scenario, Path(temporary) / "scored", jobs=1)
            ensure_stages(context, "statics", "traffic")
            targets = TargetRecord.read(context.path("trajectories.parquet"), scenario.roi.grid)
            scores: dict[str, list[float]] = {"corrected": [], "uncorrected": []}
            for seen in visible_from_sites(context.scene, targets):
                scores["corrected"].append(expected_detections(seen, DETECTORS))
                scores["uncorrected"].append(expected_detections(seen, UNCORRECTED_DETECTORS))
        for detector, measures in record.detections.items():
            ap = measures[AP].values
            rho = {name: float(spearmanr(values, ap, nan_policy="omit").statistic) for name, values in scores.items()}
            orders.append(StudyOrder(junction.name, detector, losses, rho))
    return orders


def orders_text(orders: Sequence[StudyOrder]) -> str:
    """Return the table as CSV."""
    lines = ["junction,detector,losses,uncorrected,corrected"]
    for order in orders:
        rho = f"{order.rho['uncorrected']:.4f},{order.rho['corrected']:.4f}"
        lines.append(f"{order.junction},{order.detector},{'yes' if order.losses else 'no'},{rho}")
    return "\n".join(lines) + "\n"


# ---- tables


def table(each: Sequence[StreetRows], models: Mapping[str, Model], label: str) -> list[tuple[str, LevelError]]:
    """Return the level errors at some junctions: of each detector with a model, and of all three with their mean.

    A detector without a model is compared with the mean of the models, which is what a run prints.
    """
    rows = []
    for at in each:
        by_model = {name: chances(model, at) for name, model in models.items()}
        mean: FloatArray = np.mean(list(by_model.values()), axis=0)
        for detector in at.hits:
            expected: FloatArray = by_model.get(detector, mean)
            rows += [(label, level) for level in level_errors(at, detector, expected)]
    return rows


def table_text(rows: Sequence[tuple[str, LevelError]]) -> str:
    """Return the table as CSV."""
    names = ("model", "junction", "detector", "road_users", "expected", "found", "error", "se", "upper_rms", "rho")
    lines = [",".join(names)]
    for label, level in rows:
        numbers = (level.expected, level.found, level.error, level.se, level.upper_rms)
        rho = "" if math.isnan(level.rho) else f"{level.rho:.2f}"
        cells = [label, level.junction, level.detector, level.road_users, *(f"{value:.1f}" for value in numbers), rho]
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def summary_text(rows: Sequence[tuple[str, LevelError]]) -> str:
    """Return root mean squares over junctions as Markdown, by model, detector and group of road users."""
    lines = [
        "| models | detector | road users | error | root mean square | candidates | lowest rho |",
        "|---|---|---|---:|---:|---:|---:|",
    ]
    for key in dict.fromkeys((label, level.detector, level.road_users) for label, level in rows):
        members = [level for label, level in rows if (label, level.detector, level.road_users) == key]
        errors, upper = (np.array([getattr(level, name) for level in members]) for name in ("error", "upper_rms"))
        numbers = f"{errors.mean():+.1f} | {_rms(errors):.1f} | {_rms(upper):.1f}"
        rho = min(level.rho for level in members)
        lines.append(f"| {' | '.join(key)} | {numbers} | {'' if math.isnan(rho) else f'{rho:.2f}'} |")
    return "\n".join(lines)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def comparison_text(results: Sequence[Comparison]) -> str:
    """Return the means over junctions of each correction as Markdown: level error, its size, rho and loss."""
    lines = ["| correction | detector | error | root mean square | rho | loss |", "|---|---|---:|---:|---:|---:|"]
    for correction, detector in dict.fromkeys((each.correction, each.detector) for each in results):
        members = [each for each in results if (each.correction, each.detector) == (correction, detector)]
        errors = np.array([each.level.error for each in members])
        rho = np.mean([each.level.rho for each in members])
        loss = np.mean([each.loss for each in members])
        rms = _rms(errors)
        lines.append(f"| {correction} | {detector} | {errors.mean():+.1f} | {rms:.1f} | {rho:.3f} | {loss:.4f} |")
    return "\n".join(lines)


def corrections_text(models: Mapping[str, Model], fitting: Sequence[StreetRows]) -> str:
    """Return the program's file of corrections, ``street_corrections.json``: a line for each tree."""
    junctions = {rows.junction: rows.features.shape[0] * rows.features.shape[1] for rows in fitting}
    about = {"made_by": "python -m benchmarks.across_junctions levels --fit", "vehicle_frames_of_candidates": junctions}
    each = []
    for name, model in models.items():
        correction = model["correction"]
        trees = ",\n    ".join(json.dumps(tree, separators=(",", ":")) for tree in correction["trees"])
        numbers = f'"scale": {correction["scale"]},\n   "base": {correction["base"]}'
        each.append(f'  "{name}": {{\n   {numbers},\n   "trees": [\n    {trees}\n   ]\n  }}')
    body = ",\n".join(each)
    head = json.dumps(about, indent=1).replace("\n", "\n ")
    return f'{{\n "about": {head},\n "detectors": {{\n{body}\n }}\n}}\n'
