"""Cuts a stream of rows of floating car data into groups of whole frames.

Steps: keep the time steps that are frames; number them; hand out a group as soon as its last frame is whole; at the end
of the stream, check that every frame was there. Times are whole milliseconds.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.core.errors import InputError
from pipeline.core.reading import limits
from pipeline.traffic.fcd import RIGHT, SCHEMA


@dataclass(frozen=True)
class Window:
    """Which time steps are frames: ``count`` of them, ``period_ms`` apart.

    The first is at ``first_ms``; where that is None, ``skip_ms`` after the file's own first time step. ``complete``
    says that every step was recorded, so that a time step without rows is an empty frame and not the end of the file.
    """

    count: int
    period_ms: int
    first_ms: int | None = None
    skip_ms: int = 0
    complete: bool = False


@dataclass(frozen=True)
class FrameGroup:
    """Consecutive whole frames: ``rows`` has :data:`SCHEMA` and, at ``frame``, each row's frame."""

    first_frame: int
    frames: int
    frame: NDArray[np.int64]
    rows: pa.Table


@dataclass
class _Cutter:
    """Keeps the rows of the window's frames until their group is whole."""

    window: Window
    place: str
    first_ms: int | None = None
    last_ms: int = 0
    step_ms: int = 0
    time_steps: int = 0
    start: int = 0
    frames: list[NDArray[np.int64]] = field(default_factory=list)
    tables: list[pa.Table] = field(default_factory=list)

    def add(self, table: pa.Table) -> int:
        """Keep the rows of the window's frames; return how many frames are whole now."""
        window, time_ms = self.window, table["time_ms"].to_numpy()
        if self.first_ms is None:
            own = int(time_ms[0])
            self.first_ms, self.last_ms = (own + window.skip_ms if window.first_ms is None else window.first_ms), own
            self.time_steps = 1
        steps = np.diff(time_ms, prepend=self.last_ms)
        steps = steps[steps > 0]
        self.time_steps += steps.size
        self.step_ms = int(np.gcd.reduce(steps, initial=self.step_ms))
        self.last_ms = int(time_ms[-1])
        frame, off = np.divmod(time_ms - self.first_ms, window.period_ms)
        kept = np.flatnonzero((off == 0) & (frame >= 0) & (frame < window.count))
        if kept.size:
            self.frames.append(frame[kept])
            is_run = kept[-1] - kept[0] + 1 == kept.size
            self.tables.append(table.slice(int(kept[0]), kept.size) if is_run else table.take(kept))
            held = sum(table.num_rows for table in self.tables)
            limits.ROWS.check(self.place, held, f"has more than {limits.ROWS.most:,} vehicles in frames side by side")
        return int(np.clip(-((self.first_ms - self.last_ms) // window.period_ms), 0, window.count))

    def take(self, frames: int) -> FrameGroup:
        """The next ``frames`` frames."""
        end = self.start + frames
        frame = np.concatenate([np.empty(0, np.int64), *self.frames])
        rows = pa.concat_tables([SCHEMA.empty_table(), *self.tables])
        cut = int(np.searchsorted(frame, end))
        group = FrameGroup(self.start, frames, frame[:cut], rows.slice(0, cut).combine_chunks())
        self.frames, self.tables, self.start = [frame[cut:]], [rows.slice(cut)], end
        return group

    def finish(self) -> None:
        """Check that the file held every frame."""
        if self.window.complete:
            return
        if self.first_ms is None:
            raise InputError(self.place, "holds no vehicle", RIGHT)
        check_span(self.window, self.last_ms - self.first_ms, self.step_ms, self.time_steps, self.place)


def check_span(
    window: Window, lasts_ms: int, step_ms: int, time_steps: int, place: str, file: str = "the file"
) -> None:
    """InputError where a file does not hold a window's frames.

    Its ``time_steps`` are multiples of ``step_ms`` apart; it ends ``lasts_ms`` after the first frame.
    """
    if step_ms and window.period_ms % step_ms:
        what = f"{file}'s time steps are {step_ms / 1000:g} s apart"
        raise InputError(f"{place}: frame_period_s = {window.period_ms / 1000:g}", what, "a multiple of that")
    there = max(0, lasts_ms // window.period_ms + 1)
    if there < window.count:
        raise InputError(
            f"{place}: frames = {window.count}",
            f"{file} has {there} frames {window.period_ms / 1000:g} s apart after a warm-up of"
            f" {window.skip_ms / 1000:g} s ({time_steps} time steps in all)",
            f"at most {there} frames, or a shorter warmup_s",
        )


def together(some: FrameGroup, others: FrameGroup) -> FrameGroup:
    """Two streams' rows of the same frames as one group."""
    rows = pa.concat_tables([some.rows, others.rows]).combine_chunks()
    return FrameGroup(some.first_frame, some.frames, np.concatenate([some.frame, others.frame]), rows)


def groups(tables: Iterable[pa.Table], window: Window, frames_each: int, place: str) -> Iterator[FrameGroup]:
    """Cut a stream of rows into groups of ``frames_each`` whole frames (the last may be shorter).

    InputError when the stream ends before the window does, or its time steps do not fit the window's period.
    """
    cutter = _Cutter(window, place)
    for table in tables:
        whole = cutter.add(table)
        while whole - cutter.start >= frames_each:
            yield cutter.take(frames_each)
        if whole == window.count:
            break
    cutter.finish()
    while cutter.start < window.count:
        yield cutter.take(min(frames_each, window.count - cutter.start))
