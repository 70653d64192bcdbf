"""A map's nodes become shapes, which are repaired, cut into pieces, put in order, and freed of slivers.

Frame: the network's x, y in metres, seen from above. Coordinates are whole millimetres.
"""

from __future__ import annotations

import itertools

import shapely
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry

from pipeline.formats.osm import Way
from pipeline.importers.mapped_solids import ImportCounts

XY = tuple[float, float]

_GRID_M = 0.001
_SLIVER_M2 = 0.25
_SHORT_M = 0.1


def point_at(xy: XY) -> Point:
    """A point, to the millimetre."""
    return Point(round(xy[0], 3), round(xy[1], 3))


def pieces_of(geometry: BaseGeometry) -> list[BaseGeometry]:
    """Its polygons, else its lines, else its point; in an order that depends on their places alone."""
    parts = [q for p in shapely.get_parts(geometry) for q in shapely.get_parts(p) if not q.is_empty]
    polygons = [shapely.geometry.polygon.orient(shapely.normalize(p)) for p in parts if isinstance(p, Polygon)]
    lines = [p for p in parts if isinstance(p, LineString)]
    return sorted(polygons or lines or parts, key=lambda p: (p.bounds, p.wkb))


def large_pieces_of(geometry: BaseGeometry) -> tuple[list[BaseGeometry], int]:
    """Its polygons, else its lines, to the millimetre; and how many more are slivers."""
    pieces = pieces_of(shapely.set_precision(geometry, _GRID_M))
    large = [p for p in pieces if (p.area >= _SLIVER_M2 if isinstance(p, Polygon) else p.length >= _SHORT_M)]
    return large, len(pieces) - len(large)


def lines_of(way: Way, xy: dict[int, XY]) -> list[LineString]:
    """The way as lines, broken where its nodes lie outside the file."""
    runs = []
    for known, nodes in itertools.groupby(way.nodes, lambda n: n in xy):
        points = [xy[n] for n in nodes] if known else []
        if len(points) > 1:
            runs += large_pieces_of(LineString(points))[0]
    return runs


def area_within(way: Way, xy: dict[int, XY], counts: ImportCounts) -> BaseGeometry:
    """The area inside a closed way, repaired where its outline crosses itself; only areas are kept."""
    polygon = Polygon([xy[n] for n in way.nodes])
    if polygon.is_valid:
        return polygon
    areas = [piece for piece in pieces_of(shapely.make_valid(polygon)) if isinstance(piece, Polygon)]
    counts.repaired += bool(areas)
    return shapely.union_all(areas)
