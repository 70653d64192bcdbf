"""How much of what a site sees in an as-built world no station could see.

A world from a point cloud is empty wherever no beam ended, also where no beam could come. A site that looks into such
space is scored as if it were free. :meth:`AsBuiltMap.unseen_shares` tells how much of a site's view that is.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from egvs.core.grid import BoolArray, FloatArray, Roi
from egvs.creation.map_parts import SolidMap
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster, shapes_between

VOXEL_M = 1.0
"""Edge length of the voxels in which views are compared."""


@dataclass(frozen=True)
class AsBuiltMap(SolidMap):
    """Meshes of a point cloud, and what its stations saw.

    Attributes
    ----------
    stations_m
        (n, 3) float64: where the scanner stood, as far as that is known, world frame.
    """

    stations_m: FloatArray = field(default_factory=lambda: np.empty((0, 3)))

    def world(self) -> World:
        """Return both meshes as one static world."""
        vertices = [mesh.vertices_m for mesh in self.meshes]
        starts = np.cumsum([0, *map(len, vertices)])
        faces = [mesh.faces + start for mesh, start in zip(self.meshes, starts, strict=False)]
        solids = [np.full(len(mesh.faces), number, dtype=np.int32) for number, mesh in enumerate(self.meshes)]
        return World(
            np.concatenate([np.empty((0, 3)), *vertices]),
            np.concatenate([np.empty((0, 3), dtype=np.int64), *faces]).astype(np.int32),
            np.concatenate([np.empty(0, dtype=np.int32), *solids]),
            tuple((mesh.name, mesh.kind) for mesh in self.meshes),
        )

    def unseen_shares(self, sensors_m: FloatArray, roi: Roi) -> FloatArray:
        """Return which share of its view each site has into space that no station saw.

        Parameters
        ----------
        sensors_m
            Sensors, (n, 3), in the frame of the meshes.
        roi
            The region of interest, in the same frame.

        Returns
        -------
        ndarray of float64
            (n,), see :func:`unseen_shares`.
        """
        return unseen_shares(self.world(), self.stations_m, sensors_m, roi)


def unseen_shares(world: World, stations_m: FloatArray, sites_m: FloatArray, roi: Roi) -> FloatArray:
    """Return which share of its view each site has into space that no station could see.

    Parameters
    ----------
    world
        The as-built world.
    stations_m, sites_m
        Where the scanner stood, (k, 3), and sensors, (n, 3), in the frame of the world.
    roi
        The region of interest.

    Returns
    -------
    ndarray of float64
        (n,): of the voxels of 1 m in the region whose centres the site sees past the triangles, the share whose centres
        no station sees. NaN where a site sees none, or where no station is known.
    """
    shares = np.full(len(sites_m), np.nan)
    if not len(stations_m):
        return shares
    centres = _voxel_centres(roi)
    positions = np.concatenate([stations_m, sites_m])
    caster = Caster(_faces_between(world, roi, positions), roi)
    unseen = np.ones(len(centres), dtype=np.bool_)
    for station in stations_m:
        unseen &= ~_is_visible(caster, roi, station, centres)
    for number, site in enumerate(sites_m):
        visible = _is_visible(caster, roi, site, centres)
        if visible.any():
            shares[number] = float(unseen[visible].mean())
    return shares


def _is_visible(caster: Caster, roi: Roi, position_m: FloatArray, points_m: FloatArray) -> BoolArray:
    """Return which points (n, 3) no triangle hides from a position."""
    offsets = points_m - position_m
    distances = np.sqrt((offsets**2).sum(axis=1))
    directions = offsets / np.maximum(distances, np.finfo(np.float64).tiny)[:, None]
    ranges, _ = caster.first_hits(position_m - roi.origin_m, directions)
    visible: BoolArray = ranges >= distances
    return visible


def _faces_between(world: World, roi: Roi, sites_m: FloatArray) -> World:
    """Return a world without the faces that hide no part of the region from any site."""
    kept = shapes_between(world.triangles_m, roi, sites_m)
    return replace(world, faces=world.faces[kept], solid_of_face=world.solid_of_face[kept])


def _voxel_centres(roi: Roi) -> FloatArray:
    """Return the centres of voxels of about 1 m that fill the region, (n, 3)."""
    shape = np.maximum(np.rint(np.asarray(roi.size_m) / VOXEL_M), 1).astype(np.int64)
    index = np.indices(tuple(shape)).reshape(3, -1).T
    centres: FloatArray = (index + 0.5) * (np.asarray(roi.size_m) / shape) + np.asarray(roi.origin_m)
    return centres
