"""The command line ``egvs``: each verb parses its options, calls the program, and prints the result.

Verbs with several tables are in modules of their own, which are imported when they are called
(:mod:`egvs.cli.commands`); those of extensions are found through entry points. Heavy modules are imported by the verb
that needs them, so that ``egvs --help`` is quick.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from egvs._version import __version__
from egvs.cli import environment, exit
from egvs.cli import options as cli_options
from egvs.cli.commands import ExtensibleGroup
from egvs.cli.options import (
    Audit,
    Detector,
    Jobs,
    Out,
    Rehash,
    Run,
    ScenarioPath,
    Set,
    SettingsPath,
    Top,
    Verbose,
)
from egvs.core.errors import InputError

if TYPE_CHECKING:
    from egvs.creation.new_scenario import NewScenarioOptions
    from egvs.explore.page_file import PageFile
    from egvs.scenario.model import Scenario
    from egvs.studies.effect_study import EffectStatus


app = typer.Typer(
    name="egvs",
    cls=ExtensibleGroup,
    help="Rank candidate sites for roadside LiDARs by how well they see the traffic.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def main() -> None:
    """Run the command line; errors of this program become one message and an exit code."""
    with exit.report_errors(), exit.after_imports():
        environment.check_environment(sys.argv[1:])
        app()


def _print_version(requested: bool) -> None:
    if requested:
        print(f"egvs {__version__}")
        raise typer.Exit


@app.callback()
def global_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Define the options that come before the verb."""
    del version


def _load(path: Path, overrides: Sequence[str] | None, out: Path | None) -> tuple[Scenario, Path]:
    """Return the scenario with its overrides, and the folder of its run."""
    from egvs.runs.run import default_folder
    from egvs.scenario.loading import load

    scenario = load(path, overrides or ())
    return scenario, out or default_folder(scenario)


# ---- a run and its stages


@app.command()
def run(
    scenario: ScenarioPath,
    out: Out = None,
    detector: Detector = None,
    set_: Set = None,
    jobs: Jobs = None,
    audit: Audit = False,
    top: Annotated[
        int | None, typer.Option("--top", metavar="N", min=1, help="Number of poles to print; by default 3 to 5.")
    ] = None,
    all_: Annotated[bool, typer.Option("--all", help="Print the complete ranking of all sites and poles.")] = False,
    count: Annotated[
        int | None, typer.Option(metavar="K", min=1, help="Afterwards plan at most K sensors, as egvs place does.")
    ] = None,
    verbose: Verbose = False,
    rehash: Rehash = False,
) -> None:
    """Run all stages in order and print the best poles; stages with unchanged inputs are skipped."""
    from egvs.cli.console import ProgressDisplay

    stage_options = {"score": {"audit": True}} if audit else None
    with ProgressDisplay("run", with_details=verbose, is_run=True) as screen:
        from egvs.cli import answer, run_tables
        from egvs.runs.run import run, run_rehashed

        loaded, folder = _load(scenario, cli_options.with_detector(set_, detector), out)
        screen.flow_source = answer.flow_source(loaded)
        run_all = run_rehashed if rehash else run
        record = run_all(
            loaded, folder, jobs=jobs, progress=screen.progress, listener=screen.stage_event, options=stage_options
        )
        if not screen.any_stage_ran:
            screen.say("no stage ran: no input has changed since the last run")
    if all_:
        run_tables.print_scores(folder, loaded, record, before_answer=True)
    if verbose:
        run_tables.print_costs(folder, record)
    run_tables.print_audit(record)
    answer.print_answer(
        folder, loaded, record, poles=top, with_details=verbose or all_, lines_before=screen.warning_lines
    )
    if count is not None:
        from egvs.cli.place import place

        print()
        place(folder, count=count, jobs=jobs)


@app.command()
def demo(
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="The new folder for the scenario and its results.")
    ] = Path("egvs-demo"),
    jobs: Jobs = None,
) -> None:
    """Try it: rank eight sites at a roundabout in about a minute, with traffic simulated in advance."""
    from egvs.cli.console import ProgressDisplay

    with ProgressDisplay("demo", is_run=True) as screen:
        from egvs.cli import answer, run_tables
        from egvs.runs.run import run
        from egvs.scenario import shipped
        from egvs.scenario.loading import load

        shipped.copy_scenario(shipped.DEMO, folder)
        results, loaded = folder / "results", load(folder)
        screen.flow_source = answer.flow_source(loaded)
        record = run(loaded, results, jobs=jobs, progress=screen.progress, listener=screen.stage_event)
    answer.print_answer(results, loaded, record, lines_before=screen.warning_lines)
    run_tables.print_demo_hints(results)


@app.command()
def check(
    scenario: SettingsPath,
    set_: Set = None,
    verbose: Annotated[
        bool,
        typer.Option("--verbose", help="Print all poles, and what protects this machine from the scenario's files."),
    ] = False,
) -> None:
    """Check a scenario before a run: print poles, signal plans, all errors and warnings. No files are written."""
    from egvs.cli import run_tables
    from egvs.core import sandbox
    from egvs.runs.run_sources import SettingsSource
    from egvs.stages import check

    loaded = SettingsSource.of(scenario, set_).load()
    checked = check.check_scenario(loaded)
    run_tables.print_check(checked, with_details=verbose)
    if not checked.errors:
        run_tables.print_mounts(loaded)
        run_tables.print_signals(loaded)
    if verbose:
        run_tables.print_protections(sandbox.missing_protections())
    if checked.errors:
        raise typer.Exit(InputError.exit_code)


@app.command()
def traffic(
    scenario: ScenarioPath,
    out: Out = None,
    set_: Set = None,
    jobs: Jobs = None,
    traci: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Record from a running SUMO, started with --remote-port."),
    ] = None,
) -> None:
    """Simulate the traffic with SUMO and write trajectories.parquet."""
    stage_options: dict[str, Any] = {}
    if traci is not None:
        stage_options["traci"] = cli_options.parse_host_and_port(traci)
    _run_stage("traffic", scenario, out, set_, jobs, **stage_options)


@app.command()
def statics(scenario: ScenarioPath, out: Out = None, set_: Set = None) -> None:
    """Build the static world and write statics.ply."""
    _run_stage("statics", scenario, out, set_)


@app.command()
def tpog(scenario: ScenarioPath, out: Out = None, set_: Set = None) -> None:
    """Count how often each voxel is occupied by traffic, and write tpog.parquet."""
    _run_stage("tpog", scenario, out, set_)


@app.command()
def scan(
    scenario: ScenarioPath,
    out: Out = None,
    set_: Set = None,
    jobs: Jobs = None,
    points: Annotated[
        list[str] | None,
        typer.Option(metavar="SITE", help="Also write the empty scan of this site as a point cloud (repeatable)."),
    ] = None,
    cloud: Annotated[str, typer.Option(metavar="FORMAT", help="Format of --points: ply or pcd.")] = "ply",
) -> None:
    """Simulate an empty scan (without traffic) from every site, and write scans.parquet."""
    if cloud not in ("ply", "pcd"):
        raise InputError("--cloud", f"expected ply or pcd, got {cloud!r}", "Use --cloud ply.")
    stage_options: dict[str, Any] = {}
    if points:
        stage_options = {"points": tuple(points), "cloud": cloud}
    _run_stage("scan", scenario, out, set_, jobs, **stage_options)


@app.command()
def score(
    scenario: ScenarioPath,
    out: Out = None,
    detector: Detector = None,
    set_: Set = None,
    jobs: Jobs = None,
    audit: Audit = False,
    top: Top = None,
) -> None:
    """Score and rank the sites, and write scores.parquet."""
    stage_options: dict[str, Any] = {"audit": True} if audit else {}
    overrides = cli_options.with_detector(set_, detector)
    _run_stage("score", scenario, out, overrides, jobs, top, **stage_options)


@app.command()
def report(scenario: SettingsPath, out: Out = None, set_: Set = None) -> None:
    """Write the report of a run, report.html."""
    from egvs.cli.sources import open_source

    _run_stage("report", scenario, out, set_, open_source=open_source)


def _run_stage(
    stage: str,
    scenario: Path,
    out: Path | None,
    set_: list[str] | None,
    jobs: int | None = None,
    top: int | None = None,
    open_source: Callable[..., tuple[Scenario, Path]] = _load,
    **stage_options: Any,
) -> None:
    """Run one stage and print the files that it wrote; ``open_source`` returns the scenario and its run folder."""
    from egvs.cli.console import ProgressDisplay

    with ProgressDisplay(stage, with_details=True) as screen:
        from egvs.cli import answer, run_tables
        from egvs.runs import run

        loaded, folder = open_source(scenario, set_, out)
        screen.flow_source = answer.flow_source(loaded)
        record = run.run_one(
            stage, loaded, folder, jobs=jobs, progress=screen.progress, listener=screen.stage_event, **stage_options
        )
    run_tables.print_stage_files(folder, loaded, stage, record, top=top)


@app.command()
def verify(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a finished run.")],
    scenario: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="The scenario's folder, if it has moved since the run.")
    ] = None,
    jobs: Jobs = None,
) -> None:
    """Repeat the run recorded in DIR/run.json, and compare every artefact byte for byte."""
    from egvs.cli.console import ProgressDisplay

    with ProgressDisplay("verify") as screen:
        from egvs.cli import run_tables
        from egvs.runs import verification

        differences = verification.verify(
            folder, scenario, jobs=jobs, progress=screen.progress, listener=screen.stage_event
        )
    run_tables.print_verification(folder, differences)
    if differences:
        raise typer.Exit(1)


# ---- studies


@app.command()
def accuracy(
    scenario: SettingsPath,
    out: Out = None,
    set_: Set = None,
    jobs: Jobs = None,
    tolerance: Annotated[
        float,
        typer.Option(metavar="POINTS", help="Largest expected loss to accept, in percentage points of vehicles found."),
    ] = 1.0,
    score_tolerance: Annotated[
        float | None,
        typer.Option(metavar="SHARE", help="Instead, the largest relative error of the score, e.g. 0.02 for 2 %."),
    ] = None,
    budget: Annotated[str, typer.Option(metavar="TIME", help="Time limit of the study, e.g. 60s or 10m.")] = "2m",
    seeds: Annotated[
        int | None,
        typer.Option(help="Number of seeds of the scenario (at least 4), whatever the budget; by default 4 to 8."),
    ] = None,
) -> None:
    """Price the choice of a pole: seconds and expected loss of many settings, and the cheapest one that suffices."""
    from egvs.cli import sources
    from egvs.cli.console import ProgressDisplay

    budget_s = cli_options.duration_s(budget)
    _, folder = sources.open_source(scenario, set_, out)
    with ProgressDisplay("accuracy") as screen:
        from egvs.cli import accuracy_table
        from egvs.results.studies import Tolerance
        from egvs.studies.accuracy import StudyOptions, run_accuracy_study

        options = StudyOptions(Tolerance(tolerance, score_tolerance), budget_s, seeds, jobs)
        study = run_accuracy_study(
            scenario, set_ or (), folder, options, progress=screen.progress, listener=screen.setting_event
        )
    path, overrides, _ = sources.run_arguments(scenario, set_, out)
    accuracy_table.print_study(study, cli_options.shell_command("run", path, overrides))


@app.command()
def effects(
    scenario: Annotated[
        Path | None,
        typer.Argument(metavar="[SCENARIO|RUN]", help="A scenario or a run; without it, all effects are listed."),
    ] = None,
    set_: Set = None,
    ablation: Annotated[
        bool,
        typer.Option("--ablation", help="Run the scenario with each of its effects alone, and print what it changes."),
    ] = False,
    out: Out = None,
    jobs: Jobs = None,
) -> None:
    """List the effects; with a scenario, show which are enabled or recommended, why, and what they change."""
    from egvs.cli import run_tables, sources
    from egvs.cli.console import ProgressDisplay
    from egvs.studies import effect_study

    if scenario is None:
        if ablation:
            raise InputError("--ablation", "used without a scenario", "Run egvs effects SCENARIO --ablation.")
        run_tables.print_effects(effect_study.effect_catalogue())
        return

    loaded, folder = sources.open_source(scenario, set_, out)
    with ProgressDisplay("effects") as screen:
        costs = effect_study.effect_costs(loaded, folder)
        statuses = effect_study.effect_statuses(loaded, folder, screen.progress)
    run_tables.print_effects(statuses, costs)

    path, overrides, run_out = sources.run_arguments(scenario, set_, out)
    if any(status.change == effect_study.UNTRIED for status in statuses):
        command = cli_options.shell_command("run", path, overrides, run_out)
        print(f"to measure the expected changes, first run: {command}")
    if recommended := [f"effects.{status.name}={{}}" for status in statuses if status.state == "called for"]:
        command = cli_options.shell_command("run", path, [*overrides, *recommended], run_out)
        print(f"to run with all recommended effects: {command}")
    if unmeasured := _unmeasured_effects(statuses, costs, loaded):
        study = cli_options.shell_command("accuracy", scenario, set_, out)
        print(f"to measure the cost and effect of {unmeasured}: {study}, or use --ablation")

    if not ablation:
        return
    if not loaded.effects.named:
        raise InputError("--ablation", "the scenario has no effects", "Add one, e.g. --set effects.rain.rate_mm_h=20.")
    with ProgressDisplay("effects") as screen:
        changes = effect_study.run_ablation(loaded, folder, jobs=jobs, progress=screen.progress)
    run_tables.print_ablation(changes)


def _unmeasured_effects(statuses: Sequence[EffectStatus], costs: Collection[str] | None, scenario: Scenario) -> str:
    """Return the named effects without a measured cost, as text; empty if there is none."""
    if costs is None:
        return "them"
    active = [status.name for status in statuses if status.state == "on" and status.name in scenario.effects.named]
    return ", ".join(name for name in active if name not in costs)


# ---- the explorer


@app.command()
def explore(
    context: typer.Context,
    folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="RUN|SCENARIO",
            help="Folder of a run, or a scenario, which is run first; without it, the page of egvs desk is opened.",
        ),
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page on this machine; 0 for any.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
    out: Out = None,
    set_: Set = None,
    jobs: Jobs = None,
    view: Annotated[
        str, typer.Option(metavar="LINK", help='View to open, copied from "Link to this view" in the page.')
    ] = "",
    to: Annotated[
        Path | None,
        typer.Option(metavar="PAGE.html", help="Write the 3D view as one file to share, and serve no page."),
    ] = None,
) -> None:
    """Move sensors in the browser and see their new scores immediately; or write the 3D view as one file."""
    import webbrowser

    from egvs.cli.console import ProgressDisplay
    from egvs.core import files, plugins

    if folder is None:
        if to is not None or out is not None or set_ or jobs or view:
            raise InputError("RUN|SCENARIO", "no folder is given", "Name a run or a scenario.")
        _open_start_page(context, port, browser=browser)
        return
    plugins.require_libraries("egvs explore", "explore", "viser", "PIL")
    from egvs.cli import answer, sources
    from egvs.explore import page_file
    from egvs.explore.page import Page, check_port_free
    from egvs.explore.settings import open_session

    if to is None:
        check_port_free(port)
    else:
        if port or view:
            raise InputError("--to", "cannot be combined with --port or --view", "Leave them out: no page is served.")
        page_file.check_page_file(to)
    scenario, _ = sources.open_source(folder, set_, out)
    with ProgressDisplay("explore") as screen:
        screen.flow_source = answer.flow_source(scenario)
        session = open_session(
            folder, set_ or (), out, jobs=jobs, progress=screen.progress, listener=screen.stage_event
        )  # fmt: skip
        if to is not None:
            written = page_file.write_page_file(session, to, screen.progress)
    if to is not None:
        _print_page_file(written)
        return
    command = cli_options.command_words("explore", folder, set_, out)
    with files.temporary_folder() as scratch:
        page = Page(session, scratch, port, tuple(command))
        try:
            if view:
                page.open_link(view, "--view")
            print(f"{page.address}  (press Ctrl-C to stop)", flush=True)
            if browser:
                webbrowser.open(page.address)
            page.run()
        except KeyboardInterrupt:  # the normal way to stop
            print()
        finally:
            page.stop()


def _open_start_page(context: typer.Context, port: int, *, browser: bool) -> None:
    """Call ``egvs desk``, a command of an extension."""
    group = context.find_root()
    command = group.command.get_command(group, "desk")  # type: ignore[attr-defined]
    if command is None:
        raise InputError("RUN|SCENARIO", "no folder is given", "Name a run or a scenario.")
    command.callback(folder=Path(), port=port, browser=browser)


def _print_page_file(page: PageFile) -> None:
    """Print where the 3D view of a run was written, and what is in it."""
    drawn = f"{page.returns:,} returns on road users"
    if page.returns_drawn < page.returns:
        drawn += f", {page.returns_drawn:,} of them drawn"
    sensors = ", ".join(page.sensors)
    print(f"{page.path}  ({page.size_bytes / 1e6:.1f} MB; {page.duration_s:.0f} s of traffic from {sensors}; {drawn})")


# ---- files of a run


@app.command()
def export(
    run: Run,
    to: Annotated[
        str, typer.Option(metavar="FORMAT", help="gpkg, geojson, geoparquet, kml, csv, geotiff, dxf, glb or usd.")
    ],
    crs: Annotated[
        str | None,
        typer.Option(metavar="CRS", help="scenario or wgs84; by default the one that is usual for the format."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE|DIR", help="A file (gpkg, kml, dxf) or a folder; RUN/export by default."),
    ] = None,
    site: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SITE", help="For geotiff: a site whose view is exported (repeatable); default: the best."
        ),
    ] = None,
) -> None:
    """Export a run for GIS, CAD and 3D: sites, plan, blind spots and footprints, rasters, a site plan, a scene."""
    from egvs.cli.console import ProgressDisplay
    from egvs.export import export

    with ProgressDisplay("export") as screen:
        exported = export.export_run(run, to, crs=crs, out=out, sites=site or (), progress=screen.progress)
    for note in exported.notes:
        print(note)
    print(f"positions in {exported.reference}")
    for path in exported.paths:
        print(path)


@app.command()
def figure(
    run: Run,
    what: Annotated[str, typer.Option(metavar="FIGURE", help="Required: ranking, map, tpog, seen or missed.")] = "",
    site: Annotated[
        str | None, typer.Option(metavar="SITE", help="For seen and missed: the site; the best one by default.")
    ] = None,
    kind: Annotated[str, typer.Option("--format", metavar="FORMAT", help="pdf, png or svg.")] = "pdf",
    size: Annotated[
        str, typer.Option(metavar="WIDTH", help="Width on paper, e.g. 85mm (a column) or 170mm (a page).")
    ] = "85mm",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="File to write; RUN/export/FIGURE.FORMAT by default.")
    ] = None,
) -> None:
    """Draw a figure of a run for a paper or slides."""
    from egvs.cli.console import ProgressDisplay
    from egvs.export import figure

    if not what:
        raise InputError("--what", f"expected one of {', '.join(figure.FIGURES)}", "Use --what ranking.")
    width_mm = cli_options.width_mm(size, figure.MIN_WIDTH_MM, figure.MAX_WIDTH_MM)
    with ProgressDisplay("figure") as screen:
        path = figure.draw_figure(run, what, site=site, kind=kind, width_mm=width_mm, out=out, progress=screen.progress)
    print(path)


# ---- scenarios, sensors, cached results


@app.command()
def sensors(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME|FILE]...",
            help="Print all that is known of these sensors, with the sources; of a file of beams (.csv, .json), what is"
            " read.",
        ),
    ] = None,
    scenario: Annotated[
        Path | None, typer.Option(metavar="SCENARIO", help="Know the sensors of this scenario, too.")
    ] = None,
) -> None:
    """List the sensor catalogue; with names or files of beams, print the details of these sensors."""
    from egvs.cli import run_tables
    from egvs.scenario.loading import load
    from egvs.sensors.beam_files import is_beam_file, read_beam_file
    from egvs.sensors.sensor import CATALOGUE, check_sensor_names, scenario_sensor

    loaded = None if scenario is None else load(scenario)
    custom = {} if loaded is None else {name: scenario_sensor(name, loaded, "NAME") for name in loaded.sensors}
    if not names:
        run_tables.print_sensors([*custom.values(), *CATALOGUE.values()])
        return
    files = {name: read_beam_file(Path(name)) for name in names if is_beam_file(name)}
    check_sensor_names((name for name in names if name not in files), custom, "NAME")
    for name in names:
        if name in files:
            run_tables.print_beam_file(Path(name), files[name])
        else:
            run_tables.print_sensor_details([custom[name] if name in custom else CATALOGUE[name]], loaded)


_RECORDED, _RARE = "Recorded traffic and signals", "For special cases"
"""Panels of ``egvs new --help`` below the options that most scenarios need."""


@app.command(cls=cli_options.NewCommand)
def new(
    folder: Annotated[
        Path | None, typer.Argument(metavar="FOLDER", help="Folder of the new scenario; not with --list.")
    ] = None,
    more: Annotated[
        list[Path] | None, typer.Argument(metavar="[FILE]...", help="Further map files or folders.")
    ] = None,
    maps: Annotated[
        list[Path] | None,
        typer.Option(
            "--from",
            "--osm",
            metavar="FILE",
            help="A map, or a folder of maps: roads (OpenStreetMap, SUMO, .sumocfg, OpenDRIVE, Lanelet2), and what"
            " stands beside them. Several files: --from A B C.",
        ),
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON",
            help="The junction at this point; else the nearest one with signals within 40 m, or without within 100 m."
            " X,Y in metres if the road map has no reference system. Default: the largest junction with signals.",
        ),
    ] = None,
    list_: Annotated[
        bool,
        typer.Option(
            "--list",
            help="List the junctions of the road map: names, arms, signals, --at. With --at, the nearest first."
            " Nothing is written.",
        ),
    ] = False,
    download: Annotated[
        bool,
        typer.Option(
            "--download",
            help="Download the OpenStreetMap extract around --at LAT,LON from an Overpass server.",
        ),
    ] = False,
    traffic: Annotated[
        str | None,
        typer.Option(
            metavar="LEVEL",
            help="light, medium (default) or heavy: 40, 75 or 100 % of the flow that the junction can carry, up to the"
            " usual flow for its road classes.",
        ),
    ] = None,
    counts: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Instead of assumed traffic: your counts, a table with columns street, approach (the side on which"
            " vehicles arrive), turn, start and count; docs/scenarios.md.",
        ),
    ] = None,
    poles: Annotated[
        str | None,
        typer.Option(
            metavar="every METRES|existing",
            help="Candidate poles along all kerbs of the region at this spacing, e.g. every 20m, instead of at most 12"
            " spread over the arms of the junction. existing: the lamps, signal masts and utility poles of the map.",
        ),
    ] = None,
    surroundings: Annotated[
        str | None,
        typer.Option(
            metavar="METRES",
            help="Simulate the streets within this radius of the junction, or 'all'; 300 by default for OpenStreetMap,"
            " 'all' for other maps.",
        ),
    ] = None,
    run_: Annotated[
        bool, typer.Option("--run", help="Run the new scenario at once, as egvs run does, up to the ranking.")
    ] = False,
    tracks: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Recorded tracks of road users, or a folder of them, instead of simulated traffic. Several files on"
            " one clock: --tracks A --tracks B.",
            rich_help_panel=_RECORDED,
        ),
    ] = None,
    like: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Recorded tracks, or a folder of them, from which turning counts, fleet, speeds and gaps of simulated"
            " traffic are estimated.",
            rich_help_panel=_RECORDED,
        ),
    ] = None,
    pedestrian_tracks: Annotated[
        list[Path] | None,
        typer.Option(
            "--pedestrian-tracks",
            metavar="FILE",
            help="Recorded tracks of people on foot and on bicycles, or a folder of them, beside simulated vehicles."
            " Give the signals that they were recorded under by --signals.",
            rich_help_panel=_RECORDED,
        ),
    ] = None,
    signals: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Recorded signals of the junction, and a file that assigns their groups to lanes (KML or CSV); without"
            " one, it is guessed from the tracks. --signals A --signals B.",
            rich_help_panel=_RECORDED,
        ),
    ] = None,
    track_columns: Annotated[
        Path | None,
        typer.Option(
            "--track-columns",
            metavar="FILE",
            help="TOML file that names the columns of tracks in a table of your own (CSV or JSON lines).",
            rich_help_panel=_RECORDED,
        ),
    ] = None,
    track_crs: Annotated[
        str | None,
        typer.Option(
            "--track-crs",
            metavar="CRS",
            help="Coordinate system of the tracks, if it is not the one of their format: e.g. EPSG:25832, or 'world'"
            " for metres of the road map.",
            rich_help_panel=_RECORDED,
        ),
    ] = None,
    vehicles_per_hour: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Instead of --traffic: vehicles per hour that pass the junction, in all.",
            rich_help_panel=_RARE,
        ),
    ] = None,
    walk: Annotated[
        bool, typer.Option("--walk", help="Include sidewalks and crossings, for pedestrians.", rich_help_panel=_RARE)
    ] = False,
    lefthand: Annotated[
        bool,
        typer.Option(
            "--lefthand",
            help="Traffic drives on the left; by default, the map and its position decide.",
            rich_help_panel=_RARE,
        ),
    ] = False,
    righthand: Annotated[
        bool, typer.Option("--righthand", help="Traffic drives on the right.", rich_help_panel=_RARE)
    ] = False,
    align: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y=LAT,LON",
            help="A point of the files without a reference system, in metres, and where it is; give two points.",
            rich_help_panel=_RARE,
        ),
    ] = None,
    surface: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="A raster of the heights of roofs and trees. With a terrain, buildings without a height get their"
            " height from it.",
            rich_help_panel=_RARE,
        ),
    ] = None,
    overpass_url: Annotated[
        str | None,
        typer.Option(
            "--overpass",
            metavar="URL",
            help="Overpass server for --download; default: EGVS_OVERPASS_URL, or overpass-api.de.",
            rich_help_panel=_RARE,
        ),
    ] = None,
) -> None:
    """Create a scenario from maps of roads, buildings and other objects."""
    from egvs.cli import new_summary
    from egvs.creation import new_scenario
    from egvs.creation.assumed_traffic import DEFAULT_TRAFFIC
    from egvs.creation.new_scenario import NewScenarioOptions

    paths = [*(maps or []), *(more or [])]
    if list_:
        others = {
            "--download": download, "--surroundings": surroundings, "--traffic": traffic, "--run": run_,
            "--vehicles-per-hour": vehicles_per_hour, "--counts": counts, "--poles": poles, "--tracks": tracks,
            "--like": like, "--signals": signals, "--align": align, "--surface": surface, "--overpass": overpass_url,
            "--pedestrian-tracks": pedestrian_tracks, "--track-columns": track_columns, "--track-crs": track_crs,
        }  # fmt: skip
        for option in filter(others.get, others):
            raise InputError(option, "has no effect with --list", "Remove one of them.")
        if maps and folder is not None and not folder.exists():
            raise InputError(folder, "there is no such map, and --list makes no folder", "Leave the name out.")
        maps_given = [*(maps or []), *([folder] if folder else []), *(more or [])]  # --from A B takes B for the folder
        near = None if at is None else cli_options.latitude_and_longitude(at)
        _list_junctions(maps_given, NewScenarioOptions(lefthand=lefthand, righthand=righthand, walk=walk), near)
        return
    if folder is None:
        raise InputError("FOLDER", "no folder is given", "Name the folder of the new scenario, or use --list.")
    if not paths and not download:
        hint = "Give a map of the roads, such as --from town.osm, or --at LAT,LON --download."
        raise InputError("--from", "no map is given", hint)
    if overpass_url is not None and not download:
        raise InputError("--overpass", "has no effect without --download", "Add --download.")
    location = None if at is None else cli_options.latitude_and_longitude(at)
    surroundings_m = None if surroundings is None else cli_options.radius_m(surroundings)
    if traffic is not None and vehicles_per_hour is not None:
        raise InputError("--traffic", "cannot be combined with --vehicles-per-hour", "Use one of them.")
    if counts is not None and (traffic is not None or vehicles_per_hour is not None):
        key = "--traffic" if traffic is not None else "--vehicles-per-hour"
        raise InputError(key, "has no effect on counted traffic (--counts)", "Use one of them.")
    if (tracks or like) and (traffic is not None or vehicles_per_hour is not None):
        key = "--traffic" if traffic is not None else "--vehicles-per-hour"
        source = "--tracks" if tracks else "--like"
        raise InputError(key, f"has no effect on recorded traffic ({source})", "Use one of them.")
    demand: str | int = traffic or DEFAULT_TRAFFIC
    if vehicles_per_hour is not None:
        demand = vehicles_per_hour
    pole_spacing_m = None if poles is None else cli_options.pole_spacing_m(poles)
    options = NewScenarioOptions(
        lefthand=lefthand, righthand=righthand, walk=walk, surroundings_m=surroundings_m, traffic=demand,
        pole_spacing_m=pole_spacing_m, existing_poles=poles == "existing",
        align=tuple(cli_options.point_pair(text) for text in align or []), surface=tuple(surface or []),
        tracks=tuple(tracks or ()), like=tuple(like or ()), signals=tuple(signals or ()), track_crs=track_crs,
        track_columns=track_columns, pedestrian_tracks=tuple(pedestrian_tracks or ()), counts=counts,
    )  # fmt: skip
    notes = []
    if download:
        extract = new_scenario.download_map(folder, location, options, overpass_url)
        paths.append(extract.path)
        notes.append(extract.note)
    scenario = new_scenario.create_scenario(folder, paths, location, options)
    new_summary.print_new_scenario(scenario, notes)
    if run_:
        run(folder)


def _list_junctions(paths: Sequence[Path], options: NewScenarioOptions, at: tuple[float, float] | None = None) -> None:
    from egvs.cli import new_summary
    from egvs.cli.console import ProgressDisplay
    from egvs.creation.new_scenario import list_junctions

    if not paths:
        raise InputError("--from", "no map is given", "Give a map of the roads, such as --from town.osm.")
    with ProgressDisplay("new", prints_progress=True) as screen:
        listed = list_junctions(paths, options, screen.progress, at)
    new_summary.print_junctions(listed)


@app.command()
def runs(
    folder: Annotated[
        Path | None, typer.Argument(metavar="[FOLDER]", help="Folder that contains run folders; runs by default.")
    ] = None,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Print a paragraph for each run, with all settings that differ.")
    ] = False,
) -> None:
    """List the runs: state, the best site, size and age; the latest run first."""
    from egvs.artefacts.run_folder import RUNS
    from egvs.cli import run_list_table
    from egvs.runs import run_list

    run_list_table.print_runs(run_list.list_runs(folder or RUNS), with_details=verbose)


@app.command()
def store(
    prune: Annotated[
        bool, typer.Option("--prune", help="Remove the least recently used entries beyond --max.")
    ] = False,
    max_size: Annotated[
        str | None,
        typer.Option("--max", metavar="SIZE", help="Limit for --prune, e.g. 2G; default: EGVS_STORE_MAX_GB."),
    ] = None,
    clear: Annotated[bool, typer.Option("--clear", help="Remove all entries.")] = False,
) -> None:
    """List or remove the cached results of earlier runs."""
    from egvs.cli import run_tables
    from egvs.runs.store import Store

    if clear and prune:
        raise InputError("--clear", "cannot be combined with --prune", "Use --clear alone to remove all entries.")
    if max_size is not None and not prune:
        raise InputError("--max", "used without --prune", "Run egvs store --prune --max 2G.")
    cache = Store.default()
    cache.check(changed=clear or prune)
    if not clear and not prune:
        run_tables.print_store(cache)
        return
    bound_bytes = cache.bound_bytes
    if clear:
        bound_bytes = -1.0
    elif max_size is not None:
        bound_bytes = cli_options.size_bytes(max_size)
    run_tables.print_removed(cache, cache.prune(bound_bytes))
