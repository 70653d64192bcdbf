"""A page that compares records of benchmarks over time.

``make bench-history`` reads ``build/benchmarks/*.json``, which ``make bench BENCH="--json FILE"`` wrote, and writes
``build/benchmarks/history.md``. Records of different machines are in different sections, since their times cannot be
compared.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.records import ROOT, Record, Result
from egvs.core.errors import EgvsError, InputError
from egvs.core.files import write_text

FOLDER = ROOT / "build" / "benchmarks"
COLUMNS = 6
"""So many records of a machine are shown, the newest ones; the change is relative to all earlier ones."""

NOTICEABLE = 0.2
"""A value that differs by more than this share from the median of the earlier ones is bold."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Read records and write the page; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.history", description=__doc__.split("\n")[0])
    parser.add_argument("records", nargs="*", type=Path, help=f"JSON files; without any, those in {FOLDER.name}")
    parser.add_argument("--to", type=Path, default=FOLDER / "history.md", help="the Markdown page")
    options = parser.parse_args(arguments)
    try:
        paths = options.records or sorted(FOLDER.glob("*.json"))
        if not paths:
            hint = 'Write one with: make bench BENCH="--json build/benchmarks/FIRST.json".'
            raise InputError(FOLDER, "expected records of benchmarks, got no JSON file", hint)
        page = history_page(Record.read(path) for path in paths)
        options.to.parent.mkdir(parents=True, exist_ok=True)
        write_text(options.to, page)
    except EgvsError as error:
        print(f"benchmarks.history: {error}", file=sys.stderr)
        return error.exit_code
    print(f"{options.to}: {len(paths)} records")
    return 0


def history_page(records: Iterable[Record]) -> str:
    """Return a Markdown page: a section for each machine, a table for each table of benchmarks.

    The last column states by how much the newest value differs from the median of all earlier values of the same
    benchmark on the same machine.
    """
    machines: dict[str, list[Record]] = {}
    for record in sorted(records, key=lambda record: record.time_utc):
        machines.setdefault(record.machine.label, []).append(record)
    lines = [
        "# Benchmarks over time",
        "",
        "Medians as printed by `make bench`, one column for each record, oldest first. *Change*: the newest value",
        f"relative to the median of all earlier ones; bold above {NOTICEABLE:.0%}. `*`: with local changes.",
        "`!`: the limit was not reached.",
    ]
    for label, history in machines.items():
        lines += ["", f"## {label}"]
        for table in _unique(result.table for record in history for result in record.results):
            lines += ["", f"### {table[0].upper()}{table[1:]}", "", *_table(table, history)]
    return "\n".join(lines) + "\n"


def change(values: Sequence[float]) -> float | None:
    """Return the relative difference of the last value from the median of the earlier ones; None without them.

    >>> change([1.0, 3.0, 2.0, 2.5])
    0.25
    """
    if len(values) < 2:
        return None
    median = statistics.median(values[:-1])
    return values[-1] / median - 1 if median else None


def _table(title: str, history: Sequence[Record]) -> list[str]:
    shown = history[-COLUMNS:]
    heads = [f"{record.time_utc:%Y-%m-%d} {_commit(record)}" for record in shown]
    lines = [f"| what | {' | '.join(heads)} | change |", "|---|" + "--:|" * (len(shown) + 1)]
    rows = [{result.name: result for result in record.results if result.table == title} for record in history]
    for name in _unique(name for row in rows for name in row):
        results = [row.get(name) for row in rows]
        cells = [_cell(result) for result in results[-COLUMNS:]]
        lines.append(f"| {_escape(name)} | {' | '.join(cells)} | {_change_cell(results)} |")
    return lines


def _change_cell(results: Sequence[Result | None]) -> str:
    """Return the change of the newest value in percent; empty if it is missing or has no predecessor in its unit."""
    newest = results[-1]
    if newest is None:
        return ""
    values = [r.value for r in results if r is not None and r.value is not None and r.unit == newest.unit]
    share = None if newest.value is None else change(values)
    if share is None:
        return ""
    text = f"{share:+.0%}"
    return f"**{text}**" if abs(share) > NOTICEABLE else text


def _cell(result: Result | None) -> str:
    if result is None:
        return ""
    missed = " !" if result.reached is False else ""
    if result.value is None:
        return _escape(str(result.cells[0] if result.cells and result.cells[0] is not None else "")) + missed
    return f"{result.value:.4g} {_escape(result.unit)}".rstrip() + missed


def _commit(record: Record) -> str:
    return "(no commit)" if record.commit is None else record.commit[:8] + ("*" if record.has_local_changes else "")


def _escape(text: str) -> str:
    return text.replace("|", "\\|")


def _unique(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))


if __name__ == "__main__":
    sys.exit(main())
