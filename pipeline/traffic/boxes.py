"""How does SUMO's point on a front bumper become a box, and how do the boxes of a recording behave?

SUMO gives x, y (and z on networks with heights) of the middle of the front bumper, an angle a in degrees clockwise from
north, and a slope p in degrees, uphill positive. The box of length L and height H has its centre at

    front - L/2 (sin a cos p, cos a cos p, sin p) + (0, 0, H/2),      yaw = 90 deg - a,      pitch = p

in the world frame (x east, y north, z up; yaw counter-clockwise from +x, in (-pi, pi]). Sines and cosines are taken of
degrees, exact at multiples of 90. Positions are rounded to 1 micrometre, angles to 1 nanoradian.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.core.errors import InputError
from pipeline.traffic.fcd import Group

STANDING_M_S = 0.1
"""A vehicle slower than this stands."""

_SHRINK_M = 1e-3
_MOST_CELLS = 2**20
"""Along x and along y, so that the number of a cell in a frame of a group fits 64 bits."""

_POSITION_DIGITS, _ANGLE_DIGITS = 6, 9
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Size:
    """Size and vClass of a vehicle type."""

    length_m: float
    width_m: float
    height_m: float
    vclass: str


@dataclass(frozen=True)
class Boxes:
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
    apart: NDArray[np.bool_] | None = None
    """Those who do not count as vehicles of the scenario (an effect's pedestrians and bicycles); None where all
    count."""

    def rows(self, index: Ints) -> dict[str, Any]:
        """The arrays that have one element a row, at ``index``."""
        arrays = {name: value for name, value in self.__dict__.items() if isinstance(value, np.ndarray)}
        return {name: value[index] for name, value in arrays.items()}

    def only(self, kept: NDArray[np.bool_]) -> Boxes:
        """Some of the rows."""
        return replace(self, **self.rows(np.flatnonzero(kept)))

    def columns(self) -> dict[str, Any]:
        """As the artefact ``trajectories`` has them."""
        n = self.frame.size
        return {
            "frame": self.frame.astype(np.uint32),
            "part": np.zeros(n, np.uint8) if self.part is None else self.part.astype(np.uint8),
            "vehicle": _strings(self.names, self.code),
            "kind": _strings(self.kinds, self.kind),
            **{
                name: getattr(self, name)
                for name in ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "length_m", "width_m", "height_m")
            },
        }


def boxes(
    group: Group, sizes: Mapping[str, Size], period_s: float, place: str, apart: frozenset[str] = frozenset()
) -> Boxes:
    """The boxes of a group of whole frames. Vehicles of the types in ``apart`` do not count as the scenario's.

    Raises
    ------
    InputError
        When a vehicle is of a type without a known size, or is twice in a frame.
    """
    names, code = _sorted_codes(group.rows["id"])
    types, type_code = _sorted_codes(group.rows["type"])
    for name in types:
        if name not in sizes:
            raise InputError(
                place,
                f"vehicle type {name!r} has no known size",
                f"a kind of that name with length_m, width_m and height_m (known: {', '.join(sorted(sizes))})",
            )
    order = np.lexsort((code, group.frame))
    frame, code, type_code = group.frame[order], code[order], type_code[order]
    twice = np.flatnonzero((np.diff(frame) == 0) & (np.diff(code) == 0))
    if twice.size:
        raise InputError(
            place, f"vehicle {names[code[twice[0]]]!r} is twice in frame {frame[twice[0]]}", "one row a vehicle a frame"
        )
    kinds = sorted({sizes[name].vclass for name in types})
    kind = np.array([kinds.index(sizes[name].vclass) for name in types], dtype=np.int64)[type_code]
    length, width, height = (
        np.array([getattr(sizes[name], key) for name in types], dtype=np.float64)[type_code]
        for key in ("length_m", "width_m", "height_m")
    )
    x, y, z, angle, slope, speed = (
        group.rows[key].to_numpy()[order] for key in ("x", "y", "z", "angle", "slope", "speed")
    )
    centre = centres(x, y, z, angle, slope, length, height)
    found = Boxes(
        group.first_frame,
        group.frames,
        frame,
        names,
        code,
        kinds,
        kind,
        *centre,
        yaw_rad(angle),
        _tidy(np.deg2rad(slope), _ANGLE_DIGITS),
        length,
        width,
        height,
        speed,
        types,
        type_code,
        apart=np.array([name in apart for name in types], dtype=np.bool_)[type_code] if apart else None,
    )
    return found if not np.isnan(speed).any() else _with_speed(found, period_s)


def centres(
    x: Floats, y: Floats, z: Floats, angle_deg: Floats, slope_deg: Floats, length_m: Floats, height_m: Floats
) -> tuple[Floats, Floats, Floats]:
    """Front bumpers (n,) -> box centres (n,), metres, rounded to 1 micrometre."""
    from scipy.special import cosdg, sindg

    half, flat = length_m / 2, cosdg(slope_deg)
    return (
        _tidy(x - half * flat * sindg(angle_deg), _POSITION_DIGITS),
        _tidy(y - half * flat * cosdg(angle_deg), _POSITION_DIGITS),
        _tidy(z - half * sindg(slope_deg) + height_m / 2, _POSITION_DIGITS),
    )


def yaw_rad(angle_deg: Floats) -> Floats:
    """Degrees clockwise from north -> radians counter-clockwise from +x, in (-pi, pi], rounded to 1 nanoradian."""
    degrees = 90.0 - np.asarray(angle_deg, dtype=np.float64)
    degrees = degrees - 360.0 * np.ceil((degrees - 180.0) / 360.0)
    rounded = _tidy(np.deg2rad(degrees), _ANGLE_DIGITS)
    # pi itself lies between two nanoradians, and the upper one is outside the interval
    return np.where(np.abs(rounded) > np.pi, np.pi, rounded)


def _tidy(values: Floats, digits: int) -> Floats:
    """Rounded, and without negative zeros."""
    return np.round(values, digits) + 0.0


def tidy_m(values: Floats) -> Floats:
    """Metres as trajectories have them: rounded to 1 micrometre."""
    return _tidy(values, _POSITION_DIGITS)


def tidy_rad(values: Floats) -> Floats:
    """Radians as trajectories have them: rounded to 1 nanoradian."""
    return _tidy(values, _ANGLE_DIGITS)


def _with_speed(found: Boxes, period_s: float) -> Boxes:
    """Fill speeds that the file does not give from the way to the next frame, or from the last one where there is
    none."""
    order = np.lexsort((found.frame, found.code))
    follows = (np.diff(found.code[order]) == 0) & (np.diff(found.frame[order]) == 1)
    way = np.hypot(np.diff(found.x_m[order]), np.diff(found.y_m[order])) / period_s
    way = np.where(follows, way, np.nan)
    onward, back = np.append(way, np.nan), np.insert(way, 0, np.nan)
    speed = np.empty(order.size)
    speed[order] = np.where(np.isnan(onward), back, onward)
    speed = np.where(np.isnan(found.speed_m_s), speed, found.speed_m_s)
    return replace(found, speed_m_s=speed)


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


def _strings(values: list[str], code: Ints) -> pa.Array:
    return pa.array(values, type=pa.string()).take(pa.array(code))


def overlapping(found: Boxes) -> NDArray[np.int64]:
    """Pairs of rows (n, 2) in the same frame whose boxes, made 1 mm smaller on each side, share area and height.

    Exact for rectangles (separating axes). Candidates come from square cells, at least as wide as the longest diagonal:
    a pair that overlaps lies in one cell or in two that touch. Cells are numbered along y, then x, then by frame, with
    an empty row and column between, so that a box's later neighbours are two runs: its own cell and the next, and three
    cells of the next column."""
    if not found.frame.size:
        return np.empty((0, 2), dtype=np.int64)
    half = np.hypot(found.length_m, found.width_m) / 2
    side = max(2 * half.max(), max(np.ptp(found.x_m), np.ptp(found.y_m)) / _MOST_CELLS)
    column, row = (np.floor((m - m.min()) / side).astype(np.int64) for m in (found.x_m, found.y_m))
    high, wide = int(row.max()) + 3, int(column.max()) + 2
    cell = ((found.frame - found.first_frame) * wide + column) * high + row + 1
    order = np.argsort(cell, kind="stable")
    cell, x, y, half = cell[order], found.x_m[order], found.y_m[order], half[order]
    everyone = np.arange(order.size)
    runs = (
        (everyone + 1, np.searchsorted(cell, cell + 1, side="right")),
        (np.searchsorted(cell, cell + high - 1), np.searchsorted(cell, cell + high + 1, side="right")),
    )
    hits = []
    for second, end in runs:
        first = everyone
        while (left := second < end).any():
            first, second, end = first[left], second[left], end[left]
            near = (x[second] - x[first]) ** 2 + (y[second] - y[first]) ** 2 < (half[first] + half[second]) ** 2
            a, b = order[first[near]], order[second[near]]
            hit = _share_space(found, a, b)
            hits.append(np.column_stack([np.minimum(a, b)[hit], np.maximum(a, b)[hit]]))
            second = second + 1
    return np.concatenate([np.empty((0, 2), dtype=np.int64), *hits])


def _share_space(found: Boxes, a: Ints, b: Ints) -> NDArray[np.bool_]:
    dx, dy = found.x_m[b] - found.x_m[a], found.y_m[b] - found.y_m[a]
    cos_a, sin_a = np.cos(found.yaw_rad[a]), np.sin(found.yaw_rad[a])
    cos_b, sin_b = np.cos(found.yaw_rad[b]), np.sin(found.yaw_rad[b])
    # of the angle between both headings: how much of the one's length and width points along the other's
    along, across = np.abs(cos_a * cos_b + sin_a * sin_b), np.abs(cos_a * sin_b - sin_a * cos_b)
    (long_a, wide_a), (long_b, wide_b) = (
        (found.length_m[i] / 2 - _SHRINK_M, found.width_m[i] / 2 - _SHRINK_M) for i in (a, b)
    )
    apart = np.abs(dx * cos_a + dy * sin_a) >= long_a + long_b * along + wide_b * across
    apart |= np.abs(dy * cos_a - dx * sin_a) >= wide_a + long_b * across + wide_b * along
    apart |= np.abs(dx * cos_b + dy * sin_b) >= long_b + long_a * along + wide_a * across
    apart |= np.abs(dy * cos_b - dx * sin_b) >= wide_b + long_a * across + wide_a * along
    apart |= np.abs(found.z_m[a] - found.z_m[b]) >= (found.height_m[a] + found.height_m[b]) / 2 - 2 * _SHRINK_M
    together: NDArray[np.bool_] = np.logical_not(apart)
    return together


def _whole_pairs(found: Boxes, pairs: Ints) -> Ints:
    """Pairs of parts -> pairs of vehicles, each once, as rows of the boxes that are left when only first parts are
    kept."""
    assert found.part is not None
    vehicle = np.cumsum(found.part == 0) - 1
    return np.unique(vehicle[pairs], axis=0).reshape(-1, 2)


@dataclass
class Tally:
    """What a recording amounts to, added up group by group."""

    frames: int
    vehicles: Ints = field(init=False)
    """Vehicles in each frame."""
    different: set[str] = field(default_factory=set)
    rows: int = 0
    speed_sum: float = 0.0
    standing: int = 0
    overlapping_pairs: int = 0
    frames_with_overlap: int = 0
    longest_standing_frames: int = 0
    stands_since: dict[str, int] = field(default_factory=dict)
    """Vehicles that stand in the last frame added, and the frame since when."""
    apart: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Of each kind that does not count as a vehicle: how many in a frame, and which different ones."""
    mixed_overlaps: Counter[str] = field(default_factory=Counter)
    """Overlapping pairs in which one at least does not count as a vehicle, by their kinds."""

    def __post_init__(self) -> None:
        self.vehicles = np.zeros(self.frames, dtype=np.int64)

    def add(self, found: Boxes) -> None:
        """Count the next group."""
        end, pairs = found.first_frame + found.frames, overlapping(found)
        if found.part is not None:  # the parts of one vehicle touch at their joint
            pairs = pairs[found.code[pairs[:, 0]] != found.code[pairs[:, 1]]]
            pairs, found = _whole_pairs(found, pairs), found.only(found.part == 0)
        self._add_standing(found, end)
        if found.apart is not None:
            pairs, found = self._add_apart(found, pairs)
        self.vehicles[found.first_frame : end] = np.bincount(found.frame - found.first_frame, minlength=found.frames)
        self.different.update(found.names if found.apart is None else (found.names[i] for i in np.unique(found.code)))
        self.rows += found.frame.size
        self.speed_sum += float(np.nansum(found.speed_m_s))
        self.standing += int(np.count_nonzero(found.speed_m_s < STANDING_M_S))
        self.overlapping_pairs += len(pairs)
        self.frames_with_overlap += np.unique(found.frame[pairs[:, 0]]).size

    def _add_apart(self, found: Boxes, pairs: Ints) -> tuple[Ints, Boxes]:
        """Count who does not count as a vehicle; what is left: vehicles, and the pairs of them that overlap."""
        assert found.apart is not None
        end = found.first_frame + found.frames
        for kind in np.unique(found.kind[found.apart]):
            mine = found.apart & (found.kind == kind)
            about = self.apart.setdefault(
                found.kinds[kind], {"frame": np.zeros(self.frames, np.int64), "different": set()}
            )
            about["frame"][found.first_frame : end] = np.bincount(
                found.frame[mine] - found.first_frame, minlength=found.frames
            )
            about["different"].update(found.names[i] for i in np.unique(found.code[mine]))
        mixed = found.apart[pairs].any(axis=1)
        self.mixed_overlaps.update(
            " and ".join(sorted(found.kinds[found.kind[i]] for i in pair)) for pair in pairs[mixed]
        )
        counted = ~found.apart
        return (np.cumsum(counted) - 1)[pairs[~mixed]], found.only(counted)

    def _add_standing(self, found: Boxes, end: int) -> None:
        """Follow each vehicle's runs of standing frames, across groups."""
        order = np.lexsort((found.frame, found.code))
        stands = order[found.speed_m_s[order] < STANDING_M_S]
        frame, code = found.frame[stands], found.code[stands]
        begins = np.flatnonzero((np.diff(code, prepend=-1) != 0) | (np.diff(frame, prepend=-2) != 1))
        ends = np.append(begins[1:], stands.size) - 1
        still: dict[str, int] = {}
        for first, last in zip(begins.tolist(), ends.tolist(), strict=True) if stands.size else ():
            name, since = found.names[code[first]], int(frame[first])
            if since == found.first_frame:
                since = self.stands_since.get(name, since)
            self.longest_standing_frames = max(self.longest_standing_frames, int(frame[last]) - since)
            if frame[last] == end - 1:
                still[name] = since
        self.stands_since = still

    def result(self, period_s: float) -> dict[str, Any]:
        """As the stage reports it."""
        return {
            "frames": self.frames,
            "vehicles": {
                "fewest": int(self.vehicles.min()),
                "most": int(self.vehicles.max()),
                "different": len(self.different),
            },
            "rows": self.rows,
            "mean_speed_m_s": round(self.speed_sum / self.rows, 4) if self.rows else 0.0,
            "share_standing": round(self.standing / self.rows, 4) if self.rows else 0.0,
            "longest_standing_s": round(self.longest_standing_frames * period_s, 3),
            "overlapping_pairs": self.overlapping_pairs,
            "frames_with_overlap": self.frames_with_overlap,
            **self._apart_result(),
        }

    def _apart_result(self) -> dict[str, Any]:
        """Nothing where everybody counts as a vehicle."""
        if not self.apart:
            return {}
        about = {
            kind: {
                "fewest": int(values["frame"].min()),
                "most": int(values["frame"].max()),
                "mean": round(float(values["frame"].mean()), 3),
                "different": len(values["different"]),
            }
            for kind, values in sorted(self.apart.items())
        }
        return {"beside_vehicles": about | {"overlapping_pairs": dict(sorted(self.mixed_overlaps.items()))}}
