"""Protocols of effects that act on beams: they split beams, or let part of a beam through a surface."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from egvs.core.errors import RunError

if TYPE_CHECKING:
    from collections.abc import Callable

    from egvs.core.grid import FloatArray, IntArray, Roi
    from egvs.sensors.sensor import Sensor
    from egvs.sensors.sites import Pose
    from egvs.world.mesh import World
    from egvs.world.ray_casting import EmptyScan


class SubBeams(NamedTuple):
    """Weighted sub-beams of some beams.

    Attributes
    ----------
    directions
        Unit vectors along the world axes, (m, 3) float64.
    parent
        Index of the beam that each comes from, (m,) int64, ascending.
    weight
        Share of the parent beam, (m,) float64; the weights of a beam add up to 1.
    """

    directions: FloatArray
    parent: IntArray
    weight: FloatArray


def checked_sub_beams(effect: Any, sub_beams: object, n_beams: int) -> SubBeams:
    """Return the sub-beams of an effect; raise a RunError for arrays that do not fit together or its ``n_beams``."""
    try:
        directions, parent, weight = (np.asarray(array) for array in sub_beams)  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        actual = f"{type(sub_beams).__name__}"
    else:
        actual = f"shapes {directions.shape}, {parent.shape} and {weight.shape}"
        if directions.shape == (*parent.shape, 3) and parent.shape == weight.shape == (len(weight),):
            actual = "parents of other beams"
            if parent.dtype.kind in "iu" and (not parent.size or 0 <= parent.min() <= parent.max() < n_beams):
                return SubBeams(directions, parent, weight)
    expected = f"directions (m, 3), parents (m,) and weights (m,) of sub-beams of {n_beams} beams"
    raise RunError(f"effects.{effect.NAME}: expected {expected}, got {actual}")


@runtime_checkable
class BeamExpander(Protocol):
    """An effect that turns a beam into weighted sub-beams."""

    @property
    def copies(self) -> int:
        """Number of sub-beams per beam."""

    def expand(self, directions: FloatArray, sensor: Sensor, pose: Pose) -> SubBeams:
        """Return the sub-beams of beams ``directions`` (n, 3) of a sensor that is mounted at ``pose``."""


@runtime_checkable
class BeamCutter(Protocol):
    """An effect that lets part of a beam through surfaces."""

    def opaque(self, world: World) -> World:
        """Return the world without the surfaces that this effect lets beams through."""

    def cutter(self, world: World, roi: Roi) -> Callable[[EmptyScan, Pose], EmptyScan]:
        """Return a function that cuts a scan, cast at :meth:`opaque`, into weighted parts; threads may share it.

        Each part is a beam from the sensor that ends where that share of the beam ends. The weights of a beam still add
        up to what they were, and the hits of a voxel are the share that gets as far.
        """
