"""What stands on the carriageway is cut off or dropped, because vehicles drive there; crowns that hang over it are
lifted.

Frame: the network's x, y in metres."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import shapely
from shapely.geometry import Point
from shapely.geometry.base import BaseGeometry

from pipeline.importers.mapped_solids import ImportCounts, MappedSolid
from pipeline.importers.shapes import GRID_M, is_large_enough, pieces_of

HEADROOM_M = 4.5
"""Crowns are kept clear of the carriageway up to here, as streets are trimmed; what starts above may span it."""

_MARGIN_M = 0.01


class Carriageway:
    """Where vehicles drive, in searchable pieces."""

    def __init__(self, areas: Sequence[BaseGeometry]) -> None:
        self._areas = list(areas)
        self._tree = shapely.STRtree(self._areas)

    def pieces_under(self, solid: MappedSolid) -> list[BaseGeometry]:
        """The pieces of carriageway that a solid covers or touches."""
        indices = self._tree.query(solid.area, predicate="dwithin", distance=_MARGIN_M)
        return [self._areas[i] for i in sorted(indices)]


def beside_carriageway(solid: MappedSolid, carriageway: Carriageway, counts: ImportCounts) -> list[MappedSolid]:
    """The parts of an object that stand beside the carriageway, each as a solid of its own."""
    under = carriageway.pieces_under(solid)
    if solid.base_m >= HEADROOM_M or not under:
        counts.keep(solid)
        return _split(solid, pieces_of(solid.geometry))
    # A line's own width must stay clear too.
    keep_off_m = _MARGIN_M + 1.5 * (solid.radius_m or 0.0)
    rest = solid.geometry.difference(shapely.union_all(under).buffer(keep_off_m))
    is_point = isinstance(solid.geometry, Point)
    pieces = [] if is_point else pieces_of(shapely.set_precision(rest, GRID_M))
    whole = [piece for piece in pieces if is_large_enough(piece)]
    counts.slivers += len(pieces) - len(whole)
    if not whole:
        counts.drop(solid.kind, "on_carriageway")
        return []
    counts.keep(solid)
    counts.cut[solid.kind] += 1
    return _split(solid, whole)


def _split(solid: MappedSolid, pieces: Sequence[BaseGeometry]) -> list[MappedSolid]:
    if len(pieces) == 1:
        return [dataclasses.replace(solid, geometry=pieces[0])]
    named = ((f"{solid.name}#{index}", piece) for index, piece in enumerate(pieces, 1))
    return [dataclasses.replace(solid, geometry=piece, name=name) for name, piece in named]


def above_traffic(crown: MappedSolid, carriageway: Carriageway, counts: ImportCounts) -> MappedSolid:
    """Lift the underside of a crown that hangs over the carriageway, as far as the tree is high enough."""
    lifted_m = min(HEADROOM_M, 0.8 * crown.height_m)
    if lifted_m <= crown.base_m or not carriageway.pieces_under(crown):
        return crown
    counts.raised_crowns += 1
    return dataclasses.replace(crown, base_m=lifted_m)
