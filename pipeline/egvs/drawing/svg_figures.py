"""Parts of SVG figures (axes, colour bars, north arrow), and the bar charts of rankings and plans.

Figures are written as SVG text, not by a plotting library: their colours can then follow the light or dark theme of a
page, lettering stays text, and the bytes do not depend on installed fonts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import NamedTuple, TypeVar

from egvs.core.grid import FloatArray, Grid
from egvs.core.wording import format_percent
from egvs.drawing import colours
from egvs.drawing.colours import LIGHT, STEPS, STYLE_SHEET, Theme, opacity, shape_attributes
from egvs.results.labels import shorten_name
from egvs.results.ranking import RankedSite

Box = tuple[float, float, float, float]
"""x0, y0, x1, y1: in the world frame, metres, or in a figure's units."""

Rectangle = tuple[float, float, float, float]
"""x, y, width, height, in a figure's units."""
Metres = TypeVar("Metres", float, FloatArray)

FONTS = "DejaVu Sans, Arial, Helvetica, sans-serif"
"""Fonts of printed figures."""

FONT_SIZE_PT = 7.0
"""Font size of printed figures, which is 12 units of a figure."""

_LINE_SPACING = 15.0
_SCALE_NOTE = "square-root scale"
_NAMESPACE = "http://www.w3.org/2000/svg"


@dataclass(frozen=True)
class FigureStyle:
    """Width of a figure, and where its shapes get their colours from.

    On a page, shapes have classes of :data:`egvs.drawing.colours.STYLE_SHEET`. For print, their final colours are
    written on each shape, because many programs that read SVG (cairo, slides) do not know style sheets with variables.

    Attributes
    ----------
    width
        In the figure's units.
    theme
        Colours of a printed figure; None for a page.
    width_mm
        Width on paper.
    """

    width: float = 760.0
    theme: Theme | None = None
    width_mm: float = 0.0

    @classmethod
    def for_print(cls, width_mm: float) -> FigureStyle:
        """Return the style of a figure on white paper, with lettering of :data:`FONT_SIZE_PT`."""
        return cls(width_mm / 25.4 * 72.0 * 12.0 / FONT_SIZE_PT, LIGHT, width_mm)

    @property
    def image_themes(self) -> tuple[str, ...]:
        """Themes in which images are drawn: on a page both, of which one is visible."""
        return colours.THEMES if self.theme is None else colours.THEMES[:1]

    def shape(self, *names: str) -> str:
        """Return the attributes of a shape of some classes; of conflicting ones, the last counts."""
        attributes = {"class": " ".join(names)}
        if self.theme is not None:
            for name in names:
                attributes |= shape_attributes(name, self.theme)
        return " ".join(f'{key}="{value}"' for key, value in attributes.items())

    def text_with_halo(self, name: str, position: str, text: str) -> str:
        """Return a text with an outline in the colour of the paper; ``position`` has its attributes."""
        letters = f"<text {self.shape(name)} {position}>{escape(text)}</text>"
        if self.theme is None:
            return letters
        return f"<text {self.shape(name, f'{name}-halo')} {position}>{escape(text)}</text>{letters}"


PAGE_STYLE = FigureStyle()


def extent(grid: Grid, sites: Sequence[RankedSite]) -> Box:
    """Return a box around the region of interest and all sites, with a margin, in metres."""
    (x0, y0, _), (width, height, _) = grid.origin_m, grid.roi.size_m
    xs = [x0, x0 + width, *(site.x_m for site in sites)]
    ys = [y0, y0 + height, *(site.y_m for site in sites)]
    margin = 0.04 * max(max(xs) - min(xs), max(ys) - min(ys))
    return min(xs) - margin, min(ys) - margin, max(xs) + margin, max(ys) + margin


def shared_scale(peak: float, label: str) -> str:
    """Return the colour scale of several figures as a figure of its own."""
    bar = ColourBar(0.0, peak, label)
    start = svg_start_tag(460.0, 52.0, f"Colour scale: {label}, 0 to {peak:.3g}")
    return f"{start}{bar.svg('scale', (16.0, 4.0), 428.0, bar.title_lines(428.0))}</svg>"


def standalone_svg(figure: str) -> str:
    """Return a figure of a page as the content of a file, with its style sheet."""
    head, _, rest = figure.partition(">")
    return f'{head} xmlns="{_NAMESPACE}"><style>{STYLE_SHEET}</style>{rest}\n'


class Tick(NamedTuple):
    """A value on an axis, and its text."""

    value: float
    text: str


class MapFrame:
    """The frame of a map: from world metres (x east, y north) to a figure's units, axes, colour bar.

    Parameters
    ----------
    box
        The area shown, world frame, metres.
    prefix
        Makes ids unique on a page.
    width, tallest
        Width of the figure, and the maximum height of the map without lettering; in the figure's units.
    north
        Whether to draw a north arrow.
    style
        Where colours come from.
    """

    def __init__(
        self,
        box: Box,
        prefix: str,
        width: float = 760.0,
        tallest: float = 560.0,
        north: bool = False,
        style: FigureStyle = PAGE_STYLE,
    ) -> None:
        self.box, self.prefix, self.width, self.north, self.style = box, prefix, width, north, style
        max_x_ticks = 9 if width > 600 else 6
        self._x_ticks = round_values(box[0], box[2], max_x_ticks)
        self._y_ticks = round_values(box[1], box[3], 6)
        self._y_tick_width = 7.0 * max(len(tick.text) for tick in self._y_ticks)
        self.left = 34.0 + self._y_tick_width
        self.top = 12.0
        right_margin = 40.0 if north else 16.0
        self.scale = min((width - self.left - right_margin) / (box[2] - box[0]), tallest / (box[3] - box[1]))
        self.frame_width = (box[2] - box[0]) * self.scale
        self.frame_height = (box[3] - box[1]) * self.scale
        self.left += (width - self.left - right_margin - self.frame_width) / 2

    def x(self, x_m: Metres) -> Metres:
        """Return x in the figure's units, to the right."""
        return self.left + (x_m - self.box[0]) * self.scale

    def y(self, y_m: Metres) -> Metres:
        """Return y in the figure's units, downwards."""
        return self.top + (self.box[3] - y_m) * self.scale

    @property
    def full_extent(self) -> Rectangle:
        """Rectangle of the map."""
        return self.left, self.top, self.frame_width, self.frame_height

    def region(self, grid: Grid) -> Rectangle:
        """Return the rectangle of the region of interest."""
        (x, y, _), (width, height, _) = grid.origin_m, grid.roi.size_m
        return self.x(x), self.y(y + height), width * self.scale, height * self.scale

    def roi(self, grid: Grid) -> str:
        """Return the outline of the region of interest."""
        x, y, width, height = self.region(grid)
        return f'<rect {self.style.shape("roi")} x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}"/>'

    def image(self, rectangle: Rectangle, png: str, css_class: str) -> str:
        """Return a raster image (a data URI) that fills a rectangle."""
        x, y, width, height = rectangle
        position = f'x="{x:.2f}" y="{y:.2f}" width="{width:.2f}" height="{height:.2f}"'
        rendering = 'preserveAspectRatio="none" image-rendering="pixelated"'
        return f'<image class="{css_class}" {position} {rendering} href="{png}"/>'

    def svg(self, parts: Iterable[str], alt: str, bar: ColourBar | ColourClasses | None = None) -> str:
        """Return the complete figure.

        Parameters
        ----------
        parts
            Shapes of the map, those at the bottom first.
        alt
            Text for people who do not see the figure.
        bar
            A colour bar below the map.
        """
        base = self.top + self.frame_height
        height = base + 40.0
        colour_bar = north_arrow = ""
        if bar:
            centre = self.left + self.frame_width / 2
            title = bar.title_lines(2.0 * min(centre, self.width - centre))
            height += 56.0 + _LINE_SPACING * (len(title) - 1)
            colour_bar = bar.svg(self.prefix, (self.left, base + 46.0), self.frame_width, title, self.style)
        if self.north:
            north_arrow = self._north_arrow()
        position = f'x="{self.left:.1f}" y="{self.top:.1f}"'
        frame = f'<rect {position} width="{self.frame_width:.1f}" height="{self.frame_height:.1f}"/>'
        clip = f'<clipPath id="{self.prefix}-clip">{frame}</clipPath>'
        drawing = "\n".join(parts)
        lines = [
            svg_start_tag(self.width, height, alt, self.style),
            f'<defs>{clip}</defs>{self._axes(base)}\n<g clip-path="url(#{self.prefix}-clip)">{drawing}</g>',
            north_arrow,
            colour_bar,
            "</svg>",
        ]
        return "\n".join(lines)

    def _axes(self, base: float) -> str:
        width, height = self.frame_width, self.frame_height
        lines, texts = [], []
        ticks = [f"M{self.left:.1f} {self.top:.1f}h{width:.1f}v{height:.1f}h{-width:.1f}z"]
        for value, text in self._x_ticks:
            x = self.x(value)
            lines.append(f"M{x:.1f} {self.top:.1f}V{base:.1f}")
            ticks.append(f"M{x:.1f} {base:.1f}v5")
            texts.append(_text(x, base + 18, text))
        for value, text in self._y_ticks:
            y = self.y(value)
            lines.append(f"M{self.left:.1f} {y:.1f}H{self.left + width:.1f}")
            ticks.append(f"M{self.left:.1f} {y:.1f}h-5")
            texts.append(_text(self.left - 8, y + 4, text, "end"))

        side = self.left - 16.0 - self._y_tick_width
        centre, middle = self.left + width / 2, self.top + height / 2
        texts.append(
            f'<text x="{centre:.1f}" y="{base + 34:.1f}" class="title" text-anchor="middle">x, east (m)</text>'
        )
        texts.append(
            f'<text class="title" transform="translate({side:.1f} {middle:.1f}) rotate(-90)" text-anchor="middle">'
            "y, north (m)</text>"
        )
        grid = f'<path {self.style.shape("grid")} d="{"".join(lines)}"/>'
        return f'{grid}<path {self.style.shape("axis")} d="{"".join(ticks)}"/>{"".join(texts)}'

    def _north_arrow(self) -> str:
        x, y = self.left + self.frame_width + 20.0, self.top
        arrow = f'<path {self.style.shape("north")} d="M{x:.1f} {y + 14:.1f}l7 24l-7 -6l-7 6z"/>'
        return f'<g>{arrow}<text x="{x:.1f}" y="{y + 10:.1f}" text-anchor="middle" font-weight="700">N</text></g>'


_NARROW_WIDTH, _USUAL_WIDTH, _WIDE_WIDTH = 4.5, 7.8, 12.0
_NARROW_LETTERS, _WIDE_LETTERS = set(" .,:;'|!()[]fijlrtI-·"), set("@%mwMW+…")


def text_width(text: str) -> float:
    """Return about the width of a text in a figure's units, rather too large than too small.

    For letters of :data:`FONTS`, of which DejaVu Sans is the widest.
    """
    width = 0.0
    for letter in text:
        if letter in _NARROW_LETTERS:
            width += _NARROW_WIDTH
        elif letter in _WIDE_LETTERS:
            width += _WIDE_WIDTH
        else:
            width += _USUAL_WIDTH
    return width


def wrap_text(text: str, width: float) -> list[str]:
    """Return the lines of a text, each at most about ``width`` wide unless it is a single word."""
    lines: list[str] = []
    for word in text.split():
        if lines and text_width(f"{lines[-1]} {word}") <= width:
            lines[-1] += f" {word}"
        else:
            lines.append(word)
    return lines


def _text(x: float, y: float, text: str, anchor: str = "middle") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


@dataclass(frozen=True)
class ColourBar:
    """A colour bar from ``low`` to ``high`` (which is larger), with a square-root scale unless ``even``."""

    low: float
    high: float
    label: str
    even: bool = False

    def title_lines(self, width: float) -> list[str]:
        """Return the label and the kind of scale, in lines of at most a width, in the figure's units."""
        lines = wrap_text(self.label, width)
        if self.even:
            return lines
        with_scale = f"{lines[-1]} · {_SCALE_NOTE}"
        if text_width(with_scale) <= width:
            return [*lines[:-1], with_scale]
        return [*lines, _SCALE_NOTE]

    def svg(
        self, prefix: str, corner: tuple[float, float], width: float, title: Sequence[str],
        style: FigureStyle = PAGE_STYLE,
    ) -> str:  # fmt: skip
        """Return the bar with its left upper corner at ``corner`` and the lines of its title below.

        ``prefix`` makes its id unique.
        """
        x, y = corner
        stops = []
        for i in range(STEPS + 1):
            share = i / STEPS
            alpha = 1.0 if self.even else opacity(share)
            stops.append(f'<stop {style.shape(f"q{i}")} offset="{share:.4f}" stop-opacity="{alpha:.2f}"/>')
        gradient = f'<linearGradient id="{prefix}-scale">{"".join(stops)}</linearGradient>'
        axis = style.shape("axis")
        position = f'x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="12"'
        bar = f'<rect {axis} style="fill:url(#{prefix}-scale)" {position}/>'
        ticks = []
        for tick_x, text in self._ticks(x, width):
            ticks.append(f'<path {axis} d="M{tick_x:.1f} {y + 12:.1f}v4"/>{_text(tick_x, y + 28, text)}')
        texts = []
        for number, line in enumerate(title):
            position = f'x="{x + width / 2:.1f}" y="{y + 44 + _LINE_SPACING * number:.1f}"'
            texts.append(f'<text class="title" {position} text-anchor="middle">{escape(line)}</text>')
        return f"<g>{gradient}{bar}{''.join(ticks)}{''.join(texts)}</g>"

    def _ticks(self, x: float, width: float) -> list[Tick]:
        """Positions and texts of round values; a square-root scale has more of them near its low end."""
        span = self.high - self.low
        ticks = round_values(self.low, self.high, 6)
        if not self.even:
            ticks = [*round_values(0.0, span / 25, 2), *round_values(0.0, span / 4, 4), *ticks]
        placed: list[Tick] = []
        for value in sorted({tick.value for tick in ticks}, reverse=True):
            text = f"{value:,.6g}"
            share = (value - self.low) / span
            if not self.even:
                share = math.sqrt(share)
            tick_x = x + width * share
            if all(abs(tick_x - other.value) > 5.0 * (len(text) + len(other.text)) for other in placed):
                placed.append(Tick(tick_x, text))
        return placed


@dataclass(frozen=True)
class ColourClasses:
    """A row of coloured boxes, one for each class of values, evenly spaced on the scale; two classes or more."""

    labels: tuple[str, ...]
    label: str

    def title_lines(self, width: float) -> list[str]:
        """Return the label in lines of at most a width, in the figure's units."""
        return wrap_text(self.label, width)

    def svg(
        self, prefix: str, corner: tuple[float, float], width: float, title: Sequence[str],
        style: FigureStyle = PAGE_STYLE,
    ) -> str:  # fmt: skip
        """Return the boxes with their texts, see :meth:`ColourBar.svg`; ``prefix`` is not used."""
        del prefix
        (x, y), count = corner, len(self.labels)
        each = width / count
        parts = []
        for number, text in enumerate(self.labels):
            colour = style.shape(f"q{round(STEPS * number / (count - 1))}")
            left = x + each * number
            parts.append(f'<rect {colour} x="{left:.1f}" y="{y:.1f}" width="{each:.1f}" height="12"/>')
            parts.append(_text(left + each / 2.0, y + 28, text))
        for number, line in enumerate(title):
            position = f'x="{x + width / 2:.1f}" y="{y + 44 + _LINE_SPACING * number:.1f}"'
            parts.append(f'<text class="title" {position} text-anchor="middle">{escape(line)}</text>')
        return f"<g>{''.join(parts)}</g>"


def svg_start_tag(width: float, height: float, alt: str, style: FigureStyle = PAGE_STYLE) -> str:
    """Return the first tag of a figure."""
    attributes = f'class="plan" viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(alt)}"'
    if style.theme is not None:
        height_mm = style.width_mm * float(f"{height:.0f}") / float(f"{width:.0f}")
        attributes += (
            f' xmlns="{_NAMESPACE}" width="{style.width_mm:g}mm" height="{height_mm:.3f}mm"'
            f' fill="{style.theme.ink}" font-size="12" font-family="{FONTS}"'
        )
    return f"<svg {attributes}>"


def round_values(low: float, high: float, count: int) -> list[Tick]:
    """Return about ``count`` round values from ``low`` to ``high``, or fewer."""
    span = high - low
    if not span > 0:
        return []
    exponent = math.floor(math.log10(span / count))
    for power in (exponent - 1, exponent, exponent + 1):
        for digit in (1, 2, 5):
            step = float(f"{digit}e{power}")
            if step >= 0.999 * span / count:
                first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
                return [Tick(i * step, f"{i * step:,.{max(0, -power)}f}") for i in range(first, last + 1)]
    raise AssertionError(f"no round step for {low} to {high}")


@dataclass(frozen=True)
class CurveStep:
    """Score of the best plan found with ``count`` sensors, and its upper bound; shares of that of all candidates."""

    count: int
    share: float
    bound: float


_CURVE_WIDTH, _CURVE_HEIGHT = 460.0, 250.0
_CURVE_LEFT, _CURVE_TOP, _CURVE_BOTTOM = 56.0, 14.0, 44.0
_MAX_LABELS = 12
_MIN_CUT_SHARE = 0.8
"""If each bar is longer than this share of the axis, the axis starts above 0, so that the bars look different."""
_SHORTEST_BAR = 0.25
"""Length of the shortest bar, as a share of an axis that starts above 0; at least, up to the rounding of its start."""
_MAX_AXIS_START = 0.95
"""Maximum start of the axis, as a share of its end."""


def sensor_count_axis_start(steps: Sequence[CurveStep]) -> float:
    """Return the share at which the axis of :func:`sensor_count_chart` starts: 0, unless all bars are long."""
    top = max(1.0, *(step.bound for step in steps))
    shortest = min(step.share for step in steps)
    if shortest < _MIN_CUT_SHARE * top:
        return 0.0
    start = min((shortest - _SHORTEST_BAR * top) / (1.0 - _SHORTEST_BAR), _MAX_AXIS_START * top)
    first, second, *_ = round_values(100.0 * start, 100.0 * top, 5)
    step = second.value - first.value
    return math.floor(100.0 * start / step) * step / 100.0


def sensor_count_chart(steps: Sequence[CurveStep], alt: str) -> str:
    """Return a chart with one bar per number of sensors, and a mark above it for the upper bound."""
    width, height = _CURVE_WIDTH - _CURVE_LEFT - 12.0, _CURVE_HEIGHT - _CURVE_TOP - _CURVE_BOTTOM
    top = max(1.0, *(step.bound for step in steps))
    start = sensor_count_axis_start(steps)
    base, spacing, scale = _CURVE_TOP + height, width / len(steps), height / (top - start)
    parts = [svg_start_tag(_CURVE_WIDTH, _CURVE_HEIGHT, alt)]
    for value, _ in round_values(100.0 * start, 100.0 * top, 5):
        y = base - scale * (value / 100.0 - start)
        parts.append(f'<path class="grid" d="M{_CURVE_LEFT:.1f} {y:.1f}h{width:.1f}"/>')
        parts.append(_text(_CURVE_LEFT - 8, y + 4, f"{value:g} %", "end"))
    label_step = 1
    if len(steps) > _MAX_LABELS:
        label_step += len(steps) // _MAX_LABELS
    for i, step in enumerate(steps):
        x, bar = _CURVE_LEFT + i * spacing, scale * (step.share - start)
        bound = base - scale * (step.bound - start)
        title = (
            f"{step.count} sensors: {format_percent(step.share)} of the score of all candidates; at "
            f"most {format_percent(step.bound)}"
        )
        parts.append(
            f'<g class="step"><title>{escape(title)}</title>'
            f'<rect x="{x + 0.14 * spacing:.1f}" y="{base - bar:.1f}" width="{0.72 * spacing:.1f}" height="{bar:.1f}"/>'
            f'<path d="M{x + 0.06 * spacing:.1f} {bound:.1f}h{0.88 * spacing:.1f}"/></g>'
        )
        if i % label_step == 0:
            parts.append(_text(x + spacing / 2, base + 17, str(step.count)))
    parts.append(f'<path class="axis" d="M{_CURVE_LEFT:.1f} {_CURVE_TOP:.1f}v{height:.1f}h{width:.1f}"/>')
    title = "sensors"
    if start > 0:
        title += f" (the axis starts at {100.0 * start:g} %, not at 0)"
    parts.append(_text(_CURVE_LEFT + width / 2, base + 36, title))
    return "".join([*parts, "</svg>"])


_BARS_TOP, _BAR_SPACING, _BARS_BOTTOM, _BARS_MARGIN = 8.0, 18.0, 44.0, 16.0


@dataclass(frozen=True)
class Bar:
    """A bar of a chart: name of the site, its score, standard error (None if unknown), and a description."""

    name: str
    value: float
    se: float | None
    description: str


def bar_chart(
    bars: Sequence[Bar], label: str, alt: str, factor: float = 1.0, style: FigureStyle = PAGE_STYLE, note: str = ""
) -> str:
    """Return horizontal bars, the first at the top.

    Parameters
    ----------
    bars
        At least one.
    label
        Title of the axis.
    alt
        Text for people who do not see the figure.
    factor
        Numbers on the axis are values times this: 100 for per cent.
    style
        Width and colours.
    note
        A line below the title of the axis.
    """
    names = [shorten_name(bar.name) for bar in bars]
    left = 15.0 + max(text_width(name) for name in names)
    width, height = style.width - left - _BARS_MARGIN, _BAR_SPACING * len(bars)
    most = max(bar.value + (bar.se or 0.0) for bar in bars) or 1.0
    values = [bar.value for bar in bars]
    low, high = min(values), max(values)
    base = _BARS_TOP + height
    parts = [svg_start_tag(style.width, base + _BARS_BOTTOM + (_LINE_SPACING if note else 0.0), alt, style)]
    for value, text in round_values(0.0, most * factor, max(2, int(width // 70))):
        x = left + width * value / factor / most
        parts.append(f'<path {style.shape("grid")} d="M{x:.1f} {_BARS_TOP:.1f}V{base:.1f}"/>')
        parts.append(_text(x, base + 17, text))
    for row, (bar, name) in enumerate(zip(bars, names, strict=True)):
        y, length = _BARS_TOP + _BAR_SPACING * row, width * bar.value / most
        colour = style.shape(f"q{colours.colour_class(bar.value, low, high)}")
        position = f'x="{left:.1f}" y="{y + 3:.1f}" width="{length:.1f}" height="{_BAR_SPACING - 6:.1f}"'
        parts.append(
            f'<g class="bar"><title>{escape(f"{bar.name}: {bar.description}")}</title><rect {colour} {position}/>'
        )
        parts.append(f"{_error_bar(bar, left, y, width / most, style)}</g>")
        parts.append(_text(left - 7, y + 13, name, "end"))
    parts.append(f'<path {style.shape("axis")} d="M{left:.1f} {_BARS_TOP:.1f}V{base:.1f}H{left + width:.1f}"/>')
    parts.append(_text(left + width / 2, base + 36, label))
    if note:
        parts.append(_text(left + width / 2, base + 36 + _LINE_SPACING, note))
    return "".join([*parts, "</svg>"])


def _error_bar(bar: Bar, left: float, y: float, scale: float, style: FigureStyle) -> str:
    """One standard error to either side."""
    if not bar.se:
        return ""
    start = left + max(0.0, bar.value - bar.se) * scale
    end = left + max(0.0, bar.value + bar.se) * scale
    middle = y + _BAR_SPACING / 2
    caps = "".join(f"M{x:.1f} {middle - 3:.1f}v6" for x in (start, end))
    line = f'd="M{start:.1f} {middle:.1f}H{end:.1f}{caps}"'
    halo = f'<path style="stroke:#ffffff;stroke-width:2.8;fill:none" {line}/>'
    return f"{halo}<path {style.shape('lead')} {line}/>"
