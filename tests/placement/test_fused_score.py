"""Plans in fused point clouds: values of plans, swaps, and what ``egvs place`` returns."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import egvs
from egvs.placement import fused_score
from egvs.placement.fused_score import FusedScore, improve_by_fused_swaps
from egvs.placement.problem import Plan, PlanRules, Problem
from egvs.runs.run_context import open_folder
from egvs.scoring.fused_targets import fuse_targets
from egvs.scoring.noticed import noticed_chances
from egvs.scoring.target_scores import expected_detections
from egvs.scoring.targets import TargetRecord, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from egvs.sensors.sites import Pose
from tests.conftest import write_mini
from tests.placement.instances import make_matrix, make_term

FIVE_SITES = """site,x_m,y_m,z_m
a,10,12,3
b,30.5,-12,3
b_high,30.5,-12,5
c,2,-12,4
d,38,12,4
"""
FOUND = "score.rank_by='expected_detections'"


class TableScore(FusedScore):
    """Values of plans from a function."""

    def __init__(self, value_of: Any) -> None:
        self._value_of = value_of
        self.asked: list[Plan] = []

    def value(self, plan: Any) -> float:
        self.asked.append(tuple(sorted(plan)))
        return float(self._value_of(plan))

    def prepare(self, candidates: Any) -> None:
        """Nothing to do."""


def problem_of(hits: np.ndarray, weight: np.ndarray, count: int, **rules: Any) -> Problem:
    """Return a problem of candidates with poles of their own, with these hits (candidates, cells)."""
    candidates = len(hits)
    term = make_term("", make_matrix(hits), weight)
    no_limits = PlanRules(
        count=count,
        budget=np.inf,
        cost=np.zeros(candidates),
        pole_cost=np.zeros(candidates),
        pole=np.arange(candidates),
        forced=(),
        excluded=np.zeros(candidates, dtype=np.bool_),
        most_per_pole=candidates,
        position_m=np.zeros((candidates, 3)),
        least_distance_m=0.0,
    )
    return Problem(joint=term, objective=(term,), demands=(), rules=replace(no_limits, **rules))


@pytest.mark.parametrize("seed", range(5))
def test_no_swap_is_better_afterwards(seed: int) -> None:
    rng = np.random.default_rng(seed)
    problem = problem_of(rng.integers(0, 4, (8, 30)), rng.random(30), 3)
    of_pair = rng.random((8, 8))
    score = TableScore(lambda plan: sum(of_pair[min(p), max(p)] for p in itertools.combinations(plan, 2)))
    improved = improve_by_fused_swaps(problem, score, (0, 1, 2))
    assert len(set(improved)) == 3 and score.value(improved) >= score.value((0, 1, 2))
    for sensor, other in itertools.product(improved, set(range(8)) - set(improved)):
        swapped = [candidate for candidate in improved if candidate != sensor] + [other]
        assert score.value(swapped) <= score.value(improved)


def test_swaps_keep_forced_and_excluded_candidates_and_the_budget() -> None:
    rng = np.random.default_rng(3)
    excluded = np.zeros(6, dtype=np.bool_)
    excluded[5] = True
    cost = np.array([0.0, 1.0, 1.0, 1.0, 9.0, 1.0])
    problem = problem_of(
        rng.integers(0, 4, (6, 30)), rng.random(30), 2, forced=(0,), excluded=excluded, cost=cost, budget=2.0
    )
    score = TableScore(lambda plan: sum(plan))  # would take 4 and 5
    assert set(improve_by_fused_swaps(problem, score, (0, 1))) == {0, 3}
    assert all(plan[0] == 0 and plan[1] < 4 for plan in score.asked)


def test_few_candidates_are_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that add most to the others as independent sensors."""
    monkeypatch.setattr(fused_score, "SWAP_CANDIDATES", 2)
    problem = problem_of(np.eye(6, dtype=np.int64), np.arange(1.0, 7.0), 1)
    score = TableScore(lambda plan: -plan[0])
    assert improve_by_fused_swaps(problem, score, (1,)) == (1,)
    assert set(score.asked) == {(1,), (5,), (4,)}


@pytest.fixture(scope="module")
def placed(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A plan of two of five candidates, and what each candidate sees, from a scan of its own."""
    folder = write_mini(tmp_path_factory.mktemp("fused") / "mini")
    (folder / "sites.csv").write_text(FIVE_SITES)
    scenario = egvs.load(folder, [FOUND, "placement.count=2", "tpog.blocks=10"])
    out = folder.parent / "out"
    placement = egvs.place(scenario, out)
    scene = open_folder(scenario, out).scene
    record = TargetRecord.read(out / "trajectories.parquet", scenario.roi.grid, scenario.score.sampled_frames)
    scanner = Scanner(scene)
    views = {site.name: visible_targets(record, Beams.of(scanner.scan_site(site))) for site in scene.sites}
    return SimpleNamespace(placement=placement, views=views, folder=folder, out=out)


@pytest.mark.slow
def test_values_are_those_of_scans_made_by_hand(placed: SimpleNamespace) -> None:
    placement, fused = placed.placement, placed.placement.fused
    names = [sensor.site for sensor in placement.sensors]
    views = [placed.views[name] for name in names]
    values = [expected_detections(fuse_targets(views[:count])) for count in (1, 2)]
    assert [step.score for step in fused.steps] == pytest.approx(values, rel=1e-12)
    assert fused.steps[1].gain == pytest.approx(values[1] - values[0], rel=1e-9)
    assert fused.steps[0].score == pytest.approx(placement.sensors[0].score, rel=1e-9)  # one sensor is not fused
    assert fused.steps[0].score_se == pytest.approx(placement.sensors[0].score_se, rel=1e-6)
    assert 0.0 < fused.steps[1].gain_se < math.inf


@pytest.mark.slow
def test_what_people_notice_of_a_plan_is_a_mean_over_points_of_all_sensors(placed: SimpleNamespace) -> None:
    """The points of both sensors, added here, on the curve of cars as the documentation states its values."""
    points = sum(placed.views[sensor.site].points for sensor in placed.placement.sensors)
    at = np.log1p([0.0, 1.0, 10**0.5, 50**0.5, 200**0.5, 1000**0.5, 5000**0.5, 30000**0.5, 300.0])
    shares = [0.0, 0.32, 0.458352, 0.458352, 0.6, 0.865902, 0.865902, 0.94, 0.96]
    noticed = placed.placement.fused.noticed
    assert noticed.value == pytest.approx(np.interp(np.log1p(points), at, shares).mean(), abs=1e-5)
    assert noticed.low == noticed.high == pytest.approx(noticed.value, rel=1e-12)
    hats = [np.interp(np.log1p(points), at, row).mean() for row in np.eye(9)[1:]]
    pools = [hats[0], hats[1] + hats[2], hats[3], hats[4] + hats[5], hats[6], hats[7]]
    of_curve = np.array(pools) * [0.06, 0.073110, 0.14, 0.038411, 0.03, 0.02]
    assert noticed.se**2 > (of_curve**2).sum()  # the rest is the error of the traffic
    assert noticed.se**2 < (of_curve**2).sum() + 0.05**2


@pytest.mark.slow
def test_no_pair_of_candidates_finds_more(placed: SimpleNamespace) -> None:
    """Here the local search ends at the best of all pairs."""
    fused = placed.placement.fused
    assert fused.searched
    pairs = {
        pair: expected_detections(fuse_targets([placed.views[name] for name in pair]))
        for pair in itertools.combinations(sorted(placed.views), 2)
    }
    names = fused.better_sites or tuple(sensor.site for sensor in placed.placement.sensors)
    value = fused.steps[-1].score + (fused.better.gain if fused.better else 0.0)
    assert value == pytest.approx(pairs[tuple(sorted(names))], rel=1e-9)
    assert value == pytest.approx(max(pairs.values()), rel=1e-9)


@pytest.mark.slow
def test_plans_by_points_have_no_values_in_fused_clouds(placed: SimpleNamespace) -> None:
    settings = ["score.rank_by='points_on_target'", "placement.count=2", "tpog.blocks=10"]
    assert egvs.place(egvs.load(placed.folder, settings), placed.out).fused is None


@pytest.mark.slow
def test_what_people_notice_of_a_plan_of_one_sensor_is_that_of_its_scan(placed: SimpleNamespace) -> None:
    settings = [FOUND, "placement.count=1", "tpog.blocks=10"]
    plan = egvs.place(egvs.load(placed.folder, settings), placed.out)
    (sensor,) = plan.sensors
    assert not plan.fused.searched and plan.fused.better is None
    assert plan.fused.noticed.value == pytest.approx(noticed_chances(placed.views[sensor.site]).mean(), rel=1e-12)
    assert plan.fused.noticed.se > 0.0


@pytest.mark.slow
@pytest.mark.system  # matplotlib, which cma imports, asks for fonts once
def test_refined_sensors_are_scanned_where_they_are(placed: SimpleNamespace) -> None:
    limits = ["placement.refine.evaluations=20", "placement.refine.radius_m=2", "placement.refine.heights_m=[2, 5]"]
    scenario = egvs.load(placed.folder, [FOUND, "placement.count=2", "tpog.blocks=10", *limits])
    refined = egvs.place(scenario, placed.out)
    assert refined.refinement is not None and any(sensor.moved_m for sensor in refined.sensors)
    scene = open_folder(scenario, placed.out).scene
    record = next(iter(placed.views.values())).record
    views = []
    for sensor in refined.sensors:
        pose = Pose(sensor.x_m, sensor.y_m, sensor.z_m, sensor.yaw_deg, sensor.pitch_deg, sensor.roll_deg)
        views.append(visible_targets(record, Beams.of(Scanner(scene).scan(pose, scene.sensor(sensor.sensor)))))
    fused = refined.fused
    assert fused is not None and not fused.searched and fused.better is None
    values = [expected_detections(fuse_targets(views[:count])) for count in (1, 2)]
    assert [step.score for step in fused.steps] == pytest.approx(values, rel=1e-12)
