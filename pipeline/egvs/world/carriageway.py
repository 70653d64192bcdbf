"""The carriageway: the lanes that vehicles drive on, as areas.

The centre line of each lane, including those inside junctions, is widened to its width less a margin on either side
(:data:`egvs.world.clearances.LANE_INSET_M`). Sidewalks, bicycle lanes and separate rails are not carriageway. World
frame, metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.traffic.network import LANE_WIDTH_M, Lane, Network, Shape, is_carriageway
from egvs.world import clearances

if TYPE_CHECKING:
    from shapely import STRtree
    from shapely.geometry.base import BaseGeometry


Corner = Sequence[float] | FloatArray
"""x and y, or more, of a corner of a rectangle."""

_PEDESTRIAN_FUNCTIONS = ("crossing", "walkingarea")


@dataclass(frozen=True)
class Carriageway:
    """The lanes that vehicles drive on.

    Attributes
    ----------
    names
        SUMO's id of each lane.
    lanes
        Their centre lines and widths.
    junctions, corners
        Outlines of junctions, and of the walking areas in them.
    """

    names: tuple[str, ...]
    lanes: tuple[Lane, ...]
    junctions: tuple[Shape, ...] = ()
    corners: tuple[Shape, ...] = ()

    @classmethod
    def of(cls, network: Network) -> Carriageway:
        """Return the carriageway of a network; lanes without length are left out."""
        lanes: dict[str, Lane] = {}
        corners: list[Shape] = []
        for edge in network.all_edges:
            if edge.function == "walkingarea":
                corners += [lane for lane in edge.lanes if len(lane.shape_m) > 2]
            if edge.function in _PEDESTRIAN_FUNCTIONS:
                continue
            for index, lane in enumerate(edge.lanes):
                if is_carriageway(lane.permission) and len(lane.shape_m) > 1:
                    lanes[f"{edge.id}_{index}"] = lane
        junctions = [shape for shape in network.junctions if shape.type != "internal" and len(shape.shape_m) > 2]
        return cls(tuple(lanes), tuple(lanes.values()), tuple(junctions), tuple(corners))

    @cached_property
    def areas(self) -> NDArray[Any]:
        """Area of each lane as a shapely polygon, inset on both sides."""
        import shapely

        widths_m = np.array([LANE_WIDTH_M if lane.width_m is None else lane.width_m for lane in self.lanes])
        half_widths_m = np.maximum(widths_m / 2.0 - clearances.LANE_INSET_M, 0.0)
        points = [lane.shape_m[:, :2] for lane in self.lanes]
        lane_of_point = np.repeat(np.arange(len(points)), [len(p) for p in points])
        lines = shapely.linestrings(np.concatenate([np.empty((0, 2)), *points]), indices=lane_of_point)
        areas: NDArray[Any] = shapely.buffer(lines, half_widths_m, cap_style="flat")
        return areas

    @cached_property
    def _tree(self) -> STRtree:
        from shapely import STRtree

        return STRtree(self.areas)

    def lanes_at(self, at_m: FloatArray) -> list[int | None]:
        """Return the index in :attr:`lanes` of the lane that each sensor (n, 3) would stand in; None for no lane.

        It is the highest lane below the sensor, and the first of equally high ones: one on a bridge is not in the way
        of a sensor below it.
        """
        import shapely

        lanes: list[int | None] = [None] * len(at_m)
        road_m = np.full(len(at_m), -np.inf)
        points, lanes_there = self._tree.query(shapely.points(at_m[:, :2]), "intersects").tolist()
        for point, lane in sorted(zip(points, lanes_there, strict=True)):
            height_m = self.height_m(lane, at_m[point, :2])
            if road_m[point] < height_m <= at_m[point, 2]:
                lanes[point] = lane
                road_m[point] = height_m
        return lanes

    def in_junctions(self, at_m: FloatArray) -> BoolArray:
        """Return whether each point (n, 2) is well inside a junction, and not in a walking area; (n,) bool."""
        import shapely

        inside: BoolArray = shapely.intersects(self._junction_interiors, shapely.points(at_m))
        return inside

    @cached_property
    def _junction_interiors(self) -> BaseGeometry:
        """Junctions without their kerbs and walking areas."""
        import shapely

        inset = shapely.buffer(_outlines(self.junctions), -clearances.LANE_INSET_M)
        return shapely.union_all(shapely.difference(inset, shapely.union_all(_outlines(self.corners))))

    def nearest_kerb_m(self, at_m: FloatArray) -> FloatArray:
        """Return the point of the edge of the carriageway that is nearest to each point (n, 2), (n, 2)."""
        import shapely

        _, nearest_m = self._tree.query_nearest(shapely.points(at_m), return_distance=True, all_matches=False)
        margin_m = nearest_m.max() + 2.0 * LANE_WIDTH_M
        lanes = self.within(at_m.min(axis=0) - margin_m, at_m.max(axis=0) + margin_m)
        surface = shapely.union_all([shapely.buffer(lanes, clearances.LANE_INSET_M), self._junction_interiors])
        ways = shapely.shortest_line(shapely.boundary(surface), shapely.points(at_m))
        return np.asarray(shapely.get_coordinates(shapely.get_point(ways, 0)), dtype=np.float64)

    def touching(self, shapes: Sequence[BaseGeometry] | NDArray[Any]) -> IntArray:
        """Return each pair of a shape and a lane that intersect, as indices (2, k)."""
        pairs: IntArray = self._tree.query(shapes, "intersects")
        return pairs

    def nearest(self, at_m: FloatArray) -> int:
        """Return the lane that is nearest to a point (2,)."""
        import shapely

        return int(self._tree.nearest(shapely.points(at_m)))

    def within(self, low_m: Corner, high_m: Corner) -> BaseGeometry:
        """Return all lanes in a rectangle as one shape; empty if there are no lanes."""
        import shapely

        box = shapely.box(*low_m[:2], *high_m[:2])
        return shapely.union_all(shapely.intersection(self.areas[self._tree.query(box, "intersects")], box))

    def heights_in(self, low_m: Corner, high_m: Corner) -> FloatArray:
        """Return the height of each lane that crosses a rectangle, beside its middle, (n,)."""
        import shapely

        middle_m = (np.asarray(low_m)[:2] + np.asarray(high_m)[:2]) / 2.0
        lanes = self._tree.query(shapely.box(*low_m[:2], *high_m[:2]), "intersects")
        return np.array([self.height_m(int(lane), middle_m) for lane in lanes])

    def distance_m(self, low_m: Corner, high_m: Corner) -> float:
        """Return the distance from a rectangle to the nearest lane; 0 where a lane crosses it."""
        import shapely

        box = shapely.box(*low_m[:2], *high_m[:2])
        nearest = self._tree.nearest(box)
        return float(shapely.distance(self.areas[nearest], box))

    @property
    def bounds_m(self) -> FloatArray:
        """South-west and north-east corner of all lanes, (2, 2)."""
        import shapely

        return np.reshape(shapely.total_bounds(self.areas), (2, 2))

    def height_m(self, lane: int, at_m: FloatArray) -> float:
        """Return the road's z beside a point (2,), on the centre line of a lane."""
        line = self.lanes[lane].shape_m
        starts = line[:-1, :2]
        along = np.diff(line[:, :2], axis=0)
        length2 = np.maximum((along**2).sum(axis=1), np.finfo(np.float64).tiny)
        share = np.clip(((at_m - starts) * along).sum(axis=1) / length2, 0.0, 1.0)
        distance2 = ((starts + share[:, None] * along - at_m) ** 2).sum(axis=1)
        i = int(np.argmin(distance2))
        return float(line[i, 2] + share[i] * (line[i + 1, 2] - line[i, 2]))


def _outlines(shapes: Sequence[Shape]) -> NDArray[Any]:
    import shapely

    rings = [shape.shape_m[:, :2] for shape in shapes]
    polygons: NDArray[Any] = np.array([shapely.Polygon(ring) for ring in rings], dtype=object)
    # areas only: GEOS cannot subtract a collection that contains lines; of a thin bow tie it may make an invalid one
    for _ in range(2):
        polygons = shapely.make_valid(polygons, method="structure", keep_collapsed=False)
    return polygons
