r"""Occupancy that a recording does not know: during long gaps in recorded tracks.

In a gap, the road user may be anywhere on the straight way between the two ends. The voxels that its box sweeps on this
way, at any height, are neither occupied nor empty in the frames of the gap. With u(v) of the T frames of a block
unknown, the share of occupied frames is estimated from the others, and the count of the block becomes

.. math:: c'(v) = \min\left(T, \operatorname{round}\left(c(v) \frac{T}{T - u(v)}\right)\right)

so that every reader of the counts divides by T as usual. A voxel that is unknown for more than half of a block counts
as 0 there: it has no part in scores.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.frame_boxes import UNKNOWN_BOXES_KEY, FrameBoxes
from egvs.core.grid import Grid, IntArray
from egvs.scoring.occupancy import count_occupancy

MAX_UNKNOWN_SHARE = 0.5
"""Share of a block's frames above which an unknown voxel counts as 0."""

_STEPS_PER_VOXEL = 2.0
_MIN_WAY_M = 1e-6


@dataclass(frozen=True)
class SweptGap:
    """A gap: its frames from ``first`` to before ``end``, and the voxels of the way, as flat indices (n,) int64."""

    first: int
    end: int
    cells: IntArray


@dataclass
class UnknownOccupancy:
    """Gaps in recorded tracks, and what became of the counts.

    Attributes
    ----------
    gaps
        The gaps.
    scaled, left_out
        Number of occupied voxels, summed over blocks, whose counts were scaled, and of those that count as 0.
    """

    gaps: list[SweptGap]
    scaled: int = 0
    left_out: int = 0

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, Any], grid: Grid) -> UnknownOccupancy:
        """Return the gaps in the metadata of ``trajectories.parquet``; none for other traffic."""
        return cls([_sweep(values, grid) for values in metadata.get(UNKNOWN_BOXES_KEY, ())])

    def adjust(self, counts: NDArray[np.int32], first_frame: int, frames: int) -> None:
        """Change the counts of a block in place.

        Parameters
        ----------
        counts
            Frames in which each voxel is occupied, (nx, ny, nz), contiguous.
        first_frame, frames
            First frame of the block, and their number.
        """
        overlaps = [(min(gap.end, first_frame + frames) - max(gap.first, first_frame), gap) for gap in self.gaps]
        overlaps = [(length, gap) for length, gap in overlaps if length > 0]
        if not overlaps:
            return
        unknown = np.zeros(counts.size, dtype=np.int64)
        for length, gap in overlaps:
            unknown[gap.cells] += length
        flat = counts.reshape(-1)
        cells = np.flatnonzero((unknown > 0) & (flat > 0))
        known = frames - unknown[cells]
        is_known = known >= MAX_UNKNOWN_SHARE * frames
        scaled = np.rint(flat[cells] * frames / np.maximum(known, 1))
        flat[cells] = np.where(is_known, np.minimum(scaled, frames), 0)
        self.scaled += int(is_known.sum())
        self.left_out += int((~is_known).sum())

    def summary(self) -> dict[str, int]:
        """Return the numbers of gaps and voxels; empty without gaps."""
        if not self.gaps:
            return {}
        return {"unknown_gaps": len(self.gaps), "scaled_voxels": self.scaled, "unknown_voxels": self.left_out}


def _sweep(values: Mapping[str, Any], grid: Grid) -> SweptGap:
    """Find the voxels on the way through a gap."""
    import shapely

    first, end = values["frames"]
    half_m = 0.5 * float(np.hypot(*values["size_m"]))
    low_m, size_m = np.array(grid.origin_m[:2]), np.array(grid.roi.size_m[:2])
    around = shapely.box(*(low_m - half_m), *(low_m + size_m + half_m))
    ends_m = np.array([values["start_m"], values["end_m"]], dtype=np.float64)
    stands = np.hypot(*(ends_m[1] - ends_m[0])) < _MIN_WAY_M
    whole_way = shapely.Point(ends_m[0]) if stands else shapely.LineString(ends_m)
    way = shapely.intersection(whole_way, around)
    if way.is_empty:
        return SweptGap(int(first), int(end), np.empty(0, dtype=np.int64))
    start_m, end_m = shapely.get_coordinates(way)[[0, -1]]
    steps = int(np.ceil(_STEPS_PER_VOXEL * np.hypot(*(end_m - start_m)) / grid.voxel_m)) + 1
    xy_m = start_m + np.linspace(0.0, 1.0, steps)[:, None] * (end_m - start_m)
    height_m = grid.voxel_m * grid.shape[2]
    bottom_m = grid.origin_m[2]
    centres_m = grid.to_grid_m(np.column_stack([xy_m, np.full(steps, bottom_m + height_m / 2)]))
    turns = np.column_stack([np.full(steps, values["yaw_rad"]), np.zeros(steps)])
    sizes_m = np.tile([*values["size_m"], height_m], (steps, 1))
    boxes = FrameBoxes(np.zeros(steps, dtype=np.int64), np.hstack([centres_m, turns, sizes_m]))
    return SweptGap(int(first), int(end), np.flatnonzero(count_occupancy(boxes, grid, 1)))
