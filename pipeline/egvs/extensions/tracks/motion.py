"""Directions of motion of tracks, where a format does not give headings."""

from __future__ import annotations

import math

import numpy as np

from egvs.core.grid import FloatArray, IntArray


def motion_yaw_rad(track: IntArray, time_s: FloatArray, x_m: FloatArray, y_m: FloatArray, step_m: float) -> FloatArray:
    """Return the direction in which each track moves, counter-clockwise from +x.

    Each track is reduced to positions at least ``step_m`` apart, so that noise does not turn it while it stands. The
    direction at such a position is that from the one before to the one after; in between it is interpolated by time,
    and outside it is that of the nearest.

    Parameters
    ----------
    track
        The track of each row, (n,) int64.
    time_s, x_m, y_m
        Time and position of each row, (n,).
    step_m
        Longer than the errors of positions.

    Returns
    -------
    FloatArray
        (n,) float64; NaN for tracks that never move ``step_m``.
    """
    yaw_rad = np.full(track.size, math.nan)
    order = np.lexsort((time_s, track))
    starts = np.flatnonzero(np.diff(track[order], prepend=-1))
    for rows in np.split(order, starts[1:]):
        anchors = _positions_apart(x_m[rows], y_m[rows], step_m)
        if len(anchors) < 2:
            continue
        x, y = x_m[rows][anchors], y_m[rows][anchors]
        before, after = np.maximum(np.arange(x.size) - 1, 0), np.minimum(np.arange(x.size) + 1, x.size - 1)
        directions = np.unwrap(np.arctan2(y[after] - y[before], x[after] - x[before]))
        yaw_rad[rows] = np.interp(time_s[rows], time_s[rows][anchors], directions)
    wrapped_rad: FloatArray = np.arctan2(np.sin(yaw_rad), np.cos(yaw_rad))
    return wrapped_rad


def _positions_apart(x_m: FloatArray, y_m: FloatArray, step_m: float) -> list[int]:
    """Return indices of positions at least ``step_m`` apart, beginning with the first."""
    chosen: list[int] = []
    last = (math.inf, math.inf)
    for index, position in enumerate(zip(x_m.tolist(), y_m.tolist(), strict=True)):
        if math.dist(position, last) >= step_m:
            chosen.append(index)
            last = position
    return chosen
