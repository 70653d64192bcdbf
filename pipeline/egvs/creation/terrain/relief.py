"""Heights of the roads in a region of interest, and of the ground at its poles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from egvs.core import polylines
from egvs.core.grid import FloatArray
from egvs.creation import junctions
from egvs.creation.junctions import JunctionRegion, KerbsidePole, StreetJunction, Streets
from egvs.traffic.network import Edge
from egvs.world import terrain
from egvs.world.terrain import TerrainSurface

_STEP_M = 0.25
"""The region of interest grows by whole steps of this where its ground is not flat; a voxel's default size."""

_LEVEL_M = 3.0
"""Lanes that are higher or lower than this above a junction's own are on another level."""


@dataclass(frozen=True)
class Relief:
    """The heights of the roads in a region of interest.

    Attributes
    ----------
    low_m, high_m
        z of the lowest and the highest lane of the junction's level; both 0 on a flat network.
    other_levels
        Edges in the region whose lanes are on another level.
    """

    low_m: float = 0.0
    high_m: float = 0.0
    other_levels: tuple[str, ...] = ()

    @classmethod
    def of_region(cls, streets: Streets, junction: StreetJunction, roi: JunctionRegion) -> Relief:
        """Return the heights of the lanes in a region; all 0 in a flat network."""
        network = streets.network
        if _is_flat(streets):
            return cls()
        middle_m = lane_heights_near(streets, junction)
        low_m = high_m = float(np.median(middle_m))
        others: list[str] = []
        for edge in network.edges:
            heights = _heights_inside(edge, roi)
            if not len(heights):
                continue
            if np.abs(heights[:, None] - middle_m[None, :]).min() > _LEVEL_M:
                others.append(edge.id)
                continue
            low_m, high_m = min(low_m, float(heights.min())), max(high_m, float(heights.max()))
        return cls(low_m, high_m, tuple(others))

    @property
    def is_flat(self) -> bool:
        """Whether the ground is z = 0."""
        return self.low_m == 0.0 == self.high_m

    @property
    def z_range_m(self) -> tuple[float, float]:
        """Bottom and top of the region of interest, in whole steps above the lowest lane."""
        low_m = math.floor(self.low_m / _STEP_M) * _STEP_M
        rise_m = math.ceil((self.high_m - low_m) / _STEP_M) * _STEP_M
        return low_m, low_m + rise_m + junctions.ROI_HEIGHT_M

    def ground_m(self, ground: TerrainSurface | None, poles: Sequence[KerbsidePole]) -> FloatArray | None:
        """Return z of the ground (n,) at poles; None where the ground is flat.

        Parameters
        ----------
        ground
            From :func:`ground_surface`.
        poles
            The locations.
        """
        if self.is_flat or ground is None:
            return None
        x_m, y_m = np.array([(pole.x_m, pole.y_m) for pole in poles]).T
        return np.round(ground.height_m(x_m, y_m), 3)


def ground_surface(streets: Streets, beyond_m: FloatArray | None = None) -> TerrainSurface | None:
    """Return the ground of roads with heights; None where the ground is flat.

    Parameters
    ----------
    streets
        The roads.
    beyond_m
        Points (n, 3) of the terrain beyond the roads, world frame; None without a terrain.
    """
    if _is_flat(streets):
        return None
    return terrain.triangulate_ground(streets.network, beyond_m=beyond_m)


def _is_flat(streets: Streets) -> bool:
    """Return whether the effect ``slope`` takes a network as flat."""
    if not streets.network.has_heights:
        return True
    span_m, off_m = terrain.relief_m(streets.network)
    return span_m <= terrain.MIN_RELIEF_M and abs(off_m) <= terrain.MIN_RELIEF_M


def lane_heights_near(streets: Streets, junction: StreetJunction) -> FloatArray:
    """Return z of the ends of the lanes that meet at a junction."""
    heights = []
    for edge in streets.network.edges:
        for lane in edge.lanes:
            if edge.from_node in junction.nodes:
                heights.append(lane.shape_m[0, 2])
            if edge.to_node in junction.nodes:
                heights.append(lane.shape_m[-1, 2])
    return np.array(heights)


def _heights_inside(edge: Edge, roi: JunctionRegion) -> FloatArray:
    """Return z of an edge's lanes where they are in a region, sampled every metre."""
    (x_m, y_m), (width_m, depth_m) = roi.center_m, roi.size_m
    heights = [np.empty(0)]
    for lane in edge.lanes:
        length_m = polylines.stations_m(lane.shape_m)[-1]
        x, y, z = polylines.points_at(lane.shape_m, np.linspace(0.0, length_m, int(length_m) + 2)).T
        heights.append(z[(np.abs(x - x_m) <= width_m / 2) & (np.abs(y - y_m) <= depth_m / 2)])
    return np.concatenate(heights)
