"""What of a map is solid, and how high where the map does not say: one table for OpenStreetMap and SUMO's polygons.

A type is a key of OpenStreetMap and its value, with a dot between: ``building.garage``. What is said of ``building``
goes for everything below it that has no entry of its own. The short names that SUMO's polyconvert gives by default
(``parking``, ``water``; its ``osmPolyconvert.typ.xml``) stand here too.

All sizes are round figures for towns of no special kind, not measurements. Metres, above the ground.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

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

SOLID: Mapping[str, SolidType] = {
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

POLES: Mapping[str, SolidType] = {
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
_KEYS = (
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
    (*(f"building.{v}" for v in _NO_BUILDING), *(f"barrier.{v}" for v in _NO_WALL), *_KEYS, *_SHORT_NAMES)
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
        self._solid = {name: kind for name, kind in SOLID.items() if not name.startswith(ignored)}
        self._poles = {name: kind for name, kind in POLES.items() if not name.startswith(ignored)}
        self._none = set(NOT_SOLID)
        for name, value in sorted(changes.items()):
            if value == IGNORE:
                self._none.add(name)
                self._solid.pop(name, None)
                self._poles.pop(name, None)
            elif name in POLES:
                self._poles[name] = POLES[name] if value == "solid" else replace(POLES[name], height_m=float(value))
            else:
                self._none.discard(name)
                kind = self._solid.get(name) or SOLID.get(name) or self.named(name) or _CLOSED
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
