"""The figure of a comparison with measured sweeps or labels: values by range, in panels side by side.

It is SVG text with the classes of :mod:`egvs.drawing.colours`, so that it follows the theme of its page.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from egvs.drawing.svg_figures import round_values, svg_start_tag, text_width
from egvs.extensions.validation.measured.ratios import Ratio

COLOURS = ("q13", "q3", "q8", "q16", "q11", "q5")
"""Classes of the series, in the order of panels."""

WIDTH = 760.0
_LEFT, _RIGHT, _TOP, _HEIGHT, _BOTTOM, _GAP = 52.0, 10.0, 28.0, 210.0, 42.0, 22.0
_LEGEND_LINE = 20.0
_SHAPES = (
    '<circle {} r="4.6"/>',
    '<rect {} x="-4.2" y="-4.2" width="8.4" height="8.4"/>',
    '<path {} d="M0-5.4L5.2 4H-5.2z"/>',
    '<path {} d="M0 5.4L5.2-4H-5.2z"/>',
    '<path {} d="M0-5.8L5.8 0L0 5.8L-5.8 0z"/>',
    '<path {} d="M-5-2H-2V-5H2V-2H5V2H2V5H-2V2H-5z"/>',
)


@dataclass(frozen=True)
class Series:
    """Values by range; a category without a value is missing or NaN."""

    name: str
    values: dict[str, Ratio]


@dataclass(frozen=True)
class Panel:
    """Values by range of several series.

    Attributes
    ----------
    title
        What the values are.
    categories
        Ranges, from left to right.
    series
        In the order of the legend.
    in_percent
        Whether values are shares.
    reference
        Value with a line across; None for none.
    """

    title: str
    categories: tuple[str, ...]
    series: tuple[Series, ...]
    in_percent: bool = False
    reference: float | None = None


def range_figure(panels: Sequence[Panel], alt: str) -> str:
    """Return panels side by side, with one legend above; a vertical line is two standard errors to each side."""
    names = list(dict.fromkeys(series.name for panel in panels for series in panel.series))
    legend, rows = _legend(names)
    top = _TOP + rows * _LEGEND_LINE
    panel_width = (WIDTH - _GAP * (len(panels) - 1)) / len(panels)
    parts = [svg_start_tag(WIDTH, top + _HEIGHT + _BOTTOM, alt), legend]
    for number, panel in enumerate(panels):
        left = number * (panel_width + _GAP) + _LEFT
        parts.append(_panel(panel, names, (left, top), panel_width - _LEFT - _RIGHT))
    return "".join([*parts, "</svg>"])


def _legend(names: Sequence[str]) -> tuple[str, int]:
    """Return the legend, and its number of lines."""
    parts, x, row = [], _LEFT, 0
    for number, name in enumerate(names):
        width = 30.0 + text_width(name)
        if x + width > WIDTH and x > _LEFT:
            x, row = _LEFT, row + 1
        y = 12.0 + row * _LEGEND_LINE
        parts.append(f'{_mark(number, x, y)}<text x="{x + 11:.1f}" y="{y + 4:.1f}">{escape(name)}</text>')
        x += width
    return "".join(parts), row + 1


def _mark(number: int, x: float, y: float) -> str:
    shape = _SHAPES[number % len(_SHAPES)].format(f'class="{COLOURS[number % len(COLOURS)]}"')
    return f'<g transform="translate({x:.1f} {y:.1f})">{shape}</g>'


def _panel(panel: Panel, names: Sequence[str], corner: tuple[float, float], width: float) -> str:
    left, top = corner
    base = top + _HEIGHT
    values = [ratio for series in panel.series for ratio in series.values.values() if not math.isnan(ratio.value)]
    ends = [ratio.value + (0.0 if math.isnan(ratio.se) else 2.0 * ratio.se) for ratio in values]
    most = 1.0 if panel.in_percent else 1.04 * max([panel.reference or 0.0, *ends], default=1.0)
    factor = 100.0 if panel.in_percent else 1.0

    def height(value: float) -> float:
        return base - _HEIGHT * min(max(value / most, 0.0), 1.0)

    parts = [f'<text class="label" x="{left - 42:.1f}" y="{top - 12:.1f}">{escape(panel.title)}</text>']
    for tick in round_values(0.0, most * factor, 5):
        y = height(tick.value / factor)
        parts.append(f'<path class="grid" d="M{left:.1f} {y:.1f}h{width:.1f}"/>')
        text = f"{tick.text} %" if panel.in_percent else tick.text
        parts.append(f'<text x="{left - 7:.1f}" y="{y + 4:.1f}" text-anchor="end">{text}</text>')
    if panel.reference is not None:
        parts.append(f'<path class="roi" d="M{left:.1f} {height(panel.reference):.1f}h{width:.1f}"/>')
    step = width / max(len(panel.categories), 1)
    for column, category in enumerate(panel.categories):
        middle = left + (column + 0.5) * step
        parts.append(f'<text x="{middle:.1f}" y="{base + 17:.1f}" text-anchor="middle">{escape(category)}</text>')
        for row, series in enumerate(panel.series):
            ratio = series.values.get(category)
            if ratio is None or math.isnan(ratio.value):
                continue
            x = middle + (row - (len(panel.series) - 1) / 2) * min(16.0, step / (len(panel.series) + 1))
            error = ""
            if not math.isnan(ratio.se):
                low, high = height(ratio.value - 2.0 * ratio.se), height(ratio.value + 2.0 * ratio.se)
                error = f'<path class="lead" d="M{x:.1f} {low:.1f}V{high:.1f}"/>'
            text = f"{100 * ratio.value:.0f} %" if panel.in_percent else f"{ratio.value:.2f}"
            title = f"<title>{escape(f'{series.name}, {category} m: {text}')}</title>"
            parts.append(f"<g>{title}{error}{_mark(names.index(series.name), x, height(ratio.value))}</g>")
    parts.append(f'<path class="axis" d="M{left:.1f} {top:.1f}V{base:.1f}H{left + width:.1f}"/>')
    parts.append(f'<text x="{left + width / 2:.1f}" y="{base + 35:.1f}" text-anchor="middle">range, m</text>')
    return "".join(parts)
