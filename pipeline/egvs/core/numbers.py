"""Parse numbers in texts: decimal numbers in ASCII, or NaN."""

from __future__ import annotations

import math
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
