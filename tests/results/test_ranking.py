"""Sentences about rankings made by hand."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from egvs.core.errors import Diagnostic
from egvs.drawing.run_figures import site_caption
from egvs.report import ranking_text, sensor_text
from egvs.report.sections import describe_poles_on_road
from egvs.results.labels import SCORE_LABELS
from egvs.results.levels import (
    MAX_LEVEL_ERROR,
    DetectionLevel,
    GroupLevel,
    NoticedShare,
)
from egvs.results.ranking import Pole, RankedSite, Ranking, ScoreValue, site_titles
from egvs.results.sensors import SensorComparison
from egvs.results.study_results import STUDY
from egvs.scenario.loading import load
from egvs.scenario.score_config import CostsConfig

SCENARIOS = Path(__file__).parents[2] / "scenarios"


def ranking(*rows: tuple[str, float, int, float, float]) -> Ranking:
    """From (site, score, rank, entropy seen, chance to beat the next), best first."""
    sites = tuple(
        RankedSite(site, 0.0, 0.0, 3.0, egvs, rank, site, 0.0, 0.0, 0.0, "s", 200.0, 1, 1, entropy_seen, 1.0, beats)
        for site, egvs, rank, entropy_seen, beats in rows
    )
    return Ranking(sites, tuple(site for site in sites if site.rank == 1), ())


def by_vehicles(*rows: tuple[str, float, float], rank_by: str = "expected_detections") -> Ranking:
    """From (site, EGVS, share of vehicles found), ranked by the latter, best first."""
    sites = tuple(
        replace(site, rank_by=rank_by, others=(ScoreValue("expected_detections", detected, 0.01),))
        for site, (_, _, detected) in zip(
            ranking(*((name, egvs, i + 1, 0.5, 0.99) for i, (name, egvs, _) in enumerate(rows))).sites,
            rows,
            strict=True,
        )
    )
    return Ranking(sites, sites[:1], ())


def test_sentences_for_a_score_over_vehicles() -> None:
    detected = by_vehicles(("a", 50.0, 0.871), ("b", 90.0, 0.8), ("c", 20.0, 0.4))
    assert (
        ranking_text.headline(detected, has_traffic=True)
        == "a is the best of 3 sites: it should find 87.1 % of vehicles"
    )
    assert ranking_text.lead(detected) == "It leads the next site, b, by 7.1 percentage points."
    assert ranking_text.entropy_seen_note(detected) == ""
    assert site_caption(detected.sites[0], 1, 2).startswith("a: rank 1, the share of vehicles found 87.1 %, at x")
    assert detected.sites[0].score_se == 0.01 and detected.companion_score is SCORE_LABELS["egvs"]
    assert (
        ranking_text.headline(by_vehicles(("a", 50.0, 0.871)), has_traffic=True)
        == "a, the only site, should find 87.1 % of vehicles"
    )
    assert by_vehicles(("a", 50.0, 0.9), rank_by="egvs").companion_score is SCORE_LABELS["expected_detections"]
    assert ranking(("a", 50.0, 1, 0.5, 1.0)).companion_score is None


def with_noticed(*rows: tuple[str, float, float], low: float = 0.0, high: float = 0.0) -> Ranking:
    """From (site, share found, share noticed), best first; ``low`` and ``high`` are how far the bounds are off."""
    sites = []
    for site, (_, _, noticed) in zip(
        by_vehicles(*((name, 1.0, found) for name, found, _ in rows)).sites, rows, strict=True
    ):
        others = (*site.others, ScoreValue("noticed", noticed, 0.017))
        sites.append(replace(site, others=others, noticed_low=noticed - low, noticed_high=noticed + high))
    return Ranking(tuple(sites), tuple(sites[:1]), ())


BOTH = DetectionLevel(("cluster", "pointpillars"))


def test_the_headline_names_whose_level_it_is_with_the_measured_error() -> None:
    error = BOTH.error(0.01)
    assert STUDY.street_levels.error_points["cluster"]["all"] < 100.0 * error < MAX_LEVEL_ERROR * 100.0
    found = f"should find 84 ± {math.ceil(100.0 * error)} % of vehicles"
    ranked = with_noticed(("a", 0.841, 0.897), ("b", 0.8, 0.89))
    assert ranking_text.headline(ranked, has_traffic=True, found=BOTH) == (
        f"a is the best of 2 sites: detectors {found}; people would notice 90 ± 10 %"
    )
    of_one = f"should find 84 ± {math.ceil(100.0 * DetectionLevel(('cluster',)).error(0.01))} % of vehicles"
    assert ranking_text.headline(
        with_noticed(("a", 0.841, 0.897)), has_traffic=True, found=DetectionLevel(("cluster",))
    ) == (f"a, the only site: the detector cluster {of_one}; people would notice 90 ± 10 %")
    tie = with_noticed(("a", 0.841, 0.897), ("b", 0.841, 0.897))
    assert ranking_text.headline(replace(tie, best=tie.sites), has_traffic=True, found=BOTH).startswith(
        f"All 2 sites score the same: detectors {found}; "
    )
    both_first = with_noticed(("a", 0.841, 0.897), ("b", 0.841, 0.897), ("c", 0.5, 0.6))
    assert ranking_text.headline(replace(both_first, best=both_first.sites[:2]), True, BOTH).startswith(
        f"a and b share first place among 3 sites; from a, detectors {found}"
    )
    without = by_vehicles(("a", 50.0, 0.841), ("b", 90.0, 0.8))  # a run of an earlier version
    assert ranking_text.headline(without, has_traffic=True, found=BOTH) == (
        f"a is the best of 2 sites: detectors {found}"
    )


@pytest.mark.parametrize(
    ("name", "values", "title"),
    [
        ("k04@3m+0deg", {"pole": "k04"}, "pole k04, 3 m up, level"),
        ("k04@4.5m-10deg", {"pole": "k04", "z_m": 104.5, "pitch_deg": -10.0}, "pole k04, 4.5 m up, tilted 10° down"),
        ("Pole 7", {"z_m": 6.0, "pitch_deg": 2.5}, "Pole 7, 6 m up, tilted 2.5° up"),
        ("kerb", {"z_m": 6.0, "roll_deg": 180.0}, "pole kerb, 6 m up, level, upside down"),
        ("kerb_high", {"pole": "kerb", "z_m": 6.0}, "pole kerb, 6 m up, level"),
    ],
)
def test_a_site_is_named_as_people_would(name: str, values: dict[str, Any], title: str) -> None:
    site = replace(ranking((name, 1.0, 1, 0.5, 0.9)).sites[0], **{"pole": name, "z_m": 3.0, **values})
    assert site_titles([site]) == {name: title}
    same = replace(site, site=f"{name}_b", yaw_deg=90.0)
    assert site_titles([site, same])[same.site] == f"{title} ({same.site})"


@pytest.mark.parametrize("pole", ["c02", "c1"])
def test_a_site_with_another_name_than_its_pole_is_called_by_it(pole: str) -> None:
    site = replace(ranking(("c10", 1.0, 1, 0.5, 0.9)).sites[0], pole=pole, z_m=3.0)
    assert site_titles([site]) == {"c10": "site c10, 3 m up, level"}


def test_a_height_above_sloping_ground_is_not_made_up() -> None:
    site = replace(ranking(("kerb", 1.0, 1, 0.5, 0.9)).sites[0], z_m=212.42)
    assert site_titles([site], has_relief=True) == {"kerb": "pole kerb, at z 212.4 m, level"}


def test_a_level_with_a_large_error_is_a_range() -> None:
    """At most ± 10 is printed."""
    assert BOTH.text(0.5, 0.2) == "25 to 75 %"
    assert re.fullmatch(r"50 ± \d+ %", BOTH.text(0.5, None))


def test_the_error_of_none_and_of_all_has_one_side() -> None:
    found = math.ceil(100.0 * BOTH.error(None))
    assert 5 < found < 10
    assert BOTH.text(0.994, None) == f"99 ± {found} %"
    assert BOTH.text(0.995, None) == "90 to 100 %"
    assert BOTH.text(0.004, None) == "0 to 10 %"
    assert NoticedShare(1.0, None, 1.0, 1.0).text == "90 to 100 %"


def test_no_number_is_printed_for_a_level_that_was_not_measured() -> None:
    """A model that was compared with no street; corrected models without losses. The order of sites stays."""
    ranked = with_noticed(("a", 0.841, 0.897), ("b", 0.8, 0.89))
    assert ranking_text.headline(ranked, has_traffic=True, found=DetectionLevel(("pointpillars_sensor",))) == (
        "a is the best of 2 sites: level not measured for the detector pointpillars_sensor; people would notice 90 ± "
        "10 %"
    )
    without = replace(BOTH, has_losses=False)
    assert ranking_text.headline(by_vehicles(("a", 1.0, 0.9), ("b", 1.0, 0.8)), True, without) == (
        "a is the best of 2 sites: level not measured for detectors without losses of returns (see rated_range_m)"
    )
    assert DetectionLevel(("cluster_uncorrected",), has_losses=False).is_measured
    off = load(SCENARIOS / "demo", ["effects.range_limit=false"])
    assert not sensor_text.detection_level(off, BOTH.detectors, "VLP-32C", ()).is_measured
    assert sensor_text.detection_level(load(SCENARIOS / "demo"), BOTH.detectors, "VLP-32C", ()).is_measured


def test_the_level_error_is_that_of_the_groups() -> None:
    """Weighted by the shares of the measured groups, and added: they may have one cause."""
    noticed = NoticedShare(0.9, 0.02, 0.9, 0.9)
    shares = (("cars", 0.6), ("larger vehicles", 0.36), ("people", 0.04))
    groups = tuple(GroupLevel(name, 10, share, 0.5, 0.03, noticed) for name, share in shares)
    found = replace(BOTH, groups=groups)
    points = STUDY.street_levels.error_points["pointpillars"]
    expected = (0.6 * points["cars"] + 0.36 * points["larger vehicles"]) / 0.96
    assert 100.0 * found.error(None) == pytest.approx(expected)
    assert 100.0 * found.error(0.05) == pytest.approx(math.hypot(expected, 5.0))
    of_groups = [f"50 ± {math.ceil(math.hypot(points[name], 3.0))} %" for name in ("cars", "larger vehicles")]
    assert [found.group_text(group) for group in groups] == [*of_groups, "level not measured"]


def test_a_level_that_nothing_supports_is_a_range() -> None:
    ranked = with_noticed(("a", 0.841, 0.7), ("b", 0.8, 0.89), low=0.02, high=0.09)
    assert not ranked.sites[0].noticed.is_measured
    assert ranking_text.headline(ranked, has_traffic=True, found=BOTH).endswith("people would notice 65 to 80 %")
    assert with_noticed(("a", 0.841, 0.7), low=0.02, high=0.07).sites[0].noticed.text == "70 ± 10 %"
    assert [NoticedShare(0.5, None, low, high).cell for low, high in ((0.45, 0.65), (0.0, 1.0), (0.81, 0.99))] == [
        "45 to 65 %", "0 to 100 %", "80 to 100 %",
    ]  # fmt: skip
    assert NoticedShare(0.5, None, 0.5, 0.5).text == "50 ± 10 %"
    assert NoticedShare(0.5, 0.12, 0.5, 0.5).text == "50 ± 12 %"  # a larger error of the curves counts


def test_what_detectors_find_is_a_range_where_many_vehicles_are_of_no_measured_group() -> None:
    """0.75 x 0.9 of all are cars that are found; of the other 25 %, none or all. The order of sites stays."""
    noticed = NoticedShare(0.9, 0.02, 0.9, 0.9)
    cars = GroupLevel("cars", 300, 0.75, 0.9, 0.01, noticed)
    larger, people = (
        GroupLevel("larger vehicles", 80, 0.2, 0.4, 0.02, noticed),
        GroupLevel("people", 20, 0.05, 0.5, 0.02, noticed),
    )
    assert replace(BOTH, groups=(cars, larger, people)).range is None  # 5 % are people
    of_cars = DetectionLevel(("cluster_uncorrected",), (cars, larger, people))
    found = of_cars.range
    assert found is not None and (found.low, found.high, found.outside) == pytest.approx((0.675, 0.925, 0.25))
    ranked = with_noticed(("a", 0.841, 0.897), ("b", 0.8, 0.89))
    assert ranking_text.headline(ranked, has_traffic=True, found=of_cars) == (
        "a is the best of 2 sites: the detector cluster_uncorrected should find 65 to 95 % of vehicles (nothing is "
        "known of the 25 % that are not cars); people would notice 90 ± 10 %"
    )
    assert replace(BOTH, groups=(replace(people, weight_share=1.0),)).text(0.5, None) == "0 to 100 %"
    few = (replace(cars, weight_share=0.9), replace(people, weight_share=0.1))
    assert replace(BOTH, groups=few).range is None and BOTH.range is None


def test_a_pole_from_which_people_notice_clearly_more_is_named() -> None:
    ranked = with_noticed(("a", 0.9, 0.80), ("b", 0.8, 0.809), ("c", 0.7, 0.85), ("d", 0.6, 0.5))
    assert ranking_text.noticed_preference(ranked) == (
        "People would notice more from c (85 %) than from a (80 %); sites are ranked by what detectors should find."
    )
    same_pole = tuple(replace(site, pole="p" if site.site in "ac" else site.pole) for site in ranked.sites)
    assert ranking_text.noticed_preference(replace(ranked, sites=same_pole)) == ""
    assert ranking_text.noticed_preference(with_noticed(("a", 0.9, 0.80), ("b", 0.8, 0.809))) == ""
    assert ranking_text.noticed_preference(by_vehicles(("a", 1.0, 0.9), ("b", 1.0, 0.8))) == ""


def test_what_people_notice_is_an_upper_limit_for_sensors_without_losses(tmp_path: Path) -> None:
    """One rule: losses that are off, and sensors without a rated range."""
    demo, off = load(SCENARIOS / "demo"), load(SCENARIOS / "demo", ["effects.range_limit=false"])
    assert sensor_text.upper_limit_note(off, ["VLP-32C", "VLP-32C"]) == (
        "Losses of returns are not simulated for VLP-32C (effects.range_limit = false), but the curves of what people "
        "notice are for points with losses: read that share as an upper limit. The level of corrected detectors is "
        "unknown without losses, too."
    )
    assert sensor_text.upper_limit_note(demo, ["VLP-32C"]) == ""
    unrated = load(
        SCENARIOS / "demo", ["sensors.mine={elevations_deg=[-10.0, 0.0], azimuth_step_deg=0.4, range_m=100.0}"]
    )
    assert "not simulated for mine (it has no rated range), but" in sensor_text.upper_limit_note(
        unrated, ["VLP-32C", "mine"]
    )
    assert sensor_text.upper_limit_note(unrated, ["VLP-32C"]) == ""


def test_a_sensor_with_which_people_notice_clearly_more_is_named() -> None:
    ranked = with_noticed(("a", 0.9, 0.80), ("b", 0.8, 0.82))
    sites = [replace(site, sensor=sensor) for site, sensor in zip(ranked.sites, ("VLP-16", "OS1-64"), strict=True)]
    comparison = SensorComparison.of_run(sites, CostsConfig())
    assert sensor_text.noticed_preference(comparison) == (
        "People would notice more with OS1-64 (82 %) than with VLP-16 (80 %); the differences above are of what "
        "detectors should find."
    )
    alike = [replace(site, others=(*site.others[:1], ScoreValue("noticed", 0.8, 0.02))) for site in sites]
    assert sensor_text.noticed_preference(SensorComparison.of_run(alike, CostsConfig())) == ""


def test_gain_of_a_pole_is_in_percentage_points_for_shares_and_relative_otherwise() -> None:
    shares = by_vehicles(("a", 50.0, 0.6), ("b", 90.0, 0.4), ("c", 20.0, 0.0)).sites
    assert Pole("p", shares[:2]).gain_text == "20.0"
    assert Pole("p", shares).gain_text == "60.0"
    assert Pole("p", shares[:1]).gain_text == ""
    bits = ranking(("a", 60.0, 1, 0.5, 1.0), ("b", 40.0, 2, 0.5, 1.0), ("c", 0.0, 3, 0.0, 1.0)).sites
    assert Pole("p", bits[:2]).gain_text == "50.0 %"
    assert Pole("p", bits).gain_text == ""


def test_lead_says_whether_the_best_is_certain() -> None:
    """Two that share the first place cannot beat each other; whether they lead is another matter."""
    ahead = ranking(("a", 100.0, 1, 0.5, 0.5), ("b", 100.0, 1, 0.6, 0.99), ("c", 80.0, 3, 0.4, 1.0))
    assert ranking_text.lead(ahead) == "They lead the next site, c, by 20.0 % of their score."
    near = ranking(("a", 100.0, 1, 0.5, 0.5), ("b", 100.0, 1, 0.6, 0.7), ("c", 98.0, 3, 0.4, 1.0))
    assert ranking_text.lead(near).endswith("by 2.0 % of their score. These poles cannot be told apart.")
    alone = ranking(("a", 100.0, 1, 0.5, 0.7), ("c", 98.0, 2, 0.4, 1.0))
    assert ranking_text.lead(alone, "More helps.").endswith("These poles cannot be told apart. More helps.")


def test_lead_names_the_best_site_on_another_pole_if_the_next_site_is_on_the_same_one() -> None:
    sites = by_vehicles(("a", 50.0, 0.9), ("b", 50.0, 0.88), ("c", 50.0, 0.85), ("d", 50.0, 0.8)).sites
    on_one_pole = [replace(site, pole=pole) for site, pole in zip(sites, ("p", "p", "q", "q"), strict=True)]
    text = ranking_text.lead(Ranking(tuple(on_one_pole), (on_one_pole[0],), ()))
    assert text == (
        "It leads the next site, b, by 2.0 percentage points."
        " The best site on another pole, c, is behind by 5.0 percentage points."
    )
    single_pole = tuple(replace(site, pole="p") for site in sites)
    text = ranking_text.lead(Ranking(single_pole, single_pole[:1], ()))
    assert text == "It leads the next site, b, by 2.0 percentage points."


def with_rivals(*rows: tuple[str, str, float, float, float]) -> Ranking:
    """From (site, pole, share found, error of the difference to the best, chance that the best is better)."""
    sites = by_vehicles(*((site, 50.0, share) for site, _, share, _, _ in rows)).sites
    compared = tuple(
        replace(site, pole=pole, behind_best_se=se, best_beats=chance)
        for site, (_, pole, _, se, chance) in zip(sites, rows, strict=True)
    )
    return Ranking(compared, compared[:1], ())


@pytest.mark.parametrize(
    ("chance", "says"),
    [
        (0.903, "(it is truly worse with a probability of 90 %)."),
        (0.896, "(it is truly worse with a probability of 89 %). These poles cannot be told apart. More helps."),
        (0.7, "(it is truly worse with a probability of 70 %). These poles cannot be told apart. More helps."),
        (0.9999, "(it is truly worse with a probability of over 99 %)."),
    ],
)
def test_lead_over_another_pole_has_its_error_and_probability(chance: float, says: str) -> None:
    sites = with_rivals(("a", "p", 0.9, 0.0, 0.5), ("b", "p", 0.89, 0.004, 0.99), ("c", "q", 0.883, 0.013, chance))
    assert ranking_text.lead(sites, "More helps.") == (
        "It leads the next site, b, by 1.0 ± 0.4 percentage points (it is truly better with a probability of 99 %)."
        f" The best site on another pole, c, is behind by 1.7 ± 1.3 percentage points {says}"
    )


def test_next_site_on_another_pole_is_compared_once() -> None:
    text = ranking_text.lead(with_rivals(("a", "p", 0.9, 0.0, 0.5), ("c", "q", 0.8999, 0.0001, 0.84)), "More helps.")
    assert text == (
        "It leads the next site, c, by 0.01 ± 0.01 percentage points (it is truly better with a probability of 84 %)."
        " These poles cannot be told apart."
    )


@pytest.mark.parametrize(("behind", "helps"), [(0.0009, False), (0.0011, True), (0.0, False)])
def test_hint_is_given_where_poles_differ_by_a_tenth_of_a_point(behind: float, helps: bool) -> None:
    sites = with_rivals(("a", "p", 0.9, 0.0, 0.5), ("c", "q", 0.9 - behind, 0.004, 0.6))
    text = ranking_text.lead(sites, "More helps.")
    assert "These poles cannot be told apart." in text
    assert text.endswith("More helps.") == helps


def test_no_hint_for_mounts_of_one_pole() -> None:
    sites = with_rivals(("a", "p", 0.9, 0.0, 0.5), ("b", "p", 0.895, 0.004, 0.6), ("c", "q", 0.8, 0.004, 0.999))
    text = ranking_text.lead(sites, "More helps.")
    assert "These sites cannot be told apart." in text
    assert "More helps." not in text


def test_hint_names_the_setting_that_limits_the_error(mini: Path) -> None:
    by, egvs = SCORE_LABELS["expected_detections"], SCORE_LABELS["egvs"]
    recorded = load(mini)
    more = "More frames may separate them: --set score.sampled_frames="
    assert ranking_text.more_frames_hint(recorded, by, 5000) == f"{more}1000."
    assert ranking_text.more_frames_hint(recorded, by, 600) == f"{more}600."
    assert ranking_text.more_frames_hint(recorded, by, 500) == "A longer recording may separate them."
    assert ranking_text.more_frames_hint(recorded, egvs, 5000) == "A longer recording may separate them."
    many = load(mini, ["score.sampled_frames=1000"])
    assert ranking_text.more_frames_hint(many, by, 5000) == f"{more}4000."
    simulated = load(SCENARIOS / "roundabout")
    assert ranking_text.more_frames_hint(simulated, egvs, 5000).endswith("--set traffic.frames=20000.")
    assert "longer periods" in ranking_text.more_frames_hint(load(SCENARIOS / "nishishinjuku_peaks"), by, 400)


@pytest.mark.parametrize(("by_detectors", "asks_for_traffic"), [(0.004, False), (0.0029, False), (0.0028, True)])
def test_hint_is_not_more_traffic_where_detectors_disagree(
    mini: Path, by_detectors: float, asks_for_traffic: bool
) -> None:
    """Of an error of 0.4 points, more than half of the square is due to detectors from 0.283 points on."""
    sites = with_rivals(("a", "p", 0.9, 0.0, 0.5), ("c", "q", 0.895, 0.004, 0.6))
    rival = replace(sites.sites[1], behind_best_detectors_se=by_detectors)
    sites = replace(sites, sites=(sites.sites[0], rival))
    scenario = load(mini, ["score.rank_by='expected_detections'"])
    hint = ranking_text.recorded_frames_hint(scenario, sites, {})
    assert (hint == "") == asks_for_traffic  # there is no record of the traffic
    if hint:
        assert hint == (
            "The detectors disagree about this difference, and more traffic does not change that: see --detector "
            "cluster and --detector pointpillars."
        )


def test_note_on_the_site_that_sees_most_entropy() -> None:
    """Of two with the same score, one that sees more contradicts nothing."""
    tied = ranking(("a", 100.0, 1, 0.5, 0.5), ("b", 100.0, 1, 0.6, 0.99), ("c", 80.0, 3, 0.4, 1.0))
    assert ranking_text.entropy_seen_note(tied) == "b also sees the largest share of the traffic’s uncertainty, 60.0 %."
    other = ranking(("a", 100.0, 1, 0.5, 0.99), ("c", 80.0, 2, 0.7, 1.0))
    assert ranking_text.entropy_seen_note(other).startswith(
        "c, rank 2, sees more of the traffic’s uncertainty (70.0 % against 50.0 %), but with fewer beams. One beam"
    )
    agree = ranking(("a", 100.0, 1, 0.7, 0.99), ("c", 80.0, 2, 0.5, 1.0))
    assert (
        ranking_text.entropy_seen_note(agree) == "It also sees the largest share of the traffic’s uncertainty, 70.0 %."
    )


def test_poles_in_lanes_are_named_once_with_their_street() -> None:
    ranked = by_vehicles(*((name, 50.0, 0.9) for name in ("a", "b", "c", "d")))
    warnings = [
        Diagnostic("sites on lanes", "sites.csv: site a and 2 more", "(0, 0, 3) is in a lane of An der Warth", ""),
        Diagnostic("sites on lanes", "sites.csv: site d", "(0, 9, 3) is within a junction", ""),
        Diagnostic("sites on lanes", "sites.csv", "2 more of 9 are in lanes or junctions: c, z", ""),
        Diagnostic("sites in solids", "sites.csv: site b", "(0, 9, 3) is in a house", ""),
    ]
    assert describe_poles_on_road(ranked.poles[:3], warnings) == [
        "a stands in a lane of An der Warth",
        "c stands in a lane or junction",
    ]
