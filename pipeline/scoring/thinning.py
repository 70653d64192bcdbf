r"""Thins hits by range: what detects decide, once for each voxel instead of once for each beam.

.. math:: hits(v) \cdot detect(range(v))

The range of a voxel is that of its centre from the sensor, whichever beam crosses it. The function is not asked for a
million voxels: it is asked at some thousand ranges, and a table of cubics through them answers for all. Each piece is
held against the function between its nodes, and used only where it is within ``TOLERANCE`` there; in any other piece
(the step of a hard limit) the function itself is asked for each voxel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.core.grid import Grid
from pipeline.kernels.hits import thinning as kernels

Floats = NDArray[np.float64]
ByRange = Callable[[Floats], Floats]
Hits = NDArray[np.uint32] | NDArray[np.int64]

TOLERANCE = 2.0**-34
"""How far a cubic may be from the function at the three points at which it is tried."""

_FEW, _MANY = 1024, 16384  # pieces at first, and at most
_ROUGH = 1 / 64  # with more pieces than this share left to the function, shorter ones are tried

_THROUGH = np.array([[2, 0, 0, 0], [-11, 18, -9, 2], [18, -45, 36, -9], [-9, 27, -27, 9]]).T / 2
"""Values at 0, 1/3, 2/3 and 1, to the coefficients of the cubic through them."""


@dataclass(frozen=True, eq=False)
class RangeTable:
    """A function of range, in pieces of equal length.

    Attributes
    ----------
    function
        The function itself, (n,) metres to (n,) shares.
    near_m, piece_m
        Where the first piece begins, and how long each is.
    cubics
        Coefficients of each piece, see :func:`pipeline.kernels.hits.thinning.thin`; NaN where a cubic is not good
        enough.
    """

    function: ByRange
    near_m: float
    piece_m: float
    cubics: Floats

    @classmethod
    def of(cls, function: ByRange, near_m: float, far_m: float) -> RangeTable:
        """Of a function from ``near_m`` to ``far_m``."""
        pieces = _FEW
        while True:
            cubics = _cubics(function, near_m, far_m, pieces)
            if pieces >= _MANY or np.isnan(cubics[:, 0]).mean() <= _ROUGH:
                return cls(function, near_m, (far_m - near_m) / pieces, cubics)
            pieces *= 4

    @classmethod
    def over(cls, function: ByRange, o_m: Floats, grid: Grid) -> RangeTable:
        """Of a function for all voxels, seen from ``o_m`` (3,) in the grid's frame."""
        size = np.asarray(grid.roi.size_m)
        near = np.maximum(np.maximum(-o_m, o_m - size), 0.0)
        far = np.maximum(np.abs(o_m), np.abs(o_m - size))
        return cls.of(function, float(np.sqrt((near**2).sum())), float(np.sqrt((far**2).sum())))

    def thin(
        self,
        hits: NDArray[np.uint32] | NDArray[np.int64],
        whole: int,
        o: Floats,
        grid: Grid,
        cells: NDArray[np.int64],
        thinned: NDArray[np.int64],
    ) -> None:
        """Fill ``thinned`` at ``cells`` with hits * ``whole`` * function(range), see
        :func:`pipeline.kernels.hits.thinning.thin`."""
        shape = np.asarray(grid.shape, dtype=np.int64)
        per_m = 1.0 / self.piece_m
        if not kernels.thin(hits, whole, o, shape, grid.voxel_m, self.near_m, per_m, self.cubics, cells, thinned):
            return
        left = cells[thinned[cells] < 0]
        centres = np.column_stack(np.unravel_index(left, grid.shape)) + 0.5
        range_m = np.sqrt(((centres - o) ** 2).sum(axis=1)) * grid.voxel_m
        thinned[left] = np.rint(self.function(range_m) * (-1 - thinned[left])).astype(np.int64)


def _cubics(function: ByRange, near_m: float, far_m: float, pieces: int) -> Floats:
    """Cubics through four points of each piece; NaN where one is too far off at the three points between them."""
    at = np.arange(pieces)[:, None] + np.arange(7) / 6
    found = function((near_m + at * ((far_m - near_m) / pieces)).ravel()).reshape(pieces, 7)
    cubics: Floats = (found[:, ::2, None] * _THROUGH).sum(axis=1)
    between = np.arange(1, 6, 2) / 6
    tried = ((cubics[:, 3:] * between + cubics[:, 2:3]) * between + cubics[:, 1:2]) * between + cubics[:, :1]
    off = np.abs(tried - found[:, 1::2])
    cubics[~(off <= TOLERANCE).all(axis=1)] = np.nan
    return cubics
