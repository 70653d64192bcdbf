"""How ``egvs accuracy`` and ``egvs effects --ablation`` end: what options of the traffic cost, and a conclusion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from egvs.cli.console import Column
from egvs.report.formatting import join_names
from egvs.studies.study_settings import APPROXIMATES, MEASURES, REFERENCE, SCENARIO, SEED_KNOB, TRAFFIC

if TYPE_CHECKING:
    from egvs.studies.accuracy import AccuracyStudy
    from egvs.studies.effect_study import EffectChange
    from egvs.studies.score_errors import SettingResult
    from egvs.studies.traffic_options import SeedSpread

_MAX_NAMED = 4
"""Settings with another best site that are named; the table has all."""


def traffic_columns(scenario: SettingResult, spread: SeedSpread) -> list[Column[SettingResult]]:
    """Return the columns of the options of the traffic: cost, changes against the scenario, and other seeds.

    Parameters
    ----------
    scenario
        The row of the scenario.
    spread
        What other seeds change.
    """

    def format_verdict(row: SettingResult) -> str:
        return "" if row.kind == SCENARIO or row.knob == SEED_KNOB else spread.verdict(row)

    def format_factor(row: SettingResult) -> str:
        return f"{row.busy_s / scenario.busy_s:.2f}" if scenario.busy_s > 0 else "-"

    return [
        Column("setting", lambda row: row.setting, "left", wrap=True),
        Column("seconds", lambda row: f"{row.seconds:.2f}"),
        Column("busy", lambda row: f"{row.busy_s:.2f}"),
        Column("times", format_factor),
        Column("TPOG", lambda row: _format_change(row.tpog_change)),
        Column("scores", lambda row: _format_change(row.error)),
        Column("tau", lambda row: f"{row.tau:.2f}"),
        Column("best", lambda row: row.best, "left", wrap=True),
        Column("regret", lambda row: f"{row.regret:.2%}"),
        Column("against other seeds", format_verdict, "left", wrap=True),
    ]


def _format_change(change: float) -> str:
    return "" if math.isnan(change) else f"{change:.1%}"


def accuracy_conclusion(study: AccuracyStudy) -> list[str]:
    """Return what the recommended setting saves, and which settings change the best site.

    Parameters
    ----------
    study
        A study with at least one score above 0.
    """
    rows = {row.kind: row for row in study.rows if row.kind in (SCENARIO, REFERENCE)}
    scenario = rows[SCENARIO]
    sentences = []
    if study.best is not None:
        sentences.append(_describe_saving(study.best, scenario, study.tolerance))
    sentences.append(_describe_best_sites(study.rows, scenario, rows.get(REFERENCE)))
    return sentences


def _describe_saving(best: SettingResult, scenario: SettingResult, tolerance: float) -> str:
    """Say what the recommended setting saves, and whether it has the best site of the reference."""
    same_site = f"and its best site, {best.best}, is that of the reference"
    if not best.best_kept:
        same_site = f"but its best site, {best.best}, is not that of the reference (regret {best.regret:.2%})"
    if best.kind == SCENARIO:
        return f"Conclusion: the scenario's own setting is accurate enough ({tolerance:.2%}), {same_site}."
    if best.seconds <= scenario.seconds:
        cost = f"saves a factor of {scenario.seconds / best.seconds:.1f}"
    else:
        cost = f"takes {best.seconds / scenario.seconds:.1f} times as long"
    compared = f"{best.seconds:.1f} s instead of {scenario.seconds:.1f} s with the scenario's own setting"
    return f"Conclusion: {best.setting} {cost} ({compared}), {same_site}."


def _describe_best_sites(
    rows: Sequence[SettingResult], scenario: SettingResult, reference: SettingResult | None
) -> str:
    """Say whether the best site of the scenario stays the best with other settings, and which change it."""
    others = [row for row in rows if row.kind in (APPROXIMATES, MEASURES, TRAFFIC)]
    if not others:
        return f"The best site is {scenario.best}; no other setting was run."
    changed = [row for row in others if row.best != scenario.best]
    start = f"The best site, {scenario.best},"
    if reference is not None and reference.best != scenario.best:
        start = (
            f"The best site is {reference.best} with the reference and {scenario.best} with the scenario; the latter"
        )
    if not changed:
        scope = "the other setting" if len(others) == 1 else f"all {len(others)} other settings"
        return f"{start} stays first with {scope}."
    text = f"{start} stays first with {len(others) - len(changed)} of {len(others)} other settings"
    changed.sort(key=lambda row: -row.regret)
    named = [f"{row.setting} ({row.best}, regret {row.regret:.2%})" for row in changed[:_MAX_NAMED]]
    if len(changed) > _MAX_NAMED:
        named.append(f"{len(changed) - _MAX_NAMED} more with smaller regret")
    return f"{text}; another is first with {join_names(named)}."


def ablation_conclusion(changes: Sequence[EffectChange]) -> str:
    """Return whether the best site stays first under the effects, and otherwise what choosing it loses.

    Parameters
    ----------
    changes
        The scores without effects, then with each effect alone, then with all of them where there are several.
    """
    plain = changes[0]
    alone = [change for change in changes[1:] if change.effect != "all"]
    scope = "the effect"
    if len(alone) > 1:
        scope = f"{'both' if len(alone) == 2 else f'all {len(alone)}'} effects, alone and together"
    if not any(score > 0 for score in plain.scores):
        return "Conclusion: every score is 0 without effects, so there is no first site."
    first = _first_sites(plain)
    subject, verb = join_names(first), "stays" if len(first) == 1 else "stay"
    moved = [change for change in changes[1:] if _first_sites(change) != first]
    if not moved:
        return f"Conclusion: {subject} {verb} first under {scope}."
    losses = []
    for change in moved:
        name = "all effects together" if change.effect == "all" else change.effect
        losses.append(
            f"{join_names(_first_sites(change))} under {name} (choosing {first[0]} loses {_loss(plain, change):.2%})"
        )
    return (
        f"Conclusion: {subject} {'is' if len(first) == 1 else 'are'} first without effects, but {join_names(losses)}."
    )


def _first_sites(change: EffectChange) -> list[str]:
    """Return the sites of rank 1."""
    return [site for site, rank in zip(change.sites, change.ranks, strict=True) if rank == 1]


def _loss(plain: EffectChange, change: EffectChange) -> float:
    """Return the share of the best score that the first site without effects loses (the worst of several)."""
    highest = max(change.scores)
    if not highest > 0:
        return 0.0
    scores = dict(zip(change.sites, change.scores, strict=True))
    return 1.0 - min(scores[site] for site in _first_sites(plain)) / highest
