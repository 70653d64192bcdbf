"""Makes ``trajectories.parquet`` of recorded rows, and checks what the scenario promises of them.

Steps, for each group of whole frames: rows become boxes; extensions change them; they are written as a row group, and
counted. Then the promises: N vehicles in each frame, and nobody standing for good. World frame (x east, y north, z up),
metres, radians.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from pipeline.artefacts.tables import TableWriter
from pipeline.core.errors import RunError
from pipeline.core.findings import Finding
from pipeline.core.grid import Roi
from pipeline.core.progress import Progress
from pipeline.scenario.models import Scenario
from pipeline.traffic import boxes, frames
from pipeline.traffic.extensions import BoxChange, TrafficExtension
from pipeline.traffic.frames import FrameGroup
from pipeline.traffic.recording import Recording
from pipeline.traffic.tally import SQUARE_M, TrafficTally, where

LONG_STAND_S = 120.0
"""A common signal comes round within 90 to 120 s."""

MOST_OVERLAPS = 0.05
"""Share of frames with an overlap that SUMO's sublane model makes by itself: 0 to 5 % were measured."""

GROUP_FRAMES = 500
"""Frames in a row group; fixed, so that the bytes do not depend on how the rows arrive."""


def write(
    scenario: Scenario,
    recording: Recording,
    extensions: Sequence[TrafficExtension],
    file: TableWriter,
    progress: Progress,
    first_frame: int = 0,
) -> tuple[TrafficTally, dict[str, Any]]:
    """Write a recording's boxes, changed by the extensions that act, as frames from ``first_frame`` on; what they
    add up to, and what extensions report.

    InputError when a vehicle's size is unknown, or the file has too few frames; RunError when N vehicles are not held,
    or a vehicle stands without end.
    """
    tally = TrafficTally(recording.window.count, on_purpose=recording.stopped_on_purpose)
    period_s = recording.window.period_ms / 1000.0
    changes: list[BoxChange] | None = None
    for group in groups_of(recording, GROUP_FRAMES):
        uncounted = frozenset[str]().union(*(extension.uncounted_types(recording.sizes) for extension in extensions))
        if changes is None:  # a running SUMO tells sizes with its first rows
            own = {name: size for name, size in recording.sizes.items() if name not in uncounted}
            changes = [c for extension in extensions if (c := extension.box_change(scenario, own)) is not None]
        place = recording.source or recording.place
        made = boxes.from_bumpers(group, recording.sizes, period_s, place, uncounted)
        for change in changes:
            made = change.change(made)
        if made.frame.size:
            file.write(made.columns(first_frame))
        tally.add(made)
        progress("frames written", group.first_frame + group.frames, tally.frames)
    check(scenario, tally, recording)
    return tally, {key: value for change in changes or () for key, value in change.summary().items()}


def groups_of(recording: Recording, frames_each: int) -> Iterator[FrameGroup]:
    """Groups of whole frames, persons among the vehicles where they are recorded beside."""
    groups = frames.groups(recording.rows, recording.window, frames_each, recording.place)
    if recording.persons is None:
        return groups
    persons = frames.groups(recording.persons, recording.window, frames_each, recording.place)
    return (frames.together(some, others) for some, others in zip(groups, persons, strict=True))


def check(scenario: Scenario, tally: TrafficTally, recording: Recording) -> None:
    """RunError where a recording holds nobody, or a simulated one does not keep the scenario's promises."""
    traffic = scenario.traffic
    if not tally.rows:
        source = traffic.fcd or traffic.sumocfg or ", ".join(traffic.routes) or traffic.network
        of = f" of the period {scenario.period!r}" if scenario.period else ""
        raise RunError(
            f"{recording.place}: no vehicle of {source} is in any of {tally.frames} frames{of};"
            " check the demand, begin_s and warmup_s"
        )
    if recording.vehicles is not None and traffic.hold == "exactly":
        _check_held(recording.vehicles, tally, recording.place)
    if recording.patience_s is not None:
        _check_moving(tally, recording, recording.patience_s)


def doubts(tally: TrafficTally, recording: Recording, roi: Roi) -> list[Finding]:
    """What does not look like traffic: who stood too long, boxes that overlap too often; each with its place."""
    found, period_s = [], recording.window.period_ms / 1000.0
    stand = tally.longest_jam
    if stand is not None and recording.patience_s is not None and (stood_s := stand.frames * period_s) > LONG_STAND_S:
        what = f"vehicle {stand.vehicle!r} stood there for {stood_s:g} s, longer than any signal should keep it"
        cure = "look at the signals and connections of the network there, or let fewer vehicles in"
        found.append(Finding("standing", f"{recording.place}: {where(stand.at_m, roi)}", what, cure))
    share = tally.frames_with_overlap / tally.frames
    if share > MOST_OVERLAPS:
        (square, pairs), *_ = tally.overlaps_at.most_common(1)
        at_m = ((square[0] + 0.5) * SQUARE_M, (square[1] + 0.5) * SQUARE_M)
        what = f"vehicles overlap in {share:.0%} of the frames; {pairs} of {tally.overlapping_pairs} pairs do so there"
        cure = "a larger junction, or signals in place of a right of way that vehicles take on it"
        found.append(Finding("overlaps", f"{recording.place}: {where(at_m, roi)}", what, cure))
    return found


def _check_held(vehicles: int, tally: TrafficTally, place: str) -> None:
    wrong = tally.vehicles != vehicles
    if wrong.any():
        first = int(wrong.argmax())
        raise RunError(
            f"{place}: {vehicles} vehicles are in {tally.frames - int(wrong.sum())} of {tally.frames} frames"
            f" only; the fewest are {tally.vehicles.min()}, the most {tally.vehicles.max()}, frame {first} has"
            f" {tally.vehicles[first]}. Lower traffic.vehicles (or vehicles_per_lane_km), lengthen warmup_s, raise"
            ' trips_per_s or the demand, or set hold = "at_most"'
        )


def _check_moving(tally: TrafficTally, recording: Recording, patience_s: float) -> None:
    period_s = recording.window.period_ms / 1000.0
    stands_s = {
        name: (tally.frames - 1 - frame) * period_s
        for name, frame in tally.stands_since.items()
        if name not in recording.stopped_on_purpose
    }
    stuck = [name for name, seconds in stands_s.items() if seconds > patience_s]
    if stuck:
        longest = max(stuck, key=lambda name: stands_s[name])
        raise RunError(
            f"{recording.place}: {len(stuck)} vehicles stand for more than {patience_s:g} s and through to the last"
            f" frame, {longest!r} for {stands_s[longest]:g} s: the traffic is jammed for good. Lower traffic.vehicles,"
            " or mend the network's signals and connections"
        )
