"""Find the reader of each map file, and what the files contain: roads, solids, terrain.

Readers are in the table of :mod:`egvs.core.readers`; what their modules have, says :mod:`egvs.creation.map_parts`. A
folder stands for the files in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egvs.core import readers
from egvs.core.errors import InputError
from egvs.core.readers import Reader
from egvs.core.reading import translate_errors
from egvs.core.wording import list_first

KIND = "map"
"""Kind of the readers of maps."""

ROADS, SOLIDS, TERRAIN = "roads", "solids", "terrain"
"""What a map file can contain."""

_FUNCTIONS = {ROADS: "read_roads", SOLIDS: "read_solids", TERRAIN: "read_terrain"}
"""Function of a reader's module for each part; a module with ``open_roads`` needs no ``read_roads``."""

_EXPECTED = "a module with read_roads or open_roads, read_solids, or read_terrain, see egvs.creation.map_parts"

_MAX_NAMED = 3

MAX_FILES = 1000
"""Largest number of files of a folder."""


@dataclass(frozen=True)
class MapFile:
    """A map file and its reader."""

    path: Path
    reader: Reader

    def has(self, part: str) -> bool:
        """Return whether the reader can read :data:`ROADS`, :data:`SOLIDS` or :data:`TERRAIN`."""
        return part in self.reader.gives

    @property
    def module(self) -> Any:
        """The reader's module (:mod:`egvs.creation.map_parts`); MissingBackendError when it cannot be used."""
        needs_no_read_roads = hasattr(readers.load_reader(self.reader), "open_roads")
        parts = [part for part in self.reader.gives if part != ROADS or not needs_no_read_roads]
        return readers.load_reader(self.reader, tuple(_FUNCTIONS[part] for part in parts), _EXPECTED)


@dataclass(frozen=True)
class MapFiles:
    """The files of a new scenario.

    Attributes
    ----------
    roads
        The road map.
    solids, terrain
        Files with static objects and with ground heights.
    """

    roads: MapFile
    solids: tuple[MapFile, ...]
    terrain: tuple[MapFile, ...]


def open_maps(paths: Sequence[Path]) -> MapFiles:
    """Find the readers of map files, and choose the road map.

    Parameters
    ----------
    paths
        Files and folders.

    Raises
    ------
    InputError
        When a file does not exist or no reader opens it, or when there is not exactly one road map. An OpenStreetMap
        file beside another road map contributes its static objects only.
    """
    maps = [MapFile(path, find_reader(path)) for path in list_files(paths)]
    road_maps = [file for file in maps if file.has(ROADS)]
    only_roads = [file for file in road_maps if not file.has(SOLIDS)]
    choice = only_roads or road_maps
    if not choice:
        names = ", ".join(str(path) for path in paths)
        raise InputError("--from", f"no road map among {names}", f"Add one of: {describe_formats(ROADS)}.")
    if len(choice) > 1:
        names = " and ".join(str(file.path) for file in choice[:2])
        raise InputError("--from", f"expected one road map, got {names}", "Give one of them.")
    roads = choice[0]
    return MapFiles(
        roads,
        tuple(file for file in maps if file.has(SOLIDS)),
        tuple(file for file in maps if file.has(TERRAIN)),
    )


@contextmanager
def reading(files: Sequence[MapFile]) -> Iterator[None]:
    """Translate any exception of the reader of some files to an InputError that names them."""
    with translate_errors(list_first([str(file.path) for file in files], _MAX_NAMED)):
        yield


def open_surface(paths: Sequence[Path]) -> tuple[MapFile, ...]:
    """Find the readers of surface models: files with heights, and folders of them.

    Raises
    ------
    InputError
        When a file does not exist, or contains no heights of a surface.
    """
    maps = tuple(MapFile(path, find_reader(path)) for path in list_files(paths))
    for file in maps:
        if not file.has(TERRAIN):
            formats = describe_formats(TERRAIN)
            raise InputError(file.path, f"expected a surface model, got {file.reader.name}", f"Formats: {formats}.")
    return maps


def list_files(paths: Sequence[Path]) -> list[Path]:
    """Return the files among some paths, and the files in the folders among them, without repetitions.

    Raises
    ------
    InputError
        When a path does not exist, or a folder has no file or more than :data:`MAX_FILES`.
    """
    listed: dict[Path, None] = {}
    for path in paths:
        if not path.is_dir():
            listed[path] = None
            continue
        inside = sorted(file for file in path.rglob("*") if file.is_file() and readers.find_reader(KIND, file))
        if not inside:
            raise InputError(path, "the folder contains no map that can be read", f"Formats: {describe_formats()}.")
        if len(inside) > MAX_FILES:
            problem = f"the folder contains {len(inside):,} maps; at most {MAX_FILES:,} are read"
            raise InputError(path, problem, "Give the files around the junction.")
        listed |= dict.fromkeys(inside)
    return list(listed)


def find_reader(path: Path) -> Reader:
    """Return the reader of a file; InputError when it does not exist or no reader accepts it."""
    reader = readers.find_reader(KIND, path)
    if reader is None:
        raise InputError(path, "the format of the file is unknown", f"Formats: {describe_formats()}.")
    return reader


def describe_formats(part: str | None = None) -> str:
    """Return the names of the formats, or of those with :data:`ROADS`, :data:`SOLIDS` or :data:`TERRAIN`."""
    return readers.describe_formats(KIND, part)
