r"""Candidates for a later version of ``expected_detections``: more features, and an additive model of them.

The features include how crowded a vehicle is as seen from the sensor
(:mod:`benchmarks.across_junctions.models.crowding`). The model of the probability that a detector finds the vehicle is

.. math:: p(x) = \frac{1}{1 + e^{-b - \sum_k f_k(x_k) - c}}

with a piecewise linear function :math:`f_k` of each feature, constant beyond its first and last knot, and an offset c
of the vehicle's class. Where physics prescribes a direction (:data:`DIRECTIONS`), no :math:`f_k` turns: more points, a
wider gap or a finer point spacing never lower the probability. A vehicle without any point is never detected.

On the training junctions measured so far it
predicts less well than trees of the same features (docs/validation.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from benchmarks.across_junctions.models.crowding import measure_crowding, vehicle_classes
from egvs.core.grid import FloatArray, IntArray
from egvs.core.special import expit
from egvs.scoring.target_scores import ISOLATED_GAP_M, MONOTONICITY, point_spacing_m
from egvs.scoring.targets import VisibleTargets

DIRECTIONS: Mapping[str, int] = {
    **MONOTONICITY,
    "log_column_spacing": 0,
    "hidden_share": -1,
    "front_gap_m": 1,
    "behind_gap_m": 1,
    "beside_gap_m": 1,
    "beside_gap_deg": 1,
    "link_gap": 1,
    "incidence_deg": 0,
}
"""For each feature that a model may have: 1 if the probability may only rise with it, -1 if it may only fall, 0 for
either. ``log_spacing`` and ``log_column_spacing`` are ln(spacing / 1 m), the other logarithms are ln(1 + points)."""


@dataclass(frozen=True, eq=False)
class TargetFeatures:
    """Features of vehicle-frames.

    Attributes
    ----------
    columns
        (n,) float64 each, by the names of :data:`DIRECTIONS`.
    vehicle_class
        Index in :data:`benchmarks.across_junctions.models.crowding.CLASSES`, -1 for people, (n,) int64.
    """

    columns: Mapping[str, FloatArray]
    vehicle_class: IntArray


def target_features(visible: VisibleTargets, column_step_deg: float | None = None) -> TargetFeatures:
    """Return all features of what a site sees.

    Parameters
    ----------
    column_step_deg
        Azimuth between neighbouring beams of a ring; None for a sensor without rings, whose columns count as far apart
        as all points.
    """
    crowding, spacing_m = measure_crowding(visible), point_spacing_m(visible)
    columns_m = spacing_m if column_step_deg is None else visible.range_m * math.radians(column_step_deg)
    columns = {
        "log_points": np.log1p(visible.points),
        "log_points_on_sides": np.log1p(visible.points_on_sides),
        "length_share": visible.length_share,
        "width_share": visible.width_share,
        "hole_m": visible.hole_m,
        "gap_m": np.minimum(visible.record.gap_m, ISOLATED_GAP_M),
        "hidden_share": crowding.hidden_share,
        "front_gap_m": crowding.front_gap_m,
        "behind_gap_m": crowding.behind_gap_m,
        "beside_gap_m": crowding.beside_gap_m,
        "beside_gap_deg": crowding.beside_gap_deg,
        "link_gap": crowding.link_gap,
        "log_spacing": np.log(spacing_m),
        "log_column_spacing": np.log(columns_m),
        "depression_deg": visible.depression_deg,
        "incidence_deg": crowding.incidence_deg,
        "length_m": visible.record.boxes[:, 3],
        "range_m": visible.range_m,
        "side": visible.side,
    }
    return TargetFeatures(columns, vehicle_classes(visible.record))


@dataclass(frozen=True, eq=False)
class AdditiveModel:
    """Parameters of one detector.

    Attributes
    ----------
    intercept
        b of the module's equation.
    curves
        Knots, ascending, and the values of :math:`f_k` there, (m,) float64 each, by feature.
    class_offsets
        c of each of :data:`benchmarks.across_junctions.models.crowding.CLASSES`, (5,) float64.
    """

    intercept: float
    curves: Mapping[str, tuple[FloatArray, FloatArray]]
    class_offsets: FloatArray

    def chances(self, features: TargetFeatures) -> FloatArray:
        """Return the probability of each vehicle-frame, (n,) float64, 0 to 1; undefined for people."""
        logit = self.intercept + self.class_offsets[features.vehicle_class]
        for name, (knots, values) in self.curves.items():
            logit += np.interp(features.columns[name], knots, values)
        chance: FloatArray = expit(logit)
        return chance
