"""Read tracks of the drone data sets inD, rounD, exiD and uniD.

Files of recording NN: ``NN_tracks.csv``, with ``NN_tracksMeta.csv`` (classes) and ``NN_recordingMeta.csv`` (frame rate
and origin) beside it. xCenter, yCenter are the centre in metres, y up; heading is in degrees, counter-clockwise from
+x; frames count from 0. Pedestrians and bicycles have length and width 0. Adding xUtmOrigin, yUtmOrigin gives UTM; the
zone is that of latLocation and lonLocation. See Bock et al. 2020, arXiv 1911.07602.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from egvs.core.errors import InputError
from egvs.extensions.tracks import columns
from egvs.extensions.tracks.model import TrackFrame, Tracks
from egvs.formats.georeference import WorldFrame, utm_epsg

REQUIRED_COLUMNS = ("trackId", "frame", "xCenter", "yCenter", "heading")
_CLASSES = {
    "car": "car", "van": "van", "truck": "truck", "truck_bus": "truck", "bus": "bus", "trailer": "trailer",
    "tram": "tram", "motorcycle": "motorcycle", "bicycle": "bicycle", "pedestrian": "pedestrian",
}  # fmt: skip
_MAX_LOCATION_ERROR_M = 20_000.0
"""latLocation and lonLocation are rounded, to 0.1 degrees at worst; a neighbouring zone is further away."""


def can_open(_path: Path, head: bytes) -> bool:
    """Return whether the first line names the columns of these data sets."""
    return columns.has_columns(head, *REQUIRED_COLUMNS)


def companions(path: Path) -> Sequence[Path]:
    """Return ``NN_tracksMeta.csv`` and ``NN_recordingMeta.csv``; InputError unless both are beside the tracks."""
    return [columns.companion(path, "_tracks.csv", ending) for ending in ("_tracksMeta.csv", "_recordingMeta.csv")]


def read(path: Path) -> Tracks:
    """Read a file."""
    tracks_meta, recording_meta = companions(path)
    table = columns.read_table(path, REQUIRED_COLUMNS, ("length", "width"))
    recording = read_recording(recording_meta, ("frameRate", "latLocation", "lonLocation", "xUtmOrigin", "yUtmOrigin"))
    types = columns.read_table(tracks_meta, ("trackId", "class"))
    classes = types.classes("class", _CLASSES)
    values = {
        "time_s": table.times_s("frame", 1.0 / frame_rate_hz(recording)),
        "x_m": table.positions_m("xCenter"),
        "y_m": table.positions_m("yCenter"),
        "yaw_rad": table.angles_rad("heading", math.radians(1.0)),
        "length_m": table.sizes_m("length"),
        "width_m": table.sizes_m("width"),
    }
    names = table.names("trackId")
    row_classes = [classes[row] for row in types.rows_of(names, "trackId", path)]
    sources = ['tracks of class "truck_bus" count as trucks'] if "truck_bus" in types.texts("class") else []
    return Tracks.from_rows(names, row_classes, values, _utm_frame(recording), sources)


def read_recording(path: Path, required: Sequence[str]) -> columns.Table:
    """Return columns of ``NN_recordingMeta.csv``, which has one row."""
    table = columns.read_table(path, required)
    if table.n_rows != 1:
        raise InputError(path, f"expected one row, got {table.n_rows}", "Use the file as it was published.")
    return table


def frame_rate_hz(recording: columns.Table) -> float:
    """Return the frame rate of a recording; InputError unless it is above 0."""
    rate_hz = float(recording.numbers("frameRate")[0])
    if not 0.1 <= rate_hz <= 1000.0:
        raise recording.error(0, "frameRate", f"expected 0.1 to 1000 frames per second, got {rate_hz:g}")
    return rate_hz


def _utm_frame(recording: columns.Table) -> TrackFrame:
    """Return the UTM zone in which the origin is where latLocation and lonLocation say; InputError if none fits."""
    lat_deg, lon_deg = (float(recording.numbers(name)[0]) for name in ("latLocation", "lonLocation"))
    if not (abs(lat_deg) <= 84.0 and abs(lon_deg) <= 180.0):
        raise recording.error(0, "latLocation, lonLocation", f"expected degrees, got {lat_deg:g}, {lon_deg:g}")
    offset_m = (float(recording.positions_m("xUtmOrigin")[0]), float(recording.positions_m("yUtmOrigin")[0]))
    location_deg = np.array([[lon_deg, lat_deg]])
    distances_m: dict[str, float] = {}
    for zone_lon_deg in (lon_deg, lon_deg - 6.0, lon_deg + 6.0):  # near its edge, data may keep to the zone beside
        crs = f"EPSG:{utm_epsg(zone_lon_deg, lat_deg)}"
        distances_m.setdefault(crs, math.dist(WorldFrame(crs).from_lon_lat(location_deg)[0], offset_m))
    crs = min(distances_m, key=lambda name: distances_m[name])
    if distances_m[crs] > _MAX_LOCATION_ERROR_M:
        problem = (
            f"({offset_m[0]:.0f}, {offset_m[1]:.0f}) is {distances_m[crs] / 1000:,.0f} km from latitude {lat_deg:g}"
        )
        raise recording.error(0, "xUtmOrigin, yUtmOrigin", f"{problem}, longitude {lon_deg:g} in {crs}")
    return TrackFrame(crs, offset_m)
