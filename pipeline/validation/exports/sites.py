"""Writes the folder of one site: clouds, labels, the split, every box of every frame, and what there is of it.

A box is labelled when a beam of the sweep met it, wherever it is: a detector that is trained on these labels must not
be told that a car outside the region of interest is none. ``objects.csv`` has all boxes, seen or not, and says which
are ground truth of validation (vehicles whose centre is in the region of interest).
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.traffic_frames import TrafficFrame
from pipeline.core import files
from pipeline.core.parallel import in_order
from pipeline.core.progress import Progress
from pipeline.validation import classes
from pipeline.validation.clouds.point_clouds import CloudMaker, random_of
from pipeline.validation.exports.layouts import Layout
from pipeline.validation.exports.level_frame import LevelFrame, corners
from pipeline.validation.unseen_record import UnseenRecord

TRAINING = 0.8
"""Share of the frames, the first ones, that are for training; the others are for validation."""

WELL_SEEN = 10
"""Points of an object that OpenPCDet may paste into other frames."""

COLUMNS = (
    *("frame", "object", "vehicle", "part", "kind", "class", "points", "in_roi"),
    *("x_m", "y_m", "z_m", "length_m", "width_m", "height_m", "heading_rad", "pitch_rad"),
)
"""Of ``objects.csv``, one row a box a frame."""


@dataclass
class SiteSummary:
    """What was written of a site.

    Attributes
    ----------
    train, val, empty
        Frames of the split; those without a labelled object are in neither.
    boxes, labelled, in_roi, in_roi_labelled
        Boxes of all frames; those with at least one point; vehicles whose centre is in the region of interest; those
        of them with at least one point.
    classes
        Labelled boxes by class.
    pasted
        Of the frames for training, those with at least :data:`WELL_SEEN` points by class.
    anchors
        Length, width, height and z of the bottom in the level frame by class, means over the labelled boxes.
    low_m, high_m
        The smallest box round all labelled boxes in the region of interest, in the level frame; of all labelled ones
        where none is in it, of nothing where there are none.
    """

    site: str
    sensor: str
    pose: dict[str, float]
    range_sigma_m: float
    T_world_level: list[list[float]]
    train: list[str] = field(default_factory=list)
    val: list[str] = field(default_factory=list)
    empty: list[str] = field(default_factory=list)
    points: int = 0
    boxes: int = 0
    labelled: int = 0
    in_roi: int = 0
    in_roi_labelled: int = 0
    classes: Counter[str] = field(default_factory=Counter)
    pasted: Counter[str] = field(default_factory=Counter)
    anchors: dict[str, list[float]] = field(default_factory=dict)
    low_m: list[float] = field(default_factory=list)
    high_m: list[float] = field(default_factory=list)

    @property
    def frames(self) -> int:
        """How many frames there are."""
        return len(self.train) + len(self.val) + len(self.empty)

    def to_json(self) -> dict[str, Any]:
        """As ``about.json`` holds it: lists of frames as their numbers."""
        counts = {name: len(getattr(self, name)) for name in ("train", "val", "empty")}
        return vars(self) | {"frames": self.frames} | counts


@dataclass(frozen=True)
class _Written:
    """A frame whose files are written, as the site's folder sums it up."""

    frame: TrafficFrame
    name: str
    cloud: int
    classes: tuple[str, ...]
    on_box: NDArray[np.int64]
    level: NDArray[np.float64]
    wanted: NDArray[np.bool_]


def frame_name(number: int) -> str:
    """The name of a frame's files, without a suffix: its number in the record."""
    return f"{number:06d}"


def write_site(
    folder: Path, record: UnseenRecord, maker: CloudMaker, layout: Layout, threads: int, progress: Progress
) -> SiteSummary:
    """Write all frames of a site into a folder, which is made.

    Parameters
    ----------
    progress
        Told of the frames of this site.
    """
    for name in layout.folders:
        (folder / name).mkdir(parents=True)
    view, level = maker.view, LevelFrame(maker.view.pose)
    pose = asdict(view.pose)
    matrix = level.T_world_level.tolist()
    about = SiteSummary(view.site, view.sensor.name, pose, view.sensor.range_sigma_m, matrix)

    def write(frame: TrafficFrame) -> _Written:
        taken = maker.sweep(frame, random_of(record.scenario.seed, view.site, frame.number))
        boxes, kinds = level.boxes(frame.boxes), classes.of_frame(frame)
        on_box = taken.points_on(len(boxes))
        seen = np.flatnonzero(on_box)
        name, points = frame_name(frame.number), level.points(taken.sweep.points)
        layout.write_frame(folder, name, points, taken.owner, [kinds[i] for i in seen], boxes[seen])
        wanted = np.zeros(len(boxes), dtype=np.bool_)
        wanted[frame.wanted(record.scene.roi)] = True
        return _Written(frame, name, len(points), kinds, on_box, boxes, wanted)

    training = set(record.numbers[: max(1, int(TRAINING * record.frames + 1e-9))].tolist())
    within, around, sums = _Extent(), _Extent(), dict[str, NDArray[np.float64]]()
    with (folder / "objects.csv").open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(COLUMNS)
        for done, written in enumerate(in_order(write, record.read(), threads), 1):
            rows.writerows(_rows(written))
            _count(about, written, in_training=written.frame.number in training)
            seen = written.on_box > 0
            around.add(written.level[seen])
            within.add(written.level[seen & written.wanted])
            _add_sizes(sums, written, seen)
            progress("frames", done, record.frames)
    about.low_m, about.high_m = within.bounds() or around.bounds() or ([], [])
    about.anchors = {name: (sums[name] / about.classes[name]).round(2).tolist() for name in sorted(sums)}
    for name in ("train", "val", "empty"):
        _write_lines(folder / "ImageSets" / f"{name}.txt", getattr(about, name))
    files.write_text(folder / "about.json", json.dumps(about.to_json(), indent=2, sort_keys=True) + "\n")
    return about


class _Extent:
    """Grows round boxes."""

    def __init__(self) -> None:
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)

    def add(self, boxes: NDArray[np.float64]) -> None:
        """Hold these boxes (n, 7) too."""
        if len(boxes):
            at = corners(boxes).reshape(-1, 3)
            self._low, self._high = np.minimum(self._low, at.min(axis=0)), np.maximum(self._high, at.max(axis=0))

    def bounds(self) -> tuple[list[float], list[float]] | None:
        """Lowest and highest x, y, z, in whole millimetres; None round nothing."""
        if not np.isfinite(self._low).all():
            return None
        return self._low.round(3).tolist(), self._high.round(3).tolist()


def _rows(written: _Written) -> list[list[str]]:
    """Rows of ``objects.csv``."""
    frame, found = written.frame, []
    pitch, part = frame.pitch_rad.tolist(), frame.part.tolist()
    for at, box in enumerate(written.level.tolist()):
        who = [written.name, str(at), frame.vehicles[at], str(part[at]), frame.kinds[at], written.classes[at]]
        counts = [str(written.on_box[at]), str(int(written.wanted[at]))]
        found.append([*who, *counts, *(f"{value:.6f}" for value in (*box, pitch[at]))])
    return found


def _count(about: SiteSummary, written: _Written, *, in_training: bool) -> None:
    seen = written.on_box > 0
    split = about.empty if not seen.any() else about.train if in_training else about.val
    split.append(written.name)
    about.points += written.cloud
    about.boxes += len(seen)
    about.labelled += int(seen.sum())
    about.in_roi += int(written.wanted.sum())
    about.in_roi_labelled += int((seen & written.wanted).sum())
    about.classes.update(written.classes[i] for i in np.flatnonzero(seen))
    if in_training:
        about.pasted.update(written.classes[i] for i in np.flatnonzero(written.on_box >= WELL_SEEN))


def _add_sizes(sums: dict[str, NDArray[np.float64]], written: _Written, seen: NDArray[np.bool_]) -> None:
    """Sums of length, width, height and z of the bottom by class grow by the boxes that are seen."""
    for at in np.flatnonzero(seen):
        box, name = written.level[at], written.classes[at]
        sums[name] = sums.get(name, np.zeros(4)) + np.append(box[3:6], box[2] - box[5] / 2)


def _write_lines(path: Path, lines: Sequence[str]) -> None:
    path.write_bytes("".join(f"{line}\n" for line in lines).encode())
