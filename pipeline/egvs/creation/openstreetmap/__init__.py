"""Extracts of OpenStreetMap: streets, and what stands beside them."""

import math

ATTRIBUTION = "(c) OpenStreetMap contributors, ODbL"

EARTH_M = 6371008.8
"""Mean radius of the Earth."""


def distance_m(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Return the distance of two positions (latitude, longitude in degrees), as on a small part of a sphere."""
    north = math.radians(other[0] - one[0])
    east = math.radians(other[1] - one[1]) * math.cos(math.radians(one[0]))
    return EARTH_M * math.hypot(north, east)
