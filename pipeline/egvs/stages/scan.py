"""The scan stage: what each candidate site sees of the static world alone, as ``scans.parquet``.

Steps: compare measured scans with the static world (:mod:`egvs.sensors.measured_scans`); cast the beams of every site
(or read its measured scan), :mod:`egvs.sensors.scanner`; write one row per beam
that can meet the region of interest. Scans do not depend on traffic, voxels or gamma.

With ``scan.keep = false`` nothing is written, and the score stage casts the beams.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.core.errors import WARNINGS_KEY, DiagnosticsError, InputError, unknown_site
from egvs.core.threads import map_ordered
from egvs.formats import point_clouds
from egvs.sensors import measured_scans
from egvs.sensors.scanner import Scan, Scanner
from egvs.sensors.sites import ScannedSite
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary
from egvs.stages.blocked_sites import near_share, warn_blocked_sites
from egvs.stages.scene_dependencies import scan_dependencies


def dependencies(context: StageContext) -> StageDependencies:
    """Return what empty scans depend on, and whether they are kept."""
    scans = scan_dependencies(context)
    return replace(scans, settings={"keep": context.scenario.scan.keep, **scans.settings})


def run(context: StageContext, inputs: StageDependencies, points: tuple[str, ...] = (), cloud: str = "ply") -> Summary:
    """Scan all sites and write ``scans.parquet``.

    Parameters
    ----------
    context
        The run folder, with the static world.
    inputs
        What the scans depend on.
    points
        Sites whose empty scan is also written as a point cloud, ``scan_<site>.<cloud>``.
    cloud
        ``"ply"`` or ``"pcd"``.

    Returns
    -------
    dict
        ``sites``, ``kept``, ``beams`` (cast), ``returns``, ``settled_in_float64`` (beams for which float32 was not
        exact enough), ``clouds`` (files with points); warnings.
    """
    scene = context.scene
    names = [site.name for site in scene.sites]
    for name in points:
        if name not in names:
            raise unknown_site("--points", name, names)
    _check_cloud_names(points)
    scanner = Scanner(scene)
    scanner.check(scene.sites)
    measured = list(measured_scans.check_measured_scans(scanner, scene.sites))
    errors = [finding for finding in measured if finding.is_error]
    warnings = [finding for finding in measured if not finding.is_error]
    if errors:
        raise DiagnosticsError(errors, warnings)
    summary: Summary
    if context.scenario.scan.keep:
        summary = _write_scans(context, inputs, scanner, points, cloud)
    else:
        context.folder.scans.unlink(missing_ok=True)
        clouds = []
        for site in scene.sites:
            if site.name in points:
                clouds.append(_write_cloud(context.folder, site.name, scanner.scan_site(site), cloud))
        summary = {"sites": len(names), "kept": False, "clouds": clouds}
    if warnings:
        summary[WARNINGS_KEY] = [*summary.get(WARNINGS_KEY, []), *(warning.to_json() for warning in warnings)]
    skipped = scene.skipped("scan")
    if skipped:
        summary["skipped"] = skipped
    return summary


def _check_cloud_names(sites: Sequence[str]) -> None:
    """Raise an InputError if the clouds of two sites have the same file name where case does not matter."""
    names: dict[str, str] = {}
    for site in sites:
        other = names.setdefault(site.casefold(), site)
        if other != site:
            problem = f"{site} and {other} give the same file on Windows and macOS"
            raise InputError("--points", problem, "Rename one of the two sites.")


def _write_scans(
    context: StageContext, inputs: StageDependencies, scanner: Scanner, points: tuple[str, ...], cloud: str
) -> Summary:
    """Scan the sites on the threads of the context; write one row group for each."""
    sites = context.scene.sites
    scanned: list[ScannedSite] = []
    near_shares: dict[str, float] = {}
    clouds = []
    ambiguous = 0
    with parquet.artefact_writer(context.folder.scans, "scans", scanner.columns) as file:
        scans = map_ordered(scanner.scan_site, sites, context.threads)
        for site, scan in zip(sites, scans, strict=True):
            file.write(_scan_columns(site.name, scan))
            scanned.append(scan.as_site(site.name, site.pole))
            near_shares[site.name] = near_share(scan.rows.ends_m, scan.rows.weight)
            ambiguous += scan.rows.ambiguous
            if site.name in points:
                clouds.append(_write_cloud(context.folder, site.name, scan, cloud))
            context.progress("sites", len(scanned), len(sites))
        file.describe(context.metadata(inputs, seeded=False, sites=[site.to_json() for site in scanned]))
    summary: Summary = {
        "sites": len(scanned),
        "kept": True,
        "beams": sum(site.beams_in_roi for site in scanned),
        "returns": sum(site.returns for site in scanned),
        "settled_in_float64": ambiguous,
        "clouds": clouds,
    }
    warnings = [warning.to_json() for warning in warn_blocked_sites(near_shares)]
    if warnings:
        summary[WARNINGS_KEY] = warnings
    return summary


def _scan_columns(site: str, scan: Scan) -> dict[str, Any]:
    ends = scan.rows.ends_m
    name = pa.DictionaryArray.from_arrays(np.zeros(len(ends), dtype=np.int32), [site])
    return {
        "site": name.cast(pa.string()),
        "beam": scan.rows.beam,
        "dx_m": ends[:, 0],
        "dy_m": ends[:, 1],
        "dz_m": ends[:, 2],
        "returned": scan.rows.returned,
        "weight": scan.rows.weight,
    }


def _write_cloud(folder: RunFolder, site: str, scan: Scan, suffix: str) -> str:
    """Write the points of a site; return the name of the file."""
    name = f"scan_{site}.{suffix}"
    points_m = scan.rows.ends_m[scan.rows.returned] + np.asarray(scan.pose.position_m)
    point_clouds.write_points(folder / name, points_m)
    return name


STAGE = Stage("scan", __name__, dependencies, run, reads=(RunFolder.statics,), code=("egvs.stages.scene_inputs",))
