"""Correlations over sites: intervals and their coverage, undefined values, two scores, several junctions."""

import math

import numpy as np
import pytest
import scipy.stats
from scipy.special import ndtr, ndtri

from egvs.extensions.validation.correlation import (
    ConfidenceInterval,
    CorrelationStudy,
    JunctionScores,
    MeasureValues,
    Resamples,
    share_above_zero,
)
from egvs.extensions.validation.detection_metrics import EvaluationFrames, evaluate, frame_blocks
from egvs.statistics.ranks import COEFFICIENT_KINDS
from tests.extensions.validation import simulated_studies
from tests.extensions.validation.test_detection_metrics import random_scenes


def study(junctions, resamples=300, seed=1):
    return CorrelationStudy([junctions] if isinstance(junctions, JunctionScores) else junctions, seed, resamples)


def with_scores(junction, **scores):
    scores = {name: np.asarray(values, float) for name, values in scores.items()}
    return JunctionScores(junction.name, junction.sites, {**junction.scores, **scores}, junction.measures)


@pytest.fixture
def thirteen():
    return simulated_studies.junction(np.random.default_rng(0), 13, (0.8, 0.3))


# ---- intervals


def test_interval_without_bias_has_quantiles():
    draws = np.linspace(-1, 1, 2001)
    interval = ConfidenceInterval.from_resamples(0.0, draws)
    np.testing.assert_allclose([interval.low, interval.high], [-0.95, 0.95], atol=1e-9)


def test_corrects_bias_on_normal_scale():
    """A tenth of the resamples are below the value: z0 = -1.2816, so the ends are at Phi(2 z0 -+ 1.96)."""
    draws = np.linspace(0, 1, 10_001)
    interval, z0 = ConfidenceInterval.from_resamples(0.1, draws), ndtri(0.1)
    np.testing.assert_allclose([interval.low, interval.high], ndtr(2 * z0 + np.array([-1.96, 1.96])), atol=5e-4)


def test_ties_count_half():
    assert ConfidenceInterval.from_resamples(0.5, np.array([0.0] * 50 + [0.5] * 50 + [1.0] * 50)) == ConfidenceInterval(
        0.0, 1.0
    )


def test_undefined_intervals_have_reason():
    assert "all resamples have the same value" in ConfidenceInterval.from_resamples(1.0, np.ones(100)).why
    draws = np.concatenate([np.full(10, math.nan), np.linspace(0, 1, 90)])
    assert ConfidenceInterval.from_resamples(0.5, draws).why == "10 % of the resamples have equal values only"
    assert math.isnan(ConfidenceInterval.from_resamples(0.5, draws).low)
    assert math.isfinite(ConfidenceInterval.from_resamples(0.5, draws[8:]).low)


def test_share_above_zero():
    assert share_above_zero(np.array([1.0, -1.0, 0.0, 2.0, math.nan])) == pytest.approx(2.5 / 4)
    assert math.isnan(share_above_zero(np.array([math.nan])))


@pytest.mark.slow
@pytest.mark.parametrize("kind", COEFFICIENT_KINDS)
def test_intervals_have_nominal_coverage(kind):
    """Of 100 studies 95 % should; fewer than 87 would happen by chance once in 1000. ``benchmarks.coverage`` has the
    numbers."""
    rng, held = np.random.default_rng(3), 0
    for _ in range(100):
        interval = study(simulated_studies.junction(rng, 40, (0.7,))).correlation("s0", "ap", kind).interval
        held += interval.low <= simulated_studies.truth(0.7, kind) <= interval.high
    assert held >= 87


# ---- resampling


@pytest.mark.slow
def test_drawn_blocks_approximate_recomputed_average_precision():
    """A draw of blocks is a sum of frames: AP of these frames against its linear form from the left-out values."""
    truth, detections = random_scenes(21, 60)
    measures = evaluate(EvaluationFrames.from_frames(truth, detections)).measures
    block, rng = frame_blocks(60), np.random.default_rng(5)
    weights = rng.multinomial(10, np.full(10, 0.1), 30)
    for name, least in (("ap_bev_r40_iou50", 0.85), ("recall_3d_iou50_cars", 0.98)):
        measured = MeasureValues.from_estimates([measures[name]])
        linear = Resamples(np.zeros((30, 1), np.int64), weights).resample_measure(measured, np.array([True]))[:, 0]
        recomputed = []
        for drawn in weights:
            rows = [k for k in range(60) for _ in range(drawn[block[k]])]
            again = evaluate(
                EvaluationFrames.from_frames([truth[k] for k in rows], [detections[k] for k in rows])
            ).measures
            recomputed.append(again[name].value)
        assert np.corrcoef(linear, recomputed)[0, 1] > least
        assert np.std(linear) == pytest.approx(np.std(recomputed), rel=0.25)
        assert np.mean(linear) == pytest.approx(np.mean(recomputed), abs=0.01)


def test_drawn_blocks_scatter_by_standard_error():
    made = simulated_studies.junction(np.random.default_rng(6), 3, (0.5,)).measures["ap"]
    draws = Resamples.draw("a", 3, 10, 20_000, 0)
    fixed = Resamples(np.tile(np.arange(3), (20_000, 1)), draws.blocks).resample_measure(made, made.defined)
    se = np.sqrt(9 / 10 * ((made.left_out - made.left_out.mean(axis=1, keepdims=True)) ** 2).sum(axis=1))
    np.testing.assert_allclose(fixed.std(axis=0), se, rtol=0.02)
    np.testing.assert_allclose(fixed.mean(axis=0), made.values, atol=0.005)


def test_resample_keeps_score_and_measure_of_site_together(thirteen):
    """A site's score and measure stay together, and a site that is drawn twice has the same of both."""
    draws = Resamples.draw("a", 13, 10, 50, 0)
    score, measure = (
        draws.resample_score(thirteen.scores["s0"]),
        draws.resample_measure(thirteen.measures["ap"], np.ones(13, bool)),
    )
    for row in range(50):
        assert len(np.unique(score[row])) == len(np.unique(measure[row])) == len(np.unique(draws.sites[row]))
    assert (draws.blocks.sum(axis=1) == 10).all()


# ---- one junction


def test_values_equal_scipy_and_are_reproducible(thirteen):
    a, b = thirteen.scores["s0"], thirteen.measures["ap"].values
    expected = scipy.stats.pearsonr(a, b), scipy.stats.spearmanr(a, b), scipy.stats.kendalltau(a, b)
    correlations = [study(thirteen).correlation("s0", "ap", kind) for kind in COEFFICIENT_KINDS]
    np.testing.assert_allclose([entry.value for entry in correlations], [entry.statistic for entry in expected])
    assert correlations == [study(thirteen).correlation("s0", "ap", kind) for kind in COEFFICIENT_KINDS]
    assert correlations != [study(thirteen, seed=2).correlation("s0", "ap", kind) for kind in COEFFICIENT_KINDS]
    assert all(entry.sites == 13 and entry.interval.low < entry.value < entry.interval.high for entry in correlations)


def test_result_does_not_depend_on_earlier_calls(thirteen):
    alone = study(thirteen).correlation("s1", "ap", "kendall")
    used_study = study(thirteen)
    used_study.correlation("s0", "ap", "kendall")
    used_study.difference("s0", "s1", "ap", "spearman")
    assert used_study.correlation("s1", "ap", "kendall") == alone


def test_constant_score_has_no_correlation_but_warning(thirteen):
    correlation = study(with_scores(thirteen, flat=np.full(13, 0.1))).correlation("flat", "ap", "spearman")
    assert math.isnan(correlation.value) and math.isnan(correlation.interval.low)
    (warning,) = correlation.warnings("flat, ap")
    assert str(warning) == (
        "flat, ap: no correlation: flat is the same at all sites of made up. Use more sites, or sites that differ more."
    )


@pytest.mark.parametrize(
    ("sites", "defined", "why"),
    [
        (2, False, "made up has 2 sites with values, and a correlation needs 3"),
        (4, True, "made up has sites on 4 poles, and an interval needs 5"),
        (5, True, ""),
    ],
)
def test_too_few_sites(sites, defined, why):
    correlation = study(simulated_studies.junction(np.random.default_rng(0), sites, (0.5,))).correlation(
        "s0", "ap", "pearson"
    )
    assert correlation.why == why
    assert math.isfinite(correlation.value) == defined and math.isfinite(correlation.interval.high) == (not why)


def test_perfect_ranking_without_differing_resamples_has_no_interval():
    made = simulated_studies.junction(np.random.default_rng(0), 8, (1.0,))
    sure = MeasureValues(made.scores["s0"], np.tile(made.scores["s0"][:, None], (1, 10)))  # no block changes anything
    correlation = study(JunctionScores("j", made.sites, made.scores, {"ap": sure})).correlation("s0", "ap", "spearman")
    assert (
        correlation.value == 1
        and math.isnan(correlation.interval.low)
        and "all resamples have the same value" in correlation.why
    )


def test_drops_and_names_sites_without_value(thirteen):
    values = thirteen.scores["s0"].copy()
    values[4] = math.nan
    measured = thirteen.measures["ap"]
    left_out = measured.left_out.copy()
    left_out[7, 3] = math.nan
    partly = JunctionScores("j", thirteen.sites, {"s0": values}, {"ap": MeasureValues(measured.values, left_out)})
    correlation = study(partly).correlation("s0", "ap", "spearman")
    rest = [k for k in range(13) if k not in (4, 7)]
    assert correlation.value == pytest.approx(scipy.stats.spearmanr(values[rest], measured.values[rest]).statistic)
    assert correlation.sites == 11 and correlation.dropped == ("j c04", "j c07")
    assert "without j c04, j c07, where a value is undefined" in str(correlation.warnings("s0")[0])


# ---- two scores


def test_compares_two_scores_on_same_resamples(thirteen):
    correlation = study(thirteen, 1000).difference("s0", "s1", "ap", "spearman")
    each = [study(thirteen, 1000).correlation(name, "ap", "spearman") for name in ("s0", "s1")]
    assert correlation.value == pytest.approx(each[0].value - each[1].value)
    assert correlation.interval.low < correlation.value < correlation.interval.high and 0.5 < correlation.better <= 1
    back = study(thirteen, 1000).difference("s1", "s0", "ap", "spearman")
    assert back.better == pytest.approx(1 - correlation.better) and back.value == -correlation.value


def test_paired_difference_has_narrower_interval(thirteen):
    rng = np.random.default_rng(1)
    near = with_scores(thirteen, copy=thirteen.scores["s0"], near=thirteen.scores["s0"] + 0.1 * rng.normal(size=13))
    same = study(near).difference("s0", "copy", "ap", "pearson")
    assert same.value == 0 and same.better == 0.5 and "all resamples have the same value" in same.why
    width = [entry.interval.high - entry.interval.low for entry in (
        study(near).difference("s0", "near", "ap", "pearson"), study(near).correlation("s0", "ap", "pearson"),
    )]  # fmt: skip
    assert width[0] < 0.5 * width[1]


# ---- several junctions


def test_ranks_sites_within_junctions():
    """The scale of a junction has no effect: one junction's scores and detection are far above the other's."""
    rng = np.random.default_rng(9)
    low, high = (simulated_studies.junction(rng, n, (0.6,), name=name) for n, name in ((12, "low"), (9, "high")))
    moved = MeasureValues(high.measures["ap"].values * 7 + 100, high.measures["ap"].left_out * 7 + 100)
    high = JunctionScores("high", high.sites, {"s0": high.scores["s0"] * 50 + 1e4}, {"ap": moved})
    for kind in COEFFICIENT_KINDS:
        each = [study(junction).correlation("s0", "ap", kind).value for junction in (low, high)]
        both = study([low, high]).correlation("s0", "ap", kind)
        assert both.value == pytest.approx((12 * each[0] + 9 * each[1]) / 21)
        assert both.sites == 21 and both.interval.low < both.value < both.interval.high
        assert study([high, low]).correlation("s0", "ap", kind).interval.low == pytest.approx(both.interval.low)
    ranks = []
    for junction in (low, high):
        for values in (junction.scores["s0"], junction.measures["ap"].values):
            rank = scipy.stats.rankdata(values)
            ranks.append((rank - rank.mean()) / rank.std())
    pooled = np.corrcoef(np.concatenate(ranks[::2]), np.concatenate(ranks[1::2]))[0, 1]
    assert study([low, high]).correlation("s0", "ap", "spearman").value == pytest.approx(pooled)


def test_more_junctions_give_narrower_intervals():
    rng = np.random.default_rng(10)
    junctions = [simulated_studies.junction(rng, 13, (0.5,), name=f"j{k}") for k in range(6)]
    width = [np.subtract(entry.high, entry.low) for entry in (
        study(junctions[:1]).correlation("s0", "ap", "spearman").interval,
        study(junctions).correlation("s0", "ap", "spearman").interval,
    )]  # fmt: skip
    assert width[1] < 0.6 * width[0]


def test_names_junction_with_constant_score():
    rng = np.random.default_rng(11)
    fine, flat = (simulated_studies.junction(rng, 9, (0.5,), name=name) for name in ("fine", "flat"))
    flat = with_scores(flat, s0=np.ones(9))
    correlation = study([fine, flat]).correlation("s0", "ap", "kendall")
    assert math.isnan(correlation.value) and correlation.why == "s0 is the same at all sites of flat"


def test_draws_sites_of_one_pole_together() -> None:
    poles = ("a", "b", "a", "c", "d", "d")  # two of two sites, two of one
    draws = Resamples.draw("x", 6, 10, 4000, 0, poles)
    assert draws.sites.shape == (4000, 6)
    often = np.stack([np.bincount(row, minlength=6) for row in draws.sites])
    np.testing.assert_array_equal(often[:, 0], often[:, 2])
    np.testing.assert_array_equal(often[:, 4], often[:, 5])
    assert (often[:, [0, 4]].sum(axis=1) == 2).all() and (often[:, [1, 3]].sum(axis=1) == 2).all()
    assert 0.45 < (often[:, 0] == 1).mean() < 0.55  # each of two, twice
    alone = Resamples.draw("x", 6, 10, 50, 0, tuple("abcdef"))
    np.testing.assert_array_equal(alone.sites, Resamples.draw("x", 6, 10, 50, 0).sites)


def test_poles_with_similar_sites_widen_interval() -> None:
    rng = np.random.default_rng(1)
    score, detected = (np.repeat(rng.normal(size=10), 4) + 0.01 * rng.normal(size=40) for _ in range(2))
    measures = {"ap": MeasureValues(detected, np.tile(detected[:, None], 10))}
    sites = tuple(f"s{i}" for i in range(40))
    widths = []
    for poles in ((), tuple(f"p{i // 4}" for i in range(40))):
        study = CorrelationStudy([JunctionScores("x", sites, {"s": score}, measures, poles)], 0, 500)
        interval = study.correlation("s", "ap", "spearman").interval
        widths.append(interval.high - interval.low)
    assert widths[1] > 1.5 * widths[0]
