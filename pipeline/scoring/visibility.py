"""Counts how many beams of a scan cross each voxel.

Steps: move the scan into the grid's frame in float64, march every beam, count. Where the scan's rows are shares of
beams, or effects of the score stage act, the crossings are listed, weighted, and added up in whole multiples of 2**-32
instead.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.readers import Tpog
from pipeline.core.errors import InputError, RunError
from pipeline.core.grid import Grid
from pipeline.effects.base import Detect, Effect, TransmitScore
from pipeline.kernels import march
from pipeline.kernels.crossings import accumulate
from pipeline.sensing import crossings
from pipeline.sensing.scanner import Scan
from pipeline.sensing.scene import Scene
from pipeline.sensing.sensors import Sensor
from pipeline.sensing.sites import Pose

Hits = NDArray[np.uint32] | NDArray[np.int64]

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
        live: tuple[Effect[Any], ...] = scene.acting(Effect, "score")
        self._effects = tuple(
            effect.prepare(scene, tpog, trajectories) if isinstance(effect, TransmitScore) else effect
            for effect in live
        )
        self.unit = UNIT if live or scene.weights_beams else 1
        self._local = threading.local()

    def borrowed_hits(self, beams: Beams) -> Hits:
        """Hits of one scan in each voxel, flat, (nx * ny * nz,), in ``unit``; valid until this thread's next call, so
        that counters of a million voxels are not made anew."""
        hits = self._counters()
        o, d, shape = in_voxels(beams, self._grid)
        if self.unit == 1:
            march.count_hits(o, d, shape, self._grid.voxel_m, hits)
        else:
            self._add_weighted(beams, hits)
        return hits

    def _counters(self) -> Hits:
        """This thread's counters, set to 0."""
        if not hasattr(self._local, "hits"):
            kind = np.uint32 if self.unit == 1 else np.int64
            self._local.hits = np.zeros(int(np.prod(self._grid.shape)), dtype=kind)
        hits: Hits = self._local.hits
        hits.fill(0)
        return hits

    def _add_weighted(self, beams: Beams, hits: Hits) -> None:
        whole = float(len(beams.ends_m) if beams.weight is None else beams.weight.sum())
        most = MOST_CROSSINGS / (sum(self._grid.shape) + 3)
        if whole >= most:  # no sum over voxels may leave 64 bits
            raise InputError(beams.place, f"{whole:g} beams with effects", f"fewer than {most:g}")
        for piece in crossings.listed(beams.pose.position_m, beams.ends_m, self._grid):
            share = np.ones(len(piece.cells)) if beams.weight is None else beams.weight[piece.rows][piece.piece]
            for effect in self._effects:
                if isinstance(effect, Detect):
                    share = share * _shares(effect, effect.detect(piece.middle_m, beams.sensor), share)
                elif isinstance(effect, TransmitScore):
                    share = share * _shares(effect, effect.share(piece), share)
            accumulate(piece.cells, np.rint(share * UNIT).astype(np.int64), hits)


def _shares(effect: Effect[Any], given: object, like: NDArray[np.float64]) -> NDArray[np.float64]:
    """What an effect gives, ``like`` many shares; RunError for anything else, since a wrong share is a wrong score."""
    if not isinstance(given, np.ndarray) or given.dtype.kind not in "fiub":
        found = f"gives {type(given).__name__}" + (f" of {given.dtype}" if isinstance(given, np.ndarray) else "")
    elif given.shape != like.shape:
        found = f"gives an array of the shape {given.shape} for {len(like)} crossings"
    elif given.size and not (given.min() >= 0 and given.max() <= 1):  # false where one is NaN
        found = f"gives values from {given.min():g} to {given.max():g}"
    else:
        return given
    raise RunError(f"effects.{effect.NAME}: {found}; right are shares from 0 to 1, one each")


def in_voxels(beams: Beams, grid: Grid) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Sensor (3,), beams (n, 3) and shape (3,) as :mod:`pipeline.kernels.march` wants them; InputError for what no grid
    holds."""
    place, ends_m = beams.place, beams.ends_m
    o_m = grid.to_grid_m(np.array(beams.pose.position_m))
    with np.errstate(over="ignore"):
        o, d = o_m / grid.voxel_m, ends_m / grid.voxel_m
    if not (np.isfinite(o).all() and np.isfinite(d).all()):
        raise InputError(place, "a beam with an end that is no number", "finite metres")
    if np.abs(o_m).max() > FARTHEST_M:
        raise InputError(place, f"stands {np.abs(o_m).max():g} m from the grid", f"within {FARTHEST_M:g} m")
    if len(ends_m) > np.iinfo(np.uint32).max:
        raise InputError(place, f"{len(ends_m)} beams", "fewer than 2**32")
    return o, d, np.asarray(grid.shape, dtype=np.int64)
