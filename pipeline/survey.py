"""What does the sensor at a candidate site see of the empty static world?

Steps for a site: refuse it where no sensor can stand (in a solid, below the ground, out of reach of the region of interest); turn
the sensor's table into beams; cast them - or read the measured empty scan that the site names instead.

A measured scan holds returns only: it cannot tell which beams met nothing, so those are missing from it.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipeline import sensors, sites, tables
from pipeline.errors import InputError
from pipeline.kernels import rays, solids
from pipeline.raycast import Caster, EmptyScan, standing_on
from pipeline.scenario import Scenario
from pipeline.sensors import Sensor
from pipeline.sites import Site
from pipeline.world import World


if TYPE_CHECKING:
    from pipeline.effects import Expand, TransmitScan


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
    """

    def __init__(self, scenario: Scenario, world: World) -> None:
        self.sites = sites.of(scenario)
        self._scenario, self._world, self._roi = scenario, world, scenario.roi.box
        self._sensors = {s.site: sensors.resolve(s.sensor, scenario.sensors, f"site {s.site}") for s in self.sites}
        for site in self.sites:
            self._check(site)
        self._expand, self._transmit = _effects(scenario, world, self.sites)
        for effect in self._transmit:
            world = effect.opaque(world)
        self._caster = Caster(world, self._roi)
        self._tables: dict[tuple[str, float, float, float], NDArray[np.float64]] = {}
        self._lock = threading.Lock()

    @property
    def columns(self) -> tuple[str, ...]:
        """The optional columns that these scans have."""
        return (("from_m",) if self._transmit else ()) + (("weight",) if self._transmit or self._expand else ())

    def scan(self, site: Site) -> SiteScan:
        """The empty scan of one site, simulated or measured."""
        sensor = self._sensors[site.site]
        if site.points is not None:
            scan, beams = self._measured(site)
        else:
            beams = sensor.beams
            scan = self._simulated(site, sensor)
        cast, back = np.unique(scan.beam), np.unique(scan.beam[scan.returned])
        counts = {"beams": beams, "beams_in_roi": len(cast), "returns": len(back)}
        return SiteScan(site, scan, site.to_json() | counts)

    def _simulated(self, site: Site, sensor: Sensor) -> EmptyScan:
        """Cast all beams; where effects say so, as weighted sub-beams, cut into pieces."""
        directions, beam, weight = self._directions(site), None, None
        for effect in self._expand:
            directions, parent, share = effect.expand(directions, sensor)
            beam = parent if beam is None else beam[parent]
            weight = share if weight is None else weight[parent] * share
        scan = self._caster.scan(site.position_m, directions, sensor.range_m)
        if beam is not None and weight is not None:
            scan = replace(scan, beam=beam[scan.beam].astype(np.uint32), weight=weight[scan.beam])
        for cut in self._transmit:
            scan = cut.pieces(scan, site, self._world)
        return scan

    def _directions(self, site: Site) -> NDArray[np.float64]:
        """Beams in the world's axes; sites with one sensor and pose share them."""
        pose = (site.sensor, site.yaw_deg, site.pitch_deg, site.roll_deg)
        with self._lock:
            if pose not in self._tables:
                self._tables[pose] = self._sensors[site.site].directions(*pose[1:])
            return self._tables[pose]

    def _measured(self, site: Site) -> tuple[EmptyScan, int]:
        """The returns of a measured scan, seen from the sensor; those that cannot meet the ROI are left out."""
        from pipeline import clouds

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
        return EmptyScan(beam.astype(np.uint32), ends[beam], np.ones(len(beam), dtype=np.bool_)), len(points)

    def _check(self, site: Site) -> None:
        place, sensor, box = f"site {site.site}", self._sensors[site.site], self._roi
        if self._scenario.statics.ground and not site.z_m > rays.EDGE_M:
            raise InputError(place, f"z_m = {site.z_m:g} is not above the ground (z = 0)", "a height above 0 m")
        gap = np.maximum(np.subtract(box.origin_m, site.position_m), np.subtract(site.position_m, np.add(box.origin_m, box.size_m)))
        far = float(np.sqrt((np.maximum(gap, 0.0) ** 2).sum()))
        if far > sensor.range_m:
            raise InputError(
                place, f"stands {far:.1f} m from the region of interest", f"within the {sensor.range_m:g} m of {sensor.name}"
            )
        inside = self._solid_round(site)
        if inside is not None:
            name, kind = self._world.solids[inside]
            raise InputError(place, f"({site.x_m:g}, {site.y_m:g}, {site.z_m:g}) stands inside {name} ({kind})", "a free place")

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


def _effects(scenario: Scenario, world: World, where: tuple[Site, ...]) -> tuple[tuple[Expand, ...], tuple[TransmitScan, ...]]:
    """The effects that act on scans and can change one; nothing is imported when the scenario names none."""
    if not scenario.effects:
        return (), ()
    from pipeline import effects

    scene = effects.Scene(scenario, world, where)
    named = [effect for effect in effects.of(scenario, "scan") if effect.idle(scene) is None]
    expand = tuple(effect for effect in named if isinstance(effect, effects.Expand))
    return expand, tuple(effect for effect in named if isinstance(effect, effects.TransmitScan))


def settings(scenario: Scenario) -> dict[str, Any]:
    """The settings that an empty scan depends on."""
    box = scenario.roi.box
    return {
        "name": scenario.name,
        "roi": [box.origin_m, box.size_m],
        "ground": scenario.statics.ground,
        "sites": scenario.sites.model_dump(mode="json"),
        "sensors": {name: model.model_dump(mode="json") for name, model in scenario.sensors.items()},
        **_effect_settings(scenario),
    }


def _effect_settings(scenario: Scenario) -> dict[str, Any]:
    if not scenario.effects:
        return {}
    from pipeline import effects

    named = effects.settings(effects.of(scenario, "scan"))
    return {"effects": named} if named else {}


def files(scenario: Scenario, out: Path) -> dict[str, str]:
    """The hashes of the files that an empty scan depends on."""
    hashes = {"statics.ply": tables.sha256_of(out / "statics.ply")}
    if scenario.sites.file is not None:
        hashes[scenario.sites.file] = tables.sha256_of(scenario.find(scenario.sites.file, "sites.file"))
    for site in sites.of(scenario):
        if site.points is not None:
            hashes[site.points] = tables.sha256_of(scenario.find(site.points, f"site {site.site}: points"))
    return hashes
