"""Write boxes of road users in formats of recorded tracks, one function per format, for round trips in tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from egvs.core.grid import FloatArray


@dataclass(frozen=True)
class TrackRows:
    """Boxes of road users, one per row, sorted by time; arrays have shape (n,), float64.

    Attributes
    ----------
    time_s
        Time.
    name, cls
        Name of the track, and class, of ``egvs.tracks.model.CLASSES``, of each row.
    x_m, y_m, z_m
        Centre of the box, in the coordinates of the format; z NaN if unknown.
    yaw_rad
        Direction of the front, counter-clockwise from +x.
    length_m, width_m, height_m
        Size; NaN if unknown.
    """

    time_s: FloatArray
    name: Sequence[str]
    cls: Sequence[str]
    x_m: FloatArray
    y_m: FloatArray
    z_m: FloatArray
    yaw_rad: FloatArray
    length_m: FloatArray
    width_m: FloatArray
    height_m: FloatArray
