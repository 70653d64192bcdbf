"""Extracts of OpenStreetMap: streets, and what stands beside them."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import TYPE_CHECKING

from egvs.formats.osm import Bounds, OsmExtract

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

    from egvs.core.grid import XY
    from egvs.creation.junctions import Streets

ATTRIBUTION = "(c) OpenStreetMap contributors, ODbL"

EARTH_M = 6371008.8
"""Mean radius of the Earth."""

_MARGIN_M = 100.0
"""Sides that are straight in the world frame are curved in degrees, and objects are wider than their nodes."""


def distance_m(one: tuple[float, float], other: tuple[float, float]) -> float:
    """Return the distance of two positions (latitude, longitude in degrees), as on a small part of a sphere."""
    north = math.radians(other[0] - one[0])
    east = math.radians(other[1] - one[1]) * math.cos(math.radians(one[0]))
    return EARTH_M * math.hypot(north, east)


def bounds_around(streets: Streets, window: BaseGeometry) -> Bounds:
    """Return a rectangle in degrees around a window (world frame, metres), some metres larger."""
    west_m, south_m, east_m, north_m = window.buffer(_MARGIN_M).bounds
    corners = streets.to_degrees([(x, y) for x in (west_m, east_m) for y in (south_m, north_m)])
    lons_deg, lats_deg = zip(*corners, strict=True)
    return Bounds(min(lats_deg), min(lons_deg), max(lats_deg), max(lons_deg))


def node_positions(extract: OsmExtract, streets: Streets, nodes: Collection[int]) -> dict[int, XY]:
    """Return x, y in metres (world frame) of some nodes, without those that the extract lacks."""
    return streets.node_positions({node: extract.nodes[node] for node in nodes if node in extract.nodes})
