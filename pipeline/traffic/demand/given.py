"""Tells whether the files of a user's demand bring any vehicle, before they are simulated.

Files are read only as far as the first vehicle, so it costs next to nothing where there is one.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from pipeline.core.errors import InputError
from pipeline.formats import safe_xml

OPTIONS = ("route-files", "additional-files")
"""SUMO's options that name files with vehicles."""

_BRING = frozenset({"vehicle", "trip", "flow"})
_MAY_BRING = frozenset({"include"})


def bring_vehicles(paths: Iterable[Path]) -> bool:
    """Whether any of these files has a ``<vehicle>``, ``<trip>`` or ``<flow>``, or includes files that may.

    What cannot be read is left to SUMO, which says what is wrong with it.
    """
    try:
        return any(
            element.tag in _BRING | _MAY_BRING
            for path in paths
            for child in safe_xml.children(path, "")
            for element in child.iter()
        )
    except InputError:
        return True
