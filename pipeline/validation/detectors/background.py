"""Takes the background off a sweep: beam by beam, a return well before the empty scan's is something new.

Roadside practice, since the sensor does not move. Noise lies within the margin, and so does what stands on a surface by
less than it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipeline.sensing.sensors import rotation
from pipeline.validation.sweeps import SiteView, Sweep

MARGIN_M = 0.15
"""Five standard deviations of a range whose maker says +-3 cm."""


def new_in(sweep: Sweep, view: SiteView) -> NDArray[np.bool_]:
    """Which points of a sweep lie well before what their beams meet in the empty scan, (n,)."""
    range_m = np.sqrt((sweep.points[:, :3].astype(np.float64) ** 2).sum(axis=1))
    found: NDArray[np.bool_] = range_m < view.empty_range_m[sweep.beam] - MARGIN_M
    return found


def in_world(sweep: Sweep, view: SiteView) -> NDArray[np.float64]:
    """The points of a sweep in the world frame, (n, 3) float64."""
    matrix = rotation(*view.pose.angles_deg)
    moved = (sweep.points[:, None, :3].astype(np.float64) * matrix).sum(axis=2)
    found: NDArray[np.float64] = moved + np.asarray(view.pose.position_m)
    return found
