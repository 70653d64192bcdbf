"""What does each candidate site see of the static world alone?

Steps: read ``statics.ply``; cast the beams of every site (or read its measured scan); write ``scans.parquet``, one row
a beam that can meet the region of interest. The scan knows nothing of traffic, voxels or gamma, so none of these needs
it made again.

With ``scan.keep = false`` nothing is written here, and score casts as it goes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.artefacts import tables
from pipeline.core.errors import InputError
from pipeline.core.parallel import in_order, threads
from pipeline.core.progress import Progress, silent
from pipeline.scenario.models import Scenario
from pipeline.sensing import scanner as survey
from pipeline.sensing.scanner import SiteScan, Survey
from pipeline.stages.base import metadata
from pipeline.world.mesh import read_ply

NAME = "scan"
ARTEFACTS = ("scans.parquet",)


def inputs(scenario: Scenario, out: Path) -> dict[str, Any]:
    """The region of interest without its voxels, sites, sensors; the statics and the sites' files by hash."""
    return {
        "settings": {"keep": scenario.scan.keep, **survey.settings(scenario, out)},
        "files": survey.file_digests(scenario, out),
    }


def run(
    scenario: Scenario,
    out: Path,
    *,
    jobs: int | None = None,
    progress: Progress = silent,
    points: tuple[str, ...] = (),
    cloud: str = "ply",
) -> dict[str, Any]:
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
    world, _ = read_ply(out / "statics.ply")
    surveyed = Survey(scenario, world)
    known = [site.site for site in surveyed.sites]
    for name in points:
        if name not in known:
            raise InputError(f"--points {name}", "no such site", f"one of {', '.join(known)}")
    clouds: list[str] = []
    if not scenario.scan.keep:
        (out / ARTEFACTS[0]).unlink(missing_ok=True)
        clouds += (_write_cloud(out, surveyed.scan(site), cloud) for site in surveyed.sites if site.site in points)
        return {"sites": len(known), "kept": False, "clouds": clouds, **_skipped(surveyed)}
    about: list[dict[str, Any]] = []
    doubtful = 0
    with tables.writer(out / ARTEFACTS[0], "scans", surveyed.columns) as file:
        for done in in_order(surveyed.scan, surveyed.sites, threads(jobs)):
            file.write(_columns(done))
            about.append(done.about)
            doubtful += done.scan.doubtful
            if done.site.site in points:
                clouds.append(_write_cloud(out, done, cloud))
            progress("sites", len(about), len(known))
        file.describe(metadata(scenario, inputs(scenario, out), seed=None, sites=about))
    return {
        "sites": len(known),
        "kept": True,
        "beams": sum(a["beams_in_roi"] for a in about),
        "returns": sum(a["returns"] for a in about),
        "settled_in_float64": doubtful,
        "clouds": clouds,
        **_skipped(surveyed),
    }


def _skipped(surveyed: Survey) -> dict[str, Any]:
    """What to say of effects that are named but provably change nothing; nothing when there is none."""
    return {"skipped": [f"{name}: {why}" for name, why in surveyed.skipped.items()]} if surveyed.skipped else {}


def _columns(done: SiteScan) -> dict[str, Any]:
    ends = done.scan.ends_m
    name = pa.DictionaryArray.from_arrays(np.zeros(len(ends), dtype=np.int32), [done.site.site])
    columns = {
        "site": name.cast(pa.string()),
        "beam": done.scan.beam,
        "dx_m": ends[:, 0],
        "dy_m": ends[:, 1],
        "dz_m": ends[:, 2],
        "returned": done.scan.returned,
    }
    return columns | {"weight": done.scan.weight}


def _write_cloud(out: Path, done: SiteScan, suffix: str) -> str:
    """Write a site's points; the file's name."""
    from pipeline.formats import point_clouds as clouds

    name, ends = f"scan_{done.site.site}.{suffix}", done.scan.ends_m[done.scan.returned]
    clouds.write_points(out / name, ends + np.asarray(done.site.position_m))
    return name
