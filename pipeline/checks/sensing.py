"""Rules for sensors and effects: they are known, and nothing that an effect needs is missing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pipeline.checks.subject import Refusals, Subject
from pipeline.core.errors import InputError
from pipeline.core.findings import Finding
from pipeline.effects import registry
from pipeline.effects.base import Effect
from pipeline.sensing import sensors
from pipeline.sensing.scene import Scene


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
