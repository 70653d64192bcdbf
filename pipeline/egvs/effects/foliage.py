r"""Foliage: tree crowns let part of a beam through.

Model: many small leaves at random positions in the crown. A path of s metres within leaves of density LAD (one-sided
leaf area per volume, m2/m3) transmits

.. math:: T(s) = e^{-G \cdot season \cdot LAD \cdot s}

(Beer-Lambert; Ross 1981, *The Radiation Regime and Architecture of Plant Stands*). G is the mean projection of a unit
of leaf area: 1/2 for every direction when leaves are oriented uniformly (the spherical distribution). Overlapping
crowns add up.

A beam is cut in steps: the share :math:`T(s_1) - T(s_2)` that leaves absorb between depths :math:`s_1` and :math:`s_2`
becomes a beam from the sensor that ends at the mean depth of that share, and returns; the rest continues to the opaque
surface behind. The weights of a beam still add up to what they were, and the hits of a voxel are the share that gets as
far: no beam counts twice in a voxel in which it is cut.

``season`` is the remaining share of the summer's optical depth: summer 1; winter 0.35, boughs and twigs alone; autumn
0.7, in between. Both are choices. For winter, the ratio of the logarithms of the transmittances of a tree without and
with leaves is 0.32 for the sugar maple of Heisler 1986 (Urban Ecology 9, 337-359), which blocked nearly 40 % of the
sunlight bare and about 80 % in leaf. Densities of 0.5 and 2 for thin and dense crowns are assumed.

Use it where trees are between a site and the road. Limits: no clumping (real crowns transmit more); leaves do not move;
every partial echo is detected; trunks stay opaque, and so do crowns whose surface is not closed. The TPOG still leaves
out the voxels that crowns fill, and a measured scan is not changed.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egvs.core.grid import BoolArray, FloatArray, IntArray, Roi
from egvs.effects.base import TransmitScan
from egvs.kernels import foliage
from egvs.scenario.effects_config import EffectParameters, FoliageParameters
from egvs.sensors.scene import Scene
from egvs.sensors.sites import Pose
from egvs.world import ray_casting
from egvs.world.mesh import World
from egvs.world.ray_casting import EmptyScan

CROWN = "tree_crown"
"""The kind of solids that are tree crowns."""

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
        """Return the extinction coefficient within a crown (Beer-Lambert law), in 1/m."""
        season = self.parameters.season
        share = SEASONS[season] if isinstance(season, str) else season
        return float(self.parameters.projection * share * self.parameters.leaf_area_density)

    def why_idle(self, scene: Scene) -> str | None:
        """Crowns change nothing unless a beam can meet one before it has left the region of interest.

        A crown without leaves returns nothing, so beams must not meet it behind the region either.
        """
        if not _crown_faces(scene.world).any():
            return "there is no closed tree crown"
        if not scene.cast_sites:
            return "all scans are measured"
        may_meet = ray_casting.shapes_between if self.extinction_per_m() > 0 else ray_casting.reachable_shapes
        if not may_meet(_crown_boxes(scene.world), scene.scenario.roi.box, _cast_positions(scene)).any():
            return "no crown lies between any site and the ROI"
        return None

    def summary(self, scene: Scene) -> str:
        """Return how many crowns beams may meet before they have left the region of interest, as a sentence."""
        boxes = _crown_boxes(scene.world)
        near = int(ray_casting.shapes_between(boxes, scene.scenario.roi.box, _cast_positions(scene)).sum())
        return f"{near} of {len(boxes)} tree crowns may stand between a site and the region"

    def opaque(self, world: World) -> World:
        """Return the world without closed crowns."""
        is_opaque = ~_crown_faces(world)
        return replace(world, faces=world.faces[is_opaque], solid_of_face=world.solid_of_face[is_opaque])

    def cutter(self, world: World, roi: Roi) -> Callable[[EmptyScan, Pose], EmptyScan]:
        """Return a function that cuts beams into parts that end, and return, within leaves, and one that goes on."""
        if self.extinction_per_m() == 0:
            return lambda scan, _: replace(scan, weight=_weights(scan))
        crowns = _crowns(world, roi)
        size = np.asarray(roi.size_m)
        origin = np.asarray(roi.origin_m)

        def cut(scan: EmptyScan, pose: Pose) -> EmptyScan:
            o = np.asarray(pose.position_m) - origin
            range_m = np.sqrt((scan.ends_m**2).sum(axis=1))
            d = scan.ends_m / range_m[:, None]
            weight = _weights(scan)
            rows, shares, leaf_range_m = foliage.split_at_leaves(
                o, d, range_m, weight, size, *crowns, self.extinction_per_m(), self.parameters.step_m
            )
            goes_on = np.isinf(leaf_range_m)
            leaf_ends = d[rows] * np.where(goes_on, 0.0, leaf_range_m)[:, None]
            face = None
            if scan.face is not None:
                face = np.where(goes_on, scan.face[rows], -1)
            return replace(
                scan,
                face=face,
                beam=scan.beam[rows],
                ends_m=np.where(goes_on[:, None], scan.ends_m[rows], leaf_ends),
                returned=scan.returned[rows] | ~goes_on,
                weight=weight[rows] * shares,
            )

        return cut


def _weights(scan: EmptyScan) -> FloatArray:
    return np.ones(len(scan.beam)) if scan.weight is None else scan.weight


def _cast_positions(scene: Scene) -> FloatArray:
    return np.array([site.pose.position_m for site in scene.cast_sites])


def _crown_faces(world: World) -> BoolArray:
    """Which faces belong to closed crowns, (faces,) bool."""
    is_crown = np.array([kind == CROWN for _, kind in world.solids], dtype=np.bool_) & world.closed
    return is_crown[world.solid_of_face]


def _crown_boxes(world: World) -> FloatArray:
    """The eight corners of the bounding box of each crown, (crowns, 8, 3)."""
    faces = _crown_faces(world)
    return _bounding_boxes(world.triangles_m[faces], world.solid_of_face[faces])


def _bounding_boxes(triangles: FloatArray, owner: NDArray[np.int32]) -> FloatArray:
    """The eight corners of the bounding box of each owner's triangles, (owners, 8, 3)."""
    order = np.argsort(owner, kind="stable")
    _, starts = np.unique(owner[order], return_index=True)
    low = np.minimum.reduceat(triangles[order].min(axis=1), starts)
    high = np.maximum.reduceat(triangles[order].max(axis=1), starts)
    is_high = np.array(list(itertools.product((False, True), repeat=3)))
    return np.where(is_high, high[:, None], low[:, None])


class _Crowns(NamedTuple):
    """Crowns as :func:`egvs.kernels.foliage.split_at_leaves` takes them.

    Triangles starts[i] to starts[i + 1] belong to crown i, whose bounding ball is balls[i] (centre, squared radius).
    """

    starts: IntArray
    balls: FloatArray
    triangles: FloatArray
    planes: FloatArray


def _crowns(world: World, roi: Roi) -> _Crowns:
    faces = np.flatnonzero(_crown_faces(world))
    triangles, planes, selected = ray_casting.with_planes(world.triangles_m[faces] - np.asarray(roi.origin_m))
    owner = world.solid_of_face[faces[selected]]
    order = np.argsort(owner, kind="stable")
    triangles = triangles[order]
    _, starts = np.unique(owner[order], return_index=True)
    boxes = _bounding_boxes(triangles, owner[order])
    low = boxes[:, 0]
    high = boxes[:, -1]
    radius = 0.5 * np.sqrt(((high - low) ** 2).sum(axis=1)) + 1e-3  # more than the tolerance of the kernel
    balls = np.column_stack([0.5 * (low + high), radius**2])
    return _Crowns(np.append(starts, len(triangles)).astype(np.int64), balls, triangles, planes[order])
