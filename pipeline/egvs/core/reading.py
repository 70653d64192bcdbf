"""TOML and JSON files read within limits, and the errors of any reader translated to one InputError.

The exceptions of file readers (the standard library's, Arrow's, trimesh's, laspy's, our own) have no common base and
are not documented, so :func:`translate_errors` catches any Exception; nothing else in this program does. The message
contains the exception's text, and the exception stays its cause, for those who look for a bug in a reader.

TOML and JSON values are limited to what JSON can represent: no number of thousands of digits, no unlimited nesting, no
lone surrogate, no duplicate key.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from egvs.core import limits
from egvs.core.errors import EgvsError, InputError
from egvs.core.files import DISK_FULL_ERRNOS
from egvs.core.numbers import WrittenNumber, ambiguous_number

COMPLETE_FILE = "Download or make the file again; it may be incomplete."
"""Hint for a file that cannot be read."""

_ACCESS_HINT = "Check the path and the permissions."
_MEMORY_HINT = "Use a smaller file, or a machine with more memory."


@contextmanager
def translate_errors(where: object, expected: str = COMPLETE_FILE, doing: str = "cannot be read") -> Iterator[None]:
    """Translate any exception of the block to an InputError.

    Errors of this program are not changed, nor is that of a full disk. Where the system cannot open a file, or has too
    little memory, the hint is about that.

    Parameters
    ----------
    where
        File and key, for the message.
    expected
        The hint of the message.
    doing
        What failed, e.g. "cannot be read".
    """
    try:
        yield
    except EgvsError:
        raise
    except OSError as error:
        if error.errno in DISK_FULL_ERRNOS:
            raise
        hint = expected if error.errno is None else _ACCESS_HINT  # without a number, it is about the content
        raise InputError(where, f"{doing} ({describe_exception(error)})", hint) from error
    except MemoryError as error:
        raise InputError(where, f"{doing} ({describe_exception(error)})", _MEMORY_HINT) from error
    except Exception as error:
        raise InputError(where, f"{doing} ({describe_exception(error)})", expected) from error


@contextmanager
def name_in_errors(rename: Callable[[str], str]) -> Iterator[None]:
    """Let InputErrors of the block name the user's files instead of temporary copies.

    Parameters
    ----------
    rename
        Returns a text with the user's names.
    """
    try:
        yield
    except InputError as error:
        texts = [error.where, error.problem, error.hint]
        renamed = [rename(text) for text in texts]
        if renamed == texts:
            raise
        raise InputError(*renamed) from None


def describe_exception(error: BaseException) -> str:
    """Describe an exception in words for a user."""
    match error:
        case MemoryError():
            return "it needs more memory than is available"
        case RecursionError():
            return "it is nested too deeply"
        case UnicodeDecodeError():
            return f"it is not {error.encoding} text: byte {error.start} is {error.object[error.start]:#x}"
        case OSError() if error.strerror:
            return error.strerror
        case UnicodeError():
            return f"it is not valid text: {error}"
    return _first_line(error)


def _first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines()
    if lines and not isinstance(error, KeyError):
        return lines[0]
    return f"{type(error).__name__} {error}".strip()


MAX_DEPTH = 100
"""Nesting of tables and lists; no file of this program needs ten levels."""

_MAX_DIGITS = 300
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; InputError when it is not valid."""
    data = limits.read_bytes(path, limits.DOCUMENT)
    try:
        text = data.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
        values = tomllib.loads(text, parse_float=_parse_float)
        check_depth(values)
        _check_digits(values)
    except (ValueError, RecursionError, MemoryError) as error:
        raise InputError(
            path, f"is not valid TOML: {_describe_error(error)}", "Correct the file; it must be TOML in UTF-8."
        ) from None
    return values


def _parse_float(text: str) -> float:
    number = WrittenNumber(text)
    number.text = text
    return number if ambiguous_number(text) else float(text)


def parse_toml_value(text: str) -> Any:
    """Parse a single TOML value; ValueError when it is not valid."""
    value = tomllib.loads(f"v = {text}", parse_float=_parse_float)["v"]
    check_depth(value)
    _check_digits(value)
    return value


def read_json(
    path: Path, expected: str = "Correct the file; it must be JSON in UTF-8.", limit: limits.Limit = limits.DOCUMENT
) -> Any:
    """Read a JSON file; InputError with ``expected`` as the hint when it is not valid."""
    data = limits.read_bytes(path, limit)
    try:
        return parse_json(data)
    except (ValueError, RecursionError, MemoryError) as error:
        raise InputError(path, f"is not valid JSON: {_describe_error(error)}", expected) from None


def parse_json(data: bytes) -> Any:
    """Parse JSON in UTF-8; ValueError or RecursionError when it is not valid."""
    text = data.decode("utf-8-sig")
    value = json.loads(text, object_pairs_hook=_reject_duplicate_keys, parse_int=_parse_integer)
    check_depth(value)
    if _SURROGATE.search(text):
        json.dumps(value, ensure_ascii=False).encode("utf-8")
    return value


def check_depth(value: Any) -> None:
    """Raise ValueError when tables and lists are nested more than :data:`MAX_DEPTH` deep."""
    level = [value]
    for _ in range(MAX_DEPTH):
        level = [inner for container in level for inner in _nested_containers(container)]
        if not level:
            return
    raise ValueError(f"it is nested more than {MAX_DEPTH} deep")


def _check_digits(value: Any) -> None:
    """Raise ValueError when an integer has too many digits; Python does not limit hexadecimal ones."""
    json.loads(json.dumps(value, default=str), parse_int=_parse_integer)


def _parse_integer(digits: str) -> int:
    """Parse an integer that fits into a float."""
    if len(digits) > _MAX_DIGITS:
        raise ValueError("a number has too many digits")
    return int(digits)


def _nested_containers(value: Any) -> list[Any]:
    """Return the tables and lists directly inside a value."""
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, list):
        return []
    return [part for part in value if isinstance(part, dict | list)]


def _reject_duplicate_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = {}
    for key, value in pairs:
        if key in table:
            raise ValueError(f"the key {key!r} occurs twice in one object")
        table[key] = value
    return table


def _describe_error(error: BaseException) -> str:
    text = describe_exception(error)
    if "integer string conversion" in text:
        return "a number has too many digits"
    return text


def check_ply_header(where: str, lines: Sequence[bytes]) -> None:
    """Raise an InputError for a line of a PLY header, other than a comment, that is not in ASCII."""
    for number, line in enumerate(lines, 1):
        if not (line.isascii() or line.startswith((b"comment", b"obj_info"))):
            text = line.decode("utf-8", "replace").strip()[:60]
            raise InputError(f"{where}: line {number}", f"expected a header in ASCII, got {text!r}", COMPLETE_FILE)
