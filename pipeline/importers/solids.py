"""All solid things of an OpenStreetMap extract are collected here, clear of the carriageway.

Steps of :func:`collect`: buildings (ways, multipolygons, parts), barriers, poles, trees and rows of trees -> solids;
what stands on the carriageway lower than :data:`pipeline.world.limits.CLEARANCE_M` is cut off or dropped, because
vehicles drive there; crowns that hang over it are lifted, as streets are trimmed.
Nothing is left out without being counted. Frame: the network's x, y in metres.

All default sizes are round figures for towns of no special kind, not measurements; the counts say how often each was
used.
"""

from __future__ import annotations

import dataclasses

import shapely
from shapely.geometry import Point
from shapely.geometry.base import BaseGeometry

from pipeline.formats.osm import Extract
from pipeline.importers.buildings import buildings
from pipeline.importers.junctions import Streets
from pipeline.importers.mapped_solids import ImportCounts, MappedSolid
from pipeline.importers.shapes import large_pieces_of, pieces_of
from pipeline.importers.street_furniture import barriers, poles
from pipeline.importers.vegetation import trees
from pipeline.world.limits import CLEARANCE_M

_MARGIN_M = 0.01


def collect(extract: Extract, streets: Streets) -> tuple[list[MappedSolid], ImportCounts]:
    """All static objects of an extract, with unique names, and what became of the mapped objects."""
    lats, lons = zip(*extract.nodes.values(), strict=True)
    xy = dict(zip(extract.nodes, streets.to_xy(lons, lats), strict=True))
    counts = ImportCounts()
    lanes = shapely.STRtree(list(streets.areas.values()))
    solids: list[MappedSolid] = []
    for solid in (*buildings(extract, xy, counts), *barriers(extract, xy, counts), *poles(extract, xy, counts)):
        solids += _beside_carriageway(solid, lanes, counts)
    for trunk, crown in trees(extract, xy, counts):
        if _lanes_under(trunk, lanes):
            counts.drop("tree", "on_carriageway")
        else:
            counts.keep(trunk)
            counts.keep(crown)
            solids += [trunk, _above_traffic(crown, lanes, counts)]
    return solids, counts


def _lanes_under(solid: MappedSolid, lanes: shapely.STRtree) -> list[BaseGeometry]:
    """The pieces of carriageway that a solid covers or touches."""
    return list(lanes.geometries[sorted(lanes.query(solid.area, predicate="dwithin", distance=_MARGIN_M))])


def _beside_carriageway(solid: MappedSolid, lanes: shapely.STRtree, counts: ImportCounts) -> list[MappedSolid]:
    """The parts of an object that stand beside the carriageway, each as a solid of its own."""
    under = _lanes_under(solid, lanes)
    if solid.base_m >= CLEARANCE_M or not under:
        pieces = pieces_of(solid.geometry)
    else:
        # A line's own width must stay clear too.
        keep_off_m = _MARGIN_M + 1.5 * (solid.radius_m or 0.0)
        rest = solid.geometry.difference(shapely.union_all(under).buffer(keep_off_m))
        pieces, slivers = ([], 0) if isinstance(solid.geometry, Point) else large_pieces_of(rest)
        counts.slivers += slivers
        if not pieces:
            counts.drop(solid.kind, "on_carriageway")
            return []
        counts.cut[solid.kind] += 1
    counts.keep(solid)
    names = [solid.name] if len(pieces) == 1 else [f"{solid.name}#{index}" for index in range(1, len(pieces) + 1)]
    return [dataclasses.replace(solid, geometry=p, name=name) for name, p in zip(names, pieces, strict=True)]


def _above_traffic(crown: MappedSolid, lanes: shapely.STRtree, counts: ImportCounts) -> MappedSolid:
    """Lift the underside of a crown that hangs over the carriageway, as far as the tree is high enough."""
    lifted_m = min(CLEARANCE_M, 0.8 * crown.height_m)
    if lifted_m <= crown.base_m or not _lanes_under(crown, lanes):
        return crown
    counts.raised_crowns += 1
    return dataclasses.replace(crown, base_m=lifted_m)
