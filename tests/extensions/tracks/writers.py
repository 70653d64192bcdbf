"""Write boxes of road users in formats of recorded tracks, one function per format, for round trips in tests."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egvs.core.grid import FloatArray
from egvs.formats.georeference import WorldFrame
from egvs.scenario.track_columns import TrackColumns


@dataclass(frozen=True)
class TrackRows:
    """Boxes of road users, one per row, sorted by time; arrays have shape (n,), float64.

    Attributes
    ----------
    time_s
        Time.
    name, cls
        Name of the track, and class, of ``egvs.extensions.tracks.model.CLASSES``, of each row.
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


TAF_BW_ORIGIN_DEG = (49.005306, 8.4374089)
"""Latitude and longitude that :func:`write_taf_bw` declares."""

LEVELX_ORIGIN_M = (293487.1224, 5629711.5816)
"""Easting and northing in UTM zone 32 that :func:`write_levelx` declares."""

PNEUMA_ORIGIN_M = (740_000.0, 4_206_000.0)
"""Easting and northing in UTM zone 34 of the boxes' (0, 0) in :func:`write_pneuma`."""


def write_interaction(folder: Path, boxes: TrackRows) -> Path:
    """Write INTERACTION's columns; pedestrians and bicycles without yaw and size, as far as these are NaN."""
    texts = {**_same("car", "truck", "bus", "van", "motorcycle", "tram", "bicycle"), "pedestrian": "pedestrian/bicycle"}
    return _write(folder / "vehicle_tracks_000.csv", _interaction_columns(boxes, texts))


def write_taf_bw(folder: Path, boxes: TrackRows) -> Path:
    """Write TAF-BW's capitalised types, and ``meta_data.csv``; boxes are in metres about its origin."""
    texts = {"car": "Car", "truck": "Truck", "bicycle": "Bike", "pedestrian": "Pedestrian"}
    lat, lon = TAF_BW_ORIGIN_DEG
    _write(folder / "meta_data.csv", {"id": ["000"], "frameRate_hz": ["10"], "originLat": [lat], "originLon": [lon]})
    return _write(folder / "vehicle_tracks_000.csv", _interaction_columns(boxes, texts))


def write_sind(folder: Path, boxes: TrackRows) -> Path:
    """Write SinD's columns of vehicles, with empty cells where yaw and size are NaN; heading_rad is another angle."""
    texts = _same("car", "truck", "bus", "motorcycle", "bicycle", "pedestrian") | {"other": "tricycle"}
    columns = _interaction_columns(boxes, texts)
    columns["yaw_rad"] = columns.pop("psi_rad")
    columns["heading_rad"] = _numbers(boxes.yaw_rad + 0.3)
    zeros = ["0"] * len(boxes.name)
    columns |= dict.fromkeys(("ax", "ay", "v_lon", "v_lat", "a_lon", "a_lat"), zeros)
    return _write(folder / "Veh_smoothed_tracks.csv", columns)


def write_levelx(folder: Path, boxes: TrackRows) -> Path:
    """Write inD's three files; sizes are 0 where they are NaN."""
    texts = _same("car", "van", "truck", "bus", "trailer", "motorcycle", "bicycle", "pedestrian")
    frame, rate_hz = _frames(boxes)
    ids, first = _ids(boxes)
    _write(folder / "07_tracksMeta.csv", {
        "recordingId": ["7"] * len(first), "trackId": [ids[row] for row in first],
        "class": [texts[boxes.cls[row]] for row in first],
    })  # fmt: skip
    _write(folder / "07_recordingMeta.csv", {
        "recordingId": ["7"], "locationId": ["1"], "frameRate": [f"{rate_hz:.9g}"], "latLocation": ["50.78207"],
        "lonLocation": ["6.07116"], "xUtmOrigin": [LEVELX_ORIGIN_M[0]], "yUtmOrigin": [LEVELX_ORIGIN_M[1]],
    })  # fmt: skip
    return _write(folder / "07_tracks.csv", {
        "recordingId": ["7"] * len(ids), "trackId": ids, "frame": frame, "trackLifetime": ["0"] * len(ids),
        "xCenter": _numbers(boxes.x_m), "yCenter": _numbers(boxes.y_m),
        "heading": _numbers(np.degrees(np.nan_to_num(boxes.yaw_rad)) % 360.0),
        "width": _numbers(np.nan_to_num(boxes.width_m)), "length": _numbers(np.nan_to_num(boxes.length_m)),
    })  # fmt: skip


def write_highd(folder: Path, boxes: TrackRows) -> Path:
    """Write highD's three files; ValueError unless all boxes head along +x or -x."""
    texts = {"car": "Car", "truck": "Truck"}
    is_left = np.cos(boxes.yaw_rad) < 0.0
    if np.abs(np.sin(boxes.yaw_rad)).max() > 1e-9:
        raise ValueError("highD has boxes along x only")
    frame, rate_hz = _frames(boxes)
    ids, first = _ids(boxes)
    _write(folder / "03_tracksMeta.csv", {
        "id": [ids[row] for row in first], "class": [texts[boxes.cls[row]] for row in first],
        "drivingDirection": ["1" if is_left[row] else "2" for row in first],
    })  # fmt: skip
    _write(folder / "03_recordingMeta.csv", {"id": ["3"], "frameRate": [f"{rate_hz:.9g}"], "locationId": ["2"]})
    return _write(folder / "03_tracks.csv", {
        "frame": [str(int(number) + 1) for number in frame], "id": ids,
        "x": _numbers(boxes.x_m - boxes.length_m / 2), "y": _numbers(-boxes.y_m - boxes.width_m / 2),
        "width": _numbers(boxes.length_m), "height": _numbers(boxes.width_m),
        "xVelocity": np.where(is_left, "-20.00", "20.00").tolist(), "laneId": ["2"] * len(ids),
    })  # fmt: skip


def write_ngsim(folder: Path, boxes: TrackRows) -> Path:
    """Write NGSIM's columns, in feet; fronts are half a length before the centres."""
    texts = {"motorcycle": "1", "car": "2", "truck": "3"}
    ids, _ = _ids(boxes)
    front_x_m = boxes.x_m + boxes.length_m / 2 * np.cos(boxes.yaw_rad)
    front_y_m = boxes.y_m + boxes.length_m / 2 * np.sin(boxes.yaw_rad)
    return _write(folder / "trajectories.csv", {
        "Vehicle_ID": ids, "Frame_ID": ["1"] * len(ids), "Total_Frames": ["500"] * len(ids),
        "Global_Time": _numbers(boxes.time_s * 1000.0, 0), "Local_X": _numbers(front_x_m / 0.3048),
        "Local_Y": _numbers(front_y_m / 0.3048), "v_Length": _numbers(boxes.length_m / 0.3048),
        "v_Width": _numbers(boxes.width_m / 0.3048), "v_Class": [texts[name] for name in boxes.cls],
        "Location": ["us-101"] * len(ids),
    })  # fmt: skip


def write_pneuma(folder: Path, boxes: TrackRows, decimals: int = 6) -> Path:
    """Write pNEUMA's lines; boxes are in metres about :data:`PNEUMA_ORIGIN_M`. Real files have six decimals."""
    texts = {"car": "Car", "van": "Medium Vehicle", "truck": "Heavy Vehicle", "bus": "Bus", "motorcycle": "Motorcycle"}
    east_north_m = np.column_stack([boxes.x_m, boxes.y_m]) + PNEUMA_ORIGIN_M
    lon_lat_deg = WorldFrame("EPSG:32634").to_degrees(east_north_m)
    ids, first = _ids(boxes)
    positions: dict[str, list[str]] = {ids[row]: [] for row in first}
    for name, (lon, lat), time_s in zip(ids, lon_lat_deg, boxes.time_s, strict=True):
        positions[name].append(f"{lat:.{decimals}f}; {lon:.{decimals}f}; 30.0; 0.0; 0.0; {time_s:.6f}; ")
    names = ("track_id", "type", "traveled_d", "avg_speed", "lat", "lon", "speed", "lon_acc", "lat_acc", "time")
    lines = [f"{ids[row]}; {texts[boxes.cls[row]]}; 48.9; 40.0; {''.join(positions[ids[row]])}" for row in first]
    path = folder / "20181024_d1_0830_0900.csv"
    path.write_text("\n".join(["; ".join(names), *lines]) + "\n", encoding="utf-8")
    return path


def write_lumpi(folder: Path, boxes: TrackRows) -> Path:
    """Write LUMPI's ``Label.csv``, without a header."""
    texts = {"pedestrian": "0", "car": "1", "bicycle": "2", "motorcycle": "3", "bus": "4", "truck": "5", "other": "7"}
    ids, _ = _ids(boxes)
    numbers = [boxes.x_m, boxes.y_m, boxes.z_m, boxes.length_m, boxes.width_m, boxes.height_m, boxes.yaw_rad]
    cells = zip(_numbers(boxes.time_s), ids, boxes.cls, *map(_numbers, numbers), strict=True)
    path = folder / "Label.csv"
    lines = [",".join([time_s, name, "0,0,1,1,4", texts[cls], "250", *rest, ""]) for time_s, name, cls, *rest in cells]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def write_user_table(folder: Path, boxes: TrackRows, mapping: TrackColumns, json_lines: bool = False) -> Path:
    """Write the columns that a mapping names, in its units and conventions; without a ``crs``."""
    unit_m = {"m": 1.0, "ft": 0.3048}[mapping.length_unit]
    unit_s = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[mapping.time_unit]
    unit_rad = {"rad": 1.0, "deg": np.pi / 180.0}[mapping.yaw_unit]
    is_front, is_bottom = mapping.reference == "front", mapping.z_reference == "bottom"
    ahead_m, up_m = boxes.length_m / 2 * is_front, -boxes.height_m / 2 * is_bottom
    yaw_rad = boxes.yaw_rad if mapping.yaw_convention == "ccw_from_east" else np.pi / 2 - boxes.yaw_rad
    text_of = {name: text for text, name in mapping.types.items()}
    values: dict[str, Sequence[str]] = {
        "time": _numbers(boxes.time_s / unit_s, 9), "id": boxes.name,
        "x": _numbers((boxes.x_m + ahead_m * np.cos(boxes.yaw_rad)) / unit_m),
        "y": _numbers((boxes.y_m + ahead_m * np.sin(boxes.yaw_rad)) / unit_m),
        "z": _numbers((boxes.z_m + up_m) / unit_m), "yaw": _numbers(yaw_rad / unit_rad),
        "length": _numbers(boxes.length_m / unit_m), "width": _numbers(boxes.width_m / unit_m),
        "height": _numbers(boxes.height_m / unit_m), "type": [text_of.get(name, name) for name in boxes.cls],
    }  # fmt: skip
    columns = {str(column): texts for key, texts in values.items() if (column := getattr(mapping, key)) is not None}
    if not json_lines:
        return _write(folder / "tracks.csv", columns, mapping.delimiter)
    texts = (mapping.id, mapping.type)
    columns = {name: cells if name in texts else [float(cell or "nan") for cell in cells]
               for name, cells in columns.items()}  # fmt: skip
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    path = folder / "tracks.jsonl"
    path.write_text("".join(f"{json.dumps(row)}\n" for row in rows), encoding="utf-8")
    return path


def _interaction_columns(boxes: TrackRows, texts: Mapping[str, str]) -> dict[str, Sequence[object]]:
    zeros = ["0"] * len(boxes.name)
    return {
        "track_id": boxes.name, "frame_id": zeros, "timestamp_ms": _numbers(boxes.time_s * 1000.0),
        "agent_type": [texts[name] for name in boxes.cls], "x": _numbers(boxes.x_m), "y": _numbers(boxes.y_m),
        "vx": zeros, "vy": zeros, "psi_rad": _numbers(boxes.yaw_rad), "length": _numbers(boxes.length_m),
        "width": _numbers(boxes.width_m),
    }  # fmt: skip


def _same(*names: str) -> dict[str, str]:
    return dict(zip(names, names, strict=True))


def _numbers(values: FloatArray, decimals: int = 6) -> list[str]:
    """Return numbers with a fixed number of decimals, "" for NaN."""
    return ["" if np.isnan(value) else f"{value:.{decimals}f}" for value in values]


def _frames(boxes: TrackRows) -> tuple[list[str], float]:
    """Return frame numbers, and the frame rate at which all times are multiples of the frame period."""
    times_s = np.unique(boxes.time_s)
    period_s = float(np.diff(times_s).min()) if times_s.size > 1 else 1.0
    frames = boxes.time_s / period_s
    if np.abs(frames - np.round(frames)).max() > 1e-6:
        raise ValueError("times are no multiples of one period")
    return [str(int(number)) for number in np.round(frames)], 1.0 / period_s


def _ids(boxes: TrackRows) -> tuple[list[str], list[int]]:
    """Return whole numbers as names of the tracks, and the first row of each: names that are numbers are kept."""
    numbers: dict[str, str] = {}
    first: list[int] = []
    for row, name in enumerate(boxes.name):
        if name not in numbers:
            numbers[name] = name if name.isdecimal() else str(1_000_000 + len(numbers))
            first.append(row)
    return [numbers[name] for name in boxes.name], first


def _write(path: Path, columns: Mapping[str, Sequence[object]], delimiter: str = ",") -> Path:
    rows = [list(columns), *zip(*columns.values(), strict=True)]
    lines = [delimiter.join(map(str, row)) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
