r"""How long traffic remembers: the integrated autocorrelation time of the region's occupancy.

With :math:`\rho(t)` the autocorrelation at lag t of the number of boxes near the region, frame by frame,

.. math:: \tau(M) = 1 + 2 \sum_{t=1}^{M} \rho(t)

is what a mean over T frames pays for memory: it is worth :math:`T / \tau` independent frames. The window is Sokal's,
the smallest :math:`M \ge 5 \tau(M)` (A. Sokal, Monte Carlo Methods in Statistical Mechanics, Cargese lectures, 1996,
section 3), with one departure: :math:`\tau(M)` is the largest of the sums up to M. A signal makes the autocorrelation
swing through negative values within a cycle; the plain sum then cancels, the window closes at half a cycle, and the
memory that the swing covers is missed. The estimate's own standard deviation is :math:`\tau \sqrt{2 (2 M + 1) / T}`
(there, equation 3.19).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

WINDOW = 5.0
"""Sokal's c: the window in memories."""

_DIGITS = 3
"""Decimals of a memory: an FFT's last bits are the machine's own."""


def memory_frames(series: NDArray[np.int64] | NDArray[np.float64]) -> float:
    """The integrated autocorrelation time of a series (T,), in frames, at least 1; 1 of one that does not vary.

    A memory that is longer than the series can tell is underestimated: what it says is that of its own window at most.
    """
    centred = np.asarray(series, dtype=np.float64) - np.mean(series)
    frames = len(centred)
    if frames < 2 or not centred.any():
        return 1.0
    spectrum = np.fft.rfft(centred, 2 * frames)
    covariance = np.fft.irfft(spectrum.real**2 + spectrum.imag**2)[:frames]
    sums = np.maximum.accumulate(2.0 * np.cumsum(covariance / covariance[0]) - 1.0)
    closed = np.arange(frames) >= WINDOW * sums
    return round(float(sums[int(closed.argmax()) if closed.any() else frames - 1]), _DIGITS)


def upper(memory: float, frames: int) -> float:
    """A memory that a record of so many frames does not exclude: one standard deviation above the estimate."""
    return memory * (1.0 + math.sqrt(2.0 * (2.0 * WINDOW * memory + 1.0) / frames))


def widening(memory: float, frames: int, groups: int) -> float:
    r"""How much too small a standard error is that comes from the scatter of consecutive groups of frames.

    For a memory that decays as :math:`e^{-2 t / \tau}`, a mean over n frames has the variance

    .. math:: \sigma^2 \tau f(n) / n, \qquad f(n) = 1 - (1 - e^{-x}) / x, \qquad x = 2 n / \tau

    (Priestley, Spectral Analysis and Time Series, 1981, section 5.3). Groups are then alike, and their scatter says too
    little of the whole: of k groups with variance V each and V_T of all frames, (V - V_T) / (k - 1) instead of V_T.

    Parameters
    ----------
    memory, frames, groups
        Of the traffic, in frames; of the whole record; how many groups it was cut into, at least 2.

    Returns
    -------
    float
        To multiply the standard error by, at least 1; for the memory that the record does not exclude
        (:func:`upper`).
    """
    longest = upper(memory, frames)
    ratio = groups * _share(2.0 * frames / groups / longest) / _share(2.0 * frames / longest)
    return max(1.0, math.sqrt((groups - 1.0) / (ratio - 1.0)))


def _share(x: float) -> float:
    return 1.0 + math.expm1(-x) / x
