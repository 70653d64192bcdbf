"""Take the buildings, trees, barriers and poles of an OpenStreetMap extract as solids with heights.

Steps of :func:`map_solids`: find buildings (ways, multipolygons, parts), barriers and poles; cut off or drop what
covers the carriageway below :data:`egvs.world.clearances.CLEARANCE_M`, because vehicles drive there; the same with the
decks of bridges; find trees, and lift the crowns that overhang the carriageway, as street trees are trimmed.

:class:`~egvs.creation.map_parts.ImportCounts` counts every object that is used, changed or left out, and every default
size. What is solid, and how high it is where the map gives no height, is defined in :mod:`egvs.world.map_features`. The
defaults are round figures for ordinary towns, not measurements.

Building parts replace their outline where they are. Multipolygons are assembled here, because osmium builds no area
from a ring that crosses itself (here it is repaired and counted) nor from tags on the outer way only.

Frame: the network's x (east), y (north) in metres, coordinates rounded to millimetres; heights in metres above the flat
ground.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry

from egvs.core.grid import XY
from egvs.core.polygons import PairCount, check_corners, check_crossings, repair_polygon
from egvs.creation.carriageway import clear_of_carriageway, geometry_pieces, lanes_under, large_pieces
from egvs.creation.junctions import Streets
from egvs.creation.map_parts import DECK_BASE_M, DEFAULT_BUILDING_M, OUT_OF_RANGE, ImportCounts, MappedPole, MappedSolid
from egvs.creation.openstreetmap import bounds_around, node_positions
from egvs.creation.openstreetmap.street_network import PATH_HIGHWAYS
from egvs.formats.osm import Bounds, OsmExtract, Relation, Tags, Way, parse_number
from egvs.world import map_features
from egvs.world.clearances import CLEARANCE_M
from egvs.world.map_features import SolidType, SolidTypes, VerticalExtent

TREE = map_features.SOLID_TYPES["natural.tree"]
ROW_SPACING_M = 8.0
LONGEST_ROW_M = 50_000.0
"""A longer row of trees has a misplaced node."""


DECK_THICKNESS_M = 1.0
DECK = SolidType(DECK_BASE_M + DECK_THICKNESS_M, thickness_m=DECK_THICKNESS_M)
"""A bridge without a height in the map: above the region of interest, and above lorries."""

_DECK_LANE_M, _DECK_EDGE_M, _TRACK_M, _PATH_M = 3.5, 1.0, 5.0, 3.0
"""Widths of bridges without a width in the map: of each lane, of each edge, of a railway track, and of a path."""


_area_type = lru_cache(1000)(SolidTypes().area_type)
_BUILDING_KEYS = ("building:part", "building", "man_made")
_SOLID_KEYS = frozenset({*_BUILDING_KEYS, "barrier", "natural"})
"""Keys of ways that may be static objects."""

CARRYING_POLES = {
    "highway.street_lamp": "lamp", "highway.traffic_signals": "signal", "man_made.utility_pole": "pole",
    "power.pole": "pole",
}  # fmt: skip
"""Poles that may carry a sensor, with the kind that candidates are named after."""

_MAX_LANES = 12


def map_solids(
    extract: OsmExtract, streets: Streets, bridges: Sequence[Way] = (), window: BaseGeometry | None = None
) -> tuple[list[MappedSolid], ImportCounts]:
    """Collect the static objects of an extract, clear of the carriageway.

    Parameters
    ----------
    extract
        The map.
    streets
        The carriageway, and the frame of the solids.
    bridges
        Ways whose decks are above the ground, see :func:`make_decks`.
    window
        Objects outside it are left out, with a count; None for all objects.

    Returns
    -------
    solids : list of MappedSolid
        With unique names.
    counts : ImportCounts
        What happened to the mapped objects.
    """
    counts = ImportCounts()
    if window is not None:
        extract = _within_reach(extract, streets, window, counts)
    xy = node_positions(
        extract,
        streets,
        {*extract.node_tags, *(node for way in (*extract.ways.values(), *bridges) for node in way.nodes)},
    )
    pairs = PairCount(extract.path)
    lanes = shapely.STRtree(list(streets.areas.values()))

    buildings = find_buildings(extract, xy, counts, pairs, window)
    others = find_barriers(extract, xy, counts, pairs), find_poles(extract, xy, counts)
    decks = make_decks(bridges, xy, counts, pairs)
    solids: list[MappedSolid] = []
    for solid in itertools.chain(buildings, *others, decks):
        if _is_outside(solid, window):
            counts.drop(solid.kind, OUT_OF_RANGE)
            continue
        solids += clear_of_carriageway(solid, lanes, counts)
    for trunk, crown in find_trees(extract, xy, counts, pairs):
        if _is_outside(crown, window):
            counts.drop("tree", OUT_OF_RANGE)
            continue
        if lanes_under(trunk, lanes):
            counts.drop("tree", "on_carriageway")
            continue
        counts.keep(trunk)
        counts.keep(crown)
        solids += [trunk, _above_traffic(crown, lanes, counts)]
    return solids, counts


def _within_reach(extract: OsmExtract, streets: Streets, window: BaseGeometry, counts: ImportCounts) -> OsmExtract:
    """Return the extract with only those ways that may be solid, without far buildings: these are only counted."""
    area = bounds_around(streets, window)
    relations = [relation for relation in extract.relations if _multipolygon_tags(relation, extract) is not None]
    of_relations = {way_id for relation in relations for way_id in relation.ways("outer", "", "inner")}
    kept: dict[int, Way] = {}
    far: dict[int, Bounds] = {}
    parts: list[Bounds] = []
    for way in extract.ways.values():
        if way.id not in of_relations and _SOLID_KEYS.isdisjoint(way.tags):
            continue
        kept[way.id] = way
        bounds = extract.way_bounds(way)
        if bounds is not None and (way.id in of_relations or "building:part" in way.tags):
            parts.append(bounds)
        elif bounds is not None and not bounds.meets(area) and _is_complete_outline(way, extract.nodes):
            far[way.id] = bounds
    # parts may cover an outline, which then is no object
    with_parts = {*shapely.STRtree(_boxes(parts)).query(_boxes(far.values()))[0].tolist()}
    for number, way_id in enumerate(far):
        if number not in with_parts:
            tags = kept.pop(way_id).tags
            solid = _building_type(tags)
            extent_from_tags(tags, solid, counts)
            counts.drop(_building_kind(solid), OUT_OF_RANGE)
    return dataclasses.replace(extract, ways=kept)


def _boxes(bounds: Iterable[Bounds]) -> NDArray[Any]:
    corners_deg = [(box.west_deg, box.south_deg, box.east_deg, box.north_deg) for box in bounds]
    boxes: NDArray[Any] = shapely.box(*np.array(corners_deg).reshape(-1, 4).T)
    return boxes


def _is_complete_outline(way: Way, nodes: Mapping[int, XY]) -> bool:
    is_outline = way.closed and _is_outline(way.tags) and not map_features.is_underground(way.tags)
    return is_outline and _has_positions(way, nodes)


def _is_outside(solid: MappedSolid, window: BaseGeometry | None) -> bool:
    return window is not None and not window.intersects(solid.area)


def _above_traffic(crown: MappedSolid, lanes: shapely.STRtree, counts: ImportCounts) -> MappedSolid:
    """Lift the underside of a crown that overhangs the carriageway, as far as the height of the tree allows."""
    lifted_m = min(CLEARANCE_M, 0.8 * crown.height_m)
    if lifted_m <= crown.base_m or not lanes_under(crown, lanes):
        return crown
    counts.raised_crowns += 1
    return dataclasses.replace(crown, base_m=lifted_m)


def extent_from_tags(tags: Tags, solid: SolidType, counts: ImportCounts) -> VerticalExtent:
    """Return bottom and top of an object; unreadable tags are counted."""
    extent = map_features.vertical_extent(tags, solid, DEFAULT_BUILDING_M)
    counts.unreadable.update(extent.unreadable)
    return extent


def tag_value(tags: Tags, key: str, parse: Callable[[str], float | None], counts: ImportCounts) -> float | None:
    """Return the value of a tag; an unreadable one is counted and treated as absent."""
    if key not in tags:
        return None
    value = parse(tags[key])
    if value is None:
        counts.unreadable[key] += 1
    return value


def point_at(xy: XY) -> Point:
    """Return a point, rounded to millimetres."""
    return Point(round(xy[0], 3), round(xy[1], 3))


def way_lines(way: Way, xy: dict[int, XY], pairs: PairCount) -> list[LineString]:
    """Return a way as lines, interrupted where its nodes are not in the file."""
    lines = []
    for has_position, nodes in itertools.groupby(way.nodes, lambda node: node in xy):
        if not has_position:
            continue
        points = [xy[node] for node in nodes]
        if len(points) > 1:
            line = LineString(points)
            check_crossings([line], f"{pairs.file}: way {way.id}", pairs)
            lines += large_pieces(line)[0]
    return lines


def way_area(way: Way, xy: dict[int, XY], counts: ImportCounts, pairs: PairCount) -> BaseGeometry:
    """Return the area inside a closed way, repaired where its outline crosses itself."""
    polygon = Polygon([xy[node] for node in way.nodes])
    repaired = repair_polygon(polygon, f"{pairs.file}: way {way.id}", pairs)
    if repaired is polygon:
        return polygon
    areas = [piece for piece in geometry_pieces(repaired) if isinstance(piece, Polygon)]
    if areas:
        counts.repaired += 1
    return shapely.union_all(areas)


def find_buildings(
    extract: OsmExtract, xy: dict[int, XY], counts: ImportCounts, pairs: PairCount, window: BaseGeometry | None = None
) -> Iterator[MappedSolid]:
    """Yield building outlines and parts; an outline is used only where it has no parts.

    Parameters
    ----------
    extract
        The map.
    xy
        x, y in metres by node.
    counts
        Counts what happens to the objects.
    pairs
        Pairs of edges of the file so far.
    window
        What is left out is counted within it; None for everywhere.
    """
    for node, tags in extract.node_tags.items():
        if _is_building(tags) and (window is None or window.intersects(Point(xy[node]))):
            counts.drop("building", "no_outline")

    footprints = list(_footprints(extract, xy, counts, pairs))
    part_areas = [area for _, tags, area in footprints if not _is_outline(tags)]
    parts_tree = shapely.STRtree(part_areas)
    for name, tags, outline in footprints:
        area = outline
        parts: list[BaseGeometry] = []
        if _is_outline(tags):
            parts = [part_areas[i] for i in parts_tree.query(area, predicate="intersects")]
        if parts:
            check_crossings([area, *parts], f"{pairs.file}: {name}", pairs)
            area = area.difference(shapely.union_all(parts))
        pieces, slivers = large_pieces(area)
        counts.slivers += slivers
        if pieces:
            yield _make_building(name, tags, pieces, counts)
        elif window is None or window.intersects(outline):
            counts.drop("building", "covered_by_parts" if parts else "degenerate")


def _make_building(name: str, tags: Tags, pieces: list[BaseGeometry], counts: ImportCounts) -> MappedSolid:
    solid = _building_type(tags)
    extent = extent_from_tags(tags, solid, counts)
    source = extent.source
    if source == "default" and solid.height_m:
        source = "type"
    kind = _building_kind(solid)
    return MappedSolid(name, kind, shapely.MultiPolygon(pieces), extent.top_m, source, extent.base_m)


def _building_kind(solid: SolidType) -> str:
    return "roof" if solid.thickness_m else "building"


def _solid_type(tags: Tags, key: str) -> SolidType | None:
    """Return the type of the solid that a tag names; None for no object, or one that is not solid."""
    value = tags.get(key, "no")
    if value == "no":
        return None
    return _area_type(f"{key.removesuffix(':part')}.{value}")


def _is_outline(tags: Tags) -> bool:
    return _solid_type(tags, "building") is not None or _solid_type(tags, "man_made") is not None


def _is_building(tags: Tags) -> bool:
    return _is_outline(tags) or _solid_type(tags, "building:part") is not None


def _building_type(tags: Tags) -> SolidType:
    """Return the first type with a special height (open roof, low house), otherwise the first type."""
    types = [solid for key in _BUILDING_KEYS if (solid := _solid_type(tags, key)) is not None]
    for solid in types:
        if solid.height_m:
            return solid
    return types[0]


def _footprints(
    extract: OsmExtract, xy: dict[int, XY], counts: ImportCounts, pairs: PairCount
) -> Iterator[tuple[str, Tags, BaseGeometry]]:
    """Yield name, tags and area of multipolygons, then of closed ways that are not outer ways of multipolygons."""
    outer_ways: set[int] = set()
    for relation in extract.relations:
        tags = _multipolygon_tags(relation, extract)
        if tags is None:
            continue
        outer_ways.update(relation.ways("outer", ""))
        if map_features.is_underground(tags):
            counts.drop("building", "underground")
            continue
        ways = [extract.ways[way_id] for way_id in relation.ways("outer", "", "inner") if way_id in extract.ways]
        lines = [LineString([xy[node] for node in way.nodes if node in xy]) for way in ways if len(way.nodes) > 1]
        check_crossings(lines, f"{pairs.file}: relation {relation.id}", pairs)
        outer = _assemble_area(relation.ways("outer", ""), extract, xy, counts, pairs)
        inner = _assemble_area(relation.ways("inner"), extract, xy, counts, pairs)
        if outer is None or inner is None:
            counts.drop("building", "incomplete")
            continue
        area = outer.difference(inner)
        check_corners(area, f"{pairs.file}: relation {relation.id}")
        yield f"relation/{relation.id}", tags, area

    for way in extract.ways.values():
        if way.id in outer_ways:
            continue
        if not _is_building(way.tags):
            if "building" in way.tags:  # e.g. building=ruins
                counts.not_modelled[f"building={way.tags['building']}"] += 1
        elif map_features.is_underground(way.tags):
            counts.drop("building", "underground")
        elif not way.closed or not _has_positions(way, xy):
            counts.drop("building", "incomplete")
        else:
            yield f"way/{way.id}", way.tags, way_area(way, xy, counts, pairs)


def _has_positions(way: Way, xy: Mapping[int, XY]) -> bool:
    return all(node in xy for node in way.nodes)


def _multipolygon_tags(relation: Relation, extract: OsmExtract) -> Tags | None:
    """Return the tags of a building that is a multipolygon; older ones have them on their only outer way."""
    if relation.tags.get("type") != "multipolygon":
        return None
    if _is_building(relation.tags):
        return relation.tags
    outer_ways = [extract.ways[way_id] for way_id in relation.ways("outer", "") if way_id in extract.ways]
    if len(outer_ways) == 1 and _is_building(outer_ways[0].tags):
        return outer_ways[0].tags
    return None


def _assemble_area(
    way_ids: list[int], extract: OsmExtract, xy: dict[int, XY], counts: ImportCounts, pairs: PairCount
) -> BaseGeometry | None:
    """Return the area inside rings that may consist of several ways; None when a ring is not closed."""
    areas = []
    open_lines = []
    for way_id in way_ids:
        if way_id not in extract.ways or not _has_positions(extract.ways[way_id], xy):
            return None
    for way_id in way_ids:
        way = extract.ways[way_id]
        if way.closed:
            areas.append(way_area(way, xy, counts, pairs))
        elif len(way.nodes) > 1:
            open_lines.append(LineString([xy[node] for node in way.nodes]))

    if open_lines:
        rings, cuts, dangles, invalid = shapely.polygonize_full([shapely.union_all(open_lines)])
        if not (cuts.is_empty and dangles.is_empty and invalid.is_empty):
            return None
        areas.append(shapely.union_all(rings))
    return shapely.union_all(areas)


def find_barriers(
    extract: OsmExtract, xy: dict[int, XY], counts: ImportCounts, pairs: PairCount
) -> Iterator[MappedSolid]:
    """Yield fences, walls, hedges and guard rails: lines with a width, or areas.

    A kind without default sizes is counted as not modelled. Parameters as for :func:`find_buildings`.
    """
    for way in extract.ways.values():
        value = way.tags.get("barrier", "no")
        if value == "no":
            continue
        solid = _area_type(f"barrier.{value}")
        if solid is None:
            counts.not_modelled[f"barrier={value}"] += 1
            continue

        extent = extent_from_tags(way.tags, solid, counts)
        radius_m: float | None = solid.half_width_m
        if way.closed and way.tags.get("area") == "yes" and _has_positions(way, xy):
            radius_m = None
            geometry = shapely.MultiPolygon(large_pieces(way_area(way, xy, counts, pairs))[0])
        else:
            geometry = shapely.MultiLineString(way_lines(way, xy, pairs))
        if geometry.is_empty:
            counts.drop("barrier", "degenerate")
            continue
        name = f"way/{way.id}"
        yield MappedSolid(name, "barrier", geometry, extent.top_m, extent.source, extent.base_m, radius_m)


def make_decks(
    bridges: Sequence[Way], xy: dict[int, XY], counts: ImportCounts, pairs: PairCount
) -> Iterator[MappedSolid]:
    """Yield the decks of bridges: strips as wide as the way, from ``min_height`` to ``height`` of the map.

    Parameters
    ----------
    bridges
        Ways on bridges.
    xy, counts, pairs
        As for :func:`find_buildings`.
    """
    for way in bridges:
        extent = extent_from_tags(way.tags, DECK, counts)
        half_width_m = _deck_width_m(way.tags, counts) / 2
        lines = shapely.MultiLineString(way_lines(way, xy, pairs))
        if lines.is_empty:
            counts.drop("bridge", "degenerate")
            continue
        yield MappedSolid(f"way/{way.id}", "bridge", lines, extent.top_m, extent.source, extent.base_m, half_width_m)


def _deck_width_m(tags: Tags, counts: ImportCounts) -> float:
    width_m = tag_value(tags, "width", map_features.parse_positive_length_m, counts)
    if width_m:
        return width_m
    if "railway" in tags:
        return _TRACK_M
    if tags["highway"] in PATH_HIGHWAYS:
        return _PATH_M
    lanes = tag_value(tags, "lanes", _parse_lanes, counts)
    if lanes is None:
        lanes = 1.0 if tags.get("oneway") == "yes" else 2.0
    return lanes * _DECK_LANE_M + 2 * _DECK_EDGE_M


def _parse_lanes(text: str) -> float | None:
    lanes = parse_number(text)
    return lanes if lanes is not None and 1 <= lanes <= _MAX_LANES else None


def find_poles(extract: OsmExtract, xy: dict[int, XY], counts: ImportCounts) -> Iterator[MappedSolid]:
    """Yield lamps, signals, masts and bollards as upright cylinders.

    Objects too wide for a cylinder are counted as not modelled. Parameters as for :func:`find_buildings`.
    """
    for node, tags in extract.node_tags.items():
        solid = _pole_type(tags)
        if solid is not None:
            extent = extent_from_tags(tags, solid, counts)
            name, point = f"node/{node}", point_at(xy[node])
            yield MappedSolid(name, "pole", point, extent.top_m, extent.source, extent.base_m, solid.half_width_m)
        elif "barrier" in tags:
            counts.not_modelled[f"barrier={tags['barrier']}"] += 1
        elif tags.get("power") in ("tower", "portal"):
            counts.not_modelled[f"power={tags['power']}"] += 1


def carrying_poles(extract: OsmExtract, streets: Streets, window: BaseGeometry | None) -> tuple[MappedPole, ...]:
    """Return the poles of :data:`CARRYING_POLES` in a window (world frame); parameters as of :func:`map_solids`."""
    kinds = {}
    for node, tags in extract.node_tags.items():
        of_node = [
            CARRYING_POLES[f"{key}.{value}"] for key, value in tags.items() if f"{key}.{value}" in CARRYING_POLES
        ]
        if of_node:
            kinds[node] = of_node[0]
    xy = node_positions(extract, streets, kinds)
    return tuple(
        MappedPole(f"node/{node}", kind, xy[node])
        for node, kind in kinds.items()
        if window is None or window.covers(point_at(xy[node]))
    )


def _pole_type(tags: Tags) -> SolidType | None:
    for key, value in tags.items():
        solid = map_features.POLE_TYPES.get(f"{key}.{value}")
        if solid is not None:
            return solid
    return None


def find_trees(
    extract: OsmExtract, xy: dict[int, XY], counts: ImportCounts, pairs: PairCount
) -> Iterator[tuple[MappedSolid, MappedSolid]]:
    """Yield (trunk, crown) of each tree, mapped singly or as a row.

    A row has gaps near trees that are also mapped singly. Parameters as for :func:`find_buildings`.
    """
    single_trees = {node: tags for node, tags in extract.node_tags.items() if tags.get("natural") == "tree"}
    for node, tags in single_trees.items():
        yield _make_tree(f"node/{node}", point_at(xy[node]), tags, counts)

    single_points = shapely.MultiPoint([xy[node] for node in single_trees])
    for way in extract.ways.values():
        if way.tags.get("natural") != "tree_row":
            continue
        number = 0
        for line in way_lines(way, xy, pairs):
            if line.length > LONGEST_ROW_M:
                counts.drop("tree row", "too_long")
                continue
            for point in _row_points(line):
                if not single_points.is_empty and single_points.distance(point) < ROW_SPACING_M / 2:
                    counts.drop("tree", "row_tree_mapped_singly")
                    continue
                number += 1
                yield _make_tree(f"way/{way.id}/{number}", point, way.tags, counts)


def _row_points(line: LineString) -> list[Point]:
    """Return the trees of a row; in a ring, the last would be on the first."""
    count = math.floor(line.length / ROW_SPACING_M + 1e-9) + 1
    if line.is_ring and count > 2:
        count -= 1
    points = [line.interpolate(index * ROW_SPACING_M) for index in range(count)]
    return [point_at((point.x, point.y)) for point in points]


def _make_tree(name: str, point: Point, tags: Tags, counts: ImportCounts) -> tuple[MappedSolid, MappedSolid]:
    extent = extent_from_tags(tags, TREE, counts)
    girth_m = tag_value(tags, "circumference", map_features.parse_positive_length_m, counts)
    diameter_m = tag_value(tags, "diameter_crown", map_features.parse_positive_length_m, counts)

    trunk_radius_m = map_features.TRUNK_RADIUS_M
    if girth_m:
        trunk_radius_m = min(max(girth_m / (2 * math.pi), 0.05), 1.5)
    crown_radius_m = TREE.half_width_m
    if diameter_m:
        crown_radius_m = min(max(diameter_m / 2, 2 * trunk_radius_m), 15.0)

    base_m = map_features.CROWN_BASE_SHARE * extent.top_m
    trunk = MappedSolid(f"{name}/trunk", "tree_trunk", point, base_m, extent.source, 0.0, trunk_radius_m)
    crown = MappedSolid(
        f"{name}/crown", "tree_crown", point, extent.top_m, extent.source, base_m, crown_radius_m,
        assumed_radius=not diameter_m,
    )  # fmt: skip
    return trunk, crown
