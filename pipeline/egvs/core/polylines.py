"""Lengths along a line of points, seen from above: heights do not count.

A *station* is the distance of a point of a line from its start, measured along the line.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from egvs.core.grid import FloatArray


def stations_m(line_m: FloatArray) -> FloatArray:
    """Return the station of each point of a line (n, 2 or more), (n,)."""
    return np.append(0.0, np.cumsum(_steps_m(line_m)))


def length_m(line_m: FloatArray) -> float:
    """Return the length of a line (n, 2 or more)."""
    return float(_steps_m(line_m).sum())


def points_at(line_m: FloatArray, at_m: ArrayLike) -> FloatArray:
    """Return the points of a line (n, c) at stations (k,), (k, c); its first or last point for those beyond."""
    known_m, wanted_m = stations_m(line_m), np.asarray(at_m, dtype=np.float64)
    return np.column_stack([np.interp(wanted_m, known_m, column) for column in line_m.T])


def _steps_m(line_m: FloatArray) -> FloatArray:
    steps_m: FloatArray = np.hypot(*np.diff(line_m[:, :2], axis=0).T)
    return steps_m
