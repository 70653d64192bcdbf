"""Which solid things does an OpenStreetMap extract hold, and how high are they?

Steps of :func:`collect`: buildings (ways, multipolygons, parts), trees and rows of trees, barriers, poles -> footprints
in the world frame (metres); what stands on the carriageway is cut off or dropped, because vehicles drive there. Nothing
is left out without being counted in the summary.

Heights (Simple 3D Buildings, https://wiki.openstreetmap.org/wiki/Simple_3D_Buildings):

    top  = height         or building:levels * 3 m         or the default of the kind (a building: 9 m)
    base = min_height     or building:min_level * 3 m      or 0

All defaults below are round figures for towns of no special kind, not measurements; the summary says how often each was
used."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import shapely
from shapely.geometry import LineString, Point, Polygon
from shapely.geometry.base import BaseGeometry

from pipeline.formats.osm import Extract, Relation, Tags, Way, length_m, number

LEVEL_M = 3.0
BUILDING_M = 9.0
ROOF_M, ROOF_THICKNESS_M = 5.0, 0.5
TREE_M, CROWN_RADIUS_M, TRUNK_RADIUS_M, CROWN_BASE_SHARE = 8.0, 2.0, 0.15, 0.3
ROW_SPACING_M = 8.0
HEADROOM_M = 4.5
"""Crowns are kept clear of the carriageway up to here, as streets are trimmed; what starts above may span it."""

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

_GRID_M = 0.001
_MARGIN_M = 0.01
_SLIVER_M2 = 0.25
_ROOFS = {"roof", "carport", "canopy"}
_TOWERS = {"tower", "chimney", "silo", "storage_tank", "water_tower", "gasometer"}

XY = tuple[float, float]
ToXY = Callable[[Sequence[float], Sequence[float]], list[XY]]
"""From longitudes and latitudes in degrees to world-frame x, y in metres."""


@dataclass(frozen=True)
class Footprint:
    """A solid: an area, line or point, extruded from ``base_m`` to ``height_m``.

    Lines and points reach ``radius_m`` to each side. ``source`` says where the height is from: height, levels or
    default."""

    name: str
    kind: str
    geometry: BaseGeometry
    height_m: float
    source: str
    base_m: float = 0.0
    radius_m: float | None = None

    @property
    def area(self) -> BaseGeometry:
        """What it covers, seen from above."""
        return self.geometry.buffer(self.radius_m) if self.radius_m else self.geometry

    def to_geojson(self) -> dict[str, Any]:
        """A GeoJSON feature in world-frame metres."""
        properties: dict[str, Any] = {
            "name": self.name,
            "kind": self.kind,
            "height_m": round(self.height_m, 3),
        }
        if self.base_m:
            properties["base_m"] = round(self.base_m, 3)
        if self.radius_m is not None:
            properties["radius_m"] = round(self.radius_m, 3)
        properties["height_from"] = self.source
        return {
            "type": "Feature",
            "properties": properties,
            "geometry": shapely.geometry.mapping(self.geometry),
        }


@dataclass
class Tally:
    """What happened to the objects, counted."""

    objects: Counter[str] = field(default_factory=Counter)
    heights: dict[str, Counter[str]] = field(default_factory=dict)
    unreadable: Counter[str] = field(default_factory=Counter)
    repaired: int = 0
    cut: Counter[str] = field(default_factory=Counter)
    dropped: dict[str, Counter[str]] = field(default_factory=dict)
    slivers: int = 0
    raised_crowns: int = 0
    not_modelled: Counter[str] = field(default_factory=Counter)

    def keep(self, footprint: Footprint) -> None:
        """Count an object that is kept; a tree is counted once, by its trunk."""
        self.objects[footprint.kind] += 1
        if footprint.kind != "tree_crown":
            kind = footprint.kind.removesuffix("_trunk")
            self.heights.setdefault(kind, Counter())[footprint.source] += 1

    def drop(self, kind: str, why: str) -> None:
        """Count an object that is left out."""
        self.dropped.setdefault(why, Counter())[kind] += 1

    def to_json(self) -> dict[str, Any]:
        """Plain JSON, sorted by key."""
        return {key: _sorted(value) for key, value in vars(self).items()}


def collect(
    extract: Extract, to_xy: ToXY, lane_areas: Sequence[BaseGeometry]
) -> tuple[list[Footprint], dict[str, Any]]:
    """All static objects of an extract.

    Parameters
    ----------
    to_xy
        The network's own projection with its offset.
    lane_areas
        The carriageway in pieces, world frame.

    Returns
    -------
    footprints
        With unique names, free of the carriageway.
    summary
        JSON: how many of each kind and of each source of heights, what was repaired, cut, dropped and not modelled.
    """
    lats, lons = zip(*extract.nodes.values(), strict=True)
    xy = dict(zip(extract.nodes, to_xy(lons, lats), strict=True))
    tally = Tally()
    lanes = _Lanes(lane_areas)
    footprints: list[Footprint] = []
    for found in itertools.chain(
        _buildings(extract, xy, tally), _barriers(extract, xy, tally), _poles(extract, xy, tally)
    ):
        footprints += _clear(found, lanes, tally)
    for trunk, crown in _trees(extract, xy, tally):
        if lanes.under(trunk):
            tally.drop("tree", "on_carriageway")
        else:
            tally.keep(trunk)
            tally.keep(crown)
            footprints += [trunk, _above_traffic(crown, lanes, tally)]
    return footprints, tally.to_json()


class _Lanes:
    """The carriageway, searchable."""

    def __init__(self, areas: Sequence[BaseGeometry]) -> None:
        self._areas = list(areas)
        self._tree = shapely.STRtree(self._areas)

    def under(self, footprint: Footprint) -> list[BaseGeometry]:
        """The pieces of carriageway that a footprint covers or touches."""
        found = self._tree.query(footprint.area, predicate="dwithin", distance=_MARGIN_M)
        return [self._areas[i] for i in sorted(found)]


def _clear(footprint: Footprint, lanes: _Lanes, tally: Tally) -> list[Footprint]:
    """The parts of an object that stand beside the carriageway, each as a footprint of its own."""
    under = lanes.under(footprint)
    if footprint.base_m >= HEADROOM_M or not under:
        tally.keep(footprint)
        return _split(footprint, _pieces(footprint.geometry))
    # A line's own width must stay clear too.
    keep_off_m = _MARGIN_M + 1.5 * (footprint.radius_m or 0.0)
    rest = footprint.geometry.difference(shapely.union_all(under).buffer(keep_off_m))
    is_point = isinstance(footprint.geometry, Point)
    pieces = [] if is_point else _pieces(shapely.set_precision(rest, _GRID_M))
    whole = [piece for piece in pieces if _large_enough(piece)]
    tally.slivers += len(pieces) - len(whole)
    if not whole:
        tally.drop(footprint.kind, "on_carriageway")
        return []
    tally.keep(footprint)
    tally.cut[footprint.kind] += 1
    return _split(footprint, whole)


def _split(footprint: Footprint, pieces: Sequence[BaseGeometry]) -> list[Footprint]:
    if len(pieces) == 1:
        return [dataclasses.replace(footprint, geometry=pieces[0])]
    named = ((f"{footprint.name}#{index}", piece) for index, piece in enumerate(pieces, 1))
    return [dataclasses.replace(footprint, geometry=piece, name=name) for name, piece in named]


def _above_traffic(crown: Footprint, lanes: _Lanes, tally: Tally) -> Footprint:
    """Lift the underside of a crown that hangs over the carriageway, as far as the tree is high enough."""
    lifted_m = min(HEADROOM_M, 0.8 * crown.height_m)
    if lifted_m <= crown.base_m or not lanes.under(crown):
        return crown
    tally.raised_crowns += 1
    return dataclasses.replace(crown, base_m=lifted_m)


# --- buildings ------------------------------------------------------------------------------------------------------


def _buildings(extract: Extract, xy: dict[int, XY], tally: Tally) -> Iterator[Footprint]:
    """Outlines and parts; an outline stands only where none of its parts does."""
    shapes = [*_multipolygons(extract, xy, tally), *_rings(extract, xy, tally)]
    parts = [shape for shape in shapes if not _is_outline(shape[1])]
    tree = shapely.STRtree([area for _, _, area in parts])
    for name, tags, area in shapes:
        is_outline = _is_outline(tags)
        over = [parts[i][2] for i in tree.query(area, predicate="intersects")] if is_outline else []
        rest = area.difference(shapely.union_all(over)) if over else area
        whole = _pieces(shapely.set_precision(rest, _GRID_M))
        pieces = [piece for piece in whole if _large_enough(piece)]
        tally.slivers += len(whole) - len(pieces)
        if not pieces:
            tally.drop("building", "covered_by_parts" if over else "degenerate")
            continue
        height_m, base_m, source, kind = _building_height(tags, tally)
        yield Footprint(name, kind, shapely.MultiPolygon(pieces), height_m, source, base_m)


def _is_outline(tags: Tags) -> bool:
    return tags.get("building", "no") not in ("no", "entrance") or tags.get("man_made") in _TOWERS


def _is_building(tags: Tags) -> bool:
    return _is_outline(tags) or tags.get("building:part", "no") != "no"


def _is_underground(tags: Tags, tally: Tally) -> bool:
    under = tags.get("location") == "underground" or tags.get("building") == "underground"
    if under:
        tally.drop("building", "underground")
    return under


def _building_height(tags: Tags, tally: Tally) -> tuple[float, float, str, str]:
    """Top, base, source of the top, kind."""
    kind = "roof" if {tags.get("building"), tags.get("building:part")} & _ROOFS else "building"
    default_m = ROOF_M if kind == "roof" else BUILDING_M
    height_m, source = _top(tags, default_m, tally)
    low_m = _read(tags, "min_height", length_m, tally)
    if low_m is None:
        levels = _read(tags, "building:min_level", number, tally)
        low_m = LEVEL_M * levels if levels is not None else None
    if low_m is None:
        low_m = height_m - ROOF_THICKNESS_M if kind == "roof" else 0.0
    if low_m >= height_m:
        tally.unreadable["base above top"] += 1
        low_m = 0.0
    return height_m, max(0.0, low_m), source, kind


def _top(tags: Tags, default_m: float, tally: Tally) -> tuple[float, str]:
    """Height of the top and where it is from."""
    if height_m := _read(tags, "height", _above_zero, tally):
        return height_m, "height"
    if levels := _read(tags, "building:levels", _levels, tally):
        return LEVEL_M * levels, "levels"
    return default_m, "default"


def _above_zero(text: str) -> float | None:
    return length_m(text) or None


def _levels(text: str) -> float | None:
    levels = number(text)
    return levels if levels is not None and 0 < levels < 300 else None


def _read(tags: Tags, key: str, parse: Callable[[str], float | None], tally: Tally) -> float | None:
    """A tag's value; one that says nothing is counted and treated as absent."""
    if key not in tags:
        return None
    value = parse(tags[key])
    if value is None:
        tally.unreadable[key] += 1
    return value


def _multipolygons(extract: Extract, xy: dict[int, XY], tally: Tally) -> Iterator[tuple[str, Tags, BaseGeometry]]:
    for relation in extract.relations:
        tags = _relation_tags(relation, extract)
        if tags is None or _is_underground(tags, tally):
            continue
        outer = _assembled(relation.ways("outer", ""), extract, xy, tally)
        inner = _assembled(relation.ways("inner"), extract, xy, tally)
        if outer is None or inner is None:
            tally.drop("building", "incomplete")
        else:
            yield f"relation/{relation.id}", tags, outer.difference(inner)


def _relation_tags(relation: Relation, extract: Extract) -> Tags | None:
    """The tags of a building that is a multipolygon; older ones carry them on their only outer way."""
    if relation.tags.get("type") != "multipolygon":
        return None
    if _is_building(relation.tags):
        return relation.tags
    outer = [extract.ways[w] for w in relation.ways("outer", "") if w in extract.ways]
    return outer[0].tags if len(outer) == 1 and _is_building(outer[0].tags) else None


def _assembled(ways: list[int], extract: Extract, xy: dict[int, XY], tally: Tally) -> BaseGeometry | None:
    """The area inside rings that may come in several ways; None when a ring does not close."""
    if any(w not in extract.ways or any(n not in xy for n in extract.ways[w].nodes) for w in ways):
        return None
    closed = [extract.ways[w] for w in ways if extract.ways[w].closed]
    opened = [extract.ways[w] for w in ways if not extract.ways[w].closed and len(extract.ways[w].nodes) > 1]
    areas = [_valid(Polygon([xy[n] for n in way.nodes]), tally) for way in closed]
    if opened:
        lines = shapely.union_all([LineString([xy[n] for n in way.nodes]) for way in opened])
        rings, cuts, dangles, bad = shapely.polygonize_full([lines])
        if not (cuts.is_empty and dangles.is_empty and bad.is_empty):
            return None
        areas.append(shapely.union_all(rings))
    return shapely.union_all(areas)


def _rings(extract: Extract, xy: dict[int, XY], tally: Tally) -> Iterator[tuple[str, Tags, BaseGeometry]]:
    """Buildings that are single closed ways, but not the outer ways of multipolygons."""
    outer = {
        way
        for relation in extract.relations
        if _relation_tags(relation, extract) is not None
        for way in relation.ways("outer", "")
    }
    for way in extract.ways.values():
        if way.id in outer or not _is_building(way.tags) or _is_underground(way.tags, tally):
            continue
        if not way.closed or any(n not in xy for n in way.nodes):
            tally.drop("building", "incomplete")
        else:
            yield f"way/{way.id}", way.tags, _valid(Polygon([xy[n] for n in way.nodes]), tally)


def _valid(polygon: Polygon, tally: Tally) -> BaseGeometry:
    """The polygon, repaired where its outline crosses itself; only its areas are kept."""
    if polygon.is_valid:
        return polygon
    pieces = _pieces(shapely.make_valid(polygon))
    areas = [piece for piece in pieces if isinstance(piece, Polygon)]
    tally.repaired += bool(areas)
    return shapely.union_all(areas)


# --- barriers, poles, trees -----------------------------------------------------------------------------------------


def _barriers(extract: Extract, xy: dict[int, XY], tally: Tally) -> Iterator[Footprint]:
    for way in extract.ways.values():
        value = way.tags.get("barrier")
        if value is None or value == "no":
            continue
        if value not in BARRIERS:
            tally.not_modelled[f"barrier={value}"] += 1
            continue
        height_m, source = _top(way.tags, BARRIERS[value][0], tally)
        radius_m: float | None = BARRIERS[value][1]
        if way.closed and way.tags.get("area") == "yes" and all(n in xy for n in way.nodes):
            area = _valid(Polygon([xy[n] for n in way.nodes]), tally)
            pieces = [p for p in _pieces(shapely.set_precision(area, _GRID_M)) if _large_enough(p)]
            geometry, radius_m = shapely.MultiPolygon(pieces), None
        else:
            geometry = shapely.MultiLineString(_runs(way, xy))
        if geometry.is_empty:
            tally.drop("barrier", "degenerate")
        else:
            yield Footprint(f"way/{way.id}", "barrier", geometry, height_m, source, 0.0, radius_m)


def _runs(way: Way, xy: dict[int, XY]) -> list[LineString]:
    """The way as lines, broken where its nodes lie outside the file."""
    runs = []
    for known, nodes in itertools.groupby(way.nodes, lambda n: n in xy):
        points = [xy[n] for n in nodes] if known else []
        line = shapely.set_precision(LineString(points), _GRID_M) if len(points) > 1 else LineString()
        runs += [piece for piece in _pieces(line) if _large_enough(piece)]
    return runs


def _poles(extract: Extract, xy: dict[int, XY], tally: Tally) -> Iterator[Footprint]:
    for node, tags in extract.node_tags.items():
        known = next((POLES[item] for item in tags.items() if item in POLES), None)
        if known is not None:
            height_m, source = _top(tags, known[0], tally)
            yield Footprint(f"node/{node}", "pole", _rounded(xy[node]), height_m, source, 0.0, known[1])
        elif "barrier" in tags:
            tally.not_modelled[f"barrier={tags['barrier']}"] += 1
        elif tags.get("power") in ("tower", "portal"):
            tally.not_modelled[f"power={tags['power']}"] += 1


def _trees(extract: Extract, xy: dict[int, XY], tally: Tally) -> Iterator[tuple[Footprint, Footprint]]:
    """(trunk, crown) of each tree, mapped one by one or as a row; a row leaves out where a mapped tree stands."""
    single = {n: tags for n, tags in extract.node_tags.items() if tags.get("natural") == "tree"}
    for node, tags in single.items():
        yield _tree(f"node/{node}", _rounded(xy[node]), tags, tally)
    mapped = shapely.MultiPoint([xy[n] for n in single])
    for way in extract.ways.values():
        if way.tags.get("natural") != "tree_row":
            continue
        spots = [p for line in _runs(way, xy) for p in _spots(line)]
        free = [p for p in spots if mapped.is_empty or mapped.distance(p) >= ROW_SPACING_M / 2]
        for _ in range(len(spots) - len(free)):
            tally.drop("tree", "row_tree_mapped_singly")
        for index, point in enumerate(free, 1):
            yield _tree(f"way/{way.id}/{index}", point, way.tags, tally)


def _spots(line: LineString) -> list[Point]:
    count = math.floor(line.length / ROW_SPACING_M + 1e-9)
    points = [line.interpolate(i * ROW_SPACING_M) for i in range(count + 1)]
    return [_rounded((p.x, p.y)) for p in points[: count if line.is_ring and count > 1 else None]]


def _tree(name: str, at: Point, tags: Tags, tally: Tally) -> tuple[Footprint, Footprint]:
    height_m, source = _top(tags, TREE_M, tally)
    girth_m = _read(tags, "circumference", _above_zero, tally)
    crown_m = _read(tags, "diameter_crown", _above_zero, tally)
    trunk_radius_m = min(max(girth_m / (2 * math.pi), 0.05), 1.5) if girth_m else TRUNK_RADIUS_M
    crown_radius_m = min(max(crown_m / 2, 2 * trunk_radius_m), 15.0) if crown_m else CROWN_RADIUS_M
    base_m = CROWN_BASE_SHARE * height_m
    trunk = Footprint(f"{name}/trunk", "tree_trunk", at, base_m, source, 0.0, trunk_radius_m)
    return trunk, Footprint(f"{name}/crown", "tree_crown", at, height_m, source, base_m, crown_radius_m)


# --- geometry -------------------------------------------------------------------------------------------------------


def _rounded(xy: XY) -> Point:
    return Point(round(xy[0], 3), round(xy[1], 3))


def _pieces(geometry: BaseGeometry) -> list[BaseGeometry]:
    """Its polygons, else its lines, else its point; in an order that depends on their places alone."""
    parts = [q for p in shapely.get_parts(geometry) for q in shapely.get_parts(p) if not q.is_empty]
    polygons = [shapely.geometry.polygon.orient(shapely.normalize(p)) for p in parts if isinstance(p, Polygon)]
    lines = [p for p in parts if isinstance(p, LineString)]
    return sorted(polygons or lines or parts, key=lambda p: (p.bounds, p.wkb))


def _large_enough(piece: BaseGeometry) -> bool:
    if isinstance(piece, Polygon):
        return bool(piece.area >= _SLIVER_M2)
    return bool(piece.length >= 0.1)


def _sorted(value: Any) -> Any:
    return {key: _sorted(value[key]) for key in sorted(value)} if isinstance(value, dict) else value
