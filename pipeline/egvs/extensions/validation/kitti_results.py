"""KITTI files of a validation: reads results of other detectors, writes ground truth and detections.

**Read:** a folder with ``<site>/<detector>/<frame>.txt`` for every site and every validated frame; the file of a frame
without detections is empty. ``<site>/data`` is a detector with the name of the whole folder. So results can be put
beside the exported files of ``egvs clouds`` (velodyne, label_2, calib ...), or into a folder of their own. All files
are read and checked before any of them is used.

A line has the format of KITTI's results, in the camera frame of the exported calibration
(:mod:`egvs.extensions.validation.kitti`), which converts to the world frame without loss. Pedestrians and cyclists are
left out.

**Written:**

    <folder>/<site>/label_2/<frame>.txt      vehicles whose centre is in the region of interest, visible or not
    <folder>/<site>/calib/<frame>.txt        calibration, as ``egvs clouds`` writes it
    <folder>/<site>/<detector>/<frame>.txt   detections there, all as Car, because detectors return no class

Frames have the numbers of ``egvs clouds``, so its clouds fit; ``--detections`` reads the folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.sweeps import Detections
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.grid import IntArray
from egvs.extensions.validation import detector_results, kitti
from egvs.extensions.validation.dataset_files import LAYOUTS, LevelFrame, frame_name
from egvs.extensions.validation.detector_results import CLASSES, DetectedBoxes, DetectorResult
from egvs.extensions.validation.held_out_traffic import HeldOutTraffic
from egvs.sensors.sites import Pose

IGNORED_CLASSES = frozenset({"Cyclist", "Pedestrian"})
"""Known classes that are left out."""

DATA_FOLDER = "data"
"""Folder of results of KITTI's own programs; the detector then has the name of the whole folder."""

KITTI_FOLDER = "validation_kitti"

PARTIAL_FOLDER = f".{KITTI_FOLDER}.partial"
"""Where the folder is written before it is renamed."""

_EXPORTED_FOLDERS = frozenset(name for layout in LAYOUTS.values() for name in layout.folders)
_LAYOUT_HINT = "Use folders SITE/DETECTOR/000000.txt, with one file per frame."

DetectorResults = dict[str, dict[str, tuple[Detections, ...]]]
"""Detections of each frame, by detector and site."""


@dataclass(frozen=True)
class KittiFiles:
    """The KITTI files of a validation.

    Attributes
    ----------
    detections
        Folder with results of further detectors.
    keep
        Whether to write ground truth and detections.
    """

    detections: Path | None = None
    keep: bool = False


NO_KITTI_FILES = KittiFiles()


def read_kitti_results(folder: Path, poses: Mapping[str, Pose], numbers: IntArray) -> DetectorResults:
    """Read all results of a folder.

    Parameters
    ----------
    folder
        The folder.
    poses
        Pose of each validated site.
    numbers
        Numbers of the validated frames in their recording.

    Returns
    -------
    DetectorResults
        Boxes in the world frame.

    Raises
    ------
    InputError
        Naming file and line: for a site, a detector at a site or a frame that is missing or unknown, another
        calibration than that of ``egvs clouds``, an unknown class, or a line without a score, of a wrong length or with
        values that are no finite numbers.
    """
    if not folder.is_dir():
        raise InputError(folder, "no such folder", _LAYOUT_HINT)
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not path.name.startswith(".") and path.name not in poses:
            raise InputError(path, "the folder is not named after a validated site", f"Use {', '.join(poses)}.")
    folders = {site: _detector_folders(folder, site) for site in poses}
    detectors = sorted(set[str]().union(*folders.values()))
    for site, site_folders in folders.items():
        for name in detectors:
            if name not in site_folders:
                raise InputError(
                    folder / site, f"no results of {name}", "Add the results of each detector at each site."
                )

    results: DetectorResults = {name: {} for name in detectors}
    for site, pose in poses.items():
        _check_calibrations(folder / site / "calib", numbers)
        for name in detectors:
            results[name][site] = _read_site(folders[site][name], LevelFrame(pose), numbers)
    return results


def _detector_folders(folder: Path, site: str) -> dict[str, Path]:
    """Return the folder of each detector's results at a site."""
    site_folder = folder / site
    if not site_folder.is_dir():
        raise InputError(site_folder, "no such folder", _LAYOUT_HINT)
    detectors = {}
    for path in site_folder.iterdir():
        if path.is_dir() and not path.name.startswith(".") and path.name not in _EXPORTED_FOLDERS:
            detectors[path.name] = path
    if DATA_FOLDER in detectors:
        detectors[folder.resolve().name] = detectors.pop(DATA_FOLDER)
    if not detectors:
        raise InputError(site_folder, "the folder contains no results", _LAYOUT_HINT)
    return detectors


def _check_calibrations(folder: Path, numbers: IntArray) -> None:
    """Raise an InputError if there are calibrations beside the results that differ from the exported one."""
    if folder.is_dir():
        for number in numbers.tolist():
            kitti.check_calibration(folder / f"{frame_name(number)}.txt")


def _read_site(folder: Path, level: LevelFrame, numbers: IntArray) -> tuple[Detections, ...]:
    """Read the results of one detector at one site."""
    expected = [f"{frame_name(number)}.txt" for number in numbers.tolist()]
    actual = {path.name for path in folder.iterdir() if path.suffix == ".txt"}
    missing = [name for name in expected if name not in actual]
    if missing:
        others = f", and {len(missing) - 1} others are missing" if len(missing) > 1 else ""
        hint = f"Add one file for each of the {len(expected)} frames, empty where nothing was detected."
        raise InputError(folder / missing[0], f"no such file{others}", hint)
    unknown = sorted(actual.difference(expected))
    if unknown:
        problem = f"expected results of {len(expected)} frames from {expected[0]} to {expected[-1]}"
        raise InputError(folder / unknown[0], problem, "Use the same --frames as for the export of the clouds.")
    return tuple(_read_frame(folder / name, level) for name in expected)


def _read_frame(path: Path, level: LevelFrame) -> Detections:
    """Read the vehicles of one file."""
    labels = kitti.read_labels(path)
    for line, name, score in zip(labels.lines.tolist(), labels.names, labels.scores.tolist(), strict=True):
        if name not in CLASSES:
            raise InputError(f"{path}: line {line}", f"unknown class {name!r}", f"Use one of {', '.join(CLASSES)}.")
        if np.isnan(score):
            raise InputError(f"{path}: line {line}", "no score", "Write 16 values, the last of which is the score.")
    is_vehicle = np.array([name not in IGNORED_CLASSES for name in labels.names], dtype=np.bool_)
    return Detections(level.world_boxes(labels.boxes[is_vehicle]), labels.scores[is_vehicle])


def write_kitti_results(
    folder: Path,
    record: HeldOutTraffic,
    frames: Sequence[TrafficFrame],
    results: Mapping[str, Mapping[str, DetectorResult]],
) -> None:
    """Write ground truth and detections of all sites; replaces the files of an earlier validation.

    Parameters
    ----------
    folder
        The folder to write.
    record
        The traffic and its scene.
    frames
        The validated frames.
    results
        By site and detector.
    """
    partial = folder.with_name(PARTIAL_FOLDER)
    files.remove_folder(partial)
    for site, by_detector in results.items():
        level = LevelFrame(record.scene.site(site).pose)
        _write_truth(partial / site, record, frames, level)
        for name, result in by_detector.items():
            if isinstance(result, DetectedBoxes):
                _write_boxes(partial / site / name, frames, result, level)
    files.remove_folder(folder)
    partial.rename(folder)


def _write_truth(folder: Path, record: HeldOutTraffic, frames: Sequence[TrafficFrame], level: LevelFrame) -> None:
    for name in ("label_2", "calib"):
        (folder / name).mkdir(parents=True)
    for frame in frames:
        rows = frame.target_rows(record.scene.roi)
        classes = detector_results.frame_classes(frame)
        text = kitti.format_labels([classes[row] for row in rows], level.boxes(frame.boxes[rows]))
        files.write_text(folder / "label_2" / f"{frame_name(frame.number)}.txt", text)
        files.write_text(folder / "calib" / f"{frame_name(frame.number)}.txt", kitti.CALIBRATION)


def _write_boxes(folder: Path, frames: Sequence[TrafficFrame], result: DetectedBoxes, level: LevelFrame) -> None:
    folder.mkdir(parents=True)
    for frame, detections in zip(frames, result.frames, strict=True):
        names = ["Car"] * len(detections.scores)
        text = kitti.format_labels(names, level.boxes(detections.boxes), np.asarray(detections.scores))
        files.write_text(folder / f"{frame_name(frame.number)}.txt", text)
