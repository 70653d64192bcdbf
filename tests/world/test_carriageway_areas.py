"""Areas of the carriageway where the outlines of a network touch or cross themselves."""

from __future__ import annotations

import numpy as np

from egvs.traffic.network import Shape
from egvs.world.carriageway import Carriageway


def test_thin_walking_area_that_crosses_itself_is_left_out_of_the_junction():
    """GEOS makes an invalid polygon of this one, as netconvert wrote it, and cannot subtract that."""
    thin = Shape("712.53,628.85 711,627.57 717.44,632.96 723.88,638.35 722.35,637.07 712.53,628.85", "thin")
    beside = Shape("705,625 720,625 720,633.5 705,633.5", "beside")
    junction = Shape("700,620 740,620 740,660 700,660", "junction")
    carriageway = Carriageway((), (), (junction,), (thin, beside))
    inside = carriageway.in_junctions(np.array([[730.0, 630.0], [710.0, 630.0], [690.0, 630.0]]))
    assert inside.tolist() == [True, False, False]
