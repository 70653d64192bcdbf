"""Writes trajectories.parquet; checks counts, speeds, overlaps.

Adds up how the boxes of a recording behave: how many there are, how fast, who stands, who overlaps.

World frame, metres, metres per second. Vehicles that stand are followed from group to group.

Makes ``trajectories.parquet`` of recorded rows, and checks what the scenario promises of them.

Steps, for each group of whole frames: rows become boxes; extensions change them; they are written as a row group, and
counted. Then the promises: N vehicles in each frame, and nobody standing for good. World frame (x east, y north, z up),
metres, radians.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.parquet import ArtefactWriter
from egvs.core.errors import Diagnostic, RunError
from egvs.core.grid import Roi
from egvs.core.runtime import ProgressCallback
from egvs.scenario.model import Scenario
from egvs.traffic import fcd, vehicle_boxes
from egvs.traffic.fcd import FrameGroup
from egvs.traffic.recording import Recording, describe_distance
from egvs.traffic.vehicle_boxes import BoxChange, Ints, TrafficHook, VehicleBoxes

STANDING_M_S = 0.1
"""A vehicle slower than this stands."""

SQUARE_M = 20.0
"""Overlaps are located to squares of this side."""

_SHRINK_M = 1e-3
_MOST_CELLS = 2**20
"""Along x and along y, so that the number of a cell in a frame of a group fits 64 bits."""


def describe_location(at_m: tuple[float, float], roi: Roi) -> str:
    """A place in the world frame, and how far from the region of interest it lies."""
    return f"x {at_m[0]:.0f} m, y {at_m[1]:.0f} m ({describe_distance(at_m, roi)})"


def find_overlaps(boxes: VehicleBoxes) -> NDArray[np.int64]:
    """Pairs of rows (n, 2) in the same frame whose boxes, made 1 mm smaller on each side, share area and height.

    Exact for rectangles (separating axes). Candidates come from square cells, at least as wide as the longest diagonal:
    a pair that overlaps lies in one cell or in two that touch. Cells are numbered along y, then x, then by frame, with
    an empty row and column between, so that a box's later neighbours are two runs: its own cell and the next, and three
    cells of the next column.
    """
    if not boxes.frame.size:
        return np.empty((0, 2), dtype=np.int64)
    half = np.hypot(boxes.length_m, boxes.width_m) / 2
    side = max(2 * half.max(), max(np.ptp(boxes.x_m), np.ptp(boxes.y_m)) / _MOST_CELLS)
    column, row = (np.floor((m - m.min()) / side).astype(np.int64) for m in (boxes.x_m, boxes.y_m))
    high, wide = int(row.max()) + 3, int(column.max()) + 2
    cell = ((boxes.frame - boxes.first_frame) * wide + column) * high + row + 1
    order = np.argsort(cell, kind="stable")
    cell, x, y, half = cell[order], boxes.x_m[order], boxes.y_m[order], half[order]
    everyone = np.arange(order.size)
    runs = (
        (everyone + 1, np.searchsorted(cell, cell + 1, side="right")),
        (np.searchsorted(cell, cell + high - 1), np.searchsorted(cell, cell + high + 1, side="right")),
    )
    overlaps = [np.empty((0, 2), dtype=np.int64)]
    for second, end in runs:
        first = everyone
        while (left := second < end).any():
            first, second, end = first[left], second[left], end[left]
            near = (x[second] - x[first]) ** 2 + (y[second] - y[first]) ** 2 < (half[first] + half[second]) ** 2
            a, b = order[first[near]], order[second[near]]
            hit = _boxes_overlap(boxes, a, b)
            overlaps.append(np.column_stack([np.minimum(a, b)[hit], np.maximum(a, b)[hit]]))
            second = second + 1
    return np.concatenate(overlaps)


def _boxes_overlap(boxes: VehicleBoxes, a: Ints, b: Ints) -> NDArray[np.bool_]:
    dx, dy = boxes.x_m[b] - boxes.x_m[a], boxes.y_m[b] - boxes.y_m[a]
    cos_a, sin_a = np.cos(boxes.yaw_rad[a]), np.sin(boxes.yaw_rad[a])
    cos_b, sin_b = np.cos(boxes.yaw_rad[b]), np.sin(boxes.yaw_rad[b])
    # of the angle between both headings: how much of the one's length and width points along the other's
    along, across = np.abs(cos_a * cos_b + sin_a * sin_b), np.abs(cos_a * sin_b - sin_a * cos_b)
    (long_a, wide_a), (long_b, wide_b) = (
        (boxes.length_m[i] / 2 - _SHRINK_M, boxes.width_m[i] / 2 - _SHRINK_M) for i in (a, b)
    )
    separate = np.abs(dx * cos_a + dy * sin_a) >= long_a + long_b * along + wide_b * across
    separate |= np.abs(dy * cos_a - dx * sin_a) >= wide_a + long_b * across + wide_b * along
    separate |= np.abs(dx * cos_b + dy * sin_b) >= long_b + long_a * along + wide_a * across
    separate |= np.abs(dy * cos_b - dx * sin_b) >= wide_b + long_a * across + wide_a * along
    separate |= np.abs(boxes.z_m[a] - boxes.z_m[b]) >= (boxes.height_m[a] + boxes.height_m[b]) / 2 - 2 * _SHRINK_M
    together: NDArray[np.bool_] = np.logical_not(separate)
    return together


def _vehicle_pairs(boxes: VehicleBoxes, pairs: Ints) -> Ints:
    """Pairs of parts -> pairs of vehicles, each once, as rows of the boxes whose first parts alone are kept."""
    assert boxes.part is not None
    vehicle = np.cumsum(boxes.part == 0) - 1
    return np.unique(vehicle[pairs], axis=0).reshape(-1, 2)


@dataclass
class Presence:
    """Of a kind that does not count as a vehicle: how many are in each frame, and which different ones."""

    in_frame: Ints
    different: set[str] = field(default_factory=set)

    def to_json(self) -> dict[str, Any]:
        """As the tally reports it."""
        n = self.in_frame
        mean, different = round(float(n.mean()), 3), len(self.different)
        return {"fewest": int(n.min()), "most": int(n.max()), "mean": mean, "different": different}


@dataclass(frozen=True)
class StandingVehicle:
    """A vehicle that stands: for how many frames, and where."""

    frames: int
    vehicle: str
    at_m: tuple[float, float]


@dataclass
class TrafficStatistics:
    """Adds up a recording group by group."""

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
    stopped_on_purpose: Set[str] = frozenset()
    """Vehicles that may stand where they like; their stands count, but none of them is the longest jam."""
    longest_jam: StandingVehicle | None = None
    overlaps_at: Counter[tuple[int, int]] = field(default_factory=Counter)
    """Overlapping pairs in squares of :data:`SQUARE_M`, by the square's number to the east and to the north."""
    standing_since: dict[str, int] = field(default_factory=dict)
    """Vehicles that stand in the last frame added, and the frame since when."""
    uncounted: dict[str, Presence] = field(default_factory=dict)
    mixed_overlaps: Counter[str] = field(default_factory=Counter)
    """Overlapping pairs in which one at least does not count as a vehicle, by their kinds."""

    def __post_init__(self) -> None:
        self.vehicles = np.zeros(self.frames, dtype=np.int64)

    def add(self, boxes: VehicleBoxes) -> None:
        """Count the next group."""
        end, pairs = boxes.first_frame + boxes.frames, find_overlaps(boxes)
        if boxes.part is not None:  # the parts of one vehicle touch at their joint
            pairs = pairs[boxes.code[pairs[:, 0]] != boxes.code[pairs[:, 1]]]
            pairs, boxes = _vehicle_pairs(boxes, pairs), boxes.select(boxes.part == 0)
        self._add_standing(boxes, end)
        if boxes.uncounted is not None:
            pairs, boxes = self._add_uncounted(boxes, boxes.uncounted, pairs)
        self.vehicles[boxes.first_frame : end] = _rows_per_frame(boxes, boxes.frame)
        named = boxes.names if boxes.uncounted is None else (boxes.names[i] for i in np.unique(boxes.code))
        self.different.update(named)
        self.rows += boxes.frame.size
        self.speed_sum += float(np.nansum(boxes.speed_m_s))
        self.standing += int(np.count_nonzero(boxes.speed_m_s < STANDING_M_S))
        self.overlapping_pairs += len(pairs)
        self.frames_with_overlap += np.unique(boxes.frame[pairs[:, 0]]).size
        first = pairs[:, 0]
        squares = (np.floor(values[first] / SQUARE_M).astype(int).tolist() for values in (boxes.x_m, boxes.y_m))
        self.overlaps_at.update(zip(*squares, strict=True))

    def _add_uncounted(
        self, boxes: VehicleBoxes, uncounted: NDArray[np.bool_], pairs: Ints
    ) -> tuple[Ints, VehicleBoxes]:
        """Count who does not count as a vehicle; what is left: vehicles, and the pairs of them that overlap."""
        end = boxes.first_frame + boxes.frames
        for kind in np.unique(boxes.kind[uncounted]):
            of_kind = uncounted & (boxes.kind == kind)
            presence = self.uncounted.setdefault(boxes.kinds[kind], Presence(np.zeros(self.frames, np.int64)))
            presence.in_frame[boxes.first_frame : end] = _rows_per_frame(boxes, boxes.frame[of_kind])
            presence.different.update(boxes.names[i] for i in np.unique(boxes.code[of_kind]))
        mixed = uncounted[pairs].any(axis=1)
        self.mixed_overlaps.update(
            " and ".join(sorted(boxes.kinds[boxes.kind[i]] for i in pair)) for pair in pairs[mixed]
        )
        return (np.cumsum(~uncounted) - 1)[pairs[~mixed]], boxes.select(~uncounted)

    def _add_standing(self, boxes: VehicleBoxes, end: int) -> None:
        """Follow each vehicle's runs of standing frames, across groups."""
        order = np.lexsort((boxes.frame, boxes.code))
        stands = order[boxes.speed_m_s[order] < STANDING_M_S]
        frame, code = boxes.frame[stands], boxes.code[stands]
        begins = np.flatnonzero((np.diff(code, prepend=-1) != 0) | (np.diff(frame, prepend=-2) != 1))
        ends = np.append(begins[1:], stands.size) - 1
        still: dict[str, int] = {}
        for first, last in zip(begins.tolist(), ends.tolist(), strict=True) if stands.size else ():
            name, since = boxes.names[code[first]], int(frame[first])
            if since == boxes.first_frame:
                since = self.standing_since.get(name, since)
            lasts = int(frame[last]) - since
            self.longest_standing_frames = max(self.longest_standing_frames, lasts)
            if name not in self.stopped_on_purpose and (self.longest_jam is None or lasts > self.longest_jam.frames):
                row = stands[last]
                self.longest_jam = StandingVehicle(lasts, name, (float(boxes.x_m[row]), float(boxes.y_m[row])))
            if frame[last] == end - 1:
                still[name] = since
        self.standing_since = still

    def to_json(self, period_s: float) -> dict[str, Any]:
        """What the recording amounts to, with frames ``period_s`` apart; nothing beside vehicles where all count.

        ``rows`` are vehicles, added up over the frames; ``share_standing`` is of these, slower than
        :data:`STANDING_M_S`.
        """
        n, rows = self.vehicles, self.rows
        values: dict[str, Any] = {
            "frames": self.frames,
            "vehicles": {"fewest": int(n.min()), "most": int(n.max()), "different": len(self.different)},
            "rows": rows,
            "mean_speed_m_s": round(self.speed_sum / rows, 4) if rows else 0.0,
            "share_standing": round(self.standing / rows, 4) if rows else 0.0,
            "longest_standing_s": round(self.longest_standing_frames * period_s, 3),
            "overlapping_pairs": self.overlapping_pairs,
            "frames_with_overlap": self.frames_with_overlap,
        }
        if self.uncounted:
            kinds = {kind: presence.to_json() for kind, presence in sorted(self.uncounted.items())}
            values["beside_vehicles"] = kinds | {"overlapping_pairs": dict(sorted(self.mixed_overlaps.items()))}
        return values


def _rows_per_frame(boxes: VehicleBoxes, frame: Ints) -> Ints:
    """How many rows of ``frame`` each frame of the group has."""
    return np.bincount(frame - boxes.first_frame, minlength=boxes.frames)


LONG_STOP_S = 120.0
"""A common signal comes round within 90 to 120 s."""

MAX_OVERLAP_SHARE = 0.05
"""Share of frames with an overlap that SUMO's sublane model makes by itself: 0 to 5 % were measured."""

GROUP_FRAMES = 500
"""Frames in a row group; fixed, so that the bytes do not depend on how the rows arrive."""


def write_trajectories(
    scenario: Scenario,
    recording: Recording,
    extensions: Sequence[TrafficHook],
    file: ArtefactWriter,
    progress: ProgressCallback,
    first_frame: int = 0,
) -> tuple[TrafficStatistics, dict[str, Any]]:
    """Write a recording's boxes, changed by the extensions that act, as frames from ``first_frame`` on; what they
    add up to, and what extensions report.

    InputError when a vehicle's size is unknown, or the file has too few frames; RunError when N vehicles are not held,
    or a vehicle stands without end.
    """
    tally = TrafficStatistics(recording.window.count, stopped_on_purpose=recording.stopped_on_purpose)
    period_s = recording.window.period_ms / 1000.0
    changes: list[BoxChange] | None = None
    for group in frame_groups(recording, GROUP_FRAMES):
        uncounted = frozenset[str]().union(*(extension.uncounted_types(recording.sizes) for extension in extensions))
        if changes is None:  # a running SUMO tells sizes with its first rows
            own = {name: size for name, size in recording.sizes.items() if name not in uncounted}
            changes = [c for extension in extensions if (c := extension.box_change(scenario, own)) is not None]
        place = recording.source or recording.where
        made = vehicle_boxes.boxes_from_bumpers(group, recording.sizes, period_s, place, uncounted)
        for change in changes:
            made = change.change(made)
        if made.frame.size:
            file.write(made.columns(first_frame))
        tally.add(made)
        progress("frames written", group.first_frame + group.frames, tally.frames)
    check_recording(scenario, tally, recording)
    return tally, {key: value for change in changes or () for key, value in change.summary().items()}


def frame_groups(recording: Recording, frames_each: int) -> Iterator[FrameGroup]:
    """Groups of whole frames, persons among the vehicles where they are recorded beside."""
    groups = fcd.group_frames(recording.rows, recording.window, frames_each, recording.where)
    if recording.persons is None:
        return groups
    persons = fcd.group_frames(recording.persons, recording.window, frames_each, recording.where)
    return (fcd.merge_streams(some, others) for some, others in zip(groups, persons, strict=True))


def check_recording(scenario: Scenario, tally: TrafficStatistics, recording: Recording) -> None:
    """RunError where a recording holds nobody, or a simulated one does not keep the scenario's promises."""
    traffic = scenario.traffic
    if not tally.rows:
        source = traffic.fcd or traffic.sumocfg or ", ".join(traffic.routes) or traffic.network
        of = f" of the period {scenario.period!r}" if scenario.period else ""
        raise RunError(
            f"{recording.where}: no vehicle of {source} is in any of {tally.frames} frames{of};"
            " check the demand, begin_s and warmup_s"
        )
    if recording.vehicles is not None and traffic.hold == "exactly":
        _check_vehicle_count(recording.vehicles, tally, recording.where)
    if recording.patience_s is not None:
        _check_moving(tally, recording, recording.patience_s)


def traffic_warnings(tally: TrafficStatistics, recording: Recording, roi: Roi) -> list[Diagnostic]:
    """What does not look like traffic: who stood too long, boxes that overlap too often; each with its place."""
    found, period_s = [], recording.window.period_ms / 1000.0
    stand = tally.longest_jam
    if stand is not None and recording.patience_s is not None and (stood_s := stand.frames * period_s) > LONG_STOP_S:
        what = f"vehicle {stand.vehicle!r} stood there for {stood_s:g} s, longer than any signal should keep it"
        cure = "look at the signals and connections of the network there, or let fewer vehicles in"
        found.append(Diagnostic("standing", f"{recording.where}: {describe_location(stand.at_m, roi)}", what, cure))
    share = tally.frames_with_overlap / tally.frames
    if share > MAX_OVERLAP_SHARE:
        (square, pairs), *_ = tally.overlaps_at.most_common(1)
        at_m = ((square[0] + 0.5) * SQUARE_M, (square[1] + 0.5) * SQUARE_M)
        what = f"vehicles overlap in {share:.0%} of the frames; {pairs} of {tally.overlapping_pairs} pairs do so there"
        cure = "a larger junction, or signals in place of a right of way that vehicles take on it"
        found.append(Diagnostic("overlaps", f"{recording.where}: {describe_location(at_m, roi)}", what, cure))
    return found


def _check_vehicle_count(vehicles: int, tally: TrafficStatistics, where: str) -> None:
    wrong = tally.vehicles != vehicles
    if wrong.any():
        first = int(wrong.argmax())
        raise RunError(
            f"{where}: {vehicles} vehicles are in {tally.frames - int(wrong.sum())} of {tally.frames} frames"
            f" only; the fewest are {tally.vehicles.min()}, the most {tally.vehicles.max()}, frame {first} has"
            f" {tally.vehicles[first]}. Lower traffic.vehicles (or vehicles_per_lane_km), lengthen warmup_s, raise"
            ' trips_per_s or the demand, or set hold = "at_most"'
        )


def _check_moving(tally: TrafficStatistics, recording: Recording, patience_s: float) -> None:
    period_s = recording.window.period_ms / 1000.0
    stands_s = {
        name: (tally.frames - 1 - frame) * period_s
        for name, frame in tally.standing_since.items()
        if name not in recording.stopped_on_purpose
    }
    stuck = [name for name, seconds in stands_s.items() if seconds > patience_s]
    if stuck:
        longest = max(stuck, key=lambda name: stands_s[name])
        raise RunError(
            f"{recording.where}: {len(stuck)} vehicles stand for more than {patience_s:g} s and through to the last"
            f" frame, {longest!r} for {stands_s[longest]:g} s: the traffic is jammed for good. Lower traffic.vehicles,"
            " or mend the network's signals and connections"
        )
