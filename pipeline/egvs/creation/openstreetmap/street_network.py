"""Turn the streets of an OpenStreetMap extract into a SUMO network: all of them, or those around a junction.

Streets are cut around a junction so that its traffic does not depend on the size of the extract. Steps of
:func:`cut_surroundings`: cut each street where it crosses a circle around the junction, with a new node there; keep the
pieces inside; of the roads for cars, keep those connected to the middle. Objects other than streets stay unchanged.

Distances are metres on a sphere, in the tangent plane at the middle. Within 1 km of it they differ by less than half a
percent from those on the ellipsoid; the exact point where a street is cut does not matter.

Frame of a network: its own x, y in metres. The text of a network contains neither dates nor paths.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from shapely.geometry import LineString
from shapely.geometry.base import BaseGeometry

from egvs.core import files
from egvs.core.errors import InputError, RunError
from egvs.core.grid import XY
from egvs.creation import junctions
from egvs.creation.junctions import StreetJunction, Streets
from egvs.creation.openstreetmap import ATTRIBUTION, EARTH_M, node_positions, street_turns
from egvs.creation.openstreetmap.restrictions import is_restriction, restrictions_of_pieces
from egvs.creation.openstreetmap.street_signals import number_crossings, signals_at_stop_lines, without_signal
from egvs.creation.plain_network import NETWORK_FILE
from egvs.formats.osm import Bounds, OsmExtract, Way, parse_number
from egvs.traffic import sumo
from egvs.traffic.assumed_plans import assumed_plan
from egvs.traffic.network import Location, Network
from egvs.traffic.signal_plans import make_program
from egvs.traffic.signals import read_signals, replace_programs

NETCONVERT_FLAGS = (
    "--geometry.remove", "--junctions.join", "--tls.default-type", "actuated", "--default.connection.cont-pos", "0",
    "--keep-edges.by-vclass", "passenger,bus,truck", "--remove-edges.isolated",
    "--output.street-names", "--precision", "3",
    "--no-turnarounds.except-deadend", "--junctions.right-before-left.speed-threshold", "0",
)  # fmt: skip
"""How netconvert makes a network of streets.

The last two prevent locks: vehicles turn back at dead ends only, since one that waits for a gap to turn back on a busy
street blocks all behind it; and a minor street gives way by a sign, since four vehicles that give way to each other
from the right wait forever.
"""

REPAIR_FLAGS = (
    "--tls.rebuild", "--tls.default-type", "actuated", "--default.connection.cont-pos", "0",
    "--no-turnarounds.except-deadend", "--junctions.right-before-left.speed-threshold", "0",
    "--offset.disable-normalization", "--output.street-names", "--precision", "3", street_turns.ORIGINAL_NAMES_FLAG,
)  # fmt: skip
"""How netconvert reads and writes a network whose turns are repaired: all other parts stay the same."""

SIDEWALK_FLAGS = ("--sidewalks.guess", "--sidewalks.guess.max-speed", "28", "--crossings.guess")
"""Sidewalks, walking areas at their corners, and crossings between these.

The limit is 28 m/s instead of 13.89 m/s: netconvert assumes up to that speed on a main street without ``maxspeed``, but
more on a motorway.
"""

PATH_HIGHWAYS = {
    "footway", "path", "cycleway", "steps", "pedestrian", "bridleway", "corridor", "platform", "elevator", "proposed",
    "construction", "via_ferrata",
}  # fmt: skip
"""Values of ``highway`` that are no roads for vehicles."""

_NET_OFFSET = re.compile(r'netOffset="[^"]*"')
_NOTHING_LOADED = re.compile(r"No (nodes|edges) loaded|has no road")


def netconvert_flags(extract: OsmExtract, *, lefthand: bool, walk: bool) -> list[str]:
    """Return netconvert's flags for an extract.

    Parameters
    ----------
    extract
        The map.
    lefthand
        Whether traffic drives on the left.
    walk
        Whether the network gets sidewalks and crossings.
    """
    flags = [*NETCONVERT_FLAGS]
    if extract.declared:
        # keep streets that reach beyond the bounds, drop those completely outside
        b = extract.bounds
        flags += ["--keep-edges.in-geo-boundary", f"{b.west_deg!r},{b.south_deg!r},{b.east_deg!r},{b.north_deg!r}"]
    if lefthand:
        flags.append("--lefthand")
    if walk:
        flags += SIDEWALK_FLAGS
    return flags


class StreetNetwork(NamedTuple):
    """A SUMO network of streets.

    Attributes
    ----------
    text
        The network.
    streets
        The same network, read.
    notes
        Sentences for the user about its turns, and what the map does not state.
    """

    text: str
    streets: Streets
    notes: tuple[str, ...]


def build_network(
    extract: OsmExtract, osm: Path, flags: Sequence[str], frame: Location | None = None, radius_m: float | None = None
) -> StreetNetwork:
    """Run netconvert on the streets of an extract, and repair its turns.

    Parameters
    ----------
    extract
        The map.
    osm
        Its file, for messages.
    flags
        Flags of netconvert.
    frame
        The frame of the network; by default, netconvert chooses one.
    radius_m
        Distance at which the streets of a larger extract were cut, for messages.

    Raises
    ------
    InputError
        When the extract has no drivable streets, or netconvert rejects them.
    """
    no_streets = InputError(
        osm,
        "the extract has no drivable streets that meet",
        "Choose an extract with streets for cars (ways with highway=...).",
    )
    if radius_m is not None:
        problem = f"no streets for cars meet within {radius_m:g} m of the junction"
        no_streets = InputError(osm, problem, "Use larger --surroundings, or choose another junction with --at.")
    if not any("highway" in way.tags for way in extract.ways.values()):
        raise no_streets

    with files.temporary_folder() as folder:
        roads = [way.id for way in extract.ways.values() if is_road(way)]
        at_stop_lines = signals_at_stop_lines(extract, roads, walk=SIDEWALK_FLAGS[0] in flags)
        _write_streets(extract, folder / "streets.osm.xml", at_stop_lines)
        try:
            arguments = ["--osm-files", "streets.osm.xml", *flags, *_frame_flags(frame)]
            sumo.run_netconvert([*arguments, street_turns.ORIGINAL_NAMES_FLAG], folder, NETWORK_FILE)
            lefthand = "--lefthand" in arguments
            notes = street_turns.repair_turns(extract, folder, NETWORK_FILE, REPAIR_FLAGS, lefthand=lefthand)
            text = street_turns.strip_origins((folder / NETWORK_FILE).read_text(encoding="utf-8"))
            files.write_text(folder / NETWORK_FILE, number_crossings(text))
            if frame is not None:
                _state_offset(folder / NETWORK_FILE, frame)
            streets = junctions.read_streets(folder / NETWORK_FILE)
            _plan_signals(folder / NETWORK_FILE, streets.network)
        except (RunError, InputError) as error:
            if _NOTHING_LOADED.search(str(error)):
                raise no_streets from None
            if isinstance(error, sumo.SumoInputError):
                raise error.for_input(osm, "netconvert cannot use the streets", "Choose another extract.") from None
            if isinstance(error, InputError):
                raise junctions.unusable_network(error, folder, osm) from None
            raise
        text = (folder / NETWORK_FILE).read_text(encoding="utf-8")

    # the first comment of netconvert contains the date and paths
    text = re.sub(r"<!-- generated on .*?-->", f"<!-- {ATTRIBUTION} -->", text, count=1, flags=re.DOTALL)
    return StreetNetwork(text, streets, notes)


def _plan_signals(path: Path, network: Network) -> None:
    """Replace the programs of all signals in a network by assumed plans (:mod:`egvs.traffic.assumed_plans`)."""
    programs = {
        signal.id: make_program(assumed_plan(signal), signal, f"{path}: {signal.title}")
        for signal in read_signals(path, network)
    }
    files.write_text(path, replace_programs(path.read_text(encoding="utf-8"), programs))


def crop_network(
    extract: OsmExtract, osm: Path, flags: Sequence[str], streets: Streets, junction: StreetJunction, radius_m: float
) -> StreetNetwork:
    """Build the network around a junction, in the frame of the complete network.

    Parameters
    ----------
    extract, osm, flags
        As for :func:`build_network`.
    streets
        The complete network.
    junction
        The junction in the middle.
    radius_m
        Distance at which streets end.
    """
    location = streets.network.location
    assert location is not None, "netconvert writes a location"

    ((lon_deg, lat_deg),) = streets.to_degrees([junction.at_m])
    surroundings = cut_surroundings(extract, (lat_deg, lon_deg), radius_m)
    return build_network(surroundings, osm, flags, location, radius_m)


def _frame_flags(frame: Location | None) -> list[str]:
    if frame is None:
        return []
    east_m, north_m = frame.offset_m
    return [
        "--proj", frame.projection, "--offset.disable-normalization",
        "--offset.x", f"{east_m!r}", "--offset.y", f"{north_m!r}",
    ]  # fmt: skip


def _state_offset(path: Path, frame: Location) -> None:
    """Write the offset of a frame into a network: for left-hand traffic, netconvert negates that of y."""
    east_m, north_m = frame.offset_m
    text = path.read_text(encoding="utf-8")
    files.write_text(path, _NET_OFFSET.sub(f'netOffset="{east_m:.3f},{north_m:.3f}"', text, count=1))


def cut_surroundings(extract: OsmExtract, middle: tuple[float, float], radius_m: float) -> OsmExtract:
    """Return the extract with only those pieces of streets that are within a radius.

    Parameters
    ----------
    extract
        The map.
    middle
        Latitude, longitude in degrees.
    radius_m
        Distance at which streets end.

    Returns
    -------
    OsmExtract
        With all other objects unchanged, and a new node wherever a street was cut.
    """
    circle = _Circle(extract, middle, radius_m)
    ways: dict[int, Way] = {}
    cut: dict[int, Collection[Way]] = {}
    next_id = max(extract.ways) + 1
    for way in extract.ways.values():
        if "highway" not in way.tags:
            ways[way.id] = way
            continue
        pieces = _pieces_as_ways(way, _pieces_inside(way, circle, extract), next_id)
        next_id += max(0, len(pieces) - 1)
        ways |= pieces
        cut[way.id] = pieces.values()

    node_tags = dict(sorted((extract.node_tags | circle.cut_tags).items()))
    inside = replace(
        extract,
        nodes=extract.nodes | circle.cuts,
        node_tags=node_tags,
        ways=dict(sorted(ways.items())),
        relations=restrictions_of_pieces(extract.relations, cut, extract.ways),
    )
    connected = _connected_roads(inside, circle)
    return replace(inside, ways={i: way for i, way in inside.ways.items() if i in connected or not is_road(way)})


def drop_far_streets(extract: OsmExtract, middle: tuple[float, float], distance_m: float) -> OsmExtract:
    """Return the extract without the streets that are completely farther away than a distance.

    Parameters
    ----------
    extract
        The map.
    middle
        Latitude, longitude in degrees.
    distance_m
        Half the side of a square around the middle; streets whose bounding box meets it stay. All stay if it is inf.
    """
    if math.isinf(distance_m):
        return extract
    lat_deg, lon_deg = middle
    north_deg = math.degrees(distance_m / EARTH_M)
    east_deg = north_deg / math.cos(math.radians(lat_deg))
    area = Bounds(lat_deg - north_deg, lon_deg - east_deg, lat_deg + north_deg, lon_deg + east_deg)
    far = {way.id for way in extract.ways.values() if "highway" in way.tags and not extract.is_near(way, area)}
    relations = tuple(
        relation
        for relation in extract.relations
        if not (
            is_restriction(relation) and any(member.type == "way" and member.id in far for member in relation.members)
        )
    )
    return replace(
        extract, ways={number: way for number, way in extract.ways.items() if number not in far}, relations=relations
    )


def cut_out_roads(extract: OsmExtract, streets: Streets, roads: Sequence[Way], region: BaseGeometry) -> OsmExtract:
    """Return the extract without those segments of some roads that touch a region.

    Parameters
    ----------
    extract
        The map.
    streets
        Its network, for the frame of the region.
    roads
        The roads to cut.
    region
        World frame, metres.
    """
    xy = node_positions(extract, streets, {node for road in roads for node in road.nodes})
    ways = dict(extract.ways)
    cut: dict[int, Collection[Way]] = {}
    next_id = max(ways) + 1
    for road in roads:
        del ways[road.id]
        pieces = _pieces_as_ways(road, _pieces_outside(road, xy, region), next_id)
        next_id += max(0, len(pieces) - 1)
        ways |= pieces
        cut[road.id] = pieces.values()
    relations = restrictions_of_pieces(extract.relations, cut, extract.ways)
    return replace(extract, ways=dict(sorted(ways.items())), relations=relations)


def _pieces_outside(way: Way, xy: Mapping[int, XY], region: BaseGeometry) -> Iterator[tuple[int, ...]]:
    """Yield the runs of a way's nodes whose segments do not touch a region."""
    nodes = [node for node in way.nodes if node in xy]
    piece = nodes[:1]
    for start, end in pairwise(nodes):
        if LineString([xy[start], xy[end]]).intersects(region):
            yield tuple(piece)
            piece = []
        piece.append(end)
    yield tuple(piece)


def _pieces_as_ways(way: Way, pieces: Iterable[tuple[int, ...]], next_id: int) -> dict[int, Way]:
    """Make ways of the pieces of a way that have at least two nodes.

    The longest keeps the identifier; the others are numbered from ``next_id``.
    """
    longest_first = sorted((piece for piece in pieces if len(piece) > 1), key=len, reverse=True)
    ids = [way.id, *range(next_id, next_id + len(longest_first))]
    return {way_id: Way(way_id, nodes, way.tags) for way_id, nodes in zip(ids, longest_first, strict=False)}


class _Circle:
    """A circle on the ground, and the nodes where streets are cut."""

    def __init__(self, extract: OsmExtract, middle: tuple[float, float], radius_m: float) -> None:
        self._nodes = extract.nodes
        self._lat_deg, self._lon_deg = middle
        self._radius_m = radius_m
        self._shrink = math.cos(math.radians(self._lat_deg))
        self._next_id = max(extract.nodes) + 1
        self.cuts: dict[int, tuple[float, float]] = {}
        self.cut_tags: dict[int, dict[str, str]] = {}
        self._tags = extract.node_tags

    def at_m(self, node: int) -> XY:
        """Metres east and north of the middle."""
        lat_deg, lon_deg = self._nodes[node]
        east_deg, north_deg = lon_deg - self._lon_deg, lat_deg - self._lat_deg
        return EARTH_M * math.radians(east_deg) * self._shrink, EARTH_M * math.radians(north_deg)

    def contains(self, node: int) -> bool:
        return math.hypot(*self.at_m(node)) <= self._radius_m

    def crossings(self, start: int, end: int) -> list[int]:
        """Make new nodes where the line between two nodes crosses the circle, in the order of the line."""
        x0, y0 = self.at_m(start)
        x1, y1 = self.at_m(end)
        dx, dy = x1 - x0, y1 - y0

        # |start + t (end - start)|^2 = radius^2 is a t^2 + 2 b t + c = 0
        a = dx * dx + dy * dy
        b = x0 * dx + y0 * dy
        c = x0 * x0 + y0 * y0 - self._radius_m**2
        discriminant = b * b - a * c
        if a == 0.0 or discriminant <= 0.0:
            return []

        nodes = []
        for sign in (-1.0, 1.0):
            t = (-b + sign * math.sqrt(discriminant)) / a
            if 0.0 < t < 1.0:
                node = self._add_cut(x0 + t * dx, y0 + t * dy)
                self._interpolate_height(node, start, end, t)
                nodes.append(node)
        return nodes

    def _interpolate_height(self, node: int, start: int, end: int, t: float) -> None:
        """Give a new node a height (``ele``) if both of its neighbours have one."""
        heights_m = [parse_number(self._tags.get(neighbour, {}).get("ele", "")) for neighbour in (start, end)]
        before_m, after_m = heights_m
        if before_m is not None and after_m is not None:
            self.cut_tags[node] = {"ele": f"{before_m + t * (after_m - before_m):.3f}"}

    def _add_cut(self, x_m: float, y_m: float) -> int:
        lat_deg = self._lat_deg + math.degrees(y_m / EARTH_M)
        lon_deg = self._lon_deg + math.degrees(x_m / EARTH_M / self._shrink)
        node = self._next_id
        self._next_id += 1
        self.cuts[node] = (round(lat_deg, 7), round(lon_deg, 7))
        return node


def _pieces_inside(way: Way, circle: _Circle, extract: OsmExtract) -> Iterator[tuple[int, ...]]:
    """Yield the runs of a way's nodes inside the circle, each ending on it where the way goes on."""
    nodes = [node for node in way.nodes if node in extract.nodes]
    piece = [node for node in nodes[:1] if circle.contains(node)]
    for start, end in pairwise(nodes):
        cuts = circle.crossings(start, end)
        starts_inside, ends_inside = circle.contains(start), circle.contains(end)
        if starts_inside and ends_inside:
            piece.append(end)
        elif starts_inside:
            yield (*piece, *cuts[-1:])
            piece = []
        elif ends_inside:
            piece = [*cuts[:1], end]
        elif len(cuts) == 2:
            yield tuple(cuts)
    yield tuple(piece)


def is_road(way: Way) -> bool:
    """Return whether a way is a road for vehicles."""
    return way.tags.get("highway", "footway") not in PATH_HIGHWAYS


def _connected_roads(extract: OsmExtract, circle: _Circle) -> set[int]:
    """Return the ids of the roads connected to the one nearest to the middle."""
    roads = [way for way in extract.ways.values() if is_road(way)]
    roads_at_node: dict[int, list[Way]] = {}
    for way in roads:
        for node in way.nodes:
            roads_at_node.setdefault(node, []).append(way)

    mapped = [node for node in roads_at_node if node in extract.nodes and node not in circle.cuts]
    if not mapped:
        return {way.id for way in roads}

    nearest = min(mapped, key=lambda node: (math.hypot(*circle.at_m(node)), node))
    reached: set[int] = set()
    queue = list(roads_at_node[nearest])
    while queue:
        way = queue.pop()
        if way.id in reached:
            continue
        reached.add(way.id)
        for node in way.nodes:
            queue += roads_at_node[node]
    return reached


def _write_streets(extract: OsmExtract, xml: Path, at_stop_lines: Collection[int]) -> None:
    """Write the streets (ways with ``highway``), their nodes, and the turn restrictions as an OpenStreetMap file.

    Some nodes are written without their signals.
    """
    import osmium
    from osmium.osm import mutable

    streets = [way for way in extract.ways.values() if "highway" in way.tags]
    with osmium.SimpleWriter(osmium.io.File(xml, "osm")) as writer:
        for node in sorted({n for way in streets for n in way.nodes if n in extract.nodes}):
            lat_deg, lon_deg = extract.nodes[node]
            node_tags = extract.node_tags.get(node, {})
            if node in at_stop_lines:
                node_tags = without_signal(node_tags)
            writer.add_node(mutable.Node(id=node, location=(lon_deg, lat_deg), tags=sorted(node_tags.items())))
        for way in streets:
            nodes = [n for n in way.nodes if n in extract.nodes]
            name = {"name": way.tags["ref"]} if "ref" in way.tags else {}  # the only name of many main roads
            writer.add_way(mutable.Way(id=way.id, nodes=nodes, tags=sorted((name | way.tags).items())))
        for relation in extract.relations:
            if is_restriction(relation):
                members = [(member.type[0], member.id, member.role) for member in relation.members]
                tags = sorted(relation.tags.items())
                writer.add_relation(mutable.Relation(id=relation.id, members=members, tags=tags))
