"""Shapes of nodes that do not cut the lanes.

netconvert cuts each lane where it crosses the outline of a node, or extends it to the outline. So the outline of a
junction is the area of its inner lanelets and between the lanes' ends, without the roads, and without a narrow strip
about each lane's line and its extension away from the junction. Where a lane is cut or extended all the same, the
outline may cover parts of roads; where that does not help either, it is a small triangle beside all lines.

Frame: x, y, z in metres of the world frame.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping

import numpy as np
import shapely
from shapely.geometry import LineString, MultiLineString, MultiPoint, Point, Polygon

from egvs.core.grid import FloatArray
from egvs.extensions.maps.lanelet2.road_layout import Road, RoadLayout

STRIPS_M = (0.1, 0.05)
"""Half width of the strip about a lane's line that stays free, in the first and in the second attempt."""

ATTEMPTS = 3
"""Number of shapes to try, see :meth:`NodeShapes.shape_m`."""

_TRIANGLE_M = 0.1
_FREE_M = 0.3
_EXTENSION_M = 100.0
_SIMPLIFY_M = 0.02
_MIN_AREA_M2 = 0.5
_RADII_M = (0.6, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0)
_DIRECTIONS = 16


class NodeShapes:
    """Outlines of the nodes of a layout."""

    def __init__(self, layout: RoadLayout) -> None:
        self._layout = layout
        self._roads: dict[str, list[tuple[Road, bool]]] = defaultdict(list)
        for road in layout.roads.values():
            self._roads[road.start].append((road, True))
            self._roads[road.end].append((road, False))
        self._inner = defaultdict(list)
        for key, node in layout.inner.items():
            self._inner[node].append(layout.graph.lanelets[key])

    def position_m(self, node: str) -> FloatArray:
        """Return the middle (3,) of the ends of the lanes at a node."""
        return np.asarray(np.mean([lane_end for lane_end, _ in self._lane_ends(node)], axis=0))

    def shape_m(self, node: str, attempt: int) -> FloatArray:
        """Return the shape (n, 2) of a node.

        Parameters
        ----------
        node
            The node.
        attempt
            0 for the outline without roads; 1 for the outline that may cover parts of roads; from 2 on the triangle.
        """
        if attempt >= ATTEMPTS - 1:
            return self._triangle_m(node)
        outline_m = self._outline_m(node, STRIPS_M[attempt], without_roads=attempt == 0)
        return self._triangle_m(node) if outline_m is None else outline_m

    def _outline_m(self, node: str, strip_m: float, *, without_roads: bool) -> FloatArray | None:
        """Return the outline (n, 2) of a junction; None where it would be smaller than half a square metre."""
        cross_sections = [section for _, section in self._lane_ends(node)]
        hull = MultiPoint(np.vstack(cross_sections)[:, :2]).convex_hull
        area = shapely.union_all([hull, *(lanelet.area for lanelet in self._inner[node])])
        lines = [
            _extended(lane.center_m[:, :2], before=not is_start, after=is_start)
            for road, is_start in self._roads[node]
            for lane in road.lanes
        ]
        if without_roads:
            area = area.difference(
                shapely.union_all([lane.area for road, _ in self._roads[node] for lane in road.lanes])
            )
        area = area.difference(MultiLineString(lines).buffer(strip_m, quad_segs=2, cap_style="flat"))
        parts = [part for part in shapely.get_parts(area) if isinstance(part, Polygon)]
        largest = max(parts, key=lambda part: part.area, default=None)
        if largest is None or largest.area < _MIN_AREA_M2:
            return None
        outline = Polygon(largest.exterior).simplify(_SIMPLIFY_M)
        return np.asarray(outline.exterior.coords)[:-1]

    def _triangle_m(self, node: str) -> FloatArray:
        """Return a small triangle (3, 2) near a node that no lane, and no extension of a lane, crosses."""
        lanes = (lane for road, _ in self._roads[node] for lane in road.lanes)
        lines = [_extended(lane.center_m[:, :2], before=True, after=True) for lane in lanes]
        obstacles = MultiLineString(lines)
        shapely.prepare(obstacles)
        middle = self.position_m(node)
        best = middle[:2]
        best_m = -1.0
        for radius_m in _RADII_M:
            for step in range(_DIRECTIONS):
                angle = 2 * math.pi * step / _DIRECTIONS
                point = middle[:2] + radius_m * np.array([math.cos(angle), math.sin(angle)])
                free_m = float(obstacles.distance(Point(point)))
                if free_m > best_m:
                    best, best_m = point, free_m
            if best_m >= _FREE_M:
                break
        return best + _TRIANGLE_M / 2 * np.array([[-1.0, -1.0], [1.0, -1.0], [0.0, 1.0]])

    def _lane_ends(self, node: str) -> Iterable[tuple[FloatArray, FloatArray]]:
        """Yield the end (3,) of each lane at a node, and the points (2, 3) where its bounds end."""
        for road, is_start in self._roads[node]:
            index = 0 if is_start else -1
            for lane in road.lanes:
                yield lane.center_m[index], np.array([lane.left_m[index], lane.right_m[index]])


def _extended(line_m: FloatArray, *, before: bool, after: bool) -> LineString:
    """Return a lane's line (n, 2) with its extensions at the start and at the end, as netconvert extends it."""
    parts = [line_m]
    if before:
        parts.insert(0, line_m[:1] + _EXTENSION_M * _unit(line_m[0] - line_m[1]))
    if after:
        parts.append(line_m[-1:] + _EXTENSION_M * _unit(line_m[-1] - line_m[-2]))
    return LineString(np.vstack(parts))


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / max(float(np.hypot(*vector)), 1e-9))


def lane_errors_m(
    wanted_m: Mapping[tuple[str, int], FloatArray], actual_m: Mapping[tuple[str, int], FloatArray]
) -> dict[tuple[str, int], tuple[float, float, float]]:
    """Return how far the lanes of a network are from those of the map.

    Parameters
    ----------
    wanted_m, actual_m
        Lines (n, 3) by road and index of the lane.

    Returns
    -------
    dict
        Distance at the start and at the end, and the largest distance of any point of either line from the other, all
        seen from above, in metres, by road and lane.
    """
    errors = {}
    for key, wanted in wanted_m.items():
        actual = actual_m[key]
        start_m = float(np.hypot(*(wanted[0] - actual[0])[:2]))
        end_m = float(np.hypot(*(wanted[-1] - actual[-1])[:2]))
        distance_m = shapely.hausdorff_distance(LineString(wanted[:, :2]), LineString(actual[:, :2]), densify=0.1)
        errors[key] = start_m, end_m, float(distance_m)
    return errors
