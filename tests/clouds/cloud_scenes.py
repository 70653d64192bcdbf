"""Scenes, frames and a slow reference for point clouds with traffic."""

from dataclasses import replace

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

import egvs
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds import simulation as cloud_simulation
from egvs.scenario.sensor_config import SensorConfig
from egvs.sensors import sensor
from egvs.sensors.scene import Scene
from egvs.world.mesh import World
from tests.oracles import cast

KINDS = ("passenger", "taxi", "delivery", "truck", "bus", "pedestrian", "bicycle")


def frame_of(rows, kinds=None, number=0, vehicles=None, part=None):
    """A frame of boxes (x, y, z, length, width, height, yaw, pitch)."""
    rows = np.asarray(rows, dtype=np.float64).reshape(-1, 8)
    kinds = tuple(kinds or ["passenger"] * len(rows))
    vehicles = tuple(vehicles or (f"v{i}" for i in range(len(rows))))
    more = () if part is None else (np.asarray(part),)
    return TrafficFrame(number, vehicles, kinds, rows[:, :7].copy(), rows[:, 7].copy(), *more)


def random_frame(random, centre_m, count=12, spread_m=25.0, number=0):
    """Boxes at random, some of which overlap, pitched and turned; on a ground at 0 or through it."""
    at = np.asarray(centre_m) + random.uniform(-spread_m, spread_m, (count, 3)) * (1, 1, 0)
    at[:, 2] += random.uniform(0.2, 2.5, count)
    at[1] = at[0] + (0.7, 0.3, 0.1)
    size = random.uniform((0.6, 0.5, 1.0), (12.0, 2.6, 3.5), (count, 3))
    turn = np.column_stack([random.uniform(-np.pi, np.pi, count), random.uniform(-0.3, 0.3, count)])
    turn[:2] = [(0.0, 0.0), (np.pi / 2, 0.0)]
    kinds = [KINDS[i] for i in random.integers(0, len(KINDS), count)]
    return frame_of(np.column_stack([at, size, turn]), kinds, number)


def move_scene(scene, by_m):
    """A scene somewhere else."""
    by = np.asarray(by_m, dtype=np.float64)
    centre = np.add(scene.scenario.roi.center_m, by).tolist()
    scenario = scene.scenario.model_copy(
        update={"roi": scene.scenario.roi.model_copy(update={"center_m": tuple(centre)})}
    )
    scenario._folders = scene.scenario._folders
    world = World(scene.world.vertices_m + by, scene.world.faces, scene.world.solid_of_face, scene.world.solids)
    places = [
        dict(zip(("x_m", "y_m", "z_m"), np.add(s.pose.position_m, by).tolist(), strict=True)) for s in scene.sites
    ]
    sites = tuple(replace(s, pose=replace(s.pose, **at)) for s, at in zip(scene.sites, places, strict=True))
    return Scene(scenario, world, sites, scene.effects)


def body_triangles(frame, position_m):
    """Return the triangles of all bodies relative to the sensor, along the world's axes, and the box of each."""
    shapes, corners, owner = cloud_simulation.builtin_bodies(), [], []
    several = frame.several_parts()
    for b, box in enumerate(frame.boxes):
        kind = cloud_simulation.body_kind(frame.kinds[b], box[3:6].tolist(), int(frame.part[b]), bool(several[b]))
        unit = np.concatenate([part.triangles for part in shapes[kind]])
        turn = Rotation.from_euler("ZY", [box[6], -frame.pitch_rad[b]])
        metres = turn.apply((unit * box[3:6]).reshape(-1, 3)) + (box[:3] - np.asarray(position_m))
        corners.append(metres.reshape(-1, 3, 3))
        owner.append(np.full(len(unit), b))
    return np.concatenate(corners), np.concatenate(owner)


def slow_first_hits(scene, pose, sensor, frame):
    """Range of each beam's first hit (infinity for none) and its box (-1 for the static world): all against all."""
    directions = sensor.directions(*pose.angles_deg)
    still, _ = cast.first_hits(np.zeros(3), directions, scene.world.triangles_m - np.asarray(pose.position_m))
    corners, box = body_triangles(frame, pose.position_m)
    moving, triangle = cast.first_hits(np.zeros(3), directions, corners, edge_m=1e-9)
    in_front = moving < still
    ranges, owner = np.where(in_front, moving, still), np.where(in_front, box[triangle], -1)
    lost = ~(ranges <= sensor.range_m)
    return np.where(lost, np.inf, ranges), np.where(lost, -1, owner)


def build_scene(folder, *settings):
    """The scene of a scenario."""
    return egvs.build_scene(egvs.load(folder, settings))


def make_sensor(**keys):
    """A sensor from the keys of ``[sensors.own]``, without noise by default."""
    return sensor.resolve_sensor(
        "own", {"own": SensorConfig.from_dict({"range_sigma_m": 0.0, "range_m": 100.0, **keys})}, "test"
    )


def use_boxes_for(folder, *kinds):
    """Settings that replace these kinds of bodies by boxes, so that points on them can be counted by hand."""
    trimesh.creation.box((2.0, 1.0, 3.0)).export(folder / "cube.ply")
    return [f'validation.bodies.{kind}="cube.ply"' for kind in kinds]
