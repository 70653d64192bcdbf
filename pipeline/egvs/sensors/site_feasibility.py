"""Where a sensor or its pole cannot stand.

:func:`check_pose` rejects a pose that is below the ground, inside a solid, or out of range of the region of interest.

:func:`drop_infeasible` drops candidates of a rule (a lattice or a line, which ignore the roads) whose pole would stand
in a lane, in the middle of a junction, or in a solid. The height of the sensor does not matter, since the pole reaches
the ground; sensors on gantries are listed in a sites file instead. Candidates between the lanes of a junction are
dropped too, because networks do not tell an island from the middle of a crossing. World frame, metres.

The sensor's own pole, mast or sign (:mod:`egvs.world.supports`) is in nobody's way.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import PLANE_TOLERANCE_M, IntArray, Roi
from egvs.kernels import occupancy, ray_triangle
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Pose, Site
from egvs.world.carriageway import Carriageway
from egvs.world.mesh import World
from egvs.world.ray_casting import touches_sensor
from egvs.world.supports import KINDS, MAX_WIDTH_M, Supports

IN_A_LANE = "in a lane"
IN_A_JUNCTION = "in a junction"
IN_A_SOLID = "in a solid"


def check_pose(scene: Scene, pose: Pose, sensor: Sensor, where: str) -> None:
    """Raise an InputError naming ``where`` if the sensor cannot stand at a pose, or cannot reach the ROI from it."""
    roi = scene.roi
    faces = _faces_around(scene.world, pose)
    ground_m = -np.inf
    if scene.scenario.statics.ground:
        ground_m = _ground_height_m(scene.world, pose, faces)
    if not pose.z_m > ground_m + ray_triangle.EDGE_M:
        problem = f"z_m = {pose.z_m:g} is not above the ground (z = {ground_m:.4g})"
        raise InputError(where, problem, f"Use a height above {ground_m:.4g} m.")
    distance_m = _distance_m(roi, pose.position_m)
    reach_m = sensor.range_m + PLANE_TOLERANCE_M
    if distance_m > reach_m:
        problem = f"the site is {distance_m:.1f} m from the region of interest"
        hint = f"Move it within the range of {sensor.name}, {sensor.range_m:g} m."
        middle_x_m, middle_y_m = np.add(roi.origin_m, np.divide(roi.size_m, 2.0))[:2].tolist()
        if _distance_m(roi, (pose.x_m + middle_x_m, pose.y_m + middle_y_m, pose.z_m)) <= reach_m:
            middle = f"The middle of the region is at x {middle_x_m:.6g}, y {middle_y_m:.6g}"
            hint += f" {middle}: add it to positions that count from there."
        may_be_degrees = abs(pose.x_m) <= 180.0 and abs(pose.y_m) <= 90.0
        if may_be_degrees:
            hint += " Longitude and latitude belong in columns longitude and latitude."
        raise InputError(where, problem, hint)
    enclosing = _enclosing_solid(scene.world, pose, faces, scene.own_supports(pose))
    if enclosing is not None:
        name, kind = scene.world.solids[enclosing]
        problem = f"({pose.x_m:g}, {pose.y_m:g}, {pose.z_m:g}) is inside {name} ({kind})"
        raise InputError(where, problem, _outside_hint(scene.world, enclosing))


def _distance_m(roi: Roi, position_m: tuple[float, float, float]) -> float:
    """Return the distance of a point (x, y, z) from a region."""
    below = np.subtract(roi.origin_m, position_m)
    above = np.subtract(position_m, np.add(roi.origin_m, roi.size_m))
    return float(np.sqrt((np.maximum(np.maximum(below, above), 0.0) ** 2).sum()))


def _outside_hint(world: World, solid: int) -> str:
    """Return what to do about a sensor inside a solid; one as narrow as a mast may be its mast."""
    corners_m = world.triangles_m[world.solid_of_face == solid][:, :, :2].reshape(-1, 2)
    if np.ptp(corners_m, axis=0).max() > MAX_WIDTH_M:
        return "Move it outside."
    kinds = " or ".join(KINDS)
    return f"Move it outside. If this is the sensor's mast, set its kind to {kinds}; its scan then leaves it out."


def ground_height_m(world: World, pose: Pose) -> float:
    """Return the ground's z below a pose: 0, or that of the terrain of a network with relief."""
    return _ground_height_m(world, pose, _faces_around(world, pose))


def _faces_around(world: World, pose: Pose) -> IntArray:
    """The faces that a vertical line through the sensor may meet."""
    low, high = world.bounds_xy_m
    near = np.ones(len(low), dtype=np.bool_)
    for axis, at_m in enumerate((pose.x_m, pose.y_m)):  # column by column: four times as fast as both at once
        near &= (low[:, axis] - ray_triangle.EDGE_M <= at_m) & (at_m <= high[:, axis] + ray_triangle.EDGE_M)
    return np.flatnonzero(near)


def _ground_height_m(world: World, pose: Pose, faces: IntArray) -> float:
    ground = [face for face in faces if world.solids[world.solid_of_face[face]] == ("ground", "ground")]
    for a, b, c in world.triangles_m[ground]:
        u = (b - a)[:2]
        v = (c - a)[:2]
        to = np.array([pose.x_m, pose.y_m]) - a[:2]
        area = u[0] * v[1] - u[1] * v[0]
        s = (to[0] * v[1] - to[1] * v[0]) / area
        t = (u[0] * to[1] - u[1] * to[0]) / area
        if min(s, t, 1.0 - s - t) >= -ray_triangle.EDGE_M:
            return float(a[2] + s * (b[2] - a[2]) + t * (c[2] - a[2]))
    return 0.0


def _enclosing_solid(world: World, pose: Pose, faces: IntArray, supports: tuple[int, ...]) -> int | None:
    """Return the first solid that contains a sensor; its supports, and a solid that it touches, do not count."""
    position = np.asarray(pose.position_m)
    triangles = world.triangles_m[faces]
    solids = world.solid_of_face[faces]
    winding = np.zeros(len(world.solids), dtype=np.int64)
    occupancy.point_winding_numbers(position, triangles, solids.astype(np.int64), world.signs[solids], winding)
    if winding.any():
        winding[solids[touches_sensor(triangles - position)]] = 0
    winding[list(supports)] = 0
    enclosing = np.flatnonzero((winding != 0) & world.closed)
    return int(enclosing[0]) if len(enclosing) else None


@dataclass(frozen=True)
class SiteSelection:
    """The candidates of a rule.

    Attributes
    ----------
    free
        Candidates where a pole can stand, in order.
    dropped
        The other candidates, each with the reason.
    """

    free: tuple[Site, ...]
    dropped: tuple[tuple[Site, str], ...] = ()

    @property
    def reasons(self) -> dict[str, int]:
        """Number of dropped candidates by reason."""
        return dict(Counter(reason for _, reason in self.dropped))


def drop_infeasible(sites: Sequence[Site], world: World, carriageway: Carriageway | None) -> SiteSelection:
    """Select the candidates where a pole can stand; without a carriageway, only solids are checked."""
    free = []
    dropped = []
    supports = Supports.of(world)
    for site, conflict in zip(sites, _road_conflicts(sites, carriageway), strict=True):
        reason = conflict
        own = supports.at(site.pose.x_m, site.pose.y_m)
        if reason is None and _enclosing_solid(world, site.pose, _faces_around(world, site.pose), own) is not None:
            reason = IN_A_SOLID
        if reason is None:
            free.append(site)
        else:
            dropped.append((site, reason))
    return SiteSelection(tuple(free), tuple(dropped))


def _road_conflicts(sites: Sequence[Site], carriageway: Carriageway | None) -> list[str | None]:
    """Why the pole of each site would stand on the road; None where it would not."""
    conflicts: list[str | None] = [None] * len(sites)
    if carriageway is None:
        return conflicts
    positions_m = np.array([site.pose.position_m for site in sites]).reshape(-1, 3)
    lanes = carriageway.lanes_at(positions_m)
    in_junctions = carriageway.in_junctions(positions_m[:, :2])
    for i, lane in enumerate(lanes):
        if lane is not None:
            conflicts[i] = IN_A_LANE
        elif in_junctions[i]:
            conflicts[i] = IN_A_JUNCTION
    return conflicts
