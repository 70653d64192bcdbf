"""What a worker of a city run does: jobs, tasks, cached scenes, and the scores of some sites (``part.npz``).

Tasks exchange paths, names and numbers, never meshes or grids. Each task may run anywhere and any number of times, and
gives the same bytes.

While the traffic is simulated, the scene of each junction is checked and scanned (:func:`prepare_scene`). Then a small
junction is run completely, several of them in one task (:func:`run_junctions`). A large junction takes three kinds of
tasks: :func:`prepare_junction` makes the artefacts that sites are scored from, :func:`score_part` scores some of its
sites, and :func:`finish_junction` completes its run. Results pass from one task to the next through the store; what is
missing there is computed again. Each task first releases the memory of the previous one, so that a worker needs hardly
more memory for many sites than for a few.

``part.npz`` has one array for each dtype, and a JSON text with the objects of all sites, which refer to these arrays.
So a part is read back to the last bit, and no code in it is run.
"""

from __future__ import annotations

import json
import threading
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property, wraps
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.run_folder import STAGE_NAMES, RunFolder
from egvs.core import files, reading
from egvs.core.errors import EgvsError, InputError, RunError
from egvs.core.resource_usage import ResourceUsage, measure_usage, release_memory
from egvs.extensions.city.worker_check import library_names, program_versions
from egvs.runs import run, stage_keys, stage_registry, store
from egvs.runs.run import StageOptions
from egvs.runs.run_context import open_folder
from egvs.runs.stage_registry import StageResult
from egvs.runs.store import Store
from egvs.scenario.loading import load
from egvs.scenario.model import Scenario
from egvs.scoring.blindspots import SpotVisibility
from egvs.scoring.scorer import SiteScore
from egvs.scoring.target_scores import SiteTargetScores
from egvs.sensors import sensor, sites
from egvs.sensors.sites import Pose, ScannedSite
from egvs.stages import check, site_scans
from egvs.stages.base import StageContext
from egvs.stages.check import SceneReport
from egvs.stages.site_scoring import BeamAudit, ScoredSite, SiteScoring

P = ParamSpec("P")
T = TypeVar("T")

PART_FILE, PART_KIND = "part.npz", "part"
"""Name of the file with the scores of some sites, and of its kind in the store."""

SCENE_FILE, SCENE_KIND = "scene.json", "scene"
"""Name of the file with the check of a scene, and of its kind in the store."""

SCENE_CHECK, EARLY_SCANS, SCORED_PARTS = "check of the scene", "scans for the score", "score, in parts"
"""Work that is in the costs of no stage: before the traffic is known, and in the tasks of a large junction."""

BYTES_PER_BEAM = 24
"""Largest size of a scan in the store: three numbers per beam, for the beams that can meet the region."""

MAX_CACHED_SCENES = 2
"""Number of scenes that a worker keeps in memory; a large one takes some hundred MB."""

STAGES_BEFORE_SCORE = ("statics", "scan", "traffic", "tpog")
"""The stages whose artefacts sites are scored from."""

SITE_BEAMS = 2**14
"""Work per site that does not depend on its beams, in beams: mainly the sum over all voxels."""

_PART_CLASSES = (ScoredSite, ScannedSite, Pose, SiteScore, SiteTargetScores, SpotVisibility, BeamAudit)
"""Classes that occur in a part."""

_DTYPES = ("float64", "int64", "int32")
_METADATA = "metadata"

_LOCK_WAIT_S = 60.0
"""A worker that was killed, or was thought to be, may still use the folder of a junction for a moment."""


@dataclass(frozen=True)
class RunSettings:
    """Settings of all tasks of one city run.

    Attributes
    ----------
    token
        Unique to the run: scenes that workers cache belong to one run.
    program
        The program that started the run, see :func:`program_id`.
    store
        The store as in ``EGVS_STORE``: an absolute path, or a URL.
    store_bytes
        Maximum size of the store.
    scan_bytes
        Maximum size of the scans of a junction that is scanned before its traffic is known, where its runs keep none.
    """

    token: str
    program: str
    store: str
    store_bytes: float
    scan_bytes: float = 0.0

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Use the store within the block; raise a RunError if this worker runs another version of the program."""
        if self.program != program_id():
            raise RunError(
                f"this worker runs a different version of egvs ({program_id()}, expected {self.program}). "
                "Install the same version on every machine."
            )
        with store.use_store(self.store, self.store_bytes):
            yield


@dataclass(frozen=True)
class Job:
    """One junction: the folder of its scenario, the folder of its run (absolute paths), and overrides of its keys."""

    junction: str
    folder: Path
    out: Path
    overrides: tuple[str, ...] = ()

    def scenario(self) -> Scenario:
        """Load the scenario; raise an InputError if it is wrong."""
        return load(self.folder, self.overrides)


@dataclass(frozen=True)
class JobResult:
    """A junction whose run is complete.

    Attributes
    ----------
    junction, sites
        Its name, and its number of sites.
    seconds
        Duration of the task.
    stages_run
        The stages that the task ran.
    part_costs
        Costs of scoring its sites in other tasks, as far as this task used them.
    """

    junction: str
    sites: int
    seconds: float
    stages_run: tuple[str, ...]
    part_costs: tuple[ResourceUsage, ...] = ()


@dataclass(frozen=True)
class SceneResult:
    """A junction whose scene is prepared, and the costs that are in the record of no stage, by the work done."""

    junction: str
    costs: Mapping[str, ResourceUsage]


@dataclass(frozen=True)
class JobFailure:
    """A junction whose run failed: the message and the exit code of the error."""

    junction: str
    message: str
    exit_code: int


class Part(NamedTuple):
    """One of ``total`` parts of the sites of a junction; the first part is number 0."""

    number: int
    total: int


def program_id() -> str:
    """Return a text that is equal for programs that give the same bytes: version, source and libraries."""
    versions = program_versions(library_names())
    return f"{versions.pop('egvs')}, {', '.join(' '.join(pair) for pair in versions.items())}"


def catch_input_errors(task: Callable[P, T]) -> Callable[P, T | JobFailure]:
    """Make a task, whose first argument is a :class:`Job`, return a :class:`JobFailure` instead of raising an error.

    Only an :class:`EgvsError` is caught: another attempt would fail in the same way.
    """

    @wraps(task)
    def task_or_failure(*args: P.args, **kwargs: P.kwargs) -> T | JobFailure:
        try:
            return task(*args, **kwargs)
        except EgvsError as error:
            job = args[0]
            assert isinstance(job, Job)
            return JobFailure(job.junction, str(error), error.exit_code)

    return task_or_failure


class CachedScene:
    """The artefacts of a junction that its sites are scored from, in a temporary folder, and what was built of them."""

    def __init__(self, job: Job, folder: Path) -> None:
        self._lock = threading.Lock()
        self.context = open_folder(job.scenario(), folder, jobs=1)
        self.users = 0

    def ensure_artefacts(self) -> None:
        """Fetch the artefacts from the store, or make them."""
        with self._lock:
            run.ensure_stages(self.context, *STAGES_BEFORE_SCORE)

    def scoring(self) -> SiteScoring:
        """Return the object that scores the sites."""
        with self._lock:
            return self._scoring

    @cached_property
    def _scoring(self) -> SiteScoring:
        run.ensure_stages(self.context, *STAGES_BEFORE_SCORE)
        return SiteScoring(self.context)

    @cached_property
    def score_key(self) -> str:
        """Key of the score stage."""
        return stage_keys.stage_key("score", self.context).key


class SceneCache:
    """The scenes of one process, shared by its threads; the least recently used ones are dropped.

    Parameters
    ----------
    max_scenes
        Number of scenes that are kept. Scenes in use are kept in any case.
    """

    def __init__(self, max_scenes: int = MAX_CACHED_SCENES) -> None:
        self._max_scenes, self._lock = max_scenes, threading.Lock()
        self._scenes: OrderedDict[tuple[str, Job], tuple[CachedScene, ExitStack]] = OrderedDict()

    @contextmanager
    def borrow(self, token: str, job: Job) -> Iterator[CachedScene]:
        """Use the scene of a junction within the block; its folder exists at least as long."""
        with self._lock:
            scene = self._get((token, job))
            scene.users += 1
        try:
            yield scene
        finally:
            with self._lock:
                scene.users -= 1
                self._drop_oldest()

    def drop(self, token: str, job: Job) -> None:
        """Drop the scene of a junction, unless it is in use."""
        with self._lock:
            scene, stack = self._scenes.get((token, job), (None, None))
            if scene is not None and stack is not None and not scene.users:
                del self._scenes[token, job]
                stack.close()

    def _get(self, key: tuple[str, Job]) -> CachedScene:
        if key not in self._scenes:
            stack = ExitStack()
            self._scenes[key] = CachedScene(key[1], stack.enter_context(files.temporary_folder())), stack
        self._scenes.move_to_end(key)
        return self._scenes[key][0]

    def _drop_oldest(self) -> None:
        idle = [key for key, (scene, _) in self._scenes.items() if not scene.users]
        for key in idle[: max(0, len(self._scenes) - self._max_scenes)]:
            _, stack = self._scenes.pop(key)
            stack.close()


SCENE_CACHE = SceneCache()


def write_part(path: Path, scored_sites: Iterable[ScoredSite]) -> None:
    """Write the scores of some sites; only one site at a time is in memory as an object."""
    encoder = _PartEncoder()
    metadata = [encoder.encode(site) for site in scored_sites]
    with files.atomic_write(path) as partial, partial.open("wb") as file:
        text = np.frombuffer(json.dumps(metadata).encode("utf-8"), dtype=np.uint8)
        np.savez(file, allow_pickle=False, **{_METADATA: text}, **encoder.arrays())


def read_part(path: Path) -> Iterator[ScoredSite]:
    """Yield the sites of a part, in order; raise an InputError if the file is damaged."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            metadata = json.loads(stored[_METADATA].tobytes())
            arrays = {dtype: stored[dtype] for dtype in _DTYPES}
        for value in metadata:
            yield _decode(value, arrays)
    except (OSError, EOFError, ValueError, LookupError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(path, f"cannot be read as partial scores ({error})", "Remove it, and run again.") from None


class _PartEncoder:
    """Turns sites into JSON, and collects their arrays in one array for each dtype.

    JSON lists are tuples. JSON objects are ``{"class": name, "fields": {...}}``, ``{"mapping": {...}}``, or
    ``{"array": [dtype, start, length]}``.
    """

    def __init__(self) -> None:
        self._bytes = {dtype: bytearray() for dtype in _DTYPES}

    def arrays(self) -> dict[str, NDArray[Any]]:
        return {dtype: np.frombuffer(data, dtype=dtype) for dtype, data in self._bytes.items()}

    def encode(self, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            dtype = str(value.dtype)
            start = len(self._bytes[dtype]) // value.itemsize
            self._bytes[dtype] += value.tobytes()
            return {"array": [dtype, start, len(value)]}
        if isinstance(value, _PART_CLASSES):
            encoded = {field.name: self.encode(getattr(value, field.name)) for field in fields(value)}
            return {"class": type(value).__name__, "fields": encoded}
        if isinstance(value, Mapping):
            return {"mapping": {key: self.encode(item) for key, item in value.items()}}
        if isinstance(value, tuple):
            return [self.encode(item) for item in value]
        return value


def _decode(value: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """Invert :meth:`_PartEncoder.encode`."""
    if isinstance(value, list):
        return tuple(_decode(item, arrays) for item in value)
    if not isinstance(value, dict):
        return value
    if "array" in value:
        dtype, start, length = value["array"]
        array = arrays[dtype][start : start + length]
        if len(array) != length:
            raise ValueError("numbers are missing")
        return array.copy()  # a view would keep the arrays of all sites in memory
    if "class" in value:
        decoded = {name: _decode(item, arrays) for name, item in value["fields"].items()}
        return {cls.__name__: cls for cls in _PART_CLASSES}[value["class"]](**decoded)
    return {key: _decode(item, arrays) for key, item in value["mapping"].items()}


def split_sites(count: int, parts: int) -> list[slice]:
    """Split ``count`` sites into parts whose sizes differ by at most one."""
    ends = [count * number // parts for number in range(parts + 1)]
    return [slice(low, high) for low, high in pairwise(ends)]


def read_stored_scores(parts: int, costs: list[ResourceUsage]) -> Callable[[SiteScoring], Iterator[ScoredSite]]:
    """Return a function that yields all sites of a junction for the score stage, from its parts in the store.

    Parts that the store has lost are scored again. The costs of all parts are added to ``costs``.
    """

    def scored_sites(scoring: SiteScoring) -> Iterator[ScoredSite]:
        score_key = stage_keys.stage_key("score", scoring.context).key
        for part in split_sites(len(scoring.names), parts):
            names = scoring.names[part]
            if names:
                with files.temporary_folder() as folder:
                    costs.append(_fetch_or_score(scoring, score_key, names, folder))
                    yield from read_part(folder / PART_FILE)

    return scored_sites


def score_stored_scans(scoring: SiteScoring, only: Collection[str] | None = None) -> Iterator[ScoredSite]:
    """Yield the scored sites as :meth:`SiteScoring.all_sites`, from scans in the store if it has them."""
    if scoring.context.scenario.scan.keep:
        yield from scoring.all_sites(only)
        return
    with files.temporary_folder() as folder:
        key = stage_keys.stage_key("scan", _keeping_scans(scoring.context)).key
        if Store.default().take("scan", key, folder, link=True) is None:
            yield from scoring.all_sites(only)
        else:
            scans = site_scans.read_scans(scoring.context, folder / RunFolder.scans.name, only)
            yield from map(scoring.score, scans)


def _keeping_scans(context: StageContext) -> StageContext:
    """Return a context of the same scene in which scans are kept."""
    scan = context.scenario.scan.model_copy(update={"keep": True})
    return context.with_scenario(context.scenario.model_copy(update={"scan": scan}))


def _fetch_or_score(scoring: SiteScoring, score_key: str, names: tuple[str, ...], folder: Path) -> ResourceUsage:
    """Fetch the scores of some sites from the store into a folder, or compute and store them; return their cost."""
    part_store, path = Store.default(), folder / PART_FILE
    program = stage_keys.source_digest(__name__).digest
    key = files.hash_json({"score": score_key, "sites": names, "program": program})
    entry = part_store.take(PART_KIND, key, folder)
    if entry is not None:
        return entry.made.cost
    with part_store.maker(PART_KIND, key):
        part_store.fetch(PART_KIND, key)
        entry = part_store.take(PART_KIND, key, folder)
        if entry is not None:  # another worker has stored it meanwhile
            return entry.made.cost
        with measure_usage() as cost:
            write_part(path, score_stored_scans(scoring, names))
        scoring.context.inputs.digests.check_unchanged()
        result = StageResult({PART_FILE: files.hash_file(path)}, {}, {}, cost)
        part_store.put(PART_KIND, key, folder, result)
    return cost


@catch_input_errors
def estimate_beams(job: Job, settings: RunSettings) -> int:
    """Return the work of a junction's candidates: their beams, and :data:`SITE_BEAMS` for each."""
    with settings.applied():
        return sum(n_beams + SITE_BEAMS for n_beams in _beams_of_sites(job.scenario()))


def _beams_of_sites(scenario: Scenario) -> list[int]:
    """Return the number of beams of each candidate site."""
    candidates = sites.candidate_sites(scenario)
    beams = {}
    for name in {site.sensor for site in candidates}:
        beams[name] = sensor.scenario_sensor(name, scenario, "sites").beams
    return [beams[site.sensor] for site in candidates]


@catch_input_errors
def prepare_scene(job: Job, settings: RunSettings) -> SceneResult:
    """Put the results that need no traffic into the store: the check of the scene, the static world, and the scans.

    An error is not reported here: the run of the junction finds it again, together with those in its traffic.
    """
    release_memory()
    costs: dict[str, ResourceUsage] = {}
    with settings.applied(), files.temporary_folder() as folder:
        context = open_folder(job.scenario(), folder, jobs=1)
        with measure_usage() as costs[SCENE_CHECK]:
            is_checked = _store_scene_report(context)
        if not is_checked:
            return SceneResult(job.junction, costs)
        run.ensure_stages(context, *stages_without_traffic())
        scan_bytes = BYTES_PER_BEAM * sum(_beams_of_sites(context.scenario))
        if not context.scenario.scan.keep and scan_bytes <= settings.scan_bytes:
            with measure_usage() as costs[EARLY_SCANS]:
                run.ensure_stages(_keeping_scans(context), "scan")
    return SceneResult(job.junction, costs)


def _store_scene_report(context: StageContext) -> bool:
    """Check a scene and store the report; return whether the scene has no errors."""
    scene_store, key = Store.default(), _scene_key(context)
    with scene_store.maker(SCENE_KIND, key):
        scene_store.fetch(SCENE_KIND, key)
        if _take_scene_report(scene_store, key) is not None:
            return True
        with measure_usage() as cost:
            report = check.check_scene(context.inputs)
        if report is None:
            return False
        path = context.folder / SCENE_FILE
        files.write_text(path, files.to_json_text(report.to_json()))
        result = StageResult({SCENE_FILE: files.hash_file(path)}, {}, {}, cost)
        scene_store.put(SCENE_KIND, key, context.folder.path, result)
    return True


def stored_scene_report(context: StageContext) -> SceneReport | None:
    """Return the check of a scene from the store; None if it is not there."""
    scene_store, key = Store.default(), _scene_key(context)
    with scene_store.maker(SCENE_KIND, key):  # another worker may be checking it
        scene_store.fetch(SCENE_KIND, key)
    return _take_scene_report(scene_store, key)


def _take_scene_report(scene_store: Store, key: str) -> SceneReport | None:
    with files.temporary_folder() as folder:
        if scene_store.take(SCENE_KIND, key, folder) is None:
            return None
        return SceneReport.from_json(reading.read_json(folder / SCENE_FILE))


def _scene_key(context: StageContext) -> str:
    dependencies = check.scene_dependencies(context)
    return files.hash_json(
        {
            "inputs": dependencies.to_json(),
            "program": stage_keys.program_inputs("check", context.scenario, dependencies.modules),
            "folder": str(context.scenario.folder),  # warnings contain paths
        }
    )


_STORED_RESULTS: dict[str, dict[str, Any]] = {
    "check": {"scene_report": stored_scene_report},
    "score": {"scored_elsewhere": score_stored_scans},
}
"""Options of stages whose work may be in the store, see :func:`prepare_scene`."""


def run_junctions(jobs: Sequence[Job], settings: RunSettings) -> list[JobResult | JobFailure]:
    """Run some junctions completely."""
    return [_run_junction(job, settings, _STORED_RESULTS) for job in jobs]


@catch_input_errors
def prepare_junction(job: Job, settings: RunSettings) -> None:
    """Put the artefacts that the sites of a junction are scored from into the store."""
    with settings.applied(), SCENE_CACHE.borrow(settings.token, job) as scene:
        scene.ensure_artefacts()


@catch_input_errors
def score_part(job: Job, settings: RunSettings, part: Part, prepared: JobFailure | None) -> int | JobFailure:
    """Score a part of a junction's sites, unless the store has the scores.

    Parameters
    ----------
    job, settings
        The junction, and the settings of the city run.
    part
        Which sites.
    prepared
        Result of :func:`prepare_junction`; a failure is passed on.

    Returns
    -------
    int or JobFailure
        Number of sites.
    """
    if prepared is not None:
        return prepared
    release_memory()
    with settings.applied(), SCENE_CACHE.borrow(settings.token, job) as scene:
        scoring = scene.scoring()
        names = scoring.names[split_sites(len(scoring.names), part.total)[part.number]]
        if names:
            with files.temporary_folder() as folder:
                _fetch_or_score(scoring, scene.score_key, names, folder)
        return len(names)


def finish_junction(
    job: Job, settings: RunSettings, scored: Sequence[int | JobFailure]
) -> Sequence[JobResult | JobFailure]:
    """Complete the run of a junction whose sites were scored in parts; ``scored`` are the results of the parts."""
    for result in scored:
        if isinstance(result, JobFailure):
            return [result]
    SCENE_CACHE.drop(settings.token, job)
    part_costs: list[ResourceUsage] = []
    score_options = {"scored_elsewhere": read_stored_scores(len(scored), part_costs)}
    done = _run_junction(job, settings, {**_STORED_RESULTS, "score": score_options})
    if isinstance(done, JobResult):
        return [replace(done, part_costs=tuple(part_costs))]
    return [done]


@catch_input_errors
def _run_junction(job: Job, settings: RunSettings, options: StageOptions) -> JobResult:
    release_memory()
    stages_run: list[str] = []

    def listener(stage: str, state: str, _record: object) -> None:
        if state == "done":
            stages_run.append(stage)

    start_s = perf_counter()
    with settings.applied():
        record = run.run(job.scenario(), job.out, jobs=1, options=options, wait_s=_LOCK_WAIT_S, listener=listener)
        n_sites = record.stages["score"].summary["sites"]
        return JobResult(job.junction, n_sites, perf_counter() - start_s, tuple(stages_run))


def stages_without_traffic() -> tuple[str, ...]:
    """Return the stages that need neither recorded traffic nor an artefact of a stage that does, in order."""
    names: list[str] = []
    for name in STAGE_NAMES:
        described = stage_registry.stage(name)
        makers = {file.writer for file in described.reads}
        if not described.reads_traffic and makers <= set(names):
            names.append(name)
    return tuple(names)
