"""Fit the probability that a detector finds a vehicle, and test it on a junction that was not used for fitting.

The model is a boosted ensemble of few small trees (scikit-learn's histogram boosting), with monotonicity as in
:data:`egvs.scoring.target_scores.MONOTONICITY`. Its size was chosen by cross-validation over the training junctions;
docs/validation.md shows the effect of more trees and of dropping monotonicity.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import ROUND_CEILING, Context
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr
from sklearn.ensemble import HistGradientBoostingClassifier

from egvs.scoring.target_scores import FEATURES, MONOTONICITY, DetectabilityModel

TREES, LEAVES, RATE, MIN_SAMPLES = 60, 12, 0.15, 600
"""Trees, leaves per tree, learning rate, and vehicle-frames per leaf (a hit and a miss count as two)."""

BINS = 10
"""Bins of the calibration curve."""

DIGITS = 6
"""Significant digits of thresholds and leaves."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Examples:
    """Results of one detector at one junction.

    Attributes
    ----------
    features
        Of the vehicle-frames seen from each site, (n, f) float64 each.
    hits
        Share of the two views in which each was found, (n,) float64 each: 0, 0.5 or 1.
    ap
        Combined AP R40 at IoU 0.7 of each site.
    """

    features: Sequence[Floats]
    hits: Sequence[Floats]
    ap: Sequence[float]


def fit_model(examples: Sequence[Examples]) -> dict[str, Any]:
    """Return the model of these junctions, in the format of the program's file.

    Only vehicle-frames with points take part, since the program gives the others probability 0. All junctions have
    equal weight, whatever their traffic.
    """
    each_x = [np.concatenate([x[has_points(x)] for x in e.features]) for e in examples]
    each_y = [np.concatenate([y[has_points(x)] for x, y in zip(e.features, e.hits, strict=True)]) for e in examples]
    weight = equal_weights([len(y) for y in each_y])
    return fit_trees(np.concatenate(each_x), np.concatenate(each_y), weight, list(MONOTONICITY.values()))


def has_points(features: Floats) -> NDArray[np.bool_]:
    """Return which vehicle-frames have points, (n,), from their features (n, f)."""
    is_seen: NDArray[np.bool_] = features[:, FEATURES.index("log_points")] > 0.0
    return is_seen


def equal_weights(counts: Sequence[int]) -> Floats:
    """Return a weight for each row of some junctions, (sum of counts,), with mean 1 and an equal sum for each junction.

    Examples
    --------
    >>> equal_weights([1, 3]).tolist()
    [2.0, 0.6666666666666666, 0.6666666666666666, 0.6666666666666666]
    """
    return np.concatenate([np.full(count, sum(counts) / (len(counts) * count)) for count in counts])


def fit_trees(
    x: Floats,
    hits: Floats,
    row_weight: Floats,
    directions: Sequence[int],
    *,
    trees: int | None = None,
    leaves: int | None = None,
) -> dict[str, Any]:
    """Return boosted trees in the format of the program's file.

    Parameters
    ----------
    x, hits, row_weight
        Features (n, f), share of the two views in which each vehicle was found, and weight of each row, (n,) float64.
    directions
        1, -1 or 0 for each feature, as in :data:`egvs.scoring.target_scores.MONOTONICITY`.
    trees, leaves
        Size of the model; :data:`TREES` and :data:`LEAVES` by default.
    """
    weight = np.append(hits, 1.0 - hits) * np.append(row_weight, row_weight)
    label = np.append(np.ones(len(hits)), np.zeros(len(hits)))
    is_used = weight > 0.0
    classifier = HistGradientBoostingClassifier(
        max_iter=trees or TREES, learning_rate=RATE, max_leaf_nodes=leaves or LEAVES, min_samples_leaf=MIN_SAMPLES,
        monotonic_cst=list(directions), early_stopping=False, random_state=0,
    ).fit(np.concatenate([x, x])[is_used], label[is_used], sample_weight=weight[is_used])  # fmt: skip
    fitted = [[_node(node) for node in predictor[0].nodes] for predictor in classifier._predictors]
    return {"base": _short(classifier._baseline_prediction.item()), "trees": fitted}


def _node(node: Any) -> list[float | int]:
    if node["is_leaf"]:
        return [_short(node["value"])]
    return [int(node["feature_idx"]), _short_above(node["num_threshold"]), int(node["left"]), int(node["right"])]


def _short(value: float) -> float:
    return float(f"{float(value):.{DIGITS}g}")


def _short_above(value: float) -> float:
    """Return a short number that is not below a threshold.

    Thresholds lie on values of the data, such as ln 2 of a vehicle with one point. Rounded down, they would send those
    values the other way.
    """
    context = Context(prec=DIGITS, rounding=ROUND_CEILING)
    return float(context.create_decimal_from_float(float(value)))


def cross_validate(examples: Mapping[str, Examples]) -> dict[str, Any]:
    """Predict each junction with the model of the others: Spearman's rho with AP, and the calibration of all.

    The calibration is that of the vehicle-frames with points; each counts once, so busy junctions count more.
    """
    rho = dict[str, float]()
    chances, hits = list[Floats](), list[Floats]()
    for name, of_junction in examples.items():
        model = DetectabilityModel.of(fit_model([e for other, e in examples.items() if other != name]))
        means = list[float]()
        for x, found in zip(of_junction.features, of_junction.hits, strict=True):
            seen = has_points(x)
            chance = np.where(seen, model.chances(x), 0.0)
            means.append(float(chance.mean()))
            chances.append(chance[seen])
            hits.append(found[seen])
        rho[name] = round(float(spearmanr(means, of_junction.ap).statistic), 3)
    return {"rho_with_ap": rho, "calibration": curve(np.concatenate(chances), np.concatenate(hits))}


def curve(chances: Floats, hits: Floats) -> list[dict[str, float]]:
    """Return probability, share that was found, and number of vehicles, by bins of probability."""
    bin_of = np.minimum((chances * BINS).astype(np.int64), BINS - 1)
    return [
        {
            "chance": round(float(chances[bin_of == b].mean()), 4),
            "found": round(float(hits[bin_of == b].mean()), 4),
            "vehicle_frames": int((bin_of == b).sum()),
        }
        for b in range(BINS)
        if (bin_of == b).any()
    ]
