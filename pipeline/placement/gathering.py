"""Gathers what every candidate sees: casts its empty scan, or takes the kept one, and keeps the cells that count.

Scans are taken one after another and let go; only sparse rows stay. A row is the same as what the score of that site is
made from, so a plan of one sensor has the score of that site.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pipeline.artefacts.readers import Tpog
from pipeline.core.parallel import in_order
from pipeline.effects.base import Detect
from pipeline.placement.solving import terms
from pipeline.placement.solving.sight import Floats, GrowingSight, Ints, Row, Sight
from pipeline.scoring.targets.named import WORTHS
from pipeline.scoring.targets.seen import SeenTargets
from pipeline.scoring.visibility import Beams, Visibility
from pipeline.scoring.voxel_shares import ever_occupied
from pipeline.stages.base import Workspace
from pipeline.stages.shared.scans import SiteBeams, scans
from pipeline.stages.shared.scene import scene_of
from pipeline.stages.shared.target_scores import TRAJECTORIES, Targets

_MOST_BEAMS, _MOST_SHARES = 2**32 - 1, 2**62
"""What a tally holds at most: of whole beams, and of shares of beams (in a smaller unit)."""


class VoxelView:
    """What a pose sees of the voxels that count. Threads may share one.

    Parameters
    ----------
    tpogs
        All that scores are asked for, over one grid; the first is the traffic's as a whole.
    most
        Hits of a voxel above this many beams make no difference, may be infinite.
    """

    def __init__(self, work: Workspace, tpogs: list[Tpog], most: float) -> None:
        self.voxels: Ints = ever_occupied(tpogs)
        self._visibility = Visibility(scene_of(work), tpogs[0], work.path(TRAJECTORIES))
        self.unit = self._visibility.unit
        highest, holds = most * self.unit, _MOST_BEAMS if self.unit == 1 else _MOST_SHARES
        self._most = math.ceil(highest) if highest < holds else holds

    @property
    def number(self) -> int:
        """Of cells."""
        return len(self.voxels)

    def row(self, beams: Beams) -> Row:
        """What an empty scan hits."""
        hits = self._visibility.borrowed_hits(beams, self.voxels)
        return Row.of(hits[self.voxels], max(1, self._most))


class TargetView:
    """What a pose sees of the vehicle-frames of a record, as ``score`` counts it. Threads may share one."""

    def __init__(self, work: Workspace, targets: Targets, score: str) -> None:
        self._targets, self._score = targets, score
        scene = scene_of(work)
        is_whole = score != "expected_detections" and not scene.weights_beams and not scene.acting(Detect, "score")
        self.unit = 1.0 if is_whole else terms.CHANCE_UNIT if score == "expected_detections" else _POINT_UNIT

    @property
    def number(self) -> int:
        """Of cells."""
        return len(self._targets.record)

    def row(self, beams: Beams) -> Row:
        """What an empty scan sees of each."""
        seen = self._targets.see(beams)
        return Row.of(np.rint(self._amounts(seen) * self.unit).astype(np.int64), 2**62)

    def _amounts(self, seen: SeenTargets) -> Floats:
        if self._score != "expected_detections":
            return seen.points
        chance = np.minimum(WORTHS[self._score](seen), 1.0 - 2.0**-53)
        return -np.log1p(-chance)


_POINT_UNIT = 2.0**32
"""Points that are expectations count in whole multiples of 1 over this."""

View = VoxelView | TargetView


def gather(work: Workspace, views: tuple[View, ...], heard: Callable[[int], None]) -> tuple[Sight, ...]:
    """What all candidates of a scenario see, one sight a view, each scan taken once.

    Parameters
    ----------
    heard
        Called with how many are done.
    """
    growing = [GrowingSight(view.number) for view in views]

    def rows(scan: SiteBeams) -> tuple[Row, ...]:
        return tuple(view.row(scan.beams) for view in views)

    for number, its in enumerate(in_order(rows, scans(work), work.threads), start=1):
        for sight, row in zip(growing, its, strict=True):
            sight.add(row)
        heard(number)
    return tuple(sight.whole() for sight in growing)
