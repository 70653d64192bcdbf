"""Places where a sensor could stand: poses, and candidate sites with names and sensors.

Candidate sites come from a CSV, a GeoJSON file, or a rule (a lattice, or along lines). Each has a position in the world
frame in metres (:mod:`pipeline.formats.located_rows` brings longitude and latitude there), a pose in degrees, and a
sensor; what a site does not name is taken from the scenario's ``[sites]``. A place with several heights or pitches is
as many candidates (:mod:`pipeline.sensing.aiming`). Those of one x, y stand at one *pole*, which has the name of the
first place there.
"""

from __future__ import annotations

import csv
import math
import re
import reprlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.core.errors import InputError
from pipeline.core.findings import Finding, FindingsError
from pipeline.core.reading import documents, limits
from pipeline.formats import located_rows
from pipeline.formats.georeference import Georeference, Reading
from pipeline.scenario.models import Scenario, SiteGrid, SiteLine
from pipeline.scenario.types import FARTHEST_M
from pipeline.sensing import aiming, own_columns, sensors
from pipeline.sensing.aiming import Wishes
from pipeline.sensing.sensors import Sensor
from pipeline.world import world_frame

_NEEDED = ("site", "x_m", "y_m", "z_m")
_ANGLES = ("yaw_deg", "pitch_deg", "roll_deg")
_AIM = ("aim_x_m", "aim_y_m", "aim_z_m")
_TEXTS = ("sensor", "points", "aim")
_KNOWN = (*_NEEDED, *_ANGLES, *_AIM, *_TEXTS)
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
    """A candidate: its name, pose and sensor, the file of a measured scan if any, the pole that it stands at, and what
    else its row says."""

    name: str
    pose: Pose
    sensor: str
    points: str | None = None
    pole: str = ""
    own: Mapping[str, own_columns.Value] = field(default_factory=dict, hash=False)


@dataclass(frozen=True)
class ScannedSite:
    """What artefacts hold of a site: name, pole, pose, sensor; beams of the sensor, beams that can meet the region,
    returns."""

    name: str
    pole: str
    pose: Pose
    sensor: str
    beams: int
    beams_in_roi: int
    returns: int

    def to_json(self) -> dict[str, str | float | int]:
        """As the artefacts' metadata holds it."""
        counts = {"beams": self.beams, "beams_in_roi": self.beams_in_roi, "returns": self.returns}
        return {"site": self.name, "pole": self.pole, **asdict(self.pose), "sensor": self.sensor, **counts}

    @classmethod
    def from_json(cls, value: Mapping[str, Any], place: object) -> ScannedSite:
        """The inverse of :meth:`to_json`; InputError naming ``place`` when it is none."""
        try:
            pose = Pose(**{field.name: float(value[field.name]) for field in fields(Pose)})
            counts = (int(value[key]) for key in ("beams", "beams_in_roi", "returns"))
            return cls(str(value["site"]), str(value["pole"]), pose, str(value["sensor"]), *counts)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(place, f"its metadata names a site {value!r} ({error!r})", "an unaltered file") from None


def of(scenario: Scenario) -> tuple[Site, ...]:
    """All candidate sites of a scenario, in the order of the file or the rule; those of one place by height and pitch.

    Raises
    ------
    InputError
        Naming file and row, all wrong ones at once: a missing or misspelt column, a value that is no finite number, a
        name used twice; or a key of ``[sites]`` that acts on no site.
    """
    model = scenario.sites
    if model.file is not None:
        path = scenario.find(model.file, "sites.file")
        world = world_frame.of(scenario)
        is_geojson = path.suffix.lower() in (".geojson", ".json")
        rows = _geojson(path, world) if is_geojson else _csv(path, world)
    else:
        path = scenario.file
        rows = _lattice(model.grid) if model.grid is not None else _lines(model.along)
    found: dict[str, Site] = {}
    poles: dict[tuple[float, float], str] = {}
    used: set[str] = set()
    known: dict[str, Sensor] = {}
    refused: list[InputError] = []
    for row in rows:
        try:
            for site in _candidates(row, scenario, poles, used, known):
                if site.name in found:
                    right = "a name of its own for each site"
                    raise InputError(row.place, f"site {site.name!r} stands there twice", right)
                found[site.name] = site
        except InputError as error:
            refused.append(error)
        _check_number(len(found), path, "each combination of place, height and pitch is one")
    if refused:
        raise FindingsError(_alike(refused))
    if not found:
        raise InputError(path, "holds no site", "at least one")
    if idle := aiming.idle_keys(scenario.sites, used):
        own = "z_m" if idle[0] == "heights_m" else "yaw_deg or aim" if idle[0].startswith("aim") else "pitch_deg"
        raise InputError(
            f"{scenario.file}: sites.{idle[0]}", "acts on no site", f"remove it, or {own} from the rows of {path.name}"
        )
    keep = scenario.score.keep_visibility
    for name in () if keep == "all" else keep:
        if name not in found:
            raise InputError(
                f"{scenario.file}: score.keep_visibility", f"no site {name!r}", f"one of {', '.join(found)}, or 'all'"
            )
    return _with_points(tuple(found.values()), scenario)


def _check_number(candidates: float, place: object, why: str) -> None:
    """InputError where there are too many."""
    if not candidates <= limits.SITES.most:
        what = f"more than {limits.SITES.most:,} candidates ({why})"
        raise InputError(place, what, f"a wider spacing, or fewer heights and pitches; {limits.SITES.right}")


def _alike(refused: list[InputError]) -> Iterator[Finding]:
    """One finding for each thing that is wrong; a misspelt column is so in every row."""
    places: dict[tuple[str, str], dict[str, None]] = {}
    for error in refused:
        places.setdefault((error.found, error.right), {})[error.place] = None
    for (found, right), (first, *others) in places.items():
        place = f"{first} and {len(others)} more" if others else first
        yield Finding.of("sites", InputError(place, found, right))


def _with_points(sites: tuple[Site, ...], scenario: Scenario) -> tuple[Site, ...]:
    points = scenario.sites.points
    if points is None:
        return sites
    if len(sites) != 1:
        raise InputError(f"{scenario.file}: sites.points", f"one measured scan for {len(sites)} sites",
                         "a column 'points' in the sites file, or a single site")  # fmt: skip
    return (replace(sites[0], points=points),)


@dataclass(frozen=True)
class _Row:
    """A place as a file or a rule names it: where for messages, its columns, the heights that a rule gives it."""

    place: str
    columns: dict[str, Any]
    heights_m: tuple[float, ...] = ()


def _candidates(
    row: _Row,
    scenario: Scenario,
    poles: dict[tuple[float, float], str],
    used: set[str],
    known: dict[str, Sensor],
) -> Iterator[Site]:
    """The candidates of one place; ``poles``, ``used`` (keys of ``[sites]``) and ``known`` (sensors) take what it
    adds."""
    place, columns = row.place, row.columns
    other = own_columns.own_columns(place, columns, _KNOWN)
    _check_columns(row, scenario)
    name = str(columns["site"]).strip()
    sensor = str(columns.get("sensor") or scenario.sites.sensor).strip()
    points = str(columns["points"]).strip() if columns.get("points") else None
    wishes = _wishes(row, scenario)
    pole = poles.setdefault((wishes.x_m, wishes.y_m), name)

    def aimed_sensor() -> Sensor:
        if sensor not in known:
            known[sensor] = sensors.of_scenario(sensor, scenario, f"{place}: sensor")
        return known[sensor]

    mounts = aiming.mounts(place, wishes, scenario, aimed_sensor, used)
    if points is not None and len(mounts) > 1:
        raise InputError(f"{place}: points", f"one measured scan for {len(mounts)} mounts", "one height and one pitch")
    for mount in mounts:
        own = name + mount.mark
        if not _NAME.fullmatch(own):
            right = "a name of up to 80 characters without / and \\"
            raise InputError(f"{place}: site", f"{own[:80]!r}", right)
        pose = Pose(wishes.x_m, wishes.y_m, mount.z_m, mount.yaw_deg, mount.pitch_deg, wishes.roll_deg)
        yield Site(own, pose, sensor, points, pole, other)


def _check_columns(row: _Row, scenario: Scenario) -> None:
    """InputError for a column that is missing, or a text that is none."""
    place, columns = row.place, row.columns
    has_height = row.heights_m or scenario.sites.heights_m
    for key in _NEEDED[:-1] if has_height else _NEEDED:
        if columns.get(key) in (None, ""):
            raise InputError(place, f"{key} is missing", f"the columns {', '.join(_NEEDED)}")
    for key in ("site", *_TEXTS):
        if isinstance(columns.get(key), bool | list | dict):
            raise InputError(f"{place}: {key}", repr(columns[key])[:80], "a text")


def _wishes(row: _Row, scenario: Scenario) -> Wishes:
    """The numbers of a row."""
    place = row.place
    given = {
        key: _number(place, key, value)
        for key in (*_NEEDED[1:], *_ANGLES, *_AIM)
        if (value := row.columns.get(key)) not in (None, "")
    }
    heights_m = row.heights_m or ((given["z_m"],) if "z_m" in given else ())
    pitch_deg, yaw_deg = given.get("pitch_deg"), given.get("yaw_deg")
    if pitch_deg is not None and not -90 <= pitch_deg <= 90:
        raise InputError(f"{place}: pitch_deg", f"{pitch_deg:g}", "between -90 and 90, nose up positive")
    aim_m = _own_aim(row, given, scenario)
    if aim_m is not None and yaw_deg is not None:
        raise InputError(f"{place}: yaw_deg", f"{yaw_deg:g} there, but an aim as well", "one of them")
    roll_deg = given.get("roll_deg", scenario.sites.roll_deg)
    return Wishes(given["x_m"], given["y_m"], heights_m, yaw_deg, pitch_deg, roll_deg, aim_m)


def _own_aim(row: _Row, given: Mapping[str, float], scenario: Scenario) -> aiming.Spot | None:
    """The point that a row aims at: the middle of the region, or its own."""
    place, middle = row.place, scenario.roi.center_m
    named = row.columns.get("aim") or None
    if named not in (None, "roi"):
        raise InputError(f"{place}: aim", f"{named!r}", "roi, or the columns aim_x_m and aim_y_m")
    if not any(key in given for key in _AIM):
        return middle if named else None
    if named or "aim_x_m" not in given or "aim_y_m" not in given:
        found = "'roi' and a point" if named else "one of aim_x_m and aim_y_m is missing"
        raise InputError(f"{place}: aim", found, "one of them" if named else "both")
    return given["aim_x_m"], given["aim_y_m"], given.get("aim_z_m", middle[2])


def _number(place: str, key: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not abs(number) <= FARTHEST_M or isinstance(value, bool):
        raise InputError(f"{place}: {key}", repr(value)[:80], f"a finite number, at most {FARTHEST_M:g}")
    return number


def _csv(path: Path, world: Georeference) -> Iterator[_Row]:
    places, rows = [], []
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            names = list(reader.fieldnames or ())
            if len(names) == 1 and (other := next((mark for mark in (";", "\t", "|") if mark in names[0]), None)):
                right = "commas, and decimal points in the numbers"
                raise InputError(path, f"its columns are separated by {other!r}", right)
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
    rows = located_rows.placed(zip(places, rows, strict=True), path, world)
    yield from map(_Row, places, own_columns.with_numbers(rows, _KNOWN))


def _geojson(path: Path, world: Georeference) -> Iterator[_Row]:
    right = "a FeatureCollection of Points"
    document = documents.read_json(path, right)
    if not isinstance(document, dict) or not isinstance(document.get("features"), list):
        raise InputError(path, f"has no list of features: {reprlib.repr(document)[:120]}", right)
    reading = located_rows.reading_of(document, path, world)
    for number, feature in enumerate(document["features"]):
        place = f"{path}: feature {number}"
        yield _Row(place, _feature(place, feature, reading))


def _feature(place: str, feature: Any, reading: Reading) -> dict[str, Any]:
    """The columns that a feature's coordinates, in the world frame, and properties give."""
    match feature:
        case {"geometry": {"type": "Point", "coordinates": [_, _, *more] as spot}, "properties": dict(properties)} if (
            len(more) < 2
        ):
            own = dict(zip(_NEEDED, (properties.get("name"), *located_rows.in_world(spot, reading)), strict=False))
        case _:
            right = "a Feature with properties, its geometry a Point of two or three coordinates"
            raise InputError(place, f"is {reprlib.repr(feature)[:120]}", right)
    row = {key: value for key, value in properties.items() if key != "name"}
    for key, value in own.items():
        if isinstance(value, str) and key != "site":
            raise InputError(f"{place}: {key}", f"the coordinate {value!r}", "a number, not text")
        if reading.convert is not None and located_rows.agree(row.get(key), value):
            own[key] = row[key]  # what a GIS carried along, not rounded to degrees
        elif value is not None and row.get(key, value) not in (None, value):
            raise InputError(f"{place}: {key}", f"{row[key]!r} there, but {value!r} as well", "one of them")
    return row | {key: value for key, value in own.items() if value is not None}


def _lattice(rule: SiteGrid) -> Iterator[_Row]:
    axes = []
    for low, high in zip(rule.low_m, rule.high_m, strict=True):
        steps = (high - low) / rule.spacing_m + 1e-9
        _check_number(steps, "sites.grid", f"spacing_m = {rule.spacing_m:g}")
        count = math.floor(steps) + 1
        axes.append([low + i * rule.spacing_m for i in range(count)])
    _check_number(len(axes[0]) * len(axes[1]), "sites.grid", f"spacing_m = {rule.spacing_m:g}")
    yield from _named("g", [(x, y, rule.heights_m) for y in axes[1] for x in axes[0]], "sites.grid")


def _lines(rules: tuple[SiteLine, ...]) -> Iterator[_Row]:
    spots: list[tuple[float, float, tuple[float, ...]]] = []
    for rule in rules:
        line = np.asarray(rule.line_m)
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
        _check_number(float(along[-1]) / rule.spacing_m, "sites.along", f"spacing_m = {rule.spacing_m:g}")
        where = np.arange(math.floor(along[-1] / rule.spacing_m + 1e-9) + 1) * rule.spacing_m
        xs, ys = np.interp(where, along, line[:, 0]), np.interp(where, along, line[:, 1])
        _check_number(len(spots) + len(where), "sites.along", f"spacing_m = {rule.spacing_m:g}")
        spots += [(float(x), float(y), rule.heights_m) for x, y in zip(xs, ys, strict=True)]
    yield from _named("a", spots, "sites.along")


def _named(letter: str, spots: list[tuple[float, float, tuple[float, ...]]], place: str) -> Iterator[_Row]:
    width = max(2, len(str(len(spots))))
    for number, (x, y, heights_m) in enumerate(spots, start=1):
        name = f"{letter}{number:0{width}d}"
        yield _Row(f"{place}: {name}", {"site": name, "x_m": x, "y_m": y}, heights_m)
