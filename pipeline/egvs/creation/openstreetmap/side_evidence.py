"""What an OpenStreetMap map tells about the side of traffic.

Traffic drives around a roundabout counter-clockwise where it drives on the right. Ways are drawn in driving direction
there. ``driving_side`` is a tag of countries and regions, and of single streets that are an exception.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

from egvs.core.wording import by_number, list_first, number_of
from egvs.creation.driving_side import DrivingSide, Evidence, choose_side, majority, side_at
from egvs.formats.osm import OsmExtract, Way

_RINGS = ("roundabout", "circular")
_AGAINST = ("-1", "reverse")
_TURNS = {"clockwise": True, "anticlockwise": False, "anti_clockwise": False, "counterclockwise": False}
_LISTED = 3


def choose_map_side(
    extract: OsmExtract, lefthand: bool | None, at: tuple[float, float] | None, where: str
) -> DrivingSide:
    """Decide on which side traffic drives; see :func:`egvs.creation.driving_side.choose_side`.

    Parameters
    ----------
    extract
        The map.
    lefthand
        What the user says; None for nothing.
    at
        Latitude, longitude in degrees of the junction; the middle of the map if None.
    where
        The file, for messages.
    """
    bounds = extract.bounds
    middle = (bounds.south_deg + bounds.north_deg) / 2, (bounds.west_deg + bounds.east_deg) / 2
    return choose_side(lefthand, side_evidence(extract), side_at(*(at or middle)), where)


def side_evidence(extract: OsmExtract) -> list[Evidence]:
    """Return what a map tells about the side of traffic."""
    return [evidence for evidence in (_of_rings(extract), _of_tags(extract)) if evidence is not None]


def _of_rings(extract: OsmExtract) -> Evidence | None:
    """Return what roundabouts tell, drawn as ways or nodes."""
    names: dict[bool, list[str]] = {True: [], False: []}
    for ways in _rings(extract):
        nodes = [node for way in ways for node in (way.nodes[::-1] if _is_reversed(way) else way.nodes)]
        title = next((way.tags["name"] for way in ways if "name" in way.tags), f"way {ways[0].id}")
        names[_area(nodes, extract) < 0].append(title)
    for node, tags in extract.node_tags.items():
        clockwise = _TURNS.get(tags.get("direction", ""))
        if tags.get("highway") == "mini_roundabout" and clockwise is not None:
            names[clockwise].append(f"node {node}")
    reasons = [
        f"{by_number(len(rings), 'the one-way ring', number_of(len(rings), 'one-way ring'))}"
        f" ({list_first(sorted(rings), _LISTED)}) {by_number(len(rings), 'runs', 'run')} {direction}"
        for rings, direction in ((names[True], "clockwise"), (names[False], "counter-clockwise"))
    ]
    return majority(len(names[True]), len(names[False]), (reasons[0], reasons[1]))


def _rings(extract: OsmExtract) -> Iterator[list[Way]]:
    """Yield the ways of each closed roundabout, in driving direction."""
    following: dict[int, Way] = {}
    for way in extract.ways.values():
        is_ring = way.tags.get("junction") in _RINGS and "highway" in way.tags and way.tags.get("oneway") != "no"
        if is_ring and len(way.nodes) > 1:
            following[_ends(way)[0]] = way
    while following:
        way = following.pop(next(iter(following)))
        ring = [way]
        while _ends(ring[-1])[1] in following:
            ring.append(following.pop(_ends(ring[-1])[1]))
        if _ends(ring[-1])[1] == _ends(ring[0])[0]:
            yield ring


def _is_reversed(way: Way) -> bool:
    return way.tags.get("oneway") in _AGAINST


def _ends(way: Way) -> tuple[int, int]:
    """Return the nodes where traffic enters and leaves a way."""
    return (way.nodes[-1], way.nodes[0]) if _is_reversed(way) else (way.nodes[0], way.nodes[-1])


def _area(nodes: Sequence[int], extract: OsmExtract) -> float:
    """Return the area of a ring, positive if it runs counter-clockwise; only the sign counts."""
    points = [extract.nodes[node] for node in nodes if node in extract.nodes]
    before = [*points[-1:], *points[:-1]]
    return sum(lon0 * lat1 - lon1 * lat0 for (lat0, lon0), (lat1, lon1) in zip(before, points, strict=True))


def _of_tags(extract: OsmExtract) -> Evidence | None:
    """Return what ``driving_side`` of regions tells, or of most streets."""
    regions = Counter(
        relation.tags["driving_side"] for relation in extract.relations if "driving_side" in relation.tags
    )  # fmt: skip
    streets = [way.tags.get("driving_side") for way in extract.ways.values() if "highway" in way.tags]
    tagged = Counter(side for side in streets if side)
    counts = regions or (tagged if 2 * tagged.total() > len(streets) else Counter[str | None]())
    return majority(counts["left"], counts["right"], ("driving_side is left", "driving_side is right"))


def exceptions_note(extract: OsmExtract, *, lefthand: bool) -> tuple[str, ...]:
    """Return a sentence on streets that are an exception; a network has one side."""
    other = "right" if lefthand else "left"
    ways = [way for way in extract.ways.values() if "highway" in way.tags and way.tags.get("driving_side") == other]
    if not ways:
        return ()
    titles = list_first(sorted({way.tags.get("name", f"way {way.id}") for way in ways}), _LISTED)
    return (
        f"On {number_of(len(ways), 'street')} of the map, traffic drives on the {other} (driving_side); in the network"
        f" it drives on one side only: {titles}.",
    )
