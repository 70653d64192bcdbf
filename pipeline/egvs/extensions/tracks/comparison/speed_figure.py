"""Cumulative distributions of the speeds on a lane, recorded and simulated, as SVG."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from egvs.core.grid import FloatArray
from egvs.core.wording import format_percent
from egvs.drawing.svg_figures import FigureStyle, round_values, svg_start_tag
from egvs.extensions.tracks.comparison.lane_speeds import BIN_M_S

_WIDTH, _HEIGHT = 360.0, 190.0
_LEFT, _TOP, _RIGHT, _BOTTOM = 44.0, 10.0, 12.0, 40.0
_LINES = (
    "stroke:currentColor;stroke-width:2;fill:none",
    "stroke:#e8590c;stroke-width:2;stroke-dasharray:6 3;fill:none",
)
"""Recorded: a line in the colour of the text; simulated: an orange dashed one."""


def draw_speeds(cumulative: Sequence[FloatArray], top_m_s: float, alt: str) -> str:
    """Return the figure.

    Parameters
    ----------
    cumulative
        Share of speeds up to the end of each bin, recorded and simulated.
    top_m_s
        End of the axis.
    alt
        Text for people who do not see the figure.
    """
    width, height = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM
    base = _TOP + height
    parts = [svg_start_tag(_WIDTH, _HEIGHT, alt, FigureStyle(width=_WIDTH))]
    for share in (0.0, 0.5, 1.0):
        y = base - height * share
        parts.append(f'<path class="grid" d="M{_LEFT:.1f} {y:.1f}h{width:.1f}"/>')
        parts.append(_text(_LEFT - 7, y + 4, format_percent(share, 0), "end"))
    for value, text in round_values(0.0, top_m_s, 6):
        parts.append(_text(_LEFT + width * value / top_m_s, base + 16, text))
    for shares, line in zip(cumulative, _LINES, strict=True):
        n_shown = min(int(np.ceil(top_m_s / BIN_M_S)), shares.size)
        points = [(0.0, 0.0), *((BIN_M_S * (k + 1), float(shares[k])) for k in range(n_shown))]
        path = "L".join(f"{_LEFT + width * min(x / top_m_s, 1.0):.1f} {base - height * y:.1f}" for x, y in points)
        parts.append(f'<path style="{line}" d="M{path}"/>')
    parts.append(f'<path class="axis" d="M{_LEFT:.1f} {_TOP:.1f}V{base:.1f}h{width:.1f}"/>')
    parts.append(_text(_LEFT + width / 2, base + 33, "speed (m/s)"))
    return "".join([*parts, "</svg>"])


def highest_speed_m_s(cumulative: Sequence[FloatArray]) -> float:
    """Return the end of an axis that shows 99.5 % of all speeds."""
    highest = max((int(np.searchsorted(shares, 0.995)) + 1 for shares in cumulative), default=1)
    return BIN_M_S * highest


def _text(x: float, y: float, text: str, anchor: str = "middle") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'
