"""Angles, directions of rotation, fields of view and range steps are those of the simulated sensor.

Evidence: sweeps of sensors whose angles are known; ranges with hand-set steps.
"""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.sensor_fit import angle_errors
from benchmarks.simulated_sweeps import Truth

from egvs.core.errors import InputError
from egvs.extensions.hardware.fit.beam_angles import fit_beam_angles, pulse_grid, range_step, share_offsets
from egvs.extensions.hardware.fit.fit import fit_sensor
from egvs.formats.sweep_files import Sweep
from egvs.sensors.sensor import CATALOGUE
from tests.extensions.hardware.fit.small_sensor import (
    ELEVATIONS_DEG,
    OFFSETS_DEG,
    TRUTH,
    returns_of,
    small_fit,
    small_sensor,
    sweep_of,
)


def test_organised_sweep_gives_all_angles() -> None:
    angles = small_fit().angles
    assert np.abs(angles.elevation_deg - ELEVATIONS_DEG).max() < 1e-4
    assert np.abs(angles.azimuth_offset_deg - OFFSETS_DEG).max() < 1e-4
    assert (angles.azimuths, angles.direction, angles.is_full_circle) == (900, 1, True)
    assert angles.azimuth_step_deg == pytest.approx(0.4, abs=1e-6)
    assert angles.axis_distance_m == pytest.approx(0.03, abs=1e-4)
    expected_m = -0.03 * np.tan(np.radians(ELEVATIONS_DEG))
    assert np.abs(angles.offset_m - expected_m).max() < 1e-4


@pytest.mark.slow
def test_clockwise_sweep() -> None:
    """A mirror turns the sensor the other way round; azimuth offsets change sign."""
    points = sweep_of(TRUTH) * (1.0, -1.0, 1.0)
    angles, _ = fit_beam_angles([Sweep("mirrored", points)])
    assert angles.direction == -1
    assert np.abs(angles.azimuth_offset_deg + OFFSETS_DEG).max() < 1e-4


@pytest.mark.slow
def test_elevations_of_list_with_each_point_alone() -> None:
    points = np.random.default_rng(0).permutation(returns_of(sweep_of(TRUTH)))
    fit = fit_sensor([Sweep("list", points)])
    errors = angle_errors(small_sensor(), TRUTH, fit)
    assert errors.elevation_deg < 1e-3
    assert errors.offset_mm < 0.5
    assert errors.azimuth_deg < 1e-3
    assert fit.angles.direction == 0


@pytest.mark.slow
def test_list_in_order_of_time_gives_direction() -> None:
    points = returns_of(sweep_of(TRUTH))
    assert fit_beam_angles([Sweep("list", points)])[0].direction == 1
    assert fit_beam_angles([Sweep("list", points[::-1])])[0].direction == -1


@pytest.mark.slow
@pytest.mark.parametrize("is_list", [False, True])
def test_field_of_view(is_list: bool) -> None:
    """Only returns tell its ends in a list: with losses and a wall of limited height, to a few steps."""
    sensor = small_sensor((-50.0, 70.0))
    points = sweep_of(TRUTH, sensor)
    if is_list:
        points = returns_of(points)
    angles, _ = fit_beam_angles([Sweep("view", points)])
    azimuth_deg = angles.azimuth_deg()
    assert not angles.is_full_circle
    expected = np.array(OFFSETS_DEG)
    assert azimuth_deg.min() == pytest.approx(-50.0 + expected.min(), abs=1.3 if is_list else 1e-3)
    assert azimuth_deg.max() == pytest.approx(70.0 + expected.max(), abs=3.0 if is_list else 1e-3)


@pytest.mark.slow
def test_channels_share_offsets_of_one_line() -> None:
    """40 channels whose own offsets are known to 5 mm, on the line -0.03 tan(e) with deviations of 0 or 20 mm.

    Without deviations, offsets are determined by the line, and tangents gain as much as they are correlated. With large
    ones, each channel keeps its own. Deviations in units of the standard errors have a standard deviation of 1.
    """
    rng = np.random.default_rng(0)
    tangent = np.linspace(-0.4, 0.2, 40)
    covariance = np.tile([[1e-6, -4.5e-6], [-4.5e-6, 25e-6]], (40, 1, 1))
    for deviation_m, largest_se_m in ((0.0, 0.002), (0.02, 0.006)):
        scores = []
        largest_m = []
        for _ in range(200):
            offset_m = -0.03 * tangent + deviation_m * rng.standard_normal(40)
            error = rng.multivariate_normal([0.0, 0.0], covariance[0], 40)
            cones = share_offsets(tangent + error[:, 0], offset_m + error[:, 1], covariance)
            largest_m.append(cones.offset_se_m.max())
            assert cones.axis_distance_m == pytest.approx(0.03, abs=0.1)
            scores.append((cones.offset_m - offset_m) / cones.offset_se_m)
            scores.append((cones.tangent - tangent) / cones.tangent_se)
        assert np.mean(largest_m) < largest_se_m
        assert np.std(scores) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_second_sweep_narrows_errors() -> None:
    first, second = Sweep("a", sweep_of(TRUTH)), Sweep("b", sweep_of(TRUTH, seed=1))
    one, _ = fit_beam_angles([first])
    both, _ = fit_beam_angles([first, second])
    assert (both.elevation_se_deg < one.elevation_se_deg).mean() > 0.8


def test_grid_has_every_return_once() -> None:
    points = sweep_of(TRUTH)
    fit = small_fit()
    grid = fit.grids[0]
    expected = np.isfinite(points[:, 0]).reshape(900, 10).T
    np.testing.assert_array_equal(np.isfinite(grid.range_m), expected)
    assert (grid.off_grid, grid.repeated) == (0, 0)
    # The range is measured from the optics, so it is a multiple of the step.
    steps = grid.range_m[expected] / 0.004
    assert np.abs(steps - np.round(steps)).max() < 0.02


def test_grid_counts_what_it_leaves_out() -> None:
    points = returns_of(sweep_of(TRUTH))
    stray = np.array([[10.0, 0.0, 9.0], [0.0, 12.0, 8.0]])
    grid = pulse_grid(Sweep("more", np.concatenate([points, points[:7], stray])), small_fit().angles)
    assert (grid.off_grid, grid.repeated) == (2, 7)


def test_needs_a_sweep_finer_than_float16() -> None:
    with pytest.raises(InputError, match="finer than float16"):
        fit_beam_angles([Sweep("coarse", sweep_of(TRUTH), is_coarse=True)])


@pytest.mark.slow
def test_rejects_sweep_of_another_sensor() -> None:
    other = sweep_of(Truth(), CATALOGUE["VLP-16"])
    with pytest.raises(InputError, match=r"b: .* none of the rings of the first sweep"):
        fit_beam_angles([Sweep("a", sweep_of(TRUTH)), Sweep("b", other)])


@pytest.mark.parametrize("step_m", [0.002, 0.004, 0.005, 0.025])
def test_range_step(step_m: float) -> None:
    ranges = np.random.default_rng(0).uniform(5.0, 40.0, 20_000)
    assert range_step(np.round(ranges / step_m) * step_m) == pytest.approx(step_m, rel=1e-4)


def test_continuous_ranges_have_no_step() -> None:
    rng = np.random.default_rng(0)
    assert range_step(rng.uniform(5.0, 40.0, 20_000)) is None
    rings = np.repeat(rng.uniform(5.0, 40.0, 30), 900)  # ground rings: few distinct ranges
    assert range_step(rings + 0.002 * rng.standard_normal(len(rings))) is None
    assert range_step(np.array([])) is None
