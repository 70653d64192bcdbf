"""Barriers and poles of a map: fences, walls, hedges and guard rails along ways; lamps, signals, masts and bollards.

The default sizes stand in :mod:`pipeline.world.solid_types`; the summary says how often one was used. Frame: the
network's x, y in metres.
"""

from __future__ import annotations

from collections.abc import Iterator

import shapely

from pipeline.formats.osm import Extract
from pipeline.importers.mapped_solids import ImportCounts, MappedSolid, extent_counted
from pipeline.importers.shapes import XY, area_within, large_pieces_of, lines_of, point_at
from pipeline.world.solid_types import POLES, SolidTypes


def barriers(extract: Extract, xy: dict[int, XY], counts: ImportCounts) -> Iterator[MappedSolid]:
    """Lines with a width, or areas; a kind without default sizes is counted as not modelled."""
    types = SolidTypes()
    for way in extract.ways.values():
        value = way.tags.get("barrier")
        if value is None or value == "no":
            continue
        solid = types.named(f"barrier.{value}")
        if solid is None:
            counts.not_modelled[f"barrier={value}"] += 1
            continue
        extent, radius_m = extent_counted(way.tags, solid, counts), solid.half_width_m
        if way.closed and way.tags.get("area") == "yes" and all(n in xy for n in way.nodes):
            geometry, radius_m = shapely.MultiPolygon(large_pieces_of(area_within(way, xy, counts))[0]), None
        else:
            geometry = shapely.MultiLineString(lines_of(way, xy))
        if geometry.is_empty:
            counts.drop("barrier", "degenerate")
        else:
            name, base_m = f"way/{way.id}", extent.base_m
            yield MappedSolid(name, "barrier", geometry, extent.top_m, extent.source, base_m, radius_m)


def poles(extract: Extract, xy: dict[int, XY], counts: ImportCounts) -> Iterator[MappedSolid]:
    """Upright cylinders; what is too wide for one is counted as not modelled."""
    for node, tags in extract.node_tags.items():
        known = next((POLES[name] for key, value in tags.items() if (name := f"{key}.{value}") in POLES), None)
        if known is not None:
            extent, at = extent_counted(tags, known, counts), point_at(xy[node])
            name, base_m = f"node/{node}", extent.base_m
            yield MappedSolid(name, "pole", at, extent.top_m, extent.source, base_m, known.half_width_m)
        elif "barrier" in tags:
            counts.not_modelled[f"barrier={tags['barrier']}"] += 1
        elif tags.get("power") in ("tower", "portal"):
            counts.not_modelled[f"power={tags['power']}"] += 1
