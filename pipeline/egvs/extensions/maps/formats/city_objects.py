"""City objects as they are in a file: their surfaces at each level of detail, and their heights.

:mod:`egvs.extensions.maps.formats.citygml` and :mod:`egvs.extensions.maps.formats.cityjson` make them. Coordinates are
those of the file, in its order of the axes.

An object has components: itself, its parts and its installations (balconies, chimneys, bridge piers). Each component
is used at its highest level of detail (LOD). There, the surfaces are those of its solid; without a solid, those of its
own multi-surface; without one, those of its boundary surfaces (walls, roofs). A surface that several components share
is used once. Closure surfaces are left out: beams pass through them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from egvs.core.grid import FloatArray

SOLID, SURFACE, BOUNDARY = "solid", "surface", "boundary"
FOOTPRINT, ROOF_EDGE = "footprint", "roof edge"
ROLES = (SOLID, SURFACE, BOUNDARY)
"""Geometries of a component by preference."""

FOOTPRINT_ROLES = (FOOTPRINT, SURFACE, ROOF_EDGE)
"""Geometries of a component at LOD 0 by preference."""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A polygon in space: its outer ring and its holes, (n, 3) float64 each."""

    rings: tuple[FloatArray, ...]

    def reversed(self) -> Surface:
        """Return the surface with its other side out."""
        return Surface(tuple(ring[::-1] for ring in self.rings))


class Reference(NamedTuple):
    """A surface, or a group of surfaces, by its name."""

    name: str
    is_reversed: bool = False


Member = Surface | Reference
Groups = Mapping[str, Sequence[Member]]
"""Surfaces and groups of surfaces by name."""


@dataclass
class Geometry:
    """Surfaces of a component at one level of detail."""

    lod: float
    role: str
    members: list[Member] = field(default_factory=list)


@dataclass
class Placement:
    """A template that is placed at a point (CityGML's implicit geometry).

    Attributes
    ----------
    lod
        Level of detail.
    matrix
        (16,) row by row; from the template's frame to axes parallel to those of the file.
    point
        (3,) where the template's origin is placed, in the file's coordinates; None if missing.
    template
        Name of the template, or its surfaces.
    library
        The file of the template, if it is not in this one.
    """

    lod: float
    matrix: Sequence[float] = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    point: Sequence[float] | None = None
    template: str | list[Surface] = field(default_factory=list)
    library: str = ""


@dataclass
class Component:
    """An object, a part of it, or one of its installations.

    Attributes
    ----------
    geometries, placements
        Its surfaces.
    measured_height_m, storeys
        What the file says about its height; None if unknown.
    """

    geometries: list[Geometry] = field(default_factory=list)
    placements: list[Placement] = field(default_factory=list)
    measured_height_m: float | None = None
    storeys: float | None = None

    @property
    def lod(self) -> float:
        """The highest level of detail with surfaces; -1 without any."""
        lods = [geometry.lod for geometry in self.geometries if geometry.members]
        lods += [placement.lod for placement in self.placements]
        return max(lods, default=-1.0)


@dataclass
class CityObject:
    """A building, bridge, tree or another object.

    Attributes
    ----------
    name
        Its ``gml:id``, else its type and number in the file.
    kind
        Its type in CityGML, e.g. ``SolitaryVegetationObject``.
    srs_name
        Reference system of its coordinates, as the file names it; empty if it names none.
    components
        The object itself, then its parts and installations.
    groups
        Surfaces of this object by name.
    ignored
        Geometries that are neither surfaces nor solids, e.g. points.
    openings
        Closure surfaces, by :func:`id`: they complete a solid where nothing is, e.g. at the entrance of an underpass.
    """

    name: str
    kind: str
    srs_name: str = ""
    components: list[Component] = field(default_factory=lambda: [Component()])
    groups: dict[str, list[Member]] = field(default_factory=dict)
    ignored: int = 0
    openings: set[int] = field(default_factory=set)

    @property
    def lod(self) -> float:
        """The highest level of detail of its components; -1 without any surface."""
        return max(component.lod for component in self.components)

    def measured_height_m(self) -> float | None:
        """Return the largest measured height of its components; None if unknown."""
        heights = [part.measured_height_m for part in self.components if part.measured_height_m is not None]
        return max(heights, default=None)

    def storeys(self) -> float | None:
        """Return the largest number of storeys of its components; None if unknown."""
        return max([part.storeys for part in self.components if part.storeys is not None], default=None)


class Selection(NamedTuple):
    """Surfaces and placements of an object at the highest level of detail, and how many references lead nowhere."""

    surfaces: list[Surface]
    placements: list[Placement]
    unresolved: int


def select_surfaces(city_object: CityObject) -> Selection:
    """Return the surfaces of an object at the highest level of detail of each component, LOD 1 or higher."""
    resolver = _Resolver(city_object)
    placements: list[Placement] = []
    for component in city_object.components:
        lod = component.lod
        if lod < 1:
            continue
        placements += [placement for placement in component.placements if placement.lod == lod]
        for role in ROLES:
            members = _members(component, role, lod)
            unresolved = resolver.unresolved
            resolver.add(members)
            is_complete = resolver.unresolved == unresolved
            if members and is_complete:
                break
    return Selection(list(resolver.surfaces.values()), placements, resolver.unresolved)


def select_footprint(city_object: CityObject) -> list[Surface]:
    """Return the surfaces of an object at LOD 0: its footprint, else the edge of its roof."""
    for role in FOOTPRINT_ROLES:
        resolver = _Resolver(city_object)
        for component in city_object.components:
            resolver.add(_members(component, role, 0.0))
        if resolver.surfaces:
            return list(resolver.surfaces.values())
    return []


def _members(component: Component, role: str, lod: float) -> list[Member]:
    members: list[Member] = []
    for geometry in component.geometries:
        is_level = geometry.lod == lod or (lod < 1 and geometry.lod < 1)
        if is_level and geometry.role == role:
            members += geometry.members
    return members


class _Resolver:
    """Collects surfaces, each once, and follows each reference once."""

    def __init__(self, city_object: CityObject) -> None:
        self._groups: Groups = city_object.groups
        self._openings = city_object.openings
        self._followed: set[str] = set()
        self.surfaces: dict[int, Surface] = {}
        self.unresolved = 0

    def add(self, members: Sequence[Member]) -> None:
        pending = [(member, False) for member in reversed(members)]
        while pending:
            member, is_reversed = pending.pop()
            if isinstance(member, Surface):
                if id(member) in self._openings:
                    continue
                self.surfaces.setdefault(id(member), member.reversed() if is_reversed else member)
            elif member.name not in self._groups:
                self.unresolved += 1
            elif member.name not in self._followed:
                self._followed.add(member.name)
                is_turned = is_reversed != member.is_reversed
                pending += [(inner, is_turned) for inner in reversed(self._groups[member.name])]
