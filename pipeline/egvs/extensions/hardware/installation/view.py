"""The view from a pole: a perspective picture of the static world, as a crew sees it from the sensor.

One ray per pixel is cast at the static world, without what carries the sensor. The camera has no roll. Surfaces are
shaded by their angle to the light, and fade with distance.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from egvs.core.grid import BoolArray, FloatArray, Roi
from egvs.drawing.basemap import is_vegetation
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor, rotation_world_sensor
from egvs.sensors.sites import Pose
from egvs.world.carriageway import Carriageway
from egvs.world.ray_casting import Caster
from egvs.world.supports import without_solids

HORIZONTAL_DEG = 100.0
"""Width of the picture."""
RANGE_M = 400.0
_LOWEST_DEG, _HIGHEST_DEG = -30.0, 0.0
"""Elevations between which the camera looks, so that the picture shows the horizon and the road."""
_LIGHT = np.array([0.35, -0.5, 0.79])
_FADE_M = 160.0
_COLOURS = {
    "sky": (214, 228, 242), "ground": (206, 210, 196), "road": (142, 146, 154), "building": (205, 190, 168),
    "green": (112, 152, 104), "other": (96, 104, 120),
}  # fmt: skip


def camera_pose(pose: Pose, sensor: Sensor, roi: Roi) -> Pose:
    """Return the pose of the camera at the sensor.

    It looks along the middle ray of the sensor, or at the middle of the region of interest if the sensor has a full
    circle.
    """
    if sensor.azimuth_span_deg is None:
        to_m = np.asarray(roi.origin_m) + np.asarray(roi.size_m) / 2.0 - np.asarray(pose.position_m)
        return _towards(pose, to_m / max(float(np.linalg.norm(to_m)), 1e-9))
    elevation, azimuth = (math.radians(angle) for angle in sensor.middle_deg)
    flat = math.cos(elevation)
    ray = np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])
    return _towards(pose, rotation_world_sensor(*pose.angles_deg) @ ray)


def _towards(pose: Pose, ahead: FloatArray) -> Pose:
    """Return a level camera that looks along a unit vector of the world frame, but neither far down nor up."""
    yaw_deg = math.degrees(math.atan2(ahead[1], ahead[0]))
    pitch_deg = math.degrees(math.asin(max(-1.0, min(1.0, float(ahead[2])))))
    return Pose(*pose.position_m, yaw_deg, max(_LOWEST_DEG, min(_HIGHEST_DEG, pitch_deg)))


def pixel_rays(width: int, height: int) -> FloatArray:
    """Return the unit vectors of the pixels in the camera's frame (x ahead, z up), (height * width, 3), row by row."""
    half = math.tan(math.radians(HORIZONTAL_DEG / 2.0))
    left = half * (1.0 - 2.0 * (np.arange(width) + 0.5) / width)
    up = half * (height / width) * (1.0 - 2.0 * (np.arange(height) + 0.5) / height)
    rays = np.empty((height, width, 3))
    rays[..., 0] = 1.0
    rays[..., 1] = left
    rays[..., 2] = up[:, None]
    unit: FloatArray = (rays / np.linalg.norm(rays, axis=2, keepdims=True)).reshape(-1, 3)
    return unit


def render_view(
    scene: Scene, pose: Pose, sensor: Sensor, carriageway: Carriageway | None, width: int = 640, height: int = 320
) -> NDArray[np.uint8]:
    """Return the picture from a sensor, (height, width, 3) uint8.

    Parameters
    ----------
    scene
        The scene.
    pose, sensor
        The sensor.
    carriageway
        Drawn on the ground; None if unknown.
    width, height
        Pixels.
    """
    supports = scene.own_supports(pose)
    world = without_solids(scene.world, supports) if supports else scene.world
    camera = camera_pose(pose, sensor, scene.roi)
    rays = pixel_rays(width, height) @ rotation_world_sensor(*camera.angles_deg).T
    scan = Caster(world, scene.roi).sweep(camera.position_m, np.ascontiguousarray(rays), RANGE_M)
    assert scan.face is not None
    hit = np.flatnonzero(scan.returned)
    faces = scan.face[hit]

    colour_of_solid = np.array([_COLOURS[_style(name, kind)] for name, kind in world.solids] or [(0, 0, 0)])
    colours = colour_of_solid[world.solid_of_face[faces]].astype(np.float64)
    is_ground = np.array([solid == ("ground", "ground") for solid in world.solids] or [False])[
        world.solid_of_face[faces]
    ]  # fmt: skip
    points_m = scan.ends_m[hit] + np.asarray(camera.position_m)
    if carriageway is not None:
        on_ground = np.flatnonzero(is_ground)
        on_road = on_ground[_on_road(carriageway, points_m[on_ground, :2])]
        colours[on_road] = _COLOURS["road"]

    corners = world.triangles_m[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    facing = np.sign(np.einsum("ij,ij->i", normals, -rays[hit]))
    light = 0.72 + 0.28 * np.clip((normals * facing[:, None]) @ _LIGHT, -0.6, 1.0)
    fade = 1.0 - np.exp(-np.linalg.norm(scan.ends_m[hit], axis=1) / _FADE_M)
    sky = np.array(_COLOURS["sky"], dtype=np.float64)
    picture = np.tile(sky, (len(rays), 1))
    picture[hit] = colours * light[:, None] * (1.0 - fade)[:, None] + sky * fade[:, None]
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8).reshape(height, width, 3)


def _style(name: str, kind: str) -> str:
    """Return the colour of a solid."""
    if (name, kind) == ("ground", "ground"):
        return "ground"
    if is_vegetation(kind):
        return "green"
    return "building" if "building" in kind else "other"


def _on_road(carriageway: Carriageway, xy_m: FloatArray) -> BoolArray:
    """Return which points (n, 2) lie on a lane or in a junction."""
    import shapely

    shapes = [*carriageway.areas]
    shapes += [shapely.Polygon(junction.shape_m[:, :2]) for junction in carriageway.junctions]
    near = shapely.box(*xy_m.min(axis=0), *xy_m.max(axis=0)) if len(xy_m) else shapely.box(0, 0, 0, 0)
    shapes = [shapely.make_valid(shape) for shape in shapes if shapely.intersects(shape, near)]
    area = shapely.union_all(shapes)
    shapely.prepare(area)
    inside: BoolArray = shapely.contains_xy(area, xy_m[:, 0], xy_m[:, 1])
    return inside
