"""The scene of a scenario: its sites, sensors and effects in the static world.

Steps: read or generate the candidate sites; drop generated ones where no pole can stand; keep the effects of the scan
and score stages that can change a result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from egvs.core.errors import InputError
from egvs.effects import registry
from egvs.effects.base import Effect
from egvs.scenario.model import Scenario
from egvs.sensors import site_feasibility, sites
from egvs.sensors.return_model import LossDecision, decide_losses
from egvs.sensors.scene import InactiveEffect, Scene
from egvs.sensors.sensor import Sensor, scenario_sensor
from egvs.sensors.site_feasibility import SiteSelection
from egvs.sensors.sites import Site
from egvs.traffic import sumo_folder
from egvs.world.carriageway import Carriageway
from egvs.world.mesh import World


def resolve_scene(scenario: Scenario, world: World) -> Scene:
    """Return the scene of a scenario: its feasible sites in the static world, and the active effects.

    Raises
    ------
    InputError
        When the sites are wrong, or none is left.
    """
    return with_effects(resolve_plain_scene(scenario, world))


def resolve_plain_scene(scenario: Scenario, world: World, candidates: tuple[Site, ...] | None = None) -> Scene:
    """Return the scene without effects; ``candidates`` if they were read before.

    Raises
    ------
    InputError
        When the sites are wrong, or none is left.
    """
    if candidates is None:
        candidates = sites.candidate_sites(scenario)
    selection = _feasible_sites(scenario, world, candidates)
    if not selection.free:
        reasons = ", ".join(f"{count} {reason}" for reason, count in selection.reasons.items())
        raise InputError(
            f"{scenario.file}: sites", f"no location can hold a pole ({reasons})", "Use locations beside the road."
        )
    _check_kept_sites(scenario, selection)
    return Scene(scenario, world, selection.free, dropped=selection.dropped)


def _feasible_sites(scenario: Scenario, world: World, candidates: tuple[Site, ...]) -> SiteSelection:
    """All sites of a file; of a rule those where a pole can stand."""
    config = scenario.sites
    if config.file is not None or not config.only_free:
        return SiteSelection(candidates)
    network = sumo_folder.read_network(scenario)
    carriageway = None if network is None else Carriageway.of(network)
    return site_feasibility.drop_infeasible(candidates, world, carriageway)


def _check_kept_sites(scenario: Scenario, selection: SiteSelection) -> None:
    """InputError where the visibility of a dropped site is requested."""
    requested = scenario.score.keep_visibility
    if requested == "all":
        return
    reasons = {site.name: reason for site, reason in selection.dropped}
    for name in requested:
        if name in reasons:
            problem = f"the site {name!r} is dropped: it stands {reasons[name]}"
            raise InputError(scenario.locate("score.keep_visibility"), problem, "Use a site that is scored.")


def with_effects(plain: Scene) -> Scene:
    """Add the effects on beams and clouds that can change a result: those of the scenario, and losses of returns."""
    active: list[Effect[Any]] = []
    inactive = []
    candidates = (*plain.sites, *(site for site, _ in plain.dropped))
    losses = scenario_losses(plain.scenario, candidates)
    if losses is not None and losses.acting:
        active.append(registry.make_losses())
    for effect in registry.scenario_effects(plain.scenario, "scan", "score", "clouds"):
        reason = effect.why_idle(plain)
        if reason is None:
            active.append(effect)
        elif reason:
            inactive.append(InactiveEffect(effect.NAME, effect.STAGE, reason))
    return replace(plain, effects=tuple(active), inactive_effects=tuple(inactive), losses=losses)


def with_losses_of_all(scene: Scene) -> Scene:
    """Return the scene with losses of all sensors with a rated range, for comparisons of sensors.

    It is returned as it is where the scenario decides on losses.
    """
    if scene.losses is None:
        return scene
    others = tuple(effect for effect in scene.effects if effect.NAME != registry.LOSSES)
    return replace(scene, effects=(registry.make_losses(), *others))


def scenario_losses(scenario: Scenario, candidates: Sequence[Site]) -> LossDecision | None:
    """Return which sensors of all candidate sites need losses of returns; None where the scenario decides."""
    if scenario.effects.range_limit is not None:
        return None
    sensors: dict[str, Sensor] = {}
    known = []
    for site in candidates:
        try:
            if site.sensor not in sensors:
                sensors[site.sensor] = scenario_sensor(site.sensor, scenario, f"site {site.name}")
        except InputError:
            continue  # an unknown sensor or a wrong beam table, which the check and the scan of this site report
        known.append(site)
    return decide_losses(known, sensors, scenario.roi.box)
