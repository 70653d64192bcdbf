"""All solid things of an OpenStreetMap extract are collected here, clear of the carriageway.

Steps of :func:`collect`: buildings (ways, multipolygons, parts), barriers, poles, trees and rows of trees -> solids in
the world frame (metres); what stands on the carriageway is cut off or dropped. Nothing is left out without being
counted.

All default sizes are round figures for towns of no special kind, not measurements; the counts say how often each was
used."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

from shapely.geometry.base import BaseGeometry

from pipeline.formats.osm import Extract
from pipeline.importers.buildings import buildings
from pipeline.importers.carriageway import Carriageway, above_traffic, beside_carriageway
from pipeline.importers.mapped_solids import ImportCounts, MappedSolid
from pipeline.importers.shapes import XY
from pipeline.importers.street_furniture import barriers, poles
from pipeline.importers.vegetation import trees

ToXY = Callable[[Sequence[float], Sequence[float]], list[XY]]
"""From longitudes and latitudes in degrees to world-frame x, y in metres."""


def collect(
    extract: Extract, to_xy: ToXY, lane_areas: Sequence[BaseGeometry]
) -> tuple[list[MappedSolid], ImportCounts]:
    """All static objects of an extract.

    Parameters
    ----------
    to_xy
        The network's own projection with its offset.
    lane_areas
        The carriageway in pieces, world frame.

    Returns
    -------
    solids
        With unique names, free of the carriageway.
    counts
        How many of each kind and of each source of heights, what was repaired, cut, dropped and not modelled.
    """
    lats, lons = zip(*extract.nodes.values(), strict=True)
    xy = dict(zip(extract.nodes, to_xy(lons, lats), strict=True))
    counts = ImportCounts()
    carriageway = Carriageway(lane_areas)
    solids: list[MappedSolid] = []
    for solid in itertools.chain(
        buildings(extract, xy, counts), barriers(extract, xy, counts), poles(extract, xy, counts)
    ):
        solids += beside_carriageway(solid, carriageway, counts)
    for trunk, crown in trees(extract, xy, counts):
        if carriageway.pieces_under(trunk):
            counts.drop("tree", "on_carriageway")
        else:
            counts.keep(trunk)
            counts.keep(crown)
            solids += [trunk, above_traffic(crown, carriageway, counts)]
    return solids, counts
