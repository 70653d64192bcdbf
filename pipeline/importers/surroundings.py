"""Cuts the surroundings of a junction out of an extract, so that its traffic does not depend on the extract's size.

Steps: cut each street where it crosses the circle round the junction, with a new node there; keep the pieces inside; of
those for cars, keep the pieces that hang together with the middle. What is no street (buildings, trees) stays as it is.

Distances are metres on a sphere, in the plane that touches it at the middle: within 1 km of it they differ from those
on the ellipsoid by less than half a percent, and nothing rests on where exactly a street is cut.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

from pipeline.formats.osm import Extract, Way

EARTH_M = 6371008.8
_FOR_FEET = {
    "footway", "path", "cycleway", "steps", "pedestrian", "bridleway", "corridor", "platform", "elevator", "proposed",
    "construction", "via_ferrata",
}  # fmt: skip

XY = tuple[float, float]


class _Circle:
    """A circle on the ground, and the nodes where streets are cut."""

    def __init__(self, extract: Extract, middle: tuple[float, float], radius_m: float) -> None:
        self._nodes, self._middle, self.radius_m = extract.nodes, middle, radius_m
        self._shrink = math.cos(math.radians(middle[0]))
        self._next = max(extract.nodes) + 1
        self.cuts: dict[int, tuple[float, float]] = {}

    def at_m(self, node: int) -> XY:
        lat_deg, lon_deg = self._nodes[node]
        north, east = lat_deg - self._middle[0], lon_deg - self._middle[1]
        return EARTH_M * math.radians(east) * self._shrink, EARTH_M * math.radians(north)

    def holds(self, node: int) -> bool:
        return math.hypot(*self.at_m(node)) <= self.radius_m

    def crossings(self, start: int, end: int) -> list[int]:
        """New nodes where the line between two nodes crosses the circle, in the order of the line."""
        (x0, y0), (x1, y1) = self.at_m(start), self.at_m(end)
        dx, dy = x1 - x0, y1 - y0
        a, b, c = dx * dx + dy * dy, x0 * dx + y0 * dy, x0 * x0 + y0 * y0 - self.radius_m**2
        if a == 0.0 or (root := b * b - a * c) <= 0.0:
            return []
        steps = ((-b + sign * math.sqrt(root)) / a for sign in (-1.0, 1.0))
        return [self._cut(x0 + t * dx, y0 + t * dy) for t in steps if 0.0 < t < 1.0]

    def _cut(self, x_m: float, y_m: float) -> int:
        lat_deg = self._middle[0] + math.degrees(y_m / EARTH_M)
        lon_deg = self._middle[1] + math.degrees(x_m / EARTH_M / self._shrink)
        node, self._next = self._next, self._next + 1
        self.cuts[node] = (round(lat_deg, 7), round(lon_deg, 7))
        return node


def cut_out(extract: Extract, middle: tuple[float, float], radius_m: float) -> Extract:
    """The extract with those pieces of its streets that lie within a radius.

    Parameters
    ----------
    middle
        Latitude, longitude in degrees.
    radius_m
        Where streets end.
    """
    circle = _Circle(extract, middle, radius_m)
    ways: dict[int, Way] = {}
    number = max(extract.ways) + 1
    for way in extract.ways.values():
        if "highway" not in way.tags:
            ways[way.id] = way
            continue
        pieces = sorted((p for p in _pieces(way, circle, extract) if len(p) > 1), key=len, reverse=True)
        for index, nodes in enumerate(pieces):  # the longest keeps the name, which turn restrictions know it by
            name, number = (way.id, number) if index == 0 else (number, number + 1)
            ways[name] = Way(name, nodes, way.tags)
    inside = replace(extract, nodes=extract.nodes | circle.cuts, ways=dict(sorted(ways.items())))
    joined = _joined(inside, circle)
    kept = {name: way for name, way in inside.ways.items() if not _is_road(way) or name in joined}
    return replace(inside, ways=kept)


def _is_road(way: Way) -> bool:
    return way.tags.get("highway", "footway") not in _FOR_FEET


def _pieces(way: Way, circle: _Circle, extract: Extract) -> Iterator[tuple[int, ...]]:
    """The runs of a way's nodes that lie in the circle, each ending on it where the way goes on."""
    nodes = [node for node in way.nodes if node in extract.nodes]
    run = [node for node in nodes[:1] if circle.holds(node)]
    for start, end in pairwise(nodes):
        cuts = circle.crossings(start, end)
        if circle.holds(start) and circle.holds(end):
            run.append(end)
        elif circle.holds(start):
            yield (*run, *cuts[-1:])
            run = []
        elif circle.holds(end):
            run = [*cuts[:1], end]
        elif len(cuts) == 2:
            yield tuple(cuts)
    yield tuple(run)


def _joined(extract: Extract, circle: _Circle) -> set[int]:
    """The roads that hang together with the one that comes nearest to the middle."""
    roads = [way for way in extract.ways.values() if _is_road(way)]
    at_node: dict[int, list[Way]] = {}
    for way in roads:
        for node in way.nodes:
            at_node.setdefault(node, []).append(way)
    known = [node for node in at_node if node in extract.nodes and node not in circle.cuts]
    if not known:
        return {way.id for way in roads}
    reached: set[int] = set()
    todo = list(at_node[min(known, key=lambda node: (math.hypot(*circle.at_m(node)), node))])
    while todo:
        way = todo.pop()
        if way.id not in reached:
            reached.add(way.id)
            todo += [other for node in way.nodes for other in at_node[node] if other.id not in reached]
    return reached
