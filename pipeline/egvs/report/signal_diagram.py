"""Stage diagrams: who has green when, as bars over the cycle of a signal."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any

from egvs.core.wording import shorten_id
from egvs.drawing.svg_figures import PAGE_STYLE, round_values, svg_start_tag, text_width
from egvs.traffic.signal_descriptions import plan_title

_TOP, _BOTTOM, _ROW, _RIGHT = 8.0, 44.0, 22.0, 16.0
_BAR_INSET = 4.0
_MAX_LETTERS = 30

_GREEN, _GIVES_WAY, _YELLOW, _RED = "#1f7a4d", "#8fd0ae", "#e0a800", "#c8453b"
"""Colours of signals, which are the same in the light and in the dark theme."""


def signal_diagrams(plans: Sequence[Mapping[str, Any]]) -> list[tuple[str, str, str]]:
    """Return title, way of control and diagram (SVG text) of the plans that do not replay.

    Parameters
    ----------
    plans
        From :func:`egvs.traffic.signal_descriptions.describe_signals`.
    """
    diagrams = []
    for plan in plans:
        if not plan["rows"]:
            continue
        cycle = f"Cycle {plan['cycle_s']:g} s"
        if plan["type"] != "fixed":
            cycle = f"Cycle up to {plan['cycle_s']:g} s, {plan['type']}: drawn with the longest greens"
        cycle += f"; offset {plan['offset_s']:g} s; {plan['source']}."
        diagrams.append((plan_title(plan), cycle, stage_diagram(plan)))
    return diagrams


def stage_diagram(plan: Mapping[str, Any]) -> str:
    """Return the bars of all movements over one cycle: green, paler where it gives way, yellow, and a line for red.

    Parameters
    ----------
    plan
        A plan of :func:`egvs.traffic.signal_descriptions.describe_signals`.
    """
    rows = plan["rows"]
    names = [_row_name(row) for row in rows]
    left = 15.0 + max(text_width(name) for name in names)
    width = PAGE_STYLE.width - left - _RIGHT
    base = _TOP + _ROW * len(rows)
    scale = width / plan["cycle_s"]
    alt = f"Stage diagram of the signals at {plan_title(plan)}: {_greens_in_words(rows)}"
    parts = [svg_start_tag(PAGE_STYLE.width, base + _BOTTOM, alt, PAGE_STYLE)]
    for value, text in round_values(0.0, plan["cycle_s"], max(2, int(width // 70))):
        x = left + scale * value
        parts.append(f'<path {PAGE_STYLE.shape("grid")} d="M{x:.1f} {_TOP:.1f}V{base:.1f}"/>')
        parts.append(f'<text x="{x:.1f}" y="{base + 17:.1f}" text-anchor="middle">{text}</text>')
    for number, (row, name) in enumerate(zip(rows, names, strict=True)):
        y = _TOP + _ROW * number
        middle = y + _ROW / 2
        parts.append(f'<text x="{left - 7:.1f}" y="{middle + 4:.1f}" text-anchor="end">{escape(name)}</text>')
        line = f'd="M{left:.1f} {middle:.1f}H{left + width:.1f}"'
        parts.append(f'<path style="stroke:{_RED};stroke-width:2.5;fill:none" {line}/>')
        parts += _bars(row, left, y, scale)
    parts.append(f'<path {PAGE_STYLE.shape("axis")} d="M{left:.1f} {_TOP:.1f}V{base:.1f}H{left + width:.1f}"/>')
    parts.append(
        f'<text x="{left + width / 2:.1f}" y="{base + 36:.1f}" text-anchor="middle">seconds in the cycle</text>'
    )
    return "".join([*parts, "</svg>"])


def _row_name(row: Mapping[str, Any]) -> str:
    """Return approach and movements; the street is cut where it is long, the side of the approach is kept."""
    approach = row["approach"]
    if len(approach) > _MAX_LETTERS:
        street, bracket, side = approach.rpartition(" (")
        end = f"{bracket}{shorten_id(side)}" if street else ""
        approach = f"{approach[: max(_MAX_LETTERS - 1 - len(end), 0)]}…{end}"
    return f"{approach}: {', '.join(row['movements'])}"


def _greens_in_words(rows: Sequence[Mapping[str, Any]]) -> str:
    texts = []
    for row in rows:
        times = " and ".join(f"{begin_s:g} to {end_s:g} s" for begin_s, end_s in row["green_s"]) or "never"
        texts.append(f"{row['approach']} {', '.join(row['movements'])} green {times}")
    return "; ".join(texts)


def _bars(row: Mapping[str, Any], left: float, y: float, scale: float) -> Iterator[str]:
    """Yield the bars of a movement, the greens with their seconds where these fit."""
    fill, ink = (_GIVES_WAY, "#14181f") if row["gives_way"] else (_GREEN, "#ffffff")
    for colour, intervals in ((fill, row["green_s"]), (_YELLOW, row["yellow_s"])):
        for begin_s, end_s in intervals:
            length = scale * (end_s - begin_s)
            position = f'x="{left + scale * begin_s:.1f}" y="{y + _BAR_INSET:.1f}" width="{length:.1f}"'
            yield f'<rect style="fill:{colour}" {position} height="{_ROW - 2 * _BAR_INSET:.1f}"/>'
    for begin_s, end_s in row["green_s"]:
        label = f"{end_s - begin_s:g} s"
        if scale * (end_s - begin_s) > text_width(label) + 6:
            x = left + scale * (begin_s + end_s) / 2
            yield f'<text x="{x:.1f}" y="{y + _ROW / 2 + 4:.1f}" text-anchor="middle" style="fill:{ink}">{label}</text>'
