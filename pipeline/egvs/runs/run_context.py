"""The context in which stages work in a run folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from egvs.artefacts.run_folder import RunFolder
from egvs.core.digests import Digests
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.threads import thread_count
from egvs.scenario.model import Scenario
from egvs.stages.base import StageContext
from egvs.stages.inputs import Inputs


def open_folder(
    scenario: Scenario,
    folder: Path,
    *,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    recorded: Mapping[str, str] | None = None,
    digests: Digests | None = None,
) -> StageContext:
    """Return the context of stages that work in a run folder.

    Parameters
    ----------
    scenario
        The scenario.
    folder
        Where artefacts are read and written.
    jobs
        Number of threads; one per core when None. Results do not depend on it.
    progress
        Called as the work proceeds.
    recorded
        Digests in ``run.json`` by artefact, "" for an artefact that no stage recorded. An artefact with another digest
        is refused.
    digests
        The digests of a run in progress; new ones, with ``recorded``, when None.
    """
    if digests is None:
        digests = Digests(folder, recorded={folder / name: digest for name, digest in (recorded or {}).items()})
    run_folder = RunFolder(folder)
    inputs = Inputs(scenario, run_folder, progress, digests)
    return StageContext(scenario, inputs, run_folder, thread_count(jobs), progress)
