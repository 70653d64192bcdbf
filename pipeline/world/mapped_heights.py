"""How high a thing of a map stands, from its tags (Simple 3D Buildings,
https://wiki.openstreetmap.org/wiki/Simple_3D_Buildings) and its type.

    top  = height         or (building:levels + roof:levels) * 3 m    or the default of the type
    base = min_height     or building:min_level * 3 m                 or 0, or the underside of a roof or crown

``roof:height`` stands for the storeys of the roof where it is given. Metres above the ground.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from pipeline.formats.osm import length_m, number
from pipeline.world.solid_types import CROWN_BASE_SHARE, SolidType

LEVEL_M = 3.0
"""A storey of a building."""

_MOST_LEVELS = 300


@dataclass(frozen=True)
class Extent:
    """From where to where a thing stands up.

    ``source`` says where the top is from: height, levels (tags of the map) or default. ``unreadable`` names the tags
    that say nothing, and were not heeded.
    """

    base_m: float
    top_m: float
    source: str
    unreadable: tuple[str, ...] = ()


class _Tags:
    """Values of tags; those that say nothing count as absent, and are remembered."""

    def __init__(self, tags: Mapping[str, str]) -> None:
        self._tags = tags
        self.unreadable: list[str] = []

    def read(self, key: str, parse: Callable[[str], float | None]) -> float | None:
        if key not in self._tags:
            return None
        value = parse(self._tags[key])
        if value is None:
            self.unreadable.append(key)
        return value


def extent_of(tags: Mapping[str, str], solid: SolidType, default_m: float) -> Extent:
    """Where a thing starts and ends; ``default_m`` is the top of what has no height of its own, nor one by its type."""
    read = _Tags(tags)
    low_m = _low_m(read)
    top_m, source = read.read("height", length_above_zero_m), "height"
    if top_m is None:
        top_m, source = _levels_m(read), "levels"
    if top_m is None:
        top_m, source = solid.height_m or default_m, "default"
        if low_m is not None and low_m >= top_m:
            top_m = low_m + (solid.thickness_m or LEVEL_M)
    if low_m is not None and low_m >= top_m:
        read.unreadable.append("base above top")
        low_m = None
    return Extent(_underside_m(solid, top_m) if low_m is None else low_m, top_m, source, tuple(read.unreadable))


def is_underground(tags: Mapping[str, str]) -> bool:
    """Whether a thing lies wholly below the ground."""
    if "underground" in (tags.get("location"), tags.get("building"), tags.get("parking")):
        return True
    below = number(tags.get("building:levels:underground", "0")) or 0.0
    return below > 0 and number(tags.get("building:levels", "")) == 0 and not {"height", "roof:levels"} & tags.keys()


def _low_m(read: _Tags) -> float | None:
    low_m = read.read("min_height", length_m)
    if low_m is None and (levels := read.read("building:min_level", number)) is not None:
        low_m = max(0.0, LEVEL_M * levels)
    return low_m


def _levels_m(read: _Tags) -> float | None:
    """The height of the storeys and the roof above them; None where there are none, or nobody says how many."""
    levels = read.read("building:levels", _levels)
    if levels is None:
        return None
    roof_m = read.read("roof:height", length_m)
    if roof_m is None:
        roof_m = LEVEL_M * (read.read("roof:levels", _levels) or 0.0)
    if not levels and not roof_m:
        read.unreadable.append("building:levels")
    return LEVEL_M * levels + roof_m or None


def _underside_m(solid: SolidType, top_m: float) -> float:
    if solid.is_tree:
        return CROWN_BASE_SHARE * top_m
    return max(0.0, top_m - solid.thickness_m) if solid.thickness_m else 0.0


def length_above_zero_m(text: str) -> float | None:
    """A length as OpenStreetMap writes it, in metres; None when it is none, or 0."""
    return length_m(text) or None


def _levels(text: str) -> float | None:
    levels = number(text)
    return levels if levels is not None and 0 <= levels < _MOST_LEVELS else None
