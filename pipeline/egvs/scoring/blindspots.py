"""How many vehicles a site sees at each spot; blindspots.parquet.

The places at which vehicles were recorded, and how many of them a site sees there.

A *spot* is a square of the region, a lane, a whole approach or exit, a way through a junction, a crossing. A
vehicle-frame counts for every square that its box covers in plan, for the lane or turn that its front is on and for the
road of that lane, for each crossing that its box reaches onto; where its front is on no lane, for "no lane". What
depends on traffic alone is worked out once for all sites. It is seen where it has :data:`SEEN_WELL_POINTS` points.

World frame, in plan, metres.

The rows of ``blindspots.parquet``: of each site, how many vehicles it sees at each spot.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts import parquet, readers
from egvs.artefacts.parquet import ArtefactWriter
from egvs.core.grid import Grid, Roi
from egvs.scoring.road_locations import (
    KINDS,
    Floats,
    Ints,
    RoadLocation,
    RoadLocations,
    disambiguate,
    fronts_m,
    match_lanes,
)
from egvs.scoring.targets import SEEN_WELL_POINTS, TargetRecord

CELL_M = 1.0
"""Edge of a square of the map."""

ALL, NO_LANE, CELL = "all", "no lane", "cell"

_SHRINK_M = 1e-4
"""A box is made smaller by this on each side, as everywhere."""

_ORDER = (ALL, NO_LANE, *KINDS)


@dataclass(frozen=True, eq=False)
class SpotVisibility:
    """What one site sees at each of k spots.

    Attributes
    ----------
    seen
        Vehicle-frames that it sees, (k,) int64.
    share, se
        Which share of the weight there these are, (k,) float64, and its standard error: of a ratio of sums over
        vehicles that are independent of one another; not a number of one vehicle.
    """

    seen: Ints
    share: Floats
    se: Floats


@dataclass(frozen=True, eq=False)
class VehicleSpots:
    """Where each vehicle-frame of a record is; k spots, in the order of the artefact.

    Attributes
    ----------
    locations
        In words, of the first spots.
    cells
        Squares from the region's corner to the east and to the north, of the other spots, (c, 2) int64.
    at_m
        Middle of the square, or mean of the vehicles' centres there, world frame, (k, 2) float64.
    row, visit
        Vehicle-frames, and the visits that they are part of, (m,) int64 each; a visit is all that one vehicle is at
        one spot.
    spot
        Of each visit, (v,) int64, ascending.
    weight
        How much each vehicle-frame of the record counts, (n,) float64.
    """

    locations: tuple[RoadLocation, ...]
    cells: Ints
    at_m: Floats
    row: Ints
    visit: Ints
    spot: Ints
    weight: Floats

    @classmethod
    def of(cls, record: TargetRecord, roads: RoadLocations | None, weight: Floats, period: Ints) -> VehicleSpots:
        """From the vehicle-frames of a record.

        Parameters
        ----------
        roads
            Places of the network; None where there is none, for a map alone.
        weight
            How much each vehicle-frame counts, (n,) float64.
        period
            The part of the day of each vehicle-frame, (n,) int64: two vehicles of one name may be in different ones.
        """
        vehicles = np.flatnonzero(~record.are_people)  # for scores, people may count too
        boxes = record.boxes[vehicles]
        places, rows, at = _match_roads(boxes, roads)
        cell_row, cells = cells_of(boxes, record.grid.roi)
        cell, at_cell = np.unique(cells, axis=0, return_inverse=True)
        row, spot = vehicles[np.append(rows, cell_row)], np.append(at, len(places) + at_cell.reshape(-1))
        who = record.vehicle + len(record.vehicles) * period
        names = int(who.max(initial=0)) + 1
        visits, visit = np.unique(spot * names + who[row], return_inverse=True)
        at_m = np.column_stack([np.bincount(spot, record.boxes[row, axis]) for axis in (0, 1)]).astype(np.float64)
        at_m /= np.bincount(spot)[:, None]
        at_m[len(places) :] = np.asarray(record.grid.origin_m[:2]) + (cell + 0.5) * CELL_M
        return cls(places, cell, at_m, row, visit.reshape(-1), visits // names, weight)

    def __len__(self) -> int:
        """How many spots."""
        return len(self.at_m)

    @property
    def vehicle_frames(self) -> Ints:
        """How many there are at each spot, (k,) int64."""
        return np.bincount(self.spot[self.visit], minlength=len(self))

    @property
    def vehicles(self) -> Ints:
        """Of how many different vehicles, (k,) int64."""
        return np.bincount(self.spot, minlength=len(self))

    @cached_property
    def _visit_weights(self) -> Floats:
        return self._of_visits(self.visit, self.weight[self.row])

    @cached_property
    def weights(self) -> Floats:
        """Of all vehicle-frames at each spot, (k,) float64."""
        return self._of_spots(self._visit_weights)

    def visibility(self, points: Floats) -> SpotVisibility:
        """What a site sees of them.

        Parameters
        ----------
        points
            Of the site on each vehicle-frame of the record, (n,) float64.
        """
        at = (points >= SEEN_WELL_POINTS)[self.row]
        visit, weights = self.visit[at], self._visit_weights
        of_visits = self._of_visits(visit, self.weight[self.row[at]])
        share = self._of_spots(of_visits) / self.weights
        squares = self._of_spots((of_visits - share[self.spot] * weights) ** 2)
        vehicles = self.vehicles
        more = np.divide(vehicles, vehicles - 1, out=np.full(len(self), np.nan), where=vehicles > 1)
        seen = np.bincount(self.spot[visit], minlength=len(self))
        return SpotVisibility(seen, share, np.sqrt(squares * more) / self.weights)

    def _of_visits(self, visit: Ints, weight: Floats) -> Floats:
        return np.bincount(visit, weight, minlength=len(self.spot)).astype(np.float64)

    def _of_spots(self, of_visits: Floats) -> Floats:
        return np.bincount(self.spot, of_visits, minlength=len(self)).astype(np.float64)


def cells_of(boxes: Floats, roi: Roi) -> tuple[Ints, Ints]:
    """The squares of the region whose middle a box covers in plan, and the one that holds the box's own middle.

    Parameters
    ----------
    boxes
        As :data:`egvs.artefacts.traffic_frames.BOX_COLUMNS`, (n, 7) float64; centres in the region.

    Returns
    -------
    row, cell
        Boxes (m,), ascending, and their squares (m, 2): how many to the east, to the north; int64.
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


def _match_roads(boxes: Floats, roads: RoadLocations | None) -> tuple[tuple[RoadLocation, ...], Ints, Ints]:
    """The places that vehicles are at, in order, and pairs of a vehicle-frame and one of them."""
    found = [(RoadLocation(ALL, "", "all vehicles", (0.0, 0.0)), np.arange(len(boxes)))] if len(boxes) else []
    if roads is not None:
        lane = match_lanes(fronts_m(boxes), boxes[:, 6], roads.lanes)
        rows: list[list[Ints]] = [[] for _ in roads.locations]
        for number in np.unique(lane[lane >= 0]).tolist():
            for place in roads.locations_of_lane[number]:
                rows[place].append(np.flatnonzero(lane == number))
        for place, its in _match_crossings(boxes, roads):
            rows[place].append(its)
        at = [(place, np.concatenate(its)) for place, its in zip(roads.locations, rows, strict=True) if its]
        lost = np.flatnonzero(lane < 0)
        found += [*at, *([(RoadLocation(NO_LANE, "", "on no lane", (0.0, 0.0)), lost)] if len(lost) else [])]
    found.sort(key=lambda pair: (_ORDER.index(pair[0].by), pair[0].name))
    none = np.empty(0, dtype=np.int64)
    row = np.concatenate([none, *(its for _, its in found)])
    spot = np.repeat(np.arange(len(found)), [len(its) for _, its in found])
    return tuple(disambiguate([place for place, _ in found])), row, spot


def _match_crossings(boxes: Floats, roads: RoadLocations) -> Iterator[tuple[int, Ints]]:
    """The boxes that reach onto each crossing."""
    import shapely

    if not roads.crossings or not len(boxes):
        return
    along = np.column_stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6])]) * (boxes[:, 3:4] / 2.0 - _SHRINK_M)
    across = np.column_stack([-np.sin(boxes[:, 6]), np.cos(boxes[:, 6])]) * (boxes[:, 4:5] / 2.0 - _SHRINK_M)
    signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    corners = np.stack([boxes[:, :2] + a * along + b * across for a, b in signs], axis=1)
    tree = shapely.STRtree(shapely.polygons(corners))
    for strip, place in roads.crossings:
        area = shapely.buffer(shapely.linestrings(strip.points_m), strip.width_m / 2.0, cap_style="flat")
        if len(on := np.sort(tree.query(area, "intersects"))):
            yield place, on


ARTEFACT = "blindspots"


class SpotWriter:
    """Writes ``blindspots.parquet`` site by site. Made by :func:`open_spot_writer`."""

    def __init__(self, file: ArtefactWriter, spots: VehicleSpots, sites: int) -> None:
        self._file, self._weights, self._at_once = file, spots.weights, readers.sites_per_row_group(sites)
        self._where = {name: list(values) for name, values in _spot_columns(spots).items()}
        self._waiting: list[tuple[str, SpotVisibility]] = []

    def add(self, site: str, visibility: SpotVisibility) -> None:
        """Append a site."""
        self._waiting.append((site, visibility))
        if len(self._waiting) == self._at_once:
            self._write()

    def describe(self, metadata: dict[str, Any]) -> None:
        """Set the metadata, of which ``grid`` says where squares are counted from; no site comes after."""
        if self._waiting:
            self._write()
        grid = Grid.from_json(metadata["grid"])
        cells = {"origin_m": list(grid.origin_m[:2]), "cell_m": CELL_M, "shape": list(map_shape(grid))}
        self._file.describe({**metadata, "cells": cells, "points": SEEN_WELL_POINTS})

    def _write(self) -> None:
        names, seen = zip(*self._waiting, strict=True)
        many: dict[str, Any] = {name: values * len(seen) for name, values in self._where.items()}
        many["site"] = [name for name in names for _ in self._weights]
        for column, of in (("seen", "seen"), ("share_seen", "share"), ("share_se", "se")):
            many[column] = np.concatenate([getattr(its, of) for its in seen])
        self._file.write({**many, "weight": np.tile(self._weights, len(seen))})
        self._waiting.clear()


@contextmanager
def open_spot_writer(path: Path, spots: VehicleSpots, sites: int, *, mixed: bool) -> Iterator[SpotWriter]:
    """Open ``blindspots.parquet`` for so many sites; it appears when the block ends well.

    ``mixed``: whether the traffic is a mix of periods.
    """
    with parquet.artefact_writer(path, ARTEFACT, ("weight",) if mixed else ()) as file:
        yield SpotWriter(file, spots, sites)


def map_shape(grid: Grid) -> tuple[int, int]:
    """How many squares the region has to the east and to the north."""
    nx, ny = np.ceil(np.asarray(grid.roi.size_m[:2]) / CELL_M).astype(int).tolist()
    return nx, ny


def _spot_columns(spots: VehicleSpots) -> dict[str, Any]:
    """The columns that are the same for all sites."""
    places, cells = spots.locations, len(spots.cells)
    index = np.concatenate([np.full((len(places), 2), -1), spots.cells]).astype(np.int32)
    return {
        "by": [*(place.by for place in places), *[CELL] * cells],
        "place": [*(place.name for place in places), *[""] * cells],
        "words": [*(place.words for place in places), *[""] * cells],
        "ix": index[:, 0],
        "iy": index[:, 1],
        "x_m": spots.at_m[:, 0],
        "y_m": spots.at_m[:, 1],
        "vehicle_frames": spots.vehicle_frames,
        "vehicles": spots.vehicles,
    }
