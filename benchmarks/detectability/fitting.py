"""Fits the chance that a detector finds a vehicle, and says how well that holds on a junction it was not learnt from.

A boosted model of few small trees (scikit-learn's histogram boosting), held to rise and fall as
:data:`egvs.scoring.target_scores.MONOTONICITY` says. Its size was settled on the training junctions, each foretold
by the model of the others: docs/validation.md has what more trees, or none of these directions, would change.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import spearmanr
from sklearn.ensemble import HistGradientBoostingClassifier

from egvs.scoring.target_scores import MONOTONICITY, DetectabilityModel

TREES, LEAVES, RATE, FEWEST = 60, 12, 0.15, 600
"""Trees, leaves of each, how much of each is taken, and vehicle-frames (a hit and a miss count as two) in a leaf."""

BINS = 10
"""Of the calibration curve."""

DIGITS = 6
"""Significant digits of thresholds and leaves."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Examples:
    """What one detector did at one junction.

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


def fitted(examples: Sequence[Examples]) -> dict[str, Any]:
    """The model of these junctions, as the file of the program has it."""
    x = np.concatenate([its for e in examples for its in e.features])
    y = np.concatenate([its for e in examples for its in e.hits])
    weight, label = np.append(y, 1.0 - y), np.append(np.ones(len(y)), np.zeros(len(y)))
    kept = weight > 0.0
    found = HistGradientBoostingClassifier(
        max_iter=TREES, learning_rate=RATE, max_leaf_nodes=LEAVES, min_samples_leaf=FEWEST,
        monotonic_cst=list(MONOTONICITY.values()), early_stopping=False, random_state=0,
    ).fit(np.concatenate([x, x])[kept], label[kept], sample_weight=weight[kept])  # fmt: skip
    trees = [[_node(node) for node in predictor[0].nodes] for predictor in found._predictors]
    return {"base": _short(found._baseline_prediction.item()), "trees": trees}


def _node(node: Any) -> list[float | int]:
    if node["is_leaf"]:
        return [_short(node["value"])]
    return [int(node["feature_idx"]), _short(node["num_threshold"]), int(node["left"]), int(node["right"])]


def _short(value: float) -> float:
    return float(f"{float(value):.{DIGITS}g}")


def elsewhere(examples: Mapping[str, Examples]) -> dict[str, Any]:
    """Each junction foretold by the model of the others: Spearman's rho with AP, and the calibration curve of all."""
    rho = dict[str, float]()
    chances, hits = list[Floats](), list[Floats]()
    for name, its in examples.items():
        model = DetectabilityModel.of(fitted([e for other, e in examples.items() if other != name]))
        each = [model.chances(features) for features in its.features]
        rho[name] = round(float(spearmanr([c.mean() for c in each], its.ap).statistic), 3)
        chances += each
        hits += its.hits
    return {"rho_with_ap": rho, "calibration": curve(np.concatenate(chances), np.concatenate(hits))}


def curve(chances: Floats, hits: Floats) -> list[dict[str, float]]:
    """Of vehicle-frames with about the same chance: that chance, the share that was found, and how many they are."""
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
