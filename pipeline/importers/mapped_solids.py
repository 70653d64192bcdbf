"""What the importer takes from a map: solids with heights from tags, and counts of what happened to the mapped objects.

Heights are those of :mod:`pipeline.world.mapped_heights`, defaults stand in :mod:`pipeline.world.solid_types`. Frame:
the network's x (east), y (north) in metres; heights in metres above the flat ground.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import shapely
from shapely.geometry.base import BaseGeometry

from pipeline.formats.osm import Tags
from pipeline.scenario.models import StaticsModel
from pipeline.world.mapped_heights import Extent, extent_of
from pipeline.world.solid_types import SolidType

BUILDING_M: float = StaticsModel.model_fields["polygon_height_m"].default
"""The top of a building that the map does not say, and that is of no special type."""


@dataclass(frozen=True)
class MappedSolid:
    """An area, line or point of the map, extruded from ``base_m`` to ``height_m``.

    Lines and points reach ``radius_m`` to each side. ``height_source`` is height, levels (tags of the map), type or
    default.
    """

    name: str
    kind: str
    geometry: BaseGeometry
    height_m: float
    height_source: str
    base_m: float = 0.0
    radius_m: float | None = None

    @property
    def area(self) -> BaseGeometry:
        """What it covers, seen from above."""
        return self.geometry.buffer(self.radius_m) if self.radius_m else self.geometry

    def to_geojson(self) -> dict[str, Any]:
        """A GeoJSON feature in world-frame metres."""
        properties = {"name": self.name, "kind": self.kind, "height_m": round(self.height_m, 3)}
        if self.base_m:
            properties["base_m"] = round(self.base_m, 3)
        if self.radius_m is not None:
            properties["radius_m"] = round(self.radius_m, 3)
        properties["height_from"] = self.height_source
        return {"type": "Feature", "properties": properties, "geometry": shapely.geometry.mapping(self.geometry)}


@dataclass
class ImportCounts:
    """What happened to the mapped objects, counted while they are taken in."""

    objects: Counter[str] = field(default_factory=Counter)
    heights: dict[str, Counter[str]] = field(default_factory=dict)
    unreadable: Counter[str] = field(default_factory=Counter)
    repaired: int = 0
    cut: Counter[str] = field(default_factory=Counter)
    dropped: dict[str, Counter[str]] = field(default_factory=dict)
    slivers: int = 0
    raised_crowns: int = 0
    not_modelled: Counter[str] = field(default_factory=Counter)

    def keep(self, solid: MappedSolid) -> None:
        """Count an object that is kept; a tree is counted once, by its trunk."""
        self.objects[solid.kind] += 1
        if solid.kind != "tree_crown":
            kind = solid.kind.removesuffix("_trunk")
            self.heights.setdefault(kind, Counter())[solid.height_source] += 1

    def drop(self, kind: str, why: str) -> None:
        """Count an object that is left out."""
        self.dropped.setdefault(why, Counter())[kind] += 1

    def to_json(self) -> dict[str, Any]:
        """Plain JSON, sorted by key."""
        return {key: _sorted(value) for key, value in vars(self).items()}


def extent_counted(tags: Tags, solid: SolidType, counts: ImportCounts) -> Extent:
    """From where to where a thing stands up; tags that say nothing are counted."""
    extent = extent_of(tags, solid, BUILDING_M)
    counts.unreadable.update(extent.unreadable)
    return extent


def tag_value(tags: Tags, key: str, parse: Callable[[str], float | None], counts: ImportCounts) -> float | None:
    """A tag's value; one that says nothing is counted and treated as absent."""
    if key not in tags:
        return None
    value = parse(tags[key])
    if value is None:
        counts.unreadable[key] += 1
    return value


def _sorted(value: Any) -> Any:
    return {key: _sorted(value[key]) for key in sorted(value)} if isinstance(value, dict) else value
