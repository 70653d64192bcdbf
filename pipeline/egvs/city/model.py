"""Reads and checks the folder of a city.

A city is a folder of ordinary scenarios that share one traffic:

    city.toml                      name, seed, [traffic], [effects]: the traffic of all junctions
    junctions.csv                  which junctions there are, one a row
    junctions/scenario.toml        what their scenarios have in common
    junctions/<ID>/scenario.toml   an ordinary scenario; its traffic is the file below
    traffic/<ID>.parquet           the city's traffic, cut to the junction (egvs.city.traffic_split makes it); where it
                                   has periods, traffic/periods/<NAME>/<ID>.parquet

Positions are in the network's x, y in metres, and in degrees (WGS 84).
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import Field, TypeAdapter, ValidationError

from egvs.core import limits, reading
from egvs.core.errors import InputError
from egvs.scenario.effects_config import EffectsConfig
from egvs.scenario.fields import MAX_COORDINATE_M, NAME_DESCRIPTION, Name, StrictModel
from egvs.scenario.loading import check_unused_keys, default_name, format_validation_error
from egvs.scenario.model import SCENARIO_FILE
from egvs.scenario.traffic_config import TrafficConfig

CITY_FILE, NETWORK_FILE, JUNCTIONS_FILE = "city.toml", "network.net.xml", "junctions.csv"
JUNCTIONS_FOLDER, TRAFFIC_FOLDER, PERIODS_FOLDER = "junctions", "traffic", "periods"
COLUMNS = ("junction", "title", "x_m", "y_m", "lat_deg", "lon_deg", "signalised")
"""Of ``junctions.csv``."""

_MAX_COORDINATES = {"x_m": MAX_COORDINATE_M, "y_m": MAX_COORDINATE_M, "lat_deg": 90.0, "lon_deg": 180.0}
_BOOLEANS = {"true": True, "false": False}


class CityModel(StrictModel):
    """The keys of ``city.toml``."""

    name: Name = Field("", min_length=0, validate_default=False, description="Defaults to the folder's name")
    description: str = ""
    attribution: str = Field("", description="Whose map this is; shown with results")
    seed: int = Field(0, ge=0, le=2**63 - 1, description="Of the traffic")
    traffic: TrafficConfig = Field(description="The traffic of all junctions, as in a scenario")
    effects: EffectsConfig = Field(EffectsConfig(), description="Effects that add traffic: people on foot, on bicycles")


@dataclass(frozen=True)
class CityJunction:
    """A junction: its ``id`` is the name of its folder."""

    id: str
    title: str
    x_m: float
    y_m: float
    lat_deg: float
    lon_deg: float
    signalised: bool

    def scenario_folder(self, city: City) -> Path:
        """The folder of its scenario."""
        return city.folder / JUNCTIONS_FOLDER / self.id

    def traffic_file(self, city: City, period: str = "") -> Path:
        """The city's traffic, or that of a period of it, cut to this junction."""
        folder = city.folder / TRAFFIC_FOLDER
        return (folder / PERIODS_FOLDER / period if period else folder) / f"{self.id}.parquet"


@dataclass(frozen=True)
class City:
    """A city that was read; ``junctions`` in the order of the table."""

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
        """The junction of this name; InputError where there is none."""
        for junction in self.junctions:
            if junction.id == name:
                return junction
        names = ", ".join(junction.id for junction in self.junctions)
        raise InputError(f"--junction {name}", f"no such junction in {self.folder / JUNCTIONS_FILE}", f"one of {names}")


def load_city(folder: str | Path) -> City:
    """Read and check a city, given its folder or its ``city.toml``.

    Raises
    ------
    InputError
        Naming file, key or row, value, and what would be right: a file is missing or no sound one, a key is unknown, a
        junction stands there twice or has no scenario.
    """
    path = Path(folder)
    file = path if path.is_file() else path / CITY_FILE
    if not file.is_file():
        raise InputError(path, f"no {CITY_FILE} there", "a folder that egvs city new made")
    model = _read_model(file)
    junctions = tuple(_read_junctions(file.parent / JUNCTIONS_FILE))
    city = City(
        file.parent, model.name, model.seed, model.traffic, junctions, model.attribution, model.description,
        model.effects,
    )  # fmt: skip
    for junction in junctions:
        if not (its := junction.scenario_folder(city) / SCENARIO_FILE).is_file():
            right = f"a scenario there, or no row {junction.id} in {JUNCTIONS_FILE}"
            raise InputError(its, "no such file", right)
    return city


def city_json_schema() -> str:
    """The JSON Schema that editors use to complete and check a city.toml."""
    return json.dumps(CityModel.model_json_schema(), indent=2, ensure_ascii=False) + "\n"


def _read_model(file: Path) -> CityModel:
    values = reading.read_toml(file)
    values.setdefault("name", default_name(file.parent) or "city")
    try:
        model = CityModel.from_dict(values)
    except ValidationError as error:
        raise format_validation_error(error, str(file), CityModel) from None
    check_unused_keys(model.traffic, file)
    return model


def _read_junctions(path: Path) -> Iterator[CityJunction]:
    seen = set[str]()
    for place, row in csv_rows(path, COLUMNS, COLUMNS):
        junction = _parse_junction(place, row)
        if junction.id.casefold() in seen:  # folders that some systems do not tell apart
            raise InputError(place, "stands there twice", "a name of its own for each junction")
        seen.add(junction.id.casefold())
        yield junction
    if not seen:
        raise InputError(path, "holds no junction", "at least one")


def csv_rows(path: Path, needed: Sequence[str], known: Sequence[str]) -> Iterator[tuple[str, dict[str, str]]]:
    """The rows of a table of junctions, each with its place for messages.

    InputError where it has not the ``needed`` columns, or others than those ``known``.
    """
    right = f"the columns {', '.join(needed)}"
    if not path.is_file():
        raise InputError(path, "no such file", f"a table with {right}")
    text = limits.read_bytes(path, limits.DOCUMENT)
    try:
        reader = csv.DictReader(text.decode("utf-8-sig").splitlines(), skipinitialspace=True, strict=True)
        names = list(reader.fieldnames or ())
        if not set(needed) <= set(names) <= set(known) or len(set(names)) < len(names):
            raise InputError(path, f"has the columns {', '.join(names) or 'none'}", f"{right}, with commas")
        for row in reader:
            place = f"{path}: junction {row.get('junction') or '?'}"
            if None in row or None in row.values():
                raise InputError(place, "has more or fewer values than the header has columns", "one value a column")
            yield place, row
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(path, f"cannot be read as CSV ({error})", "UTF-8 text with a header row") from None


def _parse_junction(location: str, row: dict[str, str]) -> CityJunction:
    try:
        TypeAdapter(Name).validate_python(row["junction"])
    except ValidationError:
        raise InputError(f"{location}: junction", repr(row["junction"])[:80], NAME_DESCRIPTION) from None
    numbers = {key: parse_number(f"{location}: {key}", row[key], most) for key, most in _MAX_COORDINATES.items()}
    signalised = _BOOLEANS.get(row["signalised"].strip().lower())
    if signalised is None:
        raise InputError(f"{location}: signalised", repr(row["signalised"])[:80], "true or false")
    return CityJunction(row["junction"], row["title"], **numbers, signalised=signalised)


def parse_number(location: str, text: str, most: float) -> float:
    """A number of a table, at most ``most`` either way; InputError where it is none."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= most:
        raise InputError(location, repr(text)[:80], f"a number from {-most:g} to {most:g}")
    return value


def table_rows(junctions: tuple[CityJunction, ...]) -> Iterator[list[Any]]:
    """The rows of ``junctions.csv``, its header first."""
    yield list(COLUMNS)
    for j in junctions:
        yield [j.id, j.title, j.x_m, j.y_m, j.lat_deg, j.lon_deg, str(j.signalised).lower()]
