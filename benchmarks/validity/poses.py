"""Places of a junction to look from, by a rule that nobody's wish can bend: beside the road, far apart, four heights.

Steps: lay a lattice over the region of interest and its surroundings; keep the places near a lane where a pole could
stand at every height; take the one nearest to the middle of the region, then always the one that is farthest from all
taken so far. So the first five places of ten are spread as well as the ten are. Nothing is drawn: the same junction
gives the same places. World frame, metres.
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
"""Above the ground."""

PLACES = 10
BESIDE_M = 12.0
"""How far beyond the region of interest places may lie."""

ROAD_M = 6.0
"""How far from a lane."""

SPACING_M = 2.0
"""Of the lattice."""


def grid_poses(scene: Scene, carriageway: Carriageway | None, sensor: str, places: int = PLACES) -> tuple[Site, ...]:
    """Upright sites at ``places`` places, each at every height; place by place, ``g01h2`` first.

    Raises
    ------
    InputError
        Where fewer places are free.
    """
    free = free_at(scene, carriageway, sensor)
    if len(free) < places:
        found = f"{len(free)} places beside the road are free, of {places}"
        raise InputError(f"{scene.scenario.file}: roi", found, "a junction with more room beside its roads")
    roi = scene.roi
    middle = np.asarray(roi.origin_m)[:2] + np.asarray(roi.size_m)[:2] / 2
    chosen = free[spread(free, middle, places)]
    return tuple(
        site for number, at_m in enumerate(chosen.tolist(), 1) for site in _at_all_heights(scene, at_m, number, sensor)
    )


def free_at(scene: Scene, carriageway: Carriageway | None, sensor: str) -> NDArray[np.float64]:
    """The places of the lattice where a pole could stand, at every height, (n, 2)."""
    near = _near_lanes(_lattice(scene), carriageway)
    each = [_at_all_heights(scene, at_m, number, sensor) for number, at_m in enumerate(near.tolist())]
    free = site_feasibility.drop_infeasible([sites[0] for sites in each], scene.world, carriageway).free
    poles = {site.pole for site in free}
    kept = [at_m for at_m, sites in zip(near, each, strict=True) if sites[0].pole in poles and _can_stand(scene, sites)]
    return np.array(kept, dtype=np.float64).reshape(-1, 2)


def _can_stand(scene: Scene, sites: Sequence[Site]) -> bool:
    """Whether sensors can: above the ground, in no solid, in reach of the region of interest."""
    try:
        for site in sites:
            site_feasibility.check_pose(scene, site.pose, scene.sensor(site.sensor), site.name)
    except InputError:
        return False
    return True


def spread(places_m: NDArray[np.float64], middle_m: NDArray[np.float64], wanted: int) -> list[int]:
    """Which places are taken, in order: the nearest to the middle, then the farthest from all taken; of equals the
    first."""
    taken = [int(np.argmin(_squares(places_m, middle_m)))]
    far = _squares(places_m, places_m[taken[0]])
    while len(taken) < wanted:
        taken.append(int(np.argmax(far)))
        far = np.minimum(far, _squares(places_m, places_m[taken[-1]]))
    return taken


def _squares(places_m: NDArray[np.float64], at_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared distances, without the last digits: what is equally far stays so."""
    squares: NDArray[np.float64] = np.round(((places_m - at_m) ** 2).sum(axis=1), 6)
    return squares


def _lattice(scene: Scene) -> NDArray[np.float64]:
    low = np.asarray(scene.roi.origin_m)[:2] - BESIDE_M
    steps = np.floor((np.asarray(scene.roi.size_m)[:2] + 2 * BESIDE_M) / SPACING_M).astype(int) + 1
    x, y = np.meshgrid(*(np.arange(n) * SPACING_M for n in steps.tolist()), indexing="ij")
    return low + np.column_stack([x.ravel(), y.ravel()])


def _near_lanes(places_m: NDArray[np.float64], carriageway: Carriageway | None) -> NDArray[np.float64]:
    """Without a network every place is taken to be near."""
    if carriageway is None:
        return places_m
    import shapely

    tree = shapely.STRtree(carriageway.areas)
    near = np.unique(tree.query(shapely.points(places_m), "dwithin", distance=ROAD_M)[0])
    kept: NDArray[np.float64] = places_m[near]
    return kept


def _at_all_heights(scene: Scene, at_m: Sequence[float], number: int, sensor: str) -> list[Site]:
    x_m, y_m = at_m
    ground_m = (
        site_feasibility.ground_height_m(scene.world, Pose(x_m, y_m, 0.0)) if scene.scenario.statics.ground else 0.0
    )
    pole = f"g{number:02d}"
    return [Site(f"{pole}h{h:g}", Pose(x_m, y_m, ground_m + h), sensor, pole=pole) for h in HEIGHTS_M]
