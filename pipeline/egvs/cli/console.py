"""What all output of the command line shares: the console, tables, and the progress display.

Results go to standard output; progress, stage lines and warnings go to standard error.
"""

from __future__ import annotations

import math
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.table import Table
from rich.text import Text

from egvs.artefacts.run_record import StageRecord
from egvs.cli import stage_summary
from egvs.core.errors import Diagnostic, collect_warnings, escape_control_characters
from egvs.core.wording import format_percent, number_of

if TYPE_CHECKING:
    from egvs.scenario.model import Scenario

NARROW, WIDE = 110, 190
"""Terminals below ``NARROW`` columns get fewer columns of tables; those of about ``WIDE`` get all."""

_UNBROKEN_WIDTH = 100_000
"""No sentence is longer."""

LINE_WIDTH = 100
"""Width of the lines of an answer in a file."""

_WARNING_LINES = 2
"""Lines of the most serious warning, unless all details are printed."""

LINE_INTERVAL_S = 5.0
"""Least time between two lines about the progress of one step."""

Row = TypeVar("Row")


@dataclass(frozen=True)
class Column(Generic[Row]):
    """One column of a printed table.

    Attributes
    ----------
    title
        Head of the column.
    text
        Returns the cell of a row.
    align
        ``"left"`` for text, ``"right"`` for numbers.
    wrap
        Whether a cell that is too wide continues on the next line.
    min_width
        Narrowest terminal, in characters, in which the column is shown.
    """

    title: str
    text: Callable[[Row], str]
    align: Literal["left", "right"] = "right"
    wrap: bool = False
    min_width: int = 0


class _PlainConsole(Console):
    """Prints names that files contain without what in them would control the terminal."""

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(escape_control_characters(text), **options)


def console(file_width: int, *, soft_wrap: bool = True) -> Console:
    """Return standard output: as wide as the terminal, or ``file_width`` characters if it is no terminal.

    Text is never taken for markup or an emoji: names may have brackets and colons.
    """
    width = None if sys.stdout.isatty() else file_width
    return _PlainConsole(width=width, highlight=False, markup=False, emoji=False, soft_wrap=soft_wrap)


def print_sentences(sentences: Iterable[str]) -> None:
    """Print sentences, broken between words where a terminal is too narrow; in a file, one line each."""
    out = console(_UNBROKEN_WIDTH, soft_wrap=False)
    for sentence in sentences:
        out.print(sentence)


def wrap_lines(text: str, most: int | None = None) -> list[str]:
    """Return a text in lines of at most :data:`LINE_WIDTH` characters; what follows the last line is cut off ("…")."""
    return textwrap.wrap(
        text, LINE_WIDTH, max_lines=most, placeholder=" …", break_long_words=False, break_on_hyphens=False
    )


def make_table(
    columns: Sequence[Column[Row]],
    rows: Iterable[Row],
    *,
    width: int = WIDE,
    title: str | None = None,
    caption: str | None = None,
    truncate: bool = False,
) -> Table:
    """Return a table without a frame.

    Parameters
    ----------
    columns
        Columns from left to right; those with a larger ``min_width`` than ``width`` are left out.
    rows
        One object per row.
    width
        Width of the terminal, in characters.
    title, caption
        Text above and below the table.
    truncate
        Whether cells that are too wide end in "…" instead of continuing on the next line.
    """
    shown = [column for column in columns if width >= column.min_width]
    table = Table(box=None, pad_edge=False, title=title, title_justify="left", caption=caption)
    for column in shown:
        table.add_column(
            column.title,
            justify=column.align,
            no_wrap=not column.wrap,
            overflow="ellipsis" if truncate else "fold",
        )
    for row in rows:
        table.add_row(*(column.text(row) for column in shown))
    return table


def print_table(columns: Sequence[Column[Row]], rows: Iterable[Row], *, file_width: int = WIDE) -> None:
    """Print a table as wide as the terminal."""
    out = console(file_width, soft_wrap=False)
    out.print(make_table(columns, rows, width=out.width))


def format_or_dash(value: float | None, spec: str) -> str:
    """Return a number as text, with a format such as ".2f"; "-" if it is unknown."""
    if value is None:
        return "-"
    return f"{value:{spec}}"


def percent_or_dash(share: float | None, digits: int = 1) -> str:
    """Return a share in per cent, as :func:`~egvs.core.wording.format_percent`; "-" if it is unknown."""
    return "-" if share is None else format_percent(share, digits)


class _ElapsedColumn(ProgressColumn):
    """Time since the command began.

    Unlike rich's own column it does not stop at the first stage that is complete: the same bar then shows the next one.
    """

    def render(self, task: Task) -> Text:
        """Return hours, minutes and seconds."""
        return Text(str(timedelta(seconds=int(task.elapsed or 0.0))), style="progress.elapsed")


class ProgressDisplay:
    """Shows the progress of a run: a bar on a terminal, and one line per finished stage.

    On a terminal, the name of the stage and the elapsed time are shown from the beginning to the end, ten times per
    second, whether or not the stage reports how far it is. Commands import what they need inside the ``with`` block:
    importing and reading the scenario take a second or more.

    Parameters
    ----------
    verb
        Name of the command, until a stage begins.
    with_details
        Whether all that a stage reports is printed, and every warning; otherwise one short line for each stage, and at
        the end the number of warnings and the most serious one.
    is_run
        Whether unchanged stages have a line, and their warnings are reported like those of others; otherwise only their
        number is printed.
    prints_progress
        Whether progress is printed where there is no terminal: a line for each new step, else every
        :data:`LINE_INTERVAL_S`.

    Attributes
    ----------
    any_stage_ran
        Whether at least one stage was run or restored from the cache.
    warning_lines
        Number of lines that were printed at the end, about warnings.
    flow_source
        What the simulated flows are compared with; set by commands that know the scenario.
    """

    def __init__(
        self, verb: str = "", *, with_details: bool = False, is_run: bool = False, prints_progress: bool = False
    ) -> None:
        self.any_stage_ran = False
        self.warning_lines = 0
        self.flow_source = stage_summary.FLOWS
        self._with_details = with_details
        self._is_run = is_run
        self._warnings: dict[Diagnostic, bool] = {}  # and whether it is to be printed
        self._stage = verb
        self._part = ""
        self._part_seconds = 0.0
        self._part_states: set[str] = set()
        self._console = _PlainConsole(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=True)
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),  # names may have brackets
            BarColumn(),
            _ElapsedColumn(),
            console=self._console,
            transient=True,
        )
        self._task = self._bar.add_task(verb, total=None)
        self._has_bar = sys.stderr.isatty()
        self._prints_progress = prints_progress and not self._has_bar
        self._begin_s = time.monotonic()
        self._last_line = ("", -math.inf)

    def __enter__(self) -> ProgressDisplay:
        if self._has_bar:
            self._bar.start()
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        if self._has_bar:
            self._bar.stop()
        lines = list(self._describe_warnings())
        self.warning_lines = len(lines)
        for line in lines:
            self.say(line)
        if self._is_run and error is None:
            self.say("")  # before the answer

    def _describe_warnings(self) -> Iterator[str]:
        """Yield the most serious of the warnings that were not printed, and how many there are."""
        new = [warning for warning, is_new in self._warnings.items() if is_new]
        if new and not self._with_details:
            from egvs.report.reliability import by_severity

            count = "warning" if len(new) == 1 else f"{len(new)} warnings; the most serious"
            yield from wrap_lines(f"{count}: {by_severity(new)[0]}", _WARNING_LINES)
        if known := len(self._warnings) - len(new):
            yield f"{number_of(known, 'warning')}, as in the run"

    def progress(self, what: str, done: int, total: int) -> None:
        """Move the bar; a :data:`egvs.core.progress.ProgressCallback`."""
        if self._prints_progress:
            self._print_progress(what, done, total)
        if not self._has_bar:
            return
        count = f"{done}/{total}" if total else str(done or "")
        self._bar.update(self._task, description=f"{self._part}{self._stage}: {what} {count}", completed=done)
        self._bar.tasks[0].total = total or None  # update() takes None for "unchanged"

    def _print_progress(self, what: str, done: int, total: int) -> None:
        now_s = time.monotonic() - self._begin_s
        if what == self._last_line[0] and now_s - self._last_line[1] < LINE_INTERVAL_S:
            return
        self._last_line = (what, now_s)
        self.say(f"{now_s:4.0f} s  {what} {f'{done}/{total}' if total else done or ''}".rstrip())

    def begin_part(self, title: str) -> None:
        """Begin one of several runs of a command: its stages are shown on the bar only, after the title."""
        self._part = f"{title}: "
        self._part_seconds = 0.0
        self._part_states = set()

    def run_part(self, title: str, label: str, scenario: Scenario, folder: Path) -> None:
        """Run one of several scenarios of a command, and print how long it took, and its folder, after a label."""
        from egvs.runs import run

        self.begin_part(title)
        run.run(scenario, folder, progress=self.progress, listener=self.stage_event)
        self.say(f"{label}  {self.part_duration:>10}   {folder}")

    def end_parts(self, verb: str) -> None:
        """Show what follows the last of several runs under the name of the command."""
        self._part = ""
        self._stage = verb
        self._show_stage(verb)

    @property
    def part_duration(self) -> str:
        """Time of the stages of this part that ran, "from store" or "unchanged"."""
        if "done" in self._part_states:
            return f"{self._part_seconds:.1f} s"
        return "from store" if "fetched" in self._part_states else "unchanged"

    def stage_event(self, stage: str, state: str, record: StageRecord | None) -> None:
        """Print one line when a stage ends; a :data:`egvs.runs.run.StageListener`.

        A warning is reported once, also if several stages or runs have it.
        """
        self._stage = stage
        self._part_states.add(state)
        if state in ("runs", "fetched"):
            self.any_stage_ran = True
        self._show_stage(stage)
        if state == "corrected":
            self.say(f"{stage}: the artefacts in the folder did not belong to those that they are made of; made again")
        if record is None or state == "corrected":
            return

        if state == "done":
            self._part_seconds += record.cost.seconds
        if not self._part and (state != "skipped" or self._is_run or self._with_details):
            self._print_stage(stage, state, record)
        is_new = state in ("done", "fetched") or self._is_run
        for warning in collect_warnings([record.summary]):
            if is_new and not self._warnings.get(warning) and self._with_details:
                self.say(f"warning: {warning}")
            self._warnings[warning] = self._warnings.get(warning, False) or is_new

    def _print_stage(self, stage: str, state: str, record: StageRecord) -> None:
        lines = stage_summary.stage_lines(
            stage, state, record, with_details=self._with_details, flow_source=self.flow_source
        )
        for line in lines:
            self.say(line)

    def _show_stage(self, stage: str) -> None:
        if self._has_bar:
            self._bar.update(self._task, description=f"{self._part}{stage}", completed=0)
            self._bar.tasks[0].total = None

    def setting_event(self, name: str, state: str, details: dict[str, Any]) -> None:
        """Print one line for a setting of a study that is "done" or "skipped".

        Settings that the budget leaves out are listed at the end of the study instead.
        """
        if details.get("beyond"):
            return
        duration = state
        if "seconds" in details:
            duration = f"{details['seconds']:.2f} s"
        self.say(f"{duration:>10}   {name} {details.get('why', '')}".rstrip())

    def say(self, line: str) -> None:
        """Print a line above the bar."""
        self._console.print(line)
