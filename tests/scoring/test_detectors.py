"""A score over several detectors: their disagreement is part of its standard error, and cancels where it is common.

Evidence: two and three detectors by hand; a shift of one detector at all sites; a slow twin of a complete run, from the
definition, detector by detector and block by block.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import egvs
from egvs.artefacts.readers import read_scores
from egvs.artefacts.tpog import read_periods
from egvs.artefacts.traffic_frames import spaced_frames
from egvs.core.errors import InputError
from egvs.scenario.score_config import ScoreConfig
from egvs.scoring.standard_errors import (
    BlockGroups,
    ScoreUncertainty,
    beats_next,
    detector_groups,
    lag_behind_best,
    summarise_uncertainty,
)
from egvs.scoring.target_scores import DETECTORS, correction_features, detectability_model
from egvs.scoring.targets import TargetRecord, visible_targets
from egvs.scoring.visibility import Beams
from egvs.statistics.blocks import means_without_each, standard_error_inflation

STEADY = (BlockGroups(np.full(4, 10), 0.0),)
"""Four blocks of traffic."""


def estimate(by_detector: list[list[float]], by_block: list[list[float]] | None = None) -> ScoreUncertainty:
    """From the scores of sites by each detector, and deviations of the blocks from the mean, (4, n)."""
    values = np.array(by_detector)
    mean = values.mean(axis=0)
    deviations = np.zeros((4, len(mean))) if by_block is None else np.array(by_block)
    without_block = mean + (deviations.sum(axis=0) - deviations) / 3.0
    rows = [mean[None], without_block]
    if len(values) > 1:
        rows.append(np.array([means_without_each(column) for column in values.T]).T)
    return ScoreUncertainty.of(np.vstack(rows).T, STEADY + detector_groups(len(values)))


def test_two_detectors_by_hand() -> None:
    """By cluster 70, 60 and 50 %; by PointPillars 90, 80 and 66 %.

    Means 80, 70 and 58 %; errors are half the differences of the detectors, 10, 10 and 8 points. The first site leads
    the second by 10 points for both detectors, so the error of its lead is 0. It leads the third by 20 and 24 points:
    22, and the error is 2. Student's t with one degree of freedom has the distribution 1/2 + arctan(t) / pi.
    """
    sites = estimate([[0.7, 0.6, 0.5], [0.9, 0.8, 0.66]])
    assert sites.scores == pytest.approx([0.8, 0.7, 0.58])
    assert sites.se == pytest.approx([0.1, 0.1, 0.08])
    lag = lag_behind_best(sites)
    assert lag.se == pytest.approx([0.0, 0.0, 0.02], abs=1e-12)
    assert lag.best_beats[2] == pytest.approx(0.5 + math.atan(11.0) / math.pi, abs=1e-6)
    assert beats_next(sites)[0] == 1.0
    assert beats_next(sites)[1] == pytest.approx(0.5 + math.atan(0.12 / 0.02) / math.pi, abs=1e-6)
    low, high = sites.intervals()[2]
    assert [low, high] == pytest.approx([0.58 - 6.313752 * 0.08, 0.58 + 6.313752 * 0.08], abs=1e-6)
    assert sites.bias == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)


def test_detectors_that_disagree_about_the_order_make_a_tie() -> None:
    """By one, a leads by 6 points; by the other, it is 2 behind: it leads by 2, with an error of 4."""
    sites = estimate([[0.66, 0.6], [0.78, 0.8]])
    assert sites.differences(np.array([0]), np.array([1])).se == pytest.approx([0.04])
    assert beats_next(sites)[0] == pytest.approx(0.5 + math.atan(0.5) / math.pi, abs=1e-6)


def test_three_detectors_by_hand() -> None:
    """50, 70 and 90 %: variance 0.04, and the mean of three has an error of 0.2 / sqrt(3)."""
    sites = estimate([[0.5], [0.7], [0.9]])
    assert sites.scores == pytest.approx([0.7])
    assert sites.se == pytest.approx([0.2 / math.sqrt(3.0)])


def test_variances_of_traffic_and_detectors_add_up_with_satterthwaite_s_freedom() -> None:
    """Blocks that deviate by -3, -1, 1 and 3 points: variance 20 / 3, error of the mean sqrt(5 / 3) points.

    Detectors 4 points apart: error 2. Together sqrt(5 / 3 + 4), with (17 / 3)^2 / ((5 / 3)^2 / 3 + 4^2 / 1) degrees.
    """
    deviations = [[-0.03], [-0.01], [0.01], [0.03]]
    traffic = estimate([[0.6]], deviations)
    assert traffic.se == pytest.approx([0.01 * math.sqrt(5.0 / 3.0)])
    assert traffic.freedom == 3.0
    both = estimate([[0.58], [0.62]], deviations)
    assert both.se == pytest.approx([0.01 * math.sqrt(17.0 / 3.0)])
    freedom = (17.0 / 3.0) ** 2 / ((5.0 / 3.0) ** 2 / 3.0 + 16.0)
    assert both.quantiles()[0] == pytest.approx(student_quantile(freedom, 0.95), rel=1e-6)
    assert summarise_uncertainty(both) == {
        "standard_errors_from": "4 blocks of 10 frames, and the differences between 2 detectors"
    }
    assert summarise_uncertainty(traffic) == {"standard_errors_from": "4 blocks of 10 frames"}


def student_quantile(freedom: float, level: float) -> float:
    """From the density of Student's t, by trapezoids and bisection."""

    def distribution(t: float) -> float:
        x = np.linspace(0.0, t, 20_001)
        scale = math.gamma((freedom + 1) / 2) / math.gamma(freedom / 2) / math.sqrt(freedom * math.pi)
        density = scale * (1.0 + x**2 / freedom) ** (-(freedom + 1) / 2)
        return 0.5 + float(np.trapezoid(density, x))

    low, high = 0.0, 100.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if distribution(middle) < level else (low, middle)
    return low


def test_a_shift_of_one_detector_at_all_sites_changes_no_comparison() -> None:
    rng = np.random.default_rng(11)
    values, deviations = rng.uniform(0.3, 0.6, (2, 5)), rng.normal(0.0, 0.02, (4, 5))
    deviations -= deviations.mean(axis=0)
    shifted = values + np.array([[0.0], [0.2]])
    before, after = (estimate(detectors.tolist(), deviations.tolist()) for detectors in (values, shifted))
    a, b = np.array([0, 1, 2, 3]), np.array([4, 3, 1, 2])
    assert after.differences(a, b).se == pytest.approx(before.differences(a, b).se)
    assert after.beats(a, b) == pytest.approx(before.beats(a, b))
    assert (after.se > before.se).any()


def test_a_single_detector_has_no_groups() -> None:
    assert detector_groups(1) == detector_groups(0) == ()
    assert [group.frames.tolist() for group in detector_groups(3)] == [[1, 1, 1]]


RANKED = "score.rank_by='expected_detections'"


def run(folder: Path, out: Path, *overrides: str) -> dict[str, dict[str, Any]]:
    egvs.run(egvs.load(folder, [RANKED, *overrides]), out)
    return {row["site"]: row for row in read_scores(out / "scores.parquet").to_pylist()}


class Twin:
    """Scores of a site from the definition: one vehicle-frame at a time."""

    def __init__(self, folder: Path, out: Path) -> None:
        scenario = egvs.load(folder, [RANKED])
        (self.period,) = read_periods(out / "tpog.parquet")
        self.record = TargetRecord.read(out / "trajectories.parquet", scenario.roi.grid)
        self.scanner = egvs.Scanner(egvs.build_scene(scenario))
        self.block = [int(self.record.numbers[frame]) // self.period.block_frames for frame in self.record.frame]
        assert len(self.record.numbers) == len(spaced_frames(self.period.frames, 0))

    def values(self, site: str) -> list[list[float]]:
        """The probability of each vehicle-frame, by detector."""
        scan = self.scanner.scan_site(self.scanner.scene.site(site))
        visible = visible_targets(self.record, Beams.of(scan))
        found = []
        for name in DETECTORS:
            chances = detectability_model(name).chances(correction_features(visible)).tolist()
            found.append([p if points > 0 else 0.0 for p, points in zip(chances, visible.points, strict=True)])
        return found

    def variances(self, values: list[list[float]]) -> tuple[float, float]:
        """Squared errors of the mean of all detectors: of the traffic, and of the detectors."""
        k, d = self.period.blocks, len(values)
        mean = [sum(of_vehicle) / d for of_vehicle in zip(*values, strict=True)]
        left_out = []
        for block in range(k):
            rest = [value for value, own in zip(mean, self.block, strict=True) if own != block]
            left_out.append(sum(rest) / len(rest))
        score = sum(mean) / len(mean)
        pseudo = [k * score - (k - 1) * value for value in left_out]
        centre = sum(pseudo) / k
        widening = standard_error_inflation(self.period.memory_frames, self.period.frames, k)
        traffic = widening**2 * sum((value - centre) ** 2 for value in pseudo) / k / (k - 1)
        by_detector = [sum(detector) / len(detector) for detector in values]
        return traffic, sum((value - score) ** 2 for value in by_detector) / d / (d - 1)


def test_errors_of_a_run_match_a_slow_twin(mini: Path, tmp_path: Path) -> None:
    rows = run(mini, tmp_path / "all")
    twin = Twin(mini, tmp_path / "all")
    values = {site: twin.values(site) for site in rows}
    best = next(site for site, row in rows.items() if row["rank"] == 1)
    for site, row in rows.items():
        scores = [sum(detector) / len(detector) for detector in values[site]]
        assert row["expected_detections"] == pytest.approx(sum(scores) / 2)
        traffic, detectors = twin.variances(values[site])
        assert detectors == pytest.approx((scores[0] - scores[1]) ** 2 / 4)
        assert detectors > 0.0
        assert row["expected_detections_se"] == pytest.approx(math.sqrt(traffic + detectors), rel=1e-9)
        if site == best:
            continue
        lead = [[b - s for b, s in zip(*pair, strict=True)] for pair in zip(values[best], values[site], strict=True)]
        traffic, detectors = twin.variances(lead)
        assert row["behind_best_se"] == pytest.approx(math.sqrt(traffic + detectors), rel=1e-9)
        assert row["behind_best_detectors_se"] == pytest.approx(math.sqrt(detectors), rel=1e-9)


@pytest.mark.slow
def test_a_detector_alone_has_its_own_score_and_the_error_of_the_traffic(mini: Path, tmp_path: Path) -> None:
    both = run(mini, tmp_path / "all")
    alone = {name: run(mini, tmp_path / name, f"score.detector='{name}'") for name in DETECTORS}
    twin = Twin(mini, tmp_path / "all")
    for site, row in both.items():
        values = dict(zip(DETECTORS, twin.values(site), strict=True))
        for name, rows in alone.items():
            assert rows[site]["expected_detections"] == pytest.approx(sum(values[name]) / len(values[name]))
            traffic, _ = twin.variances([values[name], values[name]])
            assert rows[site]["expected_detections_se"] == pytest.approx(math.sqrt(traffic), rel=1e-9)
        cluster, pointpillars = (alone[name][site]["expected_detections"] for name in DETECTORS)
        assert row["expected_detections"] == pytest.approx((cluster + pointpillars) / 2)
        assert "behind_best_detectors_se" not in alone["cluster"][site]
        assert row["egvs"] == alone["cluster"][site]["egvs"]
        assert row["egvs_se"] == alone["cluster"][site]["egvs_se"]


def test_all_is_the_default_and_recorded_only_where_set() -> None:
    assert ScoreConfig().detectors == ScoreConfig(detector="all").detectors == DETECTORS
    assert ScoreConfig(detector="pointpillars").detectors == ("pointpillars",)
    assert ScoreConfig(detector="pointpillars_sensor").detectors == ("pointpillars_sensor",)
    assert "detector" not in ScoreConfig().model_dump(mode="json")
    assert ScoreConfig(detector="cluster").model_dump(mode="json")["detector"] == "cluster"


def test_ranking_detectors_are_those_of_the_score_that_ranks() -> None:
    assert ScoreConfig().ranking_detectors == ()  # by egvs
    assert ScoreConfig(rank_by="expected_detections").ranking_detectors == DETECTORS


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["score.detector='yolo'"],
            "score.detector: expected 'cluster', 'pointpillars', 'pointpillars_sensor', 'cluster_uncorrected', "
            "'pointpillars_uncorrected', 'all_uncorrected' or 'all'",
        ),
        (
            ["score.detector='cluster'", "score.others=['coverage']", "score.blindspots=false"],
            "score: detector has no effect without expected_detections, blind spots and zones",
        ),
    ],
)
def test_rejects_unknown_detectors_and_those_without_effect(mini: Path, overrides: list[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        egvs.load(mini, overrides)


@pytest.mark.slow
def test_option_sets_the_key(mini: Path, tmp_path: Path, run_egvs: Any) -> None:
    sets = ("--set", RANKED)
    code, printed, told = run_egvs(
        "run", mini, "--out", tmp_path / "option", "--detector", "cluster", *sets, "--verbose"
    )
    assert code == 0, told
    assert "; the score is that of the detector cluster." in " ".join(printed.split())
    by_key = run(mini, tmp_path / "key", "score.detector='cluster'")
    by_option = {row["site"]: row for row in read_scores(tmp_path / "option" / "scores.parquet").to_pylist()}
    assert by_option == by_key
    code, printed, told = run_egvs("run", mini, "--out", tmp_path / "all", *sets, "--verbose")
    assert code == 0, told
    expected = (
        "± contains the error of a finite simulation, and how far the detectors (cluster, pointpillars) disagree."
    )
    assert expected in " ".join(printed.split())
    assert expected in " ".join((tmp_path / "all" / "report.html").read_text(encoding="utf-8").split())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("--detector", "yolo"),
            "--detector: expected cluster, pointpillars, pointpillars_sensor, cluster_uncorrected, "
            "pointpillars_uncorrected, all_uncorrected or all, got 'yolo'. Use --detector cluster.",
        ),
        (
            ("--detector", "all", "--set", "score.detector=cluster"),
            "--detector: cannot be used with --set score.detector. Remove one of the two options.",
        ),
    ],
)
@pytest.mark.parametrize("verb", ["run", "score", "place", "what-if"])
def test_option_with_a_wrong_value_is_one_message(
    mini: Path, run_egvs: Any, verb: str, words: tuple[str, ...], message: str
) -> None:
    code, _, told = run_egvs(verb, mini, *words)
    assert code == 2
    assert " ".join(told.split()).endswith(message)
    assert not (mini / "runs").exists()
