"""``egvs compare``: compare finished runs, or run a scenario with each of several sensors and compare these runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from egvs.cli.options import Top, command_words
from egvs.core.errors import InputError

if TYPE_CHECKING:
    from egvs.cli.console import ProgressDisplay
    from egvs.studies.sensor_runs import SensorRun

_OPTION = "--sensors"
_COSTS = "costs."


def compare(
    runs: Annotated[
        list[Path],
        typer.Argument(
            metavar="RUN...|SCENARIO",
            help="Folders of finished runs; one is enough if its sites have several sensors. With --sensors, a "
            "scenario or a run, to use its settings.",
        ),
    ],
    sensors: Annotated[
        str | None,
        typer.Option(
            _OPTION,
            metavar="A,B,...|all",
            help="Run the scenario with each of these sensors at all sites, or with all that egvs sensors lists, and "
            "compare the runs. Folders that are up to date are used.",
        ),
    ] = None,
    by: Annotated[
        Literal["pole", "site"] | None,
        typer.Option(
            help="Compare the best mounts of each pole, or sites of the same name. By default sites if no pole has "
            "several sites and the common sites have the same mount in all runs, else poles."
        ),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Override a cost, e.g. 'costs.sensor={\"VLP-32C\"=8000}'; with --sensors, also any key of the "
            "scenario, for all runs, e.g. effects.range_limit={} (repeatable).",
        ),
    ] = None,
    top: Top = None,
) -> None:
    """Which sensor? Compare sensors or runs: the best mount of each pole, the cost of one more point, and settings."""
    from egvs.cli.console import ProgressDisplay

    overrides = set_ or []
    costs = list(overrides)
    command: list[str] = []
    with ProgressDisplay("compare") as screen:
        from egvs.cli import study_tables
        from egvs.studies import run_comparison

        if sensors is None:
            run_comparison.check_distinct(runs)
            folders = runs
        else:
            costs = [override for override in overrides if override.strip().startswith(_COSTS)]
            settings = [override for override in overrides if override not in costs]
            folders = _run_sensors(screen, runs, sensors, settings)
            command = [*command_words("compare", runs[0], settings), _OPTION, sensors]
        comparison = run_comparison.compare_runs(folders, by, costs, screen.progress)
    study_tables.print_comparison(comparison, top, command)


def _run_sensors(screen: ProgressDisplay, paths: Sequence[Path], sensors: str, overrides: Sequence[str]) -> list[Path]:
    """Run a scenario with each sensor, print one line for each, and return the run folders."""
    from egvs.runs import run
    from egvs.studies import sensor_runs

    if len(paths) > 1:
        problem = f"expected one scenario or run, got {len(paths)}"
        raise InputError(_OPTION, problem, f"Give one of them, or leave out {_OPTION} to compare finished runs.")
    prepared = sensor_runs.prepare_runs(paths[0], sensors, overrides)
    for note in prepared.notes:
        screen.say(f"note: {note}")
    total = len(prepared.runs)
    width = max(len(sensor_run.sensor) for sensor_run in prepared.runs)

    def run_one(number: int, sensor_run: SensorRun) -> None:
        screen.begin_part(f"{sensor_run.sensor} ({number} of {total})")
        run.run(sensor_run.scenario, sensor_run.folder, progress=screen.progress, listener=screen.stage_event)
        screen.say(f"{sensor_run.sensor:<{width}}  {screen.part_duration:>10}   {sensor_run.folder}")

    def leave_out(sensor_run: SensorRun, reason: str) -> None:
        screen.say(f"{sensor_run.sensor:<{width}}  {'left out':>10}   {reason}")

    finished = sensor_runs.run_sensors(prepared, run_one, leave_out)
    screen.end_parts("compare")
    return [sensor_run.folder for sensor_run in finished]
