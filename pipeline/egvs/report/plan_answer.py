"""The answer of ``egvs place`` to how many sensors are enough, for the terminal and the report.

A further sensor is *useful* (:func:`is_useful`) if it adds at least :data:`MIN_USEFUL_SHARE` and its gain can be
separated from 0, or if requirements are met only with it. A number of sensors is *enough* if no further sensor of the
curve is useful.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

from egvs.artefacts.readers import DISTINCT_PROBABILITY
from egvs.core.wording import format_percent
from egvs.results.labels import ScoreLabel, join_names
from egvs.results.levels import NOT_MEASURED, DetectionLevel
from egvs.results.plans import PlannedSensor, PlanStep, SensorPlan
from egvs.scenario.score_config import is_plugin_score

MIN_USEFUL_SHARE = 0.01
"""A useful sensor adds at least 1 percentage point; to scores that are no shares, at least 1 % of the plan's score."""

_INDEPENDENT_SCORES = ("expected_detections",)
"""Scores whose joint value treats the sensors of a plan as independent (:mod:`egvs.placement.problem`)."""

_NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
_ORDINALS = ("", "first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")


def describe_plan_count(plan: SensorPlan) -> str:
    """Return how many sensors are enough (:func:`describe_count`), judged from the curve of a plan."""
    return describe_count(
        plan.curve,
        plan.by,
        installed=plan.sensors if plan.refinement is None else (),
        has_budget=plan.request["budget"] is not None,
        objective=describe_objective(plan.request),
        next_count=next_count(plan),
        forbids_more=plan.forbids_more,
    )


def describe_share(plan: SensorPlan, found: DetectionLevel) -> str:
    """Return what a plan achieves: what detectors should find, with the error of their level, also in fused clouds.

    Parameters
    ----------
    plan
        The plan.
    found
        What is known of the share that detectors find from its sensors; without detectors for a score that has none.

    Returns
    -------
    str
        E.g. "should find 92 ± 7 % of vehicles (86 ± 7 % in fused clouds)". For a score without detectors it has the
        standard error: "scores 99,220 ± 300 bit".
    """
    if not found.detectors:
        return plan.by.says.format(plan.by.with_unit(plan.joint, plan.joint_se))
    if not found.is_measured:
        return f"has sensors for whose detectors the {NOT_MEASURED.replace('level', 'level was')}"
    text = plan.by.says.format(found.joint_text(plan.joint, _se_or_none(plan.joint_se)))
    if plan.fused is not None and len(plan.fused.steps) > 1:
        last = plan.fused.steps[-1]
        text += f" ({found.joint_text(last.score, _se_or_none(last.score_se))} in fused clouds)"
    return text


def _se_or_none(se: float) -> float | None:
    return None if math.isnan(se) else se


def describe_objective(request: Mapping[str, Any]) -> str:
    """Return what a plan maximises, if not the joint score; empty otherwise. ``request`` is its ``[placement]``."""
    parts = []
    if request["objective"] == "worst":
        parts.append("the score in the period with the lowest share")
    if request["survives"]:
        parts.append("the score that remains if the most important sensor fails")
    return " and ".join(parts)


def describe_joint_score(by: ScoreLabel, sensors: int) -> str:
    """Return what the joint score of a plan assumes, in one sentence; empty for one sensor, and for other scores.

    Parameters
    ----------
    by
        Label of the joint score.
    sensors
        Number of sensors of the plan.
    """
    if sensors < 2 or not (by.name in _INDEPENDENT_SCORES or is_plugin_score(by.name)):
        return ""
    return (
        "Joint shares assume one independent detector per sensor (an upper end); fused clouds, only one "
        "(docs/placement.md)."
    )


def is_useful(before: PlanStep, step: PlanStep, by: ScoreLabel) -> bool:
    """Whether the last sensor of a plan is worth adding to the plan before it.

    Parameters
    ----------
    before, step
        The plan without and with it.
    by
        Label of the joint score.
    """
    if step.met and not before.met:
        return True
    return _is_large(step, by) and _is_separable(step)


def _is_large(step: PlanStep, by: ScoreLabel) -> bool:
    """Whether the gain reaches :data:`MIN_USEFUL_SHARE`."""
    if by.is_share:
        return step.gain >= MIN_USEFUL_SHARE
    return step.gain >= MIN_USEFUL_SHARE * step.score


def _is_separable(step: PlanStep) -> bool:
    """Whether the gain is known to be above 0, or standard errors are unknown."""
    return math.isnan(step.beats_previous) or step.beats_previous >= DISTINCT_PROBABILITY


def describe_count(
    steps: Sequence[PlanStep],
    by: ScoreLabel,
    *,
    installed: Sequence[PlannedSensor] = (),
    has_budget: bool = False,
    objective: str = "",
    next_count: int | None = None,
    forbids_more: str = "",
) -> str:
    """Return how many sensors are enough, in one to three sentences; empty if there is nothing to compare or to try.

    Parameters
    ----------
    steps
        The best plans of each number of sensors, at least one. If fewer sensors than those of the last plan are enough,
        their sites are named.
    by
        Label of the joint score.
    installed
        The sensors of the last plan in the order of installation: if the first ones are others than those that are
        enough, a sentence compares them.
    has_budget
        Whether a budget limits the number of sensors of the last plan.
    objective
        What the plans maximise, if not the joint score; then gains of the joint score do not tell what is enough.
    next_count
        The number of sensors to try next; None if there is no larger plan to try.
    forbids_more
        The rules that forbid any further sensor. Then plans of more sensors are the same as the last possible one.
    """
    try_next = ""
    if forbids_more:
        n_sensors = len(steps[-1].sites)
        steps = [step for step in steps if step.count <= n_sensors] or steps[:1]
        verb = "forbid" if " and " in forbids_more else "forbids"
        them = "it" if n_sensors == 1 else "them"
        try_next = f"{_capitalise(forbids_more)} {verb} {_ordinal(n_sensors + 1)} sensor beside {them}."
    elif next_count is not None:
        try_next = f"Try --count {next_count} to see what {_ordinal(next_count)} adds."
    if len(steps) < 2:
        return try_next

    before, last = steps[-2], steps[-1]
    if objective:
        adds = _describe_gain(last, by)
        answer = f"{_capitalise(_ordinal(last.count))} sensor adds {adds} to {by.noun}; the plan maximises {objective}."
        return f"{answer} {try_next if forbids_more else ''}".rstrip()

    enough = _last_useful_step(steps, by)
    if enough < len(steps) - 1:
        gain = f"{_describe_gain(steps[enough + 1], by)}{_describe_chance(steps[enough + 1], by)}"
        further = _ordinal(steps[enough + 1].count)
        is_smaller = 0 < len(steps[enough].sites) < len(last.sites)
        first_ones = _describe_first_ones(steps[enough], installed, by) if is_smaller else ""
        if is_smaller and has_budget:
            only = "only " if steps[enough + 1].gain else ""
            _, _, ordinal = further.partition(" ")
            return (
                f"The budget buys {_number(len(last.sites))} sensors; the {ordinal} adds {only}{gain}, so "
                f"{_count_is(steps[enough].count)} enough: {_name_sites(steps[enough])}.{first_ones}"
            )
        names = f" ({_name_sites(steps[enough])})" if is_smaller else ""
        return f"{_capitalise(_count_is(steps[enough].count))} enough{names}: {further} adds {gain}.{first_ones}"
    if not before.met:
        sensor = _capitalise(_ordinal(last.count))
        answer = f"{sensor} sensor is needed to meet the requirements; it adds {_describe_gain(last, by)}."
    else:
        answer = (
            f"{_capitalise(_ordinal(last.count))} sensor adds {_describe_gain(last, by)} to {by.noun}: "
            f"{by.with_unit(last.score)}, against {by.with_unit(before.score)} with "
            f"{_number(before.count)}."
        )
    return f"{answer} {try_next}".rstrip()


def _name_sites(step: PlanStep) -> str:
    """Return the sites of a plan and their cost, e.g. "a and b for 6000"."""
    cost = f" for {step.cost:g}" if step.cost else ""
    return f"{join_names(step.sites)}{cost}"


def _describe_first_ones(step: PlanStep, installed: Sequence[PlannedSensor], by: ScoreLabel) -> str:
    """Return how the first sites of a larger plan compare with a plan of as many; empty if they are the same."""
    count = len(step.sites)
    first = installed[:count]
    if len(first) < count or {sensor.site for sensor in first} == set(step.sites):
        return ""
    which, verb = ("site", "reaches") if count == 1 else (f"{_number(count)} sites", "reach")
    reached = by.with_unit(first[-1].score, first[-1].score_se)
    best = by.with_unit(step.score, step.score_se)
    names, follow = join_names([sensor.site for sensor in first]), _number(len(installed) - count)
    return (
        f" The first {which} of the plan of {_number(len(installed))}, {names}, "
        f"{verb} {reached} instead of {best}: begin with {'it' if count == 1 else 'them'} only if {follow} more "
        f"{'is' if follow == 'one' else 'are'} to follow."
    )


def next_count(plan: SensorPlan) -> int | None:
    """Return the number of sensors to try next; None if the plan is not limited by its count alone."""
    sensors = len(plan.sensors)
    is_limited_otherwise = plan.request["budget"] is not None or plan.request["reach"] is not None
    if is_limited_otherwise or plan.forbids_more or sensors < plan.curve[-1].count or sensors >= plan.candidates:
        return None
    return sensors + 1


def _last_useful_step(steps: Sequence[PlanStep], by: ScoreLabel) -> int:
    """Return the index of the last plan whose last sensor is useful; the first one's always is."""
    last = 0
    for number, (before, step) in enumerate(pairwise(steps), start=1):
        if is_useful(before, step, by):
            last = number
    return last


def _describe_gain(step: PlanStep, by: ScoreLabel) -> str:
    """What the last sensor of a plan adds, with its standard error and its unit."""
    if step.gain == 0.0:
        return "nothing"
    if by.is_zero(step.gain):
        return f"less than {by.smallest_change} {by.change_unit}".rstrip()
    text = f"{by.change(step.gain, step.gain_se)} {by.change_unit}".rstrip()
    if by.is_share or not step.score > 0.0:
        return text
    return f"{text} ({format_percent(step.gain / step.score)} of the plan's score)"


def _describe_chance(step: PlanStep, by: ScoreLabel) -> str:
    """Say that a gain is large enough, but may be due to chance; empty otherwise."""
    if _is_large(step, by) and not _is_separable(step):
        return ", which may be chance"
    return ""


def _number(count: int) -> str:
    if count < len(_NUMBERS):
        return _NUMBERS[count]
    return str(count)


def _count_is(count: int) -> str:
    return "one is" if count == 1 else f"{_number(count)} are"


def _ordinal(count: int) -> str:
    """Return "a third", "an eighth", "a 12th"."""
    if count < len(_ORDINALS):
        word = _ORDINALS[count]
    elif count % 100 in (11, 12, 13):
        word = f"{count}th"
    else:
        suffix = {1: "st", 2: "nd", 3: "rd"}.get(count % 10, "th")
        word = f"{count}{suffix}"
    article = "an" if word == "eighth" or word.startswith(("8", "11th", "18th")) else "a"
    return f"{article} {word}"


def _capitalise(text: str) -> str:
    return text[0].upper() + text[1:]
