"""Empty scans: scans of the static world, without traffic, from any pose.

Steps for a pose: reject it where no sensor can stand (in a solid, below the ground, out of range of the region of
interest); compute the directions of the sensor's beams, and their weights if it has dwell times; expand them into
weighted sub-beams, where effects do so; cast them; cut them at porous surfaces. A site with a measured scan uses that
scan instead. A scan leaves out the pole, mast or sign that carries its sensor (:mod:`egvs.world.supports`), and no
other scan does.

A measured scan holds returns only. Beams that met nothing are missing from it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.core.arguments import check_instance
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, Roi, Vec3
from egvs.core.wording import number_of
from egvs.formats import point_clouds
from egvs.formats.georeference import height_unit_m
from egvs.kernels import ray_triangle
from egvs.scenario.fields import MAX_COORDINATE_M
from egvs.sensors import site_feasibility
from egvs.sensors.beam_hooks import BeamCutter, BeamExpander, checked_sub_beams
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Pose, ScannedSite, Site
from egvs.world import geolocation
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster, EmptyScan
from egvs.world.supports import without_solids

_BEAMS_PER_CHUNK = 4096
"""Beams that are expanded at once, which bounds the memory."""

_CACHED_WORLDS = 4
"""Worlds without the supports of a sensor that are cached: the heights at one pole follow one another."""

_CACHED_MOUNTS = 32
"""Mounts whose beam directions are cached (1.4 MB each for 57,600 beams)."""


@dataclass(frozen=True)
class Scan:
    """An empty scan.

    Attributes
    ----------
    pose, sensor
        Pose and sensor of the scan.
    beams
        Beams of the sensor; points of a measured scan.
    rows
        The beams that can meet the region of interest: their ends, and weights where effects or dwell times set them.
    """

    pose: Pose
    sensor: Sensor
    beams: int
    rows: EmptyScan

    @property
    def beams_in_roi(self) -> int:
        """Number of distinct beams that can meet the region of interest."""
        return _count_distinct(self.rows.beam)

    @property
    def returns(self) -> int:
        """Number of distinct beams that met something."""
        return _count_distinct(self.rows.beam[self.rows.returned])

    def __repr__(self) -> str:
        position = ", ".join(f"{value:g}" for value in self.pose.position_m)
        angles = ", ".join(f"{value:g}" for value in self.pose.angles_deg)
        return (
            f"Scan({self.sensor.name} at x, y, z = {position} m; yaw, pitch, roll = {angles} deg; "
            f"{self.beams_in_roi:,} of {self.beams:,} beams towards the region, {self.returns:,} returns)"
        )

    def as_site(self, name: str, pole: str = "") -> ScannedSite:
        """Return the record of the scan for artefacts; ``pole`` defaults to the name of the site."""
        counts = self.beams, self.beams_in_roi, self.returns
        return ScannedSite(name, pole or name, self.pose, self.sensor.name, *counts)


class Scanner:
    """Takes scans of one scene from any pose. Threads may share one; it is pickled as its scene.

    Parameters
    ----------
    scene
        The scene to scan.
    full_sweep
        Cast all beams of a sensor, also those that cannot meet the region of interest, and record the face that each
        ends on.
    mounts
        Number of mounts whose beam directions are cached: many sites share theirs, dragged poses do not.
    """

    def __init__(self, scene: Scene, *, full_sweep: bool = False, mounts: int = _CACHED_MOUNTS) -> None:
        check_instance("scene", scene, Scene, "egvs.build_scene(scenario)")
        self.scene = scene
        self.full_sweep = full_sweep
        self._mounts = mounts
        self._expanders = [effect for effect in scene.effects if isinstance(effect, BeamExpander)]
        cutters = [effect for effect in scene.effects if isinstance(effect, BeamCutter)]
        self._opaque = scene.world
        for effect in cutters:
            self._opaque = effect.opaque(self._opaque)
        roi = _bounding_roi(scene) if full_sweep else scene.roi
        self._cuts = [effect.cutter(scene.world, roi) for effect in cutters]
        self._site_positions = frozenset(_sensor_positions(scene))
        self._casters: dict[bool, Caster] = {}
        self._casters_without: dict[tuple[bool, tuple[int, ...]], Caster] = {}
        self._directions: dict[tuple[Sensor, Vec3], FloatArray] = {}
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(Scanner, full_sweep=self.full_sweep, mounts=self._mounts), (self.scene,)

    @property
    def opaque_world(self) -> World:
        """The world that beams are cast at, without the surfaces that effects let beams through.

        The faces of a full sweep refer to it.
        """
        return self._opaque

    @property
    def columns(self) -> tuple[str, ...]:
        """The optional columns of ``scans.parquet`` that these scans fill."""
        return ("weight",) if self.scene.weights_beams else ()

    def scan(self, pose: Pose, sensor: Sensor) -> Scan:
        """Return the empty scan of a sensor at a pose.

        Raises
        ------
        InputError
            Where no sensor can stand, naming the coordinates; if the sensor is a name.
        """
        check_instance("pose", pose, Pose, "egvs.Pose(x_m=..., y_m=..., z_m=...)")
        check_instance("sensor", sensor, Sensor, f"scene.sensor({sensor!r})")
        return self._cast(pose, sensor, f"pose ({pose.x_m:g}, {pose.y_m:g}, {pose.z_m:g})")

    def scan_site(self, site: Site) -> Scan:
        """Return the empty scan of a candidate site, simulated or measured; an InputError names the site."""
        sensor = self.scene.sensor(site.sensor, f"site {site.name}")
        if site.points is None:
            return self._cast(site.pose, sensor, f"site {site.name}")
        site_feasibility.check_pose(self.scene, site.pose, sensor, f"site {site.name}")
        return self._measured_scan(site, sensor)

    def read_measured(self, site: Site) -> FloatArray:
        """Return the points of the measured scan of a site, (n, 3) in the world frame; an InputError names the site."""
        assert site.points is not None, "the site has a measured scan"
        where = f"site {site.name}: points"
        return self._read_points(self.scene.scenario.find(site.points, where), where)

    def sweep_from(self, pose: Pose, directions: FloatArray, range_m: float) -> EmptyScan:
        """Cast beams in any directions along the world axes, (n, 3), from a pose, and return the faces that they hit.

        The solids that carry the sensor at the pose are left out. Effects that split or cut beams do not act.
        """
        caster = self._caster(False, self.scene.own_supports(pose))
        return caster.sweep(pose.position_m, directions, range_m)

    def check(self, sites: Iterable[Site]) -> None:
        """Raise one InputError that names every site where its sensor cannot stand; nothing is cast."""
        errors = []
        for site in sites:
            try:
                sensor = self.scene.sensor(site.sensor, f"site {site.name}")
                site_feasibility.check_pose(self.scene, site.pose, sensor, f"site {site.name}")
            except InputError as error:
                errors.append(error)
        if errors:
            first, *more = errors
            raise InputError(first.where, first.problem, "\n".join([first.hint, *map(str, more)]))

    def _cast(self, pose: Pose, sensor: Sensor, where: str) -> Scan:
        site_feasibility.check_pose(self.scene, pose, sensor, where)
        is_site_position = (pose.position_m, sensor) in self._site_positions
        caster = self._caster(is_site_position and not self.full_sweep, self.scene.own_supports(pose))
        cast = caster.sweep if self.full_sweep else caster.scan
        directions = self._beam_directions(sensor, pose)
        if self._expanders or sensor.beam_weight is not None:
            chunks = []
            for start in range(0, len(directions), _BEAMS_PER_CHUNK):
                chunk = directions[start : start + _BEAMS_PER_CHUNK]
                chunks.append(self._cast_expanded(cast, pose, sensor, start, chunk))
            rows = _concatenate_scans(chunks)
        else:
            rows = cast(pose.position_m, directions, sensor.range_m)
        for cut in self._cuts:
            rows = cut(rows, pose)
        if rows.weight is None and self.scene.weights_beams:  # another sensor of the scenario has dwell times
            rows = replace(rows, weight=np.ones(len(rows.beam)))
        return Scan(pose, sensor, sensor.beams, rows)

    def _caster(self, at_sites: bool, supports: tuple[int, ...]) -> Caster:
        """The caster for beams from the scene's sites, or from anywhere, made at its first use.

        Both give the same hits. The first holds fewer triangles. It leaves out the ``supports`` of a sensor.
        """
        with self._lock:
            if not supports:
                if at_sites not in self._casters:
                    self._casters[at_sites] = self._make_caster(at_sites, self._opaque)
                return self._casters[at_sites]
            key = at_sites, supports
            if key not in self._casters_without:
                while len(self._casters_without) >= _CACHED_WORLDS:
                    del self._casters_without[next(iter(self._casters_without))]
                self._casters_without[key] = self._make_caster(at_sites, without_solids(self._opaque, supports))
            return self._casters_without[key]

    def _make_caster(self, at_sites: bool, world: World) -> Caster:
        starts_m = None
        range_m = float("inf")
        if at_sites:
            starts_m = np.array([position_m for position_m, _ in self._site_positions])
            range_m = max(sensor.range_m for _, sensor in self._site_positions)
        return Caster(world, self.scene.roi, starts_m, range_m)

    def _cast_expanded(
        self, cast: Callable[..., EmptyScan], pose: Pose, sensor: Sensor, start: int, directions: FloatArray
    ) -> EmptyScan:
        """Cast the sub-beams of some beams; ``start`` is the number of the first beam."""
        beam = np.arange(start, start + len(directions))
        weight = np.ones(len(directions))
        if sensor.beam_weight is not None:
            weight = sensor.beam_weight[start : start + len(directions)]
        for effect in self._expanders:
            sub_beams = checked_sub_beams(effect, effect.expand(directions, sensor, pose), len(directions))
            directions, parent, share = sub_beams
            beam = beam[parent]
            weight = weight[parent] * share
        scan = cast(pose.position_m, directions, sensor.range_m)
        return replace(scan, beam=beam[scan.beam].astype(np.uint32), weight=weight[scan.beam])

    def _beam_directions(self, sensor: Sensor, pose: Pose) -> FloatArray:
        """Beam directions along the world axes; those of the last few mounts are cached."""
        mount = (sensor, pose.angles_deg)
        with self._lock:
            if mount not in self._directions:
                while len(self._directions) >= self._mounts:
                    del self._directions[next(iter(self._directions))]
                self._directions[mount] = sensor.directions(*pose.angles_deg)
            return self._directions[mount]

    def _measured_scan(self, site: Site, sensor: Sensor) -> Scan:
        """The returns of a measured scan that lie on beams that can meet the region of interest."""
        points = self.read_measured(site)
        position_m = np.asarray(site.pose.position_m)
        ends = points - position_m
        range_m = np.sqrt((ends**2).sum(axis=1))
        directions = ends / np.maximum(range_m, np.finfo(np.float64).tiny)[:, None]
        o = position_m - np.asarray(self.scene.roi.origin_m)
        reaches = np.empty(len(ends), dtype=np.bool_)
        ray_triangle.can_meet_box(o, directions * sensor.range_m, np.asarray(self.scene.roi.size_m), reaches)
        beam = np.flatnonzero(reaches)
        if not len(beam):
            problem = f"none of {number_of(len(points), 'point')} lies on a beam that can meet the region of interest"
            where = f"site {site.name}: points: {site.points}"
            raise InputError(where, problem, "Save the points in the world frame.")
        weight = np.ones(len(beam)) if self.columns else None
        rows = EmptyScan(beam.astype(np.uint32), ends[beam], np.ones(len(beam), dtype=np.bool_), weight=weight)
        return Scan(site.pose, sensor, len(points), rows)

    def _read_points(self, path: Path, where: str) -> FloatArray:
        """The points of a measured scan (n, 3) in the world frame, from the CRS that the file declares, if any."""
        points, _ = point_clouds.read_points(path, where)
        crs = point_clouds.point_cloud_crs(path, where)
        world = geolocation.scenario_georeference(self.scene.scenario)
        where = f"{where}: {path}"
        farthest_m = np.abs(points).max()
        if farthest_m > MAX_COORDINATE_M:
            problem = f"expected points within {MAX_COORDINATE_M:g} m of the world's origin, got {farthest_m:g} m"
            raise InputError(where, problem)
        if crs is None:
            hint = "Save the points in the world frame, or as a LAS file that declares its system."
            world.check_metres(points[:, :2], where, hint)
            return points
        hint = "Check the coordinate reference system in the file's header."
        reading = world.read_coordinates(points[:, :2], where, crs, hint)
        z_m = points[:, 2] * height_unit_m(crs, where) - self.scene.scenario.crs.zero_height_m
        return np.column_stack([reading.to_world(points[:, :2]), z_m])


def _bounding_roi(scene: Scene) -> Roi:
    """A box around the static world and the region of interest."""
    roi_corners = [np.asarray(scene.roi.origin_m), np.add(scene.roi.origin_m, scene.roi.size_m)]
    corners = np.concatenate([scene.world.vertices_m, roi_corners])
    low = corners.min(axis=0) - 1.0
    high = corners.max(axis=0) + 1.0
    return Roi(tuple(low.tolist()), tuple((high - low).tolist()))


def _sensor_positions(scene: Scene) -> Iterator[tuple[Vec3, Sensor]]:
    """Positions of the scene's sensors; a site whose sensor is unknown is rejected when it is scanned."""
    for site in scene.cast_sites:
        try:
            yield site.pose.position_m, scene.sensor(site.sensor)
        except InputError:
            continue


def _count_distinct(ascending: NDArray[np.uint32]) -> int:
    """Count distinct numbers; on sorted input a hundred times as fast as sorting or hashing."""
    if not len(ascending):
        return 0
    return int(np.count_nonzero(ascending[1:] != ascending[:-1])) + 1


def _concatenate_scans(scans: list[EmptyScan]) -> EmptyScan:
    """Join scans of consecutive beams of one site."""
    names = ["beam", "ends_m", "returned", "weight"]
    if scans[0].face is not None:
        names.append("face")
    columns = {name: np.concatenate([getattr(scan, name) for scan in scans]) for name in names}
    return EmptyScan(**columns, ambiguous=sum(scan.ambiguous for scan in scans))
