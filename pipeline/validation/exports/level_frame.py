r"""The frame that exported points and boxes stand in: the sensor's place, its yaw, and a z axis that is up.

A sensor may be tilted, but a box of KITTI or OpenPCDet has no angle save its heading about the vertical. So points are
turned by the sensor's roll and pitch, and the yaw is left: x is level and points along the site's yaw, y to the left,
z up. For a sensor that is not tilted this is the sensor's own frame, to the bit.

.. math:: p_{level} = R_y(-pitch)\, R_x(roll)\, p_{sensor}, \qquad p_{world} = R_z(yaw)\, p_{level} + t
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.formats.kitti import wrapped
from pipeline.sensing.sensors import rotation
from pipeline.sensing.sites import Pose

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LevelFrame:
    """The level frame of one pose."""

    pose: Pose

    @property
    def T_world_level(self) -> Floats:
        """Brings points of this frame into the world's, (4, 4) float64."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotation(self.pose.yaw_deg, 0.0, 0.0)
        matrix[:3, 3] = self.pose.position_m
        return matrix

    def points(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Points of the sensor's frame, x, y, z, intensity (n, 4), in this one."""
        _, pitch_deg, roll_deg = self.pose.angles_deg
        if pitch_deg == 0.0 and roll_deg == 0.0:
            return points
        level = points.copy()
        level[:, :3] = _turned(rotation(0.0, pitch_deg, roll_deg), points[:, :3].astype(np.float64))
        return level

    def boxes(self, boxes: Floats) -> Floats:
        """Boxes of the world frame (n, 7) in this one; headings from -pi to pi."""
        yaw_deg, _, _ = self.pose.angles_deg
        level = boxes.copy()
        level[:, :3] = _turned(rotation(yaw_deg, 0.0, 0.0).T, boxes[:, :3] - np.asarray(self.pose.position_m))
        level[:, 6] = wrapped(boxes[:, 6] - np.radians(yaw_deg))
        return level

    def world_boxes(self, boxes: Floats) -> Floats:
        """The inverse of :meth:`boxes`."""
        yaw_deg, _, _ = self.pose.angles_deg
        world = boxes.copy()
        world[:, :3] = _turned(rotation(yaw_deg, 0.0, 0.0), boxes[:, :3]) + np.asarray(self.pose.position_m)
        world[:, 6] = wrapped(boxes[:, 6] + np.radians(yaw_deg))
        return world


def corners(boxes: Floats) -> Floats:
    """The eight corners of each upright box (n, 7), (n, 8, 3)."""
    signs = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    spread = boxes[:, None, 3:6] * signs
    cos, sin = np.cos(boxes[:, 6:7]), np.sin(boxes[:, 6:7])
    x, y = spread[..., 0] * cos - spread[..., 1] * sin, spread[..., 0] * sin + spread[..., 1] * cos
    found: Floats = np.stack([x, y, spread[..., 2]], axis=-1) + boxes[:, None, :3]
    return found


def _turned(matrix: Floats, points: Floats) -> Floats:
    """Written out: a BLAS may sum in another order on another machine."""
    found: Floats = points[:, :1] * matrix[:, 0] + points[:, 1:2] * matrix[:, 1] + points[:, 2:3] * matrix[:, 2]
    return found
