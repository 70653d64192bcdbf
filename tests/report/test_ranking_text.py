"""The EGVS and the recommended score beside each other, with the evidence of the study."""

from __future__ import annotations

import csv
import math
from pathlib import Path

from egvs.report.ranking_text import FROM_SENSOR_NOTE, RHO_RANGE, egvs_setting, ranking_disagreement
from egvs.results.study_results import STUDY
from tests.results.test_ranking import by_vehicles, ranking

EGVS = egvs_setting(2.0, 0.25)


def test_reports_scores_with_different_best_sites() -> None:
    rows = (("a", 50.0, 0.9), ("b", 90.0, 0.8), ("c", 20.0, 0.7), ("d", 80.0, 0.6))
    text = ranking_disagreement(by_vehicles(*rows).sites, EGVS, {})
    assert text == (
        "The best sites by EGVS are b, d and a; by the share of vehicles found they are a, b and c. "
        "How well this setting of the EGVS predicts detection was not measured."
    )
    assert ranking_disagreement(by_vehicles(*rows, rank_by="egvs").sites, EGVS, {}) == text  # whichever ranks
    other = ranking_disagreement(by_vehicles(*rows).sites, EGVS, detectors=("pointpillars_sensor",))
    assert other.endswith(f"they are a, b and c. {FROM_SENSOR_NOTE}")
    rho = {"expected_detections": {"cluster": 0.9, "pointpillars": 0.8}, EGVS: {"cluster": 0.7, "pointpillars": 0.6}}
    assert ranking_disagreement(by_vehicles(*rows).sites, EGVS, rho).endswith(
        " At the held-out junctions of the validation study, the share of vehicles found was the better "
        "predictor of detection: mean rank correlation 0.90 against 0.70 (cluster) and 0.80 against 0.60 "
        f"(pointpillars). That of the share of vehicles found is {RHO_RANGE}; see docs/validity.md."
    )
    for worse, who in ((0.5, "the EGVS"), (0.65, "neither score")):
        rho["expected_detections"] = {"cluster": worse, "pointpillars": worse if worse < 0.6 else 0.55}
        rho["expected_detections"]["pointpillars"] = 0.5 if worse == 0.5 else 0.7
        text = ranking_disagreement(by_vehicles(*rows).sites, EGVS, rho)
        assert f", {who} was " in text and "the better predictor of detection: mean rank" in text
    for other in (egvs_setting(10.0, 0.25), egvs_setting(2.0, 0.25, moving_occlusion=True)):
        assert ranking_disagreement(by_vehicles(*rows).sites, other, rho).endswith(
            "was not measured. The rank correlation of the share of vehicles found with detection is "
            f"{RHO_RANGE}; see docs/validity.md."
        )


def test_evidence_equals_the_tables_of_the_study() -> None:
    path = Path(__file__).parents[2] / "docs" / "data" / "validity" / "f-all-scores.csv"
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    rho = {row["score"]: {name: round(float(row[name]), 2) for name in ("cluster", "pointpillars")} for row in rows}
    expected = {name: row for name, row in rho.items() if name.startswith("egvs ")}
    expected["expected_detections"] = rho["expected_detections (detectors cluster+pointpillars)"]
    assert expected == STUDY.first_study.rho
    assert {egvs_setting(10.0, 0.25), egvs_setting(2.0, 0.5, moving_occlusion=True)} < set(expected)


def test_is_silent_if_scores_agree() -> None:
    same = (("a", 90.0, 0.9), ("b", 60.0, 0.8), ("c", 70.0, 0.7), ("d", 50.0, 0.6))  # the second and the third change
    assert ranking_disagreement(by_vehicles(*same).sites, EGVS, {}) == ""
    other_first = (("a", 60.0, 0.9), ("b", 90.0, 0.8), ("c", 70.0, 0.7), ("d", 50.0, 0.6))
    assert ranking_disagreement(by_vehicles(*other_first).sites, EGVS, {}).startswith(
        "The best sites by EGVS are b, c and a; by"
    )
    assert ranking_disagreement(ranking(("a", 9.0, 1, 0.5, 1.0)).sites, EGVS, {}) == ""  # not asked for
    unknown = by_vehicles(("a", 60.0, math.nan), ("b", 90.0, 0.8)).sites
    assert ranking_disagreement(unknown, EGVS, {}) == ""
