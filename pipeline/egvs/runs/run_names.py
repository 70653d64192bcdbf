"""Names of run folders where none is given, from the settings that differ: ``runs/<name>@<label>``.

``runs/<name>`` is the folder of a scenario, or a city, as it is written. With overrides, the folder is
``runs/<name>@<label>``. The label is the same for the same overrides, in whatever order and spelling they are given:

    score.gamma=5                                 gamma=5
    traffic.frames=300, score.gamma=0.50          frames=300,gamma=0.5
    effects.rain.rate_mm_h=20                     rain.rate_mm_h=20
    effects.range_limit={}                        range_limit=on
    sites.sensor="VLP-16"                         sensor=VLP-16,511b6d4c

A label without a hash spells all overrides. Otherwise it ends in a hash of all of them: where it would be longer than
:data:`MAX_LABEL_LENGTH`, where a value is not a plain number or lower-case word, and where a setting is removed. So
different overrides have different labels, also where the file system ignores case, and a label has no character that a
file system rejects.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin

from pydantic import BaseModel

from egvs.artefacts.run_folder import RUNS
from egvs.core import files, reading
from egvs.scenario.model import Scenario
from egvs.scenario.settings import effect_state, flatten_settings

MAX_LABEL_LENGTH = 40
"""Characters of a label before its hash."""

_HASH_DIGITS = 8

_PLAIN_WORD = re.compile(r"[a-z](?:[a-z0-9_.-]*[a-z0-9_-])?")
_UNSAFE = re.compile(r"[^A-Za-z0-9_.=+-]+")
_EFFECTS = "effects."


def run_folder(name: str, overrides: Mapping[str, Any]) -> Path:
    """Return the folder of a run where none is given.

    Parameters
    ----------
    name
        Name of the scenario or city.
    overrides
        Settings by full key; empty for the scenario as it is written.

    Examples
    --------
    >>> run_folder("hersfeld", {"score.gamma": 5.0}).as_posix()
    'runs/hersfeld@gamma=5'
    """
    if not overrides:
        return RUNS / name
    return RUNS / f"{name}@{settings_label(overrides)}"


def settings_label(overrides: Mapping[str, Any]) -> str:
    """Return a short label of some settings that can be part of a file name.

    Parameters
    ----------
    overrides
        Settings by full key; None for a removed one.
    """
    values = {key: _normalise(value) for key, value in overrides.items()}
    pairs = sorted(_format_pair(key, value) for key, value in values.items() if value is not None)
    digest = files.hash_json(values)[:_HASH_DIGITS]
    if not pairs:
        return digest
    label = ",".join(pairs)
    if len(label) <= MAX_LABEL_LENGTH and all(_is_spelled_out(key, value) for key, value in values.items()):
        return label
    return f"{_join_fitting(pairs)},{digest}"


def short_key(key: str) -> str:
    """Return the last part of a key, e.g. "gamma", if it tells the key; else the complete key.

    Keys of effects keep the name of the effect. Keys in rows of a list, and in tables with free names, are complete.
    """
    if key in _static_keys():
        name = key.rpartition(".")[2]
        if key.startswith(_EFFECTS):
            return key.removeprefix(_EFFECTS)
        if _last_parts()[name] == 1:
            return name
    return key.replace("[", ".").replace("]", "")


def parse_overrides(overrides: Iterable[str]) -> dict[str, Any]:
    """Return the settings in arguments of ``--set`` by key, where there is no single scenario to compare them with.

    Parameters
    ----------
    overrides
        ``"table.key=value"``; of several for one key, the last one counts.
    """
    settings: dict[str, Any] = {}
    for override in overrides:
        key, _, text = override.partition("=")
        try:
            value = reading.parse_toml_value(text)
        except (ValueError, RecursionError):
            value = text
        settings |= flatten_settings({key.strip(): json.loads(json.dumps(value, default=str))})
    return settings


def _normalise(value: Any) -> Any:
    """Return a value with whole numbers as int, so that 5.0 and 5 are the same, and infinity as "inf"."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, float) and value.is_integer():
        return int(value)
    if isinstance(value, list | tuple):
        return [_normalise(item) for item in value]
    if isinstance(value, dict):
        return {key: _normalise(item) for key, item in value.items()}
    return value


def _format_pair(key: str, value: Any) -> str:
    """Return "key=value" with characters that every file system accepts."""
    if state := effect_state(key, value):
        return f"{_UNSAFE.sub('-', _effect_label(key))}={state}"
    text = value if isinstance(value, str) else files.to_json_text(value, separators=(",", ":"))
    if not _is_number(value):
        text = _UNSAFE.sub("-", text).strip("-")
    return f"{_UNSAFE.sub('-', short_key(key))}={text}"


def _effect_label(key: str) -> str:
    """Return the name of an effect, or its complete key where another setting has this name."""
    name = key.removeprefix(_EFFECTS)
    return key if _last_parts()[name] else name


def _is_spelled_out(key: str, value: Any) -> bool:
    """Whether key and value can be read from their pair, and from no other pair, also where case is ignored."""
    if _UNSAFE.search(key) or key != key.lower():
        return False
    if isinstance(value, str):
        return _PLAIN_WORD.fullmatch(value) is not None and value not in ("true", "false")
    return isinstance(value, bool) or _is_number(value) or effect_state(key, value) == "on"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _join_fitting(pairs: Sequence[str]) -> str:
    """Return the first pairs that fit into a label; the beginning of the first one where it is too long."""
    label = pairs[0][:MAX_LABEL_LENGTH]
    for pair in pairs[1:]:
        longer = f"{label},{pair}"
        if len(longer) > MAX_LABEL_LENGTH:
            break
        label = longer
    return label


@cache
def _static_keys() -> frozenset[str]:
    """The keys of a scenario that exist once: those that are in no row of a list, and in no table with free names."""
    return frozenset(_keys_of(Scenario, ""))


@cache
def _last_parts() -> Counter[str]:
    """How many keys, apart from those of effects, end in each name."""
    return Counter(key.rpartition(".")[2] for key in _static_keys() if not key.startswith(_EFFECTS))


def _keys_of(table: type[BaseModel], prefix: str) -> Iterator[str]:
    for name, field in table.model_fields.items():
        inner = _table_of(field.annotation)
        if inner is not None:
            yield from _keys_of(inner, f"{prefix}{name}.")
        elif not _has_free_keys(field.annotation):
            yield f"{prefix}{name}"


def _table_of(annotation: Any) -> type[BaseModel] | None:
    """Return the table of an annotation such as ``RoiConfig`` or ``SiteGrid | None``; None where there is none."""
    if isinstance(annotation, UnionType):
        return next((choice for choice in map(_table_of, annotation.__args__) if choice is not None), None)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return None


def _has_free_keys(annotation: Any) -> bool:
    """Whether an annotation is that of a list of tables, or of a table with free names."""
    rows = get_origin(annotation) is tuple and any(_table_of(row) is not None for row in get_args(annotation))
    return rows or get_origin(annotation) is dict
