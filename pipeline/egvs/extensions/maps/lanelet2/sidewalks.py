"""Sidewalks and crossings as plain XML.

SUMO makes a crossing only between sidewalks, so the roads at a crosswalk get some, beside the kerb. The line of a
crossing must run in the direction in which netconvert goes round the junction; it is read from a network that was built
without the line.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from xml.etree.ElementTree import Element

import numpy as np

from egvs.core import files
from egvs.core.grid import FloatArray
from egvs.creation.plain_network import NETWORK_FILE
from egvs.extensions.maps.lanelet2.crosswalks import Crosswalk
from egvs.extensions.maps.lanelet2.plain_network import PlainElement, format_number, format_shape
from egvs.extensions.maps.lanelet2.road_layout import Road
from egvs.extensions.maps.lanelet2.signals import SignalPlan
from egvs.formats import xml

SIDEWALK_M = 2.0
"""Width of a sidewalk. Assumed."""

_SPEED_M_S = 2.78


def sidewalk_element(road: Road, *, lefthand: bool) -> PlainElement:
    """Return the sidewalk of a road, beside its lane 0."""
    lane = road.lanes[0]
    kerb_m = lane.left_m if lefthand else lane.right_m
    along = np.gradient(kerb_m[:, :2], axis=0)
    along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    outward = np.column_stack([-along[:, 1], along[:, 0]]) * (1.0 if lefthand else -1.0)
    line_m = np.column_stack([kerb_m[:, :2] + SIDEWALK_M / 2 * outward, kerb_m[:, 2]])
    attributes = {"index": "0", "allow": "pedestrian", "width": format_number(SIDEWALK_M), "speed": f"{_SPEED_M_S}"}
    return PlainElement("lane", attributes | {"shape": format_shape(line_m)})


def crossing_elements(
    crosswalks: Sequence[Crosswalk], signals: SignalPlan, network: str | None
) -> Iterator[PlainElement]:
    """Yield the crossings.

    Parameters
    ----------
    crosswalks
        The crosswalks.
    signals
        The traffic lights, which govern the crossings at their nodes.
    network
        A network built with these crossings without their lines; None for the first build.
    """
    built_m = {} if network is None else crossing_lines_m(network)
    numbers = dict(signals.crosswalk_index)
    for crosswalk in crosswalks:
        attributes = {
            "node": crosswalk.node,
            "edges": " ".join(crosswalk.roads),
            "width": format_number(crosswalk.width_m),
            "priority": "true",
        }
        if crosswalk.node in numbers:
            attributes["linkIndex"] = str(numbers[crosswalk.node])
            numbers[crosswalk.node] += 1
        line_m = crosswalk.shape_m
        guess_m = built_m.get(frozenset(crosswalk.roads))
        if guess_m is not None:
            if float((line_m[1] - line_m[0])[:2] @ (guess_m[-1] - guess_m[0])[:2]) < 0:
                line_m = line_m[::-1]
            attributes["shape"] = format_shape(line_m)
        yield PlainElement("crossing", attributes)


def crossing_lines_m(network: str) -> dict[frozenset[str], FloatArray]:
    """Return the lines of the crossings of a network, by the roads that they cross."""
    with files.temporary_folder() as folder:
        files.write_text(folder / NETWORK_FILE, network)
        elements = (e for e in xml.iter_elements(folder / NETWORK_FILE, "net") if e.get("function") == "crossing")
        return {frozenset(element.get("crossingEdges", "").split()): _line_m(element) for element in elements}


def _line_m(edge: Element) -> FloatArray:
    """Return the line (n, 2) of the only lane of an edge."""
    (lane,) = edge.iter("lane")
    return np.array([[float(value) for value in point.split(",")[:2]] for point in lane.attrib["shape"].split()])
