"""What of a map is solid, and how high.

What of a map is solid, and how high where the map does not say: one table for OpenStreetMap and SUMO's polygons.

A type is a key of OpenStreetMap and its value, with a dot between: ``building.garage``. What is said of ``building``
goes for everything below it that has no entry of its own. The short names that SUMO's polyconvert gives by default
(``parking``, ``water``; its ``osmPolyconvert.typ.xml``) stand here too.

All sizes are round figures for towns of no special kind, not measurements. Metres, above the ground.

How high a thing of a map stands, from its tags (Simple 3D Buildings,
https://wiki.openstreetmap.org/wiki/Simple_3D_Buildings) and its type.

    top  = height         or (building:levels + roof:levels) * 3 m    or the default of the type
    base = min_height     or building:min_level * 3 m                 or 0, or the underside of a roof or crown

``roof:height`` stands for the storeys of the roof where it is given. Metres above the ground.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

from egvs.formats.osm import parse_length_m, parse_number

IGNORE: Literal["ignore"] = "ignore"


@dataclass(frozen=True)
class SolidType:
    """How a type of things stands.

    Attributes
    ----------
    height_m
        Its top where the map names none; None: that of buildings of no special type.
    thickness_m
        For an open roof: from its underside, below which one sees through, to its top.
    half_width_m
        How far a line of it reaches to each side, or a point all round; None: only areas are solid.
    is_tree
        Whether it is a crown that starts at :data:`CROWN_BASE_SHARE` of its height.
    """

    height_m: float | None = None
    thickness_m: float | None = None
    half_width_m: float | None = None
    is_tree: bool = False


CROWN_BASE_SHARE, TRUNK_RADIUS_M = 0.3, 0.15

_CLOSED = SolidType()
_LOW, _SHED = SolidType(3.0), SolidType(2.5)

SOLID_TYPES: Mapping[str, SolidType] = {
    "building": _CLOSED,
    "building.allotment_house": _LOW,
    "building.bunker": _LOW,
    "building.cabin": _LOW,
    "building.canopy": SolidType(5.0, thickness_m=0.5),
    "building.carport": SolidType(2.5, thickness_m=0.3),
    "building.carports": SolidType(2.5, thickness_m=0.3),
    "building.container": _SHED,
    "building.garage": _SHED,
    "building.garages": _SHED,
    "building.greenhouse": _LOW,
    "building.guardhouse": _LOW,
    "building.hut": _SHED,
    "building.kiosk": _LOW,
    "building.outbuilding": _LOW,
    "building.roof": SolidType(5.0, thickness_m=0.5),
    "building.service": _LOW,
    "building.shed": _SHED,
    "building.static_caravan": _LOW,
    "building.tent": _LOW,
    "building.toilets": _LOW,
    "man_made.chimney": _CLOSED,
    "man_made.gasometer": _CLOSED,
    "man_made.silo": _CLOSED,
    "man_made.storage_tank": _CLOSED,
    "man_made.tower": _CLOSED,
    "man_made.water_tower": _CLOSED,
    "barrier": SolidType(1.5, half_width_m=0.05),
    "barrier.cable_barrier": SolidType(0.75, half_width_m=0.05),
    "barrier.city_wall": SolidType(6.0, half_width_m=0.75),
    "barrier.fence": SolidType(1.5, half_width_m=0.05),
    "barrier.guard_rail": SolidType(0.75, half_width_m=0.15),
    "barrier.handrail": SolidType(1.0, half_width_m=0.05),
    "barrier.hedge": SolidType(1.5, half_width_m=0.5),
    "barrier.jersey_barrier": SolidType(0.8, half_width_m=0.3),
    "barrier.retaining_wall": SolidType(1.5, half_width_m=0.2),
    "barrier.wall": SolidType(2.0, half_width_m=0.15),
    "city_wall": SolidType(6.0, half_width_m=0.75),
    "fence": SolidType(1.5, half_width_m=0.05),
    "hedge": SolidType(1.5, half_width_m=0.5),
    "wall": SolidType(2.0, half_width_m=0.15),
    "historic.citywalls": SolidType(6.0, half_width_m=0.75),
    "natural.tree": SolidType(8.0, half_width_m=2.0, is_tree=True),
    "natural.tree_row": SolidType(8.0, half_width_m=2.0, is_tree=True),
    "tree": SolidType(8.0, half_width_m=2.0, is_tree=True),
}
"""What is solid where it is an area or, with a half width, a line."""

POLE_TYPES: Mapping[str, SolidType] = {
    "advertising.column": SolidType(3.5, half_width_m=0.65),
    "barrier.block": SolidType(0.5, half_width_m=0.3),
    "barrier.bollard": SolidType(1.0, half_width_m=0.1),
    "highway.street_lamp": SolidType(6.0, half_width_m=0.1),
    "highway.traffic_signals": SolidType(3.5, half_width_m=0.1),
    "man_made.flagpole": SolidType(8.0, half_width_m=0.1),
    "man_made.mast": SolidType(15.0, half_width_m=0.3),
    "man_made.utility_pole": SolidType(8.0, half_width_m=0.15),
    "power.pole": SolidType(8.0, half_width_m=0.15),
}
"""What is solid where it is a point, an upright cylinder; trees stand above."""

_NO_BUILDING = (
    "demolished", "destroyed", "entrance", "no", "planned", "proposed", "razed", "removed", "underground",
)  # fmt: skip
_NO_WALL = (
    "block", "bollard", "border_control", "bump_gate", "bus_trap", "cattle_grid", "chain", "cycle_barrier",
    "debris", "ditch", "entrance", "full-height_turnstile", "gate", "hampshire_gate", "height_restrictor",
    "kerb", "kissing_gate", "lift_gate", "log", "motorcycle_barrier", "no", "rope", "sally_port",
    "sliding_gate", "spikes", "stile", "sump_buster", "swing_gate", "toll_booth", "turnstile", "wedge",
)  # fmt: skip
_TAG_KEYS = (
    "aerialway", "aeroway", "amenity", "highway", "historic", "landuse", "leisure", "man_made", "military",
    "natural", "office", "place", "power", "railway", "shop", "sport", "tourism", "waterway",
)  # fmt: skip
_SHORT_NAMES = (
    "admin_level", "bay", "boundary", "clinic", "college", "commercial", "farm", "forest", "graveyard",
    "harbour", "industrial", "kindergarten", "land", "park", "parking", "pipeline", "population",
    "railway:position", "railway:position:exact", "research_institute", "residential", "school", "services", "strait",
    "traffic_sign", "university", "water",
)  # fmt: skip
NOT_SOLID = frozenset(
    (*(f"building.{v}" for v in _NO_BUILDING), *(f"barrier.{v}" for v in _NO_WALL), *_TAG_KEYS, *_SHORT_NAMES)
)
"""What is none. Of barriers that is what one sees or drives through: gates, kerbs, ditches, rows of bollards."""


class SolidTypes:
    """The table, with what a user says of some types in place of it.

    Parameters
    ----------
    changes
        Type to a height in metres, "solid" or "ignore"; "" stands for all types that the table does not name.
        "ignore" goes for everything below the type, too.
    """

    def __init__(self, changes: Mapping[str, float | Literal["solid", "ignore"]] | None = None) -> None:
        changes = changes or {}
        ignored = tuple(f"{name}." for name, value in changes.items() if value == IGNORE and name)
        self._solid = {name: kind for name, kind in SOLID_TYPES.items() if not name.startswith(ignored)}
        self._poles = {name: kind for name, kind in POLE_TYPES.items() if not name.startswith(ignored)}
        self._none = set(NOT_SOLID)
        for name, value in sorted(changes.items()):
            if value == IGNORE:
                self._none.add(name)
                self._solid.pop(name, None)
                self._poles.pop(name, None)
            elif name in POLE_TYPES:
                self._poles[name] = (
                    POLE_TYPES[name] if value == "solid" else replace(POLE_TYPES[name], height_m=float(value))
                )
            else:
                self._none.discard(name)
                kind = self._solid.get(name) or SOLID_TYPES.get(name) or self.named(name) or _CLOSED
                self._solid[name] = kind if value == "solid" else replace(kind, height_m=float(value))

    def knows(self, name: str) -> bool:
        """Whether the table says anything of a type."""
        return any(prefix in self._solid or prefix in self._none for prefix in _prefixes(name))

    def pole(self, name: str) -> SolidType | None:
        """How a point of a type stands; None when it is neither a pole nor a tree."""
        solid = self._poles.get(name) or self.named(name)
        return solid if name in self._poles or (solid is not None and solid.is_tree) else None

    def named(self, name: str) -> SolidType | None:
        """How a type stands; None when it is not solid, or unknown."""
        known = (prefix for prefix in _prefixes(name) if prefix in self._solid or prefix in self._none)
        return self._solid.get(next(known, ""))


def _prefixes(name: str) -> list[str]:
    """The type itself, what it lies below, and last "", below which everything lies."""
    parts = name.split(".")
    return [".".join(parts[:count]) for count in range(len(parts), 0, -1)] + [""] * bool(name)


LEVEL_M = 3.0
"""A storey of a building."""

_MAX_LEVELS = 300


@dataclass(frozen=True)
class VerticalExtent:
    """From where to where a thing stands up.

    ``source`` says where the top is from: height, levels (tags of the map) or default. ``unreadable`` names the tags
    that say nothing, and were not heeded.
    """

    base_m: float
    top_m: float
    source: str
    unreadable: tuple[str, ...] = ()


class _HeightTags:
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


def vertical_extent(tags: Mapping[str, str], solid: SolidType, default_m: float) -> VerticalExtent:
    """Where a thing starts and ends; ``default_m`` is the top of what has no height of its own, nor one by its type."""
    read = _HeightTags(tags)
    low_m = _low_m(read)
    top_m, source = read.read("height", parse_positive_length_m), "height"
    if top_m is None:
        top_m, source = _levels_m(read), "levels"
    if top_m is None:
        top_m, source = solid.height_m or default_m, "default"
        if low_m is not None and low_m >= top_m:
            top_m = low_m + (solid.thickness_m or LEVEL_M)
    if low_m is not None and low_m >= top_m:
        read.unreadable.append("base above top")
        low_m = None
    return VerticalExtent(_underside_m(solid, top_m) if low_m is None else low_m, top_m, source, tuple(read.unreadable))


def is_underground(tags: Mapping[str, str]) -> bool:
    """Whether a thing lies wholly below the ground."""
    if "underground" in (tags.get("location"), tags.get("building"), tags.get("parking")):
        return True
    below = parse_number(tags.get("building:levels:underground", "0")) or 0.0
    return (
        below > 0 and parse_number(tags.get("building:levels", "")) == 0 and not {"height", "roof:levels"} & tags.keys()
    )


def _low_m(read: _HeightTags) -> float | None:
    low_m = read.read("min_height", parse_length_m)
    if low_m is None and (levels := read.read("building:min_level", parse_number)) is not None:
        low_m = max(0.0, LEVEL_M * levels)
    return low_m


def _levels_m(read: _HeightTags) -> float | None:
    """The height of the storeys and the roof above them; None where there are none, or nobody says how many."""
    levels = read.read("building:levels", _parse_levels)
    if levels is None:
        return None
    roof_m = read.read("roof:height", parse_length_m)
    if roof_m is None:
        roof_m = LEVEL_M * (read.read("roof:levels", _parse_levels) or 0.0)
    if not levels and not roof_m:
        read.unreadable.append("building:levels")
    return LEVEL_M * levels + roof_m or None


def _underside_m(solid: SolidType, top_m: float) -> float:
    if solid.is_tree:
        return CROWN_BASE_SHARE * top_m
    return max(0.0, top_m - solid.thickness_m) if solid.thickness_m else 0.0


def parse_positive_length_m(text: str) -> float | None:
    """A length as OpenStreetMap writes it, in metres; None when it is none, or 0."""
    return parse_length_m(text) or None


def _parse_levels(text: str) -> float | None:
    levels = parse_number(text)
    return levels if levels is not None and 0 <= levels < _MAX_LEVELS else None
