"""KITTI results of other detectors in, ours out.

Reads the boxes of anyone's detector from KITTI result files, which answer the clouds of ``egvs clouds``.

A folder holds ``<site>/<detector>/<frame>.txt`` for every site and every frame that is looked at, empty files where
nothing was found; ``<site>/data`` stands for a detector that is named as the folder is. So results may be put beside
what was exported (velodyne, label_2, calib ...), or into a folder of their own. All is read and checked before any of
it is used.

A line is as in KITTI's results, in the camera of the exported calibration (:mod:`egvs.formats.kitti`), which comes
back to the world frame without loss. Pedestrians and cyclists are no vehicles, and left out.

Writes ground truth and detections as KITTI's labels and results, for other programs to evaluate or to draw.

    <folder>/<site>/label_2/<frame>.txt      vehicles whose centre is in the region of interest, seen or not
    <folder>/<site>/calib/<frame>.txt        as ``egvs clouds`` writes it
    <folder>/<site>/<detector>/<frame>.txt   what a detector found there, all as Car: it tells no kinds

Frames have the numbers of ``egvs clouds``, so that its clouds fit; ``--detections`` reads the folder back.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core import files
from egvs.core.errors import InputError
from egvs.formats import kitti
from egvs.sensors.sites import Pose
from egvs.validation import sweeps
from egvs.validation.dataset_files import LAYOUTS, LevelFrame, frame_name
from egvs.validation.held_out_traffic import HeldOutTraffic
from egvs.validation.sweeps import CLASSES, DetectedBoxes, Detections, DetectorResult

IGNORED_CLASSES = frozenset({"Cyclist", "Pedestrian"})
"""Classes that are known, and left out."""

DATA_FOLDER = "data"
"""The folder of results of KITTI's own programs; the detector is then named as the whole folder."""

_EXPORTED_FOLDERS = frozenset(name for layout in LAYOUTS.values() for name in layout.folders)
_EXPECTED = "folders SITE/DETECTOR/000000.txt, one file a frame"

DetectorResults = dict[str, dict[str, tuple[Detections, ...]]]
"""Detections of each frame, by detector and site."""


def read_kitti_results(folder: Path, poses: Mapping[str, Pose], numbers: NDArray[np.int64]) -> DetectorResults:
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
        raise InputError(folder, "no such folder", _EXPECTED)
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not path.name.startswith(".") and path.name not in poses:
            raise InputError(path, "is no site that is looked from", f"one of {', '.join(poses)}")
    places = {site: _detector_folders(folder, site) for site in poses}
    names = sorted(set[str]().union(*places.values()))
    for site, its in places.items():
        if missing := [name for name in names if name not in its]:
            raise InputError(folder / site, f"has no results of {missing[0]}", "every detector at every site")
    found: DetectorResults = {name: {} for name in names}
    for site, pose in poses.items():
        _check_calibrations(folder / site / "calib", numbers)
        for name in names:
            found[name][site] = _read_site(places[site][name], LevelFrame(pose), numbers)
    return found


def _detector_folders(folder: Path, site: str) -> dict[str, Path]:
    """Where the results of each detector are."""
    place = folder / site
    if not place.is_dir():
        raise InputError(place, "no such folder", _EXPECTED)
    own = (path for path in place.iterdir() if path.is_dir() and not path.name.startswith("."))
    found = {path.name: path for path in own if path.name not in _EXPORTED_FOLDERS}
    if DATA_FOLDER in found:
        found[folder.resolve().name] = found.pop(DATA_FOLDER)
    if not found:
        raise InputError(place, "holds no results", _EXPECTED)
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
    found = kitti.read_labels(path)
    for line, name, score in zip(found.lines.tolist(), found.names, found.scores.tolist(), strict=True):
        if name not in CLASSES:
            raise InputError(f"{path}: line {line}", f"unknown class {name!r}", f"one of {', '.join(CLASSES)}")
        if np.isnan(score):
            raise InputError(f"{path}: line {line}", "has no score", "16 values, the last of which is the score")
    kept = np.array([name not in IGNORED_CLASSES for name in found.names], dtype=np.bool_)
    return Detections(level.world_boxes(found.boxes[kept]), found.scores[kept])


KITTI_FOLDER = "validation_kitti"
PARTIAL_FOLDER = f".{KITTI_FOLDER}.partial"
"""Where it is written first."""


def write_kitti_results(
    folder: Path,
    record: HeldOutTraffic,
    frames: Sequence[TrafficFrame],
    results: Mapping[str, Mapping[str, DetectorResult]],
) -> None:
    """Write all sites into ``folder``, in place of what an earlier call has written there."""
    aside = folder.with_name(PARTIAL_FOLDER)
    shutil.rmtree(aside, ignore_errors=True)
    for site, its in results.items():
        level = LevelFrame(record.scene.site(site).pose)
        _write_truth(aside / site, record, frames, level)
        for name, what in its.items():
            if isinstance(what, DetectedBoxes):
                _write_results(aside / site / name, frames, what, level)
    if folder.exists():
        shutil.rmtree(folder)
    aside.rename(folder)


def _write_truth(folder: Path, record: HeldOutTraffic, frames: Sequence[TrafficFrame], level: LevelFrame) -> None:
    for name in ("label_2", "calib"):
        (folder / name).mkdir(parents=True)
    for frame in frames:
        wanted, kinds = frame.target_rows(record.scene.roi), sweeps.frame_classes(frame)
        text = kitti.format_labels([kinds[row] for row in wanted], level.boxes(frame.boxes[wanted]))
        files.write_text(folder / "label_2" / f"{frame_name(frame.number)}.txt", text)
        files.write_text(folder / "calib" / f"{frame_name(frame.number)}.txt", kitti.CALIBRATION)


def _write_results(folder: Path, frames: Sequence[TrafficFrame], what: DetectedBoxes, level: LevelFrame) -> None:
    folder.mkdir(parents=True)
    for frame, its in zip(frames, what.frames, strict=True):
        text = kitti.format_labels(["Car"] * len(its.scores), level.boxes(its.boxes), np.asarray(its.scores))
        files.write_text(folder / f"{frame_name(frame.number)}.txt", text)
