"""A small street as numbers in the world frame, and its scores by an independent program.

Nothing here reads a file or calls the package. Vehicles are upright boxes, solids are convex prisms, the ground is a
plane. Beams are held against every triangle (:mod:`tests.oracles.cast`), occupied voxels are found with separating axes
(:func:`tests.oracles.boxes.occupied_by_upright`), and entropies are added up. Metres, radians inside; z is up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tests.oracles import cast
from tests.oracles.boxes import occupied_by_upright

FloatArray = NDArray[np.float64]
Frames = tuple[tuple["Box", ...], ...]

RANGE_M = 100.0
ON_RAY_M = 1000.0


@dataclass(frozen=True)
class Box:
    """A vehicle at one time: centre of its box, and its yaw counter-clockwise from east."""

    name: str
    kind: str
    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    length_m: float
    width_m: float
    height_m: float
    speed_m_s: float

    @property
    def front_m(self) -> tuple[float, float, float]:
        """Middle of the front bumper, on the road."""
        half_m = 0.5 * self.length_m
        x_m, y_m = self.x_m + half_m * math.cos(self.yaw_rad), self.y_m + half_m * math.sin(self.yaw_rad)
        return x_m, y_m, self.z_m - 0.5 * self.height_m


@dataclass(frozen=True)
class Prism:
    """A solid: a convex ring in plan, counter-clockwise, from its foot to its roof."""

    name: str
    ring_m: tuple[tuple[float, float], ...]
    foot_m: float
    roof_m: float

    @property
    def triangles_m(self) -> FloatArray:
        """(n, 3, 3)."""
        foot, roof = ([(x, y, z) for x, y in self.ring_m] for z in (self.foot_m, self.roof_m))
        triangles = []
        for a, b in pairwise([*range(len(foot)), 0]):
            triangles += [(foot[a], foot[b], roof[b]), (foot[a], roof[b], roof[a])]
        for ring in (foot, roof):
            triangles += [(ring[0], ring[k], ring[k + 1]) for k in range(1, len(ring) - 1)]
        return np.array(triangles)


@dataclass(frozen=True)
class Mount:
    """Where a sensor stands, and how: roll about its x axis first, then pitch (nose up), then yaw."""

    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    @property
    def position_m(self) -> FloatArray:
        """(3,)."""
        return np.array([self.x_m, self.y_m, self.z_m])

    def to_world(self, rays: FloatArray) -> FloatArray:
        """Turn directions (n, 3) of the sensor's frame."""
        for angle_deg, first, second in ((self.roll_deg, 1, 2), (self.pitch_deg, 0, 2), (self.yaw_deg, 0, 1)):
            c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
            rays = rays.copy()
            rays[:, first], rays[:, second] = (
                c * rays[:, first] - s * rays[:, second],
                s * rays[:, first] + c * rays[:, second],
            )
        return rays


@dataclass(frozen=True)
class Truth:
    """What is there.

    Attributes
    ----------
    periods
        Parts of the day: weight, and the vehicles of each frame.
    solids, ground_m
        The static world.
    mounts
        The sites.
    elevations_deg, azimuths_deg
        Beams of the sensor, all pairs.
    region_m, size_m, voxel_m
        Centre and size of the region of interest.
    gamma
        Cap of the beams in a voxel.
    """

    periods: tuple[tuple[float, Frames], ...]
    solids: tuple[Prism, ...]
    mounts: tuple[tuple[str, Mount], ...]
    elevations_deg: tuple[float, ...] = tuple(range(-20, 5, 4))
    azimuths_deg: tuple[float, ...] = tuple(range(0, 360, 3))
    ground_m: float = 0.0
    region_m: tuple[float, float, float] = (20.0, 0.0, 2.5)
    size_m: tuple[float, float, float] = (40.0, 20.0, 5.0)
    voxel_m: float = 0.5
    gamma: float = 4.0

    @property
    def shape(self) -> tuple[int, ...]:
        """Voxels along each axis."""
        return tuple(round(size / self.voxel_m) for size in self.size_m)

    @property
    def origin_m(self) -> FloatArray:
        """Lowest corner of the region, (3,)."""
        return np.array(self.region_m) - np.array(self.size_m) / 2.0

    @property
    def frames(self) -> Frames:
        """Vehicles of the only period."""
        ((_, frames),) = self.periods
        return frames

    @property
    def triangles_m(self) -> FloatArray:
        """Of all solids and the ground, (n, 3, 3)."""
        far_m = 10.0 * ON_RAY_M
        corners = [
            (x, y, self.ground_m) for x, y in ((-far_m, -far_m), (far_m, -far_m), (far_m, far_m), (-far_m, far_m))
        ]
        ground = np.array([[corners[0], corners[1], corners[2]], [corners[0], corners[2], corners[3]]])
        return np.concatenate([ground, *(solid.triangles_m for solid in self.solids)])

    def lifted(self, height_m: float) -> Truth:
        """The same on a higher ground."""
        periods = tuple(
            (weight, tuple(tuple(replace(box, z_m=box.z_m + height_m) for box in frame) for frame in frames))
            for weight, frames in self.periods
        )
        solids = tuple(replace(s, foot_m=s.foot_m + height_m, roof_m=s.roof_m + height_m) for s in self.solids)
        mounts = tuple((name, replace(mount, z_m=mount.z_m + height_m)) for name, mount in self.mounts)
        x_m, y_m, z_m = self.region_m
        region_m = (x_m, y_m, z_m + height_m)
        return replace(
            self, periods=periods, solids=solids, mounts=mounts, ground_m=self.ground_m + height_m, region_m=region_m
        )


def sensor_rays(truth: Truth) -> FloatArray:
    """Directions of the beams in the sensor's frame, (n, 3)."""
    pairs = np.array([(e, a) for a in truth.azimuths_deg for e in truth.elevations_deg], dtype=np.float64)
    elevation, azimuth = np.deg2rad(pairs).T
    return np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )


@cache
def returned_points(truth: Truth, site: str) -> FloatArray:
    """Points of a perfect scan of the static world, (n, 3), world frame."""
    ends_m, returned = _cast(truth, dict(truth.mounts)[site])
    return dict(truth.mounts)[site].position_m + ends_m[returned]


def _cast(truth: Truth, mount: Mount) -> tuple[FloatArray, NDArray[np.bool_]]:
    """End of each beam relative to the sensor, and whether it is a return."""
    rays = mount.to_world(sensor_rays(truth))
    ranges_m, _ = cast.first_hits(mount.position_m, rays, truth.triangles_m)
    return rays * np.minimum(ranges_m, RANGE_M)[:, None], ranges_m <= RANGE_M


@cache
def entropies(truth: Truth) -> FloatArray:
    """Entropy of each voxel's occupancy, in bits."""
    share = np.zeros(truth.shape)
    for weight, frames in truth.periods:
        counts = np.zeros(truth.shape)
        for frame in frames:
            occupied = np.zeros(truth.shape, dtype=bool)
            for box in frame:
                centre_m = np.array([box.x_m, box.y_m, box.z_m]) - truth.origin_m
                size_m = (box.length_m, box.width_m, box.height_m)
                occupied |= occupied_by_upright(centre_m, box.yaw_rad, size_m, truth.shape, truth.voxel_m)
            counts += occupied
        share += weight * counts / len(frames)
    share /= sum(weight for weight, _ in truth.periods)
    inside = (share > 0.0) & (share < 1.0 - 1e-12)
    p = share[inside]
    bits = np.zeros(truth.shape)
    bits[inside] = -(p * np.log2(p) + (1.0 - p) * np.log2(1.0 - p))
    return bits


def score_of_beams(truth: Truth, start_m: FloatArray, ends_m: FloatArray) -> float:
    """EGVS of some beams, (n, 3) relative to their start."""
    hits = cast.count_hits(start_m, ends_m, truth.origin_m, truth.voxel_m, truth.shape)
    return float((entropies(truth) * np.minimum(hits, truth.gamma)).sum())


@cache
def scores(truth: Truth) -> dict[str, float]:
    """EGVS of each site."""
    return {name: score_of_beams(truth, mount.position_m, _cast(truth, mount)[0]) for name, mount in truth.mounts}


# --- the street of all cases

SIZES_M = {"car": (4.5, 1.8, 1.5), "truck": (8.2, 2.4, 3.3)}
PERIOD_S = 0.5
FRAMES = 40

HOUSE = Prism("house", ((14.0, 5.0), (18.0, 5.0), (18.0, 8.0), (14.0, 8.0)), 0.0, 6.0)
WALL = Prism("wall", ((24.0, -8.0), (30.0, -8.0), (30.0, -7.5), (24.0, -7.5)), 0.0, 2.0)


def drive(name: str, kind: str, x_m: float, y_m: float, step_m: float, frames: int = FRAMES) -> list[Box]:
    """A vehicle along the street at a constant speed, to the east where ``step_m`` is positive."""
    length_m, width_m, height_m = SIZES_M[kind]
    yaw_rad = 0.0 if step_m > 0 else math.pi
    speed_m_s = abs(step_m) / PERIOD_S
    return [
        Box(name, kind, x_m + step_m * k, y_m, 0.5 * height_m, yaw_rad, length_m, width_m, height_m, speed_m_s)
        for k in range(frames)
    ]


def traffic(*vehicles: list[Box]) -> Frames:
    """Frames of some vehicles."""
    return tuple(zip(*vehicles, strict=True))


STREET = Truth(
    periods=((1.0, traffic(drive("a", "car", -20.13, -1.63, 2.03), drive("b", "truck", 58.77, 1.57, -1.97))),),
    solids=(HOUSE, WALL),
    mounts=(("pole_a", Mount(10.3, 12.2, 3.1, 30.0, -4.0, 2.0)), ("pole_b", Mount(30.63, -12.17, 3.3, 137.3))),
)
"""A street along x, one lane each way, people drive on the right; a house and a wall; two sites."""
