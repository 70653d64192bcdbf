"""The present score at junctions measured before: its judgement by hand, and the score of a real junction."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.across_junctions import calibration, second_look
from benchmarks.across_junctions.detections import AP
from benchmarks.across_junctions.protocol import read_protocol
from benchmarks.across_junctions.records import JunctionRecord, MeasureRecord

from egvs.scoring.target_scores import DETECTORS

FOUND = np.array([0.1, 0.2, 0.3, 0.5, 0.6, 0.9])
SWAPPED = np.array([0.1, 0.2, 0.3, 0.6, 0.9, 0.8])


def record(score: np.ndarray) -> JunctionRecord:
    """Six candidates, three of each height; AP and the share found are the same."""
    measure = MeasureRecord(FOUND, np.repeat(FOUND[:, None], 4, axis=1), np.repeat(FOUND[:, None], 2, axis=1))
    measures = dict.fromkeys((AP, *calibration.RECALLS), measure)
    scores = {f"expected_detections (detectors {names})": score for names in ("+".join(DETECTORS), *DETECTORS)}
    return JunctionRecord(
        "j", "held out", tuple("abcdef"), np.repeat([2.0, 5.0], 3), ("one", "two") * 3, scores,
        {"cluster": measures}, {},
    )  # fmt: skip


def test_judgement_by_hand() -> None:
    judged = second_look.judge(record(SWAPPED), "cluster")
    assert judged.rho == pytest.approx(1.0 - 6.0 * 2.0 / (6.0 * 35.0))  # the last two are in the wrong order
    assert judged.rho_within_heights == pytest.approx((1.0 + 0.5) / 2)
    assert judged.regret == pytest.approx(30.0)
    assert judged.level_error == pytest.approx(np.sqrt((10.0**2 + 30.0**2 + 10.0**2) / 3))
    assert judged.surplus == pytest.approx({"one": -10.0, "two": 0.0})


def test_tables_show_both_scores() -> None:
    before, after = (second_look.judge(record(score), "cluster") for score in (SWAPPED, FOUND))
    key = ("j", "cluster")
    text = "\n".join(second_look._over_junctions([key], {key: before}, {key: after}))
    assert "| `cluster` | 0.943 → 1.000 | 0.750 → 1.000 | 30.0 → 0.0 | 30.0 → 0.0 | 19.1 → 0.0 |" in text
    assert "| one | -10.0 → +0.0 |" in text


@pytest.mark.system
@pytest.mark.slow
def test_score_is_computed_for_all_candidates(tmp_path: Path) -> None:
    protocol = read_protocol()
    scores = second_look.compute_score(protocol, protocol.junction("hill"), None, tmp_path, jobs=2)
    assert set(scores) == set(record(FOUND).scores)
    both = scores[second_look.MAIN]
    assert len(both) == 48 and np.isfinite(both).all() and 0.0 <= both.min() < 0.1 and 0.5 < both.max() < 1.0
    np.testing.assert_allclose(
        both, np.mean([scores[f"expected_detections (detectors {d})"] for d in DETECTORS], axis=0)
    )
