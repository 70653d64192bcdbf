"""What an effect may do to beams, as the scanner asks for it: split them, or let part of them through."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from pipeline.core.grid import Roi
    from pipeline.sensing.sensors import Sensor
    from pipeline.sensing.sites import Pose
    from pipeline.world.casting import EmptyScan
    from pipeline.world.mesh import World


@runtime_checkable
class BeamExpander(Protocol):
    """An effect that turns a beam into weighted sub-beams."""

    @property
    def copies(self) -> int:
        """How many sub-beams a beam has."""
        raise NotImplementedError

    def expand(
        self, directions: NDArray[np.float64], sensor: Sensor, pose: Pose
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
        """Sub-beams (m, 3), unit vectors along the world's axes, of some beams ``directions`` (n, 3) of ``sensor`` as
        it is mounted at ``pose``; the row of ``directions`` that each comes from (m,), ascending, and its weight (m,);
        the weights of one beam add up to 1."""
        raise NotImplementedError


@runtime_checkable
class BeamCutter(Protocol):
    """An effect that lets part of a beam through surfaces."""

    def opaque(self, world: World) -> World:
        """The world without what this effect lets beams through."""
        raise NotImplementedError

    def cutter(self, world: World, roi: Roi) -> Callable[[EmptyScan, Pose], EmptyScan]:
        """What cuts a scan that was cast at :meth:`opaque` into weighted parts; prepared once, threads may share it.

        Each part is a beam from the sensor that ends where that share of the beam ends, so that the weights of a beam
        still add up to what they were, and a voxel's hits are the share that gets as far."""
        raise NotImplementedError
