"""Opens a run's folder or a scenario for exploring: what is not up to date is made first, as ``egvs run`` does."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from pipeline.artefacts.run_record import RECORD, RunRecord
from pipeline.core.errors import InputError
from pipeline.core.progress import Progress, silent
from pipeline.explore.session import Session
from pipeline.explore.settings import session_in
from pipeline.runs import workflow
from pipeline.runs.workflow import StageListener, unheard
from pipeline.scenario.loading import from_values, load
from pipeline.scenario.models import Scenario


def open_session(
    place: Path,
    sets: Sequence[str] = (),
    out: Path | None = None,
    *,
    jobs: int | None = None,
    progress: Progress = silent,
    listener: StageListener = unheard,
) -> Session:
    """A session over the folder of a run, or over a scenario's.

    Parameters
    ----------
    place
        A folder with a ``run.json``, or a scenario.
    sets, out
        Of a scenario: values laid over it, and the run's folder.

    Raises
    ------
    InputError
        When it is neither, or the scenario is wrong.
    """
    if (place / RECORD).is_file():
        given = "--set" if sets else "--out" if out is not None else None
        if given is not None:
            raise InputError(given, f"with the folder of a run, {place}", f"a scenario, or no {given}")
        scenario, folder = _recorded(place), place
    else:
        scenario = load(place, sets)
        folder = out or workflow.default_folder(scenario)
    return session_in(scenario, folder, jobs=jobs, progress=progress, listener=listener)


def _recorded(folder: Path) -> Scenario:
    """The scenario of a run."""
    record = RunRecord.read(folder)
    source = Path(os.path.normpath(folder / record.scenario_folder))
    if not source.is_dir():
        found = f"the scenario's folder {source} is not there"
        raise InputError(folder / RECORD, found, "name the scenario in place of the run")
    return from_values(record.scenario, source, str(folder / RECORD))
