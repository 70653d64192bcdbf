"""How long a setting watches traffic: the ``--set`` overrides that lengthen or shorten all of it alike.

Where the traffic has periods, each is watched ``times`` as long, whether its time is its own (``length_s``) or that of
``traffic.frames``. Frames are whole blocks.
"""

from __future__ import annotations

from collections.abc import Iterator

from pipeline.scenario.models import Scenario
from pipeline.traffic.finished.survey import recorded_frames


def counted_frames(scenario: Scenario) -> int:
    """Frames that the TPOG counts, in all periods: as the scenario says, or the whole blocks of a finished file."""
    return sum(map(_whole_blocks, scenario.by_period().values()))


def is_finished(scenario: Scenario) -> bool:
    """Whether any of the traffic is a finished file, which cannot last longer."""
    return any(alone.traffic.fcd is not None for alone in scenario.by_period().values())


def watched(scenario: Scenario, times: float, period_s: float) -> tuple[int, tuple[str, ...]]:
    """Frames in all, and the overrides, of traffic that is watched ``times`` as long with a frame every ``period_s``.

    No frames where one of the periods would have none, or where only some of them could be cut: those of finished
    files.
    """
    own, alone = scenario.traffic, scenario.by_period()
    if own.periods and is_finished(scenario) and (times, period_s) != (1.0, own.frame_period_s):
        return 0, ()
    frames = {name: _scaled(scenario, _whole_blocks(one), times, period_s) for name, one in alone.items()}
    overrides = dict(_overrides(scenario, frames, period_s))
    return (0 if 0 in frames.values() else sum(frames.values())), tuple(f"{k}={v}" for k, v in overrides.items())


def _overrides(scenario: Scenario, frames: dict[str, int], period_s: float) -> Iterator[tuple[str, int | float]]:
    """Key and value of each length that is another than the scenario's."""
    own = {name: _whole_blocks(one) for name, one in scenario.by_period().items()}
    lengths_s = {period.name: period.length_s for period in scenario.traffic.periods}
    for number, (name, its) in enumerate(frames.items()):
        length_s = lengths_s.get(name)
        if length_s is None and its != own[name]:
            yield "traffic.frames", its
        elif length_s is not None and (watched_s := float(f"{its * period_s:.9g}")) != length_s:
            yield f"traffic.periods.{number}.length_s", watched_s


def _scaled(scenario: Scenario, frames: int, times: float, period_s: float) -> int:
    blocks = scenario.tpog.blocks
    return round(frames * scenario.traffic.frame_period_s * times / period_s / blocks) * blocks


def _whole_blocks(alone: Scenario) -> int:
    frames = recorded_frames(alone)
    return frames - frames % alone.tpog.blocks
