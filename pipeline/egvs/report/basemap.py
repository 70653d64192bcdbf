"""Footprints and roads under a map.

The outlines of the static world seen from above, in world-frame metres (x east, y north).

Steps: project each solid's triangles, leave out the ground and what lies outside; unite the triangles of a kind; sort
the kinds by what they look like on a map; cut at the map's edge.

The roads under a map: lanes as wide as they are, junctions, street names, in world-frame metres (x east, y north).

Steps: take the network that vehicles drove on from the run's folder; keep what lies within the map; sort lanes by who
may use them; choose for each street name the longest straight piece, where it is written.

A finished FCD file whose scenario names no ``traffic.roads`` has no network, and maps have no roads then.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from egvs.report.svg_figures import Box
from egvs.traffic import network, sumo_folder
from egvs.traffic.network import Edge, Lane, Network
from egvs.world.mesh import World

_SMALL_M2 = 4.0
"""A solid with less footprint is street furniture."""
_MAX_SMALL_TRIANGLES = 100_000
"""More small triangles of a kind than this are drawn as squares."""
_SMALL_M, _SQUARE_M = 0.5, 0.25
_GREEN = ("tree", "crown", "canopy", "hedge", "bush", "vegetation", "forest", "wood")


@dataclass(frozen=True)
class Outlines:
    """All outlines of one look (``large``, ``green`` or ``small``: the class of the style sheet): kinds in words, and
    closed rings (n, 2), world frame, metres, holes among them (even-odd).
    """

    look: str
    kinds: tuple[str, ...]
    rings: tuple[NDArray[np.float64], ...]


def outlines_of(world: World, box: Box) -> tuple[Outlines, ...]:
    """The outlines of the static world within ``box``, buildings first, trees last; without the ground."""
    import shapely

    corners = world.triangles_m[:, :, :2]
    low, high = world.bounds_xy_m
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area_m2 = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    shown = (area_m2 > 1e-6) & (high > box[:2]).all(axis=1) & (low < box[2:]).all(axis=1)
    kinds = (
        np.array([kind for _, kind in world.solids])[world.solid_of_face]
        if len(world.faces)
        else np.empty(0, dtype=str)
    )
    by_look: dict[str, tuple[list[str], list[Any]]] = {look: ([], []) for look in ("large", "small", "green")}
    for kind in sorted(set(kinds[shown].tolist()) - {"ground"}):
        of_kind = shown & (kinds == kind)
        shape = union_of_triangles(corners[of_kind], box)
        names, shapes = by_look[_solid_style(kind, shape.area / len(np.unique(world.solid_of_face[of_kind])))]
        names.append(kind.replace("_", " "))
        shapes.append(shape)
    frame = shapely.box(box[0] - 1.0, box[1] - 1.0, box[2] + 1.0, box[3] + 1.0)
    return tuple(
        Outlines(look, tuple(names), tuple(_shape_rings(shapely.intersection(shapely.union_all(shapes), frame))))
        for look, (names, shapes) in by_look.items()
        if names
    )


def union_of_triangles(triangles: NDArray[np.float64], box: Box) -> Any:
    """The area of triangles (n, 3, 2), a shapely geometry. Of very many, those that are small are drawn as squares: to
    unite hundreds of thousands that lie over one another takes minutes."""
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


def _solid_style(kind: str, area_m2: float) -> str:
    if area_m2 < _SMALL_M2 and "crown" not in kind:
        return "small"
    return "green" if any(word in kind.lower() for word in _GREEN) else "large"


def _shape_rings(shape: Any) -> Iterable[NDArray[np.float64]]:
    import shapely

    for part in shapely.get_parts(shape):
        if part.geom_type == "Polygon":
            yield from (shapely.get_coordinates(ring) for ring in (part.exterior, *part.interiors))


Line = NDArray[np.float64]
"""Points (n, 2), world frame, metres."""

SUMO_FOLDER = "sumo"
_LANE_STYLES = (("drive", ("passenger", "truck", "bus")), ("rail", ("tram", "rail")), ("cycle", ("bicycle",)))
_WALKWAY_STYLE = "walk"


@dataclass(frozen=True)
class LanePiece:
    """A piece of a lane's middle line within the map; ``look`` says who moves there: the class of the style sheet."""

    look: str
    line: Line
    width_m: float


@dataclass(frozen=True)
class StreetName:
    """A street's name, and the straight piece along which it is written, from west to east."""

    text: str
    start_m: tuple[float, float]
    end_m: tuple[float, float]

    @property
    def length_m(self) -> float:
        """Of the piece."""
        return float(np.hypot(self.end_m[0] - self.start_m[0], self.end_m[1] - self.start_m[1]))


@dataclass(frozen=True)
class Roads:
    """What a map shows of a network: lanes (those that people walk on first), outlines of junctions, street names."""

    lanes: tuple[LanePiece, ...] = ()
    junctions: tuple[Line, ...] = ()
    names: tuple[StreetName, ...] = ()


def network_file(folder: Path) -> Path | None:
    """The network in a run's folder; None where there is none."""
    names = (sumo_folder.NETWORK_FILE, f"{sumo_folder.NETWORK_FILE}.gz")
    found = (path for name in names for path in sorted((folder / SUMO_FOLDER).rglob(name)))
    return next(found, None)


def roads_within(path: Path | None, box: Box) -> Roads:
    """The roads within ``box``; none without a network."""
    if path is None:
        return Roads()
    roads = network.read_net_xml(path)
    frame = shapely.box(*box)
    lanes = sorted(_lane_pieces(roads, frame), key=lambda piece: piece.look != _WALKWAY_STYLE)
    outlines = [junction.shape_m[:, :2] for junction in roads.junctions if junction.type != "internal"]
    shown = tuple(outline for outline in outlines if len(outline) > 2 and _touches(outline, box))
    return Roads(tuple(lanes), shown, tuple(_street_names(roads, frame)))


def _lane_pieces(roads: Network, frame: shapely.Polygon) -> Iterator[LanePiece]:
    for edge in roads.all_edges:
        if edge.function not in ("", "crossing"):
            continue  # a junction's inside, or a walking area, whose lane is an outline
        for lane in edge.lanes:
            look = _WALKWAY_STYLE if edge.function else _lane_style(lane)
            width_m = network.LANE_WIDTH_M if lane.width_m is None else lane.width_m
            for line in _pieces(lane.shape_m[:, :2], frame):
                yield LanePiece(look, line, width_m)


def _lane_style(lane: Lane) -> str:
    return next((look for look, classes in _LANE_STYLES if any(map(lane.permission.admits, classes))), _WALKWAY_STYLE)


def _pieces(points: Line, frame: shapely.Polygon) -> Iterator[Line]:
    if len(points) < 2:
        return
    for part in shapely.get_parts(shapely.intersection(shapely.LineString(points), frame)):
        if part.geom_type == "LineString" and not part.is_empty:
            yield shapely.get_coordinates(part)


def _touches(points: Line, box: Box) -> bool:
    low, high = points.min(axis=0), points.max(axis=0)
    return bool(low[0] < box[2] and high[0] > box[0] and low[1] < box[3] and high[1] > box[1])


def _street_names(roads: Network, frame: shapely.Polygon) -> Iterator[StreetName]:
    """Each name once, on the longest straight piece of any of its edges."""
    streets: dict[str, list[Edge]] = {}
    for edge in roads.edges:
        if edge.name:
            streets.setdefault(edge.name, []).append(edge)
    for name, edges in sorted(streets.items()):
        # the lane beside the other direction: written there, a name stands in the middle of the street
        lines = [line for edge in edges for line in _pieces(edge.lanes[-1].shape_m[:, :2], frame)]
        straight = [StreetName(name, *sorted(map(tuple, pair))) for line in lines for pair in pairwise(line)]
        if straight:
            yield max(straight, key=lambda piece: piece.length_m)
