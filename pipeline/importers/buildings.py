"""Buildings of a map: closed ways, multipolygons, and parts, which replace their outline where they stand.

Heights: the top as in :mod:`pipeline.importers.mapped_solids`;

    base = min_height     or building:min_level * 3 m      or 0

Multipolygons are assembled here: osmium gives no area to a ring that crosses itself (here: repaired, and counted), nor
to tags on the outer way alone.
"""

from __future__ import annotations

from collections.abc import Iterator

import shapely
from shapely.geometry import LineString
from shapely.geometry.base import BaseGeometry

from pipeline.formats.osm import Extract, Relation, Tags, length_m, number
from pipeline.importers.mapped_solids import LEVEL_M, ImportCounts, MappedSolid, tag_value, top_of
from pipeline.importers.shapes import XY, area_within, large_pieces_of

BUILDING_M = 9.0
ROOF_M, ROOF_THICKNESS_M = 5.0, 0.5

_ROOFS = {"roof", "carport", "canopy"}
_TOWERS = {"tower", "chimney", "silo", "storage_tank", "water_tower", "gasometer"}


def buildings(extract: Extract, xy: dict[int, XY], counts: ImportCounts) -> Iterator[MappedSolid]:
    """Outlines and parts; an outline stands only where none of its parts does."""
    shapes = list(_shapes(extract, xy, counts))
    parts = [shape for shape in shapes if not _is_outline(shape[1])]
    tree = shapely.STRtree([area for _, _, area in parts])
    for name, tags, area in shapes:
        is_outline = _is_outline(tags)
        over = [parts[i][2] for i in tree.query(area, predicate="intersects")] if is_outline else []
        rest = area.difference(shapely.union_all(over)) if over else area
        pieces, slivers = large_pieces_of(rest)
        counts.slivers += slivers
        if not pieces:
            counts.drop("building", "covered_by_parts" if over else "degenerate")
            continue
        height_m, base_m, source, kind = _building_height(tags, counts)
        yield MappedSolid(name, kind, shapely.MultiPolygon(pieces), height_m, source, base_m)


def _is_outline(tags: Tags) -> bool:
    return tags.get("building", "no") not in ("no", "entrance") or tags.get("man_made") in _TOWERS


def _is_building(tags: Tags) -> bool:
    return _is_outline(tags) or tags.get("building:part", "no") != "no"


def _is_underground(tags: Tags, counts: ImportCounts) -> bool:
    under = "underground" in (tags.get("location"), tags.get("building"))
    if under:
        counts.drop("building", "underground")
    return under


def _building_height(tags: Tags, counts: ImportCounts) -> tuple[float, float, str, str]:
    """Top, base, source of the top, kind."""
    kind = "roof" if {tags.get("building"), tags.get("building:part")} & _ROOFS else "building"
    default_m = ROOF_M if kind == "roof" else BUILDING_M
    height_m, source = top_of(tags, default_m, counts)
    low_m = tag_value(tags, "min_height", length_m, counts)
    if low_m is None:
        levels = tag_value(tags, "building:min_level", number, counts)
        low_m = LEVEL_M * levels if levels is not None else None
    if low_m is None:
        low_m = height_m - ROOF_THICKNESS_M if kind == "roof" else 0.0
    if low_m >= height_m:
        counts.unreadable["base above top"] += 1
        low_m = 0.0
    return height_m, max(0.0, low_m), source, kind


def _shapes(extract: Extract, xy: dict[int, XY], counts: ImportCounts) -> Iterator[tuple[str, Tags, BaseGeometry]]:
    """Multipolygons, then closed ways that are not outer ways of these: name, tags, area."""
    outer_ways = set[int]()
    for relation in extract.relations:
        tags = _relation_tags(relation, extract)
        if tags is None:
            continue
        outer_ways.update(relation.ways("outer", ""))
        if _is_underground(tags, counts):
            continue
        outer = _assembled(relation.ways("outer", ""), extract, xy, counts)
        inner = _assembled(relation.ways("inner"), extract, xy, counts)
        if outer is None or inner is None:
            counts.drop("building", "incomplete")
        else:
            yield f"relation/{relation.id}", tags, outer.difference(inner)
    for way in extract.ways.values():
        if way.id in outer_ways or not _is_building(way.tags) or _is_underground(way.tags, counts):
            continue
        if not way.closed or any(n not in xy for n in way.nodes):
            counts.drop("building", "incomplete")
        else:
            yield f"way/{way.id}", way.tags, area_within(way, xy, counts)


def _relation_tags(relation: Relation, extract: Extract) -> Tags | None:
    """The tags of a building that is a multipolygon; older ones carry them on their only outer way."""
    if relation.tags.get("type") != "multipolygon":
        return None
    if _is_building(relation.tags):
        return relation.tags
    outer = [extract.ways[w] for w in relation.ways("outer", "") if w in extract.ways]
    return outer[0].tags if len(outer) == 1 and _is_building(outer[0].tags) else None


def _assembled(ways: list[int], extract: Extract, xy: dict[int, XY], counts: ImportCounts) -> BaseGeometry | None:
    """The area inside rings that may come in several ways; None when a ring does not close."""
    if any(w not in extract.ways or any(n not in xy for n in extract.ways[w].nodes) for w in ways):
        return None
    closed = [extract.ways[w] for w in ways if extract.ways[w].closed]
    opened = [extract.ways[w] for w in ways if not extract.ways[w].closed and len(extract.ways[w].nodes) > 1]
    areas = [area_within(way, xy, counts) for way in closed]
    if opened:
        lines = shapely.union_all([LineString([xy[n] for n in way.nodes]) for way in opened])
        rings, cuts, dangles, bad = shapely.polygonize_full([lines])
        if not (cuts.is_empty and dangles.is_empty and bad.is_empty):
            return None
        areas.append(shapely.union_all(rings))
    return shapely.union_all(areas)
