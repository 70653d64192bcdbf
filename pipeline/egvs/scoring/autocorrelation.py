r"""The autocorrelation time of traffic, and what it does to standard errors.

With :math:`\rho(t)` the autocorrelation at lag t of the number of boxes near the region, frame by frame, the integrated
autocorrelation time is

.. math:: \tau(M) = 1 + 2 \sum_{t=1}^{M} \rho(t)

A mean over T frames is as accurate as one over :math:`T / \tau` independent frames. The window is Sokal's, the smallest
:math:`M \ge 5 \tau(M)` (A. Sokal, Monte Carlo Methods in Statistical Mechanics, Cargese lectures, 1996, section 3),
with one departure: :math:`\tau(M)` is the largest of the sums up to M. A signal makes the autocorrelation swing through
negative values within a cycle; the plain sum then cancels, the window closes at half a cycle, and the correlation over
full cycles is missed. The standard deviation of the estimate is :math:`\tau \sqrt{2 (2 M + 1) / T}` (equation 3.19
there).
"""

from __future__ import annotations

import math

import numpy as np

from egvs.core.grid import FloatArray, IntArray

WINDOW_TIMES = 5.0
"""Sokal's c: the window in autocorrelation times."""

_DIGITS = 3
"""Decimals of an autocorrelation time: the last bits of an FFT depend on the machine."""


def autocorrelation_time(series: IntArray | FloatArray) -> float:
    """Return the integrated autocorrelation time of a series (T,), in frames, at least 1; 1 for a constant series.

    A time that is longer than the series can show is underestimated.
    """
    centred = np.asarray(series, dtype=np.float64) - np.mean(series)
    frames = len(centred)
    if frames < 2 or not centred.any():
        return 1.0

    spectrum = np.fft.rfft(centred, 2 * frames)
    covariance = np.fft.irfft(spectrum.real**2 + spectrum.imag**2)[:frames]
    sums = np.maximum.accumulate(2.0 * np.cumsum(covariance / covariance[0]) - 1.0)
    closed = np.arange(frames) >= WINDOW_TIMES * sums
    window = frames - 1
    if closed.any():
        window = int(closed.argmax())
    return round(float(sums[window]), _DIGITS)


def time_upper_bound(time_frames: float, frames: int) -> float:
    """Return an autocorrelation time one standard deviation above the estimate from a record of so many frames."""
    return time_frames * (1.0 + math.sqrt(2.0 * (2.0 * WINDOW_TIMES * time_frames + 1.0) / frames))


def standard_error_inflation(time_frames: float, frames: int, groups: int) -> float:
    r"""Return the factor by which the scatter of consecutive groups of frames underestimates a standard error.

    For an autocorrelation that decays as :math:`e^{-2 t / \tau}`, a mean over n frames has the variance

    .. math:: \sigma^2 \tau f(n) / n, \qquad f(n) = 1 - (1 - e^{-x}) / x, \qquad x = 2 n / \tau

    (Priestley, Spectral Analysis and Time Series, 1981, section 5.3). Groups are then correlated, and their scatter
    underestimates the variance of the mean: of k groups with variance V each and V_T of all frames, it gives
    (V - V_T) / (k - 1) instead of V_T.

    Parameters
    ----------
    time_frames
        Autocorrelation time of the traffic, in frames.
    frames
        Frames of the record.
    groups
        Number of groups that the record was cut into, at least 2.

    Returns
    -------
    float
        Factor for the standard error, at least 1; for the longest autocorrelation time that the record does not exclude
        (:func:`time_upper_bound`).
    """
    longest = time_upper_bound(time_frames, frames)
    ratio = groups * _variance_share(2.0 * frames / groups / longest) / _variance_share(2.0 * frames / longest)
    return max(1.0, math.sqrt((groups - 1.0) / (ratio - 1.0)))


def _variance_share(x: float) -> float:
    return 1.0 + math.expm1(-x) / x
