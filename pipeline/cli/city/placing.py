"""``egvs city place``: parses, calls, and prints the sensors of a city in the order in which they would be put up."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.cli.city.running import CityOut, CityPath, CitySet, Cluster, Junctions, told_done

if TYPE_CHECKING:
    from pipeline.city.city_place import CityPlacement


def place(
    city: CityPath,
    out: CityOut = None,
    count: Annotated[int | None, typer.Option(metavar="K", min=1, help="The best K sensors of the whole city.")] = None,
    budget: Annotated[
        float | None, typer.Option(metavar="COST", help="The best sensors that cost no more, see \\[costs].")
    ] = None,
    cluster: Cluster = "local",
    junction: Junctions = None,
    set_: CitySet = None,
) -> None:
    """Which poles over all junctions together: the best plan of the whole city."""
    from pipeline.city import city_place, model
    from pipeline.cli.progress import Screen

    with Screen("city") as screen:
        placed = city_place.place(
            model.load(city), out, count=count, budget=budget, where=cluster, only=junction or (), sets=set_ or (),
            progress=screen.progress, heard=lambda done: screen.say(told_done(done)),
        )  # fmt: skip
        for warning in placed.ran.warnings:
            screen.say(f"warning: {warning}")
    print_plan(placed)


def print_plan(placed: CityPlacement) -> None:
    """The sensors, what is proved of them, and what was written."""
    from pipeline.city.results.words import gain_words
    from pipeline.cli.terminal import WIDE, console, table

    out, plan = console(WIDE), placed.plan
    words = gain_words(plan.rank_by)
    names = ["", "junction", "site", "z m", "yaw deg", "pitch deg", "sensor", "adds", "together", "cost"]
    rows = table(names, left=("junction", "site", "sensor"), whole=names)
    for s in plan.sensors:
        rows.add_row(
            f"{s.order}*" if s.forced else str(s.order), s.junction, s.site, f"{s.z_m:g}", f"{s.yaw_deg:.1f}",
            f"{s.pitch_deg:.1f}", s.sensor, words.value(s.gain), words.value(s.score), f"{s.cost:g}",
        )  # fmt: skip
    out.print(rows)
    if any(sensor.forced for sensor in plan.sensors):
        out.print("* is there already")
    cost = f" for {plan.cost:g}" if plan.cost else ""
    share = plan.joint / plan.together if plan.together > 0 else 0.0
    where = f"{len(plan.sensors)} sensors at {len(plan.by_junction)} of {plan.junctions} junctions{cost}"
    worth = f"{words.label} {words.value(plan.joint)}, {share:.1%} of what all {plan.candidates:,} candidates would"
    out.print(f"{where}: {worth}; proved: at least {_floored(plan.certificate)} % of the best possible")
    for path in placed.files:
        out.print(str(path))


def _floored(share: float) -> str:
    """A share that is proved in per cent, never rounded up."""
    return f"{math.floor(share * 1e4) / 1e2:.2f}"
