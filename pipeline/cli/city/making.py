"""``egvs city new`` and ``egvs city traffic``: parse, call, and print what was made."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli import arguments

if TYPE_CHECKING:
    from pipeline.city.new import NewCity
    from pipeline.city.traffic import CityTraffic

_WIDTH = 150


def new(
    folder: Annotated[Path, typer.Argument(metavar="CITY", help="The city's folder, to be made.")],
    osm: Annotated[
        Path, typer.Option(metavar="FILE", help="An OpenStreetMap extract (.osm, .osm.xml, .osm.pbf; may be gzipped).")
    ],
    around: Annotated[
        str | None, typer.Option(metavar="LAT,LON", help="The streets round this place; all by default.")
    ] = None,
    radius: Annotated[
        str | None, typer.Option(metavar="LENGTH", help="For --around: how far, e.g. 1500m; 2km by default.")
    ] = None,
    junctions: Annotated[
        str,
        typer.Option(
            metavar="WHICH", help="signalised, all, or a table (CSV) with columns junction, lat_deg, lon_deg."
        ),
    ] = "signalised",
    lefthand: Annotated[bool, typer.Option("--lefthand", help="Traffic drives on the left.")] = False,
    walk: Annotated[bool, typer.Option("--walk", help="Sidewalks and crossings, for people on foot.")] = False,
) -> None:
    """Make a city from an OpenStreetMap extract: one network, and a scenario for each junction."""
    from pipeline.city import new as making
    from pipeline.cli.progress import Screen

    place = arguments.latitude_and_longitude(around, "--around") if around is not None else None
    reach_m = arguments.length_m(radius, "--radius") if radius is not None else None
    with Screen("city") as screen:
        made = making.new(
            folder, osm, around=place, radius_m=reach_m, which=junctions, lefthand=lefthand, walk=walk,
            progress=screen.progress,
        )  # fmt: skip
    _print_new(made)


def traffic(city: Annotated[Path, typer.Argument(metavar="CITY", help="A folder that egvs city new made.")]) -> None:
    """Simulate a city's traffic once, and cut it to every junction; nothing where it is there already."""
    from pipeline.city import model
    from pipeline.city import traffic as making
    from pipeline.cli.progress import Screen

    read = model.load(city)
    with Screen("traffic") as screen:
        made = making.make(read, screen.progress)
    _print_traffic(read.folder, made)


def _print_new(made: NewCity) -> None:
    from pipeline.cli.terminal import WIDE, console, table

    out = console(WIDE)
    rows = table(("junction", "title", "lanes in", "poles", "sites"), left=("junction", "title"), whole=("junction",))
    for its in made.junctions:
        title, lanes = its.junction.title, str(its.junction.lanes_in)
        rows.add_row(its.id, title, lanes, str(len(its.places)), str(its.sites))
    out.print(rows)
    _print_json({"folder": str(made.folder)} | made.to_json())
    out.print(f"next: egvs city traffic {made.folder}")


def _print_traffic(folder: Path, made: CityTraffic) -> None:
    from pipeline.city import model
    from pipeline.cli.terminal import console
    from pipeline.core.findings import WARNINGS, warnings_of

    out = console(_WIDTH)
    shown = ("frames", "vehicles", "mean_speed_m_s", "share_standing", "frames_with_overlap", "collisions", "notes")
    _print_json({key: made.summary[key] for key in shown if made.summary.get(key) not in (None, [])})
    for name, summary in made.summary.get("periods", {}).items():
        _print_json({name: {key: summary[key] for key in shown if summary.get(key) not in (None, [])}})
    if made.linked:
        out.print(f"{model.JUNCTIONS}/*/scenario.toml: the city's files and periods put into {', '.join(made.linked)}")
    if WARNINGS in made.summary:
        for warning in warnings_of([made.summary]):
            out.print(f"warning: {warning}")
    few = min(made.rows, key=lambda name: made.rows[name])
    many = max(made.rows, key=lambda name: made.rows[name])
    out.print(f"rows: {made.rows[many]:,} at {many} (the most), {made.rows[few]:,} at {few} (the fewest)")
    if not made.anew:
        out.print("nothing to do: neither the traffic nor a region changed")
    out.print(str(folder / "traffic"))


def _print_json(values: Mapping[str, Any]) -> None:
    from pipeline.cli.terminal import console, in_words, value_in_words

    out = console(_WIDTH)
    for key, value in values.items():
        out.print(f"{key}: {in_words(value) if isinstance(value, dict) else value_in_words(value)}")
