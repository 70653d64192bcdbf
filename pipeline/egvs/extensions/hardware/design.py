r"""Choose a sensor and its mount for a pole, and the elevations of a sensor with free channels.

Steps: for each sensor, search height, yaw and pitch, from the best of the candidates at the pole and of some usual
mounts; take the best; with free channels, search the elevations at that mount. The score is the recommended one, the
expected share of vehicles found (:data:`egvs.scenario.score_config.DEFAULT_SCORE`), computed from a new empty scan for
each trial. The search is that of ``egvs place --refine`` (:func:`egvs.placement.refinement.minimise`: random points,
then CMA-ES). A sensor hangs as at the sites of the pole, were it the sensor there: mount and roll are not searched.

*Other frames.* A search finds what suits its frames, also by chance. So it sees the first half of each simulation only,
and all scores and differences that are reported come from the second half, with errors of the block jackknife over its
frames (:class:`egvs.scoring.targets.FrameGroups`). With several seeds (``traffic.seeds``), the second half of each
simulation is one group of the jackknife, as in ``egvs run``. The score on the first halves is reported beside it.

*Elevations.* The search starts at the channels of the base sensor as they are if it has as many, else evenly spread
between its lowest and its highest elevation. It divides them into at most :data:`MAX_PIECES` pieces, which it stretches
and compresses: the axes are the lowest and the highest elevation, and the share of each piece in between,
:math:`w_i = e^{8 x_i - 4}` divided by their sum, for :math:`x_i` from 0 to 1. Within a piece, the channels keep their
relative distances. Neighbours are at least :data:`MIN_GAP_DEG` apart, and elevations are rounded to hundredths of a
degree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts import traffic_frames
from egvs.artefacts.command_results import read_results
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import PeriodBlocks, read_periods, read_tpog
from egvs.core import plugins
from egvs.core.errors import InputError, choose_one
from egvs.core.grid import FloatArray, IntArray
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.threads import map_ordered
from egvs.effects.returns import ReturnProbability
from egvs.extensions.hardware.design_request import ALL_SENSORS, DesignRequest
from egvs.extensions.hardware.files import SENSOR_DESIGN, design_digest
from egvs.placement.refinement import Axis, BoxEnds, Freedom, minimise
from egvs.results.command_entries import DIGEST_KEY
from egvs.results.sensors import ScoreDifference
from egvs.runs import run, stage_registry
from egvs.runs.command_results import add_to_report
from egvs.runs.run_context import open_folder
from egvs.scenario.model import Scenario
from egvs.scenario.sensor_config import OPTICS_KEYS, SensorConfig
from egvs.scoring.standard_errors import BlockGroups, ScoreUncertainty, detector_groups
from egvs.scoring.target_scores import expected_by_detector
from egvs.scoring.targets import (
    FrameGroups,
    TargetRecord,
    recorded_frames,
    target_weights,
    visible_targets,
    weighted_mean,
    weighted_people,
    weights_in_mix,
)
from egvs.scoring.visibility import Beams
from egvs.scoring.zones import weight_zones
from egvs.sensors.scanner import Scanner
from egvs.sensors.sensor import CATALOGUE, Sensor, check_sensor_names
from egvs.sensors.site_feasibility import ground_height_m
from egvs.sensors.sites import Pose, Site, candidate_sites
from egvs.stages.base import StageContext
from egvs.stages.scene_inputs import with_losses_of_all
from egvs.statistics.blocks import group_sizes, means_without_each

STAGES = ("check", "statics", "traffic", "tpog")
MAX_PIECES = 7
MIN_GAP_DEG = 0.05
PITCH_DEG = (-30.0, 10.0)
START_PITCHES_DEG = (0.0, -5.0, -10.0, -15.0, -20.0)
MIN_EVALUATIONS = 20

_BLOCKS = 10
"""Blocks of the second half of a record, before groups are joined."""
_ANGLE_DIGITS = 2
_LOG_SHARE = 8.0
_ELEVATION_STEP = 0.03
"""Initial step of the elevations, as a share of their bounds: about two degrees."""
_IMPOSSIBLE_LOSS = 1e6


@dataclass(frozen=True)
class Design:
    """A sensor at a mount, with its scores.

    Attributes
    ----------
    sensor, pose
        The sensor and its mount.
    search_score
        Score on the frames of the search.
    score, se
        Score on other frames, and its standard error.
    difference
        This score minus that of the best design of the catalogue, on the same other frames.
    """

    sensor: Sensor
    pose: Pose
    search_score: float
    score: float
    se: float
    difference: ScoreDifference


@dataclass(frozen=True)
class DesignResult:
    """The designs for a pole.

    Attributes
    ----------
    pole
        Its name.
    ground_m
        Height of the ground at the pole, world frame.
    catalogue
        The best mount of each sensor, the best first by the score of the search.
    start, designed
        With free channels: the sensor that the search started from, and the designed one; else None.
    frames
        Number of frames of the search, and of the others.
    notes
        What a reader must know.
    """

    pole: str
    ground_m: float
    catalogue: tuple[Design, ...]
    start: Design | None
    designed: Design | None
    frames: tuple[int, int]
    notes: tuple[str, ...]

    @property
    def chosen(self) -> Design:
        """The best design by the score of the search."""
        designs = [*self.catalogue[:1], *([self.designed] if self.designed is not None else [])]
        return max(designs, key=lambda design: design.search_score)


def design_sensor(
    scenario: Scenario,
    request: DesignRequest,
    out: str | Path | None = None,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: run.StageListener = run.ignore_stage,
) -> DesignResult:
    """Choose a sensor, its mount, and the elevations of free channels for a pole.

    Parameters
    ----------
    scenario
        From :func:`egvs.load`.
    request
        What to design.
    out
        The run folder; ``runs/<scenario name>`` when None. Traffic and TPOG are brought up to date there.
    jobs
        Number of threads; one per core when None. Results do not depend on it.
    progress, listener
        Called with the progress of stages and trials, and when a stage begins or ends.

    Returns
    -------
    DesignResult
        The designs, which are also added to the report if the folder has a complete run.

    Raises
    ------
    InputError
        When the request is wrong, or the second half of the traffic has no vehicle in the region.
    """
    plugins.require_libraries("egvs sensor design", "place", "cma")
    _check_request(request)
    folder = Path(out) if out is not None else run.default_folder(scenario)
    names = _sensor_names(scenario, request)
    read_results(RunFolder(folder) / SENSOR_DESIGN.name)
    record = run.run(scenario, folder, only=STAGES, jobs=jobs, progress=progress, listener=listener)
    recorded = stage_registry.recorded_digests(record)
    context = open_folder(scenario, folder, jobs=jobs, progress=progress, recorded=recorded)
    designer = _Designer(context, request)
    notes: list[str] = []
    seeds = scenario.traffic.seeds
    if seeds > 1:
        notes.append(f"{seeds} simulations: the search saw the first half of each; ± is from their differences.")
    best_mounts: list[_Trial] = []
    for number, name in enumerate(names):
        try:
            best_mounts.append(designer.best_mount(context.scene.sensor(name, "--sensors"), number))
        except InputError as error:
            if request.sensors != (ALL_SENSORS,):
                raise
            notes.append(f"{name} is left out: {error}")
        progress("sensors", number + 1, len(names))
    if not best_mounts:
        raise InputError("--sensors", "expected a sensor that is possible in this scenario, got none", notes[0])
    best_mounts.sort(key=lambda trial: -trial.score)
    trials = list(best_mounts)
    if request.channels is not None:
        base = next((trial for trial in best_mounts if trial.sensor.channels), None)
        if base is None:
            problem = "expected a sensor with rings among --sensors, got beam tables only"
            raise InputError("--channels", problem, "Add one, such as --sensors VLP-16.")
        start, designed = designer.best_elevations(base, request, len(names))
        trials += [start, designed]
    designs = designer.evaluate(trials)
    designed_pair = designs[len(best_mounts) :]
    result = DesignResult(
        request.pole, designer.ground_m, tuple(designs[: len(best_mounts)]),
        designed_pair[0] if designed_pair else None, designed_pair[1] if designed_pair else None, designer.frames,
        tuple(notes),
    )  # fmt: skip
    entry = {**_report_entry(result), DIGEST_KEY: design_digest(scenario)}
    written = add_to_report(folder, SENSOR_DESIGN, {request.pole: entry}, STAGES)
    if RunFolder(folder).report in written:
        return result
    note = "The report will show this once the run folder has current scores (egvs run)."
    return replace(result, notes=(*result.notes, note))


def _report_entry(result: DesignResult) -> dict[str, Any]:
    """Return what the report says about the designs, JSON values."""
    designs = list(result.catalogue)
    if result.start is not None and result.designed is not None:
        designs += [result.start, result.designed]
    rows = []
    for design in designs:
        difference = design.difference
        rows.append(
            {
                "sensor": design.sensor.name,
                "height_m": design.pose.z_m - result.ground_m,
                "yaw_deg": design.pose.yaw_deg,
                "pitch_deg": design.pose.pitch_deg,
                "roll_deg": design.pose.roll_deg,
                "search_score": design.search_score,
                "score": design.score,
                "se": design.se,
                "difference": {"value": difference.value, "se": difference.se, "better": difference.better},
                "chosen": design is result.chosen,
            }
        )
    return {"frames": list(result.frames), "designs": rows, "notes": list(result.notes)}


def _check_request(request: DesignRequest) -> None:
    low, high = request.bounds_deg
    if not -90 <= low < high <= 90:
        problem = f"expected two ascending elevations from -90 to 90 degrees, got {low:g},{high:g}"
        raise InputError("--elevations", problem, "Use free, or bounds such as --elevations=-30,10.")
    if request.channels is not None:
        most = int((high - low) / MIN_GAP_DEG) + 1
        if not 2 <= request.channels <= most:
            problem = f"expected 2 to {most} channels between {low:g} and {high:g} degrees, got {request.channels}"
            raise InputError("--channels", problem, f"Use a number such as {min(32, most)}, or wider --elevations.")
    for option, evaluations in (
        ("--evaluations", request.evaluations), ("--elevation-evaluations", request.elevation_evaluations),
    ):  # fmt: skip
        if evaluations < MIN_EVALUATIONS:
            problem = f"expected at least {MIN_EVALUATIONS}, got {evaluations}"
            raise InputError(option, problem, "Leave it out, or use 100.")


def _sensor_names(scenario: Scenario, request: DesignRequest) -> tuple[str, ...]:
    if request.sensors == (ALL_SENSORS,):
        return tuple(dict.fromkeys((*scenario.sensors, *CATALOGUE)))
    check_sensor_names(request.sensors, scenario.sensors, "--sensors")
    return tuple(dict.fromkeys(request.sensors))


@dataclass(frozen=True)
class _Trial:
    """A sensor at a mount, and its score on the frames of the search."""

    sensor: Sensor
    pose: Pose
    score: float


@dataclass(frozen=True, eq=False)
class _Half:
    """The vehicle-frames of one half of each simulation, and their weights (n,)."""

    record: TargetRecord
    weight: FloatArray


class _Designer:
    """Scores sensors at a pole, and searches for better ones."""

    def __init__(self, context: StageContext, request: DesignRequest) -> None:
        self._context = context
        self._scene = with_losses_of_all(context.scene)  # it compares sensors
        self._scanner = Scanner(self._scene)
        self._sites = _sites_at(self._scene.sites, request.pole)
        self.ground_m = 0.0
        if context.scenario.statics.ground:
            self.ground_m = ground_height_m(self._scene.world, self._sites[0].pose)
        self._heights_m = request.heights_m or _heights_m(self._sites, self.ground_m)
        self._evaluations = request.evaluations
        self._seed = context.scenario.seed
        self._detectors = context.scenario.score.detectors
        self._search_half, self._other_half = self._read_halves()

    @property
    def frames(self) -> tuple[int, int]:
        """Number of frames of the search, and of the others."""
        return len(self._search_half.record.numbers), len(self._other_half.record.numbers)

    def _read_halves(self) -> tuple[_Half, _Half]:
        """Read the vehicles of the sampled frames: those of the first half of each simulation, and of the second."""
        folder, config = self._context.folder, self._context.scenario.score
        recorded = recorded_frames(folder.trajectories)
        numbers = traffic_frames.spaced_frames(sum(recorded), config.sampled_frames)
        is_first = np.zeros(len(numbers), dtype=np.bool_)
        start = 0
        for period, frames in zip(read_periods(folder.tpog), recorded, strict=True):
            for simulation in _simulations(period, frames):
                is_first |= (numbers >= start) & (numbers < start + simulation // 2)
                start += simulation
        return self._read_half(numbers[is_first], "first"), self._read_half(numbers[~is_first], "second")

    def _read_half(self, numbers: IntArray, which: str) -> _Half:
        folder, config = self._context.folder, self._context.scenario.score
        frames = list(traffic_frames.read_frames(folder.trajectories, numbers))
        grid = read_tpog(folder.tpog).grid
        record = TargetRecord.of(frames, grid, weighted_people(config.weights))
        periods = read_periods(folder.tpog)
        weight = weights_in_mix(periods, recorded_frames(folder.trajectories), record)
        if config.weights.are_given:
            weight = weight * target_weights(config.weights, weight_zones(self._context.scenario), record)
        if not math.fsum(weight) > 0.0:
            problem = f"no vehicle is in the region of interest in the {which} half of the frames"
            raise InputError(self._context.scenario.locate("traffic.frames"), problem, "Record more frames.")
        return _Half(record, weight)

    def best_mount(self, sensor: Sensor, number: int) -> _Trial:
        """Return the best mount of a sensor; the search starts at the best of the candidates and some usual mounts."""
        poses = self._site_poses(sensor)
        poses += [usual for pose in _one_of_each_roll(poses) for usual in self._usual_poses(sensor, pose)]
        starts = [trial for trial in self._try_all([(sensor, pose) for pose in poses]) if trial is not None]
        if not starts:
            problem = f"no candidate there is possible with {sensor.name}"
            raise InputError(f"--pole {self._sites[0].pole}", problem, "Use another pole, or other sensors.")
        start = max(starts, key=lambda trial: trial.score)
        low_m, high_m = (height_m + self.ground_m for height_m in self._heights_m)
        axes = [Axis("yaw_deg", -180.0, 180.0, is_periodic=True), Axis("pitch_deg", *PITCH_DEG)]
        if low_m < high_m:
            axes.append(Axis("z_m", low_m, high_m))
        freedom = Freedom(start.pose, tuple(axes))
        search = _Search(start)

        def losses(points: FloatArray) -> FloatArray:
            poses = [freedom.pose_at(point) for point in points]
            return search.losses(self._try_all([(sensor, pose) for pose in poses if pose is not None]))

        rng = np.random.default_rng(np.random.SeedSequence((self._seed, number)))
        minimise(losses, freedom.point(start.pose), freedom.ends, self._evaluations, rng)
        return search.best

    def _site_poses(self, sensor: Sensor) -> list[Pose]:
        """Return the poses of a sensor at the sites of the pole: with its own mount, and aimed by its middle ray."""
        names = {site.name for site in self._sites}
        sites = candidate_sites(self._context.scenario.with_site_sensor(sensor.name))
        return [site.pose for site in sites if site.name in names]

    def _usual_poses(self, sensor: Sensor, pose: Pose) -> list[Pose]:
        """Return mounts at three heights and :data:`START_PITCHES_DEG` that face the centre of the region."""
        x_m, y_m, _ = self._context.scenario.roi.center_m
        towards_deg = math.degrees(math.atan2(y_m - pose.y_m, x_m - pose.x_m))
        middle_deg = -sensor.middle_deg[1] if pose.is_inverted else sensor.middle_deg[1]
        yaw_deg = round(math.remainder(towards_deg - middle_deg, 360.0), _ANGLE_DIGITS)
        heights_m = np.linspace(*self._heights_m, 3) + self.ground_m
        return [
            replace(pose, z_m=round(z_m, 3), yaw_deg=yaw_deg, pitch_deg=pitch_deg)
            for z_m in dict.fromkeys(heights_m.tolist())
            for pitch_deg in START_PITCHES_DEG
        ]

    def best_elevations(self, base: _Trial, request: DesignRequest, number: int) -> tuple[_Trial, _Trial]:
        """Return a base sensor with the requested channels, and the one with the best elevations, at its mount."""
        assert request.channels is not None
        elevations_deg = start_elevations(base.sensor, request.channels, request.bounds_deg)
        first = _with_elevations(base.sensor, elevations_deg, f"{request.name}, at the start")
        (start,) = self._try_all([(first, base.pose)])
        assert start is not None, "the base sensor was possible at this mount"
        search = _Search(replace(start, sensor=replace(start.sensor, name=request.name)))
        curve = ElevationCurve(elevations_deg, *request.bounds_deg)

        def losses(points: FloatArray) -> FloatArray:
            sensors = [_with_elevations(base.sensor, curve.elevations(point), request.name) for point in points]
            values = search.losses(self._try_all([(sensor, base.pose) for sensor in sensors]))
            self._context.progress("elevations", search.tried, request.elevation_evaluations)
            return values

        rng = np.random.default_rng(np.random.SeedSequence((self._seed, number)))
        start_point = curve.point(elevations_deg)
        minimise(losses, start_point, curve.ends, request.elevation_evaluations, rng, _ELEVATION_STEP)
        return start, search.best

    def _try_all(self, mounts: Sequence[tuple[Sensor, Pose]]) -> list[_Trial | None]:
        """Return the trial of each mount on the frames of the search; None where no sensor can be."""
        return list(map_ordered(partial(self._try, half=self._search_half), mounts, self._context.threads))

    def _try(self, mount: tuple[Sensor, Pose], half: _Half) -> _Trial | None:
        sensor, pose = mount
        values = self._values(sensor, pose, half)
        return None if values is None else _Trial(sensor, pose, weighted_mean(values, half.weight))

    def _values(self, sensor: Sensor, pose: Pose, half: _Half) -> FloatArray | None:
        """Return the probability that each vehicle of a half is found, (n,); None where no sensor can be."""
        found = self._chances(sensor, pose, half)
        return None if found is None else found.mean(axis=0)

    def _chances(self, sensor: Sensor, pose: Pose, half: _Half) -> FloatArray | None:
        """Return the probability that each detector finds each vehicle of a half, (d, n); None as :meth:`_values`."""
        probability = ReturnProbability.of(self._scene, sensor)  # InputError if an effect lacks a value of the sensor
        try:
            beams = Beams.of(self._scanner.scan(pose, sensor))
        except InputError:  # the only reasons: in a solid, below the ground, out of reach
            return None
        return expected_by_detector(visible_targets(half.record, beams, probability), self._detectors)

    def evaluate(self, trials: Sequence[_Trial]) -> list[Design]:
        """Score trials on the other frames, with errors, and compare them with the first."""
        half = self._other_half
        groups = self._other_groups()
        detectors = detector_groups(len(self._detectors))
        rows = []
        for trial in trials:
            found = self._chances(trial.sensor, trial.pose, half)
            assert found is not None, "the search scanned from there"
            row = groups.means(found.mean(axis=0), half.weight / groups.weight)
            if detectors:
                by_detector = np.array([weighted_mean(chances, half.weight) for chances in found])
                row = np.append(row, means_without_each(by_detector))
            rows.append(row)
        uncertainty = ScoreUncertainty.of(np.array(rows), groups.groups + detectors, len(rows))
        number = np.arange(len(trials))
        first = np.zeros(len(trials), dtype=np.int64)
        differences, better = uncertainty.differences(number, first), uncertainty.beats(number, first)
        designs = []
        for i, trial in enumerate(trials):
            difference = ScoreDifference(
                float(differences.values[i]), float(differences.se[i]), float(better[i]), is_paired=True
            )
            score, se = float(rows[i][0]), float(uncertainty.se[i])
            designs.append(Design(trial.sensor, trial.pose, trial.score, score, se, difference))
        return designs

    def _other_groups(self) -> FrameGroups:
        """Return the groups of the second half of each simulation."""
        record = self._other_half.record
        periods = read_periods(self._context.folder.tpog)
        recorded = recorded_frames(self._context.folder.trajectories)
        groups, starts, start = [], [], 0
        for period, frames in zip(periods, recorded, strict=True):
            period_groups, group_starts = second_half_groups(period, frames)
            groups.append(period_groups)
            starts.append(start + group_starts)
            start += frames
        first_rows = np.searchsorted(record.numbers[record.frame], np.concatenate(starts))
        return FrameGroups(tuple(groups), np.append(first_rows, len(record)), weights_in_mix(periods, recorded, record))


def _simulations(period: PeriodBlocks, frames: int) -> list[int]:
    """Return the number of recorded frames of each simulation of a period, one after another."""
    return [len(part) for part in np.array_split(np.arange(frames), period.seeds)]


def second_half_groups(period: PeriodBlocks, frames: int) -> tuple[BlockGroups, IntArray]:
    """Return the groups of the frames that the search does not see, for standard errors.

    With several seeds, the second half of each simulation is a group. With one, up to ten blocks of its second half are
    joined as in :func:`egvs.scoring.standard_errors.block_groups`.

    Parameters
    ----------
    period
        The period.
    frames
        Number of its recorded frames.

    Returns
    -------
    tuple
        The groups, and the first frame of each, counted from the start of the period, (k,) int64.
    """
    if period.seeds > 1:
        simulations = np.array(_simulations(period, frames), dtype=np.int64)
        first_halves = simulations // 2
        starts = np.cumsum(simulations) - simulations + first_halves
        return BlockGroups(simulations - first_halves, period.memory_frames, are_seeds=True), starts
    half = frames - frames // 2
    blocks = min(_BLOCKS, half)
    sizes = group_sizes(blocks, half // blocks, period.memory_frames)
    lengths = [len(part) for part in np.array_split(np.arange(half), blocks)]
    ends = np.append(0, np.cumsum(sizes))
    totals = np.array([sum(lengths[first:last]) for first, last in pairwise(ends.tolist())], dtype=np.int64)
    starts = frames // 2 + np.cumsum(totals) - totals
    return BlockGroups(totals, period.memory_frames), starts


class _Search:
    """Remembers the best trial; the start counts as one."""

    def __init__(self, start: _Trial) -> None:
        self.best = start
        self.tried = 0

    def losses(self, trials: Sequence[_Trial | None]) -> FloatArray:
        """Return the losses of trials, (n,)."""
        losses = np.full(len(trials), _IMPOSSIBLE_LOSS)
        for i, trial in enumerate(trials):
            if trial is None:
                continue
            losses[i] = -trial.score
            if trial.score > self.best.score:
                self.best = trial
        self.tried += len(trials)
        return losses


def _sites_at(sites: Sequence[Site], pole: str) -> tuple[Site, ...]:
    """Return the candidates on a pole, which may also be named by one of them; InputError without any."""
    poles = {site.pole for site in sites if pole in (site.pole, site.name)}
    at_pole = tuple(site for site in sites if site.pole in poles and site.points is None)
    if not at_pole:
        known = list(dict.fromkeys(site.pole for site in sites))
        raise InputError("--pole", f"expected a pole with a simulated scan, got {pole!r}", choose_one(pole, known))
    return at_pole


def _one_of_each_roll(poses: Sequence[Pose]) -> list[Pose]:
    return list({pose.roll_deg: pose for pose in poses}.values())


def _heights_m(sites: Sequence[Site], ground_m: float) -> tuple[float, float]:
    heights_m = [site.pose.z_m - ground_m for site in sites]
    return min(heights_m), max(heights_m)


def _with_elevations(base: Sensor, elevations_deg: Sequence[float], name: str) -> Sensor:
    """Return a sensor with the azimuths, range and optics of another, and rings at these elevations."""
    rings = len(elevations_deg)
    return replace(
        base, name=name, elevations_deg=tuple(elevations_deg), azimuth_offsets_deg=(0.0,) * rings,
        source=f"egvs sensor design, from {base.name}", assumed="",
    )  # fmt: skip


def start_elevations(base: Sensor, channels: int, bounds_deg: tuple[float, float]) -> tuple[float, ...]:
    """Return the elevations that a search starts from.

    Parameters
    ----------
    base
        The sensor; its elevations are used as they are if it has as many channels, all within the bounds.
    channels
        Number of channels.
    bounds_deg
        Lowest and highest elevation.
    """
    low_deg, high_deg = bounds_deg
    base_elevations = tuple(sorted(base.elevations_deg))
    if len(base_elevations) == channels and low_deg <= base_elevations[0] and base_elevations[-1] <= high_deg:
        return base_elevations
    first, last = (min(max(value, low_deg), high_deg) for value in (base_elevations[0], base_elevations[-1]))
    if last - first < (channels - 1) * MIN_GAP_DEG:
        first, last = low_deg, high_deg
    return tuple(np.round(np.linspace(first, last, channels), _ANGLE_DIGITS).tolist())


@dataclass(frozen=True)
class ElevationCurve:
    """Elevations of n channels between two bounds, as points of a box; see the module for the definition.

    Attributes
    ----------
    start_deg
        Elevations that the search starts from, ascending, at least 2.
    low_deg, high_deg
        The bounds.
    """

    start_deg: tuple[float, ...]
    low_deg: float
    high_deg: float

    @property
    def channels(self) -> int:
        """Number of channels."""
        return len(self.start_deg)

    @property
    def pieces(self) -> int:
        """Number of linear pieces."""
        return min(MAX_PIECES, self.channels - 1)

    @property
    def ends(self) -> BoxEnds:
        """Ends of the box: two axes for the ends, one for each piece."""
        axes = 2 + self.pieces
        return [0.0] * axes, [1.0] * axes

    def elevations(self, point: FloatArray) -> tuple[float, ...]:
        """Return the ascending elevations at a point of the box, in degrees."""
        shares = np.sort(np.clip(point[:2], 0.0, 1.0))
        first, last = self.low_deg + shares * (self.high_deg - self.low_deg)
        weights = np.exp(_LOG_SHARE * (np.clip(point[2:], 0.0, 1.0) - 0.5))
        knots = first + (last - first) * np.append(0.0, np.cumsum(weights) / weights.sum())
        positions = np.interp(self._ascending(self.start_deg), self._start_knots, np.arange(self.pieces + 1))
        return self._spread(np.interp(positions, np.arange(self.pieces + 1), knots))

    @property
    def _start_knots(self) -> FloatArray:
        """The ends of the pieces at the start, in degrees, (pieces + 1,)."""
        return self._knots(self.start_deg)

    def _knots(self, elevations_deg: Sequence[float]) -> FloatArray:
        at = np.linspace(0.0, self.pieces, self.channels)
        return np.interp(np.arange(self.pieces + 1), at, self._ascending(elevations_deg))

    @staticmethod
    def _ascending(elevations_deg: Sequence[float]) -> FloatArray:
        """Return elevations of which no two are equal."""
        ascending: FloatArray = np.asarray(elevations_deg) + 1e-6 * np.arange(len(elevations_deg))
        return ascending

    def _spread(self, elevations: FloatArray) -> tuple[float, ...]:
        """Round, move neighbours apart, and keep all within the bounds."""
        unit = 10**_ANGLE_DIGITS
        gap = round(MIN_GAP_DEG * unit)
        steps = np.rint(elevations * unit).astype(np.int64)
        offsets = gap * np.arange(self.channels)
        steps = np.maximum.accumulate(steps - offsets) + offsets  # each at least a gap above the one before
        top = math.floor(self.high_deg * unit) - offsets[::-1]
        steps = np.minimum(steps, top)
        return tuple(float(step) / unit for step in steps.tolist())

    def point(self, elevations_deg: Sequence[float]) -> FloatArray:
        """Return a point of the box near to some ascending elevations, (axes,); the start is at its point."""
        span = self.high_deg - self.low_deg
        ends = [(elevations_deg[0] - self.low_deg) / span, (elevations_deg[-1] - self.low_deg) / span]
        gaps = np.diff(self._knots(elevations_deg))
        log_shares = np.log(gaps / gaps.sum())
        middle = 0.5 * (log_shares.min() + log_shares.max())  # the shares do not depend on it
        point: FloatArray = np.clip(np.append(ends, 0.5 + (log_shares - middle) / _LOG_SHARE), 0.0, 1.0)
        return point


def sensor_table(sensor: Sensor) -> dict[str, Any]:
    """Return the keys of ``[sensors.NAME]`` of a designed sensor.

    Parameters
    ----------
    sensor
        A sensor with rings.
    """
    table: dict[str, Any] = {
        "elevations_deg": list(sensor.elevations_deg), "azimuth_step_deg": sensor.azimuth_step_deg,
    }  # fmt: skip
    if sensor.azimuth_deg is not None:
        table["azimuth_deg"] = list(sensor.azimuth_deg)
    table["range_m"] = sensor.range_m
    for key in OPTICS_KEYS:
        value = getattr(sensor, key)
        if value != SensorConfig.model_fields[key].default:
            table[key] = list(value) if isinstance(value, tuple) else value
    SensorConfig.from_dict(dict(table))  # a scenario can read it
    return table
