"""Scores, plan and recorded traffic for a sensor in any pose, as the explorer shows them.

:meth:`Session.rate` gives the numbers of ``egvs score``: apply the rules of ``egvs check`` for one site; cast the empty
scan from there; score it with the TPOG, and with recorded vehicles if the scenario requests such scores; rank it among
the candidates, as if the sensor replaced its own candidate. :class:`MovingPlan` is a plan of ``egvs place`` whose
sensors are moved, with the joint score of :mod:`egvs.placement.refinement`. :class:`Playback` shows recorded traffic
with simulated returns, as in the point clouds of :mod:`egvs.clouds.simulation`.

Nothing here depends on a page or a browser. World frame, metres.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from egvs.artefacts import parquet, traffic_frames
from egvs.artefacts.readers import (
    LocationVisibility,
    SiteBlindspots,
    read_scores,
    read_scores_by_period,
)
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import Tpog, read_periods, read_tpog
from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds import simulation as cloud_simulation
from egvs.clouds.simulation import CloudSimulator, VehicleMeshes, sweep_rng
from egvs.core.errors import Diagnostic, InputError, choose_one
from egvs.core.grid import BoolArray, FloatArray, Grid, IntArray
from egvs.effects import registry
from egvs.effects.base import Effect
from egvs.effects.returns import ReturnProbability
from egvs.placement import problem_builder
from egvs.placement.problem import PlanRules
from egvs.placement.refinement import PlanPoses
from egvs.results.labels import SCORE_LABELS
from egvs.results.plans import SensorPlan
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import DEFAULT_SCORE
from egvs.scoring import blindspots
from egvs.scoring.blindspots import CELL_M, SpotVisibility, VehicleSpots
from egvs.scoring.egvs import EntropyField
from egvs.scoring.points_map import PointsMap, TargetPositions
from egvs.scoring.scorer import PeriodTpog, Scorer
from egvs.scoring.target_scores import TARGET_SCORES
from egvs.scoring.targets import SEEN_WELL_POINTS, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sites import Pose, Site
from egvs.stages import scene_checks, scene_inputs
from egvs.stages.base import StageContext
from egvs.stages.inputs import CheckInputs
from egvs.stages.points_maps import target_positions
from egvs.stages.site_scoring import TargetScorer

_SCORES = RunFolder.scores.name

_PLAN_STAGES = ("statics", "scan", "traffic", "tpog")
"""Stages that a plan depends on."""


@dataclass(frozen=True, eq=False)
class MovingPlan:
    """A plan whose sensors can be moved; ``poses`` says where they are and what they see."""

    poses: PlanPoses

    @classmethod
    def from_run(cls, work: StageContext, stages: Mapping[str, str]) -> MovingPlan | None:
        """Read the plan in a run folder; None if there is none, or if it belongs to other traffic, scans or settings.

        Parameters
        ----------
        work
            The run.
        stages
            Keys of its stages.
        """
        planned = SensorPlan.read(work.folder)
        if planned is None or any(planned.stages.get(name) != stages.get(name) for name in _PLAN_STAGES):
            return None
        plan = cls.of_candidates(work, [sensor.site for sensor in planned.sensors])
        scanner = Scanner(replace(work.scene, sites=()))
        for sensor, site in zip(planned.sensors, plan.poses.sites, strict=True):
            if sensor.mount.pose != site.pose:  # after --refine
                moved = replace(site, pose=sensor.mount.pose)
                plan = plan.with_moved(moved, Beams.of(scanner.scan_site(moved)))
        return plan

    @classmethod
    def of_candidates(cls, work: StageContext, names: Sequence[str]) -> MovingPlan:
        """Return a plan of some candidates; this scans all candidates.

        Parameters
        ----------
        work
            The run.
        names
            Names of the candidates.
        """
        config = work.scenario.placement
        anywhere = type(config)(  # sensors may be moved, whatever else [placement] requires
            excluded=config.excluded, most_per_pole=config.most_per_pole, least_distance_m=config.least_distance_m
        )
        unconstrained = work.with_scenario(work.scenario.model_copy(update={"placement": anywhere}))
        problem = problem_builder.build_problem(unconstrained, lambda _: None)
        indices = [problem.names.index(name) for name in names]
        return cls(PlanPoses.of(unconstrained.scenario, problem, indices))

    @property
    def sites(self) -> dict[str, Site]:
        """Current sites by the names of their candidates."""
        return {site.name: site for site in self.poses.sites}

    @cached_property
    def joint(self) -> float:
        """The joint score."""
        return float(self.poses.plan_value.joint)

    def with_moved(self, site: Site, beams: Beams) -> MovingPlan:
        """Return the plan with one sensor moved to ``site``, whose empty scan is ``beams``."""
        rows = tuple(view.row(beams) for view in self.poses.placement_problem.views)
        return MovingPlan(self.poses.with_sensor(list(self.sites).index(site.name), site, rows))

    def with_added(self, candidate: str) -> MovingPlan:
        """Return the plan with one more candidate."""
        problem = self.poses.placement_problem
        index = problem.names.index(candidate)
        rows = tuple(visibility.row(index) for visibility in problem.visibilities)
        extended = replace(
            self.poses,
            plan=(*self.poses.plan, index),
            sites=(*self.poses.sites, problem.sites[index]),
            rows=(*self.poses.rows, rows),
        )
        return MovingPlan(extended)

    @property
    def _rules(self) -> PlanRules:
        return self.poses.placement_problem.problem.rules

    @property
    def forbids_more(self) -> str:
        """The rules that forbid any further sensor, as :meth:`egvs.placement.problem.PlanRules.what_forbids_more`."""
        return self._rules.what_forbids_more(self.poses.plan)

    def gain(self, candidate: str) -> float:
        """Return the increase of the joint score if a candidate is added."""
        return self.with_added(candidate).joint - self.joint

    @cached_property
    def best_next(self) -> tuple[str, float] | None:
        """The candidate with the largest gain that the rules allow, and its gain; None if they allow no more."""
        problem = self.poses.placement_problem
        allowed = self._rules.allowed_additions(self.poses.plan)
        gains = {name: self.gain(name) for name, is_allowed in zip(problem.names, allowed, strict=True) if is_allowed}
        return max(gains.items(), key=lambda item: item[1], default=None)


@dataclass(frozen=True)
class PoseScore:
    """Scores of a sensor in a pose.

    Attributes
    ----------
    site
        The sensor, with the name of its candidate.
    scores
        ``egvs`` in bits, ``entropy_seen`` as a share, and the other scores of the scenario; empty if no sensor can be
        mounted there.
    rank
        Among the candidates, 1 is best; 0 if no sensor can be mounted there.
    findings
        Warnings of the check, and errors if no sensor can be mounted there.
    """

    site: Site
    scores: Mapping[str, float]
    rank: int
    findings: tuple[Diagnostic, ...] = ()

    def __repr__(self) -> str:
        if not self.is_feasible:
            problems = "; ".join(str(finding) for finding in self.findings if finding.is_error)
            return f"PoseScore({self.site.name}: no score, {problems})"
        scores = ", ".join(f"{name} {SCORE_LABELS[name].with_unit(value)}" for name, value in self.scores.items())
        return f"PoseScore({self.site.name}: rank {self.rank}, {scores})"

    @property
    def is_feasible(self) -> bool:
        """Whether a sensor can be mounted there."""
        return bool(self.scores)


@dataclass(frozen=True)
class Engine:
    """Scans and scores with certain effects."""

    scene: Scene
    scanner: Scanner
    scorer: Scorer


class _RecordedVehicles:
    """The vehicles of the recorded frames, read when they are first needed."""

    def __init__(self, work: StageContext, grid: Grid) -> None:
        self._work, self._grid = work, grid

    @cached_property
    def scorer(self) -> TargetScorer:
        """Scores visible vehicles, without blind spots, which take time for every pose but change no score."""
        return self._make_scorer(blindspots=False)

    @cached_property
    def spot_scorer(self) -> TargetScorer:
        """Scores visible vehicles, with blind spots."""
        return self._make_scorer(blindspots=True)

    @cached_property
    def positions(self) -> tuple[TargetPositions, ...]:
        """Where the standard targets stand."""
        return target_positions(self._work, self._grid)

    def _make_scorer(self, *, blindspots: bool) -> TargetScorer:
        self._work.digests(RunFolder.trajectories.name, RunFolder.tpog.name)  # InputError if they were altered
        score = self._work.scenario.score.model_copy(update={"blindspots": blindspots})
        scenario = self._work.scenario.model_copy(update={"score": score})
        return TargetScorer(self._work.with_scenario(scenario), self._grid)


class Session:
    """A run that is explored; it changes nothing in the run folder.

    Parameters
    ----------
    work
        A run folder with all stages up to ``score``.
    stages
        Keys of the stages; a plan is read only if it belongs to them.
    period
        Scores are those of this traffic period; empty for all periods together.
    recorded
        What the sessions of all periods share.

    Attributes
    ----------
    candidates
        Scores of all candidates by name.
    engines
        Cached scanners and scorers, by the settings of the active effects.
    """

    def __init__(
        self,
        work: StageContext,
        stages: Mapping[str, str],
        period: str = "",
        recorded: _RecordedVehicles | None = None,
    ) -> None:
        self.work, self._stages, self.period = work, stages, period
        self.scenario: Scenario = work.scenario
        self.scene: Scene = work.scene
        self.periods: tuple[str, ...] = tuple(entry.name for entry in read_periods(work.folder.tpog) if entry.name)
        self.tpog: Tpog = read_tpog(work.folder.tpog, period or None)
        self._recorded = recorded or _RecordedVehicles(work, self.tpog.grid)
        self.candidates: dict[str, PoseScore] = self._read_candidates()
        self.engines: dict[str, Engine] = {}

    def in_period(self, period: str) -> Session:
        """Return the same run in one period, or in all periods for an empty name."""
        return Session(self.work, self._stages, period, self._recorded)

    def clear_caches(self) -> None:
        """Free the memory of scanners and scorers; they are made again when needed."""
        self.engines.clear()
        self.__dict__.pop("entropy_bit", None)

    @cached_property
    def plan(self) -> MovingPlan | None:
        """The plan in the run folder, if it belongs to the same traffic and scans."""
        return MovingPlan.from_run(self.work, self._stages)

    @property
    def rank_by(self) -> str:
        """The score that ranks."""
        return str(self.scenario.score.rank_by)

    @property
    def frames(self) -> int:
        """Number of recorded frames that scores over vehicles use; of all frames if the scenario has no such score."""
        return self.tpog.frames if self._targets is None else len(self._targets.record.numbers)

    @property
    def ranked(self) -> list[PoseScore]:
        """The candidates, best first."""
        return sorted(self.candidates.values(), key=lambda candidate: candidate.rank)

    def rate(self, name: str, pose: Pose, sensor: str | None = None) -> PoseScore:
        """Score a candidate's sensor, or another one, in a pose.

        Parameters
        ----------
        name
            The candidate.
        pose
            Where it is moved to.
        sensor
            Name of another sensor.

        Raises
        ------
        InputError
            If there is no such candidate, or no such sensor.
        """
        if name not in self.candidates:
            raise InputError(f"candidate {name!r}", "no such candidate", choose_one(name, [*self.candidates]))
        candidate = self.candidates[name].site
        site = replace(candidate, pose=pose, sensor=sensor or candidate.sensor)
        self.scene.sensor(site.sensor)
        if site.points is not None and site != candidate:
            problem = "its empty scan was measured, so scans from other poses are unknown"
            hint = "Reset the sensor to the candidate's pose."
            finding = Diagnostic("measured scan", f"site {name}", problem, hint, is_error=True)
            return PoseScore(site, {}, 0, (finding,))
        findings = self._check(site)
        if any(finding.is_error for finding in findings):
            return PoseScore(site, {}, 0, findings)
        try:
            scores = self._scores(site)
        except InputError as error:  # an effect needs a property of the sensor that is unknown
            return PoseScore(site, {}, 0, (*findings, Diagnostic.of("score", error)))
        score = scores[self.rank_by]
        others = (other.scores[self.rank_by] for key, other in self.candidates.items() if key != name)
        rank = 1 + sum(other > score for other in others)
        return PoseScore(site, scores, rank, findings)

    def hits(self, site: Site) -> FloatArray:
        """Return the number of beams of a sensor that cross each voxel, (nx, ny, nz) float64.

        This and the following methods raise an InputError if no sensor can be mounted there.
        """
        engine = self._engine(site)
        return engine.scorer.hits(engine.scanner.scan_site(site))

    def beams(self, site: Site) -> Beams:
        """Return the empty scan of a sensor, as scores use it."""
        return Beams.of(self._engine(site).scanner.scan_site(site))

    def returns_m(self, site: Site) -> FloatArray:
        """Return the points of the empty scan, (n, 3) float64, world frame."""
        rows = self._engine(site).scanner.scan_site(site).rows
        return rows.ends_m[rows.returned] + site.pose.position_m

    def beams_m(self, site: Site, ring: int) -> FloatArray:
        """Return start and end of the beams of one ring that can meet the region, (n, 2, 3) float64, world frame.

        Parameters
        ----------
        site
            The sensor.
        ring
            Index of the ring; the last one for higher numbers. A sensor without rings has all beams.
        """
        scan = self._engine(site).scanner.scan_site(site)
        channels = scan.sensor.channels
        ends = scan.rows.ends_m
        if channels > 0 and site.points is None:
            ends = ends[scan.rows.beam % channels == min(ring, channels - 1)]
        ends = ends + site.pose.position_m
        return np.stack([np.broadcast_to(site.pose.position_m, ends.shape), ends], axis=1)

    def blindspots(self, site: Site) -> SiteBlindspots:
        """Return where a sensor misses vehicles, over all periods; see ``blindspots.parquet``."""
        targets = self._recorded.spot_scorer
        assert targets.spots is not None
        beams = self.beams(site)
        probability = ReturnProbability.of(self.scene_with(site), beams.sensor)
        visible = visible_targets(targets.record, beams, probability)
        visibility = targets.spots.visibility(visible.points, TARGET_SCORES[DEFAULT_SCORE](visible, targets.detectors))
        return site_blindspots(site.name, targets.spots, visibility, self.tpog.grid)

    def points_map(self, site: Site, target: str) -> PointsMap | None:
        """Return the points that a standard target gets from a sensor at each square metre of the road surface.

        Parameters
        ----------
        site
            The sensor in a pose.
        target
            Name of one of :data:`egvs.scoring.points_map.TARGETS`.

        Returns
        -------
        PointsMap, or None
            None where the traffic does not come from one road network.
        """
        for place in self._recorded.positions:
            if place.target.name == target:
                beams = self.beams(site)
                return place.points_map(beams, ReturnProbability.of(self.scene_with(site), beams.sensor))
        return None

    def scene_with(self, site: Site) -> Scene:
        """Return the scene with the effects that act when the candidate of a site is moved there."""
        return self._engine(site).scene

    @cached_property
    def entropy_bit(self) -> FloatArray:
        """Entropy of each voxel, (nx, ny, nz) float64."""
        field = EntropyField.of(self.tpog.counts, self.tpog.frames, self.tpog.grid)
        entropy = np.zeros(self.tpog.counts.size)
        entropy[field.cells] = field.per_cell_bit
        return entropy.reshape(self.tpog.grid.shape)

    def _read_candidates(self) -> dict[str, PoseScore]:
        """Read ``scores.parquet``, or ``scores_by_period.parquet``."""
        path = self.work.path(RunFolder.scores_by_period.name if self.period else _SCORES)
        self.work.digest(path.name)
        read = read_scores_by_period if self.period else read_scores
        rows = {row["site"]: row for row in read(path).to_pylist() if row.get("period", "") == self.period}
        if rows.keys() != {site.name for site in self.scene.sites}:
            raise InputError(path, "its sites are not those of the scenario", 'Repeat "egvs run".')
        names = dict.fromkeys(("egvs", "entropy_seen", *self.scenario.score.additional))
        candidates = {}
        for site in self.scene.sites:
            row = rows[site.name]
            candidates[site.name] = PoseScore(site, {name: row[name] for name in names}, row["rank"])
        return candidates

    @property
    def _targets(self) -> TargetScorer | None:
        """Scores visible vehicles; None if the scenario requests no such score."""
        if not any(name in TARGET_SCORES for name in self.scenario.score.additional):
            return None
        return self._recorded.scorer

    def _check(self, site: Site) -> tuple[Diagnostic, ...]:
        """Apply the rules for sites; ``only_free`` is off, because it drops sites instead of reporting them."""
        sites_config = self.scenario.sites.model_copy(update={"only_free": False})
        scenario = self.scenario.model_copy(update={"sites": sites_config})
        roads = self.work.inputs
        checked = CheckInputs(scenario, roads.network, roads.carriageway, self.scene.world, (site,), self.scene)
        return (*scene_checks.check_poses(checked), *scene_checks.warn_sites_on_lanes(checked))

    def _engine(self, site: Site) -> Engine:
        """Return scanner and scorer with the effects that act when a candidate is moved to ``site``."""
        sites = tuple(site if other.name == site.name else other for other in self.scene.sites)
        scene = scene_inputs.with_effects(replace(self.scene, sites=sites, effects=(), inactive_effects=()))
        key = json.dumps(registry.effect_settings(scene.acting(Effect)))
        if key not in self.engines:
            scene = replace(scene, sites=())  # one scanner for all poses
            self.engines[key] = Engine(scene, Scanner(scene, mounts=1), self._make_scorer(scene))
        return self.engines[key]

    def _make_scorer(self, scene: Scene) -> Scorer:
        folder = self.work.folder
        if not self.period:
            return Scorer(scene, self.tpog, folder.trajectories)
        # effects need the TPOG of all periods, in a period too
        return Scorer(scene, read_tpog(folder.tpog), folder.trajectories, periods=(PeriodTpog(self.period, self.tpog),))

    def _scores(self, site: Site) -> dict[str, float]:
        return self.score_beams(site, Beams.of(self._engine(site).scanner.scan_site(site)))

    def score_beams(self, site: Site, beams: Beams) -> dict[str, float]:
        """Return the scores of an empty scan, by name, as :attr:`PoseScore.scores`.

        Parameters
        ----------
        site
            The sensor.
        beams
            Its empty scan, such as a part of :meth:`beams`.
        """
        engine = self._engine(site)
        result = engine.scorer.score(beams)
        if self.period:
            result = result.by_period[0]
        scores = {"egvs": result.egvs, "entropy_seen": result.entropy_seen}
        scores |= {name: float(values[0]) for name, values in result.shares.items()}
        if self._targets is None:
            return scores
        visible = visible_targets(self._targets.record, beams, ReturnProbability.of(engine.scene, beams.sensor))
        target_scores = self._targets.scores(visible)
        if self.period:
            return {**scores, **target_scores.by_period[self.periods.index(self.period)]}
        of_vehicles = target_scores.scores
        return scores | {name: float(of_vehicles[name][0]) for name in of_vehicles if name in TARGET_SCORES}


def site_blindspots(site: str, spots: VehicleSpots, visibility: SpotVisibility, grid: Grid) -> SiteBlindspots:
    """Return the blind spots of a site.

    Parameters
    ----------
    site
        Its name.
    spots
        Locations, and cells of the map.
    visibility
        Share of vehicles found at each spot.
    grid
        The region of interest.
    """
    locations = []
    for index, location in enumerate(spots.locations):
        location_visibility = LocationVisibility(
            location.by,
            location.words,
            spots.at_m[index, 0].item(),
            spots.at_m[index, 1].item(),
            spots.vehicle_frames[index].item(),
            spots.vehicles[index].item(),
            visibility.share[index].item(),
            visibility.se[index].item(),
        )
        locations.append(location_visibility)
    share_missed = np.full(blindspots.blindspot_map_shape(grid), np.nan)
    share_missed[tuple(spots.cells.T)] = 1.0 - visibility.share[len(locations) :]
    x, y, _ = grid.origin_m
    return SiteBlindspots(site, tuple(locations), share_missed, (x, y), CELL_M)


@dataclass(frozen=True, eq=False)
class PlaybackFrame:
    """A recorded frame with the returns of one sensor.

    Attributes
    ----------
    frame
        All vehicle boxes.
    returns_m
        Points, (n, 3) float64, world frame.
    owner
        Index of the box that each return is from, -1 for the static world, (n,) int64.
    """

    frame: TrafficFrame
    returns_m: FloatArray
    owner: IntArray

    @property
    def is_visible(self) -> BoolArray:
        """Whether each box has enough returns, (boxes,)."""
        counts = np.bincount(self.owner[self.owner >= 0], minlength=len(self.frame.boxes))
        return np.asarray(counts >= SEEN_WELL_POINTS)


class Playback:
    """The recorded traffic of a session; it caches some frames and one sensor's empty scan.

    Parameters
    ----------
    session
        The session.
    frames_per_chunk
        Number of frames that are read at once.

    Attributes
    ----------
    frames, period_s
        Number of frames, and the time between two.
    """

    def __init__(self, session: Session, frames_per_chunk: int = 240) -> None:
        self._session, self._path = session, session.work.folder.trajectories
        self._frames_per_chunk = frames_per_chunk
        metadata = parquet.read_metadata(self._path, "trajectories")
        self.frames, self.period_s = int(metadata["frames"]), float(metadata["frame_period_s"])
        self.parts = cloud_simulation.body_parts(session.scenario)
        self._meshes = VehicleMeshes.from_parts(self.parts)
        self._first_cached, self._cached_frames = -1, list[TrafficFrame]()
        self._scanner: tuple[Scene, Scanner] | None = None
        self._simulator: tuple[Site, CloudSimulator] | None = None

    def frame(self, number: int) -> TrafficFrame:
        """Return a frame; the first or last one for numbers outside the recording."""
        number = max(0, min(number, self.frames - 1))
        first = number - number % self._frames_per_chunk
        if self._first_cached != first:
            numbers = np.arange(first, min(first + self._frames_per_chunk, self.frames), dtype=np.int64)
            self._first_cached, self._cached_frames = first, list(traffic_frames.read_frames(self._path, numbers))
        return self._cached_frames[number - first]

    def simulate(self, site: Site, frame: TrafficFrame) -> PlaybackFrame:
        """Simulate the returns of a sensor.

        Parameters
        ----------
        site
            The sensor; there are no returns if its empty scan was measured, or if it cannot be mounted there.
        frame
            A recorded frame.
        """
        try:
            simulator = self._site_simulator(site)
        except InputError:
            return PlaybackFrame(frame, np.empty((0, 3)), np.empty(0, dtype=np.int64))
        labelled = simulator.sweep(frame, sweep_rng(self._session.scenario.seed, site.name, frame.number))
        points = labelled.sweep.points[:, :3].astype(np.float64) @ rotation_world_sensor(*site.pose.angles_deg).T
        return PlaybackFrame(frame, points + site.pose.position_m, labelled.owner.astype(np.int64))

    def kinds(self, frame: TrafficFrame) -> list[str]:
        """Return the body of each box of a frame."""
        return [self._meshes.kinds[kind] for kind in self._meshes.kinds_of_boxes(frame).tolist()]

    def _site_simulator(self, site: Site) -> CloudSimulator:
        scene = self._session.scene_with(site)
        if self._scanner is None or self._scanner[0] is not scene:
            self._scanner = (scene, Scanner(scene, full_sweep=True, mounts=1))
            self._simulator = None
        if self._simulator is None or self._simulator[0] != site:
            self._simulator = (site, CloudSimulator.of_site(scene, site, self._scanner[1], self._meshes))
        return self._simulator[1]
