"""Scores that are compared with detection, and their computation for all sites of a scenario.

A surrogate score is a number for a site that is meant to predict how well a detector works there. It is a
:class:`SurrogateScore`, declared as an entry point of the group ``egvs.scores`` (``name = "module:OBJECT"``), and a
function of the :class:`SiteEvidence` of a site: its empty scan, and the traffic of the TPOG. Held-out traffic, which
sites are evaluated with, is not part of the evidence. A :class:`egvs.scoring.target_scores.VehicleScore` of that group,
by which sites can also be ranked, counts with its mean over vehicles.

Steps: compute the static world, the empty scans and the traffic of the scenario, or restore them from the store. For
each voxel size compute the TPOG; for each, with and without moving occlusion as scores require, the hits of each site;
then the scores, site by site. What several scores need is computed once: per scenario (:class:`Occupancy`) or per site.

The values depend on the scenario and the program only. The seconds are CPU time of the thread that worked on the site.

Frame: the grid's own, in metres. Voxels are addressed by the flat index ``(ix * ny + iy) * nz + iz``.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.tpog import Tpog, read_tpog
from egvs.core import files, plugins
from egvs.core.errors import Diagnostic, EgvsError, InputError, MissingBackendError, RunError, choose_one
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.threads import map_ordered
from egvs.effects import registry
from egvs.effects.returns import ReturnProbability
from egvs.extensions.validation.target_points import TargetPoints, list_target_points
from egvs.kernels.hits import max_free_probability
from egvs.runs import stage_keys
from egvs.runs.run import ensure_stages
from egvs.runs.run_context import open_folder
from egvs.scenario.effects_config import MovingOcclusionParameters
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import SCORES_GROUP
from egvs.scoring import targets
from egvs.scoring.egvs import EntropyField
from egvs.scoring.target_scores import VehicleScore, load_vehicle_score
from egvs.scoring.targets import TargetRecord, VisibleTargets
from egvs.scoring.visibility import Beams, HitCounter, Hits
from egvs.sensors import voxel_crossings
from egvs.sensors.scene import Scene
from egvs.stages.base import StageContext
from egvs.stages.site_scans import SiteScan, empty_scans
from egvs.studies.measurement import scenario_dependencies

ParameterValue = float | int | bool | str
"""Value of a score's parameter."""

EVIDENCE = ("hit_counts", "log_reach", "returns", "vehicles", "vehicle_points")
"""What a score may list in ``needs``: the parts of :class:`SiteEvidence` that take time."""

VOXEL_PARAMETER, OCCLUSION_PARAMETER, GAMMA_PARAMETER = "voxel_m", "moving_occlusion", "gamma"
"""Parameters that are settings of the scenario: the scenario's own value of voxel_m and gamma is tried too."""

_EVIDENCE_PARAMETERS = (VOXEL_PARAMETER, OCCLUSION_PARAMETER)
"""Parameters that change the evidence and are not passed to the function of a score."""


@dataclass(frozen=True)
class SurrogateScore:
    """A score that is compared with detection.

    Attributes
    ----------
    name
        Name of its entry point.
    formula
        What it computes, in words.
    source
        Where it is published.
    sign
        1 if more is supposed to be better, -1 if less is.
    function
        Returns the score of a site as a float, from its evidence and the parameters of ``sweep`` by name; NaN where the
        score is undefined. The same evidence always gives the same value.
    needs
        The parts of the evidence that it uses, of :data:`EVIDENCE`. They are computed, and timed, before it is called.
    sweep
        Values to try, by parameter, in all combinations. ``voxel_m`` and ``moving_occlusion`` are settings of the
        evidence and are not passed to ``function``; where one is missing, the scenario's value applies.
    """

    name: str
    formula: str
    source: str
    sign: int
    function: Callable[..., float]
    needs: tuple[str, ...] = ()
    sweep: Mapping[str, tuple[ParameterValue, ...]] = field(default_factory=dict)


# ---- evidence


@dataclass(frozen=True, eq=False)
class Occupancy:
    """A TPOG and the quantities that scores derive from it.

    Attributes
    ----------
    tpog
        Grid, frames and counts.
    """

    tpog: Tpog

    @cached_property
    def field(self) -> EntropyField:
        """Entropies in bits, as in the published score."""
        return EntropyField.of(self.tpog.counts, self.tpog.frames, self.tpog.grid)

    @cached_property
    def cells(self) -> IntArray:
        """Flat indices of the voxels that are occupied at some time (p > 0), (n,) int64, ascending."""
        return np.flatnonzero(self.tpog.counts.ravel() > 0)

    @cached_property
    def counts(self) -> IntArray:
        """Number of frames in which each of :attr:`cells` is occupied, (n,) int64."""
        return self.tpog.counts.ravel()[self.cells]

    @cached_property
    def p(self) -> FloatArray:
        """Share of the frames in which each of :attr:`cells` is occupied, (n,) float64."""
        return self.counts / self.tpog.frames

    @cached_property
    def log_free(self) -> FloatArray:
        """Logarithm of the probability that a voxel is free, for all voxels; minus infinity where p = 1."""
        log_free = np.zeros(self.tpog.counts.size)
        with np.errstate(divide="ignore"):
            log_free[self.cells] = np.log1p(-self.p)
        return log_free

    @cached_property
    def lowest(self) -> IntArray:
        """Return the lowest layer that is ever occupied in each column of voxels, (nx, ny) int64; -1 if none."""
        occupied = self.tpog.counts > 0
        return np.where(occupied.any(axis=2), occupied.argmax(axis=2), -1)


@dataclass(frozen=True, eq=False)
class SiteEvidence:
    """The data of one site that a score may use.

    Attributes
    ----------
    occupancy
        The TPOG.
    beams
        The empty scan: pose, sensor, ends and weights of the beams.
    returned
        Which beams met a static surface, (n,) bool.
    count_hits
        Counts the beams that cross each voxel, see :attr:`hit_counts`.
    count_points
        Counts the points on vehicles.
    detection_probability
        The probability that returns are detected; None: all are.
    """

    occupancy: Occupancy
    beams: Beams
    returned: BoolArray
    count_hits: Callable[[Beams], tuple[Hits, int]]
    count_points: Callable[[Beams], VisibleTargets]
    detection_probability: ReturnProbability | None = None

    @cached_property
    def hit_counts(self) -> tuple[Hits, int]:
        """Beams that cross each voxel of the grid, as whole multiples of a unit, and the units per beam."""
        return self.count_hits(self.beams)

    @property
    def hits(self) -> FloatArray:
        """Beams that cross each of the occupancy's ``cells``, (n,) float64."""
        hits, units_per_beam = self.hit_counts
        return hits[self.occupancy.cells] / units_per_beam

    @cached_property
    def log_reach(self) -> FloatArray:
        """Logarithm of the probability that a beam reaches each of the occupancy's ``cells``, (n,) float64.

        Voxels are taken as independent. Of several beams, the one with the highest probability counts; minus infinity
        where no beam crosses the voxel.
        """
        grid = self.occupancy.tpog.grid
        best = np.full(self.occupancy.tpog.counts.size, -np.inf)
        for chunk in voxel_crossings.list_crossings(self.beams.pose.position_m, self.beams.ends_m, grid):
            max_free_probability(chunk.first, chunk.cells, self.occupancy.log_free, best)
        return best[self.occupancy.cells]

    @cached_property
    def returns(self) -> tuple[FloatArray, FloatArray]:
        """Positions of the empty scan's returns in the grid's frame, (k, 3), and the weight of each, (k,)."""
        ends_m = self.beams.ends_m[self.returned]
        weight = np.ones(len(ends_m)) if self.beams.weight is None else self.beams.weight[self.returned]
        sensor_m = self.occupancy.tpog.grid.to_grid_m(np.asarray(self.beams.pose.position_m))
        if self.detection_probability is not None:
            weight = weight * self.detection_probability(np.sqrt((ends_m**2).sum(axis=1)))
        return sensor_m + ends_m, weight

    @cached_property
    def vehicles(self) -> VisibleTargets:
        """Points on the vehicles of the traffic that the TPOG was computed from."""
        return self.count_points(self.beams)

    @cached_property
    def vehicle_points(self) -> TargetPoints:
        """Positions of the points on the same vehicles, and the probability of each."""
        return list_target_points(self.vehicles.record, self.beams, self.detection_probability)


# ---- installed scores

_BUILTIN_SCORES = (
    "egvs", "entropy_seen", "coverage", "expected_visibility", "s_mig", "m_sog", "kl_obs", "density", "uniformity",
    "nuc", "perception_entropy", "vehicle_grid_occupancy", "points_on_target", "seen_well", "expected_detections",
    "noticed",
)  # fmt: skip
"""The scores of this program, in the order of tables."""


@dataclass(frozen=True)
class ScoreEntry:
    """An installed score.

    Attributes
    ----------
    name
        Name of its entry point.
    score
        The score; None if it cannot be loaded.
    package
        The package that provides it; empty for this program.
    problem
        Why it cannot be loaded.
    """

    name: str
    score: SurrogateScore | None
    package: str = ""
    problem: str = ""


def score_names() -> list[str]:
    """Return the names of all installed scores, those of this program first."""
    installed = plugins.plugin_names(SCORES_GROUP)
    builtin = [name for name in _BUILTIN_SCORES if name in installed]
    return builtin + [name for name in installed if name not in _BUILTIN_SCORES]


def load_score(name: str, location: str = "--score") -> SurrogateScore:
    """Return an installed score.

    Parameters
    ----------
    location
        Option or key that names the score, for messages.

    Raises
    ------
    InputError
        If there is no such score.
    MissingBackendError
        If it cannot be imported, or is not a valid score.
    """
    if name not in score_names():
        raise InputError(location, f"unknown score {name!r}", choose_one(name, score_names()))
    loaded = plugins.load_plugin(SCORES_GROUP, name)
    if isinstance(loaded, VehicleScore):
        return _surrogate_of_vehicles(load_vehicle_score(name))
    if problem := _invalid_score_reason(name, loaded):
        raise plugins.plugin_error(SCORES_GROUP, name, problem)
    score: SurrogateScore = loaded
    return score


def _surrogate_of_vehicles(score: VehicleScore) -> SurrogateScore:
    """Return a score of vehicles as a score of sites."""

    def site_score(evidence: SiteEvidence) -> float:
        return targets.weighted_mean(score(evidence.vehicles))

    return SurrogateScore(score.name, score.formula, score.source, 1, site_score, needs=("vehicles",))


def _invalid_score_reason(name: str, loaded: object) -> str:
    """Return why an object is not a valid score, or an empty text."""
    if not isinstance(loaded, SurrogateScore):
        return f"expected a {SurrogateScore.__module__}.{SurrogateScore.__name__}, got a {type(loaded).__name__}"
    if loaded.name != name:
        return f"expected the name {name!r} of its entry point, got {loaded.name!r}"
    if loaded.sign not in (1, -1):
        return f"expected the sign 1 (more is better) or -1, got {loaded.sign!r}"
    for need in loaded.needs:
        if need not in EVIDENCE:
            return f"expected needs of {', '.join(EVIDENCE)}, got {need!r}"
    for parameter, values in loaded.sweep.items():
        if not values:
            return f"expected at least one value of {parameter} in its sweep, got none"
    return ""


def score_catalogue() -> list[ScoreEntry]:
    """Return all installed scores. One that cannot be loaded is listed with its problem; others are not affected."""
    return [_score_entry(name) for name in score_names()]


def _score_entry(name: str) -> ScoreEntry:
    package = plugins.plugin_package(SCORES_GROUP, name)
    try:
        score = load_score(name)
    except MissingBackendError as error:
        return ScoreEntry(name, None, package, str(error))
    if package == plugins.PACKAGE_NAME:
        package = ""
    return ScoreEntry(name, score, package)


# ---- table of results

_TRAJECTORIES_FILE = "trajectories.parquet"


@dataclass(frozen=True)
class SurrogateRow:
    """One score of one site.

    Attributes
    ----------
    site, score
        Names.
    parameters
        Parameters of the score, by name.
    sign
        1 if more is supposed to be better, -1 if less is.
    value
        NaN where the score is undefined.
    seconds
        CPU time of the evidence that the score needs, and of the score itself.
    """

    site: str
    score: str
    parameters: Mapping[str, ParameterValue]
    sign: int
    value: float
    seconds: float

    @property
    def parameters_json(self) -> str:
        """The parameters as canonical JSON; infinity, which JSON lacks, as "inf"."""
        values = {name: "inf" if value == math.inf else value for name, value in self.parameters.items()}
        return files.canonical_json(values).decode()


@dataclass(frozen=True)
class Surrogates:
    """All scores of all sites.

    Attributes
    ----------
    rows
        By site, in the order of the sites, and by score, in the order of :func:`score_names`.
    skipped
        Scores and settings that could not be computed, with the reason.
    inputs
        Hash of everything that the values depend on.
    """

    rows: tuple[SurrogateRow, ...]
    skipped: tuple[Diagnostic, ...]
    inputs: str

    def costs_ms(self) -> dict[str, dict[str, float]]:
        """Return the median milliseconds per site, by score and parameters (JSON). They vary from run to run."""
        seconds: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
        for row in self.rows:
            seconds[row.score][row.parameters_json].append(row.seconds)
        costs: dict[str, dict[str, float]] = {}
        for score, by_parameters in seconds.items():
            costs[score] = {parameters: round(1e3 * median(times), 3) for parameters, times in by_parameters.items()}
        return costs

    def write(self, path: Path, scenario: Scenario) -> None:
        """Write ``surrogates.parquet``. It does not contain the seconds, so equal values give equal bytes."""
        names = ("site", "score", "sign", "value")
        columns: dict[str, Any] = {name: [getattr(row, name) for row in self.rows] for name in names}
        columns["parameters"] = [row.parameters_json for row in self.rows]
        metadata = {
            "schema": parquet.SCHEMA_VERSION,
            "scenario": {"name": scenario.name, "hash": files.hash_json(scenario.model_dump(mode="json"))},
            "inputs": self.inputs,
            "seed": scenario.seed,
        }
        parquet.write_artefact(path, "surrogates", columns, metadata)


# ---- computation


def compute_surrogates(
    scenario: Scenario,
    folder: Path,
    names: Sequence[str] | None = None,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
) -> Surrogates:
    """Compute the scores of all sites.

    Parameters
    ----------
    folder
        Folder for artefacts of the scenario; it is created if needed, and the artefacts stay there.
    names
        Names of the scores; by default all that are installed and can be loaded.
    jobs
        Number of threads; one per core when None. The values do not depend on it.

    Raises
    ------
    InputError
        If a stage refuses the scenario, or a score is unknown.
    MissingBackendError
        If a score of ``names`` cannot be loaded.
    RunError
        If a score does not return a number.
    """
    scores, broken = _selected_scores(names)
    tasks, unfit = _score_tasks(scenario, scores)
    prepared = _PreparedScenario(scenario, folder, jobs, progress)

    by_setting: dict[_EvidenceSetting, list[_ScoreTask]] = defaultdict(list)
    for task in tasks:
        by_setting[task.setting].append(task)
    rows: dict[str, list[_NumberedRow]] = {site.name: [] for site in prepared.scene.sites}
    done, total = 0, len(by_setting) * len(rows)
    for setting in sorted(by_setting):
        for site_rows in prepared.score_sites(setting, by_setting[setting]):
            rows[site_rows[0].row.site] += site_rows
            done += 1
            progress("scores", done, total)

    ordered: list[SurrogateRow] = []
    for site_rows in rows.values():
        ordered += [numbered.row for numbered in sorted(site_rows, key=lambda numbered: numbered.number)]
    key = surrogates_key(scenario, [score.name for score in scores])
    return Surrogates(tuple(ordered), (*broken, *unfit), key)


def surrogates_key(scenario: Scenario, names: Sequence[str] | None = None) -> str:
    """Return a hash of everything that the scores depend on: settings, files, this program, packages of scores."""
    scores = _selected_scores(names)[0]
    sweeps = {}
    for score in scores:
        sweeps[score.name] = {key: [repr(value) for value in values] for key, values in score.sweep.items()}
    modules = sorted({plugins.plugin_module(SCORES_GROUP, score.name) for score in scores})
    source = stage_keys.source_digest(__name__, *modules)
    program = {"source": source.digest, "libraries": stage_keys.library_versions(source.libraries)}
    return files.hash_json({"scenario": scenario_dependencies(scenario), "scores": sweeps, "program": program})


def _selected_scores(names: Sequence[str] | None) -> tuple[list[SurrogateScore], list[Diagnostic]]:
    """Return the scores of these names; for None all that can be loaded, with a warning about each of the others."""
    if names is not None:
        return [load_score(name) for name in names], []
    scores, broken = [], []
    for entry in score_catalogue():
        if entry.score is None:
            broken.append(Diagnostic("scores.broken", f"score {entry.name} is skipped", entry.problem, ""))
        else:
            scores.append(entry.score)
    return scores, broken


class _EvidenceSetting(NamedTuple):
    """The settings that the evidence of a score is computed with."""

    voxel_m: float
    occlusion: bool


class _ScoreTask(NamedTuple):
    """A score with one combination of its parameters; tasks are numbered in the order of the results."""

    number: int
    score: SurrogateScore
    parameters: Mapping[str, ParameterValue]
    setting: _EvidenceSetting


class _NumberedRow(NamedTuple):
    """A result and the number of its task."""

    number: int
    row: SurrogateRow


def _score_tasks(scenario: Scenario, scores: Sequence[SurrogateScore]) -> tuple[list[_ScoreTask], list[Diagnostic]]:
    """Return all combinations of scores and parameters, without voxel sizes that do not fit the region of interest."""
    scenario_values: dict[str, ParameterValue] = {
        VOXEL_PARAMETER: scenario.roi.voxel_m,
        GAMMA_PARAMETER: scenario.gamma,
    }
    has_occlusion = "moving_occlusion" in scenario.effects.named

    tasks: list[_ScoreTask] = []
    unfit: dict[float, Diagnostic] = {}
    for score in scores:
        sweep: dict[str, Sequence[ParameterValue]] = dict(score.sweep)
        for name, values in score.sweep.items():
            if name in scenario_values:
                sweep[name] = sorted({*values, scenario_values[name]})
        for combination in itertools.product(*sweep.values()):
            parameters = dict(zip(sweep, combination, strict=True))
            voxel_m = float(parameters.get(VOXEL_PARAMETER, scenario.roi.voxel_m))
            occlusion = bool(parameters.get(OCCLUSION_PARAMETER, has_occlusion))
            try:
                _with_voxels(scenario, voxel_m).roi.grid  # noqa: B018 - raises if the voxels do not fit
            except InputError as error:
                where = f"{scenario.file}: scores with voxels of {voxel_m:g} m are skipped"
                unfit[voxel_m] = Diagnostic("scores.voxels", where, error.problem, "")
                continue
            tasks.append(_ScoreTask(len(tasks), score, parameters, _EvidenceSetting(voxel_m, occlusion)))
    return tasks, list(unfit.values())


def _with_voxels(scenario: Scenario, voxel_m: float) -> Scenario:
    if voxel_m == scenario.roi.voxel_m:
        return scenario
    return scenario.model_copy(update={"roi": scenario.roi.model_copy(update={"voxel_m": voxel_m})})


class _PreparedScenario:
    """A scenario whose empty scans and traffic lie in a folder."""

    def __init__(self, scenario: Scenario, folder: Path, jobs: int | None, progress: ProgressCallback) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        scan_config = scenario.scan.model_copy(update={"keep": True})
        self._scenario = scenario.model_copy(update={"scan": scan_config})
        self._folder = folder
        self._jobs = jobs
        self._progress = progress
        self._visible_targets: dict[str, VisibleTargets] = {}
        self._record: TargetRecord | None = None
        context = self._context(self._scenario)
        ensure_stages(context, "statics", "scan", "traffic")
        self.scene = context.scene

    def _context(self, scenario: Scenario) -> StageContext:
        return open_folder(scenario, self._folder, jobs=self._jobs, progress=self._progress)

    def score_sites(self, setting: _EvidenceSetting, tasks: Sequence[_ScoreTask]) -> Iterator[list[_NumberedRow]]:
        """Yield the results of one site after another."""
        context = self._context(_with_voxels(self._scenario, setting.voxel_m))
        ensure_stages(context, "tpog")
        tpog = read_tpog(context.path("tpog.parquet"))
        trajectories = context.path(_TRAJECTORIES_FILE)
        scene = _set_occlusion(self.scene, setting.occlusion)
        occupancy = Occupancy(tpog)
        hit_counter = HitCounter(scene, tpog, trajectories)
        _ = occupancy.field.total_bit, occupancy.p, occupancy.log_free, occupancy.lowest  # before there are threads
        if self._record is None and any("vehicles" in task.score.needs for task in tasks):
            self._record = TargetRecord.read(trajectories, tpog.grid)

        def score_site(scan_and_returned: tuple[SiteScan, BoolArray]) -> list[_NumberedRow]:
            scan, returned = scan_and_returned
            site = scan.site.name
            probability = ReturnProbability.of(scene, scan.beams.sensor)

            def count_hits(beams: Beams) -> tuple[Hits, int]:
                return hit_counter.borrowed_hits(beams).copy(), hit_counter.unit

            def count_points(beams: Beams) -> VisibleTargets:
                if site not in self._visible_targets:
                    record = self._record
                    if record is None:
                        record = TargetRecord.read(trajectories, tpog.grid)
                    self._visible_targets[site] = targets.visible_targets(record, beams, probability)
                return self._visible_targets[site]

            evidence = SiteEvidence(occupancy, scan.beams, returned, count_hits, count_points, probability)
            return _score_site(site, evidence, tasks)

        scans = zip(empty_scans(context), _returned_beams(context), strict=True)
        yield from map_ordered(score_site, scans, context.threads)


def _set_occlusion(scene: Scene, is_enabled: bool) -> Scene:
    """Return the scene with moving occlusion (as configured, else with default parameters) or without."""
    other_effects = tuple(effect for effect in scene.effects if effect.NAME != "moving_occlusion")
    if not is_enabled:
        return replace(scene, effects=other_effects)
    if len(other_effects) < len(scene.effects):
        return scene
    if scene.scenario.traffic.periods:  # a replay would give all periods the same weight
        parameters = MovingOcclusionParameters(method="independent")
    else:
        parameters = MovingOcclusionParameters()
    return replace(scene, effects=(*other_effects, registry.make_effect("moving_occlusion", parameters)))


def _returned_beams(context: StageContext) -> Iterator[BoolArray]:
    """Yield which beams of each site met something, in the order of the sites."""
    path = context.folder.scans
    with parquet.open_artefact(path, "scans") as (file, _):
        for group in range(file.num_row_groups):
            yield parquet.read_row_group(file, group, path, ["returned"]).column("returned").to_numpy()


def _score_site(site: str, evidence: SiteEvidence, tasks: Sequence[_ScoreTask]) -> list[_NumberedRow]:
    """Compute the scores of one site. The time of each part of the evidence counts for every score that needs it."""
    evidence_s: dict[str, float] = {}
    rows = []
    for task in tasks:
        score = task.score
        for need in score.needs:
            if need not in evidence_s:
                start = time.thread_time()
                getattr(evidence, need)
                evidence_s[need] = time.thread_time() - start

        arguments = {name: value for name, value in task.parameters.items() if name not in _EVIDENCE_PARAMETERS}
        start = time.thread_time()
        try:
            value = score.function(evidence, **arguments)
        except EgvsError:
            raise
        except Exception as error:  # a foreign function may do anything
            raise RunError(f"score {score.name}: site {site}: its function raised {error!r}") from error
        seconds = time.thread_time() - start + sum(evidence_s[need] for need in score.needs)
        if not isinstance(value, float | int):
            raise RunError(f"score {score.name}: site {site}: expected a number, or NaN if undefined, got {value!r}")
        row = SurrogateRow(site, score.name, task.parameters, score.sign, float(value), seconds)
        rows.append(_NumberedRow(task.number, row))
    return rows
