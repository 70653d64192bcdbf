"""Settings by their full keys, as ``--set`` writes them, and the settings in which two scenarios differ."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from typing import Any

Settings = dict[str, Any]
"""Values by full key, e.g. ``"score.gamma"``, or ``"traffic.kinds[car].length_m"`` for a row of a list of tables."""


def flatten_settings(values: Mapping[str, Any]) -> Settings:
    """Return the settings of nested tables by full key; rows of tables are called by their name or number.

    Parameters
    ----------
    values
        Tables and keys, as in ``run.json``.

    Examples
    --------
    >>> flatten_settings({"seed": 1, "traffic": {"kinds": [{"name": "car", "share": 2.0}]}})
    {'seed': 1, 'traffic.kinds[car].name': 'car', 'traffic.kinds[car].share': 2.0}
    """
    settings: Settings = {}
    for name, value in values.items():
        settings.update(_flatten(value, name))
    return settings


def _flatten(value: Any, key: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict) and value:
        for name, inner in value.items():
            yield from _flatten(inner, f"{key}.{name}")
    elif isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
        for number, row in enumerate(value):
            yield from _flatten(row, f"{key}[{row.get('name', number)}]")
    else:
        yield key, value


def format_overrides(settings: Mapping[str, Any]) -> list[str]:
    """Return settings as arguments of ``--set``; removed ones are left out.

    Parameters
    ----------
    settings
        Values by full key.

    Examples
    --------
    >>> format_overrides({"score.gamma": 5.0, "sites.file": None, "traffic.kinds[car].vclass": "taxi"})
    ['score.gamma=5.0', 'traffic.kinds.car.vclass="taxi"']
    """
    overrides = []
    for key, value in settings.items():
        if value is not None:
            overrides.append(f"{key.replace('[', '.').replace(']', '')}={_format_toml(value)}")
    return overrides


def _format_toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_format_toml(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_format_toml, value)) + "]"
    if isinstance(value, float) and math.isinf(value):
        return "inf" if value > 0 else "-inf"
    return json.dumps(value, ensure_ascii=False)


def changed_settings(base: Mapping[str, Any], values: Mapping[str, Any]) -> Settings:
    """Return the settings of ``values`` that differ from those of ``base``, by full key, sorted.

    A setting that only ``base`` has is None. 5 and 5.0 are equal, and so are None and a missing key. Settings that
    others replace (:func:`without_replaced`) are left out.

    Parameters
    ----------
    base, values
        Nested tables and keys.

    Examples
    --------
    >>> changed_settings({"score": {"gamma": "auto"}, "seed": 1}, {"score": {"gamma": 5.0}, "seed": 1.0})
    {'score.gamma': 5.0}
    """
    before, after = flatten_settings(base), flatten_settings(values)
    effective = without_replaced(after)
    changed: Settings = {}
    for key in sorted(before.keys() | after.keys()):
        if before.get(key) == after.get(key) or _is_table(key, before) or _is_table(key, after):
            continue
        if key in effective or key not in after:
            changed[key] = after.get(key)
    return changed


def without_replaced(settings: Settings) -> Settings:
    """Return settings without the sensor of ``[sites]`` where ``replace_sensor`` leaves no site to it."""
    if settings.get("sites.replace_sensor") is None:
        return settings
    return {key: value for key, value in settings.items() if key != "sites.sensor"}


def _is_table(key: str, settings: Settings) -> bool:
    """Whether the settings have keys below this one, which another scenario has as an empty table."""
    return any(other.startswith((f"{key}.", f"{key}[")) for other in settings)


def effect_state(key: str, value: Any) -> str:
    """Return "on" for an effect with its default parameters, "off" for one without any; empty for other settings.

    Parameters
    ----------
    key
        Full key.
    value
        Its value; None where it is not set.

    Examples
    --------
    >>> effect_state("effects.range_limit", {}), effect_state("effects.range_limit", None), effect_state("seed", 1)
    ('on', 'off', '')
    """
    prefix, _, name = key.partition(".")
    if prefix != "effects" or not name or "." in name:
        return ""
    if value is None:
        return "off"
    return "on" if value == {} else ""
