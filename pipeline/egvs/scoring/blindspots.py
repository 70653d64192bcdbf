"""What share of the vehicles is found from a site at each spot: ``blindspots.parquet``.

A *spot* is a cell of the map, a lane, a whole approach or exit, a turn in a junction, or a crossing. A vehicle-frame
belongs to every cell that its box covers in plan, to the lane or turn where its front is and to the road of that lane,
and to each crossing that its box reaches; to "no lane" where its front is on none. The spots depend on traffic only and
are computed once for all sites. The share found is the mean probability that detectors find a vehicle, as in the score
``expected_detections``.

World frame, in plan, metres.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from egvs.artefacts import parquet, readers
from egvs.artefacts.parquet import ArtefactWriter
from egvs.core.grid import FloatArray, Grid, IntArray, Roi
from egvs.scoring.road_locations import KINDS, RoadLocation, RoadLocations, disambiguate, fronts_m, match_lanes
from egvs.scoring.targets import SEEN_WELL_POINTS, TargetRecord

CELL_M = 1.0
"""Edge of a cell of the map."""

ALL, NO_LANE, CELL = "all", "no lane", "cell"

_SHRINK_M = 1e-4
"""A box is made smaller by this on each side, as in the occupancy grid."""

_ORDER = (ALL, NO_LANE, *KINDS)


@dataclass(frozen=True, eq=False)
class SpotVisibility:
    """What one site sees at each of k spots.

    Attributes
    ----------
    share, se
        Weighted share of the vehicle-frames that detectors are expected to find, 0 to 1, (k,) float64, and its standard
        error: that of a ratio of sums over independent vehicles; NaN with one vehicle.
    with_points
        Number of vehicle-frames with at least :data:`egvs.scoring.targets.SEEN_WELL_POINTS` points, (k,) int64.
    """

    share: FloatArray
    se: FloatArray
    with_points: IntArray


@dataclass(frozen=True, eq=False)
class VehicleSpots:
    """Spots of each vehicle-frame of a record; k spots, in the order of the artefact.

    Attributes
    ----------
    locations
        The first spots: lanes, roads, turns, crossings.
    cells
        The other spots: cells, counted from the corner of the region to the east and to the north, (c, 2) int64.
    at_m
        Middle of the cell, or mean of the vehicles' centres, world frame, (k, 2) float64.
    row, visit
        Vehicle-frames, and the visits that they belong to, (m,) int64 each; a visit is all frames of one vehicle at
        one spot.
    spot
        Spot of each visit, (v,) int64, ascending.
    weight
        Weight of each vehicle-frame of the record, (n,) float64.
    """

    locations: tuple[RoadLocation, ...]
    cells: IntArray
    at_m: FloatArray
    row: IntArray
    visit: IntArray
    spot: IntArray
    weight: FloatArray

    @classmethod
    def of(
        cls, record: TargetRecord, roads: RoadLocations | None, weight: FloatArray, period: IntArray
    ) -> VehicleSpots:
        """Find the spots of the vehicle-frames of a record.

        Parameters
        ----------
        record
            Vehicles of recorded frames.
        roads
            Locations of the network; None for cells only.
        weight
            Weight of each vehicle-frame, (n,) float64.
        period
            Period of each vehicle-frame, (n,) int64: vehicles of different periods may have the same name.
        """
        vehicles = np.flatnonzero(~record.are_people)  # for scores, people may count too
        boxes = record.boxes[vehicles]
        locations, rows, at = _match_roads(boxes, roads)
        cell_row, cells = cells_of(boxes, record.grid.roi)
        cell, at_cell = np.unique(cells, axis=0, return_inverse=True)
        row, spot = vehicles[np.append(rows, cell_row)], np.append(at, len(locations) + at_cell.reshape(-1))
        spots = cls.at_locations(record, locations, row, spot, weight, period)
        spots.at_m[len(locations) :] = np.asarray(record.grid.origin_m[:2]) + (cell + 0.5) * CELL_M
        return replace(spots, cells=cell)

    @classmethod
    def at_locations(
        cls,
        record: TargetRecord,
        locations: Sequence[RoadLocation],
        row: IntArray,
        spot: IntArray,
        weight: FloatArray,
        period: IntArray,
    ) -> VehicleSpots:
        """Return spots without cells, from pairs of a vehicle-frame ``row`` and its ``spot``, (m,) int64 each.

        Every spot has a row; the other parameters are those of :meth:`of`.
        """
        vehicle = record.vehicle + len(record.vehicles) * period
        vehicles_in_all = int(vehicle.max(initial=0)) + 1
        visits, visit = np.unique(spot * vehicles_in_all + vehicle[row], return_inverse=True)
        at_m = np.column_stack([np.bincount(spot, record.boxes[row, axis]) for axis in (0, 1)]).astype(np.float64)
        at_m /= np.bincount(spot)[:, None]
        no_cells = np.empty((0, 2), dtype=np.int64)
        return cls(tuple(locations), no_cells, at_m, row, visit.reshape(-1), visits // vehicles_in_all, weight)

    def __len__(self) -> int:
        """Number of spots."""
        return len(self.at_m)

    @property
    def vehicle_frames(self) -> IntArray:
        """Number of vehicle-frames at each spot, (k,) int64."""
        return np.bincount(self.spot[self.visit], minlength=len(self))

    @property
    def vehicles(self) -> IntArray:
        """Number of different vehicles at each spot, (k,) int64."""
        return np.bincount(self.spot, minlength=len(self))

    @cached_property
    def _visit_weights(self) -> FloatArray:
        return self._sum_by_visit(self.visit, self.weight[self.row])

    @cached_property
    def weights(self) -> FloatArray:
        """Weight of all vehicle-frames at each spot, (k,) float64."""
        return self._sum_by_spot(self._visit_weights)

    def visibility(self, points: FloatArray, chances: FloatArray) -> SpotVisibility:
        """Return what a site sees at each spot.

        Parameters
        ----------
        points
            Points of the site on each vehicle-frame of the record, (n,) float64.
        chances
            Probability that each vehicle-frame is found, 0 to 1, (n,) float64.
        """
        found = self._sum_by_visit(self.visit, (self.weight * chances)[self.row])
        share = self._sum_by_spot(found) / self.weights
        squares = self._sum_by_spot((found - share[self.spot] * self._visit_weights) ** 2)
        vehicles = self.vehicles
        correction = np.divide(vehicles, vehicles - 1, out=np.full(len(self), np.nan), where=vehicles > 1)
        with_points = self.visit[(points >= SEEN_WELL_POINTS)[self.row]]
        counts = np.bincount(self.spot[with_points], minlength=len(self))
        return SpotVisibility(share, np.sqrt(squares * correction) / self.weights, counts)

    def _sum_by_visit(self, visit: IntArray, weight: FloatArray) -> FloatArray:
        return np.bincount(visit, weight, minlength=len(self.spot)).astype(np.float64)

    def _sum_by_spot(self, values: FloatArray) -> FloatArray:
        return np.bincount(self.spot, values, minlength=len(self)).astype(np.float64)


def cells_of(boxes: FloatArray, roi: Roi) -> tuple[IntArray, IntArray]:
    """Return the cells of the region whose middle a box covers in plan, and the cell of the middle of the box.

    Parameters
    ----------
    boxes
        Boxes as :data:`egvs.artefacts.traffic_frames.BOX_COLUMNS`, (n, 7) float64; centres in the region.
    roi
        The region.

    Returns
    -------
    row, cell
        Boxes (m,), ascending, and their cells (m, 2), counted to the east and to the north; int64.
    """
    centre, half = boxes[:, :2] - np.asarray(roi.origin_m[:2]), boxes[:, 3:5] / 2.0 - _SHRINK_M
    cos, sin = np.abs(np.cos(boxes[:, 6])), np.abs(np.sin(boxes[:, 6]))
    reach = np.column_stack([cos * half[:, 0] + sin * half[:, 1], sin * half[:, 0] + cos * half[:, 1]])
    last = np.ceil(np.asarray(roi.size_m[:2]) / CELL_M).astype(np.int64) - 1
    low = np.clip(np.floor((centre - reach) / CELL_M).astype(np.int64), 0, last)
    span = np.clip(np.floor((centre + reach) / CELL_M).astype(np.int64), 0, last) - low + 1
    row = np.repeat(np.arange(len(boxes)), span.prod(axis=1))
    number = np.arange(len(row)) - np.repeat(np.cumsum(span.prod(axis=1)) - span.prod(axis=1), span.prod(axis=1))
    cell = low[row] + np.column_stack([number // span[row, 1], number % span[row, 1]])
    off = (cell + 0.5) * CELL_M - centre[row]
    yaw = boxes[row, 6]
    along, across = np.cos(yaw) * off[:, 0] + np.sin(yaw) * off[:, 1], np.cos(yaw) * off[:, 1] - np.sin(yaw) * off[:, 0]
    covered = (np.abs(along) < half[row, 0]) & (np.abs(across) < half[row, 1])
    covered |= (cell == np.floor(centre[row] / CELL_M)).all(axis=1)
    return row[covered], cell[covered]


class _Matches(NamedTuple):
    """Locations in order, and pairs of a vehicle-frame and the index of a location, (m,) int64 each."""

    locations: tuple[RoadLocation, ...]
    row: IntArray
    spot: IntArray


def _match_roads(boxes: FloatArray, roads: RoadLocations | None) -> _Matches:
    """Match vehicle-frames with the locations where they are."""
    rows: list[tuple[RoadLocation, IntArray]] = []
    if len(boxes):
        rows.append((RoadLocation(ALL, "", "all vehicles", (0.0, 0.0)), np.arange(len(boxes))))
    if roads is not None:
        lane = match_lanes(fronts_m(boxes), boxes[:, 6], roads.lanes)
        by_location: list[list[IntArray]] = [[] for _ in roads.locations]
        for number in np.unique(lane[lane >= 0]).tolist():
            for location in roads.locations_of_lane[number]:
                by_location[location].append(np.flatnonzero(lane == number))
        for location, crossing_rows in _match_crossings(boxes, roads):
            by_location[location].append(crossing_rows)
        for road_location, parts in zip(roads.locations, by_location, strict=True):
            if parts:
                rows.append((road_location, np.concatenate(parts)))
        off_lanes = np.flatnonzero(lane < 0)
        if len(off_lanes):
            rows.append((RoadLocation(NO_LANE, "", "on no lane", (0.0, 0.0)), off_lanes))
    rows.sort(key=lambda pair: (_ORDER.index(pair[0].by), pair[0].name))
    row = np.concatenate([np.empty(0, dtype=np.int64), *(location_rows for _, location_rows in rows)])
    spot = np.repeat(np.arange(len(rows)), [len(location_rows) for _, location_rows in rows])
    return _Matches(tuple(disambiguate([location for location, _ in rows])), row, spot)


def _match_crossings(boxes: FloatArray, roads: RoadLocations) -> Iterator[tuple[int, IntArray]]:
    """The boxes that reach each crossing."""
    import shapely

    if not roads.crossings or not len(boxes):
        return
    along = np.column_stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6])]) * (boxes[:, 3:4] / 2.0 - _SHRINK_M)
    across = np.column_stack([-np.sin(boxes[:, 6]), np.cos(boxes[:, 6])]) * (boxes[:, 4:5] / 2.0 - _SHRINK_M)
    signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    corners = np.stack([boxes[:, :2] + a * along + b * across for a, b in signs], axis=1)
    tree = shapely.STRtree(shapely.polygons(corners))
    for strip, location in roads.crossings:
        area = shapely.buffer(shapely.linestrings(strip.points_m), strip.width_m / 2.0, cap_style="flat")
        rows = np.sort(tree.query(area, "intersects"))
        if len(rows):
            yield location, rows


ARTEFACT = "blindspots"


class SpotWriter:
    """Writes ``blindspots.parquet`` site by site; :func:`open_spot_writer` makes it."""

    def __init__(self, file: ArtefactWriter, spots: VehicleSpots, sites: int) -> None:
        self._file = file
        self._weights = spots.weights
        self._group_size = readers.sites_per_row_group(sites)
        self._spot_columns = {name: list(values) for name, values in _spot_columns(spots).items()}
        self._pending: list[tuple[str, SpotVisibility]] = []

    def add(self, site: str, visibility: SpotVisibility) -> None:
        """Append a site."""
        self._pending.append((site, visibility))
        if len(self._pending) == self._group_size:
            self._write()

    def describe(self, metadata: dict[str, Any]) -> None:
        """Write the last sites and set the metadata; its ``grid`` has the corner that cells are counted from."""
        if self._pending:
            self._write()
        grid = Grid.from_json(metadata["grid"])
        cells = {"origin_m": list(grid.origin_m[:2]), "cell_m": CELL_M, "shape": list(blindspot_map_shape(grid))}
        self._file.describe({**metadata, "cells": cells, "points": SEEN_WELL_POINTS})

    def _write(self) -> None:
        sites = len(self._pending)
        columns: dict[str, Any] = {name: values * sites for name, values in self._spot_columns.items()}
        columns["site"] = [site for site, _ in self._pending for _ in self._weights]
        columns["share_found"] = np.concatenate([visibility.share for _, visibility in self._pending])
        columns["share_found_se"] = np.concatenate([visibility.se for _, visibility in self._pending])
        columns["with_points"] = np.concatenate([visibility.with_points for _, visibility in self._pending])
        self._file.write({**columns, "weight": np.tile(self._weights, sites)})
        self._pending.clear()


@contextmanager
def open_spot_writer(path: Path, spots: VehicleSpots, sites: int, *, mixed: bool) -> Iterator[SpotWriter]:
    """Open ``blindspots.parquet`` for a number of sites; it appears when the block ends well.

    Parameters
    ----------
    path
        The file.
    spots
        Spots of the vehicle-frames.
    sites
        Number of sites.
    mixed
        Whether the traffic is a mix of periods.
    """
    with parquet.artefact_writer(path, ARTEFACT, ("weight",) if mixed else ()) as file:
        yield SpotWriter(file, spots, sites)


def blindspot_map_shape(grid: Grid) -> tuple[int, int]:
    """Return how many cells the region has to the east and to the north."""
    nx, ny = np.ceil(np.asarray(grid.roi.size_m[:2]) / CELL_M).astype(int).tolist()
    return nx, ny


def _spot_columns(spots: VehicleSpots) -> dict[str, Any]:
    """The columns that are the same for all sites."""
    locations = spots.locations
    cells = len(spots.cells)
    index = np.concatenate([np.full((len(locations), 2), -1), spots.cells]).astype(np.int32)
    return {
        "by": [*(location.by for location in locations), *[CELL] * cells],
        "place": [*(location.name for location in locations), *[""] * cells],
        "words": [*(location.words for location in locations), *[""] * cells],
        "ix": index[:, 0],
        "iy": index[:, 1],
        "x_m": spots.at_m[:, 0],
        "y_m": spots.at_m[:, 1],
        "vehicle_frames": spots.vehicle_frames,
        "vehicles": spots.vehicles,
    }
