"""Observed queues and speeds of a junction's approaches (``traffic.observed``), a CSV file.

Columns: ``approach`` (side on which vehicles arrive) and/or ``street``, as in counts by street
(:mod:`egvs.traffic.approaches`); ``queue_m`` (95th percentile of the queue) and/or ``speed_kmh`` (mean speed in the
last 100 m before the stop line), of which one may be empty; and ``period`` in a scenario with periods.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from egvs.core.errors import InputError, parse_each
from egvs.core.numbers import number_or_nan
from egvs.core.table_columns import parse_header
from egvs.formats import spreadsheets
from egvs.scenario.model import Scenario
from egvs.traffic.approaches import ApproachIndex
from egvs.traffic.movements import MovementNames
from egvs.traffic.network import Network

KEY = "traffic.observed"
COLUMNS = ("street", "approach", "period", "queue_m", "speed_kmh")

_LIMITS = {"queue_m": 10_000.0, "speed_kmh": 300.0}


@dataclass(frozen=True)
class Observation:
    """An approach as it was observed; ``queue_m`` or ``speed_kmh`` may be None, ``period`` empty."""

    approach: str
    period: str
    queue_m: float | None
    speed_kmh: float | None


def approach_index(scenario: Scenario, network: Network) -> ApproachIndex:
    """Return the names of the movements that a scenario counts, in all its periods."""
    x_m, y_m, _ = scenario.roi.center_m
    counts = {count.title: count for period in scenario.by_period().values() for count in period.traffic.counts}
    return ApproachIndex.of_flows(counts.values(), MovementNames(network, (x_m, y_m), counts.values()))


def read_observed(scenario: Scenario, network: Network) -> tuple[Observation, ...]:
    """Read the observations of a scenario that has ``traffic.observed``.

    Raises
    ------
    InputError
        When the scenario has no counts, or the file is not valid.
    """
    assert scenario.traffic.observed is not None
    periods = scenario.by_period()
    if not all(period.traffic.counts for period in periods.values()):
        problem = "needs counted traffic in every period"
        raise InputError(f"{scenario.file}: {KEY}", problem, "Add traffic.counts, e.g. with egvs new --counts.")
    path = scenario.find(scenario.traffic.observed, KEY)
    names = [name for name in periods if name]
    return read_observations(path, approach_index(scenario, network), names)


def read_observations(path: Path, index: ApproachIndex, periods: Sequence[str]) -> tuple[Observation, ...]:
    """Read observations; ``periods`` are the names of the scenario's periods, empty without periods."""
    observations: dict[tuple[str, str], Observation] = {}

    def parse(where: str, values: Mapping[str, str]) -> tuple[()]:
        observation = _parse_row(where, values, index, periods)
        if observations.setdefault((observation.approach, observation.period), observation) is not observation:
            raise InputError(where, f"two rows for the approach {observation.approach}", "Remove one of the rows.")
        return ()

    spreadsheets.parse_rows(path, partial(_check_header, path), parse)
    if not observations:
        raise InputError(path, "has no observations", "Add one row per approach below the header.")
    return tuple(observations.values())


def _check_header(path: Path, header: list[str]) -> list[str]:
    """Return the names of the columns; InputError when one is unknown or missing."""
    header = parse_header(f"{path}: header", header, COLUMNS)
    if not {"street", "approach"} & set(header) or not _LIMITS.keys() & set(header):
        problem = "expected approach or street, and queue_m or speed_kmh"
        raise InputError(f"{path}: header", problem, "Example: approach,queue_m,speed_kmh.")
    return header


def _parse_row(where: str, values: Mapping[str, str], index: ApproachIndex, periods: Sequence[str]) -> Observation:
    street, side = "", None
    if values.get("approach"):
        street, side = index.parse_approach(values["approach"], where)
    if side is None and not values.get("street"):
        raise InputError(where, "names no approach", index.hint)
    title = index.find(values.get("street") or street, side, (), where)[0].approach_title
    period = values.get("period", "")
    if (period or periods) and period not in periods:
        known = f"Periods: {', '.join(periods)}." if periods else "The scenario has no periods; remove the column."
        raise InputError(f"{where}: period", f"expected a period of the scenario, got {period!r}", known)
    parsed = parse_each(
        _LIMITS.items(), lambda item: _parse_number(f"{where}: {item[0]}", values.get(item[0], ""), item[1]), "observed"
    )
    numbers = dict(zip(_LIMITS, parsed, strict=True))
    if all(number is None for number in numbers.values()):
        raise InputError(where, "has neither queue_m nor speed_kmh", "Enter one of them.")
    return Observation(title, period, numbers["queue_m"], numbers["speed_kmh"])


def _parse_number(where: str, text: str, limit: float) -> float | None:
    if not text:
        return None
    value = number_or_nan(text)
    if not 0 <= value <= limit:
        raise InputError(where, f"expected a number of 0 to {limit:,.0f}, got {text!r}", "Use a number such as 45.")
    return value
