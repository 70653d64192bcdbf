"""Rules for the region of interest, sites, sensors, effects and solids.

A solid is in the way of a lane where it is lower than :data:`egvs.world.clearances.CLEARANCE_M` above the road. Of a
closed solid, all triangles with such a lower edge count; of an open surface, only those that also reach above
:data:`egvs.world.clearances.KERB_M`, so that terrain, or the road itself, does not count. They are compared with the
areas of the lanes in plan.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any

import numpy as np

from egvs.core.errors import Diagnostic, InputError
from egvs.core.grid import FloatArray, Roi
from egvs.core.wording import by_number, format_percent, list_first, number_of, shorten_id
from egvs.effects import registry
from egvs.effects.base import Effect
from egvs.kernels import ray_triangle
from egvs.scenario.model import SCENARIO_FILE
from egvs.sensors import sensor, site_feasibility
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor, rotation_world_sensor, scenario_sensor
from egvs.sensors.sites import Site
from egvs.stages import scene_inputs, solid_readings
from egvs.stages.inputs import CheckInputs, ErrorCollector
from egvs.traffic import sumo_folder
from egvs.traffic.network import Network
from egvs.traffic.road_lanes import LEVEL_M
from egvs.world import clearances, geolocation, supports
from egvs.world.carriageway import Carriageway
from egvs.world.mesh import World


def check_lanes_in_region(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report a region of interest without lanes, or with all lanes above or below it."""
    if inputs.network is None:
        return
    box = inputs.scenario.roi.box
    low_m = np.asarray(box.origin_m)
    high_m = np.add(box.origin_m, box.size_m)
    key = f"{inputs.scenario.file}: roi"
    hint = "Set center_m to a point on the road, in the coordinates of the network."
    if inputs.carriageway is None:
        yield Diagnostic("region", key, "the network has no lane for road vehicles", hint, is_error=True)
        return
    distance_m = inputs.carriageway.distance_m(low_m.tolist(), high_m.tolist())
    if distance_m > 0:
        (x0, y0), (x1, y1) = inputs.carriageway.bounds_m
        extent = f"lanes extend from ({x0:.0f}, {y0:.0f}) to ({x1:.0f}, {y1:.0f})"
        problem = f"no lane passes through the region: the nearest is {distance_m:,.1f} m away, {extent}"
        yield Diagnostic("region", key, problem, hint, is_error=True)
        return
    centre_m = (low_m + high_m)[:2] / 2.0
    roads_m = inputs.carriageway.heights_in(low_m, high_m)
    if not np.any((roads_m <= high_m[2]) & (roads_m + clearances.CLEARANCE_M >= low_m[2])):
        road_m = inputs.carriageway.height_m(inputs.carriageway.nearest(centre_m), centre_m)
        problem = f"the region extends from z = {low_m[2]:g} to {high_m[2]:g} m, but the road is at z = {road_m:.1f} m"
        yield Diagnostic("region", key, problem, hint, is_error=True)


def check_period_networks(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report periods whose own network has no lane in the region, or another origin than that of the first period."""
    scenario = inputs.scenario
    errors = ErrorCollector()
    for period, period_scenario in scenario.by_period().items():
        if not period:
            continue
        network = errors.attempt("network", partial(sumo_folder.read_network, period_scenario))
        if network is None or network is inputs.network:
            continue
        key = f"{scenario.file}: traffic.periods ({period})"
        difference = None
        if inputs.network is not None and inputs.network.location is not None and network.location is not None:
            difference = geolocation.location_difference(network.location, inputs.network.location)
        if difference is not None:
            statements = "{} instead of {}".format(*difference)
            problem = f"its network has another origin or projection than that of the first period ({statements})"
            hint = "Use networks of one extract and one projection, so that all periods share a world frame."
            yield Diagnostic("region", key, problem, hint, is_error=True)
            continue
        box = scenario.roi.box
        distance_m = Carriageway.of(network).distance_m(box.origin_m, np.add(box.origin_m, box.size_m))
        if distance_m > 0:
            problem = f"no lane of its network passes through the region: the nearest is {distance_m:,.1f} m away"
            hint = "Use a network in the coordinates of the others."
            yield Diagnostic("region", key, problem, hint, is_error=True)
    yield from errors.findings


MAX_LISTED_BEAMS = 5
"""Number of repeated beams of a table that are listed."""


def check_sensors_known(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report each sensor that is unknown, or whose beam table is wrong, and the sites that name it."""
    sites: dict[str, list[str]] = {}
    for site in inputs.sites:
        sites.setdefault(site.sensor, []).append(site.name)
    for sensor_name, site_names in sites.items():
        where = f"site {list_first(site_names, 1)}"
        try:
            scenario_sensor(sensor_name, inputs.scenario, where)
        except InputError as error:
            yield Diagnostic.of("sensors", error)


def warn_repeated_beams(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn about beam tables, and rings, that contain a direction twice; a scan pattern may come back to one."""
    scenario = inputs.scenario
    for name in dict.fromkeys(site.sensor for site in inputs.sites):
        config = scenario.sensors.get(name)
        if config is None or config.pattern is not None:
            continue
        try:
            table = scenario_sensor(name, scenario, name).beam_table
        except InputError:
            continue  # check_sensors_known reports it
        repeated = sensor.repeated_beams(table)
        if not repeated:
            continue
        where = config.beams or f"{SCENARIO_FILE}: sensors.{name}.elevations_deg"
        listed = list_first([f"beam {beam} = beam {first}" for beam, first in repeated], MAX_LISTED_BEAMS)
        problem = (
            f"{len(repeated)} of {len(table)} beams have the same direction as an earlier one ({listed})"
            " and count twice"
        )
        hint = "List each direction once; azimuths of 0 and 360 degrees are the same."
        yield Diagnostic("repeated beams", where, problem, hint)


def warn_odd_beams(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn about sensors with fewer beams than any LiDAR has, or with angles that look swapped or like radians."""
    scenario = inputs.scenario
    for name in dict.fromkeys(site.sensor for site in inputs.sites):
        config = scenario.sensors.get(name)
        if config is None:
            continue  # of the catalogue
        try:
            custom = scenario_sensor(name, scenario, name)
        except InputError:
            continue  # check_sensors_known reports it
        where = f"sensors.{name}" if config.beam_file is None else config.beam_file[1]
        few = sensor.describe_few_beams(custom)
        if few is not None:
            yield Diagnostic("few beams", where, few, sensor.FEW_BEAMS_HINT)
        offsets_deg = custom.azimuth_offsets_deg if custom.table is None else ()
        odd = sensor.describe_odd_angles(name, custom.beam_table.elevation_deg, offsets_deg)
        if odd is not None:
            yield Diagnostic("beam angles", where, *odd)


def check_effects(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report each effect that cannot act in this scenario, or lacks something that it needs."""
    if inputs.scene is None or any(check_sensors_known(inputs)):
        return
    for effect in registry.scenario_effects(inputs.scenario, "traffic", "scan", "score", "clouds"):
        yield from _effect_errors(effect, inputs.scene)


def _effect_errors(effect: Effect[Any], scene: Scene) -> Iterator[Diagnostic]:
    errors = ErrorCollector()
    inactive_reason = errors.attempt("effects", lambda: effect.why_idle(scene))
    yield from errors.findings
    if errors.findings or inactive_reason is not None:
        return
    error = effect.refusal(scene)
    if error is not None:
        yield Diagnostic.of("effects", error)


def warn_losses(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn about losses of returns that act twice, and about rated ranges that do not say for which reflectivity."""
    scenario, config = inputs.scenario, inputs.scenario.effects.range_limit
    if config is False:
        return
    if "surface_losses" in scenario.effects.named:
        decision = scene_inputs.scenario_losses(scenario, inputs.sites)
        if decision is None or decision.acting:
            problem = "dark vehicles and windows are part of the losses of returns too: clouds lose these returns twice"
            hint = "Set effects.range_limit = false, or remove surface_losses."
            yield Diagnostic("losses twice", f"{scenario.file}: effects.surface_losses", problem, hint)

    if config is not None and config.rated_reflectivity is not None:
        return
    for name in sorted({site.sensor for site in inputs.sites} & set(scenario.sensors)):
        custom = scenario.sensors[name]
        rated_range_m = (config and config.rated_range_m) or custom.rated_range_m
        if rated_range_m is not None and "rated_reflectivity" not in custom.model_fields_set:
            share = format_percent(custom.rated_reflectivity, 0)
            problem = f"rated_reflectivity is missing: {rated_range_m:g} m are taken as rated for a target of {share}"
            hint = "Enter that of the data sheet, often 0.1."
            yield Diagnostic("rated range", f"{scenario.file}: sensors.{name}", problem, hint)


MAX_LISTED_SITES = 8
"""Number of sites that are listed one by one; the others share a line."""

_ROUNDED_RAD = 0.01
_CACHED_MOUNTS = 4  # 57,600 beams take 1.4 MB; sites with the same mount follow one another


def check_poses(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report sites in a solid, below the ground, or too far away from the region for their sensor.

    Warn about sites none of whose beams, as mounted, meets the region.
    """
    blind = []
    if inputs.scene is None:
        return
    for site in inputs.sites:
        try:
            sensor = inputs.scene.sensor(site.sensor)
        except InputError:
            continue  # check_sensors_known reports it
        try:
            site_feasibility.check_pose(inputs.scene, site.pose, sensor, f"site {site.name}")
        except InputError as error:
            yield Diagnostic.of("sites", error)
            continue
        if site.points is None and not _reaches_region(inputs, site, sensor):
            blind.append(site.name)
    if blind:
        names = list_first(blind, MAX_LISTED_SITES)
        problem = f"{len(blind)} of {len(inputs.sites)} sites have no beam that meets the region of interest: {names}"
        yield Diagnostic("beams beside the region", "sites", problem, "Change yaw, pitch, position or sensor.")


NEAR_M = 5.0
"""Of a sensor within the region, beams that have left it through its top at this distance do not count."""

NOSE_UP_DEG = (30.0, 80.0)
"""Pitches between these get a warning; with 90 degrees, a sensor that turns is mounted sideways."""


def warn_nose_up(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn about sensors that are pitched far up."""
    low_deg, high_deg = NOSE_UP_DEG
    names = [site.name for site in inputs.sites if low_deg < site.pose.pitch_deg < high_deg and site.points is None]
    if names:
        verb = by_number(len(names), "points", "point")
        listed = list_first(names, MAX_LISTED_SITES)
        problem = f"{number_of(len(names), 'sensor')} {verb} more than {low_deg:g} degrees up: {listed}"
        yield Diagnostic("nose up", "sites", problem, "Positive pitch_deg is nose up; use a negative one to look down.")


_MAX_UPWARD_SHARE = 0.51
"""Largest share of beams above the horizon without a warning: half of them, and a margin for offsets of azimuths."""

_HORIZONTAL = 1e-9


def warn_upward_beams(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn about each sensor most of whose beams, as mounted, point above the horizon; of the catalogue, by its mount.

    Sensors that are pitched far up are left to :func:`warn_nose_up`.
    """
    if inputs.scene is None:
        return
    low_deg, high_deg = NOSE_UP_DEG
    upward: dict[str, dict[str, float]] = {}
    sites = {site.name: site for site in inputs.sites if site.points is None}
    for name, site in sites.items():
        try:
            mounted = inputs.scene.sensor(site.sensor)
        except InputError:
            continue  # check_sensors_known reports it
        share = _upward_share(mounted, site.pose.pitch_deg, site.pose.roll_deg)
        most = _MAX_UPWARD_SHARE
        if site.sensor not in inputs.scenario.sensors:
            most = max(most, _upward_share(mounted, 0.0, 0.0))
        if share > most and not low_deg < site.pose.pitch_deg < high_deg:
            upward.setdefault(site.sensor, {})[name] = share
    for sensor_name, shares in upward.items():
        mount = " (upside down)" if all(sites[name].pose.is_inverted for name in shares) else ""
        least, greatest = (format_percent(end(shares.values()), 0) for end in (min, max))
        problem = (
            f"{least if least == greatest else f'{least} to {greatest}'} of the beams point above the horizon at"
            f" {number_of(len(shares), 'site')}{mount}: {list_first(list(shares), MAX_LISTED_SITES)}"
        )
        hint = 'Elevations are those of the upright sensor; mount = "inverted" or roll_deg = 180 turns them over.'
        yield Diagnostic("upward beams", f"sensors.{sensor_name}", problem, hint)


@lru_cache(maxsize=1024)
def _upward_share(sensor: Sensor, pitch_deg: float, roll_deg: float) -> float:
    """Return the share of the beams of a mounted sensor that point above the horizon."""
    up = rotation_world_sensor(0.0, pitch_deg, roll_deg)[2]
    return float(np.mean(_cached_directions(sensor, (0.0, 0.0, 0.0)) @ up > _HORIZONTAL))


MIN_RADIANS_YAW = 1.5
"""In radians, this is a quarter turn; in degrees, more than a calibration corrects."""


def warn_radians(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn about sites whose angles look like radians: all small, with yaws that are not round and far apart."""
    angles = [abs(angle) for site in inputs.sites for angle in site.pose.angles_deg]
    yaws = dict.fromkeys(site.pose.yaw_deg for site in inputs.sites if site.pose.yaw_deg)
    is_round = any(abs(10.0 * yaw - round(10.0 * yaw)) < 1e-6 for yaw in yaws)
    if len(yaws) < 2 or is_round or max(angles) > 2.0 * math.pi + _ROUNDED_RAD:
        return
    if max(map(abs, yaws)) >= MIN_RADIANS_YAW:
        listed = list_first([f"{yaw:g}" for yaw in yaws], MAX_LISTED_SITES)
        problem = f"expected angles in degrees, got none above 2 pi, with yaws that look like radians: {listed}"
        yield Diagnostic("angles", "sites", problem, "Convert yaw_deg, pitch_deg and roll_deg to degrees.")


def warn_equal_sites(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn about sites with the pose and the sensor of another one: a plan would count one sensor twice."""
    first_names: dict[Hashable, str] = {}
    equal = []
    for site in inputs.sites:
        first = first_names.setdefault((site.pose, site.sensor, site.points), site.name)
        if first != site.name:
            equal.append(f"{site.name} = {first}")
    if equal:
        verb = by_number(len(equal), "has", "have")
        names = list_first(equal, MAX_LISTED_SITES)
        problem = f"{number_of(len(equal), 'site')} {verb} the pose and the sensor of another one: {names}"
        yield Diagnostic("equal sites", "sites", problem, "List each candidate once.")


def warn_sites_on_lanes(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn about each named site in a lane or within a junction, unless it is above the traffic."""
    config = inputs.scenario.sites
    if inputs.carriageway is None or not inputs.sites or (config.file is None and config.only_free):
        return
    on_road = list(_sites_on_road(inputs.sites, inputs.carriageway, inputs.network))
    hint = f"Move it beside the road, or more than {clearances.CLEARANCE_M:g} m above it."
    for site, where in on_road[:MAX_LISTED_SITES]:
        (kerb_m,) = inputs.carriageway.nearest_kerb_m(np.array([site.pose.position_m[:2]]))
        positions = (*site.pose.position_m, where, *kerb_m)
        problem = "({:g}, {:g}, {:g}) is {}; the nearest kerb is at ({:.1f}, {:.1f})".format(*positions)
        yield Diagnostic("sites on lanes", inputs.site_location(site), problem, hint)
    others = on_road[MAX_LISTED_SITES:]
    if others:
        names = ", ".join(site.name for site, _ in others)
        problem = f"{len(others)} more of {len(inputs.sites)} are in lanes or junctions: {names}"
        file = inputs.site_location(others[0][0]).partition(":")[0]
        yield Diagnostic("sites on lanes", file, problem, hint)


def _sites_on_road(
    sites: tuple[Site, ...], carriageway: Carriageway, network: Network | None
) -> Iterator[tuple[Site, str]]:
    """The sites in a lane or within a junction, no higher than the clearance above the road, and where they are."""
    position_m = np.array([site.pose.position_m for site in sites])
    at_m = position_m[:, :2]
    lanes = carriageway.lanes_at(position_m)
    in_junction = carriageway.in_junctions(at_m)
    for number, site in enumerate(sites):
        lane = lanes[number]
        if lane is None and not in_junction[number]:
            continue
        nearest = carriageway.nearest(at_m[number]) if lane is None else lane
        above_m = site.pose.z_m - carriageway.height_m(nearest, at_m[number])
        if not -LEVEL_M <= above_m <= clearances.CLEARANCE_M:
            continue
        yield site, "within a junction" if lane is None else f"in {_describe_lane(carriageway.names[lane], network)}"


def _describe_lane(lane: str, network: Network | None) -> str:
    """Return a lane as a user knows it, by its street or junction, e.g. ``"a lane of Main Street"``."""
    edge_id, _, _ = lane.rpartition("_")
    edges = [] if network is None else network.all_edges
    if not edge_id.startswith(":"):
        name = next((edge.name for edge in edges if edge.id == edge_id), "")
        return f"a lane of {name}" if name else f"lane {lane}"
    node = edge_id[1:].rpartition("_")[0]
    names = dict.fromkeys(edge.name for edge in edges if edge.name and node in (edge.from_node, edge.to_node))
    return f"the junction of {' and '.join(names)}" if names else f"junction {shorten_id(node)}"


@dataclass(frozen=True)
class PoleSurroundings:
    """Where a pole stands.

    Attributes
    ----------
    pole, x_m, y_m
        Its name, and its position in the world frame.
    where
        The street beside it, or the lane or junction that it stands in; empty if there is no network.
    kerb_m
        Distance to the edge of the carriageway; NaN if there is no network.
    wall_m
        Distance to the nearest surface that is not ground, tree or another pole, at most
        :data:`MAX_WALL_M`; NaN if it is farther away.
    """

    pole: str
    x_m: float
    y_m: float
    where: str
    kerb_m: float
    wall_m: float


MAX_WALL_M = 100.0


def pole_surroundings(inputs: CheckInputs) -> tuple[PoleSurroundings, ...]:
    """Return where each pole stands, in the order of the sites, as far as the network and the world are known."""
    by_pole: dict[str, Site] = {}
    for site in inputs.sites:
        by_pole.setdefault(site.pole, site)
    sites = tuple(by_pole.values())
    if not sites:
        return ()
    at_m = np.array([site.pose.position_m[:2] for site in sites])
    where, kerb_m = [""] * len(sites), np.full(len(sites), np.nan)
    if inputs.carriageway is not None and inputs.carriageway.lanes:
        kerb_m = np.hypot(*(inputs.carriageway.nearest_kerb_m(at_m) - at_m).T)
        on_road = {site.pole: place for site, place in _sites_on_road(sites, inputs.carriageway, inputs.network)}
        beside: dict[int, str] = {}
        for number, site in enumerate(sites):
            lane = inputs.carriageway.nearest(at_m[number])
            if lane not in beside:
                name = _describe_lane(inputs.carriageway.names[lane], inputs.network)
                beside[lane] = f"beside {name.removeprefix('a lane of ')}"
            where[number] = on_road.get(site.pole, beside[lane])
    wall_m = np.full(len(sites), np.nan) if inputs.world is None else _wall_distances_m(inputs.world, at_m)
    rows = zip(sites, where, kerb_m.tolist(), wall_m.tolist(), strict=True)
    return tuple(PoleSurroundings(site.pole, site.pose.x_m, site.pose.y_m, *rest) for site, *rest in rows)


def _wall_distances_m(world: World, at_m: FloatArray) -> FloatArray:
    """Return the distance of each point (n, 2) to the nearest wall in plan, (n,); NaN for none."""
    import shapely

    no_wall = ("ground", "tree", "vegetation", *supports.KINDS)
    is_wall = np.array([not kind.lower().startswith(no_wall) for _, kind in world.solids], dtype=np.bool_)
    low_m, high_m = world.bounds_xy_m
    is_near = ((low_m <= at_m.max(axis=0) + MAX_WALL_M) & (high_m >= at_m.min(axis=0) - MAX_WALL_M)).all(axis=1)
    faces = np.flatnonzero(is_near & is_wall[world.solid_of_face])
    corners_m = world.triangles_m[faces][:, :, :2].reshape(-1, 2)
    areas = shapely.convex_hull(shapely.multipoints(corners_m, indices=np.repeat(np.arange(len(faces)), 3)))
    (numbers, _), found_m = shapely.STRtree(areas).query_nearest(
        shapely.points(at_m), max_distance=MAX_WALL_M, return_distance=True, all_matches=False
    )
    distances_m = np.full(len(at_m), np.nan)
    distances_m[numbers] = found_m
    return distances_m


def warn_own_supports(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """List the poles, masts and signs that carry a sensor, which its scan leaves out."""
    if inputs.scene is None:
        return
    carried: dict[int, dict[str, None]] = {}
    for site in inputs.scene.cast_sites:
        for solid in inputs.scene.own_supports(site.pose):
            carried.setdefault(solid, {})[site.pole] = None
    if not carried:
        return
    listed = []
    for solid, poles in carried.items():
        name, kind = inputs.scene.world.solids[solid]
        listed.append(f"{name} ({kind}) at {' and '.join(poles)}")
    count = f"{len(carried)} solids carry sensors and are" if len(carried) > 1 else "a solid carries sensors and is"
    problem = f"{count} left out of their scans: {', '.join(listed)}"
    hint = f"Move sensors that they do not carry more than {supports.MAX_DISTANCE_M:g} m away."
    yield Diagnostic("own supports", "statics", problem, hint)


def warn_dropped_sites(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn how many candidates of a rule are dropped, and why."""
    if inputs.scene is None or not inputs.scene.dropped:
        return
    dropped = inputs.scene.dropped
    counts = Counter(reason for _, reason in dropped)
    reasons = ", ".join(f"{count} {reason}" for reason, count in counts.items())
    candidates = len(dropped) + len(inputs.sites)
    problem = f"{len(dropped)} of {candidates} candidates are dropped, because no pole can stand there ({reasons})"
    key = "sites.grid" if inputs.scenario.sites.grid is not None else "sites.along"
    yield Diagnostic("dropped candidates", key, problem, "List sensors on gantries or islands in a sites file.")


def _reaches_region(inputs: CheckInputs, site: Site, sensor: Sensor) -> bool:
    box = inputs.scenario.roi.box
    directions = _cached_directions(sensor, site.pose.angles_deg)
    start_m, size_m = np.subtract(site.pose.position_m, box.origin_m), np.asarray(box.size_m)
    if np.all((start_m >= 0) & (start_m <= size_m)):
        return bool((start_m[2] + NEAR_M * directions[:, 2] <= size_m[2]).any())  # others look at the sky
    reaches = np.empty(len(directions), dtype=np.bool_)
    ray_triangle.can_meet_box(start_m, directions * sensor.range_m, size_m, reaches)
    return bool(reaches.any())


@lru_cache(maxsize=_CACHED_MOUNTS)
def _cached_directions(sensor: Sensor, angles_deg: tuple[float, float, float]) -> FloatArray:
    return sensor.directions(*angles_deg)


MAX_NAMED_SOLIDS = 5

_FLAT_M2 = 1e-6  # twice the area that a triangle needs to be seen from above


def warn_solids_over_lanes(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn about solids that cover lanes in and around the region of interest."""
    if inputs.world is None or inputs.carriageway is None:
        return
    import shapely

    low_m, high_m = _surroundings(inputs.scenario.roi.box)
    lanes = inputs.carriageway.within(low_m, high_m)
    if not lanes.area:
        return
    shapely.prepare(lanes)
    covered = []
    for solid, parts in _solids_in_the_way(inputs.world, inputs.carriageway, low_m, high_m).items():
        shape = shapely.union_all(parts)
        common = shapely.intersection(shape, lanes)
        if common.area >= clearances.MIN_COVERED_M2 or (common.area > 0 and shapely.intersects(lanes, shape.centroid)):
            covered.append((common, solid))
    if not covered:
        return
    covered.sort(key=lambda item: (-item[0].area, item[1]))
    share = shapely.union_all([common for common, _ in covered]).area / lanes.area
    named = list_first([_describe_solid(inputs.world, common, solid) for common, solid in covered], MAX_NAMED_SOLIDS)
    count = f"{number_of(len(covered), 'solid')} {by_number(len(covered), 'covers', 'cover')}"
    problem = f"{count} {format_percent(share)} of the lanes in and around the region: {named}"
    hint = "Move or lift them, or check their coordinates: traffic would drive through them."
    if share >= solid_readings.MIN_COVERED_SHARE:
        reading = solid_readings.describe_free_readings(inputs.world, lanes, low_m, high_m)
        if reading is not None:
            problem += f"; {reading}, they would cover almost none"
    yield Diagnostic("solids over lanes", "statics", problem, hint)


WALL_M = (2.0, clearances.CLEARANCE_M)
"""Heights above the road between which walls are in the way; parked cars and guard rails are lower."""

MIN_WALL_M2 = 10.0
_MAX_UPRIGHT = 0.3
"""Upright triangles have at most this part of their area in plan."""


def warn_walls_over_lanes(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn about walls across lanes of surfaces without an inside, which have no area in plan."""
    world, carriageway = inputs.world, inputs.carriageway
    if world is None or carriageway is None or world.closed.all():
        return
    import shapely

    low_m, high_m = _surroundings(inputs.scenario.roi.box)
    is_open = ~world.closed & np.array([kind != "ground" for _, kind in world.solids], dtype=np.bool_)
    faces = np.flatnonzero(is_open[world.solid_of_face])
    corners_m = world.triangles_m[faces]
    normals_m2 = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0]) / 2.0
    areas_m2 = np.linalg.norm(normals_m2, axis=1)
    middles_m = corners_m.mean(axis=1)
    is_upright = np.abs(normals_m2[:, 2]) < _MAX_UPRIGHT * areas_m2
    is_upright &= np.all((middles_m[:, :2] >= low_m) & (middles_m[:, :2] <= high_m), axis=1)
    upright = np.flatnonzero(is_upright)
    in_the_way: set[int] = set()
    for row, lane in carriageway.touching(shapely.points(middles_m[upright, :2])).T:
        face = int(upright[row])
        above_m = middles_m[face, 2] - carriageway.height_m(int(lane), middles_m[face, :2])
        if WALL_M[0] <= above_m <= WALL_M[1]:
            in_the_way.add(face)
    listed = sorted(in_the_way)
    solids = world.solid_of_face[faces[listed]]
    wall_m2 = np.bincount(solids, areas_m2[listed], len(world.solids))
    for solid in np.flatnonzero(wall_m2 >= MIN_WALL_M2):
        name, kind = world.solids[solid]
        spot = _format_position(middles_m[listed][solids == solid, :2].mean(axis=0))
        problem = (
            f"walls of {name} ({kind}) are across lanes: {wall_m2[solid]:.0f} m2 between 2 and 4.5 m, around {spot}"
        )
        yield Diagnostic(
            "solids over lanes", "statics", problem, "Check its coordinates, and that z is up in its file."
        )


def warn_repeated_solids(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn about solids that are listed twice; a crown that is dims beams twice."""
    world = inputs.world
    if world is None:
        return
    first_solids: dict[bytes, int] = {}
    repeated = []
    order = np.argsort(world.solid_of_face, kind="stable")
    corners_m = world.triangles_m[order]
    ends = np.searchsorted(world.solid_of_face[order], np.arange(len(world.solids) + 1))
    for solid, (first, end) in enumerate(pairwise(ends)):
        if end > first and first_solids.setdefault(corners_m[first:end].tobytes(), solid) != solid:
            repeated.append(world.solids[solid][0])
    if repeated:
        names = list_first(repeated, MAX_NAMED_SOLIDS)
        verb = by_number(len(repeated), "has", "have")
        problem = f"{number_of(len(repeated), 'solid')} {verb} the shape and the position of another one: {names}"
        yield Diagnostic("repeated solids", "statics", problem, "Remove it from the map, or list each file once.")


def warn_solids_far_away(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn that all solids except the ground are far from the region of interest."""
    if inputs.world is None:
        return
    box = inputs.scenario.roi.box
    low, high = inputs.world.bounds_xy_m
    is_solid = np.array([kind != "ground" for _, kind in inputs.world.solids], dtype=np.bool_)
    faces = is_solid[inputs.world.solid_of_face]
    if not faces.any():
        return
    box_low = np.asarray(box.origin_m[:2])
    box_high = np.add(box.origin_m, box.size_m)[:2]
    gaps = np.maximum(np.maximum(box_low - high[faces], low[faces] - box_high), 0.0)
    nearest_m = float(np.hypot(gaps[:, 0], gaps[:, 1]).min())
    if nearest_m > clearances.MAX_STATICS_DISTANCE_M:
        middle = (low[faces].min(axis=0) + high[faces].max(axis=0)) / 2.0
        distance = f"the nearest solid is {nearest_m:,.0f} m from the region of interest"
        problem = f"{distance}; all solids are around {_format_position(middle)}"
        yield Diagnostic("statics far away", "statics", problem, "Use the coordinates of the network, in metres.")


def _solids_in_the_way(
    world: World, carriageway: Carriageway, low_m: FloatArray, high_m: FloatArray
) -> dict[int, list[object]]:
    """Solid -> its parts, in plan, that are in the way on some lane of a rectangle."""
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


def _surroundings(box: Roi) -> tuple[FloatArray, FloatArray]:
    low = np.asarray(box.origin_m[:2])
    return low - clearances.ROI_MARGIN_M, low + np.asarray(box.size_m[:2]) + clearances.ROI_MARGIN_M


def _describe_solid(world: World, common: object, solid: int) -> str:
    name, kind = world.solids[solid]
    spot = common.representative_point()  # type: ignore[attr-defined]
    return f"{name} ({kind}) {common.area:.0f} m2 at {_format_position((spot.x, spot.y))}"  # type: ignore[attr-defined]


def _format_position(xy_m: tuple[float, float] | FloatArray) -> str:
    return f"({xy_m[0]:.0f}, {xy_m[1]:.0f})"
