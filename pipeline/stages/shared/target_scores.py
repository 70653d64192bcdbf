"""What sites see of the vehicles of recorded frames: the scores over them that a scenario asks for, and blind spots.

Steps: read some frames of ``trajectories.parquet`` once for all sites; count what a site sees of each vehicle; take the
mean of what that is worth, of all vehicles, with each group of frames left out, and in each period alone; count at each
place how many are seen well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.artefacts.periods import PeriodBlocks
from pipeline.artefacts.readers import Tpog, read_periods
from pipeline.core.errors import InputError
from pipeline.core.findings import Finding
from pipeline.core.grid import Grid
from pipeline.scenario.models import FILE
from pipeline.scoring.blindspots.spots import SiteSeen
from pipeline.scoring.targets.frame_groups import FrameGroups, recorded_frames, weights_in_mix
from pipeline.scoring.targets.named import WORTHS
from pipeline.scoring.targets.record import Floats, TargetRecord
from pipeline.scoring.targets.scores import mean
from pipeline.scoring.targets.seen import SeenTargets, noticed_in, see
from pipeline.scoring.targets.weights import people_of, weights_of, without_effect
from pipeline.scoring.visibility import Beams
from pipeline.stages.base import Workspace
from pipeline.stages.shared.blindspots import spots_of
from pipeline.stages.shared.scene import scene_of

TRAJECTORIES = "trajectories.parquet"
TPOG = "tpog.parquet"


@dataclass(frozen=True)
class SiteTargets:
    """The scores of one site over vehicles, by name.

    Attributes
    ----------
    scores
        Of all vehicle-frames, then with each group of frames left out, (1 + k,) float64; the first alone where there
        are no standard errors. Not a number where no vehicle counts.
    by_period
        Of each period alone, in their order; empty where there are none.
    missed
        Where it misses vehicles; None where that is not asked for.
    """

    scores: Mapping[str, Floats]
    by_period: tuple[Mapping[str, float], ...] = ()
    missed: SiteSeen | None = None


class Targets:
    """The vehicles of recorded frames, and what they are asked for. Threads may share one.

    Parameters
    ----------
    work
        Holds ``trajectories.parquet`` and the ``tpog.parquet`` that was counted from it.
    grid
        Its region of interest is where vehicles are to be seen.

    Raises
    ------
    InputError
        When one of these scores is to rank the sites, and no vehicle counts.
    """

    def __init__(self, work: Workspace, grid: Grid) -> None:
        wanted, trajectories, tpog = work.scenario.score, work.path(TRAJECTORIES), work.path(TPOG)
        self.record = TargetRecord.read(trajectories, grid, people=people_of(wanted.weights))
        self._scene = scene_of(work)
        self._names: tuple[str, ...] = tuple(name for name in wanted.asked if name in WORTHS)
        periods, recorded = read_periods(tpog), recorded_frames(trajectories)
        in_mix = weights_in_mix(periods, recorded, self.record)
        self._by_choice = weights_of(wanted.weights, self.record) if wanted.weights.are_given else None
        self._weight = in_mix if self._by_choice is None else in_mix * self._by_choice
        self._weights = wanted.weights
        self._groups = FrameGroups.read(tpog, trajectories, self.record) if wanted.standard_error else None
        self.spots = spots_of(work, self.record, recorded, in_mix) if wanted.blindspots else None
        self._periods = _rows_of_periods(periods, recorded, self.record)
        if self.is_empty and wanted.rank_by in WORTHS:
            place = f"{work.scenario.file}: score.rank_by = {wanted.rank_by!r}"
            raise InputError(place, self._nobody, 'traffic that passes the region of interest, or rank_by = "egvs"')

    @property
    def is_empty(self) -> bool:
        """Whether no vehicle counts."""
        return not math.fsum(self._weight) > 0.0

    def see(self, beams: Beams) -> SeenTargets:
        """What an empty scan sees of each vehicle."""
        return see(self.record, beams, noticed_in(self._scene, beams.sensor))

    @property
    def counts(self) -> Floats:
        """How much each vehicle-frame counts in a score, (n,) float64."""
        return self._weight

    def counts_by_period(self) -> dict[str, Floats]:
        """The same in the scores of each period alone, by name; empty where there are none."""
        counts = {}
        for name, rows in self._periods:
            counts[name] = np.zeros(len(self.record))
            counts[name][rows] = 1.0 if self._by_choice is None else self._by_choice[rows]
        return counts

    def scores(self, seen: SeenTargets) -> SiteTargets:
        """The scores that are asked for, of what a site sees, and where it misses vehicles."""
        worths = {name: WORTHS[name](seen) for name in self._names}
        whole = {name: self._means(worth) for name, worth in worths.items()}
        apart = ({name: self._mean_of(worth, rows) for name, worth in worths.items()} for _, rows in self._periods)
        return SiteTargets(whole, tuple(apart), self.spots.by(seen.points) if self.spots is not None else None)

    def doubts(self, tpog: Tpog, by_period: Sequence[Tpog]) -> list[Finding]:
        """A warning where scores are no numbers though the region has traffic, at all or in a period; that it has none
        is told where traffic is counted."""
        names = " and ".join(self._names)
        if not names or not tpog.counts.any():
            return []
        cure, idle = "the region of interest should hold the road", list(without_effect(self._weights, self.record))
        if self.is_empty:
            return [Finding("no vehicles", f"{FILE}: roi", f"{self._nobody}: {names} is no number", cure), *idle]
        return idle + [
            Finding("no vehicles", f"{FILE}: traffic.periods ({name})", f"{self._nobody}: {names} is no number", cure)
            for (name, rows), its in zip(self._periods, by_period, strict=True)
            if not self._counts(rows) and its.counts.any()
        ]

    @property
    def _nobody(self) -> str:
        counts = "" if self._by_choice is None or not len(self.record) else " that counts by [score.weights]"
        frames = f"in the {len(self.record.numbers)} frames looked at"
        return f"no vehicle{counts} has its centre in the region of interest {frames}"

    def _means(self, worth: Floats) -> Floats:
        if self._groups is None:
            return np.array([mean(worth, self._weight)])
        return self._groups.means(worth, self._by_choice)

    def _mean_of(self, worth: Floats, rows: slice) -> float:
        """Of some vehicle-frames by themselves."""
        return mean(worth[rows], None if self._by_choice is None else self._by_choice[rows])

    def _counts(self, rows: slice) -> bool:
        """Whether any of these vehicle-frames does."""
        return bool(self._weight[rows].any())


def _rows_of_periods(
    periods: tuple[PeriodBlocks, ...], recorded: list[int], record: TargetRecord
) -> tuple[tuple[str, slice], ...]:
    """The vehicle-frames of each period; none where there are no periods."""
    ends = np.searchsorted(record.numbers[record.frame], np.append(0, np.cumsum(recorded))).tolist()
    named = zip(periods, ends[:-1], ends[1:], strict=True)
    return tuple((period.name, slice(a, b)) for period, a, b in named if period.name)
