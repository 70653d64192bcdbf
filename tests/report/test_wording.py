"""The report's sentences, on rankings made by hand."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path
from typing import get_args

from egvs.report import ranking as report_ranking
from egvs.report.formatting import SCORE_LABELS
from egvs.report.ranking import RankedSite, Ranking
from egvs.report.sections import RHO, egvs_setting, ranking_disagreement
from egvs.scenario.score_config import OtherScore


def ranking(*rows: tuple[str, float, int, float, float]) -> Ranking:
    """From (site, score, rank, entropy seen, chance to beat the next), best first."""
    sites = tuple(
        RankedSite(site, 0.0, 0.0, 3.0, egvs, rank, site, 0.0, 0.0, 0.0, "s", 200.0, 1, 1, seen, 1.0, beats)
        for site, egvs, rank, seen, beats in rows
    )
    return Ranking(sites, tuple(site for site in sites if site.rank == 1), ())


def by_vehicles(*rows: tuple[str, float, float], rank_by: str = "expected_detections") -> Ranking:
    """From (site, EGVS, share of vehicles found), ranked by the latter, best first."""
    sites = tuple(
        replace(site, rank_by=rank_by, others=(("expected_detections", found, 0.01),))
        for site, (_, _, found) in zip(
            ranking(*((name, egvs, i + 1, 0.5, 0.99) for i, (name, egvs, _) in enumerate(rows))).sites,
            rows,
            strict=True,
        )
    )
    return Ranking(sites, sites[:1], ())


def test_a_score_over_vehicles_is_told_in_a_planners_words() -> None:
    found = by_vehicles(("a", 50.0, 0.871), ("b", 90.0, 0.8), ("c", 20.0, 0.4))
    assert (
        report_ranking.headline(found, has_traffic=True) == "a is the best of 3 sites: it should find 87% of vehicles"
    )
    assert report_ranking.lead(found) == "It leads b, the next, by 8.2% of its score."
    assert report_ranking.entropy_seen_note(found) == ""
    assert report_ranking.site_caption(found.sites[0], 1, 2).startswith(
        "a: rank 1, the share of vehicles found 87.1%, at x"
    )
    assert found.sites[0].score_se == 0.01 and found.companion_score is SCORE_LABELS["egvs"]
    assert (
        report_ranking.headline(by_vehicles(("a", 50.0, 0.871)), has_traffic=True)
        == "a, the only site, should find 87% of vehicles"
    )
    assert by_vehicles(("a", 50.0, 0.9), rank_by="egvs").companion_score is SCORE_LABELS["expected_detections"]
    assert ranking(("a", 50.0, 1, 0.5, 1.0)).companion_score is None


def test_values_and_errors_in_tables() -> None:
    egvs, found, points = SCORE_LABELS["egvs"], SCORE_LABELS["expected_detections"], SCORE_LABELS["points_on_target"]
    assert (egvs.value(12345.6), found.value(0.8712), points.value(3.456)) == ("12,346", "87.1%", "3.46")
    assert (egvs.error(200.0, 3.0), found.error(0.5, 0.012), points.error(2.0, 0.1)) == ("1.5%", "±1.2%", "5.0%")
    assert (egvs.error(0.0, 3.0), found.error(0.5, math.nan), found.value(math.nan)) == ("-", "-", "-")
    assert (egvs.title, found.title, points.title) == ("EGVS<br>(bit)", "Found<br>of all", "Log<br>points")
    assert set(SCORE_LABELS) >= {"egvs", *get_args(OtherScore)}


EGVS = egvs_setting(2.0, 0.25)


def test_where_two_scores_have_other_sites_first() -> None:
    rows = (("a", 50.0, 0.9), ("b", 90.0, 0.8), ("c", 20.0, 0.7), ("d", 80.0, 0.6))
    told = ranking_disagreement(by_vehicles(*rows).sites, EGVS, {})
    assert told == (
        "The EGVS has b, d and a first, the share of vehicles found has a, b and c: how well this setting of the EGVS"
        " goes with detection was not measured."
    )
    assert ranking_disagreement(by_vehicles(*rows, rank_by="egvs").sites, EGVS, {}) == told  # whichever ranks
    rho = {"expected_detections": {"cluster": 0.9, "pointpillars": 0.8}, EGVS: {"cluster": 0.7, "pointpillars": 0.6}}
    assert ranking_disagreement(by_vehicles(*rows).sites, EGVS, rho).endswith(
        ": detection agrees with the share of vehicles found, rho with what is detected at junctions that chose"
        " nothing: 0.90 against 0.70 (cluster) and 0.80 against 0.60 (pointpillars); see docs/validity.md."
    )
    for worse, who in ((0.5, "the EGVS"), (0.65, "neither")):
        rho["expected_detections"] = {"cluster": worse, "pointpillars": worse if worse < 0.6 else 0.55}
        rho["expected_detections"]["pointpillars"] = 0.5 if worse == 0.5 else 0.7
        assert f"detection agrees with {who}, rho" in ranking_disagreement(by_vehicles(*rows).sites, EGVS, rho)
    for other in (egvs_setting(10.0, 0.25), egvs_setting(2.0, 0.25, moving_occlusion=True)):
        assert ranking_disagreement(by_vehicles(*rows).sites, other, rho).endswith(
            "was not measured; the share of vehicles found goes with it at rho 0.65 (cluster) and 0.70 (pointpillars),"
            " see docs/validity.md."
        )


def test_the_evidence_is_that_of_the_studys_tables() -> None:
    path = Path(__file__).parents[2] / "docs" / "data" / "validity" / "f-all-scores.csv"
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    told = {row["score"]: {name: round(float(row[name]), 2) for name in ("cluster", "pointpillars")} for row in rows}
    own = {name: its for name, its in told.items() if name.startswith("egvs ")}
    own["expected_detections"] = told["expected_detections (detectors cluster+pointpillars)"]
    assert own == RHO and {egvs_setting(10.0, 0.25), egvs_setting(2.0, 0.5, moving_occlusion=True)} < set(RHO)


def test_scores_that_agree_are_not_told() -> None:
    same = (("a", 90.0, 0.9), ("b", 60.0, 0.8), ("c", 70.0, 0.7), ("d", 50.0, 0.6))  # the second and the third change
    assert ranking_disagreement(by_vehicles(*same).sites, EGVS, {}) == ""
    other_first = (("a", 60.0, 0.9), ("b", 90.0, 0.8), ("c", 70.0, 0.7), ("d", 50.0, 0.6))
    assert ranking_disagreement(by_vehicles(*other_first).sites, EGVS, {}).startswith("The EGVS has b, c and a first")
    assert ranking_disagreement(ranking(("a", 9.0, 1, 0.5, 1.0)).sites, EGVS, {}) == ""  # not asked for
    unknown = by_vehicles(("a", 60.0, math.nan), ("b", 90.0, 0.8)).sites
    assert ranking_disagreement(unknown, EGVS, {}) == ""


def test_the_one_beside_the_next_says_whether_the_first_can_be_told_from_it() -> None:
    """Two that share the first place cannot beat each other; whether they lead is another matter."""
    ahead = ranking(("a", 100.0, 1, 0.5, 0.5), ("b", 100.0, 1, 0.6, 0.99), ("c", 80.0, 3, 0.4, 1.0))
    assert report_ranking.lead(ahead) == "They lead c, the next, by 20.0% of their score."
    near = ranking(("a", 100.0, 1, 0.5, 0.5), ("b", 100.0, 1, 0.6, 0.7), ("c", 98.0, 3, 0.4, 1.0))
    assert report_ranking.lead(near).endswith(
        "by 2.0% of their score. With this much traffic they cannot be told apart."
    )
    alone = ranking(("a", 100.0, 1, 0.5, 0.7), ("c", 98.0, 2, 0.4, 1.0))
    assert report_ranking.lead(alone).endswith("With this much traffic they cannot be told apart.")


def test_what_entropy_seen_says_beside_the_score() -> None:
    """Of two with the same score, one that sees more contradicts nothing."""
    tied = ranking(("a", 100.0, 1, 0.5, 0.5), ("b", 100.0, 1, 0.6, 0.99), ("c", 80.0, 3, 0.4, 1.0))
    assert report_ranking.entropy_seen_note(tied) == "b also sees most of the traffic’s uncertainty, 60.0%."
    other = ranking(("a", 100.0, 1, 0.5, 0.99), ("c", 80.0, 2, 0.7, 1.0))
    assert report_ranking.entropy_seen_note(other).startswith(
        "c, rank 2, sees more of the traffic’s uncertainty (70.0% against 50.0%), but with fewer beams on it. A voxel"
    )
    agree = ranking(("a", 100.0, 1, 0.7, 0.99), ("c", 80.0, 2, 0.5, 1.0))
    assert report_ranking.entropy_seen_note(agree) == "It also sees most of the traffic’s uncertainty, 70.0%."
