"""Rows of tracks for tests."""

from __future__ import annotations

import numpy as np

from egvs.core.grid import FloatArray
from egvs.extensions.tracks.model import Tracks


def make_tracks(*rows: tuple[str, str, float, float, float], **columns: list[float]) -> Tracks:
    """Return tracks from rows (track, class, time_s, x_m, y_m), and further columns by name."""
    names, classes, time_s, x_m, y_m = zip(*rows, strict=True)
    values: dict[str, FloatArray] = {"time_s": np.array(time_s), "x_m": np.array(x_m), "y_m": np.array(y_m)}
    values |= {name: np.array(column, dtype=np.float64) for name, column in columns.items()}
    return Tracks.from_rows(names, classes, values)


def straight(
    name: str, track_class: str, times_s: list[float], speed_m_s: float, y_m: float = 0.0
) -> list[tuple[str, str, float, float, float]]:
    """Return rows of a road user that moves along +x, at x = speed * time."""
    return [(name, track_class, time_s, speed_m_s * time_s, y_m) for time_s in times_s]
