"""The scan stage: what each candidate site sees of the static world alone, as ``scans.parquet``.

Steps: cast the beams of every site (or read its measured scan), :mod:`egvs.sensors.scanner`; write one row a beam
that can meet the region of interest. The scan knows nothing of traffic, voxels or gamma, so none of these needs it made
again.

With ``scan.keep = false`` nothing is written here, and score casts as it goes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.core.errors import InputError
from egvs.core.runtime import map_ordered
from egvs.formats import point_clouds
from egvs.sensors.scanner import Scan, Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sites import ScannedSite, Site
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary
from egvs.stages.scene_inputs import scan_dependencies


def dependencies(work: StageContext) -> StageDependencies:
    """What empty scans depend on, and whether they are kept."""
    read = scan_dependencies(work)
    return replace(read, settings={"keep": work.scenario.scan.keep, **read.settings})


def run(work: StageContext, inputs: StageDependencies, points: tuple[str, ...] = (), cloud: str = "ply") -> Summary:
    """Scan all sites and write ``scans.parquet``.

    Parameters
    ----------
    points
        Sites whose empty scan is also written as a point cloud, ``scan_<site>.<cloud>``.
    cloud
        ``"ply"`` or ``"pcd"``.

    Returns
    -------
    dict
        ``sites``, ``beams`` (cast), ``returns``, ``settled_in_float64`` (beams that float32 alone left in doubt),
        ``clouds`` (files with points).
    """
    scene = work.scene
    known = [site.name for site in scene.sites]
    for name in points:
        if name not in known:
            raise InputError(f"--points {name}", "no such site", f"one of {', '.join(known)}")
    scanner = Scanner(scene)
    scanner.check(scene.sites)
    if not work.scenario.scan.keep:
        work.folder.scans.unlink(missing_ok=True)
        written = [
            _write_cloud(work.folder.path, s.name, scanner.scan_site(s), cloud) for s in scene.sites if s.name in points
        ]
        return {"sites": len(known), "kept": False, "clouds": written, **_skipped_effects(scene)}
    return _write_all(work, inputs, scanner, points, cloud)


def _write_all(
    work: StageContext, inputs: StageDependencies, scanner: Scanner, points: tuple[str, ...], cloud: str
) -> Summary:
    scene, clouds, doubtful = work.scene, [], 0
    about: list[ScannedSite] = []

    def scan(site: Site) -> tuple[Site, Scan, ScannedSite]:
        done = scanner.scan_site(site)
        return site, done, done.as_site(site.name, site.pole)

    with parquet.artefact_writer(work.folder.scans, "scans", scanner.columns) as file:
        for site, done, scanned in map_ordered(scan, scene.sites, work.threads):
            file.write(_scan_columns(site.name, done))
            about.append(scanned)
            doubtful += done.rows.doubtful
            if site.name in points:
                clouds.append(_write_cloud(work.folder.path, site.name, done, cloud))
            work.progress("sites", len(about), len(scene.sites))
        file.describe(work.metadata(inputs, seeded=False, sites=[site.to_json() for site in about]))
    return {
        "sites": len(about),
        "kept": True,
        "beams": sum(site.beams_in_roi for site in about),
        "returns": sum(site.returns for site in about),
        "settled_in_float64": doubtful,
        "clouds": clouds,
        **_skipped_effects(scene),
    }


def _skipped_effects(scene: Scene) -> Summary:
    """What to say of effects that are named but provably change nothing; nothing when there is none."""
    skipped = scene.skipped("scan")
    return {"skipped": skipped} if skipped else {}


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


def _write_cloud(folder: Path, site: str, scan: Scan, suffix: str) -> str:
    """Write a site's points; the file's name."""
    name, ends = f"scan_{site}.{suffix}", scan.rows.ends_m[scan.rows.returned]
    point_clouds.write_points(folder / name, ends + np.asarray(scan.pose.position_m))
    return name


STAGE = Stage("scan", __name__, dependencies, run, reads=(RunFolder.statics,))
