"""Writes ground truth and detections as KITTI's labels and results, for other programs to evaluate or to draw.

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

from pipeline.artefacts.traffic_frames import TrafficFrame
from pipeline.core import files
from pipeline.formats import kitti
from pipeline.validation import classes
from pipeline.validation.exports.level_frame import LevelFrame
from pipeline.validation.exports.sites import frame_name
from pipeline.validation.site_findings import Found, FoundBoxes
from pipeline.validation.unseen_record import UnseenRecord

FOLDER = "validation_kitti"
ASIDE = f".{FOLDER}.partial"
"""Where it is written first."""


def write(
    folder: Path, record: UnseenRecord, frames: Sequence[TrafficFrame], found: Mapping[str, Mapping[str, Found]]
) -> None:
    """Write all sites into ``folder``, in place of what an earlier call has written there."""
    aside = folder.with_name(ASIDE)
    shutil.rmtree(aside, ignore_errors=True)
    for site, its in found.items():
        level = LevelFrame(record.scene.site(site).pose)
        _write_truth(aside / site, record, frames, level)
        for name, what in its.items():
            if isinstance(what, FoundBoxes):
                _write_results(aside / site / name, frames, what, level)
    if folder.exists():
        shutil.rmtree(folder)
    aside.rename(folder)


def _write_truth(folder: Path, record: UnseenRecord, frames: Sequence[TrafficFrame], level: LevelFrame) -> None:
    for name in ("label_2", "calib"):
        (folder / name).mkdir(parents=True)
    for frame in frames:
        wanted, kinds = frame.wanted(record.scene.roi), classes.of_frame(frame)
        text = kitti.lines([kinds[row] for row in wanted], level.boxes(frame.boxes[wanted]))
        files.write_text(folder / "label_2" / f"{frame_name(frame.number)}.txt", text)
        files.write_text(folder / "calib" / f"{frame_name(frame.number)}.txt", kitti.CALIBRATION)


def _write_results(folder: Path, frames: Sequence[TrafficFrame], what: FoundBoxes, level: LevelFrame) -> None:
    folder.mkdir(parents=True)
    for frame, its in zip(frames, what.frames, strict=True):
        text = kitti.lines(["Car"] * len(its.scores), level.boxes(its.boxes), np.asarray(its.scores))
        files.write_text(folder / f"{frame_name(frame.number)}.txt", text)
