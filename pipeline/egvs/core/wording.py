"""Words for numbers and lists in messages, notes and pages."""

from __future__ import annotations

from collections.abc import Sequence


def number_of(number: int, noun: str, plural: str = "") -> str:
    """Return a number with its noun.

    Parameters
    ----------
    number
        The number.
    noun
        Singular.
    plural
        By default the singular with an s.

    >>> number_of(1, "vehicle"), number_of(1200, "vehicle"), number_of(2, "axis", "axes")
    ('1 vehicle', '1,200 vehicles', '2 axes')
    """
    return f"{number:,} {noun if number == 1 else plural or f'{noun}s'}"


def by_number(number: int, singular: str, plural: str) -> str:
    """Return the word that agrees with a number.

    >>> f"{number_of(1, 'lane')} {by_number(1, 'is', 'are')} closed"
    '1 lane is closed'
    """
    return singular if number == 1 else plural


def format_percent(share: float, digits: int = 1, *, signed: bool = False) -> str:
    """Return a share in per cent, as all output writes it: with a space before the sign.

    Parameters
    ----------
    share
        The share; 1 is 100 %.
    digits
        Number of decimals.
    signed
        Whether positive values have a plus sign.

    >>> format_percent(0.1254), format_percent(0.9, 0), format_percent(0.1, signed=True), format_percent(-0.0001)
    ('12.5 %', '90 %', '+10.0 %', '0.0 %')
    """
    return f"{100.0 * share:{'+' if signed else ''}z.{digits}f} %"


def list_first(names: Sequence[str], most: int, separator: str = ", ") -> str:
    """Return the first names, and how many more there are.

    >>> list_first(["a", "b", "c", "d"], 2), list_first(["a", "b"], 2)
    ('a, b and 2 more', 'a, b')
    """
    listed = separator.join(names[:most])
    return f"{listed} and {len(names) - most:,} more" if len(names) > most else listed


def shorten_id(name: str, most: int = 20) -> str:
    """Return the id of an element of a network for a message; long ones, such as those of joined nodes, are cut.

    >>> shorten_id("J1"), shorten_id("cluster_1423165998_1698047149_31384678")
    ('J1', 'cluster_1423165998_…')
    """
    return name if len(name) <= most else f"{name[: most - 1]}…"
