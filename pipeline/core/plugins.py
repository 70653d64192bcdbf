"""Parts that other packages may add (effects, file formats) are found by their entry points, loaded when asked for.

A group, e.g. ``egvs.point_clouds``, is a table of entry points: name -> ``module:object``. What this program brings
itself is declared the same way, in its own ``pyproject.toml``. Where two packages declare one name, this program's own
comes first, then the packages in the order of their names; so what is installed beside it cannot replace a part.

https://packaging.python.org/en/latest/specifications/entry-points/
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from operator import attrgetter
from typing import Any

from pipeline.core.errors import InputError, MissingBackendError, MissingExtraError

OWN = "egvs"
"""The package of this program's own parts."""

_RIGHT = {
    "egvs.effects": (
        ("NAME", "SOURCE", "STAGE", "KIND", "Model.of"),
        "a subclass of Detect or another kind in pipeline.effects.base, with NAME, SOURCE and Model",
    ),
    "egvs.detectors": (
        ("NAME", "SOURCE", "settings", "at"),
        "a class with NAME, SOURCE, settings and at, see pipeline.validation.detectors.base",
    ),
    "egvs.scores": (
        ("name", "formula", "source", "sign", "function"),
        "a Score, see pipeline.validation.surrogates.base",
    ),
    "egvs.point_clouds": (("read",), "a module or an object with a function read"),
}
"""What an object of a group must have, and what would be right, in words."""

_PACKAGES = {"sklearn": "scikit-learn", "torch": "PyTorch"}
"""What is installed, where it has another name than what is imported."""


def require(what: str, extra: str, *libraries: str) -> None:
    """Refuse a part whose libraries are not installed, before any work is done for it; none is imported.

    Parameters
    ----------
    what
        The part, as the message names it.
    extra
        Of this package; it brings the libraries.

    Raises
    ------
    MissingExtraError
        Names all that are missing, and how to install them.
    """
    if missing := [_PACKAGES.get(name, name) for name in libraries if find_spec(name) is None]:
        told = f"{', '.join(missing)}, which {'are' if len(missing) > 1 else 'is'} not installed"
        raise MissingExtraError(f"{what} needs {told}: pip install '{OWN}[{extra}]'")


def names(group: str) -> list[str]:
    """The names that a group declares, sorted; nothing is imported."""
    return sorted(_declared(group))


def module_of(group: str, name: str) -> str:
    """The module that an entry point names; it is not imported. KeyError when the group declares no such name."""
    entry = _declared(group)[name]
    if EntryPoint.pattern.match(entry.value) is None:
        raise unusable(group, name, "it names no module")
    return entry.module


def package_of(group: str, name: str) -> str:
    """The package that declares an entry point. KeyError when the group declares no such name."""
    return _package(_declared(group)[name])


def unusable(group: str, name: str, problem: str) -> MissingBackendError:
    """The error for an entry point whose object cannot be used: names the package and the entry point."""
    entry = _declared(group)[name]
    place = f"entry point {entry.value!r} of the package {_package(entry)}"
    return MissingBackendError(f"{name!r} of {group} cannot be loaded: {problem} ({place})")


@cache
def load(group: str, name: str) -> Any:
    """The object that an entry point names; its module is imported at the first call.

    Raises
    ------
    InputError
        When the group declares no such name.
    MissingBackendError
        When the object cannot be imported, or lacks what its group asks for: names the package that declares it, and
        its entry point.
    """
    entry = _declared(group).get(name)
    if entry is None:
        raise InputError(group, f"knows no {name!r}", f"one of {', '.join(names(group)) or 'none'}")
    try:
        found = entry.load()
    except (ImportError, AttributeError, SyntaxError) as error:
        raise unusable(group, name, str(error)) from error
    except (Exception, SystemExit) as error:  # whatever somebody else's module does when it is imported
        raise unusable(group, name, f"its module ended with {error!r}") from error
    parts, right = _RIGHT.get(group, ((), ""))
    if lacks := [part for part in parts if not _has(found, part)]:
        raise unusable(group, name, f"it has no {', '.join(lacks)}; right is {right}")
    return found


@cache
def _declared(group: str) -> dict[str, EntryPoint]:
    entries = sorted(entry_points(group=group), key=lambda e: (_package(e) != OWN, _package(e), e.value))
    return {entry.name: entry for entry in reversed(entries)}


def _package(entry: EntryPoint) -> str:
    if entry.dist is None or "Name" not in entry.dist.metadata:  # a backport that other packages bring raises for it
        return "?"
    return entry.dist.metadata["Name"] or "?"


def _has(found: object, part: str) -> bool:
    """Whether an object has an attribute, which may be one of an attribute (``a.b``)."""
    try:
        attrgetter(part)(found)
    except AttributeError:
        return False
    return True
