"""Texts of the panel."""

from __future__ import annotations

from egvs.explore import controls
from egvs.explore.session import PoseScore
from egvs.sensors.sites import Pose, Site


def test_describes_score_and_change() -> None:
    site = Site("a_b", Pose(0, 0, 3), "small")
    candidate = PoseScore(site, {"egvs": 200.0, "entropy_seen": 0.5}, 2)
    moved = PoseScore(Site("a_b", Pose(0, 0, 4), "small"), {"egvs": 250.0, "entropy_seen": 0.6}, 1)
    text = controls.describe_score(moved, "egvs", candidate, 7)
    assert text.startswith("## 250.0 bit (+25.0 %)\n\nrank 1 of 7 by EGVS\n")
    assert "| entropy seen | 60.0 % |" in text
    assert "a\\_b" in controls.ranking_table([candidate], "egvs")
    assert controls.describe_score(candidate, "egvs", candidate, 7).startswith("## 200.0 bit\n")


def test_what_people_notice_is_shown_beside_what_detectors_find() -> None:
    site = Site("a", Pose(0, 0, 3), "small")
    candidate = PoseScore(site, {"expected_detections": 0.8, "noticed": 0.874}, 1)
    moved = PoseScore(Site("a", Pose(0, 0, 4), "small"), {"expected_detections": 0.84, "noticed": 0.896}, 1)
    text = controls.describe_score(moved, "expected_detections", candidate, 3)
    assert text.startswith("## 84.0 % found (+5.0 %), 90 % noticed\n")
    unknown = PoseScore(moved.site, {"expected_detections": 0.84}, 1)
    text = controls.describe_score(unknown, "expected_detections", candidate, 3)
    assert text.startswith("## 84.0 % found (+5.0 %)\n")
