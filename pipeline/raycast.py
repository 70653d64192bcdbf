"""Which static surface does each beam meet first, and where?

Embree (float32) answers *which triangle*, float64 *where*:

1. The world is moved to the region of interest's own frame in float64.
2. Embree holds every triangle enlarged by a rim that is wider than float32's error. What a beam truly meets, it meets there
   too; no beam leaks through a shared edge or vertex.
3. Each proposed hit is placed in float64 on the true triangle. A beam that met only a rim is doubtful (a few in 10,000); its
   first hit is searched among all true triangles in float64.

So the outcome is that of float64 throughout, with the two rules of :mod:`pipeline.kernels.rays`, at Embree's speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.grid import Roi
from pipeline.kernels import rays
from pipeline.world import World

_RIM_M = 1e-4
_RIM_SHARE = 2.0**-21  # of the scene's extent: eight times float32's rounding
_MAX_SHIFT_M = 1.0  # how far a needle's tip may move when the needle is enlarged


@dataclass(frozen=True)
class EmptyScan:
    """One site's beams against the static world.

    Attributes
    ----------
    beam
        Index of each cast beam in the sensor's table, (n,) uint32, ascending.
    ends_m
        Where the beam ends, seen from the sensor along the world's axes, (n, 3) float64.
    returned
        False where nothing was met within the sensor's range, (n,) bool.
    doubtful
        How many beams float32 alone would not have settled.
    """

    beam: NDArray[np.uint32]
    ends_m: NDArray[np.float64]
    returned: NDArray[np.bool_]
    doubtful: int = 0


class Caster:
    """Casts beams at a static world. Threads may share one.

    Parameters
    ----------
    world
        The static world; may be empty, then no tree is built.
    roi
        Beams that cannot meet it are not cast.
    """

    def __init__(self, world: World, roi: Roi) -> None:
        self._origin_m = np.asarray(roi.origin_m, dtype=np.float64)
        self._size_m = np.asarray(roi.size_m, dtype=np.float64)
        triangles = world.triangles_m - self._origin_m
        cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        area2 = np.sqrt((cross**2).sum(axis=1))
        solid = area2 > 0.0
        self._triangles, self._normals = triangles[solid], cross[solid] / area2[solid, None]
        self._balls, self._groups = _balls(self._triangles, 1), _balls(self._triangles, rays.GROUP)
        self._scene = _tree(self._triangles, area2[solid]) if len(self._triangles) else None

    def scan(self, position_m: tuple[float, float, float], directions: NDArray[np.float64], range_m: float) -> EmptyScan:
        """Cast the beams of one sensor.

        Parameters
        ----------
        position_m
            The sensor in the world frame, metres.
        directions
            Unit vectors of all its beams along the world's axes, (beams, 3) float64.
        range_m
            Where a beam ends that meets nothing.
        """
        o = np.asarray(position_m, dtype=np.float64) - self._origin_m
        reaches = np.empty(len(directions), dtype=np.bool_)
        rays.can_meet(o, directions * range_m, self._size_m, reaches)
        beam = np.flatnonzero(reaches)
        d = directions[beam]
        ranges, doubtful = self.first_hits(o, d)
        returned = ranges <= range_m
        ends = d * np.where(returned, ranges, range_m)[:, None]
        return EmptyScan(beam.astype(np.uint32), ends, returned, doubtful)

    def first_hits(self, o_roi_m: NDArray[np.float64], d: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
        """Range of each ray's first hit (infinity for none), and how many rays had to be searched in float64.

        ``o_roi_m`` is the sensor in the ROI's frame, (3,); ``d`` are unit directions (n, 3).
        """
        ranges = np.full(len(d), np.inf)
        if self._scene is None or len(d) == 0:
            return ranges, 0
        start = np.broadcast_to(o_roi_m.astype(np.float32), d.shape)
        proposed = self._scene.run(np.ascontiguousarray(start), d.astype(np.float32))
        doubtful = np.empty(len(d), dtype=np.int64)
        count = rays.settle(proposed, self._triangles, self._normals, o_roi_m, d, ranges, doubtful)
        rays.search(doubtful[:count], self._triangles, self._normals, self._balls, self._groups, o_roi_m, d, ranges)
        return ranges, int(count)


def _balls(triangles: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """A ball round each ``size`` consecutive triangles, (groups, 4): centre and radius."""
    starts = np.arange(0, len(triangles), size)
    if len(starts) == 0:
        return np.empty((0, 4))
    low = np.minimum.reduceat(triangles.min(axis=1), starts)
    high = np.maximum.reduceat(triangles.max(axis=1), starts)
    radius = np.sqrt(((high - low) ** 2).sum(axis=1)) / 2
    return np.column_stack([(low + high) / 2, radius * (1 + 1e-9) + 2 * rays.EDGE_M])


def _tree(triangles: NDArray[np.float64], area2: NDArray[np.float64]) -> Any:
    """Embree's tree over the triangles, each scaled from its incentre so that its sides move out by the rim."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    rim = max(_RIM_M, _RIM_SHARE * float(np.abs(triangles).max()))
    sides = np.sqrt(((np.roll(triangles, -1, axis=1) - np.roll(triangles, -2, axis=1)) ** 2).sum(axis=2))  # opposite corner i
    perimeter = sides.sum(axis=1)
    incentre = (triangles * sides[:, :, None]).sum(axis=1) / perimeter[:, None]
    from_centre = triangles - incentre[:, None]
    reach = np.sqrt((from_centre**2).sum(axis=2)).max(axis=1)
    share = np.minimum(rim * perimeter / area2, _MAX_SHIFT_M / reach)  # inradius = area2 / perimeter
    scene = EmbreeScene()
    TriangleMesh(scene, (triangles + from_centre * share[:, None, None]).astype(np.float32))
    return scene
