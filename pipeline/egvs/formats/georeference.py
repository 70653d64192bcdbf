"""WGS 84, map projections, and the world frame: where a scenario lies on the Earth, and in which system a file is.

The world frame is right-handed, x east, y north, in metres. Its position on the Earth is stated as in SUMO's
``<location>``:

    (x, y) = projection(longitude, latitude) + offset

Every pair is in the order x, y: easting before northing, longitude before latitude, whatever the order of the axes in a
coordinate reference system. Degrees are WGS 84 unless a file declares another datum. PROJ (https://proj.org) does the
work, through pyproj; beside this module, only :mod:`egvs.formats.geotiff_keys` imports it.

The coordinates of a file are metres of the world frame, degrees, or in the system that the file declares. Nothing is
inferred from the numbers. They only reveal mistakes: a file is rejected when it lies far from the region of interest,
or when numbers declared as metres can only be degrees. The message says in which system they would lie near the region.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, Roi

if TYPE_CHECKING:
    from pyproj import CRS, Transformer


WGS84 = "OGC:CRS84"
"""Longitude and latitude in degrees, in this order."""

MAX_SCALE_ERROR = 0.01
"""Largest error of lengths in a projection in which beams can be measured: UTM stays below 0.0004 in its zone; Web
Mercator, the projection of map tiles, reaches 0.6 at 51 degrees."""

LOCAL_METRES = 'LOCAL_CS["World frame of the scenario",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
"""Metres to the east and north of an unknown origin, as WKT."""

_SAME_POSITION_M = 0.001
_SYSTEM_HINT = 'Use a name that PROJ knows, for example "EPSG:25832".'
_MAX_SHOWN = 100
_HEIGHT_WORDS = re.compile(r"\+(?:geoidgrids|geoid_crs|vunits|vto_meter)=[^\s\"']*\s*")
"""What a PROJ string says of heights, also inside WKT: PROJ cannot convert x and y where it lacks the named grid."""
_GRID_WORDS = re.compile(r"\+nadgrids=[^\s\"']+\s*")


@dataclass(frozen=True)
class WorldFrame:
    """Position of a world frame on the Earth.

    Attributes
    ----------
    projection
        A projected coordinate reference system in metres to the east and north, in any form that PROJ knows:
        ``"EPSG:25832"``, a PROJ string, WKT. :meth:`from_projection` checks it.
    offset_m
        Added to easting and northing to get x and y; SUMO's ``netOffset``.
    """

    projection: str
    offset_m: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def from_projection(cls, projection: str, offset_m: tuple[float, float], where: str) -> WorldFrame:
        """Return a frame in a checked projection; InputError unless it counts metres to the east and north."""
        crs = parse_crs(projection, where)
        units = [axis.unit_name for axis in crs.axis_info[:2]]
        directions = [axis.direction for axis in crs.axis_info[:2]]
        if crs.is_projected and units == ["metre", "metre"] and sorted(directions) == ["east", "north"]:
            return cls(projection, offset_m)
        problem = "is not a map projection"
        if crs.is_projected:
            problem = f"has axes in {units[0]} to the {' and '.join(directions)}"
        hint = "Use a projection in metres to the east and north, for example epsg = 32632 (UTM zone 32 north)."
        raise InputError(where, f"{_shorten(projection)} ({crs.name}) {problem}", hint)

    def from_lon_lat(self, lon_lat_deg: FloatArray) -> FloatArray:
        """Convert longitude and latitude (n, 2) in degrees to world-frame x, y in metres, (n, 2) float64.

        Not finite where the projection is not defined.
        """
        return self.from_crs(lon_lat_deg, WGS84)

    def to_degrees(self, xy_m: FloatArray) -> FloatArray:
        """Convert world-frame x, y (n, 2) in metres to longitude and latitude in degrees (WGS 84), (n, 2) float64.

        The inverse of :meth:`from_lon_lat` to a micrometre. A change of datum alone is inverted to some millimetres
        only, so its error is measured and subtracted.
        """
        eastings = np.subtract(xy_m, self.offset_m, dtype=np.float64)
        approximate = _transform(WGS84, self.projection, eastings, "INVERSE")
        error = eastings - _transform(WGS84, self.projection, approximate)
        return _transform(WGS84, self.projection, eastings + np.nan_to_num(error, posinf=0.0, neginf=0.0), "INVERSE")

    def from_crs(self, xy: FloatArray, crs: str) -> FloatArray:
        """Convert coordinates (n, 2) of another system, in its units, to world-frame x, y in metres, (n, 2) float64."""
        eastings = _transform(crs, self.projection, np.asarray(xy, dtype=np.float64))
        return np.add(eastings, self.offset_m)

    def to_crs(self, xy_m: FloatArray, crs: str) -> FloatArray:
        """Convert world-frame x, y (n, 2) in metres to coordinates of another system, in its units, (n, 2) float64.

        The inverse of :meth:`from_crs`, to some millimetres where the datum changes.
        """
        eastings = np.subtract(xy_m, self.offset_m, dtype=np.float64)
        return _transform(self.projection, crs, eastings)

    def scale_factor(self, xy_m: tuple[float, float]) -> float:
        """Return how many times too long the projection draws a short line at x, y (1.0: true length)."""
        from pyproj import Proj

        lon_deg, lat_deg = self.to_degrees(np.array([xy_m]))[0]
        if not math.isfinite(lon_deg + lat_deg):
            return math.nan
        factors = Proj(parse_crs(self.projection, self.projection)).get_factors(lon_deg, lat_deg)
        return math.sqrt(abs(factors.areal_scale))


def parse_crs(crs: Any, where: str) -> CRS:
    """Return a coordinate reference system given in any form that PROJ knows.

    Only the horizontal part of a system with heights is returned: x and y can then be converted although PROJ lacks
    the model of the geoid.

    Parameters
    ----------
    crs
        The system.
    where
        The file or key, for messages.

    Raises
    ------
    InputError
        When the system is unknown, or has no x and y that can be converted: systems that are geocentric or of heights
        alone, of another planet, or that need a grid that is not installed. Local (engineering) systems are returned.
    """
    try:
        return _horizontal_crs(crs) if isinstance(crs, str) else _horizontal_part(crs)
    except InputError as error:
        raise InputError(where, error.problem, error.hint) from None


@cache
def _horizontal_crs(crs: str) -> CRS:
    return _horizontal_part(_HEIGHT_WORDS.sub("", crs))


def _horizontal_part(crs: Any) -> CRS:
    """Return the horizontal part of a system; InputError, without a location, where parse_crs raises one."""
    from pyproj.exceptions import ProjError

    parsed = _parse_complete(crs)
    horizontal = parsed.sub_crs_list[0] if parsed.is_compound else parsed
    if horizontal.is_engineering:
        return horizontal
    if horizontal.is_geocentric or horizontal.is_vertical:
        kind = "geocentric" if horizontal.is_geocentric else "a system of heights"
        hint = "Convert the coordinates to a map projection in metres, for example UTM."
        problem = f"expected a map projection or longitude and latitude, but {_shown_name(parsed)!r} is {kind}"
        raise InputError("", problem, hint)
    try:
        _make_transformer(WGS84, horizontal)
    except ProjError as error:
        raise _no_conversion_error(horizontal, error) from None
    return horizontal


def _parse_complete(crs: Any) -> CRS:
    """Return a system with its heights; InputError, without a location, when it is unknown."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # +init=epsg:25832 is an old form of EPSG:25832
            return CRS.from_user_input(crs)
    except (CRSError, TypeError, ValueError):
        raise InputError("", f"unknown coordinate reference system {_shorten(str(crs))!r}", _SYSTEM_HINT) from None


def _shown_name(crs: CRS) -> str:
    return _shorten(crs.name if crs.name != "unknown" else crs.srs)


def _shorten(text: str) -> str:
    return f"{text[:_MAX_SHOWN]}..." if len(text) > _MAX_SHOWN else text


def _no_conversion_error(crs: CRS, error: Exception) -> InputError:
    """Return the error, without a location, for a system whose coordinates PROJ cannot convert."""
    problem = f"PROJ cannot convert coordinates from or to {_shown_name(crs)!r}"
    grids = re.findall(r"\+nadgrids=([^\s\"']+)", crs.srs) or re.findall(
        r'PARAMETERFILE\["[^"]*","([^"]+)"', crs.to_wkt()
    )
    if grids:
        problem += f": the grid {grids[0]} is not installed"
        return InputError("", problem, "Name the system by its EPSG code, or install the grid with projsync.")
    reason = re.sub(r".*Internal Proj Error: (?:\w+: )*", "", str(error)).partition(". ")[0]
    reason = reason.removesuffix(")" if reason.count(")") > reason.count("(") else "")
    return InputError("", f"{problem} ({reason})", _SYSTEM_HINT)


def proj_string(crs: str, where: str) -> str:
    """Return a coordinate reference system as a PROJ string, which is all that SUMO reads; InputError if unknown."""
    parsed = parse_crs(crs, where)
    if crs.strip().startswith("+proj="):
        text = _HEIGHT_WORDS.sub("", crs).strip()
        return text if _has_grids(text) else _GRID_WORDS.sub("", text).strip()
    with warnings.catch_warnings():
        # a PROJ string cannot say everything, such as the names of axes
        warnings.simplefilter("ignore", UserWarning)
        return str(parsed.to_proj4())


def _has_grids(proj_string: str) -> bool:
    """Return whether PROJ has the grids that a string names; parse_crs rejects a system that needs those it lacks."""
    from pyproj import Proj
    from pyproj.exceptions import ProjError

    if _GRID_WORDS.search(proj_string) is None:
        return True
    try:
        Proj(proj_string)
    except ProjError:
        return False
    return True


@dataclass(frozen=True)
class HeightUnit:
    """The unit of the heights of a system.

    Attributes
    ----------
    metres
        Length of a height of 1; negative where the vertical axis points down.
    name
        The unit as PROJ calls it: ``"metre"``, ``"US survey foot"``.
    source
        What states the unit: the name of the vertical system, or in words.
    """

    metres: float
    name: str
    source: str


def height_unit(crs: Any, where: str) -> HeightUnit:
    """Return the unit of the heights of a system.

    Without a vertical axis, heights have the unit of a map projection's other axes, and metres beside degrees.
    """
    parse_crs(crs, where)
    parsed = _parse_complete(crs)
    for axis in parsed.axis_info:
        if axis.direction in ("up", "down"):
            factor = float(axis.unit_conversion_factor)
            name = parsed.sub_crs_list[-1].name if parsed.is_compound else parsed.name
            source = "its vertical system" if name == "unknown" else name
            return HeightUnit(factor if axis.direction == "up" else -factor, str(axis.unit_name), source)
    if parsed.is_geographic or not parsed.axis_info:
        return HeightUnit(1.0, "metre", "assumed: the file declares no vertical system")
    axis = parsed.axis_info[0]
    source = "the unit of x and y: the file declares no vertical system"
    return HeightUnit(float(axis.unit_conversion_factor), str(axis.unit_name), source)


def height_unit_m(crs: Any, where: str) -> float:
    """Return the length in metres of a height of 1 in a system, as :func:`height_unit`."""
    return height_unit(crs, where).metres


def is_north_first(crs: Any, where: str) -> bool:
    """Return whether the first axis of a system points north, as in EPSG:4326 (latitude, longitude) and EPSG:6677."""
    directions = [axis.direction for axis in parse_crs(crs, where).axis_info[:2]]
    return directions == ["north", "east"]


def crs_name(frame: WorldFrame, at_m: tuple[float, float]) -> str:
    """Return the projection of a world frame as other programs show it: an EPSG code if there is one, else WKT.

    The EPSG code must give the same eastings and northings to a millimetre at ``at_m`` (world frame, metres).
    """
    crs = parse_crs(frame.projection, frame.projection)
    code = crs.to_epsg()
    if code is not None:
        eastings = np.subtract([at_m], frame.offset_m, dtype=np.float64)
        same = _transform(frame.projection, f"EPSG:{code}", eastings)
        if np.abs(same - eastings).max() <= _SAME_POSITION_M:
            return f"EPSG:{code}"
    return str(crs.to_wkt())


def utm_epsg(lon_deg: float, lat_deg: float) -> int:
    """Return the EPSG code of the UTM zone (WGS 84) of a location."""
    zone = min(max(math.floor((lon_deg + 180.0) / 6.0) + 1, 1), 60)
    return (32600 if lat_deg >= 0 else 32700) + zone


@cache
def _transformer(source: str, target: str) -> Transformer:
    from pyproj.exceptions import ProjError

    start, end = parse_crs(source, source), parse_crs(target, target)
    try:
        return _make_transformer(start, end)
    except ProjError as error:
        failed = _no_conversion_error(start, error)
        raise InputError(f"{start.name} to {end.name}", failed.problem, failed.hint) from None


def _make_transformer(source: Any, target: Any) -> Transformer:
    from pyproj import Transformer
    from pyproj.network import set_network_enabled  # type: ignore[attr-defined]

    set_network_enabled(False)  # PROJ would download grids, if the environment says so
    return Transformer.from_crs(source, target, always_xy=True)


def _transform(source: str, target: str, xy: FloatArray, direction: str = "FORWARD") -> FloatArray:
    from pyproj.enums import TransformDirection

    x, y = _transformer(source, target).transform(xy[:, 0], xy[:, 1], direction=TransformDirection(direction))
    return np.column_stack([x, y])


WORLD = "metres of the world frame"
"""The declaration of a file in the world frame: ``"crs": null``, or a format or columns defined to be in it."""

FAR_M, COUNTRY_M = 10_000.0, 100_000.0
"""Distances from the region of interest: beyond the first, nothing matters to a scenario; beyond the second, numbers
are no degrees of its surroundings."""

_CLOSE_M, _SMALL_M, _SPREAD_DEG, _NUMBER_M = 0.01, 1.0, 5.0, 1e9
_DIGITS_M, _DIGITS_DEG = 6, 9  # a micrometre, 0.1 mm: the last bits of sines differ between machines
_DECLARE_HINT = (
    'Set "crs" in the file to null for metres of the world frame, or to {"type": "name", "properties": {"name": N}}'
    ' with N = "urn:ogc:def:crs:OGC:1.3:CRS84" for degrees, "urn:ogc:def:crs:EPSG::25832" for a projection.'
)


@dataclass(frozen=True)
class CoordinateReading:
    """The system of a file's coordinates, in words, and their conversion to the world frame (None: no conversion)."""

    description: str
    convert: Callable[[FloatArray], FloatArray] | None = None
    where: str = ""

    def to_world(self, xy: FloatArray) -> FloatArray:
        """Convert coordinates (n, 2) to world-frame x, y in metres, (n, 2) float64; InputError where undefined."""
        if self.convert is None:
            return xy
        with np.errstate(over="ignore"):  # infinite ones are rejected below
            xy_m = np.round(self.convert(xy), _DIGITS_M) + 0.0  # no -0
        for i in np.flatnonzero(~np.isfinite(xy_m).all(axis=1)):
            problem = f"({xy[i, 0]:.10g}, {xy[i, 1]:.10g}) cannot be converted from {self.description}"
            raise InputError(self.where, problem, "Check the coordinates and the scenario's projection.")
        return xy_m


WORLD_READING = CoordinateReading(WORLD)
"""The reading of coordinates that are in the world frame already."""


@dataclass(frozen=True)
class Georeference:
    """Position of a scenario's world frame on the Earth, if it is known, and the region of interest.

    Attributes
    ----------
    frame
        None where neither the scenario nor its network states it.
    roi
        The region of interest.
    where
        The scenario's file, for messages.
    """

    frame: WorldFrame | None
    roi: Roi
    where: str

    def read_coordinates(
        self, xy: FloatArray, where: str, declared: str, hint: str = _DECLARE_HINT
    ) -> CoordinateReading:
        """Return how to convert a file's coordinates to the world frame.

        Parameters
        ----------
        xy
            The coordinates (n, 2), or enough of them to check; finite.
        where
            The file, for messages.
        declared
            The coordinate reference system that the file declares, or :data:`WORLD`.
        hint
            How such a file declares its system, for messages.

        Raises
        ------
        InputError
            When the system is unknown, when the position of the world frame is needed and unknown, or when the
            coordinates lie far from the region of interest.
        """
        if declared == WORLD:
            self.check_metres(xy, where, hint)
            # Metres of real objects are not all within a centimetre of each other.
            if self.frame is None and len(xy) and _may_be_degrees(xy) and 0 < np.ptp(xy, axis=0).max() < _CLOSE_M:
                raise self.unknown_frame_error(where, f"coordinates {_format_span(xy)} look like degrees", xy)
            return WORLD_READING
        reading = self._read_declared(xy, where, declared)
        self._check_near(reading, xy, where, hint)
        return reading

    def read_framed_coordinates(
        self, frame: WorldFrame | None, xy_m: FloatArray, where: str, hint: str
    ) -> CoordinateReading:
        """Return how to convert metres of a file's own world frame, or of this one if the file states none (None)."""
        world_frame = self.frame
        if frame is None or world_frame is None or frame == world_frame:
            return self.read_coordinates(xy_m, where, WORLD, hint)
        reading = CoordinateReading(
            "metres of its own <location>", lambda xy: world_frame.from_lon_lat(frame.to_degrees(xy)), where
        )
        self._check_near(reading, xy_m, where, hint)
        return reading

    def check_metres(self, xy_m: FloatArray, where: str, hint: str) -> None:
        """Raise an InputError when coordinates that should be world-frame metres are degrees, or lie far away."""
        if not len(xy_m):
            return
        if self.frame is not None and look_like_degrees(xy_m):
            distance_m = self.distance_m(self.frame.from_lon_lat(xy_m))
            if distance_m <= COUNTRY_M:
                problem = (
                    f"expected metres of the world frame, got longitude and latitude: coordinates"
                    f" {_format_span(xy_m)}, as degrees {format_distance(distance_m)} from the region of interest"
                )
                raise InputError(where, problem, hint)
        self._check_near(WORLD_READING, xy_m, where, hint)

    def lon_lat_deg(self, xy_m: FloatArray) -> FloatArray | None:
        """Return longitude and latitude (WGS 84), (n, 2), of world-frame points, to 1e-9 degree; None if unknown."""
        return None if self.frame is None else np.round(self.frame.to_degrees(xy_m), _DIGITS_DEG)

    def distance_m(self, xy_m: FloatArray) -> float:
        """Return the horizontal distance from the region of interest to the nearest of some points; inf for none."""
        low = np.asarray(self.roi.origin_m[:2])
        gaps = np.maximum(np.maximum(low - xy_m, xy_m - low - np.asarray(self.roi.size_m[:2])), 0.0)
        distances = np.hypot(gaps[:, 0], gaps[:, 1])
        return float(np.min(distances, initial=np.inf, where=np.isfinite(distances)))

    def unknown_frame_error(self, where: str, what: str, lon_lat_deg: FloatArray | None = None) -> InputError:
        """Return the error for coordinates on the Earth in a scenario that does not state its position on it."""
        zone = ""
        if lon_lat_deg is not None and len(lon_lat_deg):
            zone = f" (UTM there: {utm_epsg(*map(float, np.median(lon_lat_deg, axis=0)))})"
        problem = f"{what}, but the position of the world frame on the Earth is unknown"
        hint = f"Set epsg{zone} and offset_m under [crs] in {self.where}, or use a network with a <location>."
        return InputError(where, problem, hint)

    def _read_declared(self, xy: FloatArray, where: str, declared: str) -> CoordinateReading:
        frame = self.frame
        crs = parse_crs(declared, where)
        if crs.is_engineering:
            unit = crs.axis_info[0] if crs.axis_info else None
            if unit is None or unit.unit_conversion_factor in (0.0, 1.0):
                return WORLD_READING
            return CoordinateReading(f"{unit.unit_name} of {crs.name}", lambda xy: xy * unit.unit_conversion_factor)
        if frame is not None:
            return CoordinateReading(crs.name, lambda points: frame.from_crs(points, declared), where)
        if crs.is_projected and all(axis.unit_name == "metre" for axis in crs.axis_info[:2]):
            return CoordinateReading(f"{crs.name}, which must then be the world frame")
        raise self.unknown_frame_error(where, f"the file is in {crs.name}", xy if crs.is_geographic else None)

    def _check_near(self, reading: CoordinateReading, xy: FloatArray, where: str, hint: str) -> None:
        """Raise an InputError when coordinates lie far from the region; it names the system in which they do not."""
        if not len(xy):
            return
        distance_m = self.distance_m(reading.to_world(xy))
        if distance_m <= FAR_M:
            return
        problem = (
            f"coordinates {_format_span(xy)} are {format_distance(distance_m)} from the region of interest,"
            f" read as {reading.description}"
        )
        distances_m = {words: self.distance_m(points) for words, points in self._alternatives(xy)}
        nearest = min(distances_m, key=lambda words: distances_m[words], default="")
        if distances_m.get(nearest, np.inf) <= FAR_M:
            hint = f"Read as {nearest}, they would be near it. {hint}"
        raise InputError(where, problem, hint)

    def _alternatives(self, xy: FloatArray) -> Iterator[tuple[str, FloatArray]]:
        """Yield other systems that coordinates could be in, in words, with the points in the world frame."""
        if not _is_collapsed(xy):
            yield WORLD, xy
        if self.frame is None:
            return
        if (np.abs(xy) <= (180.0, 90.0)).all():
            yield "degrees", self.frame.from_lon_lat(xy)
        if (np.abs(xy) <= (90.0, 180.0)).all():
            yield "latitude and longitude, in the wrong order", self.frame.from_lon_lat(xy[:, ::-1])
        name = self.frame.projection if self.frame.projection.startswith("EPSG") else "the network's projection"
        yield f"eastings and northings of {name}", xy + np.asarray(self.frame.offset_m)


def declared_crs(document: Mapping[str, Any], where: str) -> str:
    """Return the system that GeoJSON declares in its member ``crs`` (GeoJSON 2008): a name, or :data:`WORLD` for null.

    RFC 7946 has no such member and allows degrees only, while files for SUMO are in metres without saying so. So a file
    without the member is rejected.

    Raises
    ------
    InputError
        When the member is missing, or names nothing that PROJ knows.
    """
    match document.get("crs", ""):
        case "":
            raise InputError(where, 'the file does not declare its coordinate system: no member "crs"', _DECLARE_HINT)
        case None:
            return WORLD
        case {"properties": {"name": str(name)}}:
            parse_crs(name, f"{where}: crs")
            return name
        case other:
            raise InputError(f"{where}: crs", f"expected a named system or null, got {other!r}"[:160], _DECLARE_HINT)


def geojson_coordinates(features: Iterable[Any]) -> FloatArray:
    """Return all pairs of coordinates in GeoJSON features in their order, (n, 2); other values are skipped."""
    pairs, stack = list[tuple[float, float]](), list(features)[::-1]
    while stack:
        match stack.pop():
            case dict(item):
                stack += [item[key] for key in ("geometry", "geometries", "coordinates") if key in item]
            case [int() | float() as x, int() | float() as y, *_] if abs(x) <= _NUMBER_M and abs(y) <= _NUMBER_M:
                pairs.append((float(x), float(y)))
            case list(item):
                stack += item[::-1]
    return np.array(pairs, dtype=np.float64).reshape(-1, 2)


def look_like_degrees(xy: FloatArray) -> bool:
    """Return whether numbers (n, 2) can be degrees of one area, while as metres they would all be at one point."""
    return _may_be_degrees(xy) and _is_collapsed(xy)


def _may_be_degrees(xy: FloatArray) -> bool:
    """Whether numbers can be longitude and latitude of one area."""
    return bool((np.abs(xy) <= (180.0, 90.0)).all() and np.ptp(xy, axis=0).max() <= _SPREAD_DEG)


def _is_collapsed(xy: FloatArray) -> bool:
    """Whether numbers differ, but as metres would all be at one point: most within a centimetre of the next.

    Degrees of objects some metres apart differ by 1e-5 to 1e-4.
    """
    if not 0 < np.ptp(xy, axis=0).max() < _SMALL_M:
        return False
    steps = np.hypot(*np.diff(xy, axis=0).T)
    return bool(np.median(steps[steps > 0]) < _CLOSE_M)


def _format_span(xy: FloatArray) -> str:
    (x0, y0), (x1, y1) = xy.min(axis=0), xy.max(axis=0)
    if len(xy) == 1:
        return f"({x0:.10g}, {y0:.10g})"
    return f"({x0:.10g} to {x1:.10g}, {y0:.10g} to {y1:.10g})"


def format_distance(distance_m: float) -> str:
    """Return a distance for a message: kilometres from 10 km on, else metres."""
    if not np.isfinite(distance_m):
        return "infinitely far"
    return f"{distance_m / 1000:,.0f} km" if distance_m >= 10_000 else f"{distance_m:.0f} m"
