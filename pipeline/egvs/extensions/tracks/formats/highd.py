"""Read tracks of the highD data set: ``NN_tracks.csv``.

``NN_tracksMeta.csv`` and ``NN_recordingMeta.csv`` must be beside it. x, y are the upper left corner of the box in the
image, in metres, y down; width is the extent along the road, which is the vehicle's length, and height the one across,
its width. drivingDirection is 1 towards -x and 2 towards +x; frames count from 1. :func:`read` turns y up. The data set
has no georeference. See Krajewski et al. 2018, arXiv 1810.05642.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from egvs.extensions.tracks import columns
from egvs.extensions.tracks.formats import levelx
from egvs.extensions.tracks.model import TrackFrame, Tracks

REQUIRED_COLUMNS = ("frame", "id", "x", "y", "width", "height")
_CLASSES = {"car": "car", "truck": "truck"}
_YAW_RAD = {1.0: math.pi, 2.0: 0.0}


def can_open(_path: Path, head: bytes) -> bool:
    """Return whether the first line names highD's columns."""
    return columns.has_columns(head, *REQUIRED_COLUMNS, "xVelocity", "laneId")


def companions(path: Path) -> Sequence[Path]:
    """Return ``NN_tracksMeta.csv`` and ``NN_recordingMeta.csv``; InputError unless both are beside the tracks."""
    return levelx.companions(path)


def read(path: Path) -> Tracks:
    """Read a file."""
    tracks_meta, recording_meta = companions(path)
    table = columns.read_table(path, REQUIRED_COLUMNS)
    rate_hz = levelx.frame_rate_hz(levelx.read_recording(recording_meta, ("frameRate",)))
    vehicles = columns.read_table(tracks_meta, ("id", "class", "drivingDirection"))
    classes, direction = vehicles.classes("class", _CLASSES), vehicles.numbers("drivingDirection")
    for row in np.flatnonzero(~np.isin(direction, list(_YAW_RAD))):
        raise vehicles.error(int(row), "drivingDirection", f"expected 1 or 2, got {direction[row]:g}")
    length_m, width_m = table.sizes_m("width"), table.sizes_m("height")
    for name, size_m in (("width", length_m), ("height", width_m)):
        for row in np.flatnonzero(np.isnan(size_m)):
            raise table.error(int(row), name, "expected a size above 0 m, got none")
    names = table.names("id")
    vehicle = vehicles.rows_of(names, "id", path)
    values = {
        "time_s": table.times_s("frame", 1.0 / rate_hz) - 1.0 / rate_hz,
        "x_m": table.positions_m("x") + length_m / 2.0,
        "y_m": -(table.positions_m("y") + width_m / 2.0),
        "yaw_rad": np.where(direction == 1.0, _YAW_RAD[1.0], _YAW_RAD[2.0])[vehicle],
        "length_m": length_m,
        "width_m": width_m,
    }
    sources = ["positions are those in the image: x along the road, without a place on the Earth"]
    return Tracks.from_rows(names, [classes[row] for row in vehicle], values, TrackFrame(), sources)
