"""Read traffic counts as planners have them: by street, side of arrival and turn, for parts of the day.

A CSV file with one row per count. The location is one of

- ``street`` and/or ``approach`` (side on which the vehicles *arrive*), and ``turn``;
- ``lane_group`` ("NBL": northbound, left);
- ``edge``, or ``from_edge`` and ``to_edge`` (ids of the network).

The number is in ``count``, of the interval that begins at ``start`` ("07:15"), or in columns that are named by their
start ("07:00", "07:15"); without any start, ``count`` is vehicles per hour. ``minutes`` is the length of the interval;
by default the smallest difference between two starts. ``kind`` is a kind of the fleet.

Steps of :func:`read_street_counts`: read the rows; find the movements of each; divide what counts several movements by
their assumed shares; add up the intervals of each hour of the clock. An hour becomes a period of the scenario where
there are several.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import tomlkit

from egvs.core.errors import InputError, parse_each
from egvs.core.numbers import ambiguous_number, number_or_nan, parse_decimal
from egvs.core.table_columns import parse_header
from egvs.core.wording import list_first, number_of
from egvs.creation import junctions, scenario_files
from egvs.creation.junctions import StreetJunction, Streets
from egvs.formats import spreadsheets
from egvs.scenario.traffic_config import CountConfig, TrafficConfig
from egvs.traffic import capacity
from egvs.traffic.approaches import TURN_WORDS, ApproachIndex, ApproachMovement, parse_lane_group
from egvs.traffic.movements import MovementNames

LOCATION_COLUMNS = ("street", "approach", "turn", "lane_group", "edge", "from_edge", "to_edge")
VALUE_COLUMNS = ("start", "minutes", "count", "kind")

_CLOCK = re.compile(r"([01]?\d|2[0-3])[:.h]?([0-5]\d)(:00)?")
_INTERVALS_MIN = (5, 10, 15, 20, 30, 60)
_MAX_COUNT = 100_000.0
_MAX_NAMED = 4
_ALL_TURNS = ("", "all", "total", "any", "alle", "gesamt")


@dataclass(frozen=True)
class CountedHour:
    """The counts of an hour of the clock.

    Attributes
    ----------
    start_min
        Minutes after midnight; None for counts without a start.
    partial_min
        Minutes of it that were counted, by the names of the movements that were not counted during all of it.
    flows
        Vehicles per hour.
    """

    start_min: int | None
    partial_min: Mapping[str, int]
    flows: tuple[CountConfig, ...]

    @property
    def name(self) -> str:
        """Name of the period, e.g. ``"07-08"``."""
        assert self.start_min is not None
        hour = self.start_min // 60
        return f"{hour:02d}-{(hour + 1) % 24:02d}"

    @property
    def per_h(self) -> int:
        """Sum of the flows."""
        return round(math.fsum(flow.per_hour for flow in self.flows))


@dataclass(frozen=True)
class StreetCounts:
    """Counts of a junction.

    Attributes
    ----------
    path
        The file.
    hours
        At least one.
    notes
        What was assumed, and which movements have no count.
    split
        Approaches whose turns are assumed.
    uncounted
        Where no vehicle is, because none was counted: movements, approaches, or movements of an hour.
    excess
        Which counts exceed what lanes can carry, in sentences.
    """

    path: Path
    hours: tuple[CountedHour, ...]
    notes: tuple[str, ...]
    split: tuple[str, ...]
    uncounted: tuple[str, ...] = ()
    excess: tuple[str, ...] = ()

    is_recorded = False

    @property
    def flows(self) -> tuple[CountConfig, ...]:
        """The flows of the busiest hour."""
        return max(self.hours, key=lambda hour: hour.per_h).flows

    @property
    def assumptions(self) -> list[str]:
        """Assumptions, for the key ``assumed``."""
        assumed = [f"turns of the approaches {', '.join(self.split)}"] if self.split else []
        if self.uncounted:
            assumed.append(f"no vehicles in uncounted movements: {list_first(self.uncounted, _MAX_NAMED)}")
        return assumed

    def describe(self) -> str:
        """Return a sentence."""
        is_approach = {flow.title: flow.edge is not None for hour in self.hours for flow in hour.flows}
        approaches = sum(is_approach.values())
        ways = [number_of(len(is_approach) - approaches, "movement")] if approaches < len(is_approach) else []
        if approaches:
            ways.append(f"{number_of(approaches, 'approach', 'approaches')} without turns")
        counted = f"in {' and '.join(ways)}, counted ({self.path.name})"
        if len(self.hours) == 1:
            return f"{number_of(self.hours[0].per_h, 'vehicle')} an hour {counted}"
        amounts = [f"{hour.name} {hour.per_h:,}" for hour in self.hours]
        return f"vehicles an hour {counted}: {', '.join(amounts)}"

    def warnings(self, _scenario_file: Path) -> Iterator[str]:
        """Yield which counts exceed what lanes can carry; notes say what is assumed."""
        yield from self.excess

    def add_keys(self, table: Any, streets: Streets, junction: StreetJunction) -> None:
        """Add the counts to ``[traffic]``; several hours become periods."""
        flows = tuple(flow for hour in self.hours for flow in hour.flows)
        names = MovementNames(streets.network, junction.at_m, flows)
        origin = f"vehicles an hour, from {self.path.name}"
        if len(self.hours) == 1:
            table.update({"counts": scenario_files.counts_array(self.hours[0].flows, names)})
            table["counts"].comment(origin)
            return
        table.add(tomlkit.comment(f"{origin}; one period for each hour"))
        periods = tomlkit.aot()
        for hour in self.hours:
            period = tomlkit.table()
            period.update({"name": hour.name, "weight": 1, "counts": scenario_files.counts_array(hour.flows, names)})
            periods.append(period)
        table.add("periods", periods)


@dataclass(frozen=True)
class _Row:
    """A count: vehicles of some movements in an interval; ``start_min`` is None for vehicles per hour.

    ``turns`` are those of the table; empty for all.
    """

    where: str
    title: str
    movements: tuple[ApproachMovement, ...]
    turns: tuple[str, ...]
    kind: str
    start_min: int | None
    minutes: int | None
    vehicles: float

    @property
    def is_split(self) -> bool:
        """Whether the count is divided among several movements."""
        return len(self.movements) > 1


def read_junction_counts(path: Path, streets: Streets, junction: StreetJunction) -> StreetCounts:
    """Read the counts of a junction; see :func:`read_street_counts`."""
    flows = junctions.assumed_flows(streets, junctions.region_around(junction), junction.ring)
    if not flows:
        problem = "no street leads vehicles through the region of interest"
        raise InputError("--counts", problem, "Choose another junction with --at LAT,LON.")
    index = ApproachIndex.of_flows(flows, MovementNames(streets.network, junction.at_m, flows))
    edges = frozenset(edge.id for edge in streets.network.edges)
    kinds = frozenset(kind.name for kind in TrafficConfig.model_fields["kinds"].default)
    counts = read_street_counts(path, flows, index, edges, kinds)
    excess: dict[str, None] = {}
    for hour in counts.hours:
        names = MovementNames(streets.network, junction.at_m, [*flows, *hour.flows])
        for place, per_hour, lanes in capacity.find_excess(streets.network, names, hour.flows):
            excess[
                f"{path}: {place}: {per_hour:,.0f} vehicles an hour exceed what {number_of(lanes, 'lane')} can carry,"
                f" at most {lanes * capacity.LANE_PER_H:,.0f}. Check the count."
            ] = None
    return replace(counts, excess=tuple(excess))


def read_street_counts(
    path: Path, flows: Sequence[CountConfig], index: ApproachIndex, edges: frozenset[str], kinds: frozenset[str]
) -> StreetCounts:
    """Read counts by street, side of arrival and turn.

    Parameters
    ----------
    path
        CSV file, UTF-8, with commas or semicolons.
    flows
        The assumed flows of the junction, whose proportions divide counts of several movements.
    index
        Names of these flows.
    edges
        Ids of the edges of the network.
    kinds
        Names of the fleet's kinds.

    Raises
    ------
    InputError
        When a column or a value is not valid, a name is unknown or ambiguous, a movement is counted twice, or all
        counts are 0.
    """
    rows = list(_read_rows(path, index, edges, kinds))
    if not rows:
        raise InputError(path, "has no counts", "Add one row per count below the header.")
    if len({row.start_min is None for row in rows}) > 1:
        raise InputError(path, "only some rows have a start", "Give a start for every count, or for none.")
    interval_min = _interval_min(path, rows)
    hours: dict[int | None, dict[tuple[str, str], list[tuple[int | None, float]]]] = {}
    first_row: dict[tuple[str, str, int | None], str] = {}
    templates: dict[str, CountConfig] = {}
    names: dict[str, str] = {}
    for row in rows:
        hour = None if row.start_min is None else row.start_min // 60 * 60
        if row.start_min is not None and row.start_min % 60 + interval_min > 60:
            problem = f"the interval of {interval_min} minutes ends in another hour"
            raise InputError(row.where, problem, "Use intervals within an hour of the clock, such as 07:00 or 07:15.")
        total = math.fsum(move.flow.per_hour for move in row.movements)
        for move in row.movements:
            key = (move.flow.title, row.kind)
            former = first_row.setdefault((*key, row.start_min), row.where)
            if former != row.where:
                problem = f"{row.title} is counted twice, also in {former.rpartition(': ')[2]}"
                raise InputError(row.where, problem, "Give one count for each movement, interval and kind.")
            share = move.flow.per_hour / total if len(row.movements) > 1 else 1.0
            hours.setdefault(hour, {}).setdefault(key, []).append((row.start_min, row.vehicles * share))
            templates[move.flow.title] = move.flow
            names[move.flow.title] = _movement_name(move)
    counted = []
    for hour in sorted(hours, key=lambda start: start or 0):
        flows_of_hour = _to_flows(hours[hour], templates, interval_min)
        partial_min: dict[str, int] = {}
        for (title, _), values in hours[hour].items():
            minutes = len(values) * interval_min
            if minutes < 60:
                partial_min[names[title]] = min(minutes, partial_min.get(names[title], 60))
        counted.append(CountedHour(hour, partial_min, flows_of_hour))
    if not any(flow.per_hour for hour in counted for flow in hour.flows):
        raise InputError(path, "all counts are 0", "Give at least one count above 0.")
    empty = [hour for hour in counted if not any(flow.per_hour for flow in hour.flows)]
    counted = [hour for hour in counted if hour not in empty]
    split = tuple(dict.fromkeys(row.movements[0].approach_title for row in rows if row.is_split))
    notes = list(_notes(rows, counted, split, flows, index))
    if empty:
        notes.append(f"Hours without a vehicle are left out: {', '.join(hour.name for hour in empty)}.")
    uncounted = [*_uncounted(rows, flows, index), *(f"those of {name}" for name in _incomplete_hours(counted))]
    return StreetCounts(path, tuple(counted), tuple(notes), split, tuple(uncounted))


def _to_flows(
    intervals: Mapping[tuple[str, str], Sequence[tuple[int | None, float]]],
    templates: Mapping[str, CountConfig],
    interval_min: int,
) -> tuple[CountConfig, ...]:
    """Return vehicles per hour of an hour's intervals, each a start and its vehicles."""
    flows = []
    for (title, kind), values in intervals.items():
        vehicles = math.fsum(value for _, value in values)
        per_hour = round(vehicles * 60.0 / (len(values) * interval_min), 1)
        flows.append(templates[title].model_copy(update={"per_hour": per_hour, "kind": kind}))
    return tuple(flows)


def _interval_min(path: Path, rows: Sequence[_Row]) -> int:
    """Return the length of the intervals in minutes; 60 without starts."""
    lengths = {row.minutes for row in rows if row.minutes is not None}
    starts = sorted({row.start_min for row in rows if row.start_min is not None})
    if not starts:
        if lengths:
            hint = "Add a column start, or give vehicles per hour and remove minutes."
            raise InputError(path, "minutes has no effect without a start", hint)
        return 60
    if not lengths:
        lengths = {min((after - before for before, after in itertools.pairwise(starts)), default=0)}
    if len(lengths) > 1 or min(lengths) not in _INTERVALS_MIN:
        names = ", ".join(map(str, _INTERVALS_MIN))
        actual = " and ".join(str(length) for length in sorted(lengths))
        if lengths == {0}:
            actual = "a single start"
        problem = f"expected intervals of one length ({names} minutes), got {actual}"
        raise InputError(path, problem, "Add a column minutes with the length of the intervals.")
    return lengths.pop()


def _notes(
    rows: Sequence[_Row], hours: Sequence[CountedHour], split: Sequence[str], flows: Sequence[CountConfig],
    index: ApproachIndex,
) -> Iterator[str]:  # fmt: skip
    if split:
        yield f"Counts of several movements are divided by the assumed shares: {', '.join(split)}."
    straight = [row for row in rows if "straight" in row.turns]
    bends = {_movement_name(move) for row in straight for move in row.movements if move.turn not in row.turns}
    if bends:
        yield f"Counted as straight on, since the street bends there: {', '.join(sorted(bends))}."
    for hour in hours:
        if hour.partial_min:
            parts = [f"{name} ({minutes} min)" for name, minutes in hour.partial_min.items()]
            movements = number_of(len(parts), "movement")
            yield (
                f"Counts of a part of the hour {hour.name} are scaled up to an hour for {movements}:"
                f" {list_first(parts, _MAX_NAMED)}."
            )
    if incomplete := _incomplete_hours(hours):
        yield f"Movements that were not counted in an hour get no vehicles in it: {', '.join(incomplete)}."
    if uncounted := _uncounted(rows, flows, index):
        yield f"Movements without a count get no vehicles: {', '.join(uncounted)}."


def _incomplete_hours(hours: Sequence[CountedHour]) -> list[str]:
    """Return the hours in which fewer movements were counted than in others."""
    titles = [{flow.title for flow in hour.flows} for hour in hours]
    return [hour.name for hour, known in zip(hours, titles, strict=True) if known != set.union(*titles)]


def _uncounted(rows: Sequence[_Row], flows: Sequence[CountConfig], index: ApproachIndex) -> list[str]:
    """Return the movements without a count; an approach without any is named as such."""
    counted = {move.flow.title for row in rows for move in row.movements}
    missing = [move for move in index.movements if move.flow.title not in counted]
    if len(missing) == len(flows):  # the counts are at edges
        return []
    on_counted = {move.approach_title for move in index.movements if move.flow.title in counted}
    names = [_movement_name(move) if move.approach_title in on_counted else move.approach_title for move in missing]
    return sorted(dict.fromkeys(names), key=lambda name: [not name.startswith(title) for title in index.titles])


def _movement_name(move: ApproachMovement) -> str:
    return f"{move.approach_title} {move.turn}".strip()


def _read_rows(path: Path, index: ApproachIndex, edges: frozenset[str], kinds: frozenset[str]) -> list[_Row]:
    parse = partial(_parse_row, index=index, edges=edges, kinds=kinds)
    return spreadsheets.parse_rows(path, partial(_check_header, path), parse)


def _check_header(path: Path, header: list[str]) -> list[str]:
    """Return the names of the columns in lower case; InputError when one is unknown or missing."""
    known = (*LOCATION_COLUMNS, *VALUE_COLUMNS)
    where = f"{path}: header"
    hint = f"Columns: {', '.join(known)}, or starts such as 07:15."
    names = parse_header(where, header, known, hint, _CLOCK.fullmatch)
    has_starts = any(_CLOCK.fullmatch(name) for name in names)
    if has_starts == ("count" in names):
        problem = "expected a column count, or columns named by their start, got " + ("both" if has_starts else "none")
        raise InputError(where, problem, "Example: street,approach,turn,start,count.")
    if has_starts and "start" in names:
        raise InputError(where, "the start is in a column and in names of columns", "Remove the column start.")
    if not any(name in names for name in ("street", "approach", "lane_group", "edge", "from_edge")):
        problem = "no column gives the location of the counts"
        raise InputError(where, problem, "Add street and approach, lane_group, or edge.")
    return names


def _parse_row(
    where: str, values: Mapping[str, str], index: ApproachIndex, edges: frozenset[str], kinds: frozenset[str]
) -> Iterator[_Row]:
    kind = values.get("kind", "")
    if kind.casefold() in _ALL_TURNS:
        kind = ""
    if kind and kind not in kinds:
        raise InputError(
            f"{where}: kind", f"expected a kind of the fleet, got {kind!r}", f"Kinds: {', '.join(sorted(kinds))}."
        )
    movements, turns = _find_movements(where, values, index, edges)
    title = " ".join(values[name] for name in LOCATION_COLUMNS if values.get(name))
    minutes = None
    if values.get("minutes"):
        if values["minutes"] not in map(str, _INTERVALS_MIN):
            problem = f"expected one of {', '.join(map(str, _INTERVALS_MIN))}, got {values['minutes']!r}"
            raise InputError(f"{where}: minutes", problem, "Use 15 or 60.")
        minutes = int(values["minutes"])
    if "count" in values:
        start_min = _parse_clock(f"{where}: start", values["start"]) if values.get("start") else None
        vehicles = _parse_count(f"{where}: count", values["count"])
        yield _Row(where, title, movements, turns, kind, start_min, minutes, vehicles)
        return
    starts = [name for name, cell in values.items() if _CLOCK.fullmatch(name) and cell]
    counts = parse_each(starts, lambda name: _parse_count(f"{where}: {name}", values[name]), "counts")
    for name, vehicles in zip(starts, counts, strict=True):
        yield _Row(where, title, movements, turns, kind, _parse_clock(where, name), minutes, vehicles)


def _find_movements(
    where: str, values: Mapping[str, str], index: ApproachIndex, edges: frozenset[str]
) -> tuple[tuple[ApproachMovement, ...], tuple[str, ...]]:
    """Return the movements of a row, and the turns that it names."""
    named = [name for name in ("street", "approach", "lane_group", "edge", "from_edge") if values.get(name)]
    if not named:
        raise InputError(where, "has no location", "Give street and approach, lane_group, or edge.")
    if "edge" in named or "from_edge" in named:
        return (_edge_movement(where, values, edges),), ()
    street = ""
    turns: tuple[str, ...] = ()
    turn = values.get("turn", "").casefold()
    if "lane_group" in named:
        group = parse_lane_group(values["lane_group"])
        if group is None or len(named) > 1 + ("street" in named) or turn not in _ALL_TURNS:
            problem = (
                f"expected a lane group such as NBL or EBTR, without approach and turn, got {values['lane_group']!r}"
            )
            raise InputError(f"{where}: lane_group", problem, "NBL: northbound vehicles that turn left.")
        side: str | None = group[0]
        turns = group[1]
    else:
        side = None
        if values.get("approach"):
            street, side = index.parse_approach(values["approach"], where)
        if turn not in _ALL_TURNS:
            if turn not in TURN_WORDS:
                problem = f"expected left, straight, right, U-turn or all, got {values['turn']!r}"
                raise InputError(f"{where}: turn", problem, "Leave it empty for all vehicles of the approach.")
            turns = (TURN_WORDS[turn],)
    movements = tuple(index.find(values.get("street") or street, side, turns, where))
    return movements, turns


def _edge_movement(where: str, values: Mapping[str, str], edges: frozenset[str]) -> ApproachMovement:
    """Return the movement of a row with ids of edges."""
    import numpy as np

    ids = {name: values[name] for name in ("edge", "from_edge", "to_edge") if values.get(name)}
    if set(ids) not in ({"edge"}, {"from_edge", "to_edge"}) or len(set(ids.values())) < len(ids):
        raise InputError(where, "expected either edge, or from_edge and to_edge", "Leave the other cells empty.")
    if any(values.get(name) for name in ("street", "approach", "turn", "lane_group")):
        raise InputError(where, "names a street and an edge", "Leave one of them empty.")
    for name, edge in ids.items():
        if edge not in edges:
            raise InputError(f"{where}: {name}", f"the network has no edge {edge!r}", "Use the id of an edge.")
    flow = CountConfig(**ids, per_hour=1.0)
    return ApproachMovement(flow, "", flow.title, "", (), np.zeros(2))


def _parse_clock(where: str, text: str) -> int:
    match = _CLOCK.fullmatch(text)
    if match is None:
        raise InputError(where, f"expected a time of the day, got {text!r}", "Use a time such as 07:15.")
    return int(match[1]) * 60 + int(match[2])


def _parse_count(where: str, text: str) -> float:
    value = number_or_nan(text, parse_decimal)
    if choices := ambiguous_number(text):
        raise InputError(where, f"{text} can mean {choices}", f"Write {choices}.")
    if not 0 <= value <= _MAX_COUNT:
        problem = f"expected a number of vehicles of 0 to {_MAX_COUNT:,.0f}, got {text!r}"
        raise InputError(where, problem, "Use a number such as 120.")
    return value
