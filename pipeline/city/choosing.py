"""Chooses the junctions of a city.

Either all with signals, or all, or those nearest to places of a table. A junction is where at least three streets meet,
so that the signals of a mere crossing for pedestrians are none. The largest come first: by incoming lanes, then by
area. World frame, metres; places of tables in degrees (WGS 84).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError
from shapely.geometry import Point
from shapely.geometry.base import BaseGeometry

from pipeline.city.model import COLUMNS, csv_rows, number
from pipeline.core.errors import InputError
from pipeline.importers.junctions import Junction, Streets
from pipeline.scenario.types import NAME_IN_WORDS, Name

SIGNALISED, ALL = "signalised", "all"
NEEDED = ("junction", "lat_deg", "lon_deg")
"""Columns of a table of junctions; those of a city's own table may be there too."""

NEAR_M = 50.0
"""A place of a table is so near to its junction."""

_ARMS = 3
RIM, NO_SIGNALS, CROSSING = "too near to the rim", "without signals", "fewer than three streets meet"


@dataclass(frozen=True)
class Choice:
    """The junctions that were chosen, by the names of their folders; and those that were not, by why."""

    junctions: dict[str, Junction]
    left_out: dict[str, list[str]]


def choose(streets: Streets, which: str, within: BaseGeometry | None) -> Choice:
    """The junctions of a network: ``"signalised"``, ``"all"``, or those of a table, given its path.

    InputError where the table is wrong, or no junction is left. Those that ``within`` does not hold are left out.
    """
    if which not in (SIGNALISED, ALL):
        return Choice(dict(_of_table(streets, Path(which))), {})
    chosen: list[Junction] = []
    left_out: dict[str, list[str]] = {}
    for junction in sorted(streets.junctions, key=lambda j: (-j.lanes_in, -j.area.area, j.id)):
        if which == SIGNALISED and not junction.signalised:
            why = NO_SIGNALS
        elif junction.arms < _ARMS:
            why = CROSSING
        elif within is not None and not within.contains(Point(junction.at_m)):
            why = RIM
        else:
            chosen.append(junction)
            continue
        left_out.setdefault(why, []).append(junction.id)
    width = max(2, len(str(len(chosen))))
    return Choice({f"j{number:0{width}d}": junction for number, junction in enumerate(chosen, 1)}, left_out)


def _of_table(streets: Streets, path: Path) -> Iterator[tuple[str, Junction]]:
    seen: dict[str, str] = {}
    names = set[str]()
    for place, row in csv_rows(path, NEEDED, COLUMNS):
        name = row["junction"]
        try:
            TypeAdapter(Name).validate_python(name)
        except ValidationError:
            raise InputError(f"{place}: junction", repr(name)[:80], NAME_IN_WORDS) from None
        if name.casefold() in names:
            raise InputError(place, "stands there twice", "a name of its own for each junction")
        names.add(name.casefold())
        lat_deg, lon_deg = (
            number(f"{place}: {key}", row[key], most) for key, most in (("lat_deg", 90), ("lon_deg", 180))
        )
        junction = _nearest(streets, Point(streets.to_xy([lon_deg], [lat_deg])[0]), place)
        if junction.id in seen:
            raise InputError(place, f"is the same junction as {seen[junction.id]}", "one row for each junction")
        seen[junction.id] = name
        yield name, junction
    if not names:
        raise InputError(path, "names no junction", "a row for each, or --junctions signalised or all")


def _nearest(streets: Streets, at: Point, place: str) -> Junction:
    met = [junction for junction in streets.junctions if junction.arms >= _ARMS]
    away = {junction.id: at.distance(junction.area) if math.isfinite(at.x + at.y) else math.inf for junction in met}
    nearest = min(met, key=lambda j: (away[j.id], j.id), default=None)
    if nearest is None or not away[nearest.id] <= NEAR_M:
        far = "there is none" if nearest is None else f"the nearest is {away[nearest.id]:,.0f} m away"
        raise InputError(place, f"no junction of three streets or more is there ({far})", f"one within {NEAR_M:g} m")
    return nearest
