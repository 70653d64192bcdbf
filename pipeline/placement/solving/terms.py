r"""Sums over cells that several sensors raise together, each rising and submodular in the set of sensors.

.. math:: F(S) = \sum_c w_c \, f\Big(\sum_{s \in S} a_s(c)\Big)

with weights w and amounts a not below 0, f concave and rising from f(0) = 0. So what a further sensor adds never grows
when others are there already. The EGVS of several LiDARs is one of them (cells: voxels, w their entropy, a beams, f
:math:`\min(\gamma, \cdot)`); so is every other score that may rank sites:

=====================  =====================  ==========================================  ==================
score                  cells                  amounts                                     f
=====================  =====================  ==========================================  ==================
egvs                   voxels with entropy    beams                                       min(gamma, t)
entropy_seen           voxels with entropy    1 where a beam crosses                      min(1, t)
coverage               voxels with traffic    1 where a beam crosses                      min(1, t)
expected_visibility    voxels with traffic    1 where a beam crosses                      min(1, t)
points_on_target       vehicle-frames         points                                      ln(1 + t)
seen_well              vehicle-frames         points                                      1 - exp(-t / n0)
expected_detections    vehicle-frames         -ln(1 - chance that detectors find it)      1 - exp(-t)
=====================  =====================  ==========================================  ==================

The last one says that a vehicle is missed where each sensor by itself misses it, independently of the others; it knows
nothing of what detectors make of clouds put together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pipeline.artefacts.readers import Tpog
from pipeline.kernels.placement.together import CAPPED, LOGARITHM, SATURATING
from pipeline.placement.solving.sight import Floats, Ints, Sight
from pipeline.scoring.egvs import EntropyField
from pipeline.scoring.targets.scores import SEEN_WELL_POINTS, log_points, mean, well
from pipeline.scoring.voxel_shares import OccupiedVoxels

CHANCE_UNIT = 2.0**44
"""A chance p counts as -ln(1 - p), in whole multiples of 1 over this."""


@dataclass(frozen=True, eq=False)
class Term:
    """One such sum.

    Attributes
    ----------
    name
        Whose score it is: the traffic's as a whole, a period's, a zone's.
    sight
        The amounts of all candidates.
    weight
        w, (cells,) float64.
    curve, scale
        f, see :mod:`pipeline.kernels.placement.together`.
    each_once
        Whether a sensor counts once in a cell that it hits, however often.
    exact
        F from the totals of all cells, (cells,) int64, rounded once: it does not depend on the order of anything.
    """

    name: str
    sight: Sight
    weight: Floats
    curve: int
    scale: float
    each_once: bool
    exact: Callable[[Ints], float]


VOXEL_SCORES = ("egvs", "entropy_seen", "coverage", "expected_visibility")
"""The scores whose cells are voxels; those of all others are vehicle-frames."""


def voxel_term(name: str, score: str, sight: Sight, tpog: Tpog, voxels: Ints, gamma: float, unit: int) -> Term:
    """One of :data:`VOXEL_SCORES`.

    Parameters
    ----------
    voxels
        The cells of ``sight``, see :func:`pipeline.scoring.voxel_shares.ever_occupied`.
    gamma, unit
        Cap on the hits of a voxel, and what a whole beam adds to them.
    """
    weight = np.zeros(len(voxels))
    if score in ("egvs", "entropy_seen"):
        field = EntropyField.of(tpog.counts, tpog.frames, tpog.grid)
        here = np.searchsorted(voxels, field.cells)
        field = replace(field, cells=here)
        if score == "egvs":
            weight[here] = field.per_cell_bit / unit
            return Term(
                name, sight, weight, CAPPED, gamma * unit, False, lambda totals: field.score(totals, gamma, unit).egvs
            )
        weight[here] = field.per_cell_bit / field.total_bit if len(here) else 0.0
        return Term(name, sight, weight, CAPPED, 1.0, True, lambda totals: field.score(totals, 1.0).entropy_seen)
    occupied = OccupiedVoxels.of(tpog.counts)
    here = np.searchsorted(voxels, occupied.cells)
    occupied = replace(occupied, cells=here)
    if score == "coverage":
        weight[here] = 1.0 / max(len(here), 1)
        return Term(name, sight, weight, CAPPED, 1.0, True, occupied.coverage)
    weight[here] = occupied.counts / max(int(occupied.counts.sum()), 1)
    return Term(name, sight, weight, CAPPED, 1.0, True, occupied.expected_visibility)


def zone_term(name: str, sight: Sight, tpog: Tpog, voxels: Ints, inside: Ints, sensors: int) -> Term:
    """The share of a zone's entropy that at least so many sensors see.

    For more than one sensor that is no sum of concave functions: ``weight`` and ``scale`` are then those of a sum that
    is never below it (a voxel that k of n see counts k / n), and ``exact`` is the share itself.

    Parameters
    ----------
    inside
        Flat index of the voxels of the zone, ascending.
    """
    whole = EntropyField.of(tpog.counts, tpog.frames, tpog.grid)
    mine = np.isin(whole.cells, inside)
    cells, entropy = np.searchsorted(voxels, whole.cells[mine]), whole.per_cell_bit[mine]
    total = float(np.sum(entropy))
    weight = np.zeros(len(voxels))
    weight[cells] = entropy / (total * sensors) if total > 0.0 else 0.0

    def share(totals: Ints) -> float:
        return float(np.sum(entropy[totals[cells] >= sensors])) / total if total > 0.0 else 0.0

    return Term(name, sight, weight, CAPPED, float(sensors), True, share)


def target_term(name: str, score: str, sight: Sight, counts: Floats, unit: float) -> Term:
    """A score over vehicle-frames.

    Parameters
    ----------
    counts
        How much each vehicle-frame counts, (cells,) float64.
    unit
        What one point (or a chance of 1 - 1/e) adds to the amounts.
    """
    weight = counts / max(float(np.sum(counts)), np.finfo(np.float64).tiny)
    if score == "points_on_target":
        return Term(name, sight, weight, LOGARITHM, unit, False, lambda totals: mean(log_points(totals / unit), counts))
    if score == "seen_well":
        scale = SEEN_WELL_POINTS * unit
        return Term(name, sight, weight, SATURATING, scale, False, lambda totals: mean(well(totals / unit), counts))
    return Term(name, sight, weight, SATURATING, unit, False, lambda totals: mean(-np.expm1(-(totals / unit)), counts))
