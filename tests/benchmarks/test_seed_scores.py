"""Scores of several seeds: their errors are those of runs, and what all seeds together say is taken for the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks import intervals, steps

import egvs
from egvs.core.progress import no_progress
from egvs.studies.measurement import SettingRunner


@pytest.mark.slow
def test_recorded_traffic_does_not_scatter(mini: Path, tmp_path: Path) -> None:
    """Its traffic is the same with each seed, so the truth is the score of one run."""
    egvs.run(egvs.load(mini), tmp_path / "run")
    scores = egvs.read_scores(tmp_path / "run" / "scores.parquet").to_pandas()
    reports: list[str] = []
    runner = SettingRunner(mini, (), tmp_path / "out", 1, no_progress)
    runs = intervals.run_seeds(runner, 1, 3, reports.append)
    comparison = intervals.compare_seeds(runner, runs)

    assert reports == ["seed 1: done", "seed 2: done", "seed 3: done"]
    assert runs[0].sites == tuple(scores["site"])
    np.testing.assert_allclose(runs[0].estimate.se, scores["egvs_se"], rtol=1e-9)
    np.testing.assert_allclose(runs[0].estimate.bias, scores["egvs_bias"], rtol=1e-9)
    np.testing.assert_allclose(comparison.truth, scores["egvs"], rtol=1e-9)
    np.testing.assert_allclose(comparison.within, scores["egvs_se"], rtol=1e-9)
    assert comparison.between == pytest.approx(0.0) and comparison.bias == pytest.approx(0.0, abs=1e-6)


def test_scatter_of_two_seeds_by_hand(mini: Path, tmp_path: Path) -> None:
    """Other scores of the second run: their standard deviation is the difference divided by the root of 2."""
    runner = SettingRunner(mini, (), tmp_path / "out", 1, no_progress)
    (run,) = intervals.run_seeds(runner, 1, 1, lambda _: None)
    other = intervals.SeedScores(run.setting, run.sites, run.scores + 8.0, run.estimate, run.tpog)
    comparison = intervals.compare_seeds(runner, [run, other])
    np.testing.assert_allclose(comparison.between, 8.0 / np.sqrt(2.0))
    np.testing.assert_allclose(comparison.bias, 4.0, rtol=1e-6)
    far = intervals.SeedScores(run.setting, run.sites, run.scores + 1e9, run.estimate, run.tpog)
    assert intervals.compare_seeds(runner, [far, far]).covered == 0.0


def test_failing_seeds_are_reported_and_left_out(mini: Path, tmp_path: Path) -> None:
    reports: list[str] = []
    runner = SettingRunner(mini, ("tpog.blocks=1",), tmp_path / "out", 1, no_progress)
    assert intervals.run_seeds(runner, 1, 1, reports.append) == []
    assert reports == ["seed 1: left out: tpog.blocks: standard errors need at least 2 blocks, got 1"]


@pytest.mark.slow
@pytest.mark.system
def test_step_trial_has_the_shares_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = ("traffic.frames=20", "traffic.warmup_s=60", 'traffic.hold="at_most"', "tpog.blocks=4")
    traffic = (*few, 'score.rank_by="egvs"')
    egvs.run(egvs.load(steps.SCENARIO, [*traffic, "seed=7", "traffic.step_s=0.25"]), tmp_path / "run")
    scores = egvs.read_scores(tmp_path / "run" / "scores.parquet").to_pandas()
    monkeypatch.setattr(steps, "TRAFFIC", traffic)
    monkeypatch.setenv("EGVS_STORE", "")  # the trial sets it, and it is restored after the test
    sites, shares, traffic_s = steps.trial(0.25, 7)
    assert sites == scores["site"].tolist()
    assert shares == pytest.approx((scores["egvs"] / scores["egvs_limit"]).tolist())
    assert traffic_s > 0.0
