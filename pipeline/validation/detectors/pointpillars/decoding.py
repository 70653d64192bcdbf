"""Turns the network's maps into boxes.

At each cell of the output map, the network says how much this looks like the middle of a vehicle, and what a box there
is: how far its middle is from the cell's, its height over the ground, its size, and twice its heading (a box looks the
same from both ends). Peaks of the first map are detections (Yin et al. 2021, CVPR, section 4); of two that overlap, the
surer one stays.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from pipeline.validation.detectors.pointpillars.encoding import PILLAR_M

Floats = NDArray[np.float64]

STRIDE = 2
"""Pillars along each side of a cell of the output map."""

OUT_M = PILLAR_M * STRIDE
VALUES = 8
"""Of a box: x and y from the cell's middle in cells, z, log length, log width, log height, sine and cosine of twice the
heading."""

_LEAST_SCORE = 0.05
_MOST = 100


def encode(boxes: Floats) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """What the network should say of boxes: their cells (n, 2), and their values (n, VALUES).

    Boxes (n, 7): x, y in metres from the window's first corner, z of the centre as the convention counts heights,
    length, width, height, heading in the window.
    """
    cell = np.floor(boxes[:, :2] / OUT_M).astype(np.int64)
    from_middle = boxes[:, :2] / OUT_M - cell - 0.5
    turns = np.column_stack([np.sin(2 * boxes[:, 6]), np.cos(2 * boxes[:, 6])])
    values = np.column_stack([from_middle, boxes[:, 2], np.log(boxes[:, 3:6]), turns])
    return cell, values.astype(np.float32)


def decode(heat: NDArray[np.float32], values: NDArray[np.float32]) -> tuple[Floats, Floats]:
    """Boxes (m, 7), as in :func:`encode`, and scores (m,), the surest first.

    Parameters
    ----------
    heat
        Chance that a vehicle's middle is in each cell, (cells, cells).
    values
        (VALUES, cells, cells).
    """
    peaks = (heat >= _LEAST_SCORE) & (heat == maximum_filter(heat, size=3, mode="constant"))
    cell = np.argwhere(peaks)
    scores = heat[peaks].astype(np.float64)
    best = np.argsort(-scores, kind="stable")[:_MOST]
    cell, scores = cell[best], scores[best]
    found = values[:, cell[:, 0], cell[:, 1]].T.astype(np.float64)
    xy = (cell + 0.5 + found[:, :2]) * OUT_M
    sizes = np.exp(np.clip(found[:, 3:6], -2.0, 4.0))
    yaw = 0.5 * np.arctan2(found[:, 6], found[:, 7])
    return np.column_stack([xy, found[:, 2], sizes, yaw]), scores
