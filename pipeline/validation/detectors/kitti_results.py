"""Reads the boxes of anyone's detector from KITTI result files, which answer the clouds of ``egvs clouds``.

A folder holds ``<site>/<detector>/<frame>.txt`` for every site and every frame that is looked at, empty files where
nothing was found; ``<site>/data`` stands for a detector that is named as the folder is. So results may be put beside
what was exported (velodyne, label_2, calib ...), or into a folder of their own. All is read and checked before any of
it is used.

A line is as in KITTI's results, in the camera of the exported calibration (:mod:`pipeline.formats.kitti`), which comes
back to the world frame without loss. Pedestrians and cyclists are no vehicles, and left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import InputError
from pipeline.formats import kitti
from pipeline.sensing.sites import Pose
from pipeline.validation.classes import CLASSES
from pipeline.validation.exports.layouts import LAYOUTS
from pipeline.validation.exports.level_frame import LevelFrame
from pipeline.validation.exports.sites import frame_name
from pipeline.validation.sweeps import Detections

NO_VEHICLES = frozenset({"Cyclist", "Pedestrian"})
"""Classes that are known, and left out."""

DATA = "data"
"""The folder of results of KITTI's own programs; the detector is then named as the whole folder."""

_EXPORTED = frozenset(name for layout in LAYOUTS.values() for name in layout.folders)
_RIGHT = "folders SITE/DETECTOR/000000.txt, one file a frame"

Results = dict[str, dict[str, tuple[Detections, ...]]]
"""Detections of each frame, by detector and site."""


def read(folder: Path, poses: Mapping[str, Pose], numbers: NDArray[np.int64]) -> Results:
    """All results of a folder, in the world frame.

    Parameters
    ----------
    poses
        Of the sites that are looked from, by name.
    numbers
        Of the frames that are looked at, in their record.

    Raises
    ------
    InputError
        Naming file and line: a site or a detector at a site that is missing, or of which nothing is known; a frame
        that is missing, or of another record; a calibration that is not that of ``egvs clouds``; a class that is
        unknown; a line of a wrong length, without a score, or with what is no finite number.
    """
    if not folder.is_dir():
        raise InputError(folder, "no such folder", _RIGHT)
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not path.name.startswith(".") and path.name not in poses:
            raise InputError(path, "is no site that is looked from", f"one of {', '.join(poses)}")
    places = {site: _detectors(folder, site) for site in poses}
    names = sorted(set[str]().union(*places.values()))
    for site, its in places.items():
        if missing := [name for name in names if name not in its]:
            raise InputError(folder / site, f"has no results of {missing[0]}", "every detector at every site")
    found: Results = {name: {} for name in names}
    for site, pose in poses.items():
        _check_calibrations(folder / site / "calib", numbers)
        for name in names:
            found[name][site] = _read_site(places[site][name], LevelFrame(pose), numbers)
    return found


def _detectors(folder: Path, site: str) -> dict[str, Path]:
    """Where the results of each detector are."""
    place = folder / site
    if not place.is_dir():
        raise InputError(place, "no such folder", _RIGHT)
    own = (path for path in place.iterdir() if path.is_dir() and not path.name.startswith("."))
    found = {path.name: path for path in own if path.name not in _EXPORTED}
    if DATA in found:
        found[folder.resolve().name] = found.pop(DATA)
    if not found:
        raise InputError(place, "holds no results", _RIGHT)
    return found


def _check_calibrations(folder: Path, numbers: NDArray[np.int64]) -> None:
    """Where the export's calibration lies beside the results, it is the one that boxes come back by."""
    if folder.is_dir():
        for number in numbers.tolist():
            kitti.check_calibration(folder / f"{frame_name(number)}.txt")


def _read_site(folder: Path, level: LevelFrame, numbers: NDArray[np.int64]) -> tuple[Detections, ...]:
    """The results of one detector at one site."""
    wanted = [f"{frame_name(number)}.txt" for number in numbers.tolist()]
    there = {path.name for path in folder.iterdir() if path.suffix == ".txt"}
    if missing := [name for name in wanted if name not in there]:
        others = f" and {len(missing) - 1} other frames" if len(missing) > 1 else ""
        right = f"one file for each of {len(wanted)} frames, empty where nothing was found"
        raise InputError(folder / missing[0], f"no such file{others}", right)
    if other := sorted(there.difference(wanted)):
        right = f"results of the {len(wanted)} frames {wanted[0]} to {wanted[-1]}: --frames as the clouds were exported"
        raise InputError(folder / other[0], "is of no frame that is looked at", right)
    return tuple(_read_frame(folder / name, level) for name in wanted)


def _read_frame(path: Path, level: LevelFrame) -> Detections:
    """The vehicles of one file."""
    found = kitti.read(path)
    for line, name, score in zip(found.lines.tolist(), found.names, found.scores.tolist(), strict=True):
        if name not in CLASSES:
            raise InputError(f"{path}: line {line}", f"unknown class {name!r}", f"one of {', '.join(CLASSES)}")
        if np.isnan(score):
            raise InputError(f"{path}: line {line}", "has no score", "16 values, the last of which is the score")
    kept = np.array([name not in NO_VEHICLES for name in found.names], dtype=np.bool_)
    return Detections(level.world_boxes(found.boxes[kept]), found.scores[kept])
