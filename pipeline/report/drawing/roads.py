"""The roads under a map: lanes as wide as they are, junctions, street names, in world-frame metres (x east, y north).

Steps: take the network that vehicles drove on from the run's folder; keep what lies within the map; sort lanes by who
may use them; choose for each street name the longest straight piece, where it is written.

A finished FCD file whose scenario names no ``traffic.roads`` has no network, and maps have no roads then.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from pipeline.report.drawing.map_frame import Box
from pipeline.traffic import network, sumo_folder
from pipeline.traffic.network import Edge, Lane, Network

Line = NDArray[np.float64]
"""Points (n, 2), world frame, metres."""

FOLDER = "sumo"
_LOOKS = (("drive", ("passenger", "truck", "bus")), ("rail", ("tram", "rail")), ("cycle", ("bicycle",)))
_WALKED = "walk"


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
    names = (sumo_folder.NETWORK, f"{sumo_folder.NETWORK}.gz")
    found = (path for name in names for path in sorted((folder / FOLDER).rglob(name)))
    return next(found, None)


def roads_within(path: Path | None, box: Box) -> Roads:
    """The roads within ``box``; none without a network."""
    if path is None:
        return Roads()
    roads = network.read(path)
    frame = shapely.box(*box)
    lanes = sorted(_lanes(roads, frame), key=lambda piece: piece.look != _WALKED)
    outlines = [junction.shape_m[:, :2] for junction in roads.junctions if junction.type != "internal"]
    shown = tuple(outline for outline in outlines if len(outline) > 2 and _touches(outline, box))
    return Roads(tuple(lanes), shown, tuple(_names(roads, frame)))


def _lanes(roads: Network, frame: shapely.Polygon) -> Iterator[LanePiece]:
    for edge in roads.all_edges:
        if edge.function not in ("", "crossing"):
            continue  # a junction's inside, or a walking area, whose lane is an outline
        for lane in edge.lanes:
            look = _WALKED if edge.function else _look(lane)
            width_m = network.LANE_WIDTH_M if lane.width_m is None else lane.width_m
            for line in _pieces(lane.shape_m[:, :2], frame):
                yield LanePiece(look, line, width_m)


def _look(lane: Lane) -> str:
    return next((look for look, classes in _LOOKS if any(map(lane.permission.admits, classes))), _WALKED)


def _pieces(points: Line, frame: shapely.Polygon) -> Iterator[Line]:
    if len(points) < 2:
        return
    for part in shapely.get_parts(shapely.intersection(shapely.LineString(points), frame)):
        if part.geom_type == "LineString" and not part.is_empty:
            yield shapely.get_coordinates(part)


def _touches(points: Line, box: Box) -> bool:
    low, high = points.min(axis=0), points.max(axis=0)
    return bool(low[0] < box[2] and high[0] > box[0] and low[1] < box[3] and high[1] > box[1])


def _names(roads: Network, frame: shapely.Polygon) -> Iterator[StreetName]:
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
