"""Scores from parts of a run are those of runs with that traffic; they survive being saved."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.runs.run_context import open_folder
from egvs.scoring.target_scores import DETECTORS
from egvs.studies.traffic_scores import RunScores, Window, detector_score, score_run

WINDOWS = (Window(0, 4), Window(0, 2), Window(2, 2))


def scores_of(mini: Path, out: Path, *sets: str, sampled_frames: int = 0, by_detector: bool = False) -> RunScores:
    scenario = egvs.load(mini, sets)
    egvs.run(scenario, out)
    return score_run(open_folder(scenario, out), WINDOWS, sampled_frames or 40, by_detector=by_detector)


@pytest.mark.slow
def test_vehicle_scores_of_all_frames_are_those_of_a_run(mini: Path, tmp_path: Path) -> None:
    sets = ("score.rank_by=seen_well", "score.others=['expected_detections']")
    scores = scores_of(mini, tmp_path / "run", *sets)
    table = egvs.read_scores(tmp_path / "run" / "scores.parquet")
    assert scores.mounts == ("pole_a", "pole_b")
    for name in ("seen_well", "expected_detections"):
        assert scores.score(name, Window(0, 4)) == pytest.approx(table[name].to_numpy(), rel=1e-12)
    assert scores.ranking_score(Window(0, 4)).tolist() == scores.score("seen_well", Window(0, 4)).tolist()


@pytest.mark.slow
def test_parts_and_their_frames_are_weighted_by_vehicles(mini: Path, tmp_path: Path) -> None:
    scores = scores_of(mini, tmp_path / "run")
    halves = [scores.sum_over("expected_detections", window) for window in WINDOWS[1:]]
    total = sum(part for part, _ in halves) / sum(weight for _, weight in halves)
    assert scores.score("expected_detections", Window(0, 4)) == pytest.approx(total)
    few = scores.score("expected_detections", Window(0, 4), frames=4)
    rows = [5, 15, 25, 35]  # the middles of four equal parts
    by_hand = scores.sums["expected_detections"][rows].sum(axis=0) / scores.weight[rows].sum()
    assert few == pytest.approx(by_hand)


@pytest.mark.slow
def test_threefold_sampling_contains_the_frames_of_the_scenario(mini: Path, tmp_path: Path) -> None:
    sets = ("score.sampled_frames=4", "score.rank_by=expected_detections")
    scores = scores_of(mini, tmp_path / "run", *sets, sampled_frames=12)
    table = egvs.read_scores(tmp_path / "run" / "scores.parquet")
    assert scores.ranking_score(Window(0, 4), frames=4) == pytest.approx(table["expected_detections"].to_numpy())


@pytest.mark.slow
def test_voxel_score_of_a_window_is_that_of_a_run_with_this_traffic(mini: Path, tmp_path: Path) -> None:
    scores = scores_of(mini, tmp_path / "run")
    for window, frames in ((Window(0, 4), 40), (Window(0, 2), 20)):
        out = tmp_path / f"run{frames}"
        egvs.run(egvs.load(mini, [f"traffic.frames={frames}"]), out)
        table = egvs.read_scores(out / "scores.parquet")
        shares = table["egvs"].to_numpy() / table["egvs_limit"].to_numpy()
        assert scores.ranking_score(window) == pytest.approx(shares, rel=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["entropy_seen", "coverage", "expected_visibility"])
def test_shares_of_voxels_are_those_of_a_run(mini: Path, tmp_path: Path, name: str) -> None:
    scores = scores_of(mini, tmp_path / "run", f"score.rank_by={name}")
    table = egvs.read_scores(tmp_path / "run" / "scores.parquet")
    assert scores.ranking_score(Window(0, 4)) == pytest.approx(table[name].to_numpy(), rel=1e-12)


@pytest.mark.slow
def test_expected_detections_are_the_mean_over_detectors(mini: Path, tmp_path: Path) -> None:
    scores = scores_of(mini, tmp_path / "run", by_detector=True)
    alone = [scores.score(detector_score(detector), Window(0, 4)) for detector in DETECTORS]
    assert scores.score("expected_detections", Window(0, 4)) == pytest.approx(np.mean(alone, axis=0))


@pytest.mark.slow
def test_saved_scores_are_the_same(mini: Path, tmp_path: Path) -> None:
    scores = scores_of(mini, tmp_path / "run")
    again = RunScores.from_json(scores.to_json())
    assert (again.mounts, again.poles, again.windows, again.rank_by) == (
        scores.mounts,
        scores.poles,
        scores.windows,
        scores.rank_by,
    )
    assert again.voxel_scores.tolist() == scores.voxel_scores.tolist()
    assert (
        again.score("expected_detections", WINDOWS[2]).tolist()
        == scores.score("expected_detections", WINDOWS[2]).tolist()
    )
