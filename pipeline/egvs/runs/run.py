"""Run(): every stage up to date, one run a folder, never over a user's file.

What the user made is not written over: no input lies where a run writes, and nothing is written through a link.

Locks that keep processes apart; each goes with its process, however that ends.

A scenario becomes a ranking: static world and empty scans, traffic and the TPOG, scores, the report.

:func:`run` is the whole program. A stage whose inputs (settings by value, files by hash, the program's source) are
those of the last run, and whose artefacts are still what it wrote, is skipped; one that the store knows is fetched from
there; any other one is made, and kept in the store. After each stage that was made ``run.json`` is written anew, with
that stage and those before it, so that an interrupted run goes on from the last whole stage, and no record names
artefacts of another scenario than its own. A run that is refused before anything was made leaves the folder as it was.

:func:`verify` runs again what ``run.json`` says and compares every artefact byte for byte.
"""

from __future__ import annotations

import fcntl
import os
import re
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from egvs._version import __version__
from egvs.artefacts.run_folder import (
    STAGE_NAMES,
    RunFolder,
    RunRecord,
    StageRecord,
)
from egvs.core import files
from egvs.core.errors import InputError, RunError
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.formats.meshes import referenced_files
from egvs.runs import stages, store
from egvs.runs.locks import _PAUSE_S, _open_lock, _try_lock
from egvs.runs.stages import StageKey, StageResult
from egvs.runs.store import Store
from egvs.scenario.loading import scenario_from_dict
from egvs.scenario.model import Scenario
from egvs.stages import inputs as stage_inputs
from egvs.stages.base import StageContext
from egvs.stages.inputs import Inputs, open_folder
from egvs.traffic.sumo_folder import NETWORK_FILE

_CLOUD_NAME = re.compile(r"scan_.*\.(ply|pcd)", re.DOTALL)
"""Name of a point cloud that ``egvs scan --points`` writes."""


def check_no_overwrite(scenario: Scenario, folder: Path, folders: Collection[str] = ()) -> None:
    """Check that a run in a folder writes over no file of the user, and through no link.

    ``folders`` are the folders that a study makes in it, apart from those of the stages.

    Raises
    ------
    InputError
        When a file that the scenario names would be overwritten, or a folder contains a symbolic link.
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
            problem = f"a run would write over {relative.as_posix()}, which the scenario names ({key})"
            raise InputError(f"--out {folder}", problem, "Name a folder of its own, for example runs/mine.")


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


@contextmanager
def lock_run_folder(folder: Path, wait_s: float = 0.0) -> Iterator[None]:
    """Keep two runs out of one folder, and every run out of the store; the store's settings are right then.

    Another run's end is waited for so long; RunError where it is at work there then.
    """
    store.check_outside_store(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = _open_lock(folder / ".lock", shared=False)
    except OSError as error:
        raise InputError(folder, f"cannot be written ({error.strerror})", "a folder of yours") from None
    try:
        until = time.monotonic() + wait_s
        while not _try_lock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB):
            if time.monotonic() >= until:
                raise RunError(f"{folder}: another run is at work there")
            time.sleep(_PAUSE_S)
        yield
    finally:
        os.close(descriptor)


StageListener = Callable[[str, str, StageRecord | None], None]
"""Called with (stage, state, its record) as a run goes on.

States: "runs" (no record yet), then "done"; or "skipped" (nothing changed), or "fetched" (from the store).
"""


def ignore_stage(_stage: str, _state: str, _record: StageRecord | None) -> None:
    """A :data:`StageListener` that says nothing."""


def run(
    scenario: Scenario,
    out: str | Path | None = None,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: StageListener = ignore_stage,
    options: dict[str, dict[str, Any]] | None = None,
    help_from: dict[str, dict[str, Any]] | None = None,
    only: Collection[str] = STAGE_NAMES,
    wait_s: float = 0.0,
) -> RunRecord:
    """Bring every stage up to date, in order.

    Parameters
    ----------
    scenario
        From :func:`egvs.load`.
    out
        The run's folder; ``runs/<scenario name>`` when None.
    jobs
        Threads; one a core when None. Results do not depend on it.
    options
        Further keyword arguments of single stages, e.g. ``{"score": {"audit": True}}``; such a stage is always run, and
        not kept in the store.
    help_from
        Further keyword arguments of single stages that change no byte of what they make, but who makes it; such a stage
        is skipped, fetched and kept as any.
    only
        These stages alone, which must read nothing of others.
    wait_s
        How long to wait for the end of another run in the folder.

    Returns
    -------
    RunRecord
        What ``run.json`` holds.

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
    folder = Path(out) if out is not None else default_folder(scenario)
    check_no_overwrite(scenario, folder)
    with lock_run_folder(folder, wait_s), files.hold_inputs(except_in=folder):
        run = _Run(open_folder(scenario, folder, jobs=jobs, progress=progress), listener, help_from or {})
        record = _record_so_far(scenario, folder)
        for name in (stage for stage in STAGE_NAMES if stage in only):
            record = run.ensure_stage(name, record, **(options or {}).get(name, {}))
        return run.end(record, [stage for stage in record.stages if stage not in (*only, "report")])


def run_one(
    name: str,
    scenario: Scenario,
    out: Path,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: StageListener = ignore_stage,
    **options: Any,
) -> RunRecord:
    """Run a single stage, whether its inputs changed or not, and note it in ``run.json``."""
    check_no_overwrite(scenario, out)
    with lock_run_folder(out), files.hold_inputs(except_in=out):
        record = _record_so_far(scenario, out)
        work = open_folder(scenario, out, jobs=jobs, progress=progress, recorded=stages.recorded_digests(record))
        run = _Run(work, listener)
        record = run.ensure_stage(name, record, again=True, **options)
        return run.end(record, [stage for stage in record.stages if stage != name])


def refresh_report(out: Path) -> Path | None:
    """Draw the report of a whole run anew where something that it shows has changed (an accuracy study); its path.

    None, and nothing is done, where there is no whole run. For those who hold the folder
    (:func:`egvs.runs.run.lock_run_folder`).
    """
    if not RunFolder(out).run_record.is_file():
        return None
    record = RunRecord.read(out)
    source = Path(os.path.normpath(out / record.scenario_folder))
    if not all(name in record.stages for name in STAGE_NAMES) or not source.is_dir():
        return None
    scenario = scenario_from_dict(record.scenario, source, str(RunFolder(out).run_record))
    work = open_folder(scenario, out)
    before = {name: stage for name, stage in record.stages.items() if name != "report"}
    if not all(_is_up_to_date(name, work, record) and _is_intact(work, stage) for name, stage in before.items()):
        return None
    run = _Run(work, ignore_stage, complete=set(before))
    run.end(run.ensure_stage("report", record), ())
    return RunFolder(out).report


def default_folder(scenario: Scenario) -> Path:
    """Where a run goes when no folder is given."""
    return Path("runs") / scenario.name


def fetch_or_run(
    name: str, work: StageContext, key: str, store: Store, make: Callable[[], StageResult], *, link: bool = False
) -> tuple[StageResult, bool]:
    """A stage's artefacts in a workspace: from the store, else made, and kept there.

    Of several processes that want the same, one makes it. Returns what came of it, and whether it came from the store.
    """
    out = work.folder.path
    work.forget(*stages.written_by(name))
    if (entry := store.take(name, key, out, link=link)) is None:
        with store.maker(name, key, progress=work.progress):
            store.fetch(name, key)
            if (entry := store.take(name, key, out, link=link)) is None:  # nor has another one made it meanwhile
                made = make()
                store.put(name, key, out, made, link=link)
                return made, False
    for other in set(stages.stage(name).artefacts) - set(entry.made.artefacts):
        (out / other).unlink(missing_ok=True)  # as the stage does
    return entry.made, True


def ensure_stages(work: StageContext, *names: str) -> dict[str, str]:
    """The artefacts of some stages, in their order, into a workspace that is no run's folder: from the store, else
    made, and kept there. Returns their keys."""
    keys = {}
    for name in names:
        inputs = stages.stage_key(name, work)
        read = inputs.dependencies
        fetch_or_run(name, work, inputs.key, Store.default(), lambda: stages.run_stage(name, work, read), link=True)  # noqa: B023 - called at once
        keys[name] = inputs.key
    return keys


@dataclass
class _Run:
    """One scenario in one folder.

    Attributes
    ----------
    complete
        The stages that are known to be this scenario's. Of the others a record may know from earlier runs.
    is_other
        Whether artefacts in the folder are others than they were.
    """

    work: StageContext
    listener: StageListener
    help_from: dict[str, dict[str, Any]] = field(default_factory=dict)
    store: Store = field(default_factory=Store.default)
    complete: set[str] = field(default_factory=set)
    is_other: bool = False

    def ensure_stage(self, name: str, record: RunRecord, *, again: bool = False, **options: Any) -> RunRecord:
        """Bring one stage up to date; the record of the run with it. What is whole of it is written once artefacts were
        made.

        A stage with ``options`` is always run, and its artefacts are not kept in the store; ``again``: always run.
        """
        work = self.work
        inputs = stages.stage_key(name, work)
        last = record.stages.get(name)
        if last and not (again or options) and last.inputs == inputs.key and _is_intact(work, last):
            self.listener(name, "skipped", last)
            return self._record_stage(name, last, record)
        made, fetched = self._fetch_or_run(name, inputs, again, options)
        done = inputs.record(made)
        self.is_other |= bool(done.artefacts)
        record = self._record_stage(name, done, record)
        self.listener(name, "fetched" if fetched else "done", done)
        return record

    def end(self, record: RunRecord, others: Collection[str]) -> RunRecord:
        """The record without those of the other stages that are of other settings, which it would contradict; written
        where it is another one than before."""
        for name in [stage for stage in others if not _is_up_to_date(stage, self.work, record)]:
            record = record.having(name, None)
        folder = self.work.folder.path
        if not RunFolder(folder).run_record.is_file() or RunRecord.read(folder) != record:
            record.write(folder)
        return record

    def _record_stage(self, name: str, stage: StageRecord, record: RunRecord) -> RunRecord:
        self.complete.add(name)
        record = record.having(name, stage)
        if self.is_other:
            whole = {name: stage for name, stage in record.stages.items() if name in self.complete}
            replace(record, stages=whole).write(self.work.folder.path)
        return record

    def _fetch_or_run(
        self, name: str, inputs: StageKey, again: bool, options: dict[str, Any]
    ) -> tuple[StageResult, bool]:
        work = self.work

        def make() -> StageResult:
            self.listener(name, "runs", None)
            return stages.run_stage(name, work, inputs.dependencies, **self.help_from.get(name, {}), **options)

        if not (again or options):
            return fetch_or_run(name, work, inputs.key, self.store, make)
        made = make()
        if not options:
            with self.store.maker(name, inputs.key, wait=False) as mine:
                if mine:
                    self.store.put(name, inputs.key, work.folder.path, made)
        return made, False


def _record_so_far(scenario: Scenario, folder: Path) -> RunRecord:
    """What is known of earlier work in this folder, with the scenario as it is now."""
    home = Path(os.path.relpath(scenario.folder, folder)).as_posix()
    known = RunRecord.read(folder).stages if RunFolder(folder).run_record.is_file() else {}
    return RunRecord(__version__, scenario.seed, scenario.model_dump(mode="json"), home, known)


def _is_up_to_date(name: str, work: StageContext, record: RunRecord) -> bool:
    """Whether a stage's last run is what this scenario, and the artefacts as they are now, would give."""
    try:
        return record.stages[name].inputs == stages.stage_key(name, work).key
    except InputError:
        return False


def _is_intact(work: StageContext, stage: StageRecord) -> bool:
    """Whether artefacts are what the stage wrote, and a network that the report draws, where it is still there."""
    artefacts = stage.artefacts.items()
    networks = [
        (n, digest) for n, digest in stage.companions.items() if n.endswith(NETWORK_FILE) and work.path(n).is_file()
    ]
    return all(work.path(name).is_file() and work.digest(name) == digest for name, digest in (*artefacts, *networks))
