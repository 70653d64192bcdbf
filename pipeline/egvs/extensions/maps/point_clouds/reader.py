"""Read as-built point clouds as the static world: PCD, PLY, LAS, LAZ, E57 and CSV, also gzipped.

Steps of :func:`read_solids`: read the points in chunks; drop those that the file marks as errors and those that are not
finite; convert the others to the world frame; drop those outside the window; thin large scans; drop what moved
(:mod:`egvs.extensions.maps.point_clouds.moving_points`); triangulate the rest
(:mod:`egvs.extensions.maps.point_clouds.surface`).
All drops are counted.

Where the scanner stood is known from the poses of E57 scans and the VIEWPOINT of PCD files. Without it, moving objects
cannot be told from static ones, and the space that no beam crossed from free space.

Heights stay those of the file, converted to metres. A file whose reference system cannot be used is placed by an
alignment, if there is one.
"""

from __future__ import annotations

import math
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import shapely

from egvs.core import files, limits
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.reading import COMPLETE_FILE
from egvs.core.wording import number_of
from egvs.creation.map_parts import (
    GROUND_KIND,
    OBJECT_KIND,
    OUT_OF_RANGE,
    ImportCounts,
    MapContext,
    MappedMesh,
)
from egvs.creation.terrain.ground_heights import HIGHEST_M, LOWEST_M
from egvs.extensions.maps.buildings.mesh_maps import has_faces
from egvs.extensions.maps.point_clouds.as_built_view import AsBuiltMap
from egvs.extensions.maps.point_clouds.moving_points import (
    MIN_SWEEPS,
    StationScan,
    group_by_station,
    not_shared,
    seen_through,
)
from egvs.extensions.maps.point_clouds.surface import CloudSurface, TriangleSurface, thin_points, triangulate_cloud
from egvs.formats import point_clouds, xml
from egvs.formats.georeference import HeightUnit, format_distance, parse_crs
from egvs.scenario.fields import MAX_COORDINATE_M

THIN_CELL_M = 0.075
"""Large scans are thinned to one point in each cube of this size while they are read."""

LARGE_SCAN = 1_000_000
"""Scans with more points in the window are large."""

NOT_FINITE, MARKED, MOVING, THINNED = "not_finite", "marked", "moving", "thinned"
"""Reasons to leave out points, beside ``out_of_range``."""

_SAME_POSITION_M, _SAME_UNIT = 1.0, 1e-4
"""Two reference systems of a file agree up to these; the US survey foot and the foot differ by 2e-6."""

_SUFFIXES = ("csv", "e57", "las", "laz", "pcd", "ply")
_PACKABLE = ("csv", "pcd", "ply")


def can_open(path: Path, head: bytes) -> bool:
    """Return whether a file is a point cloud; a PLY with faces is a mesh."""
    suffix = _suffix(path)
    if suffix == "ply":
        return head.startswith(b"ply") and b"element vertex" in head and not has_faces(head)
    if suffix == "csv":
        names = {
            name.strip(' \t\r"').lower() for name in head.partition(b"\n")[0].decode("utf-8-sig", "replace").split(",")
        }
        return {"x_m", "y_m", "z_m"} <= names and "site" not in names
    return suffix in _SUFFIXES


def read_solids(paths: Sequence[Path], context: MapContext) -> AsBuiltMap:
    """Read point clouds, and return their ground and everything else as two meshes.

    Parameters
    ----------
    paths
        Files of one survey.
    context
        The window, and the world frame.

    Raises
    ------
    InputError
        When a file is damaged, has no points in the window, or when the surface would have too many triangles.
    """
    survey = _Survey()
    for path in paths:
        _read_file(survey, path, context)
    scans = _without_moving_objects(survey)
    points = np.concatenate([scan.points_m for scan in scans])
    surface = triangulate_cloud(points)
    triangles = len(surface.ground.faces) + len(surface.objects.faces)
    where = ", ".join(path.name for path in paths)
    limits.TRIANGLES.check(where, triangles, f"its surface in the window has {triangles:,} triangles")
    survey.counts.objects.update({mesh.kind: 1 for mesh in make_meshes(surface)})
    return AsBuiltMap(
        meshes=make_meshes(surface),
        counts=survey.counts,
        has_absolute_heights=True,
        notes=_notes(survey, surface, len(points)),
        stations_m=np.array([scan.station_m for scan in scans if scan.station_m is not None]).reshape(-1, 3),
    )


@dataclass
class _Scan:
    """Points of a scan in the window; those of a large scan are thinned whenever there are too many.

    Attributes
    ----------
    station_m
        Where the scanner stood, (3,) world frame; None if it is unknown.
    """

    station_m: FloatArray | None
    is_thinned: bool = False
    _parts: list[FloatArray] = field(default_factory=list)
    _count: int = 0
    _thinned_count: int = 0

    def add(self, points_m: FloatArray) -> int:
        """Add points (n, 3), and return how many were merged with others."""
        self._parts.append(points_m)
        self._count += len(points_m)
        if self._count - self._thinned_count < max(LARGE_SCAN, self._thinned_count):
            return 0
        before = self._count
        self._parts = [thin_points(np.concatenate(self._parts), THIN_CELL_M)]
        self._count = self._thinned_count = len(self._parts[0])
        self.is_thinned = True
        return before - self._count

    @property
    def points_m(self) -> FloatArray:
        """(n, 3) float64."""
        self._parts = [np.concatenate([np.empty((0, 3)), *self._parts])]
        return self._parts[0]


@dataclass
class _Survey:
    """All scans, and what happened to their points."""

    scans: list[_Scan] = field(default_factory=list)
    counts: ImportCounts = field(default_factory=ImportCounts)
    points_read: int = 0
    kept: int = 0
    marked: Counter[str] = field(default_factory=Counter)
    units: dict[str, None] = field(default_factory=dict)

    def drop(self, reason: str, points: int) -> None:
        if points:
            self.counts.dropped.setdefault(reason, Counter())["point"] += points

    def dropped(self, reason: str) -> int:
        return self.counts.dropped.get(reason, Counter())["point"]


def _read_file(survey: _Survey, path: Path, context: MapContext) -> None:
    """Add the scans of a file to a survey."""
    kept_before = survey.kept
    points_before = survey.points_read
    with _unpacked(path) as plain:
        where = str(path)
        crs: str | None = None
        scans: dict[int, _Scan] = {}
        nearest_m = np.inf
        for number, chunk in enumerate(point_clouds.stream_points(plain, where)):
            if number == 0:
                crs = context.usable_crs(partial(point_clouds.point_cloud_crs, plain, where), where)
                survey.units.setdefault(_unit_note(context.height_unit(crs, where)))
                other = point_clouds.other_point_cloud_crs(plain, where)
                if crs is not None and other is not None:
                    survey.units.update(dict.fromkeys(_disagreement(chunk.points_m, crs, other, context, where)))
            if chunk.scan not in scans:
                scans[chunk.scan] = _Scan(_station(chunk.station_m, crs, context, where))
            survey.points_read += len(chunk.points_m)
            survey.marked.update(chunk.marked)
            finite = chunk.points_m[np.isfinite(chunk.points_m).all(axis=1)]
            survey.drop(MARKED, sum(chunk.marked.values()))
            survey.drop(NOT_FINITE, len(chunk.points_m) - len(finite) - sum(chunk.marked.values()))
            points_m = _to_world(finite, crs, context, where)
            nearest_m = min(nearest_m, _distance_m(points_m, context))
            inside = _in_window(points_m, context)
            survey.drop(OUT_OF_RANGE, len(finite) - len(inside))
            merged = scans[chunk.scan].add(inside)
            survey.drop(THINNED, merged)
            survey.kept += len(inside) - merged
            limits.POINTS.check(where, survey.kept, f"has {survey.kept:,} points in the window")
    if survey.kept == kept_before:
        problem = (
            f"none of its {number_of(survey.points_read - points_before, 'point')} is in the window around the roads"
            f" ({format_distance(nearest_m)} from it)"
        )
        raise InputError(where, problem, "Check its coordinate reference system, or its --align.")
    survey.scans += scans.values()


def _disagreement(points: FloatArray, crs: str, other: str, context: MapContext, where: str) -> Iterator[str]:
    """Yield a sentence where the second reference system of a file gives other positions or another unit of heights."""
    finite = points[np.isfinite(points).all(axis=1)][:1]
    used, not_used = (parse_crs(text, where).name for text in (crs, other))
    units = [context.height_unit(text, where) for text in (crs, other)]
    differences = []
    if len(finite):
        used_m, other_m = (context.to_world(finite[:, :2], text, where)[0] for text in (crs, other))
        distance_m = math.dist(used_m, other_m)
        if distance_m > _SAME_POSITION_M:
            differences.append(f"positions {format_distance(distance_m)} away")
    if not math.isclose(units[0].metres, units[1].metres, rel_tol=_SAME_UNIT):
        differences.append(f"heights in the unit {units[1].name} instead of {units[0].name}")
    if differences:
        yield (
            f"{where} declares two reference systems that disagree: {used} is used, as its header says; {not_used}"
            f" would give {' and '.join(differences)}."
        )


def _unit_note(unit: HeightUnit) -> str:
    name = "metres" if unit.metres == 1.0 else f"{unit.name.replace('foot', 'feet')} and converted to metres"
    return f"Heights in the file are in {name} ({unit.source})."


def _suffix(path: Path) -> str:
    """Return the suffix that tells the format, without the dot and a ``.gz``."""
    suffixes = [suffix.lower().removeprefix(".") for suffix in path.suffixes[-2:]]
    if len(suffixes) == 2 and suffixes[1] == "gz" and suffixes[0] in _PACKABLE:
        return suffixes[0]
    return suffixes[-1] if suffixes else ""


@contextmanager
def _unpacked(path: Path) -> Iterator[Path]:
    """Yield a file that is not gzipped, with the same content."""
    if path.suffix.lower() != ".gz":
        yield path
        return
    with files.temporary_folder() as folder:
        plain = folder / path.stem
        with xml.open_bounded(path) as source, plain.open("wb") as target:
            shutil.copyfileobj(source, target, 1 << 20)
        yield plain


def _to_world(points: FloatArray, crs: str | None, context: MapContext, where: str) -> FloatArray:
    """Return points (n, 3) of a file in the world frame, z in metres in its own vertical system."""
    if not len(points):
        return points
    farthest = float(np.abs(points).max())
    if farthest > MAX_COORDINATE_M:
        problem = f"expected coordinates of at most {MAX_COORDINATE_M:g}, got {farthest:g}"
        raise InputError(where, problem, COMPLETE_FILE)
    unit_m = context.height_unit(crs, where).metres
    return np.column_stack([context.to_world(points[:, :2], crs, where), points[:, 2] * unit_m])


def _station(station: FloatArray | None, crs: str | None, context: MapContext, where: str) -> FloatArray | None:
    if station is None or not np.isfinite(station).all():
        return None
    station_m: FloatArray = _to_world(station[None, :], crs, context, where)[0]
    return station_m


def _distance_m(points_m: FloatArray, context: MapContext) -> float:
    """Return the distance from the window to the rectangle around points (n, 3); inf without points."""
    if not len(points_m):
        return np.inf
    around = shapely.box(*points_m[:, :2].min(axis=0), *points_m[:, :2].max(axis=0))
    return float(context.window.distance(around))


def _in_window(points_m: FloatArray, context: MapContext) -> FloatArray:
    """Return the points (n, 3) whose x, y is in the window, and whose z can be a height."""
    x0, y0, x1, y1 = context.window.bounds
    x, y, z = points_m.T
    near = points_m[(x >= x0) & (x <= x1) & (y >= y0) & (y <= y1) & (z >= LOWEST_M) & (z <= HIGHEST_M)]
    shapely.prepare(context.window)
    inside: FloatArray = near[shapely.intersects_xy(context.window, near[:, 0], near[:, 1])]
    return inside


def _without_moving_objects(survey: _Survey) -> list[_Scan]:
    """Return the scans without what moved: one for each station, and those whose station is unknown."""
    unplaced = [scan for scan in survey.scans if scan.station_m is None]
    placed = [scan for scan in survey.scans if scan.station_m is not None]
    sweeps = [StationScan(scan.station_m, scan.points_m) for scan in placed if scan.station_m is not None]
    views = []
    for group in group_by_station(sweeps):
        parts = [sweeps[number] for number in group]
        if len(group) >= MIN_SWEEPS and not any(placed[number].is_thinned for number in group):
            moving = not_shared(parts)
            survey.drop(MOVING, sum(int(mask.sum()) for mask in moving))
            parts = [StationScan(p.station_m, p.points_m[~mask]) for p, mask in zip(parts, moving, strict=True)]
        views.append(StationScan(parts[0].station_m, np.concatenate([part.points_m for part in parts])))
    if len(views) > 1:
        moving = seen_through(views)
        survey.drop(MOVING, sum(int(mask.sum()) for mask in moving))
        views = [StationScan(v.station_m, v.points_m[~mask]) for v, mask in zip(views, moving, strict=True)]
    return [_Scan(view.station_m, _parts=[view.points_m]) for view in views] + unplaced


def make_meshes(surface: CloudSurface) -> tuple[MappedMesh, ...]:
    """Return the meshes that have triangles."""
    named = ((GROUND_KIND, surface.ground), (OBJECT_KIND, surface.objects))
    return tuple(_mesh(kind, triangles) for kind, triangles in named if len(triangles.faces))


def _mesh(kind: str, triangles: TriangleSurface) -> MappedMesh:
    return MappedMesh(f"point_cloud_{kind}", kind, triangles.vertices_m, triangles.faces, is_closed=False)


def _notes(survey: _Survey, surface: CloudSurface, points: int) -> tuple[str, ...]:
    """Return sentences about the points, the stations and what follows from them."""
    marked = "".join(f" {count:,} marked as {mark}," for mark, count in sorted(survey.marked.items()))
    read = (
        f"{survey.points_read:,} points read from {number_of(len(survey.scans), 'scan')}:"
        f" {survey.dropped(OUT_OF_RANGE):,} outside the window, {survey.dropped(NOT_FINITE):,} not finite,{marked}"
        f" {survey.dropped(MOVING):,} on moving objects,"
        f" {survey.dropped(THINNED):,} merged with neighbours within {THIN_CELL_M:g} m; {points:,} are used"
        f" ({surface.ground_points:,} on the ground)."
    )
    made = (
        f"The as-built surface has {len(surface.ground.faces):,} triangles of ground and"
        f" {len(surface.objects.faces):,} of everything else, all open: no site can be inside of an object."
    )
    return (read, made, _station_note(survey), *survey.units)


def _station_note(survey: _Survey) -> str:
    placed = [StationScan(scan.station_m, scan.points_m) for scan in survey.scans if scan.station_m is not None]
    stations = len(group_by_station(placed))
    if len(placed) < len(survey.scans):
        share = f" for {len(survey.scans) - len(placed)} of {number_of(len(survey.scans), 'scan')}" if placed else ""
        unknown = (
            f"Where the scanner stood is unknown{share}: what moved there is part of the world. E57 scans and"
            " PCD files with a VIEWPOINT state it."
        )
        if len(survey.scans) > 1:
            return unknown
        return f"{unknown} If it is from one place, this is a world for that place only."
    if stations == 1:
        return (
            "All scans are from one place. What is hidden from there is missing, so this is a world for sensors at that"
            " place only: add scans from other places, or see the unseen share of each site."
        )
    removal = "" if survey.dropped(MOVING) else " Nothing moved between them."
    return f"The scans are from {stations} places.{removal}"
