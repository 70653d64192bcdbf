"""Place files without a reference system: two of their points, and where these are on the Earth."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import XY
from egvs.creation.map_parts import Alignment, MapContext
from egvs.formats.georeference import WorldFrame

PointPair = tuple[XY, XY]
"""x, y of a point in a file without a reference system, and its latitude, longitude (or world-frame x, y)."""

_MAX_SCALE_ERROR = 0.02
"""Largest relative difference of the distance between the points."""

_UNITS_M = (1.0, 0.3048)
"""Metres and feet; US survey feet differ by 2 parts in a million."""


def make_alignment(pairs: Sequence[PointPair], frame: WorldFrame | None) -> Alignment:
    """Return where files without a reference system are.

    Parameters
    ----------
    pairs
        Two points. The second member of each is latitude, longitude in degrees; world-frame x, y in metres if there is
        no frame.
    frame
        The world frame.

    Raises
    ------
    InputError
        When there are not two points, or when their distance in the file is within 2 % of that on the ground neither in
        metres nor in feet.
    """
    if len(pairs) != 2:
        hint = "Give --align X,Y=LAT,LON twice, for two points far from each other."
        raise InputError("--align", f"expected two points, got {len(pairs)}", hint)
    local = np.array([local for local, _ in pairs], dtype=np.float64)
    world = np.array([where for _, where in pairs], dtype=np.float64)
    world_m = frame.from_lon_lat(world[:, ::-1]) if frame is not None else world
    distance, distance_m = [float(np.hypot(*np.diff(points, axis=0)[0])) for points in (local, world_m)]
    if min(distance, distance_m) > 0.0 and math.isfinite(distance + distance_m):
        for unit_m in _UNITS_M:
            if abs(distance_m / (distance * unit_m) - 1) <= _MAX_SCALE_ERROR:
                return Alignment(local, world_m, unit_m)
    problem = f"the points are {distance:,.2f} apart in the file and {distance_m:,.2f} m on the ground"
    raise InputError("--align", problem, "Check both points; the file must be in metres or feet.")


def check_used(context: MapContext) -> None:
    """Raise an InputError when there is an alignment that no file needed."""
    if context.alignment is not None and not context.aligned:
        problem = "no file needs it: all files declare a reference system"
        raise InputError("--align", problem, "Leave it out; if a file is misplaced, correct its reference system.")
