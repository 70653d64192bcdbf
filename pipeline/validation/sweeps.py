"""What a detector is given, and what it gives back.

A detector sees one sweep of one sensor: points in the sensor's frame, and of each the beam that it came along. It knows
where it stands (a :class:`SiteView`: pose, sensor, empty scan), as every roadside unit does after calibration. It gives
boxes in the world frame, with scores.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.sensing.sensors import Sensor
from pipeline.sensing.sites import Pose


@dataclass(frozen=True)
class Sweep:
    """One turn of a sensor.

    Attributes
    ----------
    points
        x, y, z in metres in the sensor's frame (x ahead, y left, z up, as it is mounted), and intensity 0 to 1; (n, 4)
        float32.
    beam
        Index of each point's beam in the sensor's table, (n,) uint32, ascending.
    """

    points: NDArray[np.float32]
    beam: NDArray[np.uint32]


@dataclass(frozen=True)
class LabelledSweep:
    """A sweep, and which box of its frame each point lies on.

    Attributes
    ----------
    owner
        Row of the frame's boxes, -1 on the static world; (n,) int32.
    """

    sweep: Sweep
    owner: NDArray[np.int32]

    def points_on(self, boxes: int) -> NDArray[np.int64]:
        """How many points lie on each of the frame's boxes, (boxes,) int64."""
        return np.bincount(self.owner[self.owner >= 0], minlength=boxes)


@dataclass(frozen=True)
class SiteView:
    """What a detector knows of the site that it works at.

    Attributes
    ----------
    site
        Its name.
    pose, sensor
        Where the sensor is and how it is mounted, and which beams it has.
    empty_range_m
        Range of the empty scan along each beam, (beams,) float64; infinite where nothing was met.
    """

    site: str
    pose: Pose
    sensor: Sensor
    empty_range_m: NDArray[np.float64]


@dataclass(frozen=True)
class Detections:
    """Boxes that a detector gives for one sweep.

    Attributes
    ----------
    boxes
        (m, 7) float64, as :data:`pipeline.artefacts.traffic_frames.BOX`: centre in the world frame, length, width,
        height, heading.
    scores
        (m,) float64; a higher one is a surer detection.
    """

    boxes: NDArray[np.float64]
    scores: NDArray[np.float64]

    @classmethod
    def none(cls) -> Detections:
        """Nothing was found."""
        return cls(np.empty((0, 7)), np.empty(0))
