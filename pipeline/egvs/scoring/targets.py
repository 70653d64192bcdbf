r"""Vehicles of recorded frames, and what a site sees of each of them.

Steps: read some frames of ``trajectories.parquet``, evenly spread over the record; arrange their boxes for the kernels;
compute once for all sites what depends on traffic only (:class:`TargetRecord`); count for each site the beams that
hit each vehicle first (:func:`visible_targets`); average over vehicles (:func:`weighted_mean`), over all of them and
with each group of frames left out (:class:`FrameGroups`).

Targets are the boxes of :meth:`egvs.artefacts.traffic_frames.TrafficFrame.target_rows`: boxes with their centre in the
region of interest, one for each part of an articulated vehicle; pedestrians and bicycles only on request. Each such box
in a frame is one *vehicle-frame*, a row here. All other boxes of a frame only occlude.

Visibility is computed from the empty scan: the boxes of a frame are inserted, and a beam ends on the first box that it
enters (made 0.1 mm smaller on each side, as for the TPOG).

Limits: beams that cannot meet the region of interest were not cast, so the part of a vehicle outside the region gets no
or few points, and vehicles entirely beyond the region occlude nothing. (At ingolstadt it would change 6 of 24,888
counts.) Where effects lose returns, the points of an unoccluded vehicle are thinned by the probability at the range of
its centre.

Standard errors of means over vehicle-frames: neighbouring vehicle-frames are correlated, so errors come from the blocks
of frames that the TPOG was counted in, joined to groups as for the EGVS (:mod:`egvs.scoring.standard_errors`). A mean
over vehicle-frames is a ratio of two sums, of values and of vehicles. Traffic changes both, so the group is left out of
both,

.. math:: S_{(g)} = \frac{\sum_i v_i - \sum_{i \in g} v_i}{N - N_g}

and :class:`egvs.scoring.standard_errors.ScoreUncertainty` computes standard errors, intervals and comparisons from
them. Where traffic is a mix of records (periods), a vehicle-frame counts as often as the mix takes its frame, divided
by the share of frames that are replayed; the rest of a record without a group keeps the record's weight.

``[score.weights]`` weights each vehicle-frame: the weight of its kind times that of every zone that contains its
centre.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts import parquet, traffic_frames
from egvs.artefacts.frame_boxes import NON_VEHICLE_KINDS
from egvs.artefacts.tpog import PeriodBlocks, read_periods
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core.errors import Diagnostic
from egvs.core.grid import BoolArray, FloatArray, Grid, IntArray
from egvs.effects.returns import ReturnProbability, reflectivity_of
from egvs.kernels import occlusion, vehicle_visibility
from egvs.scenario.model import SCENARIO_FILE
from egvs.scenario.score_config import DEFAULT_SAMPLED_FRAMES, WeightsConfig
from egvs.scoring.standard_errors import BlockGroups, block_groups
from egvs.scoring.visibility import Beams

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry


SEEN_WELL_POINTS = 20.0
"""n0: the gain of a vehicle with this many points is 63 %, with three times as many 95 %."""

_KERNEL_ORDER = [0, 1, 2, 6, 7, 3, 4, 5]
"""Columns of ``traffic_frames.BOX_COLUMNS`` and pitch, in the order of kernels: centre, yaw, pitch, sizes."""

_BANDS = 12
"""Number of bands of slopes that beams are sorted into."""

_STRIDE = 13
"""Every so manyth beam tells where bands begin; not a divisor of any common number of channels."""

_STEPS_PER_M = 50.0
"""Steps of range between which the probability of returns is interpolated."""

MAX_HITS = 2**17
"""Hits that are listed at once, which bounds the memory."""


@dataclass(frozen=True, eq=False)
class AllBoxes:
    """Every box of the replayed frames, in the form that kernels take and in the grid's frame.

    Attributes
    ----------
    starts
        Boxes starts[f] to starts[f + 1] are those of frame f, (frames + 1,) int64.
    values
        Centre, yaw, pitch, length, width, height, (b, 8) float64, metres and radians.
    low, high
        Corners of the axis-aligned bounding box of each, (b, 3) float64, metres.
    are_vehicles
        Which boxes are neither pedestrians nor bicycles, (b,) bool.
    vehicle
        Number of the road user that each box is of, the same for all parts of a vehicle and in all frames, (b,) int64.
    """

    starts: IntArray
    values: FloatArray
    low: FloatArray
    high: FloatArray
    are_vehicles: BoolArray
    vehicle: IntArray

    @classmethod
    def of(cls, frames: Sequence[TrafficFrame], grid: Grid) -> AllBoxes:
        """Collect the boxes of frames, which are in the world frame."""
        rows = [np.column_stack([frame.boxes, frame.pitch_rad])[:, _KERNEL_ORDER] for frame in frames]
        values = np.ascontiguousarray(np.concatenate([np.empty((0, 8)), *rows]))
        values[:, :3] = grid.to_grid_m(values[:, :3])
        low, high = np.empty((len(values), 3)), np.empty((len(values), 3))
        occlusion.box_bounds(values, low, high)
        ends = np.cumsum([len(frame_rows) for frame_rows in rows], dtype=np.int64)
        are_vehicles = np.concatenate([np.empty(0, dtype=np.bool_), *(frame.are_vehicles() for frame in frames)])
        _, vehicle = _index_names([name for frame in frames for name in frame.vehicles])
        return cls(np.append(0, ends), values, low, high, are_vehicles, vehicle)

    def between(self, sensor_m: FloatArray, size_m: FloatArray) -> tuple[IntArray, IntArray]:
        """Select the boxes that can be between a sensor (3,) and the grid, the box from 0 to ``size_m`` (3,).

        Returns
        -------
        starts, order
            Boxes order[starts[f]] to order[starts[f + 1]] are those of frame f, nearest first, (frames + 1,) and (m,)
            int64.
        """
        is_apart = np.zeros(len(self.values), dtype=np.bool_)
        for axis in range(3):
            is_apart |= self.low[:, axis] > max(sensor_m[axis], size_m[axis])
            is_apart |= self.high[:, axis] < min(sensor_m[axis], 0.0)
        order = np.flatnonzero(~is_apart)
        starts = np.searchsorted(order, self.starts)
        x_m, y_m, z_m = (self.values[order, :3] - sensor_m).T
        frame = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        return starts, order[np.lexsort((x_m * x_m + y_m * y_m + z_m * z_m, frame))]


@dataclass(frozen=True, eq=False)
class TargetRecord:
    """Vehicle-frames, frame after frame, in the order of the trajectories; n of them.

    Attributes
    ----------
    grid
        Vehicles in its region of interest are the targets.
    numbers
        Numbers of the replayed frames in their record, (frames,) int64, ascending; with or without vehicles.
    frame
        Index into ``numbers`` of each row, (n,) int64, ascending.
    vehicles, vehicle
        SUMO's identifiers, sorted; and the index of each row's, (n,) int64.
    kinds, kind
        SUMO's vClasses, sorted; and the index of each row's, (n,) int64.
    part
        0, or 1.. for the rear parts of an articulated vehicle, (n,) int64.
    boxes
        Centre in the world frame, length, width, height, heading, (n, 7) float64, as
        :data:`egvs.artefacts.traffic_frames.BOX_COLUMNS`.
    pitch_rad
        Nose up, (n,) float64.
    gap_m
        Smallest distance in plan from the box's rectangle to that of any other vehicle of the frame, in the region or
        not, (n,) float64; 0 where they overlap, infinity if there is no other. The parts of an articulated vehicle are
        neighbours of each other, as they are separate boxes; people are not neighbours.
    all_boxes, row
        Every box of the frames, and the index of each row's box, (n,) int64.
    """

    grid: Grid
    numbers: IntArray
    frame: IntArray
    vehicles: tuple[str, ...]
    vehicle: IntArray
    kinds: tuple[str, ...]
    kind: IntArray
    part: IntArray
    boxes: FloatArray
    pitch_rad: FloatArray
    gap_m: FloatArray
    all_boxes: AllBoxes
    row: IntArray

    def __len__(self) -> int:
        """Number of vehicle-frames."""
        return len(self.row)

    @property
    def are_people(self) -> BoolArray:
        """Which rows are on foot or on a bicycle, (n,)."""
        return np.array([kind in NON_VEHICLE_KINDS for kind in self.kinds], dtype=np.bool_)[self.kind]

    @property
    def reflectivity(self) -> FloatArray:
        """Reflectivity of each row by its class, (n,) float64."""
        return reflectivity_of(self.kinds)[self.kind]

    @classmethod
    def read(
        cls, path: Path, grid: Grid, frames: int = DEFAULT_SAMPLED_FRAMES, people: Collection[str] = ()
    ) -> TargetRecord:
        """Read ``trajectories.parquet``.

        Parameters
        ----------
        path
            The file.
        grid
            Its region of interest contains the targets.
        frames
            Number of frames, evenly spread over the record; all for 0, or for more than there are.
        people
            vClasses of pedestrians and bicycles that are targets too.

        Raises
        ------
        InputError
            For a file that is corrupt or out of order.
        """
        recorded = int(parquet.read_metadata(path, "trajectories")["frames"])
        numbers = traffic_frames.spaced_frames(recorded, frames)
        return cls.of(list(traffic_frames.read_frames(path, numbers)), grid, people)

    @classmethod
    def of(cls, frames: Sequence[TrafficFrame], grid: Grid, people: Collection[str] = ()) -> TargetRecord:
        """Collect the targets of frames, in the order of their record; parameters as in :meth:`read`."""
        boxes = AllBoxes.of(frames, grid)
        no_index = np.empty(0, dtype=np.int64)
        rows_by_frame = [frame.target_rows(grid.roi, people) for frame in frames]
        frame_index = np.repeat(np.arange(len(frames), dtype=np.int64), [len(rows) for rows in rows_by_frame])
        row = boxes.starts[frame_index] + np.concatenate([no_index, *rows_by_frame])

        names: list[str] = []
        kind_names: list[str] = []
        for frame, rows in zip(frames, rows_by_frame, strict=True):
            names += [frame.vehicles[i] for i in rows]
            kind_names += [frame.kinds[i] for i in rows]
        vehicles, vehicle = _index_names(names)
        kinds, kind = _index_names(kind_names)

        return cls(
            grid=grid,
            numbers=np.array([frame.number for frame in frames], dtype=np.int64),
            frame=frame_index,
            vehicles=vehicles,
            vehicle=vehicle,
            kinds=kinds,
            kind=kind,
            part=np.concatenate([no_index, *(frame.part for frame in frames)])[row],
            boxes=np.concatenate([np.empty((0, 7)), *(frame.boxes for frame in frames)])[row],
            pitch_rad=boxes.values[row, 4],
            gap_m=_neighbour_gaps(boxes, row),
            all_boxes=boxes,
            row=row,
        )

    @classmethod
    def alone(cls, boxes: FloatArray, kind: str, grid: Grid) -> TargetRecord:
        """Return level boxes, each alone in a frame of its own, so that none occludes another.

        Parameters
        ----------
        boxes
            As ``boxes`` of the class, (n, 7) float64; their centres are in the region of interest.
        kind
            SUMO vClass of all of them.
        grid
            The grid.
        """
        count = len(boxes)
        values = np.ascontiguousarray(np.column_stack([boxes, np.zeros(count)])[:, _KERNEL_ORDER])
        values[:, :3] = grid.to_grid_m(values[:, :3])
        low, high = np.empty((count, 3)), np.empty((count, 3))
        occlusion.box_bounds(values, low, high)
        numbers, zeros = np.arange(count, dtype=np.int64), np.zeros(count, dtype=np.int64)
        return cls(
            grid=grid,
            numbers=numbers,
            frame=numbers,
            vehicles=("",),
            vehicle=zeros,
            kinds=(kind,),
            kind=zeros,
            part=zeros,
            boxes=boxes,
            pitch_rad=np.zeros(count),
            gap_m=np.full(count, np.inf),
            all_boxes=AllBoxes(
                starts=np.arange(count + 1, dtype=np.int64),
                values=values,
                low=low,
                high=high,
                are_vehicles=np.full(count, kind not in NON_VEHICLE_KINDS),
                vehicle=numbers,
            ),
            row=numbers,
        )


def _index_names(names: Sequence[str]) -> tuple[tuple[str, ...], IntArray]:
    """Return the distinct names, sorted, and the index of each name among them."""
    distinct = sorted(set(names))
    index = {name: i for i, name in enumerate(distinct)}
    return tuple(distinct), np.array([index[name] for name in names], dtype=np.int64)


def _neighbour_gaps(boxes: AllBoxes, row: IntArray) -> FloatArray:
    """Return the gap in plan from the boxes in ``row`` to their nearest neighbours, metres."""
    footprints, gap_m = np.empty((len(boxes.values), 6)), np.empty(len(boxes.values))
    vehicle_visibility.footprints(boxes.values, footprints)
    is_target = np.zeros(len(boxes.values), dtype=np.bool_)
    is_target[row] = True
    vehicle_visibility.neighbour_distances(boxes.starts, footprints, is_target, boxes.are_vehicles, gap_m)
    return gap_m[row]


class SliceMisses(NamedTuple):
    """Probability that slices of vehicles have no point.

    Attributes
    ----------
    rows
        The vehicle-frames, (k,) int64. Points on any other extend as far as the beams that meet it.
    misses
        Of slices of the length and the width of all vehicle-frames, (n, 2, 64) float32; undefined for the others.
    """

    rows: IntArray
    misses: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class TargetVisibility:
    """What one sensor, or several together, see of the vehicle-frames of a record, row by row, n of them.

    Attributes
    ----------
    record
        The vehicle-frames.
    points
        Number of beams that hit the vehicle first, with occlusion by the static world and all other boxes, (n,)
        float64; an expectation where effects weight beams or lose returns.
    points_alone
        The same without occlusion by other boxes, (n,) float64.
    points_on_sides
        Those of ``points`` that are not on its roof (or, from below, its underside), (n,) float64.
    length_share, width_share
        Share of the vehicle's length and of its width between the outermost of its points, along the box's axes, (n,)
        float64, 0 to 1; 0 without a point. With losses of returns, the expected share. Where other effects weight beams
        or lose returns, a beam whose point has any probability at all counts in full.
    hole_m
        Longest stretch of the vehicle's length, between its outermost points, without a point, (n,) float64, to 1/64 of
        its length; 0 without a point. With losses of returns, its expected value.
    range_m
        From the sensor to the box's centre, (n,) float64.
    depression_deg
        Angle of the box's centre below the sensor's horizon, (n,) float64, -90 to 90.
    side
        Sine of the angle in plan between the line of sight and the vehicle's length, (n,) float64: 0 from ahead or
        behind, 1 broadside.
    bounds_m
        Lowest and highest coordinate of its points, of any probability, along and across the vehicle from its centre,
        (n, 2, 2) float64; infinite and minus infinite without a point.
    slices
        Which of the 64 equal slices of the vehicle's length, from the rear, have a point of any probability: one bit
        each, (n,) uint64.
    misses
        With losses of returns, the probability that slices have no point, for vehicles of which that matters; None
        without.
    """

    record: TargetRecord
    points: FloatArray
    points_alone: FloatArray
    points_on_sides: FloatArray
    length_share: FloatArray
    width_share: FloatArray
    hole_m: FloatArray
    range_m: FloatArray
    depression_deg: FloatArray
    side: FloatArray
    bounds_m: FloatArray
    slices: NDArray[np.uint64]
    misses: SliceMisses | None

    def __len__(self) -> int:
        """Number of vehicle-frames."""
        return len(self.points)


@dataclass(frozen=True, eq=False)
class VisibleTargets(TargetVisibility):
    """What one site sees of the vehicle-frames of a record.

    Attributes
    ----------
    sensor_m
        The sensor in the grid's frame, (3,) float64.
    """

    sensor_m: FloatArray


def visible_targets(
    record: TargetRecord, beams: Beams, return_probability: ReturnProbability | None = None
) -> VisibleTargets:
    """Return what a site sees of the vehicle-frames of a record.

    Parameters
    ----------
    record
        Recorded traffic; the same for all sites.
    beams
        The site's empty scan.
    return_probability
        Probability that a return is detected, by its range and the reflectivity of the vehicle; None: every return is.
    """
    row, boxes = record.row, record.all_boxes.values[record.row]
    yaw_rad = boxes[:, 3]
    sensor_m = record.grid.to_grid_m(np.asarray(beams.pose.position_m))
    away_m = boxes[:, :3] - sensor_m
    range_m = np.sqrt((away_m**2).sum(axis=1))
    run_m = np.hypot(away_m[:, 0], away_m[:, 1])
    across_m = np.abs(away_m[:, 1] * np.cos(yaw_rad) - away_m[:, 0] * np.sin(yaw_rad))

    hits = _count_points(record, sensor_m, beams, return_probability)
    points_alone = hits.alone[row]
    if return_probability is not None:
        points_alone = points_alone * return_probability(range_m, record.reflectivity)
    bounds_m, slices = np.stack([hits.low[row], hits.high[row]], axis=1), hits.slices[row]
    misses = hits.misses
    spans, hole_m = spans_and_holes(record, bounds_m, slices, misses)
    return VisibleTargets(
        record=record,
        points=hits.points[row],
        points_alone=points_alone,
        points_on_sides=hits.on_sides[row],
        length_share=spans[:, 0],
        width_share=spans[:, 1],
        hole_m=hole_m,
        range_m=range_m,
        depression_deg=np.degrees(np.arctan2(-away_m[:, 2], run_m)),
        side=np.divide(across_m, run_m, out=np.zeros(len(row)), where=run_m > 0.0),
        bounds_m=bounds_m,
        slices=slices,
        misses=misses,
        sensor_m=sensor_m,
    )


def spans_and_holes(
    record: TargetRecord, bounds_m: FloatArray, slices: NDArray[np.uint64], misses: SliceMisses | None
) -> tuple[FloatArray, FloatArray]:
    """Return the shares of length and width between the outermost points, (n, 2), and the longest holes, (n,), metres.

    Both are expected values where returns are lost.

    Parameters
    ----------
    record
        The vehicles.
    bounds_m, slices, misses
        As in :class:`TargetVisibility`.
    """
    spans, hole = span_shares(record, bounds_m), np.zeros(len(record))
    vehicle_visibility.longest_slice_gaps(slices, hole)
    sizes_m = np.ascontiguousarray(record.all_boxes.values[record.row, 5:7])
    if misses is not None:
        vehicle_visibility.expected_spans(misses.misses, misses.rows, bounds_m, sizes_m, spans)
        vehicle_visibility.expected_gaps(misses.misses, misses.rows, hole)
    return spans, hole * sizes_m[:, 0]


def slice_misses(visible: TargetVisibility) -> NDArray[np.float32]:
    """Return the probability that each slice has no point: of the length, and of the width, (n, 2, 64) float32.

    Of vehicles on which no loss matters, it is 0 or 1, and of the width 0 in the slices with the outermost points.
    """
    parts = np.arange(vehicle_visibility.SLICES)
    misses = np.ones((len(visible), 2, len(parts)), dtype=np.float32)
    misses[:, 0] = (visible.slices[:, None] >> parts.astype(np.uint64)) & np.uint64(1) == 0
    rows = np.flatnonzero(visible.points > 0.0)
    width_m = visible.record.all_boxes.values[visible.record.row[rows], 6]
    for end_m in (visible.bounds_m[rows, 0, 1], visible.bounds_m[rows, 1, 1]):
        part = np.clip(len(parts) * (end_m / width_m + 0.5), 0, len(parts) - 1).astype(np.int64)
        misses[rows, 1, part] = 0.0
    if visible.misses is not None:
        rows = visible.misses.rows
        misses[rows] = visible.misses.misses[rows]
    return misses


def span_shares(record: TargetRecord, bounds_m: FloatArray) -> FloatArray:
    """Return the share of each vehicle's length and width between its outermost points, (n, 2) float64, 0 to 1.

    Parameters
    ----------
    record
        The vehicles.
    bounds_m
        As in :class:`TargetVisibility`, (n, 2, 2) float64.
    """
    low_m, high_m = bounds_m[:, 0], bounds_m[:, 1]
    has_points = high_m >= low_m
    sizes_m = record.all_boxes.values[record.row, 5:7]
    shares = np.zeros((len(record), 2))
    shares[has_points] = (high_m[has_points] - low_m[has_points]) / sizes_m[has_points]
    return shares


class _BoxHits(NamedTuple):
    """Points on every box of a record, (b,); ``low`` and ``high`` bound them along the box's axes, (b, 2), metres."""

    alone: FloatArray
    """Without occlusion by other boxes, and with every return detected."""
    points: FloatArray
    on_sides: FloatArray
    slices: NDArray[np.uint64]
    """Which slices of the box's length have points, as bits."""
    low: FloatArray
    high: FloatArray
    misses: SliceMisses | None
    """See :class:`TargetVisibility`."""


class Losses(NamedTuple):
    """Losses of returns in the form that :func:`egvs.kernels.vehicle_visibility.first_hits` takes."""

    shares: FloatArray
    share_row: IntArray
    per_m: float
    miss_row: IntArray
    misses: NDArray[np.float32]

    @classmethod
    def of(cls, record: TargetRecord, return_probability: ReturnProbability, farthest_m: float) -> Losses:
        """Tabulate the probability of returns up to a range, for each reflectivity of the record."""
        if not len(record):
            return NO_LOSSES
        reflectivity, row_of_kind = np.unique(reflectivity_of(record.kinds), return_inverse=True)
        range_m = np.arange(math.ceil(farthest_m * _STEPS_PER_M) + 2) / _STEPS_PER_M
        shares = [return_probability(range_m, np.full(len(range_m), rho)) for rho in reflectivity]
        count = len(record.all_boxes.values)
        share_row, miss_row = np.zeros(count, dtype=np.int64), np.full(count, -1, dtype=np.int64)
        share_row[record.row], miss_row[record.row] = row_of_kind[record.kind], np.arange(len(record))
        misses = np.empty((len(record), 2, vehicle_visibility.SLICES), dtype=np.float32)
        return cls(np.array(shares).reshape(len(shares), -1), share_row, _STEPS_PER_M, miss_row, misses)

    def filled(self, record: TargetRecord, slices: NDArray[np.uint64]) -> SliceMisses:
        """Return the probabilities that the kernel has filled; ``slices`` are those of all boxes that have points."""
        rows = np.flatnonzero((self.miss_row[record.row] >= 0) & (slices[record.row] != 0))
        return SliceMisses(rows, self.misses)


_NO_ROWS = np.empty(0, dtype=np.int64)
_NO_MISSES = np.empty((0, 2, vehicle_visibility.SLICES), dtype=np.float32)
NO_LOSSES = Losses(np.empty((0, 0)), _NO_ROWS, 1.0, _NO_ROWS, _NO_MISSES)
"""Every return is detected."""


def _count_points(
    record: TargetRecord, sensor_m: FloatArray, site: Beams, return_probability: ReturnProbability | None
) -> _BoxHits:
    boxes, count = record.all_boxes, len(record.all_boxes.values)
    losses, has_losses = NO_LOSSES, return_probability is not None and return_probability.thins_spans
    is_counted = site.weight is None and (return_probability is None or has_losses)
    beams = sort_beams(site, _BANDS if is_counted else 1)
    if return_probability is not None and has_losses:
        losses = Losses.of(record, return_probability, float(beams.length_m.max(initial=0.0)))
        return_probability = None
    is_target = np.zeros(count, dtype=np.bool_)
    is_target[record.row] = True
    size_m = np.asarray(record.grid.roi.size_m)
    all_boxes = *boxes.between(sensor_m, size_m), boxes.values, boxes.low, boxes.high, is_target

    bounds = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    sums = np.zeros(count), np.zeros(count), np.zeros(count), np.zeros(count, dtype=np.uint64), *bounds
    nearest_m = beams.length_m.copy()
    capacity = 0
    if return_probability is not None:
        capacity = max(MAX_HITS, len(beams.length_m))
    hits = (np.empty(capacity, dtype=np.int64), np.empty(capacity, dtype=np.int64), *np.empty((3, capacity)))

    frame = 0
    while frame < len(record.numbers):
        frame, filled = vehicle_visibility.first_hits(
            frame, sensor_m, size_m, all_boxes, tuple(beams), nearest_m, tuple(losses), sums, hits
        )
        if return_probability is not None:
            box, row, hit_range_m, along_m, across_m = (column[:filled] for column in hits)
            weight = beams.weight[row] * return_probability(hit_range_m)
            vehicle_visibility.accumulate_hits(box, weight, along_m, across_m, boxes.values, sums[1:])
    return _BoxHits(*sums, None if losses is NO_LOSSES else losses.filled(record, sums[3]))


class SortedBeams(NamedTuple):
    """Beams in the form that :func:`egvs.kernels.vehicle_visibility.first_hits` takes."""

    cells: IntArray
    slopes: FloatArray
    directions: FloatArray
    length_m: FloatArray
    weight: FloatArray


def sort_beams(beams: Beams, bands: int) -> SortedBeams:
    """Sort beams into bands of slopes and cells of azimuth; in a single band by azimuth, and with their weights."""
    ends_m, weight = beams.ends_m, np.empty(0)
    azimuth = np.arctan2(ends_m[:, 1], ends_m[:, 0])
    limits = _band_limits(ends_m[::_STRIDE], bands)
    if bands == 1:  # the order in which shares are added
        rows = np.argsort(azimuth, kind="stable")
        ends_m, azimuth = ends_m[rows], azimuth[rows]
        weight = np.ones(len(rows)) if beams.weight is None else beams.weight[rows]
        weight = np.append(weight, np.zeros(-len(weight) % vehicle_visibility.BLOCK))

    bands = len(limits) + 1  # fewer than requested where a sensor has few rings
    size = math.ceil(len(ends_m) / vehicle_visibility.BLOCK) * vehicle_visibility.BLOCK
    cells = np.zeros(bands * vehicle_visibility.AZIMUTH_CELLS + 1, dtype=np.int64)
    slopes = np.empty((bands, 2))
    directions, length_m = np.zeros((3, size)), np.zeros(size)
    scratch = np.empty(len(ends_m), dtype=np.int64)
    vehicle_visibility.sort_beams(ends_m, azimuth, limits, cells, slopes, directions, length_m, scratch)
    return SortedBeams(cells, slopes, directions, length_m, weight)


def _band_limits(ends_m: FloatArray, bands: int) -> FloatArray:
    """Return slopes between bands with nearly equal numbers of beams, ascending."""
    with np.errstate(invalid="ignore", divide="ignore"):  # beams without length, and vertical beams
        slope = np.sort(np.nan_to_num(ends_m[:, 2] / np.hypot(ends_m[:, 0], ends_m[:, 1])))
    if not len(slope):
        return slope
    return np.unique(slope[len(slope) * np.arange(1, bands) // bands])


def weighted_mean(values: FloatArray, weight: FloatArray | None = None) -> float:
    """Return the mean over vehicle-frames (n,), independent of their order; NaN without any weight."""
    if weight is None:
        weight = np.ones(len(values))
    total = math.fsum(weight.tolist())  # lists are summed several times as fast as arrays
    if not total > 0.0:
        return math.nan
    return math.fsum((values * weight).tolist()) / total


def recorded_frames(trajectories: Path) -> list[int]:
    """Return how many frames ``trajectories.parquet`` has of each record; one record where there are no periods."""
    metadata = parquet.read_metadata(trajectories, "trajectories")
    return [int(record["frames"]) for record in metadata.get("periods", [metadata])]


def weights_in_mix(periods: Sequence[PeriodBlocks], recorded: Sequence[int], record: TargetRecord) -> FloatArray:
    """Return the weight of each vehicle-frame in a mix of periods, (n,) float64; 1 without a mix.

    ``recorded`` is the number of frames of each period.
    """
    weight = np.ones(len(record.numbers))
    start = 0
    for period, frames in zip(periods, recorded, strict=True):
        in_period = (record.numbers >= start) & (record.numbers < start + frames)
        if len(periods) > 1 and in_period.any():
            weight[in_period] = period.times * period.frames / in_period.sum()
        start += frames
    return weight[record.frame]


@dataclass(frozen=True, eq=False)
class FrameGroups:
    """Groups of blocks that the vehicle-frames of a record belong to, for standard errors of means.

    Attributes
    ----------
    groups
        Groups of each record of the mix; one record where there are no periods.
    ends
        Vehicle-frames ends[g] to ends[g + 1] are those of group g, counted over all records, (k + 1,) int64.
    weight
        Weight of each vehicle-frame in the mix, (n,) float64; 1 where there are no periods.
    """

    groups: tuple[BlockGroups, ...]
    ends: IntArray
    weight: FloatArray

    @classmethod
    def read(cls, tpog: Path, trajectories: Path, record: TargetRecord) -> FrameGroups | None:
        """Read the groups from ``tpog.parquet`` and the ``trajectories.parquet`` that it was counted from.

        None if a record has one block only, because its scatter is unknown.
        """
        periods = read_periods(tpog)
        if any(period.blocks < 2 for period in periods):
            return None
        return cls.of(periods, recorded_frames(trajectories), record)

    @classmethod
    def of(cls, periods: Sequence[PeriodBlocks], recorded: Sequence[int], record: TargetRecord) -> FrameGroups:
        """Return the groups from the blocks of each record, two or more, and its number of recorded frames.

        Frames at the end of a record that fill no block belong to its last group. A record of which no frame is
        replayed has no weight.
        """
        groups = tuple(block_groups(period) for period in periods)
        offsets = np.append(0, np.cumsum(recorded[:-1]))
        starts = []
        for offset, period_groups in zip(offsets, groups, strict=True):
            starts.append(offset + np.append(0, np.cumsum(period_groups.frames[:-1])))
        first_rows = np.searchsorted(record.numbers[record.frame], np.concatenate(starts))
        return cls(groups, np.append(first_rows, len(record)), weights_in_mix(periods, recorded, record))

    def means(self, values: FloatArray, weight: FloatArray | None = None) -> FloatArray:
        """Return the mean of all vehicle-frames, and with each group left out, (1 + k,) float64.

        :meth:`egvs.scoring.standard_errors.ScoreUncertainty.of` takes such rows of all sites. NaN where nothing is
        left.

        Parameters
        ----------
        values
            Of vehicle-frames, (n,) float64.
        weight
            Weight of each, in addition to that in the mix, (n,) float64; equal weights where it is None.
        """
        weights = self.weight
        if weight is not None:
            weights = self.weight * weight
        sums = np.array([self._sum_by_group(values * weights), self._sum_by_group(weights)])

        sums_left_out = []
        first = 0
        for record in self.groups:
            in_record = slice(first, first + len(record.frames))
            other_records = np.delete(sums, in_record, axis=1).sum(axis=1)
            for group, frames in enumerate(record.frames.tolist()):
                remaining = np.delete(sums[:, in_record], group, axis=1).sum(axis=1)
                sums_left_out.append(other_records + record.total / (record.total - frames) * remaining)
            first = in_record.stop
        total, count = np.array(sums_left_out).T
        left_out = np.divide(total, count, out=np.full(len(total), math.nan), where=count > 0.0)
        return np.append(weighted_mean(values, weights), left_out)

    def _sum_by_group(self, values: FloatArray) -> FloatArray:
        bounds = zip(self.ends[:-1], self.ends[1:], strict=True)
        return np.array([math.fsum(values[start:end].tolist()) for start, end in bounds])


def weighted_people(config: WeightsConfig) -> frozenset[str]:
    """Return the vClasses of pedestrians and bicycles that have a weight, and so are targets."""
    return NON_VEHICLE_KINDS & set(config.kinds)


def target_weights(config: WeightsConfig, areas: Mapping[str, BaseGeometry], record: TargetRecord) -> FloatArray:
    """Return the weight of each vehicle-frame, (n,) float64, 1 by default. The edge of a zone is part of it.

    Parameters
    ----------
    config
        The weights.
    areas
        The areas of the zones by name, from :func:`egvs.scoring.zones.weight_zones`.
    record
        The vehicles.
    """
    weight: FloatArray = np.ones(len(record))
    if record.kinds:
        by_kind = np.array([config.kinds.get(kind, 1.0) for kind in record.kinds])  # type: ignore[call-overload]
        weight = by_kind[record.kind]
    for name, zone in config.zones.items():
        weight = np.where(_in_area(areas[name], record), weight * zone.weight, weight)
    return weight


def warn_unused_weights(
    config: WeightsConfig, areas: Mapping[str, BaseGeometry], record: TargetRecord
) -> Iterator[Diagnostic]:
    """Warn about each weight that applies to no vehicle."""
    hint = "Remove it, or check its name and the traffic."
    sample = f"in the {len(record.numbers)} frames examined"
    for kind in config.kinds:
        if kind not in record.kinds:
            problem = f"no {kind} has its centre in the region of interest {sample}"
            yield Diagnostic("weights", f"{SCENARIO_FILE}: score.weights.kinds.{kind}", problem, hint)
    for name in config.zones:
        if not _in_area(areas[name], record).any():
            problem = f"no vehicle has its centre in the zone {sample}"
            yield Diagnostic("weights", f"{SCENARIO_FILE}: score.weights.zones.{name}", problem, hint)


def _in_area(area: BaseGeometry, record: TargetRecord) -> BoolArray:
    """Return which vehicle-frames have their centre in an area or on its edge."""
    import shapely

    inside: BoolArray = shapely.intersects_xy(area, record.boxes[:, 0], record.boxes[:, 1])
    return inside
