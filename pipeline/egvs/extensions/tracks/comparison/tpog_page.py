"""The page of a comparison of a recorded with a simulated TPOG: numbers with standard errors, and both maps.

It is one file that loads nothing, and depends on the runs alone, not on a clock or a machine.
"""

from __future__ import annotations

from pathlib import Path

from egvs.core import files
from egvs.core.wording import format_percent
from egvs.drawing import maps, pages
from egvs.drawing.colours import ColumnValues
from egvs.drawing.maps import MapScale
from egvs.drawing.svg_figures import FigureStyle
from egvs.extensions.tracks.comparison import speed_figure
from egvs.extensions.tracks.comparison.tpog_comparison import LaneComparison, Measured, TpogComparison

TEMPLATES = Path(__file__).parent / "templates"

SIDES = ("recorded", "simulated")

MAX_SPEED_FIGURES = 6
"""Lanes whose distributions of speeds are drawn, the busiest first."""

_MAP_WIDTH = 460.0


def write_page(path: Path, comparison: TpogComparison) -> None:
    """Write the page.

    Parameters
    ----------
    path
        The file.
    comparison
        The numbers.
    """
    files.write_text(path, render_page(comparison))


def render_page(comparison: TpogComparison) -> str:
    """Return the page, HTML text.

    Parameters
    ----------
    comparison
        The numbers.
    """
    environment = pages.page_environment(
        TEMPLATES,
        measured=format_measured,
        measured_share=format_share,
        measured_bit=format_bit,
        measured_speed=format_speed,
    )
    return pages.render(
        environment,
        "tpog.html.j2",
        comparison=comparison,
        figures=draw_maps(comparison),
        speeds=draw_lane_speeds(comparison),
    )


def format_measured(measured: Measured | None) -> str:
    """Return a number with its standard error: "0.43 ± 0.03"."""
    if measured is None:
        return "–"
    if measured.se is None:
        return f"{measured.value:.2f}"
    return f"{measured.value:.2f} ± {measured.se:.2f}"


def format_share(measured: Measured) -> str:
    """Return a share in percent with its standard error: "2.4 ± 1.4 %"."""
    if measured.se is None:
        return format_percent(measured.value)
    return f"{100 * measured.value:.1f} ± {100 * measured.se:.1f} %"


def format_bit(measured: Measured) -> str:
    """Return bits with their standard error: "36,357 ± 12,943"."""
    if measured.se is None:
        return f"{measured.value:,.0f}"
    return f"{measured.value:,.0f} ± {measured.se:,.0f}"


def format_speed(measured: Measured | None) -> str:
    """Return a speed with its standard error: "7.3 ± 0.6"."""
    if measured is None:
        return "–"
    if measured.se is None:
        return f"{measured.value:.1f}"
    return f"{measured.value:.1f} ± {measured.se:.1f}"


def draw_lane_speeds(comparison: TpogComparison) -> list[tuple[LaneComparison, str]]:
    """Return lanes with the figure of their speeds, SVG text, all with one axis."""
    lanes = [(lane, lane.speed) for lane in comparison.lanes if lane.speed is not None][:MAX_SPEED_FIGURES]
    top_m_s = speed_figure.highest_speed_m_s([shares for _, speed in lanes for shares in speed.cumulative])
    figures = []
    for lane, speed in lanes:
        means = [f"{each.value:.1f} m/s {side}" for side, each in zip(SIDES, speed.mean_m_s, strict=True)]
        alt = f"Speeds on the {lane.words}: on average {' and '.join(means)}."
        figures.append((lane, speed_figure.draw_speeds(speed.cumulative, top_m_s, alt)))
    return figures


def draw_maps(comparison: TpogComparison) -> list[str]:
    """Return the maps of both TPOGs from above, with the same colour scale, SVG text."""
    values: list[ColumnValues] = [tpog.counts.max(axis=2) / tpog.frames for tpog in comparison.tpogs]
    peak = max(float(each.max(initial=0.0)) for each in values)
    label = "Share of the frames in which the column is occupied"
    figures = []
    for side, tpog, each in zip(SIDES, comparison.tpogs, values, strict=True):
        alt = f"The {side} occupancy from above; vehicles use {format_percent((each > 0).mean(), 0)} of the region."
        figures.append(
            maps.occupancy(
                tpog.grid, each, label, comparison.backdrop, (), alt, FigureStyle(width=_MAP_WIDTH),
                MapScale(f"tpog-{side}", peak),
            )
        )  # fmt: skip
    return figures
