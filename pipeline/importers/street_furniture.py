"""Barriers and poles of a map: fences, walls, hedges and guard rails along ways; lamps, signals, masts and bollards.

The default sizes are round figures for towns of no special kind, not measurements; the summary says how often a default
was used. Frame: the network's x, y in metres.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import shapely

from pipeline.formats.osm import Extract
from pipeline.importers.mapped_solids import ImportCounts, MappedSolid, top_of
from pipeline.importers.shapes import XY, area_within, large_pieces_of, lines_of, point_at

BARRIERS: Mapping[str, tuple[float, float]] = {
    "cable_barrier": (0.75, 0.05),
    "city_wall": (6.0, 0.75),
    "fence": (1.5, 0.05),
    "guard_rail": (0.75, 0.15),
    "handrail": (1.0, 0.05),
    "hedge": (1.5, 0.5),
    "jersey_barrier": (0.8, 0.3),
    "retaining_wall": (1.5, 0.2),
    "wall": (2.0, 0.15),
}
"""Default height and half width in metres of ways with ``barrier``."""

POLES: Mapping[tuple[str, str], tuple[float, float]] = {
    ("advertising", "column"): (3.5, 0.65),
    ("barrier", "block"): (0.5, 0.3),
    ("barrier", "bollard"): (1.0, 0.1),
    ("highway", "street_lamp"): (6.0, 0.1),
    ("highway", "traffic_signals"): (3.5, 0.1),
    ("man_made", "flagpole"): (8.0, 0.1),
    ("man_made", "mast"): (15.0, 0.3),
    ("man_made", "utility_pole"): (8.0, 0.15),
    ("power", "pole"): (8.0, 0.15),
}
"""Default height and radius in metres of nodes."""


def barriers(extract: Extract, xy: dict[int, XY], counts: ImportCounts) -> Iterator[MappedSolid]:
    """Lines with a width, or areas; a kind without default sizes is counted as not modelled."""
    for way in extract.ways.values():
        value = way.tags.get("barrier")
        if value is None or value == "no":
            continue
        if value not in BARRIERS:
            counts.not_modelled[f"barrier={value}"] += 1
            continue
        height_m, source = top_of(way.tags, BARRIERS[value][0], counts)
        radius_m: float | None = BARRIERS[value][1]
        if way.closed and way.tags.get("area") == "yes" and all(n in xy for n in way.nodes):
            geometry, radius_m = shapely.MultiPolygon(large_pieces_of(area_within(way, xy, counts))[0]), None
        else:
            geometry = shapely.MultiLineString(lines_of(way, xy))
        if geometry.is_empty:
            counts.drop("barrier", "degenerate")
        else:
            yield MappedSolid(f"way/{way.id}", "barrier", geometry, height_m, source, 0.0, radius_m)


def poles(extract: Extract, xy: dict[int, XY], counts: ImportCounts) -> Iterator[MappedSolid]:
    """Upright cylinders; what is too wide for one is counted as not modelled."""
    for node, tags in extract.node_tags.items():
        known = next((POLES[item] for item in tags.items() if item in POLES), None)
        if known is not None:
            height_m, source = top_of(tags, known[0], counts)
            yield MappedSolid(f"node/{node}", "pole", point_at(xy[node]), height_m, source, 0.0, known[1])
        elif "barrier" in tags:
            counts.not_modelled[f"barrier={tags['barrier']}"] += 1
        elif tags.get("power") in ("tower", "portal"):
            counts.not_modelled[f"power={tags['power']}"] += 1
