"""egvs: which pole, what height, how many roadside LiDARs?

How data flows, stage by stage (each a module of :mod:`pipeline.stages`, a verb of the command line, and an artefact)::

    scenario.toml -+-> traffic -> trajectories.parquet -> tpog -> tpog.parquet -+
                   |                                       ^                    +-> score -> scores.parquet -> report
                   +-> statics -> statics.ply -------------+-> scan -> scans.parquet

From a notebook::

    import pipeline

    scenario = pipeline.load("scenarios/nishishinjuku", ["traffic.frames=500"])
    record = pipeline.run(scenario, "runs/trial")
    p = pipeline.read_tpog("runs/trial/tpog.parquet").p  # share of frames in which each voxel is occupied

Names are imported when they are first used, so that ``import pipeline`` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from pipeline.core.version import __version__

if TYPE_CHECKING:
    from pipeline.artefacts.readers import read_scans, read_scores, read_tpog, read_trajectories, read_visibility
    from pipeline.core.errors import EgvsError, InputError, RunError
    from pipeline.runs.workflow import run, verify
    from pipeline.scenario.loading import load
    from pipeline.scenario.models import Scenario

_HOME = {
    "EgvsError": "core.errors",
    "InputError": "core.errors",
    "RunError": "core.errors",
    "Scenario": "scenario.models",
    "load": "scenario.loading",
    "read_scans": "artefacts.readers",
    "read_scores": "artefacts.readers",
    "read_tpog": "artefacts.readers",
    "read_trajectories": "artefacts.readers",
    "read_visibility": "artefacts.readers",
    "run": "runs.workflow",
    "verify": "runs.workflow",
}

__all__ = [
    "EgvsError",
    "InputError",
    "RunError",
    "Scenario",
    "__version__",
    "load",
    "read_scans",
    "read_scores",
    "read_tpog",
    "read_trajectories",
    "read_visibility",
    "run",
    "verify",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f"pipeline.{_HOME[name]}"), name)
    raise AttributeError(f"module 'pipeline' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
