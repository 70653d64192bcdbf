"""What each sensor of a plan adds, and plans with another sensor on one pole.

Evidence: slow sums over single vehicles; the plan of a run with the other sensor; the loss that the plan states.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.artefacts.readers import LocationVisibility, SiteBlindspots
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.core.errors import InputError
from egvs.core.grid import Grid
from egvs.extensions.desk import plan_sensors
from egvs.results.plans import RefinementSummary, SensorPlan
from egvs.runs import stage_registry
from egvs.runs.run_context import open_folder
from egvs.scenario.model import Scenario
from egvs.scoring.blindspots import VehicleSpots
from egvs.scoring.road_locations import RoadLocation
from egvs.scoring.targets import TargetRecord
from egvs.stages.base import StageContext
from tests.conftest import write_mini
from tests.scoring.target_scenes import frame


@pytest.mark.parametrize("sensors", [1, 2, 4])
def test_what_one_sensor_finds_is_the_sum_over_vehicles(sensors: int) -> None:
    rng = np.random.default_rng(sensors)
    n, spots_of = 60, [("approach", "North Street (north) approach"), ("lane", "North Street (north), lane")]
    boxes = np.column_stack([rng.uniform(0, 20, (n, 2)), np.full((n, 4), 1.0), np.zeros(n)])
    record = TargetRecord.of([frame(boxes)], Grid((0.0, 0.0, 0.0), 1.0, (20, 20, 4)))
    assert len(record) == n
    weight, spot = rng.uniform(0.5, 2, n), rng.integers(0, 2, n)
    locations = [RoadLocation(by, by, words, (0.0, 0.0)) for by, words in spots_of]
    spots = VehicleSpots.at_locations(record, locations, np.arange(n), spot, weight, np.zeros(n, dtype=np.int64))
    chances = {f"s{number}": rng.uniform(0, 1, n) for number in range(sensors)}
    points = {name: np.zeros(n) for name in chances}

    found = plan_sensors.exclusive_visibility(spots, points, chances)
    for name in chances:
        for k in range(2):
            alone = total = 0.0
            for i in range(n):
                if spot[i] == k:
                    others = math.prod(1.0 - chances[other][i] for other in chances if other != name)
                    alone += weight[i] * chances[name][i] * others
                    total += weight[i]
            assert found[name].share[k] == pytest.approx(alone / total, rel=1e-12)


def location(by: str, words: str, share: float, vehicles: int = 50) -> LocationVisibility:
    return LocationVisibility(by, words, 0.0, 0.0, 500, vehicles, share, 0.01)


def test_sentences_name_the_largest_shares() -> None:
    locations = (
        location("all", "all vehicles", 0.123),
        location("approach", "North Street (north) approach", 0.344),
        location("exit", "East Street (east) exit", 0.2),
        location("exit", "East Street (west) exit", 0.1),
        location("approach", "Mill Lane (west) approach", 0.9, vehicles=3),
        location("lane", "North Street (north), left-turn lane", 0.41),
        location("lane", "East Street (east), exit lane", 0.2),
        location("crossing", "North Street (north) crosswalk", 0.004),
    )
    found = SiteBlindspots("a", locations, np.empty((0, 0)), (0.0, 0.0), 1.0)
    assert plan_sensors.describe_exclusive(found) == [
        "Vehicles that only this sensor finds: 34 % on North Street (north) approach, 20 % on East Street (east) exit "
        "and 12 % of all vehicles.",
        "Of other lanes, turns and crossings, most on North Street (north), left-turn lane (41 %).",
    ]
    no_vehicles: tuple[LocationVisibility, ...] = ()
    for overall in (no_vehicles, (location("all", "all vehicles", 0.004),)):
        (text,) = plan_sensors.describe_exclusive(replace(found, locations=overall))
        assert text == "The other sensors find almost every vehicle that it finds."


SCORES = ("expected_detections", "egvs")
"""Scores over vehicles, and over voxels."""


@pytest.fixture(scope="module", params=SCORES)
def planned(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[StageContext, SensorPlan]:
    """The run and the plan of both sensors of ``mini``."""
    folder = tmp_path_factory.mktemp("planned")
    settings = (f"score.rank_by={request.param}",)
    egvs.place(egvs.load(write_mini(folder / "mini"), (*settings, "placement.count=2")), folder / "run")
    plan = SensorPlan.read(RunFolder(folder / "run"))
    assert plan is not None
    return open_run(egvs.load(folder / "mini", settings), folder / "run"), plan


def open_run(scenario: Scenario, run: Path) -> StageContext:
    return open_folder(scenario, run, recorded=stage_registry.recorded_digests(RunRecord.read(run)))


def with_other_sensor(folder: Path, score: str, points: str = "", sensor: str = "VLP-16") -> Scenario:
    """Return ``mini`` with another sensor on one pole; its own sensor is known as ``small_too``, too."""
    toml = write_mini(folder) / "scenario.toml"
    own = toml.read_text().partition("[sensors.small]")[2].partition("[score]")[0]
    toml.write_text(f"{toml.read_text()}\n[sensors.small_too]{own}")
    rows = f"pole_a,10,12,3,,\npole_b,30.5,-12,3,{sensor},{points}\n"
    (folder / "sites.csv").write_text(f"site,x_m,y_m,z_m,sensor,points\n{rows}")
    return egvs.load(folder, [f"score.rank_by={score}"])


@pytest.mark.parametrize("planned", SCORES[:1], indirect=True)
def test_sentences_have_the_loss_that_the_plan_states(planned: tuple[StageContext, SensorPlan]) -> None:
    context, plan = planned
    texts = plan_sensors.describe_additions(context, plan)
    for sensor in plan.sensors:  # the scenario has no road network
        share = f"{100 * sensor.loss:.0f} % of all vehicles"
        assert texts[sensor.site] == [f"Vehicles that only this sensor finds: {share}."]


@pytest.mark.slow
def test_joint_score_is_that_of_a_run_with_the_other_sensor(
    planned: tuple[StageContext, SensorPlan], tmp_path: Path
) -> None:
    context, plan = planned
    other = with_other_sensor(tmp_path / "other", plan.score)
    tried = plan_sensors.try_sensors(context, plan, open_run(other, context.folder.path))
    joint = egvs.JointScore.of(other, tmp_path / "run")
    joint.add("pole_a", "pole_b")
    assert tried.joint == joint.value
    assert tried.joint != plan.joint
    settings = (f"score.rank_by={plan.score}", "placement.count=2")
    planned_there = egvs.place(egvs.load(tmp_path / "other", settings), tmp_path / "planned")
    assert tried.joint_se == pytest.approx(planned_there.joint_se, rel=1e-9)
    higher = replace(plan.sensors[0], z_m=4.0)
    refined = replace(plan, sensors=(higher, *plan.sensors[1:]), refinement=RefinementSummary(*[0.0] * 3, *[0] * 3))
    assert plan_sensors.try_sensors(context, refined, open_run(other, context.folder.path)).joint != tried.joint


def test_error_of_a_change_is_that_of_paired_blocks(planned: tuple[StageContext, SensorPlan], tmp_path: Path) -> None:
    """A sensor with the same beams under another name changes nothing, and with certainty."""
    context, plan = planned
    twin = with_other_sensor(tmp_path / "other", plan.score, sensor="small_too")
    tried = plan_sensors.try_sensors(context, plan, open_run(twin, context.folder.path))
    assert (tried.joint, tried.joint_se) == (plan.joint, pytest.approx(plan.joint_se, rel=1e-9))
    assert tried.change_se == pytest.approx(0.0, abs=1e-12 * plan.joint)


def test_sensor_with_measured_scan_cannot_be_exchanged(
    planned: tuple[StageContext, SensorPlan], tmp_path: Path
) -> None:
    context, plan = planned
    other = with_other_sensor(tmp_path / "other", plan.score, "scan.csv")
    with pytest.raises(InputError, match="its empty scan was measured"):
        plan_sensors.try_sensors(context, plan, open_run(other, context.folder.path))


def test_plan_with_its_own_sensors_is_no_trial(planned: tuple[StageContext, SensorPlan]) -> None:
    context, plan = planned
    with pytest.raises(InputError, match="its sensors are these already"):
        plan_sensors.try_sensors(context, plan, context)
