"""Read infrastructure labels of DAIR-V2X and V2X-Seq (Beijing), a JSON file of boxes for each LiDAR sweep.

The given file is a label, ``label/virtuallidar/ID.json``, or ``data_info.json`` of the same folder. Read are all labels
that ``data_info.json`` lists with the same ``sequence_id`` (V2X-Seq) or ``batch_id`` (DAIR-V2X), at their
``pointcloud_timestamp`` in microseconds. Numbers may be written as texts. A box has its centre ``3d_location``, sizes
``3d_dimensions``, and ``rotation`` in radians, counter-clockwise from +x. It is in the frame of the virtual LiDAR,
whose x-y plane is parallel to the ground; ``calib/virtuallidar_to_world/ID.json`` moves it to the frame of the data
set's maps: p_world = rotation p + translation. Its ``relative_error``, which fits pairs of vehicle and infrastructure,
is not used.

DAIR-V2X has no ``track_id``: each of its boxes becomes a track of one row. See Yu et al. 2022, arXiv 2204.05575, and
2023, arXiv 2305.05938.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from egvs.core.errors import InputError
from egvs.core.wording import number_of
from egvs.extensions.tracks.boxes import Box, BoxRows, ClassNames, Pose, is_rotation
from egvs.extensions.tracks.columns import MAX_TIME_S
from egvs.extensions.tracks.formats.documents import Node, read_document
from egvs.extensions.tracks.model import TrackFrame, Tracks
from egvs.formats.sweep_labels import LabelOptions, SweepLabels, scores_or_none, sweep_name

_INDEX_FILE = "data_info.json"
_LABEL_FOLDER, _CALIBRATION_FOLDER = "virtuallidar", "virtuallidar_to_world"

_CLASSES = {
    "car": "car", "van": "van", "truck": "truck", "bus": "bus", "motorcyclist": "motorcycle",
    "tricyclist": "motorcycle", "cyclist": "bicycle", "pedestrian": "pedestrian", "barrowlist": "pedestrian",
    "carignore": "car", "pedestrianignore": "pedestrian", "otherignore": "other", "unknownmovable": "other",
}  # fmt: skip
_STATIC = frozenset({"trafficcone", "trafficconeignore", "unknownunmovable"})


class _Sweep(NamedTuple):
    """A sweep; None where there is no file."""

    time_s: float
    name: str
    label: Path | None
    calibration: Path | None


def can_open(_path: Path, head: bytes) -> bool:
    """Return whether a file with a member of a label, or of an entry of ``data_info.json``, is a JSON list."""
    return head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"[")


def companions(path: Path) -> Sequence[Path]:
    """Return ``data_info.json``, the labels of the sequence, and their calibration files."""
    files = [_folder(path) / _INDEX_FILE]
    for sweep in _sweeps(path):
        files += [file for file in (sweep.label, sweep.calibration) if file is not None]
    return [file for file in files if file != path.absolute()]


def read(path: Path) -> Tracks:
    """Read the labels of a sequence."""
    rows, classes = BoxRows(path), ClassNames(_CLASSES, _STATIC)
    sweeps = _sweeps(path)
    is_calibrated = any(sweep.calibration is not None for sweep in sweeps)
    without_label = without_track = 0
    for sweep in sweeps:
        if sweep.label is None:
            without_label += 1
            continue
        pose = _read_pose(path, sweep) if is_calibrated else Pose()
        for index, item in enumerate(read_document(sweep.label).elements()):
            cls = classes.convert(item.get("type").text())
            if cls is None:
                continue
            track = item.find("track_id")
            if track is None or track.value in ("", "-1", -1):
                name = f"{PurePosixPath(sweep.name).stem}-{index}"
                without_track += 1
            elif isinstance(track.value, str | int):
                name = str(track.value)
            else:
                raise track.error("expected a text or a whole number")
            rows.add(sweep.label, name, cls, sweep.time_s, _box(item, pose))
    sources = []
    if is_calibrated:
        sources.append("positions are in the frame of the data set's maps, whose place on Earth is unknown")
    else:
        folder = f"calib/{_CALIBRATION_FOLDER}"
        sources.append(f"positions are in the LiDAR's frame, as there is no {folder}: they count as x, y of the map")
    if without_track:
        sources.append(
            f"{number_of(without_track, 'box', 'boxes')} without track_id: each is a track of one row, and counts"
            " only in a frame at exactly its time"
        )
    if without_label:
        sources.append(f"sweeps without a label file left out: {without_label:,}")
    return rows.to_tracks(TrackFrame(), [*sources, *classes.sentences()])


def read_labels(path: Path, _options: LabelOptions) -> list[SweepLabels]:
    """Return the boxes of one label file in the frame of the LiDAR.

    Files of this form are written by many tools, with headings of different conventions.
    """
    classes = ClassNames(_CLASSES, _STATIC)
    names, kinds, boxes, scores = [], [], [], []
    tracked = True
    for index, item in enumerate(read_document(path).elements()):
        cls = classes.convert(item.get("type").text())
        if cls is None:
            continue
        track = item.find("track_id")
        is_tracked = track is not None and track.value not in ("", "-1", -1)
        tracked &= is_tracked
        names.append(str(track.value)[:80] if track is not None and is_tracked else f"{sweep_name(path)}-{index}")
        kinds.append(cls)
        score = item.find("score")
        scores.append(math.nan if score is None else score.number())
        box = _box(item, Pose())
        boxes.append((box.x_m, box.y_m, box.z_m, box.length_m, box.width_m, box.height_m, box.yaw_rad))
    array = np.array(boxes, dtype=np.float64).reshape(-1, 7)
    labels = SweepLabels(
        path, sweep_name(path), tuple(names), tuple(kinds), array,
        has_tracks=tracked, states_yaw=False, scores=scores_or_none(scores),
    )  # fmt: skip
    return [labels]


def _folder(path: Path) -> Path:
    """Return the folder of ``data_info.json``."""
    absolute = path.absolute()
    return absolute.parent if path.name == _INDEX_FILE else absolute.parent.parent.parent


def _sweeps(path: Path) -> list[_Sweep]:
    """Return the sweeps of the sequence of a label, in the order of time; InputError if there is no single one."""
    folder = _folder(path)
    index = folder / _INDEX_FILE
    is_index = path.name == _INDEX_FILE
    if not is_index and path.absolute().parent.name != _LABEL_FOLDER:
        raise InputError(path, f"expected a label in a folder {_LABEL_FOLDER!r}", "Use label/virtuallidar.")
    if not index.is_file():
        problem = f"expected {_INDEX_FILE}, which has the times of the labels, in {folder}"
        raise InputError(path, problem, "Keep the folders of the data set as they are.")
    entries = list(_entries(read_document(index)))
    names = sorted({sequence for sequence, _, name in entries if is_index or name == path.name})
    if len(names) > 1:
        problem = f"lists {len(names)} sequences: {', '.join(name[:40] for name in names[:5])}"
        raise InputError(path, problem, "Name a label file of the sequence to use instead.")
    if not names:
        problem = "is empty" if is_index else f"is not listed in {_INDEX_FILE}"
        raise InputError(path, problem, "Keep the folders of the data set as they are.")
    labels, calibrations = _files(folder / "label" / _LABEL_FOLDER), _files(folder / "calib" / _CALIBRATION_FOLDER)
    if not labels:
        raise InputError(index, f"there are no labels in label/{_LABEL_FOLDER}", "Use the infrastructure's side.")
    sweeps = []
    for sequence, entry, name in entries:
        if sequence == names[0]:
            timestamp = entry.get("pointcloud_timestamp")
            time_s = timestamp.number() / 1e6
            if abs(time_s) > MAX_TIME_S:
                raise timestamp.error(f"expected microseconds up to {1e6 * MAX_TIME_S:g}")
            sweeps.append(_Sweep(time_s, name, labels.get(name), calibrations.get(name)))
    return sorted(sweeps, key=lambda sweep: (sweep.time_s, sweep.name))


def _files(folder: Path) -> dict[str, Path]:
    """Return the files of a folder by name; none if it does not exist."""
    return {file.name: file for file in folder.iterdir() if file.is_file()} if folder.is_dir() else {}


def _entries(index: Node) -> Iterator[tuple[str, Node, str]]:
    """Yield the sequence, the entry and the name of the label file of each sweep."""
    for entry in index.elements():
        sequence = entry.find("sequence_id") or entry.find("batch_id")
        name = PurePosixPath(entry.get("label_lidar_std_path").text()).name  # a path could lead out of the data set
        yield "" if sequence is None else str(sequence.value), entry, name


def _read_pose(path: Path, sweep: _Sweep) -> Pose:
    """Return the pose of the LiDAR in the world at a sweep."""
    if sweep.calibration is None:
        problem = f"calib/{_CALIBRATION_FOLDER} has no file {sweep.name[:80]!r}, but those of other sweeps"
        raise InputError(path, problem, "Add the file, or remove the folder to use positions in the LiDAR's frame.")
    document = read_document(sweep.calibration)
    rotation = np.array([row.numbers(3) for row in document.get("rotation").elements()])
    if rotation.shape != (3, 3) or not is_rotation(rotation):
        raise document.get("rotation").error("expected a rotation matrix of three rows")
    parts = document.get("translation").elements()
    flat = [part.numbers(1)[0] if isinstance(part.value, list) else part.number() for part in parts]
    if len(flat) != 3:
        raise document.get("translation").error(f"expected 3 numbers, got {len(flat)}")
    return Pose.from_arrays(rotation, flat)


def _box(item: Node, pose: Pose) -> Box:
    location, size, yaw_rad = item.get("3d_location"), item.get("3d_dimensions"), item.get("rotation").number()
    centre = [location.get(axis).number() for axis in "xyz"]
    front = (math.cos(yaw_rad), math.sin(yaw_rad), 0.0)
    return pose.box(centre, front, [size.get(side).number() for side in "lwh"])
