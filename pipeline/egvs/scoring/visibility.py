r"""Hits of a scan: how many of its beams cross each voxel, with effects on beams and detection.

Steps: convert the scan to the grid's frame in float64, traverse the voxels of every beam, count. Effects change only
what they need to:

- where the rows of a scan are shares of beams, each row adds its share, in integer multiples of 2**-32;
- where an effect defines which share of a beam reaches a voxel, crossings are listed, and each adds that share; where
  it defines at which ranges the share of a beam falls, each beam adds the share that remains;
- the probability that a return from a voxel is detected depends on its range only, so hits are added up first and then
  multiplied by it:

.. math:: hits(v) \cdot detect(range(v))

The range of a voxel is that of its centre from the sensor, for all beams. The function is not evaluated for a million
voxels but at a few thousand ranges, and interpolated by a table of cubics. Each piece is compared with the
function between its nodes and used only where it is within ``TOLERANCE``; in any other piece (the step of a hard limit)
the function itself is evaluated for each voxel.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.tpog import Tpog
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, Grid, IntArray
from egvs.effects.base import Detect, TransmitScore, checked_shares
from egvs.effects.returns import ReturnProbability
from egvs.kernels import hits as hit_kernels
from egvs.kernels import traversal
from egvs.scoring.egvs import Hits as Hits
from egvs.sensors import voxel_crossings
from egvs.sensors.scanner import Scan
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Pose

ByRange = Callable[[FloatArray], FloatArray]

UNIT = 2**32
"""What one beam adds to a voxel where beams are weighted: weights are rounded to integer multiples of 2**-32."""

MAX_CROSSINGS = 2**31
"""Above this number of beams times voxels, sums in units of 2**-32 might overflow 64 bits."""

FARTHEST_M = 2e7
"""From farther away, float64 cannot decide whether a chord is longer than 1 micrometre."""

TOLERANCE = 2.0**-34
"""Largest accepted difference between a cubic and the function at the three points where both are compared."""

_INITIAL_PIECES = 1024
_MAX_PIECES = 16384
_MAX_ROUGH_SHARE = 1 / 64  # if a larger share of pieces needs the function itself, shorter pieces are tried

_CUBIC_COEFFICIENTS = np.array([[2, 0, 0, 0], [-11, 18, -9, 2], [18, -45, 36, -9], [-9, 27, -27, 9]]) / 2
"""Row i, times values at 0, 1/3, 2/3 and 1, is coefficient i of the cubic through them."""


@dataclass(frozen=True)
class Beams:
    """One sensor's empty scan.

    Attributes
    ----------
    pose, sensor
        Pose and sensor of the scan.
    ends_m
        End of each beam or part of a beam, relative to the sensor along the world's axes, (n, 3) float64.
    weight
        Share of its beam of each row, (n,) float64; None where every row is one beam.
    where
        The source of the beams, for messages.
    """

    pose: Pose
    sensor: Sensor
    ends_m: FloatArray
    weight: FloatArray | None = None
    where: str = "scan"

    @classmethod
    def of(cls, scan: Scan) -> Beams:
        """Return the beams of a scan."""
        return cls(scan.pose, scan.sensor, scan.rows.ends_m, scan.rows.weight)


class VoxelSegments(NamedTuple):
    """Beams in voxel units, in the form that :mod:`egvs.kernels.traversal` takes.

    ``origin``: the sensor, (3,) float64; ``ends``: beams from there, (n, 3) float64; ``shape``: the grid's, (3,) int64.
    """

    origin: FloatArray
    ends: FloatArray
    shape: IntArray


def to_voxel_units(beams: Beams, grid: Grid) -> VoxelSegments:
    """Return sensor and beams in voxel units.

    Raises
    ------
    InputError
        For positions that are not finite or too far from the grid, and for too many beams.
    """
    origin_m = grid.to_grid_m(np.array(beams.pose.position_m))
    with np.errstate(over="ignore"):
        is_finite = bool(np.isfinite(origin_m / grid.voxel_m).all())
    origin, ends = origin_m, beams.ends_m
    if is_finite:
        origin, ends = grid.segments(beams.pose.position_m, beams.ends_m)

    if not (is_finite and np.isfinite(ends).all()):
        raise InputError(beams.where, "a beam has a non-finite end point", "Use finite coordinates in metres.")
    distance_m = np.abs(origin_m).max()
    if distance_m > FARTHEST_M:
        problem = f"expected a sensor within {FARTHEST_M:g} m of the grid, got {distance_m:g} m"
        raise InputError(beams.where, problem, "Check the coordinates of the site.")
    if len(ends) > np.iinfo(np.uint32).max:
        raise InputError(beams.where, f"expected fewer than 2**32 beams, got {len(ends)}", "Use a smaller sensor.")
    return VoxelSegments(origin, ends, np.asarray(grid.shape, dtype=np.int64))


class HitCounter:
    """Counts the hits of one scan after another. Threads may share one.

    Parameters
    ----------
    scene, tpog
        The scene with its effects, and the TPOG with the grid.
    trajectories
        ``trajectories.parquet``, for effects that replay traffic.

    Attributes
    ----------
    unit
        What one beam adds to a voxel: 1 (counters are uint32), or ``UNIT`` where effects weight beams (int64).
    """

    def __init__(self, scene: Scene, tpog: Tpog, trajectories: Path | None = None) -> None:
        self._grid = tpog.grid
        transmit: tuple[TransmitScore[Any], ...] = scene.acting(TransmitScore, "score")
        self._transmit = tuple(effect.prepare(scene, tpog, trajectories) for effect in transmit)
        self._scene = scene
        self.unit = 1
        detect: tuple[Detect[Any], ...] = scene.acting(Detect, "score")
        if transmit or detect or scene.weights_beams:
            self.unit = UNIT
        self._local = threading.local()

    def borrowed_hits(self, beams: Beams, cells: IntArray | None = None) -> Hits:
        """Return the hits of one scan in each voxel, flat, (nx * ny * nz,), in ``unit``.

        The array is valid until this thread's next call: counters of a million voxels are not allocated again.

        Parameters
        ----------
        beams
            The scan.
        cells
            Flat index of the voxels that are needed, (n,) int64; values in other voxels are undefined. Scores need only
            those that traffic ever occupies. None for all voxels.
        """
        segments = to_voxel_units(beams, self._grid)
        self._refuse_too_many(beams)
        counted, weighted = self._counters()
        hits: Hits
        if beams.weight is None and not self._transmit:
            counted.fill(0)
            traversal.count_hits(*segments, self._grid.voxel_m, counted)
            if self.unit == 1:
                return counted
            hits, scale = counted, UNIT
        else:
            weighted.fill(0)
            self._add_shares(beams, segments, weighted)
            hits, scale = weighted, 1

        probability = ReturnProbability.of(self._scene, beams.sensor)
        if probability is not None:
            if cells is None:
                cells = np.arange(len(weighted))
            table = RangeTable.over(probability, segments.origin * self._grid.voxel_m, self._grid)
            table.thin(hits, scale, segments.origin, self._grid, cells, weighted)
        elif hits is not weighted:
            np.multiply(hits, scale, out=weighted, dtype=np.int64)
        return weighted

    def _refuse_too_many(self, beams: Beams) -> None:
        """Raise an InputError where a sum of weighted hits might overflow 64 bits."""
        total_weight = float(len(beams.ends_m))
        if beams.weight is not None:
            total_weight = float(beams.weight.sum())
        limit = MAX_CROSSINGS / (sum(self._grid.shape) + 3)
        if self.unit > 1 and total_weight >= limit:
            problem = f"expected fewer than {limit:g} beams with effects, got {total_weight:g}"
            raise InputError(beams.where, problem, "Use a sensor with fewer beams, or larger voxels.")

    def _counters(self) -> tuple[NDArray[np.uint32], IntArray]:
        """This thread's counters: of beams, and in ``UNIT`` where anything weights beams."""
        if not hasattr(self._local, "counters"):
            cells = int(np.prod(self._grid.shape))
            weighted_cells = 0
            if self.unit == UNIT:
                weighted_cells = cells
            self._local.counters = np.zeros(cells, dtype=np.uint32), np.zeros(weighted_cells, dtype=np.int64)
        counters: tuple[NDArray[np.uint32], IntArray] = self._local.counters
        return counters

    def _add_shares(self, beams: Beams, segments: VoxelSegments, hits: Hits) -> None:
        """Add the share of each beam that reaches each voxel, in ``UNIT``, before detection."""
        voxel_m = self._grid.voxel_m
        weights = beams.weight
        if weights is None:
            weights = np.ones(len(segments.ends))
        if not self._transmit:
            traversal.add_hits(*segments, voxel_m, np.rint(weights * UNIT).astype(np.int64), hits)
            return

        effects = [effect.for_sensor(segments.origin * voxel_m, self._grid) for effect in self._transmit]
        steps = None
        if len(effects) == 1:
            steps = effects[0].transmittance_steps(beams.ends_m)
        if steps is not None:
            for part in steps:
                share = checked_shares(effects[0], part.share, len(part.range_m), "transmittance_steps")
                hit_kernels.add_stepwise_shares(
                    *segments, voxel_m, part.rows, part.first, part.range_m, share, weights, UNIT, hits
                )
            return

        for piece in voxel_crossings.list_crossings(beams.pose.position_m, beams.ends_m, self._grid):
            shares = [checked_shares(effect, effect.share(piece), len(piece.cells), "crossings") for effect in effects]
            hit_kernels.add_shares(piece.first, piece.cells, weights[piece.rows], math.prod(shares), UNIT, hits)


@dataclass(frozen=True, eq=False)
class RangeTable:
    """A function of range, in pieces of equal length.

    Attributes
    ----------
    function
        The function itself, (n,) metres to (n,) shares.
    near_m, piece_m
        Start of the first piece, and length of each.
    cubics
        Coefficients of each piece, see :func:`egvs.kernels.hits.thin_by_range`; NaN where a cubic is too inaccurate.
    """

    function: ByRange
    near_m: float
    piece_m: float
    cubics: FloatArray

    @classmethod
    def of(cls, function: ByRange, near_m: float, far_m: float) -> RangeTable:
        """Tabulate a function from ``near_m`` to ``far_m``."""
        pieces = _INITIAL_PIECES
        while True:
            cubics = _fit_cubics(function, near_m, far_m, pieces)
            if pieces >= _MAX_PIECES or np.isnan(cubics[:, 0]).mean() <= _MAX_ROUGH_SHARE:
                return cls(function, near_m, (far_m - near_m) / pieces, cubics)
            pieces *= 4

    @classmethod
    def over(cls, function: ByRange, origin_m: FloatArray, grid: Grid) -> RangeTable:
        """Tabulate a function over the ranges of all voxels from ``origin_m`` (3,), in the grid's frame."""
        size = np.asarray(grid.roi.size_m)
        near = np.maximum(np.maximum(-origin_m, origin_m - size), 0.0)
        far = np.maximum(np.abs(origin_m), np.abs(origin_m - size))
        return cls.of(function, float(np.sqrt((near**2).sum())), float(np.sqrt((far**2).sum())))

    def thin(self, hits: Hits, scale: int, origin: FloatArray, grid: Grid, cells: IntArray, thinned: IntArray) -> None:
        """Fill ``thinned`` at ``cells`` with hits * ``scale`` * function(range).

        See :func:`egvs.kernels.hits.thin_by_range`.
        """
        shape = np.asarray(grid.shape, dtype=np.int64)
        pieces_per_m = 1.0 / self.piece_m
        needs_function = hit_kernels.thin_by_range(
            hits, scale, origin, shape, grid.voxel_m, self.near_m, pieces_per_m, self.cubics, cells, thinned
        )
        if not needs_function:
            return

        remaining = cells[thinned[cells] < 0]  # the kernel leaves -1 - hits there
        centres = np.column_stack(np.unravel_index(remaining, grid.shape)) + 0.5
        range_m = np.sqrt(((centres - origin) ** 2).sum(axis=1)) * grid.voxel_m
        thinned[remaining] = np.rint(self.function(range_m) * (-1 - thinned[remaining])).astype(np.int64)


def _fit_cubics(function: ByRange, near_m: float, far_m: float, pieces: int) -> FloatArray:
    """Fit a cubic through four points of each piece; NaN if it is too inaccurate at the three points between them."""
    sixths = np.arange(pieces)[:, None] + np.arange(6) / 6
    nodes = np.append(sixths, float(pieces))
    values = np.asarray(function(near_m + nodes * ((far_m - near_m) / pieces)), dtype=np.float64)
    cubics = np.empty((pieces, 4))
    hit_kernels.fit_cubics(values, _CUBIC_COEFFICIENTS, TOLERANCE, cubics)
    return cubics
