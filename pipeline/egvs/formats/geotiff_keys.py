"""The coordinate reference system of GeoTIFF keys, as LAS files have them: codes of EPSG, or all parameters.

Sources: GeoTIFF 1.1 (OGC 19-008r4), and the codes of projection methods of GeoTIFF 1.0, 6.3.3.3; ASPRS LAS 1.2, records
34735 to 34737. Units count: a key for the unit of x and y, or of heights, replaces that of the system of a code.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass, field
from functools import cache
from typing import Any

_USER_DEFINED = 32767
_MAX_KEYS = 1000
_DIRECTORY, _DOUBLES, _TEXTS = 34735, 34736, 34737

_MODEL_TYPE, _CITATION = 1024, 1026
_GEOGRAPHIC, _GEOGRAPHIC_CITATION, _DATUM, _MERIDIAN, _ANGLE_UNIT = 2048, 2049, 2050, 2051, 2054
_ELLIPSOID, _HALF_AXIS, _OTHER_HALF_AXIS, _INVERSE_FLATTENING = 2056, 2057, 2058, 2059
_PROJECTED, _PROJECTED_CITATION, _CONVERSION, _METHOD, _UNIT, _UNIT_SIZE = 3072, 3073, 3074, 3075, 3076, 3077
_VERTICAL, _VERTICAL_CITATION, _VERTICAL_UNIT = 4096, 4097, 4099
_PROJECTED_MODEL, _GEOGRAPHIC_MODEL, _GEOCENTRIC_MODEL, _GREENWICH = 1, 2, 3, 8901

_OLD_VERTICAL = {5101: 5701, 5102: 5702, 5103: 5703, 5104: 5704, 5105: 5705, 5106: 5706}
"""EPSG codes for those of GeoTIFF 1.0; it gives ellipsoids the codes from 5001 to 5033."""
_NO_VERTICAL_CODE = range(5001, 5034)

_NUMBERED_DATUMS = range(6001, 6647)
"""Datums for which EPSG has a system of longitude and latitude with a code that is smaller by 2000."""

# Parameters of PROJ, each with the keys that may state it.
_STANDARD_1, _STANDARD_2 = ("lat_1", (3078,)), ("lat_2", (3079,))
_ORIGIN = (("lat_0", (3081, 3085, 3089)), ("lon_0", (3080, 3084, 3088)))
_SCALE = ("k_0", (3092, 3093))
_OFFSETS = (("x_0", (3082, 3086, 3090)), ("y_0", (3083, 3087, 3091)))
_METHODS: dict[int, tuple[str, tuple[tuple[str, tuple[int, ...]], ...]]] = {
    1: ("tmerc", (*_ORIGIN, _SCALE)),
    3: ("omerc", (("lat_0", (3089, 3081)), ("lonc", (3088, 3080)), ("alpha", (3094,)), ("gamma", (3096,)),
                  ("k_0", (3093, 3092)))),
    7: ("merc", (("lon_0", (3080, 3084)), ("lat_ts", (3078,)), _SCALE)),
    8: ("lcc", (*_ORIGIN, _STANDARD_1, _STANDARD_2)),
    9: ("lcc", (("lat_1", (3081, 3078)), *_ORIGIN, _SCALE)),
    10: ("laea", _ORIGIN),
    11: ("aea", (*_ORIGIN, _STANDARD_1, _STANDARD_2)),
    12: ("aeqd", _ORIGIN),
    13: ("eqdc", (*_ORIGIN, _STANDARD_1, _STANDARD_2)),
    14: ("stere", (*_ORIGIN, _SCALE)),
    15: ("stere", (("lat_0", (3081,)), ("lon_0", (3095, 3080)), _SCALE)),
    16: ("sterea", (*_ORIGIN, _SCALE)),
    17: ("eqc", (("lat_ts", (3078,)), *_ORIGIN)),
    18: ("cass", _ORIGIN),
    22: ("poly", _ORIGIN),
    28: ("cea", (("lat_ts", (3078,)), ("lon_0", (3080, 3088)))),
}  # fmt: skip
_ANGLES = ("lat_0", "lat_1", "lat_2", "lat_ts", "lon_0", "lonc", "alpha", "gamma")


@dataclass(frozen=True)
class GeoKeys:
    """GeoTIFF keys: a whole number, numbers, or a text by key."""

    values: dict[int, Any] = field(default_factory=dict)

    @classmethod
    def from_records(cls, records: dict[int, bytes]) -> GeoKeys:
        """Return the keys in the records 34735 (directory), 34736 (numbers) and 34737 (texts) of a LAS file.

        Parameters
        ----------
        records
            Content by number.

        Raises
        ------
        ValueError
            When a key points beyond its record.
        """
        directory = records.get(_DIRECTORY, b"")
        doubles, texts = records.get(_DOUBLES, b""), records.get(_TEXTS, b"")
        if len(directory) < 8:
            return cls()
        count = struct.unpack_from("<H", directory, 6)[0]
        if count > _MAX_KEYS or len(directory) < 8 + 8 * count:
            raise ValueError(f"the directory of GeoTIFF keys declares {count} keys in {len(directory)} bytes")
        values: dict[int, Any] = {}
        for at in range(8, 8 + 8 * count, 8):
            key, location, size, offset = struct.unpack_from("<4H", directory, at)
            if location == 0:
                values[key] = offset
            elif location == _DOUBLES and 8 * (offset + size) <= len(doubles) and size:
                numbers = struct.unpack_from(f"<{size}d", doubles, 8 * offset)
                if not all(map(math.isfinite, numbers)):
                    raise ValueError(f"the GeoTIFF key {key} is not a finite number")
                values[key] = numbers[0]
            elif location == _TEXTS:
                values[key] = texts[offset : offset + size].decode("latin-1").rstrip("\0| ")
            else:
                raise ValueError(f"the GeoTIFF key {key} points beyond its record")
        return cls(values)

    def to_crs(self) -> str | None:
        """Return the reference system as WKT, with that of heights if the keys name one; None if they name none.

        Where the keys give a unit of x and y but no system, the result is a local system with this unit.

        Raises
        ------
        ValueError
            When a code is unknown to EPSG, a parameter is missing, or the projection has no counterpart in PROJ.
        """
        from pyproj import CRS
        from pyproj.exceptions import CRSError

        try:
            horizontal = self._horizontal()
            if horizontal is None:
                return None
            vertical = self._vertical(horizontal)
            if vertical is None:
                return str(CRS.from_json_dict(horizontal).to_wkt())
            name = f"{horizontal['name']} + {vertical['name']}"
            compound = {"type": "CompoundCRS", "name": name, "components": [horizontal, vertical]}
            return str(CRS.from_json_dict(compound).to_wkt())
        except CRSError as error:
            raise ValueError(f"PROJ cannot use its GeoTIFF keys ({str(error)[:200]})") from None

    def _code(self, key: int) -> int | None:
        """Return a code; None where the key is missing, undefined or user-defined."""
        code = self.values.get(key)
        return code if isinstance(code, int) and code not in (0, _USER_DEFINED) else None

    def _number(self, *keys: int) -> float | None:
        for key in keys:
            if isinstance(self.values.get(key), int | float):
                return float(self.values[key])
        return None

    def _text(self, *keys: int, default: str) -> str:
        return next((text for key in keys if isinstance(text := self.values.get(key), str) and text), default)

    # --- x and y ---

    def _horizontal(self) -> dict[str, Any] | None:
        if self.values.get(_MODEL_TYPE) == _GEOCENTRIC_MODEL:
            return _from_epsg(self._code(_GEOGRAPHIC) or 4978, "GeodeticCRS", "GeographicCRS")
        unit = self._unit(_UNIT, _UNIT_SIZE)
        code = self._code(_PROJECTED)
        if code is not None:
            system = _from_epsg(code, "ProjectedCRS", "CompoundCRS")
            return _with_unit(system["components"][0] if system["type"] == "CompoundCRS" else system, unit)
        conversion = self._conversion(unit)
        if conversion is None:
            model = self.values.get(_MODEL_TYPE)
            if model == _GEOGRAPHIC_MODEL or (_PROJECTED not in self.values and model != _PROJECTED_MODEL):
                return self._geographic()
            return None if unit is None else _local(self._text(_PROJECTED_CITATION, _CITATION, default="local"), unit)
        base = self._geographic()
        if base is None:
            raise ValueError("its GeoTIFF keys have a projection, but neither a datum nor an ellipsoid")
        return {
            "type": "ProjectedCRS",
            "name": self._text(_PROJECTED_CITATION, _CITATION, default="user-defined projection"),
            "base_crs": base,
            "conversion": conversion,
            "coordinate_system": _grid_axes(unit or _METRE),
        }

    def _conversion(self, unit: dict[str, Any] | None) -> dict[str, Any] | None:
        """Return the projection: the one of a code, else the one of the parameters; None if there is neither."""
        from pyproj import CRS
        from pyproj.crs import CoordinateOperation  # type: ignore[attr-defined]

        code = self._code(_CONVERSION)
        if code is not None:
            return CoordinateOperation.from_epsg(code).to_json_dict()
        method = self._code(_METHOD)
        if method is None:
            return None
        if method not in _METHODS:
            raise ValueError(f"the projection method {method} of its GeoTIFF keys is unknown")
        name, parameters = _METHODS[method]
        angle_deg = math.degrees(self._angle_unit())
        unit_m = 1.0 if unit is None else unit["conversion_factor"]
        words = [f"+proj={name}"]
        for parameter, keys in (*parameters, *_OFFSETS):
            value = self._number(*keys)
            if value is not None:
                factor = angle_deg if parameter in _ANGLES else unit_m if parameter in ("x_0", "y_0") else 1.0
                words.append(f"+{parameter}={value * factor!r}")
        if name in ("lcc", "aea", "eqdc") and self._number(3078, 3081) is None:
            raise ValueError("its GeoTIFF keys have no standard parallel of the projection")
        result: dict[str, Any] = CRS.from_proj4(" ".join([*words, "+ellps=GRS80", "+type=crs"])).to_json_dict()
        return dict(result["conversion"])

    def _geographic(self) -> dict[str, Any] | None:
        """Return the system of longitude and latitude; None if the keys have none."""
        code = self._code(_GEOGRAPHIC)
        datum_code = self._code(_DATUM)
        is_numbered = datum_code in _NUMBERED_DATUMS and self._code(_MERIDIAN) in (None, _GREENWICH)
        if code is None and datum_code is not None and is_numbered:
            code = datum_code - 2000  # EPSG numbers a datum and its system alike; PROJ knows the shifts of the latter
        if code is not None:
            return _from_epsg(code, "GeographicCRS")
        datum = self._datum()
        if datum is None:
            return None
        angle = {"type": "AngularUnit", "name": "angle", "conversion_factor": self._angle_unit()}
        axes = (("Geodetic latitude", "Lat", "north"), ("Geodetic longitude", "Lon", "east"))
        name = self._text(_GEOGRAPHIC_CITATION, default="user-defined")
        return {
            "type": "GeographicCRS",
            "name": name,
            "datum": datum,
            "coordinate_system": {
                "subtype": "ellipsoidal",
                "axis": [
                    {"name": axis, "abbreviation": short, "direction": direction, "unit": angle}
                    for axis, short, direction in axes
                ],
            },
        }

    def _datum(self) -> dict[str, Any] | None:
        from pyproj.crs import Datum, Ellipsoid, PrimeMeridian  # type: ignore[attr-defined]

        code = self._code(_DATUM)
        if code is not None:
            return Datum.from_epsg(code).to_json_dict()
        code = self._code(_ELLIPSOID)
        half_axis_m = self._number(_HALF_AXIS)
        name = self._text(_GEOGRAPHIC_CITATION, default="user-defined")
        if code is not None:
            ellipsoid = Ellipsoid.from_epsg(code).to_json_dict()
        elif half_axis_m is not None:
            flattening, other_m = self._number(_INVERSE_FLATTENING), self._number(_OTHER_HALF_AXIS)
            ellipsoid = {"type": "Ellipsoid", "name": name, "semi_major_axis": half_axis_m}
            if flattening:
                ellipsoid["inverse_flattening"] = flattening
            else:
                ellipsoid["semi_minor_axis"] = other_m or half_axis_m
        else:
            return None
        result = {"type": "GeodeticReferenceFrame", "name": name, "ellipsoid": ellipsoid}
        meridian = self._code(_MERIDIAN)
        if meridian is not None:
            result["prime_meridian"] = PrimeMeridian.from_epsg(meridian).to_json_dict()
        return result

    def _angle_unit(self) -> float:
        """Return the unit of angles in radians; degrees by default."""
        code = self._code(_ANGLE_UNIT)
        return math.radians(1.0) if code is None else _unit_of_code(code, "angular")["conversion_factor"]

    def _unit(self, key: int, size_key: int = 0) -> dict[str, Any] | None:
        """Return a unit of length; None if the keys have none."""
        code = self._code(key)
        if code is not None:
            return _unit_of_code(code, "linear")
        size_m = self._number(size_key) if self.values.get(key) == _USER_DEFINED else None
        if size_m is None or size_m <= 0:
            return None
        return {"type": "LinearUnit", "name": f"unit of {size_m:g} m", "conversion_factor": size_m}

    # --- heights ---

    def _vertical(self, horizontal: dict[str, Any]) -> dict[str, Any] | None:
        """Return the system of heights; None if the keys state neither one nor its unit."""
        unit = self._unit(_VERTICAL_UNIT)
        code = self._code(_VERTICAL)
        if horizontal["type"] not in ("ProjectedCRS", "GeographicCRS"):
            return None
        if code is not None and code not in _NO_VERTICAL_CODE:
            system = _from_epsg(_OLD_VERTICAL.get(code, code), "VerticalCRS", "GeographicCRS")
            if system["type"] == "VerticalCRS":
                return _with_unit(system, unit)
            if len(system["coordinate_system"]["axis"]) < 3:  # GeoTIFF 1.1 permits 3D systems
                raise ValueError(f"its GeoTIFF keys name EPSG:{code} as a VerticalCRS, but it has no heights")
            unit = unit or _METRE
        compound = self._compound()
        if compound is not None and code is None:
            return _with_unit(compound["components"][1], unit)
        if unit is None:
            return None
        name = self._text(_VERTICAL_CITATION, default="heights of the GeoTIFF keys")
        axis = {"name": "Height", "abbreviation": "H", "direction": "up", "unit": unit}
        return {
            "type": "VerticalCRS",
            "name": name,
            "datum": {"type": "VerticalReferenceFrame", "name": name},
            "coordinate_system": {"subtype": "vertical", "axis": [axis]},
        }

    def _compound(self) -> dict[str, Any] | None:
        """Return the system of the code of x and y, if it is one with heights."""
        code = self._code(_PROJECTED)
        system = None if code is None else _from_epsg(code, "ProjectedCRS", "CompoundCRS")
        return system if system is not None and system["type"] == "CompoundCRS" else None


_METRE: dict[str, Any] = {"type": "LinearUnit", "name": "metre", "conversion_factor": 1.0}


def _from_epsg(code: int, *types: str) -> dict[str, Any]:
    """Return a system as PROJJSON; ValueError where EPSG has none of these types with such a code."""
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        system: dict[str, Any] = json.loads(CRS.from_epsg(code).to_json())
    except CRSError:
        raise ValueError(f"its GeoTIFF keys name EPSG:{code}, which PROJ does not know") from None
    if system["type"] not in types:
        raise ValueError(f"its GeoTIFF keys name EPSG:{code} as a {types[0]}, but it is a {system['type']}")
    return system


def _with_unit(system: dict[str, Any], unit: dict[str, Any] | None) -> dict[str, Any]:
    """Return a system whose axes have another unit of length; under its own name if it is the same unit."""
    axes = system["coordinate_system"]["axis"]
    if unit is None or all(_size_m(axis["unit"]) == unit["conversion_factor"] for axis in axes):
        return system
    changed = {key: value for key, value in system.items() if key != "id"}
    changed["name"] = f"{system['name']} ({unit['name']})"
    changed["coordinate_system"] = system["coordinate_system"] | {"axis": [axis | {"unit": unit} for axis in axes]}
    return changed


def _size_m(unit: Any) -> float:
    return float(unit["conversion_factor"]) if isinstance(unit, dict) else 1.0


def _grid_axes(unit: dict[str, Any]) -> dict[str, Any]:
    axes = (("Easting", "E", "east"), ("Northing", "N", "north"))
    return {
        "subtype": "Cartesian",
        "axis": [
            {"name": name, "abbreviation": short, "direction": direction, "unit": unit}
            for name, short, direction in axes
        ],
    }


def _local(name: str, unit: dict[str, Any]) -> dict[str, Any]:
    """Return a system of x and y without a position on the Earth."""
    datum = {"type": "EngineeringDatum", "name": name}
    return {"type": "EngineeringCRS", "name": name, "datum": datum, "coordinate_system": _grid_axes(unit)}


@cache
def _unit_of_code(code: int, category: str) -> dict[str, Any]:
    """Return a unit of EPSG as PROJJSON: metres of a length, radians of an angle."""
    from pyproj.database import get_units_map

    for unit in get_units_map(auth_name="EPSG", category=category, allow_deprecated=True).values():
        if unit.code == str(code):
            kind = "LinearUnit" if category == "linear" else "AngularUnit"
            return {"type": kind, "name": unit.name, "conversion_factor": unit.conv_factor}
    raise ValueError(f"the unit {code} of its GeoTIFF keys is unknown")
