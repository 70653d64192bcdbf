"""Find the junctions of a city that cannot be ranked, so that all others are.

Where the program draws the demand itself, regions are watched while SUMO runs
(:class:`egvs.traffic.locks.RegionWatch`), and :attr:`egvs.traffic.recording.Recording.locked` names the locked ones. In
all other recordings, the traffic in the region of interest of a junction is locked if

- a vehicle in it stands for :func:`egvs.traffic.locks.standing_limit_s`; or
- too many of the vehicles near it had to be moved on in it (:func:`egvs.traffic.locks.are_too_many_teleports`).

A region with less than :data:`MIN_VEHICLES` at a time is too empty for a ranking by detected vehicles, which examines
250 frames by default. A vehicle that stands elsewhere in the city changes nothing. World frame, metres.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from egvs.core.grid import Roi
from egvs.scenario.model import Scenario
from egvs.scoring.target_scores import TARGET_SCORES
from egvs.traffic import locks
from egvs.traffic.locks import StreetNames, Teleport, is_inside
from egvs.traffic.recording import Recording
from egvs.traffic.trajectories import TrafficStatistics, centres_in_region
from egvs.traffic.vehicle_boxes import VehicleBoxes

MIN_VEHICLES = 0.02
"""Of 250 frames, five contain a vehicle then, on average."""


@dataclass
class RegionChecks:
    """Collects locked regions, and counts the vehicles in each region, while a recording is read.

    Attributes
    ----------
    regions
        Region of interest of each junction, by name.
    recording
        The recording.
    locked
        Why the traffic of a region is locked, by name; only locked regions.
    vehicles
        Vehicles in each region, summed over the frames, by name.
    """

    regions: Mapping[str, Roi]
    recording: Recording
    locked: dict[str, str] = field(default_factory=dict)
    vehicles: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        for name, reason in (self.recording.locked or {}).items():
            self.locked[name] = f"its traffic is locked: {reason}"

    def add_frames(self, boxes: VehicleBoxes, statistics: TrafficStatistics) -> None:
        """Check a group of frames.

        Parameters
        ----------
        boxes
            Boxes of these frames.
        statistics
            Statistics of the frames so far, including these.
        """
        counted = boxes if boxes.uncounted is None else boxes.select(~boxes.uncounted)
        for name, region in self.regions.items():
            self.vehicles[name] += int(np.count_nonzero(centres_in_region(counted, region)))
        if self.recording.locked is None:
            self._check_standing(statistics, boxes.first_frame + boxes.frames)

    def _check_standing(self, statistics: TrafficStatistics, end_frame: int) -> None:
        period_s = self.recording.window.period_ms / 1000.0
        limit_s = locks.standing_limit_s(self.recording.roads)
        for vehicle, since in statistics.standing_since.items():
            duration_s = (end_frame - 1 - since) * period_s
            if duration_s < limit_s or vehicle in self.recording.stopped_on_purpose:
                continue
            at_m = statistics.standing_at_m[vehicle]
            for name, region in self.regions.items():
                if name in self.locked or not is_inside(at_m, region):
                    continue
                begin_s = (self.recording.window.first_ms or 0) / 1000.0 + since * period_s
                place = f"x {at_m[0]:.0f} m, y {at_m[1]:.0f} m"
                if self.recording.roads is not None:
                    place = f"{StreetNames(self.recording.roads).at(at_m)} ({place})"
                self.locked[name] = (
                    f"its traffic is locked: vehicle {vehicle!r} stood at {place} for {duration_s:g} s, from"
                    f" {begin_s:g} s on"
                )

    def check_teleports(self, vehicles: Mapping[str, int]) -> None:
        """Check the vehicles that SUMO moved on.

        Parameters
        ----------
        vehicles
            Number of different vehicles near each junction.
        """
        if self.recording.locked is not None or not self.recording.teleports() or self.recording.roads is None:
            return
        names = StreetNames(self.recording.roads)
        for name, region in self.regions.items():
            inside = [teleport for teleport in self.recording.teleports() if _is_in_region(teleport, names, region)]
            if not locks.are_too_many_teleports(len(inside), vehicles[name]):
                continue
            ((place, number),) = Counter(names.of_lane(teleport.lane) for teleport in inside).most_common(1)
            reason = (
                f"its traffic is locked: {len(inside)} of {vehicles[name]} vehicles had to be moved on, {number} of"
                f" them at {place}"
            )
            self.locked.setdefault(name, reason)


def _is_in_region(teleport: Teleport, names: StreetNames, region: Roi) -> bool:
    end_m = names.end_of_lane(teleport.lane)
    return end_m is not None and is_inside(end_m, region)


def empty_regions(mean_vehicles: Mapping[str, float], scenarios: Mapping[str, Scenario]) -> dict[str, str]:
    """Return why regions are too empty for the score that ranks their sites, by name; only those.

    Parameters
    ----------
    mean_vehicles
        Vehicles in each region at a time, over all periods.
    scenarios
        Scenario of each junction.
    """
    reasons = {}
    for name, mean in mean_vehicles.items():
        if mean < MIN_VEHICLES and scenarios[name].score.rank_by in TARGET_SCORES:
            reasons[name] = (
                f"only {mean:.3g} vehicles are in its region of interest at a time (at least {MIN_VEHICLES:g})"
            )
    return reasons
