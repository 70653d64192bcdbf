"""Draws where a roadside sensor could hang: beside the lanes of a junction, at any height that poles have."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pipeline.core.errors import InputError
from pipeline.scenario.models import Scenario
from pipeline.sensing import free_places, placing
from pipeline.sensing.scene import Scene
from pipeline.sensing.sensors import Sensor
from pipeline.sensing.sites import Pose, Site
from pipeline.traffic import sumo_folder
from pipeline.world.carriageway import Carriageway

_BESIDE_M = 12.0  # beyond the region of interest
_PITCH_DEG, _ROLL_DEG = (-15.0, 3.0), 2.0
_ATTEMPTS = 1000


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
        network = sumo_folder.roads(scenario)
        return cls(scene, None if network is None else Carriageway.of(network), heights_m)

    def draw(self, sensor: Sensor, random: np.random.Generator) -> Pose:
        """One pose. A sensor with a limited field of view looks at the region of interest.

        Raises
        ------
        InputError
            Where no place round the region of interest is free.
        """
        low = np.asarray(self.scene.roi.origin_m)[:2] - _BESIDE_M
        size = np.asarray(self.scene.roi.size_m)[:2] + 2 * _BESIDE_M
        for _ in range(_ATTEMPTS):
            x_m, y_m = (low + size * random.random(2)).tolist()
            above_m, pitch_deg, roll_deg, turn = (
                random.uniform(*self.heights_m),
                random.uniform(*_PITCH_DEG),
                random.uniform(-_ROLL_DEG, _ROLL_DEG),
                random.uniform(-180.0, 180.0),
            )
            yaw_deg = turn if sensor.azimuth_span_deg is None else self._towards_roi_deg(x_m, y_m) + turn / 12
            pose = Pose(x_m, y_m, 0.0, round(yaw_deg, 3), round(pitch_deg, 3), round(roll_deg, 3))
            pose = Pose(x_m, y_m, placing.ground_m(self.scene.world, pose) + above_m, *pose.angles_deg)
            if self._is_free(pose, sensor):
                return pose
        raise InputError(f"{self.scene.scenario.file}: roi", "no free place for a pole round it", "places beside roads")

    def _is_free(self, pose: Pose, sensor: Sensor) -> bool:
        site = Site("drawn", pose, sensor.name)
        if not free_places.sort_out([site], self.scene.world, self.carriageway).free:
            return False
        try:
            placing.check(self.scene, pose, sensor, "drawn")
        except InputError:
            return False
        return True

    def _towards_roi_deg(self, x_m: float, y_m: float) -> float:
        roi = self.scene.roi
        to_x, to_y = (roi.origin_m[i] + roi.size_m[i] / 2 - at for i, at in enumerate((x_m, y_m)))
        return math.degrees(math.atan2(to_y, to_x))
