r"""Level errors of models on simulated streets (:mod:`benchmarks.across_junctions.streets`), and corrections of them.

*Level error*: expected minus found, in points of 100, of all vehicle-frames from all candidates of a junction. Its
standard error comes from leaving out one block of frames at a time.

*Corrections* keep the form of a model, boosted trees of the same features:

``scaled``
    The logit of the model becomes :math:`a + b\,l`, fitted by logistic loss. The order of vehicle-frames stays.
``continued``
    Further trees are boosted on what the scaled model leaves, with the same monotonicity: Newton steps, each a small
    regression tree (Friedman 2001, Annals of Statistics 29(5), 1189-1232).
``refitted``
    New trees from the streets alone.

Which one is used was decided on the junctions to fit at, each predicted by the corrections of the others
(:func:`compare`); the others are for quoting only.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit
from scipy.stats import spearmanr
from sklearn.tree import DecisionTreeRegressor

from benchmarks.across_junctions.models.fitting import _short, _short_above, equal_weights, fit_trees
from benchmarks.across_junctions.streets import GROUPS, StreetRows
from egvs.core.grid import FloatArray
from egvs.scoring.target_scores import FEATURES, MODEL_FILE, MONOTONICITY, DetectabilityModel

POINTS = 100.0

LOG_POINTS = FEATURES.index("log_points")

TREES, DEPTH, RATE, MIN_SAMPLES = 20, 3, 0.3, 400
"""Trees that are added, their depth, learning rate, and vehicle-frames per leaf."""

Model = Mapping[str, Any]
"""``base`` and ``trees``, as in the program's file."""


def shipped_model(detector: str) -> Model:
    """Return the entry of the program's file."""
    model: Model = json.loads(MODEL_FILE.read_text(encoding="utf-8"))["detectors"][detector]
    return model


def chances(model: Model, rows: StreetRows) -> FloatArray:
    """Return the probability of each vehicle-frame from each candidate, (m, n) float64; 0 without a point."""
    flat = rows.features.reshape(-1, len(FEATURES))
    values = DetectabilityModel.of(dict(model)).chances(flat)
    return np.where(flat[:, LOG_POINTS] > 0.0, values, 0.0).reshape(rows.features.shape[:2])


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
            flat = rows.features.reshape(-1, len(FEATURES))
            seen = flat[:, LOG_POINTS] > 0.0
            features.append(flat[seen])
            hits.append(rows.hits[detector].ravel()[seen])
        return cls(np.concatenate(features), np.concatenate(hits), equal_weights([len(h) for h in hits]))


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
    trees = [[[_short(scale * node[0])] if len(node) == 1 else node for node in tree] for tree in model["trees"]]
    return {"base": _short(shift + scale * model["base"]), "trees": trees}


def continued(model: Model, examples: Examples) -> Model:
    """Return the scaled model with further trees."""
    start = scaled(model, examples)
    logit, trees = _logit(start, examples.x), list(start["trees"])
    for _ in range(TREES):
        chance = expit(logit)
        curvature = np.maximum(chance * (1.0 - chance), 1e-3) * examples.weight
        step = DecisionTreeRegressor(
            max_depth=DEPTH, min_samples_leaf=MIN_SAMPLES, monotonic_cst=list(MONOTONICITY.values()), random_state=0
        ).fit(examples.x, examples.weight * (examples.hits - chance) / curvature, sample_weight=curvature)
        trees.append(_nodes(step))
        logit = _logit({"base": start["base"], "trees": trees}, examples.x)
    return {"base": start["base"], "trees": trees}


def refitted(_: Model, examples: Examples) -> Model:
    """Return a model that is fitted from the examples alone."""
    return fit_trees(examples.x, examples.hits, examples.weight, list(MONOTONICITY.values()))


CORRECTIONS: Mapping[str, Callable[[Model, Examples], Model]] = {
    "unchanged": unchanged,
    "scaled": scaled,
    "continued": continued,
    "refitted": refitted,
}


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
        A name of :data:`egvs GROUPS`, or ``all``.
    expected, found, error, se
        Means over candidates and vehicle-frames, their difference, and its standard error.
    candidates_rms
        Root mean square of the errors of the candidates.
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
    candidates_rms: float
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
        left_out = np.array([difference[:, block != b].mean() for b in np.unique(block)])
        count = len(left_out)
        se = float(np.sqrt((count - 1) / count * ((left_out - left_out.mean()) ** 2).sum()))
        rho = float("nan")
        if name == "all":
            rho = float(spearmanr(expected.mean(axis=1), rows.ap[detector], nan_policy="omit").statistic)
        errors.append(
            LevelError(
                rows.junction, detector, name, POINTS * float(expected[:, members].mean()),
                POINTS * float(hits[:, members].mean()), POINTS * float(difference.mean()), POINTS * se,
                POINTS * float(np.sqrt((of_candidates**2).mean())), rho,
            )
        )  # fmt: skip
    return errors
