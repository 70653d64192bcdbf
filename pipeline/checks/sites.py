"""Rules for sites: where they stand, and whether their beams meet the region of interest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline.checks.subject import Subject
from pipeline.core.errors import InputError
from pipeline.core.findings import Finding
from pipeline.kernels import rays
from pipeline.sensing import placing
from pipeline.sensing.sensors import Sensor
from pipeline.sensing.sites import Site
from pipeline.world import limits
from pipeline.world.carriageway import Carriageway

MOST_LISTED = 8
"""So many sites get a line of their own; the others share one."""

_MOUNTS = 4  # whose beams are kept, 1.4 MB each of 57,600: sites that share a mount come one after another


def poses(subject: Subject) -> Iterator[Finding]:
    """An error for each site that is in a solid, below the ground, or out of its sensor's reach of the region.

    A warning where no beam of a sensor as mounted meets the region.
    """
    blind = []
    if subject.scene is None:
        return
    for site in subject.sites:
        try:
            sensor = subject.scene.sensor(site.sensor)
        except InputError:
            continue  # told elsewhere
        try:
            placing.check(subject.scene, site.pose, sensor, f"site {site.name}")
        except InputError as error:
            yield Finding.of("sites", error)
            continue
        if site.points is None and not _meets(subject, site, sensor):
            blind.append(site.name)
    if blind:
        names = ", ".join(blind[:MOST_LISTED]) + (", ..." if blind[MOST_LISTED:] else "")
        what = f"no beam of {len(blind)} of {len(subject.sites)} sites meets the region of interest: {names}"
        yield Finding("beams beside the region", "sites", what, "another yaw, pitch or place, or a sensor that sees it")


def on_lanes(subject: Subject) -> Iterator[Finding]:
    """A warning for each named site that stands in a lane, or amid a junction, unless it hangs over the road."""
    model = subject.scenario.sites
    if subject.carriageway is None or not subject.sites or (model.file is None and model.only_free):
        return
    found = list(_on_the_road(subject.sites, subject.carriageway))
    cure = f"a place beside the road, or more than {limits.CLEARANCE_M:g} m above it"
    for site, where in found[:MOST_LISTED]:
        what = f"({site.pose.x_m:g}, {site.pose.y_m:g}, {site.pose.z_m:g}) stands {where}"
        yield Finding("sites on lanes", subject.site_place(site), what, cure)
    if rest := found[MOST_LISTED:]:
        names = ", ".join(site.name for site, _ in rest)
        what = f"{len(rest)} more of {len(subject.sites)} stand in lanes or junctions: {names}"
        yield Finding("sites on lanes", subject.site_place(rest[0][0]).partition(":")[0], what, cure)


def _on_the_road(sites: tuple[Site, ...], carriageway: Carriageway) -> Iterator[tuple[Site, str]]:
    """The sites that stand in a lane or amid a junction, no higher than the clearance above the road, and where."""
    at_m = np.array([[site.pose.x_m, site.pose.y_m] for site in sites])
    lanes, amid = carriageway.lanes_at(at_m), carriageway.in_junctions(at_m)
    for site, spot_m, lane, inside in zip(sites, at_m, lanes, amid, strict=True):
        if lane is None and not inside:
            continue
        road_m = carriageway.height_m(carriageway.nearest(spot_m) if lane is None else lane, spot_m)
        if site.pose.z_m - road_m <= limits.CLEARANCE_M:
            yield site, "amid a junction" if lane is None else f"in lane {carriageway.names[lane]}"


def dropped(subject: Subject) -> Iterator[Finding]:
    """How many candidates of a rule are dropped, and why."""
    if subject.scene is not None and (gone := subject.scene.dropped):
        reasons = Counter(why for _, why in gone)
        why = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
        what = f"{len(gone)} of {len(gone) + len(subject.sites)} candidates are dropped, since no pole can stand there"
        place = "sites.grid" if subject.scenario.sites.grid is not None else "sites.along"
        yield Finding(
            "dropped candidates", place, f"{what} ({why})", "name a sensor on a gantry or an island in a file of sites"
        )


def _meets(subject: Subject, site: Site, sensor: Sensor) -> bool:
    box = subject.scenario.roi.box
    ends = _directions(sensor, site.pose.angles_deg) * sensor.range_m
    reaches = np.empty(len(ends), dtype=np.bool_)
    rays.can_meet(np.subtract(site.pose.position_m, box.origin_m), ends, np.asarray(box.size_m), reaches)
    return bool(reaches.any())


@lru_cache(maxsize=_MOUNTS)
def _directions(sensor: Sensor, angles_deg: tuple[float, float, float]) -> NDArray[np.float64]:
    return sensor.directions(*angles_deg)
