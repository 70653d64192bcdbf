"""Holds a scenario's sites, solids, region of interest, lanes, traffic and sensors against one another.

:func:`check` reads what the scenario names once, asks every rule, and gives all findings at once, errors first. Nothing
is simulated, cast or written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from pipeline.checks import files, region, sensing, sites, solids, traffic
from pipeline.checks.subject import Subject, build_world, gather
from pipeline.core.findings import Finding
from pipeline.scenario.models import Scenario
from pipeline.world.mesh import World

RULES: tuple[Callable[[Subject], Iterator[Finding]], ...] = (
    region.lanes, region.of_periods, traffic.times, traffic.readable, traffic.weights, traffic.demand_there,
    traffic.recorded_places, traffic.finished, traffic.kinds, traffic.counts, sensing.known, sensing.repeated,
    sensing.complete, sites.poses, sites.on_lanes, sites.dropped, solids.over_lanes, solids.far_away,
)  # fmt: skip
"""In the order in which findings are told. A further rule is a function here."""


@dataclass(frozen=True)
class Checked:
    """What a check found, and how much was held against one another.

    Attributes
    ----------
    findings
        Errors first.
    sites, solids, lanes
        How many there are.
    """

    findings: tuple[Finding, ...]
    sites: int
    solids: int
    lanes: int

    @property
    def errors(self) -> tuple[Finding, ...]:
        """What must stop a run."""
        return tuple(finding for finding in self.findings if finding.is_error)

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """What a planner has to know."""
        return tuple(finding for finding in self.findings if not finding.is_error)


def check(scenario: Scenario, world_of: Callable[[Scenario], World] = build_world) -> Checked:
    """Ask every rule; ``world_of`` builds the static world.

    Raises
    ------
    RunError
        When a program that reads a file is not there or fails; what is wrong with the input is among the findings.
    """
    subject, refused = gather(scenario, world_of)
    found = [*refused, *(finding for rule in RULES for finding in rule(subject))]
    return Checked(
        tuple(sorted(_folded(_missing_once(found)), key=lambda finding: not finding.is_error)),
        len(subject.sites),
        0 if subject.world is None else len(subject.world.solids),
        0 if subject.carriageway is None else len(subject.carriageway.lanes),
    )


def _missing_once(found: Sequence[Finding]) -> Iterator[Finding]:
    """Without what rules say of files that are not there: that is told already, where the scenario names them."""
    absent = {finding.found for finding in found if finding.rule == files.RULE}
    return (finding for finding in found if finding.rule == files.RULE or finding.found not in absent)


def _folded(found: Iterable[Finding]) -> Iterator[Finding]:
    """Each finding once; those that say the same of several places as one, which names the first."""
    places: dict[tuple[str, str, bool], dict[str, Finding]] = {}
    for finding in found:
        places.setdefault((finding.found, finding.cure, finding.is_error), {}).setdefault(finding.place, finding)
    for first, *others in (list(alike.values()) for alike in places.values()):
        yield replace(first, place=f"{first.place} and {len(others)} more") if others else first
