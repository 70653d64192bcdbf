"""How studies conclude, from tables made by hand."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from egvs.cli.study_conclusions import ablation_conclusion, accuracy_conclusion
from egvs.studies.effect_study import EffectChange
from tests.studies.test_score_errors import row

SCENARIO = row("scenario", 10.0, kind="scenario", best="c03", best_kept=True)
REFERENCE = row("reference", 99.0, kind="reference", best="c03")
SHORT = row("250 frames", 2.5, best="c03", best_kept=True)
LONG = row("80000 frames", 30.0, best="c03", best_kept=True)


def conclude(*rows: object, best: object = None) -> list[str]:
    study = SimpleNamespace(rows=[SCENARIO, REFERENCE, *rows], best=best, tolerance=0.02)
    return accuracy_conclusion(study)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("best", "expected"),
    [
        (
            SHORT,
            "Conclusion: 250 frames saves a factor of 4.0 (2.5 s instead of 10.0 s with the scenario's own setting), "
            "and its best site, c03, is that of the reference.",
        ),
        (
            replace(LONG, best="c01", best_kept=False, regret=0.012),
            "Conclusion: 80000 frames takes 3.0 times as long (30.0 s instead of 10.0 s with the scenario's own "
            "setting), but its best site, c01, is not that of the reference (regret 1.20%).",
        ),
        (
            SCENARIO,
            "Conclusion: the scenario's own setting is accurate enough (2.00%), and its best site, c03, is that of the "
            "reference.",
        ),
    ],
)
def test_says_what_the_recommended_setting_saves(best: object, expected: str) -> None:
    assert conclude(SHORT, best=best)[0] == expected


def test_best_site_stays_first_with_all_settings() -> None:
    assert conclude(SHORT, LONG) == ["The best site, c03, stays first with all 2 other settings."]


def test_names_settings_that_change_the_best_site_by_regret() -> None:
    gamma = row("gamma 5", 9.0, kind="measures", best="c01", regret=0.02)
    seed = row("seed 2", 9.0, kind="traffic", best="c02", regret=0.03)
    assert conclude(SHORT, gamma, seed) == [
        "The best site, c03, stays first with 1 of 3 other settings; another is first with seed 2 (c02, regret 3.00%) "
        "and gamma 5 (c01, regret 2.00%)."
    ]


def test_lists_four_settings_at_most() -> None:
    gammas = [row(f"gamma {n}", 9.0, kind="measures", best="c01", regret=0.001 * n) for n in range(1, 7)]
    (text,) = conclude(*gammas)
    assert "gamma 6 (c01, regret 0.60%), gamma 5" in text and text.endswith("and 2 more with smaller regret.")
    assert "gamma 2" not in text


def test_says_where_the_reference_has_another_best_site() -> None:
    study = SimpleNamespace(rows=[SCENARIO, replace(REFERENCE, best="c01"), SHORT], best=None, tolerance=0.02)
    assert accuracy_conclusion(study) == [  # type: ignore[arg-type]
        "The best site is c01 with the reference and c03 with the scenario; the latter stays first with the other "
        "setting."
    ]


def change(effect: str, *scores: float) -> EffectChange:
    ranks = tuple(1 + sum(other > score for other in scores) for score in scores)
    return EffectChange(effect, 1.0, ("c01", "c02", "c03")[: len(scores)], scores, ranks, "expected_detections")


PLAIN = change("none", 0.5, 0.6, 0.8)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            [change("rain", 0.4, 0.5, 0.6), change("fog", 0.1, 0.2, 0.3), change("all", 0.1, 0.2, 0.25)],
            "Conclusion: c03 stays first under both effects, alone and together.",
        ),
        ([change("rain", 0.4, 0.5, 0.6)], "Conclusion: c03 stays first under the effect."),
        (
            [change("rain", 0.4, 0.5, 0.6), change("fog", 0.3, 0.5, 0.4), change("all", 0.4, 0.2, 0.3)],
            "Conclusion: c03 is first without effects, but c02 under fog (choosing c03 loses 20.00%) and c01 under all "
            "effects together (choosing c03 loses 25.00%).",
        ),
    ],
)
def test_ablation_says_whether_the_first_site_stays(changes: list[EffectChange], expected: str) -> None:
    assert ablation_conclusion([PLAIN, *changes]) == expected


def test_ablation_without_any_score_has_no_first_site() -> None:
    changes = [change("none", 0.0, 0.0), change("rain", 0.0, 0.0)]
    assert ablation_conclusion(changes) == "Conclusion: every score is 0 without effects, so there is no first site."
