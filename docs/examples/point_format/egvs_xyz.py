"""Point clouds as plain text (.xyz): a line with x, y and z for each return, metres in the world frame."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from egvs.core.errors import InputError


def read(path: Path, where: str) -> NDArray[np.float64]:
    """Return all points, shape (n, 3)."""
    try:
        points = np.loadtxt(path, ndmin=2)
    except ValueError as error:
        raise InputError(where, f"cannot be read ({error})", "Write three numbers per line.") from None
    if points.shape[1] != 3:
        raise InputError(where, f"expected 3 numbers per line, got {points.shape[1]}", "Write x, y and z.")
    return points


def write(path: Path, points_m: NDArray[np.float64]) -> None:
    """Write points (n, 3) with enough digits to read the same numbers back."""
    np.savetxt(path, points_m, fmt="%.17g")
