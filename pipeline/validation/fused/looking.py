"""Looks at all frames from several sites at once: their clouds of one instant are put together for a detector.

Steps for a frame: each sensor of the group makes its sweep, the same one that it makes when it looks alone; points on
vehicles are those of all; a detector that can look at fused clouds is given the sweeps, knows which sensor each point
is of, and gives one list of boxes.

Taken as given: all sensors look at the same instant, and it is known exactly where each hangs. A street has neither.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.core import code_digest, files
from pipeline.validation.detectors.base import JointDetector
from pipeline.validation.fused.plans import Group
from pipeline.validation.looking import Look, RecordLook
from pipeline.validation.site_findings import POINTS, Found


@dataclass(frozen=True)
class FusedLook(RecordLook[JointDetector]):
    """A record seen from groups of sites by some detectors."""

    def at(self, group: Group, names: Sequence[str]) -> dict[str, Found]:
        """What some of the detectors find in the clouds of a group."""
        makers = self.makers(group.sites)
        views, roi = [maker.view for maker in makers], self.record.scene.roi
        finders = {name: self.detectors[name].together(views, roi).detect for name in names if name != POINTS}
        return self.found(makers, finders, with_points=POINTS in names)

    def key(self, group: Group, name: str) -> str:
        """Hash of everything that a detector's findings in the clouds of a group depend on."""
        alone = Look(self.record, self.detectors)
        each = [alone.key(site, name) for site in group.sites]
        return files.hash_of({"fused": each, "program": code_digest.of(__name__).digest})
