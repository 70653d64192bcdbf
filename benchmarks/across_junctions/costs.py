"""How long the whole study takes, estimated from the parts that were measured.

Processor times are used, because a machine that is busy with other work makes every part slower. A detector costs its
mean candidate times the number of candidates, in proportion to the frames; this leaves out what each process needs to
start, which :data:`START_S` adds per part. Scores and vehicles cost in proportion to the candidates.
"""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.across_junctions.protocol import Protocol
from benchmarks.across_junctions.records import NOT_DETECTORS, SCORES, PartInfo

LIMIT_H, LIMIT_PART_MIN = 5.0, 20.0
"""Longest time of the study, and of one part, on :data:`CORES`."""

CORES = 2

START_S = 40.0
"""Processor seconds per part for traffic, the start of processes, and evaluation; assumed."""


def estimated_s(infos: Sequence[PartInfo], protocol: Protocol) -> dict[str, float]:
    """Return the processor seconds of a junction with the protocol's frames by part, the mean of all records."""
    count, frames = protocol.candidates.count, protocol.frames
    each: dict[str, list[float]] = {}
    for info in infos:
        if info.part in NOT_DETECTORS:
            times = 1.0 if info.part == SCORES else frames / info.frames
            seconds = info.busy_s * count / info.candidates * times
        elif info.site_s > 0.0:
            seconds = info.site_s * count * frames / info.frames + START_S
        else:
            continue
        each.setdefault(info.part, []).append(seconds)
    return {part: sum(seconds) / len(seconds) for part, seconds in each.items()}


def estimate(infos: Sequence[PartInfo], protocol: Protocol) -> str:
    """Return a sentence on the time of the whole study, on the machine of the records."""
    seconds = estimated_s(infos, protocol)
    if not seconds:
        return "nothing was measured from which the time of the study can be estimated"
    total_s, unknown = 0.0, set()
    for junction in protocol.measured_junctions:
        share = protocol.frames_of(junction) / protocol.frames
        for part in (*NOT_DETECTORS, *protocol.detectors_of(junction)):
            total_s += seconds.get(part, 0.0) * (1.0 if part == SCORES else share)
            if part not in seconds:
                unknown.add(part)
    machine = infos[-1].machine
    parts = ", ".join(f"{part} {value / 60 / CORES:.1f}" for part, value in seconds.items())
    text = (
        f"one junction on {CORES} cores, minutes: {parts} (limit {LIMIT_PART_MIN:g});"
        f" the study of {len(protocol.measured_junctions)} junctions takes about {total_s / 3600 / CORES:.1f} hours"
        f" (limit {LIMIT_H:g}); processor: {machine['processor']}"
    )
    return text + (f"; without {', '.join(sorted(unknown))}, which was not measured" if unknown else "")
