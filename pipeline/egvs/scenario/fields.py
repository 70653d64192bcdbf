"""StrictModel and the value types of scenario keys.

The base of what users write: values checked the same way everywhere.

Models are frozen, unknown keys are errors, and numbers are finite unless a field says otherwise. No text or truth value
passes for a number, no fraction for a count; lists pass for tuples, as in JSON.

Kinds of values that a scenario holds: lengths, points, names.
"""

from __future__ import annotations

import json
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field


class StrictModel(BaseModel):
    """Base of everything that is read from a scenario."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def of(cls, values: dict[str, Any]) -> Self:
        """From values as TOML gives them; pydantic's ValidationError when they are wrong."""
        return cls.model_validate_json(json.dumps(values, default=str), strict=True)


MAX_COORDINATE_M = 1e8
"""Coordinates beyond this are a mistake: the Earth is 4e7 m round."""


def parse_coordinate_m(text: str) -> float:
    """A coordinate as a file writes it; ValueError where it is none, or no place on Earth has it."""
    value = float(text)
    if not abs(value) <= MAX_COORDINATE_M:
        raise ValueError(f"the coordinate {text[:40]} is beyond {MAX_COORDINATE_M:g} m")
    return value


Positive = Annotated[float, Field(gt=0)]
Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
NotNegative = Annotated[float, Field(ge=0)]
Longitude = Annotated[float, Field(ge=-180, le=180)]
Latitude = Annotated[float, Field(ge=-90, le=90)]
Point2 = tuple[Coordinate, Coordinate]
Point3 = tuple[Coordinate, Coordinate, Coordinate]
NAME_DESCRIPTION = (
    "a name without spaces and without any of / \\ : * ? \" < > |, and not of dots alone, for it may become a folder's"
)
"""What :data:`Name` asks for; no other kind of text here has a pattern."""
_NAME_CHARACTER = r"[^\s\x00-\x1f\x7f/\\:*?\"<>|"
Name = Annotated[
    str, Field(min_length=1, max_length=80, pattern=rf"^{_NAME_CHARACTER}]*{_NAME_CHARACTER}.]{_NAME_CHARACTER}]*$")
]
