"""Rules for sensors and effects: they are known, and nothing that an effect needs is missing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pipeline.checks.subject import Refusals, Subject
from pipeline.core.errors import InputError
from pipeline.core.findings import Finding
from pipeline.effects import registry
from pipeline.effects.base import Effect
from pipeline.sensing import beam_tables, sensors
from pipeline.sensing.scene import Scene

MOST_LISTED = 5
"""So many repeated beams of a table are named."""


def known(subject: Subject) -> Iterator[Finding]:
    """An error for each sensor that nobody knows, or whose table is wrong, and which sites name it."""
    names: dict[str, list[str]] = {}
    for site in subject.sites:
        names.setdefault(site.sensor, []).append(site.name)
    for sensor, of in names.items():
        more = f" and {len(of) - 1} more" if len(of) > 1 else ""
        try:
            sensors.of_scenario(sensor, subject.scenario, f"site {of[0]}{more}")
        except InputError as error:
            yield Finding.of("sensors", error)


def repeated(subject: Subject) -> Iterator[Finding]:
    """A warning for each table of beams that names a direction twice."""
    scenario = subject.scenario
    for name in dict.fromkeys(site.sensor for site in subject.sites):
        model = scenario.sensors.get(name)
        if model is None or model.beams is None:
            continue
        try:
            table = sensors.of_scenario(name, scenario, name).table
        except InputError:
            continue  # told elsewhere
        if table is not None and (twice := beam_tables.repeated(table)):
            listed = ", ".join(f"beam {beam} as beam {first}" for beam, first in twice[:MOST_LISTED])
            more = ", ..." if twice[MOST_LISTED:] else ""
            what = (
                f"{len(twice)} of {len(table)} beams point where an earlier one does ({listed}{more}) and count again"
            )
            cure = "each direction once (azimuths of 0 and 360 degrees are the same)"
            yield Finding("repeated beams", model.beams, what, cure)


def complete(subject: Subject) -> Iterator[Finding]:
    """An error for each effect that this scenario cannot have, or that lacks something."""
    if subject.scene is None or any(True for _ in known(subject)):
        return
    for effect in registry.named(subject.scenario, "traffic", "scan", "score"):
        yield from _refusal(effect, subject.scene)


def _refusal(effect: Effect[Any], scene: Scene) -> Iterator[Finding]:
    refusals = Refusals()
    idle = refusals.unless_refused("effects", lambda: effect.why_idle(scene))
    yield from refusals.found
    if not refusals.found and idle is None and (error := effect.refusal(scene)) is not None:
        yield Finding.of("effects", error)
