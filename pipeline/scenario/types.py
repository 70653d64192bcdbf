"""Kinds of values that a scenario holds: lengths, points, names."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

FARTHEST_M = 1e8
"""Coordinates beyond this are a mistake: the Earth is 4e7 m round."""


def coordinate_m(text: str) -> float:
    """A coordinate as a file writes it; ValueError where it is none, or no place on Earth has it."""
    value = float(text)
    if not abs(value) <= FARTHEST_M:
        raise ValueError(f"the coordinate {text[:40]} is beyond {FARTHEST_M:g} m")
    return value


Positive = Annotated[float, Field(gt=0)]
Coordinate = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]
NotNegative = Annotated[float, Field(ge=0)]
Longitude = Annotated[float, Field(ge=-180, le=180)]
Latitude = Annotated[float, Field(ge=-90, le=90)]
Point2 = tuple[Coordinate, Coordinate]
Point3 = tuple[Coordinate, Coordinate, Coordinate]
NAME_IN_WORDS = (
    "a name without spaces and without any of / \\ : * ? \" < > |, and not of dots alone, for it may become a folder's"
)
"""What :data:`Name` asks for; no other kind of text here has a pattern."""
_IN_NAMES = r"[^\s\x00-\x1f\x7f/\\:*?\"<>|"
Name = Annotated[str, Field(min_length=1, max_length=80, pattern=rf"^{_IN_NAMES}]*{_IN_NAMES}.]{_IN_NAMES}]*$")]
