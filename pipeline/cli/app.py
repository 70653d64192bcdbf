"""The verbs of the command line: each parses, calls, prints; nothing else.

Heavy modules are imported by the verb that needs them, so that ``egvs --help`` answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli import arguments, ending, explore, export, interrupts, placement
from pipeline.cli.arguments import Audit, Jobs, Out, ScenarioPath, Set, Top
from pipeline.cli.city import group as city
from pipeline.cli.validation import verbs as validation
from pipeline.core.errors import InputError
from pipeline.core.version import __version__

if TYPE_CHECKING:
    from pipeline.scenario.models import Scenario

app = typer.Typer(
    name="egvs",
    help="Rank candidate sites of roadside LiDARs by the Entropy-Guided Visibility Score.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Entry point: errors of this program become one message and an exit code."""
    with ending.told(), interrupts.after_imports():
        app()


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"egvs {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options of every verb."""
    del version


# ---- the whole run, and single stages


@app.command()
def run(
    scenario: ScenarioPath,
    out: Out = None,
    set_: Set = None,
    jobs: Jobs = None,
    audit: Audit = False,
    top: Top = None,
) -> None:
    """Everything, in order; stages whose inputs did not change are skipped."""
    from pipeline.cli import results
    from pipeline.cli.progress import Screen
    from pipeline.runs import workflow

    resolved, folder = _resolved(scenario, set_, out)
    extra = {"score": {"audit": True}} if audit else None
    with Screen() as screen:
        record = workflow.run(
            resolved, folder, jobs=jobs, progress=screen.progress, listener=screen.stage_event, options=extra
        )
    results.print_run(folder, record, anything_ran=screen.any_stage_ran, top=top)


@app.command()
def check(scenario: ScenarioPath, set_: Set = None) -> None:
    """Is the scenario sound? Everything that can be told before a run, at once; writes nothing."""
    from pipeline.checks import checking
    from pipeline.cli import results
    from pipeline.scenario.loading import load

    checked = checking.check(load(scenario, set_ or ()))
    results.print_check(checked)
    if checked.errors:
        raise typer.Exit(InputError.exit_code)


@app.command()
def traffic(
    scenario: ScenarioPath,
    out: Out = None,
    set_: Set = None,
    traci: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Record from a SUMO that is already running with --remote-port."),
    ] = None,
) -> None:
    """Simulate traffic with SUMO: trajectories.parquet."""
    extra: dict[str, Any] = {"traci": arguments.host_and_port(traci)} if traci is not None else {}
    _run_stage("traffic", scenario, out, set_, **extra)


@app.command()
def statics(scenario: ScenarioPath, out: Out = None, set_: Set = None) -> None:
    """Build the static world: statics.ply."""
    _run_stage("statics", scenario, out, set_)


@app.command()
def tpog(scenario: ScenarioPath, out: Out = None, set_: Set = None) -> None:
    """Count occupancy: tpog.parquet."""
    _run_stage("tpog", scenario, out, set_)


@app.command()
def scan(
    scenario: ScenarioPath,
    out: Out = None,
    set_: Set = None,
    jobs: Jobs = None,
    points: Annotated[
        list[str] | None,
        typer.Option(metavar="SITE", help="Also write this site's empty scan as a point cloud. Repeatable."),
    ] = None,
    cloud: Annotated[str, typer.Option(metavar="FORMAT", help="Format of --points: ply or pcd.")] = "ply",
) -> None:
    """Cast an empty scan from every site: scans.parquet."""
    if cloud not in ("ply", "pcd"):
        raise InputError("--cloud", repr(cloud), "ply or pcd")
    extra: dict[str, Any] = {"points": tuple(points), "cloud": cloud} if points else {}
    _run_stage("scan", scenario, out, set_, jobs, **extra)


@app.command()
def score(
    scenario: ScenarioPath,
    out: Out = None,
    set_: Set = None,
    jobs: Jobs = None,
    audit: Audit = False,
    top: Top = None,
) -> None:
    """Score and rank the sites: scores.parquet."""
    _run_stage("score", scenario, out, set_, jobs, top, **({"audit": True} if audit else {}))


@app.command()
def report(scenario: ScenarioPath, out: Out = None, set_: Set = None) -> None:
    """Draw the report: report.html."""
    _run_stage("report", scenario, out, set_)


def _run_stage(
    stage: str,
    scenario: Path,
    out: Path | None,
    set_: list[str] | None,
    jobs: int | None = None,
    top: int | None = None,
    **extra: Any,
) -> None:
    """Run one stage and print what it wrote."""
    from pipeline.cli import results
    from pipeline.cli.progress import Screen
    from pipeline.runs import workflow

    resolved, folder = _resolved(scenario, set_, out)
    with Screen() as screen:
        record = workflow.run_one(
            stage, resolved, folder, jobs=jobs, progress=screen.progress, listener=screen.stage_event, **extra
        )
    results.print_stage(folder, stage, record, top=top)


# ---- runs that exist already


@app.command()
def verify(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The folder of a finished run.")],
    scenario: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="The scenario's folder, if it is not where the run found it.")
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Run again what DIR/run.json says, and compare every artefact byte for byte."""
    from pipeline.cli import results
    from pipeline.cli.progress import Screen
    from pipeline.runs import workflow

    with Screen() as screen:
        differences = workflow.verify(
            folder, scenario, jobs=jobs, progress=screen.progress, listener=screen.stage_event
        )
    results.print_verification(folder, differences)
    if differences:
        raise typer.Exit(1)


@app.command()
def compare(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN RUN...", help="Folders of finished runs, two or more.")],
    top: Top = None,
) -> None:
    """Runs side by side: scores, ranks, how well they agree, and what differs in their settings."""
    from pipeline.cli.studies import comparison_tables
    from pipeline.studies import run_comparison

    comparison_tables.print_comparison(run_comparison.compare(runs), top)


# ---- studies: many runs of one scenario


@app.command()
def accuracy(
    scenario: ScenarioPath,
    out: Out = None,
    set_: Set = None,
    jobs: Jobs = None,
    tolerance: Annotated[
        float, typer.Option(help="Largest error of the recommended setting, a share: 0.02 is 2 %.")
    ] = 0.02,
    budget: Annotated[str, typer.Option(metavar="TIME", help="How long the study may take, e.g. 60s or 10m.")] = "10m",
    seeds: Annotated[
        int,
        typer.Option(
            min=0, help="Also check the standard errors by so many independent runs, at least 2; takes its own time."
        ),
    ] = 0,
) -> None:
    """What accuracy costs in time, and the cheapest setting within a tolerance."""
    from pipeline.cli.progress import Screen
    from pipeline.cli.studies import accuracy_tables
    from pipeline.studies.accuracy import study

    _, folder = _resolved(scenario, set_, out)
    with Screen("accuracy") as screen:
        outcome = study(
            scenario,
            set_ or (),
            folder,
            tolerance=tolerance,
            budget_s=arguments.duration_s(budget),
            seeds=seeds,
            jobs=jobs,
            progress=screen.progress,
            listener=screen.setting_event,
        )
    accuracy_tables.print_study(outcome, arguments.command("run", scenario, set_))


@app.command()
def effects(
    scenario: Annotated[
        Path | None, typer.Argument(metavar="[SCENARIO]", help="Without it: which effects exist.")
    ] = None,
    set_: Set = None,
    ablation: Annotated[
        bool, typer.Option("--ablation", help="Run each named effect alone, and show what it changes.")
    ] = False,
    out: Out = None,
    jobs: Jobs = None,
) -> None:
    """Print which effects exist; for a scenario, which it calls for, and why."""
    from pipeline.cli import tables
    from pipeline.cli.progress import Screen
    from pipeline.studies import ablation as ablations
    from pipeline.studies import effect_overview

    if scenario is None:
        if ablation:
            raise InputError("--ablation", "without a scenario", "egvs effects SCENARIO --ablation")
        tables.print_effects(effect_overview.catalogue())
        return
    resolved, folder = _resolved(scenario, set_, out)
    with Screen() as screen:
        prices = effect_overview.prices(resolved, folder)
        calls = effect_overview.called(resolved, folder, screen.progress)
    tables.print_effects(calls, prices)
    if any(call.change == effect_overview.UNTRIED for call in calls):
        print(f"to measure what each would change, first: {arguments.command('run', scenario, set_, out)}")
    if wanted := [f"effects.{call.name}={{}}" for call in calls if call.state == "called for"]:
        print(f"with what is called for: {arguments.command('run', scenario, [*(set_ or ()), *wanted], out)}")
    on = [call.name for call in calls if call.state == "on" and call.name in resolved.effects.named]
    unpriced = [name for name in on if name not in (prices or {})]
    if prices is None or unpriced:
        what = "they" if prices is None else ", ".join(unpriced)
        print(f"what {what} cost and change: {arguments.command('accuracy', scenario, set_, out)}, or --ablation")
    if ablation:
        if not resolved.effects.named:
            raise InputError(
                "--ablation", "the scenario names no effect", "name one, e.g. --set effects.rain.rate_mm_h=20"
            )
        with Screen() as screen:
            changes = ablations.ablation(resolved, folder, jobs=jobs, progress=screen.progress)
        tables.print_ablation(changes)


# which poles together? moved by hand; does a score foretell detection? and a run taken along
for verb in (placement.place, explore.explore, *validation.VERBS, export.export, export.figure):
    app.command()(verb)

# every junction of a city
app.add_typer(city.app, name="city")


# ---- catalogues, and scenarios to begin with


@app.command()
def sensors() -> None:
    """Print the sensor catalogue."""
    from pipeline.cli import tables
    from pipeline.sensing.sensors import CATALOGUE

    tables.print_sensors(CATALOGUE.values())


@app.command()
def new(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="The scenario's folder, to be made.")],
    osm: Annotated[
        Path, typer.Option(metavar="FILE", help="An OpenStreetMap extract (.osm, .osm.xml, .osm.pbf; may be gzipped).")
    ],
    at: Annotated[
        str | None, typer.Option(metavar="LAT,LON", help="The junction nearest to this place; the largest by default.")
    ] = None,
    lefthand: Annotated[bool, typer.Option("--lefthand", help="Traffic drives on the left.")] = False,
    walk: Annotated[bool, typer.Option("--walk", help="Sidewalks and crossings, for people on foot.")] = False,
    surroundings: Annotated[
        str | None,
        typer.Option(
            metavar="METRES", help="How far from the junction streets are simulated: 300 by default; 'all' for no cut."
        ),
    ] = None,
) -> None:
    """Make a scenario from an OpenStreetMap extract."""
    from pipeline.cli import results
    from pipeline.importers import openstreetmap

    place = arguments.latitude_and_longitude(at) if at is not None else None
    reach = openstreetmap.SURROUNDINGS_M if surroundings is None else arguments.radius_m(surroundings)
    made = openstreetmap.new(folder, osm, place, lefthand=lefthand, walk=walk, surroundings_m=reach)
    results.print_new_scenario(made)


@app.command()
def store(
    prune: Annotated[bool, typer.Option("--prune", help="Remove the entries used longest ago, down to --max.")] = False,
    most: Annotated[
        str | None, typer.Option("--max", metavar="SIZE", help="For --prune, e.g. 2G; EGVS_STORE_MAX_GB by default.")
    ] = None,
    clear: Annotated[bool, typer.Option("--clear", help="Remove every entry.")] = False,
) -> None:
    """What earlier runs made and what of it is kept; a run fetches from there what it would make again."""
    from pipeline.cli import tables
    from pipeline.runs.store import Store

    if clear and prune:
        raise InputError("--clear", "with --prune", "one of them: --clear removes every entry, --prune the oldest")
    if most is not None and not prune:
        raise InputError("--max", "without --prune", "egvs store --prune --max 2G")
    kept = Store.default()
    kept.check(changed=clear or prune)
    if clear or prune:
        bound = -1.0 if clear else kept.bound_bytes if most is None else arguments.size_bytes(most)
        tables.print_removed(kept, kept.prune(bound))
    else:
        tables.print_store(kept)


def _resolved(path: Path, set_: list[str] | None, out: Path | None) -> tuple[Scenario, Path]:
    """The scenario with ``--set`` laid over it, and the run's folder."""
    from pipeline.runs.workflow import default_folder
    from pipeline.scenario.loading import load

    scenario = load(path, set_ or ())
    return scenario, out or default_folder(scenario)
