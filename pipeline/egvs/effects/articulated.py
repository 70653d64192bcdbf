r"""Articulated buses and trucks: rear parts follow the front part.

SUMO gives one point per vehicle, on its front bumper, and moves the vehicle as a rigid body. This effect takes SUMO's
pose as that of the front part and lets each rear part follow the joint that pulls it, as a tractrix: the axle of a part
moves only along the part's heading, so

.. math:: \dot\theta = \frac{v}{d} \sin(\psi - \theta)

with :math:`\theta` the part's heading, v and :math:`\psi` the speed and direction of the joint, and d the distance from
the joint to the part's axle. Between two frames the joint moves along a circular arc that turns by as much as the part
in front. The arc is cut into straight pieces of at most 1 degree; along a piece of length s the equation has the exact
solution

.. math:: \tan\frac{\psi - \theta'}{2} = e^{-s/d} \tan\frac{\psi - \theta}{2}

A vehicle is straight in its first frame, and again after a frame in which it is missing. When the joint moves on a
circle of radius R, a part settles at :math:`\sin(\psi - \theta) = d / R`. On a straight road, parts and gaps add up to
SUMO's length.

Source: Sayers 1991, "Exact Equations for Tractrix Curves Associated with Vehicle Offtracking", Vehicle System Dynamics
20(5), 297-308. Default geometry: the maximum lengths of Directive 96/53/EC as amended, 18.75 m for an articulated bus,
16.50 m for an articulated truck, of which 12.00 m from the king pin to the rear, so the joint is 4.5 m behind the
front. The division into parts (10.6 and 7.5 m, a tractor of 6 m, a bogie 7.7 of 12 m behind the king pin, axles at 0.75
of a part) is assumed.

Use it where buses and trucks of 16 m and more turn in the region of interest. Limits: no tyre slip, no steered rear
axle, no limit to the angle at the joint. SUMO itself leaves room for a rigid vehicle only, so a rear part may cut into
the neighbouring lane.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np

from egvs.core.errors import InputError
from egvs.effects.base import Traffic
from egvs.scenario.effects_config import ArticulatedParameters, EffectParameters, VehicleParts
from egvs.scenario.model import Scenario
from egvs.sensors.scene import Scene
from egvs.traffic.finished_fcd import known_sizes
from egvs.traffic.vehicle_boxes import VehicleBoxes, VehicleSize, round_m, round_rad

_MAX_PIECE_RAD = math.radians(1.0)
_MIN_MOVE_M = 1e-6
_AXLE_SHARE = 0.75
_ROUNDING_M = 1e-9

_BUS_CLASSES = ("bus", "coach")
_TRUCK_CLASSES = ("trailer", "truck")
_MIN_LENGTH_M = 16.0
_BUS_SHARES = (10.6 / 18.75, 7.5 / 18.75)
_TRACTOR_M = 6.0
_FIFTH_WHEEL_M = 4.5
_BOGIE_SHARE = 7.7 / 12.0


@dataclass(frozen=True)
class ArticulatedGeometry:
    """Parts of a vehicle type on a straight road, metres behind the front bumper; joint i pulls part i + 1."""

    starts_m: tuple[float, ...]
    lengths_m: tuple[float, ...]
    hinges_m: tuple[float, ...]
    axles_m: tuple[float, ...]


class Articulated(Traffic[ArticulatedParameters]):
    """Rear parts that follow the front part."""

    NAME: ClassVar[str] = "articulated"
    SOURCE: ClassVar[str] = "Sayers 1991, Vehicle System Dynamics 20(5), 297-308 (tractrix)"
    Model: ClassVar[type[EffectParameters]] = ArticulatedParameters

    def acts(self, scenario: Scenario) -> tuple[bool, str]:
        """Return whether any vehicle type has several parts; InputError when parts do not fit the types.

        The types of a user's SUMO demand are not known in advance.
        """
        if _demand_key(scenario) is not None:
            return True, "named"
        sizes = known_sizes(scenario)
        if not self.geometries(sizes, self.config_key(scenario)):
            longest_m = max(size.length_m for size in sizes.values())
            return False, f"no vehicle type has more than one part (the longest is {longest_m:g} m)"
        return True, "named"

    def summary(self, scene: Scene) -> str:
        """Say which vehicles may have several parts."""
        key = _demand_key(scene.scenario)
        source = "the fleet has" if key is None else f"the {key} may have"
        return f"{source} articulated vehicles of {_MIN_LENGTH_M:g} m and more"

    def box_change(self, scenario: Scenario, sizes: Mapping[str, VehicleSize]) -> Follower:
        """Return the change that replaces the box of an articulated vehicle by one box per part."""
        return Follower(self.geometries(sizes, self.config_key(scenario)))

    def followed_types(self, scenario: Scenario, sizes: Mapping[str, VehicleSize]) -> frozenset[str]:
        """Return the articulated types: their rear parts depend on the path of the front part."""
        return frozenset(self.geometries(sizes, self.config_key(scenario)))

    def geometries(self, sizes: Mapping[str, VehicleSize], where: str) -> dict[str, ArticulatedGeometry]:
        """Return the geometry of each type with several parts; InputError for an unknown type, or one too short."""
        for name in self.parameters.kinds:
            if name not in sizes:
                hint = f"Use one of {', '.join(sorted(sizes))}."
                raise InputError(f"{where}.kinds", f"there is no vehicle type {name!r}", hint)
        geometries = {}
        for name, size in sizes.items():
            parts = self.parameters.kinds.get(name)
            if not parts and self.parameters.auto:
                parts = _default_parts(size)
            if parts is None:
                continue
            geometry = _geometry(parts, size.length_m, f"{where}.kinds.{name}")
            if len(geometry.lengths_m) > 1:
                geometries[name] = geometry
        return geometries


def _demand_key(scenario: Scenario) -> str | None:
    """The key of ``[traffic]`` that names a user's SUMO demand; None where this program makes the demand."""
    for key in ("sumocfg", "routes", "vtypes"):
        if getattr(scenario.traffic, key):
            return key
    return None


def _default_parts(size: VehicleSize) -> VehicleParts | None:
    """Parts of a type that is long for its vClass."""
    if size.length_m < _MIN_LENGTH_M:
        return None
    if size.vclass in _BUS_CLASSES:
        return VehicleParts(parts_m=tuple(share * size.length_m for share in _BUS_SHARES))
    if size.vclass in _TRUCK_CLASSES:
        axle = _BOGIE_SHARE * (size.length_m - _FIFTH_WHEEL_M)
        parts_m = (_TRACTOR_M, size.length_m - _TRACTOR_M)
        return VehicleParts(parts_m=parts_m, hinges_m=(_FIFTH_WHEEL_M,), axles_m=(axle,))
    return None


def _geometry(parts: VehicleParts, length_m: float, where: str) -> ArticulatedGeometry:
    """The geometry of a type; the length that its parts leave is divided into gaps of equal length between them."""
    lengths = parts.parts_m
    joints = len(lengths) - 1
    rest = length_m - sum(lengths)
    if rest < -_ROUNDING_M or (joints == 0 and rest > _ROUNDING_M):
        expected = "exactly" if joints == 0 else "at most"
        problem = f"expected parts that add up to {expected} the type's {length_m:g} m, got {sum(lengths):g} m"
        raise InputError(f"{where}.parts_m", problem)
    if any(hinge >= length_m for hinge in parts.hinges_m):
        problem = f"expected joints within the type's {length_m:g} m, got {max(parts.hinges_m):g} m"
        raise InputError(f"{where}.hinges_m", problem)
    gap = max(0.0, rest) / joints if joints else 0.0
    starts = [sum(lengths[:i]) + i * gap for i in range(joints + 1)]
    hinges = parts.hinges_m or tuple(start - gap / 2 for start in starts[1:])
    axles = parts.axles_m or tuple(_AXLE_SHARE * length for length in lengths[1:])
    return ArticulatedGeometry(tuple(starts), lengths, hinges, axles)


@dataclass
class _VehicleState:
    """A vehicle in its last frame: headings of all parts, and positions of its joints."""

    frame: int
    headings: list[float]
    hinges: list[tuple[float, float]]


class _PartBox(NamedTuple):
    """The columns of a part's box that differ from those of the vehicle's box; x, y, z are its centre."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    length_m: float


@dataclass
class Follower:
    """Replaces boxes of vehicles by boxes of their parts, and remembers each vehicle from frame to frame."""

    geometries: Mapping[str, ArticulatedGeometry]
    largest_rad: float = 0.0
    vehicles: set[str] = field(default_factory=set)
    _states: dict[str, _VehicleState] = field(default_factory=dict)

    def change(self, boxes: VehicleBoxes) -> VehicleBoxes:
        """Return the boxes with the row of each articulated vehicle replaced by one row per part."""
        type_geometries = [self.geometries.get(name) for name in boxes.types]
        parts_of_type = [1 if geometry is None else len(geometry.lengths_m) for geometry in type_geometries]
        n_parts = np.array(parts_of_type, dtype=np.int64)[boxes.type_code]
        rows = np.repeat(np.arange(n_parts.size), n_parts)
        first = np.cumsum(n_parts) - n_parts
        part = np.arange(rows.size) - np.repeat(first, n_parts)
        repeated = replace(boxes, **boxes.rows(rows), part=part)
        columns = {name: getattr(repeated, name) for name in _PartBox._fields}
        for row in np.flatnonzero(n_parts > 1).tolist():
            geometry = type_geometries[boxes.type_code[row]]
            assert geometry is not None
            for i, box in enumerate(self._follow(boxes, row, geometry)):
                for name, value in box._asdict().items():
                    columns[name][first[row] + i] = value
        last_frame = boxes.first_frame + boxes.frames - 1
        self._states = {name: state for name, state in self._states.items() if state.frame == last_frame}
        for name in ("x_m", "y_m", "z_m"):
            columns[name] = np.where(n_parts[rows] > 1, round_m(columns[name]), columns[name])
        columns["yaw_rad"] = np.where(part > 0, round_rad(columns["yaw_rad"]), columns["yaw_rad"])
        return replace(repeated, **columns)

    def _follow(self, boxes: VehicleBoxes, row: int, geometry: ArticulatedGeometry) -> Iterator[_PartBox]:
        """Yield the box of each part of one vehicle in one frame."""
        name = boxes.names[boxes.code[row]]
        frame = int(boxes.frame[row])
        yaw = float(boxes.yaw_rad[row])
        pitch = float(boxes.pitch_rad[row])
        length = float(boxes.length_m[row])
        flat = math.cos(pitch)
        rise = math.sin(pitch)
        x = float(boxes.x_m[row]) + length / 2 * flat * math.cos(yaw)
        y = float(boxes.y_m[row]) + length / 2 * flat * math.sin(yaw)
        z = float(boxes.z_m[row]) + length / 2 * rise
        last = self._states.get(name)
        if last is not None and last.frame != frame - 1:
            last = None
        headings = [yaw]
        hinges: list[tuple[float, float]] = []
        hinge_m = 0.0
        for i, (start, part_length) in enumerate(zip(geometry.starts_m, geometry.lengths_m, strict=True)):
            if i > 0:
                reach = (geometry.hinges_m[i - 1] - hinge_m) * flat
                x -= reach * math.cos(headings[-1])
                y -= reach * math.sin(headings[-1])
                hinges.append((x, y))
                hinge_m = geometry.hinges_m[i - 1]
                heading = yaw
                if last is not None:
                    heading = _next_heading(last, i, headings[-1], (x, y), geometry.axles_m[i - 1])
                headings.append(heading)
                self.largest_rad = max(self.largest_rad, abs(_wrap_angle(headings[-1] - headings[-2])))
            centre = start + part_length / 2
            behind = (centre - hinge_m) * flat
            centre_x = x - behind * math.cos(headings[i])
            centre_y = y - behind * math.sin(headings[i])
            yield _PartBox(centre_x, centre_y, z - centre * rise, headings[i], part_length)
        self._states[name] = _VehicleState(frame, headings, hinges)
        self.vehicles.add(name)

    def summary(self) -> dict[str, Any]:
        """Return the number of articulated vehicles, and the largest angle at a joint."""
        angle_deg = round(math.degrees(self.largest_rad), 3)
        return {Articulated.NAME: {"vehicles": len(self.vehicles), "largest_angle_deg": angle_deg}}


def _next_heading(last: _VehicleState, i: int, leader_rad: float, hinge: tuple[float, float], axle_m: float) -> float:
    """The heading of part i after its joint moved to ``hinge`` while the part in front turned to ``leader_rad``."""
    dx = hinge[0] - last.hinges[i - 1][0]
    dy = hinge[1] - last.hinges[i - 1][1]
    return follow(last.headings[i], dx, dy, _wrap_angle(leader_rad - last.headings[i - 1]), axle_m)


def follow(heading_rad: float, dx_m: float, dy_m: float, turn_rad: float, axle_m: float) -> float:
    """Return a part's new heading after its joint moved by (dx, dy) on an arc that turns by ``turn_rad``.

    ``axle_m`` is the distance from the joint to the axle.
    """
    chord = math.hypot(dx_m, dy_m)
    if chord < _MIN_MOVE_M:
        return heading_rad
    pieces = max(1, math.ceil(abs(turn_rad) / _MAX_PIECE_RAD))
    step = turn_rad / pieces
    piece_m = chord / pieces
    if abs(turn_rad) >= 1e-9:
        piece_m = chord * math.sin(step / 2) / math.sin(turn_rad / 2)
    decay = math.exp(-piece_m / axle_m)
    direction = math.atan2(dy_m, dx_m)
    for k in range(pieces):
        psi = direction + (k + 0.5) * step - turn_rad / 2
        angle = _wrap_angle(psi - heading_rad)
        if angle:
            heading_rad = _wrap_angle(psi - 2.0 * math.atan(decay * math.tan(angle / 2)))
    return heading_rad


def _wrap_angle(angle_rad: float) -> float:
    """Into [-pi, pi]."""
    return math.remainder(angle_rad, math.tau)
