"""What the page shows of a scene, as arrays for a graphics card: float32 round a zero of its own, so that a scene far
from the world's zero does not tremble.

Lengths in metres. ``zero_m`` of every function is the point of the world frame that becomes (0, 0, 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.readers import Tpog
from pipeline.core.grid import Roi, Vec3
from pipeline.report.drawing import colours
from pipeline.traffic.network import LANE_WIDTH_M
from pipeline.world.carriageway import Carriageway
from pipeline.world.mesh import World

Points = NDArray[np.float32]
"""(n, 3) float32, metres."""

_ABOVE_ROAD_M = 0.03
"""So high above a lane's middle line its surface is drawn, and so high above that the TPOG."""

ABOVE_LANES_M = 2.0 * _ABOVE_ROAD_M
"""So high lies what is laid over the road."""

_SCALE_STEPS, _LEAST = 255, 0.4

MOST_TRIANGLES = 150_000
"""A world of more is drawn coarser, so that a browser without a graphics card can turn it; beams meet all of it."""

_FINEST_M = 0.25


@dataclass(frozen=True)
class Mesh:
    """Triangles: ``points`` (n, 3) float32, ``faces`` (m, 3) int32."""

    points: Points
    faces: NDArray[np.int32]


def zero_of(roi: Roi) -> Vec3:
    """The point that the page is drawn round: the middle of the region's floor, in whole metres."""
    (x, y, z), (width, length, _) = roi.origin_m, roi.size_m
    return float(round(x + width / 2.0)), float(round(y + length / 2.0)), float(round(z))


def solids(world: World, zero_m: Vec3, most: int = MOST_TRIANGLES) -> dict[str, Mesh]:
    """The static world, a mesh for each kind of solid; drawn coarser where it has more than ``most`` triangles."""
    kinds = np.array([kind for _, kind in world.solids])[world.solid_of_face] if len(world.faces) else np.empty(0, str)
    around = (world.vertices_m - zero_m).astype(np.float32)
    found = {}
    for kind in np.unique(kinds).tolist():
        used, faces = np.unique(world.faces[kinds == kind], return_inverse=True)
        found[kind] = Mesh(around[used], faces.reshape(-1, 3).astype(np.int32))
    cell_m = _FINEST_M
    while sum(len(mesh.faces) for mesh in found.values()) > most:
        found = {kind: _coarser(mesh, cell_m) for kind, mesh in found.items()}
        cell_m *= 2.0
    return found


def _coarser(mesh: Mesh, cell_m: float) -> Mesh:
    """Corners in one cell of a grid become one, in their middle; triangles that have no area then are left out, and
    the second of two alike."""
    cells = np.floor(mesh.points / np.float32(cell_m)).astype(np.int64)
    _, of, sizes = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    middle = np.column_stack([np.bincount(of.ravel(), mesh.points[:, axis]) / sizes for axis in range(3)])
    faces = of.ravel()[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return Mesh(middle.astype(np.float32), faces[np.sort(first)].astype(np.int32))


def lanes(carriageway: Carriageway, zero_m: Vec3) -> Mesh:
    """The lanes as strips of their width along their middle lines."""
    points, faces, count = [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int32)], 0
    for lane in carriageway.lanes:
        strip = _strip(lane.shape_m, LANE_WIDTH_M if lane.width_m is None else lane.width_m)
        left = np.arange(len(strip) // 2 - 1) * 2
        quads = np.column_stack([left, left + 1, left + 2, left + 2, left + 1, left + 3]).reshape(-1, 3)
        points.append(strip)
        faces.append((quads + count).astype(np.int32))
        count += len(strip)
    lifted = np.concatenate(points) - zero_m + (0.0, 0.0, _ABOVE_ROAD_M)
    return Mesh(lifted.astype(np.float32), np.concatenate(faces))


def _strip(line: NDArray[np.float64], width_m: float) -> NDArray[np.float64]:
    """Left and right of each point of a line (n, 3) in turn, (2 n, 3)."""
    along = np.gradient(line[:, :2], axis=0)
    along /= np.maximum(np.hypot(*along.T), np.finfo(np.float64).tiny)[:, None]
    aside = np.column_stack([-along[:, 1], along[:, 0], np.zeros(len(line))]) * (width_m / 2.0)
    return np.stack([line + aside, line - aside], axis=1).reshape(-1, 3)


def edges(roi: Roi, zero_m: Vec3) -> NDArray[np.float32]:
    """The 12 edges of the region of interest, (12, 2, 3)."""
    unit = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], dtype=np.float64)
    corners = np.asarray(roi.origin_m) + unit * roi.size_m - zero_m
    pairs = [(a, b) for a in range(8) for b in range(a + 1, 8) if int(np.abs(unit[a] - unit[b]).sum()) == 1]
    return corners[pairs].astype(np.float32)


def columns(
    tpog: Tpog, values: NDArray[np.float64], zero_m: Vec3, peak: float | None = None
) -> tuple[Points, NDArray[np.uint8]]:
    """Values of voxels (nx, ny, nz) added up along z, as points over the middle of each column that has some, and
    their colours (n, 3) on a scale up to ``peak``, or to the largest."""
    grid, total = tpog.grid, values.sum(axis=2)
    ix, iy = np.nonzero(total > 0.0)
    middle = np.column_stack([ix + 0.5, iy + 0.5, np.zeros(len(ix))]) * grid.voxel_m
    points = middle + grid.origin_m - zero_m + (0.0, 0.0, ABOVE_LANES_M)
    return points.astype(np.float32), scale(total[ix, iy], 0.0, peak)


def differences(
    tpog: Tpog,
    this: NDArray[np.float64],
    other: NDArray[np.float64],
    zero_m: Vec3,
    colours: tuple[Sequence[int], Sequence[int], Sequence[int]],
) -> tuple[Points, NDArray[np.uint8]]:
    """Two fields of voxels (nx, ny, nz) added up along z, where one of them is more: points as of :func:`columns`, and
    colours from the third of ``colours``, where both are alike, to the first or second, where one is most more; the
    least difference has a good part of its colour, else few large ones would hide all others."""
    grid, more = tpog.grid, this.sum(axis=2) - other.sum(axis=2)
    ix, iy = np.nonzero((this.sum(axis=2) > 0.0) | (other.sum(axis=2) > 0.0))
    middle = np.column_stack([ix + 0.5, iy + 0.5, np.zeros(len(ix))]) * grid.voxel_m
    points = middle + grid.origin_m - zero_m + (0.0, 0.0, ABOVE_LANES_M)
    share = np.abs(more[ix, iy]) / max(float(np.abs(more).max(initial=0.0)), np.finfo(np.float64).tiny)
    share[share > 0.0] = _LEAST + (1.0 - _LEAST) * share[share > 0.0]
    ends = np.where((more[ix, iy] >= 0.0)[:, None], colours[0], colours[1])
    mixed = np.asarray(colours[2]) + share[:, None] * (ends - np.asarray(colours[2]))
    return points.astype(np.float32), np.rint(mixed).astype(np.uint8)


def scale(
    values: NDArray[np.float64] | Sequence[float], low: float | None = None, high: float | None = None
) -> NDArray[np.uint8]:
    """Colours (n, 3) of values, from the lowest (or ``low``) to the highest of them (or ``high``); as in the report, on
    light."""
    known = np.asarray(values, dtype=np.float64)
    low = float(np.min(known, initial=np.inf)) if low is None else low
    span = (float(np.max(known, initial=-np.inf)) if high is None else high) - low
    share = (known - low) / span if span > 0.0 else np.ones(len(known))
    at = np.rint(np.nan_to_num(share) * _SCALE_STEPS).astype(np.int64)
    table = [tuple(colours.mixed(step, _SCALE_STEPS, colours.ON_LIGHT)) for step in range(_SCALE_STEPS + 1)]
    return np.array(table, dtype=np.uint8)[at]
