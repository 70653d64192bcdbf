"""``egvs place``: parses, calls, and prints a plan of several sensors with what is proved of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.cli import arguments
from pipeline.cli.arguments import Jobs, Out, ScenarioPath, Set

if TYPE_CHECKING:
    from pipeline.placement.placing import Moves, Placement


def place(
    scenario: ScenarioPath,
    out: Out = None,
    count: Annotated[int | None, typer.Option(metavar="K", help="The best plan of at most K sensors.")] = None,
    budget: Annotated[
        float | None, typer.Option(metavar="COST", help="The best plan that costs no more, see \\[costs].")
    ] = None,
    reach: Annotated[
        float | None,
        typer.Option(metavar="SHARE", help="The fewest sensors that reach this share of what all candidates would."),
    ] = None,
    exact: Annotated[
        bool, typer.Option("--exact", help="Search until the best plan is proved, or the time ends.")
    ] = False,
    time_limit: Annotated[
        str, typer.Option(metavar="TIME", help="Of --exact, and of the proof for --reach, e.g. 60s or 5m.")
    ] = "60s",
    refine: Annotated[
        bool,
        typer.Option("--refine", help="Then let each sensor move within what \\[placement.refine] allows."),
    ] = False,
    set_: Set = None,
    jobs: Jobs = None,
) -> None:
    """Which poles together, how many, and how sure: the best plan of several sensors."""
    from pipeline.cli.progress import Screen
    from pipeline.placement import placing
    from pipeline.runs.workflow import default_folder
    from pipeline.scenario.loading import load

    limit_s = arguments.duration_s(time_limit, "--time-limit")
    given = {"count": count, "budget": budget, "reach": reach}
    sets = [*(set_ or ()), *(f"placement.{key}={value!r}" for key, value in given.items() if value is not None)]
    loaded = load(scenario, sets)
    folder = out or default_folder(loaded)
    with Screen("place") as screen:
        placed = placing.place(
            loaded, folder, exact=exact, time_limit_s=limit_s, refine=refine, jobs=jobs, progress=screen.progress,
            listener=screen.stage_event,
        )  # fmt: skip
    print_placement(placed)
    if exact and not (placed.solution.is_best or placed.solution.fewest_is_proved):
        _say_unfinished(time_limit)


def _say_unfinished(time_limit: str) -> None:
    """That the search for the best plan ended before it was done."""
    from pipeline.cli.terminal import WIDE, console

    console(WIDE).print(f"--exact ended at its --time-limit of {time_limit}, before the best plan was proved")


def print_placement(placed: Placement) -> None:
    """The plan, how much each number of sensors is worth, and what is proved."""
    from pipeline.cli.terminal import WIDE, console, table

    out = console(WIDE)
    names: tuple[str, ...] = (
        "", "site", "z m", "yaw deg", "pitch deg", "sensor", "gain", "joint score", "lost if it fails", "cost",
    )  # fmt: skip
    if placed.moves is not None:
        names += ("moved m", "gained by moving")
    plan = table(names, left=("site", "sensor"), whole=names)
    for number, pick in enumerate(placed.picks, start=1):
        pose = pick.site.pose
        mark = f"{number}*" if pick.is_forced else str(number)
        lost = pick.loss / placed.joint if placed.joint > 0 else 0.0
        plan.add_row(
            mark, pick.site.name, f"{pose.z_m:g}", f"{pose.yaw_deg:.1f}", f"{pose.pitch_deg:.1f}", pick.site.sensor,
            f"{pick.gain:.6g}", f"{pick.score:.6g}", f"{lost:.1%}", f"{pick.cost:g}",
            *(() if placed.moves is None else (f"{pick.moved_m:.2f}", f"{pick.gain_by_refining:.6g}")),
        )  # fmt: skip
    out.print(plan)
    if any(pick.is_forced for pick in placed.picks):
        out.print("* is there already")
    has_costs = any(placed.curve_costs)
    columns = ("sensors", "joint score", "of all", "at least, of the best possible", *["cost"] * has_costs, "sites")
    curve = table(columns, left=("sites",))
    for point, sites, cost in zip(placed.solution.curve, placed.curve_sites, placed.curve_costs, strict=True):
        share = point.worth.joint / placed.together if placed.together > 0 else 0.0
        curve.add_row(
            str(point.count), f"{point.worth.joint:.6g}", f"{share:.1%}", _share(point.certificate),
            *[f"{cost:g}"] * has_costs, ", ".join(sites),
        )  # fmt: skip
    out.print(curve)
    for zone in placed.zones:
        by = f" by {zone.by} sensors" if zone.by > 1 else ""
        out.print(f"zone {zone.name}: {zone.seen:.1%} of its entropy seen{by}, {zone.share:.1%} asked for")
    out.print(in_words(placed))
    if placed.moves is not None:
        out.print(moves_in_words(placed, placed.moves))
    for path in placed.files:
        out.print(str(path))


def in_words(placed: Placement) -> str:
    """The plan and its certificate in one sentence."""
    solution, point = placed.solution, placed.solution.point
    joint, sites = point.worth.joint, ", ".join(pick.site.name for pick in placed.picks) or "no sensor"
    share = (
        f"{joint / placed.together:.1%} of what all {placed.candidates} candidates together would"
        if placed.together > 0
        else "nothing"
    )
    cost = f" for {placed.curve_costs[-1]:g}" if placed.curve_costs[-1] else ""
    plan = f"{sites}{cost}: {placed.score} {joint:.6g}, {share}; "
    if solution.fewest_is_proved is not None:
        if not (fewer := len(placed.picks) - 1):
            return plan + "one sensor is enough"
        return plan + (f"proved: {fewer} cannot" if solution.fewest_is_proved else f"whether {fewer} can is not proved")
    if solution.is_best:
        return plan + "proved: no plan within the rules is better"
    return plan + f"proved: at least {_share(placed.certificate)} of the best possible"


def moves_in_words(placed: Placement, moves: Moves) -> str:
    """What moving its sensors made of the plan."""
    more = f" ({placed.joint / moves.before - 1.0:+.1%})" if moves.before > 0 else ""
    cost = f", for {placed.cost:g}" if placed.cost else ""
    asked = f"; what was asked for {moves.value_before:.6g} before, {moves.value:.6g} after"
    if (moves.value_before, moves.value) == (moves.before, placed.joint):
        asked = ""
    return (
        f"moved: {placed.score} {moves.before:.6g} before, {placed.joint:.6g} after{more}{asked}{cost}; "
        f"{moves.tried} poses tried in {moves.turns} turns and {moves.seconds:.1f} s, "
        f"{moves.impossible} of them impossible; what is proved holds for candidates as they are given"
    )


def _share(share: float) -> str:
    """A share that is proved, never rounded up."""
    import math

    return "100 %" if share >= 1.0 else f"{math.floor(share * 1e4) / 1e2:.2f} %"
