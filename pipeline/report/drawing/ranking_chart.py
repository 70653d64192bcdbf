"""A figure of a ranking: a bar a site, with how far its score may be off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from pipeline.report.drawing import colours
from pipeline.report.drawing.map_frame import round_values, svg_start

_TOP, _EACH, _BOTTOM, _RIGHT = 8.0, 18.0, 44.0, 16.0
_LONGEST = 18
"""Letters of a name; longer ones are cut."""


@dataclass(frozen=True)
class Bar:
    """A site's name, its score, its standard error (None where it is not known), and its score in words."""

    name: str
    value: float
    se: float | None
    words: str


def chart(bars: Sequence[Bar], label: str, alt: str, width: float, factor: float = 1.0) -> str:
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
    names = [bar.name if len(bar.name) <= _LONGEST else f"{bar.name[: _LONGEST - 1]}…" for bar in bars]
    left = 16.0 + 7.0 * max(len(name) for name in names)
    wide, tall = width - left - _RIGHT, _EACH * len(bars)
    most = max(bar.value + (bar.se or 0.0) for bar in bars) or 1.0
    low, high, base = min(bar.value for bar in bars), max(bar.value for bar in bars), _TOP + tall
    parts = [svg_start(width, base + _BOTTOM, alt)]
    for value, text in round_values(0.0, most * factor, max(2, int(wide // 70))):
        x = left + wide * value / factor / most
        parts.append(f'<path class="grid" d="M{x:.1f} {_TOP:.1f}V{base:.1f}"/>')
        parts.append(f'<text x="{x:.1f}" y="{base + 17:.1f}" text-anchor="middle">{text}</text>')
    for row, (bar, name) in enumerate(zip(bars, names, strict=True)):
        y, long = _TOP + _EACH * row, wide * bar.value / most
        shape = f'x="{left:.1f}" y="{y + 3:.1f}" width="{long:.1f}" height="{_EACH - 6:.1f}"'
        parts.append(f'<g class="bar"><title>{escape(f"{bar.name}: {bar.words}")}</title>')
        parts.append(
            f'<rect class="q{colours.step(bar.value, low, high)}" {shape}/>{_error(bar, left, y, wide / most)}</g>'
        )
        parts.append(f'<text x="{left - 7:.1f}" y="{y + 13:.1f}" text-anchor="end">{escape(name)}</text>')
    parts.append(f'<path class="axis" d="M{left:.1f} {_TOP:.1f}V{base:.1f}H{left + wide:.1f}"/>')
    parts.append(
        f'<text x="{left + wide / 2:.1f}" y="{base + 36:.1f}" text-anchor="middle">{escape(label)}</text></svg>'
    )
    return "".join(parts)


def _error(bar: Bar, left: float, y: float, scale: float) -> str:
    """One standard error to either side."""
    if not bar.se:
        return ""
    start, end = (left + max(0.0, bar.value + side * bar.se) * scale for side in (-1.0, 1.0))
    middle = y + _EACH / 2
    ends = "".join(f"M{x:.1f} {middle - 3:.1f}v6" for x in (start, end))
    line = f'd="M{start:.1f} {middle:.1f}H{end:.1f}{ends}"/>'
    return f'<path style="stroke:#ffffff;stroke-width:2.8;fill:none" {line}<path class="lead" {line}'
