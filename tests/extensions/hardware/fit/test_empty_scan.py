"""The background is the farthest range that persists; what is in front of it is traffic.

Evidence: hand-made stacks of single pulses; a plain loop.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from egvs.extensions.hardware.fit.empty_scan import BACKGROUND, TRAFFIC, UNKNOWN, fit_empty_scan, tolerance_m

NAN = math.nan


@pytest.mark.parametrize(
    ("ranges", "background"),
    [
        ((20.0, 20.05, 20.1, 20.0, 20.0), 20.0),
        ((20.0, 9.0, 20.0, 9.1, 20.02), 20.0),  # a vehicle in two of five sweeps
        ((9.0, 9.0, 9.05, 20.0, 9.1), 9.025),  # one return farther away does not persist
        ((9.0, 9.0, 9.0, 20.0, 20.0, 20.0), 20.0),  # both persist: the farther one
        ((20.0, NAN, NAN, 20.1, NAN), NAN),  # two returns are too few
        ((20.0, NAN, 20.1, 20.1, NAN), 20.1),
        ((10.0, 10.2, 10.4, 10.6, 10.8), NAN),  # leaves: no three within 20 cm
        ((NAN,) * 5, NAN),
    ],
)
def test_background(ranges: tuple[float, ...], background: float) -> None:
    fit = fit_empty_scan([np.array([[r]]) for r in ranges])
    assert fit.range_m[0, 0] == pytest.approx(background, abs=0.051, nan_ok=True)


def test_labels() -> None:
    ranges = (20.0, 9.0, 20.1, 20.05, 30.0, 19.9, NAN)
    fit = fit_empty_scan([np.array([[r, NAN if i else 50.0]]) for i, r in enumerate(ranges)])
    assert fit.labels[:6, 0, 0].tolist() == [BACKGROUND, TRAFFIC, BACKGROUND, BACKGROUND, BACKGROUND, BACKGROUND]
    assert fit.labels[0, 0, 1] == UNKNOWN
    assert fit.counts == (5, 1, 1)


def test_more_sweeps_need_more_returns() -> None:
    """A fifth of 20 sweeps are 4."""
    ranges = [NAN] * 17 + [12.0] * 3
    assert np.isnan(fit_empty_scan([np.array([[r]]) for r in ranges]).range_m[0, 0])
    assert fit_empty_scan([np.array([[r]]) for r in [*ranges[1:], 12.0]]).range_m[0, 0] == 12.0


def test_background_of_plain_loop() -> None:
    rng = np.random.default_rng(0)
    stack = rng.choice([10.0, 20.0, 30.0, NAN], (7, 3, 40)) + rng.uniform(-0.1, 0.1, (7, 3, 40))
    fit = fit_empty_scan(list(stack))
    for channel in range(3):
        for column in range(40):
            ranges = sorted(r for r in stack[:, channel, column] if not math.isnan(r))
            expected = NAN
            for nearest in range(len(ranges) - 2):
                three = ranges[nearest : nearest + 3]
                if three[2] - three[0] <= tolerance_m(np.array(three[2])):
                    expected = three[1]
            assert fit.range_m[channel, column] == pytest.approx(expected, nan_ok=True)
