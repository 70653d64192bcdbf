r"""Fit how fast a sensor turns, from the times of points, or from the times of whole sweeps.

**Times of points.** The azimuth of a return, less its channel's offset, grows with its time t as
:math:`\alpha = \alpha_0 + 360 f t`, with the rate f in turns per second, negative clockwise. One turn is too short for
a periodogram's peak to be the answer, but it is unique; from it the residuals do not wrap, and a regression refines f.
The rate of several sweeps is their mean; its standard error comes from their scatter, for a single sweep from leaving
out each twentieth of the turn in turn, because the speed varies within a turn.

**Times of sweeps.** Where sweeps are the turns of a sensor, one after another, the rate is the inverse of the time
between them. Gaps of several turns count as such. The standard error comes from leaving out tenths of the recording.

**Consistency.** The time between two firings of a channel, times the rate, is the azimuth step. A fitted step that
differs says that columns are missing in the file, or that times are not those of the firings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egvs.core.grid import FloatArray
from egvs.extensions.hardware.fit.beam_angles import BeamAngles, nearest_channels
from egvs.formats.sweep_files import Sweep
from egvs.statistics.blocks import jackknife_variance

MIN_RATE_HZ, MAX_RATE_HZ = 1.0, 60.0
"""Slowest and fastest rotation that is looked for."""

_TRIAL_STEP_HZ = 0.25
_SAMPLE = 20_000
_MIN_COHERENCE = 0.9
_PARTS = 20
_MIN_STAMPS = 5
_STAMP_PARTS = 10
_MAX_STAMP_SCATTER = 0.1
"""Times of sweeps that scatter by more than this share of a turn are not those of turns."""


@dataclass(frozen=True)
class Rotation:
    """How fast a sensor turns.

    Attributes
    ----------
    rate_hz, rate_se_hz
        Turns per second and standard error; positive counter-clockwise from above, negative clockwise; without sign if
        only times of sweeps are known.
    source
        ``"times of points"`` or ``"times of sweeps"``.
    sweeps
        Number of sweeps whose times were used.
    firing_interval_s
        Time between two firings of a channel; None if only times of sweeps are known.
    """

    rate_hz: float
    rate_se_hz: float
    source: str
    sweeps: int
    firing_interval_s: float | None = None

    @property
    def step_deg(self) -> float | None:
        """The azimuth step that follows from the rate and the time between firings."""
        return None if self.firing_interval_s is None else 360.0 * abs(self.rate_hz) * self.firing_interval_s


def fit_rotation(sweeps: Sequence[Sweep], angles: BeamAngles) -> Rotation | None:
    """Return the rotation of a sensor; None if the sweeps have no usable times.

    Parameters
    ----------
    sweeps
        The sweeps.
    angles
        Their fitted angles.
    """
    timed = [sweep for sweep in sweeps if sweep.time_s is not None and not sweep.is_coarse]
    fits = [fit for fit in (_fit_sweep(sweep, angles) for sweep in timed) if fit is not None]
    if fits:
        rates, errors, intervals = (np.array(values) for values in zip(*fits, strict=True))
        error = float(np.std(rates, ddof=1) / np.sqrt(len(rates))) if len(rates) > 1 else float(errors[0])
        return Rotation(float(rates.mean()), error, "times of points", len(rates), float(np.median(intervals)))
    recordings = {id(sweep.recording): sweep.recording for sweep in sweeps if sweep.recording is not None}
    for recording in recordings.values():
        rotation = rotation_of_stamps(recording.stamps_s)
        if rotation is not None:
            return rotation
    return None


def _fit_sweep(sweep: Sweep, angles: BeamAngles) -> tuple[float, float, float] | None:
    """Return rate, its standard error (turns per second), and the time between firings; None if times do not fit."""
    assert sweep.time_s is not None
    known = np.isfinite(sweep.points_m[:, 0]) & np.isfinite(sweep.time_s)
    points, time_s = sweep.points_m[known], sweep.time_s[known]
    channel = nearest_channels(points, angles)
    on_ring = channel >= 0
    points, time_s, channel = points[on_ring], time_s[on_ring], channel[on_ring]
    if len(points) < 100 or not np.ptp(time_s) > 0:
        return None
    azimuth_deg = np.degrees(np.arctan2(points[:, 1], points[:, 0])) - angles.azimuth_offset_deg[channel]
    rate_hz = _coarse_rate(azimuth_deg, time_s)
    if rate_hz is None:
        return None
    for _ in range(3):
        residual_deg = azimuth_deg - 360.0 * rate_hz * time_s
        centre = np.degrees(np.angle(np.mean(np.exp(1j * np.radians(residual_deg)))))
        residual_deg = np.mod(residual_deg - centre + 180.0, 360.0) - 180.0
        centred = time_s - time_s.mean()
        rate_hz += float((centred * residual_deg).sum() / (centred**2).sum()) / 360.0
    part = np.minimum(np.floor(_PARTS * (time_s - time_s.min()) / np.ptp(time_s)).astype(np.int64), _PARTS - 1)
    products = np.bincount(part, weights=centred * residual_deg, minlength=_PARTS)
    squares = np.bincount(part, weights=centred**2, minlength=_PARTS)
    slopes = (products.sum() - products) / (squares.sum() - squares) / 360.0
    return rate_hz, math.sqrt(jackknife_variance(slopes)), _firing_interval_s(channel, time_s)


def _coarse_rate(azimuth_deg: FloatArray, time_s: FloatArray) -> float | None:
    """Return the rate at which azimuths, turned back by it, agree best; None if they hardly do."""
    every = slice(None, None, max(1, len(time_s) // _SAMPLE))
    phase = np.exp(1j * np.radians(azimuth_deg[every]))
    trials = np.arange(MIN_RATE_HZ, MAX_RATE_HZ, _TRIAL_STEP_HZ)
    trials = np.concatenate([-trials[::-1], trials])
    turns = -2j * np.pi * time_s[every]
    coherence = np.array([np.abs(np.mean(phase * np.exp(turns * trial))) for trial in trials])
    best = int(np.argmax(coherence))
    return float(trials[best]) if coherence[best] >= _MIN_COHERENCE else None


def _firing_interval_s(channel: np.ndarray[tuple[int], np.dtype[np.int64]], time_s: FloatArray) -> float:
    """Return the time between neighbouring firings of a channel.

    It is the mean of the gaps within a quarter of the median gap, since most neighbours are one firing apart.
    """
    order = np.lexsort((time_s, channel))
    gaps = np.diff(time_s[order])[np.diff(channel[order]) == 0]
    gaps = gaps[gaps > 1e-7]
    if not len(gaps):
        return float("nan")
    middle = float(np.median(gaps))
    return float(gaps[np.abs(gaps - middle) < 0.25 * middle].mean())


def rotation_of_stamps(stamps_s: FloatArray) -> Rotation | None:
    """Return the rotation of a sensor whose turns have these times, seconds; None if they are not those of turns."""
    stamps_s = np.unique(stamps_s)
    if len(stamps_s) < _MIN_STAMPS:
        return None
    gaps = np.diff(stamps_s)
    period_s = float(np.median(gaps))
    turns = np.concatenate([[0.0], np.cumsum(np.maximum(np.round(gaps / period_s), 1.0))])
    slope, level = np.polyfit(turns, stamps_s - stamps_s[0], 1)
    scatter = float(np.std(stamps_s - stamps_s[0] - slope * turns - level)) / slope
    if not (1.0 / MAX_RATE_HZ <= slope <= 1.0 / MIN_RATE_HZ and scatter < _MAX_STAMP_SCATTER):
        return None
    part = np.arange(len(turns)) * min(_STAMP_PARTS, len(turns)) // len(turns)
    slopes = np.array(
        [np.polyfit(turns[part != number], stamps_s[part != number] - stamps_s[0], 1)[0] for number in np.unique(part)]
    )
    slope_se = math.sqrt(jackknife_variance(slopes))
    return Rotation(1.0 / float(slope), slope_se / float(slope) ** 2, "times of sweeps", len(stamps_s))
