"""Rules for solids: none covers the lanes, and they stand where the region of interest is.

Which part of a solid is in the way: for a closed one, the triangles whose underside is lower than
:data:`pipeline.world.limits.CLEARANCE_M` above the road; of an open surface only those that reach above
:data:`pipeline.world.limits.KERB_M` as well, so that a terrain or the road itself is none. Seen from above, they are
held against the lanes' areas.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pipeline.checks.subject import Subject
from pipeline.core.findings import Finding
from pipeline.core.grid import Roi
from pipeline.world import limits
from pipeline.world.carriageway import Carriageway
from pipeline.world.mesh import World

MOST_NAMED = 5

_FLAT_M2 = 1e-6  # twice the area that a triangle needs to be seen from above


def over_lanes(subject: Subject) -> Iterator[Finding]:
    """A warning where solids cover lanes in and round the region of interest: the share, the largest, and where."""
    if subject.world is None or subject.carriageway is None:
        return
    import shapely

    low_m, high_m = _round(subject.scenario.roi.box)
    lanes = subject.carriageway.within(low_m, high_m)
    if not lanes.area:
        return
    shapely.prepare(lanes)
    covered = []
    for solid, parts in _in_the_way(subject.world, subject.carriageway, low_m, high_m).items():
        shape = shapely.union_all(parts)
        common = shapely.intersection(shape, lanes)
        if common.area >= limits.COVERED_M2 or (common.area > 0 and shapely.intersects(lanes, shape.centroid)):
            covered.append((common, solid))
    if not covered:
        return
    covered.sort(key=lambda item: (-item[0].area, item[1]))
    share = shapely.union_all([common for common, _ in covered]).area / lanes.area
    named = ", ".join(_named(subject.world, common, solid) for common, solid in covered[:MOST_NAMED])
    more = f", and {len(covered) - MOST_NAMED} more" if len(covered) > MOST_NAMED else ""
    count = f"{len(covered)} solids cover" if len(covered) > 1 else "a solid covers"
    what = f"{count} {share:.1%} of the lanes in and round the region: {named}{more}"
    cure = "move or lift them, or look at their coordinates: traffic would drive through them"
    yield Finding("solids over lanes", "statics", what, cure)


def far_away(subject: Subject) -> Iterator[Finding]:
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
    if nearest_m > limits.FAR_M:
        middle = (low[standing].min(axis=0) + high[standing].max(axis=0)) / 2.0
        what = f"the nearest solid is {nearest_m:,.0f} m from the region of interest; all lie round {_at(middle)}"
        yield Finding("statics far away", "statics", what, "the network's coordinates, in metres")


def _in_the_way(
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
        if z.min() - road_m < limits.CLEARANCE_M and top_m - road_m > limits.KERB_M:
            parts.setdefault(solid, {})[face] = shapes[shape]
    return {solid: list(of.values()) for solid, of in parts.items()}


def _round(box: Roi) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low = np.asarray(box.origin_m[:2])
    return low - limits.ROUND_ROI_M, low + np.asarray(box.size_m[:2]) + limits.ROUND_ROI_M


def _named(world: World, common: object, solid: int) -> str:
    name, kind = world.solids[solid]
    spot = common.representative_point()  # type: ignore[attr-defined]
    return f"{name} ({kind}) {common.area:.0f} m2 at {_at((spot.x, spot.y))}"  # type: ignore[attr-defined]


def _at(xy_m: tuple[float, float] | NDArray[np.float64]) -> str:
    return f"({xy_m[0]:.0f}, {xy_m[1]:.0f})"
