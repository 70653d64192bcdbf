"""Make the decks of bridges from a network with heights and a terrain.

A terrain is the ground without bridges, and the ground of the static world leaves out lanes that lie more than 1.5 m
above it (:mod:`egvs.world.terrain`). Steps of :func:`bridge_decks`: sample the lanes, also those inside junctions; find
the stretches that are that high above the terrain; extend each by one sample, into the ground at its ends; make a slab
below it, as wide as the lane with an edge on each side. Slabs of neighbouring lanes overlap.

World frame, metres.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.creation.map_parts import MappedMesh, Terrain
from egvs.creation.terrain.network_heights import attribute, sample_line
from egvs.traffic.network import LANE_WIDTH_M, Shape

CLEARANCE_M = 1.5
"""A lane that is higher above the terrain is on a bridge."""

THICKNESS_M, EDGE_M = 1.0, 0.5
"""Assumed thickness of a deck, and how far it reaches beyond a lane on each side."""

STEP_M = 5.0

_LANE = re.compile(r"<lane\s[^>]*>")
_WALKING_AREA = re.compile(r"^:.*_w\d+_\d+$")


def bridge_decks(text: str, terrain: Terrain, zero_height_m: float) -> tuple[MappedMesh, ...]:
    """Return a slab for each stretch of a lane that is high above the terrain.

    Parameters
    ----------
    text
        A network with heights, that netconvert wrote.
    terrain
        The ground.
    zero_height_m
        Height in the terrain of z = 0 of the network.

    Returns
    -------
    tuple of MappedMesh
        Closed, of the kind ``bridge``, with z in the world frame. None where the terrain is unknown.
    """
    lanes = list(_lanes(text))
    if not lanes:
        return ()
    points_m = np.concatenate([lane_m for _, lane_m, _ in lanes])
    above_m = points_m[:, 2] - (terrain.height_m(points_m[:, :2]) - zero_height_m)
    above_by_lane_m = np.split(above_m, np.cumsum([len(lane_m) for _, lane_m, _ in lanes])[:-1])
    decks = []
    for (name, lane_m, width_m), heights_m in zip(lanes, above_by_lane_m, strict=True):
        with np.errstate(invalid="ignore"):
            is_high = heights_m > CLEARANCE_M
        for number, (first, last) in enumerate(_stretches(is_high)):
            vertices_m, faces = _slab(lane_m[first : last + 1], width_m / 2 + EDGE_M)
            decks.append(MappedMesh(f"deck_{name}_{number}", "bridge", vertices_m, faces, is_closed=True))
    return tuple(decks)


def _lanes(text: str) -> Iterator[tuple[str, FloatArray, float]]:
    """Yield the id of each lane, points (n, 3) along it, and its width, metres."""
    for element in _LANE.findall(text):
        name = attribute(element, "id")
        shape_m = Shape(attribute(element, "shape"), f"lane {name}").shape_m
        is_line = len(shape_m) > 1 and np.hypot(*np.ptp(shape_m[:, :2], axis=0)) > 0
        if is_line and not _WALKING_AREA.match(name):
            width_m = float(attribute(element, "width") or LANE_WIDTH_M)
            yield name, sample_line(_distinct(shape_m), STEP_M)[0], width_m


def _distinct(points_m: FloatArray) -> FloatArray:
    """Return points without those at the place of the point before."""
    is_new = np.hypot(*np.diff(points_m[:, :2], axis=0).T) > 0
    distinct: FloatArray = points_m[np.concatenate([[True], is_new])]
    return distinct


def _stretches(is_high: BoolArray) -> Iterator[tuple[int, int]]:
    """Yield the first and the last point of each stretch, with one point more at each end if there is one."""
    wide = is_high.copy()
    wide[:-1] |= is_high[1:]
    wide[1:] |= is_high[:-1]
    borders = np.flatnonzero(np.diff(np.concatenate([[False], wide, [False]]).astype(np.int8)))
    for first, after in borders.reshape(-1, 2).tolist():
        if after - first > 1:
            yield first, after - 1


def _slab(points_m: FloatArray, half_width_m: float) -> tuple[FloatArray, IntArray]:
    """Return vertices (4n, 3) and faces (m, 3) of a closed slab below a line (n, 3), counter-clockwise from outside."""
    tangents = np.gradient(points_m[:, :2], axis=0)
    tangents /= np.hypot(*tangents.T)[:, None]
    left = np.column_stack([-tangents[:, 1], tangents[:, 0], np.zeros(len(points_m))]) * half_width_m
    down = np.array([0.0, 0.0, THICKNESS_M])
    sides = [points_m + left, points_m - left, points_m - left - down, points_m + left - down]
    vertices_m = np.stack(sides, axis=1).reshape(-1, 3)

    # vertex 4 i + k: corner k of section i, in the order top left, top right, bottom right, bottom left
    start = 4 * np.arange(len(points_m) - 1)
    faces = []
    for corner in range(4):
        following = (corner + 1) % 4
        here, beside = start + corner, start + following
        faces.append(np.column_stack([here, beside, beside + 4]))
        faces.append(np.column_stack([here, beside + 4, here + 4]))
    end = 4 * (len(points_m) - 1)
    caps = np.array([[0, 2, 1], [0, 3, 2], [end, end + 1, end + 2], [end, end + 2, end + 3]])
    return vertices_m, np.concatenate([*faces, caps]).astype(np.int64)
