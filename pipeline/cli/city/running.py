"""``egvs city run``: parses, calls, and prints the junctions, the best first."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pipeline.city.city_run import CityRun
    from pipeline.city.running.jobs import Done

CityPath = Annotated[Path, typer.Argument(metavar="CITY", help="A folder that egvs city new made.")]
CityOut = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="The folder of the city's run; runs/<name> by default.")
]
Cluster = Annotated[
    str,
    typer.Option(
        metavar="WHERE",
        help="local: a process a core of this machine; processes=N of them; or a scheduler, tcp://host:8786.",
    ),
]
Junctions = Annotated[
    list[str] | None, typer.Option("--junction", metavar="ID", help="This junction only; all by default. Repeatable.")
]

CitySet = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Override one value of every junction, e.g. score.gamma=2; not of the traffic.",
    ),
]


def run(
    city: CityPath,
    out: CityOut = None,
    cluster: Cluster = "local",
    junction: Junctions = None,
    set_: CitySet = None,
) -> None:
    """Run every junction: the traffic once, then all of them on the processes of a cluster."""
    from pipeline.city import city_run, model
    from pipeline.cli.progress import Screen

    with Screen("city") as screen:
        ran = city_run.run(
            model.load(city), out, where=cluster, only=junction or (), sets=set_ or (), progress=screen.progress,
            heard=lambda done: screen.say(told_done(done)),
        )  # fmt: skip
        for warning in ran.warnings:
            screen.say(f"warning: {warning}")
    print_junctions(ran)


def told_done(done: Done) -> str:
    """A junction that is done, in one line."""
    made = ", ".join(done.made) or "nothing, all was there"
    return f"{done.junction:<14} {done.seconds:>8.2f} s   {done.sites} sites; made {made}"


def print_junctions(ran: CityRun) -> None:
    """The junctions, the best first, and what was written; no titles where the terminal is narrow."""
    from pipeline.city.results.words import gain_words
    from pipeline.cli.terminal import NARROW, WIDE, console, table

    out, by = console(WIDE), ran.results[0].best.by
    gain = gain_words(by.name)
    shown = ("rank", "junction", "title", "best site", gain.head, by.head, "entropy seen", "vehicles", "sites")
    names = [name for name in dict.fromkeys(shown) if name != "title" or out.width >= NARROW]
    rows = table(names, left=("junction", "title", "best site"), whole=[name for name in names if name != "title"])
    for its in ran.results:
        best = its.best
        cells = {
            "rank": str(its.rank), "junction": its.junction.id, "title": its.junction.title, "best site": best.site,
            "entropy seen": f"{best.entropy_seen:.1%}", "sites": str(its.sites), by.head: by.value(its.score),
            gain.head: gain.value(its.gain), "vehicles": f"{its.vehicles:.1f}",
        }  # fmt: skip
        rows.add_row(*(cells[name] for name in names))
    out.print(rows)
    for path in ran.files:
        out.print(str(path))
