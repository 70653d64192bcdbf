"""Compass directions, and turns of connections, in words.

World frame, in plan: x east, y north, metres.
"""

from __future__ import annotations

import numpy as np

from egvs.core.grid import FloatArray

U_TURN = "U-turn"

TURNS = {"s": "straight", "l": "left", "L": "left", "r": "right", "R": "right", "t": U_TURN, "T": U_TURN}
"""SUMO's directions of connections in words, as they are printed; a partial turn counts as a turn."""

COMPASS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")
"""Names of the compass points, counter-clockwise from east."""

CLOCKWISE = tuple((2 - index) % 8 for index in range(8))
"""Index of the compass points in :data:`COMPASS`, clockwise from north."""


def compass_index(along_m: FloatArray) -> int:
    """Return the index in :data:`COMPASS` of the nearest compass point to a direction (2,), x east and y north."""
    return round(float(np.arctan2(along_m[1], along_m[0])) / (np.pi / 4)) % 8


def compass(along_m: FloatArray) -> str:
    """Return the nearest of eight compass points to a direction (2,), x east and y north."""
    return COMPASS[compass_index(along_m)]


def arrival_side(heading: FloatArray) -> str:
    """Return the side of a junction on which vehicles with a heading (2,) arrive, a value of :data:`COMPASS`.

    >>> arrival_side(np.array([0.0, 1.0]))  # northbound vehicles arrive from the south
    'south'
    """
    return compass(-heading)
