"""Find the junctions of a city that must be left out, so that all others are ranked.

The traffic in the region of interest of a junction is locked if

- a vehicle in it stands for two signal cycles, at least :data:`egvs.traffic.locks.STANDING_LIMIT_S`; or
- more than :data:`egvs.traffic.locks.MAX_TELEPORT_SHARE` of the vehicles near it had to be moved on in it, at least
  :data:`egvs.traffic.locks.MIN_TELEPORTS`.

A region with less than :data:`MIN_VEHICLES` at a time is too empty for a ranking by detected vehicles, which examines
250 frames by default. A vehicle that stands elsewhere in the city changes nothing. World frame, metres.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from egvs.core.grid import FloatArray, Roi
from egvs.traffic.locks import (
    MAX_TELEPORT_SHARE,
    MIN_TELEPORTS,
    STANDING_LIMIT_S,
    StreetNames,
    Teleport,
    is_inside,
)  # fmt: skip
from egvs.traffic.recording import Recording
from egvs.traffic.trajectories import TrafficStatistics

MIN_VEHICLES = 0.02
"""Of 250 frames, five contain a vehicle then, on average."""


@dataclass
class RegionLocks:
    """Collects regions that are locked or empty while a recording is read.

    Attributes
    ----------
    regions
        Region of interest of each junction, by name.
    recording
        The recording.
    found
        Why a junction is left out, by name.
    rows
        Vehicles in each region, summed over the frames, by name.
    """

    regions: Mapping[str, Roi]
    recording: Recording
    found: dict[str, str] = field(default_factory=dict)
    rows: Counter[str] = field(default_factory=Counter)

    def add(self, statistics: TrafficStatistics, end_frame: int) -> None:
        """Check the vehicles that stand at the end of a group of frames.

        Parameters
        ----------
        statistics
            Statistics of the frames so far.
        end_frame
            The first frame after them.
        """
        for vehicle, since in statistics.standing_since.items():
            duration_s = (end_frame - 1 - since) * self._period_s
            if duration_s < self._limit_s or vehicle in self.recording.stopped_on_purpose:
                continue
            at_m = statistics.standing_at_m[vehicle]
            for name, region in self.regions.items():
                if name not in self.found and is_inside(at_m, region):
                    begin_s = (self.recording.window.first_ms or 0) / 1000.0 + since * self._period_s
                    place = f"x {at_m[0]:.0f} m, y {at_m[1]:.0f} m"
                    if self.recording.roads is not None:
                        place = f"{StreetNames(self.recording.roads).at(at_m)} ({place})"
                    self.found[name] = (
                        f"its traffic is locked: vehicle {vehicle!r} stood at {place} for {duration_s:g} s, from"
                        f" {begin_s:g} s on"
                    )

    def add_boxes(self, x_m: FloatArray, y_m: FloatArray) -> None:
        """Count the vehicles whose centres (n,) are in each region."""
        for name, region in self.regions.items():
            (low_x_m, low_y_m), (width_m, depth_m) = region.origin_m[:2], region.size_m[:2]
            inside = (x_m >= low_x_m) & (x_m <= low_x_m + width_m) & (y_m >= low_y_m) & (y_m <= low_y_m + depth_m)
            self.rows[name] += int(np.count_nonzero(inside))

    def add_empty(self, names: Iterable[str], frames: int) -> None:
        """Check whether enough vehicles were in some regions, of which these are the names."""
        for name in names:
            mean = self.rows[name] / frames
            if mean < MIN_VEHICLES:
                reason = f"only {mean:.3g} vehicles are in its region of interest at a time (at least {MIN_VEHICLES:g})"
                self.found.setdefault(name, reason)

    def add_teleports(self, vehicles: Mapping[str, int]) -> None:
        """Check the vehicles that SUMO moved on.

        Parameters
        ----------
        vehicles
            Number of different vehicles near each junction.
        """
        if not self.recording.teleports or self.recording.roads is None:
            return
        names = StreetNames(self.recording.roads)
        for name, region in self.regions.items():
            inside = [teleport for teleport in self.recording.teleports if _is_in_region(teleport, names, region)]
            if len(inside) < MIN_TELEPORTS or len(inside) <= MAX_TELEPORT_SHARE * vehicles[name]:
                continue
            ((place, number),) = Counter(names.of_lane(teleport.lane) for teleport in inside).most_common(1)
            self.found.setdefault(
                name,
                f"its traffic is locked: {len(inside)} of {vehicles[name]} vehicles had to be moved on, {number} of"
                f" them at {place}",
            )

    @property
    def _period_s(self) -> float:
        return self.recording.window.period_ms / 1000.0

    @property
    def _limit_s(self) -> float:
        roads = self.recording.roads
        return max(STANDING_LIMIT_S, 0.0 if roads is None else 2.0 * roads.cycle_s)


def _is_in_region(teleport: Teleport, names: StreetNames, region: Roi) -> bool:
    end_m = names.end_of_lane(teleport.lane)
    return end_m is not None and is_inside(end_m, region)
