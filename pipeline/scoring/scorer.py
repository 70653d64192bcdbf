r"""Scores empty scans against a Traffic Probabilistic Occupancy Grid.

.. math:: EGVS(site) = \sum_v H(p(v)) \, \min(\gamma, hits(v))

(arXiv 2504.06772, Eq. 4): ``hits`` are the beams of the empty scan that cross voxel v, p comes from the TPOG. The sum
is that of :mod:`pipeline.scoring.egvs`, hits are those of :mod:`pipeline.scoring.visibility`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.readers import Tpog
from pipeline.scoring.egvs import EntropyField
from pipeline.scoring.leave_out import LeaveOut
from pipeline.scoring.thinning import Hits
from pipeline.scoring.visibility import Beams, Visibility
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
    seen_left_out: NDArray[np.float64] | None = None
    """The same of ``entropy_seen``, where the scenario asks for that score."""
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
        fields = (EntropyField.of(its.tpog.counts, its.tpog.frames, its.tpog.grid) for its in periods)
        self._periods = tuple(zip(fields, (its.leave_out for its in periods), strict=True))
        self._leave_out, self._gamma = leave_out, scene.scenario.gamma
        self._asks_entropy_seen = "entropy_seen" in scene.scenario.score.asked
        self.field = EntropyField.of(tpog.counts, tpog.frames, tpog.grid)
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
        return [field.limit(self._gamma) for field, _ in self._periods]

    def score(self, scan: Scan | Beams) -> SiteScore:
        """The score of one scan."""
        return self._worth(self._visibility.borrowed_hits(_beams(scan)))

    def score_and_hits(self, scan: Scan | Beams) -> tuple[SiteScore, NDArray[np.float64]]:
        """The score of one scan, and the beams that cross each voxel, (nx, ny, nz) float64."""
        hits = self._visibility.borrowed_hits(_beams(scan))
        return self._worth(hits), (hits / self._visibility.unit).reshape(self.field.grid.shape)

    def hits(self, scan: Scan | Beams) -> NDArray[np.float64]:
        """Beams that cross each voxel, (nx, ny, nz) float64; whole numbers unless an effect weights beams."""
        hits = self._visibility.borrowed_hits(_beams(scan))
        return (hits / self._visibility.unit).reshape(self.field.grid.shape)

    def _worth(self, hits: Hits) -> SiteScore:
        apart = tuple(self._against(hits, field, leave_out) for field, leave_out in self._periods)
        whole, leave_out = self._against(hits, self.field, self._leave_out), self._leave_out
        seen = leave_out.shares_seen(hits) if self._asks_entropy_seen and leave_out is not None else None
        return replace(whole, seen_left_out=seen, by_period=apart)

    def _against(self, hits: Hits, field: EntropyField, leave_out: LeaveOut | None) -> SiteScore:
        unit = self._visibility.unit
        found = field.score(hits, self._gamma, unit)
        left_out = leave_out.scores(hits, self._gamma, unit) if leave_out is not None else None
        return SiteScore(found.egvs, found.entropy_seen, left_out)


def ranks(scores: NDArray[np.float64]) -> NDArray[np.uint32]:
    """1 for the highest score; equal scores share a rank, and the next one is left out for each that shares."""
    return np.array([1 + np.sum(scores > score) for score in scores], dtype=np.uint32)


def _beams(scan: Scan | Beams) -> Beams:
    return Beams.of(scan) if isinstance(scan, Scan) else scan
