"""The rate of rotation from times of points, and from times of sweeps.

Evidence: times computed from a known rate.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from egvs.core.grid import FloatArray
from egvs.extensions.hardware.fit.rotation import fit_rotation, rotation_of_stamps
from egvs.formats.recordings import Recording
from egvs.formats.sweep_files import Sweep
from tests.extensions.hardware.fit.small_sensor import TRUTH, coarse_sensor, small_fit, sweep_of

AZIMUTHS, CHANNELS = 300, 10


def sweep(rate_hz: float, seed: int = 0, unevenness: float = 0.0) -> Sweep:
    """A sweep of a sensor that fires at constant angles, so that times tell its speed.

    Channels fire 1 microsecond apart in the simulated azimuth order; a clockwise sensor visits the columns backwards.
    """
    column = np.arange(AZIMUTHS)
    turned = column if rate_hz > 0 else AZIMUTHS - 1 - column
    share = turned / AZIMUTHS
    share = share + unevenness * np.sin(2 * np.pi * share) / (2 * np.pi)
    times = np.repeat(share / abs(rate_hz), CHANNELS)
    return Sweep("one", sweep_of(TRUTH, coarse_sensor(), seed), time_s=times)


@pytest.mark.parametrize("rate_hz", [10.0, -10.0, 20.0, -5.0])
def test_rate_and_direction_from_points(rate_hz: float) -> None:
    rotation = fit_rotation([sweep(rate_hz)], small_fit().angles)
    assert rotation is not None
    assert rotation.rate_hz == pytest.approx(rate_hz, abs=1e-3)
    assert rotation.source == "times of points"
    assert rotation.firing_interval_s == pytest.approx(1 / abs(rate_hz) / AZIMUTHS, rel=1e-6)
    assert rotation.step_deg == pytest.approx(360 / AZIMUTHS, rel=1e-4)


def test_standard_error_of_several_sweeps() -> None:
    """Three turns at 9.9, 10.0 and 10.1: mean 10.0, standard error 0.1 / sqrt(3)."""
    rotation = fit_rotation([sweep(rate, seed) for seed, rate in enumerate((9.9, 10.0, 10.1))], small_fit().angles)
    assert rotation is not None
    assert rotation.rate_hz == pytest.approx(10.0, abs=1e-3)
    assert rotation.rate_se_hz == pytest.approx(0.1 / np.sqrt(3), rel=0.02)
    assert rotation.sweeps == 3


def test_standard_error_covers_uneven_turn() -> None:
    """A speed that varies by 0.2 % within the turn moves the fitted rate; the standard error says by how much."""
    even, uneven = (fit_rotation([sweep(10.0, unevenness=u)], small_fit().angles) for u in (0.0, 0.002))
    assert even is not None and uneven is not None
    assert even.rate_se_hz < 1e-4
    assert 0.2 * abs(uneven.rate_hz - 10.0) < uneven.rate_se_hz < abs(uneven.rate_hz - 10.0)


def test_times_of_other_events_are_not_used() -> None:
    timed = sweep(10.0)
    assert timed.time_s is not None
    shuffled = replace(timed, time_s=np.random.default_rng(0).permutation(timed.time_s))
    assert fit_rotation([shuffled], small_fit().angles) is None
    assert fit_rotation([replace(timed, time_s=None)], small_fit().angles) is None


def test_rate_from_stamps() -> None:
    """12.5 turns per second, jitter of 1 ms; turns 20 to 30 are missing."""
    stamps = 1e9 + np.delete(np.arange(200.0), np.arange(20, 30)) / 12.5
    rates = []
    for seed in range(20):
        noisy: FloatArray = stamps + np.random.default_rng(seed).normal(0.0, 0.001, len(stamps))
        rotation = rotation_of_stamps(noisy)
        assert rotation is not None and rotation.source == "times of sweeps"
        rates.append((rotation.rate_hz - 12.5) / rotation.rate_se_hz)
    assert 0.6 < np.sqrt(np.mean(np.square(rates))) < 1.6


def test_stamps_of_no_turns() -> None:
    assert rotation_of_stamps(np.arange(4) * 0.1) is None  # too few
    assert rotation_of_stamps(np.arange(50) * 60.0) is None  # a sweep per minute
    assert rotation_of_stamps(np.sort(np.random.default_rng(0).uniform(0, 20, 200))) is None  # at random


def test_stamps_serve_where_points_have_no_times() -> None:
    recording = Recording("run.bag", "topic /points, frame lidar", 50, 5.0 + 0.1 * np.arange(50))
    untimed = replace(sweep(10.0), time_s=None, recording=recording)
    rotation = fit_rotation([untimed], small_fit().angles)
    assert rotation is not None
    assert (rotation.source, rotation.sweeps, rotation.step_deg) == ("times of sweeps", 50, None)
    assert rotation.rate_hz == pytest.approx(10.0, rel=1e-9)
