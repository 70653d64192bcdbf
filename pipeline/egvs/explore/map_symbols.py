"""Map symbols of the explorer's scene: an arrow to the north, a scale bar, and the names of poles.

Arrow and scale bar lie on the ground beside the region of interest, where no solid covers them. Metres; the y axis of
the world frame points north.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Literal, NamedTuple

import numpy as np
import viser

from egvs.core.grid import Roi, Vec3
from egvs.explore.road_meshes import LANE_HEIGHT_M, Mesh
from egvs.sensors.sites import Site
from egvs.world.mesh import World

MAX_POLE_NAMES = 40
"""Most poles with a name; those of the best candidates have one."""

_COLOUR = (232, 89, 12)
_HEIGHT_M = 4.0 * LANE_HEIGHT_M
_BAR_SHARE, _MARGIN_M, _CLEARANCE_M = 0.15, 1.5, 2.0
_LABEL_SCALE = 0.7
ABOVE_BALL_M = 1.2


def scale_length_m(longest_m: float) -> float:
    """Return the longest round length (1, 2 or 5 times a power of ten) that is at most ``longest_m``."""
    power = 10.0 ** math.floor(math.log10(longest_m))
    return max(factor * power for factor in (1.0, 2.0, 5.0) if factor * power <= longest_m)


def scale_mesh(length_m: float, width_m: float) -> Mesh:
    """Return a bar from (0, 0) to (``length_m``, 0), with a tick at each end."""
    half, tick = width_m / 2.0, 2.0 * width_m
    boxes = [(0.0, length_m, -half, half), (0.0, width_m, -tick, tick), (length_m - width_m, length_m, -tick, tick)]
    corners = []
    for x0, x1, y0, y1 in boxes:
        corners += [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    return _flat_mesh(corners, [(i, i + 1, i + 2, i + 3) for i in (0, 4, 8)])


def arrow_mesh(length_m: float) -> Mesh:
    """Return an arrow from (0, 0) to (0, ``length_m``), two fifths as wide as long."""
    half, notch = length_m / 5.0, length_m / 4.0
    corners = [(0.0, length_m), (-half, 0.0), (0.0, notch), (half, 0.0)]
    return _flat_mesh(corners, [(0, 1, 2, 3)])


def _flat_mesh(corners: Sequence[Sequence[float]], quads: Sequence[tuple[int, int, int, int]]) -> Mesh:
    points = np.column_stack([np.asarray(corners), np.zeros(len(corners))])
    faces = [triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))]
    return Mesh(points.astype(np.float32), np.array(faces, dtype=np.int32))


class _Symbol(NamedTuple):
    """A mesh, where it lies in the world frame, and its text at a position relative to it."""

    name: str
    mesh: Mesh
    at_m: Vec3
    text: str
    label_m: Vec3
    anchor: Literal["center-left", "bottom-center"]


def clear_place_m(roi: Roi, world: World, width_m: float, length_m: float) -> tuple[float, float]:
    """Return the low corner of a rectangle beside the region of interest that solids cover least.

    Tried are places south of it, from the middle of its edge outwards. A margin around the rectangle counts as well,
    because solids hide what is behind them.

    Parameters
    ----------
    roi
        The region of interest.
    world
        The static world.
    width_m, length_m
        Size of the rectangle along x and y.
    """
    (x, y, _), (roi_width, _, _) = roi.origin_m, roi.size_m
    middle_m = x + (roi_width - width_m) / 2.0
    steps = range(1 + max(0, math.floor((roi_width - width_m) / width_m)))
    offsets_m = [sign * step * width_m / 2.0 for step in steps for sign in (1.0, -1.0)]
    rows_m = [y - _MARGIN_M - rows * length_m for rows in (1.0, 1.5, 2.0)]
    places = [(middle_m + offset_m, row_m) for row_m in rows_m for offset_m in offsets_m]
    low_m, high_m = world.bounds_xy_m

    def covered_m2(place: tuple[float, float]) -> float:
        start_m = np.subtract(place, _CLEARANCE_M)
        end_m = np.add(place, (width_m, length_m)) + _CLEARANCE_M
        overlap_m = np.minimum(high_m, end_m) - np.maximum(low_m, start_m)
        return float(np.maximum(overlap_m, 0.0).prod(axis=1).sum())

    return min(places, key=covered_m2)


def draw_north_and_scale(scene: viser.SceneApi, roi: Roi, world: World, zero_m: Vec3) -> None:
    """Draw the arrow and the scale bar.

    Parameters
    ----------
    scene
        The page's scene.
    roi
        The region of interest.
    world
        The static world, which must not hide them.
    zero_m
        Origin of the drawing.
    """
    bar_m = scale_length_m(_BAR_SHARE * max(roi.size_m))
    arrow_m = 0.8 * bar_m
    z_m = roi.origin_m[2] + _HEIGHT_M
    low_x_m, low_y_m = clear_place_m(roi, world, bar_m, bar_m)
    bar_at_m = (low_x_m, low_y_m + 0.1 * bar_m, z_m)
    arrow_at_m = (low_x_m + bar_m / 2.0, low_y_m + 0.2 * bar_m, z_m)
    symbols = (
        _Symbol("scale", scale_mesh(bar_m, 0.04 * bar_m), bar_at_m, f"{bar_m:g} m", (bar_m, 0.0, 0.0), "center-left"),
        _Symbol("north", arrow_mesh(arrow_m), arrow_at_m, "N", (0.0, arrow_m, 0.0), "bottom-center"),
    )
    for symbol in symbols:
        scene.add_mesh_simple(
            f"/map/{symbol.name}", symbol.mesh.points, symbol.mesh.faces, color=_COLOUR, flat_shading=True,
            side="double", cast_shadow=False, position=np.subtract(symbol.at_m, zero_m),
        )  # fmt: skip
        scene.add_label(
            f"/map/{symbol.name}/label", symbol.text, position=symbol.label_m, anchor=symbol.anchor,
            font_screen_scale=_LABEL_SCALE,
        )  # fmt: skip


def draw_pole_names(scene: viser.SceneApi, sites: Sequence[Site], without: Collection[str], zero_m: Vec3) -> None:
    """Write the name of each pole above its highest candidate.

    Parameters
    ----------
    scene
        The page's scene.
    sites
        The candidates, best first; poles of the first :data:`MAX_POLE_NAMES` get a name.
    without
        Poles that have another label.
    zero_m
        Origin of the drawing.
    """
    scene.remove_by_name("/poles")
    scene.add_frame("/poles", show_axes=False)
    tops: dict[str, Site] = {}
    for site in sites:
        name = site.pole or site.name
        if name not in tops or site.pose.z_m > tops[name].pose.z_m:
            tops[name] = site
    for number, (name, site) in enumerate(list(tops.items())[:MAX_POLE_NAMES]):
        if name in without:
            continue
        position_m = np.subtract(site.pose.position_m, zero_m)
        position_m[2] += ABOVE_BALL_M
        scene.add_label(
            f"/poles/{number}", name, position=position_m, anchor="bottom-center", font_screen_scale=_LABEL_SCALE
        )
