"""Convert the points of a Lanelet2 map to metres, and state where they are on the Earth.

The world frame (x east, y north, metres) is chosen so that it agrees with other files of the map:

- ``local_x``, ``local_y`` (Autoware) are taken as they are. ``map_projector_info.yaml`` beside the map states their
  projection; without it they are metres in the 100 km square of MGRS that latitude and longitude tell.
- Otherwise latitude and longitude are projected as ``map_projector_info.yaml`` states.
- Otherwise UTM, with the south-west corner of the map near x = y = 0.
- Maps at latitude 0, longitude 0 are anonymised: a local Cartesian frame around their middle, with x = y = 0 at
  latitude 0, longitude 0.

Local Cartesian frames are tangent planes, i.e. orthographic projections of the ellipsoid (EPSG method 9840).

``map_projector_info.yaml``: Autoware, package autoware_map_projection_loader.
MGRS: NGA.STND.0037, The Universal Grids and the Transverse Mercator and Polar Stereographic Map Projections.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.maps.formats.lanelet2 import LaneletMap, parse_number
from egvs.formats.georeference import WorldFrame, utm_epsg

PROJECTOR_FILE = "map_projector_info.yaml"
PROJECTORS = ("Local", "LocalCartesian", "LocalCartesianUTM", "MGRS", "TransverseMercator")
"""Values of ``projector_type``."""

MAX_EXTENT_M = 100_000.0
"""No map reaches farther from its middle: a point that does has a wrong coordinate."""

_ANONYMOUS_DEG = 0.05
_SAME_POSITION_M = 1.0
_SQUARE_M = 100_000.0
_ROWS_M = 20 * _SQUARE_M
_COLUMN_LETTERS = ("STUVWXYZ", "ABCDEFGH", "JKLMNPQR")  # by zone modulo 3
_ROW_LETTERS = "ABCDEFGHJKLMNPQRSTUV"
_BAND_LETTERS = "CDEFGHJKLMNPQRSTUVWX"
_MGRS = re.compile(r"(\d{1,2})([C-HJ-NP-X])([A-HJ-NP-Z])([A-HJ-NP-V])")
_PAIR = re.compile(r"""(\s*)([A-Za-z_]+)\s*:\s*(?:"([^"]*)"|'([^']*)'|([^#"']*?))\s*(?:\s#.*)?""")
_FILE_HINT = f"Correct {PROJECTOR_FILE}, or remove it if it belongs to another map."


@dataclass(frozen=True)
class ProjectedPoints:
    """The points of a map in metres.

    Attributes
    ----------
    xyz_m
        (3,) float64 by identifier: x, y in the world frame, z as in the map, or 0.
    frame
        Position of the world frame on the Earth; None if the map does not tell.
    has_heights
        Whether z is from the map.
    notes
        What was assumed, in sentences.
    """

    xyz_m: dict[int, FloatArray]
    frame: WorldFrame | None
    has_heights: bool
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Projector:
    """The content of ``map_projector_info.yaml``.

    Attributes
    ----------
    kind
        One of :data:`PROJECTORS`.
    frame
        The frame of the local coordinates; None for ``Local``.
    """

    kind: str
    frame: WorldFrame | None


def project_points(lanelet_map: LaneletMap, path: Path) -> ProjectedPoints:
    """Convert the points of a map to metres.

    Parameters
    ----------
    lanelet_map
        The map.
    path
        Its file, for ``map_projector_info.yaml`` beside it and for messages.

    Raises
    ------
    InputError
        When a point has no coordinates or no height that it needs, when it lies far from all others, or when
        ``map_projector_info.yaml`` is not valid or contradicts the map. The message names the point.
    """
    projector_file = path.parent / PROJECTOR_FILE
    projector = read_projector(projector_file) if projector_file.is_file() else None
    used = _used_points(lanelet_map)
    notes: list[str] = []
    if any(lanelet_map.points[i].local_m is not None for i in used):
        xy_m, frame = _local_points(lanelet_map, used, path, projector, notes)
    else:
        xy_m, frame = _geographic_points(lanelet_map, used, path, projector, notes)
    _check_extent(xy_m, used, path)
    z_m, has_heights = _heights_m(lanelet_map, used, path, notes)
    xyz_m = dict(zip(used, np.column_stack([xy_m, z_m]), strict=True))
    return ProjectedPoints(xyz_m, frame, has_heights, tuple(notes))


def read_projector(path: Path) -> Projector:
    """Read a ``map_projector_info.yaml``; InputError when it is not valid."""
    values = _read_flat_yaml(path)
    kind = values.get("projector_type", "")
    if kind not in PROJECTORS:
        problem = f"expected one of {', '.join(PROJECTORS)}, got {kind!r}"
        raise InputError(f"{path}: projector_type", problem, _FILE_HINT)
    if kind == "Local":
        return Projector(kind, None)
    if kind == "MGRS":
        return Projector(kind, mgrs_frame(values.get("mgrs_grid", ""), f"{path}: mgrs_grid"))

    lat_deg = parse_number(f"{path}: map_origin.latitude", values.get("map_origin.latitude"), 90.0, "degrees")
    lon_deg = parse_number(f"{path}: map_origin.longitude", values.get("map_origin.longitude"), 180.0, "degrees")
    if kind == "LocalCartesian":
        return Projector(kind, local_cartesian_frame(lat_deg, lon_deg))
    if kind == "LocalCartesianUTM":
        return Projector(kind, _at_origin(_utm(lat_deg, lon_deg), lat_deg, lon_deg))
    scale = parse_number(f"{path}: scale_factor", values.get("scale_factor", "0.9996"), 2.0, "a scale")
    if scale <= 0.5:
        raise InputError(f"{path}: scale_factor", f"expected a scale near 1, got {scale:g}", _FILE_HINT)
    mercator = f"+proj=tmerc +lat_0=0 +lon_0={lon_deg!r} +k={scale!r} +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"
    return Projector(kind, _at_origin(mercator, lat_deg, lon_deg))


def mgrs_frame(square: str, where: str) -> WorldFrame:
    """Return the frame whose origin is the south-west corner of a 100 km square of MGRS, in UTM.

    >>> mgrs_frame("54SUE", "example").offset_m
    (-300000.0, -3900000.0)
    """
    match = _MGRS.fullmatch(square.strip().upper())
    hint = "Give zone, band and square, for example 54SUE."
    if match is None or not 1 <= int(match[1]) <= 60:
        raise InputError(where, f"expected a 100 km square of MGRS, got {square!r}", hint)
    zone, band, column, row = int(match[1]), match[2], match[3], match[4]
    columns = _COLUMN_LETTERS[zone % 3]
    if column not in columns:
        raise InputError(where, f"zone {zone} has no square {column}{row}", hint)

    easting_m = (columns.index(column) + 1) * _SQUARE_M
    row_of_zero = 0 if zone % 2 else 5
    northing_m = (_ROW_LETTERS.index(row) - row_of_zero) % len(_ROW_LETTERS) * _SQUARE_M
    south_deg = -80.0 + 8.0 * _BAND_LETTERS.index(band)
    projection = _utm(south_deg, 6.0 * zone - 183.0)
    ((_, band_start_m),) = WorldFrame(projection).from_lon_lat(np.array([[6.0 * zone - 183.0, south_deg]]))
    while northing_m < math.floor(band_start_m / _SQUARE_M) * _SQUARE_M:
        northing_m += _ROWS_M
    return WorldFrame(projection, (-easting_m, -northing_m))


def local_cartesian_frame(lat_deg: float, lon_deg: float) -> WorldFrame:
    """Return the tangent plane of WGS 84 at a position, which is its origin."""
    return WorldFrame(f"+proj=ortho +lat_0={lat_deg!r} +lon_0={lon_deg!r} +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs")


def _utm(lat_deg: float, lon_deg: float) -> str:
    """Return the projection of the UTM zone of a position."""
    code = utm_epsg(lon_deg, lat_deg)
    south = " +south" if code > 32700 else ""
    return f"+proj=utm +zone={code % 100}{south} +datum=WGS84 +units=m +no_defs"


def _at_origin(projection: str, lat_deg: float, lon_deg: float) -> WorldFrame:
    """Return a frame with its origin at a position."""
    ((east_m, north_m),) = WorldFrame(projection).from_lon_lat(np.array([[lon_deg, lat_deg]])).tolist()
    return WorldFrame(projection, (-east_m, -north_m))


def _used_points(lanelet_map: LaneletMap) -> list[int]:
    """Return the points of bounds, and of the lines of regulatory elements, sorted."""
    lines = {line for lanelet in lanelet_map.lanelets.values() for line in (lanelet.left, lanelet.right)}
    for regulation in lanelet_map.regulations.values():
        lines.update(member.id for member in regulation.members if member.type == "way")
    lines.update(line.id for line in lanelet_map.lines.values() if line.tags.get("type") == "stop_line")
    return sorted({node for line in lines for node in lanelet_map.lines[line].nodes})


def _local_points(
    lanelet_map: LaneletMap, used: list[int], path: Path, projector: Projector | None, notes: list[str]
) -> tuple[FloatArray, WorldFrame | None]:
    """Return x, y (n, 2) from local_x and local_y, and the frame that they are in."""
    xy = []
    for identifier in used:
        local_m = lanelet_map.points[identifier].local_m
        if local_m is None:
            problem = "has no local_x and local_y, but other nodes have"
            raise InputError(f"{path}: node {identifier}", problem, "Give all nodes local_x and local_y, or none.")
        xy.append(local_m)
    xy_m = np.array(xy, dtype=np.float64)
    if projector is not None:
        notes.append(f"x and y are local_x and local_y, in the projection {projector.kind} of {PROJECTOR_FILE}.")
        return xy_m, projector.frame
    frame = _square_of(lanelet_map, used, xy_m)
    if frame is None:
        notes.append(
            "x and y are local_x and local_y. Where they are on the Earth is unknown: there is no "
            f"{PROJECTOR_FILE}, and latitude and longitude do not agree with them in any 100 km square of MGRS."
        )
    else:
        notes.append(
            "x and y are local_x and local_y, metres in the 100 km square of MGRS that latitude and longitude tell "
            f"(there is no {PROJECTOR_FILE})."
        )
    return xy_m, frame


def _square_of(lanelet_map: LaneletMap, used: list[int], xy_m: FloatArray) -> WorldFrame | None:
    """Return the frame of the 100 km square in which local coordinates agree with latitude and longitude."""
    lon_lat_deg = _lon_lat_deg(lanelet_map, used)
    known = np.isfinite(lon_lat_deg).all(axis=1) & lon_lat_deg.any(axis=1)
    if not known.any():
        return None
    lon_deg, lat_deg = np.median(lon_lat_deg[known], axis=0)
    projection = _utm(lat_deg, lon_deg)
    corner_m = WorldFrame(projection).from_lon_lat(lon_lat_deg[known]) - xy_m[known]
    square_m = np.round(np.median(corner_m, axis=0) / _SQUARE_M) * _SQUARE_M
    if not np.abs(np.median(corner_m - square_m, axis=0)).max() <= _SAME_POSITION_M:
        return None
    return WorldFrame(projection, (-float(square_m[0]), -float(square_m[1])))


def _geographic_points(
    lanelet_map: LaneletMap, used: list[int], path: Path, projector: Projector | None, notes: list[str]
) -> tuple[FloatArray, WorldFrame]:
    """Return x, y (n, 2) from latitude and longitude, and their frame."""
    lon_lat_deg = _lon_lat_deg(lanelet_map, used)
    if projector is not None:
        if projector.frame is None:
            problem = "projector_type is Local, but the map's nodes have no local_x and local_y"
            raise InputError(path.parent / PROJECTOR_FILE, problem, _FILE_HINT)
        notes.append(f"Positions are projected as {PROJECTOR_FILE} states ({projector.kind}).")
        return projector.frame.from_lon_lat(lon_lat_deg), projector.frame

    lon_deg, lat_deg = (float(value) for value in np.median(lon_lat_deg, axis=0))
    if max(abs(lon_deg), abs(lat_deg)) < _ANONYMOUS_DEG:
        notes.append(
            "The map lies at latitude 0, longitude 0: its position is anonymised, so no other map fits it. x and y are "
            "metres in a local Cartesian frame around its middle, from latitude 0, longitude 0."
        )
        frame = local_cartesian_frame(round(lat_deg, 7), round(lon_deg, 7))
        ((x0_m, y0_m),) = frame.from_lon_lat(np.zeros((1, 2))).tolist()
        frame = WorldFrame(frame.projection, (-x0_m, -y0_m))
        return frame.from_lon_lat(lon_lat_deg), frame

    projection = _utm(lat_deg, lon_deg)
    eastings_m = WorldFrame(projection).from_lon_lat(lon_lat_deg)
    _check_extent(eastings_m, used, path)
    corner_m = np.floor(eastings_m.min(axis=0))
    frame = WorldFrame(projection, (-float(corner_m[0]), -float(corner_m[1])))
    return np.add(eastings_m, frame.offset_m), frame


def _lon_lat_deg(lanelet_map: LaneletMap, used: list[int]) -> FloatArray:
    points = (lanelet_map.points[i] for i in used)
    return np.array([(point.lon_deg, point.lat_deg) for point in points], dtype=np.float64)


def _check_extent(xy_m: FloatArray, used: list[int], path: Path) -> None:
    """Raise an InputError when a point lies far from all others, or all far from the origin of the projection."""
    if not np.isfinite(xy_m).all(axis=1).any():
        problem = "its points are on another side of the Earth than the origin of its projection"
        raise InputError(path, problem, f"Correct their lat and lon, or the origin in {PROJECTOR_FILE}.")
    distances_m = np.hypot(*(xy_m - np.median(xy_m[np.isfinite(xy_m).all(axis=1)], axis=0)).T)
    far = np.flatnonzero(~(distances_m <= MAX_EXTENT_M))
    if len(far):
        problem = f"the point is {distances_m[far[0]] / 1000:,.0f} km from the middle of the map"
        if not np.isfinite(distances_m[far[0]]):
            problem = "the point is on another side of the Earth than the map"
        raise InputError(f"{path}: node {used[far[0]]}", problem, "Correct its lat and lon, or local_x and local_y.")


def _heights_m(lanelet_map: LaneletMap, used: list[int], path: Path, notes: list[str]) -> tuple[FloatArray, bool]:
    """Return z (n,) and whether it is from the map."""
    heights_m = [lanelet_map.points[i].height_m for i in used]
    missing = [i for i, height_m in zip(used, heights_m, strict=True) if height_m is None]
    if not missing:
        return np.array(heights_m, dtype=np.float64), True
    if lanelet_map.is_autoware:
        problem = f"has no height (ele); {len(missing):,} of {len(used):,} nodes have none"
        raise InputError(f"{path}: node {missing[0]}", problem, "Autoware's maps state ele for every node; add it.")
    stated = len(used) - len(missing)
    notes.append(f"The ground is flat, z = 0: {stated:,} of {len(used):,} points state a height (ele).")
    return np.zeros(len(used)), False


def _read_flat_yaml(path: Path) -> dict[str, str]:
    """Read a YAML file of values and of mappings of values, as ``key`` and ``key.inner``; InputError for any other."""
    data = limits.read_bytes(path, limits.DOCUMENT)
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(path, f"is not UTF-8 text: byte {error.start}", _FILE_HINT) from None
    values: dict[str, str] = {}
    outer = ""
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#") or line.strip() == "---":
            continue
        match = _PAIR.fullmatch(line)
        if match is None:
            raise InputError(f"{path}: line {number}", f"expected KEY: VALUE, got {line.strip()!r}", _FILE_HINT)
        value = next((group for group in match.groups()[2:] if group is not None), "").strip()
        if match[1]:
            name = f"{outer}.{match[2]}"
        else:
            name = outer = match[2]
        if name in values:
            raise InputError(f"{path}: {name}", "occurs twice", _FILE_HINT)
        values[name] = value
    return values
