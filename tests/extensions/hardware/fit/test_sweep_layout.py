"""Channels are found in any order of points, and their cones are fitted with honest errors.

Evidence: sweeps whose channel of each point is known; cones with hand-set parameters.
"""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.simulated_sweeps import Truth

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.hardware.fit.sweep_layout import find_layout, find_rings, fit_cone, nearest_ring
from egvs.sensors.sensor import CATALOGUE
from tests.extensions.hardware.fit.small_sensor import ELEVATIONS_DEG, TRUTH, ouster_sweep, sweep_of

AZIMUTHS, CHANNELS = 900, len(ELEVATIONS_DEG)
RANK = np.argsort(np.argsort(ELEVATIONS_DEG))


@pytest.fixture(scope="module")
def organised() -> FloatArray:
    return sweep_of(TRUTH)


@pytest.mark.slow
def test_channel_fastest(organised: FloatArray) -> None:
    layout = find_layout(organised, "sweep")
    assert (layout.order, layout.channels, layout.silent) == ("channel fastest", CHANNELS, 0)
    np.testing.assert_array_equal(layout.channel, np.tile(np.arange(CHANNELS), AZIMUTHS))
    np.testing.assert_array_equal(layout.column, np.repeat(np.arange(AZIMUTHS), CHANNELS))


@pytest.mark.slow
def test_column_fastest(organised: FloatArray) -> None:
    turned = organised.reshape(AZIMUTHS, CHANNELS, 3).transpose(1, 0, 2).reshape(-1, 3)
    layout = find_layout(turned, "sweep")
    assert (layout.order, layout.channels) == ("column fastest", CHANNELS)
    np.testing.assert_array_equal(layout.channel, np.repeat(np.arange(CHANNELS), AZIMUTHS))
    np.testing.assert_array_equal(layout.column, np.tile(np.arange(AZIMUTHS), CHANNELS))


@pytest.mark.slow
def test_channel_without_returns_is_counted(organised: FloatArray) -> None:
    points = organised.copy()
    points[3::CHANNELS] = np.nan
    layout = find_layout(points, "sweep")
    assert (layout.channels, layout.silent) == (CHANNELS - 1, 1)
    assert set(layout.channel[3::CHANNELS]) == {-1}
    assert set(layout.channel[4::CHANNELS]) == {3}


@pytest.mark.slow
def test_list_of_returns(organised: FloatArray) -> None:
    rng = np.random.default_rng(5)
    order = rng.permutation(len(organised))
    order = order[np.isfinite(organised[order, 0])]
    layout = find_layout(organised[order], "sweep")
    assert (layout.order, layout.channels, layout.column) == ("list of returns", CHANNELS, None)
    np.testing.assert_array_equal(layout.channel, RANK[order % CHANNELS])


@pytest.mark.slow
def test_offset_of_optics_does_not_merge_dense_rings() -> None:
    """Rings 0.125 degrees apart, with optics 60 mm off the axis, which smears the elevation of near points by 0.2."""
    sensor = CATALOGUE["Pandar128"]
    points = sweep_of(Truth(axis_distance_m=0.06), sensor)
    layout = find_rings(points[np.isfinite(points[:, 0])], "sweep")
    assert layout.channels == sensor.channels
    assert not (layout.channel < 0).any()


@pytest.mark.slow
def test_rings_of_beams_off_the_axis() -> None:
    """A list of returns near a sensor whose frame begins 36 mm below its optics, without and with the rings."""
    points, channel = ouster_sweep()
    returned = np.isfinite(points[:, 0])
    points, channel = points[returned], channel[returned]
    for ring in (None, channel):
        layout = find_layout(points, "sweep", ring)
        assert (layout.order, layout.channels, layout.has_file_rings) == ("list of returns", 40, ring is not None)
        expected = 39 - channel if ring is None else channel  # found rings ascend
        np.testing.assert_array_equal(layout.channel, expected)


@pytest.mark.slow
def test_list_sorted_by_ring_is_not_organised() -> None:
    """Its rows of equal length are of one elevation each, as in an organised sweep with more channels."""
    points, channel = ouster_sweep()
    order = np.argsort(channel, kind="stable")
    points = points[order][np.isfinite(points[order, 0])][:19_000]
    layout = find_layout(points, "sweep")
    assert (layout.order, layout.column) == ("list of returns", None)


@pytest.mark.parametrize("order", ["channel fastest", "column fastest"])
def test_rings_of_the_file_keep_columns(organised: FloatArray, order: str) -> None:
    ring, points = np.tile(np.arange(CHANNELS), AZIMUTHS) + 3, organised
    if order == "column fastest":
        ring = ring.reshape(AZIMUTHS, CHANNELS).T.ravel()
        points = organised.reshape(AZIMUTHS, CHANNELS, 3).transpose(1, 0, 2).reshape(-1, 3)
    layout = find_layout(points, "sweep", ring)
    assert (layout.order, layout.channels, layout.note) == (order, CHANNELS, "")
    np.testing.assert_array_equal(layout.channel, ring - 3)
    assert layout.column is not None
    assert int(layout.column.max()) == AZIMUTHS - 1


@pytest.mark.slow
def test_ring_field_without_rings_is_not_used(organised: FloatArray) -> None:
    zeros = np.zeros(len(organised), dtype=np.int64)
    layout = find_layout(organised, "sweep", zeros)
    assert (layout.channels, layout.has_file_rings) == (CHANNELS, False)
    assert layout.note == "The field ring has 1 values, so rings are found from the points."
    mixed = np.random.default_rng(0).integers(0, CHANNELS, len(organised))
    layout = find_layout(organised, "sweep", mixed)
    assert (layout.channels, layout.has_file_rings) == (CHANNELS, False)
    assert "of the returns are on no ring" in layout.note


def test_ring_with_few_returns_is_counted() -> None:
    points, channel = ouster_sweep()
    few = np.flatnonzero(np.isfinite(points[:, 0]) & (channel == 7))[:5]
    used = np.isfinite(points[:, 0]) & (channel != 7)
    used[few] = True
    layout = find_layout(points[used], "sweep", channel[used])
    assert (layout.channels, layout.silent) == (39, 1)
    assert set(layout.channel[channel[used] == 7]) == {-1}


@pytest.mark.slow
def test_rejects_cloud_without_rings() -> None:
    points = np.random.default_rng(0).normal(size=(20_000, 3)) * (20.0, 20.0, 5.0)
    with pytest.raises(InputError, match="rings"):
        find_layout(points, "cloud.pcd")


def test_cone_of_hand_made_points() -> None:
    """tan(e) = -0.2, z0 = 15 mm, heights rounded to a millimetre; one point in ten is on another surface."""
    radius_m = np.linspace(3.0, 60.0, 500)
    height_m = np.round(0.015 - 0.2 * radius_m, 3)
    height_m[::10] += 0.5
    tangent, offset_m, covariance = fit_cone(radius_m, height_m)
    assert abs(tangent + 0.2) < 4 * np.sqrt(covariance[0, 0]) < 1e-4
    assert abs(offset_m - 0.015) < 4 * np.sqrt(covariance[1, 1]) < 1e-3


def test_standard_errors_of_cone() -> None:
    """Over 300 samples, the deviations in units of the standard errors have a standard deviation of 1."""
    rng = np.random.default_rng(1)
    radius_m = rng.uniform(4.0, 40.0, 300)
    deviations = []
    for _ in range(300):
        height_m = 0.01 + radius_m * (0.3 + 1e-4 * rng.standard_normal(300))
        tangent, offset_m, covariance = fit_cone(radius_m, height_m)
        deviations.append(((tangent - 0.3) / np.sqrt(covariance[0, 0]), (offset_m - 0.01) / np.sqrt(covariance[1, 1])))
    assert np.std(deviations, axis=0) == pytest.approx([1.0, 1.0], abs=0.13)


def test_offset_is_undetermined_at_one_range() -> None:
    """All returns at 10 m: the prior of the offset shows in both standard errors."""
    rng = np.random.default_rng(2)
    height_m = 1.0 + 1e-4 * rng.standard_normal(200)
    tangent, offset_m, covariance = fit_cone(np.full(200, 10.0), height_m)
    assert offset_m == pytest.approx(0.0, abs=1e-6)
    assert tangent == pytest.approx(0.1, abs=1e-5)
    assert np.sqrt(covariance[1, 1]) == pytest.approx(0.05, rel=0.05)


def test_nearest_ring_of_all_rings() -> None:
    """Against the smallest of the distances to all cones."""
    rng = np.random.default_rng(3)
    tangent = np.sort(rng.uniform(-0.4, 0.2, 20))
    offset_m = rng.uniform(-0.01, 0.01, 20)
    radius_m = rng.uniform(10.0, 50.0, 500)
    height_m = radius_m * rng.uniform(-0.4, 0.2, 500)
    ring, angle_deg = nearest_ring(radius_m, height_m, tangent, offset_m)
    miss = np.abs(height_m[:, None] - radius_m[:, None] * tangent - offset_m) / (1 + tangent**2) / radius_m[:, None]
    np.testing.assert_array_equal(ring, miss.argmin(axis=1))
    np.testing.assert_allclose(angle_deg, np.degrees(miss.min(axis=1)))
