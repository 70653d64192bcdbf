"""Sine and cosine of degrees, which all positions and directions depend on, have the same bits with every scipy."""

from __future__ import annotations

import math
import subprocess
import sys
from functools import reduce

import numpy as np
import pytest

from egvs.core import special
from egvs.core.grid import FloatArray

RADIANS_PER_DEGREE = 1.74532925199432957692e-2
SINE = (
    1.58962301572218447952e-10, -2.50507477628503540135e-8, 2.75573136213856773549e-6, -1.98412698295895384658e-4,
    8.33333333332211858862e-3, -1.66666666666666307295e-1,
)  # fmt: skip
COSINE = (
    1.13678171382044553091e-11, -2.08758833757683644217e-9, 2.75573155429816611547e-7, -2.48015872936186303776e-5,
    1.38888888888806666760e-3, -4.16666666666666348141e-2, 4.99999999999999999798e-1,
)  # fmt: skip
"""Coefficients within an eighth of a turn, the highest power first (S. L. Moshier, Cephes, 1989)."""


def reference(name: str, angle_deg: float) -> float:
    """The polynomial around the nearest even multiple of 45 degrees, as Cephes has it."""
    eighths = math.floor(abs(angle_deg) / 45.0)
    eighths += eighths % 2
    rest = (abs(angle_deg) - eighths * 45.0) * RADIANS_PER_DEGREE
    square = rest * rest
    is_cosine, quarter = name == "cosdg", eighths // 2 % 4
    if is_cosine == (quarter % 2 == 0):
        value = 1.0 - square * polynomial(COSINE, square)
    else:
        value = rest + rest * (square * polynomial(SINE, square))
    is_negative = quarter in (1, 2) if is_cosine else (quarter >= 2) != (angle_deg < 0.0)
    return -value if is_negative else value


def polynomial(coefficients: tuple[float, ...], x: float) -> float:
    """Horner's rule, without fused multiplications."""
    return reduce(lambda value, coefficient: value * x + coefficient, coefficients)


def angles_deg() -> FloatArray:
    """Angles of sensors and vehicles, multiples of 45 degrees and their neighbours, huge and tiny ones."""
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
            [0.0, -0.0],
        ]
    )


@pytest.mark.parametrize("name", ["cosdg", "sindg"])
def test_values_are_those_of_cephes_bit_for_bit(name: str) -> None:
    angles = angles_deg()
    expected = np.array([reference(name, angle) for angle in angles.tolist()])
    assert getattr(special, name)(angles).tobytes() == expected.tobytes()
    numbers = np.array([getattr(special, name)(angle) for angle in angles[::50].tolist()])
    assert numbers.tobytes() == expected[::50].tobytes()


def test_values_at_quarter_turns_are_exact() -> None:
    quarters = np.arange(-400, 401)
    np.testing.assert_array_equal(special.cosdg(90.0 * quarters), np.array([1.0, 0.0, -1.0, 0.0])[quarters % 4])
    np.testing.assert_array_equal(special.sindg(90.0 * quarters), np.array([0.0, 1.0, 0.0, -1.0])[quarters % 4])


@pytest.mark.slow
@pytest.mark.system
def test_scipy_is_imported_by_the_first_call() -> None:
    code = "import sys; from egvs.core.special import cosdg; assert 'scipy' not in sys.modules; print(cosdg(0.0))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert float(done.stdout) == 1.0
