r"""Points that a standard car or pedestrian gets from a sensor at each square metre of the road surface.

Steps: find the squares of a metre whose middle is on the surface; put one box on each of them, alone in a frame of its
own; count the beams of an empty scan that end on it, with the kernels of the scores over vehicles
(:mod:`egvs.scoring.targets`). So beams, static occlusion, weights and losses of returns are those of the scores; there
are no other road users, so nothing that moves occludes.

- A *car* (:data:`CAR`) stands with its middle on each square that a lane for vehicles covers, along that lane. Where
  lanes overlap, as in junctions, the map has the fewest points of all these directions.
- A *pedestrian* (:data:`PEDESTRIAN`, as wide as long) stands on each square of a lane, sidewalk, crossing or corner.

Boxes are level and stand on the height of the surface: slopes are ignored. Beams that cannot meet the region of
interest are not cast, so a car that reaches out of the region gets fewer points. Squares are those of
``blindspots.parquet``. World frame, metres.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from egvs.core.grid import BoolArray, FloatArray, Grid, IntArray
from egvs.effects.returns import ReturnProbability
from egvs.scoring.blindspots import CELL_M, blindspot_map_shape
from egvs.scoring.targets import SEEN_WELL_POINTS, TargetRecord, visible_targets
from egvs.scoring.visibility import Beams
from egvs.traffic.network import LANE_WIDTH_M, Lane, Network, is_carriageway

OVERLAP_POINTS = SEEN_WELL_POINTS
"""A sensor counts in a map of overlap where it has at least this number of points."""


CLASS_LIMITS = (1.0, 5.0, 20.0, 100.0, 500.0)
"""Points at which each class of a drawn map begins; the first class has none."""

CLASS_LABELS = ("0", "1\u20134", "5\u201319", "20\u201399", "100\u2013499", "500 +")


class StandardTarget(NamedTuple):
    """A box of typical size: its name, its SUMO vClass, and its length, width and height in metres."""

    name: str
    kind: str
    length_m: float
    width_m: float
    height_m: float


CAR = StandardTarget("car", "passenger", 4.5, 1.8, 1.5)
PEDESTRIAN = StandardTarget("pedestrian", "pedestrian", 0.6, 0.6, 1.73)
TARGETS = (CAR, PEDESTRIAN)
"""Targets of the maps."""


@dataclass(frozen=True, eq=False)
class PointsMap:
    """Points that a target gets from a site, or the number of sensors with enough points, at each square metre.

    Attributes
    ----------
    target
        The target.
    values
        From the south-western corner, (nx, ny) float64; NaN off the surface.
    origin_m, cell_m
        South-western corner in the world frame, and the edge of a square.
    """

    target: StandardTarget
    values: FloatArray
    origin_m: tuple[float, float]
    cell_m: float = CELL_M

    @property
    def on_surface(self) -> BoolArray:
        """Which squares are on the surface, (nx, ny)."""
        return np.logical_not(np.isnan(self.values))

    @property
    def classes(self) -> FloatArray:
        """The index in :data:`CLASS_LABELS` of the points on each square, (nx, ny) float64; NaN off the surface."""
        index = np.searchsorted(CLASS_LIMITS, self.values, side="right").astype(np.float64)
        return np.where(self.on_surface, index, np.nan)

    def share_with(self, points: float) -> float:
        """Share of the surface with at least this number of points; NaN without any surface."""
        known = self.values[self.on_surface]
        return float(np.mean(known >= points)) if len(known) else float("nan")


@dataclass(frozen=True, eq=False)
class TargetPositions:
    """Where a target stands: one box or more on each square of its surface.

    Attributes
    ----------
    target
        The target.
    grid
        The voxel grid; its region of interest contains the middles of all boxes.
    cells
        Square of each box, counted from the corner of the region to the east and to the north, (m, 2) int64.
    boxes
        As :data:`egvs.artefacts.traffic_frames.BOX_COLUMNS`, (m, 7) float64.
    """

    target: StandardTarget
    grid: Grid
    cells: IntArray
    boxes: FloatArray

    @classmethod
    def of(cls, target: StandardTarget, network: Network, grid: Grid) -> TargetPositions:
        """Find the positions of a target on the surface of a network, in the region of interest of a grid."""
        cells = [np.empty((0, 2), dtype=np.int64)]
        poses = [np.empty((0, 4))]
        nx, ny = blindspot_map_shape(grid)
        x_m = grid.origin_m[0] + (np.arange(nx) + 0.5) * CELL_M
        y_m = grid.origin_m[1] + (np.arange(ny) + 0.5) * CELL_M
        middles_m = np.stack(np.meshgrid(x_m, y_m, indexing="ij"), axis=-1)
        for area, height_and_yaw in _surfaces(target, network, grid):
            covered = _covered_cells(area, middles_m, grid)
            at_m = middles_m[covered[:, 0], covered[:, 1]]
            cells.append(covered)
            poses.append(np.column_stack([at_m, height_and_yaw(at_m)]))
        cell, (x_m, y_m, z_m, yaw_rad) = np.concatenate(cells), np.concatenate(poses).T
        size_m = np.tile([target.length_m, target.width_m, target.height_m], (len(cell), 1))
        boxes = np.column_stack([x_m, y_m, z_m + target.height_m / 2.0, size_m, yaw_rad])
        roi = grid.roi
        offset_m = boxes[:, :3] - np.asarray(roi.origin_m)
        inside = ((offset_m >= 0.0) & (offset_m < np.asarray(roi.size_m))).all(axis=1)
        return cls(target, grid, cell[inside], boxes[inside])

    @cached_property
    def _record(self) -> TargetRecord:
        return TargetRecord.alone(self.boxes, self.target.kind, self.grid)

    def points_map(self, beams: Beams, return_probability: ReturnProbability | None = None) -> PointsMap:
        """Return the points at each square, the fewest where several boxes stand on it.

        Parameters
        ----------
        beams
            The empty scan of a site.
        return_probability
            As for :func:`egvs.scoring.targets.visible_targets`.
        """
        values = np.full(blindspot_map_shape(self.grid), np.inf)
        if len(self.boxes):
            points = visible_targets(self._record, beams, return_probability).points
            np.minimum.at(values, (self.cells[:, 0], self.cells[:, 1]), points)
        values[np.isinf(values)] = np.nan
        return PointsMap(self.target, values, (self.grid.origin_m[0], self.grid.origin_m[1]))


def overlap_map(maps: Sequence[PointsMap]) -> PointsMap:
    """Return by how many sensors each square gets at least :data:`OVERLAP_POINTS`.

    Parameters
    ----------
    maps
        One map of each sensor, of the same target; at least one.
    """
    first = maps[0]
    counts = np.sum([points_map.values >= OVERLAP_POINTS for points_map in maps], axis=0).astype(np.float64)
    return PointsMap(first.target, np.where(first.on_surface, counts, np.nan), first.origin_m, first.cell_m)


def _covered_cells(area: Any, middles_m: FloatArray, grid: Grid) -> IntArray:
    """The squares whose middle an area covers, (k, 2) int64."""
    import shapely

    origin_m = np.asarray(grid.origin_m[:2])
    bounds_m = np.reshape(area.bounds, (2, 2)) - origin_m
    low, high = np.clip(np.floor(bounds_m / CELL_M).astype(np.int64), 0, middles_m.shape[:2])
    block = middles_m[low[0] : high[0] + 1, low[1] : high[1] + 1]
    covered = shapely.intersects_xy(area, block[..., 0], block[..., 1])
    cells: IntArray = np.argwhere(covered).astype(np.int64) + low
    return cells


_PoseAt = Callable[[FloatArray], FloatArray]
"""Height and yaw, (k, 2), of points (k, 2) on a surface."""


def _surfaces(target: StandardTarget, network: Network, grid: Grid) -> Iterator[tuple[Any, _PoseAt]]:
    """Yield the areas near a grid on which a target stands, with their heights and headings."""
    import shapely

    low_m = np.asarray(grid.origin_m[:2])
    high_m = low_m + np.asarray(grid.roi.size_m[:2])
    for edge in network.all_edges:
        for lane in edge.lanes:
            line_m = lane.shape_m
            margin_m = CELL_M + (lane.width_m or LANE_WIDTH_M)
            if (line_m[:, :2].max(axis=0) < low_m - margin_m).any() or (
                line_m[:, :2].min(axis=0) > high_m + margin_m
            ).any():
                continue
            if edge.function == "walkingarea":
                if target is PEDESTRIAN and len(line_m) > 2:
                    yield shapely.make_valid(shapely.Polygon(line_m[:, :2])), _at_height(float(line_m[:, 2].mean()))
                continue
            is_surface = is_carriageway(lane.permission) and edge.function != "crossing"
            if target is PEDESTRIAN:
                is_surface = is_surface or edge.function == "crossing" or lane.is_sidewalk
            if not is_surface or len(line_m) < 2 or not (line_m[:, :2] != line_m[0, :2]).any():
                continue
            yield lane.area(), _along(lane)


def _at_height(height_m: float) -> _PoseAt:
    def pose_at(at_m: FloatArray) -> FloatArray:
        return np.tile([height_m, 0.0], (len(at_m), 1))

    return pose_at


def _along(lane: Lane) -> _PoseAt:
    """Height and heading of the nearest point of the middle line of a lane."""
    line_m = lane.shape_m
    is_distinct = np.append(True, (np.diff(line_m[:, :2], axis=0) != 0.0).any(axis=1))
    start, step = line_m[is_distinct][:-1], np.diff(line_m[is_distinct], axis=0)
    heading = np.arctan2(step[:, 1], step[:, 0])

    def pose_at(at_m: FloatArray) -> FloatArray:
        to = at_m[:, None, :] - start[None, :, :2]
        share = np.clip((to * step[:, :2]).sum(axis=2) / (step[:, :2] ** 2).sum(axis=1), 0.0, 1.0)
        distance2 = ((to - share[:, :, None] * step[:, :2]) ** 2).sum(axis=2)
        nearest = distance2.argmin(axis=1)
        along = np.take_along_axis(share, nearest[:, None], axis=1)[:, 0]
        return np.column_stack([start[nearest, 2] + along * step[nearest, 2], heading[nearest]])

    return pose_at
