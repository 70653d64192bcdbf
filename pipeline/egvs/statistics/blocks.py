r"""Standard errors of means over time: the autocorrelation time, groups of blocks, and the jackknife.

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

TARGET_GROUPS = 10
"""Number of groups that blocks are joined to when there are at least twice as many."""

MIN_GROUPS = 4
"""Groups are not joined to fewer than this."""

GROUP_LENGTH_TIMES = 20.0
"""Desired length of a group, in autocorrelation times of the traffic."""

_CORRELATION_QUANTILE = 1.645
"""One-sided 5 % point of the normal distribution, for the test of neighbouring groups."""

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


def group_sizes(blocks: int, block_frames: int = 1, autocorrelation_frames: float = 0.0) -> list[int]:
    """Return the number of consecutive blocks of each group."""
    groups = blocks
    if blocks >= 2 * TARGET_GROUPS:
        groups = TARGET_GROUPS
    needed_blocks = math.ceil(GROUP_LENGTH_TIMES * autocorrelation_frames / block_frames)
    if needed_blocks > blocks // groups:
        groups = min(groups, max(MIN_GROUPS, blocks // needed_blocks))
    return [len(part) for part in np.array_split(np.arange(blocks), groups)]


def means_without_each(values: FloatArray) -> FloatArray:
    """Return the mean of all values but each, (d,) float64: the replicates of a mean over d detectors, 2 or more.

    Examples
    --------
    >>> means_without_each(np.array([0.5, 0.7, 0.9])).round(3).tolist()
    [0.8, 0.7, 0.6]
    """
    return np.array([np.delete(values, number).mean() for number in range(len(values))])


def jackknife_variance(left_out: FloatArray) -> FloatArray:
    """Return the variance of estimates, (...), from their values without each of k blocks in turn, (k, ...)."""
    k = len(left_out)
    variance: FloatArray = (k - 1) / k * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0)
    return variance


def one_step_jackknife(normals: FloatArray, sums: FloatArray) -> FloatArray:
    """Return the covariance of fitted parameters, (p, p), from one Newton step without each of k blocks in turn.

    Parameters
    ----------
    normals
        Normal matrix of each block, (k, p, p).
    sums
        Gradient of each block at the fit, (k, p).
    """
    without = np.linalg.pinv(normals.sum(axis=0) - normals, rcond=1e-9, hermitian=True)
    shifts = np.einsum("gij,gj->gi", without, sums)
    covariance: FloatArray = shifts.T @ shifts * ((len(shifts) - 1) / len(shifts))
    return covariance


def clustered_mean_se(values: FloatArray, block: IntArray) -> tuple[float, float]:
    """Return the mean of values and its standard error, which takes values of a block as dependent.

    Parameters
    ----------
    values
        The values, (n,).
    block
        Number of the block of each value, from 0, (n,).
    """
    mean = float(values.mean())
    sums = np.bincount(block, weights=values - mean)
    return mean, float(np.sqrt((sums**2).sum())) / len(values)


def _time_upper_bound(time_frames: float, frames: int) -> float:
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
        (:func:`_time_upper_bound`).
    """
    longest = _time_upper_bound(time_frames, frames)
    ratio = groups * _variance_share(2.0 * frames / groups / longest) / _variance_share(2.0 * frames / longest)
    return max(1.0, math.sqrt((groups - 1.0) / (ratio - 1.0)))


def _variance_share(x: float) -> float:
    return 1.0 + math.expm1(-x) / x


def lag_one_autocorrelation(series: FloatArray) -> float:
    """Return the lag-one autocorrelation of groups, (k, n), pooled over all sites; 0 where nothing varies."""
    centred = series - series.mean(axis=0)
    scale = np.sqrt((centred**2).sum(axis=0))
    centred = centred[:, scale > 0] / scale[scale > 0]
    if not centred.size:
        return 0.0
    return float((centred[1:] * centred[:-1]).sum(axis=0).mean())


def critical_autocorrelation(groups: int) -> float:
    """Return the autocorrelation that independent groups exceed once in 20 (Kendall and Ord, Time Series, 1990)."""
    if groups <= 2:
        return 1.0
    return -1.0 / groups + _CORRELATION_QUANTILE * math.sqrt((groups - 2) / (groups**2 - 1.0))
