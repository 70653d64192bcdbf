r"""What unlabelled sweeps of one place tell about a sensor: which returns of the static world come again.

A return of one sweep repeats if the next one has a return in the same direction (within half the azimuth step of the
sensor) at the same range (within 0.3 m and 2 %). Where the next one has a return at another range instead, something
moved, and the return does not count. The share that repeats is the probability of a return, given that there was one.

On the ground plane below the sensor, where the angle of incidence is known, the model of
:mod:`egvs.sensors.return_model` is fitted to it,

.. math:: P(r) = \Phi\!\left( \frac{2 \ln(r_{max} / r)}{s} \right), \qquad
          r_{max} = r_0 \sqrt{\frac{\rho \cos\theta}{\rho_0}}

with the reflectivity of asphalt, :data:`egvs.clouds.simulation.REFLECTIVITY`, and the softness of a flat target,
:data:`FLAT_SOFTNESS`, which are assumed. So the rated range is known only as well as these. It is fitted to all returns
from the ground together, and to those at some ranges: asphalt is rough, and loses less of the light at grazing
incidence than the model says, which shows in a rated range that rises with the range. Surfaces that return at all are
brighter than those that do not, which makes the rated range an upper estimate. It is the sensor's part of the losses:
what vehicles reflect does not follow from it.

Standard errors come from leaving out sectors of 10 degrees of azimuth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations

import numpy as np
from scipy.spatial import cKDTree

from egvs.clouds.simulation import REFLECTIVITY
from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.core.special import ndtr
from egvs.core.wording import format_percent
from egvs.extensions.validation.measured.return_fit import LIMITS_M, is_tried, minima_of_limit
from egvs.extensions.validation.measured.sensor_site import SensorSite
from egvs.formats.sweep_files import Sweep
from egvs.sensors.sensor import rotation_world_sensor
from egvs.statistics.blocks import jackknife_variance

RANGES_M = ((0, 10), (10, 20), (20, 30), (30, 40), (40, 50), (50, 60), (60, 80), (80, 120), (120, 200))

SAME_RANGE_M, SAME_RANGE_SHARE = 0.3, 0.02
ON_GROUND_M = 0.2
MIN_REPEATED = 0.3
"""Sweeps of one place repeat more of their returns."""

FLAT_SOFTNESS = 0.31
"""Of a flat target of one reflectivity, by the data sheet of an Ouster OS1 (:mod:`egvs.effects.range_limit`)."""

MIN_GROUND_RETURNS = 500
"""Fewest returns from the ground with a fit."""

_NEIGHBOURS = 3
_STEP_DEG = 0.2
_SECTOR_DEG = 10.0
_BINS = 60
_FEW = 1e-9
_LEAST_SHARE = 0.01
"""Returns are lost or found at any distance for other reasons, in this share."""


@dataclass(frozen=True)
class RepetitionRow:
    """Static returns at some ranges: their number, the share that repeats, and the rated range by the ground there."""

    from_m: int
    to_m: int
    returns: int
    share: float
    rated_range_m: float | None


@dataclass(frozen=True)
class GroundFit:
    """The rated range by returns from the ground.

    Attributes
    ----------
    rated_range_m, rated_range_se
        For the rated reflectivity of the sensor, and the standard error of its logarithm.
    returns
        Number of returns.
    """

    rated_range_m: float
    rated_range_se: float
    returns: int

    @property
    def interval_m(self) -> tuple[float, float]:
        """Interval of two standard errors."""
        width = math.exp(2 * self.rated_range_se)
        return self.rated_range_m / width, self.rated_range_m * width


@dataclass(frozen=True)
class Repetition:
    """Repetition of static returns by range, and the fit on the ground; None where that shows no range."""

    site: SensorSite
    sweeps: tuple[str, ...]
    rows: tuple[RepetitionRow, ...]
    fit: GroundFit | None


def measure_repetition(site: SensorSite, sweeps: Sequence[Sweep]) -> Repetition:
    """Return which returns of sweeps come again in the next.

    Parameters
    ----------
    site
        The sensor above the ground plane of the sweeps.
    sweeps
        At least two sweeps of one place, in the order of time.

    Raises
    ------
    InputError
        For a single sweep, and for sweeps of different places.
    """
    if len(sweeps) < 2:
        problem = f"expected at least 2 sweeps of one place without labels, got {len(sweeps)}"
        raise InputError("--against", problem, "Add sweeps, or labels with --labels.")
    tolerance_deg = 0.5 * (site.sensor.azimuth_step_deg or _STEP_DEG)
    points_m = [sweep.points_m[np.isfinite(sweep.points_m[:, 0])] for sweep in sweeps]
    static, repeats = [], []
    for pair in pairwise(points_m):
        for first, second in permutations(pair):
            is_static, is_repeated = repeated_returns(first, second, tolerance_deg)
            static.append(first[is_static])
            repeats.append(is_repeated[is_static])
    points, repeated = np.concatenate(static), np.concatenate(repeats)
    if repeated.mean() < MIN_REPEATED:
        share = format_percent(float(repeated.mean()), 0)
        problem = f"expected sweeps of one place, got sweeps of which {share} of the returns repeat"
        raise InputError("--against", problem, "Give sweeps of one installed sensor.")

    range_m = np.sqrt((points**2).sum(axis=1))
    rows = []
    for from_m, to_m in RANGES_M:
        within = (range_m >= from_m) & (range_m < to_m)
        if within.any():
            fit = _fit_ground(site, points[within], repeated[within])
            rated_m = None if fit is None else fit.rated_range_m
            rows.append(RepetitionRow(from_m, to_m, int(within.sum()), float(repeated[within].mean()), rated_m))
    names = tuple(sweep.name for sweep in sweeps)
    return Repetition(site, names, tuple(rows), _fit_ground(site, points, repeated))


def repeated_returns(first_m: FloatArray, second_m: FloatArray, tolerance_deg: float) -> tuple[BoolArray, BoolArray]:
    """Return which returns of a sweep (n, 3) are static as far as another sweep (m, 3) says, and which repeat, (n,)."""
    range_m, other_m = np.sqrt((first_m**2).sum(axis=1)), np.sqrt((second_m**2).sum(axis=1))
    tree = cKDTree(second_m / other_m[:, None])
    limit = math.radians(tolerance_deg)
    distance, row = tree.query(first_m / range_m[:, None], k=_NEIGHBOURS, distance_upper_bound=limit)
    found_m = np.append(other_m, np.inf)[row]
    is_there = np.isfinite(distance)
    same = is_there & (np.abs(found_m - range_m[:, None]) < SAME_RANGE_M + SAME_RANGE_SHARE * range_m[:, None])
    repeated = same.any(axis=1)
    return repeated | ~is_there.any(axis=1), repeated


def _fit_ground(site: SensorSite, points_m: FloatArray, repeated: BoolArray) -> GroundFit | None:
    """Return the rated range by the returns of some that are from the ground; None if they do not show it."""
    up = rotation_world_sensor(*site.pose.angles_deg)[2]
    ground = np.abs(points_m @ up + site.pose.z_m) < ON_GROUND_M
    if ground.sum() < MIN_GROUND_RETURNS:
        return None
    points_m, repeated = points_m[ground], repeated[ground]
    range_m = np.sqrt((points_m**2).sum(axis=1))
    distance_m = range_m * np.sqrt(range_m / site.pose.z_m)  # with the same power, at normal incidence
    azimuth_deg = np.degrees(np.arctan2(points_m[:, 1], points_m[:, 0])) + 180.0
    sector = np.unique(np.floor(azimuth_deg / _SECTOR_DEG), return_inverse=True)[1].astype(np.int64)
    deviance = _deviances(distance_m, repeated, sector)
    log_limit, left_out = minima_of_limit(deviance.sum(axis=0), deviance)
    if not is_tried(math.exp(log_limit)):
        return None
    se = math.sqrt(float(jackknife_variance(left_out)))
    scale = math.sqrt(site.sensor.rated_reflectivity / REFLECTIVITY["ground"])
    return GroundFit(math.exp(log_limit) * scale, se, len(range_m))


def _deviances(distance_m: FloatArray, repeated: BoolArray, sector: IntArray) -> FloatArray:
    """Return the binomial deviance of each sector, (sectors, limits)."""
    edges = np.quantile(distance_m, np.linspace(0.0, 1.0, _BINS + 1))
    of_bin = np.clip(np.searchsorted(edges, distance_m, side="right") - 1, 0, _BINS - 1)
    cell = sector * _BINS + of_bin
    cells = (int(sector.max()) + 1) * _BINS
    total = np.bincount(cell, minlength=cells).reshape(-1, _BINS)
    hits = np.bincount(cell, weights=repeated, minlength=cells).reshape(-1, _BINS)
    in_bin = np.maximum(np.bincount(of_bin, minlength=_BINS), 1)
    middle_m = np.bincount(of_bin, weights=distance_m, minlength=_BINS) / in_bin
    share = ndtr(2.0 * np.log(LIMITS_M[None, :] / np.maximum(middle_m, _FEW)[:, None]) / FLAT_SOFTNESS)
    share = np.clip(share, _LEAST_SHARE, 1.0 - _LEAST_SHARE)
    deviance: FloatArray = -2.0 * (hits @ np.log(share) + (total - hits) @ np.log1p(-share))
    return deviance
