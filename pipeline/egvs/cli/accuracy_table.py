"""What ``egvs accuracy`` prints: what each setting costs and loses, and one recommendation with its reason."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.table import Table

from egvs.cli.console import NARROW, WIDE, Column, console, make_table, print_sentences
from egvs.core.wording import format_percent
from egvs.results.labels import SCORE_LABELS, format_probability
from egvs.results.studies import MEASURES, SCENARIO
from egvs.scenario.score_config import DEFAULT_SCORE

if TYPE_CHECKING:
    from egvs.results.studies import SettingResult
    from egvs.studies.accuracy import AccuracyStudy
    from egvs.studies.recommendation import NeededTraffic

_MAX_FRAMES = 1e8
"""Traffic with more frames than this cannot be simulated in practice."""


def print_study(study: AccuracyStudy, command: str) -> None:
    """Print an accuracy study.

    Parameters
    ----------
    study
        The study.
    command
        Runs the scenario; printed with the recommended options.
    """
    out = console(WIDE)
    approximations = [row for row in study.rows if row.kind != MEASURES]
    measures = [row for row in study.rows if row.kind == MEASURES]
    title = "settings that approximate the scenario's scores"
    out.print(_settings_table(title, approximations, study.scenario, out.width))
    if measures:
        title = "settings that measure something else, judged by the scenario's own setting"
        out.print(_settings_table(title, measures, study.scenario, out.width))
    out.print(f"* no cheaper setting has a smaller {_counted(study)}, = recommended")
    out.print("seconds: processor seconds of all stages, ~ from those of the scenario by the number of frames;")
    out.print("right pole: probability that the chosen pole is the best one; loss: expected, percentage points of")
    out.print("vehicles found, ' by a model because independent traffic is too short")
    for reason in dict.fromkeys(study.skipped.values()):
        names = [name for name, skip_reason in study.skipped.items() if skip_reason == reason]
        out.print(f"skipped, {reason}: {'; '.join(names)}")
    for path in study.files:
        out.print(str(path))
    out.print()
    print_sentences(recommendation_sentences(study))
    if not study.all_zero:
        out.print(f"  {command} {study.recommended.overrides}".rstrip())


def _settings_table(title: str, rows: Sequence[SettingResult], scenario: SettingResult, width: int) -> Table:
    def format_factor(row: SettingResult) -> str:
        return f"{row.seconds / scenario.seconds:.2f}" if scenario.seconds > 0 else "-"

    columns: list[Column[SettingResult]] = [
        Column("", lambda row: "*" * row.front + "=" * row.recommended, "left"),
        Column("setting", lambda row: row.setting, "left", wrap=True),
        Column("seconds", lambda row: f"{'' if row.measured else '~'}{row.seconds:.1f}"),
        Column("times", format_factor, min_width=NARROW),
        Column("traffic", lambda row: f"{row.traffic_s:.1f}", min_width=WIDE - 10),
        Column("tpog", lambda row: f"{row.tpog_s:.1f}", min_width=WIDE - 10),
        Column("scan", lambda row: f"{row.scan_s:.1f}", min_width=WIDE - 10),
        Column("score", lambda row: f"{row.score_s:.1f}", min_width=WIDE - 10),
        Column("right pole", _format_probability),
        Column("loss", _format_loss),
        Column("chooses", lambda row: f"{row.best} ({format_percent(row.best_share, 0)})", "left"),
        Column("score error", lambda row: format_percent(row.error)),
        Column("tau", lambda row: f"{row.tau:.2f}", min_width=NARROW),
        Column("draws", lambda row: str(row.draws), min_width=NARROW),
    ]
    return make_table(columns, rows, width=width, title=title)


def _format_probability(row: SettingResult) -> str:
    if math.isnan(row.probability_se):
        return format_probability(row.probability)
    return f"{format_probability(row.probability)} ± {format_percent(row.probability_se, 0)}"


def _format_loss(row: SettingResult) -> str:
    mark = "" if row.draws else "'"
    return f"{row.loss_points:.2f} ± {row.loss_se_points:.2f}{mark}"


def recommendation_sentences(study: AccuracyStudy) -> list[str]:
    """Return the recommended setting, its reason, and what it costs and loses.

    Parameters
    ----------
    study
        The study.
    """
    if study.all_zero:
        return ["Every score is 0, so there is nothing to decide: check the region of interest and the traffic."]
    best_pole, units = study.best_pole, "parts of the recording" if study.is_recorded else "seeds"
    sentences = [
        f"With all traffic of this study ({study.units} {units}), {best_pole.name} is the best pole with a "
        f"probability of {format_probability(best_pole.probability)}; {best_pole.mount} there should find "
        f"{format_percent(best_pole.found)} of the vehicles."
    ]
    best = study.recommended
    name = best.label
    if study.is_within:
        sentences.append(f"Recommended: {name}, {_describe_cost(study)}. {_describe_quality(best)}")
        sentences.append(_reason_within(study))
        return sentences
    sentences.append(
        f"No setting within the budget meets the tolerance of {_describe_tolerance(study)}. Recommended: {name}, the "
        f"one with the smallest {_counted(study)}, {_describe_cost(study)}. {_describe_quality(best)}"
    )
    if study.needed is not None:
        sentences.append(_describe_needed(study, study.needed))
    return sentences


def _describe_cost(study: AccuracyStudy) -> str:
    """Return the seconds of the recommended setting, beside those of the scenario."""
    best, scenario = study.recommended, study.scenario
    if best.kind == SCENARIO:
        return f"{best.seconds:.1f} processor seconds"
    return f"{best.seconds:.1f} processor seconds instead of {scenario.seconds:.1f}"


def _describe_quality(row: SettingResult) -> str:
    """Return the probability and the expected loss of the choices of a setting."""
    loss = f"{row.loss_points:.2f} ± {row.loss_se_points:.2f}"
    text = (
        f"The pole that it chooses is the best one with a probability of {format_probability(row.probability)}, and is "
        f"expected to lose {loss} percentage points of the vehicles found"
    )
    if not row.draws:
        text += " (by a model, because the study has too little independent traffic for a test)"
    return f"{text}."


def _describe_tolerance(study: AccuracyStudy) -> str:
    if study.tolerance.score is not None:
        return f"{format_percent(study.tolerance.score, 2)} of the score"
    points = study.tolerance.loss_points
    return f"{points:g} percentage {'point' if points == 1 else 'points'}"


def _reason_within(study: AccuracyStudy) -> str:
    """Say why the setting is recommended: the cheapest of those within the tolerance."""
    candidates = [row for row in study.rows if row.approximates]
    within = [row for row in candidates if study.tolerance.admits(row)]
    return (
        f"{len(within)} of {len(candidates)} settings have an {_counted(study)} within the tolerance of "
        f"{_describe_tolerance(study)}; this is the cheapest."
    )


def _counted(study: AccuracyStudy) -> str:
    return "expected loss" if study.tolerance.score is None else "error of the score"


def _describe_needed(study: AccuracyStudy, needed: NeededTraffic) -> str:
    """Say how much traffic reaches the tolerance."""
    if not needed.frames < _MAX_FRAMES:
        if study.rank_by == DEFAULT_SCORE:
            return "No feasible amount of traffic reaches the tolerance."
        score = SCORE_LABELS[study.rank_by].noun
        return f"More traffic does not reach the tolerance: {score} prefers other sites than those that find most."
    return (
        f"The tolerance needs about {needed.frames:,.0f} frames, {needed.seconds:,.0f} processor seconds (estimated "
        "from the scatter between the units)."
    )
