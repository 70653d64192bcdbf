"""Places where a sensor could stand: poses, and candidate sites with names and sensors.

Candidate sites come from a CSV, a GeoJSON file, or a rule (a lattice, or along lines). Each has a position in the world
frame in metres, a pose in degrees, and a sensor; what a site does not name is taken from the scenario's ``[sites]``.
"""

from __future__ import annotations

import csv
import json
import math
import re
import reprlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.core.errors import InputError
from pipeline.scenario.models import Scenario, SiteGrid, SiteLine
from pipeline.scenario.types import FARTHEST_M
from pipeline.sensing import own_columns

_NEEDED = ("site", "x_m", "y_m", "z_m")
_ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
_TEXTS = ("sensor", "points")
_KNOWN = (*_NEEDED, *_ANGLES, *_TEXTS)
_NAME = re.compile(r"[^/\\\x00-\x1f\ud800-\udfff]{1,80}")  # becomes part of file names


@dataclass(frozen=True)
class Pose:
    """Where a sensor is and how it is mounted: position in the world frame in metres, angles in degrees.

    Roll about the sensor's x axis comes first, then pitch (nose up positive), then yaw (counter-clockwise from +x).
    """

    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    @property
    def position_m(self) -> tuple[float, float, float]:
        """(x, y, z) in the world frame."""
        return self.x_m, self.y_m, self.z_m

    @property
    def angles_deg(self) -> tuple[float, float, float]:
        """(yaw, pitch, roll)."""
        return self.yaw_deg, self.pitch_deg, self.roll_deg


@dataclass(frozen=True)
class Site:
    """A candidate: its name, pose and sensor, the file of a measured scan if any, and what else its row says."""

    name: str
    pose: Pose
    sensor: str
    points: str | None = None
    own: Mapping[str, own_columns.Value] = field(default_factory=dict, hash=False)


@dataclass(frozen=True)
class ScannedSite:
    """What artefacts hold of a site: name, pose, sensor; beams of the sensor, beams that can meet the region,
    returns."""

    name: str
    pose: Pose
    sensor: str
    beams: int
    beams_in_roi: int
    returns: int

    def to_json(self) -> dict[str, str | float | int]:
        """As the artefacts' metadata holds it."""
        counts = {"beams": self.beams, "beams_in_roi": self.beams_in_roi, "returns": self.returns}
        return {"site": self.name, **asdict(self.pose), "sensor": self.sensor, **counts}

    @classmethod
    def from_json(cls, value: Mapping[str, Any], place: object) -> ScannedSite:
        """The inverse of :meth:`to_json`; InputError naming ``place`` when it is none."""
        try:
            pose = Pose(**{field.name: float(value[field.name]) for field in fields(Pose)})
            counts = (int(value[key]) for key in ("beams", "beams_in_roi", "returns"))
            return cls(str(value["site"]), pose, str(value["sensor"]), *counts)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(place, f"its metadata names a site {value!r} ({error!r})", "an unaltered file") from None


def of(scenario: Scenario) -> tuple[Site, ...]:
    """All candidate sites of a scenario, in the order of the file or the rule.

    Raises
    ------
    InputError
        Naming file and row: a missing or misspelt column, a value that is no finite number, a name used twice.
    """
    model = scenario.sites
    if model.file is not None:
        path = scenario.find(model.file, "sites.file")
        rows = _geojson(path) if path.suffix.lower() in (".geojson", ".json") else _csv(path)
    else:
        path = scenario.file
        rows = _lattice(model.grid) if model.grid is not None else _lines(model.along)
    found: dict[str, Site] = {}
    for place, row in rows:
        site = _site(place, row, scenario)
        if site.name in found:
            raise InputError(place, f"site {site.name!r} stands there twice", "a name of its own for each site")
        found[site.name] = site
    if not found:
        raise InputError(path, "holds no site", "at least one")
    keep = scenario.score.keep_visibility
    for name in () if keep == "all" else keep:
        if name not in found:
            raise InputError(
                f"{scenario.file}: score.keep_visibility", f"no site {name!r}", f"one of {', '.join(found)}, or 'all'"
            )
    return _with_points(tuple(found.values()), scenario)


def _with_points(sites: tuple[Site, ...], scenario: Scenario) -> tuple[Site, ...]:
    points = scenario.sites.points
    if points is None:
        return sites
    if len(sites) != 1:
        raise InputError(f"{scenario.file}: sites.points", f"one measured scan for {len(sites)} sites",
                         "a column 'points' in the sites file, or a single site")  # fmt: skip
    return (replace(sites[0], points=points),)


def _site(place: str, row: dict[str, Any], scenario: Scenario) -> Site:
    own = own_columns.own_columns(place, row, _KNOWN)
    for key in _NEEDED:
        if row.get(key) in (None, ""):
            raise InputError(place, f"{key} is missing", f"the columns {', '.join(_NEEDED)}")
    for key in ("site", *_TEXTS):
        if isinstance(row.get(key), bool | list | dict):
            raise InputError(f"{place}: {key}", repr(row[key])[:80], "a text")
    name = str(row["site"]).strip()
    if not _NAME.fullmatch(name):
        raise InputError(f"{place}: site", f"{name[:80]!r}", "a name of up to 80 characters without / and \\")
    values = {}
    for key in (*_NEEDED[1:], *_ANGLES):
        value = row.get(key)
        values[key] = _number(place, key, getattr(scenario.sites, key) if value in (None, "") else value)
    if not -90 <= values["pitch_deg"] <= 90:
        raise InputError(f"{place}: pitch_deg", f"{values['pitch_deg']:g}", "between -90 and 90, nose up positive")
    points = str(row["points"]).strip() if row.get("points") else None
    return Site(name, Pose(**values), str(row.get("sensor") or scenario.sites.sensor).strip(), points, own)


def _number(place: str, key: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not abs(number) <= FARTHEST_M or isinstance(value, bool):
        raise InputError(f"{place}: {key}", repr(value)[:80], f"a finite number, at most {FARTHEST_M:g}")
    return number


def _csv(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    places, rows = [], []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            names = list(reader.fieldnames or ())
            if twice := sorted({name for name in names if names.count(name) > 1}):
                raise InputError(path, f"the column {twice[0]!r} stands there twice", "each column once")
            for row in reader:
                place = f"{path}: row {row.get('site') or '?'}"
                if None in row or None in row.values():
                    raise InputError(
                        place, "has more or fewer values than the header has columns", "one value a column"
                    )
                places.append(place)
                rows.append(dict(row))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, f"cannot be read as CSV ({error})", "UTF-8 text with a header row") from None
    yield from zip(places, own_columns.with_numbers(rows, _KNOWN), strict=True)


def _geojson(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    right = "a FeatureCollection of Points in world-frame metres"
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"cannot be read as GeoJSON ({error})", right) from None
    if not isinstance(document, dict) or not isinstance(document.get("features"), list):
        raise InputError(path, f"has no list of features: {reprlib.repr(document)[:120]}", right)
    if (crs := document.get("crs")) is not None and not _in_metres(crs):
        raise InputError(f"{path}: crs", repr(crs)[:120], "no crs (RFC 7946), and metres in the world frame")
    for number, feature in enumerate(document["features"]):
        place = f"{path}: feature {number}"
        yield place, _feature(place, feature)


def _in_metres(crs: Any) -> bool:
    """Whether all axes of a GeoJSON ``crs`` member (of 2008; RFC 7946 has none) are in metres."""
    import pyproj

    try:
        return all(axis.unit_name == "metre" for axis in pyproj.CRS(crs["properties"]["name"]).axis_info)
    except (pyproj.exceptions.CRSError, LookupError, TypeError):
        return False


def _feature(place: str, feature: Any) -> dict[str, Any]:
    """The columns that a feature's coordinates and properties give."""
    match feature:
        case {"geometry": {"type": "Point", "coordinates": [_, _, *more] as spot}, "properties": dict(properties)} if (
            len(more) < 2
        ):
            own = dict(zip(_NEEDED, (properties.get("name"), *spot), strict=False))
        case _:
            right = "a Feature with properties, its geometry a Point of two or three coordinates"
            raise InputError(place, f"is {reprlib.repr(feature)[:120]}", right)
    row = {key: value for key, value in properties.items() if key != "name"}
    for key, value in own.items():
        if isinstance(value, str) and key != "site":
            raise InputError(f"{place}: {key}", f"the coordinate {value!r}", "a number, not text")
        if value is not None and row.get(key, value) not in (None, value):
            raise InputError(f"{place}: {key}", f"{row[key]!r} there, but {value!r} as well", "one of them")
    return row | {key: value for key, value in own.items() if value is not None}


def _lattice(rule: SiteGrid) -> Iterator[tuple[str, dict[str, Any]]]:
    axes = []
    for low, high in zip(rule.low_m, rule.high_m, strict=True):
        count = math.floor((high - low) / rule.spacing_m + 1e-9) + 1
        axes.append([low + i * rule.spacing_m for i in range(count)])
    spots = [(x, y) for y in axes[1] for x in axes[0]]
    yield from _named("g", [(x, y, z) for x, y in spots for z in rule.heights_m], "sites.grid")


def _lines(rules: tuple[SiteLine, ...]) -> Iterator[tuple[str, dict[str, Any]]]:
    spots = []
    for rule in rules:
        line = np.asarray(rule.line_m)
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        where = np.arange(math.floor(along[-1] / rule.spacing_m + 1e-9) + 1) * rule.spacing_m
        xs, ys = np.interp(where, along, line[:, 0]), np.interp(where, along, line[:, 1])
        spots += [(float(x), float(y), z) for x, y in zip(xs, ys, strict=True) for z in rule.heights_m]
    yield from _named("a", spots, "sites.along")


def _named(letter: str, spots: list[tuple[float, float, float]], place: str) -> Iterator[tuple[str, dict[str, Any]]]:
    width = max(2, len(str(len(spots))))
    for number, (x, y, z) in enumerate(spots, start=1):
        name = f"{letter}{number:0{width}d}"
        yield f"{place}: {name}", {"site": name, "x_m": x, "y_m": y, "z_m": z}
