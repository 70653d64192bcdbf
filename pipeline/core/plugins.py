"""Parts that other packages may add (effects, file formats) are found by their entry points, loaded when asked for.

A group, e.g. ``egvs.point_clouds``, is a table of entry points: name -> ``module:object``. What this program brings
itself is declared the same way, in its own ``pyproject.toml``. Where two packages declare one name, this program's own
comes first, then the packages in the order of their names; so what is installed beside it cannot replace a part.

https://packaging.python.org/en/latest/specifications/entry-points/
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from pipeline.core.errors import InputError, MissingBackendError

_OWN = "egvs"


def names(group: str) -> list[str]:
    """The names that a group declares, sorted; nothing is imported."""
    return sorted(_declared(group))


def module_of(group: str, name: str) -> str:
    """The module that an entry point names; it is not imported. KeyError when the group declares no such name."""
    return _declared(group)[name].module


@cache
def load(group: str, name: str) -> Any:
    """The object that an entry point names; its module is imported at the first call.

    Raises
    ------
    InputError
        When the group declares no such name.
    MissingBackendError
        When the object cannot be imported: names the package that declares it, and its entry point.
    """
    entry = _declared(group).get(name)
    if entry is None:
        raise InputError(group, f"knows no {name!r}", f"one of {', '.join(names(group)) or 'none'}")
    try:
        return entry.load()
    except (ImportError, AttributeError, SyntaxError) as error:
        place = f"entry point {entry.value!r} of the package {_package(entry)}"
        raise MissingBackendError(f"{name!r} of {group} cannot be loaded: {error} ({place})") from error


@cache
def _declared(group: str) -> dict[str, EntryPoint]:
    entries = sorted(entry_points(group=group), key=lambda e: (_package(e) != _OWN, _package(e), e.value))
    return {entry.name: entry for entry in reversed(entries)}


def _package(entry: EntryPoint) -> str:
    return entry.dist.metadata["Name"] if entry.dist is not None else "?"
