"""How ``egvs effects --ablation`` concludes, from tables made by hand."""

from __future__ import annotations

import pytest

from egvs.cli.study_conclusions import ablation_conclusion
from egvs.studies.effect_study import EffectChange


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
            "Conclusion: c03 is first without effects, but c02 under fog (choosing c03 loses 20.00 %) and c01 under "
            "all effects together (choosing c03 loses 25.00 %).",
        ),
    ],
)
def test_ablation_says_whether_the_first_site_stays(changes: list[EffectChange], expected: str) -> None:
    assert ablation_conclusion([PLAIN, *changes]) == expected


def test_ablation_without_any_score_has_no_first_site() -> None:
    changes = [change("none", 0.0, 0.0), change("rain", 0.0, 0.0)]
    assert ablation_conclusion(changes) == "Conclusion: every score is 0 without effects, so there is no first site."
