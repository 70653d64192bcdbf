"""A scenario becomes a ranking: static world and empty scans, traffic and the TPOG, scores, the report.

:func:`run` is the whole program. A stage whose inputs (settings by value, files by hash, the program's source) are
those of the last run, and whose artefacts are still what it wrote, is skipped; one that the store knows is fetched from
there; any other one is made, and kept in the store. After each stage that was made ``run.json`` is written anew, with
that stage and those before it, so that an interrupted run goes on from the last whole stage, and no record names
artefacts of another scenario than its own. A run that is refused before anything was made leaves the folder as it was.

:func:`verify` runs again what ``run.json`` says and compares every artefact byte for byte.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pipeline.artefacts import checksums
from pipeline.artefacts.readers import ACCURACY_SUMS, PLACEMENT_SUMS, VALIDATION_SUMS
from pipeline.artefacts.run_record import RECORD, STAGES, RunRecord, StageRecord
from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.core.progress import Progress, silent
from pipeline.core.version import __version__
from pipeline.runs import stage_keys, stages
from pipeline.runs.guarding import keep_inputs
from pipeline.runs.locking import alone
from pipeline.runs.stage_keys import Inputs
from pipeline.runs.stages import Made
from pipeline.runs.store import Store
from pipeline.scenario.loading import from_values
from pipeline.scenario.models import Scenario
from pipeline.stages.base import Workspace
from pipeline.traffic.sumo_folder import NETWORK

StageListener = Callable[[str, str, StageRecord | None], None]
"""Called with (stage, state, its record) as a run goes on.

States: "runs" (no record yet), then "done"; or "skipped" (nothing changed), or "fetched" (from the store).
"""


def unheard(_stage: str, _state: str, _record: StageRecord | None) -> None:
    """A :data:`StageListener` that says nothing."""


def run(
    scenario: Scenario,
    out: str | Path | None = None,
    *,
    jobs: int | None = None,
    progress: Progress = silent,
    listener: StageListener = unheard,
    options: dict[str, dict[str, Any]] | None = None,
    help_from: dict[str, dict[str, Any]] | None = None,
    only: Collection[str] = STAGES,
    wait_s: float = 0.0,
) -> RunRecord:
    """Bring every stage up to date, in order.

    Parameters
    ----------
    scenario
        From :func:`pipeline.load`.
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
    """
    folder = Path(out) if out is not None else default_folder(scenario)
    keep_inputs(scenario, folder)
    with alone(folder, wait_s):
        run = _Run(Workspace(scenario, folder, jobs=jobs, progress=progress), listener, help_from or {})
        record = _record_so_far(scenario, folder)
        for name in (stage for stage in STAGES if stage in only):
            record = run.bring(name, record, **(options or {}).get(name, {}))
        return run.end(record, [stage for stage in record.stages if stage not in (*only, "report")])


def run_one(
    name: str,
    scenario: Scenario,
    out: Path,
    *,
    jobs: int | None = None,
    progress: Progress = silent,
    listener: StageListener = unheard,
    **options: Any,
) -> RunRecord:
    """Run a single stage, whether its inputs changed or not, and note it in ``run.json``."""
    keep_inputs(scenario, out)
    with alone(out):
        record = _record_so_far(scenario, out)
        work = Workspace(scenario, out, jobs=jobs, progress=progress, recorded=stages.recorded(record))
        run = _Run(work, listener)
        record = run.bring(name, record, again=True, **options)
        return run.end(record, [stage for stage in record.stages if stage != name])


def refresh_report(out: Path) -> Path | None:
    """Draw the report of a whole run anew where something that it shows has changed (an accuracy study); its path.

    None, and nothing is done, where there is no whole run. For those who hold the folder
    (:func:`pipeline.runs.locking.alone`).
    """
    if not (out / RECORD).is_file():
        return None
    record = RunRecord.read(out)
    source = Path(os.path.normpath(out / record.scenario_folder))
    if not all(name in record.stages for name in STAGES) or not source.is_dir():
        return None
    scenario = from_values(record.scenario, source, str(out / RECORD))
    work = Workspace(scenario, out)
    before = {name: stage for name, stage in record.stages.items() if name != "report"}
    if not all(_is_of(name, work, record) and _intact(work, stage) for name, stage in before.items()):
        return None
    run = _Run(work, unheard, whole=set(before))
    run.end(run.bring("report", record), ())
    return out / "report.html"


def default_folder(scenario: Scenario) -> Path:
    """Where a run goes when no folder is given."""
    return Path("runs") / scenario.name


def fetch_or_make(
    name: str, work: Workspace, key: str, store: Store, make: Callable[[], Made], *, link: bool = False
) -> tuple[Made, bool]:
    """A stage's artefacts in a workspace: from the store, else made, and kept there.

    Of several processes that want the same, one makes it. Returns what came of it, and whether it came from the store.
    """
    out = work.folder
    work.forget(*stages.written_by(name))
    if (entry := store.take(name, key, out, link=link)) is None:
        with store.maker(name, key, progress=work.progress):
            store.fetch(name, key)
            if (entry := store.take(name, key, out, link=link)) is None:  # nor has another one made it meanwhile
                made = make()
                store.put(name, key, out, made, link=link)
                return made, False
    for other in set(stages.artefacts_of(name)) - set(entry.made.artefacts):
        (out / other).unlink(missing_ok=True)  # as the stage does
    return entry.made, True


def bring(work: Workspace, *names: str) -> dict[str, str]:
    """The artefacts of some stages, in their order, into a workspace that is no run's folder: from the store, else
    made, and kept there. Returns their keys."""
    keys = {}
    for name in names:
        inputs = stage_keys.inputs(name, work)
        read = inputs.read
        fetch_or_make(name, work, inputs.key, Store.default(), lambda: stages.make(name, work, read), link=True)  # noqa: B023 - called at once
        keys[name] = inputs.key
    return keys


@dataclass
class _Run:
    """One scenario in one folder.

    Attributes
    ----------
    whole
        The stages that are known to be this scenario's. Of the others a record may know from earlier runs.
    is_other
        Whether artefacts in the folder are others than they were.
    """

    work: Workspace
    listener: StageListener
    help_from: dict[str, dict[str, Any]] = field(default_factory=dict)
    store: Store = field(default_factory=Store.default)
    whole: set[str] = field(default_factory=set)
    is_other: bool = False

    def bring(self, name: str, record: RunRecord, *, again: bool = False, **options: Any) -> RunRecord:
        """Bring one stage up to date; the record of the run with it. What is whole of it is written once artefacts were
        made.

        A stage with ``options`` is always run, and its artefacts are not kept in the store; ``again``: always run.
        """
        work = self.work
        inputs = stage_keys.inputs(name, work)
        last = record.stages.get(name)
        if last and not (again or options) and last.inputs == inputs.key and _intact(work, last):
            self.listener(name, "skipped", last)
            return self._with(name, last, record)
        made, fetched = self._made(name, inputs, again, options)
        done = inputs.record(made)
        self.is_other |= bool(done.artefacts)
        record = self._with(name, done, record)
        self.listener(name, "fetched" if fetched else "done", done)
        return record

    def end(self, record: RunRecord, others: Collection[str]) -> RunRecord:
        """The record without those of the other stages that are of other settings, which it would contradict; written
        where it is another one than before."""
        for name in [stage for stage in others if not _is_of(stage, self.work, record)]:
            record = record.having(name, None)
        folder = self.work.folder
        if not (folder / RECORD).is_file() or RunRecord.read(folder) != record:
            record.write(folder)
        return record

    def _with(self, name: str, stage: StageRecord, record: RunRecord) -> RunRecord:
        self.whole.add(name)
        record = record.having(name, stage)
        if self.is_other:
            whole = {name: stage for name, stage in record.stages.items() if name in self.whole}
            replace(record, stages=whole).write(self.work.folder)
        return record

    def _made(self, name: str, inputs: Inputs, again: bool, options: dict[str, Any]) -> tuple[Made, bool]:
        work = self.work

        def make() -> Made:
            self.listener(name, "runs", None)
            return stages.make(name, work, inputs.read, **self.help_from.get(name, {}), **options)

        if not (again or options):
            return fetch_or_make(name, work, inputs.key, self.store, make)
        made = make()
        if not options:
            with self.store.maker(name, inputs.key, wait=False) as mine:
                if mine:
                    self.store.put(name, inputs.key, work.folder, made)
        return made, False


def _record_so_far(scenario: Scenario, folder: Path) -> RunRecord:
    """What is known of earlier work in this folder, with the scenario as it is now."""
    home = Path(os.path.relpath(scenario.folder, folder)).as_posix()
    known = RunRecord.read(folder).stages if (folder / RECORD).is_file() else {}
    return RunRecord(__version__, scenario.seed, scenario.model_dump(mode="json"), home, known)


def _is_of(name: str, work: Workspace, record: RunRecord) -> bool:
    """Whether a stage's last run is what this scenario, and the artefacts as they are now, would give."""
    try:
        return record.stages[name].inputs == stage_keys.inputs(name, work).key
    except InputError:
        return False


def _intact(work: Workspace, stage: StageRecord) -> bool:
    """Whether artefacts are what the stage wrote, and a network that the report draws, where it is still there."""
    artefacts = stage.artefacts.items()
    networks = [(n, digest) for n, digest in stage.companions.items() if n.endswith(NETWORK) and work.path(n).is_file()]
    return all(work.path(name).is_file() and work.digest(name) == digest for name, digest in (*artefacts, *networks))


def verify(
    folder: str | Path,
    scenario_folder: str | Path | None = None,
    *,
    jobs: int | None = None,
    progress: Progress = silent,
    listener: StageListener = unheard,
) -> list[str]:
    """Run again what ``folder/run.json`` says, elsewhere, and compare. Nothing is taken from the store.

    Parameters
    ----------
    scenario_folder
        Where the scenario's files are; where ``run.json`` says when None.

    Returns
    -------
    list of str
        One line for each artefact that differs: altered since the run, or not reproduced by it. Empty when all is well.
    """
    folder = Path(folder)
    record = RunRecord.read(folder)
    missing = [name for name in STAGES if name not in record.stages]
    if missing:
        raise InputError(folder / RECORD, f"the stage {missing[0]} is not done", "a finished run; call egvs run first")
    source = Path(scenario_folder or os.path.normpath(folder / record.scenario_folder))
    if not source.is_dir():
        raise InputError(folder / RECORD, f"the scenario's folder {source} is not there", "name it with --scenario")
    scenario = from_values(record.scenario, source, str(folder / RECORD))
    made_by_stages = {name: digest for stage in record.stages.values() for name, digest in stage.artefacts.items()}
    wrong = [f"{name} was altered after the run" for name in made_by_stages if not _holds(folder, name, made_by_stages)]
    wrong += _altered_beside(folder, record)
    with files.scratch() as elsewhere:
        work = Workspace(scenario, elsewhere, jobs=jobs, progress=progress)
        again = _record_so_far(scenario, elsewhere)
        for name, before in record.stages.items():
            beside = before.files.keys() - made_by_stages.keys()
            for file in beside:  # an accuracy study, which the report shows
                if Path(file).name == file and _holds(folder, file, before.files):
                    shutil.copyfile(folder / file, elsewhere / file)
            inputs = stage_keys.inputs(name, work)
            for file in sorted(file for file in beside if inputs.read.files.get(file) != before.files[file]):
                made_of_it = " and ".join(before.artefacts) or f"the stage {name}"
                wrong.append(f"{made_of_it} shows {file}, which was replaced since; egvs {name} makes it anew")
            listener(name, "runs", None)
            made = stages.make(name, work, inputs.read)
            after = inputs.record(made)
            listener(name, "done", after)
            again = again.having(name, replace(after, cost=before.cost))  # which the report shows
            again.write(elsewhere)
            wrong += _differences(before, after)
    return wrong


def _altered_beside(folder: Path, record: RunRecord) -> Iterator[str]:
    """A line for each file beside the artefacts that is there, and is another one by now."""
    for stage in record.stages.values():
        for name in stage.companions:
            if (folder / name).is_file() and not _holds(folder, name, stage.companions):
                yield f"{name} was altered after the run"
    for sums in (ACCURACY_SUMS, VALIDATION_SUMS, PLACEMENT_SUMS):
        for name in checksums.altered(folder / sums, "remove it"):
            yield f"{name} was altered after the study that made it"


def _holds(folder: Path, name: str, digests: dict[str, str]) -> bool:
    """Whether a file is there as it was."""
    return (folder / name).is_file() and files.sha256_of(folder / name) == digests[name]


def _differences(before: StageRecord, after: StageRecord) -> Iterator[str]:
    for artefact in sorted(before.artefacts.keys() | after.artefacts.keys()):
        then, now = (stage.artefacts.get(artefact, "absent")[:12] for stage in (before, after))
        if then != now:
            yield f"{artefact} differs from what the run made: {then} then, {now} now"
