"""The command line: parses, calls, prints; nothing else.

Heavy modules are imported by the verb that needs them, so that ``egvs --help`` answers at once.
"""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.core.errors import EgvsError, InputError
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

_INTERRUPTED = 130
"""Exit code after Ctrl-C."""

ScenarioPath = Annotated[Path, typer.Argument(metavar="SCENARIO", help="A folder with a scenario.toml, or the file.")]
Out = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="The run's folder; runs/<scenario name> by default.")
]
Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override one value, e.g. traffic.frames=500.")
]
Jobs = Annotated[
    int | None, typer.Option("--jobs", min=1, help="Threads; one a core by default. Results do not depend on it.")
]
Audit = Annotated[bool, typer.Option("--audit", help="Check every beam's chords, and print the worst case.")]


def main() -> None:
    """Entry point: errors of this program become one message and an exit code."""
    try:
        app()
    except EgvsError as error:
        _fail(str(error), error.exit_code)
    except OSError as error:
        _fail(f"{error.filename or 'system'}: {error.strerror or error}", 1)
    except SystemExit as end:  # typer's own way to end, of an interrupt too
        if end.code == _INTERRUPTED:
            _fail("interrupted; run the same command again to go on from the last whole stage", _INTERRUPTED)
        raise


def _fail(message: str, code: int) -> None:
    print(f"egvs: {message}", file=sys.stderr)
    sys.exit(code)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"egvs {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options of every verb."""
    del version


@app.command()
def run(scenario: ScenarioPath, out: Out = None, set_: Set = None, jobs: Jobs = None, audit: Audit = False) -> None:
    """Everything, in order; stages whose inputs did not change are skipped."""
    from pipeline.cli import screen as show
    from pipeline.runs import workflow

    resolved = _load(scenario, set_)
    folder = out or workflow.default_folder(resolved)
    with show.Screen() as screen:
        extra = {"score": {"audit": True}} if audit else None
        record = workflow.run(
            resolved, folder, jobs=jobs, progress=screen.progress, listener=screen.told, options=extra
        )
    screen.result(folder, record)


def _one(
    stage: str, scenario: Path, out: Path | None, set_: list[str] | None, jobs: int | None = None, **extra: Any
) -> None:
    """Run one stage and say what came of it."""
    from pipeline.cli import screen as show
    from pipeline.runs import workflow

    resolved = _load(scenario, set_)
    folder = out or workflow.default_folder(resolved)
    with show.Screen() as screen:
        record = workflow.run_one(
            stage, resolved, folder, jobs=jobs, progress=screen.progress, listener=screen.told, **extra
        )
    screen.stage(folder, stage, record)


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
    extra: dict[str, Any] = {"traci": _address(traci)} if traci is not None else {}
    _one("traffic", scenario, out, set_, **extra)


@app.command()
def statics(scenario: ScenarioPath, out: Out = None, set_: Set = None) -> None:
    """Build the static world: statics.ply."""
    _one("statics", scenario, out, set_)


@app.command()
def tpog(scenario: ScenarioPath, out: Out = None, set_: Set = None) -> None:
    """Count occupancy: tpog.parquet."""
    _one("tpog", scenario, out, set_)


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
    _one("scan", scenario, out, set_, jobs, **extra)


@app.command()
def score(scenario: ScenarioPath, out: Out = None, set_: Set = None, jobs: Jobs = None, audit: Audit = False) -> None:
    """Score and rank the sites: scores.parquet."""
    _one("score", scenario, out, set_, jobs, **({"audit": True} if audit else {}))


@app.command()
def report(scenario: ScenarioPath, out: Out = None, set_: Set = None) -> None:
    """Draw the report: report.html."""
    _one("report", scenario, out, set_)


@app.command()
def verify(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The folder of a finished run.")],
    scenario: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="The scenario's folder, if it is not where the run found it.")
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Run again what DIR/run.json says, and compare every artefact byte for byte."""
    from pipeline.cli import screen as show
    from pipeline.runs import workflow

    with show.Screen() as screen:
        wrong = workflow.verify(folder, scenario, jobs=jobs, progress=screen.progress, listener=screen.told)
    screen.verdict(folder, wrong)
    if wrong:
        raise typer.Exit(1)


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
    from pipeline.cli import screen as show
    from pipeline.runs import workflow
    from pipeline.studies import accuracy as what_it_costs

    resolved = _load(scenario, set_)
    folder = out or workflow.default_folder(resolved)
    with show.Screen("accuracy") as screen:
        found = what_it_costs.study(
            scenario, set_ or (), folder, tolerance=tolerance, budget_s=_seconds(budget), seeds=seeds, jobs=jobs,
            progress=screen.progress, listener=screen.setting,
        )  # fmt: skip
    show.accuracy(found, _again("run", scenario, set_))


@app.command()
def sensors() -> None:
    """Print the sensor catalogue."""
    from pipeline.cli import screen as show
    from pipeline.sensing.sensors import CATALOGUE

    show.catalogue(CATALOGUE.values())


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
    from pipeline.cli import screen as show
    from pipeline.runs import workflow
    from pipeline.studies import ablation as ablations
    from pipeline.studies import effect_overview

    if scenario is None:
        if ablation:
            raise InputError("--ablation", "without a scenario", "egvs effects SCENARIO --ablation")
        show.effects(effect_overview.catalogue())
        return
    resolved = _load(scenario, set_)
    folder = out or workflow.default_folder(resolved)
    prices, calls = effect_overview.prices(resolved, folder), effect_overview.called(resolved)
    show.effects(calls, prices)
    untold = [
        call.name
        for call in calls
        if call.state == "on" and call.name in resolved.effects and call.name not in (prices or {})
    ]
    if prices is None or untold:
        what = "they" if prices is None else ", ".join(untold)
        print(f"what {what} cost and change: {_again('accuracy', scenario, set_, out)}, or --ablation")
    if ablation:
        if not resolved.effects:
            raise InputError(
                "--ablation", "the scenario names no effect", "name one, e.g. --set effects.rain.rate_mm_h=20"
            )
        with show.Screen() as screen:
            changes = ablations.ablation(resolved, folder, jobs=jobs, progress=screen.progress)
        show.ablation(changes)


@app.command()
def new(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="The scenario's folder, to be made.")],
    osm: Annotated[Path, typer.Option(metavar="FILE", help="An OpenStreetMap extract (.osm, .osm.xml).")],
    at: Annotated[
        str | None, typer.Option(metavar="LAT,LON", help="The junction nearest to this place; the largest by default.")
    ] = None,
    lefthand: Annotated[bool, typer.Option("--lefthand", help="Traffic drives on the left.")] = False,
) -> None:
    """Make a scenario from an OpenStreetMap extract."""
    from pipeline.cli import screen as show
    from pipeline.importers import openstreetmap as from_osm

    show.summary(folder, from_osm.new(folder, osm, _place(at) if at is not None else None, lefthand=lefthand))


def _load(path: Path, set_: list[str] | None) -> Scenario:
    from pipeline.scenario.loading import load

    return load(path, set_ or ())


def _again(verb: str, scenario: Path, set_: list[str] | None, out: Path | None = None) -> str:
    """A command that can be typed."""
    words = ["egvs", verb, str(scenario), *(word for one in set_ or () for word in ("--set", one))]
    return shlex.join([*words, "--out", str(out)] if out is not None else words)


def _seconds(text: str) -> float:
    units = {"s": 1.0, "m": 60.0, "h": 3600.0, "": 1.0}
    found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)([smh]?)", text)
    seconds = float(found[1]) * units[found[2]] if found else 0.0
    if not 0 < seconds < float("inf"):
        raise InputError("--budget", repr(text), "a time above 0 with one unit, for example 90s, 10m or 1.5h")
    return seconds


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise InputError("--traci", repr(text), "HOST:PORT, for example localhost:8813")
    return host, int(port)


def _place(text: str) -> tuple[float, float]:
    try:
        lat, lon = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError("--at", repr(text), "LAT,LON in degrees, for example 50.8704,9.7080") from None
    return lat, lon


@app.command()
def store(
    prune: Annotated[bool, typer.Option("--prune", help="Remove the entries used longest ago, down to --max.")] = False,
    most: Annotated[
        str | None, typer.Option("--max", metavar="SIZE", help="For --prune, e.g. 2G; EGVS_STORE_MAX_GB by default.")
    ] = None,
    clear: Annotated[bool, typer.Option("--clear", help="Remove every entry.")] = False,
) -> None:
    """What earlier runs made and what of it is kept; a run fetches from there what it would make again."""
    from pipeline.cli import store_table
    from pipeline.runs.store import Store

    if most is not None and not prune:
        raise InputError("--max", "without --prune", "egvs store --prune --max 2G")
    kept = Store.default()
    if clear or prune:
        bound = -1.0 if clear else kept.bound_bytes if most is None else store_table.bytes_of(most)
        store_table.print_removed(kept, kept.prune(bound))
    else:
        store_table.print_store(kept)
