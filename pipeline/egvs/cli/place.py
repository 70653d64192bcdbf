"""``egvs place``: plan several sensors, and print the plan and what is proved about it."""

from __future__ import annotations

import glob
import math
import textwrap
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from egvs.cli import options, sources
from egvs.cli.options import Detector, Jobs, Out, Set, SettingsPath
from egvs.core.errors import InputError, collect_warnings
from egvs.core.wording import by_number, format_percent, number_of

if TYPE_CHECKING:
    from pathlib import Path

    from rich.table import Table

    from egvs.results.labels import ScoreLabel
    from egvs.results.levels import DetectionLevel, GroupLevel
    from egvs.results.plans import FusedPlan, PlannedSensor, PlanStep, RefinementSummary, SensorPlan
    from egvs.scenario.model import Scenario

_NARROW_HEAD_WIDTH = 10
"""Characters of a line of the head of a column on a narrow terminal."""

_EXPORTS = (
    "export/*/plan*", "export/*/scene.*", "export/*/extrinsics.json", "export/*.gpkg",
    "export/*.kml", "export/*.dxf",
)  # fmt: skip
"""Exports of a run that show its plan."""

_REQUEST_KEYS = ("count", "budget", "reach")
"""Keys of ``[placement]`` that are options of ``egvs place`` too."""


def place(
    scenario: SettingsPath,
    out: Out = None,
    count: Annotated[int | None, typer.Option(metavar="K", help="Find the best plan of at most K sensors.")] = None,
    budget: Annotated[
        str | None, typer.Option(metavar="COST", help="Find the best plan within this total cost (see \\[costs]).")
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
    detector: Detector = None,
    set_: Set = None,
    jobs: Jobs = None,
) -> None:
    """Plan several sensors: how many, at which sites, and how close the plan is to the best possible score."""
    from egvs.cli.console import ProgressDisplay

    limit_s = options.duration_s(time_limit, "--time-limit")
    _check_request(count, reach)
    total_cost = None if budget is None else options.cost(budget)
    overrides = options.with_detector(set_, detector, scenario)
    request = []
    for key, value in zip(_REQUEST_KEYS, (count, total_cost, reach), strict=True):
        if value is not None:
            request.append(f"placement.{key}={value!r}")
    loaded, folder = sources.open_source(scenario, overrides, out, request)
    with ProgressDisplay("place") as screen:
        from egvs.artefacts.run_record import RunRecord
        from egvs.cli import answer
        from egvs.placement import plan
        from egvs.report import sections, sensor_text
        from egvs.sensors import sites

        screen.flow_source = answer.flow_source(loaded)
        replaced, earlier = plan.planned_request(folder), plan.planned_mounts(folder)
        placed = plan.place(
            loaded, folder, exact=exact, time_limit_s=limit_s, refine=refine, jobs=jobs, progress=screen.progress,
            listener=screen.stage_event,
        )  # fmt: skip
    notes = []
    if replaced is not None and (request_now := plan.planned_request(folder)) != replaced:
        notes.append(describe_replaced(replaced, request_now or {}))
    if exact and not (placed.is_best or placed.fewest_is_proved):
        notes.append(f"--exact reached its --time-limit of {time_limit} before any plan was proved optimal.")
    if replaced is not None and (outdated := outdated_handovers(folder, earlier, placed)):
        notes.append(outdated)
    traffic = RunRecord.read(folder).traffic_summary
    assumed = sections.assumptions(loaded, traffic.get("signals", ()))
    caveats = [sections.describe_missing_traffic(collect_warnings([traffic])), sections.main_assumptions(assumed)]
    if placed.fused is not None and placed.fused.noticed is not None:
        caveats.append(sensor_text.upper_limit_note(loaded, [sensor.sensor for sensor in placed.sensors]))
    candidates, planned = {site.sensor for site in sites.candidate_sites(loaded)}, {s.sensor for s in placed.sensors}
    caveats += [_describe_unplaced_sensors(loaded, candidates), _describe_unchosen_sensors(candidates, planned)]
    found, has_relief = _plan_level(loaded, folder, placed), sites.has_relief(loaded)
    print_placement(placed, notes, [caveat for caveat in caveats if caveat], found, has_relief=has_relief)


def _describe_unplaced_sensors(scenario: Scenario, placeable: Collection[str]) -> str:
    """Return which sensors have a price but no candidate site, so that no plan can have them; empty if none."""
    unplaced = [name for name in scenario.costs.sensor if name not in placeable]
    if not unplaced:
        return ""
    from egvs.results.labels import join_names

    return f"No plan has {join_names(unplaced)}: add {by_number(len(unplaced), 'it', 'them')} to sites.sensor."


def _describe_unchosen_sensors(candidates: Collection[str], planned: Collection[str]) -> str:
    """Return which sensors are at candidate sites only; empty if none, or where nothing is planned."""
    unchosen = sorted(set(candidates) - set(planned))
    if not unchosen or not planned:
        return ""
    from egvs.results.labels import join_names

    were = by_number(len(unchosen), "was a candidate, too, but is", "were candidates, too, but are")
    return f"{join_names(unchosen)} {were} not in this plan."


def _plan_level(scenario: Scenario, folder: Path, placed: SensorPlan) -> DetectionLevel:
    """Return what is known of the share that detectors find from the sensors of a plan."""
    from egvs.artefacts.run_folder import RunFolder
    from egvs.report import sensor_text
    from egvs.results.levels import NO_DETECTORS, read_levels
    from egvs.results.ranking import Ranking

    run_folder = RunFolder(folder)
    if not placed.sensors:
        return NO_DETECTORS
    groups: Sequence[GroupLevel] = ()
    if run_folder.levels.is_file() and run_folder.scores.is_file():
        groups = read_levels(run_folder.levels, Ranking.read(run_folder.scores).sites[0].site)
    return sensor_text.plan_level(scenario, [sensor.sensor for sensor in placed.sensors], groups)


def _check_request(count: int | None, reach: float | None) -> None:
    """InputError for an option whose value is out of range."""
    if count is not None and count < 1:
        raise InputError("--count", f"expected at least 1 sensor, got {count}", "Use a number such as 3.")
    if reach is not None and not 0 < reach <= 1:
        hint = "Use a share such as 0.95."
        if 1 < reach <= 100:
            hint = f"Use {reach / 100:g} for {reach:g} %."
        raise InputError("--reach", f"expected a share above 0, at most 1, got {reach:g}", hint)


def print_placement(
    placed: SensorPlan,
    notes: Sequence[str] = (),
    caveats: Sequence[str] = (),
    found: DetectionLevel | None = None,
    *,
    has_relief: bool = False,
) -> None:
    """Print the plan and the curve, what a planner should know, and the files.

    Parameters
    ----------
    placed
        The plan.
    notes
        Sentences about the search.
    caveats
        The last sentences, on what was assumed.
    found
        As for :func:`egvs.report.plan_answer.describe_share`; by default without detectors.
    has_relief
        Whether the ground is elsewhere than at z = 0.
    """
    from egvs.artefacts.readers import describe_worst_zones, worst_zones
    from egvs.cli.console import WIDE, console, print_sentences

    out = console(WIDE, soft_wrap=False)
    print_sentences([describe_plan(placed, found, has_relief=has_relief)])
    out.print(_sensor_table(placed, out.width))
    if any(sensor.forced for sensor in placed.sensors):
        out.print("* already installed")
    if other := _other_plans(placed):
        out.print()
        out.print(_curve_table(placed, other, out.width))
    print_sentences([describe_errors(placed)])
    for zone in placed.zones:
        sensors = f" by {zone.by} sensors" if zone.by > 1 else ""
        out.print(
            f"zone {zone.name}: {format_percent(zone.seen)} of its entropy seen{sensors}, "
            f"{format_percent(zone.share)} required"
        )
    if worst := worst_zones(placed.zone_results):
        print_sentences([describe_worst_zones("the plan", worst)])
    print_sentences([*notes, *_further_sentences(placed), *caveats])
    for path in placed.files:
        out.print(str(path), soft_wrap=True)


def _other_plans(placed: SensorPlan) -> list[PlanStep]:
    """Return the best plans of each number of sensors; none if they are the first sensors of the plan in its table."""
    sites = [sensor.site for sensor in placed.sensors]
    if placed.refinement is None and all(set(step.sites) == set(sites[: len(step.sites)]) for step in placed.curve):
        return []
    return list(placed.curve)


def _further_sentences(placed: SensorPlan) -> Iterator[str]:
    """Yield what is known beside the plan and its proof."""
    from egvs.report import plan_answer

    if placed.refinement is not None:
        yield describe_refinement(placed, placed.refinement)
    if absent := describe_absent_best(placed):
        yield absent
    if answer := plan_answer.describe_plan_count(placed):
        yield answer
    if assumption := plan_answer.describe_joint_score(placed.by, len(placed.sensors)):
        yield assumption
    if placed.fused is not None and (fused := describe_fused(placed.fused, placed.by)):
        yield fused


def describe_fused(fused: FusedPlan, by: ScoreLabel) -> str:
    """Return what the sensors of a plan find in their fused point clouds, and whether other sites find more there.

    Of one sensor, whose cloud is not fused, it is what people would notice only; empty if that is unknown.

    Parameters
    ----------
    fused
        The values.
    by
        Label of the joint score.
    """
    noticed = f"People would notice {fused.noticed.text} of vehicles" if fused.noticed is not None else ""
    if len(fused.steps) == 1:
        return f"{noticed} in the sweeps of this sensor." if noticed else ""
    last = f"{by.change(fused.steps[-1].gain, fused.steps[-1].gain_se)} {by.change_unit}"
    text = f"In fused clouds, the last sensor adds {last}"
    if noticed:
        noticed = f" {noticed} there."
    if fused.better is not None:
        gain = by.change(fused.better.gain, fused.better.gain_se)
        return f"{text}; {', '.join(fused.better_sites)} should find {gain} {by.change_unit} more there.{noticed}"
    if fused.searched:
        return f"{text}; no swap of one sensor finds more.{noticed}"
    return f"{text}.{noticed}"


def _sensor_table(placed: SensorPlan, width: int) -> Table:
    from egvs.cli.console import Column, make_table
    from egvs.results.ranking import describe_roll

    by, head = placed.by, partial(_head, width)
    rolls: list[Column[PlannedSensor]] = []
    if any(row.roll_deg for row in placed.sensors):
        rolls.append(Column("roll", lambda row: describe_roll(row.roll_deg), "left", wrap=True))
    columns: list[Column[PlannedSensor]] = [
        Column("", lambda row: row.marked_order),
        Column("site", lambda row: row.site, "left", wrap=True)
        if placed.refinement is None
        else Column("pole", lambda row: row.pole, "left", wrap=True),  # names of sites have heights and tilts
        Column("z m", lambda row: f"{row.z_m:.4g}"),
        Column(head("ccw yaw deg"), lambda row: f"{row.yaw_deg:.1f}"),
        Column(head("pitch deg"), lambda row: f"{row.pitch_deg:z.1f}"),
        Column("sensor", lambda row: row.sensor, "left"),
        *rolls,
        Column(head("adds", by.change_head), lambda row: _format_gain(by, row)),
        Column(head(_together_head(by)), lambda row: _format_together(by, row)),
        Column(head("lost if it fails", by.change_head), lambda row: by.change(row.loss)),
    ]
    if any(step.cost for step in placed.curve):
        columns.append(Column("cost", lambda row: f"{row.cost:g}"))
    if placed.refinement is not None:
        columns.append(Column(head("moved m"), lambda row: f"{row.moved_m:.2f}"))
        columns.append(Column(head("gained by moving", by.change_head), lambda row: by.change(row.gain_by_refining)))
    return make_table(columns, placed.sensors)


def _format_gain(by: ScoreLabel, row: PlannedSensor) -> str:
    """Return what a sensor adds, with its error; the first one adds what it finds, see :func:`_format_together`."""
    from egvs.scenario.score_config import DEFAULT_SCORE

    is_share_found = row.gain == row.score and by.name == DEFAULT_SCORE
    return by.change(row.gain) if is_share_found else by.change(row.gain, row.gain_se)


def _format_together(by: ScoreLabel, row: PlannedSensor | PlanStep) -> str:
    """Return the score of a plan with its error; that of a share of vehicles found is in the first sentence."""
    from egvs.scenario.score_config import DEFAULT_SCORE

    return by.value(row.score) if by.name == DEFAULT_SCORE else by.with_error(row.score, row.score_se)


def _curve_table(placed: SensorPlan, steps: Sequence[PlanStep], width: int) -> Table:
    from egvs.cli.console import Column, make_table

    by, head = placed.by, partial(_head, width)
    columns: list[Column[PlanStep]] = [
        Column("sensors", lambda step: str(step.count)),
        Column(head(_together_head(by)), lambda step: _format_together(by, step)),
        Column("proved", lambda step: _format_rounded_down(step.certificate)),
    ]
    if any(step.cost for step in placed.curve):
        columns.append(Column("cost", lambda step: f"{step.cost:g}"))
    columns.append(Column("sites", lambda step: ", ".join(step.sites), "left", wrap=True))
    return make_table(columns, steps)


def _together_head(by: ScoreLabel) -> str:
    """Return the head of a column of joint scores, e.g. "found together" or "EGVS together, bit"."""
    return _with_unit(f"{by.head.removesuffix(by.unit).rstrip()} together", by.unit)


def _head(width: int, title: str, unit: str = "") -> str:
    """Return the head of a column, in several lines on a narrow terminal."""
    from egvs.cli.console import NARROW

    head = _with_unit(title, unit)
    if width >= NARROW:
        return head
    if head.endswith(" deg"):
        return head.replace(" ", "\n")
    return textwrap.fill(head, _NARROW_HEAD_WIDTH, break_long_words=False)


def _with_unit(head: str, unit: str) -> str:
    if not unit:
        return head
    return f"{head}, {unit}"


def describe_replaced(replaced: Mapping[str, Any], requested: Mapping[str, Any]) -> str:
    """Return which plan was replaced, by the options that request it.

    Parameters
    ----------
    replaced, requested
        The ``[placement]`` of the replaced plan and of the present one; they differ.
    """
    options = [f"--{key} {replaced[key]:.15g}" for key in _REQUEST_KEYS if replaced.get(key) is not None]
    is_other_option = any(replaced.get(key) != requested.get(key) for key in _REQUEST_KEYS)
    others = {key for key in replaced.keys() | requested.keys() if replaced.get(key) != requested.get(key)}
    settings = " with other settings in [placement]"
    if is_other_option:
        settings = ""
    elif others == {"refine"}:
        settings = " without --refine" if replaced.get("refine") is None else " with --refine"
        if replaced.get("refine") and requested.get("refine"):
            settings = " with other settings in [placement.refine]"
    return f"replaces the plan for {' '.join(options)}{settings}"


def describe_plan(placed: SensorPlan, found: DetectionLevel | None = None, *, has_relief: bool = False) -> str:
    """Return the plan, what it achieves, and its certificate, in one sentence; see :func:`print_placement`."""
    from egvs.report.plan_answer import describe_share
    from egvs.results.levels import NO_DETECTORS
    from egvs.results.ranking import site_titles

    sites, separator = [sensor.site for sensor in placed.sensors], ", "
    proof = _describe_proof(placed)
    if placed.refinement is not None:  # the names of the candidates may have their heights and tilts
        titles = site_titles(placed.sensors, has_relief=has_relief, is_moved=True)
        sites, separator = [titles[site] for site in sites], "; "
        proof += ", at the poses of the candidates"
    cost = f" for {placed.cost:g}" if placed.cost else ""
    names = separator.join(sites) or "no sensor"
    return f"The plan {names}{cost} {describe_share(placed, found or NO_DETECTORS)}; {proof}."


def outdated_handovers(folder: Path, earlier: Sequence[tuple[Any, ...]], placed: SensorPlan) -> str:
    """Return which files for other people show the earlier plan, in one sentence; empty where the plans are the same.

    Parameters
    ----------
    folder
        The run folder.
    earlier
        The sensors of the earlier plan (:func:`egvs.placement.plan.planned_mounts`).
    placed
        The plan that replaced it.
    """
    from egvs.core.wording import by_number, list_first
    from egvs.export.export import safe_file_name
    from egvs.placement.plan import mount_of

    if sorted(earlier) == sorted(map(mount_of, placed.sensors)):
        return ""
    patterns = [f"sheets/installation_{glob.escape(safe_file_name(site))}.*" for site, *_ in earlier]
    names = []
    for pattern in (*patterns, *_EXPORTS):
        names += sorted(path.relative_to(folder).as_posix() for path in folder.glob(pattern) if path.is_file())
    if not names:
        return ""
    verbs = [verb for verb, start in (("egvs sheets", "sheets/"), ("egvs export", "export/"))
             if any(name.startswith(start) for name in names)]  # fmt: skip
    shows = by_number(len(names), "shows", "show")
    return f"{list_first(names, 3)} {shows} the earlier plan; repeat {' and '.join(verbs)}."


def describe_errors(placed: SensorPlan) -> str:
    """Return what follows "±", or why there are no standard errors; that of a share found is mostly of its level."""
    from egvs.scenario.score_config import DEFAULT_SCORE

    if placed.has_errors:
        subject = "± of differences and zones" if placed.by.name == DEFAULT_SCORE else "±"
        return f"{subject} is one standard error, from {placed.errors_from}"
    return f"no standard errors: {placed.errors_from}"


def describe_absent_best(placed: SensorPlan) -> str | None:
    """Return a sentence where the best single site is not part of the plan; None where it is, or is not known."""
    first = placed.curve[0]
    if first.count != 1 or len(placed.sensors) < 2:
        return None
    (best,) = first.sites
    if best in {sensor.site for sensor in placed.sensors}:
        return None
    return f"The best single site, {best}, is not part of this plan."


def _describe_proof(placed: SensorPlan) -> str:
    if placed.fewest_is_proved is not None:
        fewer = len(placed.sensors) - 1
        if fewer == 0:
            return "one sensor is enough"
        sensors = f"{number_of(fewer, 'sensor')} {by_number(fewer, 'is', 'are')}"
        if placed.fewest_is_proved:
            return f"proved: {sensors} not enough"
        return f"not proved that {sensors} not enough"
    if placed.is_best:
        return "proved: no plan within the rules is better"
    return f"proved: at least {_format_rounded_down(placed.certificate)} of the best possible score"


def describe_refinement(placed: SensorPlan, summary: RefinementSummary) -> str:
    """Return what the refinement of poses changed."""
    by = placed.by
    cost = objective = ""
    if placed.cost:
        cost = f", for {placed.cost:g}"
    if (summary.value_before, summary.value_after) != (summary.joint_before, placed.joint):
        objective = f"; objective {summary.value_before:.6g} before, {summary.value_after:.6g} after"
    return (
        f"Refined: {by.noun} {by.value(summary.joint_before)} before, {by.with_unit(placed.joint, placed.joint_se)} "
        f"after{objective}{cost}; "
        f"{summary.poses_tried} poses tried in {summary.turns} rounds and {summary.seconds:.1f} s, "
        f"{summary.poses_infeasible} of them infeasible; the proof applies to the poses before."
    )


def _format_rounded_down(share: float) -> str:
    """Return a proved share in per cent, never rounded up."""
    if share >= 1.0:
        return "100 %"
    return f"{math.floor(share * 1e4) / 1e2:.2f} %"
