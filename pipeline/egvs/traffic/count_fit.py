"""Counted against simulated flows: the GEH statistic of each count, and warnings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

from egvs.core.errors import Diagnostic
from egvs.core.wording import number_of
from egvs.formats import xml
from egvs.scenario.traffic_config import CountConfig, TrafficConfig
from egvs.traffic.demand import FLEET

GOOD_GEH = 5.0

_NOISE_SIGMAS = 3.0
"""A Poisson process exceeds this difference once in 370 times."""


@dataclass(frozen=True)
class CountFit:
    """Vehicles per hour at a location: counted, and simulated in the recorded frames."""

    place: str
    kind: str
    counted_per_h: float
    simulated_per_h: float
    geh: float


_NEVER = -1, -1.0


def count_fits(traffic: TrafficConfig, routes: Path, first_s: float, end_s: float) -> list[CountFit]:
    """Compare the counts with the simulated flows.

    Parameters
    ----------
    traffic
        The counts.
    routes
        SUMO's ``--vehroute-output`` with exit times.
    first_s, end_s
        The recorded time.
    """
    passages = [0] * len(traffic.counts)
    for vehicle in xml.iter_elements(routes, "routes"):
        if vehicle.tag != "vehicle":
            continue  # a person
        group = vehicle.get("id", "").rpartition(".")[0]
        exits = _edge_exits(vehicle)
        for number, count in enumerate(traffic.counts):
            if (count.kind or FLEET) == group and first_s <= _passing_time_s(count, exits) < end_s:
                passages[number] += 1

    hours = (end_s - first_s) / 3600.0
    fits = []
    for count, vehicles in zip(traffic.counts, passages, strict=True):
        per_hour = vehicles / hours
        deviation = round(geh(count.per_hour, per_hour), 2)
        fits.append(CountFit(count.title, count.kind, count.per_hour, round(per_hour, 1), deviation))
    return fits


def _edge_exits(vehicle: Element) -> dict[str, tuple[int, float]]:
    """Return the number of each edge on the route, and when the vehicle left it; -1 for never."""
    route = next(vehicle.iter("route"))
    edges = route.get("edges", "").split()
    times = route.get("exitTimes", "").split()
    return {edge: (number, float(time_s)) for number, (edge, time_s) in enumerate(zip(edges, times, strict=True))}


def _passing_time_s(count: CountConfig, exits: Mapping[str, tuple[int, float]]) -> float:
    """Return when a vehicle leaves the counted edge, or the first one; -1 if it does not pass the location."""
    if count.edge:
        return exits.get(count.edge, _NEVER)[1]
    first, time_s = exits.get(count.from_edge or "", _NEVER)
    last, _ = exits.get(count.to_edge or "", _NEVER)
    return time_s if 0 <= first < last else -1.0


def geh(counted_per_h: float, simulated_per_h: float) -> float:
    """Return the GEH statistic of two hourly flows; 0 if both are 0."""
    total = counted_per_h + simulated_per_h
    if not total:
        return 0.0
    return math.sqrt(2.0 * (simulated_per_h - counted_per_h) ** 2 / total)


def missed_count_warnings(counts: Sequence[CountFit], hours: float, where: str) -> list[Diagnostic]:
    """Warn about counts from which the simulated flows deviate by more than random variation.

    Parameters
    ----------
    counts
        From :func:`count_fits`.
    hours
        Duration of the recording.
    where
        The traffic table, for messages.
    """
    descriptions = []
    for fit in counts:
        difference = abs(fit.simulated_per_h - fit.counted_per_h) * hours
        noise = _NOISE_SIGMAS * math.sqrt(max(fit.counted_per_h * hours, 1.0))
        if not (fit.geh > GOOD_GEH and difference > noise):
            continue
        kind = f" ({fit.kind})" if fit.kind else ""
        descriptions.append(f"{fit.place}{kind}: {fit.simulated_per_h:g} instead of {fit.counted_per_h:g}")
    if not descriptions:
        return []
    problem = (
        f"the simulation misses {len(descriptions)} of {number_of(len(counts), 'count')} (vehicles per hour,"
        " simulated vs counted:"
        f" {'; '.join(descriptions)})"
    )
    hint = "Check that the counts are consistent with each other and with the network's lanes and signals."
    return [Diagnostic("counts", f"{where}.counts", problem, hint)]
