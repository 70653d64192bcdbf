"""Scans the empty static world as a sensor in some pose sees it.

Steps for a pose: refuse it where no sensor can stand (in a solid, below the ground, out of reach of the region of
interest); turn the sensor's table into beams; where effects say so, expand them into weighted sub-beams; cast them; cut
them at porous surfaces. The empty scan of a site that names a measured one is read instead.

A measured scan holds returns only: it cannot tell which beams met nothing, so those are missing from it.
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

from pipeline.core.errors import InputError
from pipeline.core.grid import Roi
from pipeline.formats import point_clouds
from pipeline.formats.crs import height_unit_m
from pipeline.kernels import rays
from pipeline.scenario.types import FARTHEST_M
from pipeline.sensing import placing
from pipeline.sensing.beam_effects import BeamCutter, BeamExpander
from pipeline.sensing.scene import Scene
from pipeline.sensing.sensors import Sensor
from pipeline.sensing.sites import Pose, ScannedSite, Site
from pipeline.world import world_frame
from pipeline.world.casting import Caster, EmptyScan
from pipeline.world.mesh import World

_BEAMS = 4096  # beams expanded at once: bounds the memory


@dataclass(frozen=True)
class Scan:
    """One empty scan.

    Attributes
    ----------
    pose, sensor
        Where it was taken, and with what.
    beams
        Beams of the sensor; of a measured scan, its points.
    rows
        The beams that can meet the region of interest: where each ends, and its weight where effects weight beams.
    """

    pose: Pose
    sensor: Sensor
    beams: int
    rows: EmptyScan

    @property
    def beams_in_roi(self) -> int:
        """How many different beams can meet the region of interest."""
        return _different(self.rows.beam)

    @property
    def returns(self) -> int:
        """How many different beams met something."""
        return _different(self.rows.beam[self.rows.returned])

    def as_site(self, name: str, pole: str = "") -> ScannedSite:
        """What artefacts hold of it; ``pole`` is where it stands, the site alone if nothing else is said."""
        counts = self.beams, self.beams_in_roi, self.returns
        return ScannedSite(name, pole or name, self.pose, self.sensor.name, *counts)


_MOUNTS = 32
"""Different mounts whose beam directions are kept (1.4 MB each of 57,600 beams)."""


class Scanner:
    """Scans from any pose before one scene. Threads may share one; it pickles to the scene that it was built from.

    Every scan belongs to the caller.

    Parameters
    ----------
    scene
        What is scanned.
    whole
        Cast every beam of a sensor, also those that cannot meet the region of interest, and tell what each ends on.
    mounts
        How many ways of mounting a sensor are remembered: many sites share theirs, poses that are dragged do not.
    """

    def __init__(self, scene: Scene, *, whole: bool = False, mounts: int = _MOUNTS) -> None:
        self.scene, self.whole, self._mounts = scene, whole, mounts
        self._expanders = [effect for effect in scene.effects if isinstance(effect, BeamExpander)]
        cutters = [effect for effect in scene.effects if isinstance(effect, BeamCutter)]
        self._opaque = scene.world
        for effect in cutters:
            self._opaque = effect.opaque(self._opaque)
        self._cuts = [effect.cutter(scene.world, _round(scene) if whole else scene.roi) for effect in cutters]
        self._at_sites = frozenset(_standing(scene))
        self._casters: dict[bool, Caster] = {}
        self._directions: dict[tuple[Sensor, tuple[float, float, float]], NDArray[np.float64]] = {}
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(Scanner, whole=self.whole, mounts=self._mounts), (self.scene,)

    @property
    def opaque_world(self) -> World:
        """The world that beams are cast at, whose faces a whole sweep names: without what effects let beams through."""
        return self._opaque

    @property
    def columns(self) -> tuple[str, ...]:
        """The optional columns of ``scans.parquet`` that these scans fill."""
        return ("weight",) if self.scene.weights_beams else ()

    def scan(self, pose: Pose, sensor: Sensor) -> Scan:
        """The empty scan of a sensor in a pose.

        Raises
        ------
        InputError
            Where no sensor can stand, naming the coordinates.
        """
        return self._cast(pose, sensor, f"pose ({pose.x_m:g}, {pose.y_m:g}, {pose.z_m:g})")

    def scan_site(self, site: Site) -> Scan:
        """The empty scan of a candidate site, simulated or measured; errors name the site."""
        sensor = self.scene.sensor(site.sensor, f"site {site.name}")
        if site.points is None:
            return self._cast(site.pose, sensor, f"site {site.name}")
        placing.check(self.scene, site.pose, sensor, f"site {site.name}")
        return self._measured(site, sensor)

    def check(self, sites: Iterable[Site]) -> None:
        """InputError that names every site where its sensor cannot stand; nothing is cast."""
        refused = []
        for site in sites:
            try:
                sensor = self.scene.sensor(site.sensor, f"site {site.name}")
                placing.check(self.scene, site.pose, sensor, f"site {site.name}")
            except InputError as error:
                refused.append(error)
        if refused:
            first, more = refused[0], "".join(f"\n{error}" for error in refused[1:])
            raise InputError(first.place, first.found, first.right + more)

    def _cast(self, pose: Pose, sensor: Sensor, place: str) -> Scan:
        placing.check(self.scene, pose, sensor, place)
        caster = self._caster((pose.position_m, sensor) in self._at_sites and not self.whole)
        cast = caster.sweep if self.whole else caster.scan
        directions = self._beam_directions(sensor, pose)
        if self._expanders:
            starts = range(0, len(directions), _BEAMS)
            parts = [self._expanded(cast, pose, sensor, s, directions[s : s + _BEAMS]) for s in starts]
            rows = _joined(parts)
        else:
            rows = cast(pose.position_m, directions, sensor.range_m)
        for cut in self._cuts:
            rows = cut(rows, pose)
        return Scan(pose, sensor, sensor.beams, rows)

    def _caster(self, at_a_site: bool) -> Caster:
        """What holds the triangles that beams can meet: from the scene's sites, or from anywhere (made when first asked
        for). Both give the same hits; the first is smaller."""
        with self._lock:
            if at_a_site not in self._casters:
                start_m, range_m = None, float("inf")
                if at_a_site:
                    start_m = np.array([position_m for position_m, _ in self._at_sites])
                    range_m = max(sensor.range_m for _, sensor in self._at_sites)
                self._casters[at_a_site] = Caster(self._opaque, self.scene.roi, start_m, range_m)
            return self._casters[at_a_site]

    def _expanded(
        self, cast: Callable[..., EmptyScan], pose: Pose, sensor: Sensor, start: int, directions: NDArray[np.float64]
    ) -> EmptyScan:
        """Cast the sub-beams of some beams, of which the first is number ``start``."""
        beam, weight = np.arange(start, start + len(directions)), np.ones(len(directions))
        for effect in self._expanders:
            directions, parent, share = effect.expand(directions, sensor, pose)
            beam, weight = beam[parent], weight[parent] * share
        scan = cast(pose.position_m, directions, sensor.range_m)
        return replace(scan, beam=beam[scan.beam].astype(np.uint32), weight=weight[scan.beam])

    def _beam_directions(self, sensor: Sensor, pose: Pose) -> NDArray[np.float64]:
        """Beams in the world's axes; the last few mounts are kept, since many sites share theirs."""
        mount = (sensor, pose.angles_deg)
        with self._lock:
            if mount not in self._directions:
                while len(self._directions) >= self._mounts:
                    del self._directions[next(iter(self._directions))]
                self._directions[mount] = sensor.directions(*pose.angles_deg)
            return self._directions[mount]

    def _measured(self, site: Site, sensor: Sensor) -> Scan:
        """The returns of a measured scan, seen from the sensor; those that cannot meet the ROI are left out."""
        assert site.points is not None
        place, roi = f"site {site.name}: points", self.scene.roi
        path = self.scene.scenario.find(site.points, place)
        points = self._points(path, place)
        ends = points - np.asarray(site.pose.position_m)
        far = np.sqrt((ends**2).sum(axis=1))
        away = np.maximum(far, np.finfo(np.float64).tiny)[:, None]
        reaches = np.empty(len(ends), dtype=np.bool_)
        o = np.asarray(site.pose.position_m) - np.asarray(roi.origin_m)
        rays.can_meet(o, ends / away * sensor.range_m, np.asarray(roi.size_m), reaches)
        beam = np.flatnonzero(reaches)
        if not len(beam):
            met_nothing = f"none of {len(points)} points lies on a beam that can meet the region of interest"
            raise InputError(f"{place}: {path}", met_nothing, "points in the world frame")
        weight = np.ones(len(beam)) if self.columns else None
        rows = EmptyScan(beam.astype(np.uint32), ends[beam], np.ones(len(beam), dtype=np.bool_), weight=weight)
        return Scan(site.pose, sensor, len(points), rows)

    def _points(self, path: Path, place: str) -> NDArray[np.float64]:
        """The points of a measured scan (n, 3) in the world frame, from the system that the file declares, if any."""
        points, _ = point_clouds.read_points(path, place)
        world, declared = world_frame.of(self.scene.scenario), point_clouds.crs_of(path, place)
        place = f"{place}: {path}"
        if (farthest_m := np.abs(points).max()) > FARTHEST_M:
            raise InputError(place, f"a point lies {farthest_m:g} m from the world's zero", f"within {FARTHEST_M:g} m")
        if declared is None:
            world.metres(points[:, :2], place, "metres of the world frame, or a LAS file that names its system")
            return points
        reading = world.reading(points[:, :2], place, declared, "points in the system that the file's header names")
        height_m = points[:, 2] * height_unit_m(declared, place) - self.scene.scenario.crs.zero_height_m
        return np.column_stack([reading.to_world(points[:, :2]), height_m])


def _round(scene: Scene) -> Roi:
    """A box round the static world and the region of interest."""
    low, high = np.asarray(scene.roi.origin_m), np.add(scene.roi.origin_m, scene.roi.size_m)
    corners = np.concatenate([scene.world.vertices_m, [low, high]])
    low, high = corners.min(axis=0) - 1.0, corners.max(axis=0) + 1.0
    return Roi(tuple(low.tolist()), tuple((high - low).tolist()))


def _standing(scene: Scene) -> Iterator[tuple[tuple[float, float, float], Sensor]]:
    """Where the scene's own sensors stand; a site whose sensor is unknown is refused when it is scanned."""
    for site in scene.cast_sites:
        try:
            yield site.pose.position_m, scene.sensor(site.sensor)
        except InputError:
            continue


def _different(ascending: NDArray[np.uint32]) -> int:
    """How many different numbers there are; a hundred times as fast as sorting or hashing them once more."""
    return int(np.count_nonzero(ascending[1:] != ascending[:-1])) + (len(ascending) > 0)


def _joined(scans: list[EmptyScan]) -> EmptyScan:
    """Scans of consecutive beams of one site as one."""
    names = ["beam", "ends_m", "returned", "weight", *(["face"] if scans[0].face is not None else [])]
    fields = {name: np.concatenate([getattr(scan, name) for scan in scans]) for name in names}
    return EmptyScan(**fields, doubtful=sum(scan.doubtful for scan in scans))
