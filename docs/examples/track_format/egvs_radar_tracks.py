"""Tracks of a radar: CSV with stamp_ms, track, kind, x_cm, y_cm of the centre in UTM zone 32 minus 500 km, 5600 km."""

import math
from collections.abc import Sequence
from pathlib import Path

from egvs.extensions.tracks import columns
from egvs.extensions.tracks.model import TrackFrame, Tracks

COLUMNS = ("stamp_ms", "track", "kind", "x_cm", "y_cm")
CLASSES = {"pkw": "car", "lkw": "truck"}  # texts in lower case


def companions(path: Path) -> Sequence[Path]:
    return []


def read(path: Path) -> Tracks:
    table = columns.read_table(path, COLUMNS, ("azimuth_deg", "length_cm"))
    values = {
        "time_s": table.times_s("stamp_ms", 0.001),
        "x_m": table.positions_m("x_cm", 0.01),
        "y_m": table.positions_m("y_cm", 0.01),
        "yaw_rad": math.pi / 2 - table.angles_rad("azimuth_deg", math.radians(1)),
        "length_m": table.sizes_m("length_cm", 0.01),
    }
    frame = TrackFrame("EPSG:25832", (500_000.0, 5_600_000.0))
    return Tracks.from_rows(table.names("track"), table.classes("kind", CLASSES), values, frame)
