"""Recorded positions against the lanes of a small network: shares and shifts that a person can check."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egvs.core.grid import Roi
from egvs.traffic import lane_alignment
from egvs.traffic.network import Network
from tests.scoring.roads import read


@pytest.fixture
def roads(tmp_path: Path) -> Network:
    return read(tmp_path)


def positions() -> np.ndarray:
    """Return positions on the eastbound lane (y = -4.8) and on the northbound road (x = 35)."""
    east = np.column_stack([np.arange(36.0, 120.0), np.full(84, -4.8)])
    north = np.column_stack([np.full(75, 35.0), np.arange(4.0, 79.0)])
    return np.concatenate([east, north])


def test_positions_on_lanes(roads: Network) -> None:
    alignment = lane_alignment.align(positions(), roads)
    assert alignment is not None
    assert alignment.share == 1.0
    assert not alignment.fits_better
    assert list(alignment.warnings("tracks")) == []


def test_position_beside_a_lane_does_not_count(roads: Network) -> None:
    """Half of a lane is 1.6 m: 1.5 m beside the centre line is on the lane, 1.8 m is not."""
    inside, outside = (np.column_stack([np.arange(40.0, 100.0), np.full(60, -4.8 - off_m)]) for off_m in (1.5, 1.8))
    shares = [lane_alignment.align(xy_m, roads) for xy_m in (inside, outside)]
    assert [alignment.share if alignment else None for alignment in shares] == [1.0, 0.0]


@pytest.mark.parametrize("shift_m", [(3.0, -2.0), (-4.0, 5.0)])
def test_estimates_shift(roads: Network, shift_m: tuple[float, float]) -> None:
    alignment = lane_alignment.align(positions() - shift_m, roads)
    assert alignment is not None
    np.testing.assert_allclose(alignment.shift_m, shift_m, atol=0.3)
    assert alignment.fitted_share > 0.95 > alignment.share
    (warning,) = alignment.warnings("tracks")
    assert "moved by" in str(warning)


def test_estimates_rotation(roads: Network) -> None:
    """Turned clockwise by 4 degrees about their middle, they must turn counter-clockwise by 4."""
    xy_m = positions()
    middle_m = xy_m.mean(axis=0)
    angle_rad = np.deg2rad(-4.0)
    turn = np.array([[np.cos(angle_rad), np.sin(angle_rad)], [-np.sin(angle_rad), np.cos(angle_rad)]])
    alignment = lane_alignment.align((xy_m - middle_m) @ turn + middle_m, roads)
    assert alignment is not None
    assert alignment.rotation_deg == pytest.approx(4.0, abs=0.3)
    assert alignment.fitted_share > 0.95


def test_without_positions_there_is_no_alignment(roads: Network) -> None:
    assert lane_alignment.align(np.empty((0, 2)), roads) is None


def test_lane_points_in_a_region(roads: Network) -> None:
    """Between x = 50 and 60 m lie 10 m of the eastbound lane and 10 m of the westbound one: 20 points each."""
    points_m = lane_alignment.lane_points(roads, Roi((50.0, -10.0, 0.0), (10.0, 20.0, 5.0)))
    assert sorted(set(points_m[:, 1].tolist())) == [-4.8, 1.6]
    assert len(points_m) == pytest.approx(40, abs=2)
