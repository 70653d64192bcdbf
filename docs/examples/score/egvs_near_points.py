"""Counts the returns of the empty scan that are near the sensor."""

import numpy as np

from egvs.extensions.validation.surrogates import SiteEvidence, SurrogateScore


def near_points(evidence: SiteEvidence, within_m: float) -> float:
    """Return the number of returns within a distance."""
    range_m = np.linalg.norm(evidence.beams.ends_m[evidence.returned], axis=1)
    return float(np.count_nonzero(range_m < within_m))


NEAR_POINTS = SurrogateScore(
    name="near_points",
    formula="returns of the empty scan within a distance",
    source="an example",
    sign=1,
    function=near_points,
    sweep={"within_m": (20.0, 50.0)},
)
