"""Stations, lengths and points of lines, by hand: 3-4-5 triangles, and heights that do not count."""

from __future__ import annotations

import numpy as np
import pytest
from shapely import LineString

from egvs.core import polylines

CORNER_M = np.array([[1.0, 2.0, 0.0], [4.0, 6.0, 10.0], [4.0, 8.0, 30.0]])


def test_a_corner_by_hand() -> None:
    np.testing.assert_array_equal(polylines.stations_m(CORNER_M), [0.0, 5.0, 7.0])
    assert polylines.length_m(CORNER_M) == 7.0
    np.testing.assert_allclose(polylines.points_at(CORNER_M, [2.5, 6.0]), [[2.5, 4.0, 5.0], [4.0, 7.0, 20.0]])


def test_points_beyond_the_ends_are_the_ends() -> None:
    np.testing.assert_array_equal(polylines.points_at(CORNER_M, [-1.0, 7.5]), CORNER_M[[0, -1]])


def test_one_station_gives_one_point() -> None:
    np.testing.assert_allclose(polylines.points_at(CORNER_M, 5.0), [CORNER_M[1]])


@pytest.mark.parametrize("seed", range(5))
def test_the_same_as_shapely_in_plan(seed: int) -> None:
    line_m = np.random.default_rng(seed).uniform(-50.0, 50.0, (12, 2))
    line = LineString(line_m)
    at_m = np.linspace(0.0, line.length, 33)
    assert polylines.length_m(line_m) == pytest.approx(line.length)
    expected = [line.interpolate(station_m).coords[0] for station_m in at_m]
    np.testing.assert_allclose(polylines.points_at(line_m, at_m), expected, atol=1e-9)
