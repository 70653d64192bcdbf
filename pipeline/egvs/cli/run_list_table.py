"""``egvs runs``: one line for each run folder."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

from egvs.city import results
from egvs.cli.console import Column, print_table
from egvs.cli.run_tables import format_age, format_size
from egvs.cli.sources import format_setting
from egvs.report.formatting import SCORE_LABELS
from egvs.runs.run_list import ListedRun

_MAX_BEST = 3
"""Sites of equal score that a line names."""


def print_runs(runs: Sequence[ListedRun]) -> None:
    """Print the run folders, or that there are none."""
    if not runs:
        print("no runs")
        return
    now = time.time()
    columns: list[Column[ListedRun]] = [
        Column("run", lambda run: run.folder.name, "left"),
        Column("scenario", _format_scenario, "left"),
        Column("differs in", _format_overrides, "left"),
        Column("state", _format_state, "left"),
        Column("best", _format_best, "left"),
        Column("score", _format_score),
        Column("by", lambda run: "" if run.best is None else run.best.rank_by, "left"),
        Column("sites", lambda run: "" if run.best is None else str(run.best.of_sites)),
        Column("size", lambda run: format_size(run.size_bytes)),
        Column("last run", lambda run: f"{format_age(now - run.last_run_s)} ago"),
    ]
    print_table(columns, runs, file_width=_FILE_WIDTH)


_FILE_WIDTH = 250


def _is_city(run: ListedRun) -> bool:
    return (run.folder / results.JUNCTIONS_TABLE).is_file()


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
    if _is_city(run):
        return "city run"
    if run.problem:
        return run.problem
    if run.missing:
        return f"without {', '.join(run.missing)}"
    return "complete"


def _format_best(run: ListedRun) -> str:
    if run.best is None:
        return ""
    names = ", ".join(run.best.names[:_MAX_BEST])
    if len(run.best.names) > _MAX_BEST:
        names += f" and {len(run.best.names) - _MAX_BEST} more"
    return names


def _format_score(run: ListedRun) -> str:
    if run.best is None:
        return ""
    label = SCORE_LABELS[run.best.rank_by]
    if label.is_share:
        return f"{run.best.score:.1%}"
    return f"{run.best.score:,.{label.digits}f} {label.unit}".rstrip()
