r"""Fit elevations, azimuths and offsets of a sensor's channels, and sort returns into a grid of pulses.

The model of a return of channel c in column k, at the measured range r:

.. math:: \rho = \rho_0 + r \cos e_c, \qquad z = z_c + \rho \tan e_c, \qquad \alpha = \alpha_c + s\, k\, \Delta

with the elevation e, the vertical offset :math:`z_c` of the channel's cone on the axis (fitted together:
:func:`egvs.extensions.hardware.fit.sweep_layout.fit_cone`), the azimuth offset :math:`\alpha_c`, the step
:math:`\Delta` and the direction of rotation s (1 is counter-clockwise seen from above). Optics at a distance
:math:`\rho_0` from the axis appear as vertical offsets :math:`z_c = -\rho_0 \tan e_c`, from which this distance is
fitted.

A list of returns does not say which columns its points belong to. Its azimuth offsets are therefore known only modulo
one step, and the direction of rotation only if the list is in order of time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.core.wording import format_percent
from egvs.extensions.hardware.fit.sweep_layout import Layout, axis_distances_m, find_layout, fit_cone, nearest_ring
from egvs.formats.sweep_files import Sweep
from egvs.sensors.ground_plane import find_ground_planes

_OFFSET_ROUNDING_M = 1e-5
"""Offsets are not more exact than this."""
_FULL_CIRCLE_GAP_DEG = 60.0
"""A wider gap without any return is taken for the end of the field of view, in a list of returns."""
_MAX_AZIMUTHS = 20_000
_MIN_COHERENCE = 0.5
_LEVEL_DEG = 0.3
"""No crew mounts a sensor so exactly upright over a road; programs level sweeps."""
_RANGE_STEPS_M = (0.001, 0.05)
_MIN_STEP_COHERENCE = 0.5
_MIN_HARMONIC = 0.5
"""Least coherence at twice the frequency of a step, relative to that at the frequency."""
_WINDOW_M, _TENTH_M, _FINE_M = 4.0, 0.1, 0.0001
_MAX_MISS_DEG = 0.1


@dataclass(frozen=True)
class BeamAngles:
    """Directions of a sensor's pulses; standard errors have the suffix ``_se``.

    Attributes
    ----------
    elevation_deg, elevation_se_deg
        Of each channel, (channels,), in the order of the layout.
    offset_m, offset_se_m
        Vertical offset z0 of each channel's cone, (channels,).
    axis_distance_m, axis_distance_se_m
        Distance of the optics from the axis of rotation that explains these offsets.
    azimuth_offset_deg, azimuth_offset_se_deg
        Azimuth of each channel in column 0, counter-clockwise from x, (channels,).
    azimuth_step_deg, azimuth_step_se_deg
        Positive.
    azimuths
        Number of columns of a turn, or of the field of view.
    first_azimuth_deg
        Azimuth of column 0 without a channel's offset; 0 for the full circle.
    is_full_circle
        Whether columns cover the full circle.
    direction
        1: counter-clockwise seen from above; -1: clockwise; 0: unknown.
    """

    elevation_deg: FloatArray
    elevation_se_deg: FloatArray
    offset_m: FloatArray
    offset_se_m: FloatArray
    axis_distance_m: float
    axis_distance_se_m: float
    azimuth_offset_deg: FloatArray
    azimuth_offset_se_deg: FloatArray
    azimuth_step_deg: float
    azimuth_step_se_deg: float
    azimuths: int
    first_azimuth_deg: float
    is_full_circle: bool
    direction: int

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.elevation_deg)

    @property
    def ascending(self) -> IntArray:
        """Channels in order of ascending elevation."""
        return np.argsort(self.elevation_deg, kind="stable")

    @property
    def grid_step_deg(self) -> float:
        """Step of the grid of pulses: the fitted step, or the nearest one that divides the full circle."""
        return 360.0 / self.azimuths if self.is_full_circle else self.azimuth_step_deg

    def azimuth_deg(self) -> FloatArray:
        """Azimuth of each pulse, (channels, azimuths)."""
        columns = self.first_azimuth_deg + self.grid_step_deg * np.arange(self.azimuths)
        return self.azimuth_offset_deg[:, None] + columns

    def directions(self) -> FloatArray:
        """Unit vectors of all pulses, (channels, azimuths, 3)."""
        azimuth = np.radians(self.azimuth_deg())
        elevation = np.radians(self.elevation_deg)[:, None]
        flat = np.cos(elevation)
        rays = [flat * np.cos(azimuth), flat * np.sin(azimuth), np.broadcast_to(np.sin(elevation), azimuth.shape)]
        return np.stack(rays, axis=-1)

    def origins_m(self) -> FloatArray:
        """Where the rays start, (channels, azimuths, 3): at the distance from the axis, and the rest of the offset."""
        azimuth = np.radians(self.azimuth_deg())
        distance = self.axis_distance_m
        height = self.offset_m + distance * np.tan(np.radians(self.elevation_deg))
        rows = [distance * np.cos(azimuth), distance * np.sin(azimuth), np.broadcast_to(height[:, None], azimuth.shape)]
        return np.stack(rows, axis=-1)


@dataclass(frozen=True)
class PulseGrid:
    """The returns of a sweep by pulse.

    Attributes
    ----------
    range_m
        Range of each pulse's return, (channels, azimuths) float64; NaN without a return.
    off_grid
        Number of returns that are on no ring.
    repeated
        Number of further returns of a pulse that has one (second returns, or an overlap of the turn's ends); the
        first in the file is used.
    """

    range_m: FloatArray
    off_grid: int
    repeated: int


def fit_beam_angles(sweeps: Sequence[Sweep]) -> tuple[BeamAngles, Layout]:
    """Fit the directions of a sensor's pulses to sweeps that are not coarse; the layout is that of the first.

    Raises
    ------
    InputError
        If no sweep is finer than float16, the points lie on no rings, sweeps have other rings than the first, or the
        azimuths have no common step.
    """
    fine = [sweep for sweep in sweeps if not sweep.is_coarse]
    if not fine:
        hint = "Give a sweep with float32 coordinates, or text."
        raise InputError(sweeps[0].name, "expected a sweep that is finer than float16, got none", hint)
    layout = find_layout(fine[0].points_m, fine[0].name, fine[0].ring)
    radius_m, height_m, channel = _pool(fine, layout)

    fits = [fit_cone(radius_m[channel == c], height_m[channel == c]) for c in range(layout.channels)]
    cones = share_offsets(
        np.array([fit[0] for fit in fits]), np.array([fit[1] for fit in fits]), np.array([fit[2] for fit in fits])
    )
    azimuth = _fit_azimuths(fine[0], layout)
    return BeamAngles(
        elevation_deg=np.degrees(np.arctan(cones.tangent)),
        elevation_se_deg=np.degrees(cones.tangent_se / (1.0 + cones.tangent**2)),
        offset_m=cones.offset_m,
        offset_se_m=cones.offset_se_m,
        axis_distance_m=cones.axis_distance_m,
        axis_distance_se_m=cones.axis_distance_se_m,
        azimuth_offset_deg=azimuth.offset_deg,
        azimuth_offset_se_deg=azimuth.offset_se_deg,
        azimuth_step_deg=azimuth.step_deg,
        azimuth_step_se_deg=azimuth.step_se_deg,
        azimuths=azimuth.azimuths,
        first_azimuth_deg=azimuth.first_deg,
        is_full_circle=azimuth.is_full_circle,
        direction=azimuth.direction,
    ), layout


def _pool(sweeps: Sequence[Sweep], layout: Layout) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return radius, height and channel of all returns; further sweeps use the rings of the first."""
    radii, heights, channels = [], [], []
    for number, sweep in enumerate(sweeps):
        finite = np.isfinite(sweep.points_m[:, 0])
        points = sweep.points_m[finite]
        radius_m = axis_distances_m(points)
        if number == 0:
            channel = layout.channel[finite]
            rings = [fit_cone(radius_m[channel == c], points[channel == c, 2]) for c in range(layout.channels)]
            order = np.argsort([ring[0] for ring in rings])
        else:
            tangent = np.array([rings[c][0] for c in order])
            offset_m = np.array([rings[c][1] for c in order])
            nearest, miss_deg = nearest_ring(radius_m, points[:, 2], tangent, offset_m)
            channel = np.where(miss_deg <= _MAX_MISS_DEG, order[nearest], -1)
            _check_same_rings(sweep, channel)
        radii.append(radius_m[channel >= 0])
        heights.append(points[channel >= 0, 2])
        channels.append(channel[channel >= 0])
    return np.concatenate(radii), np.concatenate(heights), np.concatenate(channels)


def _check_same_rings(sweep: Sweep, channel: IntArray) -> None:
    share = float(np.mean(channel < 0))
    if share > 0.2:
        problem = f"{format_percent(share, 0)} of its returns lie on none of the rings of the first sweep"
        raise InputError(sweep.name, problem, "Give sweeps of one sensor, all in its frame.")


@dataclass(frozen=True)
class Cones:
    """Cones of all channels, (channels,) each, and the distance of the optics from the axis."""

    tangent: FloatArray
    tangent_se: FloatArray
    offset_m: FloatArray
    offset_se_m: FloatArray
    axis_distance_m: float
    axis_distance_se_m: float


def share_offsets(tangent: FloatArray, offset_m: FloatArray, covariance: FloatArray) -> Cones:
    r"""Let the channels tell each other their offsets, which one channel alone determines badly.

    Elevation and offset of a channel are strongly correlated (Glennie and Lichti 2011, Remote Sens. 3, 539-553).
    Offsets of all channels follow :math:`z_c = z_0 - \rho_0 \tan e_c` up to deviations with the variance
    :math:`\tau^2`. This line is fitted; :math:`\tau^2` is what channels scatter more than their standard errors say
    (Paule and Mandel 1982, J. Res. Natl. Bur. Stand. 87, 377-385). Each offset becomes the weighted mean of its own
    value and the line, and each tangent changes by as much as its covariance with the offset says. Where deviations are
    large, nothing changes.

    Parameters
    ----------
    tangent, offset_m
        Of each channel, (n,).
    covariance
        Of the two, (n, 2, 2).
    """
    variance = covariance[:, 1, 1] + _OFFSET_ROUNDING_M**2
    design = np.column_stack([np.ones(len(tangent)), -tangent])
    tau2 = 0.0
    for _ in range(20):
        weight = 1.0 / (variance + tau2)
        inverse = np.linalg.pinv((design * weight[:, None]).T @ design)
        line = inverse @ (design.T @ (weight * offset_m))
        excess = float((weight * (offset_m - design @ line) ** 2).sum()) - (len(tangent) - 2)
        tau2 = max(0.0, tau2 + excess / float(weight.sum()))
    common_m = design @ line
    own = tau2 / (tau2 + variance)  # weight of a channel's own offset
    shared_m = own * offset_m + (1.0 - own) * common_m
    gain = covariance[:, 0, 1] / variance
    line_variance = np.einsum("ij,jk,ik->i", design, inverse, design)
    shared_variance = own * variance + (1.0 - own) ** 2 * line_variance
    tangent_variance = covariance[:, 0, 0] - gain**2 * (variance - shared_variance)
    return Cones(
        tangent=tangent + gain * (shared_m - offset_m),
        tangent_se=np.sqrt(np.maximum(tangent_variance, 0.0)),
        offset_m=shared_m,
        offset_se_m=np.sqrt(shared_variance),
        axis_distance_m=float(line[1]),
        axis_distance_se_m=float(np.sqrt(inverse[1, 1])),
    )


# ---- azimuths


@dataclass(frozen=True)
class _Azimuths:
    """Result of a fit of azimuths; columns ascend counter-clockwise."""

    offset_deg: FloatArray
    offset_se_deg: FloatArray
    step_deg: float
    step_se_deg: float
    azimuths: int
    first_deg: float
    is_full_circle: bool
    direction: int


def _fit_azimuths(sweep: Sweep, layout: Layout) -> _Azimuths:
    used = layout.channel >= 0
    used &= np.isfinite(sweep.points_m[:, 0])
    points = sweep.points_m[used]
    azimuth_deg = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    channel = layout.channel[used]
    if layout.column is None:
        return _azimuths_of_list(sweep, layout.channels, channel, azimuth_deg)
    columns = int(layout.column.max()) + 1
    return _azimuths_of_columns(sweep, layout.channels, channel, layout.column[used], columns, azimuth_deg)


def _azimuths_of_columns(
    sweep: Sweep, channels: int, channel: IntArray, column: IntArray, columns: int, azimuth_deg: FloatArray
) -> _Azimuths:
    """Fit a common step and the offset of each channel to azimuths of known columns."""
    steps_deg = []
    for c in range(channels):
        members = np.flatnonzero(channel == c)
        members = members[np.argsort(column[members], kind="stable")]
        is_next = np.diff(column[members]) == 1
        steps_deg.append(_wrap(np.diff(azimuth_deg[members]))[is_next])
    step_deg = float(np.median(np.concatenate(steps_deg)))
    if not abs(step_deg) * columns < 400.0 or step_deg == 0.0:
        raise InputError(sweep.name, "azimuths do not advance from column to column", "Give sweeps of complete turns.")
    for _ in range(3):  # each round refines the step, so that residuals do not wrap
        phase = _wrap(azimuth_deg - step_deg * column)
        offset_deg = np.array([_circular_median(phase[channel == c]) for c in range(channels)])
        residual_deg = _wrap(phase - offset_deg[channel])
        scale = 1.4826 * float(np.median(np.abs(residual_deg))) + 1e-9
        inside = np.abs(residual_deg) <= 3.5 * scale
        # The slope within channels.
        centred = column - _channel_means(column.astype(np.float64), channel, inside, channels)[channel]
        change = float((centred * residual_deg)[inside].sum() / (centred[inside] ** 2).sum())
        step_deg += change
    step_se_deg = _slope_error(centred[inside], residual_deg[inside], column[inside])

    azimuths = round(360.0 / abs(step_deg))
    is_full_circle = abs(step_deg) * (columns + 0.5) >= 360.0 - 0.5 * _FULL_CIRCLE_GAP_DEG
    grid_step_deg = math.copysign(360.0 / azimuths, step_deg) if is_full_circle else step_deg
    phase = _wrap(azimuth_deg - grid_step_deg * column)
    offset_deg = np.array([_circular_median(phase[channel == c]) for c in range(channels)])
    residual_deg = _wrap(phase - offset_deg[channel])
    mean, se_deg = _robust_means(residual_deg, channel, channels)
    offset_deg = offset_deg + mean

    direction = 1 if step_deg > 0 else -1
    if not is_full_circle:
        if direction < 0:  # columns ascend counter-clockwise in the result
            offset_deg = offset_deg + step_deg * (columns - 1)
        first_deg = float(_circular_median(offset_deg))
        return _Azimuths(
            _wrap(offset_deg - first_deg), se_deg, abs(step_deg), step_se_deg, columns, first_deg, False, direction
        )
    return _Azimuths(_wrap(offset_deg), se_deg, abs(step_deg), step_se_deg, azimuths, 0.0, True, direction)


def _slope_error(centred: FloatArray, residual_deg: FloatArray, column: IntArray) -> float:
    """Return the standard error of the step, from leaving out each of 20 parts of the turn: its speed may vary."""
    part = np.minimum(column * 20 // (int(column.max()) + 1), 19)
    products = np.bincount(part, weights=centred * residual_deg, minlength=20)
    squares = np.bincount(part, weights=centred**2, minlength=20)
    slopes = (products.sum() - products) / (squares.sum() - squares)
    return float(np.sqrt(19 / 20 * ((slopes - slopes.mean()) ** 2).sum()))


def _frame_hint(sweep: Sweep) -> str:
    """Return why the azimuths of a sweep may have no step: it is levelled, if its ground is so exactly level."""
    points_m = sweep.points_m[np.isfinite(sweep.points_m[:, 0])]
    try:
        plane = find_ground_planes(points_m, np.broadcast_to((0.0, 0.0, 1.0), points_m.shape), sweep.name)[0]
    except InputError:
        plane = None
    if plane is not None and math.hypot(plane.roll_deg, plane.pitch_deg) < _LEVEL_DEG:
        return "Its ground is level, so it was probably levelled: give the sweep in the sensor's own frame."
    return "Give single sweeps in the sensor's own frame, neither levelled nor several merged into one."


def _azimuths_of_list(sweep: Sweep, channels: int, channel: IntArray, azimuth_deg: FloatArray) -> _Azimuths:
    """Fit the step from the spacing of returns, and the offset of each channel modulo the step."""
    order = np.lexsort((azimuth_deg, channel))
    gaps = np.diff(azimuth_deg[order])[np.diff(channel[order]) == 0]
    gaps = gaps[gaps > 1e-4]
    if len(gaps) < 100:
        raise InputError(sweep.name, "the azimuths of its rings have no common step", "Give complete sweeps.")
    # Most neighbours are one step apart: take the median of the gaps below 1.5 times the median gap.
    guess_deg = float(np.median(gaps[gaps < 1.5 * np.median(gaps)]))
    step_deg, coherence = _refine_step(channel, channels, azimuth_deg, guess_deg)
    if coherence < _MIN_COHERENCE:
        problem = f"the azimuths of its rings have no common step (best: {step_deg:.4f} degrees)"
        raise InputError(sweep.name, problem, _frame_hint(sweep))

    occupied = np.zeros(720, dtype=bool)
    occupied[np.floor((azimuth_deg + 180.0) * 2).astype(np.int64) % 720] = True
    first_deg, width_deg = _longest_gap(occupied)
    is_full_circle = width_deg < _FULL_CIRCLE_GAP_DEG
    azimuths = round(360.0 / step_deg)
    step_se_deg = 0.0
    if is_full_circle:
        step_deg = 360.0 / azimuths
    phase = np.array([_circular_mean(azimuth_deg[channel == c], step_deg) for c in range(channels)])
    residual_deg = np.mod(azimuth_deg - phase[channel] + 0.5 * step_deg, step_deg) - 0.5 * step_deg
    mean, se_deg = _robust_means(residual_deg, channel, channels)
    offset_deg = np.mod(phase + mean, step_deg)
    start_deg = 0.0
    if not is_full_circle:
        start_deg = float(np.min(np.mod(azimuth_deg - first_deg, 360.0))) + first_deg
        start_deg = float(np.floor(start_deg / step_deg)) * step_deg
        last_deg = float(np.max(np.mod(azimuth_deg - start_deg, 360.0)))
        azimuths = int(np.floor(last_deg / step_deg)) + 1
    steps = np.round((azimuth_deg - offset_deg[channel]) / step_deg)
    step_se_deg = float(np.std(residual_deg) / (np.std(steps) * np.sqrt(len(steps))))
    direction = _list_direction(channel, azimuth_deg, step_deg)
    return _Azimuths(offset_deg, se_deg, step_deg, step_se_deg, azimuths, start_deg, is_full_circle, direction)


def _refine_step(channel: IntArray, channels: int, azimuth_deg: FloatArray, guess_deg: float) -> tuple[float, float]:
    """Return the step near a guess at which azimuths of each channel have the same phase, and this coherence."""
    widest = np.argsort(np.bincount(channel, minlength=channels))[-8:]
    samples = [azimuth_deg[channel == c] for c in widest]

    def coherence(step_deg: float) -> float:
        return float(np.mean([np.abs(np.mean(np.exp(2j * np.pi * sample / step_deg))) for sample in samples]))

    counts = np.arange(max(10, int(0.9 * 360.0 / guess_deg)), min(_MAX_AZIMUTHS, int(1.1 * 360.0 / guess_deg) + 2))
    trials = [coherence(360.0 / count) for count in counts]
    best = int(np.argmax(trials))
    step_deg = 360.0 / counts[best]
    return step_deg, trials[best]


def _longest_gap(occupied: np.ndarray) -> tuple[float, float]:
    """Return where the longest run of empty bins of the circle ends, and its width, degrees from -180."""
    bins = len(occupied)
    if occupied.all():
        return -180.0, 0.0
    doubled = np.concatenate([occupied, occupied])
    best_width = 0
    best_end = 0
    width = 0
    for index, full in enumerate(doubled):
        width = 0 if full else width + 1
        if width > best_width and width <= bins:
            best_width = width
            best_end = index + 1
    return -180.0 + 360.0 * (best_end % bins) / bins, 360.0 * best_width / bins


def _list_direction(channel: IntArray, azimuth_deg: FloatArray, step_deg: float) -> int:
    """Return the direction of rotation if returns of a ring come in the order of time: -1 or 1, else 0."""
    order = np.argsort(channel, kind="stable")
    change = _wrap(np.diff(azimuth_deg[order]))[np.diff(channel[order]) == 0]
    change = change[np.abs(change) < 3 * step_deg]
    if len(change) < 100:
        return 0
    share = float(np.mean(change > 0))
    if share > 0.95:
        return 1
    return -1 if share < 0.05 else 0


def _wrap(angle_deg: FloatArray) -> FloatArray:
    """Return angles in [-180, 180)."""
    return np.mod(np.asarray(angle_deg) + 180.0, 360.0) - 180.0


def _circular_mean(angle_deg: FloatArray, period_deg: float) -> float:
    turns = np.angle(np.mean(np.exp(2j * np.pi * angle_deg / period_deg))) / (2 * np.pi)
    return float(turns * period_deg)


def _circular_median(angle_deg: FloatArray) -> float:
    centre = _circular_mean(angle_deg, 360.0)
    return float(_wrap(np.array([centre + np.median(_wrap(angle_deg - centre))]))[0])


def _channel_means(values: FloatArray, channel: IntArray, used: np.ndarray, channels: int) -> FloatArray:
    counts = np.bincount(channel[used], minlength=channels)
    return np.bincount(channel[used], weights=values[used], minlength=channels) / np.maximum(counts, 1)


def _robust_means(residual: FloatArray, channel: IntArray, channels: int) -> tuple[FloatArray, FloatArray]:
    """Return the mean of each channel without values beyond 3.5 robust deviations, and its standard error."""
    means, errors = np.zeros(channels), np.zeros(channels)
    for c in range(channels):
        values = residual[channel == c]
        centre = np.median(values)
        scale = 1.4826 * np.median(np.abs(values - centre)) + 1e-12
        values = values[np.abs(values - centre) <= 3.5 * scale]
        means[c] = values.mean()
        errors[c] = values.std() / np.sqrt(len(values))
    return means, errors


# ---- the grid of pulses


def pulse_grid(sweep: Sweep, angles: BeamAngles) -> PulseGrid:
    """Sort the returns of a sweep into the grid of pulses, by their direction."""
    points = sweep.points_m[np.isfinite(sweep.points_m[:, 0])]
    radius_m = axis_distances_m(points)
    channel, miss_deg = _match_channels(points, angles)
    azimuth_deg = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    turned = azimuth_deg - angles.azimuth_offset_deg[channel] - angles.first_azimuth_deg
    column = np.round(_wrap(turned) / angles.grid_step_deg).astype(np.int64)
    if angles.is_full_circle:
        column %= angles.azimuths
    else:  # the field of view may reach beyond 180 degrees from its first column
        column += np.where(column < 0, round(360.0 / angles.grid_step_deg), 0)
    on_grid = (miss_deg <= _MAX_MISS_DEG) & (column < angles.azimuths)

    pulse = channel * angles.azimuths + column
    pulse, first = np.unique(pulse[on_grid], return_index=True)
    cosine = np.cos(np.radians(angles.elevation_deg))[channel]
    ranges_m = ((radius_m - angles.axis_distance_m) / cosine)[on_grid]
    grid = np.full(angles.channels * angles.azimuths, np.nan)
    grid[pulse] = ranges_m[first]
    off_grid = int(np.count_nonzero(~on_grid))
    repeated = int(np.count_nonzero(on_grid)) - len(pulse)
    return PulseGrid(grid.reshape(angles.channels, angles.azimuths), off_grid, repeated)


def nearest_channels(points_m: FloatArray, angles: BeamAngles) -> IntArray:
    """Return the channel whose cone each point (n, 3) lies on, (n,); -1 on none."""
    channel, miss_deg = _match_channels(points_m, angles)
    return np.where(miss_deg <= _MAX_MISS_DEG, channel, -1)


def _match_channels(points_m: FloatArray, angles: BeamAngles) -> tuple[IntArray, FloatArray]:
    """Return the channel whose cone is nearest to each point, and the angle between the two, degrees."""
    order = angles.ascending
    tangent = np.tan(np.radians(angles.elevation_deg))[order]
    ring, miss_deg = nearest_ring(axis_distances_m(points_m), points_m[:, 2], tangent, angles.offset_m[order])
    return order[ring], miss_deg


def range_step(range_m: FloatArray) -> float | None:
    """Return the step of measured ranges, metres, between 1 mm and 5 cm; None if they have no such step.

    Ranges that are multiples of a step q have the same phase at the frequency 1 / q and its multiples: the mean of
    exp(2 pi i r / q) is near 1 in size. The lowest such frequency counts. To keep phases exact, only ranges within the
    4 m are used that contain most distinct ranges; to keep surfaces from imitating a step, each 10 cm of range has the
    same weight.
    """
    window = _varied_ranges(range_m[np.isfinite(range_m)])
    if window is None:
        return None
    tenth = np.floor(window / _TENTH_M).astype(np.int64)
    weight = 1.0 / np.bincount(tenth)[tenth]
    bins = round(_WINDOW_M / _FINE_M)
    density = np.bincount(np.minimum((window / _FINE_M).astype(np.int64), bins - 1), weights=weight, minlength=bins)
    padded = 8 * bins
    coherence = np.abs(np.fft.rfft(density, padded)) / weight.sum()
    per_metre = 1.0 / (padded * _FINE_M)  # frequency of the first element
    shortest_m, longest_m = _RANGE_STEPS_M
    lowest = math.ceil(1.0 / (longest_m * per_metre))
    for k in range(lowest, math.floor(1.0 / (shortest_m * per_metre))):
        is_peak = coherence[k] >= max(coherence[k - 1], coherence[k + 1], _MIN_STEP_COHERENCE)
        if is_peak and coherence[2 * k - 1 : 2 * k + 2].max() >= _MIN_HARMONIC * coherence[k]:
            # The top of a parabola through the peak and its neighbours.
            before, top, after = coherence[k - 1 : k + 2]
            bend = before - 2.0 * top + after
            return float(1.0 / ((k + (0.5 * (before - after) / bend if bend < 0 else 0.0)) * per_metre))
    return None


def _varied_ranges(ranges_m: FloatArray) -> FloatArray | None:
    """Return the ranges in the 4 m with most occupied tenths of a metre, from its start; None if few are occupied."""
    if not len(ranges_m):
        return None
    counts = np.bincount(np.floor(ranges_m / _TENTH_M).astype(np.int64))
    width = round(_WINDOW_M / _TENTH_M)
    occupied = np.convolve(counts >= 5, np.ones(width), mode="full")[width - 1 :]
    start = int(np.argmax(occupied))
    if occupied[start] < 0.5 * width:
        return None
    inside = (ranges_m >= start * _TENTH_M) & (ranges_m < start * _TENTH_M + _WINDOW_M)
    return ranges_m[inside] - start * _TENTH_M
