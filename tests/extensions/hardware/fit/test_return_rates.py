"""Return rates on smooth surfaces and on the road, whatever stands beside the road; sectors without returns.

Evidence: simulated losses, with and without vehicles that lose more; hand-made grids.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egvs.core.grid import FloatArray
from egvs.extensions.hardware.fit import return_rates
from egvs.extensions.hardware.fit.return_rates import empty_sectors, smooth_pulses, smooth_rates, view_of_plane
from egvs.extensions.hardware.fit.surface_normals import incidence_angles_deg
from tests.extensions.hardware.fit.small_sensor import TRUTH, small_fit

ANGLES = small_fit().angles


def test_smooth_pulses_by_hand() -> None:
    """Of one channel: a loss between returns counts, a pulse beside a loss or an edge does not."""
    grid = np.full((10, 900), np.nan)
    grid[2, :8] = [10.0, 10.0, np.nan, 10.0, 10.0, 10.0, 20.0, 20.0]
    pulses = smooth_pulses([grid], ANGLES)
    # Column 2 is lost between returns; column 4 returned between returns; columns 5 and 6 have an edge beside them.
    assert pulses.returned.tolist() == [False, True]
    assert pulses.range_m.tolist() == [10.0, 10.0]


def test_rate_of_simulated_losses() -> None:
    fit = small_fit()
    assert fit.return_rate is not None
    assert fit.return_rate.low < 1 - TRUTH.lost < fit.return_rate.high
    assert fit.return_rates
    assert sum(rate.rate.low <= 1 - TRUTH.lost <= rate.rate.high for rate in fit.return_rates) >= 0.85 * len(
        fit.return_rates
    )


def test_incidence_of_known_surfaces() -> None:
    """On the ground, the incidence is known from the plane; half of the returns agree to 2 degrees."""
    fit = small_fit()
    grid = fit.grids[0].range_m
    measured = incidence_angles_deg(grid, fit.angles)
    on_ground = np.abs(fit.plane_view.height_m(grid)) < 0.1
    difference = np.abs(measured - fit.plane_view.incidence_deg)[on_ground]
    assert np.isfinite(difference).mean() > 0.5
    assert np.nanmedian(difference) < 2.0


@pytest.fixture
def road() -> tuple[FloatArray, return_rates.PlaneView]:
    """Ranges to the plane within 60 m in all directions, without losses."""
    fit = small_fit()
    view = view_of_plane([fit.grids[0].range_m], ANGLES, fit.plane, (-180.0, 180.0))
    return np.where(view.range_m < 60.0, view.range_m, np.nan), view


def test_road_with_losses(road: tuple[FloatArray, return_rates.PlaneView]) -> None:
    grid, view = road
    lost = np.random.default_rng(0).random(grid.shape) < 0.3
    bins = return_rates.road_rates([np.where(lost, np.nan, grid)], ANGLES, view)
    bins = [rate for rate in bins if rate.to_m <= 60.0]
    assert bins
    for rate in bins:
        assert rate.rate.value == pytest.approx(0.7, abs=5 * rate.rate.se)


def test_vehicle_that_loses_more_does_not_count(road: tuple[FloatArray, return_rates.PlaneView]) -> None:
    """A dark vehicle, halfway to the road, of which 60 % of the returns are lost."""
    grid, view = road
    rng = np.random.default_rng(0)
    grid = grid.copy()
    grid[:, 100:250] *= 0.5
    lost = rng.random(grid.shape) < 0.1
    lost[:, 100:250] = rng.random((10, 150)) < 0.6
    grid[lost] = np.nan
    bins = {rate.from_m: rate.rate for rate in return_rates.road_rates([grid], ANGLES, view) if rate.to_m <= 60.0}
    assert bins
    for rate in bins.values():
        assert rate.value == pytest.approx(0.9, abs=5 * rate.se)
    towards = {rate.from_m: rate.rate for rate in return_rates.rates_towards_road([grid], view)}
    assert all(towards[start].value < bins[start].value - 0.03 for start in bins)


def test_detects_road_sectors() -> None:
    """The plane is in sight only to the left; on the right, the ground lies 3 m deeper."""
    fit = small_fit()
    view = view_of_plane([fit.grids[0].range_m], ANGLES, fit.plane, (-180.0, 180.0))
    deeper = view_of_plane([fit.grids[0].range_m], ANGLES, replace(fit.plane, height_m=fit.plane.height_m + 3.0))
    azimuth_deg = np.mod(ANGLES.azimuth_deg() + 180.0, 360.0) - 180.0
    grid = np.where(azimuth_deg > 0, view.range_m, deeper.range_m)
    grid[~(grid < 60.0)] = np.nan
    on_road = view_of_plane([grid], ANGLES, fit.plane).on_road
    inside = (azimuth_deg > 4.0) & (azimuth_deg < 176.0)
    outside = (azimuth_deg < -4.0) & (azimuth_deg > -176.0)
    assert on_road[inside].all()
    assert not on_road[outside].any()


def test_sectors_without_returns() -> None:
    azimuth_deg = np.mod(ANGLES.azimuth_deg() + 180.0, 360.0) - 180.0
    grid = np.full(azimuth_deg.shape, 9.0)
    grid[(azimuth_deg > 20.0) & (azimuth_deg < 50.0)] = np.nan
    grid[np.abs(azimuth_deg) > 160.0] = np.nan
    grid[(azimuth_deg > -90.0) & (azimuth_deg < -89.0)] = np.nan  # narrower than 2 degrees
    sectors = sorted(empty_sectors([grid], ANGLES))
    assert np.abs(np.array(sectors) - [(20.0, 50.0), (160.0, 200.0)]).max() <= 2.0
    assert empty_sectors([np.full(azimuth_deg.shape, 9.0)], ANGLES) == []


def test_rates_need_enough_pulses() -> None:
    grid = np.full((10, 900), np.nan)
    grid[0, :50] = 10.0
    assert smooth_rates(smooth_pulses([grid], ANGLES)) == (None, [])
