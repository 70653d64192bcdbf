"""Load(): base files, --set, messages that name key, value and hint; JSON schema.

What is wrong with a scenario, in words: key, value, what would be right.

Reads and checks a scenario.

Steps of :func:`load`: read the TOML file, lay the ``--set`` overrides over it, validate. Files that it names are
found relative to the folder; ``$SUMO_HOME/`` in front names a file that SUMO ships.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from egvs.core import reading
from egvs.core.errors import InputError
from egvs.core.grid import Grid
from egvs.scenario.fields import NAME_DESCRIPTION
from egvs.scenario.model import SCENARIO_FILE, SITE_DIRECTIONS, SITE_SOURCES, Scenario
from egvs.scenario.traffic_config import TRAFFIC_SOURCES, TrafficConfig, unused_keys

_ALTERNATIVE = re.compile(r"\.(?:(?:constrained-)?(?:float|int|str)|(?:literal|tuple)\[.*\])$")
"""How pydantic's place of an error ends in a value that may be of several types."""

_SHOULD_BE = "input should be "


def format_validation_error(error: ValidationError, where: str, model: type[BaseModel] = Scenario) -> InputError:
    """One line for each thing that is wrong with a ``model``: key, value, what would be right."""
    lines = list(_joined(_lines(error, model, ())))
    key, found, right = lines[0]
    more = "".join(f"\n{where}: {k}: {f}" + (f"; {r}" if r else "") for k, f, r in lines[1:])
    return InputError(f"{where}: {key}", found, right + more)


def _joined(lines: Iterator[tuple[str, str, str]]) -> Iterator[tuple[str, str, str]]:
    """What every alternative of a value says, in one line: "a valid number or 'auto'"."""
    said: dict[tuple[str, str], list[str]] = {}
    for key, found, right in lines:
        said.setdefault((_ALTERNATIVE.sub("", key), found), []).append(right)
    for (key, found), rights in said.items():
        first, *others = dict.fromkeys(rights)
        yield key, found, " or ".join([first, *(other.removeprefix(_SHOULD_BE) for other in others)])


def _lines(error: ValidationError, model: type[BaseModel], above: tuple[str, ...]) -> Iterator[tuple[str, str, str]]:
    """Key, what stands there, and what would be right, of all that is wrong in ``model``, found under ``above``."""
    for item in error.errors():
        key = ".".join(str(part) for part in (*above, *item["loc"]) if part != "[key]")
        context = item.get("ctx", {})
        if item["type"] == "default_factory_not_called":
            continue  # follows from another key that is wrong, which is told
        if item["type"] == "extra_forbidden":
            yield key, "unknown key", nearest_key(item["loc"], model)
        elif item["type"] == "missing":
            yield key, "missing", "this key is needed"
        elif item["type"] == "string_pattern_mismatch":
            yield key, f"{item['input']!r}", NAME_DESCRIPTION
        elif item["type"] == "value_error":
            yield key or "scenario", str(context["error"]), ""
        elif item["type"] == "unknown_effect":
            yield f"{key}.{context['name']}", "unknown effect", context["right"]
        elif item["type"] == "of_an_effect":
            yield from _lines(context["error"], context["model"], (key, context["name"]))
        else:
            yield key, f"{item['input']!r}", item["msg"][0].lower() + item["msg"][1:]


def nearest_key(loc: Sequence[str | int], top: type[BaseModel]) -> str:
    """What the user may have meant by an unknown key of ``top``."""
    model: type[BaseModel] | None = top
    if len(loc) == 1 and (inner := _tables_with(str(loc[0]), top)):
        return f"did you mean {' or '.join(f'{table}.{loc[0]}' for table in inner)}?"
    for part in loc[:-1]:
        if model is not None and part in model.model_fields:
            model = _model_of(model.model_fields[str(part)].annotation)
    known = sorted(model.model_fields) if model is not None else []
    near = difflib.get_close_matches(str(loc[-1]), known, 1, 0.5)
    return f"did you mean {near[0]}?" if near else f"known here are {', '.join(known)}"


def _tables_with(key: str, top: type[BaseModel]) -> list[str]:
    """The tables of ``top`` that know a key."""
    models = {name: _model_of(field.annotation) for name, field in top.model_fields.items()}
    return [name for name, model in models.items() if model is not None and key in model.model_fields]


def _model_of(annotation: Any) -> type[BaseModel] | None:
    """The model inside an annotation such as ``tuple[SiteLine, ...]`` or ``SiteGrid | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        if found := _model_of(inner):
            return found
    return None


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

    Examples
    --------
    >>> import egvs
    >>> scenario = egvs.load("scenarios/roundabout", ["traffic.frames=100"])
    >>> scenario.roi.size_m
    (70.0, 70.0, 5.0)
    """
    path, overrides = Path(path), tuple(overrides)
    file = path / SCENARIO_FILE if path.is_dir() else path
    values = _read_with_bases(file, ())
    for override in overrides:
        if override.partition("=")[0].strip() == "extends":
            found = "a scenario is extended by its file alone"
            raise InputError(f"--set {override}", found, "extends = ... in a scenario.toml")
        values = _apply_override(values, override)
    try:
        return _build_scenario(values, file)
    except InputError as error:
        if not overrides or not _is_valid_alone(file):
            raise
        place, right = (text.replace(str(file), "--set") for text in (error.where, error.hint))
        raise InputError(place, error.problem, right) from None


def _build_scenario(values: dict[str, Any], file: Path) -> Scenario:
    scenario = scenario_from_dict(values, file.parent, str(file))
    check_unused_keys(scenario.traffic, file)
    return scenario


def _is_valid_alone(file: Path) -> bool:
    """Whether a file alone makes a scenario, without what is laid over it."""
    try:
        _build_scenario(_read_with_bases(file, ()), file)
    except InputError:
        return False
    return True


def check_unused_keys(traffic: TrafficConfig, file: Path) -> None:
    """InputError where a file sets a key of its traffic that would act on nothing."""
    for table, source, idle in traffic.unused_keys():
        found = f"{', '.join(sorted(idle))} would act on nothing beside {source}"
        raise InputError(f"{file}: {table}", found, "remove it")


def _read_with_bases(file: Path, heirs: tuple[Path, ...]) -> dict[str, Any]:
    """The values of a scenario file, laid over those of the scenario that it extends."""
    if not file.is_file():
        place = file.parent if file.name == SCENARIO_FILE else file
        raise InputError(place, f"no {SCENARIO_FILE} there", _suggest_scenario(place))
    if file.resolve() in heirs:
        raise InputError(f"{file}: extends", "leads back to itself", "a scenario that does not extend this one")
    values = reading.read_toml(file)
    if not isinstance(base := values.get("extends", ""), str):
        raise InputError(f"{file}: extends", f"{base!r}", "the path of a scenario's folder")
    if not base:
        return values
    below = _read_with_bases(file.parent / base / SCENARIO_FILE, (*heirs, file.resolve()))
    return _merge(_drop_replaced_keys(below, values), values)


_SITE_RULE_KEYS = ("points", "only_free", "heights_m")
_ALTERNATIVES = (("traffic", TRAFFIC_SOURCES), ("sites", SITE_SOURCES), ("sites", SITE_DIRECTIONS))


def _drop_replaced_keys(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
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
        idle = (
            _dropped_traffic_keys(source) if table == "traffic" else _SITE_RULE_KEYS if source in SITE_SOURCES else ()
        )
        left[table] = {key: value for key, value in old.items() if key not in idle and key not in sources}
    return left


def _merge(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, dict) and isinstance(below.get(key), dict)
        merged[key] = _merge(below[key], value) if both else value
    return merged


def _bases(folder: Path, extends: str, where: str) -> Iterator[Path]:
    """The scenario's folder, then those of the scenarios that it extends."""
    yield folder
    while extends:
        folder = folder / extends
        if not (folder / SCENARIO_FILE).is_file():
            raise InputError(f"{where}: extends", f"no {SCENARIO_FILE} in {folder}", "the path of a scenario's folder")
        yield folder
        extends = reading.read_toml(folder / SCENARIO_FILE).get("extends", "")


def scenario_from_dict(values: dict[str, Any], folder: Path, where: str) -> Scenario:
    """Check a scenario that is at hand as nested values (as ``run.json`` holds it)."""
    values.setdefault("name", default_name(folder) or "scenario")
    try:
        scenario = Scenario.of(values)
    except ValidationError as error:
        raise format_validation_error(error, where) from None
    scenario._folders = tuple(_bases(folder, scenario.extends, where))
    Grid.over(scenario.roi.box, scenario.roi.voxel_m, f"{where}: roi")
    return scenario


def default_name(folder: Path) -> str:
    """The name that a folder stands for."""
    return re.sub(r'[\s\x00-\x1f\x7f/\\:*?"<>|]+', "_", folder.resolve().name)[:80]


def json_schema() -> str:
    """The JSON Schema that editors use to complete and check a scenario.toml."""
    return json.dumps(Scenario.model_json_schema(), indent=2, ensure_ascii=False) + "\n"


def _suggest_scenario(folder: Path) -> str:
    """What may be meant by a folder that is no scenario's."""
    if (folder / "city.toml").is_file():
        return f"it is a city: egvs city run {folder}, or one of its junctions, {folder / 'junctions'}/ID"
    if (folder / "run.json").is_file():
        return "it is the folder of a run; the scenario that it is of"
    return f"a folder with a {SCENARIO_FILE}, or the file itself"


def _dropped_traffic_keys(source: str) -> frozenset[str]:
    """The keys of another traffic that a new source of it does not take over."""
    simulated = {"frames", "frame_period_s", "warmup_s"} if source == "fcd" else set()  # a finished file is taken whole
    return unused_keys(source) | {"routes"} | simulated


def _apply_override(values: dict[str, Any], override: str) -> dict[str, Any]:
    """``values`` with one ``key.key=value`` in them."""
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise InputError(f"--set {override}", "no key=value", "for example --set traffic.frames=500")
    try:
        value = reading.parse_toml_value(text)
    except (ValueError, RecursionError):
        value = text
    *parents, last = words = key.strip().split(".")
    if parents:
        values = _drop_replaced_keys(values, {words[0]: {words[1]: value}})
    top = values
    for parent in parents:
        values = _find_row(values, parent, override) if isinstance(values, list) else values.setdefault(parent, {})
        if not isinstance(values, dict | list):
            raise InputError(f"--set {override}", f"'{parent}' is not a table", "a key that the scenario knows")
    if isinstance(values, list):
        raise InputError(f"--set {override}", f"{last!r} is a row, not a key", f"{key.strip()}.KEY=VALUE")
    values[last] = value
    return top


def _find_row(rows: list[Any], name_or_number: str, override: str) -> Any:
    """A row of a list of tables, by its name, else by its number from 0."""
    for row in rows:
        if isinstance(row, dict) and row.get("name") == name_or_number:
            return row
    if name_or_number.isdecimal() and int(name_or_number) < len(rows):
        return rows[int(name_or_number)]
    names = [str(row["name"]) for row in rows if isinstance(row, dict) and "name" in row]
    right = f"one of {', '.join(names)}, or a number from 0" if names else f"a number from 0 to {len(rows) - 1}"
    raise InputError(f"--set {override}", f"no row {name_or_number!r}", right)
