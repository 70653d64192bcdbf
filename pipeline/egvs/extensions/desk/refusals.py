"""What the server answers where a request cannot be met, and numbers as people type them."""

from __future__ import annotations

import math
from typing import Any

from egvs.core.errors import EgvsError, InputError
from egvs.core.numbers import ambiguous_number, number_or_nan, parse_decimal


class RefusalError(Exception):
    """A request that cannot be met.

    Parameters
    ----------
    status
        Status code of the answer: 404 (unknown), 409 (not now), 413 (too large), 415 (kind of file), 422 (value).
    message, hint
        What is wrong, and what to do.
    field
        The key of the request that is wrong; may be empty.
    """

    def __init__(self, status: int, message: str, hint: str = "", field: str = "") -> None:
        super().__init__(message)
        self.status = status
        self.content = {"message": message, "hint": hint, "field": field}

    @classmethod
    def of(cls, error: EgvsError, field: str = "") -> RefusalError:
        """Return the refusal for an error of this program."""
        return cls(422, *describe_error(error), field)


def describe_error(error: EgvsError) -> tuple[str, str]:
    """Return the message and the hint of an error."""
    if isinstance(error, InputError):
        stop = "." if error.hint and error.problem[-1:].isalnum() else ""
        return f"{error.where}: {error.problem}{stop}", error.hint.strip()
    return str(error), ""


def parse_number(value: object, field: str, least: float = -1e8, most: float = 1e8) -> float:
    """Return a number of a request: a JSON number, or a text with a point or a comma before the decimals.

    >>> parse_number("8,5", "z_m"), parse_number(" 8.5 ", "z_m"), parse_number(3, "z_m")
    (8.5, 8.5, 3.0)
    """
    number = math.nan
    if isinstance(value, str):
        text = value.strip()
        if choices := ambiguous_number(text):
            raise RefusalError(422, f"{text} can mean {choices}", f"Write {choices}.", field)
        number = number_or_nan(text.replace(",", "."), parse_decimal)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        number = float(value)
    if not least <= number <= most:
        limits = "" if abs(least) == abs(most) == 1e8 else f" from {least:g} to {most:g}"
        raise RefusalError(422, f"expected a number{limits}, got {str(value)[:40]!r}", "", field)
    return number


def require_text(body: dict[str, Any], key: str) -> str:
    """Return a text of a request that may not be missing."""
    value = body.get(key)
    if not isinstance(value, str) or not value.strip():
        raise RefusalError(422, f"expected a text for {key}", "", key)
    return value.strip()
