"""Empty scans of a small scenario with other static geometry."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import shapely

import egvs
from egvs.artefacts.tpog import Tpog
from egvs.core.grid import Grid, Roi
from egvs.runs.run_context import open_folder
from egvs.scoring.scorer import Scorer
from egvs.stages import scan, statics
from egvs.stages.site_scoring import empty_scans
from egvs.world import static_world
from egvs.world.footprints import Footprint
from egvs.world.mesh import World
from tests.conftest import collection, feature
from tests.stage_runner import run_stage

FOLIAGE, DIVERGENCE, SWAY = (
    "effects.foliage.leaf_area_density=",
    "effects.divergence.sub_beams=",
    "effects.mount_sway.tilt_deg=",
)


def prism(
    x0: float, y0: float, x1: float, y1: float, base: float, top: float, kind: str, name: str = "it"
) -> dict[str, Any]:
    ring = [[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]]
    return feature({"type": "Polygon", "coordinates": [ring]}, name=name, kind=kind, base_m=base, height_m=top)


def write_scene(mini: Path, *solids: dict[str, Any], sites: str | None = None) -> Path:
    """The small scenario with other static geometry, and other sites."""
    (mini / "statics.geojson").write_text(collection(*solids))
    if sites is not None:
        (mini / "sites.csv").write_text("site,x_m,y_m,z_m\n" + sites)
    return mini


def one_beam_scene(mini: Path, *solids: dict[str, Any], divergence: str = "") -> Path:
    """One site 10 m before the region of interest, whose only beam in reach goes along y = 0.25, z = 2.25, where voxels
    have their middles; the ground is left away."""
    write_scene(mini, *solids, sites="only,-10,0.25,2.25\n")
    text = (mini / "scenario.toml").read_text()
    text = text.replace(
        "elevations_deg = [-15, 5]\nchannels = 8\nazimuth_step_deg = 1.0", "elevations_deg = [0]\nazimuth_step_deg = 90"
    )
    (mini / "scenario.toml").write_text(text.replace("[statics]", "[statics]\nground = false") + divergence)
    return mini


TREES = (
    prism(12, -4, 15, -1, 1, 4, "tree_crown", "low"),
    prism(14, -3, 17, 0.5, 2, 6, "tree_crown", "overlapping"),
    prism(13.4, -2.6, 13.6, -2.4, 0, 1, "tree_trunk", "trunk"),
    prism(27, 3, 30.5, 6, 0.5, 3.5, "tree_crown", "flush with a site's x"),
    prism(24, -2, 26, 0, 0, 2, "building", "kiosk"),
)


def run_scan(folder: Path, out: Path, *sets: str, jobs: int = 1) -> tuple[egvs.Scenario, Path]:
    scenario = egvs.load(folder, sets)
    run_stage(statics, scenario, out)
    run_stage(scan, scenario, out, jobs=jobs)
    return scenario, out


def scan_hits(folder: Path, out: Path, *sets: str) -> dict[str, np.ndarray]:
    """Hits in each voxel, by site."""
    scenario, out = run_scan(folder, out, *sets)
    grid = Grid.over(scenario.roi.box, scenario.roi.voxel_m)
    work, empty = open_folder(scenario, out), Tpog(grid, 1, np.zeros(grid.shape, dtype=np.int64))
    scorer = Scorer(work.scene, empty)
    return {scan.site.name: scorer.hits(scan.beams) for scan in empty_scans(work)}


def hits_along_only_beam(hits_by_site: dict[str, np.ndarray]) -> np.ndarray:
    """Hits along the only beam of :func:`one_beam`, by the number of the voxel: x from 0 in steps of 0.5 m."""
    return hits_by_site["only"][:, 20, 4]


def _world(*polygons: tuple[list[tuple[float, float]], float, float]) -> World:
    builder = static_world._Builder()
    for number, (ring, base, top) in enumerate(polygons):
        footprint = Footprint(str(number), "tree_crown", shapely.orient_polygons(shapely.Polygon(ring)), base, top)
        builder.add(*static_world._extrude(footprint), footprint.name, footprint.kind)
    return builder.world()


ROI = Roi((0.0, -10.0, 0.0), (40.0, 20.0, 5.0))


HOOK = [(10, -3), (18, -3), (18, 3), (14, 3), (14, -1), (12, -1), (12, 4), (10, 4)]


ROUND = [(20 + 3 * math.cos(a), 1 + 3 * math.sin(a)) for a in np.arange(16) * math.tau / 16]


CROWNS = ((HOOK, 1.0, 4.5), (ROUND, 2.0, 7.0), ([(16, -2), (24, 0), (17, 5)], 0.5, 3.0))
