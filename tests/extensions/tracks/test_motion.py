"""Directions of motion: hand-checked turns, standing, noise, and a circle with known tangents."""

from __future__ import annotations

import math

import numpy as np

from egvs.core.grid import FloatArray
from egvs.extensions.tracks.motion import motion_yaw_rad


def yaw_of(xy: FloatArray, step_m: float = 1.0) -> FloatArray:
    n = len(xy)
    return motion_yaw_rad(np.zeros(n, dtype=np.int64), np.arange(n) * 0.1, xy[:, 0], xy[:, 1], step_m)


def test_a_corner_by_hand() -> None:
    """East, then north: at the corner half-way, as the positions before and after it are north-east of each other."""
    xy = np.array([[0, 0], [2, 0], [4, 0], [4, 2], [4, 4]], dtype=np.float64)
    assert np.allclose(np.degrees(yaw_of(xy)), [0, 0, 45, 90, 90])


def test_standing_keeps_the_direction_and_noise_does_not_turn_it() -> None:
    rng = np.random.default_rng(1)
    moving = np.column_stack([np.zeros(20), -np.arange(20.0)])
    standing = moving[-1] + rng.uniform(-0.1, 0.1, (200, 2))
    assert np.allclose(yaw_of(np.vstack([moving, standing])), -math.pi / 2, atol=0.01)


def test_tracks_that_never_move_have_no_direction() -> None:
    xy = np.random.default_rng(2).uniform(-0.2, 0.2, (50, 2))
    assert np.isnan(yaw_of(xy)).all()


def test_circle_and_order_of_rows() -> None:
    """Two vehicles round the same circle in opposite directions, rows mixed; tangents are known."""
    turn = np.concatenate([np.arange(100) * 0.05, -np.arange(100) * 0.05])
    track, time_s = np.repeat([0, 1], 100), np.tile(np.arange(100) * 0.1, 2)
    expected = turn + np.repeat([math.pi / 2, -math.pi / 2], 100)
    order = np.random.default_rng(3).permutation(200)
    actual = motion_yaw_rad(track[order], time_s[order], 20 * np.cos(turn[order]), 20 * np.sin(turn[order]), 2.0)
    error = actual - expected[order]
    inside = (time_s[order] > 0.3) & (time_s[order] < 9.6)
    assert np.abs(np.arctan2(np.sin(error), np.cos(error)))[inside].max() < 0.01
