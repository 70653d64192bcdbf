"""The base class of the tables of a scenario, and types of values that several tables share: lengths, points, names.

All tables are checked in the same way: they cannot be changed, unknown keys are errors, and numbers are finite unless a
field allows otherwise. A text or a truth value is not accepted as a number, nor a fraction as a count. Lists are
accepted as tuples, as in JSON.
"""

from __future__ import annotations

import json
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field


class StrictModel(BaseModel):
    """Base of all tables of a scenario."""

    # "constants": a serializer of a model would otherwise turn the infinity of its keys into None.
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, ser_json_inf_nan="constants")

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Return the table with values as TOML gives them; pydantic's ValidationError when some are invalid."""
        return cls.model_validate_json(json.dumps(values, default=str), strict=True)


SensorMount = Literal["upright", "inverted"]
"""Whether the sensor stands, or hangs upside down with its front where it was: turned by 180 degrees about x."""


def find_duplicates(names: Sequence[Any]) -> list[Any]:
    """Return the names that occur more than once, sorted; accents may be written in two ways."""
    same = [same_name(name) if isinstance(name, str) else name for name in names]
    return sorted({name for name, form in zip(names, same, strict=True) if same.count(form) > 1})


def same_name(name: str) -> str:
    """Return the form in which names are compared: Unicode's NFC, without invisible characters.

    In NFC each accented letter is one character; characters of the category Cf, such as the zero-width space, have no
    shape of their own.

    Examples
    --------
    >>> same_name("e\N{COMBINING ACUTE ACCENT}") == "\N{LATIN SMALL LETTER E WITH ACUTE}"
    True
    >>> same_name("pole\N{ZERO WIDTH SPACE} 1")
    'pole 1'
    """
    normal = unicodedata.normalize("NFC", name)
    return normal if normal.isascii() else "".join(c for c in normal if unicodedata.category(c) != "Cf")


def similar_names(names: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Yield pairs of different names that differ only in upper and lower case, accents or invisible characters.

    Examples
    --------
    >>> list(similar_names(["Pole 1", "pole 1", "pole 2"]))
    [('Pole 1', 'pole 1')]
    """
    first_names: dict[str, str] = {}
    for name in dict.fromkeys(names):
        first = first_names.setdefault(same_name(same_name(name).casefold()), name)
        if first != name:
            yield first, name


MAX_COORDINATE_M = 1e8
"""A coordinate beyond this is a mistake: the circumference of the Earth is 4e7 m."""


def parse_coordinate_m(text: str) -> float:
    """Return a coordinate that is written in a file; ValueError when it is not a number, or too large for the Earth."""
    value = float(text)
    if not abs(value) <= MAX_COORDINATE_M:
        raise ValueError(f"the coordinate {text[:40]} is beyond {MAX_COORDINATE_M:g} m")
    return value


Positive = Annotated[float, Field(gt=0)]
Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]


def _check_no_percent(value: object) -> object:
    if isinstance(value, int | float) and 1.0 < value <= 100.0:
        raise ValueError(f"expected a share above 0 and up to 1, got {value:g}: {value:g} % is {value / 100:g}")
    return value


Reflectivity = Annotated[float, BeforeValidator(_check_no_percent), Field(gt=0, le=1)]
NotNegative = Annotated[float, Field(ge=0)]
Longitude = Annotated[float, Field(ge=-180, le=180)]
Latitude = Annotated[float, Field(ge=-90, le=90)]
Point2 = tuple[Coordinate, Coordinate]
Point3 = tuple[Coordinate, Coordinate, Coordinate]
NAME_DESCRIPTION = 'Use a name that is valid for a folder: no spaces, none of / \\ : * ? " < > |, and not only dots.'
"""Hint for a text that is not a :data:`Name`; no other text in a scenario has a pattern."""
_NAME_CHARACTER = r"[^\s\x00-\x1f\x7f/\\:*?\"<>|"
Name = Annotated[
    str, Field(min_length=1, max_length=80, pattern=rf"^{_NAME_CHARACTER}]*{_NAME_CHARACTER}.]{_NAME_CHARACTER}]*$")
]
