"""Names of the columns of tables that people write: in any case, and some in German."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

from egvs.core.errors import InputError, find_misspelling

_GERMAN = {
    "street": "strasse", "approach": "zufahrt", "turn": "richtung abbieger", "movement": "richtung abbieger",
    "start": "beginn uhrzeit von", "minutes": "minuten", "count": "anzahl fahrzeuge kfz", "kind": "fahrzeugart",
    "green_s": "grün gruen", "yellow_s": "gelb", "all_red_s": "allrot",
}  # fmt: skip
"""German names of columns, in lower case with ss for ß."""


def parse_header(
    where: object, header: Sequence[str], known: Collection[str], hint: str = "",
    is_known: Callable[[str], object] = lambda _: False,
) -> list[str]:  # fmt: skip
    """Return the names of columns as the program knows them.

    Parameters
    ----------
    where
        The file, for messages.
    header
        As they are written.
    known
        All names that may be there.
    hint
        What to do about unknown ones; by default a list of the known ones.
    is_known
        Whether a further name, in lower case, is valid.

    Raises
    ------
    InputError
        When names are unknown; all of them are named.
    """
    german = {word: name for name in known for word in _GERMAN.get(name, "").split()}
    names = [german.get(name.casefold(), name.casefold()) for name in header]
    unknown = [title for title, name in zip(header, names, strict=True) if name not in known and not is_known(name)]
    if unknown:
        meant = find_misspelling(unknown, known) if len(unknown) == 1 else None
        hint = f"Did you mean {meant[1]}?" if meant else hint or f"Columns: {', '.join(known)}."
        noun = "column" if len(unknown) == 1 else "columns"
        raise InputError(where, f"unknown {noun} {', '.join(map(repr, unknown))}", hint)
    return names
