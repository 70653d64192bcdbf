"""Read tracks of Argoverse 2: scenarios of motion forecasting (Parquet) and annotations of the sensor data (Feather).

A scenario has the columns track_id, object_type, timestep (0.1 s), position_x, position_y and heading in the frame of
the city, start_timestamp in nanoseconds and city; no sizes and heights.

``annotations.feather`` has boxes in the frame of the recording vehicle: timestamp_ns, track_uuid, category, length_m,
width_m, height_m, the quaternion qw, qx, qy, qz (scalar first) and the centre tx_m, ty_m, tz_m. The poses of the
vehicle in the city, ``city_SE3_egovehicle.feather`` beside it, are joined by their time.

The frame of a city is its UTM zone minus an origin. For annotations, the name of the city is in the name of the map:
``map/log_map_archive_LOG____PIT_city_57819.json``. See Wilson et al. 2023, arXiv 2301.00493, and
``av2/geometry/utm.py`` of the development kit.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.tracks.boxes import ClassNames, make_tracks, to_rotations, yaw_of
from egvs.extensions.tracks.formats.arrow_tables import ArrowTable, column_names
from egvs.extensions.tracks.model import TrackFrame, Tracks
from egvs.scenario.fields import MAX_COORDINATE_M

_STEP_S = 0.1
_POSES_FILE = "city_SE3_egovehicle.feather"

_SCENARIO = ("position_x", "position_y", "heading", "timestep")
_QUATERNION = ("qx", "qy", "qz", "qw")
_TRANSLATION = ("tx_m", "ty_m", "tz_m")
_SIZE = ("length_m", "width_m", "height_m")

CITY_ORIGINS = {
    "austin": ("ATX", 14, (621150.027481, 3349889.999565)),
    "dearborn": ("DTW", 17, (320669.934646, 4685369.998813)),
    "miami": ("MIA", 17, (580560.008787, 2850959.999889)),
    "palo-alto": ("PAO", 10, (576480.000592, 4141379.935333)),
    "pittsburgh": ("PIT", 17, (583710.007032, 4477259.999833)),
    "washington-dc": ("WDC", 18, (323459.999693, 4306469.987039)),
}
"""Code, UTM zone (north), and easting and northing of the origin of each city."""

_CLASSES = {
    "vehicle": "car", "regularvehicle": "car", "egovehicle": "car", "largevehicle": "truck", "boxtruck": "truck",
    "truck": "truck", "truckcab": "truck", "vehiculartrailer": "trailer", "bus": "bus", "schoolbus": "bus",
    "articulatedbus": "bus", "railedvehicle": "tram", "motorcycle": "motorcycle", "motorcyclist": "motorcycle",
    "bicycle": "bicycle", "bicyclist": "bicycle", "cyclist": "bicycle", "riderlessbicycle": "bicycle",
    "pedestrian": "pedestrian", "officialsignaler": "pedestrian", "wheelchair": "pedestrian",
    "stroller": "pedestrian", "wheeleddevice": "other", "wheeledrider": "other", "dog": "other", "animal": "other",
    "unknown": "other",
}  # fmt: skip
_STATIC = frozenset({
    "static", "background", "construction", "constructioncone", "constructionbarrel", "bollard", "sign", "stopsign",
    "trafficlighttrailer", "messageboardtrailer", "mobilepedestriancrossingsign", "mobilepedestriansign",
})  # fmt: skip


def can_open(path: Path, head: bytes) -> bool:
    """Return whether a Parquet or Feather file has the columns of a scenario or of annotations."""
    columns = column_names(path, head)
    return columns >= {"object_type", *_SCENARIO} or columns >= {"category", *_QUATERNION, *_TRANSLATION}


def companions(path: Path) -> Sequence[Path]:
    """Return the poses of the vehicle and the map beside annotations; no file for a scenario."""
    if path.suffix == ".parquet":
        return ()
    files = [path.parent / _POSES_FILE, *_map_files(path)]
    return [file for file in files if file.is_file()]


def read(path: Path) -> Tracks:
    """Read a scenario or annotations."""
    with path.open("rb") as file:
        is_scenario = file.read(4) == b"PAR1"
    return _read_scenario(path) if is_scenario else _read_annotations(path)


def _read_scenario(path: Path) -> Tracks:
    texts = ("track_id", "object_type", "city")
    table = ArrowTable(path, texts, (*_SCENARIO, "start_timestamp"), ("city", "start_timestamp"))
    start_s = table.numbers("start_timestamp") / 1e9 if table.has("start_timestamp") else np.zeros(table.n_rows)
    columns = {
        "time_s": start_s + table.numbers("timestep") * _STEP_S,
        "x_m": table.numbers("position_x"),
        "y_m": table.numbers("position_y"),
        "yaw_rad": table.numbers("heading"),
    }
    cities = set(table.texts("city")) if table.has("city") else set()
    return _tracks(path, table.texts("track_id"), table.texts("object_type"), columns, cities)


def _read_annotations(path: Path) -> Tracks:
    boxes = ArrowTable(path, ("track_uuid", "category"), ("timestamp_ns", *_SIZE, *_QUATERNION, *_TRANSLATION))
    time_ns = boxes.numbers("timestamp_ns")
    pose_rotations, pose_translations = _poses_at(path, time_ns)
    rotations, translations = _transforms(boxes)
    with np.errstate(over="ignore", invalid="ignore"):
        centres = np.einsum("nij,nj->ni", pose_rotations, translations) + pose_translations
        columns = dict(zip(("x_m", "y_m", "z_m"), centres.T, strict=True))
        columns |= {"time_s": time_ns / 1e9, "yaw_rad": yaw_of(pose_rotations @ rotations)}
    columns |= {key: boxes.numbers(key) for key in _SIZE}
    codes = {file.name.partition("____")[2].partition("_")[0] for file in _map_files(path)}
    return _tracks(path, boxes.texts("track_uuid"), boxes.texts("category"), columns, codes)


def _poses_at(path: Path, time_ns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotations (n, 3, 3) and translations (n, 3) of the vehicle at times (n,)."""
    file = path.parent / _POSES_FILE
    if not file.is_file():
        problem = f"expected {_POSES_FILE} beside it, as boxes are relative to the moving vehicle"
        raise InputError(path, problem, "Add the file of the same log.")
    poses = ArrowTable(file, (), ("timestamp_ns", *_QUATERNION, *_TRANSLATION))
    pose_time_ns = poses.numbers("timestamp_ns")
    order = np.argsort(pose_time_ns, kind="stable")
    nearest = order[np.searchsorted(pose_time_ns[order], time_ns).clip(max=order.size - 1)]
    for row in np.flatnonzero(pose_time_ns[nearest] != time_ns):
        problem = f"has no pose at timestamp_ns {time_ns[row]:.0f} of {path.name}"
        raise InputError(file, problem, "Use the files of one log.")
    rotations, translations = _transforms(poses)
    return rotations[nearest], translations[nearest]


def _transforms(table: ArrowTable) -> tuple[FloatArray, FloatArray]:
    """Return the rotations (n, 3, 3) and translations (n, 3) of a table."""
    quaternions = np.column_stack([table.numbers(name) for name in _QUATERNION])
    rotations = to_rotations(quaternions)
    for row in np.flatnonzero(~np.isfinite(rotations).all(axis=(1, 2))):
        problem = f"expected a quaternion, got {quaternions[row].tolist()}"
        raise InputError(f"{table.path}: row {row + 1}: qx, qy, qz, qw", problem, "Correct the row, or remove it.")
    translations = np.column_stack([table.numbers(name) for name in _TRANSLATION])
    for row in np.flatnonzero(~(np.abs(translations) <= MAX_COORDINATE_M).all(axis=1)):
        problem = f"expected coordinates of at most {MAX_COORDINATE_M:g} m, got {translations[row].tolist()}"
        where = f"{table.path}: row {row + 1}: {', '.join(_TRANSLATION)}"
        raise InputError(where, problem, "Correct the row, or remove it.")
    return rotations, translations


def _tracks(path: Path, names: list[str], kinds: list[str], columns: dict[str, FloatArray], cities: set[str]) -> Tracks:
    """Return the rows that are not static, in the UTM zone of the only city."""
    types = ClassNames(_CLASSES, _STATIC)
    classes = [types.convert(kind) for kind in kinds]
    rows = np.array([row for row, cls in enumerate(classes) if cls is not None], dtype=np.intp)
    frame, sources = TrackFrame(), []
    for city, (code, zone, origin_m) in CITY_ORIGINS.items():
        if cities in ({city}, {code}):
            frame = TrackFrame(f"EPSG:{32600 + zone}", origin_m)
    if frame.crs is None:
        sources.append("the city is unknown, so positions in its frame count as x, y of the map")
    return make_tracks(
        path,
        [names[row] for row in rows],
        [cls for cls in classes if cls is not None],
        {key: column[rows] for key, column in columns.items()},
        frame,
        [*sources, *types.sentences()],
    )


def _map_files(path: Path) -> list[Path]:
    return sorted((path.parent / "map").glob("log_map_archive_*____*.json"))
