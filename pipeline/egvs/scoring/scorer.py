r"""Score empty scans against a Traffic Probabilistic Occupancy Grid (TPOG): EGVS and shares of occupied voxels.

.. math:: EGVS(site) = \sum_v H(p(v)) \, \min(\gamma, hits(v))

(arXiv 2504.06772, Eq. 4): ``hits`` are the beams of the empty scan that cross voxel v, p comes from the TPOG. The sum
is that of :mod:`egvs.scoring.egvs`, hits are those of :mod:`egvs.scoring.visibility`.

Other scores are shares of the voxels that a site's beams cross: of their number, of occupancy, of entropy.

.. math:: \sum_v w(v) [hits(v) > 0] \Big/ \sum_v w(v)

with w = 1 in voxels that traffic ever occupies (``coverage``: the rest are blind spots; Kim et al. 2023), w = p
(``expected_visibility``), w = H(p) (``entropy_seen``). All shares are 0 for a TPOG without traffic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.tpog import Tpog
from egvs.core.arguments import check_instance
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.core.wording import format_percent
from egvs.scoring.egvs import EntropyField
from egvs.scoring.standard_errors import BlockJackknife
from egvs.scoring.visibility import Beams, HitCounter, Hits
from egvs.sensors.scanner import Scan
from egvs.sensors.scene import Scene

VOXEL_SHARES = ("entropy_seen", "coverage", "expected_visibility")
"""Scores that are shares of voxels, by the names that scenarios use."""


@dataclass(frozen=True)
class SiteScore:
    """Scores of one site over voxels.

    Attributes
    ----------
    egvs
        The score in bits.
    entropy_seen
        Share of the TPOG's entropy in voxels crossed at least once.
    replicates
        The EGVS of all frames, then with each group of blocks left out, (1 + k,) float64, see
        :class:`egvs.scoring.standard_errors.BlockJackknife`; None without standard errors.
    shares
        The scores of :data:`VOXEL_SHARES` that the scenario requests, by name, in the form of ``replicates``; (1,)
        without standard errors.
    by_period
        Scores in each period alone, where the TPOG is a mix and they are requested.
    """

    egvs: float
    entropy_seen: float
    replicates: FloatArray | None = None
    shares: Mapping[str, FloatArray] = field(default_factory=dict)
    by_period: tuple[SiteScore, ...] = ()

    def __repr__(self) -> str:
        shares = {"entropy_seen": self.entropy_seen} | {name: values[0] for name, values in self.shares.items()}
        listed = ", ".join(f"{name} {format_percent(value)}" for name, value in shares.items())
        return f"SiteScore(egvs {self.egvs:,.1f} bit, {listed})"


@dataclass(frozen=True)
class PeriodTpog:
    """The TPOG of one period alone, and its groups of blocks for standard errors."""

    name: str
    tpog: Tpog
    leave_out: BlockJackknife | None = None


class Scorer:
    """Scores one scan after another. Threads may share one; it is pickled as its arguments.

    Parameters
    ----------
    scene
        The scene of the scans; its scenario sets gamma.
    tpog
        Occupancy by traffic.
    trajectories
        ``trajectories.parquet``, only for effects that replay traffic.
    leave_out
        Groups of blocks that are left out in turn, for standard errors.
    periods
        TPOGs of single periods; each scan is scored against these as well, with the same hits.

    Raises
    ------
    InputError
        If the scene is a path, or the TPOG has another grid than the scene's region of interest.
    """

    def __init__(
        self,
        scene: Scene,
        tpog: Tpog,
        trajectories: Path | None = None,
        leave_out: BlockJackknife | None = None,
        periods: tuple[PeriodTpog, ...] = (),
    ) -> None:
        check_instance("scene", scene, Scene, "egvs.build_scene(scenario)")
        check_instance("tpog", tpog, Tpog, "egvs.read_tpog(path)")
        _check_grid(tpog, scene)
        self._arguments = (scene, tpog, trajectories, leave_out, periods)
        additional = scene.scenario.score.additional
        self._requested_shares: tuple[str, ...] = tuple(name for name in VOXEL_SHARES if name in additional)
        self._gamma = scene.scenario.gamma
        self._mix = _ScoredTpog.of(tpog, leave_out)
        self._periods = tuple(_ScoredTpog.of(period.tpog, period.leave_out) for period in periods)
        self._cells = ever_occupied([tpog, *(period.tpog for period in periods)])
        self._visibility = HitCounter(scene, tpog, trajectories)
        self.field = self._mix.entropy

    def __reduce__(
        self,
    ) -> tuple[type[Scorer], tuple[Scene, Tpog, Path | None, BlockJackknife | None, tuple[PeriodTpog, ...]]]:
        return Scorer, self._arguments

    @property
    def limit(self) -> float:
        """The highest possible EGVS: gamma beams in every voxel."""
        return self.field.limit(self._gamma)

    @property
    def limits_by_period(self) -> list[float]:
        """The same for each period."""
        return [period.entropy.limit(self._gamma) for period in self._periods]

    def score(self, scan: Scan | Beams) -> SiteScore:
        """Score one scan."""
        return self._score_hits(self._visibility.borrowed_hits(_as_beams(scan), self._cells))

    def score_and_hits(self, scan: Scan | Beams) -> tuple[SiteScore, FloatArray]:
        """Score one scan; return also the number of beams that cross each voxel, (nx, ny, nz) float64."""
        hits = self._visibility.borrowed_hits(_as_beams(scan))
        return self._score_hits(hits), self._in_beams(hits)

    def hits(self, scan: Scan | Beams) -> FloatArray:
        """Return the number of beams that cross each voxel, (nx, ny, nz) float64; an integer without weighted beams."""
        return self._in_beams(self._visibility.borrowed_hits(_as_beams(scan)))

    def _in_beams(self, hits: Hits) -> FloatArray:
        return (hits / self._visibility.unit).reshape(self.field.grid.shape)

    def _score_hits(self, hits: Hits) -> SiteScore:
        by_period = tuple(self._score_hits_against(hits, period) for period in self._periods)
        return replace(self._score_hits_against(hits, self._mix), by_period=by_period)

    def _score_hits_against(self, hits: Hits, tpog: _ScoredTpog) -> SiteScore:
        unit = self._visibility.unit
        score = tpog.entropy.score(hits, self._gamma, unit)
        replicates = None
        if tpog.leave_out is not None:
            replicates = tpog.leave_out.scores(hits, self._gamma, unit)
        shares = {name: tpog.share(name, hits, score.entropy_seen) for name in self._requested_shares}
        return SiteScore(score.egvs, score.entropy_seen, replicates, shares)


def _check_grid(tpog: Tpog, scene: Scene) -> None:
    expected = scene.scenario.roi.grid
    if tpog.grid != expected:
        problem = f"its {tpog.grid} is not that of the scene, {expected}"
        raise InputError("tpog", problem, "Use the tpog.parquet of a run of this scenario, with the same settings.")


def _as_beams(scan: Scan | Beams) -> Beams:
    if isinstance(scan, Scan):
        return Beams.of(scan)
    return scan


@dataclass(frozen=True, eq=False)
class OccupiedVoxels:
    """The voxels that traffic ever occupies: flat index, (n,) int64, and number of frames, (n,) int64."""

    cells: IntArray
    counts: IntArray

    @classmethod
    def of(cls, counts: IntArray) -> OccupiedVoxels:
        """Select the occupied voxels from the counts of all voxels, in any shape."""
        cells = np.flatnonzero(counts)
        return cls(cells, counts.ravel()[cells])

    def coverage(self, hits: Hits) -> float:
        """Return the share of occupied voxels that beams cross; ``hits`` are of all voxels, flat."""
        if not len(self.cells):
            return 0.0
        return int(np.count_nonzero(hits[self.cells])) / len(self.cells)

    def expected_visibility(self, hits: Hits) -> float:
        """Return the share of occupancy in voxels that beams cross."""
        if not len(self.counts):
            return 0.0
        return int(self.counts[hits[self.cells] > 0].sum()) / int(self.counts.sum())


@dataclass(frozen=True)
class _ScoredTpog:
    """What scores need of a TPOG."""

    entropy: EntropyField
    occupied: OccupiedVoxels
    leave_out: BlockJackknife | None

    @classmethod
    def of(cls, tpog: Tpog, leave_out: BlockJackknife | None) -> _ScoredTpog:
        entropy = EntropyField.of(tpog.counts, tpog.frames, tpog.grid)
        return cls(entropy, OccupiedVoxels.of(tpog.counts), leave_out)

    def share(self, name: str, hits: Hits, entropy_seen: float) -> FloatArray:
        """Return one of :data:`VOXEL_SHARES` and, if there are groups, its values with each group left out."""
        value = entropy_seen
        if name == "coverage":
            value = self.occupied.coverage(hits)
        elif name == "expected_visibility":
            value = self.occupied.expected_visibility(hits)

        if self.leave_out is None:
            return np.array([value])
        return np.append(value, self.leave_out.voxel_shares(hits, name)[1:])


def ever_occupied(tpogs: Sequence[Tpog]) -> IntArray:
    """Return the flat index of every voxel that is occupied in any of some TPOGs over one grid, ascending."""
    occupied = np.zeros(tpogs[0].counts.shape, dtype=np.bool_)
    for tpog in tpogs:
        occupied |= tpog.counts > 0
    return np.flatnonzero(occupied)


def ranks(scores: FloatArray) -> NDArray[np.uint32]:
    """Return the rank of each score, 1 for the highest; equal scores share a rank, and the next ranks are skipped."""
    return np.array([1 + np.sum(scores > score) for score in scores], dtype=np.uint32)
