"""The scene of a run's folder, resolved once, and what empty scans of it depend on."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pipeline.core import files
from pipeline.effects import registry, scene_resolving
from pipeline.effects.base import Effect
from pipeline.formats import point_clouds
from pipeline.scenario.models import Scenario
from pipeline.sensing import catalogue
from pipeline.sensing.scene import Scene
from pipeline.sensing.sites import Site
from pipeline.stages.base import StageInputs, Workspace
from pipeline.stages.shared.world import STATICS, world_of
from pipeline.world import world_frame

SCANS = "scans.parquet"


def scene_of(work: Workspace) -> Scene:
    """The scene before the static world, resolved once."""
    return work.remember("scene", (STATICS,), lambda: scene_resolving.resolve(work.scenario, world_of(work)))


def scan_inputs(work: Workspace) -> StageInputs:
    """What empty scans depend on: the region of interest without its voxels, sites, sensors, effects; files by hash."""
    scenario, scene = work.scenario, scene_of(work)
    live = scene.acting(Effect, "scan")
    settings = {
        "name": scenario.name,
        "roi": [scene.roi.origin_m, scene.roi.size_m],
        "ground": scenario.statics.ground,
        "sites": scenario.sites.model_dump(mode="json"),
        "sensors": sensor_settings(scenario),
    }
    settings |= world_frame.key(scenario)
    if scenario.crs.zero_height_m:
        settings["zero_height_m"] = scenario.crs.zero_height_m
    if live:
        settings["effects"] = registry.settings(live)
    if scene.dropped:
        settings["dropped"] = [site.name for site, _ in scene.dropped]
    hashes = work.digests(STATICS) | site_digests(scenario, scene.sites)
    readers = {point_clouds.reader_of(Path(s.points), f"site {s.name}: points") for s in scene.sites if s.points}
    return StageInputs(settings, hashes, modules=(*registry.modules(live), *sorted(readers)))


def sensor_settings(scenario: Scenario) -> dict[str, Any]:
    """The scenario's own sensors, by name, but for the noise of their ranges: empty scans and scores have none."""
    noise = {"range_sigma_m"}
    return {name: model.model_dump(mode="json", exclude=noise) for name, model in scenario.sensors.items()}


def site_digests(scenario: Scenario, sites: Iterable[Site]) -> dict[str, str]:
    """The files that say where sites are, what was measured there, and what their sensors are, by sha256."""
    sites = tuple(sites)
    hashes = {}
    if scenario.sites.file is not None:
        hashes[scenario.sites.file] = files.sha256_of(scenario.find(scenario.sites.file, "sites.file"))
    for site in sites:
        if site.points is not None:
            hashes[site.points] = files.sha256_of(scenario.find(site.points, f"site {site.name}: points"))
    return hashes | sensor_digests(scenario, sites)


def sensor_digests(scenario: Scenario, sites: Iterable[Site]) -> dict[str, str]:
    """The beam tables of the sites' own sensors, and the catalogue's entries of the others, by sha256."""
    hashes = {}
    for name in dict.fromkeys(site.sensor for site in sites):
        own = scenario.sensors.get(name)
        if own is not None and own.beams is not None:
            hashes[own.beams] = files.sha256_of(scenario.find(own.beams, f"sensors.{name}.beams"))
        elif own is None and name in catalogue.entries():
            hashes[f"catalogue: {name}"] = catalogue.digest(name)
    return hashes
