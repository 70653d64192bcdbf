"""Scenario: ``[roi]`` ``[statics]`` ``[tpog]`` ``[sites]`` ``[scan]`` ``[crs]`` ``[validation]``.

The keys of ``[crs]``: where the world frame lies on the Earth.

The keys of ``[validation]``: what detection is measured with, where it is not the program's own.

The definition of a scenario: each key with its unit in its name, its limits and its default, written once.

A scenario is a folder with a ``scenario.toml`` and the files that it names. ``[traffic]``, ``[sensors]``,
``[score]`` and ``[effects]`` have modules of their own beside this one. ``data_schemas/scenario.schema.json`` is made
from these models; :mod:`egvs.scenario.loading` reads the file.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from math import inf
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PrivateAttr, field_validator, model_validator

from egvs.core.errors import InputError
from egvs.core.grid import Grid, Roi
from egvs.core.runtime import sumo_home
from egvs.scenario.effects_config import EffectsConfig
from egvs.scenario.fields import Latitude, Longitude, Name, Point2, Point3, Positive, StrictModel
from egvs.scenario.score_config import CostsConfig, PlacementConfig, ScoreConfig, default_gamma
from egvs.scenario.sensor_config import SensorConfig
from egvs.scenario.traffic_config import TrafficConfig


class CrsConfig(StrictModel):
    """Where the world frame lies on the Earth; without it, the SUMO network's own <location> says so."""

    epsg: int | None = Field(
        None, ge=1, description="Code of a projected coordinate reference system in metres, e.g. 25832"
    )
    offset_m: Point2 = Field(
        (0.0, 0.0), description="Added to its easting and northing to reach x, y (SUMO's netOffset)"
    )
    zero_height_m: float = Field(
        0.0, ge=-12_000, le=9_000, description="Height that measured scans with a coordinate system give for z = 0"
    )

    @model_validator(mode="after")
    def _offset_of_something(self) -> CrsConfig:
        if self.epsg is None and self.offset_m != (0.0, 0.0):
            raise ValueError("offset_m without epsg: a network's <location> has its own")
        return self


BodyKind = Literal[
    "sedan", "kei", "taxi", "van", "truck", "bus", "tractor", "trailer", "pedestrian", "bicycle"
]  # fmt: skip
"""Kinds of bodies that point clouds are made with."""


class ValidationConfig(StrictModel):
    """How it is measured what detectors find."""

    bodies: dict[BodyKind, str] = Field(
        default_factory=dict,
        description="A mesh (PLY, OBJ, STL, GLB; x ahead, y left, z up) instead of the program's own body of a kind, "
        "stretched to each box",
    )


SCENARIO_FILE = "scenario.toml"
_SUMO_HOME_PREFIX = "$SUMO_HOME/"
_MAX_NAME_LENGTH = 1000


class RoiConfig(StrictModel):
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


class MeshConfig(StrictModel):
    """A triangle mesh that trimesh loads (PLY, OBJ, STL, GLB), in metres, z up."""

    file: str
    offset_m: Point3 = Field(
        (0.0, 0.0, 0.0),
        description="Added to every vertex to reach the world frame (or the system of epsg, or origin_deg)",
    )
    epsg: int | None = Field(
        None,
        ge=1,
        description="Code of the map projection of its x, y (with offset_m added), where not the world frame's",
    )
    origin_deg: tuple[Longitude, Latitude] | None = Field(
        None, description="Longitude and latitude of its zero, where its x, y are metres to the east and north of there"
    )
    kind: Name = Field("mesh", description="Shown in messages and in the report")

    @model_validator(mode="after")
    def _one_system(self) -> MeshConfig:
        if self.epsg is not None and self.origin_deg is not None:
            raise ValueError("epsg and origin_deg: a mesh is in one system")
        return self

    @property
    def system(self) -> str | None:
        """The coordinate reference system of its x, y, as PROJ knows it; None for the world frame."""
        if self.origin_deg is not None:
            lon_deg, lat_deg = self.origin_deg
            return f"+proj=aeqd +lon_0={lon_deg!r} +lat_0={lat_deg!r} +datum=WGS84 +units=m +no_defs +type=crs"
        return None if self.epsg is None else f"EPSG:{self.epsg}"


class StaticsConfig(StrictModel):
    """The static world."""

    footprints: tuple[str, ...] = Field(
        (),
        description="GeoJSON files that declare their crs (null: world-frame metres); features have height_m and may"
        " have base_m, radius_m",
    )
    polygons: tuple[str, ...] = Field((), description="SUMO .poly.xml files; what is solid in them goes by type")
    polygon_height_m: Positive = Field(
        9.0, description="Height of solid polygons that name none and whose type has none"
    )
    polygon_types: dict[str, Positive | Literal["solid", "ignore"]] = Field(
        default_factory=dict,
        description="Which types of polygons are solid, in place of the program's own table: a height in metres, "
        '"solid" or "ignore" for each, as in "building.shed" = 2.2; "" is any type that no table names',
    )
    meshes: tuple[MeshConfig, ...] = ()
    ground: bool = Field(True, description="A ground plane at z = 0")

    @field_validator("polygon_types", mode="before")
    @classmethod
    def _flatten_type_names(cls, values: Any) -> Any:
        """``building.shed = 2.2`` without quotes is a table in a table; it means the same."""
        return dict(_flatten(values, "")) if isinstance(values, dict) else values


def _flatten(values: dict[str, Any], above: str) -> Iterator[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{above}{key}.")
            continue
        is_number = isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < inf
        if not is_number and value not in ("solid", "ignore"):
            right = '"solid", "ignore" or a height in metres above 0'
            raise ValueError(f"{json.dumps(above + key)} = {json.dumps(value)}; {right}")
        yield above + key, value


MAX_BLOCKS = 65535
"""Of all periods together: ``tpog.parquet`` numbers blocks in 16 bits."""


class TpogConfig(StrictModel):
    """How frames are counted."""

    blocks: int = Field(
        10, ge=1, le=MAX_BLOCKS, description="Blocks of consecutive frames; divides traffic.frames if that is given"
    )


class SiteGrid(StrictModel):
    """Sites on a square lattice."""

    low_m: Point2 = Field(description="South-west corner, where the first site stands")
    high_m: Point2 = Field(description="No site beyond this corner")
    spacing_m: Positive
    heights_m: tuple[Positive, ...] = Field(min_length=1)


class SiteLine(StrictModel):
    """Sites along a line, the first at its start."""

    line_m: tuple[Point2, ...] = Field(min_length=2)
    spacing_m: Positive
    heights_m: tuple[Positive, ...] = Field(min_length=1)


SITE_DIRECTIONS = ("aim", "aim_m", "yaw_deg")
"""Keys that say where sensors look; at most one can hold."""

SITE_SOURCES = ("file", "grid", "along")
"""Keys that say where candidate sites come from; a scenario has one of them."""

Pitch = Annotated[float, Field(ge=-90, le=90)] | Literal["aim"]


class SitesConfig(StrictModel):
    """Candidate sites: a file, or a rule. Pose and sensor below hold for every site that names none of its own."""

    file: str | None = Field(None, description="CSV (site, x_m, y_m, z_m, ...) or GeoJSON points")
    grid: SiteGrid | None = None
    along: tuple[SiteLine, ...] = ()
    only_free: bool = Field(
        True,
        description="Drop those places of grid and along that stand in a lane, amid a junction or in a solid",
    )
    points: str | None = Field(
        None, description="A measured empty scan (PCD, PLY, LAS, LAZ, CSV; world frame) of the only site"
    )
    sensor: str = Field("VLP-32C", description="A name from `egvs sensors` or from [sensors]")
    heights_m: tuple[Positive, ...] = Field(
        (), description="Heights of the places in `file` that name no z_m; each is a candidate of its own"
    )
    aim: Literal["roi"] | None = Field(
        None, description="'roi': turned and tilted so that the sensor's middle ray meets the middle of the ROI"
    )
    aim_m: Point2 | Point3 | None = Field(
        None, description="Likewise at a point; without z, at the height of the ROI's middle"
    )
    yaw_deg: float | None = Field(
        None, description="The sensor's x axis, counter-clockwise from +x; 0, or what the aim asks for"
    )
    pitch_deg: Pitch | tuple[Pitch, ...] | None = Field(
        None,
        description="Nose up positive, or 'aim'; several are as many candidates. 'aim' where a site is aimed, else 0",
    )
    roll_deg: float = 0.0

    @model_validator(mode="after")
    def _one_source(self) -> SitesConfig:
        given = [key for key in SITE_SOURCES if getattr(self, key)]
        if len(given) != 1:
            raise ValueError(f"exactly one of file, grid and along is needed, found {' and '.join(given) or 'none'}")
        if self.file is not None and not self.only_free:
            raise ValueError("only_free acts on grid and along; all sites of a file are kept")
        if self.heights_m and self.file is None:
            raise ValueError(f"heights_m is for places in a file: {given[0]} has heights_m of its own")
        return self

    @model_validator(mode="after")
    def _one_direction(self) -> SitesConfig:
        given = [key for key in SITE_DIRECTIONS if getattr(self, key) is not None]
        if len(given) > 1:
            raise ValueError(f"at most one of aim, aim_m and yaw_deg can hold, found {' and '.join(given)}")
        for key in ("heights_m", "pitch_deg"):
            values = getattr(self, key)
            if isinstance(values, tuple) and len(set(values)) < len(values):
                raise ValueError(f"{key} = {list(values)} names a value twice")
        if self.pitch_deg == ():
            raise ValueError("pitch_deg = [] leaves no candidate")
        return self


class ScanConfig(StrictModel):
    """How empty scans are kept."""

    keep: bool = Field(
        True, description="false: no scans.parquet; score casts as it goes, for sweeps over thousands of sites"
    )


class Scenario(StrictModel):
    """Everything that a run depends on. Made by :func:`load`."""

    name: Name = Field("", min_length=0, validate_default=False, description="Defaults to the folder's name")
    description: str = ""
    extends: str = Field(
        "", description="A scenario folder whose keys hold where this one says nothing; tables merge, lists replace"
    )
    seed: int = Field(0, ge=0, le=2**63 - 1, description="The one seed; all randomness derives from it")
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

    _folders: tuple[Path, ...] = PrivateAttr(default=(Path(),))
    _period: str = PrivateAttr(default="")
    _file_name: str = PrivateAttr(default=SCENARIO_FILE)

    @model_validator(mode="after")
    def _across(self) -> Scenario:
        blocks = self.tpog.blocks
        if (all_blocks := blocks * max(1, len(self.traffic.periods))) > MAX_BLOCKS:
            raise ValueError(f"tpog.blocks = {blocks} in each period are {all_blocks} blocks: at most {MAX_BLOCKS}")
        for period, traffic in self._traffic_by_period():
            if traffic.frames is not None and traffic.frames % blocks:
                of = f" of the period {period!r}" if period else ""
                raise ValueError(f"tpog.blocks = {blocks} does not divide traffic.frames = {traffic.frames}{of}")
        replay = self.effects.named.get("moving_occlusion")
        if self.traffic.periods and getattr(replay, "method", "") == "frames":
            raise ValueError(
                'effects.moving_occlusion: method = "frames" replays all periods alike, whatever their weights;'
                ' method = "independent" takes the mix'
            )
        return self

    def _traffic_by_period(self) -> list[tuple[str, TrafficConfig]]:
        """The traffic of each period under its name; that of ``[traffic]`` under no name where there are none."""
        periods = self.traffic.periods
        return [(period.name, period.over(self.traffic)) for period in periods] or [("", self.traffic)]

    def by_period(self) -> dict[str, Scenario]:
        """A scenario for the traffic of each period alone, with a seed of its own, under the period's name; this one
        under no name where it has none."""
        if not self.traffic.periods:
            return {"": self}
        scenarios = {}
        for number, (name, traffic) in enumerate(self._traffic_by_period()):
            drawn = int(np.random.SeedSequence((self.seed, number)).generate_state(1, np.uint64)[0])
            alone = self.model_copy(update={"traffic": traffic, "seed": drawn >> 1})
            alone._folders, alone._period = self._folders, name
            scenarios[name] = alone
        return scenarios

    @property
    def gamma(self) -> float:
        """``score.gamma``, or the number that "auto" stands for in this scenario."""
        if self.score.gamma != "auto":
            return self.score.gamma
        return default_gamma(self.roi.voxel_m, moving_occlusion="moving_occlusion" in self.effects.named)

    @property
    def is_recorded(self) -> bool:
        """Whether its traffic, or that of a period, is a finished file."""
        return any(traffic.fcd is not None for _, traffic in self._traffic_by_period())

    @property
    def period(self) -> str:
        """The period whose traffic alone this is; empty for the whole scenario."""
        return self._period

    @property
    def folder(self) -> Path:
        """The folder that relative file names start from."""
        return self._folders[0]

    @property
    def file(self) -> Path:
        """The scenario file, for messages."""
        return self.folder / self._file_name

    def with_effects(self, effects: EffectsConfig) -> Scenario:
        """The same scenario with these effects instead of its own; gamma stays the number that it is."""
        score = self.score.model_copy(update={"gamma": self.gamma})
        other = self.model_copy(update={"effects": effects, "score": score})
        other._folders, other._period = self._folders, self._period
        return other

    def find(self, name: str, key: str) -> Path:
        """The file that the scenario, or one that it extends, names under ``key``.

        InputError when it is not there, or may not be read.
        """
        folders = (sumo_home(),) if name.startswith(_SUMO_HOME_PREFIX) else self._folders
        if len(name) > _MAX_NAME_LENGTH:
            raise InputError(f"{self.file}: {key} = {name!r}", "is too long for a path", "the path of a file")
        for folder in folders:
            if (path := folder / name.removeprefix(_SUMO_HOME_PREFIX)).is_file():
                if os.access(path, os.R_OK):
                    return path
                found = f"cannot be read ({path}: Permission denied)"
                raise InputError(f"{self.file}: {key} = {name!r}", found, "a file that may be read")
        shown = folders[0] / name.removeprefix(_SUMO_HOME_PREFIX)
        found = f"no such file ({shown})"
        raise InputError(f"{self.file}: {key} = {name!r}", found, "a path relative to the scenario's folder")
