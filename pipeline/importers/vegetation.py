"""Trees of a map, mapped one by one or as a row: a trunk and a crown each (hedges are barriers).

The default sizes stand in :mod:`pipeline.world.solid_types`. Frame: the network's x, y in metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import shapely
from shapely.geometry import LineString, Point

from pipeline.formats.osm import Extract, Tags
from pipeline.importers.mapped_solids import ImportCounts, MappedSolid, extent_counted, tag_value
from pipeline.importers.shapes import XY, lines_of, point_at
from pipeline.world.mapped_heights import length_above_zero_m
from pipeline.world.solid_types import CROWN_BASE_SHARE, SOLID, TRUNK_RADIUS_M

TREE = SOLID["natural.tree"]
ROW_SPACING_M = 8.0


def trees(extract: Extract, xy: dict[int, XY], counts: ImportCounts) -> Iterator[tuple[MappedSolid, MappedSolid]]:
    """(trunk, crown) of each tree, mapped one by one or as a row; a row leaves out where a mapped tree stands."""
    single = {n: tags for n, tags in extract.node_tags.items() if tags.get("natural") == "tree"}
    for node, tags in single.items():
        yield _tree(f"node/{node}", point_at(xy[node]), tags, counts)
    mapped = shapely.MultiPoint([xy[n] for n in single])
    for way in extract.ways.values():
        if way.tags.get("natural") != "tree_row":
            continue
        points = [p for line in lines_of(way, xy) for p in _row_points(line)]
        free = [p for p in points if mapped.is_empty or mapped.distance(p) >= ROW_SPACING_M / 2]
        for _ in range(len(points) - len(free)):
            counts.drop("tree", "row_tree_mapped_singly")
        for index, point in enumerate(free, 1):
            yield _tree(f"way/{way.id}/{index}", point, way.tags, counts)


def _row_points(line: LineString) -> list[Point]:
    count = math.floor(line.length / ROW_SPACING_M + 1e-9)
    points = [line.interpolate(i * ROW_SPACING_M) for i in range(count + 1)]
    return [point_at((p.x, p.y)) for p in points[: count if line.is_ring and count > 1 else None]]


def _tree(name: str, at: Point, tags: Tags, counts: ImportCounts) -> tuple[MappedSolid, MappedSolid]:
    extent = extent_counted(tags, TREE, counts)
    girth_m = tag_value(tags, "circumference", length_above_zero_m, counts)
    crown_m = tag_value(tags, "diameter_crown", length_above_zero_m, counts)
    trunk_radius_m = min(max(girth_m / (2 * math.pi), 0.05), 1.5) if girth_m else TRUNK_RADIUS_M
    crown_radius_m = min(max(crown_m / 2, 2 * trunk_radius_m), 15.0) if crown_m else TREE.half_width_m
    base_m = CROWN_BASE_SHARE * extent.top_m
    trunk = MappedSolid(f"{name}/trunk", "tree_trunk", at, base_m, extent.source, 0.0, trunk_radius_m)
    return trunk, MappedSolid(f"{name}/crown", "tree_crown", at, extent.top_m, extent.source, base_m, crown_radius_m)
