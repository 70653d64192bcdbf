"""Reads and checks a scenario.

Steps of :func:`load`: read the TOML file, lay the ``--set`` overrides over it, validate. Files that it names are
found relative to the folder; ``$SUMO_HOME/`` in front names a file that SUMO ships.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from pipeline.core.errors import InputError
from pipeline.core.grid import Grid
from pipeline.core.reading import documents
from pipeline.scenario.messages import explain
from pipeline.scenario.models import FILE, SITE_DIRECTIONS, SITE_SOURCES, Scenario
from pipeline.scenario.traffic import SOURCES, TrafficModel, idle_beside


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
    path, overrides = Path(path), tuple(overrides)
    file = path / FILE if path.is_dir() else path
    values = _read(file, ())
    for override in overrides:
        if override.partition("=")[0].strip() == "extends":
            found = "a scenario is extended by its file alone"
            raise InputError(f"--set {override}", found, "extends = ... in a scenario.toml")
        values = _lay_over(values, override)
    try:
        return _acting(values, file)
    except InputError as error:
        if not overrides or not _is_sound(file):
            raise
        place, right = (text.replace(str(file), "--set") for text in (error.place, error.right))
        raise InputError(place, error.found, right) from None


def _acting(values: dict[str, Any], file: Path) -> Scenario:
    scenario = from_values(values, file.parent, str(file))
    check_acting(scenario.traffic, file)
    return scenario


def _is_sound(file: Path) -> bool:
    """Whether a file alone makes a scenario, without what is laid over it."""
    try:
        _acting(_read(file, ()), file)
    except InputError:
        return False
    return True


def check_acting(traffic: TrafficModel, file: Path) -> None:
    """InputError where a file sets a key of its traffic that would act on nothing."""
    for table, source, idle in traffic.idle_keys():
        found = f"{', '.join(sorted(idle))} would act on nothing beside {source}"
        raise InputError(f"{file}: {table}", found, "remove it")


def _read(file: Path, heirs: tuple[Path, ...]) -> dict[str, Any]:
    """The values of a scenario file, laid over those of the scenario that it extends."""
    if not file.is_file():
        place = file.parent if file.name == FILE else file
        raise InputError(place, f"no {FILE} there", _instead(place))
    if file.resolve() in heirs:
        raise InputError(f"{file}: extends", "leads back to itself", "a scenario that does not extend this one")
    values = documents.read_toml(file)
    if not isinstance(base := values.get("extends", ""), str):
        raise InputError(f"{file}: extends", f"{base!r}", "the path of a scenario's folder")
    if not base:
        return values
    below = _read(file.parent / base / FILE, (*heirs, file.resolve()))
    return _merged(_making_way(below, values), values)


_OF_SITES = ("points", "only_free", "heights_m")
_ALTERNATIVES = (("traffic", SOURCES), ("sites", SITE_SOURCES), ("sites", SITE_DIRECTIONS))


def _making_way(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """``below`` without the sources of traffic and sites, and the directions of sensors, that ``above`` replaces by
    others, and what hangs on them."""
    left = dict(below)
    for table, sources in _ALTERNATIVES:
        old, new = left.get(table), above.get(table)
        if not isinstance(old, dict) or not isinstance(new, dict):
            continue
        source = next((key for key in sources if key in new), None)
        if source is None or all(key in new for key in sources if key in old):
            continue
        idle = _left_behind(source) if table == "traffic" else _OF_SITES if source in SITE_SOURCES else ()
        left[table] = {key: value for key, value in old.items() if key not in idle and key not in sources}
    return left


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
        extends = documents.read_toml(folder / FILE).get("extends", "")


def from_values(values: dict[str, Any], folder: Path, place: str) -> Scenario:
    """Check a scenario that is at hand as nested values (as ``run.json`` holds it)."""
    values.setdefault("name", default_name(folder) or "scenario")
    try:
        scenario = Scenario.of(values)
    except ValidationError as error:
        raise explain(error, place) from None
    scenario._folders = tuple(_bases(folder, scenario.extends, place))
    Grid.over(scenario.roi.box, scenario.roi.voxel_m, f"{place}: roi")
    return scenario


def default_name(folder: Path) -> str:
    """The name that a folder stands for."""
    return re.sub(r'[\s\x00-\x1f\x7f/\\:*?"<>|]+', "_", folder.resolve().name)[:80]


def json_schema() -> str:
    """The JSON Schema that editors use to complete and check a scenario.toml."""
    return json.dumps(Scenario.model_json_schema(), indent=2, ensure_ascii=False) + "\n"


def _instead(folder: Path) -> str:
    """What may be meant by a folder that is no scenario's."""
    if (folder / "city.toml").is_file():
        return f"it is a city: egvs city run {folder}, or one of its junctions, {folder / 'junctions'}/ID"
    if (folder / "run.json").is_file():
        return "it is the folder of a run; the scenario that it is of"
    return f"a folder with a {FILE}, or the file itself"


def _left_behind(source: str) -> frozenset[str]:
    """The keys of another traffic that a new source of it does not take over."""
    simulated = {"frames", "frame_period_s", "warmup_s"} if source == "fcd" else set()  # a finished file is taken whole
    return idle_beside(source) | {"routes"} | simulated


def _lay_over(values: dict[str, Any], override: str) -> dict[str, Any]:
    """``values`` with one ``key.key=value`` in them."""
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise InputError(f"--set {override}", "no key=value", "for example --set traffic.frames=500")
    try:
        value = documents.toml_value(text)
    except (ValueError, RecursionError):
        value = text
    *parents, last = words = key.strip().split(".")
    if parents:
        values = _making_way(values, {words[0]: {words[1]: value}})
    top = values
    for parent in parents:
        values = _row_of(values, parent, override) if isinstance(values, list) else values.setdefault(parent, {})
        if not isinstance(values, dict | list):
            raise InputError(f"--set {override}", f"'{parent}' is not a table", "a key that the scenario knows")
    if isinstance(values, list):
        raise InputError(f"--set {override}", f"{last!r} is a row, not a key", f"{key.strip()}.KEY=VALUE")
    values[last] = value
    return top


def _row_of(rows: list[Any], wanted: str, override: str) -> Any:
    """A row of a list of tables, by its name, else by its number from 0."""
    for row in rows:
        if isinstance(row, dict) and row.get("name") == wanted:
            return row
    if wanted.isdecimal() and int(wanted) < len(rows):
        return rows[int(wanted)]
    names = [str(row["name"]) for row in rows if isinstance(row, dict) and "name" in row]
    right = f"one of {', '.join(names)}, or a number from 0" if names else f"a number from 0 to {len(rows) - 1}"
    raise InputError(f"--set {override}", f"no row {wanted!r}", right)
