"""Read and change the heights in the text of a SUMO network: of edges, lanes and junctions.

The text is that of a file that netconvert wrote. Only heights change, and points that are added to shapes; everything
else, such as lengths and the digits of x and y, stays as it is. World frame, metres.
"""

from __future__ import annotations

import html
import itertools
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray
from egvs.scenario.fields import parse_coordinate_m

_TAG = re.compile(r"<(edge|lane|junction)\s[^>]*>")
_SHAPE = re.compile(r'\s(?:shape|outlineShape)="([^"]*)"')
_NODE = re.compile(r'\sx="([^"]*)"\s+y="([^"]*)"(\s+z="[^"]*")?')
_HINT = "Use a network that netconvert wrote."


class Replacement(NamedTuple):
    """A part of a text, from ``start`` to ``end``, and what takes its place."""

    start: int
    end: int
    text: str


@dataclass(frozen=True)
class ShapeText:
    """A shape in the text of a network, or the position of a node.

    Attributes
    ----------
    tag, id
        Its element.
    start, end
        Where its text is.
    xy_text
        x and y of each point, as text.
    points_m
        (n, 3) float64; z is 0 where the text has none.
    is_node
        Whether it is the position of a node.
    """

    tag: str
    id: str
    start: int
    end: int
    xy_text: tuple[str, ...]
    points_m: FloatArray
    is_node: bool

    def with_heights(self, z_m: FloatArray) -> Replacement:
        """Return the text with other heights (n,)."""
        if self.is_node:
            x, y = self.xy_text[0].split(",")
            return Replacement(self.start, self.end, f' x="{x}" y="{y}" z="{_format_m(z_m[0])}"')
        points = zip(self.xy_text, z_m, strict=True)
        return Replacement(self.start, self.end, " ".join(f"{xy},{_format_m(z)}" for xy, z in points))


def find_shapes(text: str) -> Iterator[ShapeText]:
    """Yield all shapes of edges, lanes and junctions, and the positions of nodes, in the order of the text.

    Raises
    ------
    InputError
        When a coordinate is not a number.
    """
    for tag in _TAG.finditer(text):
        element = tag[0]
        name = attribute(element, "id")
        for shape in _SHAPE.finditer(element):
            parts = [point.split(",") for point in shape[1].split()]
            yield _shape_text(tag[1], name, tag.start() + shape.start(1), shape[1], parts, is_node=False)
        node = _NODE.search(element) if tag[1] == "junction" else None
        if node is not None:
            height = re.sub(r'.*"([^"]*)"', r"\1", node[3]) if node[3] else "0"
            parts = [[node[1], node[2], height]]
            yield _shape_text(tag[1], name, tag.start() + node.start(), node[0], parts, is_node=True)


def replace_parts(text: str, replacements: Iterable[Replacement]) -> str:
    """Return a text with some parts replaced, which do not overlap."""
    pieces = []
    position = 0
    for replacement in sorted(replacements):
        pieces += [text[position : replacement.start], replacement.text]
        position = replacement.end
    return "".join([*pieces, text[position:]])


def shift_heights(text: str, height_m: float) -> str:
    """Return the text of a network in which all heights are greater by ``height_m``."""
    return replace_parts(text, (shape.with_heights(shape.points_m[:, 2] + height_m) for shape in find_shapes(text)))


def attribute(element: str, name: str) -> str:
    """Return an attribute in the text of an element; empty if it has none."""
    match = re.search(rf'\s{name}="([^"]*)"', element)
    return html.unescape(match[1]) if match else ""


def sample_line(points_m: FloatArray, step_m: float) -> tuple[FloatArray, BoolArray]:
    """Insert points into a line so that none are farther apart than a step.

    Parameters
    ----------
    points_m
        (n, 2) or (n, 3) float64.
    step_m
        Largest distance in the plane.

    Returns
    -------
    points_m : ndarray of float64
        (m, 2) or (m, 3).
    is_given : ndarray of bool
        (m,): which of them are points of the line.
    """
    pieces, is_given = [points_m[:1]], [np.array([True])]
    for start, end in itertools.pairwise(points_m):
        steps = max(1, int(np.ceil(np.hypot(*(end - start)[:2]) / step_m)))
        pieces.append(start + (end - start) * (np.arange(1, steps + 1) / steps)[:, None])
        is_given.append(np.arange(1, steps + 1) == steps)
    return np.concatenate(pieces), np.concatenate(is_given)


def node_of_internal(name: str) -> str:
    """Return the node of an internal edge (":J_3", ":J_w0"), lane (":J_3_0") or junction; empty for any other.

    >>> node_of_internal(":a_b_3_0"), node_of_internal(":a_w0"), node_of_internal("a_0")
    ('a_b', 'a', '')
    """
    if not name.startswith(":"):
        return ""
    return re.sub(r"(?:_[wc]?\d+){1,2}$", "", name[1:])


def format_point(x_m: float, y_m: float, z_m: float) -> str:
    """Return a point that is added to a shape; its digits do not bend the shape."""
    return f"{x_m:.5f},{y_m:.5f},{_format_m(z_m)}"


def _shape_text(tag: str, name: str, start: int, text: str, parts: list[list[str]], *, is_node: bool) -> ShapeText:
    try:
        points = [[*map(parse_coordinate_m, part), 0.0][:3] for part in parts]
        points_m = np.array(points, dtype=np.float64).reshape(-1, 3)
    except ValueError as error:
        raise InputError(f"<{tag} id={name!r}>", f"invalid coordinates in a shape ({error})", _HINT) from None
    xy_text = tuple(",".join(part[:2]) for part in parts)
    return ShapeText(tag, name, start, start + len(text), xy_text, points_m, is_node)


def _format_m(value_m: float) -> str:
    return f"{round(float(value_m), 3) + 0.0:.3f}"
