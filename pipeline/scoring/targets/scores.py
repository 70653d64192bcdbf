r"""Scores of a site that are means over vehicle-frames: how many points vehicles have, and how many are seen well.

.. math:: \frac{1}{N} \sum_{i=1}^{N} g(n_i)

over the N vehicle-frames of a record, :math:`n_i` the points on the vehicle with everything else in the way. The gain g
rises and is concave: a first point on a vehicle is worth more than a hundredth, so that one vehicle seen very well does
not make up for one that is missed. g(0) = 0, for a vehicle without a point is a blind spot of the site.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pipeline.scoring.targets.record import Floats
from pipeline.scoring.targets.seen import SeenTargets

Gain = Callable[[Floats], Floats]
"""What points (n,) on vehicles are worth, (n,)."""

SEEN_WELL_POINTS = 20.0
"""n0: a vehicle with so many points is seen well by 63 %, with three times as many by 95 %."""


def log_points(points: Floats) -> Floats:
    r""":math:`g(n) = \ln(1 + n)`."""
    worth: Floats = np.log1p(points)
    return worth


def well(points: Floats) -> Floats:
    r""":math:`g(n) = 1 - e^{-n / n_0}`, from 0 to 1, with :data:`SEEN_WELL_POINTS`."""
    worth: Floats = -np.expm1(-points / SEEN_WELL_POINTS)
    return worth


def points_on_target(seen: SeenTargets, gain: Gain = log_points, weight: Floats | None = None) -> float:
    """The mean gain of a site's points; not a number without any vehicle.

    Parameters
    ----------
    seen
        What the site sees.
    gain
        What points on a vehicle are worth.
    weight
        How much each vehicle-frame counts, (n,) float64, 0 or above; all alike where it is None.
    """
    return mean(gain(seen.points), weight)


def seen_well(seen: SeenTargets, weight: Floats | None = None) -> float:
    """The share of vehicles that a site sees well, 0 to 1; not a number without any vehicle. ``weight`` as in
    :func:`points_on_target`."""
    return points_on_target(seen, well, weight)


def mean(values: Floats, weight: Floats | None = None) -> float:
    """Of vehicle-frames (n,); independent of their order; not a number where none counts."""
    counts = np.ones(len(values)) if weight is None else weight
    total = math.fsum(counts)
    return math.fsum(values * counts) / total if total > 0.0 else math.nan
