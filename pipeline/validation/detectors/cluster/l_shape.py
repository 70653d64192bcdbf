"""Rectangles of clusters, seen from above, by the closeness criterion (:mod:`pipeline.kernels.detection.l_shape`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import cosdg, sindg

from pipeline.kernels.detection import l_shape as kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

HEADINGS = 90
"""How many headings of a quarter turn are tried."""

ON_SIDE_M = 0.05
"""Points nearer than this lie on a side."""


@dataclass(frozen=True)
class Rectangles:
    """The smallest rectangle round each cluster, at its best heading.

    Attributes
    ----------
    yaw_rad
        Of the first axis, 0 to pi/2, (m,) float64; the second is a quarter turn further, counter-clockwise.
    ends_m
        Low and high end along both axes, (m, 2, 2) float64.
    closeness
        How near the points lie to two sides, 0 to 1, (m,) float64.
    """

    yaw_rad: Floats
    ends_m: Floats
    closeness: Floats

    def along_axes(self, k: int, xy_m: Floats) -> Floats:
        """Places (n, 2) along the axes of a rectangle."""
        c, s = np.cos(self.yaw_rad[k]), np.sin(self.yaw_rad[k])
        return np.column_stack([c * xy_m[:, 0] + s * xy_m[:, 1], c * xy_m[:, 1] - s * xy_m[:, 0]])


def rectangles(xy_m: Floats, starts: Ints) -> Rectangles:
    """The rectangles of clusters, whose points (n, 2) begin at ``starts``, (m + 1,)."""
    degrees = np.arange(HEADINGS) * (90.0 / HEADINGS)
    clusters = len(starts) - 1
    heading, ends_m, closeness = np.empty(clusters, np.int64), np.empty((clusters, 4)), np.empty(clusters)
    kernel.fit(xy_m, starts, cosdg(degrees), sindg(degrees), ON_SIDE_M, heading, ends_m, closeness)
    return Rectangles(np.deg2rad(degrees)[heading], ends_m.reshape(-1, 2, 2), closeness)
