"""Runs single stages in a folder, as a test wants them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipeline.core.progress import Progress, silent
from pipeline.scenario.models import Scenario
from pipeline.stages.base import StageInputs, Workspace


def run_stage(
    stage: Any,
    scenario: Scenario,
    out: Path,
    jobs: int | None = None,
    progress: Progress = silent,
    **options: Any,
) -> dict[str, Any]:
    """Run one stage in a folder that holds the artefacts of those before it; its summary."""
    out.mkdir(parents=True, exist_ok=True)
    work = Workspace(scenario, out, jobs=jobs, progress=progress)
    summary: dict[str, Any] = stage.run(work, stage.inputs(work), **options)
    return summary


def inputs_of(stage: Any, scenario: Scenario, out: Path) -> StageInputs:
    """What a stage reads."""
    found: StageInputs = stage.inputs(Workspace(scenario, out))
    return found
