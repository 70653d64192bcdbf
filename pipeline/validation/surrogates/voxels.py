r"""Scores that look at voxels: which of them beams cross, and how uncertain traffic is there.

:math:`p(v)` is the share of frames in which traffic occupies voxel v, :math:`hits(v)` the beams of the empty scan that
cross it, H the binary entropy in bits, h the same in nats. A share of nothing (a TPOG without traffic) is 0.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.special import rel_entr

from pipeline.scoring.voxel_shares import OccupiedVoxels
from pipeline.validation.surrogates.base import GAMMA, OCCLUSION, VOXEL, Score
from pipeline.validation.surrogates.evidence import SiteEvidence

NAT = math.log(2.0)
"""A bit in nats."""

FLOOR = 1e-6
"""The least chance with which a voxel is taken to be observed: without it, one voxel that no beam crosses would make a
divergence infinite, whatever else is seen."""


def egvs(evidence: SiteEvidence, gamma: float) -> float:
    r""":math:`\sum_v H(p(v)) \min(\gamma, hits(v))`, in bits; 0 without traffic."""
    hits, unit = evidence.counted
    return evidence.occupancy.field.score(hits, gamma, unit).egvs


def entropy_seen(evidence: SiteEvidence) -> float:
    r""":math:`\sum_v H(p(v)) [hits(v) > 0] \,/ \sum_v H(p(v))`."""
    hits, unit = evidence.counted
    return evidence.occupancy.field.score(hits, 1.0, unit).entropy_seen


def coverage(evidence: SiteEvidence) -> float:
    r""":math:`|\{v : p(v) > 0, hits(v) > 0\}| \,/\, |\{v : p(v) > 0\}|`: the rest are blind spots."""
    return OccupiedVoxels(evidence.occupancy.cells, evidence.occupancy.counts).coverage(evidence.counted[0])


def expected_visibility(evidence: SiteEvidence) -> float:
    r""":math:`\sum_v p(v) [hits(v) > 0] \,/ \sum_v p(v)`."""
    return OccupiedVoxels(evidence.occupancy.cells, evidence.occupancy.counts).expected_visibility(evidence.counted[0])


def s_mig(evidence: SiteEvidence) -> float:
    r""":math:`\sum_v h(p(v)) - \sum_b \sum_{v \in b} h(p(v))` with b the beams, in nats.

    The second sum counts a voxel once for each beam, so it is :math:`\sum_v h(p(v))\, hits(v)`: but for sign and a
    constant this is EGVS with gamma = inf. Its authors maximise it, as information gained, although each further beam
    through an uncertain voxel lowers it.
    """
    hits, unit = evidence.counted
    field = evidence.occupancy.field
    return (field.total_bit - field.score(hits, math.inf, unit).egvs) * NAT


def m_sog(evidence: SiteEvidence) -> float:
    r""":math:`-\frac{1}{N} \sum_{v : hits(v) > 0} h(p(v))` in nats, with N the number of voxels that are crossed, with
    traffic or without; not a number where none is.

    Of the source's classes two are left, traffic and none.
    """
    hits, unit = evidence.counted
    crossed = int(np.count_nonzero(hits))
    return 0.0 - evidence.occupancy.field.score(hits, 1.0, unit).egvs * NAT / crossed if crossed else math.nan


def kl_obs(evidence: SiteEvidence) -> float:
    r"""Mean over voxels with p > 0 of :math:`p \ln\frac{p}{q} + (1-p) \ln\frac{1-p}{1-q}`, in nats, with
    :math:`q(v) = p(v) \prod_{u < v} (1 - p(u))` over the voxels u before v along a beam.

    Of several beams that with the best chance counts; q is at least ``FLOOR`` (and at most p), 1e-6 where no beam goes.
    0 without traffic: there is nothing to observe.
    """
    p = evidence.occupancy.p
    q = np.minimum(np.maximum(p * np.exp(evidence.log_reach), FLOOR), p)
    each = rel_entr(p, q) + rel_entr(1.0 - p, 1.0 - q)
    return math.fsum(each.tolist()) / len(p) if len(p) else 0.0


EGVS = Score(
    "egvs",
    "sum over voxels of entropy times beams that cross, these capped at gamma",
    "Jiang, Javanmardi, Tsukada, Esaki 2025, arXiv 2504.06772",
    1,
    egvs,
    ("counted",),
    {GAMMA: (1.0, 2.0, 5.0, 10.0, 20.0, math.inf), VOXEL: (0.25, 0.5, 1.0), OCCLUSION: (False, True)},
)
ENTROPY_SEEN = Score(
    "entropy_seen",
    "share of the traffic's entropy in voxels that are crossed",
    "Jiang et al. 2025, with gamma = 1, as a share",
    1,
    entropy_seen,
    ("counted",),
)
COVERAGE = Score(
    "coverage",
    "share of the voxels that traffic ever occupies that are crossed",
    "Kim et al. 2023 (blind spots)",
    1,
    coverage,
    ("counted",),
)
EXPECTED_VISIBILITY = Score(
    "expected_visibility",
    "share of occupancy (the sum of p) in voxels that are crossed",
    "this program",
    1,
    expected_visibility,
    ("counted",),
)
S_MIG = Score(
    "s_mig",
    "entropy of all voxels less that of the voxels of each beam, in nats",
    "Hu, Liu, Chitlangia, Agnihotri, Zhao 2022, arXiv 2105.00373, as its text has it, not its released code",
    1,
    s_mig,
    ("counted",),
)
M_SOG = Score(
    "m_sog",
    "mean entropy of the voxels that are crossed, negative, in nats",
    "Li, Kong, Hu, Xu, Huang 2024, arXiv 2403.17009, with two classes",
    1,
    m_sog,
    ("counted",),
)
KL_OBS = Score(
    "kl_obs",
    "mean divergence of what can be observed from what is there, voxel by voxel, in nats",
    "Ma et al. 2025, per voxel instead of between histograms",
    -1,
    kl_obs,
    ("log_reach",),
)
