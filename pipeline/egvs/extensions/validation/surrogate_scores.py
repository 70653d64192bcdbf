"""The surrogate scores of this program.

:math:`p(v)` is the share of frames in which traffic occupies voxel v, :math:`hits(v)` the number of beams of the empty
scan that cross it, H the binary entropy in bits, h the same in nats. Without traffic, shares are 0.

*Scores of voxels* (``egvs`` to ``kl_obs``) ask which voxels beams cross, and how uncertain occupancy is there.

*Scores of the road* (``density``, ``uniformity``) count returns of the empty scan on the road. The road is where
traffic is: columns of voxels that are ever occupied. A return lies on it if it is not higher than the lowest layer that
is ever occupied in its column.

*Scores of vehicles* (``perception_entropy`` and the following) are means over the vehicles of the traffic that the TPOG
was computed from, replayed as boxes (:mod:`egvs.scoring.targets`). Without any vehicle they are NaN.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import rel_entr

from egvs.core.grid import FloatArray, IntArray
from egvs.extensions.validation.surrogates import (
    GAMMA_PARAMETER,
    OCCLUSION_PARAMETER,
    VOXEL_PARAMETER,
    SiteEvidence,
    SurrogateScore,
)
from egvs.scoring import target_scores
from egvs.scoring.noticed import noticed_chances
from egvs.scoring.scorer import OccupiedVoxels
from egvs.scoring.targets import weighted_mean

# ---- scores of voxels

NATS_PER_BIT = math.log(2.0)

MIN_OBSERVATION_PROBABILITY = 1e-6
"""Lower bound of the probability that a voxel is observed. Without it, a single voxel that no beam crosses would make
the divergence infinite."""


def egvs(evidence: SiteEvidence, gamma: float) -> float:
    r""":math:`\sum_v H(p(v)) \min(\gamma, hits(v))`, in bits; 0 without traffic."""
    hits, units_per_beam = evidence.hit_counts
    return evidence.occupancy.field.score(hits, gamma, units_per_beam).egvs


def entropy_seen(evidence: SiteEvidence) -> float:
    r""":math:`\sum_v H(p(v)) [hits(v) > 0] \,/ \sum_v H(p(v))`."""
    hits, units_per_beam = evidence.hit_counts
    return evidence.occupancy.field.score(hits, 1.0, units_per_beam).entropy_seen


def coverage(evidence: SiteEvidence) -> float:
    r""":math:`|\{v : p(v) > 0, hits(v) > 0\}| \,/\, |\{v : p(v) > 0\}|`: the rest are blind spots."""
    return _occupied_voxels(evidence).coverage(evidence.hit_counts[0])


def expected_visibility(evidence: SiteEvidence) -> float:
    r""":math:`\sum_v p(v) [hits(v) > 0] \,/ \sum_v p(v)`."""
    return _occupied_voxels(evidence).expected_visibility(evidence.hit_counts[0])


def _occupied_voxels(evidence: SiteEvidence) -> OccupiedVoxels:
    return OccupiedVoxels(evidence.occupancy.cells, evidence.occupancy.counts)


def s_mig(evidence: SiteEvidence) -> float:
    r""":math:`\sum_v h(p(v)) - \sum_b \sum_{v \in b} h(p(v))` with b the beams, in nats.

    The second sum counts a voxel once per beam, so it is :math:`\sum_v h(p(v))\, hits(v)`: except for sign and a
    constant this is EGVS with gamma = inf. Its authors maximise it as information gain, although each further beam
    through an uncertain voxel lowers it.
    """
    hits, units_per_beam = evidence.hit_counts
    field = evidence.occupancy.field
    return (field.total_bit - field.score(hits, math.inf, units_per_beam).egvs) * NATS_PER_BIT


def m_sog(evidence: SiteEvidence) -> float:
    r""":math:`-\frac{1}{N} \sum_{v : hits(v) > 0} h(p(v))` in nats, with N the number of crossed voxels.

    All crossed voxels count, also those without traffic. NaN if no voxel is crossed. Of the classes of the source, two
    remain: traffic and free.
    """
    hits, units_per_beam = evidence.hit_counts
    crossed = int(np.count_nonzero(hits))
    if not crossed:
        return math.nan
    return 0.0 - evidence.occupancy.field.score(hits, 1.0, units_per_beam).egvs * NATS_PER_BIT / crossed


def kl_obs(evidence: SiteEvidence) -> float:
    r"""Mean over voxels with p > 0 of :math:`p \ln\frac{p}{q} + (1-p) \ln\frac{1-p}{1-q}`, in nats.

    :math:`q(v) = p(v) \prod_{u < v} (1 - p(u))` over the voxels u before v along a beam. Of several beams, the one with
    the highest probability counts. q is at least :data:`MIN_OBSERVATION_PROBABILITY` (and at most p), also where no
    beam goes. 0 without traffic: there is nothing to observe.
    """
    p = evidence.occupancy.p
    if not len(p):
        return 0.0
    q = np.minimum(np.maximum(p * np.exp(evidence.log_reach), MIN_OBSERVATION_PROBABILITY), p)
    divergence = rel_entr(p, q) + rel_entr(1.0 - p, 1.0 - q)
    return math.fsum(divergence.tolist()) / len(p)


# ---- scores of the road

CELL_M = 1.0
"""Edge of the squares of the road in which density is compared."""


def density(evidence: SiteEvidence) -> float:
    """Return the returns on the road over the road's area, in points per square metre; NaN without a road."""
    points, area_m2 = _points_on_road(evidence)
    if not area_m2.any():
        return math.nan
    return math.fsum(points.ravel()) / math.fsum(area_m2.ravel())


def uniformity(evidence: SiteEvidence) -> float:
    r"""Coefficient of variation of the density over the road; 0 is even.

    :math:`\frac{1}{\bar\rho} \sqrt{\sum_c A_c (\rho_c - \bar\rho)^2 / \sum_c A_c}` with :math:`A_c` the area of the
    road in square c, 1 m wide, :math:`\rho_c` the density there and :math:`\bar\rho` its mean. NaN if no point lies on
    a road.
    """
    points, area_m2 = _points_on_road(evidence)
    has_road = area_m2 > 0
    n, a = points[has_road], area_m2[has_road]
    if not n.any():
        return math.nan
    mean = math.fsum(n) / math.fsum(a)
    return math.sqrt(math.fsum(a * (n / a - mean) ** 2) / math.fsum(a)) / mean


def _points_on_road(evidence: SiteEvidence) -> tuple[FloatArray, FloatArray]:
    """Return the points on the road, and its area in square metres, in each square of the region of interest."""
    grid = evidence.occupancy.tpog.grid
    lowest = evidence.occupancy.lowest
    position_m, weight = evidence.returns
    with np.errstate(invalid="ignore"):
        index = np.floor(position_m / grid.voxel_m)
    inside = ((index[:, :2] >= 0) & (index[:, :2] < grid.shape[:2])).all(axis=1)
    ix, iy = index[inside, :2].astype(np.int64).T
    on_road = index[inside, 2] <= lowest[ix, iy]
    on_road &= lowest[ix, iy] >= 0  # -1 where there is no road: a layer below the floor of the region

    squares = np.ceil(np.asarray(grid.shape[:2]) * grid.voxel_m / CELL_M).astype(int)
    points = np.zeros(squares)
    area_m2 = np.zeros(squares)
    np.add.at(points, _square_of_column(grid.voxel_m, ix[on_road], iy[on_road]), weight[inside][on_road])
    np.add.at(area_m2, _square_of_column(grid.voxel_m, *np.nonzero(lowest >= 0)), grid.voxel_m**2)
    return points, area_m2


def _square_of_column(voxel_m: float, *columns: IntArray) -> tuple[IntArray, ...]:
    """Return the indices of the square that contains the middle of each column of voxels."""
    return tuple(((index + 0.5) * voxel_m / CELL_M).astype(np.int64) for index in columns)


# ---- scores of vehicles

AP_OF_LN_POINTS, AP_OF_ONE_POINT, MIN_AP, MAX_AP = 0.152, 0.659, 0.001, 0.999
"""AP = 0.152 ln m + 0.659, and its bounds."""


def perception_entropy(evidence: SiteEvidence, in_traffic: bool) -> float:
    r"""Mean over vehicles and frames of :math:`2 \ln \sigma + 1 + \ln 2\pi` with :math:`\sigma = 1 / AP - 1`.

    :math:`AP = 0.152 \ln m + 0.659`, clipped to 0.001 to 0.999 (0.001 where m = 0), with m the points on the vehicle:
    without any other vehicle, as in the source, or ``in_traffic`` with all of them.

    AP reaches 0.999 at 9.4 points. So without other vehicles, a sensor with 32 rings that sees a whole junction gives
    every vehicle the same entropy, and such sites get the same score.
    """
    m = evidence.vehicles.points if in_traffic else evidence.vehicles.points_alone
    ap = np.full(len(m), MIN_AP)
    ap[m > 0] = np.clip(AP_OF_LN_POINTS * np.log(m[m > 0]) + AP_OF_ONE_POINT, MIN_AP, MAX_AP)
    entropy = 2.0 * np.log(1.0 / ap - 1.0) + 1.0 + math.log(2.0 * math.pi)
    return math.fsum(entropy) / len(entropy) if len(entropy) else math.nan


def points_on_target(evidence: SiteEvidence) -> float:
    r"""Mean over vehicles and frames of :math:`\ln(1 + n)`, n the points on the vehicle among all others."""
    return target_scores.points_on_target(evidence.vehicles)


def seen_well(evidence: SiteEvidence) -> float:
    r"""Mean over vehicles and frames of :math:`1 - e^{-n / 20}`, n the points on the vehicle among all others."""
    return target_scores.seen_well(evidence.vehicles)


def expected_detections(evidence: SiteEvidence, detectors: str) -> float:
    """Return the share of vehicles that some detectors, joined by "+", are expected to find."""
    return target_scores.expected_detections(evidence.vehicles, detectors.split("+"))


def noticed(evidence: SiteEvidence) -> float:
    """Return the share of vehicles that people notice, from points; NaN without any vehicle."""
    return weighted_mean(noticed_chances(evidence.vehicles))


# ---- entry points

EGVS = SurrogateScore(
    "egvs",
    "sum over voxels of entropy times the number of crossing beams, capped at gamma",
    "Jiang, Javanmardi, Tsukada, Esaki 2025, arXiv 2504.06772",
    1,
    egvs,
    ("hit_counts",),
    {
        GAMMA_PARAMETER: (1.0, 2.0, 5.0, 10.0, 20.0, math.inf),
        VOXEL_PARAMETER: (0.25, 0.5, 1.0),
        OCCLUSION_PARAMETER: (False, True),
    },
)
ENTROPY_SEEN = SurrogateScore(
    "entropy_seen",
    "share of the traffic's entropy in crossed voxels",
    "Jiang et al. 2025, with gamma = 1, as a share",
    1,
    entropy_seen,
    ("hit_counts",),
)
COVERAGE = SurrogateScore(
    "coverage",
    "share of crossed voxels among those that traffic ever occupies",
    "Kim et al. 2023 (blind spots)",
    1,
    coverage,
    ("hit_counts",),
)
EXPECTED_VISIBILITY = SurrogateScore(
    "expected_visibility",
    "share of occupancy (the sum of p) in crossed voxels",
    "this program",
    1,
    expected_visibility,
    ("hit_counts",),
)
S_MIG = SurrogateScore(
    "s_mig",
    "entropy of all voxels minus that of the voxels of each beam, in nats",
    "Hu, Liu, Chitlangia, Agnihotri, Zhao 2022, arXiv 2105.00373, as in its text, not its released code",
    1,
    s_mig,
    ("hit_counts",),
)
M_SOG = SurrogateScore(
    "m_sog",
    "negative mean entropy of crossed voxels, in nats",
    "Li, Kong, Hu, Xu, Huang 2024, arXiv 2403.17009, with two classes",
    1,
    m_sog,
    ("hit_counts",),
)
KL_OBS = SurrogateScore(
    "kl_obs",
    "mean divergence between observable and actual occupancy per voxel, in nats",
    "Ma et al. 2025, per voxel instead of between histograms",
    -1,
    kl_obs,
    ("log_reach",),
)
DENSITY = SurrogateScore(
    "density",
    "returns of the empty scan per square metre of road",
    "Cai et al. 2023, arXiv 2211.15975",
    1,
    density,
    ("returns",),
)
UNIFORMITY = SurrogateScore(
    "uniformity",
    "coefficient of variation of that density over the road, in squares of 1 m",
    "Cai et al. 2023, arXiv 2211.15975; here as a coefficient of variation",
    -1,
    uniformity,
    ("returns",),
)
PERCEPTION_ENTROPY = SurrogateScore(
    "perception_entropy",
    "mean over vehicles and frames of the entropy of an error that decreases with the points on the vehicle, in nats",
    "Ma, Liu, Li 2021, arXiv 2104.06615",
    -1,
    perception_entropy,
    ("vehicles",),
    {"in_traffic": (False, True)},
)
POINTS_ON_TARGET = SurrogateScore(
    "points_on_target",
    "mean over vehicles and frames of ln(1 + points), with vehicles occluding each other",
    "this program",
    1,
    points_on_target,
    ("vehicles",),
)
SEEN_WELL = SurrogateScore(
    "seen_well",
    "mean over vehicles and frames of 1 - exp(-points / 20), with vehicles occluding each other",
    "this program",
    1,
    seen_well,
    ("vehicles",),
)
EXPECTED_DETECTIONS = SurrogateScore(
    "expected_detections",
    "share of vehicles that detectors are expected to find, from points, their extent, neighbours and line of sight",
    "this program",
    1,
    expected_detections,
    ("vehicles",),
    {"detectors": ("+".join(target_scores.DETECTORS), *target_scores.DETECTORS)},
)
NOTICED = SurrogateScore(
    "noticed",
    "share of vehicles that people notice within 3 m, from points; it does not ask how well a box fits, as AP does",
    "this program, with labels of Zimmer et al. 2023, arXiv 2306.09266",
    1,
    noticed,
    ("vehicles",),
)
