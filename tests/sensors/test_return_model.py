"""Losses of returns: the formula against a slow twin, classes of road users, and the rule that enables losses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.scenario.effects_config import RangeLimitParameters
from egvs.sensors.return_model import (
    NEGLIGIBLE_LOSS,
    REFLECTIVITY_INTERVAL,
    ReturnModel,
    class_of,
    decide_losses,
    road_user_classes,
)
from egvs.sensors.sensor import CATALOGUE, Sensor, catalogue_entries
from egvs.sensors.sites import Pose, Site

ROI = Roi((0.0, -10.0, 0.0), (40.0, 20.0, 5.0))
RATED = Sensor("rated", (0.0,), (0.0,), 8, 100.0, "this test", rated_range_m=55.0, rated_reflectivity=0.1)


def slow_probability(
    range_m: float, rated_m: float, rated_rho: float, rho: float, softness: float, dropout: float
) -> float:
    """One pulse, by the energy that comes back: the share of a normal distribution, integrated over its density."""
    power = (rho / range_m**2) / (rated_rho / rated_m**2)
    steps = 20000
    low, high = -12.0, math.log(power) / softness
    if high <= low:
        return 0.0
    width = (min(high, 12.0) - low) / steps
    density = sum(math.exp(-0.5 * (low + (k + 0.5) * width) ** 2) for k in range(steps))
    return (1.0 - dropout) * density * width / math.sqrt(2.0 * math.pi)


@pytest.mark.parametrize("softness", [0.3, 1.0, 2.2])
@pytest.mark.parametrize("rho", [0.03, 0.06, 0.8])
def test_formula_equals_integral_of_density(softness: float, rho: float) -> None:
    model = ReturnModel(55.0, 0.1, softness, 0.05)
    range_m = np.array([2.0, 13.0, 30.0, 47.0, 90.0])
    expected = [slow_probability(r, 55.0, 0.1, rho, softness, 0.05) for r in range_m]
    np.testing.assert_allclose(model.probability(range_m, rho), expected, atol=1e-6)
    np.testing.assert_allclose(model.probability(range_m, np.full(5, rho)), expected, atol=1e-6)


@given(st.floats(0.01, 1.0), st.floats(0.01, 1.0), st.floats(0.0, 3.0), st.floats(0.0, 1.0))
def test_probability_falls_with_range_and_rises_with_reflectivity(
    one: float, other: float, softness: float, dropout: float
) -> None:
    model = ReturnModel(80.0, 0.2, softness, dropout)
    range_m = np.linspace(0.0, 300.0, 40)
    dark, bright = (model.probability(range_m, rho) for rho in sorted((one, other)))
    assert (dark <= bright).all() and (np.diff(bright) <= 0.0).all()
    assert ((dark >= 0.0) & (bright <= 1.0 - dropout)).all()


def test_defaults_are_those_that_were_fitted() -> None:
    model = ReturnModel.of(CATALOGUE["OS1-64"])
    assert (model.target_reflectivity(), model.softness, model.dropout) == (0.03, 1.0, 0.05)
    assert model.limit_m(0.03) == pytest.approx(30.1, abs=0.05), "measured: 30.3 +- 1.7 m"
    assert REFLECTIVITY_INTERVAL == (0.03, 0.06)


def test_parameters_of_the_effect_replace_those_of_the_sensor() -> None:
    sensor = replace(RATED, softness=0.5, dropout=0.2)
    assert ReturnModel.of(sensor) == ReturnModel(55.0, 0.1, 0.5, 0.2)
    config = RangeLimitParameters(softness=0.0, dropout=0.0, rated_range_m=20.0, reflectivity=0.2)
    assert ReturnModel.of(sensor, config) == ReturnModel(20.0, 0.1, 0.0, 0.0, 0.2)
    with pytest.raises(InputError, match=r"sensor dark: rated_range_m is missing. Add it to \[sensors.dark\]"):
        ReturnModel.of(replace(sensor, name="dark", rated_range_m=None))


def test_scenario_sets_what_road_users_reflect_and_leaves_the_static_world() -> None:
    """A window, a whole road user and the ground, which has its own incidence in its reflectivity."""
    surfaces, of_class = np.array([0.0225, 0.03, 0.17]), np.array([0.03, 0.03, np.nan])
    plain = ReturnModel(55.0, 0.1)
    assert plain.surface_reflectivity(surfaces, of_class).tolist() == surfaces.tolist()
    tilted = replace(plain, incidence_deg=60.0)
    np.testing.assert_allclose(tilted.surface_reflectivity(surfaces, of_class), [0.01125, 0.015, 0.17])
    bright = replace(tilted, reflectivity=0.2)
    np.testing.assert_allclose(bright.surface_reflectivity(surfaces, of_class), [0.075, 0.1, 0.17])
    assert bright.target_reflectivity("bus") == pytest.approx(0.1)
    assert bright.surface_reflectivity(np.array([0.03])).tolist() == pytest.approx([0.1])


def test_each_vclass_belongs_to_one_class_with_a_source() -> None:
    classes = road_user_classes()
    listed = [vclass for road_users in classes.values() for vclass in road_users.vclasses]
    assert len(listed) == len(set(listed))
    for name, road_users in classes.items():
        low, high = road_users.interval
        assert low <= road_users.reflectivity <= high, name
        assert len(road_users.source) >= len("assumed as cars")
        glass, body, share = road_users.glass_reflectivity, road_users.body_reflectivity, road_users.glass_share
        assert glass**share * body ** (1.0 - share) == pytest.approx(road_users.reflectivity)
    assert class_of("bus").name == "bus" and class_of("passenger").name == "car"
    assert class_of("custom1") is class_of("no such vclass") is classes["car"]


def test_every_catalogue_entry_says_where_its_rated_range_is_from() -> None:
    for name, entry in catalogue_entries().items():
        assert entry.rated_source, name
        assert CATALOGUE[name].rated_source == entry.rated_source


# The rule
def sites_at(x_m: float, *names: str) -> list[Site]:
    return [Site(f"pole_{name}", Pose(x_m, 0.0, 3.0), name) for name in names]


def test_losses_act_where_more_than_five_percent_may_be_lost() -> None:
    """From (0, 0, 3) the farthest corner is sqrt(40^2 + 10^2 + 3^2) = 41.3 m away."""
    limit_m = RATED.rated_range_m * math.sqrt(0.03 / 0.1) * math.exp(-0.5 * 1.6449)
    needed_m = 41.34 / limit_m * 55.0
    for factor, is_acting in ((0.98, True), (1.02, False)):
        sensor = replace(RATED, rated_range_m=needed_m * factor)
        decision = decide_losses(sites_at(0.0, "rated"), {"rated": sensor}, ROI)
        assert ("rated" in decision.acting, "rated" in decision.negligible) == (is_acting, not is_acting)
        model = ReturnModel.of(replace(sensor, dropout=0.0))
        assert (1.0 - model.probability(np.array([41.34]))[0] > NEGLIGIBLE_LOSS) == is_acting


def test_beams_that_end_before_losses_begin_lose_nothing() -> None:
    short = replace(RATED, range_m=13.0)
    assert decide_losses(sites_at(0.0, "rated"), {"rated": short}, ROI).acting == {}
    assert "rated" in decide_losses(sites_at(0.0, "rated"), {"rated": replace(RATED, range_m=13.5)}, ROI).acting


def test_farthest_site_of_a_sensor_decides_for_all_sensors() -> None:
    far = replace(RATED, name="far", rated_range_m=400.0)
    unrated = replace(RATED, name="unrated", rated_range_m=None)
    sensors = {sensor.name: sensor for sensor in (RATED, far, unrated)}
    decision = decide_losses([*sites_at(20.0, "rated", "far", "unrated"), *sites_at(-500.0, "far")], sensors, ROI)
    assert decision.to_json() == {"on": ["rated", "far"], "negligible": [], "unrated": ["unrated"]}
    decided, unknown = decision.notes
    assert "losses of returns are simulated for rated (13 m), far (96 m)" in decided
    assert unknown.endswith("Enter rated_range_m and rated_reflectivity under [sensors.unrated]")
    near = decide_losses(sites_at(20.0, "far"), sensors, ROI)
    mixed = decide_losses(sites_at(20.0, "rated", "far"), sensors, ROI)
    assert mixed.to_json() == {"on": ["rated", "far"], "negligible": [], "unrated": []}
    decided, others = mixed.notes
    assert "are simulated for rated (13 m): the region reaches to 23 m" in decided
    assert others == "losses of returns are simulated for far, too: for all sensors or none"
    assert (near.notes, list(near.negligible)) == ((), ["far"])
    assert near.negligible_note == "not called for: far lose at most 5 % of returns from the region"
