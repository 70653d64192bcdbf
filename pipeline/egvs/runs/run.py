"""The whole program: a scenario becomes static world, scans, traffic, TPOG, scores and report in one folder.

:func:`run` brings every stage up to date. A stage is skipped when its key (settings by value, files by hash, source of
the program) is that of the last run and its artefacts are unchanged; otherwise it is restored from the store, or runs
and its artefacts are saved in the store. Stages take turns; only SUMO simulates in the background from the beginning
(:mod:`egvs.runs.background`), and its frames are written and counted as they come. ``run.json`` is written after each
stage that made something, with that stage and those before it: an interrupted run continues from there, and no record
names artefacts of another scenario. A run that is rejected before any stage ran leaves the folder as it was.

User files are not overwritten: no input lies where a run writes, and nothing is written through a link.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from egvs._version import __version__
from egvs.artefacts.origin import foreign_files
from egvs.artefacts.run_folder import STAGE_NAMES, RunFolder
from egvs.artefacts.run_record import RunRecord, StageRecord
from egvs.core import files
from egvs.core.digests import use_digests
from egvs.core.errors import EgvsError, InputError, RunError
from egvs.core.platform import relative_path
from egvs.core.progress import ProgressCallback, no_progress
from egvs.formats.meshes import referenced_files
from egvs.runs import locks, run_names, stage_keys, stage_registry, store
from egvs.runs.background import BackgroundStage, run_in_background
from egvs.runs.digest_cache import remember_digests
from egvs.runs.kernel_compiler import KernelCompiler
from egvs.runs.run_context import open_folder
from egvs.runs.stage_keys import StageKey
from egvs.runs.stage_registry import StageResult
from egvs.runs.store import Store
from egvs.scenario.loading import check_is_scenario, scenario_from_dict
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import is_plugin_score
from egvs.stages import inputs as stage_inputs
from egvs.stages.base import StageContext, WorkAhead
from egvs.stages.inputs import Inputs
from egvs.traffic.sumo_folder import NETWORK_FILE

StageListener = Callable[[str, str, StageRecord | None], None]
"""Called with (stage, state, record) as a run proceeds.

States: "runs" (without a record), then "done"; or "skipped" (nothing changed), or "fetched" (restored from the store).
"corrected" comes before "done" where the artefacts in the folder were not those that the stage makes of its inputs.
"""

StageOptions = Mapping[str, Mapping[str, Any]]
"""Further keyword arguments of single stages, for example ``{"score": {"audit": True}}``."""


def ignore_stage(_stage: str, _state: str, _record: StageRecord | None) -> None:
    """A :data:`StageListener` that does nothing."""


def run(
    scenario: Scenario,
    out: str | Path | None = None,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: StageListener = ignore_stage,
    options: StageOptions | None = None,
    only: Collection[str] = STAGE_NAMES,
    wait_s: float = 0.0,
) -> RunRecord:
    """Run every stage whose inputs changed, in order; restore artefacts from the store where it has them.

    Parameters
    ----------
    scenario
        From :func:`egvs.load`.
    out
        Run folder; ``runs/<scenario name>`` when None, or, with overrides, that and their label (see
        :mod:`egvs.runs.run_names`).
    jobs
        Number of threads; one per core when None. Results do not depend on it.
    progress
        Called as the work proceeds.
    listener
        Called when a stage starts and ends.
    options
        Further keyword arguments of single stages. A stage with options always runs and its artefacts are not saved in
        the store, unless the stage declares that they change no artefact.
    only
        Names of the stages to run, which must read nothing of the others.
    wait_s
        How long to wait for the end of another run in the folder.

    Returns
    -------
    RunRecord
        Contents of ``run.json``.

    Examples
    --------
    >>> import egvs
    >>> scenario = egvs.load("scenarios/roundabout", ["traffic.frames=100"])
    >>> record = egvs.run(scenario, "runs/example")
    >>> list(record.stages)
    ['check', 'statics', 'scan', 'traffic', 'tpog', 'score', 'report']
    >>> egvs.read_scores("runs/example/scores.parquet").num_rows == len(egvs.build_scene(scenario).sites)
    True
    """
    check_is_scenario(scenario)
    if is_plugin_score(scenario.score.rank_by):  # a broken one is reported before anything is computed
        from egvs.scoring.target_scores import load_vehicle_score

        load_vehicle_score(scenario.score.rank_by)
    open_context = partial(open_folder, scenario, jobs=jobs, progress=progress)
    with _start_run(scenario, out, listener, open_context, wait_s) as current:
        return current.run_stages(only, options or {})


def run_rehashed(
    scenario: Scenario,
    out: str | Path | None = None,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: StageListener = ignore_stage,
    options: StageOptions | None = None,
) -> RunRecord:
    """Run as :func:`run`, but trust neither time stamps nor artefacts that were made of other artefacts.

    Every file is hashed. Scans, TPOG and scores are made again from the artefacts beside them; those in the folder and
    in the store that differ are replaced, and reported as "corrected".
    """
    open_context = partial(open_folder, scenario, jobs=jobs, progress=progress)
    with _start_run(scenario, out, listener, open_context, is_rehash=True) as current:
        return current.run_stages(STAGE_NAMES, options or {})


@contextmanager
def _start_run(
    scenario: Scenario,
    out: str | Path | None,
    listener: StageListener,
    open_context: Callable[..., StageContext],
    wait_s: float = 0.0,
    *,
    is_rehash: bool = False,
) -> Iterator[_Run]:
    """Lock a run folder, and yield the run in it."""
    if out == "":
        raise InputError("out", "expected a folder, got an empty text", 'Use "." for the current folder.')
    folder = Path(out) if out is not None else default_folder(scenario)
    files.check_utf8("the run folder", str(folder.absolute()))
    check_no_overwrite(scenario, folder)
    with lock_run_folder(folder, wait_s), remember_digests(RunFolder(folder), trusted=not is_rehash) as digests:
        context = open_context(folder, digests=digests)
        yield _Run(context, start_record(scenario, folder), listener, is_rehash=is_rehash)


def run_one(
    stage: str,
    scenario: Scenario,
    out: Path,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: StageListener = ignore_stage,
    **options: Any,
) -> RunRecord:
    """Run a single stage, even if its inputs did not change, and record it in ``run.json``.

    Stages before it that have not been run in the folder are restored from the store, where it has their results for
    this scenario. So a stage can be run with another setting, which has another folder.

    Parameters are those of :func:`run`; ``options`` are further keyword arguments of the stage.
    """
    check_no_overwrite(scenario, out)
    with lock_run_folder(out):
        record = start_record(scenario, out)
        recorded = stage_registry.recorded_digests(record)
        context = open_folder(scenario, out, jobs=jobs, progress=progress, recorded=recorded)
        current = _Run(context, record, listener)
        with use_digests(context.inputs.digests):
            for earlier in stages_before(stage):
                current.restore_stage(earlier)
            current.ensure_stage(stage, options, again=True)
            return current.finish(keep=(stage,))


def stages_before(stage: str) -> list[str]:
    """Return the stages whose artefacts a stage reads, or that these stages read, in the order of execution.

    Parameters
    ----------
    stage
        Name of the stage.

    Examples
    --------
    >>> stages_before("tpog")
    ['statics', 'traffic']
    """
    needed: set[str] = set()
    pending = [stage]
    while pending:
        read = {file.writer for file in stage_registry.stage(pending.pop()).reads} - needed
        needed |= read
        pending += read
    return [name for name in STAGE_NAMES if name in needed]


def refresh_report(out: Path) -> Path | None:
    """Draw the report of a complete run again if something that it shows has changed, for example a study.

    A report in the folder that is no longer recorded, because a stage before it ran again, is drawn again, too. The
    caller holds the lock of the folder (:func:`lock_run_folder`).

    Returns
    -------
    Path, or None
        The report; None, and nothing is done, where there is no complete run of these settings and files, or no report.
    """
    folder = RunFolder(out)
    if not folder.has_record:
        return None
    record = RunRecord.read(out)
    source = Path(os.path.normpath(out / record.scenario_folder))
    views = [name for name in STAGE_NAMES if stage_registry.stage(name).is_view]
    inputs = [name for name in STAGE_NAMES if name not in views]
    if not source.is_dir() or not all(stage in record.stages for stage in inputs):
        return None
    if not folder.report.is_file() and not any(view in record.stages for view in views):
        return None

    scenario = scenario_from_dict(record.scenario, source, str(folder.run_record))
    context = open_folder(scenario, out)
    for stage in inputs:
        if not _is_up_to_date(stage, context, record) or not _is_intact(context, record.stages[stage]):
            return None
    current = _Run(context, record, complete=set(inputs))
    for view in views:
        current.ensure_stage(view, {})
    current.finish(keep=STAGE_NAMES)
    return folder.report


def default_folder(scenario: Scenario) -> Path:
    """Return the run folder where none is given: ``runs/<name>``, or ``runs/<name>@<label>`` with overrides."""
    check_is_scenario(scenario)
    return run_names.run_folder(scenario.name, scenario.overrides)


def start_record(scenario: Scenario, folder: Path) -> RunRecord:
    """Return the record of earlier runs in a folder, with the scenario as it is now."""
    scenario_folder = relative_path(scenario.folder, folder)
    recorded = RunRecord.read(folder).stages if RunFolder(folder).has_record else {}
    values, overrides = scenario.model_dump(mode="json"), dict(scenario.overrides)
    return RunRecord(__version__, scenario.seed, values, scenario_folder, recorded, overrides)


def fetch_or_run(
    name: str,
    context: StageContext,
    key: str,
    store: Store,
    make: Callable[[], StageResult],
    *,
    link: bool = False,
) -> tuple[StageResult, bool]:
    """Restore the artefacts of a stage from the store; else run the stage and save them there.

    Of several processes that need the same artefacts, one makes them.

    Parameters
    ----------
    name, key
        The stage, and its key.
    context
        The folder of the artefacts.
    store
        Where results are cached.
    make
        Runs the stage.
    link
        Link files instead of copying them.

    Returns
    -------
    tuple
        The result, and whether it was restored.
    """
    out = context.folder.path
    context.forget(*stage_registry.written_by(name))
    entry = store.take(name, key, out, link=link)
    if entry is None:
        with store.maker(name, key, progress=context.progress):
            store.fetch(name, key)
            entry = store.take(name, key, out, link=link)  # another process may have made it meanwhile
            if entry is None:
                result = make()
                store.put(name, key, out, result, link=link)
                return result, False
    for other in set(stage_registry.stage(name).artefacts) - set(entry.made.artefacts):
        (out / other).unlink(missing_ok=True)  # as the stage does
    context.expect(entry.made.artefacts)
    return entry.made, True


def ensure_stages(context: StageContext, *names: str) -> dict[str, str]:
    """Bring some stages up to date, in this order, in a folder without ``run.json``; return their keys."""
    keys = {}
    store = Store.default()
    for name in names:
        key = stage_keys.stage_key(name, context)

        def make(name: str = name, key: StageKey = key) -> StageResult:
            return stage_registry.run_stage(name, context, key.dependencies)

        fetch_or_run(name, context, key.key, store, make, link=True)
        keys[name] = key.key
    return keys


@dataclass
class _Run:
    """A run in progress: one scenario in one folder.

    Attributes
    ----------
    context
        The folder and the inputs.
    record
        What is known of the stages so far; of some from earlier runs, perhaps of other settings.
    listener
        Called when a stage starts and ends.
    complete
        The stages that belong to this scenario for certain.
    has_changed
        Whether the folder has other artefacts than before.
    is_rehash
        Whether stages that read artefacts run again, and their artefacts are compared with the recorded ones.
    background
        A stage that has been started before its turn.
    ahead
        Work of stages on the trajectories that the background has made.
    compiler
        Compiles kernels in another process.
    """

    context: StageContext
    record: RunRecord
    listener: StageListener = ignore_stage
    store: Store = field(default_factory=Store.default)
    complete: set[str] = field(default_factory=set)
    has_changed: bool = False
    is_rehash: bool = False
    background: BackgroundStage | None = None
    ahead: Mapping[str, WorkAhead] = field(default_factory=dict)
    compiler: KernelCompiler = field(default_factory=KernelCompiler)

    def run_stages(self, names: Collection[str], options: StageOptions) -> RunRecord:
        """Bring some stages up to date, in order, while SUMO simulates in the background; return the record."""
        stages = [stage for stage in STAGE_NAMES if stage in names]
        key = None
        if "traffic" in stages and "traffic" not in options:
            key = self.key_to_simulate()
        with ExitStack() as stack:
            ahead = {} if key is None else self._begin_ahead(stages, stack)
            self.background = stack.enter_context(run_in_background("traffic", key, self.context, self.store, ahead))
            stack.enter_context(self.compiler)
            for number, stage in enumerate(stages, 1):
                self.ensure_stage(stage, options.get(stage, {}), next_stages=stages[number:])
            return self.finish(keep=names, keep_views=True)

    def _begin_ahead(self, stages: Iterable[str], stack: ExitStack) -> dict[str, WorkAhead]:
        """Begin the work of some stages that goes on while SUMO simulates; it ends with ``stack``."""
        ahead = {}
        for name in stage_registry.AHEAD_STAGES & set(stages):
            begin = stage_registry.stage(name).ahead
            if begin is not None and (work := stack.enter_context(begin(self.context))) is not None:
                ahead[name] = work
        return ahead

    def key_to_simulate(self) -> StageKey | None:
        """Return the key of the traffic stage if SUMO has to simulate; None, too, where an error comes before that."""
        if self.context.scenario.is_recorded:
            return None
        try:
            if any(stage_inputs.missing_files(self.context.inputs)):
                return None
            key = stage_keys.stage_key("traffic", self.context)
        except (EgvsError, OSError):
            return None
        if self.context.folder.trajectories.is_dir():
            return None
        last = self.record.stages.get("traffic")
        is_up_to_date = last is not None and last.inputs == key.key and _is_intact(self.context, last)
        return None if is_up_to_date else key

    def ensure_stage(
        self, name: str, options: Mapping[str, Any], *, again: bool = False, next_stages: Sequence[str] = ()
    ) -> None:
        """Bring one stage up to date; with ``again``, or with options that change artefacts, it always runs.

        While a stage in the background goes on, what it and ``next_stages`` will call is loaded and compiled.
        """
        key = stage_keys.stage_key(name, self.context)
        stage = stage_registry.stage(name)
        has_options = any(option not in stage.neutral_options for option in options)
        again = again or (self.is_rehash and bool(stage.reads) and not stage.is_view)
        last = self.record.stages.get(name)
        if last and not (again or has_options) and last.inputs == key.key and _is_intact(self.context, last):
            self._record_stage(name, last)
            self.listener(name, "skipped", last)
            return

        def make() -> StageResult:
            self.listener(name, "runs", None)
            self.compiler.before(name, next_stages)
            ahead = {"ahead": self.ahead[name]} if name in self.ahead else {}
            return stage_registry.run_stage(name, self.context, key.dependencies, **options, **ahead)

        fetched = False
        if has_options:
            result = make()
        elif again:
            result = make()
            self._save(name, key, result)
        elif self.background is not None and self.background.key == key.key:
            self.listener(name, "runs", None)
            result = self.background.result(self._preparations([name, *next_stages]))
            self.store.put(name, key.key, self.context.folder.path, result)
            self.background.close()
            self.ahead = self.background.ahead
        else:
            result, fetched = fetch_or_run(name, self.context, key.key, self.store, make)
        stage_record = key.record(result)
        if self.is_rehash and last and last.inputs == key.key and last.artefacts != stage_record.artefacts:
            self.listener(name, "corrected", stage_record)
        self.has_changed |= bool(stage_record.artefacts)
        recorded = stage_record
        if last and (last.inputs, last.artefacts) == (stage_record.inputs, stage_record.artefacts):
            recorded = replace(stage_record, cost=last.cost)  # which the report shows: it stays up to date
        self._record_stage(name, recorded)
        self.listener(name, "fetched" if fetched else "done", stage_record)

    def _preparations(self, names: Iterable[str]) -> Iterator[Callable[[], None]]:
        """Yield what loads, or compiles, what some stages call."""
        for name in names:
            yield partial(self.compiler.before, name, ())
            yield from stage_registry.stage(name).prepare

    def restore_stage(self, name: str) -> None:
        """Restore a stage from the store if it has not been run in the folder; do nothing if the store lacks it."""
        folder = self.context.folder.path
        if name in self.record.stages or any((folder / file).exists() for file in stage_registry.written_by(name)):
            return
        key = stage_keys.stage_key(name, self.context)
        self.context.forget(*stage_registry.written_by(name))
        with self.store.maker(name, key.key, progress=self.context.progress):
            self.store.fetch(name, key.key)
            entry = self.store.take(name, key.key, folder)
        if entry is None:
            return
        self.has_changed = True
        self.context.expect(entry.made.artefacts)
        self._record_stage(name, key.record(entry.made))
        self.listener(name, "fetched", self.record.stages[name])

    def _save(self, name: str, key: StageKey, result: StageResult) -> None:
        """Save a result in the store, unless another process is making the same."""
        with self.store.maker(name, key.key, wait=False) as is_only_one:
            if is_only_one:
                self.store.put(name, key.key, self.context.folder.path, result)

    def _record_stage(self, name: str, stage: StageRecord) -> None:
        """Record a stage; write ``run.json`` with the complete stages if artefacts changed."""
        self.complete.add(name)
        self.record = self.record.having(name, stage)
        if self.has_changed:
            complete = {name: stage for name, stage in self.record.stages.items() if name in self.complete}
            replace(self.record, stages=complete).write(self.context.folder.path)

    def finish(self, keep: Collection[str], *, keep_views: bool = False) -> RunRecord:
        """Write ``run.json`` if it changed; drop stages of other settings, except those in ``keep``, and views."""
        for stage in list(self.record.stages):
            is_view = stage_registry.stage(stage).is_view
            if stage in keep or (is_view and keep_views):
                continue
            if is_view:
                self._write(self.record.having(stage, None))  # the key of a view depends on this record
            if not _is_up_to_date(stage, self.context, self.record):
                self.record = self.record.having(stage, None)
        self._write(self.record)
        os.utime(self.context.folder.lock)  # "egvs runs" shows when a run was last at work
        return self.record

    def _write(self, record: RunRecord) -> None:
        """Write ``run.json`` if it differs."""
        folder = self.context.folder
        if not folder.has_record or RunRecord.read(folder.path) != record:
            record.write(folder.path)


def _is_up_to_date(name: str, context: StageContext, record: RunRecord) -> bool:
    """Whether a recorded stage has the key that follows from this scenario and the present artefacts."""
    try:
        return record.stages[name].inputs == stage_keys.stage_key(name, context).key
    except InputError:
        return False


def _is_intact(context: StageContext, stage: StageRecord) -> bool:
    """Whether artefacts are as the stage wrote them, and the network that the report draws, if it exists."""
    digests = dict(stage.artefacts)
    for name, digest in stage.companions.items():
        if name.endswith(NETWORK_FILE) and context.path(name).is_file():
            digests[name] = digest
    return all(context.path(name).is_file() and context.digest(name) == digest for name, digest in digests.items())


class FolderInUseError(RunError):
    """Another run is at work in a run folder."""


@contextmanager
def lock_run_folder(folder: Path, wait_s: float = 0.0) -> Iterator[None]:
    """Keep other runs out of a folder, and every run out of the folder of the store.

    Parameters
    ----------
    folder
        Run folder; it is created if it does not exist, and removed again if nothing is written into it.
    wait_s
        How long to wait for the end of another run.

    Raises
    ------
    FolderInUseError
        When another run is still at work there.
    """
    store.check_outside_store(folder)
    created = [path for path in (folder, *folder.parents) if not path.exists()]  # the innermost first
    descriptor = _lock_folder(folder, wait_s)
    try:
        yield
    finally:
        _remove_unused(folder, created)
        os.close(descriptor)


def _lock_folder(folder: Path, wait_s: float) -> int:
    """Return the descriptor of the lock of a run folder; FolderInUseError when another run holds it."""
    while True:
        descriptor = _open_folder_lock(folder)
        if not locks.wait_for_lock(descriptor, wait_s):
            os.close(descriptor)
            raise FolderInUseError(f"{folder}: another run is using this folder")
        if locks.is_current_lock(descriptor, folder / RunFolder.lock.name):
            return descriptor
        os.close(descriptor)  # a run that wrote nothing has removed the folder meanwhile


def _open_folder_lock(folder: Path) -> int:
    """Return the descriptor of the lock of a run folder; both are created if they do not exist."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return locks.open_lock(folder / RunFolder.lock.name)
    except OSError as error:
        problem = f"cannot be written ({error.strerror})"
        raise InputError(folder, problem, "Choose a folder that you may write to.") from None


def _remove_unused(folder: Path, created: Sequence[Path]) -> None:
    """Remove the folders that this run created, if nothing was written: there is only the lock in the run folder."""
    if folder not in created or any(path.name != RunFolder.lock.name for path in folder.iterdir()):
        return
    with suppress(OSError):  # Windows removes no open file; a folder that another run uses is not empty
        (folder / RunFolder.lock.name).unlink()
        for path in created:
            path.rmdir()


_CLOUD_NAME = re.compile(r"scan_.*\.(ply|pcd)", re.DOTALL)
"""Name of a point cloud that ``egvs scan --points`` writes."""


def check_no_overwrite(scenario: Scenario, folder: Path, folders: Collection[str] = ()) -> None:
    """Check that a run in a folder writes over no file of the user, and through no link.

    ``folders`` are the folders that a study makes in it, apart from those of the stages.

    Raises
    ------
    InputError
        When a file that the scenario names, or one that no run wrote, would be overwritten, or a folder contains a
        symbolic link.
    """
    if not folder.is_dir():
        return
    folders = {*(file.name for file in RunFolder.all_files() if file.is_folder), *folders}
    for name in folders:
        for path in (folder / name, *(folder / name).rglob("*")):
            if path.is_symlink():
                raise InputError(path, "is a symbolic link, and nothing is written through links", "Remove it.")

    home = Path(os.path.realpath(folder))
    for key, path in _input_files(scenario):
        real_path = Path(os.path.realpath(path))
        if not real_path.is_relative_to(home):
            continue
        relative = real_path.relative_to(home)
        if _may_be_written(relative, folders):
            problem = f"a run would overwrite {relative.as_posix()}, which the scenario uses ({key})"
            raise InputError(f"--out {folder}", problem, "Use a separate folder, for example runs/mine.")
    for name in foreign_files(folder):
        problem = f"a run would overwrite {name}, which no run wrote"
        raise InputError(f"--out {folder}", problem, f"Use a separate folder, for example runs/mine, or move {name}.")


def _may_be_written(path: Path, folders: Collection[str]) -> bool:
    """Whether a run may write a file; ``path`` is relative to the run folder."""
    if path.parts[0] in folders:
        return True
    if len(path.parts) > 1:
        return False
    is_cloud = _CLOUD_NAME.fullmatch(path.name) is not None
    return is_cloud or any(path.name == file.name for file in RunFolder.all_files())


def _input_files(scenario: Scenario) -> Iterator[tuple[str, Path]]:
    """Yield key and path of every file named by the scenario, its meshes or its SUMO configuration."""
    candidates = stage_inputs.readable_candidates(Inputs(scenario))
    named = [
        *stage_inputs.named_files(scenario),
        *((f"validation.bodies.{kind}", name) for kind, name in scenario.validation.bodies.items()),
        *stage_inputs.measured_scan_files(candidates),
    ]
    for key, name in named:
        try:
            path = scenario.find(name, key)
        except InputError:  # the check reports missing files
            continue
        yield key, path
        if key == "statics.meshes" or key.startswith("validation.bodies."):
            yield from ((key, part) for part in referenced_files(path))
    yield from (("traffic.sumocfg", path) for path in stage_inputs.sumo_config_files(scenario))
