"""The map of a city's junctions over its streets, coloured by a value of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from pipeline.report.drawing import colours, maps
from pipeline.report.drawing.map_frame import Box, ColourBar, Plan
from pipeline.traffic import network

_WIDTH, _TALLEST = 760.0, 720.0
_NAMED = 12
"""Junctions whose names stand on the map, the first ones; every one tells its own under the pointer."""
_NUMBERED = 120
"""With more junctions than this, circles have no room for numbers."""
_ALONE_M = 300.0
"""What is shown round a single junction, at least."""


@dataclass(frozen=True)
class MapJunction:
    """A junction on the map.

    Attributes
    ----------
    value
        What it is coloured by.
    mark
        What stands in its circle.
    title
        What it tells under the pointer.
    link
        Where a click on it leads; "" for nowhere.
    """

    name: str
    x_m: float
    y_m: float
    value: float
    mark: str
    title: str
    link: str = ""


def junction_map(
    junctions: Sequence[MapJunction], streets: Sequence[str], box: Box, prefix: str, label: str, alt: str
) -> str:
    """Junctions, the first ones above all others, over streets (paths of this box's :func:`frame`)."""
    plan = frame(box, prefix)
    low, high = min(its.value for its in junctions), max(its.value for its in junctions)
    radius = 9.0 if len(junctions) <= _NUMBERED else 6.0
    parts = [f'<g class="roads"><path class="street-line" d="{"".join(streets)}"/></g>'] if streets else []
    parts += [_circle(plan, its, low, high, radius, len(junctions) <= _NUMBERED) for its in reversed(junctions)]
    parts += maps.labels(plan, [(plan.x(its.x_m), plan.y(its.y_m), its.name, radius) for its in junctions[:_NAMED]])
    return plan.svg(parts, alt, bar=ColourBar(low, high, label, even=True) if high > low else None)


def frame(box: Box, prefix: str = "") -> Plan:
    """The frame of maps of a city."""
    return Plan(box, prefix, width=_WIDTH, tallest=_TALLEST, north=True)


def box_of(places_m: Sequence[tuple[float, float]]) -> Box:
    """All junctions (x, y), with a margin."""
    xs, ys = [x for x, _ in places_m], [y for _, y in places_m]
    margin = max(0.08 * max(max(xs) - min(xs), max(ys) - min(ys)), _ALONE_M / 2)
    return min(xs) - margin, min(ys) - margin, max(xs) + margin, max(ys) + margin


def street_paths(path: Path | None, box: Box) -> list[str]:
    """The middle lines of a network's roads within a box, those over junctions as well, as paths of its :func:`frame`;
    none without a network."""
    if path is None:
        return []
    plan, paths = frame(box), []
    for edge in network.read(path).all_edges:
        if edge.function not in ("", "internal") or not edge.lanes:
            continue
        line = edge.lanes[-1].shape_m[:, :2]
        low, high = line.min(axis=0), line.max(axis=0)
        if low[0] < box[2] and high[0] > box[0] and low[1] < box[3] and high[1] > box[1]:
            points = np.column_stack([plan.x(line[:, 0]), plan.y(line[:, 1])]).round(1).tolist()
            paths.append("M" + "L".join(f"{x:g} {y:g}" for x, y in points))
    return paths


def _circle(plan: Plan, its: MapJunction, low: float, high: float, radius: float, numbered: bool) -> str:
    x, y, step = plan.x(its.x_m), plan.y(its.y_m), colours.step(its.value, low, high)
    tone = "high" if 2 * step > colours.STEPS else "low"
    number = f'<text class="rank {tone}" x="{x:.1f}" y="{y + 3.4:.1f}">{escape(its.mark)}</text>' if numbered else ""
    shape = f'<circle class="q{step}" cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}"/>{number}'
    drawn = f'<g class="site"><title>{escape(its.title)}</title>{shape}</g>'
    return f'<a href="{escape(its.link)}">{drawn}</a>' if its.link else drawn
