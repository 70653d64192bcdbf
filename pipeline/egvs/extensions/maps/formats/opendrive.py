r"""Read the roads of an OpenDRIVE map (ASAM OpenDRIVE 1.4 to 1.8): geometry, lanes, links, junctions, signals.

Steps of :func:`read_opendrive`: parse the file road by road; check that numbers are finite and lengths sensible. The
functions of :class:`Road` evaluate the map at a distance s along a road.

A road has a reference line in the plane, of elements that start at given points. With the distance :math:`s` from the
start of an element, the heading of the tangent is

.. math:: \theta(s) = \theta_0 + \kappa_0 s + (\kappa_1 - \kappa_0) s^2 / 2 L

for a line, an arc and a spiral (a clothoid), and the point is its integral. The cubic polynomials ``poly3`` and
``paramPoly3`` are given in a frame at the start of the element, u along the tangent and v to its left. Lane 0 is the
reference line, moved sideways by ``laneOffset``; positive lanes lie to its left, negative ones to its right.

Frame of the map: x east, y north, z up, metres, s along the road, t to its left. The header's ``<offset>`` is not
applied. Source: ASAM OpenDRIVE 1.8.0 (https://publications.pages.asam.net/standards/ASAM_OpenDRIVE/).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.numbers import number_or_nan
from egvs.formats import xml

ROOT = "OpenDRIVE"
MAX_ROAD_M = 100_000.0
"""Length that no road of a map exceeds."""

_MAX_COORDINATE_M = 1e8
_STEP_M = 0.5
_HINT = "Correct the map, or export it again."
_GAUSS_POINTS, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(5)
_CLOSED_LINES = frozenset({"solid", "curb", "grass"})
_SHAPES = ("line", "arc", "spiral", "poly3", "paramPoly3")

ContactPoint = Literal["start", "end"]


class Cubic(NamedTuple):
    """A polynomial a + b ds + c ds^2 + d ds^3 from a start on."""

    start_m: float
    a: float
    b: float
    c: float
    d: float

    def at(self, ds: FloatArray) -> FloatArray:
        """Return the values (n,) at distances (n,) from its start."""
        return self.a + ds * (self.b + ds * (self.c + ds * self.d))


class Link(NamedTuple):
    """What is at the end of a road: the id of a road, with the end that is met, or of a junction."""

    kind: str
    id: str
    contact: ContactPoint


@dataclass(frozen=True)
class PlanElement:
    """A piece of a reference line.

    Attributes
    ----------
    start_m, length_m
        Distance along the road, and length.
    x_m, y_m, heading_rad
        Its start.
    shape
        ``line``, ``arc``, ``spiral``, ``poly3`` or ``paramPoly3``.
    curvatures
        Curvature in 1/m at the start and at the end; of a line, an arc and a spiral.
    u, v
        Coefficients of the polynomials of ``poly3`` and ``paramPoly3``, from the constant on.
    p_max
        Parameter at the end of a ``paramPoly3``.
    """

    start_m: float
    length_m: float
    x_m: float
    y_m: float
    heading_rad: float
    shape: str
    curvatures: tuple[float, float] = (0.0, 0.0)
    u: tuple[float, ...] = (0.0, 1.0, 0.0, 0.0)
    v: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    p_max: float = 1.0

    def at(self, ds: FloatArray) -> FloatArray:
        """Return x, y and heading (n, 3) at distances (n,) from the start of the element."""
        if self.shape in ("poly3", "paramPoly3"):
            return self._cubic_at(ds)
        first, last = self.curvatures
        bend = (last - first) / self.length_m

        def heading(s: FloatArray) -> FloatArray:
            return self.heading_rad + s * (first + s * bend / 2)

        # Gauss-Legendre on pieces in which the tangent turns little
        turn = max(abs(first), abs(last)) * self.length_m
        pieces = min(max(1, math.ceil(turn)), 10_000)
        ends = ds[:, None] * (np.arange(pieces + 1) / pieces)
        half = np.diff(ends, axis=1)[:, :, None] / 2
        nodes = (ends[:, :-1] + ends[:, 1:])[:, :, None] / 2 + half * _GAUSS_POINTS
        x = self.x_m + (half * _GAUSS_WEIGHTS * np.cos(heading(nodes))).sum(axis=(1, 2))
        y = self.y_m + (half * _GAUSS_WEIGHTS * np.sin(heading(nodes))).sum(axis=(1, 2))
        return np.column_stack([x, y, heading(ds)])

    def _cubic_at(self, ds: FloatArray) -> FloatArray:
        # poly3 counts its parameter along u; its length is that of the curve
        p = self._parameter_of_length(ds) if self.shape == "poly3" else ds / self.length_m * self.p_max
        u, v, du, dv = _cubics(self.u, p), _cubics(self.v, p), _slopes(self.u, p), _slopes(self.v, p)
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        x = self.x_m + u * cos - v * sin
        y = self.y_m + u * sin + v * cos
        return np.column_stack([x, y, self.heading_rad + np.arctan2(dv, du)])

    def _parameter_of_length(self, ds: FloatArray) -> FloatArray:
        """Return u of the points of a ``poly3`` at distances (n,) along the curve."""
        u = np.linspace(0.0, self.length_m, 257)
        steps = np.hypot(np.diff(u), np.diff(_cubics(self.v, u)))
        along = np.concatenate([[0.0], np.cumsum(steps)])
        return np.interp(ds, along, u)


class RoadMark(NamedTuple):
    """The marking at the outer border of a lane, from a distance after the start of its section on.

    Attributes
    ----------
    start_m
        That distance.
    outwards, inwards
        Whether vehicles may change lanes over it, away from the reference line and towards it.
    """

    start_m: float
    outwards: bool
    inwards: bool


@dataclass(frozen=True)
class RoadLane:
    """A lane of a lane section.

    Attributes
    ----------
    id
        Negative to the right of the reference line, from the inside outwards.
    type
        ``driving``, ``sidewalk``, ...
    widths
        Its width, from distances after the start of the section on.
    predecessors, successors
        Ids of lanes in the sections, or on the roads, before and after.
    marks
        Markings at its outer border, sorted.
    """

    id: int
    type: str
    widths: tuple[Cubic, ...]
    predecessors: tuple[int, ...]
    successors: tuple[int, ...]
    marks: tuple[RoadMark, ...] = ()

    def mark_at(self, ds_m: float) -> RoadMark | None:
        """Return the marking at a distance from the start of the section; None without one."""
        marks = [mark for mark in self.marks if mark.start_m <= ds_m]
        return marks[-1] if marks else None


@dataclass(frozen=True)
class LaneSection:
    """A part of a road with constant lanes; those of ``lanes`` are sorted by id, without the middle lane 0."""

    start_m: float
    end_m: float
    lanes: Mapping[int, RoadLane]


@dataclass(frozen=True)
class RoadSignal:
    """A signal or sign beside a road; ``dynamic`` for traffic lights.

    ``orientation`` is ``+`` for traffic along the road, ``-`` for traffic against it, ``none`` for both.
    """

    id: str
    s_m: float
    dynamic: bool
    type: str
    orientation: str = "none"


@dataclass(frozen=True)
class Road:
    """A road.

    Attributes
    ----------
    id, name
        As in the file.
    length_m
        Length of its reference line.
    junction
        Id of the junction that it leads through; empty for a road between junctions.
    rule
        ``"LHT"`` where traffic keeps to the left, ``"RHT"`` to the right; empty if the file does not say.
    predecessor, successor
        What is at its ends.
    plan
        The elements of its reference line, sorted.
    elevations, superelevations, lane_offsets
        Height in metres, slope across the road in rad, and offset of lane 0 in metres.
    sections
        Lane sections, sorted.
    signals
        Signals and signs.
    states_speed
        Whether the road, or each of its lanes for driving, has a speed limit.
    """

    id: str
    name: str
    length_m: float
    junction: str
    rule: str
    predecessor: Link | None
    successor: Link | None
    plan: tuple[PlanElement, ...]
    elevations: tuple[Cubic, ...]
    superelevations: tuple[Cubic, ...]
    lane_offsets: tuple[Cubic, ...]
    sections: tuple[LaneSection, ...]
    signals: tuple[RoadSignal, ...]
    states_speed: bool = False

    def is_light_elsewhere(self, signal: RoadSignal) -> bool:
        """Return whether a signal is a traffic light for traffic towards an end that is at no junction."""
        ends = {"+": (self.successor,), "-": (self.predecessor,)}.get(
            signal.orientation, (self.successor, self.predecessor)
        )
        is_at_junction = bool(self.junction) or any(link is not None and link.kind == "junction" for link in ends)
        return signal.dynamic and not is_at_junction

    def reference_line(self, s_m: FloatArray) -> FloatArray:
        """Return x, y and heading (n, 3) of the reference line at distances (n,), in metres and rad."""
        starts = np.array([element.start_m for element in self.plan])
        number = np.maximum(np.searchsorted(starts, s_m, side="right") - 1, 0)
        points = np.empty((len(s_m), 3))
        for index in np.unique(number):
            is_here = number == index
            element = self.plan[index]
            points[is_here] = element.at(np.clip(s_m[is_here] - element.start_m, 0.0, element.length_m))
        return points

    def height_m(self, s_m: FloatArray) -> FloatArray:
        """Return the height (n,) of the reference line at distances (n,)."""
        return evaluate(self.elevations, s_m)

    def lane_line(
        self, section: LaneSection, lane: int, step_m: float = _STEP_M, *, mirrored: bool = False
    ) -> FloatArray:
        """Return x, y, z (n, 3) along the middle of a lane, in the direction of the reference line.

        The slope across the road is not part of z. With ``mirrored``, lanes lie on the other side of lane 0.
        """
        length_m = section.end_m - section.start_m
        steps = max(1, math.ceil(length_m / step_m))
        s_m = section.start_m + length_m * np.arange(steps + 1) / steps
        side = 1 if lane > 0 else -1
        t_m = evaluate(self.lane_offsets, s_m)
        for number in range(side, lane + side, side):
            width_m = evaluate(section.lanes[number].widths, s_m - section.start_m) if number in section.lanes else 0.0
            t_m = t_m + (-side if mirrored else side) * width_m * (0.5 if number == lane else 1.0)
        x, y, heading = self.reference_line(s_m).T
        return np.column_stack([x - t_m * np.sin(heading), y + t_m * np.cos(heading), self.height_m(s_m)])


class LaneLink(NamedTuple):
    """A lane of an incoming road, and the lane of the connecting road that it leads to."""

    incoming: int
    connecting: int


@dataclass(frozen=True)
class JunctionConnection:
    """A way through a junction: from a road to the ``contact`` end of a connecting road."""

    incoming: str
    connecting: str
    contact: ContactPoint
    links: tuple[LaneLink, ...]


@dataclass(frozen=True)
class OpenDriveMap:
    """An OpenDRIVE map.

    Attributes
    ----------
    reference
        The text of ``<geoReference>``; may be empty.
    offset_m, offset_rad
        x, y, z and heading of the header's ``<offset>``.
    roads
        By id.
    junctions
        The connections of each junction, by id.
    virtual
        Ids of virtual junctions, which join roads between their ends.
    """

    reference: str
    offset_m: tuple[float, float, float]
    offset_rad: float
    roads: Mapping[str, Road]
    junctions: Mapping[str, tuple[JunctionConnection, ...]]
    virtual: frozenset[str] = frozenset()

    def is_in_virtual_junction(self, road: str) -> bool:
        """Return whether a road leads through a virtual junction."""
        return road in self.roads and self.roads[road].junction in self.virtual


def evaluate(cubics: Sequence[Cubic], s_m: FloatArray) -> FloatArray:
    """Return the values (n,) of polynomials at distances (n,); 0 before the first polynomial.

    >>> evaluate([Cubic(0, 1, 0, 0, 0), Cubic(10, 1, 0.5, 0, 0)], np.array([5.0, 12.0])).tolist()
    [1.0, 2.0]
    """
    if not cubics:
        return np.zeros(len(s_m))
    starts = np.array([cubic.start_m for cubic in cubics])
    number = np.maximum(np.searchsorted(starts, s_m, side="right") - 1, 0)
    values = np.empty(len(s_m))
    for index in np.unique(number):
        is_here = number == index
        values[is_here] = cubics[index].at(s_m[is_here] - cubics[index].start_m)
    return values


def read_opendrive(path: Path) -> OpenDriveMap:
    """Read an OpenDRIVE map, gzipped or not.

    Raises
    ------
    InputError
        When the file is no OpenDRIVE map, is damaged, or has no road.
    """
    header: Element | None = None
    roads: dict[str, Road] = {}
    junctions: dict[str, tuple[JunctionConnection, ...]] = {}
    virtual = set()
    for element in xml.iter_elements(path, "", on_root=lambda root: _check_root(root, path)):
        _strip_namespaces(element)
        name = f"<{element.tag} id={element.get('id', '')!r}>"
        try:
            match element.tag:
                case "header":
                    header = _copy(element)
                case "road":
                    road = _parse_road(element)
                    if road.id in roads:
                        raise ValueError("the id occurs twice")
                    roads[road.id] = road
                    limits.MAP_OBJECTS.check(path, len(roads), "has too many roads")
                case "junction":
                    junctions[element.attrib["id"]] = tuple(_parse_connections(element))
                    if element.get("type") == "virtual":
                        virtual.add(element.attrib["id"])
        except KeyError as error:
            raise InputError(f"{path}: {name}", f"the attribute {error} is missing", _HINT) from None
        except ValueError as error:
            raise InputError(f"{path}: {name}", str(error), _HINT) from None
    if not roads:
        raise InputError(path, "the map has no roads", "Use a map with at least one <road>.")
    try:
        reference, offset_m, offset_rad = _parse_header(header)
    except ValueError as error:
        raise InputError(f"{path}: <header>", str(error), _HINT) from None
    return OpenDriveMap(reference, offset_m, offset_rad, roads, junctions, frozenset(virtual))


def _check_root(root: Element, path: Path) -> None:
    tag = root.tag.rpartition("}")[2]
    if tag != ROOT:
        raise InputError(path, f"expected the root element <{ROOT}>, got <{tag}>", "Check the file name.")


def _strip_namespaces(element: Element) -> None:
    for inner in element.iter():
        inner.tag = inner.tag.rpartition("}")[2]


def _copy(element: Element) -> Element:
    """Return a copy of an element that is cleared when the next one is read."""
    copy = Element(element.tag, element.attrib)
    copy.text = element.text
    copy.extend(_copy(child) for child in element)
    return copy


def _parse_header(header: Element | None) -> tuple[str, tuple[float, float, float], float]:
    if header is None:
        return "", (0.0, 0.0, 0.0), 0.0
    offset = header.find("offset")
    values = [0.0] * 4
    if offset is not None:
        values = [_number(offset, key, 0.0) for key in ("x", "y", "z", "hdg")]
    x, y, z, heading = values
    return (header.findtext("geoReference") or "").strip(), (x, y, z), heading


def _parse_road(element: Element) -> Road:
    length_m = _number(element, "length")
    if not 0 <= length_m <= MAX_ROAD_M:
        raise ValueError(f"expected a length from 0 to {MAX_ROAD_M:g} m, got {length_m:g}")
    plan = tuple(sorted(map(_parse_plan, element.iterfind("planView/geometry")), key=lambda piece: piece.start_m))
    if not plan:
        raise ValueError("has no <planView> with a <geometry>")
    junction = element.get("junction", "-1")
    return Road(
        id=element.attrib["id"],
        name=element.get("name", ""),
        length_m=length_m,
        junction="" if junction == "-1" else junction,
        rule=element.get("rule", "").upper(),
        predecessor=_parse_link(element.find("link/predecessor")),
        successor=_parse_link(element.find("link/successor")),
        plan=plan,
        elevations=_parse_cubics(element.iterfind("elevationProfile/elevation")),
        superelevations=_parse_cubics(element.iterfind("lateralProfile/superelevation")),
        lane_offsets=_parse_cubics(element.iterfind("lanes/laneOffset")),
        sections=tuple(_parse_sections(element, length_m)),
        signals=tuple(map(_parse_signal, element.iterfind("signals/signal"))),
        states_speed=_states_speed(element),
    )


def speed_limits(road: Element) -> Iterator[tuple[float, dict[str, str]]]:
    """Yield the speed limits of a ``<road>``: distance from its start in metres, and attributes ``max`` and ``unit``.

    ``no limit``, ``undefined`` and other words are left out.
    """
    for kind in road.iterfind("type"):
        speed = kind.find("speed")
        if speed is None:
            continue
        try:
            value, start_m = float(speed.get("max", "")), float(kind.get("s", "0"))
        except ValueError:
            continue
        if 0 < value < math.inf and 0 <= start_m < math.inf:
            yield start_m, {key: speed.attrib[key] for key in ("max", "unit") if key in speed.attrib}


def _states_speed(road: Element) -> bool:
    lanes = [lane for lane in road.iter("lane") if lane.get("type") == "driving"]
    return any(speed_limits(road)) or all(lane.find("speed") is not None for lane in lanes)


def _parse_plan(element: Element) -> PlanElement:
    start_m, length_m = _number(element, "s"), _number(element, "length")
    if not 0 <= length_m <= MAX_ROAD_M:
        raise ValueError(f"<geometry>: expected a length from 0 to {MAX_ROAD_M:g} m, got {length_m:g}")
    x_m, y_m, heading_rad = _number(element, "x"), _number(element, "y"), _number(element, "hdg")
    if not max(abs(x_m), abs(y_m)) <= _MAX_COORDINATE_M:
        raise ValueError(f"<geometry>: expected coordinates up to {_MAX_COORDINATE_M:g} m, got {x_m:g}, {y_m:g}")
    shape = next((child for child in element if child.tag in _SHAPES), None)
    if shape is None:
        raise ValueError(f"<geometry>: expected one of {', '.join(_SHAPES)}")
    kind = shape.tag
    curvatures = (0.0, 0.0)
    u, v, p_max = (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), 1.0
    if kind == "arc":
        curvatures = (_number(shape, "curvature"),) * 2
    elif kind == "spiral":
        curvatures = (_number(shape, "curvStart"), _number(shape, "curvEnd"))
    elif kind == "poly3":
        v = (_number(shape, "a"), _number(shape, "b"), _number(shape, "c"), _number(shape, "d"))
    elif kind == "paramPoly3":
        u = (_number(shape, "aU"), _number(shape, "bU"), _number(shape, "cU"), _number(shape, "dU"))
        v = (_number(shape, "aV"), _number(shape, "bV"), _number(shape, "cV"), _number(shape, "dV"))
        p_max = length_m if shape.get("pRange") == "arcLength" else 1.0
    if not length_m:
        kind = "line" if kind in ("arc", "spiral") else kind
    return PlanElement(
        start_m, length_m or 1e-9, x_m, y_m, heading_rad, kind, curvatures=curvatures, u=u, v=v, p_max=p_max
    )


def _parse_link(element: Element | None) -> Link | None:
    if element is None or "elementId" not in element.attrib:
        return None
    return Link(element.get("elementType", "road"), element.attrib["elementId"], _contact(element))


def _contact(element: Element) -> ContactPoint:
    return "end" if element.get("contactPoint") == "end" else "start"


def _parse_sections(road: Element, length_m: float) -> Iterator[LaneSection]:
    elements = sorted(road.iterfind("lanes/laneSection"), key=lambda element: _number(element, "s"))
    ends = [*(_number(element, "s") for element in elements[1:]), length_m]
    for element, end_m in zip(elements, ends, strict=True):
        widths_from_borders(element)
        lanes = [_parse_lane(lane) for side in ("left", "right") for lane in element.iterfind(f"{side}/lane")]
        if any(_integer(lane, "id") for lane in element.iterfind("center/lane")):
            raise ValueError("<center>: expected a lane with the id 0")
        by_id = {lane.id: lane for lane in sorted(lanes, key=lambda lane: lane.id)}
        start_m = _number(element, "s")
        yield LaneSection(start_m, max(start_m, end_m), by_id)


def widths_from_borders(section: Element) -> None:
    """Give widths to the lanes of a ``<laneSection>`` that have borders instead: the distance from the lane before.

    Borders to the right are negative; those of programs that write distances instead are not.
    """
    for side, sign in (("left", 1), ("right", -1)):
        inner: tuple[Cubic, ...] = ()
        for lane in sorted(section.iterfind(f"{side}/lane"), key=lambda lane: abs(_integer(lane, "id"))):
            borders = _parse_cubics(lane.iterfind("border"), "sOffset")
            if borders and lane.find("width") is None:
                for start_m in sorted({cubic.start_m for cubic in (*borders, *inner)}):
                    outer, before = _moved(borders, start_m), _moved(inner, start_m)
                    outwards = sign if sign * (outer[0] - before[0]) >= 0 else -sign
                    values = [repr(outwards * (last - first)) for last, first in zip(outer, before, strict=True)]
                    SubElement(lane, "width", {"sOffset": repr(start_m)} | dict(zip("abcd", values, strict=True)))
            for border in lane.findall("border"):
                lane.remove(border)
            inner = borders


def _moved(cubics: Sequence[Cubic], start_m: float) -> tuple[float, float, float, float]:
    """Return the coefficients of piecewise polynomials from another start on; 0 without polynomials."""
    if not cubics:
        return 0.0, 0.0, 0.0, 0.0
    cubic = next((cubic for cubic in reversed(cubics) if cubic.start_m <= start_m), cubics[0])
    by_m, (_, a, b, c, d) = start_m - cubic.start_m, cubic
    return a + by_m * (b + by_m * (c + by_m * d)), b + by_m * (2 * c + by_m * 3 * d), c + 3 * d * by_m, d


def _parse_lane(element: Element) -> RoadLane:
    number = _integer(element, "id")
    if not 0 < abs(number) <= 1000:
        raise ValueError(f"<lane>: expected an id other than 0 up to 1000, got {number}")
    widths = _parse_cubics(element.iterfind("width"), "sOffset")
    predecessors = tuple(_integer(link, "id") for link in element.iterfind("link/predecessor"))
    successors = tuple(_integer(link, "id") for link in element.iterfind("link/successor"))
    marks = tuple(sorted(_parse_mark(mark, number) for mark in element.iterfind("roadMark")))
    return RoadLane(number, element.get("type", "none"), widths, predecessors, successors, marks)


def _parse_mark(element: Element, lane: int) -> RoadMark:
    """Return a marking at the outer border of a lane.

    ``laneChange`` counts, with ids of lanes growing from the right to the left; else the type of line, of which the
    inner one is named first. By the standard, a solid line without ``laneChange`` may be crossed; exporters that do not
    know the attribute, SUMO's among them, mean that it may not.
    """
    start_m = _number(element, "sOffset", 0.0)
    change = element.get("laneChange")
    if change in ("both", "none", "increase", "decrease"):
        away = "increase" if lane > 0 else "decrease"
        towards = "decrease" if lane > 0 else "increase"
        return RoadMark(start_m, change in ("both", away), change in ("both", towards))
    lines = element.get("type", "none").split() or ["none"]
    return RoadMark(start_m, lines[0] not in _CLOSED_LINES, lines[-1] not in _CLOSED_LINES)


def _parse_signal(element: Element) -> RoadSignal:
    dynamic = element.get("dynamic", "no") == "yes"
    orientation = element.get("orientation", "none")
    return RoadSignal(element.get("id", ""), _number(element, "s"), dynamic, element.get("type", ""), orientation)


def _parse_connections(junction: Element) -> Iterator[JunctionConnection]:
    for element in junction.iterfind("connection"):
        if "incomingRoad" not in element.attrib or "connectingRoad" not in element.attrib:
            continue  # of a virtual or direct junction
        links = [LaneLink(_integer(link, "from"), _integer(link, "to")) for link in element.iterfind("laneLink")]
        yield JunctionConnection(
            element.attrib["incomingRoad"], element.attrib["connectingRoad"], _contact(element), tuple(links)
        )


def _parse_cubics(elements: Iterator[Element], start: str = "s") -> tuple[Cubic, ...]:
    cubics = [Cubic(*(_number(element, key) for key in (start, "a", "b", "c", "d"))) for element in elements]
    return tuple(sorted(cubics, key=lambda cubic: cubic.start_m))


def _number(element: Element, key: str, default: float | None = None) -> float:
    text = element.get(key)
    if text is None:
        if default is None:
            raise KeyError(key)
        return default
    value = number_or_nan(text)
    if not math.isfinite(value):
        raise ValueError(f"<{element.tag}>: {key}: expected a number, got {text[:40]!r}")
    return value


def _integer(element: Element, key: str) -> int:
    text = element.attrib[key]
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"<{element.tag}>: {key}: expected a whole number, got {text[:40]!r}") from None


def _cubics(coefficients: Sequence[float], p: FloatArray) -> FloatArray:
    a, b, c, d = coefficients
    return a + p * (b + p * (c + p * d))


def _slopes(coefficients: Sequence[float], p: FloatArray) -> FloatArray:
    _, b, c, d = coefficients
    return b + p * (2 * c + p * 3 * d)
