"""Read NGSIM vehicle trajectories (US-101, I-80, Lankershim, Peachtree) as CSV with a header row.

Columns: Vehicle_ID, Global_Time (ms), Local_X, Local_Y, v_Length, v_Width (feet) and v_Class (1 motorcycle, 2 car, 3
truck or bus), in the file with several sites also Location. Local_X points to the right of the direction of travel,
Local_Y along it. Positions are those of the middle of the front; the centre of the box is half a length behind it
along the motion, or along +y for vehicles that never move. Ids are used again after some time. See the data dictionary
of the data set, US Department of Transportation, https://doi.org/10.21949/1504477.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.wording import number_of
from egvs.extensions.tracks import columns
from egvs.extensions.tracks.model import TrackFrame, Tracks
from egvs.extensions.tracks.motion import motion_yaw_rad

FOOT_M = 0.3048
REQUIRED_COLUMNS = ("Vehicle_ID", "Global_Time", "Local_X", "Local_Y", "v_Length", "v_Width", "v_Class")
_CLASSES = {"1": "motorcycle", "2": "car", "3": "truck"}
_REUSED_AFTER_S = 10.0
_MOTION_STEP_M = 2.0


def can_open(_path: Path, head: bytes) -> bool:
    """Return whether the first line names NGSIM's columns."""
    return columns.has_columns(head, *REQUIRED_COLUMNS)


def companions(_path: Path) -> Sequence[Path]:
    """Return no files."""
    return []


def read(path: Path) -> Tracks:
    """Read a file."""
    table = columns.read_table(path, REQUIRED_COLUMNS, ("Location",))
    if len(locations := sorted(set(table.columns.get("Location", ())))) > 1:
        problem = f"expected one location, got {', '.join(locations)[:200]}"
        raise InputError(f"{path}: Location", problem, "Keep only the rows of one.")
    time_s = table.times_s("Global_Time", 0.001)
    x_m, y_m = table.positions_m("Local_X", FOOT_M), table.positions_m("Local_Y", FOOT_M)
    length_m = table.sizes_m("v_Length", FOOT_M)
    for row in np.flatnonzero(np.isnan(length_m)):
        raise table.error(int(row), "v_Length", "expected a length above 0 ft, from the front to the centre, got none")
    names, n_reused = _split_reused(table.names("Vehicle_ID"), time_s)
    track = np.unique(names, return_inverse=True)[1].astype(np.int64)
    yaw_rad = motion_yaw_rad(track, time_s, x_m, y_m, _MOTION_STEP_M)
    n_still = np.unique(track[np.isnan(yaw_rad)]).size
    yaw_rad = np.where(np.isnan(yaw_rad), math.pi / 2.0, yaw_rad)
    values = {
        "time_s": time_s,
        "x_m": x_m - length_m / 2.0 * np.cos(yaw_rad),
        "y_m": y_m - length_m / 2.0 * np.sin(yaw_rad),
        "length_m": length_m,
        "width_m": table.sizes_m("v_Width", FOOT_M),
    }
    sources = ["positions are local: y along the road, without a place on the Earth",
               "centres are half a length behind the recorded fronts, along the motion",
               f"{n_reused} vehicles have an id that an earlier one had",
               f"{number_of(n_still, 'vehicle')} without movement: taken to head along +y"]  # fmt: skip
    return Tracks.from_rows(names, table.classes("v_Class", _CLASSES), values, TrackFrame(), sources)


def _split_reused(ids: Sequence[str], time_s: FloatArray) -> tuple[list[str], int]:
    """Return names of vehicles, "7" and then "7-2" where the id returns after a time, and how many such there are."""
    number = np.unique(np.asarray(ids, dtype=object).astype(str), return_inverse=True)[1]
    order = np.lexsort((time_s, number))
    is_same = np.diff(number[order], prepend=-1) == 0
    returns = is_same & (np.diff(time_s[order], prepend=-np.inf) > _REUSED_AFTER_S)
    names, count = list(ids), 1
    for row, same, later in zip(order.tolist(), is_same.tolist(), returns.tolist(), strict=True):
        count = count + later if same else 1
        if count > 1:
            names[row] = f"{ids[row]}-{count}"
    return names, int(np.count_nonzero(returns))
