"""The context in which stages work in a run folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from egvs.artefacts.run_folder import RunFolder
from egvs.core.progress import ProgressCallback, no_progress
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
) -> StageContext:
    """Return the context of stages that work in a run folder; parameters as of :class:`StageContext`."""
    run_folder = RunFolder(folder)
    inputs = Inputs(scenario, run_folder, progress)
    return StageContext(inputs, run_folder, jobs=jobs, progress=progress, recorded=recorded)
