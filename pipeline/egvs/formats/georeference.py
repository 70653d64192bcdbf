"""WGS 84, projections, and the world frame; refuses what cannot be told.

Turns longitude and latitude, and the eastings and northings of any map projection, into the world frame and back.

The world frame is right-handed, x east, y north, in metres. Where it lies on the Earth is said as SUMO's ``<location>``
says it:

    (x, y) = projection(longitude, latitude) + offset

Every pair is in the order x, y: easting before northing, longitude before latitude, whatever order a coordinate
reference system names its axes in. Degrees are WGS 84's where a file says nothing else. PROJ does the work
(https://proj.org), through pyproj; nothing else in this program imports it.

Brings the coordinates of a user's files into the world frame, and refuses those that cannot be told.

A file's coordinates are metres of the world frame, degrees, or what the file itself declares. Where it declares
nothing, they are judged by what the numbers can be, and by where they would lie beside the region of interest:

- degrees lie within +-180 and +-90, near each other, and near the region of interest;
- metres of things that stand or drive are not all within a centimetre of each other;
- what lies far from the region of interest can play no part, so it is in other coordinates.

What fits nothing is refused, with what it would be in each reading. x is east (or longitude), y north (or latitude).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from egvs.core.errors import InputError
from egvs.core.grid import Roi

if TYPE_CHECKING:
    from pyproj import CRS, Transformer


Floats = NDArray[np.float64]

WGS84 = "OGC:CRS84"
"""Longitude and latitude in degrees, in this order."""

MAX_SCALE_ERROR = 0.01
"""A projection that makes lengths longer or shorter by more than this is none to measure beams in: UTM keeps within
0.0004 in its zone; the Web Mercator projection of map tiles stretches by 0.6 at 51 degrees."""

LOCAL_METRES = 'LOCAL_CS["World frame of the scenario",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
"""Metres to the east and north of a zero that lies nobody knows where."""

_SAME_POSITION_M = 0.001


@dataclass(frozen=True)
class WorldFrame:
    """Where a world frame lies on the Earth.

    Attributes
    ----------
    projection
        A projected coordinate reference system in metres to the east and north, in any form that PROJ knows:
        ``"EPSG:25832"``, a PROJ string, WKT. See :meth:`of`, which checks it.
    offset_m
        Added to its easting and northing to reach x and y; SUMO's ``netOffset``.
    """

    projection: str
    offset_m: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(cls, projection: str, offset_m: tuple[float, float], where: str) -> WorldFrame:
        """A frame in a projection that was checked; InputError at ``where`` where it is unknown, or not in metres to
        the east and north."""
        crs = parse_crs(projection, where)
        right = "a projected system in metres, for example epsg = 32632 (UTM zone 32 north)"
        if not crs.is_projected:
            raise InputError(where, f"{projection} ({crs.name}) is no map projection", right)
        if any(axis.unit_name != "metre" for axis in crs.axis_info[:2]):
            raise InputError(where, f"{projection} ({crs.name}) counts in {crs.axis_info[0].unit_name}", right)
        if {axis.direction for axis in crs.axis_info[:2]} != {"east", "north"}:
            ways = " and ".join(axis.direction for axis in crs.axis_info[:2])
            found = f"{projection} ({crs.name}) counts to the {ways}: the world would be turned round"
            raise InputError(where, found, "a system that counts to the east and north")
        return cls(projection, offset_m)

    def from_degrees(self, lon_lat_deg: Floats) -> Floats:
        """World-frame x, y in metres, (n, 2) float64, of longitude and latitude (n, 2) in degrees.

        Not finite where the projection has no such place.
        """
        return self.from_crs(lon_lat_deg, WGS84)

    def to_degrees(self, xy_m: Floats) -> Floats:
        """Longitude and latitude in degrees (WGS 84), (n, 2) float64, of world-frame x, y (n, 2) in metres.

        The inverse of :meth:`from_degrees` to a micrometre: where a change of datum loses up to some millimetres on the
        way back, what it loses is measured and made good.
        """
        eastings = np.subtract(xy_m, self.offset_m, dtype=np.float64)
        back = _transform(WGS84, self.projection, eastings, "INVERSE")
        lost = eastings - _transform(WGS84, self.projection, back)
        return _transform(WGS84, self.projection, eastings + np.nan_to_num(lost, posinf=0.0, neginf=0.0), "INVERSE")

    def from_crs(self, xy: Floats, crs: str) -> Floats:
        """World-frame x, y in metres, (n, 2) float64, of coordinates (n, 2) in another system (its own units)."""
        eastings = _transform(crs, self.projection, np.asarray(xy, dtype=np.float64))
        return np.add(eastings, self.offset_m)

    def stretch(self, xy_m: tuple[float, float]) -> float:
        """How many times too long the projection makes a short line at x, y (1.0: true lengths)."""
        from pyproj import Proj

        lon_deg, lat_deg = self.to_degrees(np.array([xy_m]))[0]
        if not math.isfinite(lon_deg + lat_deg):
            return math.nan
        factors = Proj(parse_crs(self.projection, self.projection)).get_factors(lon_deg, lat_deg)
        return math.sqrt(abs(factors.areal_scale))


def parse_crs(crs: Any, where: str) -> CRS:
    """A coordinate reference system in any form that PROJ knows; InputError at ``where`` for what it does not know.

    Of a compound one (with heights) the horizontal part.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        found = CRS.from_user_input(crs)
    except (CRSError, TypeError, ValueError):
        right = 'a coordinate reference system, for example "EPSG:25832"'
        raise InputError(where, f"{crs!r} is none that is known"[:160], right) from None
    return found.sub_crs_list[0] if found.is_compound else found


def height_unit_m(crs: Any, where: str) -> float:
    """How many metres a height of 1 is in a system: by its vertical axis (below 0 where that counts downwards).

    Where it has none, by the unit of a map projection's other axes, and metres beside degrees.
    """
    from pyproj import CRS

    parse_crs(crs, where)
    found = CRS.from_user_input(crs)
    for axis in found.axis_info:
        if axis.direction in ("up", "down"):
            return float(axis.unit_conversion_factor) * (1.0 if axis.direction == "up" else -1.0)
    return float(found.axis_info[0].unit_conversion_factor) if found.is_projected else 1.0


def crs_name(frame: WorldFrame, at_m: tuple[float, float]) -> str:
    """The projection of a world frame as other programs show it: its EPSG code where one gives the same eastings and
    northings at a place (world frame, metres) to a millimetre, else WKT."""
    own = parse_crs(frame.projection, frame.projection)
    code = own.to_epsg()
    if code is not None:
        eastings = np.subtract([at_m], frame.offset_m, dtype=np.float64)
        same = _transform(frame.projection, f"EPSG:{code}", eastings)
        if np.abs(same - eastings).max() <= _SAME_POSITION_M:
            return f"EPSG:{code}"
    return str(own.to_wkt())


def utm_epsg(lon_deg: float, lat_deg: float) -> int:
    """The EPSG code of the UTM zone (WGS 84) that holds a place."""
    zone = min(max(math.floor((lon_deg + 180.0) / 6.0) + 1, 1), 60)
    return (32600 if lat_deg >= 0 else 32700) + zone


@cache
def _transformer(source: str, target: str) -> Transformer:
    from pyproj import Transformer

    return Transformer.from_crs(parse_crs(source, source), parse_crs(target, target), always_xy=True)


def _transform(source: str, target: str, xy: Floats, direction: str = "FORWARD") -> Floats:
    from pyproj.enums import TransformDirection

    way = TransformDirection(direction)
    x, y = _transformer(source, target).transform(xy[:, 0], xy[:, 1], direction=way)
    return np.column_stack([x, y])


WORLD = "metres of the world frame"
"""What a file declares that says so itself: by ``"crs": null``, by a local system, by the names of its columns."""

NEAR_M, FAR_M, COUNTRY_M = 1_000.0, 10_000.0, 100_000.0
"""From the region of interest: where small numbers may be metres, where things may stand, where degrees belong."""

_CLOSE_M, _SMALL_M, _SPREAD_DEG, _NUMBER_M = 0.01, 1.0, 5.0, 1e9
_DIGITS_M, _DIGITS_DEG = 6, 9  # a micrometre, 0.1 mm: last bits of a machine's sines do not travel on
_DECLARE_HINT = (
    '"crs" in the file: "urn:ogc:def:crs:OGC:1.3:CRS84" for degrees, "urn:ogc:def:crs:EPSG::..." for a projection,'
    " null for metres of the world frame"
)


@dataclass(frozen=True)
class CoordinateReading:
    """What a file's coordinates are taken for, in words, and how they become the world frame's (None: they are)."""

    description: str
    convert: Callable[[Floats], Floats] | None = None
    where: str = ""

    def to_world(self, xy: Floats) -> Floats:
        """World-frame x, y in metres, (n, 2) float64, of coordinates (n, 2); InputError for what has no place there."""
        if self.convert is None:
            return xy
        xy_m = np.round(self.convert(xy), _DIGITS_M) + 0.0  # no -0
        for i in np.flatnonzero(~np.isfinite(xy_m).all(axis=1)):
            found = f"({xy[i, 0]:.10g}, {xy[i, 1]:.10g}) has no place in the scenario's projection"
            raise InputError(self.where, found, self.description)
        return xy_m


WORLD_READING = CoordinateReading(WORLD)
"""Of coordinates that are the world frame's already."""


@dataclass(frozen=True)
class Georeference:
    """Where a scenario's world frame lies on the Earth, if that is known, and its region of interest.

    Attributes
    ----------
    frame
        None where neither the scenario nor its network says it.
    roi
        The region of interest.
    where
        The scenario's file, for messages.
    """

    frame: WorldFrame | None
    roi: Roi
    where: str

    def read_coordinates(
        self, xy: Floats, where: str, declared: str | None = None, expected: str = _DECLARE_HINT
    ) -> CoordinateReading:
        """What a file's coordinates are.

        Parameters
        ----------
        xy
            Its coordinates (n, 2), or enough of them to judge by; finite.
        declared
            The coordinate reference system that the file names, :data:`WORLD`, or None where it names none.
        expected
            How such a file says what its coordinates are, for messages.

        Raises
        ------
        InputError
            At ``where``, where they are in nothing that is known, or lie far from the region of interest.
        """
        if declared is not None and declared != WORLD:
            reading = self._declared(xy, where, declared)
        elif declared == WORLD or not len(xy):
            self.metres(xy, where, expected)
            if self.frame is None and len(xy) and _may_be_degrees(xy) and 0 < np.ptp(xy, axis=0).max() < _CLOSE_M:
                raise self.unknown(
                    where, f"{_format_span(xy)} look like longitude and latitude", xy
                )  # no thing is so thin
            reading = WORLD_READING
        else:
            reading = self._infer(xy, where, expected)
        self._check_near(reading, xy, where, expected)
        return reading

    def of_frame(self, other: WorldFrame | None, xy_m: Floats, where: str, expected: str) -> CoordinateReading:
        """The reading of a file that has a world frame of its own; None: it says nothing, so it is in this one."""
        frame, reading = self.frame, WORLD_READING
        if other is not None and frame is not None and other != frame:
            reading = CoordinateReading(
                "metres of its own <location>", lambda xy: frame.from_degrees(other.to_degrees(xy)), where
            )
        self._check_near(reading, xy_m, where, expected)
        return reading

    def metres(self, xy_m: Floats, where: str, expected: str) -> None:
        """InputError at ``where`` where columns or a mesh that should be in world-frame metres hold degrees, or what
        lies far from the region of interest."""
        if not len(xy_m):
            return
        if self.frame is not None and _may_be_degrees(xy_m) and _is_collapsed(xy_m):
            away_m = self.distance_m(self.frame.from_degrees(xy_m))
            if away_m <= COUNTRY_M:
                found = (
                    f"{_format_span(xy_m)} are longitude and latitude: {_format_distance(away_m)} from the "
                    f"region of interest as such"
                )
                raise InputError(where, found, expected)
        self._check_near(WORLD_READING, xy_m, where, expected)

    def lon_lat_deg(self, xy_m: Floats) -> Floats | None:
        """Longitude and latitude (WGS 84), (n, 2), of world-frame points, to 1e-9 degree; None where not known."""
        return None if self.frame is None else np.round(self.frame.to_degrees(xy_m), _DIGITS_DEG)

    def distance_m(self, xy_m: Floats) -> float:
        """From the region of interest to the nearest of some world-frame points, seen from above; inf for none."""
        low = np.asarray(self.roi.origin_m[:2])
        gaps = np.maximum(np.maximum(low - xy_m, xy_m - low - np.asarray(self.roi.size_m[:2])), 0.0)
        away = np.hypot(gaps[:, 0], gaps[:, 1])
        return float(np.min(away, initial=np.inf, where=np.isfinite(away)))

    def unknown(self, where: str, what: str, lon_lat_deg: Floats | None = None) -> InputError:
        """The error for coordinates on the Earth in a scenario that does not say where its world frame lies."""
        zone = ""
        if lon_lat_deg is not None and len(lon_lat_deg):
            zone = f" (UTM there: {utm_epsg(*map(float, np.median(lon_lat_deg, axis=0)))})"
        found = f"{what}, and nothing says where the scenario's world frame lies on the Earth"
        right = f"[crs] with epsg{zone} and offset_m in {self.where}, or a network with a <location>"
        return InputError(where, found, right)

    def _declared(self, xy: Floats, where: str, declared: str) -> CoordinateReading:
        frame, found = self.frame, parse_crs(declared, where)
        if found.is_engineering:
            return WORLD_READING
        if frame is not None:
            return CoordinateReading(found.name, lambda points: frame.from_crs(points, declared), where)
        if found.is_projected and all(axis.unit_name == "metre" for axis in found.axis_info[:2]):
            return CoordinateReading(f"{found.name}, which the world frame would have to be")
        raise self.unknown(where, f"is in {found.name}", xy if found.is_geographic else None)

    def _infer(self, xy: Floats, where: str, expected: str) -> CoordinateReading:
        """The reading of coordinates that nobody has declared."""
        if not _may_be_degrees(xy):
            if (odd := _first_non_degrees(xy)) is not None:
                found = f"{_format_span(xy)} are no metres (most lie within {_CLOSE_M:g} m of the next),"
                found += f" and ({odd[0]:.10g}, {odd[1]:.10g}) is no longitude and latitude beside the others"
                raise InputError(where, found, expected)
            return WORLD_READING
        if self.frame is not None:
            believed_m = COUNTRY_M if _is_single_position(xy) else NEAR_M
            if self.distance_m(self.frame.from_degrees(xy)) <= believed_m:
                return CoordinateReading("degrees", self.frame.from_degrees, where)
        if _is_collapsed(xy) or self.distance_m(xy) > NEAR_M:
            if self.frame is None:
                raise self.unknown(where, f"{_format_span(xy)} look like longitude and latitude", xy)
            raise self._neither(xy, where, expected)
        return WORLD_READING

    def _check_near(self, reading: CoordinateReading, xy: Floats, where: str, expected: str) -> None:
        if len(xy) and self.distance_m(reading.to_world(xy)) > FAR_M:
            raise self._neither(xy, where, expected, reading)

    def _neither(self, xy: Floats, where: str, expected: str, taken: CoordinateReading | None = None) -> InputError:
        """The error for coordinates that lie far from everything; names what they would lie near as."""
        away_m = {words: self.distance_m(points) for words, points in self._others(xy)}
        told = [f"{_format_distance(away)} from it as {words}" for words, away in away_m.items()]
        found = f"{_format_span(xy)} lie far from the region of interest"
        if taken is not None:
            found += f" ({_format_distance(self.distance_m(taken.to_world(xy)))}) as {taken.description}"
        nearest = min(away_m, key=lambda words: away_m[words], default="")
        cure = f"they would lie beside it as {nearest}; " if away_m.get(nearest, np.inf) <= FAR_M else ""
        return InputError(where, f"{found} ({', '.join(told)})" if taken is None else found, cure + expected)

    def _others(self, xy: Floats) -> Iterator[tuple[str, Floats]]:
        """What else coordinates may be."""
        if not _is_collapsed(xy):
            yield WORLD, xy
        if self.frame is not None:
            if (np.abs(xy) <= (180.0, 90.0)).all():
                yield "degrees", self.frame.from_degrees(xy)
            if (np.abs(xy) <= (90.0, 180.0)).all():
                yield "latitude and longitude, in the wrong order", self.frame.from_degrees(xy[:, ::-1])
            name = self.frame.projection if self.frame.projection.startswith("EPSG") else "the network's projection"
            yield f"eastings and northings of {name}", xy + np.asarray(self.frame.offset_m)


def declared_crs(document: Mapping[str, Any], where: str) -> str | None:
    """What GeoJSON declares in its member ``crs`` (GeoJSON 2008; RFC 7946 has none): a name, :data:`WORLD` for null,
    None where there is no such member. InputError at ``where`` where it names nothing that PROJ knows.
    """
    match document.get("crs", ""):
        case "":
            return None
        case None:
            return WORLD
        case {"properties": {"name": str(name)}}:
            parse_crs(name, f"{where}: crs")
            return name
        case other:
            right = '{"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}, or null'
            raise InputError(f"{where}: crs", repr(other)[:120], right)


def geojson_coordinates(features: Iterable[Any]) -> Floats:
    """All pairs of coordinates in GeoJSON features, in their order, (n, 2); what is no number is left to its reader."""
    pairs, waiting = list[tuple[float, float]](), list(features)[::-1]
    while waiting:
        match waiting.pop():
            case dict(item):
                waiting += [item[key] for key in ("geometry", "geometries", "coordinates") if key in item]
            case [int() | float() as x, int() | float() as y, *_] if abs(x) <= _NUMBER_M and abs(y) <= _NUMBER_M:
                pairs.append((float(x), float(y)))
            case list(item):
                waiting += item[::-1]
    return np.array(pairs, dtype=np.float64).reshape(-1, 2)


def _may_be_degrees(xy: Floats) -> bool:
    """Whether numbers can be longitude and latitude of things in one place."""
    return bool((np.abs(xy) <= (180.0, 90.0)).all() and np.ptp(xy, axis=0).max() <= _SPREAD_DEG)


def _is_single_position(xy: Floats) -> bool:
    """Whether numbers, as metres, would all be at one place: degrees of things some metres apart differ by 1e-5 or
    1e-4."""
    if np.ptp(xy, axis=0).max() >= _SMALL_M:
        return False
    return _is_close_together(xy) or not np.diff(xy, axis=0).any()


def _is_close_together(xy: Floats) -> bool:
    """Whether most numbers, as metres, are within a centimetre of the next; not where all are the same."""
    steps = np.hypot(*np.diff(xy, axis=0).T)
    steps = steps[steps > 0]
    return bool(len(steps)) and bool(np.median(steps) < _CLOSE_M)


def _is_collapsed(xy: Floats) -> bool:
    """Whether numbers, as metres, would all be at one place although they differ."""
    return _is_single_position(xy) and bool(np.ptp(xy, axis=0).max() > 0)


def _first_non_degrees(xy: Floats) -> Floats | None:
    """Of numbers that differ as degrees of buildings do, but cannot all be degrees of one place, one that is none."""
    middle = np.median(xy, axis=0)
    if not _is_close_together(xy) or (np.abs(middle) > (540.0, 90.0)).any():
        return None
    beyond = (np.abs(xy) > (180.0, 90.0)).any(axis=1)
    found: Floats = xy[np.argmax(beyond if beyond.any() else np.abs(xy - middle).max(axis=1))]
    return found


def _format_span(xy: Floats) -> str:
    """What a message says of coordinates."""
    (x0, y0), (x1, y1) = xy.min(axis=0), xy.max(axis=0)
    if len(xy) == 1:
        return f"its coordinates ({x0:.10g}, {y0:.10g})"
    return f"its coordinates ({x0:.10g} to {x1:.10g}, {y0:.10g} to {y1:.10g})"


def _format_distance(distance_m: float) -> str:
    if not np.isfinite(distance_m):
        return "nowhere near"
    return f"{distance_m / 1000:,.0f} km" if distance_m >= 10_000 else f"{distance_m:.0f} m"
