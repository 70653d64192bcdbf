"""Sweeps and detections: what a detector receives and returns.

A detector sees one sweep of one sensor: points in the sensor's frame, each with the index of its beam. It knows its
site (a :class:`SiteView`: pose, sensor, empty scan), as every roadside unit does after calibration. It returns boxes in
the world frame, with scores.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egvs.core.grid import FloatArray, IntArray
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Pose


@dataclass(frozen=True)
class Sweep:
    """One revolution of a sensor.

    Attributes
    ----------
    points
        x, y, z in metres in the sensor's frame (x ahead, y left, z up, as it is mounted), and intensity 0 to 1, NaN
        where it is unknown; (n, 4) float32.
    beam
        Index of each point's beam in the sensor's table, (n,) uint32, ascending.
    """

    points: NDArray[np.float32]
    beam: NDArray[np.uint32]


@dataclass(frozen=True)
class LabelledSweep:
    """A sweep, and the box of the frame that each point lies on.

    Attributes
    ----------
    sweep
        The points.
    owner
        Row of the frame's boxes, -1 on the static world; (n,) int32.
    """

    sweep: Sweep
    owner: NDArray[np.int32]

    def points_on(self, boxes: int) -> IntArray:
        """Return the number of points on each of the frame's boxes, (boxes,) int64."""
        return np.bincount(self.owner[self.owner >= 0], minlength=boxes)


@dataclass(frozen=True)
class SiteView:
    """What a detector knows about its site.

    Attributes
    ----------
    site
        Name of the site.
    pose
        Pose of the sensor in the world frame.
    sensor
        The sensor and its beams.
    empty_range_m
        Range of the empty scan along each beam, (beams,) float64; infinite where there was no return.
    """

    site: str
    pose: Pose
    sensor: Sensor
    empty_range_m: FloatArray


@dataclass(frozen=True)
class Detections:
    """Boxes that a detector returns for one sweep.

    Attributes
    ----------
    boxes
        (m, 7) float64, as :data:`egvs.artefacts.traffic_frames.BOX_COLUMNS`: centre in the world frame, length, width,
        height, heading.
    scores
        Confidence of each box, (m,) float64; higher is more certain.
    """

    boxes: FloatArray
    scores: FloatArray

    @classmethod
    def empty(cls) -> Detections:
        """Return no boxes."""
        return cls(np.empty((0, 7)), np.empty(0))
