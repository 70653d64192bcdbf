"""Sine and cosine of degrees are those of scipy, bit for bit, and need no import of it."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import scipy.special

from egvs.core import special

FUNCTIONS = ("cosdg", "sindg")


def angles_deg() -> Any:
    """Angles of sensors and vehicles, exact multiples of 45 degrees and their neighbours, huge and tiny ones."""
    rng = np.random.default_rng(5)
    eighths = 45.0 * np.arange(-40, 41)
    return np.concatenate(
        [
            rng.uniform(-720.0, 720.0, 20_000),
            rng.uniform(-720.0, 720.0, 20_000).round(1),
            rng.uniform(-1e6, 1e6, 5_000),
            10.0 ** rng.uniform(-300.0, 13.9, 5_000),
            eighths,
            np.nextafter(eighths, np.inf),
            np.nextafter(eighths, -np.inf),
            [0.0, -0.0, np.nan],
        ]
    )


@pytest.mark.parametrize("name", FUNCTIONS)
def test_array_is_that_of_scipy_bit_for_bit(name: str) -> None:
    angles = angles_deg()
    values = getattr(special, name)(angles)
    assert values.tobytes() == getattr(scipy.special, name)(angles).tobytes()
    assert getattr(special, name)(angles[:60].reshape(3, 4, 5)).tobytes() == values[:60].tobytes()


@pytest.mark.parametrize("name", FUNCTIONS)
def test_number_is_that_of_scipy_bit_for_bit(name: str) -> None:
    angles = angles_deg()[::7]
    values = np.array([getattr(special, name)(angle) for angle in angles.tolist()])
    assert values.tobytes() == getattr(scipy.special, name)(angles).tobytes()
    assert isinstance(getattr(special, name)(3), np.float64)


@pytest.mark.parametrize("angle_deg", [1.1e14, -1e15, np.inf])
def test_huge_angle_gives_zero(angle_deg: float) -> None:
    for name in FUNCTIONS:
        assert getattr(special, name)(angle_deg) == 0.0
        assert (getattr(special, name)(np.array([angle_deg, angle_deg])) == 0.0).all()


@pytest.mark.system
def test_sine_and_cosine_do_not_import_scipy() -> None:
    code = "import sys; from egvs.core.special import cosdg; assert cosdg(60.0); print('scipy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True).stdout.strip() == b"False"
