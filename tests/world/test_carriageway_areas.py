"""Areas of the carriageway where the outlines of a network touch or cross themselves."""

from __future__ import annotations

import shapely

from egvs.traffic.network import Shape
from egvs.world.carriageway import _outlines


def test_outline_of_a_thin_walking_area_that_crosses_itself_is_valid():
    """One pass of GEOS makes an invalid polygon of this one, as netconvert wrote it; a union with others then fails."""
    thin = Shape("712.53,628.85 711,627.57 717.44,632.96 723.88,638.35 722.35,637.07 712.53,628.85", "thin")
    (outline,) = _outlines([thin])
    assert shapely.is_valid(outline)
    assert 0.0 < outline.area < 0.01
