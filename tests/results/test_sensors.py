"""The best mount of each sensor, and its cost, computed by hand."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import pytest

from egvs.report.sensor_text import (
    SENSOR_EVIDENCE,
    costs_option,
    describe_evidence,
    explain_sensor_differences,
    range_note,
)
from egvs.results.ranking import RankedSite, ScoreValue
from egvs.results.sensors import (
    ScoreDifference,
    SensorComparison,
    best_mounts,
    format_difference,
    site_cost,
)
from egvs.scenario.score_config import CostsConfig

PRICES = {"small": 4000.0, "medium": 8000.0, "large": 18000.0}


def site(name: str, sensor: str, share: float, *, z_m: float = 3.0, se: float | None = 0.003) -> RankedSite:
    base = RankedSite(name, 0.0, 0.0, z_m, 1000.0 * share, 1, name, 0.0, 0.0, 0.0, sensor, 1e4, 1, 1, 0.5)
    return replace(base, rank_by="expected_detections", others=(ScoreValue("expected_detections", share, se),))


def compare(*sites: RankedSite, prices: Mapping[str, float] = PRICES) -> SensorComparison:
    ranked = sorted(sites, key=lambda one: -one.score)
    comparison = SensorComparison.of_run(ranked, CostsConfig(sensor=dict(prices)))
    assert comparison is not None
    return comparison


def test_sensors_are_compared_with_the_cheapest() -> None:
    comparison = compare(site("a", "large", 0.85), site("b", "medium", 0.80), site("c", "small", 0.60))
    assert [result.mount.sensor for result in comparison.results] == ["small", "medium", "large"]
    assert [result.cost_text for result in comparison.results] == ["4,000", "8,000", "18,000"]
    assert [result.gain_text for result in comparison.results] == ["-", "+20.0 ± 0.4", "+25.0 ± 0.4"]


def test_costs_contain_pole_and_height() -> None:
    """2 m higher: 200 more."""
    sites = (site("a", "medium", 0.61, z_m=5.0, se=0.0001), site("b", "small", 0.60, se=0.0001))
    comparison = SensorComparison.of_run(sites, CostsConfig(sensor=dict(PRICES), pole=12000.0, metre=100.0))
    assert comparison is not None
    assert [result.mount.cost for result in comparison.results] == [16300.0, 20500.0]


def test_gain_within_its_error_is_marked() -> None:
    comparison = compare(site("a", "medium", 0.602), site("b", "small", 0.60))
    assert comparison.results[1].gain_text == "~ +0.2 ± 0.4"


def test_without_a_cost_the_sensor_that_finds_least_is_the_baseline() -> None:
    comparison = compare(site("a", "large", 0.85), site("b", "small", 0.60), prices={"small": 4000.0})
    assert not comparison.has_costs
    assert comparison.baseline.sensor == "small"
    assert "which finds least" in explain_sensor_differences(comparison)
    assert [result.cost_text for result in comparison.results] == ["4,000", "-"]
    assert costs_option(comparison.sensors) == """--set 'costs.sensor={"small" = PRICE, "large" = PRICE}'"""


def test_sensors_with_a_cost_are_compared_without_that_of_another() -> None:
    sites = site("a", "large", 0.85), site("b", "medium", 0.80), site("c", "small", 0.60)
    comparison = compare(*sites, prices={"small": 4000.0, "large": 18000.0})
    assert [result.mount.sensor for result in comparison.results] == ["small", "large", "medium"]
    assert "the cheapest with a known cost" in explain_sensor_differences(comparison)
    assert explain_sensor_differences(comparison).endswith("Without a known cost: medium.")


def test_one_sensor_is_not_compared() -> None:
    assert SensorComparison.of_run([site("a", "small", 0.6), site("b", "small", 0.5)], CostsConfig()) is None


def test_best_mount_of_a_sensor_is_its_first_site_by_rank() -> None:
    sites = [site("a", "small", 0.6), site("b", "large", 0.55), site("c", "small", 0.5)]
    assert [mount.site.site for mount in best_mounts(sites, CostsConfig())] == ["a", "b"]


@pytest.mark.parametrize(
    ("text", "cost"), [("9500", 9500.0), ("", 4000.0), ("cheap", None), ("-1", None), ("inf", None), ("nan", None)]
)
def test_column_cost_replaces_the_price(text: str, cost: float | None) -> None:
    own = replace(site("a", "small", 0.6), user_columns=(("owner", "city"), ("cost", text)))
    assert site_cost(own, CostsConfig(sensor=PRICES)) == cost


@pytest.mark.parametrize(("existing", "cost"), [((), 4500.0), (("b",), 4500.0), (("a",), 4000.0), ("all", 4000.0)])
def test_pole_that_exists_costs_nothing(existing: tuple[str, ...], cost: float) -> None:
    assert site_cost(site("a", "small", 0.6), CostsConfig(sensor=PRICES, pole=500.0), existing) == cost


def test_independent_errors_are_added_in_quadrature() -> None:
    difference = ScoreDifference.of_independent(site("a", "s", 0.65, se=0.03), site("b", "s", 0.6, se=0.04))
    assert difference.se == pytest.approx(0.05)
    assert difference.better == pytest.approx(0.841345, abs=1e-6)  # one standard deviation
    assert not difference.is_clear
    assert not difference.is_paired
    assert ScoreDifference.of_independent(site("a", "s", 0.6, se=0.0), site("b", "s", 0.6, se=0.0)).better == 0.5


def test_difference_of_unknown_error_is_shown_without_one() -> None:
    difference = ScoreDifference.of_independent(site("a", "s", 0.65, se=None), site("b", "s", 0.6))
    assert format_difference(difference, site("a", "s", 0.65)) == "+5.0"
    assert difference.is_clear


def test_difference_that_is_rounded_to_zero_has_no_minus() -> None:
    assert format_difference(ScoreDifference(-0.0004, 0.003, 0.5), site("a", "s", 0.6)) == "~ +0.0 ± 0.3"


def test_evidence_is_that_of_the_score_that_ranks() -> None:
    by_share = compare(site("a", "large", 0.85), site("b", "small", 0.60))
    assert describe_evidence(by_share) is SENSOR_EVIDENCE
    sites = [replace(result.mount.site, rank_by="egvs", others=()) for result in by_share.results]
    by_egvs = compare(*sites)
    assert "whether EGVS ranks different sensors as detectors do was not measured" in describe_evidence(by_egvs)


def test_difference_in_bits_has_no_percentage_points() -> None:
    bits = replace(site("a", "s", 0.65), rank_by="egvs", others=())
    assert format_difference(ScoreDifference(1234.4, 56.0, 1.0), bits) == "+1,234 ± 56"
    assert math.isclose(bits.score, 650.0)


def test_several_sensors_without_range_limit_have_a_note() -> None:
    assert range_note(["a", "b", "a"], is_modelled=False).endswith("leave out effects.range_limit = false.")
    assert range_note(["a", "b", "a"], is_modelled=True) == ""
    assert range_note(["a", "a"], is_modelled=False) == ""
