"""A map of a junction with the names that counts use: streets, approaches, and the vehicles of each turn.

Every approach has its name (street and side on which its vehicles arrive) at its road, and the counted vehicles per
hour that turn left, drive straight on, turn right or make a U-turn.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egvs.core import polylines
from egvs.core.grid import FloatArray
from egvs.drawing import maps
from egvs.drawing.basemap import roads_within
from egvs.drawing.svg_figures import Box, MapFrame, text_width
from egvs.report.sections import busiest_counts
from egvs.scenario.model import Scenario
from egvs.scenario.traffic_config import CountConfig
from egvs.traffic.approach_queues import approach_paths
from egvs.traffic.approaches import ApproachIndex, ApproachMovement
from egvs.traffic.directions import U_TURN
from egvs.traffic.movements import MovementNames
from egvs.traffic.network import read_net_xml

_TURN_LABELS = {"left": "left", "straight": "straight", "right": "right", U_TURN: U_TURN, "": "all"}
_MARGIN_M = 25.0
_LABEL_AT_M = 32.0
"""Distance of a label from the stop line."""
_LINE_HEIGHT = 14.0
_BOLD_WIDTH = 1.15
"""Width of bold letters, relative to the others."""
_WIDTH = 420.0
"""Small, so that the text can be read on the screen of a telephone."""


@dataclass(frozen=True)
class ApproachLabel:
    """An approach on the map: where it is (2,), its name, and vehicles per hour by turn."""

    at_m: FloatArray
    name: str
    per_hour: Mapping[str, float]

    @property
    def lines(self) -> tuple[str, ...]:
        """The text."""
        turns = [f"{_TURN_LABELS[turn]} {number:.0f}" for turn, number in self.per_hour.items() if number]
        return self.name, *turns


def approach_labels(counts: Sequence[CountConfig], network: Path, center_m: tuple[float, float]) -> list[ApproachLabel]:
    """Return the approaches of counts, in the order of the compass."""
    roads = read_net_xml(network)
    index = ApproachIndex.of_flows(counts, MovementNames(roads, center_m, counts))
    paths = approach_paths(index.movements, roads)
    by_title: dict[str, list[ApproachMovement]] = {title: [] for title in index.titles}
    for movement in index.movements:
        by_title[movement.approach_title].append(movement)
    labels = []
    for title, movements in by_title.items():
        per_hour = {turn: 0.0 for turn in _TURN_LABELS}
        for movement in movements:
            per_hour[movement.turn] += movement.flow.per_hour
        at_m = polylines.points_at(paths[title].line_m, np.array([_LABEL_AT_M]))[0]
        labels.append(ApproachLabel(at_m, title, per_hour))
    return labels


def draw_approach_map(scenario: Scenario, network: Path) -> str:
    """Return the map of the busiest period of a scenario with counts, as SVG."""
    period, counts = busiest_counts(scenario)
    (x_m, y_m, _), (width_m, height_m, _) = scenario.roi.center_m, scenario.roi.size_m
    half_m = max(width_m, height_m) / 2 + _MARGIN_M
    labels = approach_labels(counts, network, (x_m, y_m))
    box = (x_m - half_m, y_m - half_m, x_m + half_m, y_m + half_m)
    plan = MapFrame(box, "approaches", width=_WIDTH, north=True)
    texts = [f"{label.lines[0]}: {', '.join(label.lines[1:])}" for label in labels]
    of_period = f" in the period {period}" if period else ""
    alt = f"Approaches of the junction and vehicles per hour{of_period}: {'; '.join(texts)}"
    parts = [maps.road_paths(plan, roads_within(network, box))]
    covered: list[Box] = []
    for label in labels:
        parts += _draw_label(plan, label, covered)
    return plan.svg(parts, alt)


def _draw_label(plan: MapFrame, label: ApproachLabel, covered: list[Box]) -> Iterator[str]:
    """Draw a disc at the approach, and its text beside it where no other text is; with a line if that is far away."""
    x = min(max(plan.x(float(label.at_m[0])), plan.left + 12.0), plan.left + plan.frame_width - 12.0)
    y = min(max(plan.y(float(label.at_m[1])), plan.top + 12.0), plan.top + plan.frame_height - 12.0)
    box = _free_box(plan, (x, y), label, covered)
    covered.append(box)
    left, top, right, bottom = box
    text_x, anchor = (left, "start") if left > x else (right, "end")
    if left <= x <= right:
        end = x, top if top > y else bottom
    else:
        end = text_x, top + _LINE_HEIGHT / 2
    if abs(end[1] - y) > _LINE_HEIGHT:
        yield f'<path {plan.style.shape("lead")} d="M{x:.1f} {y:.1f}L{end[0]:.1f} {end[1]:.1f}"/>'
    yield f'<circle {plan.style.shape("spot")} cx="{x:.1f}" cy="{y:.1f}" r="4.5"/>'
    for number, line in enumerate(label.lines):
        position = f'x="{text_x:.1f}" y="{top + (number + 0.8) * _LINE_HEIGHT:.1f}" text-anchor="{anchor}"'
        if number == 0:
            position += ' font-weight="700"'
        yield plan.style.text_with_halo("label", position, line)


def _free_box(plan: MapFrame, at: tuple[float, float], label: ApproachLabel, covered: Sequence[Box]) -> Box:
    """Return the box of a label: the one nearest to its approach that covers no other, or else the first one."""
    widths = [_BOLD_WIDTH * text_width(label.lines[0]), *(text_width(line) for line in label.lines[1:])]
    width, height = max(widths), _LINE_HEIGHT * len(label.lines)
    x, y = at
    boxes = []
    for step in range(int(plan.frame_height / _LINE_HEIGHT)):
        for shift in dict.fromkeys((step, -step)):
            top = y + (shift - 0.5) * _LINE_HEIGHT
            beside = [x + 10.0, x - 10.0 - width]
            if top > y + 5.0 or top + height < y - 5.0:  # a long name may be above or below its disc
                beside.append(min(max(x - width / 2, plan.left), plan.left + plan.frame_width - width))
            for left in beside:
                box = (left, top, left + width, top + height)
                fits = plan.left <= box[0] and box[2] <= plan.left + plan.frame_width
                if fits and plan.top <= top and box[3] <= plan.top + plan.frame_height:
                    boxes.append(box)
    if not boxes:
        return x + 10.0, y, x + 10.0 + width, y + height
    return next((box for box in boxes if not any(_overlaps(box, other) for other in covered)), boxes[0])


def _overlaps(a: Box, b: Box) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
