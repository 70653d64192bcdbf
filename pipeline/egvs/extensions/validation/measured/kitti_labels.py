"""Read KITTI labels of the sweeps of a LiDAR: one text file for each sweep, in the frame of a virtual camera.

The camera is that of :mod:`egvs.extensions.validation.kitti`: at the LiDAR, looking along its x axis. A calibration
file with the same name in the folder ``calib`` beside the folder of the labels must state this camera.
"""

from __future__ import annotations

from pathlib import Path

from egvs.extensions.validation import kitti
from egvs.formats.sweep_labels import LabelOptions, SweepLabels, label_class, scores_or_none, sweep_name


def read_labels(path: Path, _options: LabelOptions) -> list[SweepLabels]:
    """Return the labels of one file; InputError as of :func:`egvs.extensions.validation.kitti.read_labels`."""
    calibration = path.parent.parent / "calib" / path.name
    if calibration.is_file():
        kitti.check_calibration(calibration)
    objects = kitti.read_labels(path)
    names = tuple(f"{path.stem}-{line}" for line in objects.lines.tolist())
    classes = tuple(map(label_class, objects.names))
    scores = scores_or_none(objects.scores.tolist())
    return [SweepLabels(path, sweep_name(path), names, classes, objects.boxes, has_tracks=False, scores=scores)]
