"""Verify a run: run it again from ``run.json`` in another folder, and compare every artefact byte for byte."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from egvs.artefacts import checksums
from egvs.artefacts.run_folder import STAGE_NAMES, RunFolder
from egvs.artefacts.run_record import RunRecord, StageRecord
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.progress import ProgressCallback, no_progress
from egvs.runs import stage_keys, stage_registry
from egvs.runs.run import StageListener, ignore_stage, start_record
from egvs.runs.run_context import open_folder
from egvs.scenario.loading import scenario_from_dict


def verify(
    folder: str | Path,
    scenario_folder: str | Path | None = None,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: StageListener = ignore_stage,
) -> list[str]:
    """Run again what ``run.json`` records, in a temporary folder and without the store, and compare.

    Parameters
    ----------
    folder
        Run folder.
    scenario_folder
        Folder of the scenario's files; the one in ``run.json`` when None.
    jobs, progress, listener
        As of :func:`egvs.runs.run.run`.

    Returns
    -------
    list of str
        One line for each artefact that was changed after the run, or that the new run does not reproduce.
    """
    folder = Path(folder)
    record = RunRecord.read(folder)
    record_file = RunFolder(folder).run_record
    for stage in STAGE_NAMES:
        if stage not in record.stages:
            raise InputError(record_file, f"the stage {stage} has not been run", "Finish the run with egvs run first.")
    source = Path(scenario_folder or os.path.normpath(folder / record.scenario_folder))
    if not source.is_dir():
        problem = f"the scenario's folder {source} does not exist"
        raise InputError(record_file, problem, "Give its new location with --scenario.")
    scenario = scenario_from_dict(record.scenario, source, str(record_file))

    differences = [*_changed_artefacts(folder, record), *_changed_companions(folder, record)]
    artefacts = {name for stage in record.stages.values() for name in stage.artefacts}
    with files.temporary_folder() as temporary:
        context = open_folder(scenario, temporary, jobs=jobs, progress=progress)
        new_record = start_record(scenario, temporary)
        for name, before in record.stages.items():
            studies = before.files.keys() - artefacts  # files of a study that the report shows
            _copy_unchanged(folder, temporary, {study: before.files[study] for study in studies})
            key = stage_keys.stage_key(name, context)
            for study in sorted(studies):
                if key.dependencies.files.get(study) != before.files[study]:
                    shown_in = " and ".join(before.artefacts) or f"the stage {name}"
                    differences.append(f"{shown_in} shows {study}, which was replaced since: run egvs {name} again")
            listener(name, "runs", None)
            after = key.record(stage_registry.run_stage(name, context, key.dependencies))
            listener(name, "done", after)
            new_record = new_record.having(name, replace(after, cost=before.cost))  # the report shows the cost
            new_record.write(temporary)
            differences += _differences(before, after)
    return differences


def _copy_unchanged(folder: Path, target: Path, digests: Mapping[str, str]) -> None:
    """Copy the files that are still in the run folder with these digests."""
    for name in digests:
        if Path(name).name == name and _is_unchanged(folder, name, digests):
            shutil.copyfile(folder / name, target / name)


def _changed_artefacts(folder: Path, record: RunRecord) -> Iterator[str]:
    """A line for each artefact that is missing or was changed."""
    for stage in record.stages.values():
        for name in stage.artefacts:
            if not _is_unchanged(folder, name, stage.artefacts):
                yield f"{name} was altered after the run"


def _changed_companions(folder: Path, record: RunRecord) -> Iterator[str]:
    """A line for each existing file beside the artefacts, or of a study, that was changed."""
    for stage in record.stages.values():
        for name in stage.companions:
            if (folder / name).is_file() and not _is_unchanged(folder, name, stage.companions):
                yield f"{name} was altered after the run"
    for file in RunFolder.checksum_files():
        for name in checksums.changed_files(folder / file.name, "Remove it."):
            yield f"{name} was altered after the study that made it"


def _is_unchanged(folder: Path, name: str, digests: Mapping[str, str]) -> bool:
    """Whether a file exists and has its recorded digest."""
    return (folder / name).is_file() and files.hash_file(folder / name) == digests[name]


def _differences(before: StageRecord, after: StageRecord) -> Iterator[str]:
    """A line for each artefact that two runs of a stage made differently."""
    for artefact in sorted(before.artefacts.keys() | after.artefacts.keys()):
        old = before.artefacts.get(artefact, "absent")
        new = after.artefacts.get(artefact, "absent")
        if old != new:
            yield f"{artefact} differs from that of the run: {old[:12]} then, {new[:12]} now"
