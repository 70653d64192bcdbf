"""Grid sites of a junction, chosen by a fixed rule: beside the road, far apart, at four heights.

Steps: put a lattice over the region of interest and its surroundings; select the points near a lane where a pole is
possible at every height; choose the one nearest to the middle of the region, then repeatedly the one farthest from all
chosen so far. So the first five of ten locations are spread as well as all ten. Nothing is random: the same junction
has the same locations. World frame, metres.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from egvs.core.errors import InputError
from egvs.sensors import site_feasibility
from egvs.sensors.scene import Scene
from egvs.sensors.sites import Pose, Site
from egvs.world.carriageway import Carriageway

HEIGHTS_M = (2.0, 3.0, 4.5, 6.0)
"""Mounting heights above the ground."""

PLACES = 10
MARGIN_M = 12.0
"""Largest distance of locations from the region of interest."""

ROAD_M = 6.0
"""Largest distance from a lane."""

SPACING_M = 2.0
"""Spacing of the lattice."""


def grid_poses(scene: Scene, carriageway: Carriageway | None, sensor: str, places: int = PLACES) -> tuple[Site, ...]:
    """Return upright sites at ``places`` locations, each at every height; ordered by location, ``g01h2`` first.

    Raises
    ------
    InputError
        Where fewer places are free.
    """
    free = free_at(scene, carriageway, sensor)
    if len(free) < places:
        problem = f"expected {places} free locations beside the road, got {len(free)}"
        raise InputError(f"{scene.scenario.file}: roi", problem, "Use a junction with more space beside its roads.")
    roi = scene.roi
    middle = np.asarray(roi.origin_m)[:2] + np.asarray(roi.size_m)[:2] / 2
    chosen = free[spread(free, middle, places)]
    return tuple(
        site for number, at_m in enumerate(chosen.tolist(), 1) for site in _at_all_heights(scene, at_m, number, sensor)
    )


def free_at(
    scene: Scene, carriageway: Carriageway | None, sensor: str, heights_m: Sequence[float] = HEIGHTS_M
) -> NDArray[np.float64]:
    """Return the points of the lattice where a pole is possible at every height, (n, 2)."""
    near = _near_lanes(_lattice(scene), carriageway)
    each = [_at_all_heights(scene, at_m, number, sensor, heights_m) for number, at_m in enumerate(near.tolist())]
    free = site_feasibility.drop_infeasible([sites[0] for sites in each], scene.world, carriageway).free
    poles = {site.pole for site in free}
    free_points = [
        at_m for at_m, sites in zip(near, each, strict=True) if sites[0].pole in poles and _can_be_mounted(scene, sites)
    ]
    return np.array(free_points, dtype=np.float64).reshape(-1, 2)


def _can_be_mounted(scene: Scene, sites: Sequence[Site]) -> bool:
    """Whether sensors can be mounted: above the ground, in no solid, in range of the region of interest."""
    try:
        for site in sites:
            site_feasibility.check_pose(scene, site.pose, scene.sensor(site.sensor), site.name)
    except InputError:
        return False
    return True


def spread(places_m: NDArray[np.float64], middle_m: NDArray[np.float64], count: int) -> list[int]:
    """Return the chosen points: the nearest to the middle, then the farthest from all chosen (first of equals)."""
    taken = [int(np.argmin(_squares(places_m, middle_m)))]
    far = _squares(places_m, places_m[taken[0]])
    while len(taken) < count:
        taken.append(int(np.argmax(far)))
        far = np.minimum(far, _squares(places_m, places_m[taken[-1]]))
    return taken


def _squares(places_m: NDArray[np.float64], at_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return squared distances, rounded so that equal distances stay equal."""
    squares: NDArray[np.float64] = np.round(((places_m - at_m) ** 2).sum(axis=1), 6)
    return squares


def _lattice(scene: Scene) -> NDArray[np.float64]:
    low = np.asarray(scene.roi.origin_m)[:2] - MARGIN_M
    steps = np.floor((np.asarray(scene.roi.size_m)[:2] + 2 * MARGIN_M) / SPACING_M).astype(int) + 1
    x, y = np.meshgrid(*(np.arange(n) * SPACING_M for n in steps.tolist()), indexing="ij")
    return low + np.column_stack([x.ravel(), y.ravel()])


def _near_lanes(places_m: NDArray[np.float64], carriageway: Carriageway | None) -> NDArray[np.float64]:
    """Return the points near lanes; all of them without a network."""
    if carriageway is None:
        return places_m
    import shapely

    tree = shapely.STRtree(carriageway.areas)
    near = np.unique(tree.query(shapely.points(places_m), "dwithin", distance=ROAD_M)[0])
    free_points: NDArray[np.float64] = places_m[near]
    return free_points


def _at_all_heights(
    scene: Scene, at_m: Sequence[float], number: int, sensor: str, heights_m: Sequence[float] = HEIGHTS_M
) -> list[Site]:
    x_m, y_m = at_m
    ground_m = (
        site_feasibility.ground_height_m(scene.world, Pose(x_m, y_m, 0.0)) if scene.scenario.statics.ground else 0.0
    )
    pole = f"g{number:02d}"
    return [Site(f"{pole}h{h:g}", Pose(x_m, y_m, ground_m + h), sensor, pole=pole) for h in heights_m]
