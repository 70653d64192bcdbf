"""Where score and report get empty scans from: ``scans.parquet``, or, with ``scan.keep = false``, a scanner that casts
them as they are asked for."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.artefacts import tables
from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.effects import registry
from pipeline.effects.base import Effect
from pipeline.scoring.visibility import Beams
from pipeline.sensing.scanner import Scanner
from pipeline.sensing.sites import ScannedSite
from pipeline.stages.base import StageInputs, Workspace

SCANS = "scans.parquet"


@dataclass(frozen=True)
class SiteBeams:
    """One site's empty scan, and what artefacts hold of the site."""

    site: ScannedSite
    beams: Beams


def scan_inputs(work: Workspace) -> StageInputs:
    """What empty scans depend on: the region of interest without its voxels, sites, sensors, effects; files by hash."""
    scenario, scene = work.scenario, work.scene
    live = scene.acting(Effect, "scan")
    settings = {
        "name": scenario.name,
        "roi": [scene.roi.origin_m, scene.roi.size_m],
        "ground": scenario.statics.ground,
        "sites": scenario.sites.model_dump(mode="json"),
        "sensors": {name: model.model_dump(mode="json") for name, model in scenario.sensors.items()},
    }
    if live:
        settings["effects"] = registry.settings(live)
    hashes = work.digests("statics.ply")
    if scenario.sites.file is not None:
        hashes[scenario.sites.file] = files.sha256_of(scenario.find(scenario.sites.file, "sites.file"))
    for site in scene.sites:
        if site.points is not None:
            hashes[site.points] = files.sha256_of(scenario.find(site.points, f"site {site.name}: points"))
    return StageInputs(settings, hashes, code=tuple(type(effect) for effect in live))


def scans(work: Workspace, only: Collection[str] | None = None) -> Iterator[SiteBeams]:
    """The scans in the order of the sites; of the sites named in ``only``, or of all."""
    return _kept(work, only) if work.scenario.scan.keep else _cast(work, only)


def _kept(work: Workspace, only: Collection[str] | None) -> Iterator[SiteBeams]:
    path = work.path(SCANS)
    with tables.reader(path, "scans") as (file, about):
        if file.num_row_groups != len(about["sites"]):
            raise InputError(path, f"{file.num_row_groups} row groups for {len(about['sites'])} sites", "one a site")
        wanted = [c for c in ("dx_m", "dy_m", "dz_m", "weight") if c in file.schema_arrow.names]
        for group, written in enumerate(about["sites"]):
            site = ScannedSite.from_json(written, path)
            if only is None or site.name in only:
                table = tables.read_group(file, group, path, wanted)
                columns = {name: table.column(name).to_numpy() for name in wanted}
                ends = np.column_stack([columns[name] for name in ("dx_m", "dy_m", "dz_m")])
                sensor = work.scene.sensor(site.sensor, f"site {site.name}")
                yield SiteBeams(site, Beams(site.pose, sensor, ends, columns.get("weight")))


def _cast(work: Workspace, only: Collection[str] | None) -> Iterator[SiteBeams]:
    scanner = Scanner(work.scene)
    scanner.check(work.scene.sites)
    for site in work.scene.sites:
        if only is None or site.name in only:
            scan = scanner.scan_site(site)
            yield SiteBeams(scan.as_site(site.name), Beams.of(scan))
