"""Codes of the Japanese standard grid squares (JIS X 0410), which name the tiles of PLATEAU.

A code has 4 digits (a square of about 80 km), 6 (10 km), 8 (1 km), 9 (500 m) or 10 (250 m). PLATEAU names a file
``CODE_KIND_EPSG_op.gml``, such as ``53394525_bldg_6697_op.gml``.
"""

from __future__ import annotations

import re
from typing import NamedTuple

_FILE_NAME = re.compile(r"(\d{4}|\d{6}|\d{8,10})_([a-z]+)(?:[_.].*)")


class Square(NamedTuple):
    """A grid square in degrees."""

    west: float
    south: float
    east: float
    north: float


class TileName(NamedTuple):
    """What the name of a tile says: its square, and its kind, e.g. ``bldg``."""

    square: Square
    kind: str


def parse_tile_name(name: str) -> TileName | None:
    """Return the square and kind of a PLATEAU file; None for other names.

    Examples
    --------
    >>> parse_tile_name("53392642_bldg_6697_op2.gml").kind
    'bldg'
    """
    match = _FILE_NAME.fullmatch(name)
    if match is None:
        return None
    square = grid_square(match[1])
    return None if square is None else TileName(square, match[2])


def grid_square(code: str) -> Square | None:
    """Return the square of a code; None if the code is invalid.

    Examples
    --------
    >>> grid_square("5339").south, grid_square("5339").west
    (35.333333333333336, 139.0)
    """
    digits = [int(digit) for digit in code]
    if len(digits) not in (4, 6, 8, 9, 10):
        return None
    south, west = (digits[0] * 10 + digits[1]) / 1.5, 100.0 + digits[2] * 10 + digits[3]
    height, width = 2.0 / 3.0, 1.0
    for row, column, divisions in zip(digits[4:8:2], digits[5:8:2], (8, 10), strict=False):
        if row >= divisions or column >= divisions:
            return None
        height, width = height / divisions, width / divisions
        south, west = south + row * height, west + column * width
    for quarter in digits[8:]:
        if not 1 <= quarter <= 4:
            return None
        height, width = height / 2, width / 2
        south, west = south + (quarter - 1) // 2 * height, west + (quarter - 1) % 2 * width
    return Square(west, south, west + width, south + height)
