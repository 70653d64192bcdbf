"""Sites where each detector runs: fast ones at all sites, others at some, chosen only by their order."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.validity import low_models, poses
from benchmarks.validity.junctions import Role, StudyJunction
from egvs.clouds.sweeps import POINT_COUNTS_NAME
from egvs.sensors.sites import Site

FAST = (POINT_COUNTS_NAME, "cluster")
"""Detectors that run at every site, with every sensor; others run at some."""

FEW_PLACES = 5
FEW_GIVEN: dict[Role, int] = {"training": 6, "held out": 13, "unseen": 13}
"""Sites of other detectors: the first locations of the grid at all heights, and this many given sites."""


def sites_of(detector: str, junction: StudyJunction) -> tuple[Site, ...]:
    """Return the sites of a detector at a junction; detectors for mounting heights run at held-out junctions only."""
    if detector in FAST:
        return (*junction.given, *junction.grid)
    if detector in low_models.NAMES:
        return first_places(junction.grid) if junction.role == "held out" else ()
    return (*evenly_chosen(junction.given, FEW_GIVEN[junction.role]), *first_places(junction.grid))


def first_places(grid: tuple[Site, ...]) -> tuple[Site, ...]:
    """Return the sites at the first locations of the grid."""
    return grid[: FEW_PLACES * len(poses.HEIGHTS_M)]


def evenly_chosen(sites: Sequence[Site], most: int) -> list[Site]:
    """Return at most ``most`` sites: one of each pole, evenly over the list, at alternating heights; then a second."""
    if len(sites) <= most:
        return list(sites)
    at: dict[str, list[Site]] = {}
    for site in sites:
        at.setdefault(site.pole, []).append(site)
    poles, chosen = list(at.values()), list[Site]()
    while len(chosen) < most:
        count = min(most - len(chosen), len(poles))
        for turn, number in enumerate((np.arange(count) * len(poles) // count).tolist()):
            remaining = [site for site in poles[number] if site not in chosen]
            chosen += remaining[turn % len(remaining) : turn % len(remaining) + 1] if remaining else []
        poles = [pole for pole in poles if any(site not in chosen for site in pole)]
    return [site for site in sites if site in chosen]
