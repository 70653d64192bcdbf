"""Counts how many points of a site lie on each vehicle of recorded traffic.

The boxes of a frame are laid into the empty scan; a beam ends on the first box that it enters (made 0.1 mm smaller on
each side, as everywhere). Counted are the vehicles whose centre is in the region of interest; everything else of the
frame is in the way. Boxes are plain boxes here, as for the TPOG.

Limits: beams that cannot meet the region of interest were not cast, so what of a vehicle reaches out of it has none.
Where effects lose returns, the points of a vehicle alone are thinned by the chance at its centre's range.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from pipeline.core.grid import Grid
from pipeline.kernels import occlusion
from pipeline.kernels.targets import first_met
from pipeline.scoring.visibility import Beams
from pipeline.validation.frames import TrafficFrame
from pipeline.validation.surrogates.evidence import Floats, VehiclePoints, everything

FRAMES = 250
"""Frames that are replayed, evenly spaced over the record."""

_KERNEL_ORDER = [0, 1, 2, 6, 7, 3, 4, 5]
"""Columns of ``frames.BOX`` and pitch, as kernels take a box: centre, yaw, pitch, sizes."""


def points_on_vehicles(
    frames: Iterable[TrafficFrame], grid: Grid, beams: Beams, noticed: Callable[[Floats], Floats] = everything
) -> VehiclePoints:
    """Count points of one site.

    Parameters
    ----------
    frames
        Of recorded traffic.
    grid
        Its region of interest is where vehicles are counted.
    beams
        The empty scan.
    noticed
        The chance that a return from each range (n,) is noticed.
    """
    azimuth = np.arctan2(beams.ends_m[:, 1], beams.ends_m[:, 0])
    rows = np.argsort(azimuth, kind="stable")
    azimuth, ends = azimuth[rows], beams.ends_m[rows]
    length_m = np.sqrt((ends**2).sum(axis=1))
    with np.errstate(invalid="ignore", divide="ignore"):  # a beam without length meets nothing
        d = ends / length_m[:, None]
    weight = np.ones(len(rows)) if beams.weight is None else beams.weight[rows]
    sensor_m = grid.to_grid_m(np.asarray(beams.pose.position_m))
    owner, range_m = np.empty(len(rows), dtype=np.int64), np.empty(len(rows))
    seen, alone = [np.empty(0)], [np.empty(0)]
    for frame in frames:
        wanted = frame.wanted(grid.roi)
        facing, span, box, centre_m = _facing(frame, grid, sensor_m)
        counted, met = np.empty(len(box)), np.zeros((2, len(frame.boxes)))
        first_met(facing, span, azimuth, d, length_m, weight, counted, owner, range_m)
        met[0, box] = counted * noticed(centre_m)
        hit = owner >= 0
        met[1] = np.bincount(box[owner[hit]], weight[hit] * noticed(range_m[hit]), minlength=len(frame.boxes))
        alone.append(met[0, wanted])
        seen.append(met[1, wanted])
    return VehiclePoints(np.concatenate(seen), np.concatenate(alone))


def _facing(frame: TrafficFrame, grid: Grid, sensor_m: Floats) -> tuple[Floats, Floats, NDArray[np.int64], Floats]:
    """The boxes of a frame that can stand between a sensor and the grid: as :func:`occlusion.face` fills ``facing``,
    ``span`` and ``box``, and how far away their centres are."""
    boxes = np.ascontiguousarray(np.column_stack([frame.boxes, frame.pitch_rad])[:, _KERNEL_ORDER])
    boxes[:, :3] = grid.to_grid_m(boxes[:, :3])
    most = len(boxes)
    low, high = np.empty((most, 3)), np.empty((most, 3))
    occlusion.bounds(boxes, low, high)
    facing, block, span = np.empty((most, 15)), np.empty((most, 9)), np.empty((most, 2))
    box, centre_m = np.empty(most, dtype=np.int64), np.sqrt(((boxes[:, :3] - sensor_m) ** 2).sum(axis=1))
    size_m = np.asarray(grid.roi.size_m)
    kept = occlusion.face(sensor_m, np.argsort(centre_m), boxes, low, high, size_m, facing, block, span, box)
    return facing[:kept], span[:kept], box[:kept], centre_m[box[:kept]]
