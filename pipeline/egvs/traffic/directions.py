"""Compass directions of lanes, and turns of connections, in words.

World frame, in plan: x east, y north, metres.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from egvs.traffic.network import Lane

Floats = NDArray[np.float64]

U_TURN = "U-turn"

TURNS = {"s": "straight", "l": "left", "L": "left", "r": "right", "R": "right", "t": U_TURN, "T": U_TURN}
"""SUMO's directions of connections in words, as they are printed; a partial turn counts as a turn."""

COMPASS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")
"""Names of the compass points, counter-clockwise from east."""

SIDES = ("E", "NE", "N", "NW", "W", "SW", "S", "SE")
"""Letters of the compass points, in the order of :data:`COMPASS`."""

CLOCKWISE = tuple((2 - index) % 8 for index in range(8))
"""Index of the compass points in :data:`COMPASS`, clockwise from north."""

_HEADING_OVER_M = 10.0
"""The direction of a road is that of its last metres, or of its first ones where it leaves the region."""


def compass_index(along_m: Floats) -> int:
    """Return the index in :data:`COMPASS` of the nearest compass point to a direction (2,), x east and y north."""
    return round(float(np.arctan2(along_m[1], along_m[0])) / (np.pi / 4)) % 8


def compass(along_m: Floats) -> str:
    """Return the nearest of eight compass points to a direction (2,), x east and y north."""
    return COMPASS[compass_index(along_m)]


def arrival_side(heading: Floats) -> str:
    """Return the side of a junction on which vehicles with a heading (2,) arrive, the nearest of :data:`SIDES`.

    >>> arrival_side(np.array([0.0, 1.0]))  # northbound vehicles arrive from the south
    'S'
    """
    return SIDES[compass_index(-heading)]


def lane_heading(lane: Lane, *, at_end: bool) -> Floats:
    """Return the direction of the last metres of a lane, or of its first ones, (2,)."""
    points = lane.shape_m[::-1, :2] if at_end else lane.shape_m[:, :2]
    distance_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    there = [float(np.interp(_HEADING_OVER_M, distance_m, points[:, axis])) for axis in (0, 1)]
    along = points[0] - there if at_end else there - points[0]
    return np.asarray(along, dtype=np.float64)
