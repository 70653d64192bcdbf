"""The scene of a run's folder, and its empty scans: from ``scans.parquet``, or, with ``scan.keep = false``, cast as
they are asked for."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

import numpy as np

from pipeline.artefacts import tables
from pipeline.core.errors import InputError
from pipeline.scoring.visibility import Beams
from pipeline.sensing.scanner import Scanner
from pipeline.sensing.scene import Scene
from pipeline.sensing.sites import ScannedSite
from pipeline.stages.base import Workspace
from pipeline.stages.shared.scene import SCANS, scene_of
from pipeline.stages.shared.world import STATICS


@dataclass(frozen=True)
class SiteBeams:
    """One site's empty scan, and what artefacts hold of the site."""

    site: ScannedSite
    beams: Beams


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
                sensor = scene_of(work).sensor(site.sensor, f"site {site.name}")
                yield SiteBeams(
                    site, Beams(site.pose, sensor, ends, columns.get("weight"), f"{SCANS}: site {site.name}")
                )


def _cast(work: Workspace, only: Collection[str] | None) -> Iterator[SiteBeams]:
    scanner = work.remember("scanner", (STATICS,), lambda: _scanner(scene_of(work)))
    for site in scene_of(work).sites:
        if only is None or site.name in only:
            scan = scanner.scan_site(site)
            yield SiteBeams(scan.as_site(site.name, site.pole), Beams.of(scan))


def _scanner(scene: Scene) -> Scanner:
    """What scans the sites of a scene, each of which can stand where it is."""
    scanner = Scanner(scene)
    scanner.check(scene.sites)
    return scanner
