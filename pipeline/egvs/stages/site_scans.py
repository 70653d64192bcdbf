"""The empty scans of a run folder, one by one: read from ``scans.parquet``, or cast where ``scan.keep`` is false."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.core.errors import InputError
from egvs.scoring.visibility import Beams
from egvs.sensors.sites import ScannedSite
from egvs.stages.base import StageContext


@dataclass(frozen=True)
class SiteScan:
    """The empty scan of one site, and what artefacts say about the site."""

    site: ScannedSite
    beams: Beams


def empty_scans(context: StageContext, only: Collection[str] | None = None) -> Iterator[SiteScan]:
    """Yield the scans in the order of the sites; of the sites named in ``only``, or of all."""
    if context.scenario.scan.keep:
        return read_scans(context, context.folder.scans, only)
    return _cast_scans(context, only)


def read_scans(context: StageContext, path: Path, only: Collection[str] | None = None) -> Iterator[SiteScan]:
    """Yield the scans of a ``scans.parquet`` in the order of the sites, bit by bit as they were cast.

    Parameters
    ----------
    context
        The scene of the scans.
    path
        The file.
    only
        Names of sites; all if None.
    """
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
    for site in context.scene.sites:
        if only is None or site.name in only:
            scan = context.inputs.scanner.scan_site(site)
            yield SiteScan(scan.as_site(site.name, site.pole), Beams.of(scan))
