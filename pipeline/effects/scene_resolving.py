"""Resolves a scene: the static world, the sites of a scenario, and the effects that act before it."""

from __future__ import annotations

from pipeline.effects import registry
from pipeline.scenario.models import Scenario
from pipeline.sensing import sites
from pipeline.sensing.scene import IdleEffect, Scene
from pipeline.world.mesh import World


def resolve(scenario: Scenario, world: World) -> Scene:
    """The scene of a scenario before its static world: sites, and the effects of scan and score that can change a
    result.

    Raises
    ------
    InputError
        When the sites are wrong.
    """
    plain = Scene(scenario, world, sites.of(scenario))
    if not scenario.effects.named:
        return plain
    effects = registry.named(scenario, "scan", "score")
    reasons = [effect.why_idle(plain) for effect in effects]
    live = tuple(effect for effect, why in zip(effects, reasons, strict=True) if why is None)
    idle = (IdleEffect(effect.NAME, effect.STAGE, why) for effect, why in zip(effects, reasons, strict=True) if why)
    return Scene(scenario, world, plain.sites, live, tuple(idle))
