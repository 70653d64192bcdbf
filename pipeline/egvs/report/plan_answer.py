"""The answer of ``egvs place`` to how many sensors are enough, for the terminal and the report.

A further sensor is *useful* (:func:`is_useful`) if it adds at least :data:`MIN_USEFUL_SHARE` and its gain can be
separated from 0, or if requirements are met only with it. A number of sensors is *enough* if no further sensor of the
curve is useful.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from egvs.artefacts.readers import DISTINCT_PROBABILITY
from egvs.core.wording import format_percent
from egvs.results.labels import ScoreLabel, join_names
from egvs.results.plans import PlanStep

MIN_USEFUL_SHARE = 0.01
"""A useful sensor adds at least 1 percentage point; to scores that are no shares, at least 1 % of the plan's score."""

_INDEPENDENT_SCORES = ("expected_detections",)
"""Scores whose joint value treats the sensors of a plan as independent (:mod:`egvs.placement.problem`)."""

_NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
_ORDINALS = ("", "first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")


class CurvePlan(NamedTuple):
    """Sites of the best plan with at most so many sensors, and their cost (0 without costs)."""

    sites: tuple[str, ...]
    cost: float

    @property
    def text(self) -> str:
        """Sites and cost, e.g. "a and b for 6000"."""
        cost = f" for {self.cost:g}" if self.cost else ""
        return f"{join_names(self.sites)}{cost}"


class InstalledSite(NamedTuple):
    """A site of a plan in the order of installation, and the joint score of the sites up to this one."""

    site: str
    score: float
    score_se: float = math.nan


def describe_joint_score(by: ScoreLabel, sensors: int) -> str:
    """Return what the joint score of a plan assumes, in one sentence; empty for one sensor, and for other scores.

    Parameters
    ----------
    by
        Label of the joint score.
    sensors
        Number of sensors of the plan.
    """
    if sensors < 2 or by.name not in _INDEPENDENT_SCORES:
        return ""
    return (
        "Joint shares are for sensors that detect each by itself, and assume that they miss vehicles independently of "
        "each other; near 100 % they are upper ends (docs/placement.md)."
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
    plans: Sequence[CurvePlan] = (),
    installed: Sequence[InstalledSite] = (),
    has_budget: bool = False,
    objective: str = "",
    next_count: int | None = None,
) -> str:
    """Return how many sensors are enough, in one or two sentences; empty if there is nothing to compare or to try.

    Parameters
    ----------
    steps
        The best plans of each number of sensors, at least one.
    by
        Label of the joint score.
    plans
        The plan of each step: if fewer sensors than those of the last plan are enough, their sites are named.
    installed
        The sites of the last plan in the order of installation: if the first ones are others than those that are
        enough, a sentence compares them.
    has_budget
        Whether a budget limits the number of sensors of the last plan.
    objective
        What the plans maximise, if not the joint score; then gains of the joint score do not tell what is enough.
    next_count
        The number of sensors to try next; None if there is no larger plan to try.
    """
    try_next = ""
    if next_count is not None:
        try_next = f"Try --count {next_count} to see what {_ordinal(next_count)} adds."
    if len(steps) < 2:
        return try_next

    before, last = steps[-2], steps[-1]
    if objective:
        adds = _describe_gain(last, by)
        return f"{_capitalise(_ordinal(last.count))} sensor adds {adds} to {by.noun}; the plan maximises {objective}."

    enough = _last_useful_step(steps, by)
    if enough < len(steps) - 1:
        gain = f"{_describe_gain(steps[enough + 1], by)}{_describe_chance(steps[enough + 1], by)}"
        further = _ordinal(steps[enough + 1].count)
        is_smaller = bool(plans) and 0 < len(plans[enough].sites) < len(plans[-1].sites)
        first_ones = _describe_first_ones(plans[enough], steps[enough], installed, by) if is_smaller else ""
        if is_smaller and has_budget:
            only = "only " if steps[enough + 1].gain else ""
            _, _, ordinal = further.partition(" ")
            return (
                f"The budget buys {_number(len(plans[-1].sites))} sensors; the {ordinal} adds {only}{gain}, so "
                f"{_count_is(steps[enough].count)} enough: {plans[enough].text}.{first_ones}"
            )
        names = f" ({plans[enough].text})" if is_smaller else ""
        return f"{_capitalise(_count_is(steps[enough].count))} enough{names}: {further} adds {gain}.{first_ones}"
    if not before.met:
        sensor = _capitalise(_ordinal(last.count))
        answer = f"{sensor} sensor is needed to meet the requirements; it adds {_describe_gain(last, by)}."
    else:
        answer = (
            f"{_capitalise(_ordinal(last.count))} sensor adds {_describe_gain(last, by)} to {by.noun}: "
            f"{_value_with_unit(last.score, by)}, against {_value_with_unit(before.score, by)} with "
            f"{_number(before.count)}."
        )
    return f"{answer} {try_next}".rstrip()


def _describe_first_ones(plan: CurvePlan, step: PlanStep, installed: Sequence[InstalledSite], by: ScoreLabel) -> str:
    """Return how the first sites of a larger plan compare with a plan of as many; empty if they are the same."""
    count = len(plan.sites)
    first = installed[:count]
    if len(first) < count or {site.site for site in first} == set(plan.sites):
        return ""
    which, verb = ("site", "reaches") if count == 1 else (f"{_number(count)} sites", "reach")
    reached = f"{by.with_error(first[-1].score, first[-1].score_se)} {by.unit}".rstrip()
    best = f"{by.with_error(step.score, step.score_se)} {by.unit}".rstrip()
    follow = _number(len(installed) - count)
    return (
        f" The first {which} of the plan of {_number(len(installed))}, {join_names([site.site for site in first])}, "
        f"{verb} {reached} instead of {best}: begin with {'it' if count == 1 else 'them'} only if {follow} more "
        f"{'is' if follow == 'one' else 'are'} to follow."
    )


def next_count(steps: Sequence[PlanStep], sensors: int, candidates: int, requested: Mapping[str, Any]) -> int | None:
    """Return the number of sensors to try next; None if the plan is not limited by its count alone.

    Parameters
    ----------
    steps
        The best plans of each number of sensors.
    sensors
        Number of sensors of the plan.
    candidates
        Number of candidates.
    requested
        The keys of ``[placement]``.
    """
    is_limited_otherwise = requested["budget"] is not None or requested["reach"] is not None
    if is_limited_otherwise or sensors < steps[-1].count or sensors >= candidates:
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


def _value_with_unit(value: float, by: ScoreLabel) -> str:
    return f"{by.value(value)} {by.unit}".rstrip()


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
