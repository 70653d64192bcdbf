r"""Scores that look at points: on the road of the empty scan, and on the vehicles of recorded traffic.

The road is where traffic is: columns of voxels that are ever occupied. A return lies on it where it is no higher than
the lowest layer that is ever occupied in its column (what hangs above does not count).

Points on vehicles are those of boxes replayed from the traffic that the TPOG was counted from
(:mod:`pipeline.scoring.targets.seen`). Without any vehicle their means are not a number.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.scoring.targets import detectability
from pipeline.scoring.targets import scores as targets
from pipeline.validation.surrogates.base import Score
from pipeline.validation.surrogates.evidence import Floats, SiteEvidence

CELL_M = 1.0
"""Side of the squares that the uniformity of points is judged by."""

AP_OF_LN_POINTS, AP_OF_ONE_POINT, LEAST_AP, MOST_AP = 0.152, 0.659, 0.001, 0.999
"""AP = 0.152 ln m + 0.659, and its bounds."""


def density(evidence: SiteEvidence) -> float:
    """Returns on the road, over the road's area, in points a square metre; not a number without road."""
    points, area_m2 = _on_road(evidence)
    return math.fsum(points.ravel()) / math.fsum(area_m2.ravel()) if area_m2.any() else math.nan


def uniformity(evidence: SiteEvidence) -> float:
    r"""The spread of density over the road, as a share of its mean :math:`\bar\rho`:
    :math:`\frac{1}{\bar\rho} \sqrt{\sum_c A_c (\rho_c - \bar\rho)^2 / \sum_c A_c}` with :math:`A_c` the road's area in
    square c, 1 m wide, and :math:`\rho_c` the density there. 0 is even. Not a number where no point lies on a road.
    """
    points, area_m2 = _on_road(evidence)
    road = area_m2 > 0
    n, a = points[road], area_m2[road]
    if not n.any():
        return math.nan
    mean = math.fsum(n) / math.fsum(a)
    return math.sqrt(math.fsum(a * (n / a - mean) ** 2) / math.fsum(a)) / mean


def _on_road(evidence: SiteEvidence) -> tuple[Floats, Floats]:
    """Points on the road, and its area, in each square of the region of interest."""
    grid, lowest = evidence.occupancy.tpog.grid, evidence.occupancy.lowest
    at_m, worth = evidence.returns
    with np.errstate(invalid="ignore"):
        index = np.floor(at_m / grid.voxel_m)
    inside = ((index[:, :2] >= 0) & (index[:, :2] < grid.shape[:2])).all(axis=1)
    ix, iy = index[inside, :2].astype(np.int64).T
    low = index[inside, 2] <= lowest[ix, iy]  # -1 where there is no road: the layer below the region's floor, or lower
    low &= lowest[ix, iy] >= 0
    points, area_m2 = (np.zeros(np.ceil(np.asarray(grid.shape[:2]) * grid.voxel_m / CELL_M).astype(int)) for _ in "na")
    np.add.at(points, _square(grid.voxel_m, ix[low], iy[low]), worth[inside][low])
    np.add.at(area_m2, _square(grid.voxel_m, *np.nonzero(lowest >= 0)), grid.voxel_m**2)
    return points, area_m2


def _square(voxel_m: float, *columns: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
    """The square that the middle of a column lies in."""
    return tuple(((index + 0.5) * voxel_m / CELL_M).astype(np.int64) for index in columns)


def perception_entropy(evidence: SiteEvidence, in_traffic: bool) -> float:
    r"""Mean over vehicles and frames of :math:`2 \ln \sigma + 1 + \ln 2\pi` with :math:`\sigma = 1 / AP - 1` and
    :math:`AP = 0.152 \ln m + 0.659`, held between 0.001 and 0.999 (0.001 where m = 0), m the points on the vehicle:
    with no other in the way, as the source has it, or ``in_traffic`` with all of them.

    AP reaches 0.999 at 9.4 points. So with no other vehicle in the way, a sensor of 32 rings that sees all of a
    junction gives every vehicle the same entropy, and such sites the same score.
    """
    m = evidence.vehicles.points if in_traffic else evidence.vehicles.points_alone
    ap = np.full(len(m), LEAST_AP)
    ap[m > 0] = np.clip(AP_OF_LN_POINTS * np.log(m[m > 0]) + AP_OF_ONE_POINT, LEAST_AP, MOST_AP)
    return _mean(2.0 * np.log(1.0 / ap - 1.0) + 1.0 + math.log(2.0 * math.pi))


def points_on_target(evidence: SiteEvidence) -> float:
    r"""Mean over vehicles and frames of :math:`\ln(1 + n)`, n the points on the vehicle with all others in the way."""
    return targets.points_on_target(evidence.vehicles)


def seen_well(evidence: SiteEvidence) -> float:
    r"""Mean over vehicles and frames of :math:`1 - e^{-n / 20}`."""
    return targets.seen_well(evidence.vehicles)


def expected_detections(evidence: SiteEvidence, detectors: str) -> float:
    """The share of vehicles that some detectors, named with "+" between them, are expected to find."""
    return detectability.expected_detections(evidence.vehicles, detectors.split("+"))


def _mean(values: Floats) -> float:
    return math.fsum(values) / len(values) if len(values) else math.nan


DENSITY = Score(
    "density",
    "returns of the empty scan a square metre of road",
    "Cai et al. 2023, arXiv 2211.15975",
    1,
    density,
    ("returns",),
)
UNIFORMITY = Score(
    "uniformity",
    "spread of that density over the road, in squares of 1 m, as a share of its mean",
    "Cai et al. 2023, arXiv 2211.15975; as a coefficient of variation here",
    -1,
    uniformity,
    ("returns",),
)
PERCEPTION_ENTROPY = Score(
    "perception_entropy",
    "mean over vehicles and frames of the entropy of an error that falls with the points on the vehicle, in nats",
    "Ma, Liu, Li 2021, arXiv 2104.06615",
    -1,
    perception_entropy,
    ("vehicles",),
    {"in_traffic": (False, True)},
)
POINTS_ON_TARGET = Score(
    "points_on_target",
    "mean over vehicles and frames of ln(1 + points), vehicles hiding one another",
    "this program",
    1,
    points_on_target,
    ("vehicles",),
)
SEEN_WELL = Score(
    "seen_well",
    "mean over vehicles and frames of 1 - exp(-points / 20), vehicles hiding one another",
    "this program",
    1,
    seen_well,
    ("vehicles",),
)
EXPECTED_DETECTIONS = Score(
    "expected_detections",
    "share of vehicles that detectors are expected to find, from points, spans, neighbours and the line of sight",
    "this program",
    1,
    expected_detections,
    ("vehicles",),
    {"detectors": ("+".join(detectability.DETECTORS), *detectability.DETECTORS)},
)
