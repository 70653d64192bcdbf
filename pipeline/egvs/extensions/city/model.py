"""Read and check the folder of a city.

A city is a folder of ordinary scenarios that share one traffic simulation:

    city.toml                      name, seed, [traffic], [effects]: the traffic of all junctions
    junctions.csv                  one row per junction
    junctions/scenario.toml        common settings of all junctions
    junctions/<ID>/scenario.toml   an ordinary scenario; its traffic is the file below
    traffic/<ID>.parquet           the city's traffic near this junction, written by egvs.extensions.city.traffic_split;
    with
                                   periods, traffic/periods/<NAME>/<ID>.parquet

Positions are x, y of the network in metres, and degrees (WGS 84).
"""

from __future__ import annotations

import csv
import io
import json
import os
import unicodedata
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import Field, TypeAdapter, ValidationError

from egvs.core import reading
from egvs.core.errors import InputError, parse_each
from egvs.core.numbers import number_or_nan, parse_decimal
from egvs.formats import spreadsheets
from egvs.scenario.effects_config import EffectsConfig
from egvs.scenario.fields import MAX_COORDINATE_M, NAME_DESCRIPTION, Name, StrictModel
from egvs.scenario.loading import check_unused_keys, default_name, format_validation_error
from egvs.scenario.model import SCENARIO_FILE
from egvs.scenario.traffic_config import TrafficConfig

CITY_FILE, NETWORK_FILE, JUNCTIONS_FILE = "city.toml", "network.net.xml", "junctions.csv"
JUNCTIONS_FOLDER, TRAFFIC_FOLDER, PERIODS_FOLDER = "junctions", "traffic", "periods"
JUNCTION_COLUMNS = ("junction", "title", "x_m", "y_m", "lat_deg", "lon_deg", "signalised")
"""Columns of ``junctions.csv``."""

_MAX_COORDINATES = {"x_m": MAX_COORDINATE_M, "y_m": MAX_COORDINATE_M, "lat_deg": 90.0, "lon_deg": 180.0}
_BOOLEANS = {"true": True, "false": False}


class CityModel(StrictModel):
    """The keys of ``city.toml``."""

    name: Name = Field("", min_length=0, validate_default=False, description="Defaults to the folder's name")
    description: str = ""
    attribution: str = Field("", description="Attribution of the map, shown with results")
    seed: int = Field(0, ge=0, le=2**63 - 1, description="Seed of the traffic simulation")
    traffic: TrafficConfig = Field(description="The traffic of all junctions, as in a scenario")
    effects: EffectsConfig = Field(EffectsConfig(), description="Effects that add traffic: pedestrians and bicycles")


@dataclass(frozen=True)
class CityJunction:
    """A junction; its ``id`` is the name of its folder."""

    id: str
    title: str
    x_m: float
    y_m: float
    lat_deg: float
    lon_deg: float
    signalised: bool

    def scenario_folder(self, city: City) -> Path:
        """Return the folder of the junction's scenario."""
        return city.folder / JUNCTIONS_FOLDER / self.id

    def traffic_file(self, city: City, period: str = "") -> Path:
        """Return the file with the city's traffic near this junction, of all traffic or of one period."""
        folder = city.folder / TRAFFIC_FOLDER
        if period:
            folder = folder / PERIODS_FOLDER / period
        return folder / f"{self.id}.parquet"


@dataclass(frozen=True)
class City:
    """A city; its ``junctions`` are in the order of the table."""

    folder: Path
    name: str
    seed: int
    traffic: TrafficConfig
    junctions: tuple[CityJunction, ...]
    attribution: str = ""
    description: str = ""
    effects: EffectsConfig = field(default_factory=EffectsConfig)

    @property
    def file(self) -> Path:
        """``city.toml``, for messages."""
        return self.folder / CITY_FILE

    def junction(self, name: str) -> CityJunction:
        """Return the junction of this name; raise an InputError if there is none."""
        for junction in self.junctions:
            if junction.id == name:
                return junction
        problem = f"no such junction in {self.folder / JUNCTIONS_FILE}"
        names = ", ".join(junction.id for junction in self.junctions)
        raise InputError(f"--junction {name}", problem, f"Use one of {names}.")


def load_city(folder: str | Path) -> City:
    """Read and check a city.

    Its folder of traffic must be inside it, because files are written there.

    Parameters
    ----------
    folder
        The folder of the city, or its ``city.toml``.

    Raises
    ------
    InputError
        When a file is missing or damaged, a key is unknown, a junction occurs twice or has no scenario, or the folder
        of traffic is a link.
    """
    path = Path(folder)
    file = path if path.is_file() else path / CITY_FILE
    if not file.is_file():
        raise InputError(path, f"there is no {CITY_FILE} in this folder", "Give a folder created by egvs city new.")
    values = reading.read_toml(file)
    values.setdefault("name", default_name(file.parent) or "city")
    try:
        model = CityModel.from_dict(values)
    except ValidationError as error:
        raise format_validation_error(error, str(file), CityModel) from None
    check_unused_keys(model.traffic, file)
    if model.traffic.seeds > 1:
        problem = f"expected 1 in a city, got {model.traffic.seeds}"
        raise InputError(f"{file}: traffic.seeds", problem, "Remove it, or use a scenario of one junction.")

    rows = read_junction_rows(file.parent / JUNCTIONS_FILE, JUNCTION_COLUMNS)
    city = City(
        file.parent,
        model.name,
        model.seed,
        model.traffic,
        tuple(parse_each(rows, lambda row: _parse_junction(*row), "junctions")),
        model.attribution,
        model.description,
        model.effects,
    )
    for junction in city.junctions:
        scenario_file = junction.scenario_folder(city) / SCENARIO_FILE
        if not scenario_file.is_file():
            hint = f"Create the scenario, or remove the row {junction.id} from {JUNCTIONS_FILE}."
            raise InputError(scenario_file, "no such file", hint)
    _check_traffic_folder(city.folder / TRAFFIC_FOLDER)
    return city


def _check_traffic_folder(folder: Path) -> None:
    """Raise an InputError if the folder, or one in it, is a link: files would be written to another place."""
    below = [Path(parent) / name for parent, names, _ in os.walk(folder) for name in names]
    for path in (folder, *below):
        if path.is_symlink():
            problem = f"expected a folder, got a link to {os.path.realpath(path)}"
            raise InputError(path, problem, "Remove the link; for another disk, move the whole city there.")


def city_json_schema() -> str:
    """Return the JSON Schema with which editors complete and check a city.toml."""
    return json.dumps(CityModel.model_json_schema(), indent=2, ensure_ascii=False) + "\n"


def read_junction_rows(path: Path, required: Sequence[str]) -> list[tuple[str, dict[str, str]]]:
    """Return the rows of a table of junctions, each with its location for messages.

    Parameters
    ----------
    path
        The table (:mod:`egvs.formats.spreadsheets`).
    required
        Columns that it must have, among them ``junction``; it may have all of :data:`JUNCTION_COLUMNS`.

    Raises
    ------
    InputError
        When the file is missing, is no table with these columns, has no rows, or a junction's name is invalid or
        occurs twice.
    """
    hint = f"Use the columns {', '.join(required)}."
    if not path.is_file():
        raise InputError(path, "no such file", f"Give a table of junctions. {hint}")

    def check_header(columns: list[str]) -> list[str]:
        if not set(required) <= set(columns) <= set(JUNCTION_COLUMNS):
            raise InputError(path, f"the columns are {', '.join(columns)}", hint)
        return columns

    keys = set[str]()

    def check_row(where: str, row: dict[str, str]) -> Iterator[tuple[str, dict[str, str]]]:
        where = f"{where} ({row['junction'] or '?'})"
        _check_name(where, row["junction"], keys)
        keys.add(_folder_key(row["junction"]))
        yield where, row

    rows = spreadsheets.parse_rows(path, check_header, check_row)
    if not keys:
        raise InputError(path, "the table has no junctions", "Add at least one row.")
    return rows


def _folder_key(name: str) -> str:
    """Return a text that is the same for names of one folder: some file systems ignore case and Unicode normal form."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def _check_name(where: str, name: str, other_keys: Collection[str]) -> None:
    """Raise an InputError for a name that no folder can have, or that belongs to the folder of another name."""
    try:
        TypeAdapter(Name).validate_python(name)
    except ValidationError:
        raise InputError(f"{where}: junction", f"invalid name {repr(name)[:80]}", NAME_DESCRIPTION) from None
    if _folder_key(name) in other_keys:
        hint = "Give each junction a name that differs in more than case and Unicode normal form."
        raise InputError(where, "this name occurs twice", hint)


def _parse_junction(where: str, row: dict[str, str]) -> CityJunction:
    x_m, y_m, lat_deg, lon_deg = (parse_number(where, row, key) for key in _MAX_COORDINATES)
    signalised = _BOOLEANS.get(row["signalised"].strip().lower())
    if signalised is None:
        problem = f"expected true or false, got {repr(row['signalised'])[:80]}"
        raise InputError(f"{where}: signalised", problem, "Say whether the junction has traffic lights.")
    return CityJunction(row["junction"], row["title"], x_m, y_m, lat_deg, lon_deg, signalised)


def parse_number(where: str, row: dict[str, str], column: str) -> float:
    """Return a coordinate of a table of junctions; raise an InputError if it is no number or out of range."""
    limit = _MAX_COORDINATES[column]
    value = number_or_nan(row[column], parse_decimal)
    if not abs(value) <= limit:
        problem = f"expected a number from {-limit:g} to {limit:g}, got {repr(row[column])[:80]}"
        raise InputError(f"{where}: {column}", problem, "Correct the table.")
    return value


def junctions_csv(junctions: Iterable[CityJunction]) -> str:
    """Return the text of ``junctions.csv``."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(JUNCTION_COLUMNS)
    for j in junctions:
        writer.writerow([j.id, j.title, j.x_m, j.y_m, j.lat_deg, j.lon_deg, str(j.signalised).lower()])
    return text.getvalue()
