"""Sections on other commands: their sentences, and that they are shown only beside the same run."""

from __future__ import annotations

import base64
import csv
import html
import math
from functools import partialmethod
from pathlib import Path

import pytest

from egvs.artefacts import parquet
from egvs.report.sections import FROM_SENSOR_NOTE, RHO_RANGE, egvs_setting, ranking_disagreement
from egvs.results.study_results import STUDY
from egvs.studies import study_settings
from egvs.studies.accuracy import StudyOptions
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


@pytest.mark.slow
def test_shows_the_accuracy_study_of_the_same_run(mini, tmp_path, run_egvs, monkeypatch):
    """Its recommendation, the front, the figure; not of another scenario or other files; the run is verified in each
    case."""
    few = study_settings.SettingValues(
        voxels_m=(1.0,), gammas=(2.0,), thinning_factors=(), frame_periods_s=(), unnamed_effects=False
    )
    monkeypatch.setattr(StudyOptions, "__init__", partialmethod(StudyOptions.__init__, values=few))
    out = tmp_path / "out"

    def is_shown():
        return "What a right decision costs" in (out / "report.html").read_text()

    assert run_egvs("run", mini, "--out", out)[0] == 0
    assert not is_shown()
    code, printed, error = run_egvs("accuracy", mini, "--out", out)
    assert code == 0, error
    assert str(out / "report.html") in printed.splitlines()
    text = (out / "report.html").read_text()
    assert f"data:image/png;base64,{base64.b64encode((out / 'accuracy.png').read_bytes()).decode()}" in text
    rows = parquet.read_artefact(out / "accuracy.parquet", "accuracy")[0].to_pylist()
    best = next(row for row in rows if row["recommended"])
    section = text[text.index("What a right decision costs") :]
    section = section[: section.index("</section>")]
    assert best["overrides"]  # it is cheaper than the scenario
    assert f"<code>{best['overrides']}</code>" in html.unescape(section)
    assert f"expected to lose {best['loss_points']:.2f} ±" in section
    assert section.count("<tr") == 1 + sum(
        row["front"] or row["recommended"] or row["kind"] == "scenario" for row in rows
    )
    assert run_egvs("verify", out)[0] == 0

    assert run_egvs("accuracy", mini, "--out", out, "--set", "score.gamma=3.0")[0] == 0
    assert not is_shown()  # that study is of another scenario than the run
    assert run_egvs("verify", out)[0] == 0
    assert run_egvs("run", mini, "--out", out, "--set", "score.gamma=3.0")[0] == 0
    assert is_shown()
    assert run_egvs("verify", out)[0] == 0
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,10,12,3\n")
    assert run_egvs("run", mini, "--out", out, "--set", "score.gamma=3.0")[0] == 0
    assert not is_shown()  # nor is it of other sites


@pytest.mark.slow
def test_verify_reports_a_replaced_study(mini, tmp_path, run_egvs):
    out = tmp_path / "out"
    assert run_egvs("run", mini, "--out", out)[0] == 0
    assert run_egvs("accuracy", mini, "--out", out, "--budget", "0.001s")[0] == 0
    (out / "accuracy.png").write_bytes((out / "accuracy.png").read_bytes() + b"x")
    code, printed, _ = run_egvs("verify", out)
    assert code == 1
    assert "report.html shows accuracy.png, which was replaced since" in printed


@pytest.mark.slow
def test_rejects_a_damaged_study(mini, tmp_path, run_egvs):
    out = tmp_path / "out"
    assert run_egvs("accuracy", mini, "--out", out, "--budget", "0.001s")[0] == 0
    parquet.write_artefact(
        out / "accuracy.parquet",
        "scores",
        {name: [] for name in parquet.arrow_schema("scores").names},
        {"schema": 1},
    )
    code, _, error = run_egvs("run", mini, "--out", out)
    assert code == 2
    assert "accuracy.parquet: does not match its checksum in accuracy.sha256. Remove it, or run" in error
    (out / "accuracy.sha256").unlink()  # as an earlier version left none
    code, _, error = run_egvs("run", mini, "--out", out)
    assert code == 2
    assert "accuracy.parquet: is not an accuracy study (" in error
    assert "Remove it, or run egvs accuracy again." in error
