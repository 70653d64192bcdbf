"""``egvs export`` and ``egvs figure``: parse, call, and print what was written."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli import arguments
from pipeline.cli.arguments import Run


def export(
    run: Run,
    to: Annotated[str, typer.Option(metavar="FORMAT", help="gpkg, geojson, geoparquet, kml, csv or geotiff.")],
    crs: Annotated[
        str | None,
        typer.Option(
            metavar="CRS", help="scenario (its reference system) or wgs84 (degrees); what is usual for the format."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE|DIR", help="A file (gpkg, kml), else a folder; RUN/export by default."),
    ] = None,
    site: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SITE", help="Of geotiff: what this site sees and misses; the best by default. Repeatable."
        ),
    ] = None,
) -> None:
    """Take a run along: sites, plan, blind spots and footprints for any map or spreadsheet, or rasters."""
    from pipeline.cli.progress import Screen
    from pipeline.export import exporting

    with Screen("export") as screen:
        done = exporting.export(run, to, crs=crs, out=out, sites=site or (), progress=screen.progress)
    for note in done.notes:
        print(note)
    print(f"positions in {done.reference}")
    for path in done.paths:
        print(path)


def figure(
    run: Run,
    what: Annotated[str, typer.Option(metavar="FIGURE", help="ranking, map, tpog, seen or missed.")],
    site: Annotated[
        str | None, typer.Option(metavar="SITE", help="Of seen and missed: whose; the best site's by default.")
    ] = None,
    kind: Annotated[str, typer.Option("--format", metavar="FORMAT", help="pdf, png or svg.")] = "pdf",
    size: Annotated[str, typer.Option(metavar="WIDTH", help="On paper: 85mm is a column, 170mm a page.")] = "85mm",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="RUN/export/FIGURE.FORMAT by default.")
    ] = None,
) -> None:
    """Draw a figure of a run for a paper or a slide."""
    from pipeline.cli.progress import Screen
    from pipeline.export.paper import figure as figures

    width_mm = arguments.width_mm(size, figures.NARROWEST_MM, figures.WIDEST_MM)
    with Screen("figure") as screen:
        path = figures.draw(run, what, site=site, kind=kind, width_mm=width_mm, out=out, progress=screen.progress)
    print(path)
