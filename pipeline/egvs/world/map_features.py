"""Which objects of a map are solid, and from which height to which; for OpenStreetMap and SUMO's polygons.

A type is a key of OpenStreetMap and its value: ``building.garage``. An entry for ``building`` applies to all types
below it that have no entry. The tables also list the short names that SUMO's polyconvert uses by default (``parking``,
``water``; see its ``osmPolyconvert.typ.xml``).

Sizes in the tables are round figures for ordinary towns, not measurements.

Heights follow from the tags of an object (Simple 3D Buildings,
https://wiki.openstreetmap.org/wiki/Simple_3D_Buildings) and its type, in metres above the ground::

    top  = height         or (building:levels + roof:levels) * 3 m    or the default of the type
    base = min_height     or building:min_level * 3 m                 or 0, or the underside of a roof or crown

``roof:height``, if present, replaces the levels of the roof.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from egvs.formats.osm import parse_length_m, parse_number

IGNORE: Literal["ignore"] = "ignore"


@dataclass(frozen=True)
class SolidType:
    """Default dimensions of a type of objects.

    Attributes
    ----------
    height_m
        Top of objects without a height; None for the default height of buildings.
    thickness_m
        Thickness of an open roof; below it, the object is open.
    half_width_m
        Half width of lines and radius of points; None if only areas are solid.
    is_tree
        Whether it is a crown that begins at :data:`CROWN_BASE_SHARE` of its height.
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
"""Types whose areas are solid and, if they have a half width, also their lines."""

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
"""Types whose points are solid: upright cylinders. Trees are in :data:`SOLID_TYPES`."""

_NOT_SOLID_BUILDINGS = (
    "demolished", "destroyed", "entrance", "no", "planned", "proposed", "razed", "removed", "underground",
)  # fmt: skip
_NOT_SOLID_BARRIERS = (
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
    (
        *(f"building.{v}" for v in _NOT_SOLID_BUILDINGS),
        *(f"barrier.{v}" for v in _NOT_SOLID_BARRIERS),
        *_TAG_KEYS,
        *_SHORT_NAMES,
    )
)
"""Types that are not solid. Barriers that one can see or drive through are among them: gates, kerbs, bollards."""


class SolidTypes:
    """The tables of solid types with the user's overrides.

    Parameters
    ----------
    overrides
        For some types, a height in metres, "solid" or "ignore"; "" stands for all types that the tables do not list.
        "ignore" also applies to all types below.
    """

    def __init__(self, overrides: Mapping[str, float | Literal["solid", "ignore"]] | None = None) -> None:
        overrides = overrides or {}
        ignored = tuple(f"{name}." for name, value in overrides.items() if value == IGNORE and name)
        self._solid = {name: solid for name, solid in SOLID_TYPES.items() if not name.startswith(ignored)}
        self._poles = {name: solid for name, solid in POLE_TYPES.items() if not name.startswith(ignored)}
        self._not_solid = set(NOT_SOLID)
        for name, value in sorted(overrides.items()):
            if value == IGNORE:
                self._not_solid.add(name)
                self._solid.pop(name, None)
                self._poles.pop(name, None)
            elif name in POLE_TYPES:
                self._poles[name] = _with_height(POLE_TYPES[name], value)
            else:
                self._not_solid.discard(name)
                solid = self._solid.get(name) or SOLID_TYPES.get(name) or self.area_type(name) or _CLOSED
                self._solid[name] = _with_height(solid, value)

    def is_known(self, name: str) -> bool:
        """Return whether the tables list a type, or one above it."""
        return self._listed_type(name) is not None

    def point_type(self, name: str) -> SolidType | None:
        """Return the dimensions of points of a type; None if they are neither poles nor trees."""
        pole = self._poles.get(name)
        if pole is not None:
            return pole
        solid = self.area_type(name)
        return solid if solid is not None and solid.is_tree else None

    def area_type(self, name: str) -> SolidType | None:
        """Return the dimensions of areas and lines of a type; None if it is not solid, or unknown."""
        return self._solid.get(self._listed_type(name) or "")

    def _listed_type(self, name: str) -> str | None:
        """Return the type itself, or the nearest one above it that the tables list; "" is above all types."""
        parts = name.split(".")
        prefixes = [".".join(parts[:count]) for count in range(len(parts), 0, -1)]
        for prefix in [*prefixes, ""]:
            if prefix in self._solid or prefix in self._not_solid:
                return prefix
        return None


def _with_height(solid: SolidType, value: float | Literal["solid", "ignore"]) -> SolidType:
    """Apply an override that is not "ignore"."""
    return solid if value == "solid" else replace(solid, height_m=float(value))


LEVEL_M = 3.0
"""Height of a storey."""

_MAX_LEVELS = 300


@dataclass(frozen=True)
class VerticalExtent:
    """From which height to which an object is solid.

    Attributes
    ----------
    base_m, top_m
        Heights above the ground.
    source
        Where the top is from: height or levels (tags of the map), or default.
    unreadable
        Tags that were ignored because their values are invalid.
    """

    base_m: float
    top_m: float
    source: str
    unreadable: tuple[str, ...] = ()


@dataclass
class _HeightTags:
    """Values of tags. Invalid ones count as absent and are collected."""

    tags: Mapping[str, str]
    unreadable: list[str] = field(default_factory=list)

    def read(self, key: str, parse: Callable[[str], float | None]) -> float | None:
        if key not in self.tags:
            return None
        value = parse(self.tags[key])
        if value is None:
            self.unreadable.append(key)
        return value


LEAST_HEIGHT_M = 0.01
"""A height below this is a mistake: rounded, it would be none."""


def vertical_extent(tags: Mapping[str, str], solid: SolidType, default_m: float) -> VerticalExtent:
    """Return from which height to which an object is solid.

    Parameters
    ----------
    tags
        Tags of the object.
    solid
        Dimensions of its type.
    default_m
        Top if neither the tags nor the type have a height.
    """
    height_tags = _HeightTags(tags)
    base_m = _base_m(height_tags)
    source = "height"
    top_m = height_tags.read("height", parse_positive_length_m)
    if top_m is None:
        source = "levels"
        top_m = _levels_m(height_tags)
    if top_m is None:
        source = "default"
        top_m = solid.height_m or default_m
        if base_m is not None and base_m >= top_m:
            top_m = base_m + (solid.thickness_m or LEVEL_M)
    if base_m is not None and base_m > top_m - LEAST_HEIGHT_M:
        height_tags.unreadable.append("base above top")
        base_m = None
    if base_m is None:
        base_m = _default_base_m(solid, top_m)
    return VerticalExtent(base_m, top_m, source, tuple(height_tags.unreadable))


def is_underground(tags: Mapping[str, str]) -> bool:
    """Return whether an object is completely below the ground."""
    if "underground" in (tags.get("location"), tags.get("building"), tags.get("parking")):
        return True
    levels_below = parse_number(tags.get("building:levels:underground", "0")) or 0.0
    levels_above = parse_number(tags.get("building:levels", ""))
    return levels_below > 0 and levels_above == 0 and not {"height", "roof:levels"} & tags.keys()


def _base_m(height_tags: _HeightTags) -> float | None:
    """Return the underside according to the tags; None if they do not tell."""
    base_m = height_tags.read("min_height", parse_length_m)
    if base_m is not None:
        return base_m
    levels = height_tags.read("building:min_level", parse_number)
    return None if levels is None else max(0.0, LEVEL_M * levels)


def _levels_m(height_tags: _HeightTags) -> float | None:
    """Return the height of all levels and of the roof; None if the tags do not tell."""
    levels = height_tags.read("building:levels", _parse_levels)
    if levels is None:
        return None
    roof_m = height_tags.read("roof:height", parse_length_m)
    if roof_m is None:
        roof_m = LEVEL_M * (height_tags.read("roof:levels", _parse_levels) or 0.0)
    height_m = LEVEL_M * levels + roof_m
    if height_m < LEAST_HEIGHT_M:
        height_tags.unreadable.append("building:levels")
        return None
    return height_m


def _default_base_m(solid: SolidType, top_m: float) -> float:
    if solid.is_tree:
        return CROWN_BASE_SHARE * top_m
    if solid.thickness_m:
        return max(0.0, top_m - solid.thickness_m)
    return 0.0


def parse_positive_length_m(text: str) -> float | None:
    """Return a length in OpenStreetMap's notation in metres; None if it is invalid or below 1 cm."""
    length_m = parse_length_m(text)
    return None if length_m is None or length_m < LEAST_HEIGHT_M else length_m


def _parse_levels(text: str) -> float | None:
    levels = parse_number(text)
    return levels if levels is not None and 0 <= levels < _MAX_LEVELS else None
