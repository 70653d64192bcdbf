"""Runs single stages in a folder, as a test wants them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from egvs.core.progress import ProgressCallback, no_progress
from egvs.runs.run_context import open_folder
from egvs.scenario.model import Scenario
from egvs.stages.base import StageDependencies


def run_stage(
    stage: Any,
    scenario: Scenario,
    out: Path,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    **options: Any,
) -> dict[str, Any]:
    """Run one stage in a folder that holds the artefacts of those before it; its summary."""
    out.mkdir(parents=True, exist_ok=True)
    work = open_folder(scenario, out, jobs=jobs, progress=progress)
    summary: dict[str, Any] = stage.STAGE.run(work, stage.STAGE.dependencies(work), **options)
    return summary


def inputs_of(stage: Any, scenario: Scenario, out: Path) -> StageDependencies:
    """What a stage reads."""
    found: StageDependencies = stage.STAGE.dependencies(open_folder(scenario, out))
    return found
