"""The numbers that compare a ranking with detection, against numbers calculated by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from egvs import load
from egvs.extensions.validation.detection_metrics import (
    ALL_OBJECTS,
    BLOCKS,
    MEASURES,
    JackknifeEstimate,
    SiteDetection,
)
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME
from egvs.extensions.validation.ranking_evidence import SiteRanking, check_ranking

FRAMES = 10 * BLOCKS


def estimate(by_block):
    """The mean of a value that each block has, as a detector's measures are jackknifed."""
    by_block = np.asarray(by_block, dtype=np.float64)
    left_out = (by_block.sum() - by_block) / (BLOCKS - 1)
    return JackknifeEstimate.from_values(np.append(by_block.mean(), left_out), np.full(BLOCKS, 10))


def detections(by_site, detector="cluster"):
    """Rows of ``detection.parquet``, with the same value for every measure."""
    rows = []
    for site, by_block in by_site.items():
        measures = dict.fromkeys(MEASURES, estimate(by_block))
        rows.append(SiteDetection(site, detector, ALL_OBJECTS, FRAMES, 5, {}, measures))
    return rows


def ranking_of(values):
    best = max(values.values())
    first = tuple(site for site, value in values.items() if value == best)
    return SiteRanking("egvs", values, first)


def one_check(mini, values, by_site, heights_m=None):
    poles = list(by_site)
    (check,) = check_ranking(
        load(mini), ranking_of(values), detections(by_site), poles, heights_m or [3.0] * len(poles)
    ).detectors
    return check


def test_error_of_the_loss_is_paired_over_blocks(mini):
    rng = np.random.default_rng(5)
    traffic = rng.normal(0.0, 0.1, BLOCKS)  # hard and easy blocks are the same for both sites
    a, b = 0.5 + traffic + rng.normal(0.0, 0.005, BLOCKS), 0.6 + traffic + rng.normal(0.0, 0.005, BLOCKS)
    check = one_check(mini, {"a": 9.0, "b": 5.0}, {"a": a, "b": b})
    assert (check.first, check.best) == ("a", "b")
    assert math.isclose(check.loss, (b - a).mean())
    assert math.isclose(check.loss_se, (b - a).std(ddof=1) / math.sqrt(BLOCKS))
    assert check.best_se > 5 * check.loss_se  # unpaired, the error would be that large


def test_of_several_first_sites_the_one_that_detects_best_counts(mini):
    values = {"a": 9.0, "b": 9.0, "c": 1.0}
    check = one_check(
        mini, values, {name: np.full(BLOCKS, value) for name, value in {"a": 0.3, "b": 0.5, "c": 0.6}.items()}
    )
    assert (check.first, check.best) == ("b", "c") and math.isclose(check.loss, 0.1)


def test_first_site_is_best_where_another_detects_equally_well(mini):
    check = one_check(mini, {"a": 1.0, "b": 9.0}, {"a": np.full(BLOCKS, 0.5), "b": np.full(BLOCKS, 0.5)})
    assert (check.first, check.best, check.loss) == ("b", "b", 0.0)


def test_all_sites_agree_although_each_height_disagrees(mini):
    """High sites score and detect more; within a height the order is reversed."""
    values, by_site, heights_m = {}, {}, []
    for height_m in (2.0, 6.0):
        for number in range(6):
            site = f"p{number}@{height_m:g}"
            values[site] = 10 * height_m + number
            by_site[site] = np.full(BLOCKS, 0.1 * height_m - 0.01 * number)
            heights_m.append(height_m)
    poles = [site.split("@")[0] for site in by_site]
    (check,) = check_ranking(load(mini), ranking_of(values), detections(by_site), poles, heights_m).detectors
    # ranks 6 5 4 3 2 1 12 11 10 9 8 7 against 1 to 12: 1 - 6 * 140 / (12 * 143)
    assert check.rho.value == pytest.approx(1 - 6 * 140 / (12 * 143)) and check.rho.sites == 12
    assert check.same_height.value == pytest.approx(-1.0)
    assert (check.same_height.sites, check.same_height.groups) == (12, 2)


def test_same_height_is_unknown_below_five_poles(mini):
    values = {name: float(value) for value, name in enumerate("abcdef")}
    by_site = {name: np.full(BLOCKS, 0.1 * value) for name, value in values.items()}
    check = one_check(mini, values, by_site, [2.0, 2.0, 2.0, 4.0, 4.0, 4.0])
    assert check.same_height.value is None
    assert check.same_height.why == "no mounting height has sites on 5 poles"
    assert one_check(mini, values, by_site).same_height is None  # all at one height


def test_detectors_with_boxes_come_first_and_undefined_ones_are_left_out(mini):
    by_site = {"a": np.full(BLOCKS, 0.5), "b": np.full(BLOCKS, 0.4)}
    rows = [*detections(by_site, POINT_COUNTS_NAME), *detections(by_site), *detections(
        {name: np.full(BLOCKS, math.nan) for name in "ab"}, "blind"
    )]  # fmt: skip
    checks = check_ranking(load(mini), ranking_of({"a": 2.0, "b": 1.0}), rows, ["a", "b"], [3.0, 3.0]).detectors
    assert [(check.detector, check.returns_boxes) for check in checks] == [("cluster", True), ("points", False)]
