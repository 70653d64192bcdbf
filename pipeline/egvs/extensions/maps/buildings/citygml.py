"""Reader of static objects from CityGML 1, 2 and 3, such as the tiles of PLATEAU.

A folder stands for all ``.gml`` files in it. Of files that PLATEAU names by grid squares, only those that the window
reaches are opened, and only those with kinds of objects that are modelled.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely

from egvs.core import limits, readers
from egvs.creation.map_parts import MapContext, SolidMap
from egvs.extensions.maps.buildings.city_models import SOLID_KINDS, collect_solids
from egvs.extensions.maps.formats import citygml
from egvs.extensions.maps.formats.citygml import CityGmlFile
from egvs.extensions.maps.formats.mesh_codes import TileName, parse_tile_name

TILE_KINDS = frozenset({"bldg", "brid", "cons", "frn", "veg"})
"""Kinds of PLATEAU's tiles with solids, in the names of files."""

_FIRST_MEMBER = rb"<(?:[\w.-]+:)?(?:cityObjectMember|featureMember|member)\b[^>]{0,80}>\s{0,80}<(?:[\w.-]+:)?[A-Za-z]+"

TILE_MARGIN_M = 200.0
"""How far objects may reach beyond the square of their tile."""


def is_relief(path: Path, head: bytes) -> bool:
    """Return whether a file is terrain (:mod:`egvs.extensions.maps.terrain.citygml_relief`), by its name, its
    beginning, or its first member."""
    if not citygml.is_citygml(head):
        return False
    if citygml.has_relief(head):
        return True
    tile = parse_tile_name(path.name)
    if tile is not None:
        return tile.kind == "dem"
    try:
        member = readers.first_match(path, _FIRST_MEMBER)
    except (EOFError, OSError, zlib.error):  # damaged: its reader says so
        return False
    return member is not None and member.endswith(b"ReliefFeature")


def read_solids(paths: Sequence[Path], context: MapContext) -> SolidMap:
    """Return the buildings, bridges, furniture and plants in the window; InputError when a file is damaged."""
    files = _expand_folders(paths)
    opened = [path for path in files if _is_needed(path, context, TILE_KINDS)]
    result = collect_solids((CityGmlFile(path, SOLID_KINDS) for path in opened), context, SOLID_KINDS)
    return _with_skipped_files(result, len(files), len(opened))


def is_in_reach(tile: TileName, context: MapContext) -> bool:
    """Return whether the square of a tile, with a margin, meets the window; True if the world frame is unknown."""
    if context.frame is None:
        return True
    west, south, east, north = tile.square
    corners = np.array([[west, south], [east, south], [east, north], [west, north]])
    corners_m = context.frame.from_lon_lat(corners)
    if not np.isfinite(corners_m).all():
        return False
    return bool(shapely.Polygon(corners_m).distance(context.window) <= TILE_MARGIN_M)


def _folder_files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*.gml") if path.is_file())


def _expand_folders(paths: Sequence[Path]) -> list[Path]:
    files: list[Path] = []
    for path in paths:
        files += _folder_files(path) if path.is_dir() else [path]
        limits.MAP_OBJECTS.check(path, len(files))
    return list(dict.fromkeys(files))


def _is_needed(path: Path, context: MapContext, kinds: frozenset[str]) -> bool:
    tile = parse_tile_name(path.name)
    return tile is None or (tile.kind in kinds and is_in_reach(tile, context))


def _with_skipped_files(result: SolidMap, files: int, opened: int) -> SolidMap:
    if files == opened:
        return result
    note = (
        f"{files - opened:,} of {files:,} CityGML files were not opened: their names say that they are out of reach, or"
    )
    return replace(result, notes=(*result.notes, f"{note} have no such objects."))
