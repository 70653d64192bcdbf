"""Candidates of a junction, drawn at random with the seed of the protocol.

Steps: put a lattice over the region of interest and its surroundings; select the points near a lane where a pole is
possible at every height; draw as many of them as there are candidates, without replacement. Heights and sensors are
dealt out equally often and shuffled. Pitch and roll are uniform. The sensor faces a point that is uniform in the region
of interest, so that narrow sensors do not look away from the junction. World frame, metres and degrees.
"""

from __future__ import annotations

import csv
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from benchmarks.across_junctions.protocol import CANDIDATES_FILE, FOLDER, Junction, Protocol
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.scenario.model import Scenario, SitesConfig
from egvs.sensors import site_feasibility
from egvs.sensors.scene import Scene
from egvs.sensors.sites import Pose, Site
from egvs.world.carriageway import Carriageway

COLUMNS = ("junction", "site", "x_m", "y_m", "z_m", "height_m", "yaw_deg", "pitch_deg", "roll_deg", "sensor")

T = TypeVar("T")

REFERENCE_SENSOR = "VLP-32C"
"""Its range limits how far from the region of interest a pole may stand."""

MARGIN_M = 12.0
"""Largest distance of poles from the region of interest."""

ROAD_M = 6.0
"""Largest distance of poles from a lane."""

SPACING_M = 2.0
"""Spacing of the lattice."""


def draw_candidates(
    protocol: Protocol, junction: Junction, scene: Scene, carriageway: Carriageway | None
) -> dict[Site, float]:
    """Return the candidates of a junction, with their heights above the ground in metres; none for training detectors.

    Raises
    ------
    InputError
        Where fewer places are free than there are candidates.
    """
    rule = protocol.candidates
    heights_m = protocol.heights_m(junction)
    if not heights_m:
        return {}
    free = free_locations(scene, carriageway, heights_m)
    if len(free) < rule.count:
        problem = f"expected {rule.count} free places beside the roads, got {len(free)}"
        raise InputError(f"junctions.toml: {junction.name}", problem, "Use a junction with more space.")
    rng = np.random.default_rng((protocol.seed, zlib.crc32(junction.name.encode())))
    places = free[rng.choice(len(free), rule.count, replace=False)]
    heights = dealt(heights_m, rule.count, rng)
    sensors = dealt(rule.sensors, rule.count, rng)
    aims_m = np.array(scene.roi.origin_m[:2]) + rng.random((rule.count, 2)) * np.array(scene.roi.size_m[:2])
    yaw = np.degrees(np.arctan2(*(aims_m - places).T[::-1]))
    pitch, roll = (rng.uniform(*limits, rule.count) for limits in (rule.pitch_deg, rule.roll_deg))
    candidates = {}
    for number, (x_m, y_m) in enumerate(places.tolist()):
        height_m = heights[number]
        angles = (round(float(values[number]), 2) + 0.0 for values in (yaw, pitch, roll))
        name = f"c{number + 1:02d}"
        pose = Pose(round(x_m, 3), round(y_m, 3), round(_ground_m(scene, x_m, y_m) + height_m, 3), *angles)
        site = Site(name, pose, sensors[number], pole=name)
        site_feasibility.check_pose(scene, pose, scene.sensor(site.sensor), f"{junction.name} {name}")
        candidates[site] = height_m
    return candidates


def free_locations(scene: Scene, carriageway: Carriageway | None, heights_m: Sequence[float]) -> FloatArray:
    """Return the points of the lattice where a pole is possible at every height, (n, 2) float64, in metres."""
    near = _near_lanes(_lattice(scene), carriageway)
    each = [_sites_on_pole(scene, at_m, f"g{number:02d}", heights_m) for number, at_m in enumerate(near.tolist())]
    free = site_feasibility.drop_infeasible([sites[0] for sites in each], scene.world, carriageway).free
    poles = {site.pole for site in free}
    free_points = [
        at_m for at_m, sites in zip(near, each, strict=True) if sites[0].pole in poles and _can_be_mounted(scene, sites)
    ]
    return np.array(free_points, dtype=np.float64).reshape(-1, 2)


def _lattice(scene: Scene) -> FloatArray:
    low = np.asarray(scene.roi.origin_m)[:2] - MARGIN_M
    steps = np.floor((np.asarray(scene.roi.size_m)[:2] + 2 * MARGIN_M) / SPACING_M).astype(int) + 1
    x, y = np.meshgrid(*(np.arange(n) * SPACING_M for n in steps.tolist()), indexing="ij")
    return low + np.column_stack([x.ravel(), y.ravel()])


def _near_lanes(points_m: FloatArray, carriageway: Carriageway | None) -> FloatArray:
    """Return the points near lanes; all of them without a network."""
    if carriageway is None:
        return points_m
    import shapely

    tree = shapely.STRtree(carriageway.areas)
    near = np.unique(tree.query(shapely.points(points_m), "dwithin", distance=ROAD_M)[0])
    points_near: FloatArray = points_m[near]
    return points_near


def _sites_on_pole(scene: Scene, at_m: Sequence[float], pole: str, heights_m: Sequence[float]) -> list[Site]:
    """Return a site for each height above the ground."""
    x_m, y_m = at_m
    ground_m = _ground_m(scene, x_m, y_m)
    poses = [Pose(x_m, y_m, ground_m + height_m) for height_m in heights_m]
    return [Site(f"{pole}h{h:g}", pose, REFERENCE_SENSOR, pole=pole) for h, pose in zip(heights_m, poses, strict=True)]


def _ground_m(scene: Scene, x_m: float, y_m: float) -> float:
    """Return the height of the ground; 0 in a scenario without one."""
    if not scene.scenario.statics.ground:
        return 0.0
    return site_feasibility.ground_height_m(scene.world, Pose(x_m, y_m, 0.0))


def _can_be_mounted(scene: Scene, sites: Sequence[Site]) -> bool:
    """Whether sensors can be mounted: above the ground, in no solid, in range of the region of interest."""
    try:
        for site in sites:
            site_feasibility.check_pose(scene, site.pose, scene.sensor(site.sensor), site.name)
    except InputError:
        return False
    return True


def dealt(values: Sequence[T], count: int, rng: np.random.Generator) -> list[T]:
    """Return ``count`` values, each equally often up to one, in random order."""
    order = rng.permutation(len(values))
    deck = [values[order[number % len(values)]] for number in range(count)]
    return [deck[number] for number in rng.permutation(count)]


def write_candidates(each: Mapping[str, Mapping[Site, float]], folder: Path = FOLDER) -> None:
    """Write the candidates of all junctions as CSV."""
    with (
        files.atomic_write(folder / CANDIDATES_FILE) as partial,
        partial.open("w", encoding="utf-8", newline="") as out,
    ):
        rows = csv.writer(out, lineterminator="\n")
        rows.writerow(COLUMNS)
        for junction, candidates in each.items():
            for site, height_m in candidates.items():
                pose = site.pose
                rows.writerow(
                    [junction, site.name, *map(repr, (*pose.position_m, height_m, *pose.angles_deg)), site.sensor]
                )


def read_candidates(folder: Path = FOLDER) -> dict[str, dict[Site, float]]:
    """Return the candidates of each junction, with their heights above the ground in metres.

    Raises
    ------
    InputError
        If there is no such file.
    """
    path = folder / CANDIDATES_FILE
    if not path.is_file():
        raise InputError(path, "no such file", "Write it with: python -m benchmarks.across_junctions build --write")
    each: dict[str, dict[Site, float]] = {}
    with path.open(encoding="utf-8", newline="") as lines:
        for row in csv.DictReader(lines):
            numbers = (float(row[column]) for column in ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg"))
            site = Site(row["site"], Pose(*numbers), row["sensor"], pole=row["site"])
            each.setdefault(row["junction"], {})[site] = float(row["height_m"])
    return each


def with_sites(scenario: Scenario, sites: Sequence[Site], file: Path) -> Scenario:
    """Return the scenario with these sites, written to a CSV file."""
    with files.atomic_write(file) as partial, partial.open("w", encoding="utf-8", newline="") as out:
        rows = csv.writer(out, lineterminator="\n")
        rows.writerow(["site", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg", "sensor"])
        for site in sites:
            rows.writerow([site.name, *map(repr, (*site.pose.position_m, *site.pose.angles_deg)), site.sensor])
    model = SitesConfig(file=str(file.resolve()), sensor=sites[0].sensor)  # rows have their own; one repeats it
    return scenario.model_copy(update={"sites": model})
