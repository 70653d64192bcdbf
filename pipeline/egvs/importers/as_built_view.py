"""How much of what a site sees in an as-built world nobody has measured.

A world from a point cloud is empty wherever no beam ended, also where no beam ever came. A site that looks into such
space is scored as if it were free. :meth:`AsBuiltMap.unseen_shares` tells how much of a site's view that is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from egvs.core.grid import FloatArray, Grid, Roi
from egvs.importers.map_parts import SolidMap
from egvs.importers.moving_points import StationScan
from egvs.kernels import traversal
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster, shapes_between

VOXEL_M = 1.0
"""Edge length of the voxels in which views are compared."""


@dataclass(frozen=True)
class AsBuiltMap(SolidMap):
    """Meshes of a point cloud, and what its stations saw.

    Attributes
    ----------
    scans
        The static points of each station that is known, world frame.
    ground_xy_m
        (n, 2): vertices of the ground.
    """

    scans: tuple[StationScan, ...] = ()
    ground_xy_m: FloatArray | None = None

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

    def unseen_shares(self, sites_m: FloatArray, roi: Roi) -> FloatArray:
        """Return which share of its view each site has into space that no station saw.

        Parameters
        ----------
        sites_m
            Sensors, (n, 3), in the frame of the meshes.
        roi
            The region of interest, in the same frame.

        Returns
        -------
        ndarray of float64
            (n,): of the voxels of 1 m in the region whose centres the site sees past the meshes, the share that no beam
            of a station crossed. NaN where a site sees none, or where no station is known.
        """
        return unseen_shares(self.world(), self.scans, sites_m, roi)


def unseen_shares(world: World, scans: tuple[StationScan, ...], sites_m: FloatArray, roi: Roi) -> FloatArray:
    """Return which share of its view each site has into space that no station saw; see :class:`AsBuiltMap`."""
    if not scans:
        return np.full(len(sites_m), np.nan)
    grid = _covering_grid(roi)
    unseen = ~seen_voxels(scans, grid)
    centres = _centres(grid)
    caster = Caster(_faces_between(world, grid.roi, sites_m), grid.roi)
    shares = np.full(len(sites_m), np.nan)
    for number, site in enumerate(sites_m):
        offsets = centres - site
        distances = np.sqrt((offsets**2).sum(axis=1))
        ranges, _ = caster.first_hits(site - grid.origin_m, offsets / np.maximum(distances, 1e-9)[:, None])
        is_visible = ranges >= distances
        if is_visible.any():
            shares[number] = float(unseen[is_visible].mean())
    return shares


def _faces_between(world: World, roi: Roi, sites_m: FloatArray) -> World:
    """Return a world without the faces that hide no part of the region from any site."""
    kept = shapes_between(world.triangles_m, roi, sites_m)
    return replace(world, faces=world.faces[kept], solid_of_face=world.solid_of_face[kept])


def seen_voxels(scans: tuple[StationScan, ...], grid: Grid) -> NDArray[np.bool_]:
    """Return which voxels some beam of a station crossed, in flat order, (nx * ny * nz,) bool."""
    hits = np.zeros(int(np.prod(grid.shape)), dtype=np.uint32)
    shape = np.array(grid.shape, dtype=np.int64)
    for scan in scans:
        x, y, z = scan.station_m.tolist()
        o, d = grid.segments((x, y, z), scan.points_m - scan.station_m)
        traversal.count_hits(o, d, shape, grid.voxel_m, hits)
    return hits > 0


def _covering_grid(roi: Roi) -> Grid:
    """Return voxels of 1 m that cover the region."""
    nx, ny, nz = (max(int(np.ceil(size / VOXEL_M - 1e-9)), 1) for size in roi.size_m)
    return Grid(roi.origin_m, VOXEL_M, (nx, ny, nz))


def _centres(grid: Grid) -> FloatArray:
    """Return the centres of the voxels, world frame, (n, 3), in flat order."""
    index = np.indices(grid.shape).reshape(3, -1).T
    centres: FloatArray = (index + 0.5) * grid.voxel_m + np.asarray(grid.origin_m)
    return centres
