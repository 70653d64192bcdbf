"""What a worker does: jobs, tasks, cached scenes, part.npz.

What is sent to workers and what comes back: paths, names and numbers, never meshes or grids.

Scenes that a worker has built, kept for its next tasks: the last few, each in a folder for work of its own.

Files of sites that were scored, for who puts the parts of a scenario together: ``part.npz``.

Numbers stand in one array for each type; a JSON text says which of them belong where. So a part is read back to the
last bit, and reading one runs nothing that stands in it.

Some sites of a junction, scored: from the store, else scored here, and kept there.

What workers do, one function a kind of task. Each may run anywhere, any number of times, and gives the same bytes.

A small junction is run whole, some of them in one task. Of a large one the artefacts that sites are scored from are
made (:func:`prepare_junction`), then its sites are scored in parts (:func:`score_part`), then its run is brought to
its end
(:func:`finish_junction`), which takes from the store what the others have put there, and makes what is missing. What
a task
has left of memory, the next one gives back first: so a worker takes hardly more for many sites than for a few.
"""

from __future__ import annotations

import json
import threading
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property, wraps
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from egvs._version import __version__
from egvs.core import files
from egvs.core.errors import EgvsError, InputError, RunError
from egvs.core.runtime import measure_usage, release_memory
from egvs.runs import run, stages, store
from egvs.runs.stages import StageResult
from egvs.runs.store import Store
from egvs.scenario.loading import load
from egvs.scenario.model import Scenario
from egvs.scoring.blindspots import SpotVisibility
from egvs.scoring.scorer import SiteScore
from egvs.scoring.target_scores import SiteTargetScores
from egvs.sensors import sensor, sites
from egvs.sensors.sites import ScannedSite
from egvs.stages.inputs import open_folder
from egvs.stages.site_scoring import ScoredSite, SiteScoring

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class RunSettings:
    """What holds for every task of one city run.

    Attributes
    ----------
    token
        No two runs have the same: what a worker keeps between tasks is of one run.
    program
        Of who gave the order, see :func:`program_id`.
    store
        As ``EGVS_STORE`` would say it there: an absolute path, or a URL.
    store_bytes
        How much the store may hold.
    """

    token: str
    program: str
    store: str
    store_bytes: float

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Use its store within the block; RunError where this is another version of the program."""
        if self.program != program_id():
            found = f"this worker's egvs is not the one that gave the work ({program_id()}, not {self.program})"
            raise RunError(f"{found}; install the same on every machine")
        with store.use_store(self.store, self.store_bytes):
            yield


@dataclass(frozen=True)
class Job:
    """One junction: its scenario's folder, what is laid over it, and the folder of its run; absolute paths."""

    junction: str
    folder: Path
    out: Path
    sets: tuple[str, ...] = ()

    def scenario(self) -> Scenario:
        """Its scenario; InputError where that is wrong."""
        return load(self.folder, self.sets)


@dataclass(frozen=True)
class JobResult:
    """A junction whose run is whole: how many sites it has, what the task took, and which stages were made in it."""

    junction: str
    sites: int
    seconds: float
    made: tuple[str, ...]


@dataclass(frozen=True)
class JobFailure:
    """A junction whose run cannot be: what :class:`EgvsError` said, and its exit code."""

    junction: str
    message: str
    exit_code: int


def program_id() -> str:
    """This program as a short text; it is the same where the same bytes would be made."""
    source = stages.source_digest("egvs.runs.run", "egvs.report.page", *_STAGE_MODULES)
    libraries = sorted(stages.library_versions(source.libraries).items())
    return f"{__version__}, source {source.digest[:12]}, {', '.join(' '.join(pair) for pair in libraries)}"


_STAGE_MODULES = tuple(f"egvs.stages.{name}" for name in ("check", "statics", "scan", "traffic", "tpog", "score"))


def catch_input_errors(task: Callable[P, T]) -> Callable[P, T | JobFailure]:
    """A task whose first argument is a :class:`Job` answers :class:`JobFailure` where the input is wrong or a run
    cannot
    keep its promise: that another attempt would end alike."""

    @wraps(task)
    def telling(*args: P.args, **kwargs: P.kwargs) -> T | JobFailure:
        try:
            return task(*args, **kwargs)
        except EgvsError as error:
            job = args[0]
            assert isinstance(job, Job)
            return JobFailure(job.junction, str(error), error.exit_code)

    return telling


MAX_CACHED_SCENES = 2
"""Scenes that a worker keeps; a large one takes some hundred MB."""

STAGES_BEFORE_SCORE = ("statics", "scan", "traffic", "tpog")
"""The stages whose artefacts sites are scored from."""


class CachedScene:
    """What the sites of one junction are scored from: artefacts in a folder for work, and what was built of them."""

    def __init__(self, job: Job, folder: Path) -> None:
        self._job, self._lock = job, threading.Lock()
        self.work = open_folder(job.scenario(), folder, jobs=1)
        self.users = 0

    def ensure_artefacts(self) -> None:
        """Have the artefacts, from the store or made."""
        with self._lock:
            run.ensure_stages(self.work, *STAGES_BEFORE_SCORE)

    def ready(self) -> SiteScoring:
        """What scores its sites."""
        with self._lock:
            return self._scoring

    @cached_property
    def _scoring(self) -> SiteScoring:
        run.ensure_stages(self.work, *STAGES_BEFORE_SCORE)
        return SiteScoring(self.work)

    @cached_property
    def score_key(self) -> str:
        """The key of its score stage."""
        return stages.stage_key("score", self.work).key


class SceneCache:
    """The scenes of one process; threads share it."""

    def __init__(self, most: int = MAX_CACHED_SCENES) -> None:
        self._most, self._lock = most, threading.Lock()
        self._scenes: OrderedDict[tuple[str, Job], tuple[CachedScene, ExitStack]] = OrderedDict()

    @contextmanager
    def borrow(self, token: str, job: Job) -> Iterator[CachedScene]:
        """The scene of a junction in one city run; while it is lent, its folder stays."""
        with self._lock:
            built = self._take((token, job))
            built.users += 1
        try:
            yield built
        finally:
            with self._lock:
                built.users -= 1
                self._drop_oldest()

    def drop(self, token: str, job: Job) -> None:
        """Nobody here will ask for the scene of a junction again; one that is lent stays."""
        with self._lock:
            built, stack = self._scenes.get((token, job), (None, None))
            if built is not None and stack is not None and not built.users:
                del self._scenes[token, job]
                stack.close()

    def _take(self, key: tuple[str, Job]) -> CachedScene:
        if key not in self._scenes:
            stack = ExitStack()
            self._scenes[key] = CachedScene(key[1], stack.enter_context(files.temporary_folder())), stack
        self._scenes.move_to_end(key)
        return self._scenes[key][0]

    def _drop_oldest(self) -> None:
        idle = [key for key, (built, _) in self._scenes.items() if not built.users]
        for key in idle[: max(0, len(self._scenes) - self._most)]:
            _, stack = self._scenes.pop(key)
            stack.close()


SCENE_CACHE = SceneCache()

PART = "part.npz"

_DTYPES = ("float64", "int64", "int32")
_METADATA = "about"


def write_part(path: Path, sites: Iterable[ScoredSite]) -> None:
    """Write some sites (none of them audited), in order; no more than one is held beside its numbers."""
    pool = _ArrayPool()
    about = [pool.of_site(site) for site in sites]
    with files.atomic_write(path) as partial, partial.open("wb") as file:
        text = np.frombuffer(json.dumps(about).encode("utf-8"), dtype=np.uint8)
        np.savez(file, allow_pickle=False, **{_METADATA: text}, **pool.joined())


def read_part(path: Path) -> Iterator[ScoredSite]:
    """The sites of a file, one by one; InputError where it is none."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            about = json.loads(stored[_METADATA].tobytes())
            find = _array_finder({kind: stored[kind] for kind in _DTYPES})
        for value in about:
            yield _parse_site(value, find, path)
    except (OSError, EOFError, ValueError, LookupError, TypeError, zipfile.BadZipFile) as error:
        raise InputError(path, f"is no part of a score ({error})", "remove it, and run again") from None


class _ArrayPool:
    """Arrays, one after another, by their type."""

    def __init__(self) -> None:
        self._numbers = {kind: bytearray() for kind in _DTYPES}

    def add(self, array: NDArray[Any] | None) -> list[Any] | None:
        """Where an array (n,) stands; None for none."""
        if array is None:
            return None
        kind = str(array.dtype)
        start = len(self._numbers[kind]) // array.itemsize
        self._numbers[kind] += array.tobytes()
        return [kind, start, len(array)]

    def many(self, arrays: Mapping[str, NDArray[Any]] | None) -> dict[str, Any] | None:
        """The same by name."""
        return None if arrays is None else {name: self.add(array) for name, array in arrays.items()}

    def joined(self) -> dict[str, NDArray[Any]]:
        """All of them, one array a type."""
        return {kind: np.frombuffer(numbers, dtype=kind) for kind, numbers in self._numbers.items()}

    def of_site(self, site: ScoredSite) -> dict[str, Any]:
        """A site, its arrays by where they stand."""
        return {
            "site": site.site.to_json(),
            "score": self._of_score(site.score),
            "targets": None if site.targets is None else self._of_targets(site.targets),
            "visible": self.many(site.visible),
        }

    def _of_score(self, score: SiteScore) -> dict[str, Any]:
        return {
            "worth": [score.egvs, score.entropy_seen],
            "left_out": self.add(score.left_out),
            "shares": self.many(score.shares),
            "by_period": [self._of_score(period) for period in score.by_period],
        }

    def _of_targets(self, targets: SiteTargetScores) -> dict[str, Any]:
        missed = targets.missed
        return {
            "scores": self.many(targets.scores),
            "by_period": [dict(period) for period in targets.by_period],
            "missed": None if missed is None else [self.add(a) for a in (missed.visible, missed.share, missed.se)],
        }


ArrayFinder = Callable[[Any], Any]
"""The array that stands somewhere; None for None."""


def _array_finder(arrays: Mapping[str, NDArray[Any]]) -> ArrayFinder:
    def find(where: Any) -> Any:
        if where is None:
            return None
        kind, start, length = where
        found = arrays[kind][start : start + length]
        if len(found) != length:
            raise ValueError("numbers are missing")
        return found.copy()  # a view would hold the whole file's numbers for as long as one site's score is known

    return find


def _parse_site(value: dict[str, Any], find: ArrayFinder, path: Path) -> ScoredSite:
    targets, visible = value["targets"], value["visible"]
    return ScoredSite(
        ScannedSite.from_json(value["site"], path),
        _parse_score(value["score"], find),
        None if targets is None else _parse_targets(targets, find),
        None,
        None if visible is None else _parse_arrays(visible, find),
    )


def _parse_score(value: dict[str, Any], find: ArrayFinder) -> SiteScore:
    egvs, seen = (float(number) for number in value["worth"])
    by_period = tuple(_parse_score(period, find) for period in value["by_period"])
    return SiteScore(egvs, seen, find(value["left_out"]), _parse_arrays(value["shares"], find), by_period)


def _parse_targets(value: dict[str, Any], find: ArrayFinder) -> SiteTargetScores:
    missed = value["missed"]
    by_period = tuple({name: float(number) for name, number in period.items()} for period in value["by_period"])
    return SiteTargetScores(
        _parse_arrays(value["scores"], find),
        by_period,
        None if missed is None else SpotVisibility(*(find(its) for its in missed)),
    )


def _parse_arrays(value: dict[str, Any], find: ArrayFinder) -> dict[str, NDArray[Any]]:
    return {name: find(where) for name, where in value.items()}


PART_KIND = "part"


def split_sites(count: int, parts: int) -> list[slice]:
    """``count`` sites in so many parts, as equal as can be."""
    ends = [count * number // parts for number in range(parts + 1)]
    return [slice(low, high) for low, high in pairwise(ends)]


def score_and_store(scoring: SiteScoring, score_key: str, part: slice) -> int:
    """Score some sites unless the store has them; how many there are."""
    names = scoring.names[part]
    if names:
        with files.temporary_folder() as folder:
            _fetch_or_score(scoring, score_key, names, folder)
    return len(names)


def read_stored_scores(parts: int) -> Callable[[SiteScoring], Iterator[ScoredSite]]:
    """All sites of a junction that was cut in so many parts, for the score stage; what the store has lost is scored
    again."""

    def scored(scoring: SiteScoring) -> Iterator[ScoredSite]:
        score_key = stages.stage_key("score", scoring.context).key
        for part in split_sites(len(scoring.names), parts):
            if names := scoring.names[part]:
                with files.temporary_folder() as folder:
                    yield from read_part(_fetch_or_score(scoring, score_key, names, folder))

    return scored


def _fetch_or_score(scoring: SiteScoring, score_key: str, names: tuple[str, ...], folder: Path) -> Path:
    """The file of some sites in a folder, from the store, where it is put if it is not there."""
    store, path = Store.default(), folder / PART
    program = stages.source_digest(__name__).digest
    key = files.hash_json({"score": score_key, "sites": names, "program": program})
    if store.take(PART_KIND, key, folder) is None:
        with store.maker(PART_KIND, key):
            store.fetch(PART_KIND, key)
            if store.take(PART_KIND, key, folder) is None:  # nor has another one made it meanwhile
                with measure_usage() as cost:
                    write_part(path, scoring.all_sites(only=names))
                store.put(PART_KIND, key, folder, StageResult({PART: files.hash_file(path)}, {}, {}, cost))
    return path


_LOCK_WAIT_S = 60.0
"""A worker that was killed, or was only taken for lost, may be at a junction for a moment more."""

SITE_BEAMS = 2**14
"""What a site takes beside its beams, as beams: few take less than adding up what all voxels are worth."""


@catch_input_errors
def estimate_beams(job: Job, settings: RunSettings) -> int:
    """The work of a junction's candidates: their beams, and as many more as a site by itself takes the time of."""
    with settings.applied():
        scenario = job.scenario()
        candidates = sites.candidate_sites(scenario)
        its = {name: sensor.scenario_sensor(name, scenario, "sites").beams for name in {s.sensor for s in candidates}}
        return sum(its[site.sensor] + SITE_BEAMS for site in candidates)


def run_junctions(jobs: Sequence[Job], settings: RunSettings) -> list[JobResult | JobFailure]:
    """Run some junctions from beginning to end."""
    return [_run_junction(job, settings, {}) for job in jobs]


@catch_input_errors
def prepare_junction(job: Job, settings: RunSettings) -> None:
    """Put into the store what sites are scored from."""
    with settings.applied(), SCENE_CACHE.borrow(settings.token, job) as built:
        built.ensure_artefacts()


@catch_input_errors
def score_part(job: Job, settings: RunSettings, part: tuple[int, int], prepared: JobFailure | None) -> int | JobFailure:
    """Score one of some parts of the sites, (number, of how many); how many sites that were."""
    if prepared is not None:
        return prepared
    release_memory()
    with settings.applied(), SCENE_CACHE.borrow(settings.token, job) as built:
        scoring = built.ready()
        return score_and_store(scoring, built.score_key, split_sites(len(scoring.names), part[1])[part[0]])


def finish_junction(
    job: Job, settings: RunSettings, scored: Sequence[int | JobFailure]
) -> Sequence[JobResult | JobFailure]:
    """The run of a junction whose sites were scored in parts."""
    failed = [its for its in scored if isinstance(its, JobFailure)]
    if failed:
        return failed[:1]
    SCENE_CACHE.drop(settings.token, job)
    return [_run_junction(job, settings, {"score": {"scored_elsewhere": read_stored_scores(len(scored))}})]


@catch_input_errors
def _run_junction(job: Job, settings: RunSettings, help_from: dict[str, dict[str, Any]]) -> JobResult:
    release_memory()
    made: list[str] = []
    begin = perf_counter()
    with settings.applied():
        record = run.run(
            job.scenario(), job.out, jobs=1, options=help_from, wait_s=_LOCK_WAIT_S,
            listener=lambda stage, state, _: made.append(stage) if state == "done" else None,
        )  # fmt: skip
        return JobResult(job.junction, record.stages["score"].summary["sites"], perf_counter() - begin, tuple(made))
