"""``egvs place``: plan several sensors, and print the plan and what is proved about it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated

import typer

from egvs.cli import options, sources
from egvs.cli.options import Jobs, Out, Set, SettingsPath

if TYPE_CHECKING:
    from rich.table import Table

    from egvs.artefacts.planned_sensor import PlannedSensor
    from egvs.placement.plan import Placement, RefinementSummary
    from egvs.report.formatting import ScoreLabel


def place(
    scenario: SettingsPath,
    out: Out = None,
    count: Annotated[int | None, typer.Option(metavar="K", help="Find the best plan of at most K sensors.")] = None,
    budget: Annotated[
        float | None, typer.Option(metavar="COST", help="Find the best plan within this total cost (see \\[costs]).")
    ] = None,
    reach: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE", help="Find the fewest sensors that reach this share of the score of all candidates."
        ),
    ] = None,
    exact: Annotated[
        bool, typer.Option("--exact", help="Search until the plan is proved optimal or time runs out.")
    ] = False,
    time_limit: Annotated[
        str, typer.Option(metavar="TIME", help="Time limit of --exact, and of the proof for --reach, e.g. 60s or 5m.")
    ] = "60s",
    refine: Annotated[
        bool,
        typer.Option("--refine", help="Afterwards, optimise each pose within the limits of \\[placement.refine]."),
    ] = False,
    set_: Set = None,
    jobs: Jobs = None,
) -> None:
    """Plan several sensors: how many, at which sites, and how close the plan is to the best possible score."""
    from egvs.cli.console import WIDE, ProgressDisplay, console

    limit_s = options.duration_s(time_limit, "--time-limit")
    request = []
    for key, value in (("count", count), ("budget", budget), ("reach", reach)):
        if value is not None:
            request.append(f"placement.{key}={value!r}")
    loaded, folder = sources.open_source(scenario, set_, out, request)
    with ProgressDisplay("place") as screen:
        from egvs.placement import plan

        placed = plan.place(
            loaded, folder, exact=exact, time_limit_s=limit_s, refine=refine, jobs=jobs, progress=screen.progress,
            listener=screen.stage_event,
        )  # fmt: skip
    print_placement(placed)
    if exact and not (placed.solution.is_best or placed.solution.fewest_is_proved):
        console(WIDE).print(f"--exact reached its --time-limit of {time_limit} before any plan was proved optimal")


def print_placement(placed: Placement) -> None:
    """Print the sensors of the plan, the score of each number of sensors, and the certificate."""
    from egvs.cli.console import WIDE, console

    out = console(WIDE)
    out.print(_sensor_table(placed))
    if any(sensor.forced for sensor in placed.sensors):
        out.print("* already installed")
    out.print(_curve_table(placed))
    for zone in placed.zones:
        sensors = f" by {zone.by} sensors" if zone.by > 1 else ""
        out.print(f"zone {zone.name}: {zone.seen:.1%} of its entropy seen{sensors}, {zone.share:.1%} required")
    out.print(describe_plan(placed))
    if placed.refinement is not None:
        out.print(describe_refinement(placed, placed.refinement))
    for path in placed.files:
        out.print(str(path))
    if gain := describe_last_gain(placed):
        out.print(gain)
    if absent := describe_absent_best(placed):
        out.print(absent)


def _sensor_table(placed: Placement) -> Table:
    from egvs.cli.console import Column, make_table

    label = _label(placed)
    columns: list[Column[PlannedSensor]] = [
        Column("", lambda row: row.marked_order),
        Column("site", lambda row: row.site, "left"),
        Column("z m", lambda row: f"{row.z_m:g}"),
        Column("yaw deg", lambda row: f"{row.yaw_deg:.1f}"),
        Column("pitch deg", lambda row: f"{row.pitch_deg:.1f}"),
        Column("sensor", lambda row: row.sensor, "left"),
        Column(f"gain {label.unit}".strip(), lambda row: label.value(row.gain)),
        Column(f"joint score {label.unit}".strip(), lambda row: label.value(row.score)),
        Column("lost if it fails", lambda row: f"{_loss_share(placed, row):.1%}"),
    ]
    if any(placed.curve_costs):
        columns.append(Column("cost", lambda row: f"{row.cost:g}"))
    if placed.refinement is not None:
        columns.append(Column("moved m", lambda row: f"{row.moved_m:.2f}"))
        columns.append(Column("gained by moving", lambda row: label.value(row.gain_by_refining)))
    return make_table(columns, placed.sensors)


def _label(placed: Placement) -> ScoreLabel:
    """Return the name and the unit of the joint score."""
    from egvs.report.formatting import SCORE_LABELS

    return SCORE_LABELS[placed.score]


def _loss_share(placed: Placement, sensor: PlannedSensor) -> float:
    """Return the share of the joint score that is lost if one sensor fails."""
    if not placed.joint > 0:
        return 0.0
    return sensor.loss / placed.joint


def _curve_table(placed: Placement) -> Table:
    from egvs.cli.console import Column, make_table

    curve = placed.solution.curve
    label = _label(placed)
    columns = [
        Column[int]("sensors", lambda i: str(curve[i].count)),
        Column[int](f"joint score {label.unit}".strip(), lambda i: label.value(curve[i].plan_value.joint)),
        Column[int]("of all candidates", lambda i: f"{_score_share(placed, curve[i].plan_value.joint):.1%}"),
        Column[int]("proved, of the best possible score", lambda i: _format_rounded_down(curve[i].certificate)),
    ]
    if any(placed.curve_costs):
        columns.append(Column("cost", lambda i: f"{placed.curve_costs[i]:g}"))
    columns.append(Column("sites", lambda i: ", ".join(placed.curve_sites[i]), "left", wrap=True))
    return make_table(columns, range(len(curve)))


def _score_share(placed: Placement, joint: float) -> float:
    """Return a joint score as a share of that of all candidates together."""
    if not placed.joint_of_all > 0:
        return 0.0
    return joint / placed.joint_of_all


def describe_plan(placed: Placement) -> str:
    """Return the plan and its certificate in one sentence."""
    joint = placed.solution.point.plan_value.joint
    sites = ", ".join(sensor.site for sensor in placed.sensors) or "no sensor"
    cost = f" for {placed.curve_costs[-1]:g}" if placed.curve_costs[-1] else ""
    score = _label(placed).with_noun(joint).removeprefix("the ")
    if placed.joint_of_all > 0:
        share = _score_share(placed, joint)
        score += f", {share:.1%} of the score of all {placed.candidates} candidates together"
    return f"{sites}{cost}: {score}; {_describe_proof(placed)}"


def describe_last_gain(placed: Placement) -> str | None:
    """Return how much the largest plan of the curve adds to the one before it; None if there is nothing to compare."""
    curve = placed.solution.curve
    if len(curve) < 2 or not curve[-2].plan_value.joint > 0:
        return None
    gain = curve[-1].plan_value.joint / curve[-2].plan_value.joint - 1.0
    return f"Going from {curve[-2].count} to {curve[-1].count} sensors adds {gain:.1%}."


def describe_absent_best(placed: Placement) -> str | None:
    """Return a sentence where the best single site is not part of the plan; None where it is, or is not known."""
    first = placed.solution.curve[0]
    if first.count != 1 or len(placed.sensors) < 2:
        return None
    (best,) = placed.curve_sites[0]
    if best in {sensor.site for sensor in placed.sensors}:
        return None
    return (
        f"The best single site, {best}, is not part of this plan: the sites of the plan complement one another better."
    )


def _describe_proof(placed: Placement) -> str:
    solution = placed.solution
    if solution.fewest_is_proved is not None:
        fewer = len(placed.sensors) - 1
        if fewer == 0:
            return "one sensor is enough"
        noun = "sensor is" if fewer == 1 else "sensors are"
        if solution.fewest_is_proved:
            return f"proved: {fewer} {noun} not enough"
        return f"not proved that {fewer} {noun} not enough"
    if solution.is_best:
        return "proved: no plan within the rules is better"
    return f"proved: at least {_format_rounded_down(placed.certificate)} of the best possible score"


def describe_refinement(placed: Placement, summary: RefinementSummary) -> str:
    """Return what the refinement of poses changed."""
    change = cost = objective = ""
    if summary.joint_before > 0:
        change = f" ({placed.joint / summary.joint_before - 1.0:+.1%})"
    if placed.cost:
        cost = f", for {placed.cost:g}"
    if (summary.value_before, summary.value_after) != (summary.joint_before, placed.joint):
        objective = f"; objective {summary.value_before:.6g} before, {summary.value_after:.6g} after"
    label = _label(placed)
    before = label.with_noun(summary.joint_before).removeprefix("the ")
    return (
        f"refined: {before} before, {label.value(placed.joint)} after{change}"
        f"{objective}{cost}; {summary.poses_tried} poses tried in {summary.turns} rounds and {summary.seconds:.1f} s, "
        f"{summary.poses_infeasible} of them infeasible; the proof applies to the candidates at their original poses"
    )


def _format_rounded_down(share: float) -> str:
    """Return a proved share in per cent, never rounded up."""
    if share >= 1.0:
        return "100 %"
    return f"{math.floor(share * 1e4) / 1e2:.2f} %"
