"""egvs: which pole, what height, how many roadside LiDARs?

How data flows, stage by stage (each a module of :mod:`egvs.stages`, a verb of the command line, and an artefact)::

    scenario.toml -+-> traffic -> trajectories.parquet -> tpog -> tpog.parquet -+
                   |                                       ^                    +-> score -> scores.parquet -> report
                   +-> statics -> statics.ply -------------+-> scan -> scans.parquet

From a notebook::

    import egvs

    scenario = egvs.load("scenarios/nishishinjuku", ["traffic.frames=500"])
    record = egvs.run(scenario, "runs/trial")
    tpog = egvs.read_tpog("runs/trial/tpog.parquet")
    tpog.p  # share of frames in which each voxel is occupied

Any pose, not only the scenario's sites, with all scores of the run::

    session = egvs.open_session("runs/trial")
    rated = session.rate("c03", egvs.Pose(x_m=12.0, y_m=30.0, z_m=4.5, yaw_deg=180.0))  # c03's sensor, moved
    rated.scores["expected_detections"]

Empty scans, and the scores that need no recorded vehicles, in milliseconds::

    scene = egvs.build_scene(scenario)
    scanner, scorer = egvs.Scanner(scene), egvs.Scorer(scene, tpog)
    pose = egvs.Pose(x_m=12.0, y_m=30.0, z_m=4.5, yaw_deg=180.0)
    scorer.score(scanner.scan(pose, scene.sensor("VLP-32C"))).egvs

Several poses together, and plans with proven bounds on their quality::

    joint = egvs.JointScore.of(scenario, "runs/trial")
    joint.add("c03")
    joint.gain("c10")
    egvs.place(egvs.load("scenarios/nishishinjuku", ["placement.count=3"])).certificate

What a planner does next; the report of the run shows the result::

    egvs.what_if("scenarios/nishishinjuku").answers

From maps to a scenario, and what accuracy and effects cost::

    egvs.create_scenario("myplace", "extract.osm", at=(50.8704, 9.7080))
    egvs.run_accuracy_study("myplace", [], "runs/myplace", egvs.StudyOptions(egvs.Tolerance(1.0), budget_s=120.0))
    egvs.effect_statuses(egvs.load("myplace"), "runs/myplace")

Labelled point clouds with traffic, for detectors::

    egvs.write_clouds(egvs.load("myplace"), "clouds", sites=["c03"], frames=100)

Names are imported when they are first used, so that ``import egvs`` costs nothing. Those of an extension are imported
from its package, for example ``from egvs.extensions.NAME import ...``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from egvs._version import __version__
from egvs.core.lazy import lazy_exports

if TYPE_CHECKING:
    from egvs.artefacts.readers import read_scans, read_scores, read_scores_by_period, read_visibility
    from egvs.artefacts.tpog import Tpog, read_tpog
    from egvs.artefacts.traffic_frames import read_trajectories
    from egvs.clouds.simulation import write_clouds
    from egvs.core.errors import EgvsError, InputError, RunError
    from egvs.creation.new_scenario import NewScenarioOptions, create_scenario
    from egvs.explore.settings import open_session
    from egvs.export.figure import draw_figure
    from egvs.placement.plan import JointScore, place
    from egvs.results.studies import Tolerance
    from egvs.runs.run import run
    from egvs.runs.verification import verify
    from egvs.scenario.loading import load
    from egvs.scenario.model import Scenario
    from egvs.scenario.shipped import shipped_scenario
    from egvs.scoring.scorer import Scorer
    from egvs.sensors.scanner import Scanner
    from egvs.sensors.scene import Scene
    from egvs.sensors.sensor import Sensor
    from egvs.sensors.sites import Pose, Site
    from egvs.stages.inputs import build_scene
    from egvs.studies.accuracy import StudyOptions, run_accuracy_study
    from egvs.studies.effect_study import effect_statuses, run_ablation
    from egvs.studies.run_comparison import compare_runs
    from egvs.studies.what_if import what_if
    from egvs.world.mesh import World

__all__ = [
    "EgvsError",
    "InputError",
    "JointScore",
    "NewScenarioOptions",
    "Pose",
    "RunError",
    "Scanner",
    "Scenario",
    "Scene",
    "Scorer",
    "Sensor",
    "Site",
    "StudyOptions",
    "Tolerance",
    "Tpog",
    "World",
    "__version__",
    "build_scene",
    "compare_runs",
    "create_scenario",
    "draw_figure",
    "effect_statuses",
    "load",
    "open_session",
    "place",
    "read_scans",
    "read_scores",
    "read_scores_by_period",
    "read_tpog",
    "read_trajectories",
    "read_visibility",
    "run",
    "run_ablation",
    "run_accuracy_study",
    "shipped_scenario",
    "verify",
    "what_if",
    "write_clouds",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "artefacts.readers": ["read_scans", "read_scores", "read_scores_by_period", "read_visibility"],
        "artefacts.tpog": ["Tpog", "read_tpog"],
        "artefacts.traffic_frames": ["read_trajectories"],
        "clouds.simulation": ["write_clouds"],
        "core.errors": ["EgvsError", "InputError", "RunError"],
        "creation.new_scenario": ["NewScenarioOptions", "create_scenario"],
        "explore.settings": ["open_session"],
        "export.figure": ["draw_figure"],
        "placement.plan": ["JointScore", "place"],
        "results.studies": ["Tolerance"],
        "runs.run": ["run"],
        "runs.verification": ["verify"],
        "scenario.loading": ["load"],
        "scenario.model": ["Scenario"],
        "scenario.shipped": ["shipped_scenario"],
        "scoring.scorer": ["Scorer"],
        "sensors.scanner": ["Scanner"],
        "sensors.scene": ["Scene"],
        "sensors.sensor": ["Sensor"],
        "sensors.sites": ["Pose", "Site"],
        "stages.inputs": ["build_scene"],
        "studies.accuracy": ["StudyOptions", "run_accuracy_study"],
        "studies.effect_study": ["effect_statuses", "run_ablation"],
        "studies.run_comparison": ["compare_runs"],
        "studies.what_if": ["what_if"],
        "world.mesh": ["World"],
        "_version": ["__version__"],
    },
)
