"""Front-bumper points to boxes; the hooks for traffic effects.

Turns SUMO's points on front bumpers into boxes.

SUMO gives x, y (and z on networks with heights) of the middle of the front bumper, an angle a in degrees clockwise from
north, and a slope p in degrees, uphill positive. The box of length L and height H has its centre at

    front - L/2 (sin a cos p, cos a cos p, sin p) + (0, 0, H/2),      yaw = 90 deg - a,      pitch = p

in the world frame (x east, y north, z up; yaw counter-clockwise from +x, in (-pi, pi]). Sines and cosines are taken of
degrees, exact at multiples of 90. Positions are rounded to 1 micrometre, angles to 1 nanoradian.

Says what may go beyond plain vehicles on flat ground, and in which order it is asked.

An extension may bring traffic of its own (a further route file of the same simulation), have types of vehicles that do
not count as the scenario's vehicles, and change boxes before they are written. Those that act are passed into the
recording and the writing of trajectories, which know none of them by name.

Order: :meth:`~TrafficHook.refuses` before anything is laid out; :meth:`~TrafficHook.plan` while SUMO's folder
is; :meth:`~TrafficHook.box_change` once the types' sizes are known; then each group of frames passes through the
changes, in the order of the extensions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egvs.artefacts.frame_boxes import MAX_BOX_M, MIN_BOX_M
from egvs.core.errors import InputError
from egvs.traffic.fcd import FrameGroup

if TYPE_CHECKING:
    from egvs.scenario.model import Scenario
    from egvs.traffic.network import Network


_POSITION_DIGITS, _ANGLE_DIGITS = 6, 9
_NUMBERS = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "length_m", "width_m", "height_m")
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class VehicleSize:
    """Size and vClass of a vehicle type."""

    length_m: float
    width_m: float
    height_m: float
    vclass: str


@dataclass(frozen=True)
class VehicleBoxes:
    """Vehicle boxes of consecutive frames, sorted by frame, then vehicle. Arrays have one element a row."""

    first_frame: int
    frames: int
    frame: Ints
    names: list[str]
    code: Ints
    """Position in ``names``, which is sorted."""
    kinds: list[str]
    kind: Ints
    x_m: Floats
    y_m: Floats
    z_m: Floats
    yaw_rad: Floats
    pitch_rad: Floats
    length_m: Floats
    width_m: Floats
    height_m: Floats
    speed_m_s: Floats
    """NaN where unknown."""
    types: list[str] = field(default_factory=list)
    type_code: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    """Position in ``types``, SUMO's vehicle types."""
    part: Ints | None = None
    """0, or 1.. for the rear parts of an articulated vehicle; None where every vehicle is one box."""
    uncounted: NDArray[np.bool_] | None = None
    """Who does not count as the scenario's vehicle (an extension's pedestrians, bicycles); None where all count."""

    def rows(self, index: Ints) -> dict[str, Any]:
        """The arrays that have one element a row, at ``index``."""
        arrays = {name: value for name, value in self.__dict__.items() if isinstance(value, np.ndarray)}
        return {name: value[index] for name, value in arrays.items()}

    def select(self, mask: NDArray[np.bool_]) -> VehicleBoxes:
        """Some of the rows."""
        return replace(self, **self.rows(np.flatnonzero(mask)))

    def columns(self, first_frame: int = 0) -> dict[str, Any]:
        """As the artefact ``trajectories`` has them, counted from ``first_frame`` on."""
        n = self.frame.size
        return {
            "frame": (self.frame + first_frame).astype(np.uint32),
            "part": np.zeros(n, np.uint8) if self.part is None else self.part.astype(np.uint8),
            "vehicle": _decode_strings(self.names, self.code),
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
    """The boxes of a group of whole frames. Those of ``uncounted_types`` do not count as vehicles of the scenario.

    InputError when a vehicle is of a type without a size that a vehicle has, or is twice in a frame.
    """
    names, code = _sorted_codes(group.rows["id"])
    types, type_code = _sorted_codes(group.rows["type"])
    for name in (name for name in types if name not in sizes):
        right = f"a kind of that name with length_m, width_m and height_m (known: {', '.join(sorted(sizes))})"
        raise InputError(where, f"vehicle type {name!r} has no known size", right)
    for name in types:
        for key in ("length_m", "width_m", "height_m"):
            if not MIN_BOX_M <= (size_m := getattr(sizes[name], key)) <= MAX_BOX_M:
                what = f"vehicle type {name!r} has {key} = {size_m:g}"
                raise InputError(where, what, f"at least {MIN_BOX_M} m, at most {MAX_BOX_M:g} m")
    order = np.lexsort((code, group.frame))
    frame, code, type_code = group.frame[order], code[order], type_code[order]
    twice = np.flatnonzero((np.diff(frame) == 0) & (np.diff(code) == 0))
    if twice.size:
        what = f"vehicle {names[code[twice[0]]]!r} is twice in frame {frame[twice[0]]}"
        raise InputError(where, what, "one row a vehicle a frame")
    kinds = sorted({sizes[name].vclass for name in types})
    kind = np.array([kinds.index(sizes[name].vclass) for name in types], dtype=np.int64)[type_code]
    length, width, height = (
        np.array([getattr(sizes[name], key) for name in types], dtype=np.float64)[type_code]
        for key in ("length_m", "width_m", "height_m")
    )
    keys = ("x", "y", "z", "angle", "slope", "speed")
    x, y, z, angle, slope, speed = (group.rows[key].to_numpy()[order] for key in keys)
    uncounted = np.array([name in uncounted_types for name in types], dtype=np.bool_)
    poses = *box_centres(x, y, z, angle, slope, length, height), yaw_from_angle(angle), round_rad(np.deg2rad(slope))
    boxes = VehicleBoxes(
        group.first_frame, group.frames, frame, names, code, kinds, kind, *poses, length, width, height, speed,
        types, type_code, uncounted=uncounted[type_code] if uncounted_types else None,
    )  # fmt: skip
    return boxes if not np.isnan(speed).any() else _fill_speeds(boxes, period_s)


def box_centres(
    x: Floats, y: Floats, z: Floats, angle_deg: Floats, slope_deg: Floats, length_m: Floats, height_m: Floats
) -> tuple[Floats, Floats, Floats]:
    """Front bumpers (n,) -> box centres (n,), metres, rounded to 1 micrometre."""
    from scipy.special import cosdg, sindg

    half, flat = length_m / 2, cosdg(slope_deg)
    return (
        round_m(x - half * flat * sindg(angle_deg)),
        round_m(y - half * flat * cosdg(angle_deg)),
        round_m(z - half * sindg(slope_deg) + height_m / 2),
    )


def yaw_from_angle(angle_deg: Floats) -> Floats:
    """Degrees clockwise from north -> radians counter-clockwise from +x, in (-pi, pi], rounded to 1 nanoradian."""
    degrees = 90.0 - np.asarray(angle_deg, dtype=np.float64)
    degrees = degrees - 360.0 * np.ceil((degrees - 180.0) / 360.0)
    rounded = round_rad(np.deg2rad(degrees))
    # pi itself lies between two nanoradians, and the upper one is outside the interval
    return np.where(np.abs(rounded) > np.pi, np.pi, rounded)


def round_m(values: Floats) -> Floats:
    """Metres as trajectories have them: rounded to 1 micrometre, without negative zeros."""
    return np.round(values, _POSITION_DIGITS) + 0.0


def round_rad(values: Floats) -> Floats:
    """Radians as trajectories have them: rounded to 1 nanoradian, without negative zeros."""
    return np.round(values, _ANGLE_DIGITS) + 0.0


def _fill_speeds(boxes: VehicleBoxes, period_s: float) -> VehicleBoxes:
    """Fill speeds that the file does not give from the way to the next frame, or else from the last one."""
    order = np.lexsort((boxes.frame, boxes.code))
    follows = (np.diff(boxes.code[order]) == 0) & (np.diff(boxes.frame[order]) == 1)
    way = np.hypot(np.diff(boxes.x_m[order]), np.diff(boxes.y_m[order])) / period_s
    way = np.where(follows, way, np.nan)
    onward, back = np.append(way, np.nan), np.insert(way, 0, np.nan)
    speed = np.empty(order.size)
    speed[order] = np.where(np.isnan(onward), back, onward)
    return replace(boxes, speed_m_s=np.where(np.isnan(boxes.speed_m_s), speed, boxes.speed_m_s))


def _sorted_codes(column: pa.ChunkedArray) -> tuple[list[str], Ints]:
    """Different values, sorted by code point, and each row's position among them."""
    encoded = column.combine_chunks().dictionary_encode()
    if isinstance(encoded, pa.ChunkedArray):
        encoded = encoded.combine_chunks()
    values = encoded.dictionary.to_pylist()
    order = sorted(range(len(values)), key=values.__getitem__)
    rank = np.empty(len(values), dtype=np.int64)
    rank[order] = np.arange(len(values))
    return [values[i] for i in order], rank[encoded.indices.to_numpy(zero_copy_only=False).astype(np.int64)]


def _decode_strings(values: list[str], code: Ints) -> pa.Array:
    return pa.array(values, type=pa.string()).take(pa.array(code))


@dataclass(frozen=True)
class ExtraTraffic:
    """Traffic beside the scenario's own.

    Attributes
    ----------
    xml
        A route file.
    vehicles
        How many of SUMO's vehicles it takes at most at a time: ``--max-num-vehicles`` holds that many more.
    notes
        What the user should know.
    """

    xml: str
    vehicles: int
    notes: tuple[str, ...] = ()


class BoxChange(Protocol):
    """Changes the boxes of one recording, group by group; may remember the last group."""

    def change(self, boxes: VehicleBoxes) -> VehicleBoxes:
        """The boxes of the next group, changed."""
        ...

    def summary(self) -> dict[str, Any]:
        """What the stage reports beside the counts, as JSON."""
        ...


class TrafficHook(Protocol):
    """Something that goes beyond plain vehicles on flat ground. As it stands here, it changes nothing."""

    ADDS_TRAFFIC: ClassVar[bool] = False
    """Whether it has a :meth:`plan`; people on foot are recorded then."""

    def refuses(self, scenario: Scenario) -> InputError | None:
        """Why this scenario cannot have it; None when it can."""
        return None

    def sizes(self) -> dict[str, VehicleSize]:
        """Sizes of the types of vehicles and persons that it adds."""
        return {}

    def uncounted_types(self, sizes: Mapping[str, VehicleSize]) -> frozenset[str]:
        """Which of SUMO's types are no vehicles of the scenario."""
        return frozenset()

    def followed_types(self, scenario: Scenario, sizes: Mapping[str, VehicleSize]) -> frozenset[str]:
        """Types whose vehicles must be recorded all along their way, since a box depends on those before it."""
        return frozenset()

    def plan(
        self, scenario: Scenario, roads: Network, begin_s: float, end_s: float, rng: np.random.Generator
    ) -> ExtraTraffic:
        """The traffic that it adds between two times."""
        return ExtraTraffic("<routes/>", 0)

    def box_change(self, scenario: Scenario, sizes: Mapping[str, VehicleSize]) -> BoxChange | None:
        """What changes the boxes of a recording whose vehicles have these sizes; None for nothing."""
        return None
