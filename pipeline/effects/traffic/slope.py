r"""Seats boxes and ground on roads that go up and down.

A triangulated surface is laid through the lanes (:mod:`pipeline.world.terrain`). Then

- *boxes* stand with both ends on the road. SUMO gives the slope at the front bumper only: a bus whose front has reached
  the grade would hang with its rear in the ground. With z the surface's height below the front f and the rear r of a
  box of length L, on top of SUMO's own height of the front bumper,

  .. math:: \sin pitch = (z(f) - z(r)) / L, \qquad r = f - L \cos pitch \cdot (\cos yaw, \sin yaw)

  and the centre is L/2 behind the front along the slope and half a height above it, as everywhere
  (:mod:`pipeline.traffic.boxes`). On an even grade that is SUMO's own pitch. Pedestrians stay upright;
- *the ground* of the static world is this surface instead of the plane z = 0;
- *footprints* count ``base_m`` and ``height_m`` from the ground below their centre, and reach down to the lowest ground
  below them where they stand on it. Meshes, sites and the region of interest stay in the world's z.

Acts by itself when the network's lanes differ in height by more than 0.1 m, or lie off z = 0, because leaving it out
would be wrong then; never on a flat network. No parameters.

Source: SUMO's networks with elevation (https://sumo.dlr.de/docs/Networks/Elevation.html); linear interpolation over a
Delaunay triangulation: Barber, Dobkin, Huhdanpaa 1996, ACM TOMS 22(4), 469-483 (Qhull).

Limits: those of one surface (a box more than 1 m off it, on a bridge, keeps SUMO's own slope); no camber; vehicles'
speeds do not depend on the grade in SUMO's car-following.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pipeline.effects.base import Traffic
from pipeline.scenario.effects import EffectParameters, SlopeParameters
from pipeline.scenario.models import Scenario
from pipeline.traffic import network, sumo_folder
from pipeline.traffic.boxes import Size, VehicleBoxes, tidy_m, tidy_rad
from pipeline.world import terrain
from pipeline.world.terrain import Surface

LEAST_M = 0.1
"""Differences in height up to this are no relief."""

_OFF_M = 1.0
_UPRIGHT = "pedestrian"


class Slope(Traffic[SlopeParameters]):
    """Pitched boxes and a ground that follows the roads."""

    NAME: ClassVar[str] = "slope"
    SOURCE: ClassVar[str] = "SUMO networks with elevation; Delaunay surface (Barber et al. 1996, Qhull)"
    Model: ClassVar[type[EffectParameters]] = SlopeParameters
    SELF_ACTING: ClassVar[bool] = True

    def acts(self, scenario: Scenario) -> tuple[bool, str]:
        """Where the network has relief, whoever names it."""
        path = sumo_folder.network_path(scenario)
        if path is None:
            return False, "no network is named (traffic.roads) beside the finished FCD file, whose own z and slope hold"
        if not network.may_have_heights(path):
            return False, "the network is flat"
        span_m, off_m = terrain.relief_m(network.read(path))
        if span_m > LEAST_M:
            return True, f"the network has {span_m:.1f} m of relief"
        if abs(off_m) > LEAST_M:
            return True, f"the network lies at z = {off_m:.1f} m"
        return False, f"the network has {span_m:.2g} m of relief, no more than {LEAST_M:g} m"

    def box_change(self, scenario: Scenario, sizes: Mapping[str, Size]) -> Seating:
        """Boxes are seated on the ground around the network."""
        return Seating(self.ground(scenario))

    def ground(
        self, scenario: Scenario, low_m: NDArray[np.float64] | None = None, high_m: NDArray[np.float64] | None = None
    ) -> Surface:
        """The ground through the network's lanes."""
        path = sumo_folder.network_path(scenario)
        assert path is not None, "a scenario in which the slope acts has a network"
        return terrain.ground(network.read(path), low_m, high_m, path)


@dataclass(frozen=True)
class Seating:
    """Sets boxes on a surface."""

    surface: Surface

    def change(self, boxes: VehicleBoxes) -> VehicleBoxes:
        """Boxes with both ends on the surface; those that are far off it (bridges) as they were."""
        cos, sin = np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad)
        half, flat = boxes.length_m / 2, np.cos(boxes.pitch_rad)
        front_x, front_y = boxes.x_m + half * flat * cos, boxes.y_m + half * flat * sin
        front_z = boxes.z_m - boxes.height_m / 2 + half * np.sin(boxes.pitch_rad)
        ground = self.surface.height_m(front_x, front_y)
        above = (front_z - ground)[_first_parts(boxes)]
        pitch = boxes.pitch_rad
        for _ in range(2):  # where the rear is depends on the pitch, a little
            reach = boxes.length_m * np.cos(pitch)
            rise = ground - self.surface.height_m(front_x - reach * cos, front_y - reach * sin)
            pitch = np.arcsin(np.clip(rise / boxes.length_m, -1.0, 1.0))
        flat = np.cos(pitch)
        seated: dict[str, Any] = {
            "x_m": tidy_m(front_x - half * flat * cos),
            "y_m": tidy_m(front_y - half * flat * sin),
            "z_m": tidy_m(ground + above - half * np.sin(pitch) + boxes.height_m / 2),
            "pitch_rad": tidy_rad(pitch),
        }
        upright = np.array([kind == _UPRIGHT for kind in boxes.kinds], dtype=np.bool_)[boxes.kind]
        stays = upright | ~(np.abs(above) <= _OFF_M)
        return replace(boxes, **{name: np.where(stays, getattr(boxes, name), new) for name, new in seated.items()})

    def summary(self) -> dict[str, Any]:
        """Nothing beside the note that it acts."""
        return {}


def _first_parts(boxes: VehicleBoxes) -> NDArray[np.int64]:
    """For each row, the row of the same vehicle's first part."""
    rows = np.arange(boxes.frame.size)
    return rows if boxes.part is None else np.maximum.accumulate(np.where(boxes.part == 0, rows, 0))
