"""egvs: which pole, what height, how many roadside LiDARs?

How data flows, stage by stage (each a module, a verb of the command line, and an artefact)::

    scenario.toml -+-> traffic --> trajectories.parquet --> tpog --> tpog.parquet ---+
                   |                                         ^                       +--> score --> scores.parquet --> report
                   +-> statics --> statics.ply --------------+--> scan --> scans.parquet --+

From a notebook::

    import pipeline

    scenario = pipeline.load("scenarios/nishishinjuku", ["traffic.frames=500"])
    record = pipeline.run(scenario, "runs/trial")
    p = pipeline.read_tpog("runs/trial/tpog.parquet").p

Names are imported when they are first used, so that ``import pipeline`` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.errors import EgvsError, InputError, RunError
    from pipeline.results import read_scans, read_scores, read_tpog, read_trajectories, read_visibility
    from pipeline.scenario import Scenario, load
    from pipeline.workflow import run, verify

__version__ = "0.1.0"

_HOME = {
    "EgvsError": "errors",
    "InputError": "errors",
    "RunError": "errors",
    "Scenario": "scenario",
    "load": "scenario",
    "read_scans": "results",
    "read_scores": "results",
    "read_tpog": "results",
    "read_trajectories": "results",
    "read_visibility": "results",
    "run": "workflow",
    "verify": "workflow",
}
_STAGES = ("traffic", "statics", "tpog", "scan", "score", "report")

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
    if name in _STAGES:
        return importlib.import_module(f"pipeline.{name}")
    raise AttributeError(f"module 'pipeline' has no attribute {name!r}")
