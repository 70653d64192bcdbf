"""Figures of a plan of several sensors: the map of its poles, and how much each number of sensors is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from pipeline.core.grid import Grid
from pipeline.report.drawing import maps
from pipeline.report.drawing.map_frame import MapSite, Plan, extent, round_values, svg_start
from pipeline.report.drawing.maps import Backdrop
from pipeline.report.drawing.raster import ColumnValues


@dataclass(frozen=True)
class PlannedPole:
    """A pole of a plan on a map: where, the numbers of its sensors ("1, 3"), and what they are and add, in words."""

    x_m: float
    y_m: float
    numbers: str
    label: str
    title: str


def plan_map(
    grid: Grid,
    values: ColumnValues,
    backdrop: Backdrop,
    candidates: Sequence[MapSite],
    poles: Sequence[PlannedPole],
    alt: str,
) -> str:
    """The poles of a plan, numbered in their order, over all candidates; traffic faint below."""
    plan = Plan(extent(grid, candidates), "plan", north=True)
    parts = maps.ground(plan, grid, values, backdrop)
    for x_m, y_m in dict.fromkeys((site.x_m, site.y_m) for site in candidates):
        parts.append(f'<circle class="spot" cx="{plan.x(x_m):.1f}" cy="{plan.y(y_m):.1f}" r="3"/>')
    spots = [(plan.x(pole.x_m), plan.y(pole.y_m)) for pole in poles]
    for pole, (x, y) in zip(poles, spots, strict=True):
        wide = _half_width(pole)
        shape = f'<rect x="{x - wide:.1f}" y="{y - 10:.1f}" width="{2 * wide:.1f}" height="20" rx="10"/>'
        number = f'<text x="{x:.1f}" y="{y + 4:.1f}">{escape(pole.numbers)}</text>'
        parts.append(f'<g class="planned"><title>{escape(pole.title)}</title>{shape}{number}</g>')
    parts += maps.labels(
        plan, [(x, y, pole.label, _half_width(pole)) for pole, (x, y) in zip(poles, spots, strict=True)]
    )
    return plan.svg(parts, alt)


def _half_width(pole: PlannedPole) -> float:
    """Of the mark that holds its numbers."""
    return 10.0 + 3.4 * max(0, len(pole.numbers) - 1)


@dataclass(frozen=True)
class CurveStep:
    """What so many sensors are worth: of the plan, and what no plan exceeds; shares of what all candidates would."""

    count: int
    share: float
    bound: float


_WIDTH, _TALL = 460.0, 250.0
_LEFT, _TOP, _BOTTOM = 56.0, 14.0, 44.0
_MOST_LABELS = 12


def curve(steps: Sequence[CurveStep], alt: str) -> str:
    """How many are enough: a bar for each number of sensors, and a mark above it for what no plan exceeds."""
    wide, tall = _WIDTH - _LEFT - 12.0, _TALL - _TOP - _BOTTOM
    most = max(1.0, *(step.bound for step in steps))
    base, each = _TOP + tall, wide / len(steps)
    parts = [svg_start(_WIDTH, _TALL, alt)]
    for value, _ in round_values(0.0, 100.0 * most, 5):
        y = base - tall * value / 100.0 / most
        parts.append(f'<path class="grid" d="M{_LEFT:.1f} {y:.1f}h{wide:.1f}"/>')
        parts.append(f'<text x="{_LEFT - 8:.1f}" y="{y + 4:.1f}" text-anchor="end">{value:g} %</text>')
    for i, step in enumerate(steps):
        x, bar = _LEFT + i * each, tall * step.share / most
        bound = base - tall * step.bound / most
        title = f"{step.count} sensors: {step.share:.1%} of what all would; no plan exceeds {step.bound:.1%}"
        parts.append(
            f'<g class="step"><title>{escape(title)}</title>'
            f'<rect x="{x + 0.14 * each:.1f}" y="{base - bar:.1f}" width="{0.72 * each:.1f}" height="{bar:.1f}"/>'
            f'<path d="M{x + 0.06 * each:.1f} {bound:.1f}h{0.88 * each:.1f}"/></g>'
        )
        if len(steps) <= _MOST_LABELS or i % (1 + len(steps) // _MOST_LABELS) == 0:
            parts.append(f'<text x="{x + each / 2:.1f}" y="{base + 17:.1f}" text-anchor="middle">{step.count}</text>')
    parts.append(f'<path class="axis" d="M{_LEFT:.1f} {_TOP:.1f}v{tall:.1f}h{wide:.1f}"/>')
    parts.append(f'<text x="{_LEFT + wide / 2:.1f}" y="{base + 36:.1f}" text-anchor="middle">sensors</text></svg>')
    return "".join(parts)
