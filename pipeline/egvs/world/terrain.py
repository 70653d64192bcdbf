"""A triangulated ground through the lanes of a network.

Steps: sample the centre line and both sides of each lane every few metres; leave out lanes that cross above others, on
the crossing and 5 m around it; thin the points to one per cell of half a metre (the mean of its lowest level, so that
points of a plane stay on it); triangulate the points (Delaunay). Beyond the roads, the ground continues at the height
of the nearest lane. World frame (x east, y north, z up), metres.

Where points of a terrain are given, the ground beyond the roads goes through them. Then lanes more than 1.5 m above or
below the terrain are bridges and tunnels, and no part of the ground; near the other lanes, the ground is that of the
lanes.

Source: linear interpolation over a Delaunay triangulation: Barber, Dobkin, Huhdanpaa 1996, ACM TOMS 22(4), 469-483
(Qhull).

Limits: the ground is one surface; without a terrain, it has ramps instead of bridges, and between roads it is
interpolated, not measured.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from egvs.core import polylines
from egvs.core.grid import FloatArray, IntArray
from egvs.core.limits import GROUND_POINTS
from egvs.traffic.network import LANE_WIDTH_M, Edge, Lane, Network
from egvs.traffic.road_lanes import RoadLanes

if TYPE_CHECKING:
    from egvs.scenario.model import Scenario


@runtime_checkable
class GroundSource(Protocol):
    """An effect that provides a ground with relief."""

    NAME: ClassVar[str]

    def ground(
        self, scenario: Scenario, low_m: FloatArray | None = None, high_m: FloatArray | None = None
    ) -> TerrainSurface:
        """Return the ground over a rectangle with the corners ``low_m`` and ``high_m``; by default, of the network."""


MIN_RELIEF_M = 0.1
"""A network whose heights differ by no more than this is flat."""

_STEP_M = 10.0
_CELL_M = 0.5
_LEVEL_M = 1.5
"""Points of a cell that are higher above its lowest point than this belong to another level, e.g. a bridge."""

_BESIDE_M = 5.0
"""Within this distance of points of lanes, points of the terrain do not count, nor do those of a lane above."""

_CROSSING_STEP_M = 1.0

_RIM_STEP_M = 50.0
_MAX_RIM_STEPS = 2000
"""On each side, which is 100 km then. The time grows with the square, and one point of a terrain may be far away."""

_MARGIN_M = 100.0
_EPSILON = 1e-12


@dataclass(frozen=True)
class TerrainSurface:
    """A triangulated ground.

    Attributes
    ----------
    vertices_m
        (n, 3) float64, world frame.
    faces
        (m, 3) int64, counter-clockwise from above.
    low_m, high_m
        Corners of the rectangle that the faces cover, (2,) each.
    """

    vertices_m: FloatArray
    faces: IntArray
    low_m: FloatArray
    high_m: FloatArray

    @cached_property
    def _triangulation(self) -> Any:
        from scipy.spatial import Delaunay

        return Delaunay(self.vertices_m[:, :2] - self.low_m)

    def height_m(self, x_m: FloatArray, y_m: FloatArray) -> FloatArray:
        """Return z of the ground at points (n,).

        Outside of the rectangle, it is that of the nearest point on its border.
        """
        # slightly inside, since points on the border of the hull may count as outside
        margin = 1e-6 * (self.high_m - self.low_m)
        at = np.clip(np.column_stack([x_m, y_m]), self.low_m + margin, self.high_m - margin) - self.low_m
        corners, shares = self._locate(at)
        heights: FloatArray = (self.vertices_m[corners, 2] * shares).sum(axis=1)
        return heights

    def _locate(self, at: FloatArray) -> tuple[IntArray, FloatArray]:
        """Return the vertices (n, 3) of the triangle around each point (n, 2), and barycentric coordinates (n, 3).

        Walks from a triangle at the nearest vertex to the neighbour across the side that the point is beyond; on a
        Delaunay triangulation this ends. (Qhull's own search solves thousands of 2 x 2 systems with LAPACK, whose
        threads may take seconds on a busy machine.)
        """
        mesh = self._triangulation
        points = self.vertices_m[:, :2] - self.low_m
        first = mesh.vertex_to_simplex.copy()
        first[mesh.coplanar[:, 0]] = mesh.coplanar[:, 1]  # of repeated points, SciPy has the number of a vertex there
        face = np.maximum(first[_nearest(points, at)], 0).astype(np.int64)
        shares = _barycentric(points[mesh.simplices[face]], at)
        active = np.arange(len(at))
        for _ in range(len(mesh.simplices)):
            side = shares[active].argmin(axis=1)
            neighbour = mesh.neighbors[face[active], side]
            is_beyond = (shares[active, side] < -_EPSILON) & (neighbour >= 0)
            if not is_beyond.any():
                break
            active = active[is_beyond]
            face[active] = neighbour[is_beyond]
            shares[active] = _barycentric(points[mesh.simplices[face[active]]], at[active])
        return mesh.simplices[face], shares

    def lowest_m(self, outline_m: FloatArray) -> float:
        """Return the lowest z of the ground along an outline (n, 2), sampled every metre."""
        points = [outline_m[:1]]
        for start, end in itertools.pairwise(outline_m):
            steps = int(np.ceil(np.hypot(*(end - start)))) + 1
            points.append(start + (end - start) * (np.arange(1, steps + 1) / steps)[:, None])
        return float(self.height_m(*np.concatenate(points).T).min())


def relief_m(roads: Network) -> tuple[float, float]:
    """Return the range of the heights of all lanes, and the height that is farthest from z = 0."""
    heights = np.concatenate([lane.shape_m[:, 2] for edge in roads.all_edges for lane in edge.lanes])
    return float(np.ptp(heights)), float(heights[np.abs(heights).argmax()])


def triangulate_ground(
    roads: Network,
    low_m: FloatArray | None = None,
    high_m: FloatArray | None = None,
    where: object = "the network",
    *,
    beyond_m: FloatArray | None = None,
) -> TerrainSurface:
    """Triangulate the ground through the lanes of a network.

    Parameters
    ----------
    roads
        The network.
    low_m, high_m
        Corners of the rectangle to cover, (2,) each. By default, the network with a margin.
    where
        The network, for messages.
    beyond_m
        Points (n, 3) of the terrain, world frame.

    Raises
    ------
    InputError
        When the ground would have too many points.
    """
    _check_point_count(roads, low_m, high_m, where)
    lanes = [lane for edge in roads.all_edges for lane in edge.lanes]
    samples = [_sample_lane(lane, _width_m(edge, lane)) for edge in roads.all_edges for lane in edge.lanes]
    if beyond_m is None:
        points = _thin_points(np.concatenate(_without_bridges(roads, lanes, samples)))
    else:
        points = _join_terrain(np.concatenate(samples), beyond_m, low_m, high_m, where)
    low = points[:, :2].min(axis=0) - _MARGIN_M if low_m is None else low_m
    high = points[:, :2].max(axis=0) + _MARGIN_M if high_m is None else high_m
    is_inside = np.all((points[:, :2] > low) & (points[:, :2] < high), axis=1)
    rim = _rim(low, high)
    rim = np.column_stack([rim, points[_nearest(points[:, :2], rim), 2]])
    vertices = np.concatenate([points[is_inside], rim])
    return TerrainSurface(vertices, triangulate(vertices, low), low, high)


def _without_bridges(roads: Network, lanes: Sequence[Lane], samples: Sequence[FloatArray]) -> list[FloatArray]:
    """Leave out the points (n, 3) of lanes that cross above others, within :data:`_BESIDE_M` of these."""
    heights = np.concatenate([lane.shape_m[:, 2] for lane in lanes])
    if np.ptp(heights) <= _LEVEL_M:
        return list(samples)
    road_lanes = RoadLanes(roads)
    kept = []
    for lane, points in zip(lanes, samples, strict=True):
        middle = polylines.points_at(lane.shape_m, np.arange(0.0, polylines.length_m(lane.shape_m), _CROSSING_STEP_M))
        at = road_lanes.near(middle[:, :2], 0.0)
        crossed = at.lane[at.height_m < middle[at.row, 2] - _LEVEL_M]
        beside = road_lanes.near(points[:, :2], _BESIDE_M)
        is_above = np.isin(beside.lane, crossed) & (beside.height_m < points[beside.row, 2] - _LEVEL_M)
        kept.append(np.delete(points, np.unique(beside.row[is_above]), axis=0))
    return kept


def _join_terrain(
    lanes: FloatArray, terrain: FloatArray, low_m: FloatArray | None, high_m: FloatArray | None, where: object
) -> FloatArray:
    """Return the points (n, 3) of the ground: of lanes on the terrain, and of the terrain away from them."""
    if low_m is not None and high_m is not None:
        is_near = np.all((terrain[:, :2] > low_m - _MARGIN_M) & (terrain[:, :2] < high_m + _MARGIN_M), axis=1)
        terrain = terrain[is_near]
    GROUND_POINTS.check(where, len(terrain), f"needs {len(terrain):,} points of the terrain")
    height = _interpolate(terrain, lanes[:, :2])
    is_ground = ~(np.abs(lanes[:, 2] - height) > _LEVEL_M)  # also where the terrain is unknown
    if not is_ground.any():
        return _thin_points(terrain)
    points = _thin_points(lanes[is_ground])
    if not len(terrain):
        return points

    from scipy.spatial import KDTree

    is_beyond = KDTree(points[:, :2]).query(terrain[:, :2])[0] > _BESIDE_M
    return np.concatenate([points, _thin_points(terrain[is_beyond])]) if is_beyond.any() else points


def _interpolate(points: FloatArray, at: FloatArray) -> FloatArray:
    """Return heights (n,) at locations (n, 2) on triangles through points; NaN outside their hull."""
    from scipy.spatial import QhullError

    heights = np.full(len(at), np.nan)
    if len(points) < 3:
        return heights
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    try:
        corners, shares = TerrainSurface(points, np.empty((0, 3), dtype=np.int64), low, high)._locate(at - low)
    except QhullError:  # all points on one line
        return heights
    is_inside = shares.min(axis=1) >= -_EPSILON
    heights[is_inside] = (points[corners, 2] * shares).sum(axis=1)[is_inside]
    return heights


def _check_point_count(roads: Network, low_m: FloatArray | None, high_m: FloatArray | None, where: object) -> None:
    """Raise an InputError when lanes are so long, or the rectangle so wide, that there are too many points."""
    shapes = [lane.shape_m for edge in roads.all_edges for lane in edge.lanes]
    length = sum(polylines.length_m(shape) for shape in shapes)
    vertices = np.concatenate(shapes)[:, :2]
    low = vertices.min(axis=0) if low_m is None else low_m
    high = vertices.max(axis=0) if high_m is None else high_m
    points = 3 * (length / _STEP_M + 2 * len(vertices)) + 2 * float((high - low).sum()) / _RIM_STEP_M
    GROUND_POINTS.check(where, points, f"is so large that its ground needs {points:,.0f} points")


def _width_m(edge: Edge, lane: Lane) -> float:
    """Return the width of a lane; 0 for a walking area, whose shape is its outline."""
    if edge.function == "walkingarea":
        return 0.0
    return LANE_WIDTH_M if lane.width_m is None else lane.width_m


def _barycentric(triangles: FloatArray, at: FloatArray) -> FloatArray:
    """Return barycentric coordinates (n, 3) of points (n, 2) in triangles (n, 3, 2)."""
    ax, ay = (triangles[:, 0] - at).T
    bx, by = (triangles[:, 1] - at).T
    cx, cy = (triangles[:, 2] - at).T
    areas = np.column_stack([bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx])
    shares: FloatArray = areas / areas.sum(axis=1)[:, None]
    return shares


def _nearest(points: FloatArray, at: FloatArray) -> IntArray:
    """Return the index of the nearest point for each location."""
    from scipy.spatial import KDTree

    index: IntArray = KDTree(points).query(at)[1]
    return index


def triangulate(vertices: FloatArray, origin: FloatArray) -> IntArray:
    """Return the Delaunay triangles of points (n, 3) from above, (m, 3) int64, facing up, sorted.

    Parameters
    ----------
    vertices
        The points, metres.
    origin
        x and y of a point near them, from which they are triangulated, (2,).
    """
    from scipy.spatial import Delaunay

    faces = np.asarray(Delaunay(vertices[:, :2] - origin).simplices, dtype=np.int64)
    # SciPy's triangles are counter-clockwise. Each from its lowest vertex, and sorted: Qhull's order does not matter.
    first = np.argmin(faces, axis=1)
    faces = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    return faces[np.lexsort(faces.T[::-1])]


def _sample_lane(lane: Lane, width_m: float) -> FloatArray:
    """Return points (n, 3) along the middle and both sides of a lane."""
    shape = lane.shape_m[np.insert(np.any(np.diff(lane.shape_m, axis=0) != 0, axis=1), 0, True)]
    if len(shape) < 2:
        return lane.shape_m[:1]
    segments = np.diff(shape, axis=0)
    lengths = np.hypot(segments[:, 0], segments[:, 1])
    points = [np.empty((0, 3))]
    for start, segment, length in zip(shape[:-1], segments, lengths, strict=True):
        if not length:
            continue
        steps = int(np.ceil(length / _STEP_M))
        middle = start + segment * (np.arange(steps + 1) / steps)[:, None]
        points.append(middle)
        if width_m:
            side = np.array([-segment[1], segment[0], 0.0]) / length * width_m / 2
            points += [middle + side, middle - side]
    return np.concatenate(points)


def _thin_points(points: FloatArray) -> FloatArray:
    """Return the mean of the lowest level of each cell, sorted by cell, rounded to 0.1 mm."""
    cell = np.floor(points[:, :2] / _CELL_M).astype(np.int64)
    order = np.lexsort((points[:, 2], cell[:, 1], cell[:, 0]))
    points = points[order]
    starts = np.insert(np.any(np.diff(cell[order], axis=0) != 0, axis=1), 0, True)
    number = np.cumsum(starts) - 1
    lowest = points[starts, 2][number]  # the first of each cell, since points are sorted by height
    is_lowest_level = points[:, 2] <= lowest + _LEVEL_M
    number = number[is_lowest_level]
    count = np.bincount(number)
    means = [np.bincount(number, weights=points[is_lowest_level, axis]) / count for axis in range(3)]
    return np.asarray(np.round(np.column_stack(means), 4) + 0.0, dtype=np.float64)


def _rim(low: FloatArray, high: FloatArray) -> FloatArray:
    """Return points (n, 2) along the sides of a rectangle."""
    steps = np.minimum(np.ceil((high - low) / _RIM_STEP_M), _MAX_RIM_STEPS).astype(int) + 1
    xs = np.linspace(low[0], high[0], steps[0])
    ys = np.linspace(low[1], high[1], steps[1])
    horizontal = [np.column_stack([xs, np.full(xs.size, y)]) for y in (low[1], high[1])]
    vertical = [np.column_stack([np.full(ys.size - 2, x), ys[1:-1]]) for x in (low[0], high[0])]
    return np.concatenate([*horizontal, *vertical])
