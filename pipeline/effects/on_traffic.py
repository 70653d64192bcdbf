"""Finds the effects that act on traffic and ground: those that are named, and those that switch themselves on."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from pipeline.effects import registry
from pipeline.effects.base import Traffic
from pipeline.scenario.models import Scenario
from pipeline.traffic import sumo_folder
from pipeline.traffic.boxes import Size
from pipeline.world.ground import GroundSource

SELF_ACTING: dict[str, Callable[[Scenario], bool]] = {"slope": sumo_folder.may_have_heights}
"""Effects that switch themselves on where leaving them out would be wrong; a quick look tells where they may."""


def live(scenario: Scenario) -> tuple[tuple[Traffic[Any], ...], tuple[str, ...]]:
    """The effects that act, in order; and notes on those that act by themselves or are skipped."""
    effects, notes = [], []
    for effect in _asked(scenario):
        on, reason = effect.acts(scenario)
        if on:
            effects.append(effect)
            if effect.SELF_ACTING:
                notes.append(f"{effect.NAME}: on, {reason}")
        elif effect.NAME in scenario.effects.named:
            notes.append(f"{effect.NAME}: named, but {reason}: skipped, the result is the same")
        else:
            notes.append(f"{effect.NAME}: off, {reason}")
    return tuple(effects), tuple(notes)


def followed_types(scenario: Scenario, sizes: Mapping[str, Size]) -> frozenset[str]:
    """Types whose vehicles the scenario's effects must have all along their way."""
    return frozenset[str]().union(*(effect.followed_types(scenario, sizes) for effect in _asked(scenario)))


def ground(scenario: Scenario) -> GroundSource | None:
    """The effect that lays the ground; None where it is flat."""
    return next((e for e in _asked(scenario) if isinstance(e, GroundSource) and e.acts(scenario)[0]), None)


def _asked(scenario: Scenario) -> Iterator[Traffic[Any]]:
    """The effects on the traffic that are named, or may act by themselves; in the order in which they are composed."""
    named = scenario.effects.named
    by_themselves = [name for name, may_act in SELF_ACTING.items() if name not in named and may_act(scenario)]
    for name in (name for name in registry.names() if name in named or name in by_themselves):
        effect_class = registry.effect_class(name)
        if issubclass(effect_class, Traffic):
            yield effect_class(named[name] if name in named else effect_class.Model())
