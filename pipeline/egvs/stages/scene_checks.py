"""Rules for sites, solids, region, sensors and effects.

Rules for the region of interest: lanes lead through it.

Rules for sensors and effects: they are known, and nothing that an effect needs is missing.

Rules for sites: where they stand, and whether their beams meet the region of interest.

Rules for solids: none covers the lanes, and they stand where the region of interest is.

Which part of a solid is in the way: for a closed one, the triangles whose underside is lower than
:data:`egvs.world.clearances.CLEARANCE_M` above the road; of an open surface only those that reach above
:data:`egvs.world.clearances.KERB_M` as well, so that a terrain or the road itself is none. Seen from above, they are
held against the lanes' areas.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.core.errors import Diagnostic, InputError
from egvs.core.grid import Roi
from egvs.effects import registry
from egvs.effects.base import Effect
from egvs.kernels import ray_triangle
from egvs.sensors import sensor, site_feasibility
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor, scenario_sensor
from egvs.sensors.sites import Site
from egvs.stages.inputs import CheckInputs, ErrorCollector
from egvs.traffic import sumo_folder
from egvs.world import clearances, geolocation
from egvs.world.carriageway import Carriageway
from egvs.world.mesh import World


def check_lanes_in_region(subject: CheckInputs) -> Iterator[Diagnostic]:
    """An error where no lane leads through the region, or all lie above or below it."""
    if subject.network is None:
        return
    box = subject.scenario.roi.box
    low_m, high_m = np.asarray(box.origin_m), np.add(box.origin_m, box.size_m)
    place, cure = f"{subject.scenario.file}: roi", "a region over the network's roads, in the network's coordinates"
    if subject.carriageway is None:
        yield Diagnostic("region", place, "the network has no lane for vehicles of the road", cure, is_error=True)
        return
    if (far_m := subject.carriageway.distance_m(low_m.tolist(), high_m.tolist())) > 0:
        (x0, y0), (x1, y1) = subject.carriageway.bounds_m
        extent = f"lanes reach from ({x0:.0f}, {y0:.0f}) to ({x1:.0f}, {y1:.0f})"
        what = f"no lane leads through it: the nearest is {far_m:,.1f} m away, {extent}"
        yield Diagnostic("region", place, what, cure, is_error=True)
        return
    at_m = (low_m + high_m)[:2] / 2.0
    lane = subject.carriageway.nearest(at_m)
    road_m = subject.carriageway.height_m(lane, at_m)
    if road_m > high_m[2] or road_m + clearances.CLEARANCE_M < low_m[2]:
        what = f"reaches from z = {low_m[2]:g} to {high_m[2]:g} m, but the road there lies at z = {road_m:.1f} m"
        yield Diagnostic("region", place, what, "a center_m that holds the traffic", is_error=True)


def check_period_networks(subject: CheckInputs) -> Iterator[Diagnostic]:
    """An error for each period with a network of its own that has no lane in the region, or another zero than the
    first period's: its vehicles would drive elsewhere.
    """
    scenario, refusals = subject.scenario, ErrorCollector()
    for period, alone in scenario.by_period().items():
        roads = refusals.attempt("network", partial(sumo_folder.read_network, alone)) if period else None
        if roads is None or roads is subject.network:
            continue
        place, box = f"{scenario.file}: traffic.periods ({period})", scenario.roi.box
        first, own = (
            geolocation.network_world_frame(None if n is None else n.location) for n in (subject.network, roads)
        )
        if first is not None and own is not None and first != own:
            offsets = f"netOffset {list(own.offset_m)}, not {list(first.offset_m)}"
            what = f"its network has another zero or projection than that of the first period ({offsets})"
            cure = "networks of one extract and one projection, so that all periods share a world frame"
            yield Diagnostic("region", place, what, cure, is_error=True)
        elif (far_m := Carriageway.of(roads).distance_m(box.origin_m, np.add(box.origin_m, box.size_m))) > 0:
            what = f"no lane of its network leads through the region: the nearest is {far_m:,.1f} m away"
            yield Diagnostic("region", place, what, "a network in the coordinates of the others", is_error=True)
    yield from refusals.findings


MAX_LISTED_BEAMS = 5
"""So many repeated beams of a table are named."""


def check_sensors_known(subject: CheckInputs) -> Iterator[Diagnostic]:
    """An error for each sensor that nobody knows, or whose table is wrong, and which sites name it."""
    names: dict[str, list[str]] = {}
    for site in subject.sites:
        names.setdefault(site.sensor, []).append(site.name)
    for sensor_name, of in names.items():
        more = f" and {len(of) - 1} more" if len(of) > 1 else ""
        try:
            scenario_sensor(sensor_name, subject.scenario, f"site {of[0]}{more}")
        except InputError as error:
            yield Diagnostic.of("sensors", error)


def warn_repeated_beams(subject: CheckInputs) -> Iterator[Diagnostic]:
    """A warning for each table of beams that names a direction twice."""
    scenario = subject.scenario
    for name in dict.fromkeys(site.sensor for site in subject.sites):
        model = scenario.sensors.get(name)
        if model is None or model.beams is None:
            continue
        try:
            table = sensor.scenario_sensor(name, scenario, name).table
        except InputError:
            continue  # told elsewhere
        if table is not None and (twice := sensor.repeated_beams(table)):
            listed = ", ".join(f"beam {beam} as beam {first}" for beam, first in twice[:MAX_LISTED_BEAMS])
            more = ", ..." if twice[MAX_LISTED_BEAMS:] else ""
            what = (
                f"{len(twice)} of {len(table)} beams point where an earlier one does ({listed}{more}) and count again"
            )
            cure = "each direction once (azimuths of 0 and 360 degrees are the same)"
            yield Diagnostic("repeated beams", model.beams, what, cure)


def check_effects(subject: CheckInputs) -> Iterator[Diagnostic]:
    """An error for each effect that this scenario cannot have, or that lacks something."""
    if subject.scene is None or any(True for _ in check_sensors_known(subject)):
        return
    for effect in registry.scenario_effects(subject.scenario, "traffic", "scan", "score"):
        yield from _effect_errors(effect, subject.scene)


def _effect_errors(effect: Effect[Any], scene: Scene) -> Iterator[Diagnostic]:
    refusals = ErrorCollector()
    idle = refusals.attempt("effects", lambda: effect.why_idle(scene))
    yield from refusals.findings
    if not refusals.findings and idle is None and (error := effect.refusal(scene)) is not None:
        yield Diagnostic.of("effects", error)


MAX_LISTED_SITES = 8
"""So many sites get a line of their own; the others share one."""

_CACHED_MOUNTS = 4  # whose beams are kept, 1.4 MB each of 57,600: sites that share a mount come one after another


def check_poses(subject: CheckInputs) -> Iterator[Diagnostic]:
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
            site_feasibility.check_pose(subject.scene, site.pose, sensor, f"site {site.name}")
        except InputError as error:
            yield Diagnostic.of("sites", error)
            continue
        if site.points is None and not _reaches_region(subject, site, sensor):
            blind.append(site.name)
    if blind:
        names = ", ".join(blind[:MAX_LISTED_SITES]) + (", ..." if blind[MAX_LISTED_SITES:] else "")
        what = f"no beam of {len(blind)} of {len(subject.sites)} sites meets the region of interest: {names}"
        yield Diagnostic(
            "beams beside the region", "sites", what, "another yaw, pitch or place, or a sensor that sees it"
        )


def warn_sites_on_lanes(subject: CheckInputs) -> Iterator[Diagnostic]:
    """A warning for each named site that stands in a lane, or amid a junction, unless it hangs over the road."""
    model = subject.scenario.sites
    if subject.carriageway is None or not subject.sites or (model.file is None and model.only_free):
        return
    found = list(_sites_on_road(subject.sites, subject.carriageway))
    cure = f"a place beside the road, or more than {clearances.CLEARANCE_M:g} m above it"
    for site, where in found[:MAX_LISTED_SITES]:
        what = f"({site.pose.x_m:g}, {site.pose.y_m:g}, {site.pose.z_m:g}) stands {where}"
        yield Diagnostic("sites on lanes", subject.site_location(site), what, cure)
    if rest := found[MAX_LISTED_SITES:]:
        names = ", ".join(site.name for site, _ in rest)
        what = f"{len(rest)} more of {len(subject.sites)} stand in lanes or junctions: {names}"
        yield Diagnostic("sites on lanes", subject.site_location(rest[0][0]).partition(":")[0], what, cure)


def _sites_on_road(sites: tuple[Site, ...], carriageway: Carriageway) -> Iterator[tuple[Site, str]]:
    """The sites that stand in a lane or amid a junction, no higher than the clearance above the road, and where."""
    at_m = np.array([[site.pose.x_m, site.pose.y_m] for site in sites])
    lanes, amid = carriageway.lanes_at(at_m), carriageway.in_junctions(at_m)
    for site, spot_m, lane, inside in zip(sites, at_m, lanes, amid, strict=True):
        if lane is None and not inside:
            continue
        road_m = carriageway.height_m(carriageway.nearest(spot_m) if lane is None else lane, spot_m)
        if site.pose.z_m - road_m <= clearances.CLEARANCE_M:
            yield site, "amid a junction" if lane is None else f"in lane {carriageway.names[lane]}"


def warn_dropped_sites(subject: CheckInputs) -> Iterator[Diagnostic]:
    """How many candidates of a rule are dropped, and why."""
    if subject.scene is not None and (gone := subject.scene.dropped):
        reasons = Counter(why for _, why in gone)
        why = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
        what = f"{len(gone)} of {len(gone) + len(subject.sites)} candidates are dropped, since no pole can stand there"
        place = "sites.grid" if subject.scenario.sites.grid is not None else "sites.along"
        yield Diagnostic(
            "dropped candidates", place, f"{what} ({why})", "name a sensor on a gantry or an island in a file of sites"
        )


def _reaches_region(subject: CheckInputs, site: Site, sensor: Sensor) -> bool:
    box = subject.scenario.roi.box
    ends = _cached_directions(sensor, site.pose.angles_deg) * sensor.range_m
    reaches = np.empty(len(ends), dtype=np.bool_)
    ray_triangle.can_meet_box(np.subtract(site.pose.position_m, box.origin_m), ends, np.asarray(box.size_m), reaches)
    return bool(reaches.any())


@lru_cache(maxsize=_CACHED_MOUNTS)
def _cached_directions(sensor: Sensor, angles_deg: tuple[float, float, float]) -> NDArray[np.float64]:
    return sensor.directions(*angles_deg)


MAX_NAMED_SOLIDS = 5

_FLAT_M2 = 1e-6  # twice the area that a triangle needs to be seen from above


def warn_solids_over_lanes(subject: CheckInputs) -> Iterator[Diagnostic]:
    """A warning where solids cover lanes in and round the region of interest: the share, the largest, and where."""
    if subject.world is None or subject.carriageway is None:
        return
    import shapely

    low_m, high_m = _surroundings(subject.scenario.roi.box)
    lanes = subject.carriageway.within(low_m, high_m)
    if not lanes.area:
        return
    shapely.prepare(lanes)
    covered = []
    for solid, parts in _solids_in_the_way(subject.world, subject.carriageway, low_m, high_m).items():
        shape = shapely.union_all(parts)
        common = shapely.intersection(shape, lanes)
        if common.area >= clearances.MIN_COVERED_M2 or (common.area > 0 and shapely.intersects(lanes, shape.centroid)):
            covered.append((common, solid))
    if not covered:
        return
    covered.sort(key=lambda item: (-item[0].area, item[1]))
    share = shapely.union_all([common for common, _ in covered]).area / lanes.area
    named = ", ".join(_describe_solid(subject.world, common, solid) for common, solid in covered[:MAX_NAMED_SOLIDS])
    more = f", and {len(covered) - MAX_NAMED_SOLIDS} more" if len(covered) > MAX_NAMED_SOLIDS else ""
    count = f"{len(covered)} solids cover" if len(covered) > 1 else "a solid covers"
    what = f"{count} {share:.1%} of the lanes in and round the region: {named}{more}"
    cure = "move or lift them, or look at their coordinates: traffic would drive through them"
    yield Diagnostic("solids over lanes", "statics", what, cure)


def warn_solids_far_away(subject: CheckInputs) -> Iterator[Diagnostic]:
    """A warning where all that stands is far from the region of interest."""
    if subject.world is None:
        return
    world, box = subject.world, subject.scenario.roi.box
    low, high = world.bounds_xy_m
    standing = np.array([kind != "ground" for _, kind in world.solids], dtype=np.bool_)[world.solid_of_face]
    if not standing.any():
        return
    first, last = np.asarray(box.origin_m[:2]), np.add(box.origin_m, box.size_m)[:2]
    gaps = np.maximum(np.maximum(first - high[standing], low[standing] - last), 0.0)
    nearest_m = float(np.hypot(gaps[:, 0], gaps[:, 1]).min())
    if nearest_m > clearances.MAX_STATICS_DISTANCE_M:
        middle = (low[standing].min(axis=0) + high[standing].max(axis=0)) / 2.0
        what = (
            f"the nearest solid is {nearest_m:,.0f} m from the region of interest; all lie round "
            f"{_format_position(middle)}"
        )
        yield Diagnostic("statics far away", "statics", what, "the network's coordinates, in metres")


def _solids_in_the_way(
    world: World, carriageway: Carriageway, low_m: NDArray[np.float64], high_m: NDArray[np.float64]
) -> dict[int, list[object]]:
    """Solid -> its parts, seen from above, that are in the way on some lane of a rectangle."""
    import shapely

    low, high = world.bounds_xy_m
    corners = world.triangles_m
    (ax, ay), (bx, by) = (corners[:, 1] - corners[:, 0])[:, :2].T, (corners[:, 2] - corners[:, 0])[:, :2].T
    near = (low <= high_m).all(axis=1) & (high >= low_m).all(axis=1) & (np.abs(ax * by - ay * bx) > _FLAT_M2)
    near &= np.array([kind != "ground" for _, kind in world.solids], dtype=np.bool_)[world.solid_of_face]
    faces = np.flatnonzero(near)
    shapes = shapely.polygons(corners[faces][:, :, :2])
    tops = np.full(len(world.solids), -np.inf)
    np.maximum.at(tops, world.solid_of_face, corners[:, :, 2].max(axis=1))
    parts: dict[int, dict[int, object]] = {}
    for shape, lane in carriageway.touching(shapes).T:
        face = int(faces[shape])
        solid, z = int(world.solid_of_face[face]), corners[face, :, 2]
        road_m = carriageway.height_m(int(lane), corners[face, :, :2].mean(axis=0))
        top_m = tops[solid] if world.closed[solid] else z.max()
        if z.min() - road_m < clearances.CLEARANCE_M and top_m - road_m > clearances.KERB_M:
            parts.setdefault(solid, {})[face] = shapes[shape]
    return {solid: list(of.values()) for solid, of in parts.items()}


def _surroundings(box: Roi) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low = np.asarray(box.origin_m[:2])
    return low - clearances.ROI_MARGIN_M, low + np.asarray(box.size_m[:2]) + clearances.ROI_MARGIN_M


def _describe_solid(world: World, common: object, solid: int) -> str:
    name, kind = world.solids[solid]
    spot = common.representative_point()  # type: ignore[attr-defined]
    return f"{name} ({kind}) {common.area:.0f} m2 at {_format_position((spot.x, spot.y))}"  # type: ignore[attr-defined]


def _format_position(xy_m: tuple[float, float] | NDArray[np.float64]) -> str:
    return f"({xy_m[0]:.0f}, {xy_m[1]:.0f})"
