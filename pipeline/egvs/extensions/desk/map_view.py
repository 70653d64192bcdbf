"""What the page draws: streets, junctions and solids seen from above, as JSON in world-frame metres."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from egvs.creation import junctions
from egvs.creation.junctions import StreetJunction, Streets
from egvs.results.map_credits import read_map_credits
from egvs.scoring import zones
from egvs.stages.inputs import Inputs
from egvs.traffic.network import LANE_WIDTH_M, Network, is_carriageway
from egvs.world.mesh import World

MARGIN_M = 150.0
"""What is farther from the region of interest is not drawn."""

_ROUND = ("tree", "pole")
"""Beginnings of kinds of solids that are convex."""

MOST_SOLIDS = 4000
"""The nearest solids are drawn."""


def describe_streets(streets: Streets, attribution: str) -> dict[str, Any]:
    """Return the streets of a map and the junctions of which a scenario can be made, the largest first.

    ``attribution`` says who made the map. Junctions of the same streets are numbered.
    """
    lanes = list(_lanes(streets.network))
    crossings = junctions.distinct_crossings(streets)
    titles = _numbered([junction.title for junction in crossings])
    points_m = [point for lane in lanes for point in lane["points_m"]]
    low, high = np.min(points_m, axis=0), np.max(points_m, axis=0)
    return {
        "bounds_m": [*low.tolist(), *high.tolist()],
        "frame": None if streets.frame is None else [streets.frame.projection, streets.frame.offset_m],
        "lanes": lanes,
        "junctions": [_describe_junction(streets, *each) for each in zip(crossings, titles, strict=True)],
        "attribution": attribution,
    }


def _numbered(titles: Sequence[str]) -> Iterator[str]:
    """Yield titles; those that several junctions share have a number, such as "Mill Lane (2 of 3)"."""
    totals, numbers = Counter(titles), Counter[str]()
    for title in titles:
        numbers[title] += 1
        yield title if totals[title] == 1 else f"{title} ({numbers[title]} of {totals[title]})"


def _describe_junction(streets: Streets, junction: StreetJunction, title: str) -> dict[str, Any]:
    x_m, y_m = junction.at_m
    at = [round(x_m, 1), round(y_m, 1)]
    if streets.frame is not None:
        at = [round(degrees, 5) for degrees in streets.to_degrees([junction.at_m])[0][::-1]]
    return {
        "id": junction.id, "title": title, "at": at, "x_m": round(x_m, 2), "y_m": round(y_m, 2),
        "arms": junction.arms, "signalised": junction.signalised,
        "outline_m": _rings(junction.area)[:1] and _rings(junction.area)[0][0],
    }  # fmt: skip


def _lanes(network: Network, window: BaseGeometry | None = None) -> Iterator[dict[str, Any]]:
    for edge in network.edges:
        for lane in edge.lanes:
            if len(lane.shape_m) < 2:
                continue
            if window is not None and not window.intersects(shapely.LineString(lane.shape_m[:, :2])):
                continue
            yield {
                "points_m": np.round(lane.shape_m[:, :2], 2).tolist(),
                "width_m": LANE_WIDTH_M if lane.width_m is None else lane.width_m,
                "road": is_carriageway(lane.permission),
            }


def describe_scene(inputs: Inputs) -> dict[str, Any]:
    """Return the map of a scenario around its region of interest."""
    scenario, network = inputs.scenario, inputs.network
    (x0, y0), (x1, y1) = zones.region_bounds_m(scenario)
    window = shapely.box(x0 - MARGIN_M, y0 - MARGIN_M, x1 + MARGIN_M, y1 + MARGIN_M)
    lanes, areas = [], []
    if network is not None:
        lanes = list(_lanes(network, window))
        nodes = (shapely.Polygon(node.shape_m[:, :2]) for node in network.junctions if len(node.shape_m) > 2)
        areas = [ring for node in nodes if window.intersects(node) for ring in _rings(node)]
    return {
        "bounds_m": list(window.bounds),
        "lanes": lanes,
        "junctions": [area[0] for area in areas],
        "solids": list(_solids(inputs.built_world[0], window)),
        "attribution": "; ".join(read_map_credits(scenario)),
    }


def _solids(world: World, window: BaseGeometry) -> Iterator[dict[str, Any]]:
    """Yield the outlines of the solids in a window, the nearest to its middle first."""
    triangles_m = world.triangles_m
    edges_m = triangles_m[:, 1:, :2] - triangles_m[:, :1, :2]
    is_drawn = np.abs(edges_m[:, 0, 0] * edges_m[:, 1, 1] - edges_m[:, 0, 1] * edges_m[:, 1, 0]) > 1e-6
    order = np.argsort(world.solid_of_face, kind="stable")
    starts = np.searchsorted(world.solid_of_face[order], np.arange(len(world.solids) + 1))
    outlines: list[tuple[float, dict[str, Any]]] = []
    for number, (_, kind) in enumerate(world.solids):
        faces = order[starts[number] : starts[number + 1]]
        if kind == "ground" or not len(faces):
            continue
        outline = _outline(triangles_m[faces], triangles_m[faces[is_drawn[faces]]], kind)
        if not window.intersects(outline):
            continue
        for ring in _rings(outline):
            outlines.append((outline.distance(window.centroid), {"kind": kind, "outline_m": ring}))
    outlines.sort(key=lambda each: each[0])
    yield from (solid for _, solid in outlines[:MOST_SOLIDS])


def _outline(triangles_m: NDArray[np.float64], drawn_m: NDArray[np.float64], kind: str) -> BaseGeometry:
    """Return the outline of a solid, of whose triangles some are drawn: of an extruded one that of its roof."""
    if kind.startswith(_ROUND) or not len(drawn_m):
        return shapely.MultiPoint(triangles_m[:, :, :2].reshape(-1, 2)).convex_hull
    top_m = triangles_m[:, :, 2].max()
    roof_m = drawn_m[(drawn_m[:, :, 2] == top_m).all(axis=1)]
    if 2 * len(roof_m) == len(drawn_m):  # the other half is its floor
        return shapely.coverage_union_all(shapely.polygons(roof_m[:, :, :2]))
    return shapely.union_all(shapely.polygons(drawn_m[:, :, :2]))


def _rings(area: BaseGeometry) -> list[list[Any]]:
    """Return the rings of each polygon: the outline, then its holes."""
    polygons = (part for part in shapely.get_parts(area) if isinstance(part, shapely.Polygon) and not part.is_empty)
    return [[_points(ring.coords) for ring in (polygon.exterior, *polygon.interiors)] for polygon in polygons]


def _points(coordinates: Iterable[Any]) -> list[list[float]]:
    return [[round(point[0], 2), round(point[1], 2)] for point in coordinates]
