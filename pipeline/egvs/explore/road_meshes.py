"""Meshes of the road for the explorer: lanes, junctions, lane markings and crossings.

Markings follow from the lanes of the network, which knows no paint: a line along the outer side of the first and the
last lane of each road, dashes between lanes, and zebra stripes on crossings for pedestrians. Points are float32
relative to ``zero_m``; each layer is a few centimetres above the one below, so that browsers draw it on top. Metres.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray

from egvs.core import polylines
from egvs.core.grid import FloatArray, Vec3
from egvs.traffic.network import LANE_WIDTH_M, Edge, Lane, Network, is_carriageway
from egvs.world.carriageway import Carriageway

LANE_HEIGHT_M = 0.03
"""Height of a drawn lane above its middle line; junctions are below, markings above."""

_JUNCTION_HEIGHT_M, _MARKING_HEIGHT_M = 0.01, 0.05
_LINE_WIDTH_M, _DASH_M, _GAP_M = 0.15, 3.0, 3.0
_STRIPE_M = 0.5
"""Width of a stripe of a crossing, and of the gap to the next."""


@dataclass(frozen=True)
class Mesh:
    """Triangles: ``points`` (n, 3) float32, ``faces`` (m, 3) int32."""

    points: NDArray[np.float32]
    faces: NDArray[np.int32]


def lane_mesh(carriageway: Carriageway, zero_m: Vec3) -> Mesh:
    """Return the lanes as strips along their middle lines.

    Parameters
    ----------
    carriageway
        The lanes.
    zero_m
        Origin of the drawing.
    """
    strips = [_strip(lane.shape_m, _width_m(lane)) for lane in carriageway.lanes]
    return _join_strips(strips, zero_m, LANE_HEIGHT_M)


def junction_mesh(carriageway: Carriageway, zero_m: Vec3) -> Mesh:
    """Return the areas of junctions, which fill the gaps between their lanes; parameters as in :func:`lane_mesh`."""
    points, faces, count = [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int32)], 0
    for junction in carriageway.junctions:
        outline = shapely.make_valid(shapely.Polygon(junction.shape_m[:, :2]))
        for area in shapely.get_parts(outline):
            if area.geom_type != "Polygon":
                continue
            corners, triangles = trimesh.creation.triangulate_polygon(area, engine="earcut")
            points.append(np.column_stack([corners, np.full(len(corners), junction.shape_m[:, 2].mean())]))
            faces.append(triangles.astype(np.int32) + count)
            count += len(corners)
    lifted = np.concatenate(points) - zero_m + (0.0, 0.0, _JUNCTION_HEIGHT_M)
    return Mesh(lifted.astype(np.float32), np.concatenate(faces).astype(np.int32))


def marking_mesh(network: Network, zero_m: Vec3) -> Mesh:
    """Return lane markings and the stripes of crossings.

    Parameters
    ----------
    network
        The street network.
    zero_m
        Origin of the drawing.
    """
    strips: list[FloatArray] = []
    for edge in network.all_edges:
        if edge.function == "crossing":
            strips += [stripe for lane in edge.lanes for stripe in _crossing_stripes(lane)]
        elif edge.function == "":
            strips += _lane_markings(edge)
    return _join_strips(strips, zero_m, _MARKING_HEIGHT_M)


def _width_m(lane: Lane) -> float:
    return LANE_WIDTH_M if lane.width_m is None else lane.width_m


def _lane_markings(edge: Edge) -> list[FloatArray]:
    """Return solid lines along both sides of a road, and dashes between its lanes."""
    lanes = [lane for lane in edge.lanes if is_carriageway(lane.permission) and len(lane.shape_m) > 1]
    if not lanes:
        return []
    strips = []
    for lane, following in pairwise(lanes):
        between = _nearer_side(lane, following)
        strips += [_strip(dash, _LINE_WIDTH_M) for dash in _dashes(between)]
    if len(lanes) == 1:
        outer = list(_sides(lanes[0]))
    else:
        outer = [_farther_side(lanes[0], lanes[1]), _farther_side(lanes[-1], lanes[-2])]
    return strips + [_strip(line, _LINE_WIDTH_M) for line in outer]


def _sides(lane: Lane) -> tuple[FloatArray, FloatArray]:
    """Return the left and the right side of a lane, (n, 3) each."""
    corners = _strip(lane.shape_m, _width_m(lane))
    return corners[::2], corners[1::2]


def _nearer_side(lane: Lane, other: Lane) -> FloatArray:
    return min(_sides(lane), key=lambda side: _distance_m(side, other))


def _farther_side(lane: Lane, other: Lane) -> FloatArray:
    return max(_sides(lane), key=lambda side: _distance_m(side, other))


def _distance_m(side: FloatArray, other: Lane) -> float:
    return float(np.hypot(*(side[0, :2] - other.shape_m[0, :2])))


def _dashes(line: FloatArray) -> Iterator[FloatArray]:
    """Yield the dashes of a broken line (n, 3); corners between their ends are cut."""
    for start_m in np.arange(0.0, polylines.stations_m(line)[-1] - _DASH_M, _DASH_M + _GAP_M):
        yield polylines.points_at(line, (start_m, start_m + _DASH_M))


def _crossing_stripes(lane: Lane) -> Iterator[FloatArray]:
    """Yield the stripes of a crossing, as strips across its middle line."""
    line = lane.shape_m
    for start_m in np.arange(_STRIPE_M / 2.0, polylines.stations_m(line)[-1] - _STRIPE_M, 2.0 * _STRIPE_M):
        yield _strip(polylines.points_at(line, (start_m, start_m + _STRIPE_M)), _width_m(lane))


def _strip(line: FloatArray, width_m: float) -> FloatArray:
    """Return points left and right of each point of a line (n, 3) in turn, (2 n, 3)."""
    along = np.gradient(line[:, :2], axis=0)
    along /= np.maximum(np.hypot(*along.T), np.finfo(np.float64).tiny)[:, None]
    across = np.column_stack([-along[:, 1], along[:, 0], np.zeros(len(line))]) * (width_m / 2.0)
    return np.stack([line + across, line - across], axis=1).reshape(-1, 3)


def _join_strips(strips: Iterable[FloatArray], zero_m: Vec3, height_m: float) -> Mesh:
    """Return strips as one mesh, lifted by ``height_m``."""
    points, faces, count = [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int32)], 0
    for strip in strips:
        left = np.arange(len(strip) // 2 - 1) * 2
        quads = np.column_stack([left, left + 1, left + 2, left + 2, left + 1, left + 3]).reshape(-1, 3)
        points.append(strip)
        faces.append((quads + count).astype(np.int32))
        count += len(strip)
    lifted = np.concatenate(points) - zero_m + (0.0, 0.0, height_m)
    return Mesh(lifted.astype(np.float32), np.concatenate(faces))
