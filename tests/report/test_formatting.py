"""Values and standard errors of scores as text."""

from __future__ import annotations

import math
from typing import get_args

from egvs.report.formatting import SCORE_LABELS
from egvs.scenario.score_config import OtherScore


def test_values_and_errors_as_text() -> None:
    egvs, detections, points = (
        SCORE_LABELS["egvs"],
        SCORE_LABELS["expected_detections"],
        SCORE_LABELS["points_on_target"],
    )
    assert (egvs.value(12345.6), detections.value(0.8712), points.value(3.456)) == ("12,346", "87.1%", "3.46")
    assert (egvs.error(200.0, 3.0), detections.error(0.5, 0.012), points.error(2.0, 0.1)) == ("1.5%", "±1.2%", "5.0%")
    assert (egvs.error(0.0, 3.0), detections.error(0.5, math.nan), detections.value(math.nan)) == ("-", "-", "-")
    assert (egvs.title, detections.title, points.title) == ("EGVS<br>(bit)", "Found<br>of all", "Log<br>points")
    assert set(SCORE_LABELS) >= {"egvs", *get_args(OtherScore)}
