"""``egvs city``: create a city, simulate its traffic, run all junctions, and plan sensors for the whole city."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from egvs.cli import options
from egvs.cli.commands import Command
from egvs.core.wording import format_percent, number_of

if TYPE_CHECKING:
    from egvs.cli.console import ProgressDisplay
    from egvs.extensions.city.city_run import CityPlacement, CityRun, CityRunOptions
    from egvs.extensions.city.costs import CityCosts
    from egvs.extensions.city.plan_comparison import PlanComparison
    from egvs.extensions.city.tasks import JobResult
    from egvs.extensions.city.traffic_split import CityTraffic

_WIDTH = 150

CityPath = Annotated[Path, typer.Argument(metavar="CITY", help="A folder created by egvs city new.")]
CityOut = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="DIR",
        help="Folder of the city run; by default runs/<name>, with --set runs/<name>@<what differs>.",
    ),
]
Cluster = Annotated[
    str,
    typer.Option(
        metavar="WHERE",
        help="local (one process per core), processes=N, or a Dask scheduler such as tcp://host:8786.",
    ),
]
Junctions = Annotated[
    list[str] | None, typer.Option("--junction", metavar="ID", help="Only this junction (repeatable); all by default.")
]
CitySet = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override a key of every junction, e.g. score.gamma=2; not for traffic (repeatable).",
    ),
]


def new(
    folder: Annotated[Path, typer.Argument(metavar="CITY", help="Folder of the new city.")],
    osm: Annotated[
        Path,
        typer.Option(
            "--from",
            "--osm",
            metavar="FILE",
            help="An OpenStreetMap extract (.osm, .osm.xml, .osm.pbf, also gzipped or zipped).",
        ),
    ],
    around: Annotated[
        str | None, typer.Option(metavar="LAT,LON", help="Only the streets around this point; all by default.")
    ] = None,
    radius: Annotated[
        str | None, typer.Option(metavar="LENGTH", help="Radius of --around, e.g. 1500m; 2km by default.")
    ] = None,
    junctions: Annotated[
        str,
        typer.Option(
            metavar="WHICH", help="signalised, all, or a CSV table with the columns junction, lat_deg, lon_deg."
        ),
    ] = "signalised",
    lefthand: Annotated[
        bool,
        typer.Option("--lefthand", help="Traffic drives on the left; by default, the map and its position decide."),
    ] = False,
    righthand: Annotated[bool, typer.Option("--righthand", help="Traffic drives on the right.")] = False,
    walk: Annotated[bool, typer.Option("--walk", help="Include sidewalks and crossings, for pedestrians.")] = False,
    traffic: Annotated[
        str,
        typer.Option(
            metavar="LEVEL", help="light, medium or heavy: 40, 75 or 100 % of the flow that the network carries."
        ),
    ] = "medium",
) -> None:
    """Create a city from an OpenStreetMap extract: one network, and a scenario for each junction."""
    from egvs.cli.console import ProgressDisplay

    centre = radius_m = None
    if around is not None:
        centre = options.latitude_and_longitude(around, "--around")
    if radius is not None:
        radius_m = options.length_m(radius, "--radius")
    with ProgressDisplay("city", prints_progress=True) as screen:
        from egvs.extensions.city import creation, new_summary

        new_options = creation.NewCityOptions(
            centre, radius_m, junctions, lefthand, walk, traffic, screen.progress, righthand
        )  # fmt: skip
        created = creation.create_city(folder, osm, new_options)
    new_summary.print_new_city(created)


def traffic(city: CityPath) -> None:
    """Simulate a city's traffic once and divide it among its junctions; skipped if nothing has changed."""
    from egvs.cli.console import ProgressDisplay

    with ProgressDisplay("traffic") as screen:
        from egvs.extensions.city import model, traffic_split

        loaded = model.load_city(city)
        result = traffic_split.make_city_traffic(loaded, screen.progress)
    _print_traffic(loaded.folder, result)


def run(
    city: CityPath,
    out: CityOut = None,
    cluster: Cluster = "local",
    junction: Junctions = None,
    set_: CitySet = None,
    verbose: Annotated[
        bool,
        typer.Option(
            "--verbose", help="Print also the time of each part and stage, and the peak memory of every process."
        ),
    ] = False,
) -> None:
    """Simulate the city's traffic once, then run the scenarios of all junctions in parallel."""
    from egvs.cli.console import ProgressDisplay

    with ProgressDisplay("city") as screen:
        from egvs.extensions.city import city_run, model

        run_options = _run_options(cluster, junction, set_, screen)
        result = city_run.run_city(model.load_city(city), out, run_options)
        for warning in result.warnings:
            screen.say(f"warning: {warning}")
    print_junctions(result)
    if verbose:
        print_costs(result.costs)


def place(
    city: CityPath,
    out: CityOut = None,
    count: Annotated[int | None, typer.Option(metavar="K", min=1, help="Find the best K sensors of the city.")] = None,
    budget: Annotated[
        str | None, typer.Option(metavar="COST", help="Find the best sensors within this total cost (see \\[costs]).")
    ] = None,
    phases: Annotated[
        str | None,
        typer.Option(metavar="K,K,...", help="Sensors after each phase of the installation, e.g. 5,10 for --count 10."),
    ] = None,
    cluster: Cluster = "local",
    junction: Junctions = None,
    set_: CitySet = None,
) -> None:
    """Plan sensors for all junctions together: find the best plan for the whole city."""
    from egvs.cli.console import ProgressDisplay

    with ProgressDisplay("city") as screen:
        from egvs.extensions.city import city_run, model

        run_options = _run_options(cluster, junction, set_, screen)
        numbers = _parse_phases(phases)
        cost = None if budget is None else options.cost(budget)
        placed = city_run.place_city(model.load_city(city), out, run_options, count=count, budget=cost, phases=numbers)
        for warning in placed.city_run.warnings:
            screen.say(f"warning: {warning}")
    print_plan(placed)


def compare(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN RUN...", help="Folders of egvs city place, e.g. one for each traffic demand."),
    ],
) -> None:
    """Compare the plans of several city runs: which sensors stay, and what each plan scores in the others' traffic."""
    from egvs.cli.console import ProgressDisplay
    from egvs.extensions.city import plan_comparison

    with ProgressDisplay("compare") as screen:
        comparison = plan_comparison.compare_plans(runs, screen.progress)
    print_comparison(comparison)


def _parse_phases(text: str | None) -> tuple[int, ...]:
    from egvs.core.errors import InputError

    if text is None:
        return ()
    try:
        return tuple(int(number) for number in text.split(","))
    except ValueError:
        problem = f"expected whole numbers separated by commas, got {text[:80]!r}"
        raise InputError("--phases", problem, "Use, for example, --count 10 --phases 5,10.") from None


def _run_options(
    cluster: str, junctions: list[str] | None, overrides: list[str] | None, screen: ProgressDisplay
) -> CityRunOptions:
    from egvs.extensions.city.city_run import CityRunOptions

    def on_done(done: JobResult) -> None:
        screen.say(describe_done(done))

    return CityRunOptions(cluster, junctions or (), overrides or (), screen.progress, on_done, screen.say)


def _print_traffic(folder: Path, result: CityTraffic) -> None:
    from egvs.cli.console import console
    from egvs.core.errors import WARNINGS_KEY, collect_warnings
    from egvs.extensions.city import model

    out = console(_WIDTH)
    _print_mapping(_shown_statistics(result.summary), _WIDTH)
    for name, summary in result.summary.get("periods", {}).items():
        _print_mapping({name: _shown_statistics(summary)}, _WIDTH)
    if result.linked:
        junctions = ", ".join(result.linked)
        out.print(f"{model.JUNCTIONS_FOLDER}/*/scenario.toml: added the city's files and periods to {junctions}")
    if WARNINGS_KEY in result.summary:
        for warning in collect_warnings([result.summary]):
            out.print(f"warning: {warning}")
    fewest = min(result.rows, key=lambda name: result.rows[name])
    most = max(result.rows, key=lambda name: result.rows[name])
    out.print(f"rows: {result.rows[most]:,} at {most} (the most), {result.rows[fewest]:,} at {fewest} (the fewest)")
    if not result.is_new:
        out.print("nothing to do: neither the traffic nor any region has changed")
    out.print(str(folder / "traffic"))


_STATISTICS = (
    "frames", "vehicles", "mean_speed_m_s", "share_standing", "frames_with_overlap", "collisions", "notes",
)  # fmt: skip


def _shown_statistics(summary: Mapping[str, Any]) -> dict[str, Any]:
    return {key: summary[key] for key in _STATISTICS if summary.get(key) not in (None, [])}


def describe_done(done: JobResult) -> str:
    """Return one line about a finished junction."""
    stages = ", ".join(done.stages_run) or "nothing, all results were up to date"
    return f"{done.junction:<14} {done.seconds:>8.2f} s   {done.sites} sites; ran {stages}"


def print_junctions(city_run: CityRun) -> None:
    """Print the junctions, best first, and the files that were written."""
    from egvs.cli.console import NARROW, WIDE, Column, console, make_table
    from egvs.extensions.city.results import gain_label, has_noticed
    from egvs.results.labels import SCORE_LABELS
    from egvs.scenario.score_config import NOTICED

    by = city_run.results[0].best.by
    gain = gain_label(by.name)
    columns: list[Column[Any]] = [
        Column("rank", lambda row: str(row.rank)),
        Column("junction", lambda row: row.junction.id, "left"),
        Column("title", lambda row: row.junction.title, "left", wrap=True, min_width=NARROW),
        Column("best site", lambda row: row.best.site, "left"),
        Column(gain.head, lambda row: gain.value(row.gain)),
    ]
    if by.head != gain.head:
        columns.append(Column(by.head, lambda row: by.value(row.score)))
    if has_noticed(city_run.results):
        columns.append(Column(SCORE_LABELS[NOTICED].head, lambda row: row.best.noticed_cell))
    if "entropy seen" not in (gain.head, by.head):
        columns.append(Column("entropy seen", lambda row: format_percent(row.best.entropy_seen)))
    columns.append(Column("vehicles", lambda row: f"{row.vehicles:.1f}"))
    columns.append(Column("sites", lambda row: str(row.sites)))

    out = console(WIDE)
    out.print(make_table(columns, city_run.results, width=out.width))
    for path in city_run.files:
        out.print(str(path))


def print_costs(costs: CityCosts) -> None:
    """Print the time of each part and stage of a city run, and the peak memory of every process."""
    from egvs.cli.console import WIDE, Column, console, make_table

    parts: list[Column[Any]] = [
        Column("part", lambda part: f"  {part.part}" if part.within else part.part, "left"),
        Column("seconds", lambda part: f"{part.seconds:.2f}"),
        Column("start s", lambda part: f"{part.start_s:.2f}"),
        Column("end s", lambda part: f"{part.end_s:.2f}"),
    ]
    stages: list[Column[Any]] = [
        Column("stage, at all junctions", lambda stage: stage.stage, "left"),
        Column("seconds", lambda stage: f"{stage.seconds:.2f}"),
        Column("peak MB", lambda stage: f"{stage.peak_mb:.0f}"),
    ]
    processes: list[Column[Any]] = [
        Column("process", lambda process: process.process, "left"),
        Column("host", lambda process: process.host, "left"),
        Column("peak MB", lambda process: f"{process.peak_mb:.0f}"),
        Column("core s", lambda process: "" if process.busy_s is None else f"{process.busy_s:.1f}"),
    ]
    out = console(WIDE)
    out.print(make_table(parts, costs.parts))
    out.print(make_table(stages, costs.stages))
    out.print(make_table(processes, costs.processes))


def print_plan(placed: CityPlacement) -> None:
    """Print the sensors, the certificate, and the files that were written."""
    from egvs.cli.console import WIDE, Column, console, make_table
    from egvs.extensions.city.results import gain_label

    plan = placed.plan
    label = gain_label(plan.rank_by)
    columns: list[Column[Any]] = [
        Column("", lambda sensor: sensor.marked_order),
        Column("junction", lambda sensor: sensor.junction, "left"),
        Column("site", lambda sensor: sensor.site, "left"),
        Column("z m", lambda sensor: f"{sensor.z_m:g}"),
        Column("ccw yaw deg", lambda sensor: f"{sensor.yaw_deg:.1f}"),
        Column("pitch deg", lambda sensor: f"{sensor.pitch_deg:.1f}"),
        Column("sensor", lambda sensor: sensor.sensor, "left"),
        Column("gain", lambda sensor: label.value(sensor.gain)),
        Column("joint score", lambda sensor: label.value(sensor.score)),
        Column("cost", lambda sensor: f"{sensor.cost:g}"),
    ]
    out = console(WIDE)
    out.print(make_table(columns, plan.sensors))
    if any(sensor.forced for sensor in plan.sensors):
        out.print("* already installed")

    cost = f" for {plan.cost:g}" if plan.cost else ""
    share = 0.0
    if plan.joint_of_all > 0:
        share = plan.joint / plan.joint_of_all
    proved = math.floor(plan.certificate * 1e4) / 1e2  # never rounded up
    sensors = number_of(len(plan.sensors), "sensor")
    out.print(
        f"{sensors} at {len(plan.by_junction)} of {plan.junctions} junctions{cost}: "
        f"{label.label} {label.value(plan.joint)}, {format_percent(share)} of the score of all "
        f"{plan.candidates:,} candidates "
        f"together; proved: at least {proved:.2f} % of the best possible score"
    )
    if plan.has_errors:
        last = plan.curve[-1]
        out.print(f"standard error: {label.value(last.score_se)}, from {plan.errors_from}")
    else:
        out.print(f"no standard errors: {plan.errors_from}")
    for phase in plan.by_phase:
        names = ", ".join(f"{sensor.junction} {sensor.site}" for sensor in phase.sensors) or "no sensor"
        error = f" ± {label.value(phase.point.installed_se)}" if plan.has_errors else ""
        out.print(
            f"phase {phase.number}: {names}; then {label.label} {label.value(phase.point.installed)}{error}, "
            f"{format_percent(phase.loss, 2)} below the best plan of {phase.point.limit:g} alone"
        )
    for path in placed.files:
        out.print(str(path))


def print_comparison(comparison: PlanComparison) -> None:
    """Print one row per plan: the sensors that it shares with all others, and its value in the traffic of each run."""
    from egvs.cli.console import WIDE, Column, console, make_table
    from egvs.extensions.city.results import gain_label

    plans, folders = comparison.plans, comparison.folders
    label = gain_label(plans[0].rank_by)
    relative = comparison.relative_values

    def value_column(j: int) -> Column[int]:
        def text(i: int) -> str:
            return f"{label.value(comparison.values[i, j])} ({format_percent(relative[i, j])})"

        return Column(f"in the traffic of {folders[j].name}", text, wrap=True)

    columns: list[Column[int]] = [
        Column("plan", lambda i: folders[i].name, "left"),
        Column("sensors", lambda i: str(len(plans[i].sensors))),
        Column("in all plans", lambda i: format_percent(comparison.common_to_all(i).sensors, 0)),
        Column("same pole", lambda i: format_percent(comparison.common_to_all(i).poles, 0)),
        Column("same junction", lambda i: format_percent(comparison.common_to_all(i).junctions, 0)),
        *(value_column(j) for j in range(len(plans))),
    ]
    out = console(WIDE)
    out.print(make_table(columns, range(len(plans)), width=out.width))
    out.print(f"values: {label.label}; in brackets, relative to the plan that was made for this traffic")
    for i, folder in enumerate(folders):
        for j, other in enumerate(folders):
            if i < j:
                shares = comparison.common(i, [j])
                out.print(
                    f"{folder.name}, {other.name}: {format_percent(shares.sensors, 0)} of the sensors, "
                    f"{format_percent(shares.poles, 0)} of the "
                    f"poles and {format_percent(shares.junctions, 0)} of the junctions in common"
                )


app = typer.Typer(no_args_is_help=True, help="Run every junction of a city, on one machine or a cluster.")

app.command(cls=options.PointCommand)(new)
for verb in (traffic, run, place, compare):
    app.command()(verb)

COMMANDS = (Command("city", "Decide", app),)


def _print_mapping(values: Mapping[str, Any], file_width: int) -> None:
    """Print one line per key; ``file_width`` is that of :func:`console`."""
    from egvs.cli.console import console
    from egvs.cli.value_text import format_value, format_values

    out = console(file_width)
    for key, value in values.items():
        text = format_value(value)
        if isinstance(value, dict):
            text = format_values(value)
        out.print(f"{key}: {text}")
