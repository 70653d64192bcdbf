"""Drops those candidates of a rule that no pole can stand for: in a lane, amid a junction, or in a solid.

A lattice or a line knows nothing of the junction. A pole cannot stand in a lane whatever the sensor's height, so all
candidates of such a place go; who means a gantry names its sites in a file. So do those between the lanes of a
junction: networks do not tell an island from the middle of the crossing. World frame, metres.
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

IN_A_LANE, IN_A_JUNCTION, IN_A_SOLID = "in a lane", "in a junction", "in a solid"


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
    reasons = [
        IN_A_SOLID if why is None and placing.solid_round(world, site.pose) is not None else why
        for site, why in zip(sites, _on_roads(sites, carriageway), strict=True)
    ]
    free = tuple(site for site, why in zip(sites, reasons, strict=True) if why is None)
    return Candidates(free, tuple((site, why) for site, why in zip(sites, reasons, strict=True) if why is not None))


def _on_roads(sites: Sequence[Site], carriageway: Carriageway | None) -> list[str | None]:
    """Why the road keeps a pole from standing at each place; None where it does not."""
    if carriageway is None:
        return [None] * len(sites)
    at_m = np.array([[site.pose.x_m, site.pose.y_m] for site in sites]).reshape(-1, 2)
    return [
        IN_A_LANE if lane is not None else IN_A_JUNCTION if inside else None
        for lane, inside in zip(carriageway.lanes_at(at_m), carriageway.in_junctions(at_m), strict=True)
    ]
