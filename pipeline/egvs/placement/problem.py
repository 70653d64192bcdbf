r"""Define the placement problem: coverage terms over sparse visibility, zone demands, rules, and values of plans.

A *plan* is a set S of candidate poses. Each score of a plan is a sum over cells (voxels or vehicle-frames):

.. math:: F(S) = \sum_c w_c \, f\Big(\sum_{s \in S} a_s(c)\Big)

with weights :math:`w_c \ge 0`, amounts :math:`a_s(c) \ge 0` (how often pose s hits cell c), and f concave,
non-decreasing, f(0) = 0. F is therefore monotone and submodular: the gain from a further sensor never grows as others
are added. The scores that may rank sites are all of this form:

=====================  =====================  ==========================================  ==================
score                  cells                  amounts                                     f
=====================  =====================  ==========================================  ==================
egvs                   voxels with entropy    beams                                       min(gamma, t)
entropy_seen           voxels with entropy    1 where a beam crosses                      min(1, t)
coverage               voxels with traffic    1 where a beam crosses                      min(1, t)
expected_visibility    voxels with traffic    1 where a beam crosses                      min(1, t)
points_on_target       vehicle-frames         points                                      ln(1 + t)
seen_well              vehicle-frames         points                                      1 - exp(-t / n0)
expected_detections    vehicle-frames         -ln(1 - detection probability)              1 - exp(-t)
those of plug-ins      vehicle-frames         -ln(1 - value)                              1 - exp(-t)
=====================  =====================  ==========================================  ==================

The last two treat sensors as independent: a vehicle is missed when each sensor by itself misses it. They do not model
detectors that work on merged point clouds.

Amounts and their totals are whole numbers, so the value of a plan depends neither on the order of its sensors nor on
the number of threads. They are stored as sparse rows, in memory or, above :data:`MAX_BYTES_IN_MEMORY`, in a temporary
file.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.tpog import Tpog
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.core.threads import map_ordered
from egvs.core.wording import number_of
from egvs.kernels import submodular
from egvs.scoring.egvs import EntropyField
from egvs.scoring.scorer import OccupiedVoxels
from egvs.scoring.target_scores import log_points, saturating_gain
from egvs.scoring.targets import SEEN_WELL_POINTS, weighted_mean

Plan = tuple[int, ...]
"""Indices of candidates."""

MAX_BYTES_IN_MEMORY = 1_500_000_000
"""A larger visibility matrix is written to a temporary file and mapped into memory."""

VOXEL_SCORES = ("egvs", "entropy_seen", "coverage", "expected_visibility")
"""Scores whose cells are voxels. The cells of all other scores are vehicle-frames."""

CHANCE_UNIT = 2.0**44
"""A probability p is stored as -ln(1 - p), rounded to a multiple of 1 / CHANCE_UNIT."""

_MAX_UINT16 = int(np.iinfo(np.uint16).max)

_COST_TOLERANCE = 1e-9
"""Costs are sums of decimal numbers, so a plan may exceed the budget by this share of it."""

_DEMAND_TOLERANCE = 1e-12
"""A demand that is missed by no more than this share counts as met."""

_MIN_CANDIDATES_FOR_THREADS = 64
"""Fewer candidates than this are not worth starting threads for."""


@dataclass(frozen=True, eq=False)
class VisibilityRow:
    """Cells that one pose hits.

    Attributes
    ----------
    cells
        Indices of the cells, (k,) int32, ascending.
    amounts
        Number of hits in each, (k,) uint16 or int64, above 0.
    """

    cells: NDArray[np.int32]
    amounts: NDArray[Any]

    @classmethod
    def of(cls, hits: NDArray[Any], max_amount: int) -> VisibilityRow:
        """Build a row from the hits of every cell, (n_cells,) whole numbers, capped at ``max_amount``."""
        cells = np.flatnonzero(hits).astype(np.int32)
        dtype = np.uint16 if max_amount <= _MAX_UINT16 else np.int64
        amounts = np.minimum(hits[cells].astype(np.int64), max_amount)
        return cls(cells, amounts.astype(dtype))

    def dense(self, n_cells: int) -> IntArray:
        """Return the amounts in all cells, (n_cells,) int64."""
        amounts = np.zeros(n_cells, dtype=np.int64)
        amounts[self.cells] = self.amounts
        return amounts


@dataclass(frozen=True, eq=False)
class VisibilityMatrix:
    """Cells that each candidate hits, as a sparse matrix (candidates x cells) in CSR form.

    Attributes
    ----------
    n_cells
        Number of cells.
    starts
        Candidate i has the entries starts[i] to starts[i + 1], (candidates + 1,) int64.
    cells, amounts
        The entries of all candidates, one after another; see :class:`VisibilityRow`.
    """

    n_cells: int
    starts: IntArray
    cells: NDArray[np.int32]
    amounts: NDArray[Any]

    def __len__(self) -> int:
        """Number of candidates."""
        return len(self.starts) - 1

    @classmethod
    def of(cls, rows: Iterable[VisibilityRow], n_cells: int) -> VisibilityMatrix:
        """Build the matrix from the rows of all candidates."""
        builder = VisibilityMatrixBuilder(n_cells)
        for row in rows:
            builder.add(row)
        return builder.build()

    def row(self, candidate: int) -> VisibilityRow:
        """Cells that one candidate hits."""
        entries = slice(int(self.starts[candidate]), int(self.starts[candidate + 1]))
        return VisibilityRow(self.cells[entries], self.amounts[entries])


class VisibilityMatrixBuilder:
    """Collect the rows of candidates, one after another, into a :class:`VisibilityMatrix`.

    Parameters
    ----------
    n_cells
        Number of cells.
    max_bytes
        More bytes than this go to a temporary file.
    """

    def __init__(self, n_cells: int, max_bytes: int = MAX_BYTES_IN_MEMORY) -> None:
        self._n_cells = n_cells
        self._max_bytes = max_bytes
        self._lengths = [0]
        self._pending: list[VisibilityRow] = []
        self._pending_bytes = 0
        self._files: tuple[IO[bytes], IO[bytes]] | None = None

    def add(self, row: VisibilityRow) -> None:
        """Append the row of the next candidate."""
        self._lengths.append(len(row.cells))
        self._pending.append(row)
        self._pending_bytes += row.cells.nbytes + row.amounts.nbytes
        if self._pending_bytes > self._max_bytes:
            self._spill()

    def build(self) -> VisibilityMatrix:
        """Return the matrix of all rows."""
        starts = np.cumsum(self._lengths, dtype=np.int64)
        cells: NDArray[np.int32]
        amounts: NDArray[Any]

        if not self._pending and self._files is None:
            cells = np.empty(0, dtype=np.int32)
            amounts = np.empty(0, dtype=np.uint16)
            return VisibilityMatrix(self._n_cells, starts, cells, amounts)

        if self._files is None or not starts[-1]:
            cells = np.concatenate([row.cells for row in self._pending])
            amounts = np.concatenate([row.amounts for row in self._pending])
            return VisibilityMatrix(self._n_cells, starts, cells, amounts)

        dtype = self._spill()
        cells_file, amounts_file = self._files
        cells = np.memmap(cells_file, dtype=np.int32, mode="r")
        amounts = np.memmap(amounts_file, dtype=dtype, mode="r")
        cells_file.close()  # the mapping stays valid
        amounts_file.close()
        return VisibilityMatrix(self._n_cells, starts, cells, amounts)

    def _spill(self) -> np.dtype[Any]:
        """Write the pending rows to the temporary files; return the dtype of the amounts."""
        if self._files is None:
            self._files = _anonymous_file(), _anonymous_file()
            self._amounts_dtype = self._pending[0].amounts.dtype
        cells_file, amounts_file = self._files
        for row in self._pending:
            cells_file.write(row.cells.tobytes())
            amounts_file.write(row.amounts.tobytes())
        cells_file.flush()
        amounts_file.flush()
        self._pending = []
        self._pending_bytes = 0
        return self._amounts_dtype


def _anonymous_file() -> IO[bytes]:
    """Open a temporary file that disappears when it is closed and unmapped."""
    return tempfile.TemporaryFile(prefix="egvs-place-")


class GainBound(NamedTuple):
    """An upper bound on a sum of gains, and the relaxed selection that attains it.

    Attributes
    ----------
    total
        The bound.
    candidates, shares
        The selected candidates and the share of each, 0 to 1, both (m,).
    """

    total: float
    candidates: IntArray
    shares: FloatArray


@dataclass(frozen=True, eq=False)
class PlanRules:
    """Rules that every plan over n candidates keeps.

    Attributes
    ----------
    count
        Maximum number of sensors.
    budget
        Maximum cost; infinite if there is no budget.
    cost
        Cost of each candidate alone, (n,) float64, 0 or above; 0 for forced candidates.
    pole_cost
        The part of ``cost`` that pays for the pole, (n,) float64; paid once for all sensors at a pole.
    pole
        Index of each candidate's pole, (n,) int64.
    forced
        Candidates that are part of every plan.
    excluded
        Candidates that are part of no plan, (n,) bool.
    most_per_pole
        Maximum number of sensors at one pole.
    position_m
        Positions in the world frame, (n, 3) float64.
    least_distance_m
        Minimum distance between any two sensors.
    """

    count: int
    budget: float
    cost: FloatArray
    pole_cost: FloatArray
    pole: IntArray
    forced: tuple[int, ...]
    excluded: BoolArray
    most_per_pole: int
    position_m: FloatArray
    least_distance_m: float

    def cost_of(self, plan: Sequence[int]) -> float:
        """Cost of a plan. Each pole is paid for once; a pole with a forced sensor is free."""
        candidates = list(plan)
        mount_cost = (self.cost - self.pole_cost)[candidates].sum()
        return float(mount_cost + self._paid_for_poles(candidates).sum())

    def further_cost(self, plan: Sequence[int]) -> FloatArray:
        """Cost of adding each candidate to a plan, (n,)."""
        paid = self._paid_for_poles(list(plan))
        paid[self.pole[list(self.forced)]] = np.inf
        return self.cost - self.pole_cost + np.maximum(self.pole_cost - paid[self.pole], 0.0)

    def _paid_for_poles(self, candidates: list[int]) -> FloatArray:
        """Cost of each pole under some candidates, (poles,)."""
        paid = np.zeros(int(self.pole.max(initial=-1)) + 1)
        np.maximum.at(paid, self.pole[candidates], self.pole_cost[candidates])
        paid[self.pole[list(self.forced)]] = 0.0
        return paid

    @property
    def max_sensors(self) -> int:
        """Upper bound on the number of sensors, from the count and from the cheapest candidates."""
        cheapest = np.sort((self.cost - self.pole_cost)[~self.excluded])
        affordable = int(np.searchsorted(np.cumsum(cheapest), self.budget * (1.0 + _COST_TOLERANCE), side="right"))
        return max(1, min(self.count, affordable))

    def allowed_additions(self, plan: Sequence[int]) -> BoolArray:
        """Return which candidates may be added to a plan that keeps the rules, (n,) bool."""
        candidates = list(plan)
        allowed: BoolArray = ~self.excluded
        if len(candidates) >= self.count:
            return np.zeros_like(allowed)

        allowed[candidates] = False
        if candidates:
            poles, n_sensors = np.unique(self.pole[candidates], return_counts=True)
            allowed &= ~np.isin(self.pole, poles[n_sensors >= self.most_per_pole])
        if candidates and self.least_distance_m > 0.0:
            offset_m = self.position_m[:, None] - self.position_m[candidates][None]
            distance_m = np.sqrt((offset_m**2).sum(axis=2))
            allowed &= (distance_m >= self.least_distance_m).all(axis=1)
        if np.isfinite(self.budget):
            total_cost = self.cost_of(candidates) + self.further_cost(candidates)
            allowed &= total_cost <= self.budget * (1.0 + _COST_TOLERANCE)
        return allowed

    def what_forbids_more(self, plan: Sequence[int]) -> str:
        """Return what forbids every other candidate beside a plan: the rules, and the budget if it does, too.

        Empty if a larger count and budget would allow one, or there is no other.
        """
        unlimited = replace(self, count=len(self.cost) + 1, budget=np.inf)
        without_rules = replace(unlimited, most_per_pole=len(self.cost), least_distance_m=0.0)
        if unlimited.allowed_additions(plan).any() or not without_rules.allowed_additions(plan).any():
            return ""
        per_pole = f"the limit of {number_of(self.most_per_pole, 'sensor')} per pole (most_per_pole)"
        distance = f"the distance of {self.least_distance_m:g} m (least_distance_m)"
        rules = {
            per_pole: replace(without_rules, most_per_pole=self.most_per_pole),
            distance: replace(unlimited, most_per_pole=len(self.cost)),
        }
        free = without_rules.allowed_additions(plan)
        names = [name for name, alone in rules.items() if (free & ~alone.allowed_additions(plan)).any()]
        if not replace(without_rules, budget=self.budget).allowed_additions(plan).any():
            names.append("the budget")
        return " and ".join(names)

    def allows(self, plan: Sequence[int]) -> bool:
        """Whether a plan, in any order, keeps the rules and contains the forced candidates."""
        if not set(self.forced) <= set(plan):
            return False
        return all(self.allowed_additions(plan[:number])[candidate] for number, candidate in enumerate(plan))

    def max_gain_sum(self, gains: FloatArray, candidates: IntArray, plan: Sequence[int]) -> GainBound:
        """Bound the sum of gains that candidates may add to a plan.

        Two relaxations bound it: the count with the poles (costs ignored) and the fractional knapsack of the budget
        (count and poles ignored). The smaller one is returned.

        Parameters
        ----------
        gains
            Gain of each of ``candidates``, (k,) float64, 0 or above.
        candidates
            The candidates that may be added, (k,).
        plan
            The sensors that are there already.
        """
        order = np.argsort(-gains, kind="stable")
        if self.most_per_pole < len(self.cost):
            order = order[self._fits_on_pole(self.pole[candidates[order]], plan)]
        selected = order[: max(self.count - len(plan), 0)]
        total_by_count = float(gains[selected].sum())
        by_count = GainBound(total_by_count, candidates[selected], np.ones(len(selected)))
        if not np.isfinite(self.budget) or not len(candidates):
            return by_count

        if self.most_per_pole > 1:  # another sensor of a better plan may have paid for the pole
            cost = (self.cost - self.pole_cost)[candidates]
        else:
            cost = self.further_cost(plan)[candidates]
        remaining_budget = self.budget * (1 + _COST_TOLERANCE) - self.cost_of(plan)
        with np.errstate(divide="ignore", invalid="ignore"):
            gain_per_cost = np.where(cost > 0.0, gains / cost, np.inf)
        order = np.argsort(-gain_per_cost, kind="stable")
        cost_before = np.cumsum(cost[order]) - cost[order]
        spent = np.clip(remaining_budget - cost_before, 0.0, cost[order])
        shares = np.divide(spent, cost[order], out=np.ones(len(order)), where=cost[order] > 0.0)
        total_by_cost = float((gains[order] * shares).sum())
        if total_by_count <= total_by_cost:
            return by_count
        bought = shares > 0.0
        return GainBound(total_by_cost, candidates[order[bought]], shares[bought])

    def _fits_on_pole(self, pole: IntArray, plan: Sequence[int]) -> BoolArray:
        """Of candidates in order of preference, given by their poles: which ones find room at their pole."""
        order = np.argsort(pole, kind="stable")
        sorted_poles = pole[order]
        number_on_pole = np.empty(len(pole), dtype=np.int64)
        number_on_pole[order] = np.arange(len(pole)) - np.searchsorted(sorted_poles, sorted_poles)
        if plan:
            used_poles, n_used = np.unique(self.pole[list(plan)], return_counts=True)
            at = np.minimum(np.searchsorted(used_poles, pole), len(used_poles) - 1)
            number_on_pole = number_on_pole + np.where(used_poles[at] == pole, n_used[at], 0)
        return number_on_pole < self.most_per_pole


@dataclass(frozen=True, eq=False)
class CoverageTerm:
    """One sum F(S), see the module's docstring.

    Attributes
    ----------
    name
        Name of the period or zone; "" for all traffic.
    visibility
        The amounts of all candidates.
    weight
        w, (n_cells,) float64.
    curve, scale
        The concave function f and its parameter, see :mod:`egvs.kernels.submodular`.
    each_once
        Whether every hit cell counts as 1 per sensor, whatever its amount.
    exact
        F from the totals of all cells, (n_cells,) int64; rounded once, so that the order of summation does not matter.
    """

    name: str
    visibility: VisibilityMatrix
    weight: FloatArray
    curve: int
    scale: float
    each_once: bool
    exact: Callable[[IntArray], float]


def voxel_term(
    name: str, score: str, visibility: VisibilityMatrix, tpog: Tpog, voxels: IntArray, gamma: float, unit: int
) -> CoverageTerm:
    """Return the term of one of :data:`VOXEL_SCORES`.

    Parameters
    ----------
    name
        Name of the period.
    score
        The score.
    visibility
        Hits of all candidates.
    tpog
        Occupancy of the period.
    voxels
        Flat indices of the cells of ``visibility``, see :func:`egvs.scoring.scorer.ever_occupied`.
    gamma
        Cap on the hits of a voxel.
    unit
        Amount that one whole beam adds.
    """
    weight = np.zeros(len(voxels))
    if score in ("egvs", "entropy_seen"):
        field = EntropyField.of(tpog.counts, tpog.frames, tpog.grid)
        cells = np.searchsorted(voxels, field.cells)
        field = replace(field, cells=cells)
        if score == "egvs":
            weight[cells] = field.per_cell_bit / unit
            scale = gamma * unit
            return CoverageTerm(
                name, visibility, weight, submodular.CAPPED, scale, False,
                lambda totals: field.score(totals, gamma, unit).egvs,
            )  # fmt: skip
        if len(cells):
            weight[cells] = field.per_cell_bit / field.total_bit
        return CoverageTerm(
            name, visibility, weight, submodular.CAPPED, 1.0, True,
            lambda totals: field.score(totals, 1.0).entropy_seen,
        )  # fmt: skip

    occupied = OccupiedVoxels.of(tpog.counts)
    cells = np.searchsorted(voxels, occupied.cells)
    occupied = replace(occupied, cells=cells)
    if score == "coverage":
        weight[cells] = 1.0 / max(len(cells), 1)
        exact = occupied.coverage
    else:
        weight[cells] = occupied.counts / max(int(occupied.counts.sum()), 1)
        exact = occupied.expected_visibility
    return CoverageTerm(name, visibility, weight, submodular.CAPPED, 1.0, True, exact)


def zone_term(
    name: str, visibility: VisibilityMatrix, tpog: Tpog, voxels: IntArray, inside: IntArray, sensors: int
) -> CoverageTerm:
    """Return the share of a zone's entropy that is visible to at least ``sensors`` sensors.

    For more than one sensor this share is not a sum of concave functions. ``weight`` and ``scale`` then describe an
    upper bound that is (a voxel that k of n sensors see counts k / n), and ``exact`` is the share itself.

    Parameters
    ----------
    name
        Name of the zone.
    visibility
        Hits of all candidates.
    tpog
        Occupancy of all traffic.
    voxels
        Flat indices of the cells of ``visibility``.
    inside
        Flat indices of the voxels in the zone, ascending.
    sensors
        Number of sensors that must see a voxel.
    """
    field = EntropyField.of(tpog.counts, tpog.frames, tpog.grid)
    in_zone = np.isin(field.cells, inside)
    cells = np.searchsorted(voxels, field.cells[in_zone])
    entropy_bit = field.per_cell_bit[in_zone]
    total_bit = float(np.sum(entropy_bit))
    weight = np.zeros(len(voxels))
    if total_bit > 0.0:
        weight[cells] = entropy_bit / (total_bit * sensors)

    def visible_share(totals: IntArray) -> float:
        if not total_bit > 0.0:
            return 0.0
        return float(np.sum(entropy_bit[totals[cells] >= sensors])) / total_bit

    return CoverageTerm(name, visibility, weight, submodular.CAPPED, float(sensors), True, visible_share)


def target_term(name: str, score: str, visibility: VisibilityMatrix, counts: FloatArray, unit: float) -> CoverageTerm:
    """Return the term of a score over vehicle-frames.

    Parameters
    ----------
    name
        Name of the period.
    score
        The score.
    visibility
        Amounts of all candidates.
    counts
        Weight of each vehicle-frame, (n_cells,) float64.
    unit
        Amount that one point adds (for ``expected_detections``: a detection probability of 1 - 1/e).
    """
    weight = counts / max(float(np.sum(counts)), np.finfo(np.float64).tiny)
    curve, scale = submodular.SATURATING, unit
    if score == "points_on_target":
        curve = submodular.LOGARITHM
    elif score == "seen_well":
        scale = SEEN_WELL_POINTS * unit
    return CoverageTerm(
        name, visibility, weight, curve, scale, False,
        lambda totals: weighted_mean(target_values(score, totals, unit), counts),
    )  # fmt: skip


def target_values(score: str, totals: IntArray, unit: float) -> FloatArray:
    """Return the value of each vehicle-frame, f of its total amount, (n_cells,) float64.

    Parameters
    ----------
    score
        A score over vehicle-frames.
    totals
        Total amount in each vehicle-frame, (n_cells,) int64.
    unit
        As in :func:`target_term`.
    """
    if score == "points_on_target":
        return log_points(totals / unit)
    if score == "seen_well":
        return saturating_gain(totals / unit)
    return -np.expm1(-(totals / unit))


class CoverageState:
    """The total amounts of a set of candidates, updated as candidates are added and removed.

    Parameters
    ----------
    terms
        The sums that will be evaluated.
    chosen
        Candidates to begin with.
    threads
        Number of threads for gains.
    """

    def __init__(self, terms: Sequence[CoverageTerm], chosen: Iterable[int] = (), threads: int = 1) -> None:
        self._threads = threads
        self._matrices = {(id(term.visibility), term.each_once): term.visibility for term in terms}
        self._totals = {key: np.zeros(matrix.n_cells, dtype=np.int64) for key, matrix in self._matrices.items()}
        self.chosen: list[int] = []
        for candidate in chosen:
            self.add(candidate)

    def add(self, candidate: int) -> None:
        """Add a candidate."""
        self._change(candidate, 1)
        self.chosen.append(candidate)

    def remove(self, candidate: int) -> None:
        """Remove a candidate; ValueError if it is not in the set."""
        self.chosen.remove(candidate)
        self._change(candidate, -1)

    def _change(self, candidate: int, times: int) -> None:
        for key, matrix in self._matrices.items():
            _, each_once = key
            first = int(matrix.starts[candidate])
            last = int(matrix.starts[candidate + 1])
            submodular.add_sensor(
                first, last, matrix.cells, matrix.amounts, each_once, np.int64(times), self._totals[key]
            )

    def totals(self, term: CoverageTerm) -> IntArray:
        """Total amount in each cell, (n_cells,); do not modify."""
        return self._totals[id(term.visibility), term.each_once]

    def value(self, term: CoverageTerm) -> float:
        """F of this set, rounded once."""
        return term.exact(self.totals(term))

    def value_with(self, term: CoverageTerm, row: VisibilityRow) -> float:
        """F of this set and a further pose with visibility ``row``, rounded once."""
        totals = self.totals(term).copy()
        submodular.add_sensor(0, len(row.cells), row.cells, row.amounts, term.each_once, np.int64(1), totals)
        return term.exact(totals)

    def gains(self, term: CoverageTerm, candidates: IntArray) -> FloatArray:
        """Gain from each of some candidates, (k,) float64; the rounding error is at most 1e-11 of the sum."""
        totals = self.totals(term)
        matrix = term.visibility

        def gains_of(rows: IntArray) -> FloatArray:
            gains = np.empty(len(rows))
            submodular.marginal_gains(
                rows, matrix.starts, matrix.cells, matrix.amounts, term.each_once, totals, term.weight, term.curve,
                term.scale, gains,
            )  # fmt: skip
            return gains

        return map_in_threads(gains_of, candidates, self._threads)


def map_in_threads(function: Callable[[IntArray], FloatArray], candidates: IntArray, threads: int) -> FloatArray:
    """Apply a function to parts of the candidates in several threads; return the results in order."""
    if threads == 1 or len(candidates) < _MIN_CANDIDATES_FOR_THREADS:
        return function(candidates)
    parts = np.array_split(candidates, 4 * threads)
    return np.concatenate(list(map_ordered(function, parts, threads)))


@dataclass(frozen=True, eq=False)
class Demand:
    """A lower limit ``least`` on the value of ``term``."""

    term: CoverageTerm
    least: float

    def unmet(self, reached: FloatArray | float) -> FloatArray:
        """Share of the demand that values fall short by, 0 to 1."""
        missing = np.maximum(self.least - np.asarray(reached), 0.0)
        if not self.least:
            return 0 * missing
        return np.where(missing > _DEMAND_TOLERANCE * self.least, missing / self.least, 0.0)


@dataclass(frozen=True, order=True)
class PlanValue:
    """Value of a plan. Plans compare by ``met``, then ``value``, then ``joint``; greater is better.

    Attributes
    ----------
    met
        Minus the sum of the unmet shares of all demands; 0 if all are met.
    value
        The objective: the joint score; the smallest of several periods; or the score left when any one sensor fails.
    joint
        The joint score for all traffic.
    """

    met: float
    value: float
    joint: float


class AdditionValues(NamedTuple):
    """Values of a plan with each of k candidates added, see :class:`PlanValue`; (k,) float64 each."""

    met: FloatArray
    value: FloatArray
    joint: FloatArray


@dataclass(frozen=True, eq=False)
class Problem:
    """A placement problem: which plan within the rules has the greatest :class:`PlanValue`?

    Attributes
    ----------
    joint
        The joint score for all traffic.
    objective
        The terms whose smallest value is maximised; usually ``joint`` alone.
    demands
        Lower limits on terms.
    rules
        Count, budget, poles and distances.
    survives
        Number of sensors that may fail: with 1, the objective is the value left after the worst single failure.
    threads
        Number of threads for gains.
    """

    joint: CoverageTerm
    objective: tuple[CoverageTerm, ...]
    demands: tuple[Demand, ...]
    rules: PlanRules
    survives: int = 0
    threads: int = 1

    @property
    def terms(self) -> tuple[CoverageTerm, ...]:
        """All terms, each once."""
        terms = (self.joint, *self.objective, *(demand.term for demand in self.demands))
        return tuple({id(term): term for term in terms}.values())

    @property
    def candidates(self) -> IntArray:
        """Candidates that may be part of a plan."""
        return np.flatnonzero(~self.rules.excluded).astype(np.int64)

    @property
    def is_plain(self) -> bool:
        """Whether a single term is maximised, without demands or failures."""
        return len(self.objective) == 1 and not self.demands and not self.survives

    def with_count(self, count: int) -> Problem:
        """Return the problem with another maximum number of sensors."""
        return replace(self, rules=replace(self.rules, count=count))

    def restricted_to(self, candidates: Iterable[int]) -> Problem:
        """Return the problem with all other candidates excluded."""
        excluded = np.ones_like(self.rules.excluded)
        excluded[list(candidates)] = False
        return replace(self, rules=replace(self.rules, excluded=excluded | self.rules.excluded))

    def coverage_state(self, chosen: Sequence[int] = ()) -> CoverageState:
        """Return the totals of a set of candidates for all terms."""
        return CoverageState(self.terms, chosen, self.threads)

    def plan_value(self, plan: Sequence[int]) -> PlanValue:
        """Value of a plan."""
        return self.plan_value_of(self.coverage_state(plan))

    def plan_value_of(self, state: CoverageState) -> PlanValue:
        """Value of the plan whose totals ``state`` holds."""
        met = -sum(float(demand.unmet(state.value(demand.term))) for demand in self.demands)
        if self.survives:
            value = min(self._values_after_failure(state), default=0.0)
        else:
            value = min(state.value(term) for term in self.objective)
        return PlanValue(met, value, state.value(self.joint))

    def _values_after_failure(self, state: CoverageState) -> list[float]:
        """Objective without each single sensor of a plan."""
        values = []
        for candidate in list(state.chosen):
            state.remove(candidate)
            values.append(min(state.value(term) for term in self.objective))
            state.add(candidate)
        return values

    def values_with_each(self, state: CoverageState, candidates: IntArray) -> AdditionValues:
        """Values of a plan with each of some candidates added.

        They are exact up to rounding, except ``met`` for demands on several sensors, which is an upper bound.
        """
        met = np.zeros(len(candidates))
        for demand in self.demands:
            reached = self.relaxed_value(state, demand.term) + state.gains(demand.term, candidates)
            met -= demand.unmet(reached)
        joint = state.value(self.joint) + state.gains(self.joint, candidates)

        if not self.survives:
            if self.objective == (self.joint,):
                return AdditionValues(met, joint, joint)
            return AdditionValues(met, self._objective_with_each(state, candidates), joint)

        value = np.full(len(candidates), min(state.value(term) for term in self.objective))
        for candidate in list(state.chosen):
            state.remove(candidate)
            value = np.minimum(value, self._objective_with_each(state, candidates))
            state.add(candidate)
        return AdditionValues(met, value, joint)

    def _objective_with_each(self, state: CoverageState, candidates: IntArray) -> FloatArray:
        values = [state.value(term) + state.gains(term, candidates) for term in self.objective]
        smallest: FloatArray = np.min(values, axis=0)
        return smallest

    @staticmethod
    def relaxed_value(state: CoverageState, term: CoverageTerm) -> float:
        """Submodular upper bound on a demand's term; the term itself if one sensor is enough."""
        if term.scale <= 1.0 or not term.each_once:
            return state.value(term)
        return float((term.weight * np.minimum(state.totals(term), term.scale)).sum())


def tie_break_key(plan: Plan) -> tuple[int, Plan]:
    """Key that orders plans of equal value: fewer sensors first, then by candidate index."""
    return len(plan), plan
