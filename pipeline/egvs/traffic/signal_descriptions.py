"""Describe signal plans, for ``egvs check``, for the answer of a run and for its report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from egvs.core.grid import Roi
from egvs.core.wording import shorten_id
from egvs.scenario.model import Scenario
from egvs.traffic.assumed_plans import is_assumed
from egvs.traffic.directions import CLOCKWISE, COMPASS
from egvs.traffic.signal_plans import find_signal
from egvs.traffic.signals import (
    CROSSING,
    GREEN_LETTERS,
    MOVEMENTS,
    YELLOW_LETTERS,
    Link,
    Program,
    Signal,
)

ASSUMED_SOURCE = "assumed"
"""Source of a plan that netconvert has made."""

_MAX_GREENS = 6
_MAX_PHASES = 100
"""A program with more phases replays a recording; it is not described phase by phase."""


def describe_simulated(scenario: Scenario, found: Sequence[Signal]) -> list[dict[str, Any]]:
    """Return :func:`describe_signals` for the signals of a network with the plans of a scenario."""
    planned = {}
    for name, config in scenario.traffic.signals.items():
        signal = find_signal(name, found, f"{scenario.file}: traffic.signals.{name}")
        planned[signal.id] = ASSUMED_SOURCE if is_assumed(signal) else config.file or "from the scenario"
    assumes_plans = any("signal" in entry for entry in scenario.assumed)
    return describe_signals(found, scenario.roi.box, planned, ASSUMED_SOURCE if assumes_plans else "from the network")


def describe_signals(
    signals: Sequence[Signal], region: Roi, planned: Mapping[str, str], network_source: str
) -> list[dict[str, Any]]:
    """Return the plans of the signals with a junction in a region, as JSON for the summary of the traffic.

    Parameters
    ----------
    signals
        The signals of the network that was simulated.
    region
        Region of interest.
    planned
        Where the plans of the scenario come from, by the id of their signal.
    network_source
        What the others are: "assumed", or "from the network".

    Returns
    -------
    list of dict
        ``signal``, ``streets``, ``source``, ``type``, ``cycle_s``, ``offset_s``, and ``rows`` (none where a recording
        is replayed): ``approach``, ``movements``, ``green_s`` and ``yellow_s`` (pairs of begin and end in the cycle),
        and ``gives_way`` (whether all of its green gives way). Actuated signals are described by their longest greens.
    """
    (x0, y0), (width, depth) = region.origin_m[:2], region.size_m[:2]
    described = []
    for signal in signals:
        x, y = signal.at_m
        if not (x0 <= x <= x0 + width and y0 <= y <= y0 + depth):
            continue
        program = signal.program
        kind = "fixed" if program.type == "static" else program.type
        if program.clock is not None or len(program.phases) > _MAX_PHASES:
            kind = "replayed"
        described.append({
            "signal": signal.id,
            "streets": list(signal.streets),
            "source": planned.get(signal.id, network_source),
            "type": kind,
            "cycle_s": round(program.cycle_s, 3),
            "offset_s": program.offset_s,
            "rows": [] if kind == "replayed" else list(_movement_rows(signal)),
        })  # fmt: skip
    return described


def _movement_rows(signal: Signal) -> Iterator[dict[str, Any]]:
    """Yield the intervals of the movements of each approach; those with equal states share a row."""
    grouped: dict[tuple[str, str], list[Link]] = {}
    for link in sorted(signal.links, key=lambda link: (_clockwise(link), MOVEMENTS.index(link.movement))):
        letters = "".join(phase.state[link.index] for phase in signal.program.phases)
        key = letters if link.movement != CROSSING else f"{CROSSING} {letters}"
        grouped.setdefault((link.approach, key), []).append(link)
    for (approach, key), links in grouped.items():
        letters = key.removeprefix(f"{CROSSING} ")
        green = set(letters) & GREEN_LETTERS
        yield {
            "approach": approach,
            "movements": list(dict.fromkeys(link.movement for link in links)),
            "green_s": _intervals(letters, signal.program, GREEN_LETTERS),
            "yellow_s": _intervals(letters, signal.program, YELLOW_LETTERS),
            "gives_way": green == {"g"},
        }


def _clockwise(link: Link) -> tuple[int, str]:
    return (CLOCKWISE.index(COMPASS.index(link.side)) if link.side else len(COMPASS)), link.approach


def _intervals(letters: str, program: Program, accepted: frozenset[str]) -> list[list[float]]:
    """Return begin and end in the cycle of each run of phases with one of the letters."""
    intervals: list[list[float]] = []
    begin_s = 0.0
    for letter, duration_s in zip(letters, program.longest_s, strict=True):
        end_s = round(begin_s + duration_s, 3)
        if letter in accepted:
            if intervals and intervals[-1][1] == begin_s:
                intervals[-1][1] = end_s
            else:
                intervals.append([begin_s, end_s])
        begin_s = end_s
    return intervals


def plan_title(plan: Mapping[str, Any]) -> str:
    """Return the streets of a plan of :func:`describe_signals`, or the id of its signal, shortened."""
    return " / ".join(plan["streets"]) or shorten_id(str(plan["signal"]))


def format_plan(plan: Mapping[str, Any]) -> str:
    """Return a plan of :func:`describe_signals` in a sentence: cycle, and greens of vehicles by approach.

    Approaches and movements that have green at the same times share an entry; of many entries, the first are named.
    """
    if not plan["rows"]:
        return f"Signals at {plan_title(plan)} ({plan['source']}): {plan['cycle_s']:g} s of a recording are replayed."
    up_to = "" if plan["type"] == "fixed" else "up to "
    by_approach: dict[str, list[Mapping[str, Any]]] = {}
    for row in plan["rows"]:
        if row["movements"] != [CROSSING]:
            by_approach.setdefault(row["approach"], []).append(row)
    by_times: dict[str, list[str]] = {}
    seconds: dict[str, float] = {}
    for approach, rows in by_approach.items():
        movements: dict[str, list[str]] = {}
        for row in rows:
            times = repr(row["green_s"])
            seconds[times] = sum(end_s - begin_s for begin_s, end_s in row["green_s"])
            movements.setdefault(times, []).extend(row["movements"])
        for times, listed_movements in movements.items():
            which = "" if len(movements) == 1 else f" {', '.join(dict.fromkeys(listed_movements))}"
            by_times.setdefault(times, []).append(f"{approach}{which}")
    listed = [f"{seconds[times]:g} s {' and '.join(names)}" for times, names in by_times.items()]
    greens = "; ".join(listed[:_MAX_GREENS])
    if len(listed) > _MAX_GREENS:
        greens += f"; {len(listed) - _MAX_GREENS} more in the report"
    control = f"{plan['type']}, cycle {up_to}{plan['cycle_s']:g} s"
    return f"Signals at {plan_title(plan)} ({plan['source']}): {control}; green {up_to}{greens}."
