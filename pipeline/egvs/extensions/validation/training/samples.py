"""Training samples: crops of simulated sweeps from random poses, and what the network should return for them.

Poses are drawn beside the lanes of a junction, at any height of poles. Sample number i depends on the seed and i only,
so an interrupted training can be resumed. A pose is used for several samples, because its empty scan costs more than a
sweep; the samples of a batch have different poses. Crops are rotated at random and mirrored, so that the network does
not learn compass directions.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.simulation import CloudSimulator
from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.extensions.validation.detectors import pointpillars
from egvs.extensions.validation.detectors.pointpillars import (
    OUTPUT_CELL_M,
    STRIDE,
    Convention,
    HeightOrigin,
    PillarPoints,
    Pillars,
    PillarWindow,
    encode_boxes,
)
from egvs.extensions.validation.held_out_traffic import HeldOutTraffic
from egvs.sensors import site_feasibility
from egvs.sensors.scanner import Scanner
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Pose, Site
from egvs.traffic import sumo_folder
from egvs.world.carriageway import Carriageway

CROP_CELLS = 128
BATCH = 8

_MAX_ROAD_DISTANCE_M = 12.0  # of a pose from the region of interest
_PITCH_DEG = (-25.0, 3.0)
_ROLL_DEG = 2.0
_MAX_ATTEMPTS = 1000
_SAMPLES_PER_POSE = 20
_MIN_POINTS = 3  # of a vehicle that should be detected
_IGNORED_POINTS = 1  # with so many, up to the minimum, a vehicle may be detected or not
_JITTER_M = 20.0  # of the centre of a crop from a vehicle
_ANYWHERE_SHARE = 0.1  # of crops that are not near a vehicle
_MARGIN_M = 15.0  # of crops around the region of interest
_PEAK_SHARE = 1 / 8  # standard deviation of a peak of the heat map, relative to the size of the vehicle
_MIN_PEAK_M = 0.6


class TrainingJunction:
    """A training junction: its scene, its frames, and random poses.

    Parameters
    ----------
    record
        Scene and traffic.
    heights_m
        Lowest and highest mounting height above the ground.
    """

    def __init__(self, record: HeldOutTraffic, heights_m: tuple[float, float]) -> None:
        self.record = record
        self.frames = list(record.read())
        self._heights_m = heights_m
        network = sumo_folder.read_network(record.scenario)
        self._carriageway = None if network is None else Carriageway.of(network)

    @cached_property
    def scanner(self) -> Scanner:
        """Scanner for all poses."""
        return Scanner(self.record.scene, full_sweep=True)

    def draw_pose(self, sensor: Sensor, rng: np.random.Generator) -> Pose:
        """Draw a pose. A sensor with a limited field of view points at the region of interest.

        Raises
        ------
        InputError
            If there is no free position around the region of interest.
        """
        scene = self.record.scene
        low = np.asarray(scene.roi.origin_m)[:2] - _MAX_ROAD_DISTANCE_M
        size = np.asarray(scene.roi.size_m)[:2] + 2 * _MAX_ROAD_DISTANCE_M
        for _ in range(_MAX_ATTEMPTS):
            x_m, y_m = (low + size * rng.random(2)).tolist()
            height_m = rng.uniform(*self._heights_m)
            pitch_deg = rng.uniform(*_PITCH_DEG)
            roll_deg = rng.uniform(-_ROLL_DEG, _ROLL_DEG)
            turn_deg = rng.uniform(-180.0, 180.0)
            yaw_deg = turn_deg
            if sensor.azimuth_span_deg is not None:
                yaw_deg = self._direction_to_roi_deg(x_m, y_m) + turn_deg / 12
            pose = Pose(x_m, y_m, 0.0, round(yaw_deg, 3), round(pitch_deg, 3), round(roll_deg, 3))
            z_m = site_feasibility.ground_height_m(scene.world, pose) + height_m
            pose = Pose(x_m, y_m, z_m, *pose.angles_deg)
            if self._is_free(pose, sensor):
                return pose
        problem = "there is no free position for a pole around the region"
        raise InputError(f"{scene.scenario.file}: roi", problem, "Use a region with space beside its roads.")

    def _is_free(self, pose: Pose, sensor: Sensor) -> bool:
        scene = self.record.scene
        site = Site("drawn", pose, sensor.name)
        if not site_feasibility.drop_infeasible([site], scene.world, self._carriageway).free:
            return False
        try:
            site_feasibility.check_pose(scene, pose, sensor, "drawn")
        except InputError:
            return False
        return True

    def _direction_to_roi_deg(self, x_m: float, y_m: float) -> float:
        roi = self.record.scene.roi
        to_x = roi.origin_m[0] + roi.size_m[0] / 2 - x_m
        to_y = roi.origin_m[1] + roi.size_m[1] / 2 - y_m
        return math.degrees(math.atan2(to_y, to_x))


@dataclass(frozen=True)
class Target:
    """What the network should return for a crop.

    Attributes
    ----------
    heat
        1 in the cell of a vehicle's centre, less around it, (c, c) float32.
    loss_weight
        0 where the output does not matter, else 1, (c, c) float32.
    cell, values
        Of each vehicle, see :func:`egvs.extensions.validation.detectors.pointpillars.encode_boxes`.
    """

    heat: NDArray[np.float32]
    loss_weight: NDArray[np.float32]
    cell: IntArray
    values: NDArray[np.float32]


@dataclass(frozen=True)
class Sample:
    """The pillars of one crop, and its target."""

    pillars: Pillars
    target: Target


class _DrawnPose(NamedTuple):
    junction: TrainingJunction
    simulator: CloudSimulator
    origin: HeightOrigin


class Samples:
    """Training samples by number.

    Parameters
    ----------
    junctions
        The training junctions, which take turns.
    sensors
        Names of sensors to draw from.
    convention
        Where heights are measured from.
    seed
        Seed of poses, crops and sweeps.
    """

    def __init__(
        self, junctions: Sequence[TrainingJunction], sensors: Sequence[str], convention: Convention, seed: int
    ) -> None:
        self._junctions = junctions
        self._sensors = sensors
        self._convention = convention
        self._seed = seed
        self._poses: OrderedDict[int, _DrawnPose] = OrderedDict()

    def sample(self, number: int) -> Sample:
        """Return a sample; numbers start at 0."""
        group = number // (BATCH * _SAMPLES_PER_POSE) * BATCH + number % BATCH
        junction, simulator, origin = self._draw_pose(group)
        rng = self._rng(1, number)
        frame = junction.frames[int(rng.integers(len(junction.frames)))]
        cloud = simulator.sweep(frame, rng)
        is_vehicle = frame.are_vehicles()
        points_on_box = cloud.points_on(len(frame.boxes))
        window = self._draw_window(junction, frame.boxes[is_vehicle & (points_on_box >= _MIN_POINTS)], rng)
        points = PillarPoints.from_sweeps([cloud.sweep], [simulator.view], origin)
        pillars = pointpillars.make_pillars(points, window, self._convention)
        return randomly_mirrored(Sample(pillars, make_target(frame, is_vehicle, points_on_box, window, origin)), rng)

    def _draw_pose(self, group: int) -> _DrawnPose:
        """Return the pose of a group of samples; the last ones are cached."""
        if group not in self._poses:
            rng = self._rng(0, group)
            junction = self._junctions[group % len(self._junctions)]
            scene = junction.record.scene
            sensor = scene.sensor(self._sensors[int(rng.integers(len(self._sensors)))])
            pose = junction.draw_pose(sensor, rng)
            simulator = CloudSimulator(scene, pose, sensor, f"drawn {group}", junction.scanner)
            origin = HeightOrigin(self._convention, [simulator.view], scene.roi)
            self._poses[group] = _DrawnPose(junction, simulator, origin)
            while len(self._poses) > BATCH:
                self._poses.popitem(last=False)
        return self._poses[group]

    def _rng(self, stream: int, number: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence((self._seed, stream, number)))

    def _draw_window(self, junction: TrainingJunction, boxes: FloatArray, rng: np.random.Generator) -> PillarWindow:
        """Draw a crop near a visible vehicle; sometimes anywhere."""
        roi = junction.record.scene.roi
        low = np.asarray(roi.origin_m)[:2] - _MARGIN_M
        high = low + np.asarray(roi.size_m)[:2] + 2 * _MARGIN_M
        near = boxes[((boxes[:, :2] >= low) & (boxes[:, :2] < high)).all(axis=1), :2]
        if len(near) and rng.random() >= _ANYWHERE_SHARE:
            centre = near[int(rng.integers(len(near)))] + rng.uniform(-_JITTER_M, _JITTER_M, 2)
        else:
            centre = rng.uniform(low, high)
        return PillarWindow((float(centre[0]), float(centre[1])), rng.uniform(-math.pi, math.pi), CROP_CELLS)


def make_target(
    frame: TrafficFrame, is_vehicle: BoolArray, points_on_box: IntArray, window: PillarWindow, origin: HeightOrigin
) -> Target:
    """Return what the network should return for a frame in a window.

    Parameters
    ----------
    frame
        The traffic.
    is_vehicle
        Which of the frame's boxes are vehicles, (n,).
    points_on_box
        Number of points on each of the frame's boxes, (n,).
    window
        The crop.
    origin
        Where heights are measured from.
    """
    boxes = frame.boxes[is_vehicle].copy()
    boxes[:, 2] -= origin.z_m(boxes[:, :2])
    boxes[:, :2] = window.to_window(boxes[:, :2])
    boxes[:, 6] -= window.turn_rad
    inside = ((boxes[:, :2] >= 0.0) & (boxes[:, :2] < window.size_m)).all(axis=1)
    points = points_on_box[is_vehicle]
    size = window.cells // STRIDE
    heat = np.zeros((size, size), dtype=np.float32)
    loss_weight = np.ones((size, size), dtype=np.float32)
    for box in boxes[(points >= _IGNORED_POINTS) & (points < _MIN_POINTS)]:
        loss_weight[_heat_peak(box, size) > 0.1] = 0.0
    targets = boxes[inside & (points >= _MIN_POINTS)]
    for box in targets:
        peak = _heat_peak(box, size)
        np.maximum(heat, peak, out=heat)
        loss_weight[peak > 0.1] = 1.0
    cell, values = encode_boxes(targets)
    heat[tuple(cell.T)] = 1.0
    loss_weight[tuple(cell.T)] = 1.0
    return Target(heat, loss_weight, cell, values)


def _heat_peak(box: FloatArray, size: int) -> NDArray[np.float32]:
    """Return a Gaussian peak at the centre of a box, as long and wide as the box in proportion, (size, size)."""
    middle = (np.arange(size) + 0.5) * OUTPUT_CELL_M
    x, y = np.meshgrid(middle - box[0], middle - box[1], indexing="ij")
    cos = math.cos(box[6])
    sin = math.sin(box[6])
    sigma_along = max(_MIN_PEAK_M, box[3] * _PEAK_SHARE)
    sigma_across = max(_MIN_PEAK_M, box[4] * _PEAK_SHARE)
    along = (cos * x + sin * y) / sigma_along
    across = (cos * y - sin * x) / sigma_across
    peak: NDArray[np.float32] = np.exp(-0.5 * (along**2 + across**2)).astype(np.float32)
    return peak


def randomly_mirrored(sample: Sample, rng: np.random.Generator) -> Sample:
    """Return the sample or, in half of all cases, its mirror image across y."""
    if rng.random() < 0.5:
        return sample
    pillars = sample.pillars
    target = sample.target
    features = pillars.features.copy()
    features[:, :, [1, 5]] *= -1.0  # y from the centre of the pillar, and from the mean of its points
    cell = pillars.cell + CROP_CELLS - 1 - 2 * (pillars.cell % CROP_CELLS)
    order = np.argsort(cell)
    values = target.values * np.array([1, -1, 1, 1, 1, 1, -1, 1], dtype=np.float32)
    target_cell = np.column_stack([target.cell[:, 0], len(target.heat) - 1 - target.cell[:, 1]])
    heat = target.heat[:, ::-1].copy()
    loss_weight = target.loss_weight[:, ::-1].copy()
    mirrored_pillars = Pillars(features[order], pillars.present[order], cell[order])
    return Sample(mirrored_pillars, Target(heat, loss_weight, target_cell, values))
