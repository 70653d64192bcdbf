"""Residuals of ranges vanish on planes, and their scale is the noise that was simulated.

Evidence: exact planes; a plain loop over triples; simulated noise.
"""

from __future__ import annotations

import numpy as np
import pytest

from egvs.core.grid import FloatArray
from egvs.extensions.hardware.fit.range_noise import MAX_SLOPE, noise_by_channel, noise_by_range, range_residuals
from tests.extensions.hardware.fit.small_sensor import TRUTH, small_fit


def wall_ranges(distance_m: float = 20.0, channels: int = 3) -> FloatArray:
    """Ranges to a wall x = distance of beams every 0.2 degrees, +-70 degrees; NaN elsewhere."""
    azimuth = np.radians(np.arange(1800) * 0.2 - 180.0)
    elevation = np.radians(np.array([-5.0, 0.0, 10.0])[:channels])
    ranges = distance_m / (np.cos(elevation)[:, None] * np.cos(azimuth))
    ranges[:, np.abs(azimuth) > np.radians(70.0)] = np.nan
    return ranges


def test_no_residual_on_oblique_wall() -> None:
    """At 70 degrees of incidence, the usual second difference is 1.7 mm; this residual is below 6e-6 of the range."""
    ranges = wall_ranges()
    residuals = range_residuals([ranges], True)
    assert len(residuals.range_m) == 3 * 699
    assert np.abs(residuals.residual_m / residuals.range_m).max() < 6.2e-6
    usual = np.diff(ranges, 2, axis=1)
    assert np.nanmax(np.abs(usual)) > 0.002


def test_residuals_of_plain_loop() -> None:
    rng = np.random.default_rng(0)
    ranges = wall_ranges() + 0.5 * rng.standard_normal((3, 1800))
    ranges[rng.random(ranges.shape) < 0.2] = np.nan
    residuals = range_residuals([ranges], True)
    expected = []
    for channel in range(3):
        for column in range(1800):
            before, middle, after = ranges[channel, [column - 1, column, (column + 1) % 1800]]
            if abs(after - before) <= MAX_SLOPE * middle:
                expected.append((channel, column, middle - 2 / (1 / before + 1 / after)))
    np.testing.assert_array_equal(residuals.channel, [row[0] for row in expected])
    np.testing.assert_array_equal(residuals.pulse % 1800, [row[1] for row in expected])
    np.testing.assert_allclose(residuals.residual_m, [row[2] for row in expected])


def test_ends_of_a_field_of_view_have_one_neighbour() -> None:
    ranges = np.full((1, 10), 8.0)
    assert len(range_residuals([ranges], True).range_m) == 10
    assert len(range_residuals([ranges], False).range_m) == 8


def test_only_used_returns_count_as_neighbours() -> None:
    ranges = np.full((1, 10), 8.0)
    used = np.ones((1, 10), dtype=bool)
    used[0, 4] = False
    assert range_residuals([ranges], True, [used]).pulse.tolist() == [0, 1, 2, 6, 7, 8, 9]


def test_noise_by_range_and_channel() -> None:
    rng = np.random.default_rng(1)
    sigma_m = np.array([[0.01], [0.02], [0.04]])
    residuals = range_residuals([wall_ranges(8.0) + sigma_m * rng.standard_normal((3, 1800))], True)
    values = [estimate.value if estimate else 0.0 for estimate in noise_by_channel(residuals, 4, 0.0)]
    assert values == pytest.approx([0.01, 0.02, 0.04, 0.0], rel=0.12)
    bins = noise_by_range(residuals, 0.0)
    assert [(b.from_m, b.to_m) for b in bins] == [(5.0, 10.0), (10.0, 15.0), (15.0, 20.0), (20.0, 25.0)]
    assert sum(b.sigma_m.n for b in bins) == len(residuals.range_m)


def test_noise_of_simulated_sweep() -> None:
    sigma_m = small_fit().sigma_m
    assert sigma_m is not None
    assert sigma_m.low < TRUTH.sigma_m < sigma_m.high
    assert sigma_m.high - sigma_m.low < 0.2 * TRUTH.sigma_m
