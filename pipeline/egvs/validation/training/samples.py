"""Training crops and targets from random poses.

Draws where a roadside sensor could hang: beside the lanes of a junction, at any height that poles have.

Makes what the network learns from: crops of simulated sweeps, and what it should say of each.

Sample number i is a function of the seed and i alone, so that training goes on where it was stopped. A pose serves some
samples in turn, because its empty scan costs more than a sweep; each sample of a batch is from another pose. Crops are
turned at random and mirrored, so that the network knows no compass.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.traffic_frames import NON_VEHICLE_KINDS, TrafficFrame
from egvs.core.errors import InputError
from egvs.scenario.model import Scenario
from egvs.sensors import site_feasibility
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Pose, Site
from egvs.traffic import sumo_folder
from egvs.validation.cloud_simulation import CloudSimulator
from egvs.validation.detectors import pointpillars
from egvs.validation.detectors.pointpillars import (
    OUTPUT_CELL_M,
    STRIDE,
    Convention,
    HeightZero,
    PillarPoints,
    Pillars,
    PillarWindow,
    encode_boxes,
)
from egvs.validation.held_out_traffic import HeldOutTraffic
from egvs.world.carriageway import Carriageway

_MAX_ROAD_DISTANCE_M = 12.0  # beyond the region of interest
_PITCH_DEG, _ROLL_DEG = (-15.0, 3.0), 2.0
_MAX_ATTEMPTS = 1000


@dataclass(frozen=True)
class PoseRule:
    """Where poses of a junction are drawn from.

    Attributes
    ----------
    heights_m
        Lowest and highest height above the ground.
    """

    scene: Scene
    carriageway: Carriageway | None
    heights_m: tuple[float, float]

    @classmethod
    def of(cls, scenario: Scenario, scene: Scene, heights_m: tuple[float, float]) -> PoseRule:
        """For a scenario's scene."""
        network = sumo_folder.read_network(scenario)
        return cls(scene, None if network is None else Carriageway.of(network), heights_m)

    def draw(self, sensor: Sensor, random: np.random.Generator) -> Pose:
        """One pose. A sensor with a limited field of view looks at the region of interest.

        Raises
        ------
        InputError
            Where no place round the region of interest is free.
        """
        low = np.asarray(self.scene.roi.origin_m)[:2] - _MAX_ROAD_DISTANCE_M
        size = np.asarray(self.scene.roi.size_m)[:2] + 2 * _MAX_ROAD_DISTANCE_M
        for _ in range(_MAX_ATTEMPTS):
            x_m, y_m = (low + size * random.random(2)).tolist()
            above_m, pitch_deg, roll_deg, turn = (
                random.uniform(*self.heights_m),
                random.uniform(*_PITCH_DEG),
                random.uniform(-_ROLL_DEG, _ROLL_DEG),
                random.uniform(-180.0, 180.0),
            )
            yaw_deg = turn if sensor.azimuth_span_deg is None else self._towards_roi_deg(x_m, y_m) + turn / 12
            pose = Pose(x_m, y_m, 0.0, round(yaw_deg, 3), round(pitch_deg, 3), round(roll_deg, 3))
            pose = Pose(x_m, y_m, site_feasibility.ground_height_m(self.scene.world, pose) + above_m, *pose.angles_deg)
            if self._is_free(pose, sensor):
                return pose
        raise InputError(f"{self.scene.scenario.file}: roi", "no free place for a pole round it", "places beside roads")

    def _is_free(self, pose: Pose, sensor: Sensor) -> bool:
        site = Site("drawn", pose, sensor.name)
        if not site_feasibility.drop_infeasible([site], self.scene.world, self.carriageway).free:
            return False
        try:
            site_feasibility.check_pose(self.scene, pose, sensor, "drawn")
        except InputError:
            return False
        return True

    def _towards_roi_deg(self, x_m: float, y_m: float) -> float:
        roi = self.scene.roi
        to_x, to_y = (roi.origin_m[i] + roi.size_m[i] / 2 - at for i, at in enumerate((x_m, y_m)))
        return math.degrees(math.atan2(to_y, to_x))


CROP_CELLS = 128
BATCH = 8
_SAMPLES_PER_POSE = 20
_FEWEST, _UNSURE = 3, 1  # points of a vehicle that should be found; that may be found or not
_JITTER_M, _ELSEWHERE = 20.0, 0.1
_BEYOND_M = 15.0
_SPREAD, _LEAST_SPREAD_M = 8.0, 0.6


@dataclass(frozen=True)
class Target:
    """What the network should say of a crop.

    Attributes
    ----------
    heat
        1 in the cell of a vehicle's middle, less round it, (c, c) float32.
    counts
        0 where it does not matter what the network says, (c, c) float32.
    cell, values
        Of each vehicle, see :func:`egvs.validation.detectors.pointpillars.encode_boxes`.
    """

    heat: NDArray[np.float32]
    counts: NDArray[np.float32]
    cell: NDArray[np.int64]
    values: NDArray[np.float32]


@dataclass(frozen=True)
class Sample:
    """One crop."""

    pillars: Pillars
    target: Target


class TrainingJunction:
    """A training junction: its scene, its frames, and where sensors may hang."""

    def __init__(self, record: HeldOutTraffic, heights_m: tuple[float, float]) -> None:
        self.record = record
        self.frames = list(record.read())
        self.rule = PoseRule.of(record.scenario, record.scene, heights_m)

    @cached_property
    def scanner(self) -> Scanner:
        """Scans for all poses."""
        return Scanner(self.record.scene, full_sweep=True)


class Samples:
    """Samples by number."""

    def __init__(
        self, junctions: Sequence[TrainingJunction], sensors: Sequence[str], convention: Convention, seed: int
    ) -> None:
        self._junctions, self._sensors, self._convention, self._seed = junctions, sensors, convention, seed
        self._open: OrderedDict[int, tuple[TrainingJunction, CloudSimulator, HeightZero]] = OrderedDict()

    def sample(self, number: int) -> Sample:
        """Sample ``number``, from 0."""
        group = number // (BATCH * _SAMPLES_PER_POSE) * BATCH + number % BATCH
        junction, maker, zero = self._posed(group)
        random = self._random(1, number)
        frame = junction.frames[int(random.integers(len(junction.frames)))]
        sweep = maker.sweep(frame, random)
        motor = np.array([kind not in NON_VEHICLE_KINDS for kind in frame.kinds], dtype=np.bool_)
        points = sweep.points_on(len(frame.boxes))
        window = self._window(junction, frame.boxes[motor & (points >= _FEWEST)], random)
        seen = PillarPoints.of(sweep.sweep, maker.view, zero)
        pillars = pointpillars.make_pillars(seen, window, self._convention)
        return randomly_mirrored(Sample(pillars, make_target(frame, motor, points, window, zero)), random)

    def _posed(self, group: int) -> tuple[TrainingJunction, CloudSimulator, HeightZero]:
        """The pose of a group of samples; the last ones are kept."""
        if group not in self._open:
            random = self._random(0, group)
            junction = self._junctions[group % len(self._junctions)]
            sensor = junction.record.scene.sensor(self._sensors[int(random.integers(len(self._sensors)))])
            pose = junction.rule.draw(sensor, random)
            maker = CloudSimulator(junction.record.scene, pose, sensor, f"drawn {group}", junction.scanner)
            zero = HeightZero(self._convention, maker.view, junction.record.scene.roi)
            self._open[group] = junction, maker, zero
            while len(self._open) > BATCH:
                self._open.popitem(last=False)
        return self._open[group]

    def _random(self, what: int, number: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence((self._seed, what, number)))

    def _window(
        self, junction: TrainingJunction, boxes: NDArray[np.float64], random: np.random.Generator
    ) -> PillarWindow:
        """A crop near a vehicle that can be seen; now and then anywhere."""
        low = np.asarray(junction.record.scene.roi.origin_m)[:2] - _BEYOND_M
        high = low + np.asarray(junction.record.scene.roi.size_m)[:2] + 2 * _BEYOND_M
        near = boxes[((boxes[:, :2] >= low) & (boxes[:, :2] < high)).all(axis=1), :2]
        if len(near) and random.random() >= _ELSEWHERE:
            centre = near[int(random.integers(len(near)))] + random.uniform(-_JITTER_M, _JITTER_M, 2)
        else:
            centre = random.uniform(low, high)
        return PillarWindow((float(centre[0]), float(centre[1])), random.uniform(-math.pi, math.pi), CROP_CELLS)


def make_target(
    frame: TrafficFrame, motor: NDArray[np.bool_], points: NDArray[np.int64], window: PillarWindow, zero: HeightZero
) -> Target:
    """What the network should say of a frame in a window; ``points`` lie on each of the frame's boxes."""
    boxes = frame.boxes[motor].copy()
    boxes[:, 2] -= zero.below_m(boxes[:, :2])
    boxes[:, :2] = window.to_window(boxes[:, :2])
    boxes[:, 6] -= window.turn_rad
    inside = ((boxes[:, :2] >= 0.0) & (boxes[:, :2] < window.size_m)).all(axis=1)
    on = points[motor]
    size = window.cells // STRIDE
    heat, counts = np.zeros((size, size), dtype=np.float32), np.ones((size, size), dtype=np.float32)
    for box in boxes[(on >= _UNSURE) & (on < _FEWEST)]:
        counts[_heat_bump(box, size) > 0.1] = 0.0
    sought = boxes[inside & (on >= _FEWEST)]
    for box in sought:
        bump = _heat_bump(box, size)
        np.maximum(heat, bump, out=heat)
        counts[bump > 0.1] = 1.0
    cell, values = encode_boxes(sought)
    heat[tuple(cell.T)] = 1.0
    counts[tuple(cell.T)] = 1.0
    return Target(heat, counts, cell, values)


def _heat_bump(box: NDArray[np.float64], size: int) -> NDArray[np.float32]:
    """How near each cell is to a box's middle, 1 to 0, along its length and its width."""
    middle = (np.arange(size) + 0.5) * OUTPUT_CELL_M
    x, y = np.meshgrid(middle - box[0], middle - box[1], indexing="ij")
    c, s = math.cos(box[6]), math.sin(box[6])
    long, wide = (max(_LEAST_SPREAD_M, extent / _SPREAD) for extent in box[3:5])
    near = np.exp(-0.5 * (((c * x + s * y) / long) ** 2 + ((c * y - s * x) / wide) ** 2))
    found: NDArray[np.float32] = near.astype(np.float32)
    return found


def randomly_mirrored(sample: Sample, random: np.random.Generator) -> Sample:
    """The sample, or its mirror image across y, by the throw of a coin."""
    if random.random() < 0.5:
        return sample
    pillars, its = sample.pillars, sample.target
    features = pillars.features.copy()
    features[:, :, [1, 5]] *= -1.0  # y from the pillar's middle, and from the mean of its points
    size = CROP_CELLS
    cell = pillars.cell + size - 1 - 2 * (pillars.cell % size)
    order = np.argsort(cell)
    values = its.values * np.array([1, -1, 1, 1, 1, 1, -1, 1], dtype=np.float32)
    to = np.column_stack([its.cell[:, 0], len(its.heat) - 1 - its.cell[:, 1]])
    turned = Target(its.heat[:, ::-1].copy(), its.counts[:, ::-1].copy(), to, values)
    return Sample(Pillars(features[order], pillars.present[order], cell[order]), turned)
