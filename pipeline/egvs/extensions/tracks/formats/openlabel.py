"""Read boxes in OpenLABEL: ASAM OpenLABEL 1.0, and the dialect of TUMTraf and A9 (Munich).

Both have ``openlabel.frames.N.objects.ID.object_data.cuboid`` with ``val`` = x, y, z of the centre, a quaternion with
the scalar last (or three Euler angles, of which the last is the yaw), length, width, height. The ID is the track. Time
is ``frame_properties.timestamp`` in seconds.

ASAM: ``cuboid`` is a list, of which the first counts; types are declared in ``openlabel.objects``. Positions are moved
along the coordinate systems as far as poses are given: by the frame's ``transforms``, else by ``pose_wrt_parent``. A
system of type ``geo_utm`` that is named like ``utm-30t`` is a UTM zone.

TUMTraf: ``cuboid`` is an object, and the type is in ``object_data``. A file is one sweep, named
``SECONDS_NANOSECONDS_SENSOR.json``: all sweeps of the sensor in the folder are read. Positions are moved from the
sensor to the base of its station, whose axes are level, if the file has its pose. Releases of the data differ in the
direction of poses; since a sensor is above its base, that direction can be told. That of poses beyond the base and of
``transforms`` cannot, so they are not used. In labels in ``common_road``, z is the bottom.

See ASAM OpenLABEL 1.0.0; Zimmer et al. 2023, arXiv 2306.09266; and the development kit of TUMTraf.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from egvs.core.errors import InputError
from egvs.extensions.tracks.boxes import Box, BoxRows, ClassNames, Pose, front_of
from egvs.extensions.tracks.formats.documents import Node, read_document
from egvs.extensions.tracks.formats.openlabel_poses import SystemPose, pose_in_station, pose_in_world
from egvs.extensions.tracks.model import TrackFrame, Tracks
from egvs.formats.sweep_labels import LabelOptions, SensorPose, SweepLabels, scores_or_none, sweep_name

_SWEEP_NAME = re.compile(r"(\d{9,11})_(\d{1,9})_(.+)\.json(\.gz)?")
_SCORE_NAMES = ("score", "confidence")
_MAX_LENGTH_ERROR = 0.01
"""Of a quaternion."""

_MIN_ROWS_WITHOUT_YAW = 20
"""So many boxes with a heading of exactly 0 have none."""

_CLASSES = {
    "car": "car", "passengercar": "car", "suv": "car", "taxi": "car", "vehicle": "car", "van": "van",
    "emergencyvehicle": "van", "truck": "truck", "lorry": "truck", "trailer": "trailer", "bus": "bus", "tram": "tram",
    "train": "tram", "motorcycle": "motorcycle", "motorbike": "motorcycle", "motorcyclist": "motorcycle",
    "bicycle": "bicycle", "bike": "bicycle", "cyclist": "bicycle", "bicyclist": "bicycle", "pedestrian": "pedestrian",
    "person": "pedestrian", "human": "pedestrian", "other": "other", "othervehicle": "other", "othervehicles": "other",
    "animal": "other", "escooter": "other",
}  # fmt: skip
_STATIC = frozenset({
    "barrier", "building", "cone", "trafficcone", "pole", "signalpole", "catenarypole", "trafficsign", "sign",
    "trafficlight", "signal", "tree", "vegetation", "wall", "fence", "bench", "bufferstop", "track", "switch",
    "signalbridge", "licenseplatelocation",
})  # fmt: skip


def can_open(_path: Path, head: bytes) -> bool:
    """Return whether a file with the name of OpenLABEL's root is a JSON object."""
    return head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{")


def companions(path: Path) -> Sequence[Path]:
    """Return the other sweeps of the same sensor in the folder, in the order of time; no file if it is no sweep."""
    return [file for file in _sweeps(path) if file.name != path.name]


def read(path: Path) -> Tracks:
    """Read a file; if it is a sweep, read all sweeps of its sensor in the folder."""
    recording = _Recording(path)
    for file in _sweeps(path):
        recording.add(file)
    return recording.to_tracks()


def read_labels(path: Path, _options: LabelOptions) -> list[SweepLabels]:
    """Return the boxes of each frame of a file as they are written, in the frame of the sensor.

    InputError for cuboids in a coordinate system that is not that of a sensor.
    """
    root = read_document(path).get("openlabel")
    classes = ClassNames(_CLASSES, _STATIC)
    match = _SWEEP_NAME.fullmatch(path.name)
    labels = []
    for _, frame in root.get("frames").members():
        properties = frame.find("frame_properties")
        time = None if properties is None else properties.find("timestamp")
        file = None if properties is None else properties.find("point_cloud_file_name")
        names, kinds, boxes, scores, pose = [], [], [], [], None
        for name, item, cuboid, is_tumtraf in _cuboids(frame, Counter()):
            cls = classes.convert(_type_of(root, name, item, is_tumtraf))
            if cls is None:
                continue
            system = cuboid.find("coordinate_system")
            _check_in_sensor(root, system)
            if pose is None:
                named = match[3] if system is None and match is not None else "" if system is None else system.text()
                pose = _sensor_pose(root, properties, named, is_tumtraf)
            scores.append(_score(cuboid))
            box = _box(cuboid.get("val"), Pose())
            names.append(name)
            kinds.append(cls)
            boxes.append((box.x_m, box.y_m, box.z_m, box.length_m, box.width_m, box.height_m, box.yaw_rad))
        time_s = math.nan if time is None else time.number()
        if time is None and match is not None:
            time_s = int(match[1]) + int(match[2]) * 1e-9
        sweep = sweep_name(path if file is None else file.text())
        array = np.array(boxes, dtype=np.float64).reshape(-1, 7)
        found = scores_or_none(scores)
        labels.append(SweepLabels(path, sweep, tuple(names), tuple(kinds), array, time_s, scores=found, pose=pose))
    return labels


def _sensor_pose(root: Node, properties: Node | None, system: str, is_tumtraf: bool) -> SensorPose | None:
    """Return the pose of a sensor in the frame to which poses lead; None if the file has none that is possible."""
    try:
        outer = pose_in_station(root, system) if is_tumtraf else pose_in_world(root, properties, system)
    except InputError:
        return None
    if outer.name == system:
        return None
    return SensorPose(outer.name, np.array(outer.pose.rotation), np.array(outer.pose.translation))


def _score(cuboid: Node) -> float:
    """Return the score that a detector gives a cuboid, a number among its attributes; NaN without one."""
    attributes = cuboid.find("attributes")
    numbers = None if attributes is None else attributes.find("num")
    is_list = numbers is not None and isinstance(numbers.value, list)
    for item in numbers.elements() if numbers is not None and is_list else ():
        name = item.find("name") if isinstance(item.value, dict) else None
        if name is not None and str(name.value).lower() in _SCORE_NAMES:
            return item.get("val").number()
    return math.nan


def _check_in_sensor(root: Node, system: Node | None) -> None:
    """Raise an InputError for a coordinate system that is declared as another than a sensor's."""
    if system is None:
        return
    systems = root.find("coordinate_systems")
    declared = None if systems is None else systems.find(system.text())
    kind = None if declared is None else declared.find("type")
    if kind is not None and kind.value not in ("sensor_cs", "sensor"):
        problem = f"expected boxes in the sensor's frame, got the system {system.text()[:80]!r} of type {kind.value!r}"
        raise system.error(problem, "Export the labels in the frame of the sweeps.")


def _sweeps(path: Path) -> list[Path]:
    match = _SWEEP_NAME.fullmatch(path.name)
    if match is None:
        return [path]
    sweeps = []
    for file in path.parent.iterdir():
        other = _SWEEP_NAME.fullmatch(file.name)
        if other is not None and other[3] == match[3] and file.is_file():
            sweeps.append((int(other[1]), int(other[2]), file))
    return [file for _, _, file in sorted(sweeps)]


class _Recording:
    """The boxes of all files, and what was done to them."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._rows = BoxRows(path)
        self._classes = ClassNames(_CLASSES, _STATIC)
        self._poses: set[tuple[str, TrackFrame]] = set()
        self._counts: Counter[str] = Counter()

    def add(self, file: Path) -> None:
        """Add the boxes of a file."""
        self._counts["files"] += 1
        root = read_document(file).get("openlabel")
        match = _SWEEP_NAME.fullmatch(file.name)
        sensor = "" if match is None else match[3]
        for _, frame in root.get("frames").members():
            properties = frame.find("frame_properties")
            time = None if properties is None else properties.find("timestamp")
            if time is not None:
                time_s = time.number()
            elif match is not None:
                time_s = int(match[1]) + int(match[2]) * 1e-9
            else:
                raise frame.error("frame_properties.timestamp is missing", "Add the time of the frame in seconds.")
            poses: dict[tuple[str, bool], SystemPose] = {}
            for name, item, cuboid, is_tumtraf in _cuboids(frame, self._counts):
                cls = self._classes.convert(_type_of(root, name, item, is_tumtraf))
                if cls is None:
                    continue
                named = cuboid.find("coordinate_system")
                system = sensor if named is None else named.text()
                if (system, is_tumtraf) not in poses:
                    pose = pose_in_station(root, system) if is_tumtraf else pose_in_world(root, properties, system)
                    poses[system, is_tumtraf] = pose
                    self._poses.add((pose.name, pose.frame))
                box = _box(cuboid.get("val"), poses[system, is_tumtraf].pose)
                if is_tumtraf and system == "common_road":
                    box = box._replace(z_m=box.z_m + box.height_m / 2)
                    self._counts["bottoms"] += 1
                self._counts["without yaw"] += is_tumtraf and cuboid.get("val").value[3:6] == [0, 0, 0]
                self._rows.add(file, name, cls, time_s, box)

    def to_tracks(self) -> Tracks:
        """Return the tracks; InputError unless all are in one coordinate system."""
        if len(self._poses) > 1:
            names = ", ".join(repr(name[:80]) for name, _ in sorted(self._poses, key=str)[:5])
            problem = f"cuboids are in several coordinate systems: {names}"
            raise InputError(self._path, problem, "Add the pose of each in a system that they share.")
        system, frame = next(iter(self._poses), ("", TrackFrame()))
        tracks = self._rows.to_tracks(frame, [*self._sources(system, frame), *self._classes.sentences()])
        if self._counts["without yaw"] == tracks.n_rows >= _MIN_ROWS_WITHOUT_YAW:
            note = "all headings are exactly 0, as in predictions saved by TUMTraf's tools: they count as not given"
            missing = np.full(tracks.n_rows, math.nan)
            return dataclasses.replace(tracks, yaw_rad=missing, sources=(*tracks.sources, note))
        return tracks

    def _sources(self, system: str, frame: TrackFrame) -> Iterator[str]:
        if self._counts["files"] > 1:
            yield f"all {self._counts['files']:,} sweeps in the folder {self._path.parent.name!r} were read"
        if frame.crs is None:
            name = f"the coordinate system {system[:80]!r}" if system else "a coordinate system without a name"
            yield f"positions are in {name}, whose place on Earth is unknown: they count as x, y of the map"
        if self._counts["bottoms"]:
            yield "z of labels in common_road is the bottom: half the height was added"
        if self._counts["no cuboid"]:
            yield f"objects without a cuboid left out: {self._counts['no cuboid']:,}"
        if self._counts["further cuboids"]:
            yield f"further cuboids of the same object left out: {self._counts['further cuboids']:,}"


def _cuboids(frame: Node, counts: Counter[str]) -> Iterator[tuple[str, Node, Node, bool]]:
    """Yield the track, the object, its cuboid, and whether it is TUMTraf's dialect, of all objects of a frame.

    ``counts`` counts what is left out.
    """
    objects = frame.find("objects")
    for name, item in objects.members() if objects is not None else ():
        data = item.find("object_data")
        cuboid = None if data is None else data.find("cuboid")
        if cuboid is None or cuboid.value == []:
            counts["no cuboid"] += 1
        elif isinstance(cuboid.value, list):
            first, *others = cuboid.elements()
            counts["further cuboids"] += len(others)
            yield name, item, first, False
        else:
            yield name, item, cuboid, True


def _type_of(root: Node, name: str, item: Node, is_tumtraf: bool) -> str:
    """Return the type of an object: ASAM's is usually declared once, beside the frames."""
    if is_tumtraf:
        return item.get("object_data").get("type").text()
    return (item.find("type") or root.get("objects").get(name).get("type")).text()


def _box(values: Node, pose: Pose) -> Box:
    """Return the box of a cuboid in the outer system; without a heading for a quaternion of length 0."""
    numbers = values.numbers(9, 10)
    if len(numbers) == 9:
        yaw_rad = numbers[5]
        return pose.box(numbers[:3], (math.cos(yaw_rad), math.sin(yaw_rad), 0.0), numbers[6:])
    length = math.hypot(*numbers[3:7])
    if length > 0 and not abs(length - 1) < _MAX_LENGTH_ERROR:
        raise values.error(f"expected a quaternion of length 1, got one of length {length:.3g}")
    return pose.box(numbers[:3], front_of(*numbers[3:7]), numbers[7:])
