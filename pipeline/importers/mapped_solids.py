"""What the importer takes from a map: solids with heights from tags, and counts of what happened to the mapped objects.

Heights (Simple 3D Buildings, https://wiki.openstreetmap.org/wiki/Simple_3D_Buildings):

    top  = height         or building:levels * 3 m         or the default of the kind (a building: 9 m)

Frame: the network's x (east), y (north) in metres; heights in metres above the flat ground.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import shapely
from shapely.geometry.base import BaseGeometry

from pipeline.formats.osm import Tags, length_m, number

LEVEL_M = 3.0
"""A storey of a building."""


@dataclass(frozen=True)
class MappedSolid:
    """An area, line or point of the map, extruded from ``base_m`` to ``height_m``.

    Lines and points reach ``radius_m`` to each side. ``height_source`` is height, levels (tags of the map) or default.
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


def top_of(tags: Tags, default_m: float, counts: ImportCounts) -> tuple[float, str]:
    """Height of the top in metres, and its source: height, levels or default."""
    if height_m := tag_value(tags, "height", length_above_zero_m, counts):
        return height_m, "height"
    if levels := tag_value(tags, "building:levels", _levels, counts):
        return LEVEL_M * levels, "levels"
    return default_m, "default"


def length_above_zero_m(text: str) -> float | None:
    """A length as OpenStreetMap writes it, in metres; None when it is none, or 0."""
    return length_m(text) or None


def _levels(text: str) -> float | None:
    levels = number(text)
    return levels if levels is not None and 0 < levels < 300 else None


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
