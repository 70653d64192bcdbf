r"""The chance that a detector finds a vehicle, from what a site sees of it; and the share of vehicles that it finds.

.. math:: \frac{1}{N} \sum_{i=1}^{N} p(x_i), \qquad p(x) = \frac{1}{1 + e^{-b - \sum_t f_t(x)}}

over the N vehicle-frames of a record; x are :data:`FEATURES`, f_t the trees of a boosted model. The model rises with
points, points on sides, spans and the gap to the neighbour, and falls with the hole between points and with steepness
(:data:`RISES`); it is free in range, length and the angle of view. A vehicle without any point is never found.

Its numbers are data, ``detectability.json`` beside this module. They were learnt from what each detector found, and
missed, on junctions that no result is quoted for (``benchmarks/detectability`` makes them anew; docs/validity.md shows
how well they hold elsewhere). "Finds" means a box that overlaps the vehicle by more than 0.7, in the mean of seen from
above and in space.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from pipeline.kernels.detection.trees import add_trees
from pipeline.scoring.targets.record import Floats
from pipeline.scoring.targets.scores import mean
from pipeline.scoring.targets.seen import SeenTargets

FILE = Path(__file__).with_name("detectability.json")

DETECTORS = ("cluster", "pointpillars")
"""Those that have a model."""

LONELY_M = 20.0
"""A neighbour farther away than this makes no difference."""

RISES = {
    "log_points": 1,
    "log_points_on_sides": 1,
    "length_share": 1,
    "width_share": 1,
    "hole_m": -1,
    "gap_m": 1,
    "depression_deg": -1,
    "length_m": 0,
    "range_m": 0,
    "side": 0,
}
"""Of each feature, whether the chance rises with it (1), falls (-1), or may do either (0)."""

FEATURES = tuple(RISES)
"""What the chance is made of, see :class:`pipeline.scoring.targets.seen.SeenTargets`: logarithms of 1 + points, gaps of
at most :data:`LONELY_M`."""


@dataclass(frozen=True, eq=False)
class Model:
    """Boosted trees over :data:`FEATURES`, as :func:`pipeline.kernels.detection.trees.add_trees` takes them.

    Attributes
    ----------
    base
        b, the logit before any tree.
    """

    base: float
    starts: NDArray[np.int64]
    feature: NDArray[np.int64]
    threshold: Floats
    left: NDArray[np.int64]
    right: NDArray[np.int64]
    value: Floats

    @classmethod
    def of(cls, its: dict[str, Any]) -> Model:
        """From an entry of the file: a tree is a list of nodes, a node [feature, threshold, left, right] or [value]."""
        nodes = [node for tree in its["trees"] for node in tree]
        whole = np.array([[n[0], n[2], n[3]] if len(n) == 4 else [-1, 0, 0] for n in nodes], dtype=np.int64)
        parts = np.array([[n[1], 0.0] if len(n) == 4 else [0.0, n[0]] for n in nodes])
        starts = np.append(0, np.cumsum([len(tree) for tree in its["trees"]], dtype=np.int64))
        columns = [np.ascontiguousarray(column) for column in (*whole.T, *parts.T)]
        return cls(its["base"], starts, columns[0], columns[3], columns[1], columns[2], columns[4])

    def chances(self, features: Floats) -> Floats:
        """Of rows of :data:`FEATURES` (n, f), the chance of each, (n,), 0 to 1."""
        logit, columns = np.full(len(features), self.base), np.ascontiguousarray(features.T)
        add_trees(
            columns, self.starts, self.feature, self.threshold, self.left, self.right, self.value, logit
        )  # fmt: skip
        chance: Floats = expit(logit)
        return chance


@cache
def model_of(detector: str) -> Model:
    """The model of one of :data:`DETECTORS`."""
    return Model.of(json.loads(FILE.read_text(encoding="utf-8"))["detectors"][detector])


def features_of(seen: SeenTargets) -> Floats:
    """:data:`FEATURES` of what a site sees, (n, f) float64."""
    return np.column_stack([
        np.log1p(seen.points),
        np.log1p(seen.points_on_sides),
        seen.length_share,
        seen.width_share,
        seen.hole_m,
        np.minimum(seen.record.gap_m, LONELY_M),
        seen.depression_deg,
        seen.record.boxes[:, 3],
        seen.range_m,
        seen.side,
    ])  # fmt: skip


def chances(seen: SeenTargets, detectors: Sequence[str] = DETECTORS) -> Floats:
    """The chance that each vehicle-frame is found, in the mean of some detectors, (n,) float64, 0 to 1.

    Raises
    ------
    KeyError
        For a detector that has no model.
    """
    features, found = features_of(seen), seen.points > 0.0
    each: Floats = np.mean([model_of(name).chances(features) for name in detectors], axis=0)
    return np.where(found, each, 0.0)


def expected_detections(seen: SeenTargets, detectors: Sequence[str] = DETECTORS, weight: Floats | None = None) -> float:
    """The share of vehicles that detectors are expected to find, 0 to 1; not a number without any vehicle.

    Parameters
    ----------
    seen
        What the site sees.
    detectors
        Whose chances are averaged.
    weight
        How much each vehicle-frame counts, (n,) float64, 0 or above; all alike where it is None.
    """
    return mean(chances(seen, detectors), weight) if len(seen) else math.nan
