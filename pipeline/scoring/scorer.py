r"""Scores empty scans against a Traffic Probabilistic Occupancy Grid.

.. math:: EGVS(site) = \sum_v H(p(v)) \, \min(\gamma, hits(v))

(arXiv 2504.06772, Eq. 4): ``hits`` are the beams of the empty scan that cross voxel v, p comes from the TPOG. The sum
is that of :mod:`pipeline.scoring.egvs`, hits are those of :mod:`pipeline.scoring.visibility`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.readers import Tpog
from pipeline.scoring import voxel_shares
from pipeline.scoring.egvs import EntropyField
from pipeline.scoring.leave_out import LeaveOut
from pipeline.scoring.thinning import Hits
from pipeline.scoring.visibility import Beams, Visibility
from pipeline.scoring.voxel_shares import OccupiedVoxels
from pipeline.sensing.scanner import Scan
from pipeline.sensing.scene import Scene


@dataclass(frozen=True)
class SiteScore:
    """What a scan is worth.

    Attributes
    ----------
    egvs
        The score in bits.
    entropy_seen
        Share of the TPOG's entropy in voxels crossed at least once.
    left_out
        The score of all frames, then with each group of blocks left out, (1 + k,) float64, see
        :class:`pipeline.scoring.leave_out.LeaveOut`; None where that was not asked for.
    """

    egvs: float
    entropy_seen: float
    left_out: NDArray[np.float64] | None = None
    shares: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    """The same of those of :data:`pipeline.scoring.voxel_shares.NAMES` that the scenario asks for, by name; the score
    of all frames alone, (1,), where nothing is left out."""
    by_period: tuple[SiteScore, ...] = ()
    """The same for each period alone, where the TPOG is a mix of some and that was asked for."""


@dataclass(frozen=True)
class PeriodTpog:
    """The TPOG of one period alone, and its groups of blocks for standard errors."""

    name: str
    tpog: Tpog
    leave_out: LeaveOut | None = None


class Scorer:
    """Scores one scan after another. Threads may share one; it pickles to what it was built from.

    Parameters
    ----------
    scene
        As the scans were taken in; its scenario says gamma.
    tpog
        Occupancy by traffic.
    trajectories
        ``trajectories.parquet``, only for effects that replay traffic.
    leave_out
        Groups of blocks that are left out in turn, for standard errors.
    periods
        TPOGs of periods that each scan is also scored against, with the same hits.
    """

    def __init__(
        self,
        scene: Scene,
        tpog: Tpog,
        trajectories: Path | None = None,
        leave_out: LeaveOut | None = None,
        periods: tuple[PeriodTpog, ...] = (),
    ) -> None:
        self._built_from = (scene, tpog, trajectories, leave_out, periods)
        self._asked: tuple[str, ...] = tuple(name for name in voxel_shares.NAMES if name in scene.scenario.score.asked)
        self._periods = tuple(_Field.of(its.tpog, its.leave_out) for its in periods)
        self._whole = _Field.of(tpog, leave_out)
        self._cells = voxel_shares.ever_occupied([tpog, *(its.tpog for its in periods)])
        self._gamma, self.field = scene.scenario.gamma, self._whole.entropy
        self._visibility = Visibility(scene, tpog, trajectories)

    def __reduce__(
        self,
    ) -> tuple[type[Scorer], tuple[Scene, Tpog, Path | None, LeaveOut | None, tuple[PeriodTpog, ...]]]:
        return Scorer, self._built_from

    @property
    def limit(self) -> float:
        """The most that any scan could reach: the same sum with gamma in every voxel."""
        return self.field.limit(self._gamma)

    @property
    def limits_by_period(self) -> list[float]:
        """The same of each period."""
        return [its.entropy.limit(self._gamma) for its in self._periods]

    def score(self, scan: Scan | Beams) -> SiteScore:
        """The score of one scan."""
        return self._worth(self._visibility.borrowed_hits(_beams(scan), self._cells))

    def score_and_hits(self, scan: Scan | Beams) -> tuple[SiteScore, NDArray[np.float64]]:
        """The score of one scan, and the beams that cross each voxel, (nx, ny, nz) float64."""
        hits = self._visibility.borrowed_hits(_beams(scan))
        return self._worth(hits), (hits / self._visibility.unit).reshape(self.field.grid.shape)

    def hits(self, scan: Scan | Beams) -> NDArray[np.float64]:
        """Beams that cross each voxel, (nx, ny, nz) float64; whole numbers unless an effect weights beams."""
        hits = self._visibility.borrowed_hits(_beams(scan))
        return (hits / self._visibility.unit).reshape(self.field.grid.shape)

    def _worth(self, hits: Hits) -> SiteScore:
        return replace(self._against(hits, self._whole), by_period=tuple(self._against(hits, p) for p in self._periods))

    def _against(self, hits: Hits, its: _Field) -> SiteScore:
        unit = self._visibility.unit
        found = its.entropy.score(hits, self._gamma, unit)
        left_out = its.leave_out.scores(hits, self._gamma, unit) if its.leave_out is not None else None
        shares = {name: its.share(name, hits, found.entropy_seen) for name in self._asked}
        return SiteScore(found.egvs, found.entropy_seen, left_out, shares)


@dataclass(frozen=True)
class _Field:
    """A TPOG as scores take it."""

    entropy: EntropyField
    occupied: OccupiedVoxels
    leave_out: LeaveOut | None

    @classmethod
    def of(cls, tpog: Tpog, leave_out: LeaveOut | None) -> _Field:
        entropy = EntropyField.of(tpog.counts, tpog.frames, tpog.grid)
        return cls(entropy, OccupiedVoxels.of(tpog.counts), leave_out)

    def share(self, name: str, hits: Hits, entropy_seen: float) -> NDArray[np.float64]:
        """One of :data:`voxel_shares.NAMES`, with groups left out where that is asked for."""
        if name == "entropy_seen":
            value = entropy_seen
        else:
            value = (self.occupied.coverage if name == "coverage" else self.occupied.expected_visibility)(hits)
        rest = np.empty(0) if self.leave_out is None else self.leave_out.shares_seen(hits, name)[1:]
        return np.append(value, rest)


def ranks(scores: NDArray[np.float64]) -> NDArray[np.uint32]:
    """1 for the highest score; equal scores share a rank, and the next one is left out for each that shares."""
    return np.array([1 + np.sum(scores > score) for score in scores], dtype=np.uint32)


def _beams(scan: Scan | Beams) -> Beams:
    return Beams.of(scan) if isinstance(scan, Scan) else scan
