"""What does the sensor at a candidate site see of the empty static world?

Steps for a site: refuse it where no sensor can stand (in a solid, below the ground, out of reach of the region of
interest); turn the sensor's table into beams; cast them - or read the measured empty scan that the site names instead.

A measured scan holds returns only: it cannot tell which beams met nothing, so those are missing from it.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.kernels import rays, solids
from pipeline.scenario.models import Scenario
from pipeline.sensing import sensors, sites
from pipeline.sensing.sensors import Sensor
from pipeline.sensing.sites import Site
from pipeline.world.casting import Caster, EmptyScan, standing_on
from pipeline.world.mesh import World, read_ply

if TYPE_CHECKING:
    from pipeline.effects.registry import Expand, TransmitScan

_BEAMS = 4096  # beams expanded at once: bounds the memory


@dataclass(frozen=True)
class SiteScan:
    """A site, what the metadata says of it, and its empty scan."""

    site: Site
    scan: EmptyScan
    about: dict[str, Any]


class Survey:
    """All candidate sites of a scenario before one static world. Threads may share one.

    Attributes
    ----------
    sites
        In the order of the sites file.
    skipped
        Effects that are named but provably change nothing here, and why.
    """

    def __init__(self, scenario: Scenario, world: World) -> None:
        self.sites = sites.of(scenario)
        self._scenario, self._world, self._roi = scenario, world, scenario.roi.box
        self._sensors = {s.site: sensors.resolve(s.sensor, scenario.sensors, f"site {s.site}") for s in self.sites}
        for site in self.sites:
            self._check(site)
        found = acting(scenario, world, self.sites)
        self.skipped, self._expand = found.skipped, found.expand
        opaque = world
        for effect in found.transmit:
            opaque = effect.opaque(opaque)
        self._cuts = [effect.cutter(world, self._roi) for effect in found.transmit]
        cast = [site for site in self.sites if site.points is None]
        reach = max((self._sensors[site.site].range_m for site in cast), default=0.0)
        self._caster = Caster(opaque, self._roi, np.array([site.position_m for site in cast]), reach)
        self._tables: dict[tuple[str, float, float, float], NDArray[np.float64]] = {}
        self._lock = threading.Lock()

    @property
    def columns(self) -> tuple[str, ...]:
        """The optional columns that these scans have."""
        return ("weight",) if self._cuts or self._expand else ()

    def scan(self, site: Site) -> SiteScan:
        """The empty scan of one site, simulated or measured."""
        sensor = self._sensors[site.site]
        if site.points is not None:
            scan, beams = self._measured(site)
        else:
            beams = sensor.beams
            scan = self._simulated(site, sensor)
        counts = {
            "beams": beams,
            "beams_in_roi": _different(scan.beam),
            "returns": _different(scan.beam[scan.returned]),
        }
        return SiteScan(site, scan, site.to_json() | counts)

    def _simulated(self, site: Site, sensor: Sensor) -> EmptyScan:
        """Cast all beams; where effects say so, as weighted sub-beams, and those cut into parts."""
        directions = self._directions(site)
        if self._expand:
            starts = range(0, len(directions), _BEAMS)
            scan = _joined(
                [self._expanded(site, sensor, start, directions[start : start + _BEAMS]) for start in starts]
            )
        else:
            scan = self._caster.scan(site.position_m, directions, sensor.range_m)
        for cut in self._cuts:
            scan = cut(scan, site)
        return scan

    def _expanded(self, site: Site, sensor: Sensor, start: int, directions: NDArray[np.float64]) -> EmptyScan:
        """Cast the sub-beams of some beams, of which the first is number ``start``."""
        beam, weight = np.arange(start, start + len(directions)), np.ones(len(directions))
        for effect in self._expand:
            directions, parent, share = effect.expand(directions, sensor, site)
            beam, weight = beam[parent], weight[parent] * share
        scan = self._caster.scan(site.position_m, directions, sensor.range_m)
        return replace(scan, beam=beam[scan.beam].astype(np.uint32), weight=weight[scan.beam])

    def _directions(self, site: Site) -> NDArray[np.float64]:
        """Beams in the world's axes; sites with one sensor and pose share them."""
        pose = (site.sensor, site.yaw_deg, site.pitch_deg, site.roll_deg)
        with self._lock:
            if pose not in self._tables:
                self._tables[pose] = self._sensors[site.site].directions(*pose[1:])
            return self._tables[pose]

    def _measured(self, site: Site) -> tuple[EmptyScan, int]:
        """The returns of a measured scan, seen from the sensor; those that cannot meet the ROI are left out."""
        from pipeline.formats import point_clouds as clouds

        assert site.points is not None
        place = f"site {site.site}: points"
        points, _ = clouds.read_points(self._scenario.find(site.points, place), place)
        ends = points - np.asarray(site.position_m)
        far = np.sqrt((ends**2).sum(axis=1))
        away = np.maximum(far, np.finfo(np.float64).tiny)[:, None]
        reaches = np.empty(len(ends), dtype=np.bool_)
        o = np.asarray(site.position_m) - np.asarray(self._roi.origin_m)
        rays.can_meet(o, ends / away * self._sensors[site.site].range_m, np.asarray(self._roi.size_m), reaches)
        beam = np.flatnonzero(reaches)
        if not len(beam):
            found = f"none of {len(points)} points lies on a beam that can meet the region of interest"
            raise InputError(place, found, "points in the world frame")
        weight = np.ones(len(beam)) if self.columns else None
        return EmptyScan(beam.astype(np.uint32), ends[beam], np.ones(len(beam), dtype=np.bool_), weight=weight), len(
            points
        )

    def _check(self, site: Site) -> None:
        place, sensor, box = f"site {site.site}", self._sensors[site.site], self._roi
        ground = self._ground_m(site) if self._scenario.statics.ground else -np.inf
        if not site.z_m > ground + rays.EDGE_M:
            raise InputError(
                place,
                f"z_m = {site.z_m:g} is not above the ground (z = {ground:.4g})",
                f"a height above {ground:.4g} m",
            )
        gap = np.maximum(
            np.subtract(box.origin_m, site.position_m), np.subtract(site.position_m, np.add(box.origin_m, box.size_m))
        )
        far = float(np.sqrt((np.maximum(gap, 0.0) ** 2).sum()))
        if far > sensor.range_m:
            raise InputError(
                place,
                f"stands {far:.1f} m from the region of interest",
                f"within the {sensor.range_m:g} m of {sensor.name}",
            )
        inside = self._solid_round(site)
        if inside is not None:
            name, kind = self._world.solids[inside]
            raise InputError(
                place, f"({site.x_m:g}, {site.y_m:g}, {site.z_m:g}) stands inside {name} ({kind})", "a free place"
            )

    def _ground_m(self, site: Site) -> float:
        """The ground's z below a site: 0, or on the surface that a network with relief has."""
        world, at = self._world, np.array([site.x_m, site.y_m])
        low, high = world.bounds_xy_m
        over = np.flatnonzero(np.all((low - rays.EDGE_M <= at) & (at <= high + rays.EDGE_M), axis=1))
        for a, b, c in world.triangles_m[
            [i for i in over if world.solids[world.solid_of_face[i]] == ("ground", "ground")]
        ]:
            u, v, to = (b - a)[:2], (c - a)[:2], at - a[:2]
            area = u[0] * v[1] - u[1] * v[0]
            s, t = (to[0] * v[1] - to[1] * v[0]) / area, (u[0] * to[1] - u[1] * to[0]) / area
            if min(s, t, 1.0 - s - t) >= -rays.EDGE_M:
                return float(a[2] + s * (b[2] - a[2]) + t * (c[2] - a[2]))
        return 0.0

    def _solid_round(self, site: Site) -> int | None:
        """The first solid that the site stands in, by its winding number; not one whose surface it stands on."""
        world, at = self._world, np.asarray(site.position_m)
        low, high = world.bounds_xy_m
        over = np.flatnonzero(np.all((low - rays.EDGE_M <= at[:2]) & (at[:2] <= high + rays.EDGE_M), axis=1))
        totals = np.zeros(len(world.solids), dtype=np.int64)
        owner = world.solid_of_face[over]
        solids.windings_at(at, world.triangles_m[over], owner.astype(np.int64), world.signs[owner], totals)
        if totals.any():
            totals[owner[standing_on(world.triangles_m[over] - at)]] = 0
        inside = np.flatnonzero((totals != 0) & world.closed)
        return int(inside[0]) if len(inside) else None


def _effects(
    scenario: Scenario, world: World, where: tuple[Site, ...]
) -> tuple[tuple[Expand, ...], tuple[TransmitScan, ...]]:
    """The effects that act on scans and can change one; nothing is imported when the scenario names none."""
    if not scenario.effects:
        return (), ()
    from pipeline.effects import registry as effects

    scene = effects.Scene(scenario, world, where)
    named = [effect for effect in effects.of(scenario, "scan") if effect.idle(scene) is None]
    expand = tuple(effect for effect in named if isinstance(effect, effects.Expand))
    return expand, tuple(effect for effect in named if isinstance(effect, effects.TransmitScan))


def _different(ascending: NDArray[np.uint32]) -> int:
    """How many different numbers there are; a hundred times as fast as sorting or hashing them once more."""
    return int(np.count_nonzero(ascending[1:] != ascending[:-1])) + (len(ascending) > 0)


def _joined(scans: list[EmptyScan]) -> EmptyScan:
    """Scans of consecutive beams of one site as one."""
    fields = {
        name: np.concatenate([getattr(scan, name) for scan in scans])
        for name in ("beam", "ends_m", "returned", "weight")
    }
    return EmptyScan(**fields, doubtful=sum(scan.doubtful for scan in scans))


@dataclass(frozen=True)
class Acting:
    """The effects of this stage: those that act, in the order in which they do, and why each other one cannot."""

    expand: tuple[Expand, ...] = ()
    transmit: tuple[TransmitScan, ...] = ()
    skipped: dict[str, str] = field(default_factory=dict)


def acting(scenario: Scenario, world: World, standing: tuple[Site, ...]) -> Acting:
    """Which of the effects that the scenario names change what is scanned; none is imported when it names none."""
    if not scenario.effects:
        return Acting()
    from pipeline.effects import registry as effects

    live, skipped = effects.acting(scenario, "scan", world, standing)
    return Acting(
        tuple(effect for effect in live if isinstance(effect, effects.Expand)),
        tuple(effect for effect in live if isinstance(effect, effects.TransmitScan)),
        skipped,
    )


def settings(scenario: Scenario, out: Path) -> dict[str, Any]:
    """The settings that an empty scan depends on; ``out`` holds ``statics.ply``, which tells what an effect can act
    on."""
    box = scenario.roi.box
    return {
        "name": scenario.name,
        "roi": [box.origin_m, box.size_m],
        "ground": scenario.statics.ground,
        "sites": scenario.sites.model_dump(mode="json"),
        "sensors": {name: model.model_dump(mode="json") for name, model in scenario.sensors.items()},
        **_effect_settings(scenario, out),
    }


def _effect_settings(scenario: Scenario, out: Path) -> dict[str, Any]:
    """The effects that act. One that cannot change the result is left out, as if it were not named."""
    if not scenario.effects:
        return {}
    from pipeline.effects import registry as effects

    if not effects.of(scenario, "scan"):
        return {}
    found = acting(scenario, read_ply(out / "statics.ply")[0], sites.of(scenario))
    live = (*found.expand, *found.transmit)
    return {"effects": effects.settings(live)} if live else {}


def file_digests(scenario: Scenario, out: Path) -> dict[str, str]:
    """The hashes of the files that an empty scan depends on."""
    return {"statics.ply": files.sha256_of(out / "statics.ply"), **site_files(scenario)}


def site_files(scenario: Scenario) -> dict[str, str]:
    """The hashes of the files that say where sites are, and what was measured there."""
    hashes = {}
    if scenario.sites.file is not None:
        hashes[scenario.sites.file] = files.sha256_of(scenario.find(scenario.sites.file, "sites.file"))
    for site in sites.of(scenario):
        if site.points is not None:
            hashes[site.points] = files.sha256_of(scenario.find(site.points, f"site {site.site}: points"))
    return hashes
