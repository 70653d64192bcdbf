"""Special functions: sine and cosine of degrees, and functions of scipy, which is imported when one is first called.

Importing ``scipy.special`` takes longer than a whole run in which nothing has changed. Angles are in degrees, and
``cosdg`` and ``sindg`` are exact at multiples of 90 degrees.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

_RADIANS_PER_DEGREE = 1.74532925199432957692e-2
_LARGEST_DEG = 1e14
"""The sine and cosine of larger angles are 0."""

_Number = TypeVar("_Number", float, NDArray[np.float64])

_CHUNK = 4096
"""Angles that fit into the cache of a processor with all that is computed of them."""

_SINE = (
    1.58962301572218447952e-10,
    -2.50507477628503540135e-8,
    2.75573136213856773549e-6,
    -1.98412698295895384658e-4,
    8.33333333332211858862e-3,
    -1.66666666666666307295e-1,
)
_COSINE = (
    1.13678171382044553091e-11,
    -2.08758833757683644217e-9,
    2.75573155429816611547e-7,
    -2.48015872936186303776e-5,
    1.38888888888806666760e-3,
    -4.16666666666666348141e-2,
    4.99999999999999999798e-1,
)
"""Coefficients of the polynomials within an eighth of a turn, the highest power first (S. L. Moshier, Cephes, 1989)."""


def cosdg(angle_deg: Any) -> Any:
    """Return the cosine of an angle, or of each angle in an array: that of ``scipy.special.cosdg``, bit for bit."""
    return _trigonometric(angle_deg, is_cosine=True)


def sindg(angle_deg: Any) -> Any:
    """Return the sine of an angle, or of each angle in an array: that of ``scipy.special.sindg``, bit for bit."""
    return _trigonometric(angle_deg, is_cosine=False)


def _trigonometric(angle_deg: Any, *, is_cosine: bool) -> Any:
    if isinstance(angle_deg, float | int):
        return np.float64(_of_angle(float(angle_deg), is_cosine=is_cosine))
    angles = np.asarray(angle_deg, dtype=np.float64)
    values = np.empty(angles.size)
    flat = angles.reshape(-1)
    for start in range(0, angles.size, _CHUNK):
        part = slice(start, start + _CHUNK)
        values[part] = _of_angles(flat[part], is_cosine=is_cosine)
    return values.reshape(angles.shape)[()]


def _of_angles(angle_deg: NDArray[np.float64], *, is_cosine: bool) -> NDArray[np.float64]:
    """Return sines or cosines, each by the polynomial around the nearest multiple of 90 degrees."""
    size = np.abs(angle_deg)
    eighths = np.floor(size / 45.0)
    with np.errstate(invalid="ignore"):  # of infinite angles
        eighths += eighths % 2.0
        eighth = eighths % 8.0
    rest = (size - eighths * 45.0) * _RADIANS_PER_DEGREE
    square = rest * rest
    sine = rest + rest * (square * _polynomial(_SINE, square))
    cosine = 1.0 - square * _polynomial(_COSINE, square)

    is_odd_quarter = (eighth == 2.0) | (eighth == 6.0)
    if is_cosine:
        value = np.where(is_odd_quarter, sine, cosine)
        is_negative = (eighth == 2.0) | (eighth == 4.0)
    else:
        value = np.where(is_odd_quarter, cosine, sine)
        is_negative = (eighth >= 4.0) != (angle_deg < 0.0)
    return np.where(size > _LARGEST_DEG, 0.0, np.where(is_negative, -value, value))


def _of_angle(angle_deg: float, *, is_cosine: bool) -> float:
    """Return the sine or cosine of one angle; arrays of one element take ten times as long."""
    size = abs(angle_deg)
    if size > _LARGEST_DEG:
        return 0.0
    if math.isnan(size):
        return size
    eighths = float(math.floor(size / 45.0))
    eighths += eighths % 2.0
    eighth = eighths % 8.0
    rest = (size - eighths * 45.0) * _RADIANS_PER_DEGREE
    square = rest * rest
    is_odd_quarter = eighth in (2.0, 6.0)
    if is_odd_quarter == is_cosine:
        value = rest + rest * (square * _polynomial(_SINE, square))
    else:
        value = 1.0 - square * _polynomial(_COSINE, square)
    is_negative = eighth in (2.0, 4.0) if is_cosine else (eighth >= 4.0) != (angle_deg < 0.0)
    return -value if is_negative else value


def _polynomial(coefficients: tuple[float, ...], x: _Number) -> _Number:
    value = x * coefficients[0] + coefficients[1]
    for coefficient in coefficients[2:]:
        value = value * x + coefficient
    return value


def expit(logit: Any) -> Any:
    """Return the logistic function of each number in an array."""
    from scipy import special

    return special.expit(logit)


def stdtr(freedom: Any, t: Any) -> Any:
    """Return the cumulative distribution function of Student's t."""
    from scipy import special

    return special.stdtr(freedom, t)


def stdtrit(freedom: Any, probability: Any) -> Any:
    """Return the inverse of the cumulative distribution function of Student's t."""
    from scipy import special

    return special.stdtrit(freedom, probability)
