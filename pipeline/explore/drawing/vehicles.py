"""The vehicles of a recorded frame as one mesh: the bodies that point clouds are made with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.traffic_frames import TrafficFrame
from pipeline.core.grid import Vec3
from pipeline.explore.drawing.shapes import Mesh
from pipeline.validation.clouds.bodies import Part

Floats = NDArray[np.float64]


def bodies(
    frame: TrafficFrame,
    kinds: Sequence[str],
    parts: Mapping[str, tuple[Part, ...]],
    which: NDArray[np.bool_],
    zero_m: Vec3,
) -> Mesh:
    """Some vehicles of a frame.

    Parameters
    ----------
    kinds, parts
        The body of each box, and the parts of each body.
    which
        Of the boxes, (n,).
    zero_m
        The point of the world that becomes (0, 0, 0).
    """
    found = [
        _placed(np.concatenate([part.triangles for part in parts[kinds[i]]]), frame.boxes[i], float(frame.pitch_rad[i]))
        for i in np.flatnonzero(which).tolist()
    ]
    corners = np.concatenate(found) - zero_m if found else np.empty((0, 3, 3))
    return Mesh(corners.reshape(-1, 3).astype(np.float32), np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3))


def _placed(triangles: Floats, box: Floats, pitch_rad: float) -> Floats:
    """Triangles (m, 3, 3) of the unit box round zero in a box of :data:`pipeline.artefacts.traffic_frames.BOX`."""
    (cy, cp), (sy, sp) = np.cos((box[6], pitch_rad)), np.sin((box[6], pitch_rad))
    yaw = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    pitch = np.array([[cp, 0.0, -sp], [0.0, 1.0, 0.0], [sp, 0.0, cp]])
    placed: Floats = (triangles * box[3:6]) @ (yaw @ pitch).T + box[:3]
    return placed
