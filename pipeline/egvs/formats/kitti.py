r"""KITTI's files of the 3D object benchmark: lines of labels and results, and the calibration that goes with them.

A box of a LiDAR is its centre x, y, z, length, width, height and heading (counter-clockwise from x, seen from above),
in a frame whose z axis is up. KITTI writes it in a camera's frame (x right, y down, z ahead), by the middle of its
*bottom*, as height, width, length and the turn about y. The camera of these files is thought: it stands where the LiDAR
stands and looks along its x axis, so that

.. math:: x_c = -y, \quad y_c = -(z - h/2), \quad z_c = x, \quad r_y = -\theta - \pi/2, \quad
          \alpha = r_y - \operatorname{atan2}(x_c, z_c)

and back without loss. There is no picture: every rectangle in the picture is the same, 0 0 50 50, which no evaluation
takes for too small.

Source: Geiger, Lenz, Urtasun 2012, the development kit of the benchmark (readme.txt).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from egvs.core.errors import InputError

Floats = NDArray[np.float64]

_TRUNCATED = "0.00 0"  # and not occluded: both are said of pictures
_RECTANGLE = "0.00 0.00 50.00 50.00"
_VALUES_PER_LINE = 15  # of a label; a result has its score too

_CAMERA = "1 0 0 0 0 1 0 0 0 0 1 0"
CALIBRATION = (
    "".join(f"P{number}: {_CAMERA}\n" for number in range(4))
    + "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\nTr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0\n"
)
"""The text of a file ``calib/*.txt``; the same for every frame."""

_CAMERA_KEYS = ("R0_rect", "Tr_velo_to_cam")


@dataclass(frozen=True)
class KittiObjects:
    """The lines of one file.

    Attributes
    ----------
    names
        The class of each, as it stands there.
    boxes
        (n, 7) float64, in the LiDAR's frame: centre, length, width, height, heading from -pi to pi.
    scores
        (n,) float64; NaN for a label, which has none.
    lines
        Where each stands, counted from 1, (n,) int64.
    """

    names: tuple[str, ...]
    boxes: Floats
    scores: Floats
    lines: NDArray[np.int64]


def wrap_angle(angle_rad: Floats) -> Floats:
    """Angles from -pi to just below pi."""
    return np.mod(angle_rad + math.pi, 2.0 * math.pi) - math.pi


def to_camera(boxes: Floats) -> Floats:
    """Boxes of the LiDAR's frame (n, 7) as KITTI has them: height, width, length, x, y, z of the bottom, turn."""
    x, y, z, length, width, height, heading = boxes.T
    turn = wrap_angle(-heading - math.pi / 2)
    return np.column_stack([height, width, length, -y, -(z - height / 2), x, turn])


def from_camera(boxes: Floats) -> Floats:
    """The inverse of :func:`to_camera`, for the calibration of these files."""
    height, width, length, x, y, z, turn = boxes.T
    return np.column_stack([z, -x, -y + height / 2, length, width, height, wrap_angle(-turn - math.pi / 2)])


def format_labels(names: Sequence[str], boxes: Floats, scores: Floats | None = None) -> str:
    """The text of a file: one line a box, with its score where it has one."""
    camera = to_camera(boxes)
    alpha = wrap_angle(camera[:, 6] - np.arctan2(camera[:, 3], camera[:, 5]))
    rows = []
    for at, (name, values) in enumerate(zip(names, camera.tolist(), strict=True)):
        numbers = " ".join(f"{value:.6f}" for value in values)
        score = "" if scores is None else f" {scores[at]:.6f}"
        rows.append(f"{name} {_TRUNCATED} {alpha[at]:.6f} {_RECTANGLE} {numbers}{score}\n")
    return "".join(rows)


def read_labels(path: Path) -> KittiObjects:
    """The lines of a file of labels or results, in the LiDAR's frame; those of the class DontCare are left out.

    Raises
    ------
    InputError
        For a file that is not there or no text; naming the line: too few or too many values, what is no finite number,
        a size that is not above 0.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (FileNotFoundError, IsADirectoryError):
        raise InputError(path, "no such file", "a text file, one line an object (empty where there is none)") from None
    except UnicodeDecodeError:
        raise InputError(path, "is no text", "one line an object, as KITTI has them") from None
    names, boxes, scores, at = [], [], [], []
    for number, line in enumerate(text.splitlines(), 1):
        if not (words := line.split()) or words[0] == "DontCare":
            continue
        values = _numbers(f"{path}: line {number}", words)
        at.append(number)
        names.append(words[0])
        boxes.append(values[7:14])
        scores.append(values[14] if len(words) > _VALUES_PER_LINE else math.nan)
    camera = np.array(boxes, dtype=np.float64).reshape(-1, 7)
    numbers = np.array(at, dtype=np.int64)
    return KittiObjects(tuple(names), from_camera(camera), np.array(scores, dtype=np.float64), numbers)


def check_calibration(path: Path) -> None:
    """Hold a file of calibration against :data:`CALIBRATION`, which alone brings boxes back without loss.

    Raises
    ------
    InputError
        When it cannot be read, or the camera stands otherwise.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise InputError(path, "cannot be read", "a calibration as `egvs clouds` writes it") from None
    entries = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    for line in CALIBRATION.splitlines():
        key, values = line.split(":")
        if key in _CAMERA_KEYS and _floats(entries.get(key, "")) != _floats(values):
            found = f"{key} is{entries[key]}" if key in entries else f"has no {key}"
            raise InputError(path, found, f"{key}:{values}, as `egvs clouds` writes it")


def _floats(text: str) -> list[float] | None:
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return None


def _numbers(where: str, words: list[str]) -> list[float]:
    """The numbers after the class; InputError where they are not as they should be."""
    if len(words) not in (_VALUES_PER_LINE, _VALUES_PER_LINE + 1):
        right = f"{_VALUES_PER_LINE} (a label) or {_VALUES_PER_LINE + 1} (a result, whose last is its score)"
        raise InputError(where, f"holds {len(words)} values", right)
    values = []
    for word in words[1:]:
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(where, repr(word), "a finite number")
        values.append(value)
    if min(values[7:10]) <= 0:
        raise InputError(where, f"a size of {' x '.join(words[8:11])} m", "height, width and length above 0")
    return values
