"""Parse numbers in texts: decimal numbers in ASCII, or NaN; numbers whose point may separate thousands."""

from __future__ import annotations

import math
import re
from collections.abc import Callable


def parse_decimal(text: str) -> float:
    """Parse a decimal number in ASCII, such as ``-1.5e3``.

    Unlike :class:`float`, it accepts neither ``1_0``, which Python alone reads as 10, nor digits of other scripts.

    Parameters
    ----------
    text
        The number, with any white space around it.

    Raises
    ------
    ValueError
        If it is not a number.

    Examples
    --------
    >>> parse_decimal(" 8e3 ")
    8000.0
    """
    number = text.strip()
    if not number.isascii() or "_" in number:
        raise ValueError(f"not a decimal number: {text!r}")
    return float(number)


def number_or_nan(text: str, parse: Callable[[str], float] = float) -> float:
    """Parse a number; NaN, which is in no range, if the text is none.

    Examples
    --------
    >>> number_or_nan("1e3"), number_or_nan("ten"), number_or_nan("1_0", parse_decimal)
    (1000.0, nan, nan)
    """
    try:
        return parse(text)
    except ValueError:
        return math.nan


def ambiguous_number(text: str) -> str:
    """Return both numbers that a text with three decimals can be, with its unit; empty if it can be only one.

    Examples
    --------
    >>> ambiguous_number("30.000"), ambiguous_number("1,234m"), ambiguous_number("30.00"), ambiguous_number("0.125")
    ('30 or 30000', '1.2340m or 1234m', '', '')
    """
    match = re.fullmatch(r"([1-9][0-9]{0,2})[.,]([0-9]{3})([A-Za-z]*)", text)
    if match is None:
        return ""
    whole, decimals, unit = match.groups()
    number = f"{whole}.{decimals}"
    number = f"{number}0" if decimals[-1] != "0" else number.rstrip("0").rstrip(".")
    return f"{number}{unit} or {whole}{decimals}{unit}"


class WrittenNumber(float):
    """A number of a file that :func:`ambiguous_number` reads in two ways; ``text`` is how it is written."""

    text: str
