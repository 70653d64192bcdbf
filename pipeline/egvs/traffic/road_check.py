"""Compare recorded vehicles with the roads: FCD files and tracks alike.

Wrong coordinates, another convention of angles, a mirrored map or shared names give a complete result that is wrong.
Five things are counted, of motor vehicles in and around the region of interest:

- *off their lanes*: positions of moving vehicles more than :data:`BESIDE_M` beside every lane that leads their way, to
  :data:`SAME_WAY_DEG`. Beyond the region of interest, only positions within the bounds of all lanes count: a network
  may end there. In a network without lanes inside junctions, a junction is a lane in all directions;
- *against the lanes*: positions on lanes that all lead the other way, outside of junctions;
- *headings*: headings that are more than :data:`ACROSS_DEG` off the motion;
- *jumps over junctions*: steps from one side of a junction to the other, in a file without positions inside
  junctions; SUMO writes such files from networks without internal links;
- *shared names*: rows of one vehicle at one time in two places, and steps that no vehicle can make.

A vehicle moves if it is at least :data:`MIN_MOTION_M` away after :data:`BASE_S`, and faster than :data:`MOVING_M_S`.
Real traffic has some of each: drivers overtake, turn round, cross car parks, and roads are missing in maps. So a small
share is nothing, a larger one is a warning, and one that no traffic has is an error.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa

from egvs.core.errors import Diagnostic
from egvs.core.grid import BoolArray, FloatArray, IntArray, Roi
from egvs.core.wording import format_percent, number_of
from egvs.traffic import lane_alignment
from egvs.traffic.lane_alignment import Alignment
from egvs.traffic.network import Network
from egvs.traffic.reference_points import ReferencePoints
from egvs.traffic.road_lanes import RoadLanes
from egvs.traffic.shared_names import MAX_SPEED_M_S, MIN_JUMP_M, SharedNames

AROUND_M = 50.0
"""Vehicles farther from the region of interest than this do not count."""

BASE_S, MIN_MOTION_M, MOVING_M_S = 0.5, 1.0, 1.5
"""Over this time, and at least this distance, motion is measured; slower vehicles do not count."""

MAX_BASE_S = 5.0
"""Over longer times, a vehicle may have turned several times."""

MAX_TURN_DEG = 30.0
"""Where a heading changes by more, the motion in between says little about it."""

BESIDE_M = 1.0
"""A front that is no more than this beside a lane is on it: drivers keep to a side, and maps are inexact."""

SAME_WAY_DEG = 45.0
"""A lane leads the way of a vehicle if its direction is no farther off the motion than this."""

AGAINST_DEG = 120.0
"""A lane leads the other way if its direction is farther off the motion than this."""

ACROSS_DEG = 45.0
"""A heading that is farther off the motion than this is wrong."""

WARN_SHARE = 0.1
"""Share of positions against the lanes, or of headings off the motion, that gets a warning."""

WARN_OFF_SHARE = 0.2
"""Share of positions off their lanes that gets a warning."""

ERROR_SHARE = 0.4
"""Share of positions off their lanes and against lanes together that is an error. In a recording of a real junction it
is 7 %; moved by 7 m across its main road 49 %, mirrored 63 to 75 %."""

ERROR_SHIFTED_SHARE = 0.25
"""The same share, where a shift brings at least this share of the positions more onto lanes."""

ERROR_AGAINST_SHARE = 0.25
"""Share of positions against the lanes that is an error."""

ERROR_HEADING_SHARE = 0.25
"""Share of headings off the motion that is an error."""

WARN_HEADING_DEG, ERROR_HEADING_DEG = 10.0, 20.0
"""Median of the headings off the motion that gets a warning, and that is an error: all are turned by some angle."""

MAX_SPEED_RATIO = 1.5
"""Median of stated speeds over the speed of the motion, or of its inverse, that gets a warning: km/h are 3.6."""

MAX_LIMIT_RATIO, MIN_FAST_M_S, MIN_FAST_POSITIONS = 2.0, 12.0, 5
"""Median speed over the speed limit, and median speed, of vehicles that are faster than any traffic, at this number of
positions: a wrong clock."""

STRETCH_M, MIN_TOP_M_S, MIN_WAY_M, MIN_WAYS_M = 3.0, 2.5, 30.0, 100.0
"""If nine of ten vehicles are slower than this on each stretch of their way, times are no seconds. Ways of at least
this length count, if they are this long together."""

MIN_JUMP_OVER_M, MAX_INSIDE_SHARE = 5.0, 0.1
"""Vehicles jump over a junction if this much of a step is inside it. In complete files, moving vehicles are inside
junctions in more rows than this share of such steps."""

MIN_POSITIONS = 20
"""Shares of fewer positions are only warnings."""

_MAX_POSITIONS = 4000
"""Positions of each table that are compared with lanes."""

_MAX_STEPS, _SAMPLES = 20_000, 10
"""Steps of each table that are compared with junctions, and points on each of them."""


@dataclass
class RoadCheck:
    """Counts vehicles that do not fit the roads, table by table.

    Attributes
    ----------
    roads
        The network; None without one, then only headings and names are checked.
    region
        The region of interest.
    motor_types
        Vehicle types of motor vehicles; others do not count.
    positions, off_lanes, against
        Positions of moving vehicles, those off their lanes, and of the others those against the lanes.
    beside_m
        Distance of those off their lanes from the nearest lane that leads their way, at most :data:`AROUND_M`, of each
        table.
    headings, across
        Headings of moving vehicles, and those off their motion.
    off_motion_deg
        By how much each heading is off its motion, 0 to 180, of each table.
    speed_ratios
        Stated speed over the speed of the motion, of each table; without speeds of 0, which programs write for unknown.
    limit_ratios, speeds_m_s
        Speed over the limit of the lane, and speed, of positions on lanes, of each table.
    top_speeds_m_s, ways_m
        Speed on the fastest stretch of the way of each vehicle, and the length of the way, of each table.
    inside_junctions, jumps_over_junctions
        Moving vehicles inside junctions, and steps over junctions.
    names
        Signs of shared names.
    lengths_m
        Length of the vehicles of each type, where it is known.
    reference
        Which point of a vehicle the positions are those of.
    """

    roads: Network | None
    region: Roi
    motor_types: frozenset[str]
    positions: int = 0
    off_lanes: int = 0
    against: int = 0
    beside_m: list[FloatArray] = field(default_factory=list)
    headings: int = 0
    across: int = 0
    off_motion_deg: list[FloatArray] = field(default_factory=list)
    speed_ratios: list[FloatArray] = field(default_factory=list)
    limit_ratios: list[FloatArray] = field(default_factory=list)
    speeds_m_s: list[FloatArray] = field(default_factory=list)
    top_speeds_m_s: list[FloatArray] = field(default_factory=list)
    ways_m: list[FloatArray] = field(default_factory=list)
    inside_junctions: int = 0
    jumps_over_junctions: int = 0
    names: SharedNames = field(default_factory=SharedNames)
    lengths_m: Mapping[str, float] = field(default_factory=dict)
    reference: ReferencePoints = field(default_factory=ReferencePoints)

    def __post_init__(self) -> None:
        self._lanes = None if self.roads is None else RoadLanes(self.roads)
        edges = () if self.roads is None else self.roads.all_edges
        self._has_junction_lanes = any(edge.function == "internal" for edge in edges)
        self._positions_m: list[FloatArray] = []

    def add(self, table: pa.Table) -> None:
        """Count the rows of a table of :data:`egvs.traffic.fcd.FCD_SCHEMA`."""
        import pyarrow.compute as pc

        names = table["id"].combine_chunks().dictionary_encode()
        is_motor = pc.is_in(table["type"], pa.array(sorted(self.motor_types), pa.string())).to_numpy()
        vehicle, time_ms = names.indices.to_numpy().astype(np.int64), table["time_ms"].to_numpy()
        xy_m = np.column_stack([table["x"].to_numpy(), table["y"].to_numpy()])
        order = np.lexsort((time_ms, vehicle))
        vehicle, time_ms, xy_m = vehicle[order], time_ms[order], xy_m[order]
        yaw_rad, is_motor = np.deg2rad(90.0 - table["angle"].to_numpy()[order]), is_motor[order]
        self._count_shared(names.dictionary, vehicle, time_ms, xy_m)
        types = table["type"].combine_chunks().dictionary_encode()
        type_lengths_m = [self.lengths_m.get(name, np.nan) for name in types.dictionary.to_pylist()]
        length_m = np.where(is_motor, np.array(type_lengths_m)[types.indices.to_numpy()[order]], np.nan)
        self.reference.add(names.dictionary.to_pylist(), vehicle, time_ms, xy_m, yaw_rad, length_m)

        near = is_motor & self._is_around(xy_m, AROUND_M)
        self._add_top_speeds(vehicle[near], time_ms[near] / 1000.0, xy_m[near])
        self._count_jumps_over_junctions(vehicle[near], xy_m[near])

        first, second, motion_m = _motions(vehicle, time_ms, xy_m)
        counts = is_motor[first] & self._is_around(xy_m[first], AROUND_M)
        first, second, motion_m = first[counts], second[counts], motion_m[counts]
        motion_rad = np.arctan2(motion_m[:, 1], motion_m[:, 0])
        self._count_headings(yaw_rad[first], yaw_rad[second], motion_rad)
        speed_m_s = table["speed"].to_numpy()[order]
        moved_m_s = np.hypot(*motion_m.T) / ((time_ms[second] - time_ms[first]) / 1000.0)
        ratio = (speed_m_s[first] + speed_m_s[second]) / 2.0 / moved_m_s
        self.speed_ratios.append(ratio[ratio > 0.0])  # others have no speed
        if self._lanes is not None and len(self._lanes):
            covered = self._is_around(xy_m[first], 0.0) | _is_inside(xy_m[first], *self._lanes.bounds_m)
            first, motion_rad, moved_m_s = first[covered], motion_rad[covered], moved_m_s[covered]
            if len(first) > _MAX_POSITIONS:
                chosen = np.sort(np.random.default_rng(0).choice(len(first), _MAX_POSITIONS, replace=False))
                first, motion_rad, moved_m_s = first[chosen], motion_rad[chosen], moved_m_s[chosen]
            self._count_positions(self._lanes, xy_m[first], motion_rad, moved_m_s)

    def _is_around(self, xy_m: FloatArray, margin_m: float) -> BoolArray:
        low_m = np.array(self.region.origin_m[:2])
        return _is_inside(xy_m, low_m - margin_m, low_m + self.region.size_m[:2] + margin_m)

    def _count_shared(self, names: pa.Array, vehicle: IntArray, time_ms: IntArray, xy_m: FloatArray) -> None:
        same = np.diff(vehicle) == 0
        step_ms = np.diff(time_ms)
        distance_m = np.hypot(*np.diff(xy_m, axis=0).T)
        repeated = np.flatnonzero(same & (step_ms == 0) & (distance_m > MIN_JUMP_M))
        jumps = same & (step_ms > 0) & (distance_m > MIN_JUMP_M) & (distance_m > MAX_SPEED_M_S * step_ms / 1000.0)
        self.names.rows += len(vehicle)
        self.names.repeated += len(repeated)
        self.names.jumps += int(jumps.sum())
        if len(repeated) and not self.names.example:
            row = repeated[0]
            self.names.example = f"{names[int(vehicle[row])].as_py()!r} at {time_ms[row] / 1000.0:g} s"

    def _count_headings(self, first_rad: FloatArray, second_rad: FloatArray, motion_rad: FloatArray) -> None:
        turn_rad = _wrap(second_rad - first_rad)
        is_steady = np.abs(turn_rad) <= np.deg2rad(MAX_TURN_DEG)
        off_rad = _wrap(first_rad + turn_rad / 2.0 - motion_rad)[is_steady]
        off_deg = np.rad2deg(np.abs(off_rad))
        self.headings += len(off_deg)
        self.across += int((off_deg > ACROSS_DEG).sum())
        self.off_motion_deg.append(off_deg)

    def _count_jumps_over_junctions(self, vehicle: IntArray, xy_m: FloatArray) -> None:
        """Count steps from one side of a junction to the other; rows are by vehicle, then time."""
        if self._lanes is None:
            return
        step_m = np.diff(xy_m, axis=0)
        length_m = np.hypot(*step_m.T)
        start = np.flatnonzero((np.diff(vehicle) == 0) & (length_m > 0.0))[:_MAX_STEPS]
        self.inside_junctions += int(self._lanes.in_junctions(xy_m[start]).sum())
        start = start[(length_m[start] >= MIN_JUMP_OVER_M) & (length_m[start] <= AROUND_M)]
        between = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
        points_m = xy_m[start, None] + between[:, None] * step_m[start, None]
        inside = self._lanes.in_junctions(points_m.reshape(-1, 2)).reshape(-1, _SAMPLES)
        self.jumps_over_junctions += int((inside.mean(axis=1) * length_m[start] >= MIN_JUMP_OVER_M).sum())

    def _add_top_speeds(self, vehicle: IntArray, time_s: FloatArray, xy_m: FloatArray) -> None:
        """Measure how fast each vehicle is on its fastest stretch; rows are by vehicle, then time."""
        if len(vehicle) < 2:
            return
        same = np.diff(vehicle) == 0
        way_m = np.append(0.0, np.cumsum(np.where(same, np.hypot(*np.diff(xy_m, axis=0).T), 0.0)))
        marks_m = np.arange(0.0, way_m[-1], STRETCH_M)
        row = np.searchsorted(way_m, marks_m, side="right") - 1
        passed_s = time_s[row] + (marks_m - way_m[row]) / np.maximum(way_m[row + 1] - way_m[row], 1e-9) * (
            time_s[row + 1] - time_s[row]
        )
        stretch_s = np.diff(passed_s)
        counts = (np.diff(vehicle[row]) == 0) & (stretch_s > 0.0)
        top_m_s = np.zeros(int(vehicle.max()) + 1)
        np.maximum.at(top_m_s, vehicle[row[1:]][counts], STRETCH_M / stretch_s[counts])
        stretches = np.bincount(vehicle[row[1:]][counts], minlength=len(top_m_s))
        is_long = STRETCH_M * stretches >= MIN_WAY_M
        self.top_speeds_m_s.append(top_m_s[is_long])
        self.ways_m.append(STRETCH_M * stretches[is_long].astype(np.float64))

    def _count_positions(
        self, lanes: RoadLanes, xy_m: FloatArray, motion_rad: FloatArray, speed_m_s: FloatArray
    ) -> None:
        in_junction = lanes.in_junctions(xy_m)
        near = lanes.near(xy_m, BESIDE_M)
        off_rad = np.abs(_wrap(motion_rad[near.row] - near.yaw_rad))
        on_lane = _mark(near.row, len(xy_m))
        same_way = off_rad <= np.deg2rad(SAME_WAY_DEG)
        leads_on = _mark(near.row[same_way], len(xy_m))
        limit_m_s = np.zeros(len(xy_m))
        np.maximum.at(limit_m_s, near.row[same_way], lanes.limits_m_s[near.lane[same_way]])
        has_limit = limit_m_s > 0.0
        self.limit_ratios.append(speed_m_s[has_limit] / limit_m_s[has_limit])
        self.speeds_m_s.append(speed_m_s[has_limit])
        leads_elsewhere = _mark(near.row[off_rad <= np.deg2rad(AGAINST_DEG)], len(xy_m))
        against = on_lane & ~leads_elsewhere & ~in_junction
        off_lanes = ~leads_on & ~against
        if not self._has_junction_lanes:
            off_lanes &= ~in_junction
        self.positions += len(xy_m)
        self.off_lanes += int(off_lanes.sum())
        self.against += int(against.sum())
        self.beside_m.append(_distances_m(lanes, xy_m[off_lanes], motion_rad[off_lanes]))
        self._positions_m.append(xy_m if self._has_junction_lanes else xy_m[~in_junction])

    def alignment(self) -> Alignment | None:
        """Compare the positions with the lanes, and find a shift that fits better; None without positions or lanes."""
        if self.roads is None or not self._positions_m:
            return None
        return lane_alignment.align(np.concatenate(self._positions_m), self.roads)

    def findings(self, where: str) -> Iterator[Diagnostic]:
        """Yield errors and warnings.

        Parameters
        ----------
        where
            Key of the file, for messages.
        """
        jumps = list(self._junction_findings(where))
        yield from jumps
        if not jumps or self.names.repeated:
            yield from self.names.findings(where)
        headings = list(self._heading_findings(where))
        yield from headings
        if not any(finding.is_error for finding in headings):
            yield from self.reference.findings(where)
        yield from self._speed_findings(where)
        yield from self._clock_findings(where)
        yield from self._position_findings(where)

    def _junction_findings(self, where: str) -> Iterator[Diagnostic]:
        jumps = self.jumps_over_junctions
        if jumps < MIN_POSITIONS or self.inside_junctions > MAX_INSIDE_SHARE * jumps:
            return
        problem = (
            f"vehicles jump over junctions in {number_of(jumps, 'step')}, and are inside them in"
            f" {number_of(self.inside_junctions, 'row')}: the network that SUMO used had no internal links"
        )
        hint = "Simulate again with a network that has them: run netconvert with --no-internal-links false."
        yield Diagnostic("jumps over junctions", where, problem, hint)

    def _heading_findings(self, where: str) -> Iterator[Diagnostic]:
        if not self.headings:
            return
        median_deg = float(np.median(np.concatenate(self.off_motion_deg)))
        if self.across <= WARN_SHARE * self.headings and median_deg <= WARN_HEADING_DEG:
            return
        problem = (
            f"{format_percent(self.across / self.headings, 0)} of {number_of(self.headings, 'heading')} of moving"
            f" vehicles are more than {ACROSS_DEG:g} degrees off their motion (median of all {median_deg:.0f} degrees)"
        )
        hint = "Check the angles: FCD has degrees clockwise from north, tracks counter-clockwise from x."
        is_error = self._is_error(self.across, self.headings, ERROR_HEADING_SHARE)
        is_error |= self.headings >= MIN_POSITIONS and median_deg > ERROR_HEADING_DEG
        yield Diagnostic("headings", where, problem, hint, is_error)

    def _speed_findings(self, where: str) -> Iterator[Diagnostic]:
        ratios = np.concatenate([np.empty(0), *self.speed_ratios])
        if len(ratios) < MIN_POSITIONS:
            return
        median = float(np.median(ratios))
        if 1.0 / MAX_SPEED_RATIO <= median <= MAX_SPEED_RATIO:
            return
        problem = (
            f"expected speeds in m/s, got {median:.2g} times the speed of the motion (median of"
            f" {number_of(len(ratios), 'speed')})"
        )
        yield Diagnostic("speeds", where, problem, "Convert the speeds to m/s, or check the times.")

    def _clock_findings(self, where: str) -> Iterator[Diagnostic]:
        """Warn about motion that is too fast or too slow for traffic."""
        hint = "Check the times: frames and milliseconds are no seconds."
        speeds = np.concatenate([np.empty(0), *self.speeds_m_s])
        if len(speeds) >= MIN_FAST_POSITIONS:
            ratio, speed_m_s = float(np.median(np.concatenate(self.limit_ratios))), float(np.median(speeds))
            if ratio > MAX_LIMIT_RATIO and speed_m_s > MIN_FAST_M_S:
                problem = (
                    f"vehicles move at {speed_m_s:.0f} m/s, {ratio:.1f} times the speed limit (medians of"
                    f" {number_of(len(speeds), 'position')} on lanes)"
                )
                yield Diagnostic("clock", where, problem, hint)
        tops = np.concatenate([np.empty(0), *self.top_speeds_m_s])
        if sum(float(ways.sum()) for ways in self.ways_m) < MIN_WAYS_M:
            return
        top_m_s = float(np.quantile(tops, 0.9))
        if top_m_s < MIN_TOP_M_S:
            problem = (
                f"expected vehicles that drive, got {top_m_s:.2g} m/s as the highest speed of nine of ten (of"
                f" {number_of(len(tops), 'vehicle')} that move on)"
            )
            yield Diagnostic("clock", where, problem, hint)

    def _position_findings(self, where: str) -> Iterator[Diagnostic]:
        alignment = self.alignment()
        if alignment is None:
            return
        misplaced = self.off_lanes + self.against
        is_shifted = alignment.fitted_share - alignment.share >= ERROR_SHIFTED_SHARE
        share = ERROR_SHIFTED_SHARE if is_shifted else ERROR_SHARE
        hint = "Check the coordinate system, and whether vehicles and network show the same place."
        if self.off_lanes > WARN_OFF_SHARE * self.positions:
            is_error = self._is_error(misplaced, self.positions, share)
            distance_m = np.median(np.concatenate(self.beside_m))
            problem = (
                f"{format_percent(self.off_lanes / self.positions, 0)} of {number_of(self.positions, 'position')} of"
                f" moving vehicles are more than {BESIDE_M:g} m beside every lane that leads their way (median"
                f" {distance_m:.1f} m)"
            )
            problem += f"; {alignment.describe()}"
            yield Diagnostic("vehicles off their lanes", where, problem, hint, is_error)
        else:
            yield from alignment.warnings(where)
        if self.against > WARN_SHARE * self.positions:
            problem = (
                f"{format_percent(self.against / self.positions, 0)} of {number_of(self.positions, 'position')} of"
                " moving vehicles are on lanes that lead the other way"
            )
            hint = "Check that the map is not mirrored, the side of driving, and the order of times."
            is_error = self._is_error(self.against, self.positions, ERROR_AGAINST_SHARE)
            yield Diagnostic("vehicles against lanes", where, problem, hint, is_error)

    @staticmethod
    def _is_error(number: int, of: int, share: float) -> bool:
        return of >= MIN_POSITIONS and number > share * of


def check_tables(
    tables: Iterable[pa.Table],
    roads: Network | None,
    region: Roi,
    motor_types: frozenset[str],
    names: SharedNames | None = None,
    lengths_m: Mapping[str, float] | None = None,
    *,
    are_centres: bool = False,
) -> RoadCheck:
    """Count the vehicles of some tables that do not fit the roads.

    Parameters
    ----------
    tables
        Rows of :data:`egvs.traffic.fcd.FCD_SCHEMA`, in order of time.
    roads
        The network; None without one.
    region
        The region of interest.
    motor_types
        Vehicle types of motor vehicles.
    names
        Signs of shared names, where they were found before and the tables have no such rows any more.
    lengths_m
        Length of the vehicles of each type, where it is known.
    are_centres
        Whether the file, of which the tables are made, states centres of vehicles.
    """
    reference = ReferencePoints(are_centres)
    check = RoadCheck(roads, region, motor_types, lengths_m=lengths_m or {}, reference=reference)
    for table in tables:
        if table.num_rows:
            check.add(table)
    if names is not None:
        check.names = names
    return check


def _motions(vehicle: IntArray, time_ms: IntArray, xy_m: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return pairs of rows between which a vehicle moves, and its motion (n, 2); rows are by vehicle, then time."""
    steps_ms = np.diff(time_ms)[np.diff(vehicle) == 0]
    steps_ms = steps_ms[steps_ms > 0]
    if not len(steps_ms):
        none = np.empty(0, dtype=np.int64)
        return none, none, np.empty((0, 2))
    lag = max(1, int(np.ceil(BASE_S * 1000.0 / np.median(steps_ms))))
    first = np.arange(len(vehicle) - lag)
    second = first + lag
    motion_m = xy_m[second] - xy_m[first]
    duration_s = (time_ms[second] - time_ms[first]) / 1000.0
    distance_m = np.hypot(*motion_m.T)
    same_vehicle: BoolArray = vehicle[second] == vehicle[first]
    moves = same_vehicle & (duration_s > 0.0) & (duration_s <= MAX_BASE_S)
    moves &= (distance_m >= MIN_MOTION_M) & (distance_m > MOVING_M_S * duration_s)
    moves &= distance_m <= np.maximum(MAX_SPEED_M_S * duration_s, MIN_JUMP_M)
    return first[moves], second[moves], motion_m[moves]


def _is_inside(xy_m: FloatArray, low_m: FloatArray, high_m: FloatArray) -> BoolArray:
    """Return whether positions (n, 2) are in a rectangle, (n,)."""
    inside: BoolArray = np.all((xy_m >= low_m) & (xy_m <= high_m), axis=1)
    return inside


def _mark(rows: IntArray, count: int) -> BoolArray:
    """Return which of ``count`` rows are among ``rows``."""
    marked = np.zeros(count, dtype=np.bool_)
    marked[rows] = True
    return marked


def _distances_m(lanes: RoadLanes, xy_m: FloatArray, motion_rad: FloatArray) -> FloatArray:
    """Return the distance of positions (n, 2) from the nearest lane that leads their way, at most :data:`AROUND_M`."""
    distance_m = np.full(len(xy_m), AROUND_M)
    near = lanes.near(xy_m, AROUND_M)
    same_way = np.abs(_wrap(motion_rad[near.row] - near.yaw_rad)) <= np.deg2rad(SAME_WAY_DEG)
    np.minimum.at(distance_m, near.row[same_way], near.distance_m[same_way])
    return distance_m


def _wrap(angle_rad: FloatArray) -> FloatArray:
    """Return angles from -pi to pi."""
    return np.mod(angle_rad + np.pi, 2.0 * np.pi) - np.pi
