"""Looks a finished file of floating car data through before its rows are taken. Times are whole milliseconds.

A file that states its frames (:mod:`pipeline.traffic.finished.stated`) need not be looked through: time steps without
rows are frames without vehicles then.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pyarrow.compute as pc

from pipeline.core.errors import InputError
from pipeline.scenario.models import Scenario
from pipeline.traffic import fcd, sumo_folder
from pipeline.traffic.boxes import Size
from pipeline.traffic.finished import stated
from pipeline.traffic.finished.stated import StatedFcd
from pipeline.traffic.frames import Window, check_span


@dataclass(frozen=True)
class FcdSurvey:
    """What a finished file holds: the time from its first row to its last, its time steps, and their greatest common
    divisor; the types of its vehicles; what it states itself, if it does."""

    lasts_ms: int
    time_steps: int
    step_ms: int
    types: frozenset[str]
    stated: StatedFcd | None = None

    @property
    def sizes(self) -> dict[str, Size]:
        """The sizes that the file itself states."""
        return {} if self.stated is None else self.stated.sizes


def survey(path: Path, until_ms: int | None = None) -> FcdSurvey:
    """Look a finished file through, to ``until_ms`` after its first row or to its end.

    InputError as :func:`pipeline.traffic.fcd.read`, and when it holds no vehicle.
    """
    if (itself := stated.read(path)) is not None:
        lasts_ms = (itself.frames - 1) * itself.period_ms
        return FcdSurvey(lasts_ms, itself.frames, itself.period_ms, frozenset(itself.types), itself)
    first_ms, last_ms, types = None, 0, set[str]()
    time_steps, step_ms = 1, 0
    for table in fcd.read(path):
        time_ms = table["time_ms"].to_numpy()
        if first_ms is None:
            first_ms = last_ms = int(time_ms[0])
        steps = np.diff(time_ms, prepend=last_ms)
        time_steps += int(np.count_nonzero(steps))
        step_ms = int(np.gcd.reduce(steps, initial=step_ms))
        if until_ms is not None:
            table = table.slice(0, int(np.searchsorted(time_ms, first_ms + until_ms, side="right")))
        types.update(pc.unique(table["type"]).to_pylist())
        last_ms = int(time_ms[-1])
        if until_ms is not None and last_ms > first_ms + until_ms:
            break
    if first_ms is None:
        raise InputError(path, "holds no vehicle", fcd.RIGHT)
    return FcdSurvey(last_ms - first_ms, time_steps, step_ms, frozenset(types))


def window(scenario: Scenario) -> tuple[Window, FcdSurvey]:
    """Which rows of a scenario's finished file are frames, and what the file holds as far as they reach.

    InputError when the file does not hold these frames, or is no sound file.
    """
    traffic, place = scenario.traffic, sumo_folder.place_of(scenario)
    assert traffic.fcd is not None
    path = scenario.find(traffic.fcd, "traffic.fcd")
    period_ms = max(1, sumo_folder.milliseconds(traffic.frame_period_s, f"{place}.frame_period_s"))
    skip_ms = sumo_folder.milliseconds(traffic.warmup_s + (traffic.begin_s or 0.0), f"{place}.warmup_s")
    until_ms = None if traffic.frames is None else skip_ms + (traffic.frames - 1) * period_ms
    found = _remembered(path, path.stat().st_mtime_ns, until_ms)
    frames = traffic.frames or (found.lasts_ms - skip_ms) // period_ms + 1
    if frames < 1:
        lasts = f"{path.name} lasts {found.lasts_ms / 1000:g} s"
        raise InputError(f"{place}.warmup_s = {traffic.warmup_s:g}", lasts, "a shorter warm-up")
    if found.stated is None:
        wanted = Window(frames, period_ms, skip_ms=skip_ms)
    else:
        wanted = Window(frames, period_ms, first_ms=skip_ms, skip_ms=skip_ms, complete=True)
    check_span(wanted, found.lasts_ms - skip_ms, found.step_ms, found.time_steps, place, str(traffic.fcd))
    return wanted, found


@lru_cache(maxsize=4)
def _remembered(path: Path, _modified_ns: int, until_ms: int | None) -> FcdSurvey:
    return survey(path, until_ms)


def recorded_frames(scenario: Scenario) -> int:
    """Frames that a scenario records: as it says, or all of a finished file."""
    return window(scenario)[0].count if scenario.traffic.frames is None else scenario.traffic.frames
