"""A plan of ``egvs place`` whose sensors are being moved: what they are worth together, and where one more is best.

The worth is that of :mod:`pipeline.placement.refining.poses`, which ``egvs place --refine`` goes by.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, fields, replace
from functools import cached_property

from pipeline.artefacts.readers import read_placement
from pipeline.placement import asking
from pipeline.placement.refining.poses import Poses
from pipeline.placement.writing import CURVE, PLACEMENT
from pipeline.scoring.visibility import Beams
from pipeline.sensing.scanner import Scanner
from pipeline.sensing.sites import Pose, Site
from pipeline.stages.base import Workspace
from pipeline.stages.shared.scene import scene_of

_MADE_FROM = ("statics", "scan", "traffic", "tpog")
"""Stages of which a plan must be; the check also asks what was wanted of the plan."""


@dataclass(frozen=True, eq=False)
class MovingPlan:
    """Sensors that are to work together.

    Attributes
    ----------
    poses
        Where each is now, and what it sees.
    """

    poses: Poses

    @classmethod
    def of(cls, work: Workspace, stages: Mapping[str, str]) -> MovingPlan | None:
        """The plan in a run's folder; None where there is none, or one of other traffic, scans or settings.

        Parameters
        ----------
        stages
            Keys of the run's stages, by name.
        """
        found = read_placement(work.path(PLACEMENT), work.path(CURVE))
        if found is None or any(found[2]["stages"].get(name) != stages.get(name) for name in _MADE_FROM):
            return None
        free = copy(work)  # of what was asked for of the plan: it may be moved anywhere
        free.scenario = work.scenario.model_copy(update={"placement": type(work.scenario.placement)()})
        asked = asking.ask(free, lambda _: None)
        rows = found[0]
        poses = Poses.of(free.scenario, asked, [asked.names.index(row["site"]) for row in rows])
        plan, scanner = cls(poses), Scanner(replace(scene_of(work), sites=()))
        for row, site in zip(rows, poses.sites, strict=True):
            pose = Pose(**{field.name: row[field.name] for field in fields(Pose)})
            if pose != site.pose:  # after --refine
                there = replace(site, pose=pose)
                plan = plan.moved(there, Beams.of(scanner.scan_site(there)))
        return plan

    @property
    def sites(self) -> dict[str, Site]:
        """Its sensors by the names of their candidates, where they are now."""
        return {site.name: site for site in self.poses.sites}

    @cached_property
    def joint(self) -> float:
        """Its joint score."""
        return float(self.poses.worth.joint)

    def moved(self, site: Site, beams: Beams) -> MovingPlan:
        """The plan with one of its sensors elsewhere, from where it sees ``beams``."""
        rows = tuple(view.row(beams) for view in self.poses.asked.views)
        return MovingPlan(self.poses.with_sensor(list(self.sites).index(site.name), site, rows))

    def gain(self, candidate: str) -> float:
        """What a candidate that is not in it would add to its joint score."""
        poses, index = self.poses, self.poses.asked.names.index(candidate)
        rows = tuple(sight.row(index) for sight in poses.asked.sights)
        site = poses.asked.sites[index]
        more = replace(poses, plan=(*poses.plan, index), sites=(*poses.sites, site), rows=(*poses.rows, rows))
        return float(more.worth.joint) - self.joint

    @cached_property
    def best_next(self) -> tuple[str, float] | None:
        """The candidate that would add most to it, and how much; None where all are in it."""
        gains = {name: self.gain(name) for name in self.poses.asked.names if name not in self.sites}
        return max(gains.items(), key=lambda item: item[1], default=None)
