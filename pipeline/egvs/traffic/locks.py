"""See locks of the traffic while SUMO runs, and name where and when they happen.

A lock is a group of vehicles that wait for each other, or for a gap that never comes. A vehicle is locked if it has
not moved for :data:`LOCK_S`, and the road ahead of it is free or it is part of a circle of vehicles. At a signal, it
must also have stood longer than the longest red phase there. A queue behind another vehicle is no lock by itself.

With ``traffic.teleport_s``, SUMO moves a vehicle on that stands first on its lane for so long
(:func:`egvs.traffic.sumo_folder.rescue_s`), and reports it in its log: :func:`read_teleports`,
:func:`teleport_warning`. This changes the record, so a region that needs it too often is locked as well.

:class:`RegionWatch` reads the log and the FCD file while SUMO writes them. A region is locked if

- more than :data:`MAX_TELEPORT_SHARE` of the vehicles so far had to be moved on in it, at least
  :data:`MIN_TELEPORTS`; or
- a vehicle in it is still locked :data:`PATIENCE_S` after SUMO should have moved it on, or, without ``teleport_s``,
  after it became locked; or
- a vehicle in it has stood for twice that time, whatever is ahead.

The decision depends on the content of these files only, not on when they are read: a record that is refused is refused
at the same time again.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from egvs.core.errors import Diagnostic, RunError
from egvs.core.grid import XY, FloatArray, Roi
from egvs.core.wording import format_percent, number_of, shorten_id
from egvs.traffic.network import Network
from egvs.traffic.sumo_folder import RED_MARGIN_S, Timing
from egvs.traffic.vehicle_boxes import VehicleSize

if TYPE_CHECKING:
    import shapely

MAX_TELEPORT_SHARE = 0.05
MIN_TELEPORTS = 10

LOCK_S = 120.0
"""A vehicle that stands longer than this, with free road ahead, is locked."""

PATIENCE_S = 60.0
"""A region is refused so long after a vehicle in it became locked."""

STANDING_LIMIT_S = 300.0
"""Of traffic that was recorded elsewhere: longer than most queues stand."""

STOP_LINE_M = 10.0
"""A vehicle waits at a signal if its front is so near to the end of a lane there."""

SAMPLE_S = 10.0
MOVED_M = 2.0
"""A vehicle stands if it moves less than this between two samples."""

FREE_AHEAD_M, LANE_HALF_WIDTH_M = 10.0, 1.5
"""The road ahead of a vehicle is free if no other vehicle is in this rectangle."""

_TELEPORT = re.compile(r"Teleporting vehicle '(.*?)'; waited too long \((.*?)\), lane='(.*?)', time=(\d+(?:\.\d+)?)")
_DEFAULT_LENGTH_M = 5.0
_MAX_REASONS = 5


class Teleport(NamedTuple):
    """A vehicle that SUMO moved on: its name, SUMO's reason, its lane and the time."""

    vehicle: str
    reason: str
    lane: str
    time_s: float


def read_teleports(log: str, first_s: float) -> list[Teleport]:
    """Return the vehicles that SUMO moved on in the recorded time.

    Parameters
    ----------
    log
        SUMO's log.
    first_s
        Time of the first frame.
    """
    teleports = []
    for vehicle, reason, lane, time in _TELEPORT.findall(log):
        if float(time) >= first_s:
            teleports.append(Teleport(vehicle, reason, lane, float(time)))
    return teleports


class DemandKey(NamedTuple):
    """The key of a scenario that sets how much traffic there is, and how to reduce the traffic."""

    where: str
    hint: str


class StreetNames:
    """Names locations on a network as a user knows them: by junction and street.

    Parameters
    ----------
    roads
        The network.
    """

    def __init__(self, roads: Network) -> None:
        self._edges = [edge for edge in roads.all_edges if edge.function in ("", "internal")]
        self._by_lane = {f"{edge.id}_{i}": edge for edge in self._edges for i in range(len(edge.lanes))}
        self._nodes = {node.id: node for node in roads.junctions}

    def of_lane(self, lane: str) -> str:
        """Return the junction that a lane leads to, and the street, e.g. ``"junction J1, Main Street"``."""
        edge = self._by_lane.get(lane)
        if edge is None:
            return f"lane {lane}"
        node = edge.to_node or edge.id[1:].rpartition("_")[0]  # ":J_3" is in the junction J
        return f"junction {shorten_id(node)}, {edge.name or f'edge {edge.id}'}"

    def end_of_lane(self, lane: str) -> XY | None:
        """Return where a lane ends; None for an unknown lane."""
        edge = self._by_lane.get(lane)
        return None if edge is None else edge.end_m

    def at(self, at_m: XY) -> str:
        """Return the junction and the street at a position."""
        import shapely

        lanes = list(self._by_lane)
        lines = [self._by_lane[lane].lanes[int(lane.rpartition("_")[2])].shape_m[:, :2] for lane in lanes]
        distances = [shapely.Point(at_m).distance(_line(points)) for points in lines]
        return self.of_lane(lanes[int(np.argmin(distances))])


def _line(points: FloatArray) -> shapely.Geometry:
    import shapely

    return shapely.LineString(points) if len(points) > 1 else shapely.Point(points[0])


def teleport_warning(
    teleports: Sequence[Teleport], vehicles: int, limit_s: float, names: StreetNames, roi: Roi, demand: DemandKey
) -> list[Diagnostic]:
    """Warn about vehicles that SUMO moved on, with the junctions, streets and times.

    Parameters
    ----------
    teleports
        From :func:`read_teleports`.
    vehicles
        Number of all vehicles.
    limit_s
        ``traffic.teleport_s``.
    names
        Names junctions and streets.
    roi
        The region of interest.
    demand
        For messages.
    """
    if not teleports:
        return []
    numbers = Counter(names.of_lane(teleport.lane) for teleport in teleports)
    locations = []
    for location, number in numbers.most_common(3):
        there = [teleport for teleport in teleports if names.of_lane(teleport.lane) == location]
        end_m = names.end_of_lane(there[0].lane)
        distance = ""
        if end_m is not None:
            distance = f", x {end_m[0]:.0f} m, y {end_m[1]:.0f} m, {describe_distance(end_m, roi)}"
        period = f"{there[0].time_s:.0f} to {there[-1].time_s:.0f} s" if number > 1 else f"{there[0].time_s:.0f} s"
        locations.append(f"{number} at {location} ({period}{distance})")
    count = len({teleport.vehicle for teleport in teleports})
    share = format_percent(count / max(vehicles, 1))
    problem = (
        f"{count} of {number_of(vehicles, 'vehicle')} ({share}) stood at the head of their lane for {limit_s:g}"
        " s and were moved"
        f" on: {'; '.join(locations)}"
    )
    return [Diagnostic("teleports", demand.where, problem, demand.hint)]


def standing_limit_s(roads: Network | None) -> float:
    """Return how long a vehicle may stand in recorded traffic: two cycles, at least :data:`STANDING_LIMIT_S`."""
    return max(STANDING_LIMIT_S, 0.0 if roads is None else 2.0 * roads.cycle_s)


def are_too_many_teleports(teleports: int, vehicles: int) -> bool:
    """Return whether so many teleports of so many vehicles mean that a region is locked."""
    return teleports >= MIN_TELEPORTS and teleports > MAX_TELEPORT_SHARE * vehicles


def is_inside(at_m: XY, roi: Roi) -> bool:
    """Return whether a position is in the region of interest, seen from above."""
    return all(
        low <= value <= low + size for value, low, size in zip(at_m, roi.origin_m[:2], roi.size_m[:2], strict=True)
    )


def describe_distance(at_m: XY, roi: Roi) -> str:
    """Describe the horizontal distance of a point in the world frame from the region of interest."""
    axes = zip(at_m, roi.origin_m[:2], roi.size_m[:2], strict=True)
    distance_m = math.hypot(*(max(low - x, x - low - size, 0.0) for x, low, size in axes))
    if not distance_m:
        return "in the region of interest"
    return f"{distance_m:.0f} m from the region of interest"


class _Vehicle(NamedTuple):
    """A row of the FCD file: position of the front bumper, angle in degrees clockwise from north, and type."""

    at_m: XY
    angle_deg: float
    vtype: str


@dataclass
class _Standing:
    """Since when, and where, a vehicle stands."""

    since_ms: int
    at_m: XY


class WatchedRegion(NamedTuple):
    """A region of interest, and the area whose vehicles count for it; None for all vehicles."""

    box: Roi
    near: Roi | None = None


class RegionWatch:
    """Watches regions while SUMO writes its files, and raises an error as soon as all of them are locked.

    Parameters
    ----------
    fcd, log
        Files that SUMO writes: FCD as CSV, and its log.
    timing
        Times of the simulation.
    regions
        The regions by name; a single region may have the name "".
    roads
        The network, for signals and for names in messages.
    sizes
        Sizes of the vehicle types.
    demand
        For messages.
    teleport_s
        Time after which SUMO moves a vehicle on, see :func:`egvs.traffic.sumo_folder.rescue_s`; None if it does not.

    Attributes
    ----------
    locked
        Why a region is locked, by name; only locked regions.
    """

    def __init__(
        self, fcd: Path, log: Path, timing: Timing, regions: Mapping[str, WatchedRegion], roads: Network,
        sizes: Mapping[str, VehicleSize], demand: DemandKey, teleport_s: float | None = None,
    ) -> None:  # fmt: skip
        self.locked: dict[str, str] = {}
        self._fcd, self._log = fcd, log
        self._first_ms = timing.first_ms
        self._sample_ms = timing.period_ms * max(1, round(SAMPLE_S * 1000 / timing.period_ms))
        self._regions, self._roads, self._sizes = regions, roads, sizes
        self._lock_s = max(LOCK_S, teleport_s or 0.0)
        self._demand = demand
        self._offset = 0
        self._rest = b""
        self._columns: dict[str, int] = {}
        self._time, self._now_ms = b"", -1
        self._log_bytes = 0
        self._teleports: dict[str, list[Teleport]] = {}
        self._vehicles: dict[str, _Vehicle] = {}
        self._standing: dict[str, _Standing] = {}
        self._names: dict[str, set[str]] = {name: set() for name in regions}

    def update(self) -> None:
        """Read what SUMO wrote since the last call.

        Raises
        ------
        RunError
            When all regions are locked.
        """
        if not self._fcd.is_file():
            return
        with self._fcd.open("rb") as file:
            file.seek(self._offset)
            content = self._rest + file.read()
            self._offset = file.tell()
        *lines, self._rest = content.split(b"\n")
        for line in lines:
            self._add(line)

    def finish(self) -> None:
        """Read the rest, after SUMO has ended."""
        self.update()
        self._check_sample()

    def _add(self, line: bytes) -> None:
        if not self._columns:  # the time is the first column
            header = line.decode("utf-8", "replace").split(";")
            self._columns = {name.rpartition("vehicle_")[2]: i for i, name in enumerate(header)}
            return
        time = line.partition(b";")[0]
        if time != self._time:
            self._check_sample()
            self._time, self._now_ms, self._vehicles = time, round(float(time or b"-1") * 1000), {}
        if (self._now_ms - self._first_ms) % self._sample_ms:
            return
        values = line.decode("utf-8", "replace").split(";")
        if len(values) < len(self._columns) or not values[self._columns["id"]]:
            return
        x_m, y_m, angle_deg = (float(values[self._columns[key]]) for key in ("x", "y", "angle"))
        vehicle = _Vehicle((x_m, y_m), angle_deg, values[self._columns["type"]])
        self._vehicles[values[self._columns["id"]]] = vehicle

    def _check_sample(self) -> None:
        """Check the vehicles of a sample that is complete."""
        if not self._vehicles:
            return
        standing = {}
        for name, vehicle in self._vehicles.items():
            before = self._standing.get(name)
            if before is None or math.dist(before.at_m, vehicle.at_m) >= MOVED_M:
                before = _Standing(self._now_ms, vehicle.at_m)
            standing[name] = before
        self._standing = standing
        self._count_vehicles()
        self._check_teleports()
        self._check_standing()

    def _count_vehicles(self) -> None:
        names = list(self._vehicles)
        positions_m = np.array([vehicle.at_m for vehicle in self._vehicles.values()])
        for region, watched in self._regions.items():
            if watched.near is None:
                self._names[region].update(names)
                continue
            low_m, size_m = np.array(watched.near.origin_m[:2]), np.array(watched.near.size_m[:2])
            inside = np.all((positions_m >= low_m) & (positions_m <= low_m + size_m), axis=1)
            self._names[region].update(names[i] for i in np.flatnonzero(inside))

    def _check_standing(self) -> None:
        for name, standing in self._standing.items():
            duration_s = (self._now_ms - standing.since_ms) / 1000.0
            if duration_s < LOCK_S + PATIENCE_S:
                continue
            at_m = self._vehicles[name].at_m
            regions = [region for region, watched in self._regions.items() if is_inside(at_m, watched.box)]
            if not regions or not self._is_locked_for_good(name, duration_s):
                continue
            problem = (
                f"vehicle {name!r} stood at {self._street_names.at(at_m)} (x {at_m[0]:.0f} m, y {at_m[1]:.0f} m) from"
                f" {standing.since_ms / 1000:.0f} s to {self._now_ms / 1000:.0f} s"
            )
            for region in regions:
                self._add_locked(region, problem)

    def _is_locked_for_good(self, name: str, duration_s: float) -> bool:
        limit_s = max(self._lock_s, self._red_s(self._vehicles[name].at_m)) + PATIENCE_S
        if duration_s < limit_s:
            return False
        return duration_s >= 2 * limit_s or self._waits_for_itself(name)

    def _red_s(self, at_m: XY) -> float:
        """Return how long a vehicle waits at a position for a signal; 0 where there is none."""
        reds_s = [line.red_s for line in self._roads.stop_lines if math.dist(line.at_m, at_m) <= STOP_LINE_M]
        return max(reds_s) + RED_MARGIN_S if reds_s else 0.0

    def _waits_for_itself(self, name: str) -> bool:
        """Return whether the road ahead of a vehicle is free, or the vehicles ahead are a circle that it is part of."""
        passed = set()
        ahead = self._vehicle_ahead(name)
        while ahead is not None and ahead != name:
            is_standing = self._now_ms - self._standing[ahead].since_ms >= LOCK_S * 1000
            if ahead in passed or not is_standing:
                return False
            passed.add(ahead)
            ahead = self._vehicle_ahead(ahead)
        return ahead == name or not passed

    def _check_teleports(self) -> None:
        log_bytes = self._log.stat().st_size if self._log.is_file() else 0
        if log_bytes != self._log_bytes:
            self._log_bytes = log_bytes
            text = self._log.read_text(encoding="utf-8", errors="replace")
            self._teleports = self._teleports_by_region(read_teleports(text, self._first_ms / 1000))
        names = self._street_names
        for region, teleports in self._teleports.items():
            inside = [teleport for teleport in teleports if teleport.time_s * 1000 <= self._now_ms]
            if not are_too_many_teleports(len(inside), len(self._names[region])):
                continue
            locations = Counter(names.of_lane(teleport.lane) for teleport in inside)
            ((location, number),) = locations.most_common(1)
            first = next(teleport for teleport in inside if names.of_lane(teleport.lane) == location)
            end_m = names.end_of_lane(first.lane)
            assert end_m is not None, "teleports at a region are on known lanes"
            problem = (
                f"{len(inside)} of {len(self._names[region])} vehicles had to be moved on by"
                f" {self._now_ms / 1000:.0f} s, {number} of them at {location} (x {end_m[0]:.0f} m, y {end_m[1]:.0f}"
                f" m), the first at {first.time_s:.0f} s"
            )
            self._add_locked(region, problem)

    def _teleports_by_region(self, teleports: Sequence[Teleport]) -> dict[str, list[Teleport]]:
        by_region: dict[str, list[Teleport]] = {}
        for teleport in teleports:
            end_m = self._street_names.end_of_lane(teleport.lane)
            for region, watched in self._regions.items():
                if end_m is not None and is_inside(end_m, watched.box):
                    by_region.setdefault(region, []).append(teleport)
        return by_region

    def _add_locked(self, region: str, problem: str) -> None:
        """Add a locked region; raise a RunError if no other region is left."""
        self.locked.setdefault(region, problem)
        if len(self.locked) < len(self._regions):
            return
        where, hint = self._demand
        if len(self._regions) == 1:
            raise RunError(f"{where}: the traffic in the region of interest is locked: {problem}. {hint}")
        problems = "; ".join(f"{name}: {reason}" for name, reason in list(self.locked.items())[:_MAX_REASONS])
        raise RunError(
            f"{where}: the traffic in all {len(self._regions)} regions of interest is locked: {problems}. {hint}"
        )

    @cached_property
    def _street_names(self) -> StreetNames:
        return StreetNames(self._roads)

    def _vehicle_ahead(self, name: str) -> str | None:
        """Return a vehicle just ahead of a vehicle; None if the road there is free."""
        mine = self._vehicles[name]
        ahead = math.radians(mine.angle_deg)
        nearest_m, nearest = math.inf, None
        for other_name, other in self._vehicles.items():
            if other_name == name or math.dist(mine.at_m, other.at_m) > 50.0:
                continue
            size = self._sizes.get(other.vtype)
            length_m = _DEFAULT_LENGTH_M if size is None else size.length_m
            heading = math.radians(other.angle_deg)
            for back_m in (0.0, length_m / 2, length_m):
                dx = other.at_m[0] - back_m * math.sin(heading) - mine.at_m[0]
                dy = other.at_m[1] - back_m * math.cos(heading) - mine.at_m[1]
                along_m = dx * math.sin(ahead) + dy * math.cos(ahead)
                across_m = dx * math.cos(ahead) - dy * math.sin(ahead)
                if 0.0 < along_m <= min(FREE_AHEAD_M, nearest_m) and abs(across_m) <= LANE_HALF_WIDTH_M:
                    nearest_m, nearest = along_m, other_name
        return nearest
