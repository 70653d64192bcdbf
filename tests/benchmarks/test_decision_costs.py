"""Rows about decisions are written to a page one by one; losses are those of tables made by hand."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from benchmarks import decision_costs, page_tables

import egvs
from egvs.studies.study_settings import SettingValues

PAGE = Path(__file__).parents[2] / "docs" / "accuracy.md"
TABLES = (
    (decision_costs.SCENARIO_MARKS, decision_costs.SCENARIO_HEADINGS),
    (decision_costs.AREA_MARKS, decision_costs.AREA_HEADINGS),
    (decision_costs.DETECTOR_MARKS, decision_costs.DETECTOR_HEADINGS),
)
FOUND = {"a": np.array([0.5, 0.7]), "b": np.array([0.9, 0.7]), "c": np.array([0.4, 0.4]), "d": np.array([0.1, 0.1])}
AP = {"a": (0.8, 0.03), "b": (0.7, 0.04), "c": (0.3, 0.02), "d": (math.nan, math.nan)}


def test_losses_by_hand() -> None:
    """Mount b should find 80 %; its AP is 70 %. Mount d has no AP."""
    best, second, third = decision_costs.mount_losses(FOUND, AP)
    assert (best.mount, best.predicted_points, best.measured_points) == ("b", 0.0, 0.0)
    assert (second.mount, second.found) == ("a", pytest.approx(0.6))
    assert (second.predicted_points, second.measured_points) == (pytest.approx(20.0), pytest.approx(-10.0))
    assert second.predicted_se_points == pytest.approx(20.0)  # of 40 and 0
    assert (third.mount, third.predicted_points, third.measured_points) == ("c", pytest.approx(40), pytest.approx(40))


def test_slope_and_correlation_by_hand() -> None:
    """x = 0, 20, 40 and y = 0, -10, 40: slope (-200 + 1600) / 2000; deviations (-20, 0, 20) and (-10, -20, 30)."""
    slope, correlation = decision_costs.regression(decision_costs.mount_losses(FOUND, AP))
    assert slope == pytest.approx(0.7)
    assert correlation == pytest.approx(800 / math.sqrt(800 * 1400))


def test_row_of_a_detector_has_what_the_chosen_mount_loses() -> None:
    cells = decision_costs.detector_cells("mini", "cluster", 1000, decision_costs.mount_losses(FOUND, AP))
    assert cells == ("mini", "`cluster`", "1,000", "3", "0.70", "0.76", "b", "10.0 ± 5.0", "a", "20.0 ± 20.0")


def test_losses_of_other_scenarios_stay_in_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decision_costs, "DATA", tmp_path / "losses.csv")
    losses = decision_costs.mount_losses(FOUND, AP)
    for name in ("mini", "other", "mini"):
        decision_costs.write_losses(name, losses)
    rows = list(csv.DictReader((tmp_path / "losses.csv").read_text(encoding="utf-8").splitlines()))
    assert [(row["scenario"], row["mount"]) for row in rows] == [
        (name, mount) for name in ("other", "mini") for mount in "bac"
    ]
    assert rows[1]["ap_loss_points"] == "-10.0000"


def test_rows_with_the_same_key_are_replaced(tmp_path: Path) -> None:
    page, marks = tmp_path / "page.md", ("<!-- a -->", "<!-- b -->")
    page.write_text("\n".join(marks), encoding="utf-8")
    for rows in ([("x", "1", "5")], [("y", "1", "6"), ("x", "2", "7")], [("x", "1", "8")]):
        decision_costs.write_rows(page, marks, ("name", "key", "n"), rows, key_columns=2)
    assert page.read_text(encoding="utf-8").splitlines() == [
        marks[0], "| name | key | n |", "|---|---:|---:|", "| x | 1 | 8 |", "| y | 1 | 6 |", "| x | 2 | 7 |", marks[1],
    ]  # fmt: skip


@pytest.mark.parametrize(("marks", "headings"), TABLES)
def test_page_has_a_table_of_each_kind(marks: tuple[str, str], headings: tuple[str, ...]) -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert (text.count(marks[0]), text.count(marks[1])) == (1, 1)
    table = text.partition(marks[0])[2].partition(marks[1])[0].strip()
    assert table.startswith("| " + " | ".join(headings) + " |")
    assert len(page_tables.read_rows(table, len(headings))) == len(table.splitlines()) - 2 > 0


def test_region_keeps_its_shape_in_whole_metres(mini: Path) -> None:
    scenario = egvs.load(mini)
    x_m, y_m, _ = scenario.roi.size_m
    larger = egvs.load(mini, decision_costs.region_overrides(scenario, 4.0))
    assert larger.roi.size_m[:2] == (2 * x_m, 2 * y_m)
    assert decision_costs.region_overrides(scenario, 1.0) == decision_costs.region_overrides(scenario, 1.01)


@pytest.mark.slow
def test_study_of_a_recording_fills_both_rows(mini: Path, tmp_path: Path) -> None:
    few = SettingValues(voxels_m=(), gammas=(), thinning_factors=(), frame_periods_s=(), unnamed_effects=False)
    study = decision_costs.study_scenario(mini, (), tmp_path / "out", few)
    scenario = egvs.load(mini)
    row = decision_costs.scenario_cells(scenario, study)
    assert (len(row), row[0], row[1]) == (len(decision_costs.SCENARIO_HEADINGS), "mini", "2, 2")
    assert row[4:7] == decision_costs.price_cells(study.scenario)
    area = decision_costs.area_cells(scenario, study)
    assert len(area) == len(decision_costs.AREA_HEADINGS)
    assert float(area[3]) == pytest.approx(study.scenario.seconds, abs=0.051)
