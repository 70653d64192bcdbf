"""What empty scans of a scene depend on, and the digests of the files of its sites and sensors."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from egvs.artefacts.run_folder import RunFolder
from egvs.core.digests import hash_input
from egvs.effects import registry
from egvs.effects.base import Effect
from egvs.formats import point_clouds, vector_files
from egvs.scenario.model import Scenario
from egvs.sensors import sensor
from egvs.sensors.sites import Site
from egvs.stages.base import StageContext, StageDependencies
from egvs.world import geolocation


def scan_dependencies(context: StageContext) -> StageDependencies:
    """What empty scans depend on: the region without its voxels, sites, sensors and effects; files by sha256."""
    scenario = context.scenario
    scene = context.scene
    active = scene.acting(Effect, "scan")
    settings: dict[str, Any] = {
        "name": scenario.name,
        "roi": [scene.roi.origin_m, scene.roi.size_m],
        "ground": scenario.statics.ground,
        "sites": scenario.sites.model_dump(mode="json", exclude={"existing_poles"}),
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
        digests[scenario.sites.file] = hash_input(path)
        for part in vector_files.companion_files(path):
            digests[f"sites.file: {part.name}"] = hash_input(part)
    for site in sites:
        if site.points is not None:
            digests[site.points] = hash_input(scenario.find(site.points, f"site {site.name}: points"))
    return digests | sensor_digests(scenario, sites)


def sensor_digests(scenario: Scenario, sites: Iterable[Site]) -> dict[str, str]:
    """Return the sha256 of the beam files of the user's sensors, and of the catalogue entries of the others."""
    digests = {}
    for name in dict.fromkeys(site.sensor for site in sites):
        config = scenario.sensors.get(name)
        if config is not None and config.beam_file is not None:
            key, file = config.beam_file
            digests[file] = hash_input(scenario.find(file, f"sensors.{name}.{key}"))
        elif config is None and name in sensor.catalogue_entries():
            digests[f"catalogue: {name}"] = sensor.catalogue_digest(name)
    return digests
