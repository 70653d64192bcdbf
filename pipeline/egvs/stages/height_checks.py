"""Rules for heights without a common zero: roads, solids, sites, terrain and recorded traffic near the region.

Heights above sea level beside a road at z = 0 make solids, or vehicles, float where no beam meets them. So heights are
compared with those of the road beside them (of the traffic, where there is no network), in z of the world frame:

- A solid floats if its foot is higher above the road than a slope of :data:`MAX_SLOPE` explains and above all sensors,
  and no other solid carries it. It is buried if its roof is lower below the road than such a slope explains. Solids
  over lanes, bridges and crowns float only above :data:`MAX_ELEVATED_M`, other thin solids above :data:`MAX_BESIDE_M`.
- Solids with the same offset as those count, too. If they are most of those that stand on the ground, the file has
  another zero, which is an error. Single ones are a warning, and so are files most of whose solids are above the road.
- Vehicles are compared with the lanes below them, lanes with the points of the terrain, sensors with the road and with
  the ground, the lowest road with the floor of the region.
- Solids higher than any building, and a region where all solids are as high as towers, get a warning.

Hillside houses, decks, bridges and elevated roads are valid: a slope, another solid or the terrain explains them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.core import polylines
from egvs.core.errors import Diagnostic, InputError
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.core.wording import by_number, format_percent, list_first, number_of
from egvs.scenario.model import TERRAIN_KEY
from egvs.sensors.site_feasibility import ground_height_m
from egvs.sensors.sites import Pose
from egvs.stages.inputs import CheckInputs
from egvs.world import clearances
from egvs.world.carriageway import Carriageway
from egvs.world.footprints import box_pairs
from egvs.world.mesh import World
from egvs.world.static_world import SolidSource

RULE = "heights"

MAX_SLOPE = 1.0
"""Steepest slope, rise over distance, between a road and what stands beside it: retaining walls included."""

MARGIN_M = 3.0
"""Differences up to this need no explanation: embankments, basements, floors on stilts."""

MAX_ELEVATED_M = 40.0
"""Decks, roofs and viaducts are at most this high above a road, or a road above the terrain."""

MAX_DECK_M = 3.0
"""A solid no thicker than this may be a roof, a sign or the deck of a railway beside the road,"""

MAX_BESIDE_M = 20.0
"""at most this high."""

MAX_BUILDING_M = 830.0
"""The highest building of the world has this height."""

MIN_TOWER_M = 100.0
"""Not all of several solids are higher than this,"""

MIN_TOWERS = 5
"""if there are this many."""

MIN_SENSOR_M = 1.0
"""Sensors lower than this above the ground get a warning: cars hide everything from them."""

MAX_BELOW_ROADS = 0.3
"""Largest part of the height of the region that may be below all roads in it."""

MAX_SENSOR_M = 20.0
"""Sensors higher than this above the road, without a solid that carries them, get a warning."""

_OVERHEAD_KINDS = ("bridge", "roof", "tree_crown", "tree", "foliage")
_AROUND_M = 20.0
"""The road beside a solid is that within this distance more than the nearest point of it."""

_ROAD_M = 300.0
_STEP_M = 5.0
_MAX_POINTS = 2_000_000
_TOUCH_M = 1.0
_LANE_REACH_M = 10.0
_MAX_SAMPLES = 2000
_MAX_LISTED = 3


@dataclass(frozen=True)
class Reference:
    """Where vehicles drive: what solids and sensors are compared with.

    Attributes
    ----------
    name
        ``"the road"`` or ``"the traffic"``, for messages.
    points_m
        Points of it, (n, 3), world frame.
    """

    name: str
    points_m: FloatArray

    @classmethod
    def of_lanes(cls, inputs: CheckInputs) -> Reference | None:
        """Return the centre lines of the lanes near the region; None without a network."""
        if inputs.carriageway is None:
            return None
        points_m = lane_points_m(inputs.carriageway)
        low_m, high_m = _near_region_m(inputs)
        is_near = np.all((points_m[:, :2] > low_m - _ROAD_M) & (points_m[:, :2] < high_m + _ROAD_M), axis=1)
        return cls("the road", points_m[is_near] if is_near.any() else points_m)

    def beside(self, boxes: NDArray[Any]) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the distance (n,) to rectangles, and the lowest and highest z beside each."""
        import shapely

        tree = shapely.STRtree(shapely.points(self.points_m[:, :2]))
        (rows, _), distances_m = tree.query_nearest(boxes, return_distance=True, all_matches=False)
        distance_m = np.empty(len(boxes))
        distance_m[rows] = distances_m
        low_m = np.full(len(boxes), np.inf)
        high_m = np.full(len(boxes), -np.inf)
        rows, points = tree.query(boxes, "dwithin", distance_m + _AROUND_M)
        np.minimum.at(low_m, rows, self.points_m[points, 2])
        np.maximum.at(high_m, rows, self.points_m[points, 2])
        return distance_m, low_m, high_m


def lane_points_m(carriageway: Carriageway) -> FloatArray:
    """Return points (n, 3) along the centre lines of all lanes, a few metres apart; farther where there are many."""
    step_m = max(_STEP_M, sum(polylines.length_m(lane.shape_m) for lane in carriageway.lanes) / _MAX_POINTS)
    points = []
    for lane in carriageway.lanes:
        starts, steps = lane.shape_m[:-1], np.diff(lane.shape_m, axis=0)
        counts = np.ceil(np.hypot(steps[:, 0], steps[:, 1]) / step_m).astype(int)
        for start, step, count in zip(starts, steps, np.maximum(counts, 1), strict=True):
            points.append(start + step * (np.arange(count) / count)[:, None])
        points.append(lane.shape_m[-1:])
    return np.concatenate(points)


def _near_region_m(inputs: CheckInputs) -> tuple[FloatArray, FloatArray]:
    """Return the corners (2,) of the region and all sites, with a margin: what is between them can hide something."""
    box = inputs.scenario.roi.box
    corners = [np.asarray(box.origin_m[:2]), np.add(box.origin_m, box.size_m)[:2]]
    corners += [np.array([site.pose.x_m, site.pose.y_m]) for site in inputs.sites]
    points = np.array(corners)
    return points.min(axis=0) - clearances.ROI_MARGIN_M, points.max(axis=0) + clearances.ROI_MARGIN_M


# --- solids, sites and terrain


def warn_low_sites(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn about sensors close to the ground, on which beams with traffic in the way end."""
    if inputs.world is None or not inputs.scenario.statics.ground:
        return
    low = {}
    for site in inputs.sites:
        above_m = site.pose.z_m - ground_height_m(inputs.world, site.pose)
        if site.points is None and 0.0 < above_m < MIN_SENSOR_M:
            low[site.name] = above_m
    if low:
        names = list_first(list(low), _MAX_LISTED)
        verb = by_number(len(low), "is", "are")
        lowest_m = min(low.values())
        problem = f"{number_of(len(low), 'sensor')} {verb} less than {MIN_SENSOR_M:g} m above the ground: {names}"
        hint = f"Check z_m (the lowest is {lowest_m:.2g} m above the ground): it is in metres."
        yield Diagnostic(RULE, "sites", problem, hint)


def check_heights(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report solids, sites and terrain whose heights have another zero than the road."""
    reference = Reference.of_lanes(inputs)
    if reference is None:
        return  # check_traffic_heights compares them with the traffic
    yield from compare_scene(inputs, reference)
    yield from _check_terrain(inputs, reference)
    yield from _warn_region_below_roads(inputs, reference)


def compare_scene(inputs: CheckInputs, reference: Reference) -> Iterator[Diagnostic]:
    """Report solids and sites whose heights have another zero than a reference."""
    if inputs.world is not None:
        extents = _Extents.of(inputs.world)
        for source in inputs.solid_sources:
            yield from _check_source(inputs, reference, extents, source)
        yield from _warn_tall_solids(inputs, extents)
        yield from _warn_high_sites(inputs, reference, extents)


@dataclass(frozen=True)
class _Extents:
    """Corners of each solid, (n, 3) each, and whether it has triangles and is no ground."""

    low_m: FloatArray
    high_m: FloatArray
    is_solid: BoolArray

    @classmethod
    def of(cls, world: World) -> _Extents:
        low_m = np.full((len(world.solids), 3), np.inf)
        high_m = np.full((len(world.solids), 3), -np.inf)
        np.minimum.at(low_m, world.solid_of_face, world.triangles_m.min(axis=1))
        np.maximum.at(high_m, world.solid_of_face, world.triangles_m.max(axis=1))
        is_ground = np.array([kind == "ground" for _, kind in world.solids], dtype=np.bool_)
        return cls(low_m, high_m, np.isfinite(low_m[:, 0]) & ~is_ground)

    def boxes(self, solids: IntArray) -> NDArray[Any]:
        """Return rectangles in plan."""
        import shapely

        boxes: NDArray[Any] = shapely.box(*self.low_m[solids, :2].T, *self.high_m[solids, :2].T)
        return boxes

    def carried(self, solids: IntArray) -> BoolArray:
        """Return which solids stand on another one, or in it."""
        others = np.flatnonzero(self.is_solid)
        carried = np.zeros(len(solids), dtype=np.bool_)
        for pairs, below in box_pairs(self.boxes(solids), self.boxes(others)):
            first, second = solids[pairs], others[below]
            foot_m = self.low_m[first, 2]
            carries = (self.low_m[second, 2] < foot_m - _TOUCH_M) & (self.high_m[second, 2] >= foot_m - _TOUCH_M)
            carried[pairs[carries & (first != second)]] = True
        return carried


def _check_source(
    inputs: CheckInputs, reference: Reference, extents: _Extents, source: SolidSource
) -> Iterator[Diagnostic]:
    """Compare the solids of a file near the region with the road beside each of them."""
    assert inputs.world is not None
    near_low_m, near_high_m = _near_region_m(inputs)
    solids = np.arange(source.first, source.end)
    is_near = (extents.low_m[solids, :2] <= near_high_m).all(axis=1)
    is_near &= (extents.high_m[solids, :2] >= near_low_m).all(axis=1)
    solids = solids[is_near & extents.is_solid[solids]]
    if not solids.size:
        return
    boxes = extents.boxes(solids)
    distance_m, low_m, high_m = reference.beside(boxes)
    allowed_m = MAX_SLOPE * distance_m + MARGIN_M
    foot_m, roof_m = extents.low_m[solids, 2], extents.high_m[solids, 2]
    above_m, below_m = foot_m - high_m, low_m - roof_m
    overhead_m = _overhead_heights_m(inputs, extents, solids, boxes)
    is_carried = extents.carried(solids)
    stands = (overhead_m == 0) & ~is_carried
    sensors_m = max((site.pose.z_m for site in inputs.sites), default=-np.inf)
    hides_nothing = (foot_m > sensors_m) | (above_m > allowed_m + MAX_ELEVATED_M)

    floats = ~is_carried & (above_m > np.maximum(allowed_m, overhead_m)) & hides_nothing
    floats |= stands & _has_offset_of(floats, above_m)
    is_buried = below_m > allowed_m
    is_buried |= stands & (below_m > 0) & _has_offset_of(is_buried, low_m - foot_m)
    is_high, is_low = stands & (above_m > MARGIN_M), stands & (below_m > 0)
    if inputs.scenario.statics.terrain is not None:  # the ground is known: cliffs, and roads on bridges
        for number in np.flatnonzero(floats | is_buried | is_high | is_low):
            ground_m = _ground_below_m(inputs.world, boxes[number])
            is_above, is_below = foot_m[number] > ground_m + MARGIN_M, roof_m[number] < ground_m
            floats[number] &= is_above
            is_high[number] &= is_above
            is_buried[number] &= is_below
            is_low[number] &= is_below
    total = int((stands | floats | is_buried).sum())
    names = [inputs.world.solids[solid][0] for solid in solids]
    for is_off, is_doubtful, offset_m, side in (
        (floats, is_high, above_m, "above"),
        (is_buried, is_low, below_m, "below"),
    ):
        if is_off.any():
            is_error = 2 * int(is_off.sum()) > total
            yield _solid_diagnostic(source, reference, is_off, total, offset_m, names, side, is_error=is_error)
        elif 2 * int(is_doubtful.sum()) > total:
            yield _solid_diagnostic(source, reference, is_doubtful, total, offset_m, names, side, is_error=False)


def _has_offset_of(is_off: BoolArray, offset_m: FloatArray) -> BoolArray:
    """Return which solids have the same offset as those that no slope explains: a slope would depend on distance."""
    if not is_off.any():
        return is_off
    return np.abs(offset_m - np.median(offset_m[is_off])) <= MARGIN_M


def _overhead_heights_m(inputs: CheckInputs, extents: _Extents, solids: IntArray, boxes: NDArray[Any]) -> FloatArray:
    """Return how high solids may be above the road without a slope, as decks, roofs, signs or crowns; 0 for others."""
    assert inputs.world is not None
    thickness_m = extents.high_m[solids, 2] - extents.low_m[solids, 2]
    heights_m = np.where(thickness_m <= MAX_DECK_M, MAX_BESIDE_M, 0.0)
    is_overhead = np.array([inputs.world.solids[solid][1].lower() in _OVERHEAD_KINDS for solid in solids], dtype=bool)
    if inputs.carriageway is not None:
        is_overhead[np.unique(inputs.carriageway.touching(boxes)[0])] = True
    heights_m[is_overhead] = MAX_ELEVATED_M
    return heights_m


def _ground_below_m(world: World, box: Any) -> float:
    return ground_height_m(world, Pose(box.centroid.x, box.centroid.y, 0.0))


def _solid_diagnostic(
    source: SolidSource,
    reference: Reference,
    is_off: BoolArray,
    total: int,
    offset_m: FloatArray,
    names: list[str],
    side: str,
    *,
    is_error: bool,
) -> Diagnostic:
    """Return the finding on solids of a file that are higher or lower than the road beside them."""
    count = int(is_off.sum())
    median_m = float(np.median(offset_m[is_off]))
    part, change_m = ("foot", -median_m) if side == "above" else ("roof", median_m)
    listed = list_first([names[number] for number in np.flatnonzero(is_off)], _MAX_LISTED)
    verb = f"{by_number(count, 'has its', 'have their')} {part} {median_m:,.1f} m {side} {reference.name} beside"
    pronoun = by_number(count, "it", "them (median)")
    problem = f"{count} of {number_of(total, 'solid')} near the region {verb} {pronoun}: {listed}"
    return Diagnostic(RULE, source.where, problem, source.zero_hint(change_m), is_error=is_error)


def _warn_tall_solids(inputs: CheckInputs, extents: _Extents) -> Iterator[Diagnostic]:
    """Warn for each file with a solid higher than any building, or near the region only with solids like towers."""
    assert inputs.world is not None
    near_low_m, near_high_m = _near_region_m(inputs)
    is_near = np.all((extents.low_m[:, :2] <= near_high_m) & (extents.high_m[:, :2] >= near_low_m), axis=1)
    height_m = extents.high_m[:, 2] - extents.low_m[:, 2]
    for source in inputs.solid_sources:
        solids = np.arange(source.first, source.end)
        solids = solids[extents.is_solid[solids]]
        tall = solids[height_m[solids] > MAX_BUILDING_M]
        near = solids[is_near[solids]]
        if tall.size:
            listed = list_first([inputs.world.solids[solid][0] for solid in tall], _MAX_LISTED)
            verb = by_number(len(tall), "is", "are")
            problem = (
                f"{number_of(len(tall), 'solid')} {verb} higher than any building ({MAX_BUILDING_M:g} m): {listed}"
            )
        elif len(near) >= MIN_TOWERS and height_m[near].min() > MIN_TOWER_M:
            problem = f"all {len(near)} solids near the region are more than {height_m[near].min():,.0f} m high"
        else:
            continue
        hint = "Use heights in metres above the foot of each solid, not above sea level."
        yield Diagnostic(RULE, source.where, problem, hint)


def _warn_region_below_roads(inputs: CheckInputs, reference: Reference) -> Iterator[Diagnostic]:
    """Warn about a region of interest with much of its height below all roads in it."""
    box = inputs.scenario.roi.box
    low_m, high_m = np.asarray(box.origin_m), np.add(box.origin_m, box.size_m)
    points_m = reference.points_m
    points_m = points_m[np.all((points_m[:, :2] >= low_m[:2]) & (points_m[:, :2] <= high_m[:2]), axis=1)]
    if not len(points_m):
        return
    road_m = float(points_m[:, 2].min())
    share = (road_m - low_m[2]) / (high_m[2] - low_m[2])
    if MAX_BELOW_ROADS < share < 1.0:
        problem = (
            f"{format_percent(share)} of the region's height is below all roads: it extends from z = {low_m[2]:g} to"
            f" {high_m[2]:g} m, and the lowest road is at z = {road_m:.1f} m"
        )
        hint = f"center_m is the centre of the region, not its floor: use z = {road_m + box.size_m[2] / 2:.4g}."
        yield Diagnostic(RULE, f"{inputs.scenario.file}: roi", problem, hint)


def _warn_high_sites(inputs: CheckInputs, reference: Reference, extents: _Extents) -> Iterator[Diagnostic]:
    """Warn if all sensors are far above the road, and no solid carries them."""
    import shapely

    if not inputs.sites:
        return
    positions_m = np.array([site.pose.position_m for site in inputs.sites])
    points = shapely.points(positions_m[:, :2])
    distance_m, _, high_m = reference.beside(points)
    above_m = positions_m[:, 2] - high_m
    is_high = above_m > MAX_SLOPE * distance_m + MAX_SENSOR_M
    if not is_high.all():
        return
    solids = np.flatnonzero(extents.is_solid)
    carries = np.zeros(len(points), dtype=np.bool_)
    rows, others = shapely.STRtree(extents.boxes(solids)).query(points, "dwithin", 2.0 * _TOUCH_M)
    reaches = extents.high_m[solids[others], 2] > positions_m[rows, 2] - MAX_SENSOR_M
    carries[rows[reaches]] = True
    if carries.all():
        return
    problem = f"all sensors are {float(np.median(above_m)):,.1f} m above {reference.name} beside them (median)"
    yield Diagnostic(RULE, "sites", problem, "Check z_m: it counts from z = 0 of the world frame, as the roads do.")


def _check_terrain(inputs: CheckInputs, reference: Reference) -> Iterator[Diagnostic]:
    """Report a terrain above or far below all lanes near the region."""
    name = inputs.scenario.statics.terrain
    if name is None:
        return

    from scipy.spatial import KDTree

    from egvs.effects.slope import read_ground_points

    try:
        ground_m = read_ground_points(inputs.scenario.find(name, TERRAIN_KEY))
    except InputError:
        return  # the static world reports it
    low_m, high_m = _near_region_m(inputs)
    lanes_m = reference.points_m
    lanes_m = lanes_m[np.all((lanes_m[:, :2] >= low_m) & (lanes_m[:, :2] <= high_m), axis=1)]
    if not len(lanes_m) or not len(ground_m):
        return
    distance_m, nearest = KDTree(ground_m[:, :2]).query(lanes_m[:, :2])
    above_m = lanes_m[:, 2] - ground_m[nearest, 2]
    unexplained_m = np.abs(above_m) - MAX_SLOPE * distance_m - MARGIN_M
    is_off = (unexplained_m > 0) & (np.sign(above_m) == np.sign(np.median(above_m)))
    if 2 * is_off.sum() <= len(lanes_m):
        return
    median_m = float(np.median(above_m[is_off]))
    side = "above" if median_m > 0 else "below"
    problem = f"the road near the region is {abs(median_m):,.1f} m {side} the points of the terrain (median)"
    hint = f"Use heights with the zero of the network: add {median_m:+,.1f} m to z of the terrain."
    is_error = median_m > MAX_ELEVATED_M or median_m < -MARGIN_M
    yield Diagnostic(RULE, f"{TERRAIN_KEY} = {name!r}", problem, hint, is_error=is_error)


# --- recorded traffic


def compare_traffic(
    inputs: CheckInputs, carriageway: Carriageway | None, traffic_m: FloatArray, where: str
) -> Iterator[Diagnostic]:
    """Report vehicles whose heights have another zero than the lanes, or else than the ground and the solids.

    Parameters
    ----------
    inputs
        The inputs.
    carriageway
        The lanes that they drive on; None without a network.
    traffic_m
        Positions of vehicles near the region, on the road, (n, 3), world frame.
    where
        The key of the recording, for messages.
    """
    if not len(traffic_m):
        return
    traffic_m = traffic_m[:: -(-len(traffic_m) // _MAX_SAMPLES)]
    if carriageway is not None:
        yield from _compare_with_lanes(carriageway, traffic_m, where)
        return
    z_m = float(np.median(traffic_m[:, 2]))
    if inputs.world is None:
        return
    is_off = inputs.scenario.statics.ground and abs(z_m) > clearances.KERB_M + _TOUCH_M
    if is_off and not _is_on_solids(inputs.world, traffic_m):
        side = "above" if z_m > 0 else "below"
        problem = f"vehicles drive {abs(z_m):,.1f} m {side} the ground at z = 0 (median), since no network is named"
        hint = f"Name their network in traffic.roads, so that the ground has its height, or add {-z_m:+,.1f} m to z."
        is_error = abs(z_m) > MARGIN_M
        yield Diagnostic(RULE, where, problem, hint, is_error=is_error)
        if is_error:
            return
    yield from compare_scene(inputs, Reference("the traffic", traffic_m))


def _compare_with_lanes(carriageway: Carriageway, traffic_m: FloatArray, where: str) -> Iterator[Diagnostic]:
    """Compare vehicles with the lane below them that is nearest in height."""
    from scipy.spatial import KDTree

    lanes_m = lane_points_m(carriageway)
    around = KDTree(lanes_m[:, :2]).query_ball_point(traffic_m[:, :2], _LANE_REACH_M)
    offsets_m = []
    for z_m, lanes in zip(traffic_m[:, 2], around, strict=True):
        if lanes:
            heights_m = z_m - lanes_m[lanes, 2]
            offsets_m.append(float(heights_m[np.abs(heights_m).argmin()]))
    if not offsets_m:
        return
    median_m = float(np.median(offsets_m))
    is_error = abs(median_m) > MARGIN_M
    if abs(median_m) <= clearances.KERB_M + _TOUCH_M:
        return
    side = "above" if median_m > 0 else "below"
    z_m = float(np.median(traffic_m[:, 2]))
    problem = f"vehicles drive {abs(median_m):,.1f} m {side} their lanes (median; at z = {z_m:,.1f} m)"
    hint = f"Use z of the network for both: add {-median_m:+,.1f} m to z of the vehicles."
    if z_m == 0:
        hint = "Write z as well: --fcd-output.attributes id,x,y,z,angle,slope,type,speed."
    yield Diagnostic(RULE, where, problem, hint, is_error=is_error)


def _is_on_solids(world: World, traffic_m: FloatArray) -> bool:
    """Return whether most vehicles are on a surface of the static world, such as the mesh of a road."""
    import shapely

    samples_m = traffic_m[:: -(-len(traffic_m) // 100)]
    low, high = world.bounds_xy_m
    faces = np.flatnonzero(
        np.array([kind != "ground" for _, kind in world.solids], dtype=np.bool_)[world.solid_of_face]
    )
    if not faces.size:
        return False
    tree = shapely.STRtree(shapely.box(*low[faces].T, *high[faces].T))
    rows, below = tree.query(shapely.points(samples_m[:, :2]), "intersects")
    z_m = world.triangles_m[faces[below], :, 2]
    is_near = (z_m.min(axis=1) <= samples_m[rows, 2] + _TOUCH_M) & (z_m.max(axis=1) >= samples_m[rows, 2] - MARGIN_M)
    return 2 * len(np.unique(rows[is_near])) > len(samples_m)
