"""Says what may go beyond plain vehicles on flat ground, and in which order it is asked.

An extension may bring traffic of its own (a further route file of the same simulation), have types of vehicles that do
not count as the scenario's vehicles, and change boxes before they are written. Those that act are passed into the
recording and the writing of trajectories, which know none of them by name.

Order: :meth:`~TrafficExtension.refuses` before anything is laid out; :meth:`~TrafficExtension.plan` while SUMO's folder
is; :meth:`~TrafficExtension.box_change` once the types' sizes are known; then each group of frames passes through the
changes, in the order of the extensions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

if TYPE_CHECKING:
    import numpy as np

    from pipeline.core.errors import InputError
    from pipeline.scenario.models import Scenario
    from pipeline.traffic.boxes import Size, VehicleBoxes
    from pipeline.traffic.network import Network


@dataclass(frozen=True)
class TrafficPlan:
    """Traffic beside the scenario's own.

    Attributes
    ----------
    xml
        A route file.
    vehicles
        How many of SUMO's vehicles it takes at most at a time: ``--max-num-vehicles`` holds that many more.
    notes
        What the user should know.
    """

    xml: str
    vehicles: int
    notes: tuple[str, ...] = ()


class BoxChange(Protocol):
    """Changes the boxes of one recording, group by group; may remember the last group."""

    def change(self, boxes: VehicleBoxes) -> VehicleBoxes:
        """The boxes of the next group, changed."""
        ...

    def summary(self) -> dict[str, Any]:
        """What the stage reports beside the counts, as JSON."""
        ...


class TrafficExtension(Protocol):
    """Something that goes beyond plain vehicles on flat ground. As it stands here, it changes nothing."""

    ADDS_TRAFFIC: ClassVar[bool] = False
    """Whether it has a :meth:`plan`; people on foot are recorded then."""

    def refuses(self, scenario: Scenario) -> InputError | None:
        """Why this scenario cannot have it; None when it can."""
        return None

    def sizes(self) -> dict[str, Size]:
        """Sizes of the types of vehicles and persons that it adds."""
        return {}

    def uncounted_types(self, sizes: Mapping[str, Size]) -> frozenset[str]:
        """Which of SUMO's types are no vehicles of the scenario."""
        return frozenset()

    def followed_types(self, scenario: Scenario, sizes: Mapping[str, Size]) -> frozenset[str]:
        """Types whose vehicles must be recorded all along their way, since a box depends on those before it."""
        return frozenset()

    def plan(
        self, scenario: Scenario, roads: Network, begin_s: float, end_s: float, rng: np.random.Generator
    ) -> TrafficPlan:
        """The traffic that it adds between two times."""
        return TrafficPlan("<routes/>", 0)

    def box_change(self, scenario: Scenario, sizes: Mapping[str, Size]) -> BoxChange | None:
        """What changes the boxes of a recording whose vehicles have these sizes; None for nothing."""
        return None
