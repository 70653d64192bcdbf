"""Turns longitude and latitude, and the eastings and northings of any map projection, into the world frame and back.

The world frame is right-handed, x east, y north, in metres. Where it lies on the Earth is said as SUMO's ``<location>``
says it:

    (x, y) = projection(longitude, latitude) + offset

Every pair is in the order x, y: easting before northing, longitude before latitude, whatever order a coordinate
reference system names its axes in. Degrees are WGS 84's where a file says nothing else. PROJ does the work
(https://proj.org), through pyproj; nothing else in this program imports it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import InputError

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

Floats = NDArray[np.float64]

WGS84 = "OGC:CRS84"
"""Longitude and latitude in degrees, in this order."""

STRETCH_MOST = 0.01
"""A projection that makes lengths longer or shorter by more than this is none to measure beams in: UTM keeps within
0.0004 in its zone; the Web Mercator projection of map tiles stretches by 0.6 at 51 degrees."""

LOCAL_METRES = 'LOCAL_CS["World frame of the scenario",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
"""Metres to the east and north of a zero that lies nobody knows where."""

_SAME_M = 0.001


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
    def of(cls, projection: str, offset_m: tuple[float, float], place: str) -> WorldFrame:
        """A frame in a projection that was checked; InputError at ``place`` where it is unknown, or not in metres to
        the east and north."""
        crs = parsed(projection, place)
        right = "a projected system in metres, for example epsg = 32632 (UTM zone 32 north)"
        if not crs.is_projected:
            raise InputError(place, f"{projection} ({crs.name}) is no map projection", right)
        if any(axis.unit_name != "metre" for axis in crs.axis_info[:2]):
            raise InputError(place, f"{projection} ({crs.name}) counts in {crs.axis_info[0].unit_name}", right)
        if {axis.direction for axis in crs.axis_info[:2]} != {"east", "north"}:
            ways = " and ".join(axis.direction for axis in crs.axis_info[:2])
            found = f"{projection} ({crs.name}) counts to the {ways}: the world would be turned round"
            raise InputError(place, found, "a system that counts to the east and north")
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
        back = _transformed(WGS84, self.projection, eastings, "INVERSE")
        lost = eastings - _transformed(WGS84, self.projection, back)
        return _transformed(WGS84, self.projection, eastings + np.nan_to_num(lost, posinf=0.0, neginf=0.0), "INVERSE")

    def from_crs(self, xy: Floats, crs: str) -> Floats:
        """World-frame x, y in metres, (n, 2) float64, of coordinates (n, 2) in another system (its own units)."""
        eastings = _transformed(crs, self.projection, np.asarray(xy, dtype=np.float64))
        return np.add(eastings, self.offset_m)

    def stretch(self, xy_m: tuple[float, float]) -> float:
        """How many times too long the projection makes a short line at x, y (1.0: true lengths)."""
        from pyproj import Proj

        lon_deg, lat_deg = self.to_degrees(np.array([xy_m]))[0]
        if not math.isfinite(lon_deg + lat_deg):
            return math.nan
        factors = Proj(parsed(self.projection, self.projection)).get_factors(lon_deg, lat_deg)
        return math.sqrt(abs(factors.areal_scale))


def parsed(crs: Any, place: str) -> CRS:
    """A coordinate reference system in any form that PROJ knows; InputError at ``place`` for what it does not know.

    Of a compound one (with heights) the horizontal part.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        found = CRS.from_user_input(crs)
    except (CRSError, TypeError, ValueError):
        right = 'a coordinate reference system, for example "EPSG:25832"'
        raise InputError(place, f"{crs!r} is none that is known"[:160], right) from None
    return found.sub_crs_list[0] if found.is_compound else found


def height_unit_m(crs: Any, place: str) -> float:
    """How many metres a height of 1 is in a system: by its vertical axis (below 0 where that counts downwards).

    Where it has none, by the unit of a map projection's other axes, and metres beside degrees.
    """
    from pyproj import CRS

    parsed(crs, place)
    found = CRS.from_user_input(crs)
    for axis in found.axis_info:
        if axis.direction in ("up", "down"):
            return float(axis.unit_conversion_factor) * (1.0 if axis.direction == "up" else -1.0)
    return float(found.axis_info[0].unit_conversion_factor) if found.is_projected else 1.0


def named(frame: WorldFrame, at_m: tuple[float, float]) -> str:
    """The projection of a world frame as other programs show it: its EPSG code where one gives the same eastings and
    northings at a place (world frame, metres) to a millimetre, else WKT."""
    own = parsed(frame.projection, frame.projection)
    code = own.to_epsg()
    if code is not None:
        eastings = np.subtract([at_m], frame.offset_m, dtype=np.float64)
        same = _transformed(frame.projection, f"EPSG:{code}", eastings)
        if np.abs(same - eastings).max() <= _SAME_M:
            return f"EPSG:{code}"
    return str(own.to_wkt())


def utm_epsg(lon_deg: float, lat_deg: float) -> int:
    """The EPSG code of the UTM zone (WGS 84) that holds a place."""
    zone = min(max(math.floor((lon_deg + 180.0) / 6.0) + 1, 1), 60)
    return (32600 if lat_deg >= 0 else 32700) + zone


@cache
def _transformer(source: str, target: str) -> Transformer:
    from pyproj import Transformer

    return Transformer.from_crs(parsed(source, source), parsed(target, target), always_xy=True)


def _transformed(source: str, target: str, xy: Floats, direction: str = "FORWARD") -> Floats:
    from pyproj.enums import TransformDirection

    way = TransformDirection(direction)
    x, y = _transformer(source, target).transform(xy[:, 0], xy[:, 1], direction=way)
    return np.column_stack([x, y])
