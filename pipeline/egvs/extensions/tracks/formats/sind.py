"""Read tracks of the SinD data set: vehicles (Veh_smoothed_tracks.csv) and pedestrians (Ped_smoothed_tracks.csv).

Columns: track_id, frame_id, timestamp_ms, agent_type, x, y, vx, vy, ax, ay; vehicles also have yaw_rad, heading_rad,
length and width. x, y are the centre; yaw_rad is the direction of the body, heading_rad that of the motion, which is
not read. Coordinates are those of the Lanelet2 map, as in INTERACTION. See Xu et al. 2022, arXiv 2209.02297.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from egvs.extensions.tracks import columns
from egvs.extensions.tracks.formats.interaction import MAP_FRAME
from egvs.extensions.tracks.model import Tracks

REQUIRED_COLUMNS = ("track_id", "timestamp_ms", "agent_type", "x", "y")
_FURTHER = ("ax", "ay")
_CLASSES = {
    "car": "car", "bus": "bus", "truck": "truck", "motorcycle": "motorcycle", "bicycle": "bicycle",
    "tricycle": "other", "pedestrian": "pedestrian",
}  # fmt: skip


def can_open(_path: Path, head: bytes) -> bool:
    """Return whether the first line names SinD's columns: INTERACTION's, and accelerations."""
    return columns.has_columns(head, *REQUIRED_COLUMNS, *_FURTHER)


def companions(_path: Path) -> Sequence[Path]:
    """Return no files."""
    return []


def read(path: Path) -> Tracks:
    """Read a file."""
    table = columns.read_table(path, REQUIRED_COLUMNS, ("yaw_rad", "length", "width"))
    values = {
        "time_s": table.times_s("timestamp_ms", 0.001),
        "x_m": table.positions_m("x"),
        "y_m": table.positions_m("y"),
        "yaw_rad": table.angles_rad("yaw_rad"),
        "length_m": table.sizes_m("length"),
        "width_m": table.sizes_m("width"),
    }
    classes = table.classes("agent_type", _CLASSES)
    sources = ["tricycles are of class other"] if "other" in classes else []
    return Tracks.from_rows(table.names("track_id"), classes, values, MAP_FRAME, sources)
