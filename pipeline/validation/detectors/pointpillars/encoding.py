"""Turns a sweep into pillars, as PointPillars (Lang et al. 2019, CVPR, section 2.1) does.

The window is a square over the region of interest with sides along the world's axes, or turned; heights count from the
ground (:mod:`pipeline.validation.detectors.ground`), so that it does not matter how high the sensor hangs. The other
convention, that of detectors made for cars (heights from the sensor, from 3 m below it to 1 m above), is here to show
what it does.

Several sensors' points are put together in the world frame; whether a point is new, and its range, are said by the
sensor that it is of.

Features of a point: from the pillar's centre (x, y), height, intensity, from the mean of the pillar's points (x, y, z),
whether it is new since the empty scan, and its share of 50 m from the sensor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.core.grid import Roi
from pipeline.validation.detectors import background
from pipeline.validation.detectors.ground import GroundMap
from pipeline.validation.sweeps import SiteView, Sweep

Floats = NDArray[np.float64]

CELLS, PILLAR_M = 256, 0.4
"""Pillars along each side of a window where a detector looks, and how wide one is."""

POINTS = 16
"""Points of a pillar at most; of more, every so many is taken."""

FEATURES = 9
Convention = Literal["ground", "sensor"]
HEIGHTS_M: dict[Convention, tuple[float, float]] = {"ground": (-0.5, 4.5), "sensor": (-3.0, 1.0)}
"""What is lower or higher is left out."""

_FAR_M = 50.0


@dataclass(frozen=True)
class Window:
    """A square of the ground.

    Attributes
    ----------
    centre_m
        World x, y.
    turn_rad
        How its x axis is turned from the world's, counter-clockwise.
    cells
        Pillars along each side.
    """

    centre_m: tuple[float, float]
    turn_rad: float = 0.0
    cells: int = CELLS

    @property
    def size_m(self) -> float:
        """How long each side is."""
        return self.cells * PILLAR_M

    def to_window(self, xy_m: Floats) -> Floats:
        """World x, y (n, 2) to metres from the window's first corner."""
        c, s = math.cos(self.turn_rad), math.sin(self.turn_rad)
        x, y = (xy_m - np.asarray(self.centre_m)).T
        return np.column_stack([c * x + s * y, c * y - s * x]) + self.size_m / 2

    def to_world(self, xy_m: Floats) -> Floats:
        """The other way round."""
        c, s = math.cos(self.turn_rad), math.sin(self.turn_rad)
        x, y = (xy_m - self.size_m / 2).T
        turned: Floats = np.column_stack([c * x - s * y, s * x + c * y])
        turned += np.asarray(self.centre_m)
        return turned


@dataclass(frozen=True)
class SeenPoints:
    """The points of a sweep, or of several, with all that pillars tell of them.

    Attributes
    ----------
    xy_m
        In the world frame, (n, 2).
    height_m
        As the convention counts it, (n,).
    intensity, new, range_m
        0 to 1; whether it is new since the empty scan; from the sensor. (n,) each.
    """

    xy_m: Floats
    height_m: Floats
    intensity: NDArray[np.float32]
    new: NDArray[np.bool_]
    range_m: Floats

    @classmethod
    def of(cls, sweep: Sweep, view: SiteView, zero: HeightZero) -> SeenPoints:
        """Of a sweep."""
        return cls.together((sweep,), (view,), zero)

    @classmethod
    def together(cls, sweeps: Sequence[Sweep], views: Sequence[SiteView], zero: HeightZero) -> SeenPoints:
        """Of the sweeps of one instant, in the order of the sites."""
        each = [cls._of_one(sweep, view, zero) for sweep, view in zip(sweeps, views, strict=True)]
        if len(each) == 1:
            return each[0]
        return cls(
            *(
                np.concatenate([getattr(its, name) for its in each])
                for name in ("xy_m", "height_m", "intensity", "new", "range_m")
            )
        )

    @classmethod
    def _of_one(cls, sweep: Sweep, view: SiteView, zero: HeightZero) -> SeenPoints:
        at = background.in_world(sweep, view)
        range_m = np.sqrt((sweep.points[:, :3].astype(np.float64) ** 2).sum(axis=1))
        heights = at[:, 2] - zero.below_m(at[:, :2])
        return cls(at[:, :2], heights, sweep.points[:, 3], background.new_in(sweep, view), range_m)


class HeightZero:
    """What heights are counted from at one site, or at several: their ground, or the first one's sensor."""

    def __init__(self, convention: Convention, view: SiteView, roi: Roi, others: Sequence[SiteView] = ()) -> None:
        self._ground = GroundMap.together((view, *others), roi) if convention == "ground" else None
        self._sensor_m = view.pose.z_m

    def below_m(self, xy_m: Floats) -> Floats:
        """World z of height 0 at places (n, 2), (n,)."""
        return np.full(len(xy_m), self._sensor_m) if self._ground is None else self._ground.height_m(xy_m)


@dataclass(frozen=True)
class Pillars:
    """The pillars of one window that hold points.

    Attributes
    ----------
    features
        (p, POINTS, FEATURES) float32, 0 where there is no point.
    present
        1 where there is a point, (p, POINTS) float32.
    cell
        Number of each pillar's cell, ix * (the window's cells) + iy, (p,) int64, ascending.
    """

    features: NDArray[np.float32]
    present: NDArray[np.float32]
    cell: NDArray[np.int64]


def pillars(seen: SeenPoints, window: Window, convention: Convention) -> Pillars:
    """The pillars of what is seen in a window."""
    points = np.column_stack([window.to_window(seen.xy_m), seen.height_m])
    cells_wide = window.cells
    low, high = HEIGHTS_M[convention]
    ix, iy = (np.floor(points[:, axis] / PILLAR_M).astype(np.int64) for axis in (0, 1))
    kept = (
        (ix >= 0) & (ix < cells_wide) & (iy >= 0) & (iy < cells_wide) & (points[:, 2] >= low) & (points[:, 2] <= high)
    )
    cell = (ix * cells_wide + iy)[kept]
    order = np.argsort(cell, kind="stable")
    rows, cell = np.flatnonzero(kept)[order], cell[order]
    cells, first, count = np.unique(cell, return_index=True, return_counts=True)
    pillar = np.repeat(np.arange(len(cells)), count)
    rank = np.arange(len(rows)) - first[pillar]
    slot = rank * POINTS // np.maximum(count, POINTS)[pillar]  # every so many, where there are more than fit
    leads = np.append(True, (slot[1:] != slot[:-1]) | (pillar[1:] != pillar[:-1])) if len(rows) else kept[:0]
    rows, pillar, slot = rows[leads], pillar[leads], slot[leads]
    fewer = np.minimum(count, POINTS)
    at = points[rows]
    mean = np.column_stack([np.bincount(pillar, at[:, axis], len(cells)) for axis in range(3)]) / fewer[:, None]
    centre = (np.column_stack([cells // cells_wide, cells % cells_wide]) + 0.5) * PILLAR_M
    features = np.zeros((len(cells), POINTS, FEATURES), dtype=np.float32)
    present = np.zeros((len(cells), POINTS), dtype=np.float32)
    columns = [
        at[:, :2] - centre[pillar],
        at[:, 2:],
        seen.intensity[rows, None],
        at - mean[pillar],
        seen.new[rows, None],
    ]
    features[pillar, slot] = np.column_stack([*columns, seen.range_m[rows, None] / _FAR_M])
    present[pillar, slot] = 1.0
    return Pillars(features, present, cells)
