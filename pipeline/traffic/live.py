"""Records the rows of floating car data from a SUMO that is already running, over TraCI.

Steps: check that its clock fits the scenario's; subscribe to everybody on the road; step it through the recording, and
give the rows of each frame as SUMO's own FCD file would have them. World frame and units as in SUMO; times are whole
milliseconds.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.core.errors import InputError, RunError
from pipeline.traffic import fcd, sumo
from pipeline.traffic.boxes import Size
from pipeline.traffic.sumo_folder import FCD_DIGITS, Timing


@dataclass
class LiveObservations:
    """What :func:`poll` learns beside the rows.

    Attributes
    ----------
    sizes
        Of the types of everybody who was there, asked for when first needed.
    collided
        Pairs that collided while frames were recorded.
    stopped_on_purpose
        Vehicles that stand at the end because they are told to.
    """

    sizes: dict[str, Size] = field(default_factory=dict)
    collided: set[tuple[str, str]] = field(default_factory=set)
    stopped_on_purpose: set[str] = field(default_factory=set)


def poll(
    connection: Any, when: Timing, observations: LiveObservations, address: str, *, persons: bool = False
) -> Iterator[pa.Table]:
    """Step a running SUMO through the recording, and give its rows as its FCD file would have them.

    After a step, TraCI's clock is one step ahead of the state that it shows: what SUMO's FCD calls time t is seen at
    t + step.
    """
    _check_clock(connection, when, address)
    watched = _Subscriptions(connection, observations.sizes, persons)
    while (shown_ms := round(connection.simulation.getTime() * 1000)) < when.end_ms:
        connection.simulationStep()
        watched.follow()
        if shown_ms < when.first_ms:
            continue
        observations.collided |= {(c.collider, c.victim) for c in connection.simulation.getCollisions()}
        if (shown_ms - when.first_ms) % when.period_ms == 0 and (rows := watched.rows()):
            if shown_ms + when.step_ms >= when.end_ms:
                stopped = {name for name in watched.vehicles() if connection.vehicle.isStopped(name)}
                observations.stopped_on_purpose |= stopped
            yield _as_table(shown_ms, rows)


def ask_size(connection: Any, name: str) -> Size:
    """One vehicle type's size over TraCI."""
    types = connection.vehicletype
    return Size(types.getLength(name), types.getWidth(name), types.getHeight(name), types.getVehicleClass(name))


def _check_clock(connection: Any, when: Timing, address: str) -> None:
    step = round(connection.simulation.getDeltaT() * 1000)
    if step != when.step_ms:
        right = f"traffic.step_s = {when.step_ms / 1000:g}"
        raise InputError(f"--traci {address}", f"that SUMO's step is {step / 1000:g} s", right)
    now, first = round(connection.simulation.getTime() * 1000), f"the first frame at {when.first_ms / 1000:g} s"
    if now > when.first_ms:
        raise RunError(
            f"--traci {address}: that SUMO is at {now / 1000:g} s already, after {first}; start it anew, or set a"
            " longer traffic.warmup_s"
        )
    if (when.first_ms - now) % when.step_ms:
        steps = f"from {now / 1000:g} s, steps of {step / 1000:g} s"
        raise RunError(f"--traci {address}: {steps} do not meet {first}")


class _Subscriptions:
    """Subscriptions to every vehicle on the road, and to every person where these are wanted."""

    def __init__(self, connection: Any, sizes: dict[str, Size], persons: bool) -> None:
        tc = sumo.constants()
        self._connection, self._sizes = connection, sizes
        self._wanted = (tc.VAR_POSITION3D, tc.VAR_ANGLE, tc.VAR_SLOPE, tc.VAR_SPEED, tc.VAR_TYPE)
        self._invalid = tc.INVALID_DOUBLE_VALUE
        for name in connection.vehicle.getIDList():
            connection.vehicle.subscribe(name, self._wanted)
        connection.simulation.subscribe((tc.VAR_DEPARTED_VEHICLES_IDS,))
        self._departed = tc.VAR_DEPARTED_VEHICLES_IDS
        self._persons: set[str] | None = set() if persons else None

    def follow(self) -> None:
        """Subscribe to the vehicles that departed in this step, and to persons who are new."""
        for name in self._connection.simulation.getSubscriptionResults()[self._departed]:
            self._connection.vehicle.subscribe(name, self._wanted)
        if self._persons is not None:
            there = set(self._connection.person.getIDList())
            for name in sorted(there - self._persons):
                self._connection.person.subscribe(name, self._wanted)
            self._persons = there

    def vehicles(self) -> list[str]:
        """The names of all vehicles on the road."""
        position = self._wanted[0]
        results = self._connection.vehicle.getAllSubscriptionResults()
        return [name for name, values in results.items() if values[position][0] != self._invalid]

    def rows(self) -> list[tuple[str, str, list[float]]]:
        """(id, type, [x, y, z, angle, slope, speed]) of everybody, rounded as SUMO rounds in its files."""
        rows = list(self._rows(self._connection.vehicle))
        if self._persons is not None:  # people stand upright, see fcd.read
            persons = self._rows(self._connection.person)
            rows += [(name, vtype, [*n[:4], 0.0, n[5]]) for name, vtype, n in persons]
        return rows

    def _rows(self, domain: Any) -> Iterator[tuple[str, str, list[float]]]:
        position, angle, slope, speed, vtype = self._wanted
        for name, values in domain.getAllSubscriptionResults().items():
            if values[position][0] == self._invalid:
                continue  # between two places of a teleport
            if values[vtype] not in self._sizes:
                self._sizes[values[vtype]] = ask_size(self._connection, values[vtype])
            numbers = (*values[position], values[angle], values[slope], values[speed])
            yield name, values[vtype], [float(f"{n:.{FCD_DIGITS}f}") for n in numbers]


def _as_table(time_ms: int, rows: list[tuple[str, str, list[float]]]) -> pa.Table:
    names, types, numbers = zip(*rows, strict=True)
    columns = np.array(numbers).T
    return pa.table([np.full(len(rows), time_ms), pa.array(names), pa.array(types), *columns], schema=fcd.SCHEMA)
