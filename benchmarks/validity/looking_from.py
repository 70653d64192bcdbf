"""Where each detector looks from at a junction: quick ones from all sites, others from some, chosen by order alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.validity import low_models, poses
from benchmarks.validity.junctions import Role, StudyJunction
from egvs.sensors.sites import Site
from egvs.validation.sweeps import POINT_COUNTS_NAME

FAST = (POINT_COUNTS_NAME, "cluster")
"""Detectors that look from every site, and with every sensor; others look from some."""

FEW_PLACES = 5
FEW_GIVEN: dict[Role, int] = {"training": 6, "held out": 13, "unseen": 13}
"""Where other detectors look from: the first places of the grid at all heights, and so many of the given sites."""


def sites_of(detector: str, junction: StudyJunction) -> tuple[Site, ...]:
    """Where a detector looks from at a junction; those that are there for mounting heights at held-out ones alone."""
    if detector in FAST:
        return (*junction.given, *junction.grid)
    if detector in low_models.NAMES:
        return first_places(junction.grid) if junction.role == "held out" else ()
    return (*some(junction.given, FEW_GIVEN[junction.role]), *first_places(junction.grid))


def first_places(grid: tuple[Site, ...]) -> tuple[Site, ...]:
    """The sites at the first places of the grid."""
    return grid[: FEW_PLACES * len(poses.HEIGHTS_M)]


def some(sites: Sequence[Site], most: int) -> list[Site]:
    """Not more than so many: of poles evenly over the list one each, the next height with each pole; then a second."""
    if len(sites) <= most:
        return list(sites)
    at: dict[str, list[Site]] = {}
    for site in sites:
        at.setdefault(site.pole, []).append(site)
    poles, chosen = list(at.values()), list[Site]()
    while len(chosen) < most:
        wanted = min(most - len(chosen), len(poles))
        for turn, number in enumerate((np.arange(wanted) * len(poles) // wanted).tolist()):
            left = [site for site in poles[number] if site not in chosen]
            chosen += left[turn % len(left) : turn % len(left) + 1] if left else []
        poles = [pole for pole in poles if any(site not in chosen for site in pole)]
    return [site for site in sites if site in chosen]
