"""Boxes that people labelled in the sweeps of a LiDAR, in the sensor's frame.

Formats are found in the table of readers (:mod:`egvs.core.readers`, kind ``labels``). The module of a format has a
function ``read_labels(path, options)`` that returns one :class:`SweepLabels` for each sweep that a file labels.

Labels belong to the sweep of the same name: ``A.json`` or ``A.txt`` to ``A.pcd`` or ``A.pcd.gz``. Labels of a recording
belong to the sweep that is nearest in time, within :data:`MAX_TIME_DIFFERENCE_S`. A file with the labels of one sweep
belongs to the only sweep there is.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath
from typing import Protocol, cast

import numpy as np

from egvs.core import limits, readers
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.reading import translate_errors
from egvs.core.wording import list_first
from egvs.formats.sweep_files import Sweep

KIND = "labels"
"""Kind of the readers of labels."""

MAX_TIME_DIFFERENCE_S = 0.05
"""Half the period of a sensor with 10 sweeps per second."""

MAX_SIZE_M = 100.0
MAX_COORDINATE_M = 10_000.0

VCLASSES = {
    "car": "passenger", "van": "delivery", "truck": "truck", "trailer": "trailer", "bus": "bus", "tram": "tram",
    "motorcycle": "motorcycle", "bicycle": "bicycle", "pedestrian": "pedestrian", "other": "ignoring",
}  # fmt: skip
"""Class of a label to SUMO's vClass; boxes of the class ``other`` only hide what is behind them."""

_SYNONYMS = {
    "cyclist": "bicycle", "bicyclist": "bicycle", "person": "pedestrian", "personsitting": "pedestrian",
    "motorcyclist": "motorcycle", "lorry": "truck", "passenger": "car", "delivery": "van",
}  # fmt: skip

_SUFFIXES = re.compile(r"(\.(pcd|ply|las|laz|csv|e57|bin|npz|json|txt))?(\.gz)?$", re.IGNORECASE)
_LABEL_SUFFIXES = (".json", ".txt", ".csv")
_NAME_HINT = "Name labels like their sweep: A.json or A.txt beside A.pcd."


@dataclass(frozen=True)
class LabelOptions:
    """How labels are read.

    Attributes
    ----------
    columns
        Column of a table for each of its values; values that are missing here have their own name.
    """

    columns: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class SensorPose:
    """Pose of a sensor in a frame that sensors share: p_shared = rotation p + translation.

    Attributes
    ----------
    frame
        Name of the shared frame.
    rotation, translation_m
        (3, 3) and (3,) float64.
    """

    frame: str
    rotation: FloatArray
    translation_m: FloatArray


@dataclass(frozen=True, eq=False)
class SweepLabels:
    """The labelled boxes of one sweep.

    Attributes
    ----------
    file
        The file that they are from.
    sweep
        Name of the sweep's file without folder and suffixes; empty if unknown.
    names
        Name of each of the n objects; the same in all sweeps if ``has_tracks``.
    classes
        Class of each, of :data:`VCLASSES`.
    boxes
        Centre, length, width, height, and heading counter-clockwise from x about the z axis, in the sensor's frame,
        (n, 7) float64, metres and radians.
    time_s
        When the sweep was recorded, on the clock of its recording; NaN if unknown.
    has_tracks
        Whether an object has one name in all sweeps.
    states_yaw
        Whether the format says where headings count from, and in which direction.
    scores
        Score of each box by a detector, (n,) float64; None for labels of people.
    pose
        Pose of the sensor in a frame that it shares with others, if the file has one.
    """

    file: Path
    sweep: str
    names: tuple[str, ...]
    classes: tuple[str, ...]
    boxes: FloatArray
    time_s: float = math.nan
    has_tracks: bool = True
    states_yaw: bool = True
    scores: FloatArray | None = None
    pose: SensorPose | None = None

    def __len__(self) -> int:
        """Number of boxes."""
        return len(self.names)

    def with_boxes(self, boxes: FloatArray) -> SweepLabels:
        """Return the same labels with other boxes, (n, 7) float64."""
        return replace(self, boxes=boxes)


class LabelFormat(Protocol):
    """Module of a format."""

    def read_labels(self, path: Path, options: LabelOptions, /) -> list[SweepLabels]:
        """Return the labels of all sweeps in a file; InputError when it is damaged."""


def label_class(text: str) -> str:
    """Return the class of a name in any capitals: one of :data:`VCLASSES`, "other" for an unknown name."""
    name = re.sub(r"[^a-z]", "", text.lower())
    name = _SYNONYMS.get(name, name)
    return name if name in VCLASSES else "other"


def scores_or_none(scores: Sequence[float]) -> FloatArray | None:
    """Return the scores of all boxes of a file, (n,) float64; None unless each has one."""
    array = np.array(scores, dtype=np.float64)
    return array if len(array) and np.isfinite(array).all() else None


def sweep_name(path: PurePath | str) -> str:
    """Return the name of a file without its folder and suffixes.

    >>> sweep_name("labels/000012.pcd.gz")
    '000012'
    """
    return _SUFFIXES.sub("", PurePath(path).name, count=1)


def read_labels(
    paths: Sequence[str | Path], options: LabelOptions | None = None, sweeps: Sequence[Sweep] = ()
) -> list[SweepLabels]:
    """Return the labels in some files, in their order.

    Parameters
    ----------
    paths
        Files, or folders, of which all files count whose name is of a format of labels.
    options
        How they are read.
    sweeps
        The sweeps. A file of a folder that is named like one, as labels are, must be of a known format.

    Raises
    ------
    InputError
        If a file is missing, damaged, of an unknown format, or has no possible boxes; if no file has a box.
    """
    labels: list[SweepLabels] = []
    for path in [*list_files(paths, KIND), *_named_like_labels(paths, sweeps)]:
        limits.checked_size(path, limits.FILE)
        reader = readers.find_reader(KIND, path)
        if reader is None:
            problem = f"expected labels ({readers.describe_formats(KIND)}), got another or a damaged file"
            raise InputError(path, problem, "Convert the labels, or leave the file out.")
        expected = "a module with a function read_labels(path, options)"
        module = cast(LabelFormat, readers.load_reader(reader, ("read_labels",), expected))
        with translate_errors(path):
            labels += module.read_labels(path, options or LabelOptions())
    for item in labels:
        _check(item)
    if not labels:
        raise InputError("--labels", "expected labels, got none", _NAME_HINT)
    return labels


def _named_like_labels(paths: Sequence[str | Path], sweeps: Sequence[Sweep]) -> list[Path]:
    """Return the files of folders that are named like a sweep and have a suffix of labels, but not their content."""
    files = {sweep.name.split(": ")[0] for sweep in sweeps}
    names = {sweep_name(file) for file in files}
    return [
        file
        for folder in map(Path, paths)
        if folder.is_dir()
        for file in sorted(folder.rglob("*"))
        if file.name.lower().removesuffix(".gz").endswith(_LABEL_SUFFIXES)
        and file.is_file()
        and sweep_name(file) in names
        and file.name not in files
        and not _is_of_kinds(file, (KIND,))
    ]


def list_files(paths: Sequence[str | Path], *kinds: str) -> list[Path]:
    """Return files as they are given, and the files of folders, by name, that may be of one of some kinds.

    A folder that is itself of a format, as a recording of ROS 2, stays as it is. Of a folder without such files, those
    in its folders count.
    """
    listed: list[Path] = []
    for path in map(Path, paths):
        if not path.is_dir() or (path / "metadata.yaml").is_file():
            listed.append(path)
            continue
        entries = [entry for entry in sorted(path.iterdir()) if not entry.name.startswith(".")]
        inside = [file for file in entries if file.is_file() and _is_of_kinds(file, kinds)]
        listed += inside or list_files([entry for entry in entries if entry.is_dir()], *kinds)
    return listed


def _is_of_kinds(file: Path, kinds: Sequence[str]) -> bool:
    head = readers.read_head(file)
    plain = file.with_suffix("") if file.suffix.lower() == ".gz" else file
    candidates = (reader for kind in kinds for reader in readers.list_readers(kind))
    return any(reader.may_open(named, head) for reader in candidates for named in (file, plain))


def match_labels(
    sweeps: Sequence[Sweep], labels: Sequence[SweepLabels]
) -> tuple[list[tuple[Sweep, SweepLabels]], list[str]]:
    """Return sweeps with their labels, and sentences on those without a partner.

    Raises
    ------
    InputError
        If no labels belong to a sweep, or two belong to the same.
    """
    by_name = {sweep_name(sweep.name.split(": ")[0]): sweep for sweep in sweeps if sweep.stamp_s is None}
    stamped = [sweep for sweep in sweeps if sweep.stamp_s is not None]
    pairs: list[tuple[Sweep, SweepLabels]] = []
    alone: list[str] = []
    for item in labels:
        sweep = by_name.get(item.sweep)
        if sweep is None and stamped and math.isfinite(item.time_s):
            nearest = min(stamped, key=lambda other: abs(cast(float, other.stamp_s) - item.time_s))
            sweep = nearest if abs(cast(float, nearest.stamp_s) - item.time_s) <= MAX_TIME_DIFFERENCE_S else None
        if sweep is None and len(sweeps) == len(labels) == 1:
            sweep = sweeps[0]
        if sweep is None:
            alone.append(item.sweep or item.file.name)
        else:
            pairs.append((sweep, item))
    if not pairs:
        problem = f"expected labels of these sweeps ({list_first([sweep.name for sweep in sweeps], 3)}), got none"
        raise InputError(labels[0].file, problem, _NAME_HINT)
    matched = [sweep.name for sweep, _ in pairs]
    for name in matched:
        if matched.count(name) > 1:
            raise InputError(name, "has labels in two files", "Give one set of labels for each sweep.")
    notes = []
    if alone:
        notes.append(f"labels without a sweep: {len(alone):,} ({list_first(alone, 3)})")
    if without := [sweep.name for sweep in sweeps if sweep.name not in matched]:
        notes.append(f"sweeps without labels: {len(without):,} ({list_first(without, 3)})")
    return pairs, notes


def _check(labels: SweepLabels) -> None:
    """Raise an InputError for a box that cannot be."""
    boxes = labels.boxes
    possible = np.isfinite(boxes).all(axis=1)
    possible &= (np.abs(boxes[:, :3]) <= MAX_COORDINATE_M).all(axis=1)
    possible &= ((boxes[:, 3:6] > 0.0) & (boxes[:, 3:6] <= MAX_SIZE_M)).all(axis=1)
    for row in np.flatnonzero(~possible).tolist():
        numbers = ", ".join(f"{value:g}" for value in boxes[row])
        problem = f"expected a box near the sensor with sizes above 0 and up to {MAX_SIZE_M:g} m, got {numbers}"
        raise InputError(f"{labels.file}: {labels.names[row][:80]!r}", problem, "Correct the box, or remove it.")
