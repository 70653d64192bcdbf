"""Buildings of a map: closed ways, multipolygons, and parts, which replace their outline where they stand.

What is a building, and how high where the map does not say, stands in :mod:`pipeline.world.solid_types`; heights are
those of :mod:`pipeline.world.mapped_heights`. Multipolygons are assembled here:
osmium gives no area to a ring that crosses itself (here: repaired, and counted), nor to tags on the outer way alone.
"""

from __future__ import annotations

from collections.abc import Iterator

import shapely
from shapely.geometry import LineString
from shapely.geometry.base import BaseGeometry

from pipeline.formats.osm import Extract, Relation, Tags
from pipeline.importers.mapped_solids import ImportCounts, MappedSolid, extent_counted
from pipeline.importers.shapes import XY, area_within, large_pieces_of
from pipeline.world.mapped_heights import is_underground
from pipeline.world.solid_types import SolidType, SolidTypes

_TYPES = SolidTypes()


def buildings(extract: Extract, xy: dict[int, XY], counts: ImportCounts) -> Iterator[MappedSolid]:
    """Outlines and parts; an outline stands only where none of its parts does."""
    for tags in extract.node_tags.values():
        if _is_building(tags):
            counts.drop("building", "no_outline")
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
        solid = _solid(tags)
        extent, kind = extent_counted(tags, solid, counts), "roof" if solid.thickness_m else "building"
        source = "type" if extent.source == "default" and solid.height_m else extent.source
        yield MappedSolid(name, kind, shapely.MultiPolygon(pieces), extent.top_m, source, extent.base_m)


def _named(tags: Tags, key: str) -> SolidType | None:
    """How the thing that ``key`` names stands; None where it is none, or not solid."""
    value = tags.get(key, "no")
    return _TYPES.named(f"{key.removesuffix(':part')}.{value}") if value != "no" else None


def _is_outline(tags: Tags) -> bool:
    return _named(tags, "building") is not None or _named(tags, "man_made") is not None


def _is_building(tags: Tags) -> bool:
    return _is_outline(tags) or _named(tags, "building:part") is not None


def _is_none(tags: Tags, counts: ImportCounts) -> bool:
    """Whether a way is no building; what a map calls a building that is none (any more) is counted."""
    none = not _is_building(tags)
    if none and "building" in tags:
        counts.not_modelled[f"building={tags['building']}"] += 1
    return none


def _solid(tags: Tags) -> SolidType:
    """How a building stands: as an open roof or low house where one of its tags says so, else as any building."""
    kinds = [kind for key in ("building:part", "building", "man_made") if (kind := _named(tags, key)) is not None]
    return next((kind for kind in kinds if kind.height_m), kinds[0])


def _is_underground(tags: Tags, counts: ImportCounts) -> bool:
    under = is_underground(tags)
    if under:
        counts.drop("building", "underground")
    return under


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
        if way.id in outer_ways or _is_none(way.tags, counts) or _is_underground(way.tags, counts):
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
