"""Heights of roads from the tag ``ele`` of an OpenStreetMap extract, if most of its road nodes have one.

Few extracts have heights on their roads. netconvert takes a node without ``ele`` as lying at sea level, so a road with
heights on some nodes only would have pits. Steps of :func:`read_elevations`: parse ``ele`` of all nodes of roads for
vehicles; ignore them unless :data:`MIN_SHARE` of the nodes have one; interpolate the others along their roads, from
both sides where possible; where a road has none at all, take those of the roads that it meets, in rounds.

Heights are metres as in the map (above sea level). Source: https://wiki.openstreetmap.org/wiki/Key:ele.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from egvs.core.wording import by_number, number_of
from egvs.creation.openstreetmap import distance_m
from egvs.creation.openstreetmap.street_network import is_road
from egvs.formats.osm import OsmExtract, parse_number

ELEVATION_FLAGS = ("--osm.elevation", "--geometry.max-grade.fix", "false")
"""Flags of netconvert for an extract from :func:`add_elevations`; by default, netconvert levels steep roads."""

MIN_SHARE = 0.8
"""Share of road nodes that need a height."""

NOTED_SHARE = 0.01
"""Fewer heights than this share of the road nodes are ignored without a note."""

_KEY = "ele"
_MAX_M = 9000.0


@dataclass(frozen=True)
class RoadElevations:
    """Heights of the nodes of roads.

    Attributes
    ----------
    heights_m
        By node; of all road nodes, or none where they are ignored.
    known, total
        Number of road nodes with a height in the map, and of all.
    note
        A sentence for the user; empty where the map has no height.
    """

    heights_m: Mapping[int, float]
    known: int
    total: int
    note: str


def read_elevations(extract: OsmExtract) -> RoadElevations:
    """Return the heights of the road nodes of an extract."""
    roads = [
        tuple(node for node in way.nodes if node in extract.nodes) for way in extract.ways.values() if is_road(way)
    ]
    nodes = {node for road in roads for node in road}
    known = {node: height for node in nodes if (height := _parse_height(extract, node)) is not None}
    count, total = len(known), len(nodes)
    if not known:
        return RoadElevations({}, 0, total, "")
    if count < MIN_SHARE * total:
        note = (
            f"The heights (ele) of {count:,} of {number_of(total, 'road node')} are ignored, since too many have none."
            if count >= NOTED_SHARE * total
            else ""
        )
        return RoadElevations({}, count, total, note)

    heights = dict(known)
    while len(heights) < total:
        found = _interpolate(extract, roads, heights)
        if not found:
            break
        heights |= found
    lowest = min(known.values())
    isolated = nodes - heights.keys()
    heights |= dict.fromkeys(isolated, lowest)
    note = (
        f"Roads have the heights of the map (ele); {total - count:,} of {number_of(total, 'node')} without"
        f" {by_number(total - count, 'was', 'were')} interpolated."
    )
    if isolated:
        note += f" {number_of(len(isolated), 'node')} of roads that meet no other got the lowest height, {lowest:g} m."
    return RoadElevations(dict(sorted(heights.items())), count, total, note)


def add_elevations(extract: OsmExtract, heights_m: Mapping[int, float]) -> OsmExtract:
    """Return the extract with these heights as ``ele`` of nodes, and no others."""
    tags = {}
    for node, old in extract.node_tags.items():
        rest = {key: value for key, value in old.items() if key != _KEY}
        if rest:
            tags[node] = rest
    for node, height_m in heights_m.items():
        tags[node] = {**tags.get(node, {}), _KEY: f"{round(height_m, 3) + 0.0:.3f}"}
    return replace(extract, node_tags=dict(sorted(tags.items())))


def _parse_height(extract: OsmExtract, node: int) -> float | None:
    text = extract.node_tags.get(node, {}).get(_KEY, "").strip()
    height_m = parse_number(text.removesuffix("m"))
    return height_m if height_m is not None and abs(height_m) <= _MAX_M else None


def _interpolate(extract: OsmExtract, roads: list[tuple[int, ...]], heights: Mapping[int, float]) -> dict[int, float]:
    """Return the heights of nodes on roads with a known node; a node of several roads gets the mean."""
    estimates: dict[int, list[float]] = {}
    for road in roads:
        for node, height_m in _along(extract, road, heights):
            estimates.setdefault(node, []).append(height_m)
    return {node: math.fsum(values) / len(values) for node, values in estimates.items()}


def _along(extract: OsmExtract, road: tuple[int, ...], heights: Mapping[int, float]) -> Iterator[tuple[int, float]]:
    """Yield the unknown nodes of a road, with a height between the nearest known ones before and after."""
    known = [index for index, node in enumerate(road) if node in heights]
    if not known or len(known) == len(road):
        return
    along_m = [0.0]
    for start, end in pairwise(road):
        along_m.append(along_m[-1] + distance_m(extract.nodes[start], extract.nodes[end]))
    known_m = [along_m[index] for index in known]
    known_heights = [heights[road[index]] for index in known]
    for index, node in enumerate(road):
        if node not in heights:
            yield node, float(np.interp(along_m[index], known_m, known_heights))
