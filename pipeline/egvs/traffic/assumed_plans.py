"""Assume the plan of a signal whose phases nobody has stated.

Approaches that do not conflict have green together, as opposite ones do. Where a signal governs several nodes, such as
those of the two carriageways of a main road, the streets between them have green with the approaches that lead to them,
so that vehicles do not stop inside the junction. Then come the movements that still have no green. Left turns give way
to oncoming traffic: phases of their own cost more time than they save at usual flows.

The signals are actuated: greens end early where nobody arrives, and are so long that nobody waits longer than
:data:`CYCLE_S`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

from egvs.core.grid import FloatArray
from egvs.scenario.signal_config import DEFAULT_MIN_GREEN_S, SignalConfig, SignalPhaseConfig
from egvs.traffic.signal_plans import agree, make_program
from egvs.traffic.signals import CROSSING, Link, Signal

CYCLE_S = 120.0
"""Longest cycle."""

MAX_GREEN_S = 50.0
SHORT_GREEN_S = 15.0
"""Longest green of single movements, and of people on crossings that no other green serves."""

CHANGE_S = 5.0
"""Yellow and all-red between two greens."""

Movement = tuple[str, str]


def assumed_plan(signal: Signal) -> SignalConfig:
    """Return a plan in which all movements of a signal have green.

    Parameters
    ----------
    signal
        The signal; its program does not matter.
    """
    stages = _stages(signal)
    is_short = [short for _, short in stages]
    long_s = (CYCLE_S - CHANGE_S * len(stages) - SHORT_GREEN_S * sum(is_short)) / max(1, is_short.count(False))
    long_s = float(max(DEFAULT_MIN_GREEN_S, min(MAX_GREEN_S, math.floor(long_s))))
    phases = [
        SignalPhaseConfig(green=_by_approach(stage), green_s=SHORT_GREEN_S if short else long_s)
        for stage, short in stages
    ]
    return SignalConfig(type="actuated", phases=tuple(phases))


def is_assumed(signal: Signal) -> bool:
    """Return whether the program of a signal is the assumed plan."""
    program = signal.program
    if program.type != "actuated" or program.params or program.clock is not None:
        return False
    return program == make_program(assumed_plan(signal), signal, signal.title)


class _Movements:
    """The movements of a signal, and which of them may have green together."""

    def __init__(self, signal: Signal) -> None:
        self.links: dict[Movement, list[Link]] = {}
        for link in signal.links:
            self.links.setdefault((link.approach, link.movement), []).append(link)
        self.vehicles = [movement for movement in self.links if movement[1] != CROSSING]
        edges = {link.edge for link in signal.links if link.edge}
        self._inner = {link.target for link in signal.links} & edges
        self.outer = list(dict.fromkeys(link.approach for link in signal.links if link.edge not in {"", *self._inner}))

    def agree(self, movement: Movement, others: Iterable[Movement]) -> bool:
        """Return whether a movement may have green together with others."""
        links = [link for other in others for link in self.links[other]]
        return all(agree(link, other) for link in self.links[movement] for other in links)

    def of_approach(self, approach: str) -> list[Movement]:
        """Return the movements of an approach."""
        return [movement for movement in self.vehicles if movement[0] == approach]

    def with_ways_on(self, approach: str) -> list[Movement]:
        """Return the movements of an approach, and those of the streets inside the junction that lead straight on.

        Vehicles that turn may wait inside.
        """
        stage: list[Movement] = []
        queue = self.of_approach(approach)
        while queue:
            movement = queue.pop(0)
            if movement not in stage and self.agree(movement, stage):
                stage.append(movement)
                queue += self._ways_on(movement)
        return stage

    def _ways_on(self, movement: Movement) -> list[Movement]:
        if movement[1] != "straight":
            return []
        targets = {link.target for link in self.links[movement]} & self._inner
        return [other for other in self.vehicles if any(link.edge in targets for link in self.links[other])]

    def filled(self, stage: Sequence[Movement]) -> list[Movement]:
        """Return a stage with all further movements that agree with it, and do not end inside the junction."""
        whole = [*stage]
        for movement in self.vehicles:
            if movement not in whole and self.agree(movement, whole) and set(self._ways_on(movement)) <= set(whole):
                whole.append(movement)
        return whole

    def cosine(self, approach: str, other: str) -> float:
        """Return the cosine of the angle between two approaches, -1 for opposite ones."""
        headings = [self._heading(name) for name in (approach, other)]
        return float(headings[0] @ headings[1] / np.prod(np.linalg.norm(headings, axis=1)))

    def _heading(self, approach: str) -> FloatArray:
        links = (link for (name, _), links in self.links.items() if name == approach for link in links)
        return next(link.heading for link in links if link.heading is not None)


def _stages(signal: Signal) -> list[tuple[list[Movement], bool]]:
    """Return the movements that have green in each phase, and whether it is a short one."""
    movements = _Movements(signal)
    stages: list[list[Movement]] = []
    for approach in movements.outer:
        stage = movements.with_ways_on(approach)
        if not _is_served(stage, stages):
            for other in sorted(movements.outer, key=lambda name: movements.cosine(approach, name)):
                together = [movement for movement in movements.with_ways_on(other) if movement not in stage]
                if all(movements.agree(movement, stage) for movement in together):
                    stage += together
            stages.append(movements.filled(stage))
    for movement in movements.vehicles:
        if not _is_served([movement], stages):
            stages.append(movements.filled([movement]))
    for stage in [*stages]:
        others = [other for other in stages if other is not stage]
        if _is_served(stage, others):
            stages = others

    phases = [
        (stage, not any(_is_served(movements.of_approach(name), [stage]) for name in movements.outer))
        for stage in stages
    ]
    vehicles = [[link for movement in phase for link in movements.links[movement]] for phase, _ in phases]
    people = [link for link in signal.links if link.movement == CROSSING]
    is_always_green = len(phases) == 1
    if is_always_green or not all(
        any(all(agree(link, v) for v in of_phase) for of_phase in vehicles) for link in people
    ):
        phases.append(([], True))  # vehicles wait, and all crossings have green
    return phases


def _is_served(stage: Iterable[Movement], stages: Iterable[Sequence[Movement]]) -> bool:
    """Return whether each movement of a stage has green in another stage."""
    return set(stage) <= {movement for other in stages for movement in other}


def _by_approach(stage: Sequence[Movement]) -> dict[str, tuple[str, ...]]:
    """Return the movements of each approach."""
    green: dict[str, tuple[str, ...]] = {}
    for approach, movement in stage:
        green[approach] = (*green.get(approach, ()), movement)
    return green
