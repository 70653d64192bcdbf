"""Moves the sensors of a plan, one after another, until none finds a better pose.

Steps of a sensor's turn: all others stay; poses that it may have are tried (:mod:`.searching`); each is refused where
it breaks a rule of the plan, stands in a lane or a junction, or where no sensor can stand; of all others the exact
worth of the plan is worked out from a scan of its own; the best is kept, which is never worse than what was there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import InputError
from pipeline.core.parallel import in_order
from pipeline.placement.asking import Asked
from pipeline.placement.refining.freedom import Freedom, freedoms
from pipeline.placement.refining.poses import Poses, Rows
from pipeline.placement.refining.searching import search
from pipeline.placement.solving.problem import Worth
from pipeline.placement.solving.sight import Floats
from pipeline.scenario.placement import RefineModel
from pipeline.scoring.visibility import Beams
from pipeline.sensing.scanner import Scanner
from pipeline.sensing.sites import Site
from pipeline.stages.base import Workspace
from pipeline.stages.shared.scene import scene_of
from pipeline.traffic import sumo_folder
from pipeline.world.carriageway import Carriageway

WORTHWHILE = 1e-3
"""A turn that adds less than this share is kept, but gives nobody else another turn."""

_JOINT = 1e-3
"""What the joint score counts beside the value that is asked for, while a sensor is being moved."""

_CANNOT = 1e6
"""The loss of a pose that cannot be: above every other."""


@dataclass(frozen=True, eq=False)
class Refined:
    """A plan after its sensors have moved.

    Attributes
    ----------
    before, after
        The plan as its candidates hang, and as its sensors hang now.
    tried
        Poses, those that cannot be among them.
    impossible
        Of these, those that break a rule, or where no sensor can stand.
    turns
        Of all sensors together.
    """

    before: Poses
    after: Poses
    tried: int
    impossible: int
    turns: int

    def moved_m(self, number: int) -> float:
        """How far a sensor is from where its candidate hangs."""
        now, first = (np.array(poses.sites[number].pose.position_m) for poses in (self.after, self.before))
        return float(np.sqrt(((now - first) ** 2).sum()))

    def gain(self, number: int) -> float:
        """What the joint score would lose were this sensor alone put back."""
        back = self.after.with_sensor(number, self.before.sites[number], self.before.rows[number])
        return self.after.worth.joint - back.worth.joint


def refine(work: Workspace, asked: Asked, plan: Sequence[int], wanted: RefineModel) -> Refined:
    """A plan whose sensors have moved within what ``[placement.refine]`` says; never worth less than it was.

    Raises
    ------
    InputError
        Where no sensor of the plan may move.
    """
    before = Poses.of(work.scenario, asked, plan)
    stay = [candidate in asked.problem.rules.forced for candidate in plan]
    allowed = freedoms(work.scenario, wanted, asked.sites, before.sites, stay)
    movable = [number for number, freedom in enumerate(allowed) if freedom is not None]
    places = _Places(work, asked)
    poses, settled, turns, tried, impossible = before, set[int](), 0, 0, 0
    while not settled >= set(movable):
        number = movable[turns % len(movable)]
        freedom = allowed[number]
        assert freedom is not None
        turn = _Turn(places, poses, number, freedom)
        seed = np.random.SeedSequence((work.scenario.seed, turns))
        search(turn.losses, freedom.point(poses.sites[number].pose), freedom.ends, wanted.evaluations,
               np.random.default_rng(seed))  # fmt: skip
        worth, poses = poses.worth, turn.best
        has_helped = poses.worth.value > worth.value * (1.0 + WORTHWHILE)
        settled = {number} if has_helped else settled | {number}
        turns, tried, impossible = turns + 1, tried + turn.tried, impossible + turn.impossible
        work.progress("poses", tried, 0)
    return Refined(before, poses, tried, impossible, turns)


class _Places:
    """Where sensors can be, and what they see from there."""

    def __init__(self, work: Workspace, asked: Asked) -> None:
        self.threads = work.threads
        self._scene, self._views = scene_of(work), asked.views
        self._scanner = Scanner(self._scene)

    def on_roads(self, sites: Sequence[Site]) -> NDArray[np.bool_]:
        """Which of some places no pole can have, for vehicles; none where candidates are not asked either."""
        if self._carriageway is None or not sites:
            return np.zeros(len(sites), dtype=np.bool_)
        at_m = np.array([[site.pose.x_m, site.pose.y_m] for site in sites])
        lanes: NDArray[np.bool_] = np.array([lane is not None for lane in self._carriageway.lanes_at(at_m)])
        return lanes | self._carriageway.in_junctions(at_m)

    def rows(self, site: Site) -> Rows | None:
        """What a sensor sees; None where none can stand."""
        sensor = self._scene.sensor(site.sensor)
        try:
            scan = self._scanner.scan(site.pose, sensor)
        except InputError:  # in a solid, below the ground, out of reach: that is all that a scan refuses
            return None
        beams = Beams.of(scan)
        return tuple(view.row(beams) for view in self._views)

    @cached_property
    def _carriageway(self) -> Carriageway | None:
        scenario = self._scene.scenario
        network = sumo_folder.roads(scenario) if scenario.sites.only_free else None
        return None if network is None else Carriageway.of(network)


class _Turn:
    """One sensor's turn: holds the best plan so far."""

    def __init__(self, places: _Places, poses: Poses, number: int, freedom: Freedom) -> None:
        self.best, self.tried, self.impossible = poses, 0, 0
        self._places, self._start, self._number, self._freedom = places, poses, number, freedom

    def losses(self, points: Floats) -> Floats:
        """Of points of the freedom's box, (n, axes); the better the plan, the lower."""
        losses = np.full(len(points), _CANNOT)
        for i, trial in enumerate(in_order(self._plan, self._sites(points), self._places.threads)):
            if trial is None:
                self.impossible += 1
                continue
            plan, worth = trial
            losses[i] = self._loss(worth)
            if worth > self.best.worth:
                self.best = plan
        self.tried += len(points)
        return losses

    def _sites(self, points: Floats) -> list[Site | None]:
        """Where the points are; None where no pole may be, or a rule of the plan is broken."""
        own, poses = self._start.sites[self._number], [self._freedom.pose_at(point) for point in points]
        sites = [None if pose is None else replace(own, pose=pose) for pose in poses]
        if self._freedom.moves_pole:
            some = [site for site in sites if site is not None]
            taken = iter(self._places.on_roads(some).tolist())
            sites = [None if site is None or next(taken) else site for site in sites]
        return [site if site is not None and self._may_be(site) else None for site in sites]

    def _may_be(self, site: Site) -> bool:
        sites = list(self._start.sites)
        sites[self._number] = site
        return self._start.keeps_rules(sites)

    def _plan(self, site: Site | None) -> tuple[Poses, Worth] | None:
        """The plan with the sensor there, and what it is worth; None where it cannot be."""
        rows = None if site is None else self._places.rows(site)
        if site is None or rows is None:
            return None
        plan = self._start.with_sensor(self._number, site, rows)
        return plan, plan.worth

    def _loss(self, worth: Worth) -> float:
        """Minus the value, with a little of the joint score where the value may not depend on this sensor; what misses
        demands comes behind all that meets them."""
        if worth.met < 0.0:
            return 1.0 - worth.met
        before, tiny = self._start.worth, float(np.finfo(np.float64).tiny)
        return -worth.value / max(before.value, tiny) - _JOINT * worth.joint / max(before.joint, tiny)
