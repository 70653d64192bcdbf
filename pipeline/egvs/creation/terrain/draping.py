r"""Lay the roads of a flat network on a terrain.

Steps of :func:`drape_network`: sample all shapes every few metres; look up the height of the ground at each point;
refuse a network that leaves the terrain; let bridges and tunnels run straight between their ends; move everything so
that z = 0 is the ground at a given point; keep an inserted point only where the shape would be more than a centimetre
off without it.

The ground is one surface, without the decks of bridges. So an edge on another level (``levels``) is not laid on it: its
height changes linearly along it, from the ground at one end to the ground at the other. Where such edges meet each
other, away from the ground, the heights h of their nodes are those of tight strings between the ends,

.. math:: \sum_j (h_i - h_j) / l_{ij} = 0

over the edges from node i to nodes j of length l. A road map with heights of its own keeps them, see
:func:`level_difference_m`.

World frame, metres. Lengths of lanes stay as they are in the plane: at a grade of 10 % they are 0.5 % short.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from egvs.core import polylines
from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray
from egvs.core.wording import by_number, format_percent, list_first, number_of
from egvs.creation.map_parts import Terrain
from egvs.creation.terrain.network_heights import (
    Replacement,
    ShapeText,
    attribute,
    find_shapes,
    format_point,
    node_of_internal,
    replace_parts,
    sample_line,
)

STEP_M = 5.0
"""Distance of the points at which the ground is looked up."""

TOLERANCE_M = 0.01
"""How far a shape may be above or below the ground between its points."""

_EDGE = re.compile(r"<edge\s[^>]*>")
_LEAST_POINTS = 3
_HINT = "Use a terrain that covers all roads, or a smaller road map."


@dataclass(frozen=True)
class DrapedNetwork:
    """A network on a terrain.

    Attributes
    ----------
    text
        The SUMO network.
    zero_height_m
        Height in the terrain of z = 0.
    notes
        Sentences for the user.
    """

    text: str
    zero_height_m: float
    notes: tuple[str, ...]


def drape_network(
    text: str,
    terrain: Terrain,
    zero_at_m: tuple[float, float],
    levels: Mapping[str, int] | None = None,
    where: object = "the road map",
) -> DrapedNetwork:
    """Lay a network on a terrain.

    Parameters
    ----------
    text
        A network that netconvert wrote. Its heights, if any, are replaced.
    terrain
        The ground.
    zero_at_m
        World-frame x, y of the point where the ground gets z = 0.
    levels
        Levels of edges by id, other than 0, which is the ground: bridges and tunnels.
    where
        The road map, for messages.

    Raises
    ------
    InputError
        When the height of the ground is unknown at that point, or anywhere on the roads.
    """
    zero_height_m = ground_height_m(terrain, zero_at_m, where)
    shapes = list(find_shapes(text))
    samples = [_sample(shape) for shape in shapes]
    heights = _heights(terrain, samples, where)
    graph = _EdgeGraph.from_text(text, shapes, levels or {})
    graph.lift(shapes, samples, heights)

    replacements = [
        _replacement(shape, sample, height - zero_height_m)
        for shape, sample, height in zip(shapes, samples, heights, strict=True)
    ]
    all_heights = np.concatenate(heights) - zero_height_m
    notes = [
        f"Roads follow the terrain, from z = {all_heights.min():.1f} m to {all_heights.max():.1f} m;"
        f" z = 0 is a height of {zero_height_m:.2f} m, the ground at ({zero_at_m[0]:.1f}, {zero_at_m[1]:.1f})."
    ]
    if graph.raised:
        notes.append(
            f"{number_of(len(graph.raised), 'edge')} on bridges or in tunnels"
            f" {by_number(len(graph.raised), 'runs', 'run')} straight between their ends."
        )
    crossings = graph.crossings(shapes)
    if crossings:
        pairs = list_first([f"{one} with {other}" for one, other in crossings], 3)
        notes.append(
            f"In {number_of(len(crossings), 'place')}, roads cross without a junction, but both lie on the ground,"
            " since the map does not"
            f" say which is above: {pairs}."
        )
    return DrapedNetwork(replace_parts(text, replacements), zero_height_m, tuple(notes))


def ground_height_m(terrain: Terrain, at_m: tuple[float, float], where: object) -> float:
    """Return the height of the ground at a point; InputError where it is unknown."""
    height_m = float(terrain.height_m(np.array([at_m]))[0])
    if not np.isfinite(height_m):
        problem = f"the terrain has no height at ({at_m[0]:.1f}, {at_m[1]:.1f})"
        raise InputError(where, problem, "Use a terrain that covers the region of interest.")
    return height_m


def level_difference_m(text: str, terrain: Terrain, where: object = "the road map") -> tuple[float, float]:
    """Return how high the terrain is above the roads of a network with heights of its own.

    Parameters
    ----------
    text
        A network that netconvert wrote.
    terrain
        The ground.
    where
        The road map, for messages.

    Returns
    -------
    median_m : float
        Median of the differences at all points of lanes. Subtracted from heights of the terrain, it gives z.
    spread_m : float
        Median of the absolute differences from it.

    Raises
    ------
    InputError
        When the terrain has heights at fewer than 3 of the points.
    """
    lanes = [shape.points_m for shape in find_shapes(text) if shape.tag == "lane"]
    points_m = np.concatenate(lanes)
    differences = terrain.height_m(points_m[:, :2]) - points_m[:, 2]
    known = differences[np.isfinite(differences)]
    if len(known) < _LEAST_POINTS:
        problem = f"the terrain has heights at {len(known)} of {len(points_m):,} points of the roads"
        raise InputError(where, problem, _HINT)
    median_m = float(np.median(known))
    return median_m, float(np.median(np.abs(known - median_m)))


_LEVEL_DIFFERENCE_M = 3.0
"""Difference of heights above which two roads are at different levels."""


def roads_above_others(text: str) -> tuple[tuple[str, str], ...]:
    """Return the pairs of edges of a network with heights that cross at different levels: the upper one, the lower one.

    Parameters
    ----------
    text
        A network that netconvert wrote.
    """
    shapes = list(find_shapes(text))
    graph = _EdgeGraph.from_text(text, shapes, {})
    lines = {edge: shape.points_m for shape in reversed(shapes) if (edge := _edge_of_lane(shape)) in graph.nodes}
    pairs = []
    for one, other in graph.crossings(shapes):
        at = shapely.LineString(lines[one][:, :2]).intersection(shapely.LineString(lines[other][:, :2]))
        difference_m = _height_at(lines[one], at) - _height_at(lines[other], at)
        if abs(difference_m) > _LEVEL_DIFFERENCE_M:
            pairs.append((one, other) if difference_m > 0 else (other, one))
    return tuple(pairs)


def _height_at(line_m: FloatArray, at: shapely.Geometry) -> float:
    """Return the height of a line (n, 3) at a point near it."""
    line = shapely.LineString(line_m[:, :2])
    return float(np.interp(line.project(shapely.centroid(at)), polylines.stations_m(line_m), line_m[:, 2]))


@dataclass(frozen=True)
class _Sample:
    """Points (n, 2) along a shape, and which of them are points of the shape."""

    xy_m: FloatArray
    is_given: BoolArray


def _sample(shape: ShapeText) -> _Sample:
    """Return points along a shape; outlines and nodes get no points between theirs."""
    given = shape.points_m[:, :2]
    if shape.tag == "junction" or len(given) < 2:
        return _Sample(given, np.ones(len(given), dtype=np.bool_))
    return _Sample(*sample_line(given, STEP_M))


def _heights(terrain: Terrain, samples: Sequence[_Sample], where: object) -> list[FloatArray]:
    """Return the heights of the ground at all points; InputError where any is unknown."""
    points_m = np.concatenate([sample.xy_m for sample in samples])
    heights = terrain.height_m(points_m)
    unknown = np.flatnonzero(~np.isfinite(heights))
    if len(unknown):
        x, y = points_m[unknown[0]]
        problem = (
            f"the terrain has no height at {_share(len(unknown), len(points_m))} points of the roads,"
            f" such as ({x:.1f}, {y:.1f})"
        )
        raise InputError(where, problem, _HINT)
    return np.split(heights, np.cumsum([len(sample.xy_m) for sample in samples])[:-1])


def _share(part: int, total: int) -> str:
    return f"{part:,} of {total:,} ({format_percent(part / total)})"


def _replacement(shape: ShapeText, sample: _Sample, z_m: FloatArray) -> Replacement:
    """Return the text of a shape with heights, and with those inserted points that it needs."""
    if shape.is_node or sample.is_given.all():
        return shape.with_heights(z_m)
    texts = iter(shape.xy_text)
    given_m = iter(z_m[sample.is_given])
    points = []
    for index in _needed(sample, z_m):
        if sample.is_given[index]:
            points.append(f"{next(texts)},{round(float(next(given_m)), 3) + 0.0:.3f}")
        else:
            x, y = sample.xy_m[index]
            points.append(format_point(x, y, z_m[index]))
    return Replacement(shape.start, shape.end, " ".join(points))


def _needed(sample: _Sample, z_m: FloatArray) -> list[int]:
    """Return the given points, and inserted ones without which heights between them would be off (Douglas-Peucker)."""
    steps = np.hypot(*np.diff(sample.xy_m, axis=0).T)
    along_m = np.concatenate([[0.0], np.cumsum(steps)])
    given = np.flatnonzero(sample.is_given)
    needed = set(given.tolist())
    spans = list(zip(given[:-1].tolist(), given[1:].tolist(), strict=True))
    while spans:
        first, last = spans.pop()
        if last - first < 2:
            continue
        inside = slice(first + 1, last)
        line_m = np.interp(along_m[inside], along_m[[first, last]], z_m[[first, last]])
        off_m = np.abs(z_m[inside] - line_m)
        if off_m.max() > TOLERANCE_M:
            middle = first + 1 + int(off_m.argmax())
            needed.add(middle)
            spans += [(first, middle), (middle, last)]
    return sorted(needed)


@dataclass(frozen=True)
class _EdgeGraph:
    """The edges of a network between their nodes.

    Attributes
    ----------
    nodes
        Start and end of each edge.
    lengths_m
        Length of each edge's first lane.
    raised
        Edges on another level than the ground.
    """

    nodes: Mapping[str, tuple[str, str]]
    lengths_m: Mapping[str, float]
    raised: frozenset[str]

    @classmethod
    def from_text(cls, text: str, shapes: Sequence[ShapeText], levels: Mapping[str, int]) -> _EdgeGraph:
        nodes = {}
        for element in _EDGE.findall(text):
            if not attribute(element, "function"):
                nodes[attribute(element, "id")] = attribute(element, "from"), attribute(element, "to")
        lengths_m: dict[str, float] = {}
        for shape in shapes:
            edge = _edge_of_lane(shape)
            if edge in nodes:
                lengths_m.setdefault(edge, max(polylines.length_m(shape.points_m), 0.1))
        raised = frozenset(edge for edge in nodes if levels.get(edge, 0))
        return cls(nodes, lengths_m, raised)

    def lift(self, shapes: Sequence[ShapeText], samples: Sequence[_Sample], heights: list[FloatArray]) -> None:
        """Replace the heights of edges on other levels, and of the junctions between them."""
        if not self.raised:
            return
        node_heights = self._node_heights(shapes, heights)
        for number, shape in enumerate(shapes):
            node = node_of_internal(shape.id) or (shape.id if shape.tag == "junction" else "")
            edge = shape.id if shape.tag == "edge" else _edge_of_lane(shape)
            if node in node_heights:
                heights[number] = np.full(len(heights[number]), node_heights[node])
            elif edge in self.raised:
                start, end = self.nodes[edge]
                ends = node_heights.get(start, heights[number][0]), node_heights.get(end, heights[number][-1])
                steps = np.hypot(*np.diff(samples[number].xy_m, axis=0).T)
                along_m = np.concatenate([[0.0], np.cumsum(steps)])
                heights[number] = np.interp(along_m, along_m[[0, -1]], ends)

    def crossings(self, shapes: Sequence[ShapeText]) -> list[tuple[str, str]]:
        """Return pairs of edges on the ground that cross without a common node."""
        lines: dict[str, shapely.LineString] = {}
        for shape in shapes:
            edge = _edge_of_lane(shape)
            if edge in self.nodes and edge not in self.raised and edge not in lines and len(shape.points_m) > 1:
                lines[edge] = shapely.LineString(shape.points_m[:, :2])
        names = list(lines)
        first, second = shapely.STRtree(list(lines.values())).query(list(lines.values()), predicate="crosses")
        pairs = []
        for one, other in zip(first.tolist(), second.tolist(), strict=True):
            edges = names[one], names[other]
            if one < other and not {*self.nodes[edges[0]]} & {*self.nodes[edges[1]]}:
                pairs.append(edges)
        return pairs

    def _node_heights(self, shapes: Sequence[ShapeText], heights: Sequence[FloatArray]) -> dict[str, float]:
        """Return the heights of the nodes at which only edges on other levels meet."""
        ground_nodes = {node for edge, ends in self.nodes.items() if edge not in self.raised for node in ends}
        raised_nodes = {node for edge in self.raised for node in self.nodes[edge]}
        ends = _dead_ends(self.nodes[edge] for edge in self.raised)
        free = sorted(raised_nodes - ground_nodes - ends)
        index = {node: number for number, node in enumerate(free)}
        terrain_heights = {
            shape.id: float(height[0]) for shape, height in zip(shapes, heights, strict=True) if shape.is_node
        }
        matrix, values = np.zeros((len(free), len(free))), np.zeros(len(free))
        for edge in sorted(self.raised):
            weight = 1.0 / self.lengths_m[edge]
            start, end = self.nodes[edge]
            for node, other in ((start, end), (end, start)):
                if node not in index:
                    continue
                matrix[index[node], index[node]] += weight
                if other in index:
                    matrix[index[node], index[other]] -= weight
                else:
                    values[index[node]] += weight * terrain_heights[other]
        solution = np.linalg.lstsq(matrix, values, rcond=None)[0] if free else values
        return dict(zip(free, map(float, solution), strict=True))


def _dead_ends(edges: Iterator[tuple[str, str]]) -> set[str]:
    """Return the nodes with a single neighbour: they are on the ground, since nothing else holds the edge."""
    neighbours: dict[str, set[str]] = {}
    for start, end in edges:
        neighbours.setdefault(start, set()).add(end)
        neighbours.setdefault(end, set()).add(start)
    return {node for node, others in neighbours.items() if len(others) == 1}


def _edge_of_lane(shape: ShapeText) -> str:
    return shape.id.rpartition("_")[0] if shape.tag == "lane" else ""
