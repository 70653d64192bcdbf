"""Looks at all frames from several sites at once: their clouds of one instant are put together for a detector.

Steps for a frame: each sensor of the group makes its sweep, the same one that it makes when it looks alone; points on
vehicles are those of all; a detector that can look at fused clouds is given the sweeps, knows which sensor each point
is of, and gives one list of boxes.

Taken as given: all sensors look at the same instant, and it is known exactly where each hangs. A street has neither.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pipeline.core import code_digest, files
from pipeline.sensing.scanner import Scanner
from pipeline.validation.clouds import bodies
from pipeline.validation.clouds.point_clouds import CloudMaker, random_of
from pipeline.validation.detectors.base import JointDetector
from pipeline.validation.fused.plans import Group
from pipeline.validation.looking import Look
from pipeline.validation.metrics.matching import within
from pipeline.validation.site_findings import POINTS, Found, FoundBoxes, FoundPoints
from pipeline.validation.sweeps import Detections
from pipeline.validation.unseen_record import UnseenRecord


@dataclass(frozen=True)
class FusedLook:
    """A record seen from groups of sites by some detectors.

    Attributes
    ----------
    detectors
        By name; points on vehicles are always counted.
    """

    record: UnseenRecord
    detectors: Mapping[str, JointDetector]

    @property
    def names(self) -> list[str]:
        """The detectors, points on vehicles first."""
        return [POINTS, *self.detectors]

    @cached_property
    def scanner(self) -> Scanner:
        """Scans of all beams."""
        return Scanner(self.record.scene, whole=True)

    def at(self, group: Group, names: Sequence[str]) -> dict[str, Found]:
        """What some of the detectors find in the clouds of a group."""
        scene, seed = self.record.scene, self.record.scenario.seed
        shapes = bodies.of_scenario(scene.scenario)
        makers = [CloudMaker.of_site(scene, site, self.scanner, shapes) for site in group.sites]
        views = [maker.view for maker in makers]
        ready = {name: self.detectors[name].together(views, scene.roi) for name in names if name != POINTS}
        points, boxes = [], {name: list[Detections]() for name in ready}
        for frame in self.record.read():
            swept = [maker.sweep(frame, random_of(seed, maker.view.site, frame.number)) for maker in makers]
            on = np.array([its.points_on(len(frame.boxes)) for its in swept])
            points.append(on[:, frame.wanted(scene.roi)].sum(axis=0))
            sweeps = [its.sweep for its in swept]
            for name, detector in ready.items():
                boxes[name].append(within(detector.detect(sweeps), scene.roi))
        found: dict[str, Found] = {name: FoundBoxes(tuple(its)) for name, its in boxes.items()}
        return found | ({POINTS: FoundPoints(tuple(points))} if POINTS in names else {})

    def key(self, group: Group, name: str) -> str:
        """Hash of everything that a detector's findings in the clouds of a group depend on."""
        alone = Look(self.record, dict(self.detectors))
        each = [alone.key(site, name) for site in group.sites]
        return files.hash_of({"fused": each, "program": code_digest.of(__name__).digest})
