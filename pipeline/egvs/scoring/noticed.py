r"""What people notice in the sweeps of a sensor: curves from simulated points to a share, by group of road users.

Two sensors of one junction were labelled, each by itself. Of the boxes in one list, the share that has a box within 3 m
in the other list says how many road users people notice, by the points that the simulation, with losses of returns
(:mod:`egvs.sensors.return_model`), puts on them. Shares, their standard errors and the source are in ``noticed.json``
beside this module: the table of the TUM Traffic Intersection Dataset (Zimmer et al., ITSC 2023, arXiv 2306.09266).

A curve is made from its row of the table as follows.

1. *Monotone*: neighbouring bins in the wrong order are pooled to their mean with the weights :math:`1 / se^2` (pool
   adjacent violators; Barlow et al., Statistical Inference under Order Restrictions, 1972). The standard error of a
   pool is :math:`(\sum 1 / se^2)^{-1/2}`.
2. *Nodes*: each bin has one node, at the geometric mean of its bounds; the last bin, which has no upper bound, at its
   lower bound. Between nodes, the curve is linear in :math:`\ln(1 + n)`; beyond the last one it is constant.
3. *Origin*: no points, nothing noticed. The first bin of the table contains boxes that match by chance, and makes no
   node.

So the share of n points is :math:`\sum_j h_j(n) s_j` with hat functions :math:`h_j` of the nodes. The mean over
vehicle-frames is :math:`\sum_k m_k s_k`, where :math:`m_k` is the mean of all hat functions of pool k. Pools are taken
as independent, also those of different groups, although they come from the same sweeps. So the curves contribute

.. math:: se^2 = \sum_k (m_k \, se_k)^2

to the squared standard error of the mean, and :math:`\sum_k ((m_k - m'_k) \, se_k)^2` to that of a difference of two
sites (:mod:`egvs.scoring.standard_errors`).

If all errors had one cause, the error would be :math:`\sum_k m_k \, se_k` instead, about twice as large.

Limits. One junction, two units of one type of sensor, 211 s of labelled sweeps at 10 Hz: the boxes are those of few
vehicles, seen again and again. The error does not contain how far another place, sensor or person differs, so what is
printed has an error of at least 10 points (:data:`egvs.results.levels.TRANSFER_ERROR`). Shares are not corrected for
boxes that match by chance: with a share c of such matches, they are too high by :math:`c (1 - s) / (1 - c)`. It was
measured of cars only, c = 0.13 (lists shifted by 60 s): 0.10 at s = 0.32 and 0.02 at s = 0.87. In simulated traffic in
which 0.13 of the cars match, too, 0.13 and 0.15 of the larger vehicles do, which match any vehicle, and 0.03 of the
people, one a frame as in the labels (``benchmarks.chance_matches``): too high by 0.12 at s = 0.32 and 0.03 at s = 0.82
(larger vehicles), and by 0.02 at s = 0.5 (people). If all that matches with less than half a point were chance (0.32
and 0.36), it would be 0.06 at s = 0.87 and 0.11 at s = 0.8. The reference is what the other sensor's list has, 14 m
away: vehicles that neither has are not counted, which makes shares too high. People follow a road user through time, so
their share can be higher than what one sweep shows. Whether a box fits is another question
(:mod:`egvs.scoring.target_scores`). *Outside the data* are road users of kinds that were not labelled as such, and
those farther than :data:`FARTHEST_M` from the sensor: the former take the curve of the group they resemble most, and
:func:`noticed_bounds` says how far the mean depends on both.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.scoring.targets import TargetRecord, TargetVisibility

DATA_FILE = Path(__file__).with_name("noticed.json")

CARS = "cars"
"""Name of the group of cars."""

FARTHEST_M = 80.0
"""The curves were compared with boxes up to this range."""


@dataclass(frozen=True, eq=False)
class NoticeCurve:
    """The share of road users that people notice, by the points on them.

    Attributes
    ----------
    points
        Points of each node, ascending, (k,) float64.
    shares
        Share at each node, ascending, (k,) float64.
    pool
        Pool that each node belongs to, (k,) int64.
    pool_se
        Standard error of the share of each pool, (pools,) float64.
    """

    points: FloatArray
    shares: FloatArray
    pool: IntArray
    pool_se: FloatArray

    @classmethod
    def of(
        cls, bins: Sequence[tuple[float, float | None]], shares: Sequence[float], standard_errors: Sequence[float]
    ) -> NoticeCurve:
        """Make the curve of a row of the table; the first bin is left out.

        Parameters
        ----------
        bins
            Lowest and highest number of points in each bin; None in the last one if it has no upper bound.
        shares, standard_errors
            Of each bin, from the first on; there may be fewer than bins.
        """
        points = [low if high is None else (low * high) ** 0.5 for low, high in bins[1 : len(shares)]]
        pooled = pool_adjacent_violators(np.array(shares[1:]), np.array(standard_errors[1:]))
        return cls(np.array(points), *pooled)

    def share(self, points: FloatArray) -> FloatArray:
        """Return the share noticed at each number of points (n,), (n,) float64, 0 to 1."""
        return self._interpolate(points, self.shares)

    def errors(self, points: FloatArray) -> FloatArray:
        """Return the change of the share at points (n,) by one standard error of each pool, (pools, n) float64."""
        changes = [self._interpolate(points, (self.pool == k) * se) for k, se in enumerate(self.pool_se)]
        return np.array(changes).reshape(len(self.pool_se), len(points))

    def _interpolate(self, points: FloatArray, at_nodes: FloatArray) -> FloatArray:
        """Interpolate linearly in ln(1 + n), from 0 at no points."""
        nodes = np.append(0.0, np.log1p(self.points))
        values: FloatArray = np.interp(np.log1p(points), nodes, np.append(0.0, at_nodes))
        return values


def pool_adjacent_violators(shares: FloatArray, standard_errors: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
    """Return the ascending shares that fit best by weighted least squares, with the weights 1 / se^2.

    Parameters
    ----------
    shares, standard_errors
        Of each bin, (k,) float64.

    Returns
    -------
    shares, pool, pool_se
        The ascending shares, (k,) float64; the pool that each belongs to, (k,) int64; and the standard error of each
        pool, (pools,) float64.

    Examples
    --------
    >>> shares, pool, pool_se = pool_adjacent_violators(np.array([0.2, 0.5, 0.4]), np.array([0.1, 0.1, 0.2]))
    >>> shares.round(3).tolist(), pool.tolist(), pool_se.round(3).tolist()
    ([0.2, 0.48, 0.48], [0, 1, 1], [0.1, 0.089])
    """
    pools: list[_Pool] = []
    for share, se in zip(shares.tolist(), standard_errors.tolist(), strict=True):
        pools.append(_Pool(share, se**-2, 1))
        while len(pools) > 1 and pools[-2].share >= pools[-1].share:
            last = pools.pop()
            pools[-1] = pools[-1].joined(last)
    size = [pool.bins for pool in pools]
    ascending = np.repeat([pool.share for pool in pools], size)
    pool_se = np.array([pool.weight**-0.5 for pool in pools])
    return ascending, np.repeat(np.arange(len(pools)), size), pool_se


class _Pool(NamedTuple):
    """Neighbouring bins with one share; their weights add up."""

    share: float
    weight: float
    bins: int

    def joined(self, other: _Pool) -> _Pool:
        weight = self.weight + other.weight
        return _Pool((self.weight * self.share + other.weight * other.share) / weight, weight, self.bins + other.bins)


@dataclass(frozen=True, eq=False)
class RoadUserGroup:
    """Road users that share a curve.

    Attributes
    ----------
    name
        Name of the group, in the plural.
    curve
        Their curve.
    boxes
        Number of boxes that the curve was measured with.
    measured
        SUMO's vClasses that were labelled as such.
    others
        vClasses that take the curve because they resemble the group most.
    """

    name: str
    curve: NoticeCurve
    boxes: int
    measured: frozenset[str]
    others: frozenset[str]

    @classmethod
    def of(cls, name: str, entry: Mapping[str, Any], bins: Sequence[tuple[float, float | None]]) -> RoadUserGroup:
        """Parse an entry of ``curves`` in the file."""
        curve = NoticeCurve.of(bins, entry["shares"], entry["standard_errors"])
        return cls(name, curve, entry["boxes"], frozenset(entry["vclasses"]), frozenset(entry["others"]))


@cache
def road_user_groups() -> tuple[RoadUserGroup, ...]:
    """Return the groups in the order of the file: cars, larger vehicles, people."""
    document = json.loads(DATA_FILE.read_text(encoding="utf-8"))
    bins = [(low, high) for low, high in document["bins"]]
    return tuple(RoadUserGroup.of(name, entry, bins) for name, entry in document["curves"].items())


def group_members(record: TargetRecord) -> dict[str, BoolArray]:
    """Return which rows of a record each group has, (n,) bool, by the name of the group."""
    members = {}
    for group in road_user_groups():
        of_group = np.array([kind in group.measured or kind in group.others for kind in record.kinds], dtype=np.bool_)
        members[group.name] = of_group[record.kind]
    return members


def noticed_chances(visible: TargetVisibility) -> FloatArray:
    """Return the probability that people notice each vehicle-frame in the sweep, (n,) float64, 0 to 1."""
    chances = np.zeros(len(visible))
    members = group_members(visible.record)
    for group in road_user_groups():
        rows = members[group.name]
        chances[rows] = group.curve.share(visible.points[rows])
    return chances


def noticed_errors(visible: TargetVisibility) -> FloatArray:
    """Return the change of :func:`noticed_chances` by one standard error of each pool of all curves, (pools, n)."""
    members = group_members(visible.record)
    changes = []
    for group in road_user_groups():
        rows = members[group.name]
        of_group = np.zeros((len(group.curve.pool_se), len(visible)))
        of_group[:, rows] = group.curve.errors(visible.points[rows])
        changes.append(of_group)
    return np.concatenate(changes)


def noticed_pools() -> int:
    """Return the number of pools of all curves: the length of :func:`noticed_errors`."""
    return sum(len(group.curve.pool_se) for group in road_user_groups())


def are_outside_data(visible: TargetVisibility) -> BoolArray:
    """Return which vehicle-frames are of a kind that was not measured, or farther than :data:`FARTHEST_M`, (n,)."""
    record = visible.record
    measured = frozenset[str]().union(*(group.measured for group in road_user_groups()))
    is_measured = np.array([kind in measured for kind in record.kinds], dtype=np.bool_)[record.kind]
    return ~is_measured | (visible.range_m > FARTHEST_M)


def noticed_bounds(visible: TargetVisibility) -> tuple[FloatArray, FloatArray]:
    """Return :func:`noticed_chances` if nothing, and if everything outside the data was noticed, (n,) float64 each."""
    chances, outside = noticed_chances(visible), are_outside_data(visible)
    return np.where(outside, 0.0, chances), np.where(outside, 1.0, chances)
