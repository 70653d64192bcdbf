r"""Find which channel fired each pulse of a sweep, from the points alone.

Two kinds of files exist. An *organised* sweep has a slot for each pulse, with a missing return as NaN; slots run either
channel by channel within a column (a column is one azimuth step), or column by column within a channel. Headers often
claim the wrong one of the two, so both are tested for every number of channels that divides the number of slots: the
right one is the smallest number for which each channel keeps to one elevation. A *list of returns* has no slots; its
points lie on as many cones as the sensor has channels, and :func:`find_rings` separates them by elevation. Where the
file says of each point which ring it is from (field ``ring``), the rings are those, provided that the points of each
lie on one cone: many drivers fill the field with zeros, or with something else.

A return's optical path need not start at the origin of the frame. A channel at elevation e whose rays start at a height
z0 on the axis gives points on the cone

.. math:: z = \rho \tan e + z_0, \qquad \rho = \sqrt{x^2 + y^2},

so a few centimetres of offset smear the elevation of near points by more than the spacing of dense rings. Rays of an
Ouster start 12 to 28 mm beside the axis (``lidar_origin_to_beam_origin_mm``), and the frame of its driver begins 36 mm
below: a point at 1 m is 2 degrees above the elevation of its beam. Before either, one offset in radius and one in
height for all channels are therefore chosen such that the elevations cluster best, as in the Hough transform of
ALICE-LRI (Soutullo et al. 2025, arXiv 2510.20708).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.core.wording import format_percent

MIN_CHANNELS, MAX_CHANNELS = 4, 512
MIN_COLUMNS = 100

_ORGANISED_SPREAD_DEG = 0.2
"""Median spread of elevations within a channel, above which the slots are not in the tested order."""
_COLUMN_SPREAD_DEG = 1.0
"""Azimuths of neighbouring channels may differ by this much more or less in a column than on average."""
_SPREAD_RATIO = 1.5
"""A number of channels fits as well as the best one if its spread is at most this multiple of the least spread."""
_ROUNDING_DEG = 0.02
_MIN_RETURNS_PER_CHANNEL = 20

_OFFSETS_M = np.arange(-0.10, 0.1001, 0.004)
_SHARPNESS_BIN_DEG = 0.02
_SHARPNESS_SAMPLE = 10_000
_SHARPER = 1.02
"""Shifts count only if they make elevations cluster by this factor better."""
_BIN_DEG = 0.005
_MIN_SPACING_DEG = 0.04
_MIN_RING_SHARE = 0.02
"""A ring has at least this share of the returns of the median ring."""
_FINEST_M = 1e-6
"""Coordinates are not more exact than this."""
_MAX_RESIDUAL_DEG = 0.05
_MAX_STRAY_SHARE = 0.2

_HINT = (
    "Give complete sweeps of a sensor with rings, in the sensor's frame (z along the axis of rotation). Patterns that"
    " do not repeat (Livox) cannot be fitted; use pattern.file with directions and dwell times."
)


@dataclass(frozen=True)
class Layout:
    """Channel and column of each slot of a sweep.

    Attributes
    ----------
    order
        ``"channel fastest"``, ``"column fastest"``, or ``"list of returns"``.
    channels
        Number of channels.
    channel
        (n,) int64; -1 for a point on no ring.
    column
        (n,) int64; None for a list of returns.
    silent
        Number of further channels with fewer than 20 returns, which cannot be fitted.
    has_file_rings
        Whether the rings are those of the file.
    note
        Why the rings of the file are not used, as a sentence; empty if they are, or if the file has none.
    """

    order: str
    channels: int
    channel: IntArray
    column: IntArray | None
    silent: int = 0
    has_file_rings: bool = False
    note: str = ""


def find_layout(points_m: FloatArray, where: str, ring: IntArray | None = None) -> Layout:
    """Return the layout of a sweep.

    Parameters
    ----------
    points_m
        (n, 3), NaN for missing returns.
    where
        The sweep, for messages.
    ring
        The ring of each point by the file, (n,); None if it does not say.

    Raises
    ------
    InputError
        If the points do not lie on rings.
    """
    note = ""
    if ring is not None:
        layout, note = _layout_of_rings(points_m, ring)
        if layout is not None:
            return layout
    return replace(_organised_layout(points_m) or find_rings(points_m, where), note=note)


def _layout_of_rings(points_m: FloatArray, ring: IntArray) -> tuple[Layout | None, str]:
    """Return the layout by the rings of the file; or None, and a sentence that says why they cannot be used."""
    returned = np.isfinite(points_m[:, 0])
    numbers, counts = np.unique(ring[returned], return_counts=True)
    if not MIN_CHANNELS <= len(numbers) <= MAX_CHANNELS:
        return None, f"The field ring has {len(numbers)} values, so rings are found from the points."
    used = numbers[counts >= _MIN_RETURNS_PER_CHANNEL]
    channel = np.where(np.isin(ring, used), np.searchsorted(used, ring), -1)
    radius_m = axis_distances_m(points_m)
    missed, members = 0, 0
    for number in range(len(used)):
        part = returned & (channel == number)
        tangent, offset_m, _ = fit_cone(radius_m[part], points_m[part, 2])
        miss_m = np.abs(points_m[part, 2] - radius_m[part] * tangent - offset_m) / (1.0 + tangent**2)
        missed += int(np.count_nonzero(np.degrees(miss_m / radius_m[part]) > _MAX_RESIDUAL_DEG))
        members += int(np.count_nonzero(part))
    if missed > _MAX_STRAY_SHARE * max(members, 1):
        share = format_percent(missed / max(members, 1), 0)
        return None, f"By the field ring, {share} of the returns are on no ring, so rings are found from the points."
    silent = len(numbers) - len(used)
    order, column = _order_of_rings(ring)
    return Layout(order, len(used), channel, column, silent, has_file_rings=True), ""


def _order_of_rings(ring: IntArray) -> tuple[str, IntArray | None]:
    """Return the order and the column of each slot; a list of returns unless the rings repeat from slot to slot."""
    n, channels = len(ring), len(np.unique(ring))
    if n % channels == 0 and n // channels >= MIN_COLUMNS:
        slots = np.arange(n)
        if (ring.reshape(-1, channels) == ring[:channels]).all():
            return "channel fastest", slots // channels
        if (ring.reshape(channels, -1) == ring[:: n // channels, None]).all():
            return "column fastest", slots % (n // channels)
    return "list of returns", None


def _organised_layout(points_m: FloatArray) -> Layout | None:
    """Return the layout of an organised sweep; None if no number of channels fits."""
    n = len(points_m)
    returned = np.isfinite(points_m[:, 0])
    elevation_deg = np.full(n, np.nan)
    radius_m = axis_distances_m(points_m[returned])
    elevation_deg[returned] = _sharpest_elevations(radius_m, points_m[returned, 2])
    trials: list[tuple[float, int, str]] = []
    for channels in range(MIN_CHANNELS, min(MAX_CHANNELS, n // MIN_COLUMNS) + 1):
        if n % channels:
            continue
        for order in ("channel fastest", "column fastest"):
            trials.append((_elevation_spread(_by_channel(elevation_deg, channels, order)), channels, order))
    if not trials:
        return None
    least = min(spread for spread, _, _ in trials)
    if not least < _ORGANISED_SPREAD_DEG:
        return None
    # Twice the channels fit as well: each of them is then divided in two.
    _, channels, order = min(
        (trial for trial in trials if trial[0] <= _SPREAD_RATIO * least + _ROUNDING_DEG), key=lambda trial: trial[1]
    )
    slots = np.arange(n)
    if order == "channel fastest":
        column, channel = np.divmod(slots, channels)
    else:
        channel, column = np.divmod(slots, n // channels)
    azimuth_deg = np.degrees(np.arctan2(points_m[:, 1], points_m[:, 0]))
    if not _columns_agree(_by_channel(azimuth_deg, channels, order)):
        return None
    used = np.bincount(channel[returned], minlength=channels) >= _MIN_RETURNS_PER_CHANNEL
    fitted = np.where(used[channel], (np.cumsum(used) - 1)[channel], -1)
    return Layout(order, int(np.count_nonzero(used)), fitted, column, channels - int(np.count_nonzero(used)))


def _by_channel(values: FloatArray, channels: int, order: str) -> FloatArray:
    """Return the values of all slots as (channels, columns)."""
    if order == "channel fastest":
        return values.reshape(-1, channels).T
    return values.reshape(channels, -1)


def _columns_agree(azimuth_deg: FloatArray) -> bool:
    """Whether azimuths (channels, columns) of neighbouring channels differ by the same in most columns.

    In a list of returns that is sorted by ring, neighbours in a row are of one ring as well, but rows have no common
    columns.
    """
    phase = np.exp(1j * np.radians(np.diff(azimuth_deg, axis=0)))
    filled = phase[np.isfinite(phase).sum(axis=1) >= _MIN_RETURNS_PER_CHANNEL]
    if not len(filled):
        return False
    with np.errstate(invalid="ignore"):
        deviation_deg = np.abs(np.degrees(np.angle(filled / np.nanmean(filled, axis=1)[:, None])))
    return float(np.median(np.nanpercentile(deviation_deg, 80, axis=1))) < _COLUMN_SPREAD_DEG


def _elevation_spread(elevation_deg: FloatArray) -> float:
    """Median over channels of the width that holds 80 % of their elevations; infinite if channels do not differ.

    Two channels that are taken for one differ by their distance in at least 20 % of the slots.
    """
    counts = np.isfinite(elevation_deg).sum(axis=1)
    filled = elevation_deg[counts >= _MIN_RETURNS_PER_CHANNEL]
    if len(filled) < MIN_CHANNELS:
        return float("inf")
    low, middle, high = np.nanpercentile(filled, [10, 50, 90], axis=1)
    spread = float(np.median(high - low))
    total = float(np.median(np.abs(middle - np.median(middle))))
    return spread if spread < 0.1 * total else float("inf")


def find_rings(points_m: FloatArray, where: str) -> Layout:
    """Return the layout of a list of returns: the ring of each point, in order of ascending elevation.

    Parameters
    ----------
    points_m
        (n, 3); NaN belongs to no ring.
    where
        The sweep, for messages.

    Raises
    ------
    InputError
        If there are no rings, or more than a fifth of the points are on none.
    """
    finite = np.isfinite(points_m[:, 0])
    radius_m = axis_distances_m(points_m[finite])
    height_m = points_m[finite, 2]
    elevation_deg = _sharpest_elevations(radius_m, height_m)

    centres_deg = _histogram_peaks(elevation_deg)
    _check_ring_count(len(centres_deg), where)
    ring = np.searchsorted(0.5 * (centres_deg[1:] + centres_deg[:-1]), elevation_deg)
    for _ in range(3):
        tangent, offset_m = _fit_cones(radius_m, height_m, ring, len(centres_deg))
        _check_ring_count(len(tangent), where)
        ring, residual_deg = nearest_ring(radius_m, height_m, tangent, offset_m)
    is_stray = residual_deg > _MAX_RESIDUAL_DEG
    counts = np.bincount(ring[~is_stray], minlength=len(tangent))
    used = counts >= max(_MIN_RING_SHARE * np.median(counts[counts > 0]), _MIN_RETURNS_PER_CHANNEL)
    is_stray |= ~used[ring]
    if np.mean(is_stray) > _MAX_STRAY_SHARE or np.count_nonzero(used) < MIN_CHANNELS:
        problem = f"expected points on rings, but {format_percent(float(np.mean(is_stray)), 0)} of them are on none"
        raise InputError(where, problem, _HINT)
    number = np.cumsum(used) - 1
    channel = np.full(len(points_m), -1, dtype=np.int64)
    channel[finite] = np.where(is_stray, -1, number[ring])
    return Layout("list of returns", int(np.count_nonzero(used)), channel, None)


def axis_distances_m(points_m: FloatArray) -> FloatArray:
    """Return the horizontal distances of points (n, 3) from the axis of rotation, at least 1 mm."""
    return np.maximum(np.hypot(points_m[:, 0], points_m[:, 1]), 0.001)


def _check_ring_count(rings: int, where: str) -> None:
    if rings < MIN_CHANNELS:
        problem = f"expected at least {MIN_CHANNELS} rings of {_MIN_RETURNS_PER_CHANNEL} returns, got {rings}"
        raise InputError(where, problem, _HINT)


def nearest_ring(
    radius_m: FloatArray, height_m: FloatArray, tangent: FloatArray, offset_m: FloatArray
) -> tuple[IntArray, FloatArray]:
    r"""Return the ring whose cone is nearest to each point, and the angle between the two, degrees.

    ``tangent`` is ascending. The cones of neighbouring rings do not cross within the range of returns, so the ring is
    one of the two between whose heights at this radius the point lies. The search starts where it would be if all
    offsets followed :math:`z_c = z_0 - \rho_0 \tan e_c`: near an Ouster, whose rays start 36 mm above the origin of its
    frame, the elevation from the origin is five rings off.
    """
    slope_m, common_m = np.polyfit(tangent, offset_m, 1) if len(tangent) > 1 else (0.0, float(offset_m[0]))
    ring = np.searchsorted(tangent, (height_m - common_m) / np.maximum(radius_m + slope_m, 0.001))
    best = np.zeros(len(radius_m), dtype=np.int64)
    least = np.full(len(radius_m), np.inf)
    for shift in (-2, -1, 0, 1):
        candidate = np.clip(ring + shift, 0, len(tangent) - 1)
        cos2 = 1.0 / (1.0 + tangent[candidate] ** 2)
        angle = np.abs(height_m - radius_m * tangent[candidate] - offset_m[candidate]) * cos2 / radius_m
        is_nearer = angle < least
        best[is_nearer] = candidate[is_nearer]
        least[is_nearer] = angle[is_nearer]
    return best, np.degrees(least)


def _sharpest_elevations(radius_m: FloatArray, height_m: FloatArray) -> FloatArray:
    """Return elevations (degrees) from the origin, shifted in radius and height, at which they cluster best.

    All pairs of shifts are tried: radius and height alone, one after the other, end in a lesser maximum where both are
    far from 0.
    """
    sample = slice(None, None, max(1, len(radius_m) // _SHARPNESS_SAMPLE))

    def elevations(shift_m: tuple[float, float], part: slice) -> FloatArray:
        return np.degrees(np.arctan2(height_m[part] - shift_m[1], radius_m[part] - shift_m[0]))

    def sharpness(shift_m: tuple[float, float]) -> float:
        bins = np.floor((elevations(shift_m, sample) + 180) / _SHARPNESS_BIN_DEG).astype(int)
        return float((np.bincount(bins).astype(np.float64) ** 2).sum())

    shifts_m = [(float(radius), float(height)) for radius in _OFFSETS_M for height in _OFFSETS_M]
    best_m = max(shifts_m, key=sharpness)
    if sharpness(best_m) <= _SHARPER * sharpness((0.0, 0.0)):
        best_m = (0.0, 0.0)
    return elevations(best_m, slice(None))


def _histogram_peaks(elevation_deg: FloatArray) -> FloatArray:
    """Return the elevations at which points cluster, ascending."""
    low = float(elevation_deg.min()) - 1.0
    bins = np.floor((elevation_deg - low) / _BIN_DEG).astype(np.int64)
    counts = gaussian_filter1d(np.bincount(bins, minlength=int(bins.max()) + 200).astype(np.float64), 2.0)
    peaks, _ = find_peaks(counts, distance=max(1, round(_MIN_SPACING_DEG / _BIN_DEG)))
    if not len(peaks):
        return np.empty(0)
    tall = counts[peaks] > 0.05 * np.median(np.sort(counts[peaks])[-max(4, len(peaks) // 2) :])
    centres: FloatArray = low + (peaks[tall] + 0.5) * _BIN_DEG
    return centres


def _fit_cones(radius_m: FloatArray, height_m: FloatArray, ring: IntArray, rings: int) -> tuple[FloatArray, FloatArray]:
    """Fit the tangent of the elevation and the offset of each ring with at least 20 points, ascending."""
    tangents, offsets_m = [], []
    order = np.argsort(ring, kind="stable")
    for members in np.split(order, np.cumsum(np.bincount(ring, minlength=rings))[:-1]):
        if len(members) >= _MIN_RETURNS_PER_CHANNEL:
            tangent, offset_m, _ = fit_cone(radius_m[members], height_m[members])
            tangents.append(tangent)
            offsets_m.append(offset_m)
    ascending = np.argsort(tangents)
    return np.array(tangents)[ascending], np.array(offsets_m)[ascending]


PRIOR_OFFSET_M = 0.05
"""Standard deviation of a prior of the vertical offset around 0. Where all returns of a channel have the same range, it
decides between elevation and offset; otherwise it has no effect."""


def fit_cone(radius_m: FloatArray, height_m: FloatArray) -> tuple[float, float, FloatArray]:
    """Fit z = rho tan(e) + z0 to the points of a channel, robustly.

    Noise of the range moves a point along its cone. What remains is the pointing error, which grows with range, and the
    rounding of coordinates, which does not; weights 1 / (1 + (rho / median)^2) serve both. Points beyond 3.5 robust
    standard deviations get no weight (three rounds). The covariance is the heteroscedasticity-consistent "sandwich"
    (White 1980, Econometrica 48, 817-838).

    Returns
    -------
    tangent, offset_m
        tan(e) and z0.
    covariance
        Of the two, (2, 2).
    """
    design = np.column_stack([radius_m, np.ones(len(radius_m))])
    weight = 1.0 / (1.0 + (radius_m / np.median(radius_m)) ** 2)
    tangent = float(np.median(height_m / radius_m))
    parameters = np.array([tangent, 0.0])
    residual = height_m - design @ parameters
    scale = _weighted_scale(residual, weight)
    for _ in range(4):
        inside = np.abs(residual) * np.sqrt(weight) <= 3.5 * scale
        used = weight * inside
        prior = np.diag([0.0, scale**2 / PRIOR_OFFSET_M**2])
        normal = (design * used[:, None]).T @ design + prior
        parameters = np.linalg.solve(normal, design.T @ (used * height_m))
        residual = height_m - design @ parameters
        scale = _weighted_scale(residual, weight)
    inverse = np.linalg.inv(normal)
    scores = design * (used * residual)[:, None]
    n_used = int(np.count_nonzero(used))
    correction = n_used / max(1, n_used - 2)
    covariance = inverse @ (scores.T @ scores * correction + prior * scale**2) @ inverse
    return float(parameters[0]), float(parameters[1]), covariance


def _weighted_scale(residual: FloatArray, weight: FloatArray) -> float:
    return max(1.4826 * float(np.median(np.abs(residual) * np.sqrt(weight))), _FINEST_M)
