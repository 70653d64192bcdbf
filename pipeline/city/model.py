"""Reads and checks the folder of a city.

A city is a folder of ordinary scenarios that share one traffic:

    city.toml                      name, seed, [traffic], [effects]: the traffic of all junctions
    junctions.csv                  which junctions there are, one a row
    junctions/scenario.toml        what their scenarios have in common
    junctions/<ID>/scenario.toml   an ordinary scenario; its traffic is the file below
    traffic/<ID>.parquet           the city's traffic, cut to the junction (pipeline.city.traffic makes it); where it
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

from pipeline.core.errors import InputError
from pipeline.core.reading import documents, limits
from pipeline.core.strict_model import StrictModel
from pipeline.scenario.effects import EffectsModel
from pipeline.scenario.loading import check_acting, default_name
from pipeline.scenario.messages import explain
from pipeline.scenario.models import FILE as SCENARIO_FILE
from pipeline.scenario.traffic import TrafficModel
from pipeline.scenario.types import FARTHEST_M, NAME_IN_WORDS, Name

FILE, NETWORK, TABLE = "city.toml", "network.net.xml", "junctions.csv"
JUNCTIONS, TRAFFIC, PERIODS = "junctions", "traffic", "periods"
COLUMNS = ("junction", "title", "x_m", "y_m", "lat_deg", "lon_deg", "signalised")
"""Of ``junctions.csv``."""

_MOST = {"x_m": FARTHEST_M, "y_m": FARTHEST_M, "lat_deg": 90.0, "lon_deg": 180.0}
_TRUTH = {"true": True, "false": False}


class CityModel(StrictModel):
    """The keys of ``city.toml``."""

    name: Name = Field("", min_length=0, validate_default=False, description="Defaults to the folder's name")
    description: str = ""
    attribution: str = Field("", description="Whose map this is; shown with results")
    seed: int = Field(0, ge=0, le=2**63 - 1, description="Of the traffic")
    traffic: TrafficModel = Field(description="The traffic of all junctions, as in a scenario")
    effects: EffectsModel = Field(EffectsModel(), description="Effects that add traffic: people on foot, on bicycles")


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
        return city.folder / JUNCTIONS / self.id

    def traffic_file(self, city: City, period: str = "") -> Path:
        """The city's traffic, or that of a period of it, cut to this junction."""
        folder = city.folder / TRAFFIC
        return (folder / PERIODS / period if period else folder) / f"{self.id}.parquet"


@dataclass(frozen=True)
class City:
    """A city that was read; ``junctions`` in the order of the table."""

    folder: Path
    name: str
    seed: int
    traffic: TrafficModel
    junctions: tuple[CityJunction, ...]
    attribution: str = ""
    description: str = ""
    effects: EffectsModel = field(default_factory=EffectsModel)

    @property
    def file(self) -> Path:
        """``city.toml``, for messages."""
        return self.folder / FILE

    def junction(self, wanted: str) -> CityJunction:
        """The junction of this name; InputError where there is none."""
        for junction in self.junctions:
            if junction.id == wanted:
                return junction
        names = ", ".join(junction.id for junction in self.junctions)
        raise InputError(f"--junction {wanted}", f"no such junction in {self.folder / TABLE}", f"one of {names}")


def load(folder: str | Path) -> City:
    """Read and check a city, given its folder or its ``city.toml``.

    Raises
    ------
    InputError
        Naming file, key or row, value, and what would be right: a file is missing or no sound one, a key is unknown, a
        junction stands there twice or has no scenario.
    """
    path = Path(folder)
    file = path if path.is_file() else path / FILE
    if not file.is_file():
        raise InputError(path, f"no {FILE} there", "a folder that egvs city new made")
    model = _model(file)
    junctions = tuple(_junctions(file.parent / TABLE))
    city = City(
        file.parent, model.name, model.seed, model.traffic, junctions, model.attribution, model.description,
        model.effects,
    )  # fmt: skip
    for junction in junctions:
        if not (its := junction.scenario_folder(city) / SCENARIO_FILE).is_file():
            right = f"a scenario there, or no row {junction.id} in {TABLE}"
            raise InputError(its, "no such file", right)
    return city


def json_schema() -> str:
    """The JSON Schema that editors use to complete and check a city.toml."""
    return json.dumps(CityModel.model_json_schema(), indent=2, ensure_ascii=False) + "\n"


def _model(file: Path) -> CityModel:
    values = documents.read_toml(file)
    values.setdefault("name", default_name(file.parent) or "city")
    try:
        model = CityModel.of(values)
    except ValidationError as error:
        raise explain(error, str(file), CityModel) from None
    check_acting(model.traffic, file)
    return model


def _junctions(path: Path) -> Iterator[CityJunction]:
    seen = set[str]()
    for place, row in csv_rows(path, COLUMNS, COLUMNS):
        junction = _junction(place, row)
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


def _junction(place: str, row: dict[str, str]) -> CityJunction:
    try:
        TypeAdapter(Name).validate_python(row["junction"])
    except ValidationError:
        raise InputError(f"{place}: junction", repr(row["junction"])[:80], NAME_IN_WORDS) from None
    numbers = {key: number(f"{place}: {key}", row[key], most) for key, most in _MOST.items()}
    signalised = _TRUTH.get(row["signalised"].strip().lower())
    if signalised is None:
        raise InputError(f"{place}: signalised", repr(row["signalised"])[:80], "true or false")
    return CityJunction(row["junction"], row["title"], **numbers, signalised=signalised)


def number(place: str, text: str, most: float) -> float:
    """A number of a table, at most ``most`` either way; InputError where it is none."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= most:
        raise InputError(place, repr(text)[:80], f"a number from {-most:g} to {most:g}")
    return value


def table(junctions: tuple[CityJunction, ...]) -> Iterator[list[Any]]:
    """The rows of ``junctions.csv``, its header first."""
    yield list(COLUMNS)
    for j in junctions:
        yield [j.id, j.title, j.x_m, j.y_m, j.lat_deg, j.lon_deg, str(j.signalised).lower()]
