"""Ground triangulated through lane heights.

What lays a ground that goes up and down, as whoever builds the static world asks for it.

Lays a triangulated ground through the lanes of a network, and tells its heights.

Steps: take every lane's middle line, and its sides at the same height, a point every few metres; thin them to one a
cell of half a metre (a mean, so that points of a plane stay on it; where lanes cross at different levels, the lowest
level counts); lay a triangulated surface through them (Delaunay), which goes on level from the nearest lane beyond the
roads. World frame (x east, y north, z up), metres.

Source: linear interpolation over a Delaunay triangulation: Barber, Dobkin, Huhdanpaa 1996, ACM TOMS 22(4), 469-483
(Qhull).

Limits: one surface, so no ground below bridges' ends but a ramp; between roads the ground is interpolated, not
measured.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from egvs.core.limits import GROUND_POINTS
from egvs.traffic.network import LANE_WIDTH_M, Edge, Lane, Network

if TYPE_CHECKING:
    from egvs.scenario.model import Scenario


@runtime_checkable
class GroundSource(Protocol):
    """Something that lays a ground which goes up and down."""

    NAME: ClassVar[str]

    def ground(
        self, scenario: Scenario, low_m: NDArray[np.float64] | None = None, high_m: NDArray[np.float64] | None = None
    ) -> TerrainSurface:
        """The ground over a rectangle; around the network when None."""
        raise NotImplementedError


Floats = NDArray[np.float64]

_STEP_M = 10.0
_CELL_M = 0.5
_LEVEL_M = 1.5
"""Points of a cell that lie so much above its lowest are another level: a bridge."""

_RING_M = 50.0
_MARGIN_M = 100.0
_EPSILON = 1e-12


@dataclass(frozen=True)
class TerrainSurface:
    """Heights of a triangulated ground.

    Attributes
    ----------
    vertices_m
        (n, 3) float64, world frame.
    faces
        (m, 3) int64, counter-clockwise seen from above.
    low_m, high_m
        The rectangle that the faces cover.
    """

    vertices_m: Floats
    faces: NDArray[np.int64]
    low_m: Floats
    high_m: Floats

    @cached_property
    def _triangulation(self) -> Any:
        from scipy.spatial import Delaunay

        return Delaunay(self.vertices_m[:, :2] - self.low_m)

    def height_m(self, x_m: Floats, y_m: Floats) -> Floats:
        """The ground's z below points (n,); beyond the rectangle it goes on level."""
        # a hair inside, since a point on the hull's own edge may count as outside
        hair = 1e-6 * (self.high_m - self.low_m)
        at = np.clip(np.column_stack([x_m, y_m]), self.low_m + hair, self.high_m - hair) - self.low_m
        corners, shares = self._round(at)
        heights: Floats = (self.vertices_m[corners, 2] * shares).sum(axis=1)
        return heights

    def _round(self, at: Floats) -> tuple[NDArray[np.int64], Floats]:
        """The triangle round each point (n, 2): its vertices (n, 3) and their shares in the point (n, 3).

        A walk from the nearest vertex to the neighbour across the side that the point lies beyond; on a Delaunay
        triangulation it ends. (Qhull's own search asks LAPACK for thousands of 2 x 2 matrices, whose threads may take
        seconds on a busy machine.)
        """
        net, points = self._triangulation, self.vertices_m[:, :2] - self.low_m
        face = np.maximum(net.vertex_to_simplex[_nearest(points, at)], 0).astype(np.int64)
        shares, active = _barycentric(points[net.simplices[face]], at), np.arange(len(at))
        for _ in range(len(net.simplices)):
            beyond = shares[active].argmin(axis=1)
            onward = net.neighbors[face[active], beyond]
            goes = (shares[active, beyond] < -_EPSILON) & (onward >= 0)
            if not goes.any():
                break
            active = active[goes]
            face[active] = onward[goes]
            shares[active] = _barycentric(points[net.simplices[face[active]]], at[active])
        return net.simplices[face], shares

    def lowest_m(self, outline_m: Floats) -> float:
        """The lowest ground along an outline (n, 2), a sample every metre."""
        points = [outline_m[:1]]
        for start, end in itertools.pairwise(outline_m):
            steps = int(np.ceil(np.hypot(*(end - start)))) + 1
            points.append(start + (end - start) * (np.arange(1, steps + 1) / steps)[:, None])
        return float(self.height_m(*np.concatenate(points).T).min())


def relief_m(roads: Network) -> tuple[float, float]:
    """How far a network's lanes (all of them) differ in height, and their height furthest off z = 0."""
    heights = np.concatenate([lane.shape_m[:, 2] for edge in roads.all_edges for lane in edge.lanes])
    return float(np.ptp(heights)), float(heights[np.abs(heights).argmax()])


def triangulate_ground(
    roads: Network, low_m: Floats | None = None, high_m: Floats | None = None, where: object = "the network"
) -> TerrainSurface:
    """The surface through a network's lanes, from ``low_m`` to ``high_m``; around the network when None.

    InputError at ``where`` where it would have too many points.
    """
    _check_amount(roads, low_m, high_m, where)
    lanes = [_sample_lane(lane, _width_m(edge, lane)) for edge in roads.all_edges for lane in edge.lanes]
    points = _thin_points(np.concatenate(lanes))
    low = points[:, :2].min(axis=0) - _MARGIN_M if low_m is None else low_m
    high = points[:, :2].max(axis=0) + _MARGIN_M if high_m is None else high_m
    inside = np.all((points[:, :2] > low) & (points[:, :2] < high), axis=1)
    rim = _rim(low, high)
    rim = np.column_stack([rim, points[_nearest(points[:, :2], rim), 2]])
    return _triangulate(np.concatenate([points[inside], rim]), low, high)


def _check_amount(roads: Network, low_m: Floats | None, high_m: Floats | None, where: object) -> None:
    """InputError where lanes are so long, or the rectangle so wide, that there would be too many points."""
    shapes = [lane.shape_m for edge in roads.all_edges for lane in edge.lanes]
    lengths = sum(float(np.hypot(*np.diff(shape[:, :2], axis=0).T).sum()) for shape in shapes)
    every = np.concatenate(shapes)[:, :2]
    low = every.min(axis=0) if low_m is None else low_m
    high = every.max(axis=0) if high_m is None else high_m
    points = 3 * (lengths / _STEP_M + 2 * len(every)) + 2 * float((high - low).sum()) / _RING_M
    GROUND_POINTS.check(where, points, f"reaches so far that its ground takes {points:,.0f} points")


def _width_m(edge: Edge, lane: Lane) -> float:
    """A walking area's shape is its outline, which has no width."""
    if edge.function == "walkingarea":
        return 0.0
    return LANE_WIDTH_M if lane.width_m is None else lane.width_m


def _barycentric(triangles: Floats, at: Floats) -> Floats:
    """Barycentric coordinates (n, 3) of points (n, 2) in triangles (n, 3, 2)."""
    (ax, ay), (bx, by), (cx, cy) = ((triangles[:, i] - at).T for i in range(3))
    parts = np.column_stack([bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx])
    shares: Floats = parts / parts.sum(axis=1)[:, None]
    return shares


def _nearest(points: Floats, at: Floats) -> NDArray[np.int64]:
    from scipy.spatial import KDTree

    index: NDArray[np.int64] = KDTree(points).query(at)[1]
    return index


def _triangulate(vertices: Floats, low: Floats, high: Floats) -> TerrainSurface:
    from scipy.spatial import Delaunay

    faces = np.asarray(Delaunay(vertices[:, :2] - low).simplices, dtype=np.int64)
    (ax, ay), (bx, by), (cx, cy) = (vertices[faces[:, i], :2].T for i in range(3))
    down = (bx - ax) * (cy - ay) < (by - ay) * (cx - ax)
    faces[down] = faces[down][:, [0, 2, 1]]
    # each face from its lowest vertex, faces in order: the bytes do not depend on Qhull's order
    first = np.argmin(faces, axis=1)
    faces = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    return TerrainSurface(vertices, faces[np.lexsort(faces.T[::-1])], low, high)


def _sample_lane(lane: Lane, width_m: float) -> Floats:
    """Points (n, 3) along a lane's middle and both its sides, no further apart than a few metres."""
    shape = lane.shape_m[np.insert(np.any(np.diff(lane.shape_m, axis=0) != 0, axis=1), 0, True)]
    if len(shape) < 2:
        return lane.shape_m[:1]
    way = np.diff(shape, axis=0)
    length = np.hypot(way[:, 0], way[:, 1])
    pieces = [np.empty((0, 3))]
    for start, along, far in zip(shape[:-1], way, length, strict=True):
        if not far:
            continue
        steps = int(np.ceil(far / _STEP_M))
        line = start + along * (np.arange(steps + 1) / steps)[:, None]
        aside = np.array([-along[1], along[0], 0.0]) / far * width_m / 2
        pieces += [line, line + aside, line - aside] if width_m else [line]
    return np.concatenate(pieces)


def _thin_points(points: Floats) -> Floats:
    """One point a cell: the mean of its lowest level; sorted by cell, rounded to 0.1 mm."""
    cell = np.floor(points[:, :2] / _CELL_M).astype(np.int64)
    order = np.lexsort((points[:, 2], cell[:, 1], cell[:, 0]))
    points, cell = points[order], cell[order]
    starts = np.insert(np.any(np.diff(cell, axis=0) != 0, axis=1), 0, True)
    number = np.cumsum(starts) - 1
    low = points[starts, 2][number]  # sorted by height: the first of a cell is its lowest
    kept = points[:, 2] <= low + _LEVEL_M
    count = np.bincount(number[kept])
    means = [np.bincount(number[kept], weights=points[kept, axis]) / count for axis in range(3)]
    thinned: Floats = np.asarray(np.round(np.column_stack(means), 4) + 0.0, dtype=np.float64)
    return thinned


def _rim(low: Floats, high: Floats) -> Floats:
    """Points (n, 2) along the edges of a rectangle."""
    xs, ys = (np.linspace(a, b, int(np.ceil((b - a) / _RING_M)) + 1) for a, b in zip(low, high, strict=True))
    along = [np.column_stack([xs, np.full(xs.size, y)]) for y in (low[1], high[1])]
    across = [np.column_stack([np.full(ys.size - 2, x), ys[1:-1]]) for x in (low[0], high[0])]
    return np.concatenate([*along, *across])
