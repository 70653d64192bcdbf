r"""Read and write files of KITTI's 3D object benchmark: labels and results, and their calibration.

A LiDAR box is its centre x, y, z, length, width, height and heading (counter-clockwise from x, seen from above), in a
frame whose z axis points up. KITTI stores it in a camera's frame (x right, y down, z ahead), by the centre of its
*bottom*, as height, width, length and the rotation about y. The camera of these files is virtual: it is at the LiDAR
and looks along its x axis, so that

.. math:: x_c = -y, \quad y_c = -(z - h/2), \quad z_c = x, \quad r_y = -\theta - \pi/2, \quad
          \alpha = r_y - \operatorname{atan2}(x_c, z_c)

and the inverse is exact. There is no image: the rectangle in it is always 0 0 50 50, which no evaluation takes for too
small.

Source: Geiger, Lenz, Urtasun 2012, the development kit of the benchmark (readme.txt).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.core.numbers import number_or_nan, parse_decimal

_NOT_TRUNCATED_NOT_OCCLUDED = "0.00 0"
_RECTANGLE = "0.00 0.00 50.00 50.00"
_LABEL_VALUES, _RESULT_VALUES = 15, 16
_LABELS_HINT = "Write one object per line, as in KITTI; leave the file empty if there are no objects."

_CAMERA = "1 0 0 0 0 1 0 0 0 0 1 0"
CALIBRATION = (
    "".join(f"P{number}: {_CAMERA}\n" for number in range(4))
    + "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\nTr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0\n"
)
"""The text of a file ``calib/*.txt``; the same for every frame."""

_CAMERA_KEYS = ("R0_rect", "Tr_velo_to_cam")
_CALIBRATION_HINT = "Use the calibration file written by egvs clouds."


@dataclass(frozen=True)
class KittiObjects:
    """The objects of one file.

    Attributes
    ----------
    names
        Class of each, as in the file.
    boxes
        (n, 7) float64, in the LiDAR's frame: centre, length, width, height, heading from -pi to pi.
    scores
        (n,) float64; NaN for labels.
    lines
        Line number of each, from 1, (n,) int64.
    """

    names: tuple[str, ...]
    boxes: FloatArray
    scores: FloatArray
    lines: IntArray


def wrap_angle(angle_rad: FloatArray) -> FloatArray:
    """Return angles from -pi to just below pi."""
    return np.mod(angle_rad + math.pi, 2.0 * math.pi) - math.pi


def to_camera(boxes: FloatArray) -> FloatArray:
    """Convert LiDAR boxes (n, 7) to KITTI's order: height, width, length, x, y, z of the bottom, rotation."""
    x, y, z, length, width, height, heading = boxes.T
    rotation = wrap_angle(-heading - math.pi / 2)
    return np.column_stack([height, width, length, -y, -(z - height / 2), x, rotation])


def from_camera(boxes: FloatArray) -> FloatArray:
    """Convert KITTI boxes (n, 7) to LiDAR boxes, the inverse of :func:`to_camera`."""
    height, width, length, x, y, z, rotation = boxes.T
    return np.column_stack([z, -x, -y + height / 2, length, width, height, wrap_angle(-rotation - math.pi / 2)])


def format_labels(names: Sequence[str], boxes: FloatArray, scores: FloatArray | None = None) -> str:
    """Return the text of a file: one line per box, with its score if there are ``scores``."""
    camera = to_camera(boxes)
    alpha = wrap_angle(camera[:, 6] - np.arctan2(camera[:, 3], camera[:, 5]))
    lines = []
    for i, (name, values) in enumerate(zip(names, camera.tolist(), strict=True)):
        numbers = " ".join(f"{value:.6f}" for value in values)
        line = f"{name} {_NOT_TRUNCATED_NOT_OCCLUDED} {alpha[i]:.6f} {_RECTANGLE} {numbers}"
        if scores is not None:
            line += f" {scores[i]:.6f}"
        lines.append(f"{line}\n")
    return "".join(lines)


def read_labels(path: Path) -> KittiObjects:
    """Read a file of labels or results, in the LiDAR's frame, without objects of the class DontCare.

    Raises
    ------
    InputError
        When the file does not exist or is not text, or when a line has too few or too many values, a value that is not
        a finite number, or a size that is not above 0.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (FileNotFoundError, IsADirectoryError):
        raise InputError(path, "no such file", _LABELS_HINT) from None
    except UnicodeDecodeError:
        raise InputError(path, "the file is not text", _LABELS_HINT) from None
    names, boxes, scores, lines = [], [], [], []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0] == "DontCare":
            continue
        values = _parse_values(f"{path}: line {number}", words)
        lines.append(number)
        names.append(words[0])
        boxes.append(values[7:14])
        score = values[14] if len(words) == _RESULT_VALUES else math.nan
        scores.append(score)
    camera = np.array(boxes, dtype=np.float64).reshape(-1, 7)
    return KittiObjects(
        tuple(names), from_camera(camera), np.array(scores, dtype=np.float64), np.array(lines, dtype=np.int64)
    )


def check_calibration(path: Path) -> None:
    """Check that a calibration file has the camera of :data:`CALIBRATION`, whose boxes are converted exactly.

    Raises
    ------
    InputError
        When it cannot be read, or has another camera.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise InputError(path, "cannot be read", _CALIBRATION_HINT) from None
    entries = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    for line in CALIBRATION.splitlines():
        key, values = line.split(":")
        if key in _CAMERA_KEYS and _parse_floats(entries.get(key, "")) != _parse_floats(values):
            problem = f"expected {key}:{values}, got{entries.get(key, ' none')}"
            raise InputError(path, problem, _CALIBRATION_HINT)


def _parse_floats(text: str) -> list[float] | None:
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return None


def _parse_values(where: str, words: list[str]) -> list[float]:
    """Parse and check the numbers after the class."""
    if len(words) not in (_LABEL_VALUES, _RESULT_VALUES):
        problem = (
            f"expected {_LABEL_VALUES} values (a label) or {_RESULT_VALUES} (a result with score), got {len(words)}"
        )
        raise InputError(where, problem, _LABELS_HINT)
    values = []
    for word in words[1:]:
        value = number_or_nan(word, parse_decimal)
        if not math.isfinite(value):
            raise InputError(where, f"expected a finite number, got {word!r}", _LABELS_HINT)
        values.append(value)
    if min(values[7:10]) <= 0:
        problem = f"expected height, width and length above 0, got {' x '.join(words[8:11])} m"
        raise InputError(where, problem, "Correct the size.")
    return values
