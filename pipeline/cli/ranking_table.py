"""The ranking of the sites as a table."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table

from pipeline.artefacts.readers import SEPARABLE
from pipeline.cli.terminal import NARROW, WIDE
from pipeline.report.ranking import ScoredSite


def ranking_table(sites: Sequence[ScoredSite], width: int = WIDE) -> Table:
    """Sites by rank; without poses and sensors where the terminal is narrow."""
    table = Table(box=None, pad_edge=False)
    is_wide, has_errors = width >= NARROW, any(site.egvs_se is not None for site in sites)
    if not all(site.is_separable for site in sites):
        table.caption = (
            f"~ not separable from the next site: the chance that it truly scores higher is below {SEPARABLE:.0%}"
        )
    pose = ["x m", "y m", "z m", "sensor"] if is_wide else []
    errors = ["std error", "beats next"] if has_errors else []
    beams = ["beams in ROI"] if is_wide else []
    for name in ("rank", "site", *pose, "EGVS bit", *errors, "of best", "entropy seen", *beams):
        left = name in ("site", "sensor")
        table.add_column(name, justify="left" if left else "right", no_wrap=name != "site", overflow="fold")
    best = max((site.egvs for site in sites), default=0.0)
    ordered = sorted(sites, key=lambda site: site.rank)
    for site in ordered:
        cells = [str(site.rank), site.site]
        if is_wide:
            cells += [f"{site.x_m:.2f}", f"{site.y_m:.2f}", f"{site.z_m:.2f}", site.sensor]
        cells.append(f"{site.egvs:.1f}")
        if has_errors:
            cells += _errors(site, is_last=site is ordered[-1])
        cells += [f"{site.egvs / best:.1%}" if best > 0 else "-", f"{site.entropy_seen:.1%}"]
        table.add_row(*cells, *([str(site.beams_in_roi)] if is_wide else []))
    return table


def _errors(site: ScoredSite, *, is_last: bool) -> list[str]:
    """How far a score may be off, and whether the site is told from the next."""
    known = "-" if site.relative_se is None else f"{site.relative_se:.1%}"
    return [known, "-" if is_last else f"{'' if site.is_separable else '~ '}{site.beats_next:.0%}"]
