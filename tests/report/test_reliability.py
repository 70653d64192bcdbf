"""Reasons to be careful with rankings made by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from egvs.report.reliability import describe_reliability
from egvs.results.ranking import RankedSite, Ranking, ScoreValue


def ranked(*mounts: tuple[str, float, float, float], rank_by: str = "egvs") -> Ranking:
    """From (pole, z, pitch, score), best first; each site is named after its pole, z and pitch."""
    sites = []
    for rank, (pole, z_m, pitch_deg, score) in enumerate(mounts, 1):
        name = f"{pole}@{z_m:g}m{pitch_deg:+g}deg"
        site = RankedSite(name, 0.0, 0.0, z_m, score, rank, pole, 0.0, pitch_deg, 0.0, "s", 200.0, 1, 1, 0.5)
        sites.append(replace(site, rank_by=rank_by, others=(ScoreValue("expected_detections", score, 0.01),)))
    return Ranking(tuple(sites), (sites[0],), ())


def test_nothing_is_said_of_a_level_site_between_the_limits() -> None:
    assert describe_reliability(ranked(("a", 4, 0, 9.0), ("a", 3, 0, 5.0), ("a", 6, 0, 4.0), ("b", 9, -20, 1.0))) == []


@pytest.mark.parametrize(
    ("mounts", "limits"),
    [
        ([(3, 0), (4, 0)], "lowest"),
        ([(4, 0), (3, 0)], "highest"),
        ([(3, -10), (3, 0)], "steepest"),
        ([(3, 0), (3, -10)], "least tilted"),
        ([(4, -10), (3, -20), (4, -15)], "highest and least tilted"),
        ([(3, -10), (4, 0)], "lowest and steepest"),
    ],
)
def test_names_the_limits_that_the_best_mount_of_a_pole_reaches(mounts: list[tuple[float, float]], limits: str) -> None:
    sites = [("a", z_m, pitch_deg, 9.0 - rank) for rank, (z_m, pitch_deg) in enumerate(mounts)]
    sentence = f"The best mount is the {limits} of those tried: one beyond may be better."
    assert describe_reliability(ranked(*sites))[-1] == sentence


def test_one_mount_on_each_pole_has_no_limits() -> None:
    assert describe_reliability(ranked(("a", 3, 0, 9.0), ("b", 6, 0, 5.0))) == []


@pytest.mark.parametrize(("pitch_deg", "is_tilted"), [(-29.0, True), (5.0, True), (-10.0, False), (0.0, False)])
def test_says_that_larger_tilts_were_not_validated(pitch_deg: float, is_tilted: bool) -> None:
    sentences = describe_reliability(ranked(("a", 3, pitch_deg, 9.0), ("b", 3, 0, 5.0)))
    assert sentences == is_tilted * [
        f"The tilt of a@3m{pitch_deg:+g}deg is outside the range of the validation (pitch -25 to 0 degrees, positive "
        "is up; roll up to 3 degrees; docs/validity.md)."
    ]


@pytest.mark.parametrize(("roll_deg", "is_tilted"), [(180.0, False), (-178.0, False), (170.0, True), (10.0, True)])
def test_upside_down_is_no_tilt(roll_deg: float, is_tilted: bool) -> None:
    ranking = ranked(("a", 3, 0, 9.0), ("b", 3, 0, 5.0))
    hung = replace(ranking, sites=tuple(replace(site, roll_deg=roll_deg) for site in ranking.sites))
    assert any("The tilt of" in sentence for sentence in describe_reliability(hung)) == is_tilted


def test_size_of_expected_detections_was_validated_less_than_its_order() -> None:
    (sentence,) = describe_reliability(ranked(("a", 3, 0, 0.9), ("b", 3, 0, 0.5), rank_by="expected_detections"))
    assert "better than its size" in sentence and "±" not in sentence


@pytest.mark.parametrize("rank_by", ["egvs", "expected_detections"])
@pytest.mark.parametrize("traffic", [{"seeds": [1, 7, 9]}, {"periods": {"day": {"seeds": [1, 7, 9]}}}])
def test_says_that_errors_come_from_several_simulations(rank_by: str, traffic: dict[str, Any]) -> None:
    ranking = ranked(("a", 3, 0, 0.9), ("b", 3, 0, 0.5), rank_by=rank_by)
    assert not any("±" in sentence for sentence in describe_reliability(ranking, traffic))
    with_errors = replace(ranking, sites=tuple(replace(site, egvs_se=0.1) for site in ranking.sites))
    (sentence,) = describe_reliability(with_errors, traffic)
    assert sentence.startswith("± is the error of finite simulations only, from the differences between 3 of them.")
    assert ("validated" in sentence) == (rank_by == "expected_detections")


@pytest.mark.parametrize(
    ("seeds", "detectors", "note"),
    [
        ([1], ("a", "b"), "± contains the error of a finite simulation, and how far the detectors (a, b) disagree."),
        (
            [1, 7],
            ("a", "b"),
            "± contains the error of finite simulations, from the differences between 2 of them, and how far the "
            "detectors (a, b) disagree.",
        ),
        ([1], ("a",), "± is the error of a finite simulation only; the score is that of the detector a."),
        ([1], (), "± is the error of a finite simulation only."),
    ],
)
def test_says_what_errors_contain(seeds: list[int], detectors: tuple[str, ...], note: str) -> None:
    ranking = ranked(("a", 3, 0, 0.9), ("b", 3, 0, 0.5), rank_by="expected_detections")
    ranking = replace(ranking, sites=tuple(replace(site, egvs_se=0.1) for site in ranking.sites))
    (sentence,) = describe_reliability(ranking, {"seeds": seeds}, detectors)
    assert sentence.startswith(f"{note} The order of sites")


def test_says_how_little_the_score_for_heights_from_the_sensor_was_tested() -> None:
    ranking = ranked(("a", 3, 0, 0.9), ("b", 3, 0, 0.5), rank_by="expected_detections")
    (sentence,) = describe_reliability(ranking, None, ("pointpillars_sensor",))
    assert sentence == (
        "This detector measures heights from the sensor, and the score for it was tested at 13 sites of one junction "
        "only (docs/validity.md)."
    )


def test_sites_that_see_nothing_or_score_the_same_need_no_further_words() -> None:
    assert describe_reliability(ranked(("a", 3, -10, 0.0), ("a", 4, 0, 0.0))) == []
    tie = ranked(("a", 3, -10, 5.0), ("a", 4, 0, 5.0))
    assert describe_reliability(Ranking(tie.sites, tie.sites, ())) == []
