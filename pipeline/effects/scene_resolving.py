"""Resolves a scene: the static world, the sites of a scenario, and the effects that act before it."""

from __future__ import annotations

from dataclasses import replace

from pipeline.core.errors import InputError
from pipeline.effects import registry
from pipeline.scenario.models import Scenario
from pipeline.sensing import free_places, sites
from pipeline.sensing.free_places import Candidates
from pipeline.sensing.scene import IdleEffect, Scene
from pipeline.traffic import sumo_folder
from pipeline.world.carriageway import Carriageway
from pipeline.world.mesh import World


def resolve(scenario: Scenario, world: World) -> Scene:
    """The scene of a scenario before its static world: sites, and the effects of scan and score that can change a
    result. Candidates of a rule that no pole can stand for are dropped.

    Raises
    ------
    InputError
        When the sites are wrong, or none is left.
    """
    return with_effects(without_effects(scenario, world))


def with_effects(plain: Scene) -> Scene:
    """A scene without effects, and those of scan and score that its scenario names and that can change a result."""
    if not plain.scenario.effects.named:
        return plain
    effects = registry.named(plain.scenario, "scan", "score")
    reasons = [effect.why_idle(plain) for effect in effects]
    live = tuple(effect for effect, why in zip(effects, reasons, strict=True) if why is None)
    idle = (IdleEffect(effect.NAME, effect.STAGE, why) for effect, why in zip(effects, reasons, strict=True) if why)
    return replace(plain, effects=live, idle=tuple(idle))


def without_effects(scenario: Scenario, world: World) -> Scene:
    """The same without effects; InputError as above."""
    candidates = _candidates(scenario, world)
    if not candidates.free:
        why = ", ".join(f"{count} {reason}" for reason, count in candidates.reasons.items())
        raise InputError(f"{scenario.file}: sites", f"no place can hold a pole ({why})", "places beside the road")
    dropped, keep = {site.name: why for site, why in candidates.dropped}, scenario.score.keep_visibility
    if gone := [name for name in keep if name in dropped] if keep != "all" else []:
        found = f"the site {gone[0]!r} is dropped: it stands {dropped[gone[0]]}"
        raise InputError(f"{scenario.file}: score.keep_visibility", found, "one that is scored")
    return Scene(scenario, world, candidates.free, dropped=candidates.dropped)


def _candidates(scenario: Scenario, world: World) -> Candidates:
    """All sites of a file; those of a rule that a pole can stand for."""
    found, model = sites.of(scenario), scenario.sites
    if model.file is not None or not model.only_free:
        return Candidates(found)
    network = sumo_folder.roads(scenario)
    return free_places.sort_out(found, world, None if network is None else Carriageway.of(network))
