"""The scene of a scenario, and what empty scans of it depend on.

Steps: read or generate the candidate sites; drop generated ones where no pole can stand; keep the effects of the scan
and score stages that can change a result.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from egvs.artefacts.run_folder import RunFolder
from egvs.core import files
from egvs.core.errors import InputError
from egvs.effects import registry
from egvs.effects.base import Effect
from egvs.formats import point_clouds, vector_files
from egvs.scenario.model import Scenario
from egvs.sensors import sensor, site_feasibility, sites
from egvs.sensors.scene import InactiveEffect, Scene
from egvs.sensors.site_feasibility import SiteSelection
from egvs.sensors.sites import Site
from egvs.stages.base import StageContext, StageDependencies
from egvs.traffic import sumo_folder
from egvs.world import geolocation
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
            raise InputError(f"{scenario.file}: score.keep_visibility", problem, "Use a site that is scored.")


def with_effects(plain: Scene) -> Scene:
    """Add the effects on beams and clouds that the scenario names and that can change a result."""
    if not plain.scenario.effects.named:
        return plain
    active = []
    inactive = []
    for effect in registry.scenario_effects(plain.scenario, "scan", "score", "clouds"):
        reason = effect.why_idle(plain)
        if reason is None:
            active.append(effect)
        elif reason:
            inactive.append(InactiveEffect(effect.NAME, effect.STAGE, reason))
    return replace(plain, effects=tuple(active), inactive_effects=tuple(inactive))


def scan_dependencies(context: StageContext) -> StageDependencies:
    """What empty scans depend on: the region without its voxels, sites, sensors and effects; files by sha256."""
    scenario = context.scenario
    scene = context.scene
    active = scene.acting(Effect, "scan")
    settings: dict[str, Any] = {
        "name": scenario.name,
        "roi": [scene.roi.origin_m, scene.roi.size_m],
        "ground": scenario.statics.ground,
        "sites": scenario.sites.model_dump(mode="json"),
        "sensors": sensor_settings(scenario),
    }
    settings |= geolocation.world_frame_settings(scenario)
    if scenario.crs.zero_height_m:
        settings["zero_height_m"] = scenario.crs.zero_height_m
    if active:
        settings["effects"] = registry.effect_settings(active)
    if scene.dropped:
        settings["dropped"] = [site.name for site, _ in scene.dropped]

    digests = context.digests(RunFolder.statics.name) | site_digests(scenario, scene.sites)
    readers = set()
    for site in scene.sites:
        if site.points:
            readers.add(point_clouds.format_of_file(Path(site.points), f"site {site.name}: points"))
    return StageDependencies(settings, digests, modules=(*registry.effect_modules(active), *sorted(readers)))


def sensor_settings(scenario: Scenario) -> dict[str, Any]:
    """The user's sensors by name, without range noise: empty scans and scores are computed without it."""
    noise = {"range_sigma_m"}
    return {name: model.model_dump(mode="json", exclude=noise) for name, model in scenario.sensors.items()}


def site_digests(scenario: Scenario, sites: Iterable[Site]) -> dict[str, str]:
    """Return the sha256 of the sites file, of measured scans, and of the data of sensors."""
    sites = tuple(sites)
    digests = {}
    if scenario.sites.file is not None:
        path = scenario.find(scenario.sites.file, "sites.file")
        digests[scenario.sites.file] = files.hash_file(path)
        for part in vector_files.companion_files(path):
            digests[f"sites.file: {part.name}"] = files.hash_file(part)
    for site in sites:
        if site.points is not None:
            digests[site.points] = files.hash_file(scenario.find(site.points, f"site {site.name}: points"))
    return digests | sensor_digests(scenario, sites)


def sensor_digests(scenario: Scenario, sites: Iterable[Site]) -> dict[str, str]:
    """Return the sha256 of the beam tables of the user's sensors, and of the catalogue entries of the others."""
    digests = {}
    for name in dict.fromkeys(site.sensor for site in sites):
        config = scenario.sensors.get(name)
        if config is not None and config.beams is not None:
            digests[config.beams] = files.hash_file(scenario.find(config.beams, f"sensors.{name}.beams"))
        elif config is None and name in sensor.catalogue_entries():
            digests[f"catalogue: {name}"] = sensor.catalogue_digest(name)
    return digests
