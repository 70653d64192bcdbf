r"""Lets the rear parts of an articulated vehicle follow its front.

SUMO gives one point a vehicle, on its front bumper, and moves the whole length as one. This effect takes the pose that
SUMO gives as that of the front part, and lets each rear part follow the joint that pulls it, as a tractrix: its axle
moves only along itself, so

.. math:: \dot\theta = \frac{v}{d} \sin(\psi - \theta)

with :math:`\theta` the part's heading, v and :math:`\psi` the speed and direction of the joint, d the distance from the
joint to the part's axle. Between two frames the joint moves on the circular arc that turns it by as much as the part
before it turns, cut into pieces of at most 1 degree; along a straight piece of length s the equation has the exact
solution

.. math:: \tan\frac{\psi - \theta'}{2} = e^{-s/d} \tan\frac{\psi - \theta}{2}

A vehicle starts straight in its first frame, and again after a frame in which it is missing. On a circle of radius R
(of the joint) a part settles at :math:`\sin(\psi - \theta) = d / R`. On a straight road parts and gaps add up to SUMO's
length.

Source: Sayers 1991, "Exact Equations for Tractrix Curves Associated with Vehicle Offtracking", Vehicle System Dynamics
20(5), 297-308. Default geometry: the greatest lengths of Directive 96/53/EC as amended, 18.75 m for an articulated bus,
16.50 m for an articulated truck, 12.00 m of it from the king pin to the rear, so the joint is 4.5 m behind the front.
How they divide (10.6 to 7.5 m, a tractor of 6 m, a bogie 7.7 of 12 m behind the king pin, axles at 0.75 of a part) is
assumed.

Calls for it: buses and trucks of 16 m and more that turn in the region of interest. Limits: no tyre slip, no steered
rear axle, no limit to the angle at the joint; SUMO itself leaves room for a stiff vehicle only, so a rear part may cut
into a neighbour's lane.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import InputError
from pipeline.effects.base import Traffic
from pipeline.scenario.effects import ArticulatedParameters, EffectParameters, VehicleParts
from pipeline.scenario.models import Scenario
from pipeline.sensing.scene import Scene
from pipeline.traffic.boxes import Size, VehicleBoxes, tidy_m, tidy_rad
from pipeline.traffic.finished.sizes import known_sizes

Floats = NDArray[np.float64]

_PIECE_RAD = math.radians(1.0)
_STILL_M = 1e-6
_AXLE_SHARE = 0.75
_ROUNDING_M = 1e-9

_BUSES, _TRAILERS, _LONG_M = ("bus", "coach"), ("trailer", "truck"), 16.0
_BUS_SHARES = (10.6 / 18.75, 7.5 / 18.75)
_TRACTOR_M, _FIFTH_WHEEL_M, _BOGIE_SHARE = 6.0, 4.5, 7.7 / 12.0


@dataclass(frozen=True)
class Geometry:
    """A kind's parts on a straight road, metres behind the front bumper; joint i pulls part i + 1."""

    starts_m: tuple[float, ...]
    lengths_m: tuple[float, ...]
    hinges_m: tuple[float, ...]
    axles_m: tuple[float, ...]


class Articulated(Traffic[ArticulatedParameters]):
    """Rear parts that follow the front."""

    NAME: ClassVar[str] = "articulated"
    SOURCE: ClassVar[str] = "Sayers 1991, Vehicle System Dynamics 20(5), 297-308 (tractrix)"
    Model: ClassVar[type[EffectParameters]] = ArticulatedParameters

    def acts(self, scenario: Scenario) -> tuple[bool, str]:
        """Where each kind is one part, nothing changes. InputError when parts do not fit the kinds.

        Of a user's own SUMO demand the kinds are not known beforehand.
        """
        own = scenario.traffic.sumocfg is not None or scenario.traffic.routes or scenario.traffic.vtypes
        if not own and not self.geometries(sizes := known_sizes(scenario), self.place(scenario)):
            longest_m = max(size.length_m for size in sizes.values())
            return False, f"no kind of vehicle has more than one part (the longest is {longest_m:g} m)"
        return True, "named"

    def seen(self, scene: Scene) -> str:
        """Which vehicles may get parts."""
        own = scene.scenario.traffic
        given = next((key for key in ("sumocfg", "routes", "vtypes") if getattr(own, key)), None)
        which = "the fleet has kinds" if given is None else f"the {given} may name kinds"
        return f"{which} of {_LONG_M:g} m and more, which bend"

    def box_change(self, scenario: Scenario, sizes: Mapping[str, Size]) -> Follower:
        """Each box of several parts becomes one box a part."""
        return Follower(self.geometries(sizes, self.place(scenario)))

    def followed_types(self, scenario: Scenario, sizes: Mapping[str, Size]) -> frozenset[str]:
        """Rear parts follow the way that the front took."""
        return frozenset(self.geometries(sizes, self.place(scenario)))

    def geometries(self, sizes: Mapping[str, Size], place: str) -> dict[str, Geometry]:
        """Kind -> its parts, for kinds of more than one; InputError when one is missing, or shorter than its parts."""
        for name in self.parameters.kinds:
            if name not in sizes:
                known = ", ".join(sorted(sizes))
                raise InputError(f"{place}.kinds", f"there is no kind of vehicle {name!r}", f"one of {known}")
        geometries = {}
        for name, size in sizes.items():
            parts = self.parameters.kinds.get(name) or (_by_class(size) if self.parameters.auto else None)
            if parts is not None:
                geometry = _geometry(parts, size.length_m, f"{place}.kinds.{name}")
                if len(geometry.lengths_m) > 1:
                    geometries[name] = geometry
        return geometries


def _by_class(size: Size) -> VehicleParts | None:
    """Parts of a kind that is long for its vClass."""
    if size.length_m < _LONG_M:
        return None
    if size.vclass in _BUSES:
        return VehicleParts(parts_m=tuple(share * size.length_m for share in _BUS_SHARES))
    if size.vclass in _TRAILERS:
        axle = _BOGIE_SHARE * (size.length_m - _FIFTH_WHEEL_M)
        parts_m = (_TRACTOR_M, size.length_m - _TRACTOR_M)
        return VehicleParts(parts_m=parts_m, hinges_m=(_FIFTH_WHEEL_M,), axles_m=(axle,))
    return None


def _geometry(parts: VehicleParts, length_m: float, place: str) -> Geometry:
    """Gaps of equal length between the parts take up what is left of the vehicle's length."""
    lengths, joints = parts.parts_m, len(parts.parts_m) - 1
    left = length_m - sum(lengths)
    if left < -_ROUNDING_M or (joints == 0 and left > _ROUNDING_M):
        right = "as much" if joints == 0 else "that at most; gaps take up the rest"
        raise InputError(f"{place}.parts_m", f"adds up to {sum(lengths):g} m of the kind's {length_m:g} m", right)
    if any(hinge >= length_m for hinge in parts.hinges_m):
        raise InputError(f"{place}.hinges_m", f"{max(parts.hinges_m):g} m", f"less than the kind's {length_m:g} m")
    gap = max(0.0, left) / joints if joints else 0.0
    starts = [sum(lengths[:i]) + i * gap for i in range(joints + 1)]
    hinges = parts.hinges_m or tuple(start - gap / 2 for start in starts[1:])
    axles = parts.axles_m or tuple(_AXLE_SHARE * length for length in lengths[1:])
    return Geometry(tuple(starts), lengths, hinges, axles)


@dataclass
class _State:
    """A vehicle in its last frame: headings of all parts, and where its joints were."""

    frame: int
    headings: list[float]
    hinges: list[tuple[float, float]]


@dataclass
class Follower:
    """Makes parts of whole vehicles, group by group; remembers each vehicle from one frame to the next."""

    geometries: Mapping[str, Geometry]
    largest_rad: float = 0.0
    vehicles: set[str] = field(default_factory=set)
    _states: dict[str, _State] = field(default_factory=dict)

    def change(self, boxes: VehicleBoxes) -> VehicleBoxes:
        """The boxes with each articulated vehicle's row replaced by one row a part."""
        shapes = [self.geometries.get(name) for name in boxes.types]
        of_type = np.array([1 if shape is None else len(shape.lengths_m) for shape in shapes], dtype=np.int64)
        parts = of_type[boxes.type_code]
        rows, first = np.repeat(np.arange(parts.size), parts), np.cumsum(parts) - parts
        part = np.arange(rows.size) - np.repeat(first, parts)
        whole = replace(boxes, **boxes.rows(rows), part=part)
        columns = {name: getattr(whole, name) for name in ("x_m", "y_m", "z_m", "yaw_rad", "length_m")}
        for row in np.flatnonzero(parts > 1).tolist():
            shape = shapes[boxes.type_code[row]]
            assert shape is not None
            for i, values in enumerate(self._follow(boxes, row, shape)):
                for name, value in zip(columns, values, strict=True):
                    columns[name][first[row] + i] = value
        last_frame = boxes.first_frame + boxes.frames - 1
        self._states = {name: state for name, state in self._states.items() if state.frame == last_frame}
        for name in ("x_m", "y_m", "z_m"):
            columns[name] = np.where(parts[rows] > 1, tidy_m(columns[name]), columns[name])
        columns["yaw_rad"] = np.where(part > 0, tidy_rad(columns["yaw_rad"]), columns["yaw_rad"])
        return replace(whole, **columns)

    def _follow(
        self, boxes: VehicleBoxes, row: int, shape: Geometry
    ) -> Iterator[tuple[float, float, float, float, float]]:
        """x, y, z of the centre, yaw, and length of each part of one vehicle in one frame."""
        name, frame = boxes.names[boxes.code[row]], int(boxes.frame[row])
        yaw, pitch, length = float(boxes.yaw_rad[row]), float(boxes.pitch_rad[row]), float(boxes.length_m[row])
        flat, rise = math.cos(pitch), math.sin(pitch)
        x = float(boxes.x_m[row]) + length / 2 * flat * math.cos(yaw)
        y = float(boxes.y_m[row]) + length / 2 * flat * math.sin(yaw)
        z = float(boxes.z_m[row]) + length / 2 * rise
        last = self._states.get(name)
        last = last if last is not None and last.frame == frame - 1 else None
        headings, hinges, pulled_m = [yaw], [], 0.0
        for i, (start, size) in enumerate(zip(shape.starts_m, shape.lengths_m, strict=True)):
            if i:
                reach = (shape.hinges_m[i - 1] - pulled_m) * flat
                x, y = x - reach * math.cos(headings[-1]), y - reach * math.sin(headings[-1])
                hinges.append((x, y))
                pulled_m = shape.hinges_m[i - 1]
                axle = shape.axles_m[i - 1]
                headings.append(yaw if last is None else _pulled(last, headings[-1], (x, y), i, axle))
                self.largest_rad = max(self.largest_rad, abs(_wrapped(headings[-1] - headings[-2])))
            back = start + size / 2
            away = (back - pulled_m) * flat
            yield x - away * math.cos(headings[i]), y - away * math.sin(headings[i]), z - back * rise, headings[i], size
        self._states[name] = _State(frame, headings, hinges)
        self.vehicles.add(name)

    def summary(self) -> dict[str, Any]:
        """How many vehicles have rear parts, and the largest angle at a joint."""
        angle_deg = round(math.degrees(self.largest_rad), 3)
        return {Articulated.NAME: {"vehicles": len(self.vehicles), "largest_angle_deg": angle_deg}}


def _pulled(last: _State, leader_rad: float, hinge: tuple[float, float], i: int, axle_m: float) -> float:
    """A part's heading after its joint moved from where it was to ``hinge``, while the part before it turned."""
    dx, dy = hinge[0] - last.hinges[i - 1][0], hinge[1] - last.hinges[i - 1][1]
    return follow(last.headings[i], dx, dy, _wrapped(leader_rad - last.headings[i - 1]), axle_m)


def follow(heading_rad: float, dx_m: float, dy_m: float, turn_rad: float, axle_m: float) -> float:
    """A part's new heading, when its joint, ``axle_m`` before its axle, moves by (dx, dy) on an arc of ``turn_rad``."""
    chord = math.hypot(dx_m, dy_m)
    if chord < _STILL_M:
        return heading_rad
    pieces = max(1, math.ceil(abs(turn_rad) / _PIECE_RAD))
    step = turn_rad / pieces
    piece_m = chord / pieces if abs(turn_rad) < 1e-9 else chord * math.sin(step / 2) / math.sin(turn_rad / 2)
    decay, direction = math.exp(-piece_m / axle_m), math.atan2(dy_m, dx_m)
    for k in range(pieces):
        psi = direction + (k + 0.5) * step - turn_rad / 2
        angle = _wrapped(psi - heading_rad)
        if angle:
            heading_rad = _wrapped(psi - 2.0 * math.atan(decay * math.tan(angle / 2)))
    return heading_rad


def _wrapped(angle_rad: float) -> float:
    """Into [-pi, pi]."""
    return math.remainder(angle_rad, math.tau)
