"""Folders of extensions that ``egvs runs`` lists and ``egvs export`` reads: entry points of the group ``egvs.folders``.

Such a folder has the results of several runs, for example of all junctions of a city.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from egvs.core import plugins

if TYPE_CHECKING:
    from egvs.export.finished_run import FinishedRun
    from egvs.export.layers import Layer

GROUP = "egvs.folders"
"""The group of entry points."""


@runtime_checkable
class FolderKind(Protocol):
    """A kind of folder.

    Attributes
    ----------
    name
        What it is the folder of: "city".
    marker
        Name of a file that only these folders have.
    state
        Its state in the list of runs: "city run".
    """

    name: str
    marker: str
    state: str

    def title(self, folder: Path) -> str:
        """Return a name for exported files."""

    def reference_run(self, folder: Path) -> FinishedRun:
        """Return a run whose reference system is that of the layers."""

    def layers(self, folder: Path) -> tuple[list[Layer], list[str]]:
        """Return the layers, the topmost first, and notes on those that are left out; InputError if outdated."""

    def part_hint(self, folder: Path) -> str:
        """Return a sentence on what to export instead, in formats for runs only."""


@cache
def folder_kinds() -> tuple[FolderKind, ...]:
    """Return the kinds of all extensions, in the order of their entry points.

    Raises
    ------
    MissingBackendError
        When an entry point cannot be loaded, or is no :class:`FolderKind`.
    """
    expected = "an object with name, marker, state, title, reference_run, layers and part_hint"
    return plugins.load_plugins(GROUP, FolderKind, expected)  # type: ignore[type-abstract]


def find_kind(folder: Path) -> FolderKind | None:
    """Return the kind of a folder; None if it is none of an extension."""
    return next((kind for kind in folder_kinds() if (folder / kind.marker).is_file()), None)
