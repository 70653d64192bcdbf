"""The height of the ground at a junction, by which the heights of city models are shifted to those of a network.

City models count heights from sea level, a flat network has its ground at z = 0. One shift serves all objects: the
height of a terrain at the middle of the region; without one, the median of the lowest points of the nearest buildings.
The ground's own relief remains: single buildings then float or sink.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egvs.core.grid import FloatArray
from egvs.importers.map_parts import MappedMesh, Terrain

NEAREST_BUILDINGS = 5


@dataclass(frozen=True)
class GroundLevel:
    """The height of the ground, and where it is from.

    Attributes
    ----------
    height_m
        In the vertical system of the meshes; to be subtracted from their z.
    source
        In words.
    deviation_m
        How far the lowest points of the nearest buildings are from it, at most; None without buildings.
    """

    height_m: float
    source: str
    deviation_m: float | None = None

    def note(self) -> str:
        """Return a sentence for the user."""
        sentence = f"Heights are shifted by {-self.height_m:+.2f} m, so that the ground is at z = 0: {self.source}."
        if self.deviation_m is None:
            return sentence
        return f"{sentence} The nearest buildings then float or sink by up to {self.deviation_m:.2f} m."


def ground_level(meshes: Sequence[MappedMesh], at_m: FloatArray, terrain: Terrain | None = None) -> GroundLevel | None:
    """Return the height of the ground at a point; None if neither a terrain nor a building tells.

    Parameters
    ----------
    meshes
        Objects with absolute heights.
    at_m
        (2,) world frame, the middle of the region of interest.
    terrain
        Heights in the same vertical system.
    """
    bases_m = _nearest_bases_m(meshes, at_m)
    terrain_m = float("nan") if terrain is None else float(terrain.height_m(np.reshape(at_m, (1, 2)))[0])
    if np.isfinite(terrain_m):
        return GroundLevel(terrain_m, "the terrain at the middle of the region", _deviation_m(bases_m, terrain_m))
    if not len(bases_m):
        return None
    height_m = float(np.median(bases_m))
    nearest = f"the {len(bases_m)} nearest buildings" if len(bases_m) > 1 else "the only building"
    return GroundLevel(height_m, f"the median of the lowest points of {nearest}", _deviation_m(bases_m, height_m))


def _nearest_bases_m(meshes: Sequence[MappedMesh], at_m: FloatArray) -> FloatArray:
    """Return the lowest z of the nearest buildings, the nearest first."""
    buildings = [mesh.vertices_m for mesh in meshes if mesh.kind == "building"]
    distances_m = np.array([np.hypot(*(vertices[:, :2] - at_m).T).min() for vertices in buildings])
    bases_m = np.array([vertices[:, 2].min() for vertices in buildings])
    nearest: FloatArray = bases_m[np.argsort(distances_m, kind="stable")[:NEAREST_BUILDINGS]]
    return nearest


def _deviation_m(bases_m: FloatArray, height_m: float) -> float | None:
    return float(np.abs(bases_m - height_m).max()) if len(bases_m) else None
