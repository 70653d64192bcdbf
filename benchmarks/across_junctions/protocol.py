"""The protocol of the study: junctions, roles, candidates, sensors, detectors and frames, and its hash.

``junctions.toml`` states everything that is chosen; ``candidates.csv`` lists the poses drawn from it, and
``worlds.csv`` the hash of every scenario made from it. The hash of the protocol covers these three files and the sensor
catalogue, so none of them can change unnoticed after it was written down.

``frozen.json`` has the hashes of what is tested and of how it is judged: the models of the score, the detectors, and
the statistics and tables. It is written when all choices are made; held-out junctions are only measured while the
hashes are those of the present source. Whenever it is written again, it records why, and the name and the hash of
everything that changed, before and after.
"""

from __future__ import annotations

import hashlib
import json
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

from pydantic import Field, ValidationError, model_validator

from egvs.core import files
from egvs.core.errors import InputError
from egvs.extensions.validation.detectors import base
from egvs.runs import stage_keys
from egvs.scenario.fields import StrictModel, find_duplicates
from egvs.scenario.loading import format_validation_error
from egvs.scenario.traffic_config import VehicleKind
from egvs.scoring import target_scores
from egvs.scoring.target_scores import CORRECTIONS_FILE, MODEL_FILE
from egvs.sensors.sensor import CATALOGUE, catalogue_digest

FOLDER = Path(__file__).resolve().parent

T = TypeVar("T")
JUNCTIONS_FILE, CANDIDATES_FILE, WORLDS_FILE = "junctions.toml", "candidates.csv", "worlds.csv"
FROZEN_FILE = "frozen.json"

AGAIN = "frozen again"
"""Key of the changes in the file of what is frozen: a reason each, and the names and hashes before and after."""

JUDGING = (
    "benchmarks.across_junctions.statistics",
    "benchmarks.across_junctions.tables",
    "benchmarks.across_junctions.calibration",
    "benchmarks.across_junctions.vehicle_rows",
    "benchmarks.across_junctions.records",
    "benchmarks.across_junctions.detections",
    "benchmarks.across_junctions.measurement",
    "benchmarks.across_junctions.models.additive_model",
    "benchmarks.across_junctions.models.comparison",
    "benchmarks.across_junctions.models.fitting",
    "benchmarks.across_junctions.egvs_settings",
    "benchmarks.across_junctions.table_files",
    "egvs.kernels.boosted_trees",
    "egvs.kernels.vehicle_visibility",
    "egvs.scoring.targets",
    "egvs.scoring.visibility",
    "egvs.statistics.ranks",
    "egvs.extensions.validation.correlation",
    "egvs.extensions.validation.detection_metrics",
    "egvs.extensions.validation.surrogate_scores",
    "egvs.extensions.validation.surrogates",
)
"""Modules that compute scores and visibility, and turn detections into results."""

Role = Literal["detector", "training", "held out", "comparison"]
"""What a junction is for: training detectors, training the score, testing it once, or comparison with the source
paper."""

ROLES: tuple[Role, ...] = ("training", "held out", "comparison")
"""Roles of junctions with candidates."""

MIN_SITES_OF_A_HEIGHT = 15
"""Sites of one height at a junction that a coefficient among them needs."""


class Arm(StrictModel):
    """A road of a junction of arms."""

    bearing_deg: float = Field(ge=0, lt=360, description="Direction from the junction, counter-clockwise from east")
    length_m: float = Field(ge=60, le=400)
    lanes: int = Field(ge=1, le=4)
    speed_m_s: float = Field(13.89, gt=0)


class Terrain(StrictModel):
    r"""A ground of plane waves: z = sum of a sin(2 pi (x cos b + y sin b) / l + phase), in metres.

    Attributes
    ----------
    amplitude_m, wavelength_m, bearing_deg, phase_deg
        One value per wave.
    """

    amplitude_m: tuple[float, ...]
    wavelength_m: tuple[float, ...]
    bearing_deg: tuple[float, ...]
    phase_deg: tuple[float, ...]

    def height_m(self, x_m: float, y_m: float) -> float:
        """Return the height of the ground at a point of the network's frame."""
        total = 0.0
        for amplitude, wavelength, bearing, phase in zip(
            self.amplitude_m, self.wavelength_m, self.bearing_deg, self.phase_deg, strict=True
        ):
            angle = math.radians(bearing)
            along = x_m * math.cos(angle) + y_m * math.sin(angle)
            total += amplitude * math.sin(2.0 * math.pi * along / wavelength + math.radians(phase))
        return total


class Furniture(StrictModel):
    """Street furniture and buildings beside the roads, drawn at random (:mod:`furniture`)."""

    poles: int = Field(0, ge=0, description="Posts of lamps and signs")
    trees: int = Field(0, ge=0)
    kiosks: int = Field(0, ge=0, description="Shelters, cabinets and parked trailers")
    buildings: int = Field(0, ge=0)


class MapFile(StrictModel):
    """A file that the study needs and the project does not ship."""

    name: str
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


_KEYS_OF_SHIPPED = {"name", "role", "differs_in", "source", "scenario", "heights", "frames"}


class Junction(StrictModel):
    """A junction of the study, and how its scenario is made.

    Attributes
    ----------
    scenario
        A shipped scenario; or one of ``netgenerate``, ``arms`` and ``map``.
    netgenerate
        Arguments of SUMO's netgenerate, without seed and output.
    arms
        Roads that meet in one junction.
    map
        Name of a road map that is not shipped, below the folder of maps; :attr:`further_maps` names its companions.
    at
        Latitude and longitude, or x and y, of the junction in its map; the largest with signals by default.
    fleet
        A name of the table ``fleets``; the scenario's own fleet by default.
    traffic
        Level, or vehicles per hour, of the assumed traffic.
    tables
        Tables and keys that are set in scenario.toml.
    """

    name: str = Field(pattern="^[a-z0-9_]+$")
    role: Role
    differs_in: str = Field(description="What it adds to the others")
    source: str = ""
    scenario: str = ""
    netgenerate: tuple[str, ...] = ()
    arms: tuple[Arm, ...] = ()
    map: MapFile | None = None
    pedestrian_tracks: MapFile | None = None
    signals: MapFile | None = None
    seed: int = 1
    at: tuple[float, float] | None = None
    lefthand: bool = False
    walk: bool = False
    traffic: str | int = "medium"
    surroundings_m: float | None = None
    fleet: str = ""
    terrain: Terrain | None = None
    furniture: Furniture | None = None
    tables: dict[str, Any] = Field(default_factory=dict)
    heights: int | None = Field(None, description="Which row of candidates.heights_m is used, from 0", ge=0)
    frames: int | None = Field(None, ge=20, description="Of unseen traffic, where they differ from the other junctions")

    @model_validator(mode="after")
    def _check_origin(self) -> Self:
        origins = [bool(self.scenario), bool(self.netgenerate), bool(self.arms), self.map is not None]
        if sum(origins) != 1:
            raise ValueError("expected one of scenario, netgenerate, arms and map")
        if self.scenario and (unused := sorted(self.model_fields_set - _KEYS_OF_SHIPPED)):
            raise ValueError(f"{unused[0]} does not apply to a shipped scenario")
        if (self.heights is None) != (self.role == "detector"):
            raise ValueError("expected heights, except at junctions for training detectors")
        return self

    @property
    def files(self) -> tuple[MapFile, ...]:
        """Files that are not shipped."""
        return tuple(entry for entry in (self.map, self.pedestrian_tracks, self.signals) if entry is not None)


class CandidateRule(StrictModel):
    """How candidates are drawn; see :mod:`candidates`.

    Attributes
    ----------
    heights_m
        Mounting heights above the ground; each junction uses one row, and each height equally often.
    sensors
        Each equally often, up to one.
    """

    count: int = Field(ge=1)
    heights_m: tuple[tuple[float, ...], ...]
    pitch_deg: tuple[float, float]
    roll_deg: tuple[float, float]
    sensors: tuple[str, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if unknown := [name for name in self.sensors if name not in CATALOGUE]:
            raise ValueError(f"expected sensors of the catalogue, got {unknown[0]!r}")
        for row in self.heights_m:
            if self.count // len(row) < MIN_SITES_OF_A_HEIGHT:
                raise ValueError(f"expected at least {MIN_SITES_OF_A_HEIGHT} candidates of each height")
        return self


class Detectors(StrictModel):
    """Detectors by role of the junction; those of training junctions may train the model of the score."""

    training: tuple[str, ...]
    held_out: tuple[str, ...]


class Protocol(StrictModel):
    """The contents of ``junctions.toml``."""

    seed: int
    frames: int = Field(ge=20, description="Of unseen traffic, the same for all candidates of a junction")
    training_frames: int = Field(ge=20, description="The same, at training junctions")
    apart_s: float = Field(ge=7.0, description="Least time between two frames")
    tpog_frames: int = Field(ge=100, description="Of the traffic behind the scores, where a scenario is made here")
    candidates: CandidateRule
    detectors: Detectors
    fleets: dict[str, tuple[VehicleKind, ...]]
    junctions: tuple[Junction, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if duplicates := find_duplicates([junction.name for junction in self.junctions]):
            raise ValueError(f"two junctions have the same name: {duplicates[0]}")
        for junction in self.junctions:
            if junction.fleet and junction.fleet not in self.fleets:
                raise ValueError(f"junction {junction.name}: there is no fleet {junction.fleet!r}")
            if junction.heights is not None and junction.heights >= len(self.candidates.heights_m):
                raise ValueError(f"junction {junction.name}: there is no row {junction.heights} of heights")
        return self

    def junction(self, name: str) -> Junction:
        """Return a junction by its name.

        Raises
        ------
        InputError
            If the study has no junction of this name.
        """
        for junction in self.junctions:
            if junction.name == name:
                return junction
        known = ", ".join(junction.name for junction in self.junctions)
        raise InputError("--junction", f"expected a junction of the study, got {name!r}", f"Use some of {known}.")

    @property
    def measured_junctions(self) -> tuple[Junction, ...]:
        """The junctions with candidates."""
        return tuple(junction for junction in self.junctions if junction.role in ROLES)

    def heights_m(self, junction: Junction) -> tuple[float, ...]:
        """Return the mounting heights at a junction; none where it has no candidates."""
        return () if junction.heights is None else self.candidates.heights_m[junction.heights]

    def frames_of(self, junction: Junction) -> int:
        """Return the number of frames of unseen traffic at a junction."""
        if junction.frames is not None:
            return junction.frames
        return self.training_frames if junction.role == "training" else self.frames

    def detectors_of(self, junction: Junction) -> tuple[str, ...]:
        """Return the detectors that are run at a junction."""
        return self.detectors.training if junction.role == "training" else self.detectors.held_out


def detector_junctions(protocol: Protocol) -> tuple[Junction, ...]:
    """Return the junctions where detectors are trained: those of the role, and the training junctions shipped."""
    shipped = [junction for junction in protocol.junctions if junction.role == "training" and junction.scenario]
    return (*shipped, *(junction for junction in protocol.junctions if junction.role == "detector"))


def of_junction(each: Mapping[str, T], junction: Junction, file: str) -> T:
    """Return what a file of the protocol has for one junction.

    Raises
    ------
    InputError
        If it has nothing.
    """
    if junction.name not in each:
        hint = f"Write it with: python -m benchmarks.across_junctions build --junction {junction.name} --write"
        raise InputError(FOLDER / file, f"no row of {junction.name}", hint)
    return each[junction.name]


def read_protocol(file: Path = FOLDER / JUNCTIONS_FILE) -> Protocol:
    """Read and check the protocol.

    Raises
    ------
    InputError
        For an unknown key, or a value that is out of its limits.
    """
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise InputError(file, f"expected a TOML file, got an error: {error}", "Restore the file.") from None
    try:
        return Protocol.from_dict(values)
    except ValidationError as error:
        raise format_validation_error(error, file.name, Protocol) from None


@dataclass(frozen=True)
class ProtocolFiles:
    """The files of the protocol, and their hashes."""

    folder: Path = FOLDER

    @cached_property
    def digests(self) -> dict[str, str]:
        """SHA-256 of each file by name, and of the sensors of the catalogue.

        Raises
        ------
        InputError
            If a file is missing.
        """
        digests = {}
        for name in (JUNCTIONS_FILE, CANDIDATES_FILE, WORLDS_FILE):
            path = self.folder / name
            if not path.is_file():
                raise InputError(
                    path, "no such file", "Write it with: python -m benchmarks.across_junctions build --write"
                )
            digests[name] = hashlib.sha256(path.read_bytes().replace(b"\r\n", b"\n")).hexdigest()
        sensors = read_protocol(self.folder / JUNCTIONS_FILE).candidates.sensors
        digests["sensors"] = files.hash_json({name: catalogue_digest(name) for name in sensors})
        return digests

    @property
    def digest(self) -> str:
        """SHA-256 of the whole protocol."""
        return files.hash_json(self.digests)


def frozen_digests() -> dict[str, str]:
    """Return the hash of each model of the score, of each detector, and of each module of :data:`JUDGING`, by name."""
    protocol = read_protocol()
    score = files.hash_json([files.hash_file(MODEL_FILE), files.hash_file(CORRECTIONS_FILE)])
    digests = {"score": score, "features": stage_keys.text_digest(target_scores.__name__)}
    for name in protocol.detectors.held_out:
        detector = base.make_detector(name)
        source = stage_keys.source_digest(type(detector).__module__).digest
        digests[name] = files.hash_json([detector.settings, source])
    return digests | {name: stage_keys.text_digest(name) for name in JUDGING}


def write_frozen(
    records_folder: Path, folder: Path = FOLDER, again: str = "", renamed: Mapping[str, str] | None = None
) -> Path:
    """Write the file of what is frozen, and return its path.

    Parameters
    ----------
    again
        Why something may be frozen again after a held-out junction was measured; it is recorded, with what changed.
    renamed
        New name of each module that was moved, or merged into another one, by its name in the file.

    Raises
    ------
    InputError
        If a held-out junction was measured already or a module was renamed, and no reason is given; for a renamed
        module whose names are not its former and its present one.
    """
    path = folder / FROZEN_FILE
    held_out = [junction.name for junction in read_protocol().junctions if junction.role == "held out"]
    spent = [name for name in held_out if any(records_folder.glob(f"{name}.*"))]
    if spent and not again:
        problem = f"{', '.join(spent)} measured already"
        hint = 'What is frozen after that is hardly frozen. If it must be: --again "REASON", which is recorded.'
        raise InputError(records_folder, problem, hint)
    if renamed and not again:
        raise InputError("--renamed", "is recorded with a reason only", 'Give one: --again "REASON".')
    frozen, changes = _read_frozen(folder)
    present = frozen_digests()
    for old, new in (renamed or {}).items():
        if old not in frozen or old in present or new not in present:
            problem = f"expected the former and the present name of a frozen module, got {old}={new}"
            raise InputError("--renamed", problem, "Former names are in frozen.json, present ones in JUDGING.")
    if again:
        changes.append({"reason": again, "changed": _changes(frozen, present, renamed or {})})
    content = present | ({AGAIN: changes} if changes else {})
    files.write_text(path, files.to_json_text(content, indent=1) + "\n")
    return path


def _read_frozen(folder: Path) -> tuple[dict[str, str], list[dict[str, Any]]]:
    """Return the frozen hashes by name, and the changes; both are empty where nothing is frozen."""
    path = folder / FROZEN_FILE
    frozen = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    changes = frozen.pop(AGAIN, [])
    return frozen, changes


def _changes(
    frozen: Mapping[str, str], present: Mapping[str, str], renamed: Mapping[str, str]
) -> list[dict[str, str | None]]:
    """Return the name and the hash of everything that changed, before and after; a hash is None where there is none."""
    new_names = {name: renamed.get(name, name) for name in frozen}
    new_names |= {name: name for name in present if name not in new_names.values()}
    rows = [(name, frozen.get(name), new_name, present.get(new_name)) for name, new_name in new_names.items()]
    keys = ("name", "hash", "new name", "new hash")
    return [dict(zip(keys, row, strict=True)) for row in rows if row[:2] != row[2:]]


def frozen_again(folder: Path = FOLDER) -> list[str]:
    """Return why something was frozen again after a held-out junction was measured."""
    return [change["reason"] for change in _read_frozen(folder)[1]]


def check_frozen(folder: Path = FOLDER) -> None:
    """Check that nothing that is tested, or that judges it, has changed since it was frozen.

    Raises
    ------
    InputError
        Where the file is missing, or names another version.
    """
    path = folder / FROZEN_FILE
    command = "python -m benchmarks.across_junctions list --freeze"
    hint = f"When all choices are made: {command}, and a line in docs/validity.md."
    if not path.is_file():
        raise InputError(path, "score, detectors and statistics are not frozen yet", hint)
    frozen, present = _read_frozen(folder)[0], frozen_digests()
    changed = sorted(name for name in frozen.keys() | present.keys() if frozen.get(name) != present.get(name))
    if changed:
        raise InputError(path, f"{', '.join(changed)} changed since they were frozen", hint)
