r"""How much of two boxes is common to both: intersection over union, from above and in space.

From above (BEV) boxes are rotated rectangles, and the overlap is area over area. In space it is volume over volume: the
shared area times the shared height. Boxes stand upright, pitch is left out, as in KITTI.

.. math:: IoU_{BEV} = \frac{A_{ab}}{A_a + A_b - A_{ab}}, \qquad
          IoU_{3D} = \frac{A_{ab} h_{ab}}{V_a + V_b - A_{ab} h_{ab}}
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.kernels import matching as kernel

View = Literal["bev", "3d"]

VIEWS: tuple[View, ...] = ("bev", "3d")


def overlap_each(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Overlap of box k of a with box k of b.

    Parameters
    ----------
    a, b
        (n, 7) float64, as :data:`pipeline.artefacts.traffic_frames.BOX`.

    Returns
    -------
    NDArray
        In the order of :data:`VIEWS`, (2, n) float64, 0 to 1; 0 for boxes without any area or volume.
    """
    found = np.empty((len(VIEWS), len(a)))
    kernel.overlap_each(np.ascontiguousarray(a, np.float64), np.ascontiguousarray(b, np.float64), found[0], found[1])
    return found
