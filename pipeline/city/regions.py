"""How much of a city's traffic a junction needs.

What a run makes of traffic depends on the boxes that can meet the region of interest (the TPOG), that can stand between
a site and the region, or a vehicle in it (points on target, moving occlusion), and that stand within
:data:`pipeline.scoring.targets.detectability.LONELY_M` of such a vehicle. So the rectangle round the region and all
sites, grown by :data:`MARGIN_M`, has them all: a vehicle belongs to it when any of its box may lie there. World frame,
metres.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from pipeline.city.model import City, CityJunction
from pipeline.core.errors import InputError
from pipeline.effects import on_traffic
from pipeline.scenario.loading import load
from pipeline.scenario.models import Scenario
from pipeline.scoring.targets.detectability import LONELY_M
from pipeline.sensing import sites
from pipeline.traffic.boxes import Size

LONGEST_M = 80.0
"""A vehicle in the region may reach half of this beyond it; a longer tram's neighbours may be missed."""

MARGIN_M = LONELY_M + LONGEST_M / 2
STEP_M = 10.0
"""Rectangles are rounded outwards to this, so that a pole that moves a little needs no new simulation."""


@dataclass(frozen=True)
class Region:
    """What a junction needs: a rectangle, and the effects that ask for whole ways."""

    low_x_m: float
    low_y_m: float
    high_x_m: float
    high_y_m: float
    scenario: Scenario

    def to_json(self) -> list[float]:
        """The rectangle."""
        return [self.low_x_m, self.low_y_m, self.high_x_m, self.high_y_m]

    def followed_types(self, sizes: Mapping[str, Size]) -> frozenset[str]:
        """Types of which every row is kept, wherever it is."""
        return on_traffic.followed_types(self.scenario, sizes)


def of(city: City, sets: Sequence[str] = ()) -> dict[str, Region]:
    """The region of each junction, with ``sets`` laid over its scenario.

    InputError where a scenario is wrong, or has other traffic than the city's.
    """
    return {junction.id: _of_junction(city, junction, sets) for junction in city.junctions}


def _of_junction(city: City, junction: CityJunction, sets: Sequence[str]) -> Region:
    scenario = load(junction.scenario_folder(city), sets)
    _check_traffic(city, junction, scenario)
    roi = scenario.roi.box
    spots = [(site.pose.x_m, site.pose.y_m) for site in sites.of(scenario)]
    low = [min(roi.origin_m[i], *(spot[i] for spot in spots)) for i in (0, 1)]
    high = [max(roi.origin_m[i] + roi.size_m[i], *(spot[i] for spot in spots)) for i in (0, 1)]
    x0, y0 = (STEP_M * math.floor((value - MARGIN_M) / STEP_M) for value in low)
    x1, y1 = (STEP_M * math.ceil((value + MARGIN_M) / STEP_M) for value in high)
    return Region(x0, y0, x1, y1, scenario)


def _check_traffic(city: City, junction: CityJunction, scenario: Scenario) -> None:
    """InputError where a junction's scenario does not take the city's traffic as it is."""
    traffic, alone = scenario.traffic, scenario.by_period()
    its = {period.name for period in city.traffic.periods} or {""}
    if alone.keys() != its:
        found = f"has {_periods(alone)}, the city {_periods(its)}"
        raise InputError(f"{scenario.file}: traffic", found, f"a period for each of {city.file}, with the city's files")
    for name, of_period in alone.items():
        wanted, given = junction.traffic_file(city, name), of_period.traffic
        if given.fcd is None or os.path.realpath(scenario.folder / given.fcd) != os.path.realpath(wanted):
            source = given.fcd or given.network or given.sumocfg
            right = f'fcd = "../../{wanted.relative_to(city.folder).as_posix()}"'
            raise InputError(f"{scenario.file}: traffic", f"comes from {source}, not from the city's", right)
    strides = traffic.frame_period_s / city.traffic.frame_period_s
    if abs(strides - round(strides)) > 1e-9 or round(strides) < 1:
        found = f"{traffic.frame_period_s:g} s, but {city.file} has a frame each {city.traffic.frame_period_s:g} s"
        raise InputError(f"{scenario.file}: traffic.frame_period_s", found, "the same, or a multiple of it")


def _periods(names: Iterable[str]) -> str:
    return f"the periods {', '.join(sorted(names))}" if any(names) else "no periods"
