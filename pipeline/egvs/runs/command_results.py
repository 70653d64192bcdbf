"""Keeps the results of a command in a run folder, and adds them to its report."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from egvs.artefacts.command_results import CommandResult, write_results
from egvs.artefacts.run_folder import RunFile, RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.runs.run import lock_run_folder, refresh_report
from egvs.runs.stage_registry import stage

LOCK_WAIT_S = 60.0
"""How long to wait for another command in the folder."""


def add_to_report(
    folder: Path,
    file: RunFile,
    values: Mapping[str, Mapping[str, Any]],
    stages: Iterable[str] | None = None,
    removed: Collection[str] = (),
) -> tuple[Path, ...]:
    """Write the results of a command into a run folder, and draw its report again.

    Parameters
    ----------
    folder
        The run folder.
    file
        The file of the command in it.
    values
        JSON values of each entry, by its name.
    stages
        Stages that the results depend on; all recorded ones but the report when None.
    removed
        Names of entries of the file that no longer hold.

    Returns
    -------
    tuple of Path
        The file, and the report if the run is complete.

    Raises
    ------
    InputError
        If the file in the folder is damaged.
    FolderInUseError
        If another command is still at work in the folder.
    """
    with lock_run_folder(folder, LOCK_WAIT_S):
        recorded = RunRecord.read(folder).stages
        names = [name for name in recorded if not stage(name).is_view] if stages is None else list(stages)
        inputs = {name: recorded[name].inputs for name in names}
        path = folder / file.name
        write_results(path, {name: CommandResult(inputs, entry) for name, entry in values.items()}, removed)
        report = refresh_report(RunFolder(folder).path)
    return (path,) if report is None else (path, report)
