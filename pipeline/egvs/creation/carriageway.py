"""Keep static objects off the carriageway, in pieces whose coordinates are whole millimetres."""

from __future__ import annotations

import dataclasses

import shapely
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry

from egvs.creation.map_parts import ImportCounts, MappedSolid
from egvs.world.clearances import CLEARANCE_M

_GRID_M = 0.001
_SLIVER_M2 = 0.25
_SHORT_M = 0.1
_MARGIN_M = 0.01


def clear_of_carriageway(solid: MappedSolid, lanes: shapely.STRtree, counts: ImportCounts) -> list[MappedSolid]:
    """Return the parts of an object outside the carriageway, one solid for each part; the object is counted."""
    covered_lanes = lanes_under(solid, lanes)
    if solid.base_m >= CLEARANCE_M or not covered_lanes:
        pieces = geometry_pieces(solid.geometry)
    else:
        pieces = _cut_away(solid, covered_lanes, counts)
        if not pieces:
            counts.drop(solid.kind, "on_carriageway")
            return []
        counts.cut[solid.kind] += 1

    counts.keep(solid)
    if len(pieces) == 1:
        return [dataclasses.replace(solid, geometry=pieces[0])]
    solids = []
    for number, piece in enumerate(pieces, 1):
        solids.append(dataclasses.replace(solid, geometry=piece, name=f"{solid.name}#{number}"))
    return solids


def lanes_under(solid: MappedSolid, lanes: shapely.STRtree) -> list[BaseGeometry]:
    """Return the pieces of carriageway that a solid covers or touches."""
    return list(lanes.geometries[sorted(lanes.query(solid.area, predicate="dwithin", distance=_MARGIN_M))])


def _cut_away(solid: MappedSolid, lanes: list[BaseGeometry], counts: ImportCounts) -> list[BaseGeometry]:
    """Cut the lanes out of a solid; a point on a lane vanishes."""
    if isinstance(solid.geometry, Point):
        return []
    clearance_m = _MARGIN_M + 1.5 * (solid.radius_m or 0.0)  # the width of a line must stay clear too
    rest = solid.geometry.difference(shapely.union_all(lanes).buffer(clearance_m))
    pieces, slivers = large_pieces(rest)
    counts.slivers += slivers
    return pieces


def geometry_pieces(geometry: BaseGeometry) -> list[BaseGeometry]:
    """Split a geometry into its polygons or, without any, its lines or points, in an order that depends on position."""
    parts = [geometry]
    while any(hasattr(part, "geoms") for part in parts):  # get_parts is slow for what has none
        parts = [*shapely.get_parts(parts)]
    parts = [part for part in parts if not part.is_empty]
    polygons = []
    lines = []
    for part in parts:
        if isinstance(part, Polygon):
            polygons.append(shapely.geometry.polygon.orient(shapely.normalize(part)))
        elif isinstance(part, LineString):
            lines.append(part)
    pieces = polygons or lines or parts
    return sorted(pieces, key=lambda piece: (piece.bounds, piece.wkb)) if len(pieces) > 1 else pieces


def large_pieces(geometry: BaseGeometry) -> tuple[list[BaseGeometry], int]:
    """Split a geometry, in millimetres, into polygons or else lines; also return how many slivers were dropped."""
    pieces = geometry_pieces(shapely.set_precision(geometry, _GRID_M))
    large = [piece for piece in pieces if not _is_sliver(piece)]
    return large, len(pieces) - len(large)


def _is_sliver(piece: BaseGeometry) -> bool:
    if isinstance(piece, Polygon):
        return bool(piece.area < _SLIVER_M2)
    return bool(piece.length < _SHORT_M)
