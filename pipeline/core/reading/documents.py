"""TOML and JSON files of the user's are read here, within a bound, and refused where they say two things at once.

Nothing that JSON cannot hold comes out: no number of thousands of digits, no nesting without end, no half of a
character (a lone surrogate), no key that stands there twice.
"""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

from pipeline.core.errors import InputError
from pipeline.core.reading import limits
from pipeline.core.reading.refusing import why

DEEPEST = 100
"""Tables and lists in one another; of what is read here, none needs ten."""

_MOST_DIGITS = 300
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def read_toml(path: Path) -> dict[str, Any]:
    """The values of a TOML file; InputError where it is none."""
    data = limits.read_bytes(path, limits.DOCUMENT)
    try:
        values = tomllib.loads(data.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n"))
        check_depth(values)
        _check_digits(values)
    except (ValueError, RecursionError, MemoryError) as error:
        raise InputError(path, f"is not valid TOML: {_said(error)}", "a whole TOML file, in UTF-8") from None
    return values


def toml_value(text: str) -> Any:
    """A single value as TOML writes it; ValueError where it is none."""
    value = tomllib.loads(f"v = {text}")["v"]
    check_depth(value)
    _check_digits(value)
    return value


def read_json(path: Path, right: str = "a whole JSON file, in UTF-8", limit: limits.Limit = limits.DOCUMENT) -> Any:
    """The value of a JSON file; InputError where it is none, and ``right`` what it should be."""
    data = limits.read_bytes(path, limit)
    try:
        return json_value(data)
    except (ValueError, RecursionError, MemoryError) as error:
        raise InputError(path, f"is not valid JSON: {_said(error)}", right) from None


def json_value(data: bytes) -> Any:
    """The value of JSON in UTF-8; ValueError, or RecursionError, where it is none."""
    text = data.decode("utf-8-sig")
    value = json.loads(text, object_pairs_hook=_once, parse_int=_whole_number)
    check_depth(value)
    if _SURROGATE.search(text):
        json.dumps(value, ensure_ascii=False).encode("utf-8")
    return value


def check_depth(value: Any) -> None:
    """ValueError where tables and lists stand in one another more than :data:`DEEPEST` deep."""
    level = [value]
    for _ in range(DEEPEST):
        level = [part for whole in level for part in _parts(whole)]
        if not level:
            return
    raise ValueError(f"it is nested more than {DEEPEST} deep")


def _check_digits(value: Any) -> None:
    """ValueError where an integer has too many digits; in hexadecimal ones Python reads any number."""
    json.loads(json.dumps(value, default=str), parse_int=_whole_number)


def _whole_number(digits: str) -> int:
    """An integer that a float can be made of."""
    if len(digits) > _MOST_DIGITS:
        raise ValueError("a number has too many digits")
    return int(digits)


def _parts(value: Any) -> list[Any]:
    """The tables and lists in one."""
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [part for part in inner if isinstance(part, dict | list)]


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [key for key, _ in pairs]
        twice = next(key for key in names if names.count(key) > 1)
        raise ValueError(f"the key {twice!r} stands there twice in one object")
    return found


def _said(error: BaseException) -> str:
    text = why(error)
    return "a number has too many digits" if "integer string conversion" in text else text
