"""Find the reader of each map file, and what the files contain: roads, solids, terrain.

Readers are entry points of the group ``egvs.maps`` (see :mod:`egvs.creation.map_parts`). A file is opened by the first
reader, in the order of their names, whose ``can_open`` accepts it. A folder stands for the files in it.
"""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egvs.core import plugins
from egvs.core.digests import open_input
from egvs.core.errors import InputError
from egvs.creation.map_parts import HEAD_BYTES, MapReader

GROUP = "egvs.maps"

ROADS, SOLIDS, TERRAIN = "read_roads", "read_solids", "read_terrain"
"""Functions of readers, for what a file can contain."""

MAX_FILES = 1000
"""Largest number of files of a folder."""

_GZIP = b"\x1f\x8b"


@dataclass(frozen=True)
class MapFile:
    """A map file and its reader (:mod:`egvs.creation.map_parts`)."""

    path: Path
    reader: Any

    def has(self, part: str) -> bool:
        """Return whether the reader can read :data:`ROADS`, :data:`SOLIDS` or :data:`TERRAIN`."""
        return hasattr(self.reader, part)


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
            raise InputError(file.path, f"expected a surface model, got {file.reader.NAME}", f"Formats: {formats}.")
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
        inside = sorted(file for file in path.rglob("*") if file.is_file() and _can_be_opened(file))
        if not inside:
            raise InputError(path, "the folder contains no map that can be read", f"Formats: {describe_formats()}.")
        if len(inside) > MAX_FILES:
            problem = f"the folder contains {len(inside):,} maps; at most {MAX_FILES:,} are read"
            raise InputError(path, problem, "Give the files around the junction.")
        listed |= dict.fromkeys(inside)
    return list(listed)


def find_reader(path: Path) -> MapReader:
    """Return the reader of a file; InputError when it does not exist or no reader accepts it."""
    head = read_head(path)
    for reader in _readers():
        if reader.can_open(path, head):
            return reader
    raise InputError(path, "the format of the file is unknown", f"Formats: {describe_formats()}.")


def read_head(path: Path) -> bytes:
    """Return the first bytes of a file, after gunzip where possible; InputError when it cannot be read."""
    if not path.is_file():
        raise InputError(path, "no such file", "Check the path.")
    try:
        with open_input(path) as content:
            head: bytes = content.read(HEAD_BYTES)
    except OSError as error:
        problem = f"the file cannot be read ({error.strerror or error})"
        raise InputError(path, problem, "Check its permissions, or leave it out.") from None
    if not head.startswith(_GZIP):
        return head
    try:
        with open_input(path) as content, gzip.open(content) as unzipped:
            return unzipped.read(HEAD_BYTES)
    except (EOFError, OSError, zlib.error):  # damaged: its reader says so
        return head


def describe_formats(part: str | None = None) -> str:
    """Return the names of the readers, or of those that read :data:`ROADS`, :data:`SOLIDS` or :data:`TERRAIN`."""
    return ", ".join(reader.NAME for reader in _readers() if part is None or hasattr(reader, part))


def _can_be_opened(path: Path) -> bool:
    head = read_head(path)
    return any(reader.can_open(path, head) for reader in _readers())


def _readers() -> list[MapReader]:
    return [plugins.load_plugin(GROUP, name) for name in plugins.plugin_names(GROUP)]
