r"""Noise of measured ranges, by range and by channel.

Along a channel, a plane surface satisfies :math:`1 / r = a + b \cos\alpha + c \sin\alpha`, which is straight over two
azimuth steps of 0.2 degrees to :math:`6 \cdot 10^{-6} r`. So each return is compared with the harmonic mean of its two
neighbours in azimuth,

.. math:: e_k = r_k - \frac{2}{1 / r_{k-1} + 1 / r_{k+1}},

whose variance is 3/2 of that of a range. For nearly constant ranges, e is half the usual second difference, whose
variance is 6 times that of a range. Surfaces that are rough at the scale of a step, such as asphalt at a grazing angle,
add to it: the result is then an upper bound.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.statistics.intervals import MIN_VALUES, Estimate, estimate_scale

VARIANCE_FACTOR = 1.5
RANGE_EDGES_M = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 40.0, 70.0, 120.0, 200.0, 400.0)
MAX_SLOPE = 0.05
"""Neighbours whose ranges differ by a larger share, over two steps, are not on one surface."""


@dataclass(frozen=True)
class NoiseBin:
    """Noise of the returns between two ranges.

    Attributes
    ----------
    from_m, to_m
        The ranges.
    sigma_m
        Standard deviation of a range.
    incidence_deg
        Median angle of incidence, where the surface is known; else NaN.
    """

    from_m: float
    to_m: float
    sigma_m: Estimate
    incidence_deg: float


@dataclass(frozen=True)
class RangeResiduals:
    """Ranges compared with their neighbours, in the order of sweeps, channels and columns, (n,) each.

    Attributes
    ----------
    residual_m, range_m
        The residual e, and the range.
    channel
        Channel of the return.
    pulse
        Index of the pulse in its sweep's grid.
    incidence_deg
        Angle of incidence, NaN where unknown.
    """

    residual_m: FloatArray
    range_m: FloatArray
    channel: IntArray
    pulse: IntArray
    incidence_deg: FloatArray


def range_residuals(
    grids: list[FloatArray],
    is_full_circle: bool,
    used: list[BoolArray] | None = None,
    incidence_deg: FloatArray | None = None,
) -> RangeResiduals:
    """Return the residuals of all returns with two neighbours on the same surface.

    Parameters
    ----------
    grids
        Ranges of each sweep's pulses, (channels, azimuths), NaN without a return.
    is_full_circle
        Whether the last column is next to the first.
    used
        Which returns of each sweep count, with both neighbours; by default all.
    incidence_deg
        Angle of incidence of each pulse, (channels, azimuths).
    """
    parts = []
    for number, range_m in enumerate(grids):
        r = range_m if used is None else np.where(used[number], range_m, np.nan)
        before, after = np.roll(r, 1, axis=1), np.roll(r, -1, axis=1)
        if not is_full_circle:
            before[:, 0] = np.nan
            after[:, -1] = np.nan
        with np.errstate(invalid="ignore"):
            residual = r - 2.0 / (1.0 / before + 1.0 / after)
            smooth = np.abs(after - before) <= MAX_SLOPE * r
        channel, column = np.nonzero(smooth & np.isfinite(residual))
        angle = np.full(len(channel), np.nan)
        if incidence_deg is not None:
            angle = incidence_deg[channel, column]
        pulse = channel * r.shape[1] + column
        parts.append((residual[channel, column], r[channel, column], channel, pulse, angle))
    return RangeResiduals(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def noise_by_range(residuals: RangeResiduals, step_m: float) -> list[NoiseBin]:
    """Return the noise in each interval of :data:`RANGE_EDGES_M` with at least 100 residuals."""
    bins = []
    for start_m, end_m in pairwise(RANGE_EDGES_M):
        members = (residuals.range_m >= start_m) & (residuals.range_m < end_m)
        sigma_m = estimate_scale(residuals.residual_m[members], VARIANCE_FACTOR, step_m)
        if sigma_m is not None:
            angles = residuals.incidence_deg[members]
            angle = float(np.median(angles[np.isfinite(angles)])) if np.isfinite(angles).any() else float("nan")
            bins.append(NoiseBin(start_m, end_m, sigma_m, angle))
    return bins


def noise_by_channel(residuals: RangeResiduals, channels: int, step_m: float) -> list[Estimate | None]:
    """Return the noise of each channel; None with fewer than 100 residuals."""
    order = np.argsort(residuals.channel, kind="stable")
    ends = np.cumsum(np.bincount(residuals.channel, minlength=channels))[:-1]
    results: list[Estimate | None] = []
    for members in np.split(order, ends):
        enough = len(members) >= MIN_VALUES
        results.append(estimate_scale(residuals.residual_m[members], VARIANCE_FACTOR, step_m) if enough else None)
    return results
