"""egvs: which pole, what height, how many roadside LiDARs?

How data flows, stage by stage (each a module of :mod:`pipeline.stages`, a verb of the command line, and an artefact)::

    scenario.toml -+-> traffic -> trajectories.parquet -> tpog -> tpog.parquet -+
                   |                                       ^                    +-> score -> scores.parquet -> report
                   +-> statics -> statics.ply -------------+-> scan -> scans.parquet

From a notebook::

    import pipeline

    scenario = pipeline.load("scenarios/nishishinjuku", ["traffic.frames=500"])
    record = pipeline.run(scenario, "runs/trial")
    tpog = pipeline.read_tpog("runs/trial/tpog.parquet")
    tpog.p  # share of frames in which each voxel is occupied

Any pose, not only the scenario's sites, in milliseconds::

    scene = pipeline.build_scene(scenario)
    scanner, scorer = pipeline.Scanner(scene), pipeline.Scorer(scene, tpog)
    pose = pipeline.Pose(x_m=12.0, y_m=30.0, z_m=4.5, yaw_deg=180.0)
    scorer.score(scanner.scan(pose, scene.sensor("VLP-32C"))).egvs

Several poses together, and plans with what is proved of them::

    joint = pipeline.JointScore.of(scenario, "runs/trial")
    joint.add("c03")
    joint.gain("c10")
    pipeline.place(pipeline.load("scenarios/nishishinjuku", ["placement.count=3"])).certificate

Names are imported when they are first used, so that ``import pipeline`` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from pipeline.core.version import __version__

if TYPE_CHECKING:
    from pipeline.artefacts.readers import (
        Tpog,
        read_scans,
        read_scores,
        read_scores_by_period,
        read_tpog,
        read_trajectories,
        read_visibility,
    )
    from pipeline.core.errors import EgvsError, InputError, RunError
    from pipeline.effects.scene_building import build_scene
    from pipeline.placement.joint_score import JointScore
    from pipeline.placement.placing import place
    from pipeline.runs.workflow import run, verify
    from pipeline.scenario.loading import load
    from pipeline.scenario.models import Scenario
    from pipeline.scoring.scorer import Scorer
    from pipeline.sensing.scanner import Scanner
    from pipeline.sensing.scene import Scene
    from pipeline.sensing.sensors import Sensor
    from pipeline.sensing.sites import Pose, Site
    from pipeline.world.mesh import World

_HOME = {
    "EgvsError": "core.errors",
    "InputError": "core.errors",
    "JointScore": "placement.joint_score",
    "Pose": "sensing.sites",
    "RunError": "core.errors",
    "Scanner": "sensing.scanner",
    "Scenario": "scenario.models",
    "Scene": "sensing.scene",
    "Scorer": "scoring.scorer",
    "Sensor": "sensing.sensors",
    "Site": "sensing.sites",
    "Tpog": "artefacts.readers",
    "World": "world.mesh",
    "build_scene": "effects.scene_building",
    "load": "scenario.loading",
    "place": "placement.placing",
    "read_scans": "artefacts.readers",
    "read_scores": "artefacts.readers",
    "read_scores_by_period": "artefacts.readers",
    "read_tpog": "artefacts.readers",
    "read_trajectories": "artefacts.readers",
    "read_visibility": "artefacts.readers",
    "run": "runs.workflow",
    "verify": "runs.workflow",
}
"""Public name -> the module that it is from."""

__all__ = [
    "EgvsError",
    "InputError",
    "JointScore",
    "Pose",
    "RunError",
    "Scanner",
    "Scenario",
    "Scene",
    "Scorer",
    "Sensor",
    "Site",
    "Tpog",
    "World",
    "__version__",
    "build_scene",
    "load",
    "place",
    "read_scans",
    "read_scores",
    "read_scores_by_period",
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
