"""How far a run is: a progress bar on a terminal, plain lines elsewhere; all of it on standard error."""

from __future__ import annotations

import sys
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from pipeline.artefacts.run_record import StageRecord
from pipeline.cli.terminal import in_words
from pipeline.core.findings import WARNINGS, warnings_of

_TOLD_APART = ("flags", "missed", WARNINGS)
"""Of a stage's summary, what its line leaves out: told elsewhere, or by nobody."""


class Screen:
    """Shows a run as it goes on.

    Attributes
    ----------
    any_stage_ran
        False as long as every stage was skipped.
    """

    def __init__(self, verb: str = "") -> None:
        self.any_stage_ran = False
        self._stage = verb
        self._console = Console(stderr=True, highlight=False, markup=False, emoji=False, soft_wrap=True)
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),  # names may have brackets
            BarColumn(),
            TimeElapsedColumn(),
            console=self._console,
            transient=True,
        )
        self._task = self._bar.add_task("", total=None, visible=False)
        self._has_bar = sys.stderr.isatty()

    def __enter__(self) -> Screen:
        if self._has_bar:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._has_bar:
            self._bar.stop()

    def progress(self, what: str, done: int, total: int) -> None:
        """A :data:`pipeline.core.progress.Progress`."""
        if self._has_bar:
            count = f"{done}/{total}" if total else str(done)
            self._bar.update(self._task, description=f"{self._stage}: {what} {count}", completed=done, visible=True)
            self._bar.tasks[0].total = total or None  # update() takes None for "as it was"

    def stage_event(self, stage: str, state: str, record: StageRecord | None) -> None:
        """A :data:`pipeline.runs.workflow.StageListener`: one line when a stage ends."""
        self._stage = stage
        if state in ("runs", "fetched"):
            self.any_stage_ran = True
        if record is None:
            if self._has_bar:
                self._bar.update(self._task, description=stage, completed=0, visible=True)
                self._bar.tasks[0].total = None
            return
        if self._has_bar:
            self._bar.update(self._task, visible=False)
        took = {"skipped": "unchanged", "fetched": "from store"}.get(state) or f"{record.cost.seconds:.2f} s"
        summary = {key: value for key, value in record.summary.items() if key not in _TOLD_APART}
        if counts := summary.pop("counts", None):
            summary["worst GEH of counts"] = max(count["geh"] for count in counts)
        periods = summary.pop("periods", {}) if stage == "traffic" else {}
        self.say(f"{stage:<8} {took:>10}   {in_words(summary)}")
        for period, its in periods.items():
            self.say(f"{period:>19}   {in_words(its)}")
        for warning in warnings_of([record.summary]):
            self.say(f"warning: {warning}")

    def setting_event(self, name: str, state: str, about: dict[str, Any]) -> None:
        """A setting of a study is "done", "kept" or "skipped": one line, but for what the budget leaves out."""
        if about.get("beyond"):
            return
        took = f"{about['seconds']:.2f} s" if "seconds" in about else state
        self.say(f"{took:>10}   {name}{' (kept)' if state == 'kept' else ''} {about.get('why', '')}")

    def say(self, line: str) -> None:
        """Print a line, above the bar."""
        self._console.print(line)
