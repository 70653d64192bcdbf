"""The budget curve of a city as a figure: what the whole city gets for a number of sensors, or for a cost."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape

from egvs.core.wording import number_of
from egvs.drawing.svg_figures import round_values, svg_start_tag
from egvs.extensions.city.results import BudgetPoint, CityPlan, gain_label

_WIDTH, _HEIGHT = 640.0, 360.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 64.0, 20.0, 34.0, 46.0

_MAX_CEILING = 1.6
"""The score of all candidates is shown up to this multiple of the highest upper bound."""

_MIN_LABEL_SPACING = 34.0
"""Least distance between labels of the sensors axis."""

_MAX_MARKERS = 60
"""More points than this have no markers."""

Point = tuple[float, float]


def budget_chart(plan: CityPlan) -> str:
    """Draw the curve of a plan, with one standard error to either side; "" for fewer than two points.

    Shown are the best plan for each number of sensors (or cost), the upper bound of all plans, and, for a number of
    sensors, the plan in the order of installation with its phases.
    """
    if len(plan.curve) < 2 or not plan.curve[-1].limit > plan.curve[0].limit:
        return ""
    return _BudgetChart(plan).svg()


class _BudgetChart:
    def __init__(self, plan: CityPlan) -> None:
        self._plan = plan
        self._points = plan.curve
        self._is_count = "count" in plan.requested
        self._label = gain_label(plan.rank_by)
        self._low, self._high = self._points[0].limit, self._points[-1].limit
        highest = max(max(point.bound, point.score + _or_zero(point.score_se)) for point in self._points)
        self._has_ceiling = 0.0 < plan.joint_of_all <= _MAX_CEILING * highest
        self._top = 1.04 * (max(highest, plan.joint_of_all) if self._has_ceiling else highest) or 1.0

    def svg(self) -> str:
        unit = "number of sensors" if self._is_count else "cost"
        alt = f"{self._label.label[0].upper()}{self._label.label[1:]} by {unit}, with standard errors"
        parts = [svg_start_tag(_WIDTH, _HEIGHT, alt), *self._grid(), *self._ceiling(), *self._phases()]
        if self._plan.has_errors:
            parts.append(f'<path class="curve-band" d="{self._band()}"/>')
        parts.append(f'<path class="curve-bound" d="{_line(self._at(p, p.bound) for p in self._points)}"/>')
        if self._is_count:
            parts.append(f'<path class="curve-installed" d="{_line(self._at(p, p.installed) for p in self._points)}"/>')
        parts.append(f'<path class="curve-best" d="{_line(self._at(p, p.score) for p in self._points)}"/>')
        parts += self._markers()
        return "".join([*parts, "</svg>"])

    def _x(self, limit: float) -> float:
        return _LEFT + (_WIDTH - _LEFT - _RIGHT) * (limit - self._low) / (self._high - self._low)

    def _y(self, score: float) -> float:
        return _TOP + (_HEIGHT - _TOP - _BOTTOM) * (1.0 - max(score, 0.0) / self._top)

    def _at(self, point: BudgetPoint, score: float) -> Point:
        return self._x(point.limit), self._y(score)

    def _band(self) -> str:
        upper = [self._at(p, p.score + p.score_se) for p in self._points]
        lower = [self._at(p, p.score - p.score_se) for p in reversed(self._points)]
        return f"{_line([*upper, *lower])}Z"

    def _grid(self) -> Iterable[str]:
        base, right = _HEIGHT - _BOTTOM, _WIDTH - _RIGHT
        for value, text in round_values(0.0, self._top, 6):
            y = self._y(value)
            yield f'<path class="grid" d="M{_LEFT:.1f} {y:.1f}H{right:.1f}"/>'
            yield _text(_LEFT - 8, y + 4, text, "end")
        for limit, text in self._limit_ticks():
            yield f'<path class="axis" d="M{self._x(limit):.1f} {base:.1f}v4"/>'
            yield _text(self._x(limit), base + 18, text)
        yield f'<path class="axis" d="M{_LEFT:.1f} {_TOP:.1f}V{base:.1f}H{right:.1f}"/>'
        yield _text((_LEFT + right) / 2, _HEIGHT - 8, "sensors in the whole city" if self._is_count else "cost")
        yield _text(10.0, 14.0, self._label.label, "start")

    def _limit_ticks(self) -> list[tuple[float, str]]:
        span = _WIDTH - _LEFT - _RIGHT
        ticks = round_values(self._low, self._high, int(span / (2 * _MIN_LABEL_SPACING)))
        if not self._is_count:
            return [(value, text) for value, text in ticks]
        if span / (self._high - self._low) >= _MIN_LABEL_SPACING:
            return [(point.limit, f"{point.limit:g}") for point in self._points]
        return [(value, f"{value:g}") for value, _ in ticks if value == int(value)]

    def _ceiling(self) -> Iterable[str]:
        """The score of all candidates together."""
        if not self._has_ceiling:
            return
        y = self._y(self._plan.joint_of_all)
        yield f'<path class="curve-ceiling" d="M{_LEFT:.1f} {y:.1f}H{_WIDTH - _RIGHT:.1f}"/>'
        text = f"all {self._plan.candidates:,} candidates: {self._label.value(self._plan.joint_of_all)}"
        yield _text(_WIDTH - _RIGHT, y - 5, text, "end")

    def _phases(self) -> Iterable[str]:
        base = _HEIGHT - _BOTTOM
        for phase in self._plan.by_phase:
            x = self._x(phase.point.limit)
            yield f'<path class="curve-phase" d="M{x:.1f} {_TOP:.1f}V{base:.1f}"/>'
            yield _text(x - 5, base - 8, f"phase {phase.number}", "end")

    def _markers(self) -> Iterable[str]:
        if len(self._points) > _MAX_MARKERS:
            return
        for point in self._points:
            x, y = self._at(point, point.score)
            title = escape(self._title(point))
            yield f'<g class="curve-marker"><title>{title}</title><circle cx="{x:.1f}" cy="{y:.1f}" r="3.6"/></g>'

    def _title(self, point: BudgetPoint) -> str:
        sensors = number_of(point.sensors, "sensor")
        within = sensors if self._is_count else f"cost {point.cost:,.0f}, {sensors}"
        error = f" ± {self._label.value(point.score_se)}" if self._plan.has_errors else ""
        return f"{within}: {self._label.value(point.score)}{error}, at most {self._label.value(point.bound)}"


def _or_zero(value: float) -> float:
    return 0.0 if math.isnan(value) else value


def _line(points: Iterable[Point]) -> str:
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in points)


def _text(x: float, y: float, text: str, anchor: str = "middle") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def curve_rows(plan: CityPlan, most: int = 12) -> Sequence[BudgetPoint]:
    """Return at most ``most`` points of the curve for a table, evenly spread; with the ends of all phases."""
    points = [point for point in plan.curve if point.limit > 0]
    step = max(1, math.ceil(len(points) / most))
    ends = set(plan.phases)
    last = len(points) - 1
    return [point for i, point in enumerate(points) if (last - i) % step == 0 or point.limit in ends]
