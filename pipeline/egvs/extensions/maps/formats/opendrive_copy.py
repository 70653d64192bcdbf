"""Write a copy of an OpenDRIVE map with only what SUMO's netconvert reads, and as netconvert expects it.

netconvert (1.28) knows a projection only as a PROJ string with ``+proj=``; ignores the heading of the header's offset;
imports parking and other lanes that no traffic uses; takes lanes in their order, whatever their ids; and, for left-hand
traffic, expects the ids of lanes of right-hand traffic, which it draws on the other side of the reference line. It
divides by the curvature of an arc, and by the change of curvature along a spiral: where these are so small that the
shape differs from a line or an arc by less than :data:`_SAME_SHAPE_M`, the simpler shape is written. It reads no direct
junctions (:mod:`egvs.extensions.maps.formats.direct_junctions`), no borders of lanes, which become widths, and no speed
limits of roads, which become those of their lanes. It moves the ends of roads to virtual junctions, which are left out. What it
need not know is left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO
from xml.etree.ElementTree import Element, tostring

from egvs.extensions.maps.formats import opendrive
from egvs.extensions.maps.formats.direct_junctions import replace_direct_connections
from egvs.extensions.maps.formats.opendrive import OpenDriveMap, Road, widths_from_borders
from egvs.formats import xml

_ROAD_PARTS = frozenset({"link", "type", "planView", "elevationProfile", "lanes", "signals"})
_PARTS = frozenset({"header", "road", "junction", "controller"})
_IGNORED_TYPE = "none"
_SAME_SHAPE_M = 1e-3
_SHORTEST_SPEED_M = 1.0
"""A shorter piece of road with a speed limit of its own would be an edge of this length."""
_SWAPPED_CHANGES = {"increase": "decrease", "decrease": "increase"}


@dataclass(frozen=True)
class CopyOptions:
    """What a copy changes.

    Attributes
    ----------
    reference
        The text of ``<geoReference>``. If it is empty, the header's offset is left out.
    rotation_rad
        Angle by which the plan is turned about the origin, counter-clockwise.
    swap_lanes
        Whether the ids of lanes change their sign.
    keeps_type
        Whether a lane of this type is imported.
    keeps_all_lights
        Whether traffic lights that are at no junction, such as those of pedestrian crossings, are kept.
    """

    reference: str
    rotation_rad: float
    swap_lanes: bool
    keeps_type: Callable[[str], bool]
    keeps_all_lights: bool


def write_copy(path: Path, road_map: OpenDriveMap, to: Path, options: CopyOptions) -> None:
    """Write a copy of a map that :func:`egvs.extensions.maps.formats.opendrive.read_opendrive` has read."""
    with to.open("wb") as file:
        file.write(b'<?xml version="1.0" encoding="UTF-8"?>\n<OpenDRIVE>\n')
        for element in xml.iter_elements(path, ""):
            for inner in element.iter():
                inner.tag = inner.tag.rpartition("}")[2]
            if element.tag not in _PARTS or _is_of_virtual_junction(element, road_map):
                continue
            added = []
            if element.tag == "road":
                _remove_virtual_links(element, road_map)
                if not options.keeps_all_lights:
                    _remove_other_lights(element, road_map.roads[element.attrib["id"]])
            elif element.tag == "junction":
                added = replace_direct_connections(element, road_map, lefthand=options.swap_lanes)
            for part in (element, *added):
                _change(part, options)
                _write(part, file)
        file.write(b"</OpenDRIVE>\n")


def _write(element: Element, file: IO[bytes]) -> None:
    element.tail = "\n"
    file.write(tostring(element, encoding="utf-8", xml_declaration=False))


def _change(element: Element, options: CopyOptions) -> None:
    match element.tag:
        case "header":
            _change_header(element, options)
        case "road":
            _change_road(element, options)
        case "junction" if options.swap_lanes:
            for link in element.iter("laneLink"):
                _negate(link, "from")
                _negate(link, "to")


def _is_of_virtual_junction(element: Element, road_map: OpenDriveMap) -> bool:
    identifier = element.get("id", "")
    if element.tag == "junction":
        return identifier in road_map.virtual
    return element.tag == "road" and road_map.is_in_virtual_junction(identifier)


def _remove_virtual_links(road: Element, road_map: OpenDriveMap) -> None:
    """Remove the links of a ``<road>`` to virtual junctions and to the roads through them."""
    for links in road.iterfind("link"):
        for link in list(links):
            name = link.get("elementId", "")
            is_junction = link.get("elementType") == "junction"
            if name in road_map.virtual if is_junction else road_map.is_in_virtual_junction(name):
                links.remove(link)


def _remove_other_lights(element: Element, road: Road) -> None:
    """Remove the traffic lights of a ``<road>`` that are at no junction."""
    for signals in element.iterfind("signals"):
        for child, signal in zip(list(signals.iterfind("signal")), road.signals, strict=True):
            if road.is_light_elsewhere(signal):
                signals.remove(child)


def _change_header(header: Element, options: CopyOptions) -> None:
    for child in list(header):
        if child.tag != "offset" or not options.reference:
            header.remove(child)
    if options.reference:
        reference = Element("geoReference")
        reference.text = options.reference
        header.insert(0, reference)
    offset = header.find("offset")
    if offset is not None:
        offset.set("hdg", "0")
        for key in ("x", "y", "z"):
            offset.set(key, offset.get(key, "0"))


def _change_road(road: Element, options: CopyOptions) -> None:
    for child in list(road):
        if child.tag not in _ROAD_PARTS:
            road.remove(child)
    road.attrib.pop("rule", None)
    for lane in road.iter("lane"):
        if not options.keeps_type(lane.get("type", _IGNORED_TYPE)):
            lane.set("type", _IGNORED_TYPE)
    _copy_speeds_to_lanes(road)
    for section in road.iter("laneSection"):
        widths_from_borders(section)
    for geometry in road.iter("geometry"):
        _simplify(geometry)
        if options.rotation_rad:
            _rotate(geometry, options.rotation_rad)
    if options.swap_lanes:
        _swap_lanes(road)
    _sort_lanes(road)


def _copy_speeds_to_lanes(road: Element) -> None:
    """Give the speed limits of a road to its lanes that state none."""
    limits = sorted(opendrive.speed_limits(road), key=lambda limit: limit[0])
    sections = sorted(road.iterfind("lanes/laneSection"), key=lambda section: float(section.attrib["s"]))
    starts_m = [float(section.attrib["s"]) for section in sections]
    for section, start_m, end_m in zip(sections, starts_m, [*starts_m[1:], float(road.attrib["length"])], strict=True):
        by_offset = {
            offset_m if offset_m >= _SHORTEST_SPEED_M else 0.0: speed
            for offset_m, speed in ((max(0.0, at_m - start_m), speed) for at_m, speed in limits)
            if offset_m == 0 or offset_m <= end_m - start_m - _SHORTEST_SPEED_M
        }
        for lane in section.iter("lane"):
            if lane.find("speed") is None and lane.get("id") != "0":
                for offset_m, speed in by_offset.items():
                    lane.append(Element("speed", speed | {"sOffset": repr(offset_m)}))


def _simplify(geometry: Element) -> None:
    """Replace a spiral by an arc, and an arc by a line, that end at most :data:`_SAME_SHAPE_M` from it."""
    for shape in list(geometry):
        if shape.tag not in ("arc", "spiral"):
            continue
        square_m2 = float(geometry.attrib["length"]) ** 2
        keys = ("curvature", "curvature") if shape.tag == "arc" else ("curvStart", "curvEnd")
        first, last = (float(shape.attrib[key]) for key in keys)
        if abs(last - first) * square_m2 / 12 > _SAME_SHAPE_M:
            continue
        curvature = (first + last) / 2
        shape.attrib.clear()
        shape.tag = "line"
        if abs(curvature) * square_m2 / 2 > _SAME_SHAPE_M:
            shape.tag = "arc"
            shape.set("curvature", repr(curvature))


def _rotate(geometry: Element, angle_rad: float) -> None:
    x, y, heading = (float(geometry.attrib[key]) for key in ("x", "y", "hdg"))
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    turned = {"x": x * cos - y * sin, "y": x * sin + y * cos, "hdg": heading + angle_rad}
    for key, value in turned.items():
        geometry.set(key, repr(value))


def _sort_lanes(road: Element) -> None:
    """Put lanes on the side of their id, from the left to the right: netconvert goes by their order."""
    for section in road.iter("laneSection"):
        lanes = sorted(section.iter("lane"), key=lambda lane: -int(lane.attrib["id"]))
        section[:] = []
        for tag, sign in (("left", 1), ("center", 0), ("right", -1)):
            side = Element(tag)
            side.extend(lane for lane in lanes if _sign(int(lane.attrib["id"])) == sign)
            if len(side):
                section.append(side)


def _sign(number: int) -> int:
    return (number > 0) - (number < 0)


def _swap_lanes(road: Element) -> None:
    for lane in road.iter("lane"):
        _negate(lane, "id")
        for link in lane.iterfind("link/*"):
            _negate(link, "id")
        for mark in lane.iterfind("roadMark"):
            change = mark.get("laneChange", "")
            if change in _SWAPPED_CHANGES:
                mark.set("laneChange", _SWAPPED_CHANGES[change])
    for validity in road.iter("validity"):
        _negate(validity, "fromLane")
        _negate(validity, "toLane")


def _negate(element: Element, key: str) -> None:
    value = element.get(key)
    if value is not None:
        element.set(key, str(-int(value)))
