"""Where vehicles drive: the lanes of a network as areas, and what of them a place or a solid takes.

Steps: widen the middle line of each lane, those inside junctions included, to its width, less a little on either side
(:data:`pipeline.world.limits.LANE_INSET_M`); keep the areas in a tree. Sidewalks, bicycle lanes and rails apart from
the street are no carriageway. World frame, metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.traffic.network import LANE_WIDTH_M, Lane, Network, Permission, Shape
from pipeline.world import limits

if TYPE_CHECKING:
    from shapely import STRtree
    from shapely.geometry.base import BaseGeometry

Floats = NDArray[np.float64]
Corner = Sequence[float] | Floats
"""x and y, or more, of a corner of a rectangle."""

ON_ROADS = (
    "passenger", "private", "taxi", "bus", "coach", "delivery", "truck", "trailer", "motorcycle", "moped", "evehicle",
    "hov", "emergency", "authority", "army", "vip", "tram",
)  # fmt: skip
"""A lane that admits one of these vClasses is carriageway."""

_PEOPLE = ("crossing", "walkingarea")


@dataclass(frozen=True)
class Carriageway:
    """The lanes that vehicles drive on.

    Attributes
    ----------
    names
        SUMO's id of each lane.
    lanes
        Their middle lines and widths.
    junctions, corners
        Outlines of junctions, and of the walking areas in them.
    """

    names: tuple[str, ...]
    lanes: tuple[Lane, ...]
    junctions: tuple[Shape, ...] = ()
    corners: tuple[Shape, ...] = ()

    @classmethod
    def of(cls, network: Network) -> Carriageway:
        """From a network; a lane without length is left out."""
        found = [
            (f"{edge.id}_{index}", lane)
            for edge in network.all_edges
            if edge.function not in _PEOPLE
            for index, lane in enumerate(edge.lanes)
            if is_carriageway(lane.permission) and len(lane.shape_m) > 1
        ]
        junctions = tuple(j for j in network.junctions if j.type != "internal" and len(j.shape_m) > 2)
        walked = (lane for edge in network.all_edges if edge.function == "walkingarea" for lane in edge.lanes)
        corners = tuple(lane for lane in walked if len(lane.shape_m) > 2)
        return cls(tuple(name for name, _ in found), tuple(lane for _, lane in found), junctions, corners)

    @cached_property
    def areas(self) -> NDArray[Any]:
        """Each lane's area as a shapely polygon, inset on both sides."""
        import shapely

        widths_m = np.array([LANE_WIDTH_M if lane.width_m is None else lane.width_m for lane in self.lanes])
        halves_m = np.maximum(widths_m / 2.0 - limits.LANE_INSET_M, 0.0)
        points = [lane.shape_m[:, :2] for lane in self.lanes]
        owner = np.repeat(np.arange(len(points)), [len(p) for p in points])
        lines = shapely.linestrings(np.concatenate([np.empty((0, 2)), *points]), indices=owner)
        areas: NDArray[Any] = shapely.buffer(lines, halves_m, cap_style="flat")
        return areas

    @cached_property
    def _tree(self) -> STRtree:
        from shapely import STRtree

        return STRtree(self.areas)

    def lanes_at(self, at_m: Floats) -> list[int | None]:
        """For each place (n, 2), the first lane that it stands in, as a position in :attr:`lanes`; None beside them."""
        import shapely

        found: list[int | None] = [None] * len(at_m)
        for place, lane in sorted(zip(*self._tree.query(shapely.points(at_m), "intersects").tolist(), strict=True)):
            if found[place] is None:
                found[place] = lane
        return found

    def in_junctions(self, at_m: Floats) -> NDArray[np.bool_]:
        """Whether each place (n, 2) lies in a junction, deeper than at a kerb, and not where people walk."""
        import shapely

        found: NDArray[np.bool_] = shapely.intersects(self._inner, shapely.points(at_m))
        return found

    @cached_property
    def _inner(self) -> BaseGeometry:
        """Junctions, deeper than at a kerb, without where people walk."""
        import shapely

        inner = shapely.difference(
            shapely.buffer(_outlines(self.junctions), -limits.LANE_INSET_M), shapely.union_all(_outlines(self.corners))
        )
        return shapely.union_all(inner)

    def touching(self, shapes: Sequence[BaseGeometry] | NDArray[Any]) -> NDArray[np.int64]:
        """(2, k): each shape that has something in common with a lane, and that lane."""
        pairs: NDArray[np.int64] = self._tree.query(shapes, "intersects")
        return pairs

    def nearest(self, at_m: Floats) -> int:
        """The lane that is nearest to a place (2,)."""
        import shapely

        return int(self._tree.nearest(shapely.points(at_m)))

    def within(self, low_m: Corner, high_m: Corner) -> BaseGeometry:
        """All lanes in a rectangle as one shape, empty where there is none."""
        import shapely

        box = shapely.box(*low_m[:2], *high_m[:2])
        return shapely.union_all(shapely.intersection(self.areas[self._tree.query(box, "intersects")], box))

    def distance_m(self, low_m: Corner, high_m: Corner) -> float:
        """How far the nearest lane is from a rectangle; 0 where one leads through it."""
        import shapely

        box = shapely.box(*low_m[:2], *high_m[:2])
        nearest = self._tree.nearest(box)
        return float(shapely.distance(self.areas[nearest], box))

    @property
    def bounds_m(self) -> Floats:
        """South-west and north-east corner of all lanes, (2, 2)."""
        import shapely

        return np.reshape(shapely.total_bounds(self.areas), (2, 2))

    def height_m(self, lane: int, at_m: Floats) -> float:
        """The road's z beside a place (2,), on the middle line of a lane."""
        line = self.lanes[lane].shape_m
        start, along = line[:-1, :2], np.diff(line[:, :2], axis=0)
        length2 = np.maximum((along**2).sum(axis=1), np.finfo(np.float64).tiny)
        share = np.clip(((at_m - start) * along).sum(axis=1) / length2, 0.0, 1.0)
        i = int(np.argmin(((start + share[:, None] * along - at_m) ** 2).sum(axis=1)))
        return float(line[i, 2] + share[i] * (line[i + 1, 2] - line[i, 2]))


def _outlines(shapes: Sequence[Shape]) -> NDArray[Any]:
    import shapely

    rings = [shape.shape_m[:, :2] for shape in shapes]
    polygons = np.array([shapely.Polygon(ring) for ring in rings], dtype=object)
    # areas alone: GEOS subtracts no collection in which lines stand beside them
    outlines: NDArray[Any] = shapely.make_valid(polygons, method="structure", keep_collapsed=False)
    return outlines


def is_carriageway(permission: Permission) -> bool:
    """Whether a lane is for vehicles of the road."""
    return any(permission.admits(vclass) for vclass in ON_ROADS)
