"""What the readers of map files return: roads, solids and terrain, all in one world frame.

A reader is a module with one or more of ``read_roads`` (or ``open_roads``), ``read_solids`` and ``read_terrain``. It is
in the table of readers (:mod:`egvs.core.readers`), which says what it gives.

The world frame is that of the network: x east, y north in metres (see :mod:`egvs.formats.georeference`). Roads are read
first; the ``<location>`` of their network states the frame. The other readers convert their coordinates with
:meth:`MapContext.to_world`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from egvs.core.errors import InputError
from egvs.core.grid import XY, FloatArray, IntArray, Roi
from egvs.creation import driving_side
from egvs.creation.junctions import Streets
from egvs.formats.georeference import HeightUnit, WorldFrame, height_unit, parse_crs
from egvs.scenario.fields import MAX_COORDINATE_M
from egvs.scenario.model import StaticsConfig

DEFAULT_BUILDING_M: float = StaticsConfig.model_fields["polygon_height_m"].default
"""Height of a building without a height in the map, and of no special type."""

DECK_BASE_M = 5.0
"""Height of the underside of a bridge without a height in the map: above lorries."""

OUT_OF_RANGE = "out_of_range"
"""The reason to leave out objects outside the window of a map."""

ALIGN_HINT = "Give two of its points and where they are: --align X,Y=LAT,LON --align X,Y=LAT,LON."
"""How to place a file without a reference system."""

GROUND_KIND, OBJECT_KIND = "ground", "as_built"
"""Kinds of the meshes of a point cloud: its ground, and all else."""


@dataclass(frozen=True)
class MappedSolid:
    """An area, line or point of the map, extruded from ``base_m`` to ``height_m``.

    Attributes
    ----------
    name
        Unique, e.g. ``"way/12"``.
    kind
        ``building``, ``roof``, ``barrier``, ``bridge``, ``pole``, ``tree_trunk`` or ``tree_crown``.
    geometry
        World frame, metres.
    height_m, base_m
        Top and bottom above the ground.
    height_source
        Where the height comes from: ``height`` or ``levels`` (tags of the map), ``type`` or ``default``.
    radius_m
        Half the width of a line, radius of a point; None for an area.
    assumed_radius
        Whether the radius of a tree crown is assumed.
    """

    name: str
    kind: str
    geometry: BaseGeometry
    height_m: float
    height_source: str
    base_m: float = 0.0
    radius_m: float | None = None
    assumed_radius: bool = False

    @property
    def area(self) -> BaseGeometry:
        """The area covered, seen from above."""
        return self.geometry.buffer(self.radius_m) if self.radius_m else self.geometry

    def to_geojson(self) -> dict[str, Any]:
        """Return a GeoJSON feature in world-frame metres."""
        properties = {"name": self.name, "kind": self.kind, "height_m": round(self.height_m, 3)}
        if self.base_m:
            properties["base_m"] = round(self.base_m, 3)
        if self.radius_m is not None:
            properties["radius_m"] = round(self.radius_m, 3)
        properties["height_from"] = self.height_source
        return {"type": "Feature", "properties": properties, "geometry": shapely.geometry.mapping(self.geometry)}


@dataclass(frozen=True)
class MappedPole:
    """A pole that exists and may carry a sensor.

    Attributes
    ----------
    name
        As of the :class:`MappedSolid`.
    kind
        ``lamp``, ``signal`` or ``pole``.
    at_m
        x, y in the world frame, as mapped.
    """

    name: str
    kind: str
    at_m: XY


@dataclass
class ImportCounts:
    """Counts of what happened to the mapped objects."""

    objects: Counter[str] = field(default_factory=Counter)
    heights: dict[str, Counter[str]] = field(default_factory=dict)
    unreadable: Counter[str] = field(default_factory=Counter)
    repaired: int = 0
    cut: Counter[str] = field(default_factory=Counter)
    dropped: dict[str, Counter[str]] = field(default_factory=dict)
    slivers: int = 0
    raised_crowns: int = 0
    assumed_crowns: int = 0
    not_modelled: Counter[str] = field(default_factory=Counter)

    def keep(self, solid: MappedSolid) -> None:
        """Count an object that is used; a tree is counted once, by its trunk."""
        self.objects[solid.kind] += 1
        self.assumed_crowns += solid.assumed_radius
        if solid.kind != "tree_crown":
            kind = solid.kind.removesuffix("_trunk")
            self.heights.setdefault(kind, Counter())[solid.height_source] += 1

    def remove(self, solid: MappedSolid) -> None:
        """Take back what :meth:`keep` counted."""
        self.objects -= Counter({solid.kind: 1})
        self.assumed_crowns -= solid.assumed_radius
        if solid.kind != "tree_crown":
            self.heights[solid.kind.removesuffix("_trunk")] -= Counter({solid.height_source: 1})

    def drop(self, kind: str, reason: str) -> None:
        """Count an object that is left out."""
        self.dropped.setdefault(reason, Counter())[kind] += 1

    def plus(self, other: ImportCounts) -> ImportCounts:
        """Return the sums of two maps."""
        return ImportCounts(**{key: _add_counts(value, vars(other)[key]) for key, value in vars(self).items()})

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON, sorted by key."""
        return {key: _sort_keys(value) for key, value in vars(self).items()}


def _add_counts(one: Any, other: Any) -> Any:
    """Return the sum of two numbers, counters, or dictionaries of counters."""
    if isinstance(one, Counter) or not isinstance(one, dict):
        return one + other
    return {key: one.get(key, Counter()) + other.get(key, Counter()) for key in {**one, **other}}


def _sort_keys(value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    return {key: _sort_keys(value[key]) for key in sorted(value)}


@dataclass(frozen=True)
class RoadMap:
    """A SUMO network made from a road map.

    Attributes
    ----------
    network
        The text of a ``.net.xml`` without dates and paths. Its ``<location>`` states the projection, unless the map
        has none.
    attribution
        Who made the map, and its licence; empty if unknown.
    notes
        Sentences for the user: what was assumed, left out or is wrong in the map.
    has_heights
        Whether the z of its lanes comes from the map.
    keeps_heights
        Whether its heights are used as they are: z = 0 is that of the network, not the ground at the junction.
    """

    network: str
    attribution: str = ""
    notes: tuple[str, ...] = ()
    has_heights: bool = False
    keeps_heights: bool = False


@dataclass(frozen=True)
class RoadOptions:
    """Options for reading roads.

    Attributes
    ----------
    lefthand, righthand
        Whether the user says that traffic drives on the left, or on the right; if neither, the map and its position
        decide.
    walk
        Whether the network gets sidewalks and crossings.
    has_terrain
        Whether the roads will be laid on a terrain: heights of OpenStreetMap are not needed then, but its bridges and
        tunnels stay edges of their own.
    at
        Latitude, longitude in degrees of the requested junction, or x, y in metres if the map has no reference system;
        None if any will do. A reader may reject a position outside its map.
    surroundings_m
        Distance from the junction at which streets will end; None if the reader decides, inf for the complete map.
        With ``at``, a reader may leave out what is farther away.
    """

    lefthand: bool = False
    walk: bool = False
    has_terrain: bool = False
    at: tuple[float, float] | None = None
    righthand: bool = False
    surroundings_m: float | None = None

    @property
    def requested_left(self) -> bool | None:
        """Whether left-hand traffic was requested; None if nothing was."""
        return driving_side.requested_left(lefthand=self.lefthand, righthand=self.righthand)


@dataclass(frozen=True)
class MappedMesh:
    """A triangle mesh of one object, e.g. a building with its roof.

    Attributes
    ----------
    name
        Unique in its file, e.g. a ``gml:id``.
    kind
        ``building``, ``bridge``, ``furniture``, ``vegetation``, ``ground`` or another name.
    vertices_m
        (n, 3) float64: world-frame x, y; z in the file's heights.
    faces
        (m, 3) int64.
    is_closed
        Whether the triangles enclose a volume.
    group
        Meshes of one group, such as the parts of a file, keep their heights to each other on a sloping ground.
        By default each mesh is a group of its own.
    """

    name: str
    kind: str
    vertices_m: FloatArray
    faces: IntArray
    is_closed: bool
    group: str = ""


@dataclass(frozen=True)
class SolidMap:
    """Static objects of one map.

    Attributes
    ----------
    solids
        Footprints with heights above the ground.
    meshes
        Meshes, whose z is a height in the file's vertical system if ``has_absolute_heights``, else above the ground.
    counts
        What happened to the objects of the map.
    has_absolute_heights
        Whether the heights of the meshes count from sea level.
    notes
        Sentences for the user.
    attribution
        Who made the map, and its licence; empty if unknown.
    is_base
        Whether it is a map of everything: its buildings give way to those of other maps, and its objects are clear of
        the carriageway already.
    poles
        Poles that may carry a sensor, also those on the carriageway.
    """

    solids: tuple[MappedSolid, ...] = ()
    meshes: tuple[MappedMesh, ...] = ()
    counts: ImportCounts = field(default_factory=ImportCounts)
    has_absolute_heights: bool = False
    notes: tuple[str, ...] = ()
    attribution: str = ""
    is_base: bool = False
    poles: tuple[MappedPole, ...] = ()

    def unseen_shares(self, sensors_m: FloatArray, roi: Roi) -> FloatArray | None:
        """Return the share of each sensor's view that no survey saw, (n,); None if the map is no survey.

        Parameters
        ----------
        sensors_m
            Sensors, (n, 3), in the frame of the meshes.
        roi
            The region of interest, in the same frame.
        """
        del sensors_m, roi
        return None


class Terrain(Protocol):
    """Heights of the ground."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user."""

    def height_m(self, xy_m: FloatArray) -> FloatArray:
        """Return the heights (n,) of the ground at world-frame points (n, 2), in metres; NaN where unknown."""


@dataclass(frozen=True)
class Alignment:
    """Two points of files without a reference system, and where they are in the world frame.

    A rotation and a translation take the middle of the first pair to that of the second; lengths are kept, but for the
    unit.

    Attributes
    ----------
    local, world_m
        (2, 2) float64: x, y in the file, in its unit, and in the world frame, in metres.
    unit_m
        The unit of the file in metres, also of its heights.
    """

    local: FloatArray
    world_m: FloatArray
    unit_m: float = 1.0

    def to_world(self, xy: FloatArray) -> FloatArray:
        """Return world-frame x, y (n, 2) of x, y (n, 2) in the file."""
        rotation = self.unit_m * self._rotation
        moved: FloatArray = (xy - self.local.mean(axis=0)) @ rotation.T + self.world_m.mean(axis=0)
        return moved

    def from_world(self, xy_m: FloatArray) -> FloatArray:
        """Return x, y (n, 2) in the file of world-frame x, y (n, 2); the inverse of :meth:`to_world`."""
        turned = (xy_m - self.world_m.mean(axis=0)) @ self._rotation / self.unit_m
        moved: FloatArray = turned + self.local.mean(axis=0)
        return moved

    @property
    def scale(self) -> float:
        """Distance of the points in the world, divided by that in the file; 1 if both are metres."""
        local, world_m = np.diff(self.local, axis=0)[0], np.diff(self.world_m, axis=0)[0]
        return float(np.hypot(*world_m) / np.hypot(*local))

    @property
    def _rotation(self) -> FloatArray:
        (x0, y0), (x1, y1) = np.diff(self.local, axis=0)[0], np.diff(self.world_m, axis=0)[0]
        angle = np.arctan2(y1, x1) - np.arctan2(y0, x0)
        return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@dataclass(frozen=True)
class MapContext:
    """Where the region is, for readers of solids and terrain.

    Attributes
    ----------
    frame
        The world frame of the network; None if the road map has no reference system.
    window
        World frame, metres: what sensors can reach. Objects outside it are left out, with a count.
    alignment
        From ``--align``; used for files without a reference system.
    streets
        The roads, for objects that are cut at the carriageway.
    aligned
        Files that the alignment placed; filled while files are read.
    """

    frame: WorldFrame | None
    window: BaseGeometry
    alignment: Alignment | None = None
    streets: Streets | None = None
    aligned: set[str] = field(default_factory=set)

    def to_world(self, xy: FloatArray, crs: str | None, where: str) -> FloatArray:
        """Convert coordinates of a file to world-frame x, y in metres.

        Parameters
        ----------
        xy
            (n, 2), in the order x (easting, longitude), y (northing, latitude).
        crs
            The reference system that the file declares, in a form that PROJ knows; None if it declares none.
        where
            The file, for messages.

        Returns
        -------
        ndarray of float64
            (n, 2). The heights of points do not change.

        Raises
        ------
        InputError
            When there is neither a system nor an alignment, when the network has no reference system, or where the
            projection is undefined or the result is not on the Earth.
        """
        frame = self._frame_or_alignment(crs, where)
        xy_m = frame.to_world(xy) if isinstance(frame, Alignment) else frame.from_crs(xy, str(crs))
        undefined = np.flatnonzero(~(np.abs(xy_m) <= MAX_COORDINATE_M).all(axis=1))
        if len(undefined):
            point = xy[undefined[0]]
            problem = f"({point[0]:.10g}, {point[1]:.10g}) cannot be converted from {crs or 'local metres'}"
            raise InputError(where, problem, "Check the file's coordinates and its reference system.")
        return xy_m

    def from_world(self, xy_m: FloatArray, crs: str | None, where: str) -> FloatArray:
        """Convert world-frame x, y (n, 2) to the coordinates of a file; the inverse of :meth:`to_world`.

        Not finite where the projection is undefined; InputError as there.
        """
        frame = self._frame_or_alignment(crs, where)
        return frame.from_world(xy_m) if isinstance(frame, Alignment) else frame.to_crs(xy_m, str(crs))

    def usable_crs(self, read: Callable[[], str | None], where: str) -> str | None:
        """Return the reference system that a file declares; None where only the alignment can place the file.

        Parameters
        ----------
        read
            Returns what the file declares; it may raise an InputError.
        where
            The file, for messages.

        Raises
        ------
        InputError
            When the declaration is damaged or PROJ cannot use the system, and there is no alignment.
        """
        try:
            crs = read()
            if crs is not None:
                parse_crs(crs, where)
        except InputError as error:
            if self.alignment is None:
                raise InputError(error.where, error.problem, f"{error.hint} Or: {ALIGN_HINT}") from None
            return None
        return crs

    def height_unit(self, crs: str | None, where: str) -> HeightUnit:
        """Return the unit of the heights of a file; that of the alignment for files without a reference system."""
        frame = self._frame_or_alignment(crs, where)
        if isinstance(frame, Alignment):
            name = "metre" if frame.unit_m == 1.0 else "foot"
            return HeightUnit(frame.unit_m, name, "from the distance of the points of --align")
        return height_unit(crs, where)

    def _frame_or_alignment(self, crs: str | None, where: str) -> WorldFrame | Alignment:
        """Return what converts coordinates of a system; the alignment for files without one."""
        if crs is None or parse_crs(crs, where).is_engineering:
            if self.alignment is None:
                raise InputError(where, "the file declares no coordinate reference system", ALIGN_HINT)
            self.aligned.add(where)
            return self.alignment
        if self.frame is None:
            problem = f"the file is in {crs}, but the road map has no reference system"
            raise InputError(where, problem, "Use a road map with a reference system.")
        return self.frame


@runtime_checkable
class RoadReader(Protocol):
    """A module that reads roads.

    One whose roads can be divided by level, or cut better than any network, has ``open_roads(path, options)`` instead,
    which returns a :class:`~egvs.creation.road_source.RoadSource`.
    """

    def read_roads(self, path: Path, options: RoadOptions) -> RoadMap:
        """Return the network of a road map; InputError when it is damaged."""


@runtime_checkable
class SolidReader(Protocol):
    """A module that reads static objects. Files of one format are read together: objects may be cut at borders."""

    def read_solids(self, paths: Sequence[Path], context: MapContext) -> SolidMap:
        """Return the objects in the window; InputError when a file is damaged."""


@runtime_checkable
class TerrainReader(Protocol):
    """A module that reads ground heights."""

    def read_terrain(self, paths: Sequence[Path], context: MapContext) -> Terrain:
        """Return the ground in the window; InputError when a file is damaged."""
