"""``egvs runs``: one line for each run folder."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from egvs.cli.console import Column, console, make_table
from egvs.cli.run_tables import format_age, format_size
from egvs.cli.sources import format_setting
from egvs.core.wording import list_first
from egvs.export.folder_kinds import find_kind
from egvs.results.labels import SCORE_LABELS
from egvs.runs.run_list import ListedRun

FILE_WIDTH = 100
"""Width of the table where standard output is no terminal."""

_WIDE = 140
"""Terminals of this width get the scenario, the settings and the number of sites, too."""

_MAX_BEST = 3
"""Sites of equal score that are named."""


def print_runs(runs: Sequence[ListedRun], *, with_details: bool = False) -> None:
    """Print the run folders.

    Parameters
    ----------
    runs
        The run folders.
    with_details
        Whether a paragraph with all settings is printed for each, instead of a line.
    """
    if not runs:
        print("no runs")
        return
    now_s = time.time()
    if with_details:
        print("\n\n".join(describe_run(run, now_s) for run in runs))
        return
    out = console(FILE_WIDTH, soft_wrap=False)
    out.print(runs_table(runs, out.width, now_s))
    if out.width < _WIDE and any(run.overrides for run in runs):
        out.print("egvs runs --verbose lists the settings in which each run differs from its scenario")


def _columns(now_s: float) -> list[Column[ListedRun]]:
    """Return what is listed of a run, its folder first; ``now_s`` is the time in seconds since 1970."""
    return [
        Column("run", lambda run: run.folder.name, "left", wrap=True),
        Column("scenario", _format_scenario, "left", wrap=True, min_width=_WIDE),
        Column("differs in", _format_overrides, "left", wrap=True, min_width=_WIDE),
        Column("state", _format_state, "left", wrap=True),
        Column("best", _format_best, "left", wrap=True),
        Column("score", _format_score),
        Column("sites", lambda run: "" if run.best is None else str(run.best.of_sites), min_width=_WIDE),
        Column("size", lambda run: format_size(run.size_bytes)),
        Column("last run", lambda run: _format_last_run(run, now_s)),
    ]


def runs_table(runs: Sequence[ListedRun], width: int, now_s: float) -> Table:
    """Return the table for a terminal of a width in characters; ``now_s`` is the time in seconds since 1970."""
    return make_table(_columns(now_s), runs, width=width)


def describe_run(run: ListedRun, now_s: float) -> str:
    """Return all that is listed of a run, in lines; ``now_s`` is the time in seconds since 1970."""
    lines = [str(run.folder)]
    for column in _columns(now_s)[1:]:
        if text := column.text(run):
            lines.append(f"  {column.title:<10}  {text}")
    return "\n".join(lines)


def _format_scenario(run: ListedRun) -> str:
    """Return the scenario's folder, relative to the present one if it is below."""
    if run.problem:
        return ""
    folder = run.scenario.resolve()
    present = Path.cwd()
    return os.path.relpath(folder, present) if folder.is_relative_to(present) else str(folder)


def _format_overrides(run: ListedRun) -> str:
    return ", ".join(f"{key}={format_setting(key, value)}" for key, value in run.overrides.items())


def _format_state(run: ListedRun) -> str:
    if (kind := find_kind(run.folder)) is not None:
        return kind.state
    if run.problem:
        return run.problem
    if run.missing:
        return f"without {', '.join(run.missing)}"
    return "complete"


def _format_best(run: ListedRun) -> str:
    return "" if run.best is None else list_first(run.best.names, _MAX_BEST)


def _format_score(run: ListedRun) -> str:
    """Return the score of the best site, and by which score sites are ranked."""
    if run.best is None:
        return ""
    label = SCORE_LABELS[run.best.rank_by]
    return f"{label.value(run.best.score)} {label.head}"


def _format_last_run(run: ListedRun, now_s: float) -> str:
    return f"{format_age(now_s - run.last_run_s)} ago"
