"""Solids that can carry a sensor: poles, masts and signs.

Maps of street furniture contain the very mast that a sensor is mounted on. It would stop most beams of a sensor inside
it, or beside it, although a real sensor is mounted so that it sees past its mast. A solid of one of :data:`KINDS` whose
footprint is at most :data:`MAX_WIDTH_M` across is the support of every sensor that is within :data:`MAX_DISTANCE_M` of
it in plan. The width of a footprint is the longer side of the smallest rectangle around it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from egvs.core.grid import IntArray
from egvs.world.mesh import World

if TYPE_CHECKING:
    import shapely

KINDS = ("pole", "mast", "sign")
MAX_WIDTH_M = 1.0
MAX_DISTANCE_M = 0.5

_ROUNDING_M = 1e-6
"""A footprint that is exactly as wide, or as far away, as allowed is a support."""


@dataclass(frozen=True)
class Supports:
    """The solids of a world that can carry a sensor.

    Attributes
    ----------
    solids
        Indices into the solids of the world, (n,) int64.
    footprints
        The area that each covers in plan, (n,) shapely geometries, world frame.
    """

    solids: IntArray
    footprints: NDArray[Any]

    @classmethod
    def of(cls, world: World) -> Supports:
        """Find the supports of a world."""
        import shapely

        is_support_kind = np.array([kind.lower() in KINDS for _, kind in world.solids], dtype=np.bool_)
        faces = np.flatnonzero(is_support_kind[world.solid_of_face])
        faces = faces[np.argsort(world.solid_of_face[faces], kind="stable")]
        solids, group = np.unique(world.solid_of_face[faces], return_inverse=True)
        corners_m = world.triangles_m[faces][:, :, :2].reshape(-1, 2)
        footprints = shapely.convex_hull(shapely.multipoints(corners_m, indices=np.repeat(group, 3)))
        is_narrow = np.array([_width_m(footprint) <= MAX_WIDTH_M + _ROUNDING_M for footprint in footprints], dtype=bool)
        return cls(solids[is_narrow].astype(np.int64), footprints[is_narrow])

    def at(self, x_m: float, y_m: float) -> tuple[int, ...]:
        """Return the solids that carry a sensor at a location, in order; none where there is no support."""
        import shapely

        distance_m = shapely.distance(self.footprints, shapely.Point(x_m, y_m))
        return tuple(self.solids[distance_m <= MAX_DISTANCE_M + _ROUNDING_M].tolist())


def _width_m(footprint: shapely.Geometry) -> float:
    import shapely

    rectangle = shapely.get_coordinates(shapely.oriented_envelope(footprint))
    sides_m = np.hypot(*np.diff(rectangle[:3], axis=0).T)
    return float(sides_m.max(initial=0.0))


def without_solids(world: World, solids: tuple[int, ...]) -> World:
    """Return the world without some solids; the numbers of the other solids and of all faces are the same.

    The faces of these solids are reduced to points, which no beam can hit.
    """
    faces = world.faces.copy()
    removed = np.isin(world.solid_of_face, solids)
    faces[removed] = faces[removed][:, :1]
    return World(world.vertices_m, faces, world.solid_of_face, world.solids)
