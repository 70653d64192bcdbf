"""Plug-ins: effects, readers, detectors and scores, declared as entry points and loaded on first use.

A group, e.g. ``egvs.effects``, is a table of entry points: name -> ``module:object``. The parts of this program
are declared the same way, in its own ``pyproject.toml``. Where two packages declare one name, this program has
priority, then the packages in the order of their names; so an installed package cannot replace a part of this program.
Who calls the objects of a group defines what they must have, and checks it (:func:`check_plugin`).

https://packaging.python.org/en/latest/specifications/entry-points/
"""

from __future__ import annotations

from functools import cache
from importlib.metadata import Distribution, EntryPoint, entry_points
from importlib.util import find_spec
from operator import attrgetter
from typing import Any, TypeVar

from egvs.core.errors import InputError, MissingBackendError, MissingExtraError
from egvs.core.wording import by_number

T = TypeVar("T")

PACKAGE_NAME = "egvs"
"""The package of this program."""

_PACKAGES = {
    "PIL": "Pillow",
    "osi3": "osi-python",
    "pxr": "usd-core",
    "python_calamine": "python-calamine",
    "sklearn": "scikit-learn",
    "torch": "PyTorch",
    "velodyne_decoder": "velodyne-decoder",
}
"""Names of packages that differ from the name that is imported."""


def require_libraries(what: str, extra: str, *libraries: str) -> None:
    """Check, before any work is done, that the libraries of an extra are installed; none is imported.

    Parameters
    ----------
    what
        The feature, for the message.
    extra
        The extra of this package that installs the libraries.
    *libraries
        Names of modules.

    Raises
    ------
    MissingExtraError
        Names all missing libraries, and how to install them.
    """
    missing = [_PACKAGES.get(name, name) for name in libraries if find_spec(name) is None]
    if not missing:
        return
    verb = by_number(len(missing), "is", "are")
    names = f"{', '.join(missing)}, which {verb} not installed"
    raise MissingExtraError(f"{what} needs {names}. Run pip install '{PACKAGE_NAME}[{extra}]'")


def plugin_names(group: str) -> list[str]:
    """Return the names that a group declares, sorted; nothing is imported."""
    return sorted(_entry_points_by_name(group))


def plugin_module(group: str, name: str) -> str:
    """Return the module of an entry point without importing it; KeyError when the group declares no such name."""
    entry = _entry_points_by_name(group)[name]
    if EntryPoint.pattern.match(entry.value) is None:
        raise plugin_error(group, name, "it does not name a module")
    return entry.module


def plugin_package(group: str, name: str) -> str:
    """Return the package that declares an entry point; KeyError when the group declares no such name."""
    return _distribution_name(_entry_points_by_name(group)[name].dist)


def plugin_error(group: str, name: str, problem: str) -> MissingBackendError:
    """Make the error for an entry point whose object cannot be used; it names the package and the entry point."""
    entry = _entry_points_by_name(group)[name]
    origin = f"entry point {entry.value!r} of the package {_distribution_name(entry.dist)}"
    return MissingBackendError(f"{name!r} of {group} cannot be loaded: {problem} ({origin})")


@cache
def load_plugin(group: str, name: str) -> Any:
    """Return the object of an entry point; its module is imported at the first call.

    Raises
    ------
    InputError
        When the group declares no such name.
    MissingBackendError
        When the object cannot be imported: names the package that declares it, and its entry point.
    """
    entry = _entry_points_by_name(group).get(name)
    if entry is None:
        known = ", ".join(plugin_names(group)) or "none"
        raise InputError(group, f"unknown name {name!r}", f"Choose one of {known}.")
    try:
        return entry.load()
    except (ImportError, AttributeError, SyntaxError) as error:
        raise plugin_error(group, name, str(error)) from error
    except (Exception, SystemExit) as error:  # a foreign module may do anything when it is imported
        raise plugin_error(group, name, f"its import raised {error!r}") from error


def load_plugins(group: str, kind: type[T], expected: str) -> tuple[T, ...]:
    """Return the objects of all entry points of a group, in the order of their names.

    Parameters
    ----------
    group
        The group.
    kind
        What each must be an instance of: a class, or a protocol that can be checked at run time.
    expected
        What an object of this group is, for the message.

    Raises
    ------
    MissingBackendError
        When one cannot be loaded, or is of another kind.
    """
    loaded = []
    for name in plugin_names(group):
        plugin = load_plugin(group, name)
        if not isinstance(plugin, kind):
            raise plugin_error(group, name, f"expected {expected}")
        loaded.append(plugin)
    return tuple(loaded)


def load_rows(group: str, name: str, kind: type[T]) -> tuple[T, ...]:
    """Return the object of an entry point that is a tuple of rows of one class; MissingBackendError if it is not."""
    rows = load_plugin(group, name)
    if not isinstance(rows, tuple) or not all(isinstance(row, kind) for row in rows):
        raise plugin_error(group, name, f"expected a tuple of {kind.__module__}.{kind.__name__}, got {rows!r}")
    return rows


def check_plugin(group: str, name: str, plugin: object, required: tuple[str, ...], expected: str) -> None:
    """Raise a MissingBackendError if an object lacks an attribute.

    Parameters
    ----------
    group, name
        The entry point that it was loaded from, for the message.
    plugin
        The object.
    required
        Names of attributes, which may be nested: ``Model.from_dict``.
    expected
        What an object of this group is, for the message.
    """
    missing = [attribute for attribute in required if not _has_attribute(plugin, attribute)]
    if missing:
        raise plugin_error(group, name, f"it has no {', '.join(missing)}; expected {expected}")


@cache
def _entry_points_by_name(group: str) -> dict[str, EntryPoint]:
    def priority(entry: EntryPoint) -> tuple[bool, str, str]:
        package = _distribution_name(entry.dist)
        return package != PACKAGE_NAME, package, entry.value

    entries = sorted(_all_entry_points().select(group=group), key=priority)
    return {entry.name: entry for entry in reversed(entries)}


@cache
def _all_entry_points() -> Any:
    """Read the entry points of all groups at once: each reading opens the metadata of every installed package.

    Returns ``EntryPoints``, or in Python 3.11 a dictionary by group; both have ``select``.
    """
    return entry_points()


@cache
def _distribution_name(distribution: Distribution | None) -> str:
    """Return the name of a package, whose metadata are parsed for that; ``"?"`` where it is unknown."""
    if distribution is None or "Name" not in distribution.metadata:  # the backport of importlib.metadata raises for it
        return "?"
    return distribution.metadata["Name"] or "?"


def _has_attribute(plugin: object, attribute: str) -> bool:
    """Return whether an object has an attribute, which may be nested (``a.b``)."""
    try:
        attrgetter(attribute)(plugin)
    except AttributeError:
        return False
    return True
