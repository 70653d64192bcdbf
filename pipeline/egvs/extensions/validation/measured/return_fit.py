r"""Fit the return model of a sensor to the points on labelled vehicles.

The simulation says at which ranges :math:`r_b` the beams of the sensor meet a vehicle, without losses. With the model
of :mod:`egvs.sensors.return_model`, it has

.. math:: \mu_i = (1 - d) \sum_b \Phi\!\left( \frac{2 \ln(r_{max} / r_b)}{s} \right)

points. :math:`r_{max}` and the softness s minimise the deviance of the measured points :math:`m_i` from Poisson's
distribution, :math:`2 \sum_i m_i \ln(m_i / \mu_i) - (m_i - \mu_i)`: the best of a grid, then Newton's step. Only its
minimum is taken from Poisson: paint and the fit of boxes scatter more, so standard errors come from leaving out one
object at a time, in all sweeps (of many objects, one of :data:`MOST_GROUPS` groups).
The dropout d cannot be told from a shorter range, and stays that of the sensor. Where the vehicles do not show the
softness (too few objects, or one range), it stays that of the sensor, too.

The rated range follows from :math:`r_{max}` with the reflectivity of cars: range and reflectivity cannot be told apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from egvs.core.grid import FloatArray, IntArray
from egvs.core.special import ndtr
from egvs.sensors.return_model import ReturnModel
from egvs.statistics.blocks import jackknife_variance

LIMIT_STEP, SOFTNESS_STEP = 0.01, 0.1
"""Steps of the logarithm of r_max, and of the softness, between tried values."""

LIMITS_M: FloatArray = 4.0 * np.exp(LIMIT_STEP * np.arange(502))
SOFTNESSES: FloatArray = np.round(np.arange(0.2, 4.01, SOFTNESS_STEP), 2)

MIN_OBJECTS = 5
"""Fewest objects with a fit."""

MOST_GROUPS = 100

MIN_OBJECTS_SOFTNESS = 8
MAX_SOFTNESS_ERROR = 0.25
"""The softness is fitted if its relative standard error is at most this."""

_BIN_M = 0.5
_FEW = 1e-6
_MOST_STEPS = 50.0


@dataclass(frozen=True)
class ReturnFit:
    """A fitted return model.

    Attributes
    ----------
    limit_m, limit_se
        Range at which half of the returns from cars are lost, and the standard error of its logarithm.
    softness, softness_se
        The softness and its standard error; 0 where it is that of the sensor.
    dropout
        That of the sensor.
    rated_range_m
        Rated range for the sensor's rated reflectivity, by the reflectivity of cars.
    vehicles, objects
        Number of boxes, and of objects that they are of.
    """

    limit_m: float
    limit_se: float
    softness: float
    softness_se: float
    dropout: float
    rated_range_m: float
    vehicles: int
    objects: int

    @property
    def limit_interval_m(self) -> tuple[float, float]:
        """Interval of two standard errors."""
        return self.limit_m * math.exp(-2 * self.limit_se), self.limit_m * math.exp(2 * self.limit_se)

    @property
    def softness_interval(self) -> tuple[float, float]:
        """Interval of two standard errors."""
        return max(self.softness - 2 * self.softness_se, 0.0), self.softness + 2 * self.softness_se


def fit_returns(
    measured: IntArray, owner: IntArray, range_m: FloatArray, weight: FloatArray, objects: IntArray, model: ReturnModel
) -> ReturnFit | None:
    """Return the fit; None with fewer than :data:`MIN_OBJECTS` objects, or with a limit beyond :data:`LIMITS_M`.

    Parameters
    ----------
    measured
        Points on each vehicle, (n,) int64.
    owner, range_m, weight
        Vehicle that each beam meets, its range without losses, and its share, (beams,).
    objects
        Object that each vehicle is of, (n,) int64.
    model
        The losses of the sensor as it is.
    """
    numbers, of_object = np.unique(objects, return_inverse=True)
    if len(numbers) < MIN_OBJECTS or not measured.sum():
        return None

    group = of_object % MOST_GROUPS
    deviance = np.zeros((min(len(numbers), MOST_GROUPS), len(SOFTNESSES), len(LIMITS_M)))
    for vehicle, count in enumerate(measured.tolist()):
        beams = owner == vehicle
        expected = (1.0 - model.dropout) * _expected_points(range_m[beams], weight[beams])
        deviance[group[vehicle]] += _deviance(count, expected)

    total = deviance.sum(axis=0)
    row, column = map(int, np.unravel_index(int(np.argmin(total)), total.shape))
    is_inside = 0 < row < len(SOFTNESSES) - 1
    estimates = _minima(total, deviance, row, column) if is_inside and len(numbers) >= MIN_OBJECTS_SOFTNESS else None
    if estimates is not None:
        (log_limit, softness), left_out = estimates
        limit_se, softness_se = np.sqrt(jackknife_variance(left_out)).tolist()
    if estimates is None or softness_se > MAX_SOFTNESS_ERROR * softness:
        row = int(np.argmin(np.abs(SOFTNESSES - model.softness)))
        log_limit, without = minima_of_limit(total[row], deviance[:, row])
        limit_se = math.sqrt(float(jackknife_variance(without)))
        softness, softness_se = float(SOFTNESSES[row]), 0.0
    limit = math.exp(log_limit)
    if not is_tried(limit):
        return None
    rated_m = limit / model.limit_m(model.target_reflectivity()) * model.rated_range_m
    return ReturnFit(limit, limit_se, softness, softness_se, model.dropout, rated_m, len(measured), len(numbers))


def is_tried(limit_m: float) -> bool:
    """Return whether a limit is among :data:`LIMITS_M`; beyond, Newton's step is no estimate."""
    return bool(LIMITS_M[0] < limit_m < LIMITS_M[-1])


def _expected_points(range_m: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the points on a vehicle without dropout, whose beams have these ranges, (softnesses, limits) float64."""
    bins, of_bin = np.unique(np.floor(range_m / _BIN_M), return_inverse=True)
    beams = np.bincount(of_bin, weights=weight, minlength=len(bins))
    expected = np.zeros((len(SOFTNESSES), len(LIMITS_M)))
    for at_m, count in zip(((bins + 0.5) * _BIN_M).tolist(), beams.tolist(), strict=True):
        expected += count * ndtr(2.0 * np.log(LIMITS_M / at_m)[None, :] / SOFTNESSES[:, None])
    return expected


def _deviance(count: int, expected: FloatArray) -> FloatArray:
    """Return Poisson's deviance of a count from each expected value, of the shape of ``expected``."""
    mean = np.maximum(expected, _FEW)
    logarithm = count * np.log(count / mean) if count else 0.0
    return 2.0 * (logarithm - (count - mean))


def _minima(
    total: FloatArray, parts: FloatArray, row: int, column: int
) -> tuple[tuple[float, float], FloatArray] | None:
    """Return where the deviance is smallest, and where it is without each part, by Newton's step from a grid point.

    Each is the logarithm of the limit, and the softness; of the parts (k, 2). None where the deviance has no minimum.
    """
    column = min(max(column, 1), len(LIMITS_M) - 2)
    start = np.array([math.log(LIMITS_M[column]), SOFTNESSES[row]])
    found = []
    for surface in (total, *(total - part for part in parts)):
        near = surface[row - 1 : row + 2, column - 1 : column + 2]
        gradient = np.array([near[1, 2] - near[1, 0], near[2, 1] - near[0, 1]]) / 2.0
        mixed = (near[2, 2] - near[2, 0] - near[0, 2] + near[0, 0]) / 4.0
        curvature = np.array(
            [
                [near[1, 2] - 2.0 * near[1, 1] + near[1, 0], mixed],
                [mixed, near[2, 1] - 2.0 * near[1, 1] + near[0, 1]],
            ]
        )
        if np.linalg.eigvalsh(curvature)[0] <= 0.0:
            return None
        found.append(start - np.linalg.solve(curvature, gradient) * (LIMIT_STEP, SOFTNESS_STEP))
    (log_limit, softness), *left_out = found
    return (float(log_limit), float(softness)), np.array(left_out)


def minima_of_limit(total: FloatArray, parts: FloatArray) -> tuple[float, FloatArray]:
    """Return the logarithm of the limit with the smallest deviance, and those without each part, (k,) float64.

    By Newton's step from the best of :data:`LIMITS_M`.

    Parameters
    ----------
    total
        Deviance for each limit, (limits,).
    parts
        Deviance of each part, (k, limits).
    """
    column = min(max(int(np.argmin(total)), 1), len(LIMITS_M) - 2)
    surfaces = np.vstack([total, total - parts])
    below, at, above = surfaces[:, column - 1], surfaces[:, column], surfaces[:, column + 1]
    curvature = np.maximum(above - 2.0 * at + below, _FEW)
    steps = np.clip(-(above - below) / (2.0 * curvature), -_MOST_STEPS, _MOST_STEPS)
    logarithms = math.log(LIMITS_M[column]) + steps * LIMIT_STEP
    return float(logarithms[0]), logarithms[1:]
