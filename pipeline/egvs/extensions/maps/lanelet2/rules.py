"""Traffic rules of lanelets: who may drive where, how fast, and on which side of the road.

What a map does not state is assumed, and counted in :class:`Assumptions`.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
import shapely
from shapely.geometry import LineString, Point

from egvs.core.errors import InputError
from egvs.creation.driving_side import DrivingSide, Evidence, choose_side, majority
from egvs.extensions.maps.formats.lanelet2 import Lanelet, LaneletMap
from egvs.extensions.maps.formats.lanelet2_graph import MOTOR_VEHICLES, DirectedLanelet, LaneletGraph, allowed_users
from egvs.formats.osm import Tags, Way

DEFAULT_SPEEDS_KM_H = {
    ("road", "urban"): 50.0, ("road", "nonurban"): 80.0,
    ("highway", "urban"): 80.0, ("highway", "nonurban"): 100.0,
    ("exit", "urban"): 20.0, ("exit", "nonurban"): 20.0,
    ("play_street", "urban"): 10.0, ("play_street", "nonurban"): 10.0,
}  # fmt: skip
"""Speed limits by subtype and location, where a map states none. Assumed; other subtypes count as roads."""

MAX_SPEED_KM_H = 300.0

_CLASSES = {
    "car": ("private", "passenger", "delivery", "hov", "evehicle"),
    "bus": ("bus", "coach"),
    "truck": ("truck", "trailer"),
    "motorcycle": ("motorcycle", "moped"),
    "taxi": ("taxi",),
    "emergency": ("emergency", "authority", "army", "vip"),
    "bicycle": ("bicycle",),
}
"""SUMO's vClasses of each kind of user."""

NOT_ON_ROADS = ("pedestrian", "tram", "rail_urban", "rail", "rail_electric", "rail_fast", "ship")
"""vClasses that may not use a lane for all motor vehicles."""

_CLASS_OF_SUBTYPE = {"highway": "motorway", "play_street": "living_street", "exit": "service"}

_UNIT_KM_H = {"": 1.0, "km/h": 1.0, "kmh": 1.0, "kph": 1.0, "m/s": 3.6, "mps": 3.6, "mph": 1.609344}
_SPEED = re.compile(r"(\d+(?:\.\d+)?)\s*([a-z/]*)", re.IGNORECASE)
_SIGN = re.compile(r"de274(?:[.-]\d+)?-(\d+)|^(\d+)\s*(?:km/h|kmh)$", re.IGNORECASE)
_SPEED_HINT = "Give a speed such as 50, 50 km/h or 13.9 m/s."

_DASHED_TYPES = ("line_thin", "line_thick")
_SIDE_RANGE_M, _SIDE_MIN_M = 25.0, 1.5
_OPPOSITE = -0.8


@dataclass
class Assumptions:
    """How often something was assumed.

    Attributes
    ----------
    speeds_km_h
        Number of lanes by their assumed speed.
    classes
        Number of roads by their assumed class.
    """

    speeds_km_h: Counter[float] = field(default_factory=Counter)
    classes: Counter[str] = field(default_factory=Counter)


def is_for_motor_vehicles(lanelet: Lanelet) -> bool:
    """Return whether any motor vehicle may drive on a lanelet."""
    return not allowed_users(lanelet.tags).isdisjoint(MOTOR_VEHICLES)


def permission_attributes(users: frozenset[str]) -> dict[str, str]:
    """Return SUMO's attributes ``allow`` or ``disallow`` of a lane.

    >>> permission_attributes(frozenset({"bus", "taxi"}))
    {'allow': 'bus coach taxi'}
    """
    if users.issuperset(MOTOR_VEHICLES):
        bicycles = () if "bicycle" in users else ("bicycle",)
        return {"disallow": " ".join([*NOT_ON_ROADS, *bicycles])}
    return {"allow": " ".join(name for kind, names in _CLASSES.items() if kind in users for name in names)}


def speed_limit_km_h(lanelet: DirectedLanelet, lanelet_map: LaneletMap, where: str, assumed: Assumptions) -> float:
    """Return the speed limit of a lanelet: of its tag, of its regulatory element, or assumed.

    Parameters
    ----------
    lanelet
        The lanelet.
    lanelet_map
        The map, for regulatory elements.
    where
        The file, for messages.
    assumed
        Counts the limits that the map does not state.

    Raises
    ------
    InputError
        When the tag ``speed_limit`` is not a speed.
    """
    if "speed_limit" in lanelet.tags:
        text = lanelet.tags["speed_limit"]
        speed_km_h = parse_speed_km_h(text)
        if speed_km_h is None:
            raise InputError(f"{where}: lanelet {lanelet.key.id}: speed_limit", f"got {text!r}", _SPEED_HINT)
        return speed_km_h
    for number in lanelet.regulations:
        regulation = lanelet_map.regulations[number]
        if regulation.subtype == "speed_limit":
            signs = [lanelet_map.lines[way].tags.get("subtype", "") for way in regulation.ids("way", "refers")]
            for text in (regulation.tags.get("sign_type", ""), *signs):
                if (match := _SIGN.search(text)) and 0 < float(match[1] or match[2]) <= MAX_SPEED_KM_H:
                    return float(match[1] or match[2])
    speed_km_h = parse_speed_km_h(lanelet.tags.get("maxspeed", ""))  # OpenStreetMap's tag
    if speed_km_h is not None:
        return speed_km_h
    location = "nonurban" if lanelet.tags.get("location") == "nonurban" else "urban"
    subtype = lanelet.tags.get("subtype", "road")
    speed_km_h = DEFAULT_SPEEDS_KM_H.get((subtype, location), DEFAULT_SPEEDS_KM_H["road", location])
    assumed.speeds_km_h[speed_km_h] += 1
    return speed_km_h


def parse_speed_km_h(text: str) -> float | None:
    """Parse a speed; None unless it is above 0 and at most :data:`MAX_SPEED_KM_H`.

    >>> parse_speed_km_h("50"), parse_speed_km_h("10 m/s"), parse_speed_km_h("fast")
    (50.0, 36.0, None)
    """
    match = _SPEED.fullmatch(text.strip())
    if match is None or match[2].lower() not in _UNIT_KM_H:
        return None
    speed_km_h = float(match[1]) * _UNIT_KM_H[match[2].lower()]
    return speed_km_h if 0 < speed_km_h <= MAX_SPEED_KM_H else None


def road_class(tags: Tags, lanes: int, assumed: Assumptions) -> str:
    """Return the OpenStreetMap road class of a road: of its tag ``highway``, or assumed.

    Parameters
    ----------
    tags
        Tags of its first lanelet.
    lanes
        Number of its lanes.
    assumed
        Counts the classes that the map does not state.
    """
    if "highway" in tags:
        return tags["highway"]
    name = _CLASS_OF_SUBTYPE.get(tags.get("subtype", ""), "secondary" if lanes > 1 else "tertiary")
    assumed.classes[name] += 1
    return name


def may_cross(line: Way, *, is_along: bool) -> tuple[bool, bool]:
    """Return whether vehicles may change lanes over a marking, to the left and to the right.

    Parameters
    ----------
    line
        The bound between two lanes.
    is_along
        Whether it runs in driving direction.
    """
    if "lane_change" in line.tags:
        allowed = line.tags["lane_change"].lower() in ("yes", "true", "1")
        return allowed, allowed
    kind, subtype = line.tags.get("type", ""), line.tags.get("subtype", "")
    if kind == "virtual" or (kind in _DASHED_TYPES and subtype == "dashed"):
        return True, True
    if kind in _DASHED_TYPES and subtype in ("solid_dashed", "dashed_solid"):
        to_left = (subtype == "solid_dashed") == is_along
        return to_left, not to_left
    return False, False


def opposite_sides_m(graph: LaneletGraph) -> tuple[float, float]:
    """Return the length of lanelets whose nearest opposite lanelet is on their left, and on their right."""
    lanelets = list(graph.lanelets.values())
    lines = [LineString(lanelet.center_m[:, :2]) for lanelet in lanelets]
    tree = shapely.STRtree(lines)
    left_m = right_m = 0.0
    for lanelet in lanelets:
        middle = len(lanelet.center_m) // 2
        at_m = lanelet.center_m[middle, :2]
        heading = _unit(
            lanelet.center_m[min(middle + 1, len(lanelet.center_m) - 1), :2] - lanelet.center_m[middle - 1, :2]
        )
        nearest_m, side = _SIDE_RANGE_M, 0.0
        for index in tree.query(Point(at_m).buffer(_SIDE_RANGE_M)).tolist():
            other = lanelets[index]
            if other.key.id == lanelet.key.id:
                continue
            offset_m, direction = _nearest_piece(other, at_m)
            distance_m = float(np.hypot(*offset_m))
            if float(direction @ heading) < _OPPOSITE and _SIDE_MIN_M < distance_m < nearest_m:
                nearest_m = distance_m
                side = float(heading[0] * offset_m[1] - heading[1] * offset_m[0])
        if side > 0:
            left_m += lanelet.length_m
        elif side < 0:
            right_m += lanelet.length_m
    return left_m, right_m


def choose_driving_side(
    graph: LaneletGraph, lefthand: bool | None, of_position: Evidence | None, where: str
) -> DrivingSide:
    """Decide on which side traffic drives: as opposite lanes lie to each other, or else as requested, or as at the
    map's position.

    Raises
    ------
    InputError
        When opposite lanes contradict the request.
    """
    left_m, right_m = opposite_sides_m(graph)
    reasons = "opposite lanes lie to the right of each other", "opposite lanes lie to the left of each other"
    evidence = majority(right_m, left_m, reasons)
    return choose_side(lefthand, [] if evidence is None else [evidence], of_position, where)


def _nearest_piece(lanelet: DirectedLanelet, at_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the offset from a point to the nearest point of a centre line, and the line's direction there."""
    line = lanelet.center_m[:, :2]
    index = int(np.argmin(np.hypot(*(line - at_m).T)))
    low, high = max(index - 1, 0), min(index + 1, len(line) - 1)
    return line[index] - at_m, _unit(line[high] - line[low])


def _unit(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / max(float(np.hypot(*vector)), 1e-9))


def common_tag(lanelets: Iterable[DirectedLanelet], key: str) -> str:
    """Return the value of a tag that all lanelets share; empty if they do not."""
    values = {lanelet.tags.get(key, "") for lanelet in lanelets}
    return values.pop() if len(values) == 1 else ""
