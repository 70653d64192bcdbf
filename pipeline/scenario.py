"""What does a scenario say, and is it sound?

A scenario is a folder with a ``scenario.toml`` and the files that it names. The frozen models below are its only
definition: each key with its unit in its name, each default written once. ``data_schemas/scenario.schema.json`` is made from them.

Steps of :func:`load`: read the TOML file, lay the ``--set`` overrides over it, validate. Files that it names are
found relative to the folder; ``$SUMO_HOME/`` in front names a file that SUMO ships.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import json
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    Field,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from pipeline.checked import Checked
from pipeline.errors import InputError, MissingBackendError
from pipeline.grid import Grid, Roi

FILE = "scenario.toml"
_SUMO = "$SUMO_HOME/"

FARTHEST_M = 1e8
"""Coordinates beyond this are a mistake: the Earth is 4e7 m round."""

Positive = Annotated[float, Field(gt=0)]
Coordinate = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]
NotNegative = Annotated[float, Field(ge=0)]
Point2 = tuple[Coordinate, Coordinate]
Point3 = tuple[Coordinate, Coordinate, Coordinate]
Name = Annotated[str, Field(min_length=1, pattern=r"^[^\s/\\:*?\"<>|]+$")]


class RoiModel(Checked):
    """The region of interest, a box in the world frame, and the voxels that it is cut into."""

    center_m: Point3 = Field(description="Centre of the box, world frame (x east, y north, z up)")
    size_m: tuple[Positive, Positive, Positive] = Field(description="Size along x, y, z; a whole number of voxels each")
    voxel_m: Positive = Field(0.25, description="Edge length of a voxel")

    @property
    def box(self) -> Roi:
        """The box alone, without voxels."""
        return Roi.around(self.center_m, self.size_m)

    @property
    def grid(self) -> Grid:
        """The box cut into voxels; raises InputError when they do not fit."""
        return Grid.over(self.box, self.voxel_m)


class VehicleKind(Checked):
    """One row of the fleet: a SUMO vType with its real size and its share of the trips."""

    name: Name = Field(description="Identifier of the SUMO vType; for a finished FCD file, the type that it names")
    vclass: str = Field("passenger", description="SUMO vClass")
    share: Positive = Field(1.0, description="Share of the trips, relative to the other kinds")
    length_m: Positive
    width_m: Positive
    height_m: Positive
    attributes: dict[str, str | float] = Field(
        default_factory=dict, description="Further attributes of the SUMO vType, under SUMO's own names"
    )


_FLEET = (
    VehicleKind(name="car", share=0.78, length_m=4.5, width_m=1.75, height_m=1.5),
    VehicleKind(name="van", vclass="delivery", share=0.12, length_m=4.9, width_m=1.9, height_m=2.1),
    VehicleKind(name="truck", vclass="truck", share=0.07, length_m=7.6, width_m=2.3, height_m=3.0),
    VehicleKind(name="bus", vclass="bus", share=0.03, length_m=10.9, width_m=2.5, height_m=3.1),
)


class TrafficModel(Checked):
    """Where vehicles come from: a network (with drawn or given demand), a SUMO configuration, or a finished FCD file."""

    network: str | None = Field(None, description="A .net.xml(.gz) or an OpenStreetMap file; may start with $SUMO_HOME/")
    routes: tuple[str, ...] = Field((), description="Route files for the network; none: trips are drawn between its fringe edges")
    sumocfg: str | None = Field(None, description="A .sumocfg that names network and demand")
    fcd: str | None = Field(None, description="A finished FCD file (XML, CSV or Parquet, may be gzipped); nothing is simulated")
    vehicles: int = Field(50, ge=1, description="Vehicles in the whole network at all times")
    hold: Literal["exactly", "at_most"] = Field("exactly", description="Whether a frame with fewer vehicles is an error")
    frames: int = Field(5000, ge=1, le=2**32 - 1, description="Frames to record")
    frame_period_s: Positive = Field(1.0, description="Time between two frames; a whole number of steps")
    step_s: Positive = Field(0.25, description="SUMO's step length")
    warmup_s: float = Field(300.0, ge=0, description="Time before the first frame")
    lateral_resolution_m: float = Field(0.8, ge=0, description="SUMO's sublane width; 0 makes lane changes instant jumps")
    trips_per_s: Positive = Field(2.0, description="Rate of drawn trips; more than the network takes, so that N is held")
    max_depart_delay_s: Positive = Field(120.0, description="A trip that could not start for so long is given up")
    min_trip_m: float = Field(0.0, ge=0, description="Drawn trips are at least so long as the crow flies")
    edge_weights: dict[str, Annotated[float, Field(ge=0)]] = Field(
        default_factory=dict,
        description="Drawn trips that start or end at an edge, relative to others; its number of lanes if not named",
    )
    kinds: tuple[VehicleKind, ...] = Field(
        _FLEET, min_length=1, description="The fleet of drawn trips; the sizes in a finished FCD file"
    )

    @model_validator(mode="after")
    def _one_source(self) -> TrafficModel:
        given = [key for key in ("network", "sumocfg", "fcd") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(f"exactly one of network, sumocfg and fcd is needed, found {' and '.join(given) or 'none'}")
        names = [kind.name for kind in self.kinds]
        if len(set(names)) != len(names):
            raise ValueError(f"two kinds have the same name: {', '.join(sorted({n for n in names if names.count(n) > 1}))}")
        return self

    @model_validator(mode="after")
    def _not_endless(self) -> TrafficModel:
        lasts_s = self.warmup_s + self.frames * self.frame_period_s
        for what, amount, most in (
            ("frames", self.frames, 10_000_000),
            ("seconds of traffic", lasts_s, 1e7),
            ("drawn trips (trips_per_s times these seconds)", lasts_s * self.trips_per_s, 1e7),
        ):
            if amount > most:
                raise ValueError(f"{amount:,.0f} {what}: at most {most:,.0f} can be handled")
        return self

    def idle_keys(self) -> tuple[str, set[str]]:
        """The source of the traffic, and the keys that the user set although they act on nothing with this source."""
        drawn = {"trips_per_s", "min_trip_m", "edge_weights", "kinds"}
        simulated = {"vehicles", "hold", "step_s", "lateral_resolution_m", "max_depart_delay_s"}
        if self.fcd is not None:
            return "fcd", self.model_fields_set & ({"routes"} | simulated | drawn - {"kinds"})
        if self.sumocfg is not None:
            return "sumocfg", self.model_fields_set & ({"routes"} | drawn)
        return "routes", self.model_fields_set & (drawn if self.routes else set())


class MeshModel(Checked):
    """A triangle mesh that trimesh loads (PLY, OBJ, STL, GLB), in metres, z up."""

    file: str
    offset_m: Point3 = Field((0.0, 0.0, 0.0), description="Added to every vertex to reach the world frame")
    kind: Name = Field("mesh", description="Shown in messages and in the report")


class StaticsModel(Checked):
    """The static world."""

    footprints: tuple[str, ...] = Field(
        (), description="GeoJSON files in world-frame metres; features have height_m and may have base_m, radius_m"
    )
    polygons: tuple[str, ...] = Field((), description="SUMO .poly.xml files")
    polygon_height_m: Positive = Field(9.0, description="Height of polygons that name none")
    meshes: tuple[MeshModel, ...] = ()
    ground: bool = Field(True, description="A ground plane at z = 0")


class TpogModel(Checked):
    """How frames are counted."""

    blocks: int = Field(10, ge=1, le=65535, description="Blocks of consecutive frames; divides traffic.frames")


_OPTICS = ("wavelength_nm", "divergence_mrad", "rated_range_m", "rated_reflectivity")


_MOST_BEAMS = 10_000_000


class SensorModel(Checked):
    """A sensor of the user's. Elevations are listed, or uniform between two when ``channels`` is given."""

    elevations_deg: tuple[Annotated[float, Field(ge=-90, le=90)], ...] = Field(
        min_length=1, description="One a ring; or the first and the last of `channels` uniform ones"
    )
    channels: int | None = Field(None, ge=1, description="Rings, uniform between two elevations_deg")
    azimuth_offsets_deg: tuple[float, ...] = Field((), description="One a ring, added to each azimuth; none: all 0")
    azimuth_step_deg: Positive = Field(description="Divides 360")
    range_m: Positive
    wavelength_nm: Positive | None = Field(None, description="Of the laser; only effects ask")
    divergence_mrad: tuple[NotNegative, NotNegative] | None = Field(
        None, description="Full angle of a beam across and along the elevation; only effects ask"
    )
    rated_range_m: Positive | None = Field(
        None, description="A target of rated_reflectivity, met squarely, is just noticed here; only effects ask"
    )
    rated_reflectivity: Positive | None = Field(None, description="See rated_range_m; only effects ask")

    @property
    def optics(self) -> dict[str, Any]:
        """What the user said of the laser and the receiver; :class:`pipeline.sensors.Sensor` knows the rest."""
        said = {name: getattr(self, name) for name in _OPTICS}
        return {name: value for name, value in said.items() if value is not None}

    @model_serializer(mode="wrap")
    def _said(self, plain: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without the optics that the user left out: what no effect asks for changes no artefact."""
        return {name: value for name, value in plain(self).items() if name not in _OPTICS or value is not None}

    @model_validator(mode="after")
    def _consistent(self) -> SensorModel:
        listed = len(self.elevations_deg)
        if self.channels not in (None, listed) and listed != 2:
            raise ValueError(
                f"channels = {self.channels} needs elevations_deg with 2 values (uniform) or {self.channels}, found {listed}"
            )
        rings = self.channels or listed
        if rings * 360.0 / self.azimuth_step_deg > _MOST_BEAMS:
            raise ValueError(f"{rings} rings every {self.azimuth_step_deg:g} degrees are more than {_MOST_BEAMS:,} beams")
        if self.azimuth_offsets_deg and len(self.azimuth_offsets_deg) != rings:
            raise ValueError(
                f"azimuth_offsets_deg has {len(self.azimuth_offsets_deg)} values, one for each of {rings} rings is needed"
            )
        turns = 360.0 / self.azimuth_step_deg
        if abs(turns - round(turns)) > 1e-9 * turns:
            raise ValueError(f"azimuth_step_deg = {self.azimuth_step_deg:g} does not divide 360")
        return self


class SiteGrid(Checked):
    """Sites on a square lattice."""

    low_m: Point2 = Field(description="South-west corner, where the first site stands")
    high_m: Point2 = Field(description="No site beyond this corner")
    spacing_m: Positive
    heights_m: tuple[Positive, ...] = Field(min_length=1)


class SiteLine(Checked):
    """Sites along a line, the first at its start."""

    line_m: tuple[Point2, ...] = Field(min_length=2)
    spacing_m: Positive
    heights_m: tuple[Positive, ...] = Field(min_length=1)


class SitesModel(Checked):
    """Candidate sites: a file, or a rule. Pose and sensor below hold for every site that names none of its own."""

    file: str | None = Field(None, description="CSV (site, x_m, y_m, z_m, ...) or GeoJSON points")
    grid: SiteGrid | None = None
    along: tuple[SiteLine, ...] = ()
    points: str | None = Field(None, description="A measured empty scan (PCD, PLY, LAS, LAZ, CSV; world frame) of the only site")
    sensor: str = Field("VLP-32C", description="A name from `egvs sensors` or from [sensors]")
    yaw_deg: float = Field(0.0, description="The sensor's x axis, counter-clockwise from +x")
    pitch_deg: float = Field(0.0, ge=-90, le=90, description="Nose up positive")
    roll_deg: float = 0.0

    @model_validator(mode="after")
    def _one_source(self) -> SitesModel:
        given = [key for key in ("file", "grid", "along") if getattr(self, key)]
        if len(given) != 1:
            raise ValueError(f"exactly one of file, grid and along is needed, found {' and '.join(given) or 'none'}")
        return self


class ScanModel(Checked):
    """How empty scans are kept."""

    keep: bool = Field(True, description="false: no scans.parquet; score casts as it goes, for sweeps over thousands of sites")


class ScoreModel(Checked):
    """How a site is scored."""

    gamma: float = Field(10.0, ge=0, allow_inf_nan=True, description="Beams in a voxel above this number count no more; may be inf")
    keep_visibility: tuple[str, ...] | Literal["all"] = Field(
        (), description="Sites whose hits in every voxel are written to visibility.parquet"
    )
    standard_error: bool = Field(True, description="Say how far each score may be off because the traffic was short")


class Scenario(Checked):
    """Everything that a run depends on. Made by :func:`load`."""

    name: Name = Field("", min_length=0, validate_default=False, description="Defaults to the folder's name")
    description: str = ""
    extends: str = Field(
        "", description="A scenario folder whose keys hold where this one says nothing; tables merge, lists replace"
    )
    seed: int = Field(0, ge=0, le=2**63 - 1, description="The one seed; all randomness derives from it")
    roi: RoiModel
    traffic: TrafficModel
    statics: StaticsModel = StaticsModel()
    tpog: TpogModel = TpogModel()
    sites: SitesModel
    sensors: dict[str, SensorModel] = Field(default_factory=dict)
    scan: ScanModel = ScanModel()
    score: ScoreModel = ScoreModel()
    effects: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="What goes beyond the plain scene; `egvs effects` prints names and parameters"
    )

    _folders: tuple[Path, ...] = PrivateAttr(default=(Path(),))

    @model_validator(mode="after")
    def _across(self) -> Scenario:
        if self.traffic.frames % self.tpog.blocks:
            raise ValueError(f"tpog.blocks = {self.tpog.blocks} does not divide traffic.frames = {self.traffic.frames}")
        return self

    @property
    def folder(self) -> Path:
        """The folder that relative file names start from."""
        return self._folders[0]

    @property
    def file(self) -> Path:
        """The scenario file, for messages."""
        return self.folder / FILE

    def with_effects(self, effects: dict[str, dict[str, Any]]) -> Scenario:
        """The same scenario with these effects instead of its own."""
        other = self.model_copy(update={"effects": effects})
        other._folders = self._folders
        return other

    def find(self, name: str, key: str) -> Path:
        """The file that the scenario, or one that it extends, names under ``key``; InputError when it is not there."""
        folders = (sumo_home(),) if name.startswith(_SUMO) else self._folders
        for folder in folders:
            if (path := folder / name.removeprefix(_SUMO)).is_file():
                return path
        shown = folders[0] / name.removeprefix(_SUMO)
        raise InputError(f"{self.file}: {key} = {name!r}", f"no such file ({shown})", "a path relative to the scenario's folder")


def sumo_home() -> Path:
    """SUMO's home: the environment's SUMO_HOME, else the installed wheel's."""
    if home := os.environ.get("SUMO_HOME"):
        return Path(home)
    spec = importlib.util.find_spec("sumo")
    if spec is None or not spec.submodule_search_locations:
        raise MissingBackendError("SUMO is not installed: set SUMO_HOME, or pip install eclipse-sumo")
    return Path(spec.submodule_search_locations[0])


def load(path: str | Path, overrides: Iterable[str] = ()) -> Scenario:
    """Read and check a scenario.

    Parameters
    ----------
    path
        The folder, or its ``scenario.toml``.
    overrides
        ``"key.key=value"``, the value as in TOML (a bare word is taken as a string).

    Raises
    ------
    InputError
        Naming file, key, value, and what would be right.
    """
    path = Path(path)
    file = path / FILE if path.is_dir() else path
    values = _read(file, ())
    for override in overrides:
        if override.partition("=")[0].strip() == "extends":
            raise InputError(f"--set {override}", "a scenario is extended by its file alone", "extends = ... in a scenario.toml")
        _lay_over(values, override)
    scenario = from_values(values, file.parent, str(file))
    if scenario.effects:
        registry = importlib.import_module("pipeline.effects")
        for name, parameters in scenario.effects.items():
            registry.make(name, parameters, f"{file}: effects")
    source, idle = scenario.traffic.idle_keys()
    if idle:
        raise InputError(f"{file}: traffic", f"{', '.join(sorted(idle))} would act on nothing beside {source}", "remove it")
    return scenario


def _read(file: Path, heirs: tuple[Path, ...]) -> dict[str, Any]:
    """The values of a scenario file, laid over those of the scenario that it extends."""
    if not file.is_file():
        raise InputError(
            file.parent if file.name == FILE else file, f"no {FILE} there", f"a folder with a {FILE}, or the file itself"
        )
    if file.resolve() in heirs:
        raise InputError(f"{file}: extends", "leads back to itself", "a scenario that does not extend this one")
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(file, f"is not valid TOML: {error}") from None
    if not isinstance(base := values.get("extends", ""), str):
        raise InputError(f"{file}: extends", f"{base!r}", "the path of a scenario's folder")
    return _merged(_read(file.parent / base / FILE, (*heirs, file.resolve())), values) if base else values


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(below.get(key), dict)
        merged[key] = _merged(below[key], value) if both else value
    return merged


def _bases(folder: Path, extends: str, place: str) -> Iterator[Path]:
    """The scenario's folder, then those of the scenarios that it extends."""
    yield folder
    while extends:
        folder = folder / extends
        if not (folder / FILE).is_file():
            raise InputError(f"{place}: extends", f"no {FILE} in {folder}", "the path of a scenario's folder")
        yield folder
        extends = tomllib.loads((folder / FILE).read_text(encoding="utf-8")).get("extends", "")


def from_values(values: dict[str, Any], folder: Path, place: str) -> Scenario:
    """Check a scenario that is at hand as nested values (as ``run.json`` holds it)."""
    values.setdefault("name", re.sub(r'[\s/\\:*?"<>|]+', "_", folder.resolve().name) or "scenario")
    try:
        scenario = Scenario.of(values)
    except ValidationError as error:
        raise _explain(error, place) from None
    scenario._folders = tuple(_bases(folder, scenario.extends, place))
    Grid.over(scenario.roi.box, scenario.roi.voxel_m, f"{place}: roi")
    return scenario


def json_schema() -> str:
    """The JSON Schema that editors use to complete and check a scenario.toml."""
    return json.dumps(Scenario.model_json_schema(), indent=2, ensure_ascii=False) + "\n"


def _lay_over(values: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise InputError(f"--set {override}", "no key=value", "for example --set traffic.frames=500")
    try:
        value = tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        value = text
    *parents, last = key.strip().split(".")
    for parent in parents:
        values = values.setdefault(parent, {})
        if not isinstance(values, dict):
            raise InputError(f"--set {override}", f"'{parent}' is not a table", "a key that the scenario knows")
    values[last] = value


def _explain(error: ValidationError, place: str) -> InputError:
    """One line for each thing that is wrong: key, value, what would be right."""
    lines = []
    for item in error.errors():
        key = ".".join(str(part) for part in item["loc"])
        if item["type"] == "extra_forbidden":
            lines.append((key, "unknown key", _nearest(item["loc"])))
        elif item["type"] == "missing":
            lines.append((key, "missing", "this key is needed"))
        elif item["type"] == "value_error":
            lines.append((key or "scenario", str(item["ctx"]["error"]), ""))
        else:
            lines.append((key, f"{item['input']!r}", item["msg"][0].lower() + item["msg"][1:]))
    key, found, right = lines[0]
    more = "".join(f"\n{place}: {k}: {f}" + (f"; {r}" if r else "") for k, f, r in lines[1:])
    return InputError(f"{place}: {key}", found, right + more)


def _nearest(loc: Sequence[str | int]) -> str:
    """What the user may have meant by an unknown key."""
    model: type[BaseModel] | None = Scenario
    for part in loc[:-1]:
        if model is not None and part in model.model_fields:
            model = _model_of(model.model_fields[str(part)].annotation)
    known = sorted(model.model_fields) if model is not None else []
    near = difflib.get_close_matches(str(loc[-1]), known, 1, 0.5)
    return f"did you mean {near[0]}?" if near else f"known here are {', '.join(known)}"


def _model_of(annotation: Any) -> type[BaseModel] | None:
    """The model inside an annotation such as ``tuple[SiteLine, ...]`` or ``SiteGrid | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        if found := _model_of(inner):
            return found
    return None
