"""Write ``trajectories.parquet``, and check counts, speeds and overlaps of the vehicles.

Steps, for each group of frames: compute boxes; let extensions change them; write them as a row group; add them to the
statistics. Then check the recording: N vehicles in each frame, and no vehicle that stands for good. World frame (x
east, y north, z up), metres, radians, metres per second.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from egvs.artefacts.parquet import ArtefactWriter
from egvs.core.errors import Diagnostic, RunError
from egvs.core.grid import BoolArray, IntArray, Roi
from egvs.core.progress import ProgressCallback
from egvs.core.wording import by_number, format_percent, number_of
from egvs.scenario.model import Scenario
from egvs.traffic import fcd, vehicle_boxes
from egvs.traffic.locks import DemandKey, StreetNames, describe_distance, is_inside
from egvs.traffic.recording import Recording, demand_key
from egvs.traffic.vehicle_boxes import BoxChange, TrafficHook, VehicleBoxes

STANDING_M_S = 0.1
"""A vehicle slower than this is standing."""

LONG_STOP_S = 120.0
"""Usual signals have cycles of 90 to 120 s."""

MAX_OVERLAP_SHARE = 0.05
"""SUMO's sublane model has overlaps in 0 to 5 % of the frames (measured)."""

MIN_OVERLAPS_PER_THOUSAND = 1.0
"""Overlaps with blockers per 1,000 vehicles and frames in the region: fewer are no warning."""

GROUP_FRAMES = 500
"""Frames of a row group; constant, so that the file does not depend on how the rows arrive."""

SQUARE_M = 20.0
"""Overlaps are counted in squares of this side."""

SAME_PLACE_M = 0.1
"""Centres of two vehicles that are no farther apart are those of one vehicle."""

MIN_TWIN_SHARE = 0.5
"""Share of the overlaps whose vehicles are in the same place that gets another warning."""

_SHRINK_M = 1e-3
_MAX_CELLS = 2**20
"""Limit along x and along y, so that the number of a cell in a frame fits 64 bits."""


def describe_location(at_m: tuple[float, float], roi: Roi) -> str:
    """Describe a point in the world frame: its coordinates, and its distance from the region of interest."""
    return f"x {at_m[0]:.0f} m, y {at_m[1]:.0f} m ({describe_distance(at_m, roi)})"


def find_overlaps(boxes: VehicleBoxes) -> IntArray:
    """Find the boxes that overlap in the same frame, after shrinking each by 1 mm on all sides.

    Exact for rectangles (separating axes). Candidate pairs come from a grid of square cells that are at least as wide
    as the longest diagonal, so that boxes that overlap are in the same cell or in neighbouring ones. Cells are numbered
    along y, then x, then by frame, with an empty row and column between, so that the following neighbours of a box are
    two runs: its cell and the next one, and three cells of the next column.

    Parameters
    ----------
    boxes
        Boxes of consecutive frames.

    Returns
    -------
    ndarray
        Positions of pairs of boxes, shape (n, 2), int64.
    """
    if not boxes.frame.size:
        return np.empty((0, 2), dtype=np.int64)
    half = np.hypot(boxes.length_m, boxes.width_m) / 2
    side = max(2 * half.max(), max(np.ptp(boxes.x_m), np.ptp(boxes.y_m)) / _MAX_CELLS)
    column = np.floor((boxes.x_m - boxes.x_m.min()) / side).astype(np.int64)
    row = np.floor((boxes.y_m - boxes.y_m.min()) / side).astype(np.int64)
    n_rows, n_columns = int(row.max()) + 3, int(column.max()) + 2
    cell = ((boxes.frame - boxes.first_frame) * n_columns + column) * n_rows + row + 1
    order = np.argsort(cell, kind="stable")
    cell, x, y, half = cell[order], boxes.x_m[order], boxes.y_m[order], half[order]

    positions = np.arange(order.size)
    runs = (
        (positions + 1, np.searchsorted(cell, cell + 1, side="right")),
        (np.searchsorted(cell, cell + n_rows - 1), np.searchsorted(cell, cell + n_rows + 1, side="right")),
    )
    overlaps = [np.empty((0, 2), dtype=np.int64)]
    for second, end in runs:
        first = positions
        while (remaining := second < end).any():
            first, second, end = first[remaining], second[remaining], end[remaining]
            near = (x[second] - x[first]) ** 2 + (y[second] - y[first]) ** 2 < (half[first] + half[second]) ** 2
            a, b = order[first[near]], order[second[near]]
            hit = _boxes_overlap(boxes, a, b)
            overlaps.append(np.column_stack([np.minimum(a, b)[hit], np.maximum(a, b)[hit]]))
            second = second + 1
    return np.concatenate(overlaps)


def _boxes_overlap(boxes: VehicleBoxes, a: IntArray, b: IntArray) -> BoolArray:
    dx, dy = boxes.x_m[b] - boxes.x_m[a], boxes.y_m[b] - boxes.y_m[a]
    cos_a, sin_a = np.cos(boxes.yaw_rad[a]), np.sin(boxes.yaw_rad[a])
    cos_b, sin_b = np.cos(boxes.yaw_rad[b]), np.sin(boxes.yaw_rad[b])
    # cosine and sine of the angle between both headings
    along, across = np.abs(cos_a * cos_b + sin_a * sin_b), np.abs(cos_a * sin_b - sin_a * cos_b)
    long_a, wide_a = boxes.length_m[a] / 2 - _SHRINK_M, boxes.width_m[a] / 2 - _SHRINK_M
    long_b, wide_b = boxes.length_m[b] / 2 - _SHRINK_M, boxes.width_m[b] / 2 - _SHRINK_M
    separate = np.abs(dx * cos_a + dy * sin_a) >= long_a + long_b * along + wide_b * across
    separate |= np.abs(dy * cos_a - dx * sin_a) >= wide_a + long_b * across + wide_b * along
    separate |= np.abs(dx * cos_b + dy * sin_b) >= long_b + long_a * along + wide_a * across
    separate |= np.abs(dy * cos_b - dx * sin_b) >= wide_b + long_a * across + wide_a * along
    separate |= np.abs(boxes.z_m[a] - boxes.z_m[b]) >= (boxes.height_m[a] + boxes.height_m[b]) / 2 - 2 * _SHRINK_M
    overlap: BoolArray = np.logical_not(separate)
    return overlap


@dataclass
class UncountedKind:
    """Statistics of a kind that does not count as a vehicle: number in each frame, and names."""

    in_frame: IntArray
    names: set[str] = field(default_factory=set)

    def to_json(self) -> dict[str, Any]:
        """Return the statistics as JSON."""
        n = self.in_frame
        mean = round(float(n.mean()), 3)
        return {"fewest": int(n.min()), "most": int(n.max()), "mean": mean, "different": len(self.names)}


@dataclass(frozen=True)
class StandingVehicle:
    """A vehicle that was standing: since which frame, for how many frames, and its position."""

    since: int
    frames: int
    vehicle: str
    at_m: tuple[float, float]


@dataclass
class TrafficStatistics:
    """Statistics of a recording, added up group by group.

    Attributes
    ----------
    frames
        Frames of the recording.
    vehicles
        Number of vehicles in each frame.
    names
        Names of all vehicles.
    rows
        Vehicles, summed over the frames.
    speed_sum
        Sum of speeds over all rows.
    standing
        Rows of standing vehicles.
    overlapping_pairs, frames_with_overlap
        Overlaps of vehicles.
    longest_standing_frames
        Longest time that a vehicle was standing.
    stopped_on_purpose
        Vehicles that are ignored in ``longest_jam``.
    longest_jam
        Vehicle that was standing for longest.
    long_stop_frames
        A vehicle that was standing for more frames made a long stop.
    stood_long
        Names of the vehicles with a long stop.
    same_place, twins
        Overlaps of two vehicles in the same place, and an example of their names.
    overlaps_by_square
        Overlaps in squares of :data:`SQUARE_M`, by number of the square to the east and to the north.
    standing_since
        Vehicles that are standing in the last frame, and the frame since when.
    standing_at_m
        Where they are standing.
    region
        Where overlaps with blockers are counted; None for nowhere.
    blocker_frames
        A vehicle that has stood for so many frames is a blocker.
    rows_in_region, overlaps_in_region
        Vehicles in the region, summed over the frames, and overlaps with blockers.
    uncounted
        Statistics of kinds that do not count as vehicles.
    mixed_overlaps
        Overlaps in which one at least does not count as a vehicle, by their kinds.
    """

    frames: int
    vehicles: IntArray = field(init=False)
    names: set[str] = field(default_factory=set)
    rows: int = 0
    speed_sum: float = 0.0
    standing: int = 0
    overlapping_pairs: int = 0
    frames_with_overlap: int = 0
    same_place: int = 0
    twins: tuple[str, str] | None = None
    longest_standing_frames: int = 0
    stopped_on_purpose: Set[str] = frozenset()
    longest_jam: StandingVehicle | None = None
    long_stop_frames: float = math.inf
    stood_long: set[str] = field(default_factory=set)
    overlaps_by_square: Counter[tuple[int, int]] = field(default_factory=Counter)
    standing_since: dict[str, int] = field(default_factory=dict)
    standing_at_m: dict[str, tuple[float, float]] = field(default_factory=dict)
    region: Roi | None = None
    blocker_frames: int = 0
    rows_in_region: int = 0
    overlaps_in_region: int = 0
    uncounted: dict[str, UncountedKind] = field(default_factory=dict)
    mixed_overlaps: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.vehicles = np.zeros(self.frames, dtype=np.int64)

    def add(self, boxes: VehicleBoxes) -> None:
        """Add the next group of frames."""
        pairs = find_overlaps(boxes)
        if boxes.part is not None:
            pairs = _vehicle_pairs(boxes, boxes.part, pairs)
            boxes = boxes.select(boxes.part == 0)
        end = boxes.first_frame + boxes.frames
        standing_frames = self._add_standing(boxes, end)
        if boxes.uncounted is not None:
            self._add_uncounted(boxes, boxes.uncounted, pairs)
            mixed = boxes.uncounted[pairs].any(axis=1)
            pairs = (np.cumsum(~boxes.uncounted) - 1)[pairs[~mixed]]
            standing_frames = standing_frames[~boxes.uncounted]
            boxes = boxes.select(~boxes.uncounted)
        self.vehicles[boxes.first_frame : end] = _boxes_per_frame(boxes, boxes.frame)
        self.names.update(boxes.names[i] for i in np.unique(boxes.code))
        self.rows += boxes.frame.size
        self.speed_sum += float(np.nansum(boxes.speed_m_s))
        self.standing += int(np.count_nonzero(boxes.speed_m_s < STANDING_M_S))
        self.overlapping_pairs += len(pairs)
        first = pairs[:, 0]
        self.frames_with_overlap += np.unique(boxes.frame[first]).size
        self._add_twins(boxes, pairs)
        east = np.floor(boxes.x_m[first] / SQUARE_M).astype(int)
        north = np.floor(boxes.y_m[first] / SQUARE_M).astype(int)
        self.overlaps_by_square.update(zip(east.tolist(), north.tolist(), strict=True))
        if self.region is not None:
            in_region = centres_in_region(boxes, self.region)
            self.rows_in_region += int(np.count_nonzero(in_region))
            is_blocker = standing_frames >= self.blocker_frames
            self.overlaps_in_region += int(np.count_nonzero((in_region & is_blocker)[pairs].any(axis=1)))

    def _add_twins(self, boxes: VehicleBoxes, pairs: IntArray) -> None:
        """Count the overlaps whose boxes have the same centre."""
        centres_m = np.column_stack([boxes.x_m, boxes.y_m, boxes.z_m])
        distance_m = np.linalg.norm(centres_m[pairs[:, 0]] - centres_m[pairs[:, 1]], axis=1)
        twins = pairs[distance_m <= SAME_PLACE_M]
        self.same_place += len(twins)
        if len(twins) and self.twins is None:
            one, other = boxes.code[twins[0]]
            self.twins = boxes.names[one], boxes.names[other]

    def _add_uncounted(self, boxes: VehicleBoxes, uncounted: BoolArray, pairs: IntArray) -> None:
        """Add the boxes that do not count as vehicles, and the overlaps of such boxes."""
        end = boxes.first_frame + boxes.frames
        for kind in np.unique(boxes.kind[uncounted]):
            of_kind = uncounted & (boxes.kind == kind)
            statistics = self.uncounted.setdefault(boxes.kinds[kind], UncountedKind(np.zeros(self.frames, np.int64)))
            statistics.in_frame[boxes.first_frame : end] = _boxes_per_frame(boxes, boxes.frame[of_kind])
            statistics.names.update(boxes.names[i] for i in np.unique(boxes.code[of_kind]))
        for pair in pairs[uncounted[pairs].any(axis=1)]:
            kinds = sorted(boxes.kinds[boxes.kind[i]] for i in pair)
            self.mixed_overlaps[" and ".join(kinds)] += 1

    def _add_standing(self, boxes: VehicleBoxes, end: int) -> IntArray:
        """Follow the runs of frames in which each vehicle is standing, across groups.

        Return for how many frames each vehicle has stood; -1 for those that move.
        """
        standing_frames = np.full(boxes.frame.size, -1)
        order = np.lexsort((boxes.frame, boxes.code))
        rows = order[boxes.speed_m_s[order] < STANDING_M_S]
        frame, code = boxes.frame[rows], boxes.code[rows]
        begins = np.flatnonzero((np.diff(code, prepend=-1) != 0) | (np.diff(frame, prepend=-2) != 1))
        ends = np.append(begins, rows.size)[1:] - 1
        still_standing: dict[str, int] = {}
        self.standing_at_m = {}
        for first, last in zip(begins.tolist(), ends.tolist(), strict=True):
            name = boxes.names[code[first]]
            since = int(frame[first])
            if since == boxes.first_frame:
                since = self.standing_since.get(name, since)
            duration = int(frame[last]) - since
            standing_frames[rows[first : last + 1]] = frame[first : last + 1] - since
            self.longest_standing_frames = max(self.longest_standing_frames, duration)
            is_longest = self.longest_jam is None or duration > self.longest_jam.frames
            if duration > self.long_stop_frames and name not in self.stopped_on_purpose:
                self.stood_long.add(name)
            if is_longest and name not in self.stopped_on_purpose:
                row = rows[last]
                self.longest_jam = StandingVehicle(
                    since, duration, name, (float(boxes.x_m[row]), float(boxes.y_m[row]))
                )
            if frame[last] == end - 1:
                still_standing[name] = since
                self.standing_at_m[name] = float(boxes.x_m[rows[last]]), float(boxes.y_m[rows[last]])
        self.standing_since = still_standing
        return standing_frames

    def to_json(self, period_s: float) -> dict[str, Any]:
        """Return the statistics as JSON.

        Parameters
        ----------
        period_s
            Time between frames.

        Returns
        -------
        dict
            ``rows`` are vehicles, summed over the frames; ``share_standing`` is the share of them that are slower than
            :data:`STANDING_M_S`; ``beside_vehicles`` is missing if all boxes count as vehicles.
        """
        n, rows = self.vehicles, self.rows
        values: dict[str, Any] = {
            "frames": self.frames,
            "vehicles": {"fewest": int(n.min()), "most": int(n.max()), "different": len(self.names)},
            "rows": rows,
            "mean_speed_m_s": round(self.speed_sum / max(rows, 1), 4),
            "share_standing": round(self.standing / max(rows, 1), 4),
            "longest_standing_s": round(self.longest_standing_frames * period_s, 3),
            "overlapping_pairs": self.overlapping_pairs,
            "frames_with_overlap": self.frames_with_overlap,
        }
        if self.region is not None:
            values["overlapping_pairs_in_roi"] = self.overlaps_in_region
        if self.uncounted:
            kinds = {kind: statistics.to_json() for kind, statistics in sorted(self.uncounted.items())}
            values["beside_vehicles"] = kinds | {"overlapping_pairs": dict(sorted(self.mixed_overlaps.items()))}
        return values


def centres_in_region(boxes: VehicleBoxes, region: Roi) -> BoolArray:
    """Return whether the centre of each box is in a region, seen from above."""
    (x_m, y_m), (width_m, depth_m) = region.origin_m[:2], region.size_m[:2]
    inside: BoolArray = (boxes.x_m >= x_m) & (boxes.x_m <= x_m + width_m)
    return inside & (boxes.y_m >= y_m) & (boxes.y_m <= y_m + depth_m)


def _vehicle_pairs(boxes: VehicleBoxes, part: IntArray, pairs: IntArray) -> IntArray:
    """Convert pairs of parts to pairs of different vehicles, as positions among the first parts; no duplicates."""
    pairs = pairs[boxes.code[pairs[:, 0]] != boxes.code[pairs[:, 1]]]  # parts of one vehicle touch at their joint
    vehicle = np.cumsum(part == 0) - 1
    return np.unique(vehicle[pairs], axis=0).reshape(-1, 2)


def _boxes_per_frame(boxes: VehicleBoxes, frame: IntArray) -> IntArray:
    """Count the elements of ``frame`` in each frame of the group."""
    return np.bincount(frame - boxes.first_frame, minlength=boxes.frames)


def write_trajectories(
    scenario: Scenario,
    recording: Recording,
    extensions: Sequence[TrafficHook],
    file: ArtefactWriter,
    progress: ProgressCallback,
    first_frame: int = 0,
    name_prefix: str = "",
) -> tuple[TrafficStatistics, dict[str, Any]]:
    """Write the boxes of a recording.

    Parameters
    ----------
    scenario
        The scenario.
    recording
        Its FCD rows.
    extensions
        Change the boxes.
    file
        The artefact.
    progress
        Reports written frames.
    first_frame
        Number of the first frame in the file.
    name_prefix
        Put before the names of vehicles, so that those of several simulations differ.

    Returns
    -------
    tuple of TrafficStatistics and dict
        The statistics, and the summaries of the extensions.

    Raises
    ------
    InputError
        When the size of a vehicle is unknown, or a finished file has too few frames.
    RunError
        When the number of vehicles is not maintained, or a vehicle stands for good.
    """
    period_s = recording.window.period_ms / 1000.0
    statistics = TrafficStatistics(recording.window.count, stopped_on_purpose=recording.stopped_on_purpose)
    statistics.long_stop_frames = LONG_STOP_S / period_s
    blocker_s = scenario.traffic.junction_blocker_s
    if blocker_s is not None:
        statistics.region = scenario.roi.box
        statistics.blocker_frames = max(0, int(blocker_s / period_s) - 1)  # it stopped between two frames
    changes: list[BoxChange] | None = None
    for group in frame_groups(recording, GROUP_FRAMES):
        uncounted = recording.uncounted_types.union(
            *(extension.uncounted_types(recording.sizes) for extension in extensions)
        )
        if changes is None:  # here, because a running SUMO reports sizes with its first rows
            vehicle_sizes = {name: size for name, size in recording.sizes.items() if name not in uncounted}
            candidates = [extension.box_change(scenario, vehicle_sizes) for extension in extensions]
            changes = [change for change in candidates if change is not None]
        where = recording.source or recording.where
        boxes = vehicle_boxes.boxes_from_bumpers(group, recording.sizes, period_s, where, uncounted)
        for change in changes:
            boxes = vehicle_boxes.checked_boxes(change, change.change(boxes))
        if boxes.frame.size:
            file.write(boxes.columns(first_frame, name_prefix))
        statistics.add(boxes)
        progress("frames written", group.first_frame + group.frames, statistics.frames)
    recording.finish()
    check_recording(scenario, statistics, recording)
    summaries: dict[str, Any] = {}
    for change in changes or ():
        summaries |= change.summary()
    return statistics, summaries


def frame_groups(recording: Recording, frames_each: int) -> Iterator[fcd.FrameGroup]:
    """Return groups of frames of a recording, with vehicles and persons."""
    groups = fcd.group_frames(recording.rows, recording.window, frames_each, recording.where)
    if recording.persons is None:
        return groups
    persons = fcd.group_frames(recording.persons, recording.window, frames_each, recording.where)
    return (fcd.merge_groups(vehicles, others) for vehicles, others in zip(groups, persons, strict=True))


def check_recording(scenario: Scenario, statistics: TrafficStatistics, recording: Recording) -> None:
    """Check a recording.

    Parameters
    ----------
    scenario
        The scenario.
    statistics
        Statistics of all frames.
    recording
        The recording.

    Raises
    ------
    RunError
        When there is no vehicle, the number of vehicles is not maintained, or a vehicle stands for good.
    """
    traffic = scenario.traffic
    if not statistics.rows and not statistics.uncounted:
        source = (
            traffic.fcd
            or ", ".join(traffic.tracks or ())
            or traffic.sumocfg
            or ", ".join(traffic.routes)
            or traffic.network
        )
        period = f" of the period {scenario.period!r}" if scenario.period else ""
        raise RunError(
            f"{recording.where}: no vehicle of {source} is in any of {number_of(statistics.frames, 'frame')}{period}."
            " Check the demand, begin_s and warmup_s"
        )
    if recording.vehicles is not None and traffic.hold == "exactly":
        _check_vehicle_count(recording.vehicles, statistics, recording.where)
    if recording.standing_limit_s is not None:
        _check_moving(scenario, statistics, recording, recording.standing_limit_s)


def traffic_warnings(
    statistics: TrafficStatistics, recording: Recording, roi: Roi, demand: DemandKey
) -> list[Diagnostic]:
    """Warn about implausible traffic: a vehicle that was standing for too long, overlaps in too many frames.

    Parameters
    ----------
    statistics
        Statistics of all frames.
    recording
        The recording.
    roi
        Region of interest; locations are described by their distance from it.
    demand
        How to reduce the traffic, for messages.
    """
    warnings = []
    jam = statistics.longest_jam
    if jam is not None and recording.standing_limit_s is not None:
        duration_s = jam.frames * (recording.window.period_ms / 1000.0)
        if duration_s > LONG_STOP_S:
            problem = (
                f"vehicle {jam.vehicle!r} was standing for {duration_s:g} s, longer than any usual red phase,"
                f" {_describe_stand(jam.at_m, jam.since, recording, roi)}"
            )
            if statistics.stood_long:
                number, total = len(statistics.stood_long), len(statistics.names)
                percent = format_percent(number / total)
                problem += (
                    f"; {number} of {total:,} vehicles ({percent}) stood for more than {LONG_STOP_S:g} s somewhere"
                )
            warnings.append(Diagnostic("standing", demand.where, problem, demand.hint))
    per_thousand = 1000 * statistics.overlaps_in_region / max(statistics.rows_in_region, 1)
    if per_thousand >= MIN_OVERLAPS_PER_THOUSAND:
        problem = (
            f"vehicles overlap {number_of(statistics.overlaps_in_region, 'time')} in the region of interest"
            f" ({per_thousand:.1f} per"
            " 1,000 vehicles and frames) with one that blocked them on a junction"
        )
        hint = "Reduce the traffic, or remove junction_blocker_s, without which the traffic may lock."
        warnings.append(Diagnostic("overlaps in roi", f"{recording.where}.junction_blocker_s", problem, hint))
    share = statistics.frames_with_overlap / statistics.frames
    if share > MAX_OVERLAP_SHARE:
        ((east, north), pairs), *_ = statistics.overlaps_by_square.most_common(1)
        centre_m = (east + 0.5) * SQUARE_M, (north + 0.5) * SQUARE_M
        where = f"{recording.where}: {describe_location(centre_m, roi)}"
        problem = (
            f"vehicles overlap in {format_percent(share, 0)} of the frames; {pairs} of"
            f" {number_of(statistics.overlapping_pairs, 'overlap')} {by_number(pairs, 'is', 'are')}"
            " here"
        )
        hint = "Enlarge the junction, or use signals where vehicles wait on it to give way."
        if recording.tracks is not None:
            hint = "Check times, positions and sizes of the tracks."
        if statistics.twins is not None and statistics.same_place >= MIN_TWIN_SHARE * statistics.overlapping_pairs:
            where = recording.where
            same_place = format_percent(statistics.same_place / statistics.overlapping_pairs, 0)
            one, other = statistics.twins
            problem = (
                f"vehicles overlap in {format_percent(share, 0)} of the frames; {same_place} of these overlaps are of"
                f" two vehicles in the same place, such as {one!r} and {other!r}: one vehicle with two names, or"
                " listed twice"
            )
            hint = "Remove the copies, such as those of a second file or sensor; each would count as traffic."
        warnings.append(Diagnostic("overlaps", where, problem, hint))
    return warnings


def _check_vehicle_count(vehicles: int, statistics: TrafficStatistics, where: str) -> None:
    wrong = statistics.vehicles != vehicles
    if wrong.any():
        first = int(wrong.argmax())
        raise RunError(
            f"{where}: expected {number_of(vehicles, 'vehicle')} in every frame, got them in"
            f" {statistics.frames - int(wrong.sum())} of {statistics.frames} frames (min {statistics.vehicles.min()},"
            f" max {statistics.vehicles.max()}; frame {first} has {statistics.vehicles[first]}). Lower traffic.vehicles"
            " (or vehicles_per_lane_km), increase warmup_s, trips_per_s or the demand, or set"
            ' hold = "at_most"'
        )


def _check_moving(scenario: Scenario, statistics: TrafficStatistics, recording: Recording, limit_s: float) -> None:
    """Raise a RunError if vehicles stand for good.

    Where the number of vehicles is maintained, a jam anywhere collects the vehicles of all streets. Otherwise a jam
    matters in the region of interest only, if that was not watched while SUMO ran.
    """
    is_watched = recording.locked is not None
    period_s = recording.window.period_ms / 1000.0
    jammed_s = {}
    for name, frame in statistics.standing_since.items():
        duration_s = (statistics.frames - 1 - frame) * period_s
        is_in_region = not is_watched and is_inside(statistics.standing_at_m[name], scenario.roi.box)
        matters = recording.vehicles is not None or is_in_region
        if matters and name not in recording.stopped_on_purpose and duration_s > limit_s:
            jammed_s[name] = duration_s
    if jammed_s:
        longest = max(jammed_s, key=lambda name: jammed_s[name])
        at_m, since = statistics.standing_at_m[longest], statistics.standing_since[longest]
        where, hint = demand_key(scenario)
        raise RunError(
            f"{where}: the traffic is jammed: {number_of(len(jammed_s), 'vehicle')}"
            f" {by_number(len(jammed_s), 'stands', 'stand')} for more than {limit_s:g} s up"
            f" to the last frame, {longest!r} for {jammed_s[longest]:g} s"
            f" {_describe_stand(at_m, since, recording, scenario.roi.box)}. {hint}"
        )


def _describe_stand(at_m: tuple[float, float], since: int, recording: Recording, roi: Roi) -> str:
    """Describe where a vehicle stands, by street if the network is known, and from which second on."""
    location = describe_location(at_m, roi)
    if recording.roads is not None:
        location = f"{StreetNames(recording.roads).at(at_m)}, {location}"
    begin_s = ((recording.window.first_ms or 0) + since * recording.window.period_ms) / 1000.0
    return f"at {location}, from {begin_s:g} s on"
