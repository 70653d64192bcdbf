"""Standard errors of plans, compared with scores.parquet and with slow sums over blocks of frames."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.readers import read_scores
from egvs.artefacts.tpog import read_periods
from egvs.results.plans import ERROR_COLUMNS, plan_steps
from egvs.statistics.blocks import standard_error_inflation

FOUR_SITES = """site,x_m,y_m,z_m
a,10,12,3
b,30.5,-12,3
c,2,-12,4
d,38,12,4
"""
FAR_APART = """site,x_m,y_m,z_m
left,4,8,3
right,36,-8,3
"""
SCORES = ("expected_detections", "points_on_target", "seen_well", "entropy_seen", "coverage", "expected_visibility")


@pytest.mark.slow
@pytest.mark.parametrize("score", ["egvs", *SCORES])
def test_plan_of_one_sensor_has_standard_error_of_its_site(mini: Path, tmp_path: Path, score: str) -> None:
    (mini / "sites.csv").write_text(FOUR_SITES)
    scenario = egvs.load(mini, [f"score.rank_by='{score}'", "placement.count=2", "tpog.blocks=10"])
    egvs.run(scenario, tmp_path / "out")
    rows = read_scores(tmp_path / "out" / "scores.parquet").to_pylist()
    site_se = {row["site"]: row[f"{score}_se"] for row in rows}
    assert len(set(site_se.values())) > 1

    placed = egvs.place(scenario, tmp_path / "out")
    expected = site_se[placed.curve_sites[0][0]]
    if score == "expected_detections":  # chances are rounded to 2**-44 to add up exactly
        expected = pytest.approx(expected, rel=1e-9)
    assert placed.steps[0].score_se == placed.steps[0].gain_se == expected


def egvs_without_blocks(folder: Path, hits: dict[tuple[int, int, int], float], gamma: float) -> list[float]:
    """Return the EGVS without each block of frames, voxel by voxel."""
    (period,) = read_periods(folder / "tpog.parquet")
    counts = parquet.read_artefact(folder / "tpog.parquet", "tpog")[0].to_pylist()
    scores = []
    for left_out in range(period.blocks):
        remaining: dict[tuple[int, int, int], int] = {}
        for row in counts:
            voxel = (row["ix"], row["iy"], row["iz"])
            if row["block"] != left_out and voxel in hits:
                remaining[voxel] = remaining.get(voxel, 0) + row["count"]
        score = 0.0
        for voxel, count in remaining.items():
            p = count / (period.frames - period.block_frames)
            if 0.0 < p < 1.0:
                score -= min(gamma, hits[voxel]) * (p * math.log2(p) + (1 - p) * math.log2(1 - p))
        scores.append(score)
    return scores


@pytest.mark.slow
def test_disjoint_sensors_add_their_scores_without_each_block(mini: Path, tmp_path: Path) -> None:
    """The jackknife by hand: of k equal blocks, the variance is (k - 1) / k times the sum of squared deviations."""
    (mini / "sites.csv").write_text(FAR_APART)
    sets = ["sensors.small.range_m=14", "score.keep_visibility='all'", "placement.count=2", "score.rank_by='egvs'"]
    scenario, out = egvs.load(mini, sets), tmp_path / "out"
    egvs.run(scenario, out)
    table, _ = parquet.read_artefact(out / "visibility.parquet", "visibility")
    hits: dict[str, dict[tuple[int, int, int], float]] = {"left": {}, "right": {}}
    for row in table.to_pylist():
        hits[row["site"]][row["ix"], row["iy"], row["iz"]] = row["hits"]
    assert not set(hits["left"]) & set(hits["right"])

    left = egvs_without_blocks(out, hits["left"], scenario.gamma)
    right = egvs_without_blocks(out, hits["right"], scenario.gamma)
    (period,) = read_periods(out / "tpog.parquet")
    k = period.blocks
    widening = standard_error_inflation(period.memory_frames, period.frames, k)

    def standard_error(without: list[float]) -> float:
        mean = sum(without) / k
        return widening * math.sqrt((k - 1) / k * sum((score - mean) ** 2 for score in without))

    placed = egvs.place(scenario, out)
    together = [a + b for a, b in zip(left, right, strict=True)]
    first, second = (left, right) if placed.curve_sites[0] == ("left",) else (right, left)
    assert min(standard_error(first), standard_error(second)) > 0.0
    assert [step.score_se for step in placed.steps] == pytest.approx([standard_error(first), standard_error(together)])
    assert placed.steps[1].gain_se == pytest.approx(standard_error(second))
    assert placed.joint_se == placed.steps[1].score_se
    assert [sensor.gain_se for sensor in placed.sensors] == pytest.approx(
        [standard_error(first), standard_error(second)]
    )


def test_tables_have_errors_of_each_number_of_sensors(mini: Path, tmp_path: Path) -> None:
    (mini / "sites.csv").write_text(FOUR_SITES)
    placed = egvs.place(egvs.load(mini, ["placement.count=3"]), tmp_path / "out")
    curve, metadata = parquet.read_artefact(tmp_path / "out" / "curve.parquet", "curve")
    assert metadata["plan"]["standard_errors"] == placed.errors_from
    assert placed.errors_from.startswith("4 blocks of 10 frames")
    rows = curve.to_pylist()
    assert plan_steps(rows) == placed.steps
    for before, row, step in zip([None, *rows[:-1]], rows, placed.steps, strict=True):
        assert step.gain == row["score"] - (0.0 if before is None else before["score"])
        assert row["score_se"] > 0.0
        assert 0.5 < row["beats_previous"] <= 1.0
    plan, _ = parquet.read_artefact(tmp_path / "out" / "placement.parquet", "placement")
    assert plan.column("score_se").to_pylist() == [sensor.score_se for sensor in placed.sensors]
    for smaller, larger in pairwise(placed.sensors):
        assert larger.gain_se < math.hypot(smaller.score_se, larger.score_se)  # paired: common scatter cancels


WITHOUT_ERRORS = {
    "score.standard_error=false": "score.standard_error is false",
    "tpog.blocks=1": "the traffic has a single block of frames (tpog.blocks)",
}


@pytest.mark.parametrize("override", WITHOUT_ERRORS)
def test_reason_is_named_where_errors_are_unknown(mini: Path, tmp_path: Path, override: str) -> None:
    placed = egvs.place(egvs.load(mini, ["placement.count=2", override]), tmp_path / "out")
    assert placed.errors_from == WITHOUT_ERRORS[override]
    assert not placed.has_errors
    assert np.isnan([placed.joint_se, *(step.score_se for step in placed.steps)]).all()
    curve, _ = parquet.read_artefact(tmp_path / "out" / "curve.parquet", "curve")
    assert not set(ERROR_COLUMNS) & set(curve.column_names)


@pytest.mark.slow
def test_report_names_reason_where_errors_are_unknown(mini: Path, tmp_path: Path) -> None:
    scenario = egvs.load(mini, ["placement.count=2", "score.standard_error=false"])
    egvs.run(scenario, tmp_path / "out")
    egvs.place(scenario, tmp_path / "out")
    page = (tmp_path / "out" / "report.html").read_text()
    plan = page[page.index('<section id="plan">') :]
    plan = plan[: plan.index("</section>")]
    assert "No standard errors: score.standard_error is false." in plan
    assert "nan" not in plan


def test_no_errors_where_all_vehicles_are_in_one_block(mini: Path, tmp_path: Path) -> None:
    lines = (mini / "fcd.csv").read_text().splitlines()
    for number in range(13, len(lines)):  # from the 7th frame on, both are far away
        time, vehicle, x_m, *others = lines[number].split(";")
        lines[number] = ";".join([time, vehicle, str(float(x_m) + 500.0), *others])
    (mini / "fcd.csv").write_text("\n".join(lines) + "\n")
    sets = ["placement.count=1", "score.rank_by='expected_detections'"]
    placed = egvs.place(egvs.load(mini, sets), tmp_path / "out")
    assert placed.errors_from == "without one of the blocks of frames there are no vehicles"
    assert math.isnan(placed.joint_se)
