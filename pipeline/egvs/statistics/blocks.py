r"""The autocorrelation time of traffic.

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
