r"""How much of a beam gets through a tree crown.

Model: leaves that are small, many and placed at random in the crown. A stretch of s metres within leaves of density LAD
(one-sided leaf area a volume, m2/m3) lets through

.. math:: T(s) = e^{-G \cdot season \cdot LAD \cdot s}

(Beer-Lambert; Ross 1981, *The Radiation Regime and Architecture of Plant Stands*). G is the mean projection of a unit
of leaf area: 1/2 for every direction when leaves point evenly everywhere (the spherical distribution). Crowns that
overlap add up.

Where a beam is cut: the share :math:`T(s_1) - T(s_2)` that leaves take between depths :math:`s_1` and :math:`s_2` (a
step) becomes a beam from the sensor that ends there, at the mean depth of what the step takes, and returns; what is
left over goes on to the opaque surface behind. So the weights of a beam add up to what they were, and a voxel's hits
are the share that gets as far: no beam counts twice in a voxel in which it is cut.

season is the share of the summer's optical depth that is left: summer 1; winter 0.35, boughs and twigs alone; autumn
0.7, between both. Both are choices. For winter, the ratio of the logarithms of what single trees let through without
and with leaves is 0.32 for the sugar maple of Heisler 1986 (Urban Ecology 9, 337-359), whose shade took nearly 40 % of
the sunlight bare and about 80 % in leaf. Densities of 0.5 and 2 as thin and dense crowns are assumed.

Calls for it: trees between a site and the road. Limits: no clumping (real crowns let more through); leaves stand still;
no partial echo is too weak to be noticed; trunks stay opaque, and so do crowns whose surface is not closed. The TPOG
still leaves out the voxels that crowns fill, and a measured scan is taken as it is.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pipeline.core.grid import Roi
from pipeline.effects.base import TransmitScan
from pipeline.kernels import foliage as kernels
from pipeline.scenario.effects import EffectParameters, FoliageParameters
from pipeline.sensing.scene import Scene
from pipeline.sensing.sites import Pose
from pipeline.world import casting as raycast
from pipeline.world.casting import EmptyScan
from pipeline.world.mesh import World

CROWN = "tree_crown"
"""The kind of solids that are crowns."""

SEASONS = {"summer": 1.0, "autumn": 0.7, "winter": 0.35}
"""Share of the summer's optical depth."""


class Foliage(TransmitScan[FoliageParameters]):
    """Porous tree crowns."""

    NAME: ClassVar[str] = "foliage"
    SOURCE: ClassVar[str] = (
        "Beer-Lambert with G = 1/2 (Ross 1981); winter's share chosen near Heisler 1986, Urban Ecology 9"
    )
    Model: ClassVar[type[EffectParameters]] = FoliageParameters
    QUALITY: ClassVar[dict[str, tuple[Any, ...]]] = {"step_m": (2.0, 0.5, 0.1)}

    def extinction_per_m(self) -> float:
        """Nepers a metre within a crown."""
        season = self.parameters.season
        share = SEASONS[season] if isinstance(season, str) else season
        return float(self.parameters.projection * share * self.parameters.leaf_area_density)

    def why_idle(self, scene: Scene) -> str | None:
        """Without a crown that a beam can meet before it has left the region of interest.

        A crown without leaves returns nothing, so it must not be met behind the region either.
        """
        world, cast = scene.world, [site.pose.position_m for site in scene.cast_sites]
        faces = _of_crowns(world)
        if not faces.any():
            return "there is no closed tree crown"
        if not cast:
            return "all scans are measured"
        boxes = _boxes(world.triangles_m[faces], world.solid_of_face[faces])
        may_meet = raycast.between if self.extinction_per_m() > 0 else raycast.reachable
        met = may_meet(boxes, scene.scenario.roi.box, np.array(cast)).any()
        return None if met else "no crown lies between any site and the ROI"

    def seen(self, scene: Scene) -> str:
        """How many crowns there are, and how many beams may meet before they have left the region of interest."""
        world, cast = scene.world, np.array([site.pose.position_m for site in scene.cast_sites])
        faces = _of_crowns(world)
        boxes = _boxes(world.triangles_m[faces], world.solid_of_face[faces])
        near = int(raycast.between(boxes, scene.scenario.roi.box, cast).sum())
        return f"{near} of {len(boxes)} tree crowns may stand between a site and the region"

    def opaque(self, world: World) -> World:
        """The world without closed crowns."""
        stays = ~_of_crowns(world)
        return replace(world, faces=world.faces[stays], solid_of_face=world.solid_of_face[stays])

    def cutter(self, world: World, roi: Roi) -> Callable[[EmptyScan, Pose], EmptyScan]:
        """Cuts beams into parts that end within leaves, and one that goes on; ``returned`` holds for all that end in
        leaves."""
        if self.extinction_per_m() == 0:
            return lambda scan, _: replace(scan, weight=_weights(scan))
        crowns = _crowns(world, roi)
        size, origin = np.asarray(roi.size_m), np.asarray(roi.origin_m)

        def cut(scan: EmptyScan, pose: Pose) -> EmptyScan:
            far = np.sqrt((scan.ends_m**2).sum(axis=1))
            d, weight = scan.ends_m / far[:, None], _weights(scan)
            o = np.asarray(pose.position_m) - origin
            rows, shares, at_m = kernels.cut(
                o, d, far, weight, size, *crowns, self.extinction_per_m(), self.parameters.step_m
            )
            on = np.isinf(at_m)
            ends = np.where(on[:, None], scan.ends_m[rows], d[rows] * np.where(on, 0.0, at_m)[:, None])
            face = None if scan.face is None else np.where(on, scan.face[rows], -1)
            return replace(
                scan,
                face=face,
                beam=scan.beam[rows],
                ends_m=ends,
                returned=scan.returned[rows] | ~on,
                weight=weight[rows] * shares,
            )

        return cut


def _weights(scan: EmptyScan) -> NDArray[np.float64]:
    return np.ones(len(scan.beam)) if scan.weight is None else scan.weight


def _boxes(triangles: NDArray[np.float64], owner: NDArray[np.int32]) -> NDArray[np.float64]:
    """The eight corners of the box round each owner's triangles, (owners, 8, 3)."""
    order = np.argsort(owner, kind="stable")
    _, starts = np.unique(owner[order], return_index=True)
    low = np.minimum.reduceat(triangles[order].min(axis=1), starts)
    high = np.maximum.reduceat(triangles[order].max(axis=1), starts)
    picks = np.array(list(itertools.product((False, True), repeat=3)))
    return np.where(picks, high[:, None], low[:, None])


def _of_crowns(world: World) -> NDArray[np.bool_]:
    """Which faces are those of closed crowns, (faces,) bool."""
    porous = np.array([kind == CROWN for _, kind in world.solids], dtype=np.bool_) & world.closed
    of_face: NDArray[np.bool_] = porous[world.solid_of_face]
    return of_face


def _crowns(
    world: World, roi: Roi
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """What :func:`pipeline.kernels.foliage.cut` asks of the crowns: starts, balls, triangles, planes."""
    faces = np.flatnonzero(_of_crowns(world))
    triangles = world.triangles_m[faces] - np.asarray(roi.origin_m)
    triangles, planes, kept = raycast.with_planes(triangles)
    owner = world.solid_of_face[faces[kept]]
    order = np.argsort(owner, kind="stable")
    triangles, planes = triangles[order], planes[order]
    _, starts = np.unique(owner[order], return_index=True)
    boxes = _boxes(triangles, owner[order])
    low, high = boxes[:, 0], boxes[:, -1]
    radius = 0.5 * np.sqrt(((high - low) ** 2).sum(axis=1)) + 1e-3  # wider than the rules of kernels.rays
    balls = np.column_stack([0.5 * (low + high), radius**2])
    return np.append(starts, len(triangles)).astype(np.int64), balls, triangles, planes
