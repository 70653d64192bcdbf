"""What ``egvs compare --tpog`` prints: the traffic of a recorded and a simulated run, side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from egvs.cli.console import WIDE, Column, console, make_table
from egvs.core.wording import format_percent
from egvs.extensions.tracks.comparison.tpog_page import format_bit, format_measured, format_share, format_speed

FULLY_COVERED = 0.95
"""A smaller covered share of the lanes is reported."""

if TYPE_CHECKING:
    from egvs.extensions.tracks.comparison.tpog_comparison import LaneComparison, TpogComparison


def print_tpog_comparison(comparison: TpogComparison, page: Path, top: int | None = None) -> None:
    """Print a comparison of traffic.

    Parameters
    ----------
    comparison
        The numbers.
    page
        The page that has all of them.
    top
        How many lanes are printed, the busiest first; all for None.
    """
    columns: list[Column[LaneComparison]] = [
        Column("lane", lambda lane: lane.words, "left", wrap=True),
        Column("distance", lambda lane: format_measured(lane.distance)),
        Column("occupancy recorded", lambda lane: format_share(lane.occupancy[0])),
        Column("simulated", lambda lane: format_share(lane.occupancy[1])),
        Column("m/s recorded", lambda lane: format_speed(lane.speed.mean_m_s[0] if lane.speed else None)),
        Column("simulated", lambda lane: format_speed(lane.speed.mean_m_s[1] if lane.speed else None)),
        Column("speed distance", lambda lane: format_speed(lane.speed.distance_m_s if lane.speed else None)),
    ]
    out = console(WIDE)
    out.print(make_table(columns, comparison.lanes[:top]))
    recorded, simulated, difference = comparison.entropy_bit
    out.print(f"Jensen-Shannon distance over all lanes: {format_measured(comparison.distance)}")
    occupancy = [format_share(each) for each in comparison.occupancy]
    out.print(f"mean occupancy of the lanes: {occupancy[0]} recorded, {occupancy[1]} simulated")
    out.print(
        f"entropy: {format_bit(recorded)} bit recorded, {format_bit(simulated)} bit simulated,"
        f" difference {format_bit(difference)} bit"
    )
    ranks = comparison.ranks
    if ranks is not None:
        out.print(
            f"ranks of {ranks.sites:,} sites: Kendall's tau {format_measured(ranks.tau)}; best site {ranks.best[0]}"
            f" recorded, {ranks.best[1]} simulated, which loses {format_share(ranks.lost)} of the best recorded score"
        )
        if ranks.note:
            out.print(f"note: no standard errors of the ranks: {ranks.note}")
    if comparison.covered_share < FULLY_COVERED:
        share = format_percent(comparison.covered_share)
        out.print(
            f"note: the recording covered {share} of the area of the lanes; only this part counts, except in the ranks"
        )
    first, second = comparison.blocks
    out.print(f"± is one standard error, from {first} and {second} groups of blocks")
    out.print(f"page: {page}")
