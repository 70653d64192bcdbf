"""``egvs compare``: compare finished runs, or runs of a scenario with several sensors or other heights of buildings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from egvs.core import files, plugins
from egvs.core.errors import InputError

if TYPE_CHECKING:
    from egvs.cli.console import ProgressDisplay
    from egvs.studies.assumed_heights import HeightRun
    from egvs.studies.sensor_runs import SensorRun

GROUP = "egvs.traffic_comparisons"
"""Entry points of what ``--tpog`` calls: a function of the recorded and the simulated run, the page, and the number of
lanes that are printed (None for all)."""

_OPTION = "--sensors"
_HEIGHTS_OPTION = "--assumed-heights"
_TPOG_OPTION = "--tpog"
_COSTS = "costs."
_LABEL_WIDTH = 10


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
    assumed_heights: Annotated[
        bool,
        typer.Option(
            _HEIGHTS_OPTION,
            help="Run the scenario also with all assumed heights of buildings 30 % lower and higher, and say which of "
            "the best five sites change.",
        ),
    ] = False,
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
            "scenario, for all runs, e.g. effects.range_limit=false (repeatable).",
        ),
    ] = None,
    tpog: Annotated[
        Path | None,
        typer.Option(
            _TPOG_OPTION,
            metavar="PAGE.html",
            help="Compare the traffic of two runs, a recorded and a simulated one: distances by lane, entropy, ranks."
            " Writes a page with both maps.",
        ),
    ] = None,
    top: Annotated[
        int | None,
        typer.Option("--top", metavar="N", min=1, help="Number of poles, sites or lanes to print; by default 5."),
    ] = None,
) -> None:
    """Which sensor? Compare sensors or runs: the best mount of each pole, costs, and settings."""
    from egvs.cli.console import ProgressDisplay

    overrides = set_ or []
    if tpog is not None:
        for option, value in ((_OPTION, sensors), (_HEIGHTS_OPTION, assumed_heights or None), ("--set", set_)):
            if value:
                raise InputError(_TPOG_OPTION, f"cannot be used together with {option}", "Use one of them.")
        _compare_tpogs(runs, tpog, top)
        return
    if assumed_heights:
        if sensors is not None:
            problem = f"cannot be used together with {_OPTION}"
            raise InputError(_HEIGHTS_OPTION, problem, "Set sites.replace_sensor for another sensor.")
        _compare_heights(runs, overrides)
        return
    costs = list(overrides)
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
        comparison = run_comparison.compare_runs(folders, by, costs, screen.progress)
    study_tables.print_comparison(comparison, top)


def _compare_tpogs(runs: Sequence[Path], page: Path, top: int | None) -> None:
    """Compare the traffic of two runs by an extension, which prints the numbers and writes a page."""
    from egvs.traffic import traffic_sources

    if len(runs) != 2:
        problem = f"expected two runs, the recorded and the simulated one, got {len(runs)}"
        raise InputError(_TPOG_OPTION, problem, "Give their folders, in this order.")
    if page.suffix != ".html":
        raise InputError(_TPOG_OPTION, f"expected a file PAGE.html to write, got {page}", "Use --tpog traffic.html.")
    files.check_writable(page)
    names = plugins.plugin_names(GROUP)
    if not names:
        raise traffic_sources.missing_extension(_TPOG_OPTION)
    compare_traffic = plugins.load_plugin(GROUP, names[0])
    compare_traffic(runs[0], runs[1], page, top)


def _compare_heights(paths: Sequence[Path], overrides: Sequence[str]) -> None:
    """Run a scenario with several heights of buildings, print one line for each, and which sites change."""
    from egvs.cli import study_tables
    from egvs.cli.console import ProgressDisplay
    from egvs.studies import assumed_heights

    path = _single_path(paths, _HEIGHTS_OPTION)
    with ProgressDisplay("compare") as screen:
        prepared = assumed_heights.prepare_runs(path, overrides)
        total = len(prepared.runs)

        def run_one(number: int, height_run: HeightRun) -> None:
            title, label = f"heights {height_run.label} ({number} of {total})", f"{height_run.label:<{_LABEL_WIDTH}}"
            screen.run_part(title, label, height_run.scenario, height_run.folder)

        if prepared.assumed:
            sensitivity = assumed_heights.compare_heights(prepared, run_one)
        screen.end_parts("compare")
    if prepared.assumed:
        study_tables.print_height_sensitivity(sensitivity)
    else:
        study_tables.print_no_assumed_height(prepared)


def _single_path(paths: Sequence[Path], option: str) -> Path:
    """Return the only path; InputError if there are several."""
    if len(paths) > 1:
        problem = f"expected one scenario or run, got {len(paths)}"
        raise InputError(option, problem, f"Give one of them, or leave out {option} to compare finished runs.")
    return paths[0]


def _run_sensors(screen: ProgressDisplay, paths: Sequence[Path], sensors: str, overrides: Sequence[str]) -> list[Path]:
    """Run a scenario with each sensor, print one line for each, and return the run folders."""
    from egvs.studies import sensor_runs

    prepared = sensor_runs.prepare_runs(_single_path(paths, _OPTION), sensors, overrides)
    for note in prepared.notes:
        screen.say(f"note: {note}")
    total = len(prepared.runs)
    width = max(len(sensor_run.sensor) for sensor_run in prepared.runs)

    def run_one(number: int, sensor_run: SensorRun) -> None:
        title, label = f"{sensor_run.sensor} ({number} of {total})", f"{sensor_run.sensor:<{width}}"
        screen.run_part(title, label, sensor_run.scenario, sensor_run.folder)

    def leave_out(sensor_run: SensorRun, reason: str) -> None:
        screen.say(f"{sensor_run.sensor:<{width}}  {'left out':>10}   {reason}")

    finished = sensor_runs.run_sensors(prepared, run_one, leave_out)
    screen.end_parts("compare")
    return [sensor_run.folder for sensor_run in finished]
