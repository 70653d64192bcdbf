"""The definition of a scenario: all keys with their units, limits and defaults.

A scenario is a folder with a ``scenario.toml`` and the files that it names. The tables ``[traffic]``, ``[sensors]``,
``[effects]``, ``[score]``, ``[placement]`` and ``[costs]`` are defined in modules of their own in this package.
``data_schemas/scenario.schema.json`` and ``docs/scenario-keys.md`` are made from these models: the docstrings of the
tables and the descriptions of the keys are user documentation. :mod:`egvs.scenario.loading` reads the file.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    Field,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from egvs.core.errors import InputError
from egvs.core.grid import Grid, Roi
from egvs.core.sumo_home import sumo_home
from egvs.scenario.effects_config import EffectsConfig
from egvs.scenario.fields import Latitude, Longitude, Name, Point2, Point3, Positive, SensorMount, StrictModel
from egvs.scenario.score_config import CostsConfig, PlacementConfig, ScoreConfig, default_gamma
from egvs.scenario.sensor_config import SensorConfig
from egvs.scenario.traffic_config import TrafficConfig
from egvs.scenario.what_if_config import WhatIfConfig


class CrsConfig(StrictModel):
    """Position of the world frame on the Earth. By default, that of the ``<location>`` in the SUMO network."""

    epsg: int | None = Field(
        None, ge=1, description="EPSG code of a projected coordinate reference system in metres, e.g. 25832"
    )
    offset_m: Point2 = Field((0.0, 0.0), description="Added to easting and northing to get x, y (SUMO's netOffset)")
    zero_height_m: float = Field(
        0.0, ge=-12_000, le=9_000, description="Height of z = 0 in measured scans that declare their CRS"
    )

    @model_validator(mode="after")
    def _check_offset(self) -> CrsConfig:
        if self.epsg is None and self.offset_m != (0.0, 0.0):
            raise ValueError("offset_m needs epsg: the <location> of a network has its own offset")
        return self


BodyKind = Literal["sedan", "kei", "taxi", "van", "truck", "bus", "tractor", "trailer", "pedestrian", "bicycle"]
"""Kinds of bodies in simulated point clouds."""


class ValidationConfig(StrictModel):
    """Simulated point clouds for validation against detectors."""

    bodies: dict[BodyKind, str] = Field(
        default_factory=dict,
        description="Mesh file (PLY, OBJ, STL or GLB; x ahead, y left, z up) for a kind of body, scaled to each "
        "vehicle. By default a built-in mesh",
    )


SCENARIO_FILE = "scenario.toml"
_SUMO_HOME_PREFIX = "$SUMO_HOME/"
_MAX_NAME_LENGTH = 1000


class RoiConfig(StrictModel):
    """The region of interest: a box in the world frame, divided into voxels."""

    center_m: Point3 = Field(description="Centre of the box in the world frame (x east, y north, z up)")
    size_m: tuple[Positive, Positive, Positive] = Field(description="Size along x, y, z; each a whole number of voxels")
    voxel_m: Positive = Field(0.25, description="Edge length of a voxel")

    @property
    def box(self) -> Roi:
        """The box, without voxels."""
        return Roi.around(self.center_m, self.size_m)

    @property
    def grid(self) -> Grid:
        """The voxels of the box; InputError when the size is not a whole number of voxels."""
        return Grid.over(self.box, self.voxel_m)


class MeshConfig(StrictModel):
    """A triangle mesh in metres, z up (PLY, OBJ, STL or GLB)."""

    file: str = Field(description="File of the mesh")
    offset_m: Point3 = Field(
        (0.0, 0.0, 0.0), description="Added to each vertex, before the conversion by epsg or origin_deg"
    )
    epsg: int | None = Field(
        None, ge=1, description="EPSG code of the map projection of x, y. By default the world frame"
    )
    origin_deg: tuple[Longitude, Latitude] | None = Field(
        None, description="Longitude and latitude of the origin, if x, y are metres to the east and north of it"
    )
    kind: Name = Field("mesh", description="Kind of solid, shown in messages and in the report")

    @model_validator(mode="after")
    def _check_crs(self) -> MeshConfig:
        if self.epsg is not None and self.origin_deg is not None:
            raise ValueError("expected epsg or origin_deg, got both")
        return self

    @property
    def crs(self) -> str | None:
        """Coordinate reference system of x, y in the notation of PROJ; None for the world frame."""
        if self.origin_deg is not None:
            lon_deg, lat_deg = self.origin_deg
            return f"+proj=aeqd +lon_0={lon_deg!r} +lat_0={lat_deg!r} +datum=WGS84 +units=m +no_defs +type=crs"
        if self.epsg is not None:
            return f"EPSG:{self.epsg}"
        return None


POLE_POSITIONS = "positions of the poles"
"""Entry of the key ``assumed``: no candidate pole is known to exist."""

NO_SURROUNDINGS = "surroundings (no building or tree is known)"
"""Entry of the key ``assumed``: no map has anything that could hide vehicles."""

TERRAIN_KEY = "statics.terrain"
"""The key of the file with the ground beyond the roads."""


class StaticsConfig(StrictModel):
    """The static world: everything that does not move and that beams can hit."""

    footprints: tuple[str, ...] = Field(
        (),
        description="GeoJSON files that declare their crs (null: world-frame metres), or GeoPackage, Shapefile,"
        " GeoParquet, KML; features have height_m and may have base_m, radius_m",
    )
    polygons: tuple[str, ...] = Field((), description="SUMO .poly.xml files; polygons are solid or not by their type")
    polygon_height_m: Positive = Field(
        9.0, description="Height of solid polygons that have no height and whose type has none"
    )
    polygon_types: dict[str, Positive | Literal["solid", "ignore"]] = Field(
        default_factory=dict,
        description='Overrides of the built-in table of solid types: a height in metres, "solid" or "ignore" for a '
        'type, e.g. "building.shed" = 2.2. The type "" stands for all types that no table lists',
    )
    meshes: tuple[MeshConfig, ...] = ()
    ground: bool = Field(True, description="Add a ground plane at z = 0")
    terrain: str | None = Field(
        None,
        description="PLY file with points of the ground beyond the roads, world frame; the traffic must have a network",
    )

    @model_serializer(mode="wrap")
    def _serialize(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out terrain where it is not set, so that it does not change cache keys."""
        return {name: value for name, value in serialize(self).items() if name != "terrain" or value is not None}

    @field_validator("polygon_types", mode="before")
    @classmethod
    def _flatten_types(cls, values: Any) -> Any:
        """Accept ``building.shed = 2.2`` without quotes, which TOML reads as a table in a table."""
        return dict(_flatten(values, "")) if isinstance(values, dict) else values


def _flatten(values: dict[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
            continue
        is_number = isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < inf
        if not is_number and value not in ("solid", "ignore"):
            expected = '"solid", "ignore" or a height in metres above 0'
            raise ValueError(f"expected {expected} for {json.dumps(prefix + key)}, got {json.dumps(value)}")
        yield prefix + key, value


MAX_BLOCKS = 65535
"""Limit for the blocks of all periods together: ``tpog.parquet`` numbers them in 16 bits."""


class TpogConfig(StrictModel):
    """The traffic-probability occupancy grid (TPOG)."""

    blocks: int = Field(
        10, ge=1, le=MAX_BLOCKS, description="Number of blocks of consecutive frames; it must divide traffic.frames"
    )


class SiteGrid(StrictModel):
    """Candidate sites on a square grid."""

    low_m: Point2 = Field(description="South-west corner, with the first site")
    high_m: Point2 = Field(description="North-east corner; no site is beyond it")
    spacing_m: Positive = Field(description="Distance between neighbouring sites")
    heights_m: tuple[Positive, ...] = Field(min_length=1, description="Heights z; each is a candidate")


class SiteLine(StrictModel):
    """Candidate sites along a line, the first at its start."""

    line_m: tuple[Point2, ...] = Field(min_length=2, description="Points of the line in the world frame")
    spacing_m: Positive = Field(description="Distance between neighbouring sites along the line")
    heights_m: tuple[Positive, ...] = Field(min_length=1, description="Heights z; each is a candidate")


SITE_DIRECTIONS = ("aim", "aim_m", "yaw_deg")
"""Keys that set the direction of sensors; at most one may be set."""

SITE_SENSORS = ("sensor", "replace_sensor")
"""Keys that set the sensor of sites; the second one leaves no site to the first."""

SITE_SOURCES = ("file", "grid", "along")
"""Keys that set where candidate sites come from; exactly one must be set."""

Pitch = Annotated[float, Field(ge=-90, le=90)] | Literal["aim"]


class SitesConfig(StrictModel):
    """Candidate sites: a file, or a rule. Sensor and angles are defaults for sites that do not set their own."""

    file: str | None = Field(
        None,
        description="Table (CSV, xlsx, ods) with site, x_m, y_m, z_m, ..., or points in GeoJSON, GeoPackage, Shapefile,"
        " GeoParquet or KML",
    )
    grid: SiteGrid | None = None
    along: tuple[SiteLine, ...] = ()
    only_free: bool = Field(True, description="Drop sites of grid and along in lanes, junctions and solids")
    points: str | None = Field(
        None, description="Measured empty scan of the only site (PCD, PLY, LAS, LAZ, E57, CSV; world frame)"
    )
    sensor: str | Annotated[tuple[str, ...], Field(min_length=1)] = Field(
        "VLP-32C", description="A sensor from `egvs sensors` or from [sensors]; each of a list is a candidate"
    )
    replace_sensor: str | None = Field(
        None, description="A sensor for all sites, also for those whose row names another one"
    )
    heights_m: tuple[Positive, ...] = Field(
        (),
        description="Heights of locations in `file` that have no z_m, above their ground_m (0 without it); each is a"
        " candidate",
    )
    aim: Literal["roi"] | None = Field(
        None, description="'roi': yaw and pitch such that the central beam hits the centre of the region of interest"
    )
    aim_m: Point2 | Point3 | None = Field(
        None, description="Aim at this point instead; without z, at the height of the region's centre"
    )
    yaw_deg: float | None = Field(
        None, description="Yaw of the sensor's x axis, counter-clockwise from +x. By default 0, or set by the aim"
    )
    pitch_deg: Pitch | tuple[Pitch, ...] | None = Field(
        None,
        description="Pitch, positive for nose up, or 'aim'; each value of a list is a candidate. By default 'aim' for "
        "sites that are aimed, else 0",
    )
    roll_deg: float = Field(0.0, description="Roll about the sensor's x axis; from upside down, if it is inverted")
    mount: SensorMount | None = Field(
        None, description="'inverted': upside down, with the front in the same direction. By default that of the sensor"
    )
    existing_poles: tuple[str, ...] | Literal["all"] = Field(
        (), description="Names of poles that exist, or 'all': they cost nothing, and their positions are not assumed"
    )

    @model_serializer(mode="wrap")
    def _serialize(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out newer keys where they are not set, so that they do not change cache keys."""
        values: dict[str, Any] = serialize(self)
        for name in ("replace_sensor", "mount", "existing_poles"):
            if not values.get(name):
                values.pop(name, None)
        return values

    @model_validator(mode="after")
    def _check_source(self) -> SitesConfig:
        sources = [key for key in SITE_SOURCES if getattr(self, key)]
        if len(sources) != 1:
            raise ValueError(f"expected exactly one of file, grid and along, got {' and '.join(sources) or 'none'}")
        if self.file is not None and not self.only_free:
            raise ValueError("only_free has no effect with file: all sites of a file are used")
        if self.heights_m and self.file is None:
            raise ValueError(f"heights_m has no effect with {sources[0]}. Set {sources[0]}.heights_m")
        return self

    @model_validator(mode="after")
    def _check_direction(self) -> SitesConfig:
        directions = [key for key in SITE_DIRECTIONS if getattr(self, key) is not None]
        if len(directions) > 1:
            raise ValueError(f"expected at most one of aim, aim_m and yaw_deg, got {' and '.join(directions)}")
        for key in ("heights_m", "pitch_deg", "sensor"):
            values = getattr(self, key)
            if isinstance(values, tuple) and len(set(values)) < len(values):
                raise ValueError(f"{key} = {list(values)} contains a value twice")
        if self.pitch_deg == ():
            raise ValueError("pitch_deg = [] leaves no candidate")
        return self


class ScanConfig(StrictModel):
    """Empty scans: scans of the static world without traffic."""

    keep: bool = Field(
        True, description="Write scans.parquet; with false, scans are not saved (for thousands of sites)"
    )


_SEEDS_STREAM = 1_000_000
"""Spawn key of the seeds of ``traffic.seeds``; one simulation spawns far fewer child sequences from its seed."""


class Scenario(StrictModel):
    """Everything that the results of a run depend on; made by :func:`egvs.scenario.loading.load`."""

    name: Name = Field("", min_length=0, validate_default=False, description="By default the name of the folder")
    description: str = Field("", description="Shown in the report")
    assumed: tuple[str, ...] = Field(
        (),
        description="What is assumed rather than measured; shown with the ranking. Remove what you have replaced",
    )
    extends: str = Field(
        "", description="Folder of a scenario that supplies keys not set here; tables are merged, lists replaced"
    )
    seed: int = Field(0, ge=0, le=2**63 - 1, description="Seed of all random numbers")
    crs: CrsConfig = CrsConfig()
    roi: RoiConfig
    traffic: TrafficConfig
    statics: StaticsConfig = StaticsConfig()
    tpog: TpogConfig = TpogConfig()
    sites: SitesConfig
    sensors: dict[str, SensorConfig] = Field(default_factory=dict)
    scan: ScanConfig = ScanConfig()
    score: ScoreConfig = ScoreConfig()
    effects: EffectsConfig = EffectsConfig()
    costs: CostsConfig = CostsConfig()
    placement: PlacementConfig = PlacementConfig()
    validation: ValidationConfig = ValidationConfig()
    what_if: dict[Name, WhatIfConfig] = Field(default_factory=dict)

    _folders: tuple[Path, ...] = PrivateAttr(default=(Path(),))
    _period: str = PrivateAttr(default="")
    _period_keys: frozenset[str] = PrivateAttr(default=frozenset())
    _file_name: str = PrivateAttr(default=SCENARIO_FILE)
    _written_site_keys: frozenset[str] = PrivateAttr(default=frozenset())
    _overrides: dict[str, Any] = PrivateAttr(default_factory=dict)

    @model_serializer(mode="wrap")
    def _serialize(self, serialize: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what_if where it is empty, so that records of scenarios without it do not change."""
        return {name: value for name, value in serialize(self).items() if name != "what_if" or value}

    @model_validator(mode="after")
    def _check_tables_together(self) -> Scenario:
        blocks = self.tpog.blocks
        all_blocks = blocks * max(1, len(self.traffic.periods))
        if all_blocks > MAX_BLOCKS:
            raise ValueError(f"tpog.blocks = {blocks} gives {all_blocks} blocks in all periods, more than {MAX_BLOCKS}")
        seeds = self.traffic.seeds
        if blocks % seeds:
            near = f"{seeds * (blocks // seeds)} or " if blocks > seeds else ""
            raise ValueError(
                f"traffic.seeds = {seeds} does not divide tpog.blocks = {blocks}, and no block spans two simulations."
                f" Use tpog.blocks = {near}{seeds * (blocks // seeds + 1)}"
            )
        for period, traffic in self._traffic_by_period():
            if traffic.frames is not None and traffic.frames % blocks:
                suffix = f" of the period {period!r}" if period else ""
                below = traffic.frames - traffic.frames % blocks
                near = f"{below} or {below + blocks}" if below else f"{blocks}"
                raise ValueError(
                    f"tpog.blocks = {blocks} does not divide traffic.frames = {traffic.frames}{suffix}. Use"
                    f" traffic.frames = {near}, or other blocks"
                )
        occlusion = self.effects.named.get("moving_occlusion")
        if self.traffic.periods and getattr(occlusion, "method", "") == "frames":
            raise ValueError(
                'effects.moving_occlusion: method = "frames" cannot weight the periods of traffic. Use method ='
                ' "independent"'
            )
        return self

    def _traffic_by_period(self) -> list[tuple[str, TrafficConfig]]:
        """Name and traffic of each period; the complete traffic with an empty name when there are no periods."""
        if not self.traffic.periods:
            return [("", self.traffic)]
        return [(period.name, period.apply_to(self.traffic)) for period in self.traffic.periods]

    def by_period(self) -> dict[str, Scenario]:
        """Split the scenario by the periods of its traffic.

        Returns
        -------
        dict
            For each name of a period, a scenario with the traffic of this period and a seed of its own; this scenario
            with an empty name when there are no periods.
        """
        if not self.traffic.periods:
            return {"": self}
        scenarios = {}
        for number, (name, traffic) in enumerate(self._traffic_by_period()):
            period = self.traffic.periods[number]
            drawn = int(np.random.SeedSequence((self.seed, number)).generate_state(1, np.uint64)[0])
            scenario = self.model_copy(update={"traffic": traffic, "seed": drawn >> 1})
            scenario._period = name
            scenario._period_keys = frozenset(period.model_fields_set)
            scenarios[name] = scenario
        return scenarios

    def by_seed(self) -> tuple[Scenario, ...]:
        """Split a scenario without periods, or one of :meth:`by_period`, by ``traffic.seeds``.

        Returns
        -------
        tuple
            For each simulation, a scenario with an equal share of the frames. The first keeps the seed; the others have
            seeds from child sequences of it.
        """
        seeds = self.traffic.seeds
        if seeds == 1:
            return (self,)
        assert self.traffic.frames is not None, "several seeds are simulated"
        traffic = self.traffic.model_copy(update={"frames": self.traffic.frames // seeds, "seeds": 1})
        scenarios = []
        for number in range(seeds):
            seed = self.seed
            if number:
                sequence = np.random.SeedSequence(self.seed, spawn_key=(_SEEDS_STREAM, number))
                seed = int(sequence.generate_state(1, np.uint64)[0]) >> 1
            scenarios.append(self.model_copy(update={"traffic": traffic, "seed": seed}))
        return tuple(scenarios)

    @property
    def gamma(self) -> float:
        """``score.gamma``, with the number that "auto" stands for."""
        if self.score.gamma != "auto":
            return self.score.gamma
        return default_gamma(self.roi.voxel_m, moving_occlusion="moving_occlusion" in self.effects.named)

    @property
    def is_recorded(self) -> bool:
        """Whether the traffic, or that of a period, is a finished FCD file or recorded tracks."""
        return any(traffic.is_finished for _, traffic in self._traffic_by_period())

    @property
    def period(self) -> str:
        """The period of a scenario from :meth:`by_period`, else empty."""
        return self._period

    @property
    def period_keys(self) -> frozenset[str]:
        """The keys that the period of a scenario from :meth:`by_period` sets itself, else none."""
        return self._period_keys

    def with_site_sensor(self, name: str) -> Scenario:
        """Return the scenario with a sensor at all sites, as ``sites.replace_sensor`` sets it."""
        changed = self.model_copy(update={"sites": self.sites.model_copy(update={"replace_sensor": name})})
        changed._written_site_keys = self._written_site_keys - {"sensor"}
        return changed

    @property
    def written_site_keys(self) -> frozenset[str]:
        """The keys of ``[sites]`` that the user wrote; none for a scenario from ``run.json``, which has all keys."""
        return self._written_site_keys

    @property
    def overrides(self) -> dict[str, Any]:
        """The settings that ``--set`` gave other values than the file has, by full key; None for a removed one."""
        return self._overrides

    @property
    def folder(self) -> Path:
        """The folder that paths in the scenario are relative to."""
        return self._folders[0]

    @property
    def file(self) -> Path:
        """The scenario file, for messages."""
        return self.folder / self._file_name

    def locate(self, key: str) -> str:
        """Return where a key is, for errors: the command line for one that it sets, else the file."""
        is_set = any(f"{key}.".startswith(f"{name}.") or name.startswith(f"{key}.") for name in self._overrides)
        return f"command line: {key}" if is_set else f"{self.file}: {key}"

    def with_effects(self, effects: EffectsConfig) -> Scenario:
        """Return the same scenario with other effects; gamma keeps its number, even if it was "auto"."""
        score = self.score.model_copy(update={"gamma": self.gamma})
        return self.model_copy(update={"effects": effects, "score": score})

    def find(self, name: str, key: str) -> Path:
        """Return the path of a file that the scenario, or one that it extends, names.

        Parameters
        ----------
        name
            The path as it is written in the scenario.
        key
            The key, for messages.

        Raises
        ------
        InputError
            When there is no such file, or it cannot be read.
        """
        where = f"{self.locate(key)} = {name!r}"
        if len(name) > _MAX_NAME_LENGTH:
            raise InputError(where, f"the path is longer than {_MAX_NAME_LENGTH} characters")
        folders = (sumo_home(),) if name.startswith(_SUMO_HOME_PREFIX) else self._folders
        paths = [folder / name.removeprefix(_SUMO_HOME_PREFIX) for folder in folders]
        for path in paths:
            if not path.is_file():
                continue
            if not os.access(path, os.R_OK):
                raise InputError(where, f"cannot be read ({path}: Permission denied)", "Check its permissions.")
            return path
        raise InputError(where, f"no such file ({paths[0]})", "Give a path relative to the scenario's folder.")
