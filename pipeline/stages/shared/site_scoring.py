"""Scores the sites of a run's folder one by one, from its TPOG, its scans, and the vehicles of recorded frames.

What one site scores depends on no other site, so the sites of a scenario may be scored in any order, and anywhere where
the artefacts of the stages before lie.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.readers import read_tpog
from pipeline.core.grid import Grid
from pipeline.core.parallel import in_order
from pipeline.kernels import march
from pipeline.scenario.models import Scenario
from pipeline.scoring.leave_out import LeaveOut
from pipeline.scoring.scorer import Scorer, SiteScore
from pipeline.scoring.targets.named import WORTHS
from pipeline.scoring.visibility import Beams, in_voxels
from pipeline.sensing.sites import ScannedSite
from pipeline.stages.base import Workspace
from pipeline.stages.shared.period_scores import period_tpogs
from pipeline.stages.shared.scans import SiteBeams, scans
from pipeline.stages.shared.scene import scene_of
from pipeline.stages.shared.target_scores import TPOG, TRAJECTORIES, SiteTargets, Targets


@dataclass(frozen=True)
class ScoredSite:
    """A site, its scores, and what else was asked for: an audit of its beams, its hits in the voxels that it sees."""

    site: ScannedSite
    score: SiteScore
    targets: SiteTargets | None
    audit: BeamAudit | None
    visible: dict[str, NDArray[Any]] | None


@dataclass(frozen=True)
class BeamAudit:
    """The worst of some beams, see :func:`pipeline.kernels.march.audit`."""

    worst_sum: float
    longest_gap_m: float
    misplaced_chords: int
    voxels_visited_twice: int


class SiteScoring:
    """What all sites of a run's folder are scored against, read once. Threads may share one.

    Parameters
    ----------
    work
        Holds ``tpog.parquet``, ``statics.ply``, ``scans.parquet`` where scans are kept, and ``trajectories.parquet``.
    audit
        Check each beam as well, see :func:`audit_beams`.
    """

    def __init__(self, work: Workspace, *, audit: bool = False) -> None:
        wanted = work.scenario.score
        self.work, self._audit, self._kept = work, audit, wanted.keep_visibility
        self.tpog = read_tpog(work.path(TPOG))
        self.leave_out = LeaveOut.of(work.path(TPOG), self.tpog) if wanted.standard_error else None
        self.periods = period_tpogs(work.path(TPOG), standard_errors=wanted.standard_error)
        self.scorer = Scorer(scene_of(work), self.tpog, work.path(TRAJECTORIES), self.leave_out, self.periods)
        self.targets = Targets(work, self.tpog.grid) if asks_targets(work.scenario) else None

    @property
    def names(self) -> tuple[str, ...]:
        """The sites, in order."""
        return tuple(site.name for site in scene_of(self.work).sites)

    def all_sites(self, only: Collection[str] | None = None) -> Iterator[ScoredSite]:
        """The sites in order, on the workspace's threads; of those named in ``only``, or of all."""
        return in_order(self.score, scans(self.work, only), self.work.threads)

    def score(self, scan: SiteBeams) -> ScoredSite:
        """Score one scan."""
        checked = audit_beams(scan.beams, self.tpog.grid) if self._audit else None
        its = self.targets.scores(self.targets.see(scan.beams)) if self.targets is not None else None
        if self._kept == "all" or scan.site.name in self._kept:
            worth, hits = self.scorer.score_and_hits(scan.beams)
            return ScoredSite(scan.site, worth, its, checked, _sparse(hits))
        return ScoredSite(scan.site, self.scorer.score(scan.beams), its, checked, None)


def asks_targets(scenario: Scenario) -> bool:
    """Whether something is asked for that looks at the vehicles of recorded frames."""
    return scenario.score.blindspots or any(name in WORTHS for name in scenario.score.asked)


def audit_beams(beams: Beams, grid: Grid) -> BeamAudit:
    """Check each beam of a site, see :func:`pipeline.kernels.march.audit`."""
    o, d, shape = in_voxels(beams, grid)
    return BeamAudit(*march.audit(o, d, shape, grid.voxel_m, np.zeros(int(np.prod(grid.shape)), dtype=np.uint32)))


def _sparse(hits: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """The voxels that are crossed, in order."""
    ix, iy, iz = np.nonzero(hits)
    index = {"ix": ix.astype(np.int32), "iy": iy.astype(np.int32), "iz": iz.astype(np.int32)}
    return {**index, "hits": hits[ix, iy, iz]}
