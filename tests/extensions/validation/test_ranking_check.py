"""When detection contradicts a ranking, by tables made by hand, and the sentences about it."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from egvs.extensions.validation.ranking_check import DetectorCheck, RankCorrelation, RankingCheck

GOOD_ORDER = RankCorrelation(0.9, 0.6, 0.97, 13)

CONFIRMING = DetectorCheck(
    detector="cluster",
    measure="mean AP of BEV and 3D",
    returns_boxes=True,
    first="c03",
    first_value=0.7,
    best="c03",
    best_value=0.7,
    best_se=0.01,
    loss=0.0,
    loss_se=0.0,
    blocks=10,
    rho=GOOD_ORDER,
    same_height=None,
)


def behind(loss: float, se: float | None, sites: int = 13) -> DetectorCheck:
    """Return a detector that finds more from c07 than from c03."""
    rho = replace(GOOD_ORDER, sites=sites)
    return replace(CONFIRMING, best="c07", best_value=0.7 + loss, loss=loss, loss_se=se, rho=rho)


def contradiction(*checks: DetectorCheck) -> str:
    return RankingCheck("expected_detections", checks).contradiction


@pytest.mark.parametrize(
    ("check", "contradicts"),
    [
        pytest.param(CONFIRMING, False, id="the first site detects best"),
        # 12 comparisons: t of 9 degrees of freedom at 1 - 0.05 / 12 is 3.37
        pytest.param(behind(0.066, 0.02), False, id="3.3 errors are too few among 13 sites"),
        pytest.param(behind(0.068, 0.02), True, id="3.4 errors are enough among 13 sites"),
        # one comparison: t is 1.83
        pytest.param(behind(0.036, 0.02, sites=2), False, id="1.8 errors are too few among 2 sites"),
        pytest.param(behind(0.037, 0.02, sites=2), True, id="1.85 errors are enough among 2 sites"),
        # 75 comparisons: t is 4.7
        pytest.param(behind(0.09, 0.02, sites=76), False, id="4.5 errors are too few among 76 sites"),
        pytest.param(behind(0.009, 0.0001), False, id="less than one point of AP"),
        pytest.param(behind(0.5, 0.0), False, id="no error is known"),
        pytest.param(behind(0.5, None), False, id="the error is undefined"),
        pytest.param(replace(behind(0.5, 0.01), returns_boxes=False), False, id="points are no detector"),
    ],
)
def test_best_site_contradicts_if_it_is_significantly_better_than_the_first(
    check: DetectorCheck, contradicts: bool
) -> None:
    text = contradiction(check)
    assert bool(text) == contradicts
    if contradicts:
        assert text.startswith("with cluster, detection is better from c07 than from the first site, c03, by ")
        warning = RankingCheck("expected_detections", (check,)).warning
        assert warning == f"The validation contradicts the ranking: {text}."
    else:
        assert RankingCheck("expected_detections", (check,)).warning == ""


@pytest.mark.parametrize(
    ("low", "high", "contradicts"),
    [(-0.6, 0.49, True), (-0.6, 0.51, False), (-0.9, -0.2, True), (None, None, False)],
)
def test_order_contradicts_if_the_interval_of_rho_lies_below_one_half(
    low: float | None, high: float | None, contradicts: bool
) -> None:
    check = replace(CONFIRMING, rho=RankCorrelation(-0.1, low, high, 13))
    assert bool(contradiction(check)) == contradicts


def test_each_further_detector_raises_the_bar() -> None:
    check = behind(0.068, 0.02)  # 3.4 errors; t at 1 - 0.05 / 24 is 3.8
    assert contradiction(check)
    assert not contradiction(check, replace(CONFIRMING, detector="pointpillars"))


def test_counts_of_points_do_not_raise_the_bar() -> None:
    points = replace(CONFIRMING, detector="points", returns_boxes=False)
    assert contradiction(behind(0.068, 0.02), points)


@pytest.mark.parametrize(
    ("check", "expected"),
    [
        (
            CONFIRMING,
            "With cluster, the share of vehicles found predicts detection here: rho 0.90 (0.60 to 0.97) over 13 sites. "
            "c03 detects best (mean AP of BEV and 3D 70.0 ± 1.0 %), and is also first in the ranking: nothing is lost "
            "by following it.",
        ),
        (
            replace(CONFIRMING, best_value=0.997, best_se=0.002),
            "With cluster, the share of vehicles found predicts detection here: rho 0.90 (0.60 to 0.97) over 13 sites. "
            "c03 detects best (mean AP of BEV and 3D 99.7 ± 0.2 %), and is also first in the ranking: nothing is lost "
            "by following it. Values so near 100 % cannot tell the best sites apart; more frames may.",
        ),
        (
            replace(behind(0.02, 0.015), same_height=RankCorrelation(0.4, -0.1, 0.8, 10, 2)),
            "With cluster, the share of vehicles found predicts detection here: rho 0.90 (0.60 to 0.97) over 13 sites, "
            "but 0.40 (-0.10 to 0.80) among sites of equal height (10 sites at 2 heights), which are too few, or "
            "too similar, to tell. c07 detects best (mean AP of BEV and 3D 72.0 ± 1.0 %); following the ranking, to "
            "c03, loses 2.0 ± 1.5 AP points, which may be chance.",
        ),
        (
            replace(behind(0.08, 0.01), rho=RankCorrelation(0.3, -0.2, 0.7, 6)),
            "With cluster, 6 sites are too few, or too similar, to tell whether the share of vehicles found predicts "
            "detection here: rho is 0.30 (-0.20 to 0.70), and the interval contains 0. c07 detects best (mean AP of "
            "BEV and 3D 78.0 ± 1.0 %); following the ranking, to c03, loses 8.0 ± 1.0 AP points.",
        ),
        (
            replace(CONFIRMING, rho=RankCorrelation(-0.8, -0.9, -0.6, 13)),
            "With cluster, the share of vehicles found ranks the sites here the wrong way round: rho -0.80 (-0.90 to "
            "-0.60) over 13 sites. c03 detects best (mean AP of BEV and 3D 70.0 ± 1.0 %), and is also first in the "
            "ranking: nothing is lost by following it.",
        ),
    ],
)
def test_concludes_in_two_sentences(check: DetectorCheck, expected: str) -> None:
    assert RankingCheck("expected_detections", (check,)).sentences == [expected]


def test_points_conclude_only_without_a_detector() -> None:
    points = replace(CONFIRMING, detector="points", measure="vehicles with 20 points", returns_boxes=False)
    (with_points,) = RankingCheck("egvs", (points,)).sentences
    assert with_points.startswith("No detector ran; by points on vehicles, EGVS predicts detection here")
    assert "c03 has most vehicles with 20 points (70.0 ± 1.0 %)" in with_points
    (with_detector,) = RankingCheck("egvs", (CONFIRMING, points)).sentences
    assert with_detector.startswith("With cluster")


def test_json_gives_the_same_check() -> None:
    check = RankingCheck("egvs", (replace(behind(0.1, None), same_height=GOOD_ORDER), CONFIRMING))
    assert RankingCheck.from_json(json.loads(json.dumps(check.to_json(), allow_nan=False))) == check
