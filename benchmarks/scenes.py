"""Single stages and recorded traffic for benchmarks."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts.frame_boxes import FrameBoxes, read_boxes
from egvs.runs.run_context import open_folder
from egvs.scenario.model import Scenario
from egvs.scoring.occupancy import near_grid
from egvs.stages import traffic


def run_stage(stage: Any, scenario: Scenario, folder: Path, **options: Any) -> dict[str, Any]:
    """Run one stage in a folder with the artefacts of the stages before it."""
    work = open_folder(scenario, folder)
    summary: dict[str, Any] = stage.STAGE.run(work, stage.STAGE.dependencies(work), **options)
    return summary


def recorded_boxes(scenario: Scenario) -> FrameBoxes:
    """Simulate the traffic of a scenario, and return boxes near its grid, in the grid's frame."""
    with tempfile.TemporaryDirectory() as temporary:
        run_stage(traffic, scenario, Path(temporary))
        groups = list(read_boxes(Path(temporary) / "trajectories.parquet", scenario.roi.grid))
    frame, values = (np.concatenate([getattr(group, name) for group in groups]) for name in ("frame", "values"))
    near = near_grid(values, scenario.roi.grid)
    return FrameBoxes(frame[near], values[near])
