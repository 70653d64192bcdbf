"""``egvs compare RECORDED SIMULATED --tpog PAGE.html``; the entry point of the group ``egvs.traffic_comparisons``."""

from __future__ import annotations

from pathlib import Path

from egvs.cli.console import ProgressDisplay
from egvs.extensions.tracks.comparison import tpog_comparison, tpog_page, tpog_table


def compare_traffic(recorded: Path, simulated: Path, page: Path, top: int | None) -> None:
    """Compare the traffic of two runs, print the numbers, and write a page.

    Parameters
    ----------
    recorded, simulated
        The run folders.
    page
        HTML file to write.
    top
        How many lanes are printed, the busiest first; all for None.
    """
    with ProgressDisplay("compare") as screen:
        comparison = tpog_comparison.compare_tpogs(recorded, simulated, screen.progress)
        tpog_page.write_page(page, comparison)
    tpog_table.print_tpog_comparison(comparison, page, top)
