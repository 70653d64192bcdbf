"""Load a scenario: its file, the scenarios that it extends, and overrides of the command line.

Steps of :func:`load`: read the TOML file and those that it extends; apply the ``--set`` overrides; validate. Paths in a
scenario are relative to its folder; ``$SUMO_HOME/`` at the start of a path refers to the files that SUMO ships.

Messages about invalid values name the key, the value, and what is expected.
"""

from __future__ import annotations

import csv
import difflib
import json
import os
import re
import shlex
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from egvs.core import files, reading
from egvs.core.errors import InputError, check_list, format_problem
from egvs.core.grid import Grid
from egvs.core.numbers import WrittenNumber, ambiguous_number, number_or_nan
from egvs.core.table_columns import parse_header
from egvs.scenario.fields import NAME_DESCRIPTION
from egvs.scenario.model import SCENARIO_FILE, SITE_DIRECTIONS, SITE_SENSORS, SITE_SOURCES, Scenario, StaticsConfig
from egvs.scenario.settings import changed_settings, flatten_settings
from egvs.scenario.shipped import shipped_names, shipped_scenario
from egvs.scenario.traffic_config import (
    COUNT_IDS,
    COUNT_NAMES,
    FINISHED_SOURCES,
    MAX_PER_HOUR,
    TRAFFIC_SOURCES,
    TrafficConfig,
    keys_without_effect,
)

_ALTERNATIVE = re.compile(r"\.(?:(?:constrained-)?(?:float|int|str)|(?:literal|tuple)\[.*\])$")
"""End of pydantic's location of an error in a value that may have one of several types."""

_TABLE_NAME = re.compile(r"\.[A-Z][A-Za-z]+Parameters(?=\.|$)")
"""Pydantic's location of a table that may also be a single value: the name of its class."""

_EXPECTATION = re.compile(r"[A-Z]\w+ should (?:be|have) (?P<what>.+?)(?: after validation, not .+)?$")
"""Most messages of pydantic: "Input should be a valid number"."""

_TOML_TERMS = {"an object": "a table", "a valid array": "a list", "False": "false"}


class _KeyProblem(NamedTuple):
    """What is wrong with a key.

    Attributes
    ----------
    key
        The key with its tables, e.g. ``"roi.voxel_m"``.
    problem
        What is wrong; only the value where ``expected`` is set.
    hint
        What to do about it.
    expected
        What the value should be.
    """

    key: str
    problem: str
    hint: str = ""
    expected: str = ""


def format_validation_error(error: ValidationError, where: str, model: type[BaseModel] = Scenario) -> InputError:
    """Convert an error of pydantic to an InputError with one line for each problem.

    Parameters
    ----------
    error
        The error of pydantic.
    where
        The file, for messages.
    model
        The table that was validated.
    """
    problems = _merge_alternatives(_key_problems(error, model, ()))
    first = f"{where}: {problems[0].key}"
    lines = [format_problem(f"{where}: {problem.key}", problem.problem, problem.hint) for problem in problems]
    return InputError(first, "\n".join(lines).removeprefix(f"{first}: "))


def _merge_alternatives(problems: Iterable[_KeyProblem]) -> list[_KeyProblem]:
    """Merge the problems that pydantic reports for each type that a value may have: "a valid number or 'auto'"."""
    alternatives: dict[_KeyProblem, dict[str, None]] = {}
    for problem in problems:
        merged = problem._replace(key=_ALTERNATIVE.sub("", problem.key), expected="")
        alternatives.setdefault(merged, {})[problem.expected] = None
    return [problem._replace(problem=_describe(problem, list(expected))) for problem, expected in alternatives.items()]


def _describe(problem: _KeyProblem, expected: list[str]) -> str:
    return f"expected {' or '.join(expected)}, got {problem.problem}" if any(expected) else problem.problem


def _key_problems(error: ValidationError, model: type[BaseModel], parents: tuple[str, ...]) -> Iterator[_KeyProblem]:
    """Yield all problems of a table of a type ``model``; ``parents`` are the keys of the tables around it."""
    for item in error.errors():
        if item["type"] == "literal_error" and isinstance(item["input"], dict):
            continue  # a table that may also be a single value; the problems of the table are reported
        key = ".".join(str(part) for part in (*parents, *item["loc"]) if part != "[key]")
        key = _TABLE_NAME.sub("", key)
        value = repr(item["input"])
        context = item.get("ctx", {})
        match item["type"]:
            case "default_factory_not_called":
                continue  # follows from another problem, which is reported
            case "too_short" if len(item["input"]) >= context["min_length"]:
                continue  # so does this: items with problems are not counted
            case "extra_forbidden":
                yield _KeyProblem(key, "unknown key", _suggest_key(item["loc"], model))
            case "missing":
                yield _KeyProblem(key, "this key is required")
            case "string_pattern_mismatch":
                yield _KeyProblem(key, value, NAME_DESCRIPTION, "a name")
            case "value_error":
                yield _KeyProblem(key or "scenario", str(context["error"]))
            case "unknown_effect":
                yield _KeyProblem(f"{key}.{context['name']}", "unknown effect", context["hint"])
            case "effect_parameters":
                yield from _key_problems(context["error"], context["model"], (key, context["name"]))
            case _:
                yield _wrong_value(key, value, item["msg"])


def _wrong_value(key: str, value: str, message: str) -> _KeyProblem:
    """Return the problem of pydantic's ``message`` about a value."""
    expectation = _EXPECTATION.match(message)
    if expectation is None:
        return _KeyProblem(key, f"{value}: {message[0].lower()}{message[1:]}")
    expected = expectation["what"]
    if expected.startswith(("greater ", "less ")):
        expected = f"a value {expected}"
    return _KeyProblem(key, value, expected=_TOML_TERMS.get(expected, expected))


def _suggest_key(location: Sequence[str | int], top: type[BaseModel]) -> str:
    """Return a hint at the key of ``top`` that the user may have meant."""
    key = str(location[-1])
    fields = top.model_fields
    tables = [f"{name}.{key}" for name, table in fields.items() if key in _table_fields(table.annotation)]
    for part in location[:-1]:
        if part in fields:
            fields = _table_fields(fields[str(part)].annotation)
    if tables and (len(location) == 1 or not difflib.get_close_matches(key, sorted(fields), 1, 0.8)):
        return f"Did you mean {' or '.join(tables)}?"
    similar = difflib.get_close_matches(key, sorted(fields), 1, 0.5)
    return f"Did you mean {similar[0]}?" if similar else f"Known keys are {', '.join(sorted(fields))}."


def _table_fields(annotation: Any) -> dict[str, FieldInfo]:
    """Return the keys of the table in an annotation such as ``tuple[SiteLine, ...]`` or ``SiteGrid | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation.model_fields
    fields = (_table_fields(argument) for argument in getattr(annotation, "__args__", ()))
    return next(filter(None, fields), {})


def load(path: str | Path, overrides: Iterable[str] = ()) -> Scenario:
    """Read and check a scenario.

    Parameters
    ----------
    path
        The folder, or its ``scenario.toml``; the name of a scenario that comes with this program, if there is no such
        folder.
    overrides
        ``"table.key=value"``, the value as in TOML; a word without quotes is a string.

    Raises
    ------
    InputError
        When the scenario is invalid, naming the file, the key, the value, and what is expected.

    Examples
    --------
    >>> import egvs
    >>> scenario = egvs.load("scenarios/roundabout", ["traffic.frames=100"])
    >>> scenario.roi.size_m
    (70.0, 70.0, 5.0)
    """
    path = Path(path)
    files.check_utf8("the scenario", str(path.absolute()))
    check_list("overrides", overrides)
    overrides = tuple(overrides)
    if path.name == os.fspath(path) and path.name in shipped_names() and not path.exists():
        path = shipped_scenario(path.name)
    file = path / SCENARIO_FILE if path.is_dir() else path
    values = apply_overrides(_read_with_bases(file, ()), overrides)
    try:
        scenario = _build_scenario(values, file)
    except InputError as error:
        if not overrides or _scenario_without_overrides(file) is None:
            raise
        texts = [text.replace(str(file), "--set") for text in (error.where, error.problem, error.hint)]
        raise InputError(*texts) from None
    if overrides:
        scenario._overrides = _changes_by_overrides(scenario, values, file)
    return scenario


def apply_overrides(values: dict[str, Any], overrides: Iterable[str]) -> dict[str, Any]:
    """Return nested tables, as in a scenario file, with overrides ``"table.key=value"``; ``values`` may change too.

    Raises
    ------
    InputError
        When an override is not of this form, names a row that does not exist, or is replaced by a later one.
    """
    overrides = tuple(overrides)
    for number, override in enumerate(overrides):
        if override.partition("=")[0].strip() == "extends":
            hint = f"Set it in a {SCENARIO_FILE}."
            raise InputError(f"--set {override}", "the key extends cannot be set here", hint)
        values = _apply_override(values, override)
        _check_earlier_overrides(values, overrides[:number], override)
    return values


def _build_scenario(values: dict[str, Any], file: Path) -> Scenario:
    scenario = scenario_from_dict(values, file.parent, str(file))
    check_unused_keys(scenario.traffic, file)
    _check_polygon_keys(scenario.statics, file)
    scenario._written_site_keys = frozenset(scenario.sites.model_fields_set)
    return scenario


def _scenario_without_overrides(file: Path) -> Scenario | None:
    """Return the scenario of a file; None if it is not valid without overrides."""
    try:
        return _build_scenario(_read_with_bases(file, ()), file)
    except InputError:
        return None


def _changes_by_overrides(scenario: Scenario, values: dict[str, Any], file: Path) -> dict[str, Any]:
    """Return the settings that overrides changed, by full key.

    The resolved scenarios are compared, so that neither the spelling of a value counts, nor an override that repeats
    the file or a default. A file that is not complete without the overrides is compared as it is written. The name is
    left out: it is a name for the results.
    """
    resolved = scenario.model_dump(mode="json")
    base = _scenario_without_overrides(file)
    if base is not None:
        changed = changed_settings(base.model_dump(mode="json"), resolved)
    else:
        changed = changed_settings(_read_with_bases(file, ()), values)
        changed |= {key: value for key, value in flatten_settings(resolved).items() if key in changed}
    changed.pop("name", None)
    return changed


def check_unused_keys(traffic: TrafficConfig, file: Path) -> None:
    """Raise an InputError when a file sets keys of ``[traffic]`` that have no effect.

    Parameters
    ----------
    traffic
        The traffic of the file.
    file
        The scenario or city, for messages.
    """
    for unused in traffic.unused_keys():
        names = ", ".join(sorted(unused.keys))
        problem = f"{names} {'have' if len(unused.keys) > 1 else 'has'} no effect with {unused.source}"
        raise InputError(f"{file}: {unused.table}", problem, f"Remove {names}.")


def _check_polygon_keys(statics: StaticsConfig, file: Path) -> None:
    """Raise an InputError when a file says how SUMO's polygons become solids, but names no polygons."""
    keys = sorted(statics.model_fields_set & set(_POLYGON_KEYS))
    if keys and not statics.polygons:
        names = " and ".join(keys)
        verb = "have" if len(keys) > 1 else "has"
        problem = f"{names} {verb} no effect without polygons"
        raise InputError(f"{file}: statics", problem, f"Set polygons, or remove {names}.")


def _read_with_bases(file: Path, extending: tuple[Path, ...]) -> dict[str, Any]:
    """Return the values of a scenario file and of those that it extends; ``extending`` are the files that extend it."""
    if not file.is_file():
        where = file.parent if file.name == SCENARIO_FILE else file
        if not where.exists():
            raise InputError(where, "no such folder", _suggest_similar_scenario(where))
        raise InputError(where, f"expected a {SCENARIO_FILE}, got none", _suggest_scenario(where))
    if file.resolve() in extending:
        raise InputError(f"{file}: extends", "the scenario extends itself", "Extend a different scenario.")
    values = _with_count_tables(reading.read_toml(file), file)
    _check_amounts("", values, str(file))
    extends = values.get("extends", "")
    if not isinstance(extends, str):
        raise InputError(f"{file}: extends", f"expected the path of a scenario folder, got {extends!r}")
    if not extends:
        return values
    base = _read_with_bases(file.parent / extends / SCENARIO_FILE, (*extending, file.resolve()))
    return _merge(_drop_replaced_keys(base, values), values)


def _check_amounts(key: str, value: Any, where: str) -> None:
    """Raise an InputError for a budget or a cost in which a point can separate thousands: 30.000."""
    if isinstance(value, dict):
        for name, inner in value.items():
            _check_amounts(f"{key}.{name}" if key else name, inner, where)
    elif isinstance(value, WrittenNumber) and key.startswith(("placement.budget", "costs.")):
        choices = ambiguous_number(value.text)
        raise InputError(f"{where}: {key}", f"{value.text} can mean {choices}", f"Write {choices}.")


def _with_count_tables(values: dict[str, Any], file: Path) -> dict[str, Any]:
    """Return the values with the rows of tables in place of their names: ``counts = "counts.csv"``."""
    traffic = values.get("traffic")
    if not isinstance(traffic, dict):
        return values
    periods = traffic.get("periods")
    for table in (traffic, *(periods if isinstance(periods, list) else ())):
        if isinstance(table, dict) and isinstance(table.get("counts"), str):
            table["counts"] = _read_counts(file.parent / table["counts"], f"{file}: traffic.counts")
    return values


def _read_counts(path: Path, where: str) -> list[dict[str, Any]]:
    """Return the counts of a table as rows of ``traffic.counts``; columns with names are for people."""
    if not path.is_file():
        raise InputError(where, f"no such file: {path}", "Give the path of a CSV file, or counts in rows.")
    hint = "Save it as CSV in UTF-8; egvs new --counts FILE reads spreadsheets, too."
    with reading.translate_errors(path, hint):
        text = path.read_text(encoding="utf-8-sig")
    first = text.partition("\n")[0]
    has_semicolons = first.count(";") > first.count(",")
    rows = csv.DictReader(text.splitlines(), delimiter=";" if has_semicolons else ",")
    known = (*COUNT_NAMES, *COUNT_IDS, "count", "kind")
    rows.fieldnames = parse_header(path, rows.fieldnames or (), known)
    if "count" not in rows.fieldnames:
        raise InputError(path, "the column 'count' is missing", f"Columns: {', '.join(known)}.")
    counts = []
    for number, row in enumerate(rows, start=2):
        count: dict[str, Any] = {key: row[key] for key in (*COUNT_IDS, "kind") if row.get(key)}
        if not any(row.values()):
            continue
        if not any(key in count for key in COUNT_IDS):
            hint = "Keep the ids of the template; egvs new --counts FILE reads tables with names only."
            raise InputError(f"{path}: line {number}", "expected from_edge and to_edge, or edge, got neither", hint)
        number_text = row["count"] or ""
        if choices := ambiguous_number(number_text):
            raise InputError(f"{path}: line {number}: count", f"{number_text} can mean {choices}", f"Write {choices}.")
        count["per_hour"] = number_or_nan(number_text.replace(",", ".") if has_semicolons else number_text)
        if not 0 <= count["per_hour"] <= MAX_PER_HOUR:
            problem = f"expected vehicles per hour, got {row['count']!r}"
            raise InputError(f"{path}: line {number}: count", problem, "Use a number such as 120.")
        counts.append(count)
    return counts


_SITE_SOURCE_KEYS = ("points", "only_free", "heights_m", "existing_poles")
"""Keys of ``[sites]`` that go with one source of sites; a new source does not take them over."""
_POLYGON_KEYS = ("polygon_height_m", "polygon_types")
"""Keys of ``[statics]`` that go with ``polygons``."""
_ALTERNATIVES = (
    ("traffic", TRAFFIC_SOURCES),
    ("sites", SITE_SOURCES),
    ("sites", SITE_DIRECTIONS),
    ("sites", SITE_SENSORS),
)


def _drop_replaced_keys(base: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Drop keys of ``base`` that contradict the ``values`` above it.

    These are sources of traffic and sites and directions of sensors that are replaced by others, and the keys that have
    an effect with the replaced source only.
    """
    remaining = dict(base)
    if values.get("statics", {}).get("polygons") == [] and isinstance(remaining.get("statics"), dict):
        remaining["statics"] = {key: value for key, value in remaining["statics"].items() if key not in _POLYGON_KEYS}
    for table, sources in _ALTERNATIVES:
        old = remaining.get(table)
        new = values.get(table)
        if not isinstance(old, dict) or not isinstance(new, dict):
            continue
        source = next((key for key in sources if key in new), None)
        if source is None or all(key in new for key in sources if key in old):
            continue
        dropped = set(sources)
        if table == "traffic":
            dropped |= _dropped_traffic_keys(source)
        elif source in SITE_SOURCES:
            dropped.update(_SITE_SOURCE_KEYS)
        remaining[table] = {key: value for key, value in old.items() if key not in dropped}
    return remaining


def _dropped_traffic_keys(source: str) -> frozenset[str]:
    """Return the keys of another source of traffic that a new source does not take over."""
    dropped = keys_without_effect(source) | {"routes"}
    if source in FINISHED_SOURCES:  # recorded traffic is used completely
        dropped |= {"frames", "frame_period_s", "warmup_s"}
    return dropped


def _merge(base: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Return ``base`` updated by ``values``, table by table."""
    merged = dict(base)
    for key, value in values.items():
        if isinstance(value, dict) and isinstance(base.get(key), dict):
            merged[key] = _merge(base[key], value)
        else:
            merged[key] = value
    return merged


def _scenario_folders(folder: Path, extends: str, where: str) -> Iterator[Path]:
    """Yield the scenario's folder, then those of the scenarios that it extends."""
    yield folder
    while extends:
        folder = folder / extends
        if not (folder / SCENARIO_FILE).is_file():
            raise InputError(f"{where}: extends", f"expected the path of a scenario folder, got {folder}")
        yield folder
        extends = reading.read_toml(folder / SCENARIO_FILE).get("extends", "")


def scenario_from_dict(values: dict[str, Any], folder: Path, where: str) -> Scenario:
    """Check a scenario that is given as nested dictionaries, as in ``run.json``.

    Parameters
    ----------
    values
        Tables and keys.
    folder
        Folder that paths in the scenario are relative to.
    where
        The file, for messages.

    Raises
    ------
    InputError
        When the scenario is invalid.
    """
    values.setdefault("name", default_name(folder) or "scenario")
    try:
        scenario = Scenario.from_dict(values)
    except ValidationError as error:
        raise format_validation_error(error, where) from None
    scenario._folders = tuple(_scenario_folders(folder, scenario.extends, where))
    Grid.over(scenario.roi.box, scenario.roi.voxel_m, f"{where}: roi")
    return scenario


def default_name(folder: Path) -> str:
    """Return the name of a scenario that is not named otherwise: that of its folder."""
    return re.sub(r'[\s\x00-\x1f\x7f/\\:*?"<>|]+', "_", folder.resolve().name)[:80]


def json_schema() -> str:
    """Return the JSON Schema with which editors complete and check a scenario.toml."""
    return json.dumps(Scenario.model_json_schema(), indent=2, ensure_ascii=False) + "\n"


def _suggest_scenario(folder: Path) -> str:
    """Return a hint at the scenario that may be meant by another folder."""
    if (folder / "city.toml").is_file():
        command = f"egvs city run {shlex.quote(str(folder))}"
        return f"This is a city. Use {command}, or one of its junctions, {folder / 'junctions'}/ID."
    if (folder / _RUN_RECORD).is_file():
        return f"This is a run folder. Give the scenario's folder{_recorded_folder(folder)}."
    return f"Give a folder with a {SCENARIO_FILE}, or the file."


_RUN_RECORD = "run.json"


def _recorded_folder(run: Path) -> str:
    """Return the scenario's folder that a run recorded, as ", NAME"; empty if it cannot be read."""
    try:
        record = reading.read_json(run / _RUN_RECORD)
    except InputError:  # this is a hint in another message
        return ""
    match record:
        case {"scenario_folder": str(scenario)}:
            return f", {os.path.normpath(run / scenario)}"
    return ""


def _suggest_similar_scenario(folder: Path) -> str:
    """Return a hint at a scenario with a similar name, beside a missing folder or shipped, or at all shipped ones."""
    scenarios = {name: Path(name) for name in shipped_names()}
    hint = f"Give a folder with a {SCENARIO_FILE}, or the name of a shipped scenario: {', '.join(scenarios)}."
    if folder.parent.is_dir():
        paths = (path for path in folder.parent.iterdir() if (path / SCENARIO_FILE).is_file())
        scenarios |= {path.name: path for path in sorted(paths)}
    similar = difflib.get_close_matches(folder.name, scenarios, 1)
    return f"Did you mean {scenarios[similar[0]]}?" if similar else hint


def check_is_scenario(scenario: object) -> None:
    """Raise an InputError for a path or another value in place of a scenario."""
    if not isinstance(scenario, Scenario):
        problem = f"expected the result of egvs.load, got {str(scenario)[:80]!r}"
        raise InputError("scenario", problem, "Use egvs.load(FOLDER).")


def _apply_override(values: dict[str, Any], override: str) -> dict[str, Any]:
    """Return ``values`` with one override ``table.key=value``."""
    where = f"--set {override}"
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise InputError(where, "expected KEY=VALUE", "Use, for example, --set traffic.frames=500.")
    try:
        value = reading.parse_toml_value(text)
    except (ValueError, RecursionError):
        value = text
    _check_amounts(key.strip(), value, "--set")
    parts = key.strip().split(".")
    if len(parts) > 1:
        values = _drop_replaced_keys(values, {parts[0]: {parts[1]: value}})
    table: Any = values
    for parent in parts[:-1]:
        table = _find_row(table, parent, where) if isinstance(table, list) else table.setdefault(parent, {})
        if not isinstance(table, dict | list):
            raise InputError(where, f"{parent!r} is not a table")
    if isinstance(table, list):
        raise InputError(where, f"{parts[-1]!r} is a row, not a key", f"Use {key.strip()}.KEY=VALUE.")
    table[parts[-1]] = value
    return values


def _check_earlier_overrides(values: dict[str, Any], earlier: Sequence[str], last: str) -> None:
    """Raise an InputError when the last override replaced a key that an earlier one had set."""
    for override in earlier:
        table, _, key = override.partition("=")[0].strip().partition(".")
        if isinstance(values.get(table), dict) and key and "." not in key and key not in values[table]:
            problem = f"the key has no effect: the later --set {last} replaces it"
            raise InputError(f"--set: {table}.{key}", problem, "Use only one of them.")


def _find_row(rows: list[Any], name_or_number: str, where: str) -> Any:
    """Return a row of a list of tables by its name, else by its number from 0."""
    for row in rows:
        if isinstance(row, dict) and row.get("name") == name_or_number:
            return row
    if name_or_number.isdecimal() and int(name_or_number) < len(rows):
        return rows[int(name_or_number)]
    names = [str(row["name"]) for row in rows if isinstance(row, dict) and "name" in row]
    choices = f"one of {', '.join(names)}, or " if names else ""
    hint = f"Use {choices}a number from 0 to {len(rows) - 1}."
    raise InputError(where, f"there is no row {name_or_number!r}", hint)
