"""Vehicle boxes from SUMO's front-bumper points, and the hooks of effects on traffic.

SUMO gives x, y (and z on networks with heights) of the centre of the front bumper, an angle a in degrees clockwise from
north, and a slope p in degrees, positive uphill. The box of length L and height H has its centre at

    front - L/2 (sin a cos p, cos a cos p, sin p) + (0, 0, H/2),      yaw = 90 deg - a,      pitch = p

in the world frame (x east, y north, z up; yaw counter-clockwise from +x, in (-pi, pi]). Sines and cosines of degrees
are exact at multiples of 90. Positions are rounded to 1 micrometre, angles to 1 nanoradian.

An extension (:class:`TrafficHook`) may add traffic to the simulation, have vehicle types that do not count as vehicles
of the scenario, and change boxes. Order: :meth:`~TrafficHook.scenario_error` before the simulation is prepared;
:meth:`~TrafficHook.plan` while it is prepared; :meth:`~TrafficHook.box_change` when the sizes are known; then each
group of frames passes through the changes, in the order of the extensions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
import pyarrow as pa

from egvs.artefacts.frame_boxes import MAX_BOX_M, MIN_BOX_M
from egvs.core.errors import InputError, RunError
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.traffic.fcd import FrameGroup

if TYPE_CHECKING:
    from egvs.scenario.model import Scenario
    from egvs.traffic.network import Network


_POSITION_DIGITS, _ANGLE_DIGITS = 6, 9
_NUMBERS = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "length_m", "width_m", "height_m")
_SIZE_KEYS = ("length_m", "width_m", "height_m")


@dataclass(frozen=True)
class VehicleSize:
    """Size and vClass of a vehicle type."""

    length_m: float
    width_m: float
    height_m: float
    vclass: str


@dataclass(frozen=True)
class VehicleBoxes:
    """Boxes of vehicles in consecutive frames, sorted by frame, then vehicle.

    Attributes
    ----------
    first_frame, frames
        The frames.
    frame
        Frame of each box, shape (n,), as all arrays.
    names, code
        Names of vehicles, sorted, and position of each box's name among them.
    kinds, kind
        vClasses, sorted, and position of each box's vClass among them.
    x_m, y_m, z_m
        Centre.
    yaw_rad, pitch_rad
        Orientation.
    length_m, width_m, height_m
        Size.
    speed_m_s
        Speed; NaN if unknown.
    types, type_code
        SUMO's vehicle types, sorted, and position of each box's type among them.
    part
        0, or 1, 2, ... for the rear parts of an articulated vehicle; None if every vehicle is one box.
    uncounted
        Whether a box does not count as a vehicle of the scenario (pedestrians, bicycles); None if all count.
    """

    first_frame: int
    frames: int
    frame: IntArray
    names: list[str]
    code: IntArray
    kinds: list[str]
    kind: IntArray
    x_m: FloatArray
    y_m: FloatArray
    z_m: FloatArray
    yaw_rad: FloatArray
    pitch_rad: FloatArray
    length_m: FloatArray
    width_m: FloatArray
    height_m: FloatArray
    speed_m_s: FloatArray
    types: list[str] = field(default_factory=list)
    type_code: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    part: IntArray | None = None
    uncounted: BoolArray | None = None

    def rows(self, index: IntArray) -> dict[str, Any]:
        """Return all arrays at some positions, by name."""
        arrays = {name: value for name, value in self.__dict__.items() if isinstance(value, np.ndarray)}
        return {name: value[index] for name, value in arrays.items()}

    def select(self, mask: BoolArray) -> VehicleBoxes:
        """Return some of the boxes."""
        return replace(self, **self.rows(np.flatnonzero(mask)))

    def columns(self, first_frame: int = 0, name_prefix: str = "") -> dict[str, Any]:
        """Return the columns of the artefact ``trajectories``.

        ``first_frame`` is added to the frame numbers, and ``name_prefix`` is put before the names of vehicles.
        """
        names = [name_prefix + name for name in self.names]
        part = np.zeros(self.frame.size, np.int64) if self.part is None else self.part
        return {
            "frame": (self.frame + first_frame).astype(np.uint32),
            "part": part.astype(np.uint8),
            "vehicle": _decode_strings(names, self.code),
            "kind": _decode_strings(self.kinds, self.kind),
            **{name: getattr(self, name) for name in _NUMBERS},
        }


def boxes_from_bumpers(
    group: FrameGroup,
    sizes: Mapping[str, VehicleSize],
    period_s: float,
    where: str,
    uncounted_types: frozenset[str] = frozenset(),
) -> VehicleBoxes:
    """Compute the boxes of a group of frames.

    Parameters
    ----------
    group
        FCD rows.
    sizes
        Size of each vehicle type.
    period_s
        Time between frames, from which missing speeds are computed.
    where
        Source of the rows, for messages.
    uncounted_types
        Types that do not count as vehicles of the scenario.

    Raises
    ------
    InputError
        When a type has no size, or an implausible one, or a vehicle is twice in a frame.
    """
    names, code = _sorted_codes(group.rows["id"])
    types, type_code = _sorted_codes(group.rows["type"])
    _check_sizes(types, sizes, where)

    order = np.lexsort((code, group.frame))
    frame, code, type_code = group.frame[order], code[order], type_code[order]
    duplicates = np.flatnonzero((np.diff(frame) == 0) & (np.diff(code) == 0))
    if duplicates.size:
        row = duplicates[0]
        problem = f"vehicle {names[code[row]]!r} occurs twice in frame {frame[row]}"
        raise InputError(where, problem, "Write one row per vehicle and frame.")

    kinds = sorted({sizes[name].vclass for name in types})
    kind = np.array([kinds.index(sizes[name].vclass) for name in types], dtype=np.int64)[type_code]
    length, width, height = (
        np.array([getattr(sizes[name], key) for name in types], dtype=np.float64)[type_code] for key in _SIZE_KEYS
    )
    keys = ("x", "y", "z", "angle", "slope", "speed")
    x, y, z, angle, slope, speed = (group.rows[key].to_numpy()[order] for key in keys)
    centre = box_centres(x, y, z, angle, slope, length, height)
    yaw, pitch = yaw_from_angle(angle), round_rad(np.deg2rad(slope))
    uncounted = np.isin(types, list(uncounted_types))[type_code] if uncounted_types else None
    boxes = VehicleBoxes(
        group.first_frame, group.frames, frame, names, code, kinds, kind, *centre, yaw, pitch, length, width, height,
        speed, types, type_code, uncounted=uncounted,
    )  # fmt: skip
    return _fill_speeds(boxes, period_s) if np.isnan(speed).any() else boxes


def _check_sizes(types: list[str], sizes: Mapping[str, VehicleSize], where: str) -> None:
    """Raise an InputError if a type has no size, or one that no vehicle has."""
    for name in types:
        if name not in sizes:
            known = ", ".join(sorted(sizes))
            hint = f"Add a kind of that name with length_m, width_m and height_m (known: {known})."
            raise InputError(where, f"the size of vehicle type {name!r} is unknown", hint)
        for key in _SIZE_KEYS:
            value_m = getattr(sizes[name], key)
            if not MIN_BOX_M <= value_m <= MAX_BOX_M:
                problem = f"vehicle type {name!r} has {key} = {value_m:g}"
                raise InputError(where, problem, f"Use at least {MIN_BOX_M} m and at most {MAX_BOX_M:g} m.")


def box_centres(
    x: FloatArray,
    y: FloatArray,
    z: FloatArray,
    angle_deg: FloatArray,
    slope_deg: FloatArray,
    length_m: FloatArray,
    height_m: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute box centres from front bumpers.

    Parameters
    ----------
    x, y, z
        Front bumper, shape (n,), metres.
    angle_deg, slope_deg
        Clockwise from north; positive uphill.
    length_m, height_m
        Size.

    Returns
    -------
    tuple of ndarray
        x, y and z, metres, rounded to 1 micrometre.
    """
    from egvs.core.special import cosdg, sindg

    half, flat = length_m / 2, cosdg(slope_deg)
    return (
        round_m(x - half * flat * sindg(angle_deg)),
        round_m(y - half * flat * cosdg(angle_deg)),
        round_m(z - half * sindg(slope_deg) + height_m / 2),
    )


def yaw_from_angle(angle_deg: FloatArray) -> FloatArray:
    """Convert degrees clockwise from north to radians counter-clockwise from +x, in (-pi, pi], rounded."""
    degrees = 90.0 - np.asarray(angle_deg, dtype=np.float64)
    degrees = degrees - 360.0 * np.ceil((degrees - 180.0) / 360.0)
    rounded = round_rad(np.deg2rad(degrees))
    # pi rounded up to nanoradians is outside the interval
    return np.where(np.abs(rounded) > np.pi, np.pi, rounded)


def round_m(values: FloatArray) -> FloatArray:
    """Round metres to 1 micrometre, without negative zeros."""
    return np.round(values, _POSITION_DIGITS) + 0.0


def round_rad(values: FloatArray) -> FloatArray:
    """Round radians to 1 nanoradian, without negative zeros."""
    return np.round(values, _ANGLE_DIGITS) + 0.0


def _fill_speeds(boxes: VehicleBoxes, period_s: float) -> VehicleBoxes:
    """Fill in missing speeds from the distance to the next frame, or else from the previous one."""
    order = np.lexsort((boxes.frame, boxes.code))
    follows = (np.diff(boxes.code[order]) == 0) & (np.diff(boxes.frame[order]) == 1)
    step = np.hypot(np.diff(boxes.x_m[order]), np.diff(boxes.y_m[order])) / period_s
    step = np.where(follows, step, np.nan)
    to_next, from_previous = np.append(step, np.nan), np.insert(step, 0, np.nan)
    speed = np.empty(order.size)
    speed[order] = np.where(np.isnan(to_next), from_previous, to_next)
    return replace(boxes, speed_m_s=np.where(np.isnan(boxes.speed_m_s), speed, boxes.speed_m_s))


def _sorted_codes(column: pa.ChunkedArray) -> tuple[list[str], IntArray]:
    """Return the distinct values, sorted by code point, and the position of each row's value among them."""
    encoded = column.combine_chunks().dictionary_encode()
    if isinstance(encoded, pa.ChunkedArray):
        encoded = encoded.combine_chunks()
    values = encoded.dictionary.to_pylist()
    order = sorted(range(len(values)), key=values.__getitem__)
    rank = np.empty(len(values), dtype=np.int64)
    rank[order] = np.arange(len(values))
    return [values[i] for i in order], rank[encoded.indices.to_numpy(zero_copy_only=False).astype(np.int64)]


def _decode_strings(values: list[str], code: IntArray) -> pa.Array:
    return pa.array(values, type=pa.string()).take(pa.array(code))


@dataclass(frozen=True)
class ExtraTraffic:
    """Traffic that an extension adds.

    Attributes
    ----------
    xml
        A route file.
    vehicles
        How many vehicles of SUMO it needs at most at a time; ``--max-num-vehicles`` is raised by it.
    notes
        Remarks for the user.
    """

    xml: str
    vehicles: int
    notes: tuple[str, ...] = ()


class BoxChange(Protocol):
    """Changes the boxes of one recording, group by group; may remember the last group."""

    def change(self, boxes: VehicleBoxes) -> VehicleBoxes:
        """Return the boxes of the next group, changed."""

    def summary(self) -> dict[str, Any]:
        """Return what the stage reports about the changes, as JSON."""


def checked_boxes(change: BoxChange, boxes: object) -> VehicleBoxes:
    """Return the boxes of a change; raise a RunError for anything else, and for arrays of different lengths."""
    if not isinstance(boxes, VehicleBoxes):
        raise RunError(f"{type(change).__qualname__}: expected VehicleBoxes, got {type(boxes).__name__}")
    for name in ("frame", "code", "kind", *_NUMBERS):
        array = getattr(boxes, name)
        if np.shape(array) != (boxes.frame.size,):
            problem = f"expected {name} of shape ({boxes.frame.size},), got {np.shape(array)}"
            raise RunError(f"{type(change).__qualname__}: {problem}")
    return boxes


class TrafficHook(Protocol):
    """An extension of the traffic. The defaults change nothing."""

    ADDS_TRAFFIC: ClassVar[bool] = False
    """Whether :meth:`plan` adds traffic; then persons are recorded, too."""

    def scenario_error(self, scenario: Scenario) -> InputError | None:
        """Return an error if the extension does not support a scenario."""
        return None

    def sizes(self) -> dict[str, VehicleSize]:
        """Return the sizes of the types of vehicles and persons that it adds."""
        return {}

    def uncounted_types(self, sizes: Mapping[str, VehicleSize]) -> frozenset[str]:
        """Return the types that do not count as vehicles of the scenario."""
        return frozenset()

    def followed_types(self, scenario: Scenario, sizes: Mapping[str, VehicleSize]) -> frozenset[str]:
        """Return the types whose vehicles must be recorded without gaps, because a box depends on earlier ones."""
        return frozenset()

    def plan(
        self, scenario: Scenario, roads: Network, begin_s: float, end_s: float, rng: np.random.Generator
    ) -> ExtraTraffic:
        """Return the traffic that it adds between two times."""
        return ExtraTraffic("<routes/>", 0)

    def box_change(self, scenario: Scenario, sizes: Mapping[str, VehicleSize]) -> BoxChange | None:
        """Return the change of boxes for vehicles of these sizes, if any."""
        return None
