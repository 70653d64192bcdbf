r"""Slope: vehicles and ground follow roads with relief.

A triangulated surface is laid through the lanes (:mod:`egvs.world.terrain`). Then

- *boxes* are pitched so that both ends are on the road. SUMO gives the slope at the front bumper only: the rear of a
  bus whose front has reached the grade would be in the ground. With z the surface's height below the front f and the
  rear r of a box of length L,

  .. math:: \sin pitch = (z(f) - z(r)) / L, \qquad r = f - L \cos pitch \cdot (\cos yaw, \sin yaw)

  and the centre is L/2 behind the front along the slope and half a height above it, as everywhere
  (:mod:`egvs.traffic.vehicle_boxes`). The height of SUMO's front bumper above the surface is kept. On an even grade the
  pitch is SUMO's. Pedestrians stay upright;
- *the ground* of the static world is this surface instead of the plane z = 0;
- *footprints* count ``base_m`` and ``height_m`` from the ground below their centre, and those that stand on the ground
  reach down to its lowest point below them. Meshes, sites and the region of interest stay in the world's z.

The effect is enabled automatically when the network's lanes differ in height by more than 0.1 m, or lie off z = 0, or
when ``statics.terrain`` gives the ground beyond the roads, because leaving it out would be wrong then; it never acts on
a flat network without a terrain. It has no parameters.

Source: SUMO's networks with elevation (https://sumo.dlr.de/docs/Networks/Elevation.html); linear interpolation over a
Delaunay triangulation: Barber, Dobkin, Huhdanpaa 1996, ACM TOMS 22(4), 469-483 (Qhull).

Limits: there is one surface (a box more than 1 m off it, on a bridge, keeps SUMO's slope); no camber; speeds do not
depend on the grade in SUMO's car-following.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.core.reading import translate_errors
from egvs.effects.base import Traffic
from egvs.formats import ply
from egvs.scenario.effects_config import EffectParameters, SlopeParameters
from egvs.scenario.fields import MAX_COORDINATE_M
from egvs.scenario.model import TERRAIN_KEY, Scenario
from egvs.traffic import network, sumo_folder
from egvs.traffic.vehicle_boxes import VehicleBoxes, VehicleSize, round_m, round_rad
from egvs.world import terrain
from egvs.world.terrain import TerrainSurface

_MAX_OFF_SURFACE_M = 1.0
_UPRIGHT_KIND = "pedestrian"


class Slope(Traffic[SlopeParameters]):
    """Pitched boxes and a ground that follows the roads."""

    NAME: ClassVar[str] = "slope"
    SOURCE: ClassVar[str] = "SUMO networks with elevation; Delaunay surface (Barber et al. 1996, Qhull)"
    Model: ClassVar[type[EffectParameters]] = SlopeParameters
    AUTO_ENABLED: ClassVar[bool] = True

    def acts(self, scenario: Scenario) -> tuple[bool, str]:
        """Return whether the network has relief, and how much."""
        path = sumo_folder.network_path(scenario)
        terrain_file = scenario.statics.terrain
        if terrain_file is not None:
            if path is None:
                where = f"{scenario.file}: {TERRAIN_KEY}"
                raise InputError(where, "the traffic has no network", "Set traffic.roads, or remove the terrain.")
            return True, f"the ground beyond the roads is {terrain_file}"
        if path is None:
            return False, "there is no network (traffic.roads), so the z and slope of the FCD file are used"
        if not network.may_have_slopes(path):
            return False, "the network is flat"
        span_m, off_m = terrain.relief_m(network.read_net_xml(path))
        if span_m > terrain.MIN_RELIEF_M:
            return True, f"the network has {span_m:.1f} m of relief"
        if abs(off_m) > terrain.MIN_RELIEF_M:
            return True, f"the network lies at z = {off_m:.1f} m"
        return False, f"the network has {span_m:.2g} m of relief, no more than {terrain.MIN_RELIEF_M:g} m"

    def box_change(self, scenario: Scenario, sizes: Mapping[str, VehicleSize]) -> SurfaceFitter:
        """Return the change that sets boxes on the ground around the network."""
        return SurfaceFitter(self.ground(scenario))

    def ground(
        self, scenario: Scenario, low_m: FloatArray | None = None, high_m: FloatArray | None = None
    ) -> TerrainSurface:
        """Return the ground through the network's lanes, and through the terrain beyond them."""
        path = sumo_folder.network_path(scenario)
        assert path is not None, "a scenario in which this effect acts has a network"
        beyond_m = None
        if scenario.statics.terrain is not None:
            beyond_m = read_ground_points(scenario.find(scenario.statics.terrain, TERRAIN_KEY))
        return terrain.triangulate_ground(network.read_net_xml(path), low_m, high_m, path, beyond_m=beyond_m)


def read_ground_points(path: Path) -> FloatArray:
    """Read points of the ground, (n, 3) float64, world frame, from a PLY file.

    Raises
    ------
    InputError
        When the file is damaged, has no points, or points that are not finite.
    """
    where = f"{path}: {TERRAIN_KEY}"
    limits.checked_size(path, limits.FILE, where)
    with translate_errors(where):
        points_m = ply.read(path, where)
    limits.POINTS.check(where, len(points_m))
    is_valid = (np.abs(points_m) <= MAX_COORDINATE_M).all(axis=1)
    if not is_valid.all():
        first = int(np.flatnonzero(~is_valid)[0])
        actual = f"got point {first}: {points_m[first].tolist()}"
        expected = f"expected points with coordinates up to {MAX_COORDINATE_M:g} m"
        raise InputError(where, f"{expected}, {actual}", "Write the ground in the world frame again.")
    return points_m


@dataclass(frozen=True)
class SurfaceFitter:
    """Sets boxes on a surface."""

    surface: TerrainSurface

    def change(self, boxes: VehicleBoxes) -> VehicleBoxes:
        """Return the boxes with both ends on the surface; boxes far off it (on bridges) are not changed."""
        cos = np.cos(boxes.yaw_rad)
        sin = np.sin(boxes.yaw_rad)
        half = boxes.length_m / 2
        flat = np.cos(boxes.pitch_rad)
        front_x = boxes.x_m + half * flat * cos
        front_y = boxes.y_m + half * flat * sin
        front_z = boxes.z_m - boxes.height_m / 2 + half * np.sin(boxes.pitch_rad)
        ground = self.surface.height_m(front_x, front_y)
        above = (front_z - ground)[_first_parts(boxes)]
        pitch = boxes.pitch_rad
        for _ in range(2):  # the position of the rear depends slightly on the pitch
            reach = boxes.length_m * np.cos(pitch)
            rise = ground - self.surface.height_m(front_x - reach * cos, front_y - reach * sin)
            pitch = np.arcsin(np.clip(rise / boxes.length_m, -1.0, 1.0))
        flat = np.cos(pitch)
        fitted = {
            "x_m": round_m(front_x - half * flat * cos),
            "y_m": round_m(front_y - half * flat * sin),
            "z_m": round_m(ground + above - half * np.sin(pitch) + boxes.height_m / 2),
            "pitch_rad": round_rad(pitch),
        }
        is_upright = np.array([kind == _UPRIGHT_KIND for kind in boxes.kinds], dtype=np.bool_)[boxes.kind]
        is_unchanged = is_upright | ~(np.abs(above) <= _MAX_OFF_SURFACE_M)
        columns: dict[str, Any] = {}
        for name, values in fitted.items():
            columns[name] = np.where(is_unchanged, getattr(boxes, name), values)
        return replace(boxes, **columns)

    def summary(self) -> dict[str, Any]:
        """Return nothing: a note says that the effect acts."""
        return {}


def _first_parts(boxes: VehicleBoxes) -> IntArray:
    """For each row, the row of the first part of the same vehicle."""
    rows = np.arange(boxes.frame.size)
    if boxes.part is None:
        return rows
    return np.maximum.accumulate(np.where(boxes.part == 0, rows, 0))
