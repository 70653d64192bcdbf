"""Counts how many beams of a scan cross each voxel.

Steps: move the scan into the grid's frame in float64, march every beam, count. Effects change as little of that as
they need to:

- where the scan's rows are shares of beams, each beam adds its share, in whole multiples of 2**-32;
- where an effect says what gets as far as a voxel, crossings are listed, and each adds what gets there; where it says
  at which ranges a beam's share falls, each beam adds what is left of it;
- what effects detect of a voxel depends on its range alone, so hits are added up first, then thinned.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.readers import Tpog
from pipeline.core.errors import InputError, RunError
from pipeline.core.grid import Grid
from pipeline.effects.base import Detect, Effect, TransmitScore
from pipeline.kernels import march
from pipeline.kernels.crossings import add_falling, add_shares
from pipeline.scoring.thinning import Hits, RangeTable
from pipeline.sensing import crossings
from pipeline.sensing.scanner import Scan
from pipeline.sensing.scene import Scene
from pipeline.sensing.sensors import Sensor
from pipeline.sensing.sites import Pose

FARTHEST_M = 2e7
"""From further away, float64 cannot tell whether a chord is longer than 1 micrometre."""

UNIT = 2**32
"""What a whole beam adds to a voxel where beams are weighted: weights are rounded to whole multiples of 2**-32."""


MOST_CROSSINGS = 2**31
"""More whole beams times voxels might add up to more than 64 bits hold, in units of 2**-32."""


@dataclass(frozen=True)
class Beams:
    """One sensor's empty scan, as the march needs it.

    Attributes
    ----------
    pose, sensor
        Where it was taken, and with what.
    ends_m
        Where each piece ends, seen from the sensor along the world's axes, (n, 3) float64.
    weight
        The share of its beam that each row is, (n,) float64; None where every row is a whole beam.
    place
        Where messages point to.
    """

    pose: Pose
    sensor: Sensor
    ends_m: NDArray[np.float64]
    weight: NDArray[np.float64] | None = None
    place: str = "scan"

    @classmethod
    def of(cls, scan: Scan) -> Beams:
        """From a scan."""
        return cls(scan.pose, scan.sensor, scan.rows.ends_m, scan.rows.weight)


class Visibility:
    """Counts the hits of one scan after another. Threads may share one.

    Parameters
    ----------
    scene, tpog
        What is scored, and the TPOG whose grid is marched.
    trajectories
        ``trajectories.parquet``, for effects that replay traffic.

    Attributes
    ----------
    unit
        What a whole beam adds to a voxel: 1 (counters are uint32), or ``UNIT`` where effects weight beams (int64).
    """

    def __init__(self, scene: Scene, tpog: Tpog, trajectories: Path | None = None) -> None:
        self._grid = tpog.grid
        transmit: tuple[TransmitScore[Any], ...] = scene.acting(TransmitScore, "score")
        self._transmit = tuple(effect.prepare(scene, tpog, trajectories) for effect in transmit)
        self._detect: tuple[Detect[Any], ...] = scene.acting(Detect, "score")
        self.unit = UNIT if transmit or self._detect or scene.weights_beams else 1
        self._local = threading.local()

    def borrowed_hits(self, beams: Beams, cells: NDArray[np.int64] | None = None) -> Hits:
        """Hits of one scan in each voxel, flat, (nx * ny * nz,), in ``unit``; valid until this thread's next call, so
        that counters of a million voxels are not made anew.

        Parameters
        ----------
        cells
            Flat index of the voxels that are asked for, (n,) int64: scores look only where traffic ever is, and where
            effects detect, only these are thinned. What stands in others means nothing. None for all.
        """
        o, d, shape = in_voxels(beams, self._grid)
        self._refuse_too_many(beams)
        counted, weighted = self._counters()
        if beams.weight is None and not self._transmit:
            counted.fill(0)
            march.count_hits(o, d, shape, self._grid.voxel_m, counted)
            if self.unit == 1:
                return counted
            return self._thinned(counted, UNIT, beams.sensor, o, cells, weighted)
        weighted.fill(0)
        self._add_shares(beams, o, d, weighted)
        return self._thinned(weighted, 1, beams.sensor, o, cells, weighted)

    def _counters(self) -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
        """This thread's counters: of beams, and in ``UNIT`` where anything weights beams."""
        if not hasattr(self._local, "counters"):
            cells = int(np.prod(self._grid.shape))
            weighted = np.zeros(cells if self.unit == UNIT else 0, dtype=np.int64)
            self._local.counters = np.zeros(cells, dtype=np.uint32), weighted
        counters: tuple[NDArray[np.uint32], NDArray[np.int64]] = self._local.counters
        return counters

    def _thinned(
        self,
        hits: Hits,
        whole: int,
        sensor: Sensor,
        o: NDArray[np.float64],
        cells: NDArray[np.int64] | None,
        thinned: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        """``hits`` times ``whole``, less what is not detected, in ``thinned`` at ``cells``."""
        if self._detect:
            table = RangeTable.over(partial(self._detected, sensor), o * self._grid.voxel_m, self._grid)
            table.thin(hits, whole, o, self._grid, np.arange(len(thinned)) if cells is None else cells, thinned)
        elif hits is not thinned:
            np.multiply(hits, whole, out=thinned, dtype=np.int64)
        return thinned

    def _refuse_too_many(self, beams: Beams) -> None:
        """InputError where a sum of weighted hits might leave 64 bits."""
        whole = float(len(beams.ends_m) if beams.weight is None else beams.weight.sum())
        most = MOST_CROSSINGS / (sum(self._grid.shape) + 3)
        if self.unit > 1 and whole >= most:
            raise InputError(beams.place, f"{whole:g} beams with effects", f"fewer than {most:g}")

    def _add_shares(self, beams: Beams, o: NDArray[np.float64], d: NDArray[np.float64], hits: Hits) -> None:
        """Add what each beam is worth in each voxel, in ``UNIT``, before detection."""
        weights = np.ones(len(d)) if beams.weight is None else beams.weight
        shape = np.asarray(self._grid.shape, dtype=np.int64)
        if not self._transmit:
            march.add_hits(o, d, shape, self._grid.voxel_m, np.rint(weights * UNIT).astype(np.int64), hits)
            return
        effects = [effect.seen_from(o * self._grid.voxel_m, self._grid) for effect in self._transmit]
        falls = effects[0].falls(beams.ends_m) if len(effects) == 1 else None
        if falls is not None:
            for part in falls:
                share = _shares(effects[0], part.share, len(part.range_m), "falls")
                add_falling(
                    o, d, shape, self._grid.voxel_m, part.rows, part.first, part.range_m, share, weights, UNIT, hits
                )
            return
        for piece in crossings.listed(beams.pose.position_m, beams.ends_m, self._grid):
            shares = [_shares(effect, effect.share(piece), len(piece.cells), "crossings") for effect in effects]
            add_shares(piece.first, piece.cells, weights[piece.rows], math.prod(shares), UNIT, hits)

    def _detected(self, sensor: Sensor, range_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """What all effects together detect at ranges (n,)."""
        found = np.ones(len(range_m))
        for effect in self._detect:
            found = found * _shares(effect, effect.detect(range_m, sensor), len(range_m), "ranges")
        return found


def _shares(effect: Effect[Any], given: object, count: int, of: str) -> NDArray[np.float64]:
    """What an effect gives, ``count`` shares; RunError for anything else, since a wrong share is a wrong score."""
    if not isinstance(given, np.ndarray) or given.dtype.kind not in "fiub":
        found = f"gives {type(given).__name__}" + (f" of {given.dtype}" if isinstance(given, np.ndarray) else "")
    elif given.shape != (count,):
        found = f"gives an array of the shape {given.shape} for {count} {of}"
    elif given.size and not (given.min() >= 0 and given.max() <= 1):  # false where one is NaN
        found = f"gives values from {given.min():g} to {given.max():g}"
    else:
        return given
    raise RunError(f"effects.{effect.NAME}: {found}; right are shares from 0 to 1, one each")


def in_voxels(beams: Beams, grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Sensor (3,), beams (n, 3) and shape (3,) as :mod:`pipeline.kernels.march` wants them; InputError for what no grid
    holds."""
    place, o_m = beams.place, grid.to_grid_m(np.array(beams.pose.position_m))
    with np.errstate(over="ignore"):
        finite = np.isfinite(o_m / grid.voxel_m).all()
    o, d = grid.segments(beams.pose.position_m, beams.ends_m) if finite else (o_m, beams.ends_m)
    if not (finite and np.isfinite(d).all()):
        raise InputError(place, "a beam with an end that is no number", "finite metres")
    if np.abs(o_m).max() > FARTHEST_M:
        raise InputError(place, f"stands {np.abs(o_m).max():g} m from the grid", f"within {FARTHEST_M:g} m")
    if len(d) > np.iinfo(np.uint32).max:
        raise InputError(place, f"{len(d)} beams", "fewer than 2**32")
    return o, d, np.asarray(grid.shape, dtype=np.int64)
