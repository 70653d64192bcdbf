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
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from egvs.artefacts import checksums
from egvs.artefacts.run_folder import STAGE_NAMES, RunFolder
from egvs.artefacts.run_record import RunRecord, StageRecord
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.runs import stages
from egvs.runs.run import StageListener, _record_so_far, ignore_stage
from egvs.scenario.loading import scenario_from_dict
from egvs.stages.inputs import open_folder


def verify(
    folder: str | Path,
    scenario_folder: str | Path | None = None,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: StageListener = ignore_stage,
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
    missing = [name for name in STAGE_NAMES if name not in record.stages]
    if missing:
        raise InputError(
            RunFolder(folder).run_record, f"the stage {missing[0]} is not done", "a finished run; call egvs run first"
        )
    source = Path(scenario_folder or os.path.normpath(folder / record.scenario_folder))
    if not source.is_dir():
        raise InputError(
            RunFolder(folder).run_record, f"the scenario's folder {source} is not there", "name it with --scenario"
        )
    scenario = scenario_from_dict(record.scenario, source, str(RunFolder(folder).run_record))
    made_by_stages = {name: digest for stage in record.stages.values() for name, digest in stage.artefacts.items()}
    wrong = [
        f"{name} was altered after the run"
        for name in made_by_stages
        if not _is_unchanged(folder, name, made_by_stages)
    ]
    wrong += _altered_companions(folder, record)
    with files.temporary_folder() as elsewhere:
        work = open_folder(scenario, elsewhere, jobs=jobs, progress=progress)
        again = _record_so_far(scenario, elsewhere)
        for name, before in record.stages.items():
            beside = before.files.keys() - made_by_stages.keys()
            for file in beside:  # an accuracy study, which the report shows
                if Path(file).name == file and _is_unchanged(folder, file, before.files):
                    shutil.copyfile(folder / file, elsewhere / file)
            inputs = stages.stage_key(name, work)
            for file in sorted(file for file in beside if inputs.dependencies.files.get(file) != before.files[file]):
                made_of_it = " and ".join(before.artefacts) or f"the stage {name}"
                wrong.append(f"{made_of_it} shows {file}, which was replaced since; egvs {name} makes it anew")
            listener(name, "runs", None)
            made = stages.run_stage(name, work, inputs.dependencies)
            after = inputs.record(made)
            listener(name, "done", after)
            again = again.having(name, replace(after, cost=before.cost))  # which the report shows
            again.write(elsewhere)
            wrong += _differences(before, after)
    return wrong


def _altered_companions(folder: Path, record: RunRecord) -> Iterator[str]:
    """A line for each file beside the artefacts that is there, and is another one by now."""
    for stage in record.stages.values():
        for name in stage.companions:
            if (folder / name).is_file() and not _is_unchanged(folder, name, stage.companions):
                yield f"{name} was altered after the run"
    for sums in (
        RunFolder.accuracy_checksums.name,
        RunFolder.validation_checksums.name,
        RunFolder.placement_checksums.name,
    ):
        for name in checksums.changed_files(folder / sums, "remove it"):
            yield f"{name} was altered after the study that made it"


def _is_unchanged(folder: Path, name: str, digests: dict[str, str]) -> bool:
    """Whether a file is there as it was."""
    return (folder / name).is_file() and files.hash_file(folder / name) == digests[name]


def _differences(before: StageRecord, after: StageRecord) -> Iterator[str]:
    for artefact in sorted(before.artefacts.keys() | after.artefacts.keys()):
        then, now = (stage.artefacts.get(artefact, "absent")[:12] for stage in (before, after))
        if then != now:
            yield f"{artefact} differs from what the run made: {then} then, {now} now"
