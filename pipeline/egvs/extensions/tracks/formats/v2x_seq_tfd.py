"""Read tracks of the V2X-Seq trajectory forecasting data set (Beijing).

Columns: city, timestamp, id, type, sub_type, tag, x, y, z, length, width, height, theta, v_x, v_y, intersect_id, and
further ones in cooperative files. x, y, z are the centre and theta is in radians, counter-clockwise from +x, in the
frame of the data set's maps. Times are in seconds; those beyond 1e11 are milliseconds, beyond 1e14 microseconds. See Yu
et al. 2023, arXiv 2305.05938.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from egvs.extensions.tracks import columns
from egvs.extensions.tracks.boxes import ClassNames, make_tracks
from egvs.extensions.tracks.model import TrackFrame, Tracks

REQUIRED_COLUMNS = ("timestamp", "id", "type", "sub_type", "x", "y", "theta")
_OPTIONAL = ("z", "length", "width", "height")

_CLASSES = {
    "car": "car", "van": "van", "truck": "truck", "bus": "bus", "motorcyclist": "motorcycle",
    "tricyclist": "motorcycle", "cyclist": "bicycle", "bicycle": "bicycle", "pedestrian": "pedestrian",
    "pedestrain": "pedestrian", "barrowlist": "pedestrian", "vehicle": "car",
}  # fmt: skip
_STATIC = frozenset({"trafficcone", "unknownunmovable"})


def can_open(_path: Path, head: bytes) -> bool:
    """Return whether the first line names the data set's columns."""
    return columns.has_columns(head, *REQUIRED_COLUMNS, "tag", "intersect_id")


def companions(_path: Path) -> Sequence[Path]:
    """Return no file: a file is complete."""
    return ()


def read(path: Path) -> Tracks:
    """Read a file."""
    table = columns.read_table(path, REQUIRED_COLUMNS, _OPTIONAL)
    types = ClassNames(_CLASSES, _STATIC)
    pairs = zip(table.texts("sub_type"), table.texts("type"), strict=True)
    classes = [types.convert(sub_type or kind) for sub_type, kind in pairs]
    rows = np.array([row for row, cls in enumerate(classes) if cls is not None], dtype=np.intp)
    latest = float(np.abs(table.numbers("timestamp")).max())
    values = {
        "time_s": table.times_s("timestamp", 1e-6 if latest > 1e14 else 1e-3 if latest > 1e11 else 1.0),
        "x_m": table.positions_m("x"),
        "y_m": table.positions_m("y"),
        "z_m": table.heights_m("z"),
        "yaw_rad": table.angles_rad("theta"),
        "length_m": table.sizes_m("length"),
        "width_m": table.sizes_m("width"),
        "height_m": table.sizes_m("height"),
    }
    names = table.names("id")
    sources = ["positions are in the frame of the data set's maps, whose place on Earth is unknown"]
    return make_tracks(
        path,
        [names[row] for row in rows],
        [cls for cls in classes if cls is not None],
        {key: column[rows] for key, column in values.items()},
        TrackFrame(),
        [*sources, *types.sentences()],
    )
