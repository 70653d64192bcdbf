"""Runs of one scenario with each of several sensors, for ``egvs compare --sensors``.

Each run is the scenario with one sensor at all sites (``sites.replace_sensor``), in the folder that ``egvs run --set``
gives it: traffic, TPOG and static world come from the store. If all sites have the sensor already, the run is that of
the scenario as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from egvs.core.errors import InputError
from egvs.core.wording import by_number
from egvs.results.labels import join_names
from egvs.runs import run
from egvs.runs.run_sources import SettingsSource
from egvs.scenario.model import Scenario
from egvs.scenario.settings import format_overrides
from egvs.sensors.return_model import decide_losses
from egvs.sensors.sensor import CATALOGUE, check_sensor_names, scenario_sensor
from egvs.sensors.sites import Site, candidate_sites

ALL_SENSORS = "all"
"""Stands for the sensors of the scenario and the complete catalogue."""

OPTION = "--sensors"


@dataclass(frozen=True)
class SensorRun:
    """A run with one sensor at all sites.

    Attributes
    ----------
    sensor
        Name of the sensor.
    scenario
        The scenario with this sensor.
    folder
        The run folder.
    """

    sensor: str
    scenario: Scenario
    folder: Path


@dataclass(frozen=True)
class SensorRuns:
    """Runs of one scenario that differ in the sensor.

    Attributes
    ----------
    runs
        One run per sensor, in the order of the request.
    are_all
        Whether they are all sensors that are known, instead of chosen ones.
    notes
        What a reader must know before comparing the sensors.
    """

    runs: tuple[SensorRun, ...]
    are_all: bool
    notes: tuple[str, ...]


def prepare_runs(path: Path, sensors: str, overrides: Sequence[str] = ()) -> SensorRuns:
    """Return the runs of a scenario with each of several sensors; nothing is run yet.

    Parameters
    ----------
    path
        The scenario, or a run, whose settings are used.
    sensors
        Names, separated by commas, or :data:`ALL_SENSORS`.
    overrides
        Further settings of all runs, as in :func:`egvs.load`.

    Raises
    ------
    InputError
        When the scenario is wrong, a sensor is unknown or is named twice, fewer than two are named, or a site has a
        measured scan.
    """
    source = SettingsSource(path)
    base = source.load_variant(overrides)
    names = _sensor_names(sensors, base)
    sites = candidate_sites(base)
    _check_simulated(sites)
    present = {site.sensor for site in sites}

    runs = []
    for name in names:
        scenario, folder = base, run.default_folder(base)
        changes = _losses_of(name, base, sites)
        if present != {name}:
            changes["sites.replace_sensor"] = name
        if changes:
            scenario = source.load_variant((*overrides, *format_overrides(changes)))
            folder = run.default_folder(scenario)
        elif not overrides:
            folder = source.folder(base)
        runs.append(SensorRun(name, scenario, folder))
    return SensorRuns(tuple(runs), sensors == ALL_SENSORS, tuple(_notes(runs, sites)))


def _losses_of(name: str, scenario: Scenario, sites: Sequence[Site]) -> dict[str, Any]:
    """Return the setting with which losses of returns act for a sensor that the scenario would not need them for.

    Sensors are compared with the losses of all; those of a sensor without a rated range are unknown.
    """
    if scenario.effects.range_limit is not None:
        return {}
    replaced = [replace(site, sensor=name) for site in sites]
    losses = decide_losses(replaced, {name: scenario_sensor(name, scenario, OPTION)}, scenario.roi.box)
    return {"effects.range_limit": {}} if losses.negligible else {}


def run_sensors(
    sensor_runs: SensorRuns, run_one: Callable[[int, SensorRun], None], on_left_out: Callable[[SensorRun, str], None]
) -> tuple[SensorRun, ...]:
    """Run the scenario with each sensor, and return the runs.

    Of all known sensors, those that are not possible in this scenario are left out, for example a sensor without a
    rated range under the effect ``range_limit``.

    Parameters
    ----------
    sensor_runs
        From :func:`prepare_runs`.
    run_one
        Brings one run up to date; called with its number, from 1.
    on_left_out
        Called with a run that is left out, and the reason.

    Raises
    ------
    InputError
        When a chosen sensor is not possible in the scenario, or when fewer than two of all sensors are.
    """
    finished = []
    errors = []
    for number, sensor_run in enumerate(sensor_runs.runs, start=1):
        try:
            run_one(number, sensor_run)
        except InputError as error:
            if not sensor_runs.are_all:
                raise
            errors.append(error)
            on_left_out(sensor_run, str(error))
        else:
            finished.append(sensor_run)
    if len(finished) < 2:
        raise errors[0]
    return tuple(finished)


def _sensor_names(sensors: str, scenario: Scenario) -> tuple[str, ...]:
    """Return the names in a list of sensors; InputError if a sensor is unknown or named twice, or there is only one."""
    if sensors == ALL_SENSORS:
        return tuple(dict.fromkeys((*scenario.sensors, *CATALOGUE)))
    names = tuple(name.strip() for name in sensors.split(",") if name.strip())
    check_sensor_names(names, scenario.sensors, OPTION)
    if len(set(names)) < len(names):
        repeated = next(name for name in names if names.count(name) > 1)
        raise InputError(OPTION, f"{repeated} is named twice", "Name each sensor once.")
    if len(names) < 2:
        problem = f"expected at least two sensors, got {names[0] if names else 'none'}"
        raise InputError(OPTION, problem, "Use names such as VLP-32C,OS1-128, or all; egvs sensors lists them.")
    return names


def _check_simulated(sites: Sequence[Site]) -> None:
    """InputError if a site has a measured scan, which belongs to its sensor."""
    measured = next((site for site in sites if site.points is not None), None)
    if measured is not None:
        problem = f"site {measured.name} has a measured scan, which cannot be repeated with another sensor"
        raise InputError(OPTION, problem, "Remove points from its row, or from [sites].")


def _notes(runs: Sequence[SensorRun], sites: Sequence[Site]) -> Iterator[str]:
    """Yield notes on sensors without a rated range, and on partial views from sites that all look east."""
    for sensor_run in runs:
        sensor = scenario_sensor(sensor_run.sensor, sensor_run.scenario, OPTION)
        if sensor.rated_range_m is None and sensor_run.scenario.effects.range_limit is None:
            yield (
                f"{sensor.name} has no rated range: its losses of returns are not simulated, and it looks better than "
                f"it is. Enter rated_range_m and rated_reflectivity under [sensors.{sensor.name}]"
            )
    if any(site.pose.yaw_deg for site in sites):
        return
    partial = []
    for sensor_run in runs:
        sensor = scenario_sensor(sensor_run.sensor, sensor_run.scenario, OPTION)
        if sensor.azimuth_span_deg is not None:
            partial.append(sensor.name)
    if partial:
        verb = by_number(len(partial), "does", "do")
        yield (
            f"{join_names(partial)} {verb} not see the full circle, and every site looks east (yaw 0): give the sites "
            "a yaw_deg or an aim for a fair comparison"
        )
