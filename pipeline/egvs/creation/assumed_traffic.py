"""Assume the traffic through a junction that nobody has counted, and find how much of it the network carries.

The flows between the streets come from :func:`egvs.creation.junctions.assumed_flows`. A new scenario uses a share of
what the network carries of them without a lock, see :mod:`egvs.traffic.capacity`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import tomlkit

from egvs.core.errors import InputError
from egvs.core.wording import by_number, format_percent, number_of
from egvs.creation import junctions, scenario_files
from egvs.creation.junctions import StreetJunction, Streets
from egvs.scenario.traffic_config import CountConfig
from egvs.traffic.capacity import Capacity, distribute_total, find_capacity, scale_flows

JUNCTION_BLOCKER_S, TELEPORT_S = 10.0, 120.0
"""What ends locks in new scenarios; the second is longer than any red phase and most waits to give way."""

TRAFFIC_LEVELS = {"light": 0.4, "medium": 0.75, "heavy": 1.0}
"""Shares of the carried flow. The queues of a junction get long, and rare locks possible, near its capacity."""

DEFAULT_TRAFFIC = "medium"

MAX_VEHICLES_PER_H = 100_000
"""More do not pass any junction."""


@dataclass(frozen=True)
class AssumedTraffic:
    """The traffic of a new scenario.

    Attributes
    ----------
    assumed
        Flows from the classes of the streets, or in their proportions if their sum is given.
    capacity
        What the network carries of them.
    level
        A key of :data:`TRAFFIC_LEVELS`; None if the sum of the flows is given, and they are used in full.
    """

    assumed: tuple[CountConfig, ...]
    capacity: Capacity
    level: str | None

    is_recorded = False

    @cached_property
    def flows(self) -> tuple[CountConfig, ...]:
        """The flows of the scenario."""
        if self.level is None:
            return self.assumed
        return tuple(scale_flows(self.assumed, self.capacity.share * TRAFFIC_LEVELS[self.level]))

    @property
    def assumed_per_h(self) -> int:
        """Sum of the assumed flows."""
        return round(math.fsum(flow.per_hour for flow in self.assumed))

    @property
    def carried_per_h(self) -> int:
        """Sum of the flows that the network carries, in steps of 10."""
        if self.capacity.is_everything:
            return self.assumed_per_h
        return round(self.capacity.share * self.assumed_per_h / 10) * 10

    @property
    def per_h(self) -> int:
        """Sum of the flows of the scenario."""
        return round(math.fsum(flow.per_hour for flow in self.flows))

    @property
    def summary(self) -> str:
        """What is carried and used, as a sentence."""
        if self.level is None:
            carried = "all" if self.capacity.is_everything else f"{self.carried_per_h:,}"
            return f"carries {carried} of the {self.assumed_per_h:,} requested vehicles an hour"
        carried = f"{self.carried_per_h:,}"
        carried = f"at least {carried}" if self.capacity.is_everything else f"{carried} of {self.assumed_per_h:,}"
        share = format_percent(TRAFFIC_LEVELS[self.level], 0)
        return f"carries {carried} vehicles an hour; {self.level} {share} is used"

    @property
    def notes(self) -> list[str]:
        """What the network does not carry."""
        capacity = self.capacity
        jam = f"; {capacity.jam}" if capacity.jam else ""
        hint = "Lower per_hour of traffic.counts, or check the signals and connections there."
        if self.level is None:
            if capacity.is_everything:
                return []
            return [f"Traffic jams are likely: the network {self.summary}{jam}. {hint}"]
        if not capacity.is_confirmed:
            return [
                "Traffic jams occur in"
                f" {by_number(len(capacity.runs), 'the trial', f'all {len(capacity.runs)} trials')}{jam}. {hint}"
            ]
        return []

    @property
    def assumptions(self) -> list[str]:
        """What is assumed, for the key ``assumed``."""
        if self.level is None:
            return [f"shares of the movements (of {self.per_h:,} vehicles an hour)"]
        return [f"traffic ({self.per_h:,} vehicles an hour, from the road classes)"]

    def describe(self) -> str:
        """Return a sentence."""
        movements = number_of(len(self.flows), "movement")
        return f"the region {self.summary}: {self.per_h:,} vehicles an hour in {movements} (assumed)"

    def warnings(self, scenario_file: Path) -> Iterator[str]:
        """Warn that the traffic is not counted."""
        assumed = "the traffic is assumed" if self.level is not None else "the shares of the movements are assumed"
        yield _assumed_warning(assumed, self.per_h, scenario_file)

    def add_keys(self, table: Any, streets: Streets, junction: StreetJunction) -> None:
        """Name the table of the counts in ``[traffic]``, and say how periods are added."""
        table.update({"counts": scenario_files.COUNTS_FILE})
        origin = "assumed from the road classes" if self.level is not None else "divided by the road classes"
        table["counts"].comment(f"{origin}: replace its numbers by real counts")
        table.add(tomlkit.comment(scenario_files.PERIODS_HINT))


class NoTraffic:
    """The traffic of a region through which no street leads vehicles."""

    flows: tuple[CountConfig, ...] = ()
    notes: tuple[str, ...] = ()
    assumptions: tuple[str, ...] = ()
    is_recorded = False

    def describe(self) -> str:
        """Return a sentence."""
        return "none: no street leads vehicles through the region"

    def warnings(self, scenario_file: Path) -> Iterator[str]:
        """Warn that there is no traffic."""
        yield _assumed_warning("the traffic is assumed", 0, scenario_file)

    def add_keys(self, table: Any, streets: Streets, junction: StreetJunction) -> None:
        """Add nothing."""


def _assumed_warning(assumed: str, per_h: int, scenario_file: Path) -> str:
    place = (
        f"under [traffic] in {scenario_file}"
        if not per_h
        else f"in {scenario_file.parent / scenario_files.COUNTS_FILE}"
    )
    return (
        f"{assumed} ({per_h:,} vehicles an hour); this affects the ranking."
        f" Enter counted traffic {place} before you rely on the ranking,"
        f" and remove its entry from assumed in {scenario_file.name}."
    )


def check_traffic_level(level: str) -> None:
    """Raise an InputError unless a text is a key of :data:`TRAFFIC_LEVELS`."""
    if level not in TRAFFIC_LEVELS:
        raise InputError("--traffic", f"expected light, medium or heavy, got {level!r}", "Use --traffic medium.")


def check_traffic(traffic: str | int) -> None:
    if isinstance(traffic, str):
        check_traffic_level(traffic)
    elif not 1 <= traffic <= MAX_VEHICLES_PER_H:
        problem = f"expected 1 to {MAX_VEHICLES_PER_H:,} vehicles an hour, got {traffic:,}"
        raise InputError("--vehicles-per-hour", problem, "Give the vehicles that pass the junction from all sides.")


def assume_traffic(
    network: str, streets: Streets, junction: StreetJunction, traffic: str | int
) -> AssumedTraffic | NoTraffic:
    """Assume flows through the region of a junction, and find how much of them the network carries."""
    flows = junctions.assumed_flows(streets, junctions.region_around(junction), junction.ring)
    if isinstance(traffic, int):
        if not flows:
            problem = "no street leads vehicles through the region of interest"
            raise InputError("--vehicles-per-hour", problem, "Choose another junction with --at LAT,LON.")
        flows = distribute_total(flows, traffic)
    if not flows:
        return NoTraffic()
    level = traffic if isinstance(traffic, str) else None
    return AssumedTraffic(tuple(flows), find_capacity(network, flows, JUNCTION_BLOCKER_S), level)
