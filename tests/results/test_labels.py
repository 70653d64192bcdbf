"""Values and standard errors of scores as text."""

from __future__ import annotations

import math
from typing import get_args

import pytest

from egvs.results.labels import SCORE_LABELS, format_probability
from egvs.scenario.score_config import OtherScore


def test_values_and_errors_as_text() -> None:
    egvs, detections, points = (
        SCORE_LABELS["egvs"],
        SCORE_LABELS["expected_detections"],
        SCORE_LABELS["points_on_target"],
    )
    assert (egvs.value(12345.6), detections.value(0.8712), points.value(3.456)) == ("12,346", "87.1 %", "3.46")
    assert (egvs.error(200.0, 3.0), detections.error(0.5, 0.012), points.error(2.0, 0.1)) == (
        "1.5 %",
        "±1.2 %",
        "5.0 %",
    )
    assert (egvs.error(0.0, 3.0), detections.error(0.5, math.nan), detections.value(math.nan)) == ("-", "-", "-")
    assert (egvs.title, detections.title, points.title) == ("EGVS<br>(bit)", "Found<br>of all", "Log<br>points")
    assert set(SCORE_LABELS) >= {"egvs", *get_args(OtherScore)}


def test_differences_are_in_percentage_points_or_units() -> None:
    egvs, detections, points = (SCORE_LABELS[name] for name in ("egvs", "expected_detections", "points_on_target"))
    assert detections.with_error(0.9457, 0.0089) == "94.6 ± 0.9 %"
    assert egvs.with_error(247397.2, 1203.4) == "247,397 ± 1,203"
    assert (detections.with_error(0.9457, math.nan), egvs.with_error(200.0, math.nan)) == ("94.6 %", "200")
    assert (detections.change(0.0468, 0.0051), points.change(0.25, 0.02)) == ("4.7 ± 0.5", "0.25 ± 0.02")
    assert (detections.change(-0.0468), egvs.change(12345.6, math.nan)) == ("-4.7", "12,346")
    assert (detections.change_unit, egvs.change_unit) == ("percentage points", "bit")


def test_difference_that_is_rounded_to_zero_has_no_minus() -> None:
    assert SCORE_LABELS["expected_detections"].change(-0.0004) == "0.0"
    assert SCORE_LABELS["expected_detections"].change(-0.0006) == "-0.1"
    assert SCORE_LABELS["egvs"].change(-0.4, 0.1) == "0 ± <1"


def test_small_standard_error_is_not_written_as_zero() -> None:
    egvs, detections = SCORE_LABELS["egvs"], SCORE_LABELS["expected_detections"]
    assert detections.with_error(0.999, 0.0004) == "99.9 ± <0.1 %"
    assert egvs.change(55.0, 0.4) == "55 ± <1"
    assert detections.with_error(1.0, 0.0) == "100.0 %"
    assert detections.is_zero(0.0004)
    assert not detections.is_zero(0.0006)


@pytest.mark.parametrize(
    ("probability", "text"),
    [
        (0.004, "under 1 %"),
        (0.516, "52 %"),
        (0.897, "89 %"),
        (0.9, "90 %"),
        (0.994, "99 %"),
        (0.995, "over 99 %"),
        (1.0, "over 99 %"),
    ],
)
def test_probabilities_are_whole_per_cent_that_keep_their_side_of_the_limit(probability: float, text: str) -> None:
    assert format_probability(probability) == text
