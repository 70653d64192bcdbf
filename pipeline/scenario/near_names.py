"""Finds names that are nearly known ones: what a user may have meant."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable

_UNIT = re.compile(r"[_ ]?(m|deg|rad)$")
_ALIKE = 0.8
"""Names that share more of their letters than this are taken for one another."""


def misspelt(names: Iterable[str], known: Collection[str]) -> tuple[str, str] | None:
    """The first of ``names`` that is nearly a known one which ``names`` lack, and that one; None where there is none.

    Nearly: the same but for the unit, or for a letter or two (``yaw``, ``Yaw_deg`` and ``yaw_dge`` for ``yaw_deg``).
    """
    given = list(names)
    missing = {name.lower(): name for name in known if name not in given}
    stems = {_UNIT.sub("", low): name for low, name in missing.items()}
    for name in given:
        if name in known:
            continue
        low = name.strip().lower()
        near = difflib.get_close_matches(low, missing, 1, _ALIKE)
        meant = stems.get(_UNIT.sub("", low)) or (missing[near[0]] if near and _ratio(low, near[0]) > _ALIKE else None)
        if meant is not None:
            return name, meant
    return None


def _ratio(a: str, b: str) -> float:
    return difflib.SequenceMatcher(None, b, a).ratio()
