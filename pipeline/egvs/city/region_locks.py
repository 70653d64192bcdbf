"""Find the junctions of a city whose traffic locks, so that they are left out and all others are ranked.

The traffic in the region of interest of a junction is locked if

- a vehicle in it stands for two signal cycles, at least :data:`egvs.traffic.locks.STANDING_LIMIT_S`; or
- more than :data:`egvs.traffic.locks.MAX_TELEPORT_SHARE` of the vehicles near it had to be moved on in it, at least
  :data:`egvs.traffic.locks.MIN_TELEPORTS`.

A vehicle that stands elsewhere in the city changes nothing. World frame, metres.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from egvs.core.grid import Roi
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


@dataclass
class RegionLocks:
    """Collects locked regions while a recording is read.

    Attributes
    ----------
    regions
        Region of interest of each junction, by name.
    recording
        The recording.
    found
        Why a junction is locked, by name.
    """

    regions: Mapping[str, Roi]
    recording: Recording
    found: dict[str, str] = field(default_factory=dict)

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
                        f"vehicle {vehicle!r} stood at {place} for {duration_s:g} s, from {begin_s:g} s on"
                    )

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
                f"{len(inside)} of {vehicles[name]} vehicles had to be moved on, {number} of them at {place}",
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
