"""The empty scans of a run folder, one by one: read from ``scans.parquet``, or cast where ``scan.keep`` is false.

:func:`warn_blocked_sites` names sites whose sensor sees little but what is around it, such as its own mast.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.core.errors import Diagnostic, InputError
from egvs.core.grid import FloatArray
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sites import ScannedSite
from egvs.stages.base import StageContext
from egvs.world import supports

NEAR_M = 0.5
"""Beams that end closer to the sensor have met what it is mounted on, or mounted in."""


@dataclass(frozen=True)
class SiteScan:
    """The empty scan of one site, and what artefacts say about the site."""

    site: ScannedSite
    beams: Beams


def empty_scans(context: StageContext, only: Collection[str] | None = None) -> Iterator[SiteScan]:
    """Yield the scans in the order of the sites; of the sites named in ``only``, or of all."""
    if context.scenario.scan.keep:
        return _stored_scans(context, only)
    return _cast_scans(context, only)


def _stored_scans(context: StageContext, only: Collection[str] | None) -> Iterator[SiteScan]:
    path = context.folder.scans
    with parquet.open_artefact(path, "scans") as (file, metadata):
        sites = metadata["sites"]
        if file.num_row_groups != len(sites):
            problem = f"expected {len(sites)} row groups, one per site, got {file.num_row_groups}"
            raise InputError(path, problem, "Run the scan stage again.")
        names = [name for name in ("dx_m", "dy_m", "dz_m", "weight") if name in file.schema_arrow.names]
        for group, entry in enumerate(sites):
            site = ScannedSite.from_json(entry, path)
            if only is not None and site.name not in only:
                continue
            table = parquet.read_row_group(file, group, path, names)
            columns = {name: table.column(name).to_numpy() for name in names}
            ends_m = np.column_stack([columns[name] for name in ("dx_m", "dy_m", "dz_m")])
            sensor = context.scene.sensor(site.sensor, f"site {site.name}")
            source = f"{RunFolder.scans.name}: site {site.name}"
            yield SiteScan(site, Beams(site.pose, sensor, ends_m, columns.get("weight"), source))


def _cast_scans(context: StageContext, only: Collection[str] | None) -> Iterator[SiteScan]:
    scanner = context.remember("scanner", (RunFolder.statics.name,), lambda: _make_scanner(context.scene))
    for site in context.scene.sites:
        if only is None or site.name in only:
            scan = scanner.scan_site(site)
            yield SiteScan(scan.as_site(site.name, site.pole), Beams.of(scan))


def _make_scanner(scene: Scene) -> Scanner:
    """Make the scanner of a scene, and check the pose of each site."""
    scanner = Scanner(scene)
    scanner.check(scene.sites)
    return scanner


def near_share(ends_m: FloatArray, weight: FloatArray | None) -> float:
    """Return the share of beams that end within :data:`NEAR_M` of the sensor; 0 without beams.

    Parameters
    ----------
    ends_m
        Ends of the beams relative to the sensor, (n, 3).
    weight
        Share of its beam of each row, (n,); None where every row is one beam.
    """
    is_near = (ends_m**2).sum(axis=1) < NEAR_M**2
    if not is_near.any():
        return 0.0
    return float(np.average(is_near, weights=weight))


def warn_blocked_sites(near_shares: Mapping[str, float]) -> Iterator[Diagnostic]:
    """Warn about the sites of which most beams end near the sensor; ``near_shares`` by site."""
    blocked = [f"{site} ({share:.0%})" for site, share in near_shares.items() if share > 0.5]
    if blocked:
        count = f"{len(blocked)} of {len(near_shares)} sites"
        problem = f"most beams of {count} end within {NEAR_M:g} m of the sensor: {', '.join(blocked)}"
        kinds = ", ".join(supports.KINDS)
        hint = (
            f"Move the sensor away from the solid, or set the kind of its mast (one of {kinds}; at most"
            f" {supports.MAX_WIDTH_M:g} m across), which is then left out of the scan."
        )
        yield Diagnostic("blocked sites", "sites", problem, hint)
