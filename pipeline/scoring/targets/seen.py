"""What is seen of each vehicle of recorded traffic from one site, from its empty scan alone.

The boxes of a frame are laid into the empty scan; a beam ends on the first box that it enters (made 0.1 mm smaller on
each side, as everywhere). Boxes are plain boxes here, as for the TPOG.

Limits: beams that cannot meet the region of interest were not cast, so what of a vehicle reaches out of it has none, or
few; and what stands wholly beyond the region hides none of those. (At ingolstadt it would change 6 of 24,888 counts.)
Where effects lose returns, the points of a vehicle alone are thinned by the chance at its centre's range.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.effects.base import Detect
from pipeline.kernels import targets as kernels
from pipeline.scoring.targets.record import Floats, TargetRecord
from pipeline.scoring.visibility import Beams
from pipeline.sensing.scene import Scene
from pipeline.sensing.sensors import Sensor

_BANDS = 16
"""Bands of slopes that beams are sorted into."""

_SAME_SLOPE = 1e-9
"""Slopes of one ring of a sensor differ by rounding alone, and belong into one band."""

_ROOM = 2**17
"""Hits that are listed at once: bounds the memory."""


def noticed_in(scene: Scene, sensor: Sensor) -> Callable[[Floats], Floats] | None:
    """The chance that a sensor's return from each range (n,) is noticed: what all effects of a scene together detect;
    None where there is no such effect."""
    effects: tuple[Detect[Any], ...] = scene.acting(Detect, "score")
    if not effects:
        return None

    def noticed(range_m: Floats) -> Floats:
        chance = np.ones(len(range_m))
        for effect in effects:
            chance = chance * effect.detect(range_m, sensor)
        return chance

    return noticed


@dataclass(frozen=True, eq=False)
class SeenTargets:
    """What one site sees of the vehicle-frames of a record, row by row, n of them.

    Attributes
    ----------
    record
        The vehicle-frames: frame, vehicle, kind, place, gap to the nearest neighbour, share in the region.
    points
        Beams that meet the vehicle first, with the static world and everything else in the way, (n,) float64: a whole
        number; an expectation where effects weigh beams or lose returns.
    points_alone
        The same with no other box in the way, (n,) float64.
    points_on_sides
        Those of ``points`` that are not on its roof (or, from below, its underside), (n,) float64.
    length_share, width_share
        Share of the vehicle's length and of its width between the outermost of its points, along the box's own axes,
        (n,) float64, 0 to 1; 0 without a point. Where effects weigh beams or lose returns, a beam whose point has any
        chance at all counts in full.
    hole_m
        Longest stretch of the vehicle's length, between its outermost points, that has none, (n,) float64, to 1/64 of
        its length; 0 without a point. Counted as the shares are.
    range_m
        From the sensor to the box's centre, (n,) float64.
    depression_deg
        How far below the sensor's horizon the box's centre is seen, (n,) float64, -90 to 90.
    side
        Sine of the angle in plan between the line of sight and the vehicle's length, (n,) float64: 0 from ahead or
        behind, 1 broadside.
    """

    record: TargetRecord
    points: Floats
    points_alone: Floats
    points_on_sides: Floats
    length_share: Floats
    width_share: Floats
    hole_m: Floats
    range_m: Floats
    depression_deg: Floats
    side: Floats

    def __len__(self) -> int:
        """How many vehicle-frames."""
        return len(self.points)


def see(record: TargetRecord, beams: Beams, noticed: Callable[[Floats], Floats] | None = None) -> SeenTargets:
    """What a site sees.

    Parameters
    ----------
    record
        Of recorded traffic; the same for all sites.
    beams
        The site's empty scan.
    noticed
        The chance that a return from each range (n,) is noticed; 1 where it is None.
    """
    sensor_m = record.grid.to_grid_m(np.asarray(beams.pose.position_m))
    row, values = record.row, record.all_boxes.values
    alone, (total, sides, slices, low, high) = _counted(record, sensor_m, beams, noticed)
    away = values[row, :3] - sensor_m
    range_m, run_m = np.sqrt((away**2).sum(axis=1)), np.hypot(away[:, 0], away[:, 1])
    yaw = values[row, 3]
    across = np.abs(away[:, 1] * np.cos(yaw) - away[:, 0] * np.sin(yaw))
    seen, spans, hole = high[row] >= low[row], np.zeros((len(row), 2)), np.zeros(len(row))
    spans[seen] = (high[row][seen] - low[row][seen]) / values[row, 5:7][seen]
    kernels.holes(slices[row], hole)
    return SeenTargets(
        record=record,
        points=total[row],
        points_alone=alone[row] if noticed is None else alone[row] * noticed(range_m),
        points_on_sides=sides[row],
        length_share=spans[:, 0],
        width_share=spans[:, 1],
        hole_m=hole * values[row, 5],
        range_m=range_m,
        depression_deg=np.degrees(np.arctan2(-away[:, 2], run_m)),
        side=np.divide(across, run_m, out=np.zeros(len(row)), where=run_m > 0.0),
    )


def _in_bands(beams: Beams, bands: int) -> tuple[NDArray[Any], ...]:
    """Beams as :func:`pipeline.kernels.targets.first_met` takes them: in bands of slopes with as many beams in each."""
    ends = beams.ends_m
    azimuth, run_m = np.arctan2(ends[:, 1], ends[:, 0]), np.sqrt(ends[:, 0] ** 2 + ends[:, 1] ** 2)
    length_m = np.sqrt((ends[:, 0] ** 2 + ends[:, 1] ** 2) + ends[:, 2] ** 2)
    with np.errstate(invalid="ignore", divide="ignore"):  # a beam without length meets nothing; one may be vertical
        slope, d = np.nan_to_num(ends[:, 2] / run_m), ends.T / length_m
    parts = np.sort(slope)[len(slope) * np.arange(1, bands) // bands] if len(slope) else slope
    band = np.searchsorted(np.unique(parts), slope + _SAME_SLOPE)
    rows = np.lexsort((azimuth, band))
    starts = np.flatnonzero(np.diff(band[rows], prepend=-1))
    slopes = np.column_stack([np.minimum.reduceat(slope[rows], starts), np.maximum.reduceat(slope[rows], starts)])
    weight = np.ones(len(rows)) if beams.weight is None else beams.weight[rows]
    d = np.take(d, rows, axis=1)  # each axis in one piece, as d[:, rows] is not: the kernel's loops need that
    return np.append(starts, len(rows)), slopes, azimuth[rows], d, length_m[rows], weight


def _counted(
    record: TargetRecord, sensor_m: Floats, site: Beams, noticed: Callable[[Floats], Floats] | None
) -> tuple[Floats, tuple[NDArray[Any], ...]]:
    """Of every box of the record, (b,): the points that it would have alone, were all noticed; and of those that it
    has, how many, how many on its sides, in which slices of its length, and between which bounds (b, 2)."""
    boxes, count = record.all_boxes, len(record.all_boxes.values)
    whole = site.weight is None and noticed is None
    beams = _in_bands(site, _BANDS if whole else 1)  # in one band, shares are added in the order of azimuths alone
    listed = np.zeros(count, dtype=np.bool_)
    listed[record.row] = True
    spans = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    found = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count, dtype=np.uint64), *spans
    length_m, weight = beams[4], beams[5]
    owner, range_m = np.full(len(weight), -1, dtype=np.int32), length_m.copy()
    room = 0 if noticed is None else max(_ROOM, len(weight))
    hits = (np.empty(room, dtype=np.int64), np.empty(room, dtype=np.int64), *np.empty((3, room)))
    every = boxes.starts, boxes.values, boxes.low, boxes.high, listed
    size_m, frame = np.asarray(record.grid.roi.size_m), 0
    while frame < len(record.numbers):
        frame, filled = kernels.first_met(frame, sensor_m, size_m, every, beams, owner, range_m, found, hits)
        if noticed is not None:
            box, row, at_m, along_m, across_m = (column[:filled] for column in hits)
            kernels.add_up(box, weight[row] * noticed(at_m), along_m, across_m, boxes.values, found[1:])
    return found[0], found[1:]
