"""Drops those candidates of a rule that no pole can stand for: in a lane, or in a solid.

A lattice or a line knows nothing of the junction. A pole cannot stand in a lane whatever the sensor's height, so all
candidates of such a place go; who means a gantry names its sites in a file. World frame, metres.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.sensing import placing
from pipeline.sensing.sites import Site
from pipeline.world.carriageway import Carriageway
from pipeline.world.mesh import World

IN_A_LANE, IN_A_SOLID = "in a lane", "in a solid"


@dataclass(frozen=True)
class Candidates:
    """The candidates of a rule.

    Attributes
    ----------
    free
        Those that a pole can stand for, in order.
    dropped
        The others, each with the reason.
    """

    free: tuple[Site, ...]
    dropped: tuple[tuple[Site, str], ...] = ()

    @property
    def reasons(self) -> dict[str, int]:
        """How many were dropped, a reason."""
        return dict(Counter(why for _, why in self.dropped))


def sort_out(sites: Sequence[Site], world: World, carriageway: Carriageway | None) -> Candidates:
    """Which candidates can stand; without a carriageway only solids are asked."""
    at_m = np.array([[site.pose.x_m, site.pose.y_m] for site in sites]).reshape(-1, 2)
    lanes = [None] * len(sites) if carriageway is None else carriageway.lanes_at(at_m)
    reasons = [
        IN_A_LANE if lane is not None else IN_A_SOLID if placing.solid_round(world, site.pose) is not None else None
        for site, lane in zip(sites, lanes, strict=True)
    ]
    free = tuple(site for site, why in zip(sites, reasons, strict=True) if why is None)
    return Candidates(free, tuple((site, why) for site, why in zip(sites, reasons, strict=True) if why is not None))
