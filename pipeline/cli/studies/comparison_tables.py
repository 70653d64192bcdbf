"""Tables of ``egvs compare``: runs side by side, how well their rankings agree, what differs between them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from pipeline.cli.terminal import NARROW, console, table
from pipeline.report.score_words import SCORES
from pipeline.studies.run_comparison import ComparedRun, Comparison, SiteResult

_FILE_WIDTH = 190
_GAP = 2
"""Columns between two of rich's."""
_PLACE, _DEGREES = 28, 26
"""What x, y, z and what longitude and latitude take."""


def print_comparison(found: Comparison, top: int | None = None) -> None:
    """Everything; the ``top`` sites of the first run where that is given."""
    out = console(_FILE_WIDTH, soft_wrap=False)
    for run in found.runs:
        out.print(f"{run.label}  {run.folder}", soft_wrap=True)
    out.print()
    for part in _fitting(found.runs, out.width):
        out.print(_site_table(found, part, found.sites[:top], out.width))
        out.print()
    out.print(_agreement_table(found))
    out.print()
    if found.differences:
        out.print(_difference_table(found))
    else:
        out.print("their settings and files are the same")
    _print_notes(out, found.notes)


def _print_notes(out: Console, notes: Sequence[str]) -> None:
    for note in notes:
        out.print(f"note: {note}", soft_wrap=True)


def _columns(run: ComparedRun, is_wide: bool) -> list[str]:
    label = run.label
    first, second = ("bit", "of limit") if run.rank_by == "egvs" else (SCORES[run.rank_by].head, "bit")
    names = [f"{label} {first}", *([f"{label} error"] if is_wide else []), f"{label} {second}", f"{label} rank"]
    return names if is_wide or len(label) == 1 else names[-2:]


def _fitting(runs: Sequence[ComparedRun], width: int) -> list[Sequence[ComparedRun]]:
    """Runs in as many tables as the width needs, the first in each of them, so that it stands beside every other."""
    is_wide = width >= NARROW
    each = max(sum(max(len(name), 8) + _GAP for name in _columns(run, is_wide)) for run in runs)
    sites = [site for run in runs for site in run.sites.values()]
    taken = max(len(site.site) for site in sites) + _GAP if sites else 0
    if is_wide:
        taken += _PLACE + (_DEGREES if any(site.longitude_deg is not None for site in sites) else 0)
    room = max(2, (width - taken) // each)
    first, others = runs[:1], runs[1:]
    return [(*first, *others[start : start + room - 1]) for start in range(0, len(others), room - 1)]


def _site_table(found: Comparison, runs: Sequence[ComparedRun], sites: Sequence[str], width: int) -> Table:
    is_wide = width >= NARROW
    shown = [next(run.sites[site] for run in found.runs if site in run.sites) for site in sites]
    has_degrees = is_wide and any(site.longitude_deg is not None for site in shown)
    names = ["site", *(["x m", "y m", "z m"] if is_wide else []), *(["longitude", "latitude"] if has_degrees else [])]
    of_runs = [name for run in runs for name in _columns(run, is_wide)]
    rows = table([*names, *of_runs], left=("site",), whole=[*names[1:], *of_runs])
    for site in shown:
        cells: dict[str, str] = {"site": site.site, "longitude": "-", "latitude": "-"}
        cells |= {name: f"{value:.2f}" for name, value in zip(("x m", "y m", "z m"), site.pose, strict=False)}
        if site.longitude_deg is not None and site.latitude_deg is not None:
            cells |= {"longitude": f"{site.longitude_deg:.6f}", "latitude": f"{site.latitude_deg:.6f}"}
        for run in runs:
            cells |= _cells(run, run.sites.get(site.site))
        rows.add_row(*(cells[name] for name in (*names, *of_runs)))
    return rows


def _cells(run: ComparedRun, site: SiteResult | None) -> dict[str, str]:
    label, by = run.label, SCORES[run.rank_by]
    if site is None:
        return {f"{label} {name}": "-" for name in ("bit", "error", "of limit", "rank", by.head)}
    return {
        f"{label} {by.head}": by.value(site.score),
        f"{label} bit": f"{site.egvs:.1f}",
        f"{label} error": by.error(site.score, site.egvs_se if site.other is None else site.other_se),
        f"{label} of limit": "-" if site.share is None else f"{site.share:.1%}",
        f"{label} rank": str(site.rank),
    }


def _agreement_table(found: Comparison) -> Table:
    names = ("runs", "sites in both", "tau", "rho", "best", "lost by trusting the first's best")
    rows = table(names, left=("runs", "best"), whole=("runs", "tau", "rho"))
    for pair in found.agreements:
        same = "the same: " if pair.best_a == pair.best_b else ""
        best = same + _few(pair.best_a) if same else f"{_few(pair.best_a)} / {_few(pair.best_b)}"
        tau, rho = ("-" if value is None else f"{value:.2f}" for value in (pair.tau, pair.rho))
        lost = "-" if pair.regret_a is None else f"{pair.regret_a:.2%}"
        rows.add_row(f"{pair.a}, {pair.b}", str(pair.shared), tau, rho, best if pair.shared else "-", lost)
    return rows


def _few(sites: tuple[str, ...]) -> str:
    return ", ".join(sites[:2]) + (f" and {len(sites) - 2} more" if len(sites) > 2 else "")


def _difference_table(found: Comparison) -> Table:
    labels = [run.label for run in found.runs]
    rows = table(["what differs", *labels], left=["what differs", *labels])
    for difference in found.differences:
        rows.add_row(difference.what, *(_value(value) for value in difference.values))
    return rows


def _value(value: Any) -> str:
    if value is None:
        return "-"
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
