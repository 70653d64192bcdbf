"""Scores, plan and recorded frames from any pose.

Where a moved sensor misses vehicles, as ``blindspots.parquet`` has it of the candidates.

A plan of ``egvs place`` whose sensors are being moved: what they are worth together, and where one more is best.

The worth is that of :mod:`egvs.placement.refinement`, which ``egvs place --refine`` goes by.

What a sensor is worth where somebody has moved it: the numbers of ``egvs score``, from any pose.

Steps for a pose: ask the rules of ``egvs check`` that are about one site; cast the empty scan from there; score it
against the TPOG, and against the vehicles of recorded frames where the scenario asks for that; rank it among the
candidates, as if the moved one hung there in place of its own. Nothing here knows of a page or a browser.

A recorded frame of traffic before a moved sensor: which vehicles there are, and the returns that they give.

The returns are those of a point cloud as ``egvs clouds`` makes it (:mod:`egvs.validation.cloud_simulation`), of
the traffic that the run was scored with. A vehicle with :data:`SEEN_WELL_POINTS` of them is seen.

World frame, metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts import parquet, traffic_frames
from egvs.artefacts.readers import (
    LocationVisibility,
    SiteBlindspots,
    read_placement,
    read_scores,
    read_scores_by_period,
)
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import Tpog, read_periods, read_tpog
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.core.errors import Diagnostic, InputError
from egvs.core.grid import Grid
from egvs.placement import problem_builder
from egvs.placement.refinement import PlanPoses
from egvs.scenario.model import Scenario
from egvs.scoring import blindspots
from egvs.scoring.blindspots import CELL_M, SpotVisibility, VehicleSpots
from egvs.scoring.egvs import EntropyField
from egvs.scoring.scorer import PeriodTpog, Scorer
from egvs.scoring.target_scores import TARGET_SCORES
from egvs.scoring.targets import SEEN_WELL_POINTS, detection_probability, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sites import Pose, Site
from egvs.stages import inputs, scene_checks
from egvs.stages.base import StageContext
from egvs.stages.inputs import CheckInputs, get_scene
from egvs.stages.site_scoring import TargetScorer
from egvs.traffic import sumo_folder
from egvs.traffic.network import Network
from egvs.validation import cloud_simulation
from egvs.validation.cloud_simulation import CloudSimulator, VehicleMeshes, sweep_rng
from egvs.world.carriageway import Carriageway


def site_blindspots(site: str, spots: VehicleSpots, visibility: SpotVisibility, grid: Grid) -> SiteBlindspots:
    """What a site sees at each spot of the region of a grid."""
    count = len(spots.locations)
    columns = (
        spots.at_m[:, 0],
        spots.at_m[:, 1],
        spots.vehicle_frames,
        spots.vehicles,
        visibility.share,
        visibility.se,
    )
    rows = zip(*(column[:count].tolist() for column in columns), strict=True)
    places = tuple(
        LocationVisibility(place.by, place.words, *row) for place, row in zip(spots.locations, rows, strict=True)
    )
    share_missed = np.full(blindspots.map_shape(grid), np.nan)
    share_missed[tuple(spots.cells.T)] = 1.0 - visibility.share[count:]
    x, y, _ = grid.origin_m
    return SiteBlindspots(site, SEEN_WELL_POINTS, places, share_missed, (x, y), CELL_M)


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

    poses: PlanPoses

    @classmethod
    def of(cls, work: StageContext, stages: Mapping[str, str]) -> MovingPlan | None:
        """The plan in a run's folder; None where there is none, or one of other traffic, scans or settings.

        Parameters
        ----------
        stages
            Keys of the run's stages, by name.
        """
        found = read_placement(work.folder.placement, work.folder.curve)
        if found is None or any(found[2]["stages"].get(name) != stages.get(name) for name in _MADE_FROM):
            return None
        free = copy(work)  # of what was asked for of the plan: it may be moved anywhere
        free.scenario = work.scenario.model_copy(update={"placement": type(work.scenario.placement)()})
        asked = problem_builder.build_problem(free, lambda _: None)
        rows = found[0]
        poses = PlanPoses.of(free.scenario, asked, [asked.names.index(row["site"]) for row in rows])
        plan, scanner = cls(poses), Scanner(replace(get_scene(work), sites=()))
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
        return float(self.poses.plan_value.joint)

    def moved(self, site: Site, beams: Beams) -> MovingPlan:
        """The plan with one of its sensors elsewhere, from where it sees ``beams``."""
        rows = tuple(view.row(beams) for view in self.poses.placement_problem.views)
        return MovingPlan(self.poses.with_sensor(list(self.sites).index(site.name), site, rows))

    def gain(self, candidate: str) -> float:
        """What a candidate that is not in it would add to its joint score."""
        poses, index = self.poses, self.poses.placement_problem.names.index(candidate)
        rows = tuple(sight.row(index) for sight in poses.placement_problem.visibilities)
        site = poses.placement_problem.sites[index]
        more = replace(poses, plan=(*poses.plan, index), sites=(*poses.sites, site), rows=(*poses.rows, rows))
        return float(more.plan_value.joint) - self.joint

    @cached_property
    def best_next(self) -> tuple[str, float] | None:
        """The candidate that would add most to it, and how much; None where all are in it."""
        gains = {name: self.gain(name) for name in self.poses.placement_problem.names if name not in self.sites}
        return max(gains.items(), key=lambda item: item[1], default=None)


SCORES = RunFolder.scores.name
_RECORDED = (RunFolder.trajectories.name, RunFolder.tpog.name)


@dataclass(frozen=True)
class PoseScore:
    """What a sensor is worth in a pose.

    Attributes
    ----------
    site
        The candidate that it comes from.
    scores
        By name: ``egvs`` in bits, ``entropy_seen`` as a share, and what else the scenario asks for; empty where no
        sensor can stand.
    rank
        Among the candidates, 1 is best; 0 where no sensor can stand.
    findings
        What the check says of the place; one of them is an error where no sensor can stand.
    """

    site: Site
    scores: Mapping[str, float]
    rank: int
    findings: tuple[Diagnostic, ...] = ()

    @property
    def is_feasible(self) -> bool:
        """Whether a sensor can stand there."""
        return bool(self.scores)


@dataclass(frozen=True)
class _Engine:
    """What scans and scores with certain effects."""

    scene: Scene
    scanner: Scanner
    scorer: Scorer


class Session:
    """A run that is being explored. It changes nothing in the run's folder.

    Parameters
    ----------
    work
        A folder in which all stages up to ``score`` are done.
    stages
        Their keys, by name: a plan in the folder is taken only where it was made from them.
    period
        Of the traffic, whose scores are told; the mix of all when empty.
    """

    def __init__(self, work: StageContext, stages: Mapping[str, str], period: str = "") -> None:
        self.work, self._stages, self.period = work, stages, period
        self.scenario: Scenario = work.scenario
        self.scene: Scene = get_scene(work)
        self.periods: tuple[str, ...] = tuple(its.name for its in read_periods(work.folder.tpog) if its.name)
        self.tpog: Tpog = read_tpog(work.folder.tpog, period or None)
        self.candidates: dict[str, PoseScore] = self._rated()
        self._engines: dict[tuple[str, ...], _Engine] = {}

    def in_period(self, period: str) -> Session:
        """The same run, seen in another period alone; in the mix of all for an empty name."""
        return Session(self.work, self._stages, period)

    def forget(self) -> None:
        """Let go of what scores poses quickly; it is made again when it is asked for."""
        self._engines.clear()
        self.__dict__.pop("entropy_bit", None)

    @cached_property
    def plan(self) -> MovingPlan | None:
        """The plan in the run's folder, where there is one that was made from the same traffic and scans."""
        return MovingPlan.of(self.work, self._stages)

    @property
    def rank_by(self) -> str:
        """The score that ranks."""
        return str(self.scenario.score.rank_by)

    @property
    def ranked(self) -> list[PoseScore]:
        """The candidates, the best first."""
        return sorted(self.candidates.values(), key=lambda rating: rating.rank)

    @property
    def network(self) -> Network | None:
        """The roads, where the scenario has some."""
        return self.work.remember("explored roads", (), lambda: sumo_folder.read_network(self.scenario))

    @property
    def carriageway(self) -> Carriageway | None:
        """The lanes that vehicles drive on, where the scenario has some."""

        def found() -> Carriageway | None:
            its = None if self.network is None else Carriageway.of(self.network)
            return its if its is not None and its.lanes else None

        return self.work.remember("explored lanes", (), found)

    def rate(self, name: str, pose: Pose, sensor: str | None = None) -> PoseScore:
        """What a candidate's sensor, or another one, is worth in a pose; KeyError where there is no such candidate.

        InputError where there is no such sensor.
        """
        own = self.candidates[name].site
        site = replace(own, pose=pose, sensor=sensor or own.sensor)
        self.scene.sensor(site.sensor)
        if site.points is not None and site != own:
            finding = Diagnostic("measured scan", f"site {name}", "its empty scan was measured",
                              "its own pose: what would be measured elsewhere is not known", is_error=True)  # fmt: skip
            return PoseScore(site, {}, 0, (finding,))
        findings = self._findings(site)
        if any(finding.is_error for finding in findings):
            return PoseScore(site, {}, 0, findings)
        try:
            scores = self._scores(site)
        except InputError as error:  # an effect that has to know of the sensor what nobody has said
            return PoseScore(site, {}, 0, (*findings, Diagnostic.of("score", error)))
        return PoseScore(site, scores, self._rank(name, scores[self.rank_by]), findings)

    def hits(self, site: Site) -> NDArray[np.float64]:
        """The beams of a sensor that cross each voxel, (nx, ny, nz) float64; InputError where it cannot stand."""
        engine = self._engine(site)
        return engine.scorer.hits(engine.scanner.scan_site(site))

    def beams(self, site: Site) -> Beams:
        """The empty scan of a sensor as scores take it; InputError as above."""
        return Beams.of(self._engine(site).scanner.scan_site(site))

    def returns_m(self, site: Site) -> NDArray[np.float64]:
        """Where the empty scan of a sensor met something, (n, 3) float64, world frame; InputError as above."""
        rows = self._engine(site).scanner.scan_site(site).rows
        return rows.ends_m[rows.returned] + site.pose.position_m

    def beams_m(self, site: Site, ring: int) -> NDArray[np.float64]:
        """The beams of one ring that can meet the region, (n, 2, 3) float64: from the sensor to where each ends, world
        frame. None of a sensor without rings; the last ring for a higher number. InputError as above."""
        scan = self._engine(site).scanner.scan_site(site)
        channels = scan.sensor.channels
        has_rings = channels > 0 and site.points is None
        of_ring = scan.rows.beam % channels == min(ring, channels - 1) if has_rings else slice(0)
        ends = scan.rows.ends_m[of_ring] + site.pose.position_m
        return np.stack([np.broadcast_to(site.pose.position_m, ends.shape), ends], axis=1)

    def blindspots(self, site: Site) -> SiteBlindspots:
        """Where a sensor misses vehicles, of all periods together; InputError as above."""
        asking = _with_blindspots(self.work, True)
        targets = self.work.remember("targets at places", _RECORDED, lambda: TargetScorer(asking, self.tpog.grid))
        beams = self.beams(site)
        seen = visible_targets(targets.record, beams, detection_probability(self.scene_before(site), beams.sensor))
        assert targets.spots is not None
        return site_blindspots(site.name, targets.spots, targets.spots.visibility(seen.points), self.tpog.grid)

    def scene_before(self, site: Site) -> Scene:
        """The scene with the effects that act while a sensor is as it is now."""
        return self._engine(site).scene

    @cached_property
    def entropy_bit(self) -> NDArray[np.float64]:
        """Entropy of each voxel, (nx, ny, nz) float64."""
        field = EntropyField.of(self.tpog.counts, self.tpog.frames, self.tpog.grid)
        found = np.zeros(self.tpog.counts.size)
        found[field.cells] = field.per_cell_bit
        return found.reshape(self.tpog.grid.shape)

    def _rated(self) -> dict[str, PoseScore]:
        """The candidates as ``scores.parquet`` has them, or ``scores_by_period.parquet``."""
        path = self.work.path(RunFolder.scores_by_period.name if self.period else SCORES)
        self.work.digest(path.name)
        every = (read_scores_by_period if self.period else read_scores)(path).to_pylist()
        rows = {row["site"]: row for row in every if row.get("period", "") == self.period}
        if rows.keys() != {site.name for site in self.scene.sites}:
            raise InputError(path, "holds other sites than the scenario", "egvs run makes it again")
        names = dict.fromkeys(("egvs", "entropy_seen", *self.scenario.score.additional))
        return {
            site.name: PoseScore(site, {name: rows[site.name][name] for name in names}, rows[site.name]["rank"])
            for site in self.scene.sites
        }

    @cached_property
    def _targets(self) -> TargetScorer | None:
        """The vehicles that scores look at; None where no score does."""
        if not any(name in TARGET_SCORES for name in self.scenario.score.additional):
            return None
        lean = _with_blindspots(self.work, False)
        return self.work.remember("targets", _RECORDED, lambda: TargetScorer(lean, self.tpog.grid))

    def _findings(self, site: Site) -> tuple[Diagnostic, ...]:
        """What the check says of a place, candidates of a rule included: nobody has sorted this one out."""
        asked = self.scenario.sites.model_copy(update={"only_free": False})
        scenario = self.scenario.model_copy(update={"sites": asked})
        subject = CheckInputs(scenario, self.network, self.carriageway, self.scene.world, (site,), self.scene)
        return (*scene_checks.check_poses(subject), *scene_checks.warn_sites_on_lanes(subject))

    def _engine(self, site: Site) -> _Engine:
        """What scans and scores while a site is as it is now: an effect that changes nothing for the candidates as they
        are given may do so then, and the other way round."""
        sites = tuple(site if its.name == site.name else its for its in self.scene.sites)
        scene = inputs.with_effects(replace(self.scene, sites=sites, effects=(), inactive_effects=()))
        key = tuple(effect.NAME for effect in scene.effects)
        if key not in self._engines:
            scene = replace(scene, sites=())  # one caster serves every pose
            self._engines[key] = _Engine(scene, Scanner(scene, mounts=1), self._scorer(scene))
        return self._engines[key]

    def _scorer(self, scene: Scene) -> Scorer:
        """Effects on what is seen know the mix, in a period too."""
        tpog, trajectories = self.work.folder.tpog, self.work.folder.trajectories
        mix = read_tpog(tpog) if self.period else self.tpog
        alone = (PeriodTpog(self.period, self.tpog),) if self.period else ()
        return Scorer(scene, mix, trajectories, periods=alone)

    def _scores(self, site: Site) -> dict[str, float]:
        engine = self._engine(site)
        beams = Beams.of(engine.scanner.scan_site(site))
        found = engine.scorer.score(beams)
        found = found.by_period[0] if self.period else found
        scores = {"egvs": found.egvs, "entropy_seen": found.entropy_seen}
        scores |= {name: float(value[0]) for name, value in found.shares.items()}
        if self._targets is not None:
            seen = visible_targets(self._targets.record, beams, detection_probability(engine.scene, beams.sensor))
            worth = self._targets.scores(seen)
            whole = {name: float(value[0]) for name, value in worth.scores.items()}
            scores |= worth.by_period[self.periods.index(self.period)] if self.period else whole
        return scores

    def _rank(self, name: str, score: float) -> int:
        others = (its.scores[self.rank_by] for other, its in self.candidates.items() if other != name)
        return 1 + sum(other > score for other in others)


def _with_blindspots(work: StageContext, enabled: bool) -> StageContext:
    """The same folder where blind spots are asked for, or not: they cost time for every pose, and change no score."""
    score = work.scenario.score.model_copy(update={"blindspots": enabled})
    other = copy(work)
    other.scenario = work.scenario.model_copy(update={"score": score})
    return other


Floats = NDArray[np.float64]

FRAMES_PER_CHUNK = 240
"""Frames that are read and held together: what is played is a stretch of the record."""


@dataclass(frozen=True, eq=False)
class PlaybackFrame:
    """A frame, and what a sensor takes of it.

    Attributes
    ----------
    frame
        Every box.
    returns_m
        World frame, (n, 3) float64.
    owner
        The box that each return is of, -1 for the static world, (n,) int64.
    """

    frame: TrafficFrame
    returns_m: Floats
    owner: NDArray[np.int64]

    @property
    def is_visible(self) -> NDArray[np.bool_]:
        """Of each box, whether it has enough returns, (boxes,)."""
        counts = np.bincount(self.owner[self.owner >= 0], minlength=len(self.frame.boxes))
        return np.asarray(counts >= SEEN_WELL_POINTS)


class Playback:
    """The record of a session. It holds one stretch of it, and one sensor's empty scan."""

    def __init__(self, session: Session) -> None:
        self._session, self._path = session, session.work.folder.trajectories
        self.frames = int(parquet.read_metadata(self._path, "trajectories")["frames"])
        self.parts = cloud_simulation.body_parts(session.scenario)
        self._shapes = VehicleMeshes.from_parts(self.parts)
        self._stretch: tuple[int, list[TrafficFrame]] = (-1, [])
        self._scanner: tuple[Scene, Scanner] | None = None
        self._maker: tuple[Site, CloudSimulator] | None = None

    def frame(self, number: int) -> TrafficFrame:
        """A frame of the record; the last one for a higher number."""
        number = max(0, min(number, self.frames - 1))
        first = number - number % FRAMES_PER_CHUNK
        if self._stretch[0] != first:
            numbers = np.arange(first, min(first + FRAMES_PER_CHUNK, self.frames), dtype=np.int64)
            self._stretch = (first, list(traffic_frames.read_frames(self._path, numbers)))
        return self._stretch[1][number - first]

    def moment(self, site: Site, number: int) -> PlaybackFrame:
        """A frame before a sensor; without returns where none are known: its empty scan was measured, or no sensor can
        stand there."""
        frame = self.frame(number)
        try:
            maker = self._maker_of(site)
        except InputError:
            return PlaybackFrame(frame, np.empty((0, 3)), np.empty(0, dtype=np.int64))
        swept = maker.sweep(frame, sweep_rng(self._session.scenario.seed, site.name, frame.number))
        points = swept.sweep.points[:, :3].astype(np.float64) @ rotation_world_sensor(*site.pose.angles_deg).T
        return PlaybackFrame(frame, points + site.pose.position_m, swept.owner.astype(np.int64))

    def kinds(self, frame: TrafficFrame) -> list[str]:
        """The body of each box of a frame."""
        return [self._shapes.kinds[kind] for kind in self._shapes.kinds_of_boxes(frame).tolist()]

    def _maker_of(self, site: Site) -> CloudSimulator:
        scene = self._session.scene_before(site)
        if self._scanner is None or self._scanner[0] is not scene:
            self._scanner = (scene, Scanner(scene, full_sweep=True, mounts=1))
            self._maker = None
        if self._maker is None or self._maker[0] != site:
            self._maker = (site, CloudSimulator.of_site(scene, site, self._scanner[1], self._shapes))
        return self._maker[1]
