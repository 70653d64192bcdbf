"""Background of the maps: outlines of the static world, and roads, in world-frame metres (x east, y north).

Outlines: the triangles of each kind of solid, without the ground, are projected and united; kinds that look alike on a
map form a group.

Roads: lanes with their widths, junctions and street names of the network that vehicles drove on, from the run folder.
A run whose traffic is a finished FCD file without ``traffic.roads`` has no network, and its maps have no roads.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egvs.core.grid import FloatArray
from egvs.drawing.svg_figures import Box
from egvs.traffic import network, sumo_folder
from egvs.traffic.network import Edge, Lane, Network
from egvs.world.mesh import World

if TYPE_CHECKING:
    import shapely

_SMALL_M2 = 4.0
"""Solids with a smaller footprint are street furniture."""
_MAX_SMALL_TRIANGLES = 100_000
"""If there are more small triangles of a kind than this, they are drawn as squares."""
_SMALL_M, _SQUARE_M = 0.5, 0.25
_GREEN = re.compile(r"(?<![a-z])(tree|crown|canopy|hedge|bush|vegetation|forest|wood(?!en))")
"""Words that begin with one of these: "trees" and "tree_crown", but not "street_lamp"."""


@dataclass(frozen=True)
class Outlines:
    """Outlines of the solids that look alike.

    Attributes
    ----------
    css_class
        Class of the style sheet: ``large``, ``green`` or ``small``.
    kinds
        Kinds of solids, for the legend.
    rings
        Closed rings, shape (n, 2), world frame, metres; holes follow the even-odd rule.
    """

    css_class: str
    kinds: tuple[str, ...]
    rings: tuple[FloatArray, ...]


def world_outlines(world: World, box: Box) -> tuple[Outlines, ...]:
    """Return the outlines of the static world within a box, buildings first, trees last; without the ground."""
    import shapely

    corners = world.triangles_m[:, :, :2]
    low, high = world.bounds_xy_m
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area_m2 = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    is_visible = (area_m2 > 1e-6) & (high > box[:2]).all(axis=1) & (low < box[2:]).all(axis=1)
    kinds = np.empty(0, dtype=str)
    if len(world.faces):
        kinds = np.array([kind for _, kind in world.solids])[world.solid_of_face]
    by_class: dict[str, tuple[list[str], list[Any]]] = {"large": ([], []), "small": ([], []), "green": ([], [])}
    for kind in sorted(set(kinds[is_visible].tolist()) - {"ground"}):
        of_kind = is_visible & (kinds == kind)
        shape = union_of_triangles(corners[of_kind], box)
        names, shapes = by_class[solid_group(kind, shape.area / len(np.unique(world.solid_of_face[of_kind])))]
        names.append(kind.replace("_", " "))
        shapes.append(shape)
    frame = shapely.box(box[0] - 1.0, box[1] - 1.0, box[2] + 1.0, box[3] + 1.0)
    outlines = []
    for css_class, (names, shapes) in by_class.items():
        if names:
            shape = shapely.intersection(shapely.union_all(shapes), frame)
            outlines.append(Outlines(css_class, tuple(names), tuple(_shape_rings(shape))))
    return tuple(outlines)


def union_of_triangles(triangles: FloatArray, box: Box) -> Any:
    """Return the union of triangles as a shapely geometry.

    Very many small triangles are replaced by squares of 0.25 m, because uniting hundreds of thousands of overlapping
    triangles takes minutes.

    Parameters
    ----------
    triangles
        Corners, shape (n, 3, 2).
    box
        Triangles that reach out of this box are never replaced.
    """
    import shapely

    low, high = triangles.min(axis=1), triangles.max(axis=1)
    small = ((high - low) <= _SMALL_M).all(axis=1) & (low > box[:2]).all(axis=1) & (high < box[2:]).all(axis=1)
    if np.count_nonzero(small) <= _MAX_SMALL_TRIANGLES:
        return shapely.union_all(shapely.polygons(triangles))
    first, last = (np.floor((at[small] - box[:2]) / _SQUARE_M).astype(np.int64) for at in (low, high))
    covered = np.zeros(last.max(axis=0) + 2, dtype=bool)
    for dx, dy in np.ndindex(*(last - first).max(axis=0) + 1):
        x, y = np.minimum(first + np.array([dx, dy]), last).T
        covered[x, y] = True
    edges = np.diff(covered.astype(np.int8), axis=1, prepend=0, append=0)
    (row, start), (_, end) = np.nonzero(edges == 1), np.nonzero(edges == -1)
    x0, y0 = box[:2]
    runs = shapely.box(x0 + row * _SQUARE_M, y0 + start * _SQUARE_M, x0 + (row + 1) * _SQUARE_M, y0 + end * _SQUARE_M)
    return shapely.union_all([*runs, shapely.union_all(shapely.polygons(triangles[~small]))])


def solid_group(kind: str, area_m2: float) -> str:
    """Return the group of a solid that looks alike on a map: ``large``, ``green`` or ``small``."""
    if area_m2 < _SMALL_M2 and "crown" not in kind:
        return "small"
    return "green" if is_vegetation(kind) else "large"


def is_vegetation(kind: str) -> bool:
    """Whether a word of a kind of solid is a tree, a hedge or the like.

    >>> is_vegetation("tree_crown") and is_vegetation("Hedges")
    True
    >>> is_vegetation("street_lamp") or is_vegetation("wooden_fence")
    False
    """
    return _GREEN.search(kind.lower()) is not None


def _shape_rings(shape: Any) -> Iterable[FloatArray]:
    import shapely

    for part in shapely.get_parts(shape):
        if part.geom_type == "Polygon":
            for ring in (part.exterior, *part.interiors):
                yield shapely.get_coordinates(ring)


Line = FloatArray
"""Points, shape (n, 2), world frame, metres."""

SUMO_FOLDER = "sumo"
_LANE_STYLES = (("drive", ("passenger", "truck", "bus")), ("rail", ("tram", "rail")), ("cycle", ("bicycle",)))
_WALKWAY_STYLE = "walk"


@dataclass(frozen=True)
class LanePiece:
    """A piece of a lane's centre line on the map; ``css_class`` depends on who uses the lane."""

    css_class: str
    line: Line
    width_m: float


@dataclass(frozen=True)
class StreetName:
    """A street name, and the straight line along which it is written, from west to east."""

    text: str
    start_m: tuple[float, float]
    end_m: tuple[float, float]

    @property
    def length_m(self) -> float:
        """Length of the line."""
        return float(np.hypot(self.end_m[0] - self.start_m[0], self.end_m[1] - self.start_m[1]))


@dataclass(frozen=True)
class Roads:
    """Parts of a network on a map: lanes (footways first), outlines of junctions, street names."""

    lanes: tuple[LanePiece, ...] = ()
    junctions: tuple[Line, ...] = ()
    names: tuple[StreetName, ...] = ()


def network_file(folder: Path) -> Path | None:
    """Return the network in a run folder, if it has one."""
    for name in (sumo_folder.NETWORK_FILE, f"{sumo_folder.NETWORK_FILE}.gz"):
        for path in sorted((folder / SUMO_FOLDER).rglob(name)):
            return path
    return None


def roads_within(path: Path | None, box: Box) -> Roads:
    """Return the roads of a network within a box; empty without a network."""
    import shapely

    if path is None:
        return Roads()
    roads = network.read_net_xml(path)
    frame = shapely.box(*box)
    lanes = sorted(_lane_pieces(roads, frame), key=lambda piece: piece.css_class != _WALKWAY_STYLE)
    junctions = []
    for junction in roads.junctions:
        outline = junction.shape_m[:, :2]
        if junction.type != "internal" and len(outline) > 2 and _touches(outline, box):
            junctions.append(outline)
    return Roads(tuple(lanes), tuple(junctions), tuple(_street_names(roads, frame)))


def _lane_pieces(roads: Network, frame: shapely.Polygon) -> Iterator[LanePiece]:
    for edge in roads.all_edges:
        if edge.function not in ("", "crossing"):
            continue  # the inside of a junction, or a walking area, whose shape is an outline
        for lane in edge.lanes:
            css_class = _WALKWAY_STYLE if edge.function else _lane_style(lane)
            width_m = network.LANE_WIDTH_M if lane.width_m is None else lane.width_m
            for line in _pieces(lane.shape_m[:, :2], frame):
                yield LanePiece(css_class, line, width_m)


def _lane_style(lane: Lane) -> str:
    for css_class, vehicle_classes in _LANE_STYLES:
        if any(lane.permission.admits(vehicle_class) for vehicle_class in vehicle_classes):
            return css_class
    return _WALKWAY_STYLE


def _pieces(points: Line, frame: shapely.Polygon) -> Iterator[Line]:
    import shapely

    if len(points) < 2:
        return
    for part in shapely.get_parts(shapely.intersection(shapely.LineString(points), frame)):
        if part.geom_type == "LineString" and not part.is_empty:
            yield shapely.get_coordinates(part)


def _touches(points: Line, box: Box) -> bool:
    low, high = points.min(axis=0), points.max(axis=0)
    return bool(low[0] < box[2] and high[0] > box[0] and low[1] < box[3] and high[1] > box[1])


def _street_names(roads: Network, frame: shapely.Polygon) -> Iterator[StreetName]:
    """Each name once, on the longest straight line of its edges."""
    streets: dict[str, list[Edge]] = {}
    for edge in roads.edges:
        if edge.name:
            streets.setdefault(edge.name, []).append(edge)
    for name, edges in sorted(streets.items()):
        candidates = []
        for edge in edges:
            # the lane next to the opposite direction, so that the name is in the middle of the street
            for line in _pieces(edge.lanes[-1].shape_m[:, :2], frame):
                for start_m, end_m in pairwise(line.tolist()):
                    candidates.append(StreetName(name, *sorted([tuple(start_m), tuple(end_m)])))
        if candidates:
            yield max(candidates, key=lambda street_name: street_name.length_m)
