"""Axes, legends, charts: ranking, plan curve.

The frame of a figure seen from above: world metres (x east, y north; north is up) to a figure's units, axes, the
region of interest, colour bar.

A figure is SVG text. It is written here, not by a plotting library: colours then follow the page (light, dark, print)
through the classes in :data:`egvs.report.colours.STYLE_SHEET`, lettering stays text, and the bytes depend
on no installed font.

Figures of a plan of several sensors: the map of its poles, and how much each number of sensors is worth.

A figure of a ranking: a bar a site, with how far its score may be off.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from egvs.core.grid import Grid
from egvs.report import colours
from egvs.report.colours import STEPS, STYLE_SHEET, opacity
from egvs.report.formatting import SCORE_LABELS, ScoreLabel

Box = tuple[float, float, float, float]
"""x0, y0, x1, y1: in the world frame, metres, or in a figure's units."""

Rectangle = tuple[float, float, float, float]
"""x, y, width, height, in a figure's units."""
Metres = TypeVar("Metres", float, NDArray[np.float64])


@dataclass(frozen=True)
class MapSite:
    """A candidate site on a map, with its score."""

    site: str
    x_m: float
    y_m: float
    z_m: float
    egvs: float
    rank: int

    @property
    def score(self) -> float:
        """Its value of the score that ranks."""
        return self.egvs

    @property
    def by(self) -> ScoreLabel:
        """The score that ranks."""
        return SCORE_LABELS["egvs"]


def extent(grid: Grid, sites: Sequence[MapSite]) -> Box:
    """The region of interest and all sites, with a margin, in metres."""
    (x0, y0, _), (w, h, _) = grid.origin_m, grid.roi.size_m
    xs, ys = [x0, x0 + w, *(s.x_m for s in sites)], [y0, y0 + h, *(s.y_m for s in sites)]
    margin = 0.04 * max(max(xs) - min(xs), max(ys) - min(ys))
    return min(xs) - margin, min(ys) - margin, max(xs) + margin, max(ys) + margin


def shared_scale(peak: float, label: str) -> str:
    """The colour scale that several figures share, alone."""
    bar = ColourBar(0.0, peak, label)
    start = svg_start(460.0, 52.0, f"Colour scale: {label}, 0 to {peak:.3g}")
    return start + bar.svg("scale", 16.0, 4.0, 428.0) + "</svg>"


def standalone(figure: str) -> str:
    """A figure as the content of a file of its own."""
    head, _, rest = figure.partition(">")
    return f'{head} xmlns="http://www.w3.org/2000/svg"><style>{STYLE_SHEET}</style>{rest}\n'


class MapFrame:
    """From world metres to a figure's units, and what every figure has: axes, frame, colour bar.

    Parameters
    ----------
    box
        What is shown, world frame, metres.
    prefix
        Makes ids unique on a page.
    width, tallest
        The figure's width, and the most that its height may be, without lettering; in its own units.
    north
        Whether an arrow points north.
    """

    def __init__(
        self, box: Box, prefix: str, width: float = 760.0, tallest: float = 560.0, north: bool = False
    ) -> None:
        self.box, self.prefix, self.width, self.north = box, prefix, width, north
        self._ticks = [round_values(box[0], box[2], 9 if width > 600 else 6), round_values(box[1], box[3], 6)]
        self.left = 34.0 + 7.0 * max(len(t) for _, t in self._ticks[1])
        self.top, right = 12.0, 40.0 if north else 16.0
        self.scale = min((width - self.left - right) / (box[2] - box[0]), tallest / (box[3] - box[1]))
        self.frame_width, self.frame_height = (box[2] - box[0]) * self.scale, (box[3] - box[1]) * self.scale
        self.left += (width - self.left - right - self.frame_width) / 2

    def x(self, x_m: Metres) -> Metres:
        """Rightwards with east."""
        return self.left + (x_m - self.box[0]) * self.scale

    def y(self, y_m: Metres) -> Metres:
        """Downwards with south."""
        return self.top + (self.box[3] - y_m) * self.scale

    @property
    def full_extent(self) -> Rectangle:
        """All that is shown."""
        return self.left, self.top, self.frame_width, self.frame_height

    def region(self, grid: Grid) -> Rectangle:
        """The region of interest."""
        (x, y, _), (w, h, _) = grid.origin_m, grid.roi.size_m
        return self.x(x), self.y(y + h), w * self.scale, h * self.scale

    def roi(self, grid: Grid) -> str:
        """The region of interest."""
        x, y, w, h = self.region(grid)
        return f'<rect class="roi" x="{x:.1f}" y="{y:.1f}" width="{w:.1f}" height="{h:.1f}"/>'

    def image(self, rectangle: Rectangle, png: str, look: str) -> str:
        """A raster over a rectangle."""
        x, y, w, h = rectangle
        place = f'x="{x:.2f}" y="{y:.2f}" width="{w:.2f}" height="{h:.2f}"'
        return f'<image class="{look}" {place} preserveAspectRatio="none" href="{png}"/>'

    def svg(self, parts: Iterable[str], alt: str, bar: ColourBar | None = None) -> str:
        """The whole figure."""
        base = self.top + self.frame_height
        tall = base + 40.0 + (56.0 if bar else 0.0)
        place = f'x="{self.left:.1f}" y="{self.top:.1f}"'
        frame = f'<rect {place} width="{self.frame_width:.1f}" height="{self.frame_height:.1f}"/>'
        clip = f'<clipPath id="{self.prefix}-clip">{frame}</clipPath>'
        drawing = "\n".join(parts)
        return "\n".join(
            (
                svg_start(self.width, tall, alt),
                f'<defs>{clip}</defs>{self._axes(base)}\n<g clip-path="url(#{self.prefix}-clip)">{drawing}</g>',
                self._north_arrow() if self.north else "",
                bar.svg(self.prefix, self.left, base + 46.0, self.frame_width) if bar else "",
                "</svg>",
            )
        )

    def _axes(self, base: float) -> str:
        wide, tall = self.frame_width, self.frame_height
        lines, texts = [], []
        ticks = [f"M{self.left:.1f} {self.top:.1f}h{wide:.1f}v{tall:.1f}h{-wide:.1f}z"]
        for value, text in self._ticks[0]:
            x = self.x(value)
            lines.append(f"M{x:.1f} {self.top:.1f}V{base:.1f}")
            ticks.append(f"M{x:.1f} {base:.1f}v5")
            texts.append(f'<text x="{x:.1f}" y="{base + 18:.1f}" text-anchor="middle">{text}</text>')
        for value, text in self._ticks[1]:
            y = self.y(value)
            lines.append(f"M{self.left:.1f} {y:.1f}H{self.left + wide:.1f}")
            ticks.append(f"M{self.left:.1f} {y:.1f}h-5")
            texts.append(f'<text x="{self.left - 8:.1f}" y="{y + 4:.1f}" text-anchor="end">{text}</text>')
        side = self.left - 16.0 - 7.0 * max(len(t) for _, t in self._ticks[1])
        centre, middle = self.left + wide / 2, self.top + tall / 2
        texts.append(
            f'<text x="{centre:.1f}" y="{base + 34:.1f}" class="title" text-anchor="middle">x, east (m)</text>'
        )
        texts.append(
            f'<text class="title" transform="translate({side:.1f} {middle:.1f}) rotate(-90)" text-anchor="middle">'
            "y, north (m)</text>"
        )
        return f'<path class="grid" d="{"".join(lines)}"/><path class="axis" d="{"".join(ticks)}"/>{"".join(texts)}'

    def _north_arrow(self) -> str:
        x, y = self.left + self.frame_width + 20.0, self.top
        arrow = f'<path d="M{x:.1f} {y + 14:.1f}l7 24l-7 -6l-7 6z" fill="currentColor"/>'
        return f'<g>{arrow}<text x="{x:.1f}" y="{y + 10:.1f}" text-anchor="middle" font-weight="700">N</text></g>'


@dataclass(frozen=True)
class ColourBar:
    """A colour bar: from ``low`` to ``high`` (above it), with a square-root scale unless ``even``."""

    low: float
    high: float
    label: str
    even: bool = False

    def svg(self, prefix: str, x: float, y: float, width: float) -> str:
        covers = [1.0 if self.even else opacity(i / STEPS) for i in range(STEPS + 1)]
        stops = "".join(
            f'<stop class="q{i}" offset="{i / STEPS:.4f}" stop-opacity="{part:.2f}"/>' for i, part in enumerate(covers)
        )
        fill = f'<linearGradient id="{prefix}-scale">{stops}</linearGradient>'
        place = f'x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="12"'
        bar = f'<rect class="axis" style="fill:url(#{prefix}-scale)" {place}/>'
        ticks = "".join(
            f'<path class="axis" d="M{at:.1f} {y + 12:.1f}v4"/>'
            f'<text x="{at:.1f}" y="{y + 28:.1f}" text-anchor="middle">{text}</text>'
            for at, text in self._ticks(x, width)
        )
        note = "" if self.even else " · square-root scale"
        place = f'x="{x + width / 2:.1f}" y="{y + 44:.1f}"'
        title = f'<text class="title" {place} text-anchor="middle">{escape(self.label)}{note}</text>'
        return f"<g>{fill}{bar}{ticks}{title}</g>"

    def _ticks(self, x: float, width: float) -> list[tuple[float, str]]:
        """Round values, no closer than their lettering allows; on a square-root scale, finer towards zero."""
        span = self.high - self.low
        values = round_values(self.low, self.high, 6)
        if not self.even:
            values = [*round_values(0.0, span / 25, 2), *round_values(0.0, span / 4, 4), *values]
        placed: list[tuple[float, str]] = []
        for value in sorted({value for value, _ in values}, reverse=True):
            text = f"{value:,.6g}"
            share = (value - self.low) / span
            at = x + width * (share if self.even else math.sqrt(share))
            if all(abs(at - other) > 5.0 * (len(text) + len(shown)) for other, shown in placed):
                placed.append((at, text))
        return placed


def svg_start(width: float, height: float, alt: str) -> str:
    """The first tag of a figure."""
    return f'<svg class="plan" viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(alt)}">'


def round_values(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """Round values between two others, at most about ``most``, and how they are written."""
    span = high - low
    if not span > 0:
        return []
    exponent = math.floor(math.log10(span / most))
    tens = [(m, e) for e in (exponent - 1, exponent, exponent + 1) for m in (1, 2, 5)]
    size, power = next((float(f"{m}e{e}"), e) for m, e in tens if float(f"{m}e{e}") >= 0.999 * span / most)
    first, last = math.ceil(low / size - 1e-9), math.floor(high / size + 1e-9)
    return [(i * size, f"{i * size:,.{max(0, -power)}f}") for i in range(first, last + 1)]


@dataclass(frozen=True)
class CurveStep:
    """What so many sensors are worth: of the plan, and what no plan exceeds; shares of what all candidates would."""

    count: int
    share: float
    bound: float


_CURVE_WIDTH, _CURVE_HEIGHT = 460.0, 250.0
_CURVE_LEFT, _CURVE_TOP, _CURVE_BOTTOM = 56.0, 14.0, 44.0
_MAX_LABELS = 12


def sensor_count_chart(steps: Sequence[CurveStep], alt: str) -> str:
    """How many are enough: a bar for each number of sensors, and a mark above it for what no plan exceeds."""
    wide, tall = _CURVE_WIDTH - _CURVE_LEFT - 12.0, _CURVE_HEIGHT - _CURVE_TOP - _CURVE_BOTTOM
    most = max(1.0, *(step.bound for step in steps))
    base, each = _CURVE_TOP + tall, wide / len(steps)
    parts = [svg_start(_CURVE_WIDTH, _CURVE_HEIGHT, alt)]
    for value, _ in round_values(0.0, 100.0 * most, 5):
        y = base - tall * value / 100.0 / most
        parts.append(f'<path class="grid" d="M{_CURVE_LEFT:.1f} {y:.1f}h{wide:.1f}"/>')
        parts.append(f'<text x="{_CURVE_LEFT - 8:.1f}" y="{y + 4:.1f}" text-anchor="end">{value:g} %</text>')
    for i, step in enumerate(steps):
        x, bar = _CURVE_LEFT + i * each, tall * step.share / most
        bound = base - tall * step.bound / most
        title = f"{step.count} sensors: {step.share:.1%} of what all would; no plan exceeds {step.bound:.1%}"
        parts.append(
            f'<g class="step"><title>{escape(title)}</title>'
            f'<rect x="{x + 0.14 * each:.1f}" y="{base - bar:.1f}" width="{0.72 * each:.1f}" height="{bar:.1f}"/>'
            f'<path d="M{x + 0.06 * each:.1f} {bound:.1f}h{0.88 * each:.1f}"/></g>'
        )
        if len(steps) <= _MAX_LABELS or i % (1 + len(steps) // _MAX_LABELS) == 0:
            parts.append(f'<text x="{x + each / 2:.1f}" y="{base + 17:.1f}" text-anchor="middle">{step.count}</text>')
    parts.append(f'<path class="axis" d="M{_CURVE_LEFT:.1f} {_CURVE_TOP:.1f}v{tall:.1f}h{wide:.1f}"/>')
    parts.append(
        f'<text x="{_CURVE_LEFT + wide / 2:.1f}" y="{base + 36:.1f}" text-anchor="middle">sensors</text></svg>'
    )
    return "".join(parts)


_BARS_TOP, _BAR_SPACING, _BARS_BOTTOM, _BARS_MARGIN = 8.0, 18.0, 44.0, 16.0
_MAX_LETTERS = 18
"""Letters of a name; longer ones are cut."""


@dataclass(frozen=True)
class Bar:
    """A site's name, its score, its standard error (None where it is not known), and its score in words."""

    name: str
    value: float
    se: float | None
    words: str


def bar_chart(bars: Sequence[Bar], label: str, alt: str, width: float, factor: float = 1.0) -> str:
    """Bars below each other, the first on top, SVG text.

    Parameters
    ----------
    label
        Of the axis.
    width
        Of the figure, in its own units.
    factor
        Numbers of the axis are values times this: 100 for per cent.
    """
    names = [bar.name if len(bar.name) <= _MAX_LETTERS else f"{bar.name[: _MAX_LETTERS - 1]}…" for bar in bars]
    left = 16.0 + 7.0 * max(len(name) for name in names)
    wide, tall = width - left - _BARS_MARGIN, _BAR_SPACING * len(bars)
    most = max(bar.value + (bar.se or 0.0) for bar in bars) or 1.0
    low, high, base = min(bar.value for bar in bars), max(bar.value for bar in bars), _BARS_TOP + tall
    parts = [svg_start(width, base + _BARS_BOTTOM, alt)]
    for value, text in round_values(0.0, most * factor, max(2, int(wide // 70))):
        x = left + wide * value / factor / most
        parts.append(f'<path class="grid" d="M{x:.1f} {_BARS_TOP:.1f}V{base:.1f}"/>')
        parts.append(f'<text x="{x:.1f}" y="{base + 17:.1f}" text-anchor="middle">{text}</text>')
    for row, (bar, name) in enumerate(zip(bars, names, strict=True)):
        y, long = _BARS_TOP + _BAR_SPACING * row, wide * bar.value / most
        shape = f'x="{left:.1f}" y="{y + 3:.1f}" width="{long:.1f}" height="{_BAR_SPACING - 6:.1f}"'
        parts.append(f'<g class="bar"><title>{escape(f"{bar.name}: {bar.words}")}</title>')
        parts.append(
            f'<rect class="q{colours.colour_class(bar.value, low, high)}" '
            f"{shape}/>{_error_bar(bar, left, y, wide / most)}</g>"
        )
        parts.append(f'<text x="{left - 7:.1f}" y="{y + 13:.1f}" text-anchor="end">{escape(name)}</text>')
    parts.append(f'<path class="axis" d="M{left:.1f} {_BARS_TOP:.1f}V{base:.1f}H{left + wide:.1f}"/>')
    parts.append(
        f'<text x="{left + wide / 2:.1f}" y="{base + 36:.1f}" text-anchor="middle">{escape(label)}</text></svg>'
    )
    return "".join(parts)


def _error_bar(bar: Bar, left: float, y: float, scale: float) -> str:
    """One standard error to either side."""
    if not bar.se:
        return ""
    start, end = (left + max(0.0, bar.value + side * bar.se) * scale for side in (-1.0, 1.0))
    middle = y + _BAR_SPACING / 2
    ends = "".join(f"M{x:.1f} {middle - 3:.1f}v6" for x in (start, end))
    line = f'd="M{start:.1f} {middle:.1f}H{end:.1f}{ends}"/>'
    return f'<path style="stroke:#ffffff;stroke-width:2.8;fill:none" {line}<path class="lead" {line}'
