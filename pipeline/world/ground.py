"""What lays a ground that goes up and down, as whoever builds the static world asks for it."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Protocol, runtime_checkable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from pipeline.scenario.models import Scenario
    from pipeline.world.terrain import Surface


@runtime_checkable
class GroundSource(Protocol):
    """Something that lays a ground which goes up and down."""

    NAME: ClassVar[str]

    def ground(
        self, scenario: Scenario, low_m: NDArray[np.float64] | None = None, high_m: NDArray[np.float64] | None = None
    ) -> Surface:
        """The ground over a rectangle; around the network when None."""
        raise NotImplementedError
