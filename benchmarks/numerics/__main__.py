"""Run all numerical checks.

``python -m benchmarks.numerics`` runs them at full length (``--scale 1e-3`` is a smoke test), prints one table, and
exits with 1 if a decision differs from exact arithmetic.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.numerics import boxes, cast, entropy, march
from benchmarks.numerics.row import Row

MODULES = (march, boxes, cast, entropy)
HEADINGS = ("case", "rule", "tested against", "cases", "excluded", "mismatches", "worst figure")


def cells(row: Row) -> tuple[str, ...]:
    """A row as text."""
    return row.case, row.rule, row.tested, f"{row.cases:,}", f"{row.excluded:,}", f"{row.mismatches:,}", row.worst


def write_csv(path: Path, rows: list[Row]) -> None:
    """Write the rows as a table of the documentation."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADINGS)
        writer.writerows((r.case, r.rule, r.tested, r.cases, r.excluded, r.mismatches, r.worst) for r in rows)


def main(arguments: list[str] | None = None) -> int:
    """Run all checks, and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.numerics", description=__doc__)
    parser.add_argument("--scale", type=float, default=1.0, help="share of the full length (default 1)")
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write the table there too")
    chosen = parser.parse_args(arguments)
    if not 0 < chosen.scale <= 100:
        parser.error(f"--scale {chosen.scale:g}: a number above 0, at most 100")
    console, start = Console(highlight=False), time.perf_counter()
    by_module: dict[str, list[Row]] = {}
    with Progress(console=console, transient=True) as progress:
        for module in progress.track(MODULES, description="checking"):
            by_module[module.__name__.rpartition(".")[2]] = module.rows(chosen.scale)
    rows = [row for part in by_module.values() for row in part]
    table = Table(*HEADINGS, box=None, title=f"Decisions compared with exact arithmetic, scale {chosen.scale:g}")
    for row in rows:
        table.add_row(*cells(row), style="red" if row.mismatches else None)
    console.print(table)
    if chosen.csv is not None:
        write_csv(chosen.csv, rows)
    for name, part in by_module.items():
        console.print(
            f"{name}: {sum(row.mismatches for row in part)} mismatches in {sum(row.cases for row in part):,} cases"
        )
    wrong = sum(row.mismatches for row in rows)
    console.print(f"all: {wrong} mismatches, {time.perf_counter() - start:.0f} s")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
