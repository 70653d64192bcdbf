"""Returns that come again: sweeps of a ground whose returns are drawn with known losses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from egvs.clouds.simulation import REFLECTIVITY
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.special import ndtr
from egvs.extensions.validation.measured.repetition import FLAT_SOFTNESS, measure_repetition, repeated_returns
from egvs.extensions.validation.measured.sensor_site import on_ground_plane
from egvs.formats.sweep_files import Sweep
from egvs.sensors.sensor import CATALOGUE
from tests.extensions.validation.measured.twin import POSE, SENSOR

RATED_RANGE_M = 70.0


def ground_sweep(seed: int, yaw_deg: float = 0.0) -> Sweep:
    """A sweep of level ground: returns are lost as from a flat target of asphalt."""
    rng = np.random.default_rng(seed)
    sensor = CATALOGUE[SENSOR]
    down = -sensor.directions(*POSE.angles_deg)[:, 2]
    range_m = np.where(down > 0.07, POSE.z_m / np.maximum(down, 0.07), np.inf)
    limit_m = RATED_RANGE_M * np.sqrt(REFLECTIVITY["ground"] * np.maximum(down, 0.0) / sensor.rated_reflectivity)
    with np.errstate(divide="ignore"):
        probability = ndtr(2.0 * np.log(limit_m / range_m) / FLAT_SOFTNESS)
    returned = np.isfinite(range_m) & (rng.random(len(range_m)) < probability)
    points_m: FloatArray = sensor.directions()[returned] * range_m[returned, None]
    points_m *= (1.0 + 0.0005 * rng.standard_normal(len(points_m)))[:, None]
    if yaw_deg:
        cos, sin = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
        points_m = points_m @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return Sweep(f"sweep{seed}", points_m)


@pytest.mark.slow
def test_rated_range_is_within_the_printed_interval() -> None:
    sweeps = [ground_sweep(1), ground_sweep(2)]
    site = on_ground_plane(CATALOGUE[SENSOR], sweeps)
    result = measure_repetition(site, sweeps)
    assert result.fit is not None
    low_m, high_m = result.fit.interval_m
    assert low_m * 0.99 < RATED_RANGE_M < high_m * 1.01  # the grid has steps of 1 %
    assert high_m < 1.1 * low_m
    near, *_, far = result.rows
    assert near.share > 0.98 > far.share
    fitted = [row.rated_range_m for row in result.rows if row.rated_range_m is not None]
    assert fitted[-1] == pytest.approx(RATED_RANGE_M, rel=0.05)


def test_moving_things_do_not_count() -> None:
    """By hand: one return repeats, one is lost, one is of something that moved away."""
    first = np.array([[10.0, 0, 0], [0, 10.0, 0], [-10.0, 0, 0]])
    second = np.array([[10.1, 0, 0], [-20.0, 0, 0]])
    static, repeated = repeated_returns(first, second, 0.1)
    assert static.tolist() == [True, True, False]
    assert repeated.tolist() == [True, False, False]


@pytest.mark.slow
def test_sweeps_of_other_places_are_refused() -> None:
    sweeps = [ground_sweep(1), Sweep("other", ground_sweep(2).points_m * 1.5)]
    site = on_ground_plane(CATALOGUE[SENSOR], sweeps[:1])
    with pytest.raises(InputError, match="expected sweeps of one place"):
        measure_repetition(site, sweeps)
    with pytest.raises(InputError, match="expected at least 2 sweeps"):
        measure_repetition(site, sweeps[:1])
