r"""Candidate sites of a scenario, from a file or a rule, with each height and pitch at which a sensor is mounted.

Candidate sites come from a file (CSV, GeoJSON, GIS formats) or a rule (a lattice, or points along lines). Each has a
position in the world frame in metres (:mod:`egvs.sensors.site_files` converts longitude and latitude), angles in
degrees, and a sensor; what a row leaves out is taken from the scenario's ``[sites]``. Each combination of a location
with a sensor, a height and a pitch is one candidate. Candidates with the same x, y share one *pole*, named after the
first site there.

A sensor is *aimed* when its middle ray (:attr:`egvs.sensors.sensor.Sensor.middle_deg`) meets a given point. With
:math:`m` that ray after the roll, and :math:`d` the unit vector from the sensor to the point, pitch and yaw follow from
the order of rotations (roll, pitch, yaw):

.. math:: \rho \sin(pitch + \phi) = d_z, \quad \rho = \sqrt{m_x^2 + m_z^2}, \quad \phi = atan2(m_z, m_x), \\
          yaw = atan2(d_y, d_x) - atan2(m_y, m'_x), \quad m'_x = \rho \cos(pitch + \phi)

Two pitches satisfy this. The one that keeps the sign of :math:`m_x` is used: a field of view behind the sensor stays
behind it, so the sensor is turned round and not upside down. A sensor without roll whose middle azimuth is 0 is pitched
by the elevation of the point minus the middle elevation.

Both angles are rounded to 1e-6 degree, so that the last bits of an arc tangent do not change results.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from egvs.core import polylines
from egvs.core.errors import InputError, parse_each, raise_together, unknown_site
from egvs.core.grid import Vec3
from egvs.core.special import cosdg, sindg
from egvs.formats import vector_files
from egvs.scenario.fields import MAX_COORDINATE_M, SensorMount, same_name
from egvs.scenario.model import Scenario, SiteGrid, SiteLine
from egvs.sensors import site_files
from egvs.sensors.sensor import Sensor, scenario_sensor
from egvs.sensors.site_files import SiteRow
from egvs.traffic import network, sumo_folder
from egvs.world import geolocation, terrain

Pitch = float | Literal["aim"]

_ANGLE_DIGITS = 6
_MIN_OFFSET_M = 1e-6
"""A point closer than this to the vertical line through the sensor has no azimuth."""

_SITE_NAME = re.compile(r"[^/\\\x00-\x1f\ud800-\udfff]{1,80}")  # becomes part of file names


@dataclass(frozen=True)
class Pose:
    """Position of a sensor in the world frame in metres, and its mounting angles in degrees.

    Roll about the sensor's x axis comes first, then pitch (nose up positive), then yaw (counter-clockwise from +x).
    """

    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    @property
    def position_m(self) -> Vec3:
        """(x, y, z) in the world frame."""
        return self.x_m, self.y_m, self.z_m

    @property
    def is_inverted(self) -> bool:
        """Whether the sensor is upside down."""
        return abs(wrap_deg(self.roll_deg)) > 90.0

    @property
    def side_tilt_deg(self) -> float:
        """The roll from upright, or from upside down, of which it is nearer; -90 to 90."""
        roll_deg = wrap_deg(self.roll_deg)
        return wrap_deg(roll_deg + 180.0) if self.is_inverted else roll_deg

    @property
    def angles_deg(self) -> Vec3:
        """(yaw, pitch, roll)."""
        return self.yaw_deg, self.pitch_deg, self.roll_deg


def wrap_deg(angle_deg: float) -> float:
    """Return an angle above -180 and up to 180 degrees.

    >>> wrap_deg(180.0), wrap_deg(-180.0), wrap_deg(182.5)
    (180.0, 180.0, -177.5)
    """
    return 180.0 - (180.0 - angle_deg) % 360.0


def grid_bearing_deg(yaw_deg: float) -> float:
    """Return the bearing, clockwise from grid north, 0 to 360, of a yaw counter-clockwise from east.

    >>> grid_bearing_deg(0.0), grid_bearing_deg(90.0), grid_bearing_deg(-90.0)
    (90.0, 0.0, 180.0)
    """
    return (90.0 - yaw_deg) % 360.0


@dataclass(frozen=True)
class Site:
    """A candidate site.

    Attributes
    ----------
    name
        Unique name.
    pose
        Where the sensor is mounted, and how.
    sensor
        Name of the sensor.
    points
        File of a measured scan; None where the scan is simulated.
    pole
        Name of the pole, shared by all sites at the same x, y.
    user_columns
        Further columns of the sites file.
    """

    name: str
    pose: Pose
    sensor: str
    points: str | None = None
    pole: str = ""
    user_columns: Mapping[str, site_files.ColumnValue] = field(default_factory=dict, hash=False)


@dataclass(frozen=True)
class ScannedSite:
    """A site as artefacts record it: name, pole, pose, sensor, and how many beams and returns its scan has.

    Attributes
    ----------
    beams
        Beams of the sensor.
    beams_in_roi
        Beams that can meet the region of interest.
    returns
        Beams that met something.
    """

    name: str
    pole: str
    pose: Pose
    sensor: str
    beams: int
    beams_in_roi: int
    returns: int

    def to_json(self) -> dict[str, str | float | int]:
        """Return the form in which the metadata of artefacts holds it."""
        counts = {"beams": self.beams, "beams_in_roi": self.beams_in_roi, "returns": self.returns}
        return {"site": self.name, "pole": self.pole, **asdict(self.pose), "sensor": self.sensor, **counts}

    @classmethod
    def from_json(cls, value: Mapping[str, Any], where: object) -> ScannedSite:
        """Invert :meth:`to_json`; InputError naming ``where`` for anything else."""
        try:
            pose = Pose(**{field.name: float(value[field.name]) for field in fields(Pose)})
            counts = (int(value[key]) for key in ("beams", "beams_in_roi", "returns"))
            return cls(str(value["site"]), str(value["pole"]), pose, str(value["sensor"]), *counts)
        except (KeyError, TypeError, ValueError) as error:
            problem = f"its metadata has an invalid site {value!r} ({error!r})"
            raise InputError(where, problem, "Use the original file.") from None


def candidate_sites(scenario: Scenario) -> tuple[Site, ...]:
    """Return all candidate sites of a scenario, in the order of the file or rule; in a row by sensor, height, pitch.

    Raises
    ------
    InputError
        With file and row, for all invalid rows at once: a missing or misspelt column, a value that is no finite number,
        a duplicate name; or for a key of ``[sites]`` that has no effect on any site.
    """
    path = scenario.file
    if scenario.sites.file is not None:
        path = scenario.find(scenario.sites.file, "sites.file")
    builder = _SiteBuilder(scenario)
    sites: dict[str, Site] = {}
    names: dict[str, str] = {}
    rows, errors = _site_rows(scenario, path)
    for row in rows:
        try:
            for site in builder.candidates(row):
                other = names.setdefault(same_name(site.name), site.name)
                if site.name in sites:
                    hint = "Give each site its own name."
                    if site.sensor != sites[site.name].sensor:
                        both = f'["{sites[site.name].sensor}", "{site.sensor}"]'
                        hint += f" For several sensors on each pole, use one row, and sites.sensor = {both}."
                    raise InputError(row.where, f"there are two sites {site.name!r}", hint)
                if other != site.name:
                    difference = "in the Unicode of accents or in invisible characters"
                    problem = f"the sites {other!a} and {site.name!a} differ only {difference}"
                    raise InputError(row.where, problem, "Give each site its own name.")
                sites[site.name] = site
        except InputError as error:
            errors.append(error)
        site_files.check_site_count(len(sites), path, "each combination of location, sensor, height and pitch is one")
    raise_together(errors, "sites")
    if not sites:
        raise InputError(path, "expected at least one site, got none")
    _check_unused_keys(scenario, builder.used_keys, path)
    poles = list(dict.fromkeys(site.pole for site in sites.values()))
    for pole in scenario.sites.existing_poles if scenario.sites.existing_poles != "all" else ():
        if pole not in poles:
            raise unknown_site(scenario.locate("sites.existing_poles"), pole, poles)
    _check_keep_visibility(scenario, sites)
    return _with_measured_scan(tuple(sites.values()), scenario)


def pole_exists(pole: str, existing: Sequence[str]) -> bool:
    """Return whether a pole is one of ``sites.existing_poles``."""
    return existing == "all" or pole in existing


def _site_rows(scenario: Scenario, path: Path) -> tuple[Iterable[SiteRow], list[InputError]]:
    """Return the rows of the file or the rule, and what is wrong with the other rows of a table."""
    config = scenario.sites
    if config.file is not None:
        world = geolocation.scenario_georeference(scenario)
        if path.suffix.lower() in (".geojson", ".json") or vector_files.is_gis_file(path):
            is_kml = path.suffix.lower() in vector_files.KML_SUFFIXES
            return site_files.read_features(path, world, has_relief=is_kml and has_relief(scenario)), []
        return site_files.read_table(path, world)
    if config.grid is not None:
        return _grid_rows(config.grid), []
    return _line_rows(config.along), []


def has_relief(scenario: Scenario) -> bool:
    """Whether the ground is elsewhere than at z = 0."""
    if scenario.statics.terrain is not None:
        return True
    path = sumo_folder.network_path(scenario)
    if path is None or not path.is_file() or not network.may_have_slopes(path):
        return False
    span_m, farthest_m = terrain.relief_m(network.read_net_xml(path))
    return max(span_m, abs(farthest_m)) > terrain.MIN_RELIEF_M


_OVERRIDING_COLUMNS = {
    "sensor": "sensor",
    "heights_m": "z_m",
    "aim": "yaw_deg or aim",
    "aim_m": "yaw_deg or aim",
    "yaw_deg": "yaw_deg or aim",
    "pitch_deg": "pitch_deg",
    "roll_deg": "roll_deg",
    "mount": "mount",
}
"""Keys of ``[sites]`` that are defaults for rows, and the columns that override them."""


def _check_unused_keys(scenario: Scenario, used_keys: set[str], path: Path) -> None:
    """InputError for a key of ``[sites]`` that the user wrote and that every row overrides."""
    config = scenario.sites
    for key, column in _OVERRIDING_COLUMNS.items():
        is_set = key in scenario.written_site_keys and getattr(config, key) not in (None, ())
        if not is_set or key in used_keys:
            continue
        problem = f"the key has no effect on any site: each row of {path.name} has its own {column}"
        hint = f"Remove it, or remove {column} from the rows of {path.name}."
        if key == "sensor" and config.replace_sensor is not None:
            problem = "the key has no effect on any site: replace_sensor sets the sensor of all"
            hint = "Remove one of them."
        elif key == "sensor" and isinstance(config.sensor, str):
            hint = f"Use sites.replace_sensor={config.sensor} to replace them, or remove the key."
        raise InputError(scenario.locate(f"sites.{key}"), problem, hint)


def _check_keep_visibility(scenario: Scenario, sites: Mapping[str, Site]) -> None:
    kept = scenario.score.keep_visibility
    if kept == "all":
        return
    for name in kept:
        if name not in sites:
            raise unknown_site(scenario.locate("score.keep_visibility"), name, list(sites))


def _with_measured_scan(sites: tuple[Site, ...], scenario: Scenario) -> tuple[Site, ...]:
    points = scenario.sites.points
    if points is None:
        return sites
    if len(sites) != 1:
        hint = "Add a column 'points' to the sites file, or use a single site."
        raise InputError(scenario.locate("sites.points"), f"one measured scan is given for {len(sites)} sites", hint)
    return (replace(sites[0], points=points),)


@dataclass(frozen=True)
class MountRequest:
    """Position, angles and aim that a row states; None where it leaves a value to ``[sites]``.

    ``heights_m`` are the heights of the row's rule, or the row's own height; they count from ``ground_m``.
    """

    x_m: float
    y_m: float
    heights_m: tuple[float, ...]
    yaw_deg: float | None = None
    pitch_deg: float | None = None
    roll_deg: float = 0.0
    aim_m: Vec3 | None = None
    ground_m: float = 0.0


@dataclass(frozen=True)
class Mount:
    """One height and orientation of a sensor at a location.

    ``name_suffix`` tells the candidate from the others there, and is empty for the only one.
    """

    name_suffix: str
    z_m: float
    yaw_deg: float
    pitch_deg: float


class _SiteBuilder:
    """Makes the candidates of one row after another.

    ``used_keys`` collects the keys of ``[sites]`` that had an effect, or that a row repeats.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.used_keys: set[str] = set()
        self._poles: dict[tuple[float, float], str] = {}
        self._sensors: dict[str, Sensor] = {}

    def candidates(self, row: SiteRow) -> Iterator[Site]:
        """Yield the candidates of a row, one for each sensor, height and pitch."""
        columns = row.columns
        user_columns = site_files.user_columns(row.where, columns, site_files.KNOWN_COLUMNS)
        _check_columns(row, self.scenario)
        name = str(columns["site"]).strip()
        sensor_names = self._sensor_names(columns)
        points = str(columns["points"]).strip() if columns.get("points") else None
        if columns.get("roll_deg") in (None, ""):
            self.used_keys.add("roll_deg")
        for sensor_name in sensor_names:
            request = _mount_request(row, self.scenario, is_inverted=self._is_inverted(row, sensor_name))
            pole = self._poles.setdefault((request.x_m, request.y_m), name)
            mounts = self._mounts(row.where, request, sensor_name)
            if points is not None and (n_mounts := len(mounts) * len(sensor_names)) > 1:
                problem = f"one measured scan is given for {n_mounts} mounts"
                raise InputError(f"{row.where}: points", problem, "Use one height, one pitch and one sensor.")
            for mount in mounts:
                site_name = name + mount.name_suffix
                if len(sensor_names) > 1:
                    site_name += f"{'+' if mount.name_suffix else '@'}{sensor_name}"
                if not _SITE_NAME.fullmatch(site_name):
                    problem = f"expected a name of up to 80 characters without / and \\, got {site_name[:80]!r}"
                    raise InputError(f"{row.where}: site", problem)
                pose = Pose(request.x_m, request.y_m, mount.z_m, mount.yaw_deg, mount.pitch_deg, request.roll_deg)
                yield Site(site_name, pose, sensor_name, points, pole, user_columns)

    def _sensor_names(self, columns: Mapping[str, Any]) -> tuple[str, ...]:
        config = self.scenario.sites
        if config.replace_sensor is not None:
            return (config.replace_sensor,)
        default = config.sensor if isinstance(config.sensor, tuple) else (config.sensor,)
        if columns.get("sensor"):
            name = str(columns["sensor"]).strip()
            if (name,) == default:  # the row says the same
                self.used_keys.add("sensor")
            return (name,)
        self.used_keys.add("sensor")
        return default

    def _is_inverted(self, row: SiteRow, sensor_name: str) -> bool:
        """Whether the sensor is upside down: by the row, else by ``[sites]``, else by the sensor."""
        mount = str(row.columns.get("mount") or "").strip()
        if not mount:
            self.used_keys.add("mount")
            own = self.scenario.sensors.get(sensor_name)
            mount = self.scenario.sites.mount or ("upright" if own is None else own.mount)
        if mount not in get_args(SensorMount):
            raise InputError(f"{row.where}: mount", f"expected upright or inverted, got {mount[:80]!r}")
        return mount == "inverted"

    def _mounts(self, where: str, request: MountRequest, sensor_name: str) -> list[Mount]:
        """Every combination of height and pitch of a row; InputError for an aim that no mount meets."""
        heights_m = self._heights_m(request)
        aim_m = request.aim_m
        if aim_m is None and request.yaw_deg is None:
            aim_m = self._default_aim_m()
        pitches = self._pitches(request, has_aim=aim_m is not None)
        mounts = []
        for height_m in heights_m:
            z_m = request.ground_m + height_m
            position_m = request.x_m, request.y_m, z_m
            aimed = None
            if aim_m is not None:
                sensor = self._sensor(sensor_name, f"{where}: sensor")
                aimed = aiming_angles(where, position_m, aim_m, request.roll_deg, sensor)
            for pitch in pitches:
                suffix = _name_suffix(height_m, pitch, with_height=len(heights_m) > 1, with_pitch=len(pitches) > 1)
                yaw_deg, pitch_deg = self._angles(where, request, pitch, aimed)
                mounts.append(Mount(suffix, z_m, yaw_deg, pitch_deg))
        return mounts

    def _heights_m(self, request: MountRequest) -> tuple[float, ...]:
        default_m = self.scenario.sites.heights_m
        if request.heights_m or not default_m:
            return request.heights_m
        self.used_keys.add("heights_m")
        return default_m

    def _default_aim_m(self) -> Vec3 | None:
        """The point that ``[sites]`` aims at; its z is that of the centre of the region unless given."""
        config = self.scenario.sites
        if config.aim is None and config.aim_m is None:
            return None
        self.used_keys.add("aim" if config.aim is not None else "aim_m")
        center_m = self.scenario.roi.center_m
        x_m, y_m, z_m = (*(config.aim_m or center_m), center_m[2])[:3]
        return x_m, y_m, z_m

    def _pitches(self, request: MountRequest, has_aim: bool) -> tuple[Pitch, ...]:
        """The pitch of the row, else the pitches of ``[sites]``, else the aim's pitch, else 0."""
        if request.pitch_deg is not None:
            return (request.pitch_deg,)
        default_deg = self.scenario.sites.pitch_deg
        if default_deg is None:
            return ("aim",) if has_aim else (0.0,)
        self.used_keys.add("pitch_deg")
        return default_deg if isinstance(default_deg, tuple) else (default_deg,)

    def _angles(
        self, where: str, request: MountRequest, pitch: Pitch, aimed: tuple[float, float] | None
    ) -> tuple[float, float]:
        """Yaw and pitch of a mount, degrees."""
        if aimed is not None and pitch == "aim":
            return aimed
        if aimed is not None:
            return aimed[0], float(pitch)
        if pitch == "aim":
            reason = "there is no aim"
            if request.yaw_deg is not None:
                reason = f"the row has its own yaw_deg, {request.yaw_deg:g}"
            raise InputError(f"{where}: pitch_deg", f"pitch_deg is 'aim', but {reason}", 'Set aim = "roi", or aim_m.')
        if request.yaw_deg is not None:
            return request.yaw_deg, float(pitch)
        self.used_keys.add("yaw_deg")
        return self.scenario.sites.yaw_deg or 0.0, float(pitch)

    def _sensor(self, name: str, where: str) -> Sensor:
        if name not in self._sensors:
            self._sensors[name] = scenario_sensor(name, self.scenario, where)
        return self._sensors[name]


def _name_suffix(z_m: float, pitch: Pitch, *, with_height: bool, with_pitch: bool) -> str:
    """Return ``@4.5m-10deg``, ``@4.5m+aim``; without the height or pitch that all candidates share."""
    suffix = ""
    if with_height:
        suffix = f"{z_m:.10g}m"
    if with_pitch:
        suffix += "+aim" if pitch == "aim" else f"{pitch + 0.0:+.10g}deg"
    return "@" + suffix.removeprefix("+") if suffix else ""


def aiming_angles(where: str, from_m: Vec3, to_m: Vec3, roll_deg: float, sensor: Sensor) -> tuple[float, float]:
    """Return yaw and pitch, degrees, at which the middle ray of a sensor meets a point; see the module's docstring.

    Parameters
    ----------
    where
        File and row, for messages.
    from_m, to_m
        The sensor and its target in the world frame, metres.
    roll_deg
        Roll of the sensor.
    sensor
        The sensor.

    Raises
    ------
    InputError
        When the point is directly above or below the sensor, or when no pitch between -90 and 90 degrees lets the ray
        meet it.
    """
    target = f"({', '.join(f'{v:g}' for v in to_m)})"
    x, y, z = (to - start for to, start in zip(to_m, from_m, strict=True))
    level_m = math.hypot(x, y)
    if level_m < _MIN_OFFSET_M:
        problem = f"{target} is directly above or below the sensor"
        raise InputError(f"{where}: aim", problem, "Aim at a point to the side of it.")
    range_m = math.hypot(level_m, z)
    middle_x, middle_y, middle_z = _rotate_around_x(sensor.middle_deg, roll_deg)
    level = level_m / range_m
    forward = math.copysign(math.sqrt(max((level - middle_y) * (level + middle_y), 0.0)), middle_x)
    pitch_rad = math.atan2(z / range_m, forward) - math.atan2(middle_z, middle_x)
    pitch_deg = math.remainder(math.degrees(pitch_rad), 360.0)
    if level < abs(middle_y) or abs(pitch_deg) > 90:
        problem = f"{sensor.name} cannot be pitched so that its central ray meets {target}"
        hint = "Aim at a point that the central ray can reach with a pitch between -90 and 90 degrees."
        raise InputError(f"{where}: aim", problem, hint)
    yaw_deg = math.degrees(math.atan2(y, x) - math.atan2(middle_y, forward))
    yaw_deg = round(math.remainder(yaw_deg, 360.0), _ANGLE_DIGITS) + 0.0
    return yaw_deg, round(pitch_deg, _ANGLE_DIGITS) + 0.0


def _rotate_around_x(middle_deg: tuple[float, float], roll_deg: float) -> Vec3:
    """The unit vector of the middle ray after the roll."""
    elevation, azimuth = middle_deg
    x = cosdg(elevation) * cosdg(azimuth)
    y = cosdg(elevation) * sindg(azimuth)
    z = sindg(elevation)
    rolled_y = cosdg(roll_deg) * y - sindg(roll_deg) * z
    rolled_z = sindg(roll_deg) * y + cosdg(roll_deg) * z
    return float(x), float(rolled_y), float(rolled_z)


def _check_columns(row: SiteRow, scenario: Scenario) -> None:
    """InputError for a missing column, or a list or table where a text is expected."""
    required: tuple[str, ...] = site_files.REQUIRED_COLUMNS
    if row.heights_m or scenario.sites.heights_m:
        required = tuple(key for key in required if key != "z_m")
    for key in required:
        if row.columns.get(key) in (None, ""):
            hint = f"A row needs the columns {', '.join(site_files.REQUIRED_COLUMNS)}."
            raise InputError(row.where, f"{key} is missing", hint)
    for key in ("site", *site_files.TEXT_COLUMNS):
        value = row.columns.get(key)
        if isinstance(value, bool | list | dict):
            raise InputError(f"{row.where}: {key}", f"expected text, got {repr(value)[:80]}")


def _mount_request(row: SiteRow, scenario: Scenario, *, is_inverted: bool) -> MountRequest:
    keys = [key for key in site_files.NUMBER_COLUMNS if row.columns.get(key) not in (None, "")]
    values = parse_each(keys, lambda key: _parse_number(row.where, key, row.columns[key]), "sites")
    numbers = dict(zip(keys, values, strict=True))
    heights_m = row.heights_m
    ground_m = numbers.get("ground_m", 0.0)
    if not heights_m and "z_m" in numbers:
        heights_m = (numbers["z_m"],)
        if ground_m:
            problem = f"the row has ground_m = {ground_m:g} and z_m, which already contains the ground's z"
            raise InputError(f"{row.where}: ground_m", problem, "Use ground_m with sites.heights_m, or z_m alone.")
    pitch_deg = numbers.get("pitch_deg")
    if pitch_deg is not None and not -90 <= pitch_deg <= 90:
        problem = f"expected an angle between -90 and 90, got {pitch_deg:g}"
        raise InputError(f"{row.where}: pitch_deg", problem, "Nose up is positive.")
    aim_m = _row_aim_m(row, numbers, scenario)
    yaw_deg = numbers.get("yaw_deg")
    if aim_m is not None and yaw_deg is not None:
        raise InputError(f"{row.where}: yaw_deg", f"the row has yaw_deg = {yaw_deg:g} and an aim", "Use one of them.")
    roll_deg = numbers.get("roll_deg", scenario.sites.roll_deg)
    if is_inverted:
        roll_deg = wrap_deg(roll_deg + 180.0)
    return MountRequest(numbers["x_m"], numbers["y_m"], heights_m, yaw_deg, pitch_deg, roll_deg, aim_m, ground_m)


def _row_aim_m(row: SiteRow, numbers: Mapping[str, float], scenario: Scenario) -> Vec3 | None:
    """The point that a row aims at: the centre of the region of interest, or any point; None without an aim."""
    where = f"{row.where}: aim"
    center_m = scenario.roi.center_m
    aim = row.columns.get("aim") or None
    if aim not in (None, "roi"):
        raise InputError(where, f"expected 'roi', got {aim!r}", "For a point, use the columns aim_x_m and aim_y_m.")
    has_point = any(key in numbers for key in site_files.AIM_COLUMNS)
    if aim and has_point:
        raise InputError(where, "the row aims at 'roi' and at a point", "Use one of them.")
    if aim:
        return center_m
    if not has_point:
        return None
    if "aim_x_m" not in numbers or "aim_y_m" not in numbers:
        raise InputError(where, "one of aim_x_m and aim_y_m is missing", "Give both.")
    return numbers["aim_x_m"], numbers["aim_y_m"], numbers.get("aim_z_m", center_m[2])


def _parse_number(where: str, key: str, value: Any) -> float:
    number = site_files.number_or_nan(value)
    if not abs(number) <= MAX_COORDINATE_M or isinstance(value, bool):
        problem = f"expected a finite number of at most {MAX_COORDINATE_M:g}, got {repr(value)[:80]}"
        raise InputError(f"{where}: {key}", problem)
    return number


def _grid_rows(rule: SiteGrid) -> Iterator[SiteRow]:
    reason = f"spacing_m = {rule.spacing_m:g}"
    axes = []
    for low, high in zip(rule.low_m, rule.high_m, strict=True):
        steps = (high - low) / rule.spacing_m + 1e-9
        site_files.check_site_count(steps, "sites.grid", reason)
        count = math.floor(steps) + 1
        axes.append([low + i * rule.spacing_m for i in range(count)])
    xs, ys = axes
    site_files.check_site_count(len(xs) * len(ys), "sites.grid", reason)
    points = [(x, y, rule.heights_m) for y in ys for x in xs]
    yield from _numbered_rows("g", points, "sites.grid")


def _line_rows(rules: tuple[SiteLine, ...]) -> Iterator[SiteRow]:
    points: list[tuple[float, float, tuple[float, ...]]] = []
    for rule in rules:
        reason = f"spacing_m = {rule.spacing_m:g}"
        line = np.asarray(rule.line_m)
        stations_m = polylines.stations_m(line)
        site_files.check_site_count(float(stations_m[-1]) / rule.spacing_m, "sites.along", reason)
        count = math.floor(stations_m[-1] / rule.spacing_m + 1e-9) + 1
        site_files.check_site_count(len(points) + count, "sites.along", reason)
        at_m = np.arange(count) * rule.spacing_m
        points += [(float(x), float(y), rule.heights_m) for x, y in polylines.points_at(line, at_m)]
    yield from _numbered_rows("a", points, "sites.along")


def _numbered_rows(letter: str, points: list[tuple[float, float, tuple[float, ...]]], where: str) -> Iterator[SiteRow]:
    """Yield a row for each point of a rule, given by x, y and heights in metres."""
    width = max(2, len(str(len(points))))
    for number, (x_m, y_m, heights_m) in enumerate(points, start=1):
        name = f"{letter}{number:0{width}d}"
        yield SiteRow(f"{where}: {name}", {"site": name, "x_m": x_m, "y_m": y_m}, heights_m)
