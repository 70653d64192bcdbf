"""Weights of kinds and zones: by hand, in a run, and each wrong use with its message."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import shapely

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.readers import read_scores, read_scores_by_period
from egvs.core.errors import collect_warnings
from egvs.scenario import loading
from egvs.scenario.score_config import WeightsConfig
from egvs.scoring.target_scores import DETECTORS, TARGET_SCORES, saturating_gain
from egvs.scoring.targets import TargetRecord, target_weights, visible_targets, weighted_people
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from tests.scoring.target_scenes import GRID, beams_to, frame

SQUARE = [[110.0, 205.0], [120.0, 205.0], [120.0, 215.0], [110.0, 215.0]]
SCORES = 'score.others=["expected_detections", "seen_well", "points_on_target"]'


def record_of(people=()) -> TargetRecord:
    """A bus, a car in the square, one on its corner, a walker in it and one beside it."""
    at = [(104.0, 210.0), (115.0, 210.0), (110.0, 205.0), (116.0, 207.0), (130.0, 207.0)]
    kinds = ("bus", "passenger", "passenger", "pedestrian", "pedestrian")
    return TargetRecord.of([frame([(x, y, 1.0, 1.0, 1.0, 1.8, 0.0) for x, y in at], kinds)], GRID, people)


def areas_of(config: WeightsConfig) -> dict[str, shapely.Polygon]:
    return {name: shapely.Polygon(zone.polygon_m) for name, zone in config.zones.items()}


def test_a_vehicle_counts_by_its_kind_and_by_every_zone_that_holds_it() -> None:
    overlap = {"polygon_m": [[114.0, 200.0], [119.0, 200.0], [119.0, 220.0], [114.0, 220.0]], "weight": 5.0}
    wanted = WeightsConfig.from_dict({"kinds": {"bus": 3.0, "pedestrian": 2.0}, "zones": {
        "crosswalk": {"polygon_m": SQUARE, "weight": 0.5}, "stop": overlap,
    }})  # fmt: skip
    record = record_of(weighted_people(wanted))
    assert target_weights(wanted, areas_of(wanted), record).tolist() == [3.0, 0.5 * 5.0, 0.5, 2.0 * 0.5 * 5.0, 2.0]
    assert record.are_people.tolist() == [False, False, False, True, True]


def test_people_are_to_be_seen_only_where_they_have_a_weight() -> None:
    assert len(record_of()) == 3
    assert not record_of().are_people.any()
    assert weighted_people(WeightsConfig.from_dict({"kinds": {"bus": 3.0}})) == frozenset()
    assert len(record_of(weighted_people(WeightsConfig.from_dict({"kinds": {"pedestrian": 0.0}})))) == 5
    assert target_weights(WeightsConfig(), {}, record_of()).tolist() == [1.0] * 3
    assert not len(target_weights(WeightsConfig(), {}, TargetRecord.of([], GRID)))


def test_people_are_expected_by_points() -> None:
    """No chance of detection is calibrated for them: from 20 points on, they count as found."""
    record = record_of({"pedestrian"})
    ends = [[x - 101.0 + 3.0 * (x - 101.0), 4 * (y - 206.0), 0.0] for x, y in record.boxes[:, :2] for _ in range(30)]
    seen = visible_targets(record, beams_to((101.0, 206.0, 1.0), ends))
    found = TARGET_SCORES["expected_detections"](seen, DETECTORS)
    assert seen.points[3] > 0
    assert found[record.are_people].tolist() == [float(points >= 20) for points in seen.points[record.are_people]]
    for points, expected in ((0.0, 0.0), (19.9, 0.0), (20.0, 1.0), (500.0, 1.0)):
        changed = dataclasses.replace(seen, points=np.where(record.are_people, points, seen.points))
        for detectors in (DETECTORS, ("cluster",)):
            values = TARGET_SCORES["expected_detections"](changed, detectors)
            assert set(values[record.are_people].tolist()) == {expected}
            assert values[:3].tolist() == TARGET_SCORES["expected_detections"](seen, detectors)[:3].tolist()
    cars = TARGET_SCORES["expected_detections"](
        visible_targets(record_of(), beams_to((101.0, 206.0, 1.0), ends)), DETECTORS
    )
    assert found[:3].tolist() == cars.tolist()


def run(folder: Path, out: Path, *overrides: str) -> dict[str, dict[str, float]]:
    egvs.run(loading.load(folder, [SCORES, *overrides]), out, jobs=2)
    return {row["site"]: row for row in read_scores(out / "scores.parquet").to_pylist()}


WEST = "score.weights.zones.west={weight=4, polygon_m=[[0, -10], [16, -10], [16, 10], [0, 10]]}"


@pytest.mark.slow
def test_scores_of_a_run_are_weighted_means_and_so_are_their_errors(mini: Path, tmp_path: Path) -> None:
    one = "score.detector='cluster'"  # so that errors are those of the traffic alone
    plain, rows = run(mini, tmp_path / "plain", one), run(mini, tmp_path / "run", WEST, one)
    scenario = loading.load(mini)
    record = TargetRecord.read(tmp_path / "run" / "trajectories.parquet", scenario.roi.grid)
    weight = np.where(record.boxes[:, 0] <= 16.0, 4.0, 1.0)
    block, scanner, ratios = record.numbers[record.frame] // 10, Scanner(egvs.build_scene(scenario)), []
    for site in scanner.scene.sites:
        seen = visible_targets(record, Beams.of(scanner.scan_site(site)))
        for name, worth in TARGET_SCORES.items():
            values = worth(seen, ("cluster",))
            assert rows[site.name][name] == pytest.approx(np.average(values, weights=weight), rel=1e-12)
            assert plain[site.name][name] == pytest.approx(values.mean(), rel=1e-12)
            left = [np.average(values[block != b], weights=weight[block != b]) for b in range(4)]
            if name != "noticed":  # whose error is not that of the traffic alone
                ratios.append(rows[site.name][f"{name}_se"] / np.std(left) / math.sqrt(3))
        assert rows[site.name]["egvs"] == plain[site.name]["egvs"]
    assert ratios == pytest.approx([ratios[0]] * 6) and ratios[0] >= 1.0  # widened alike, for the traffic's memory


@pytest.mark.slow
def test_a_weight_of_one_for_all_changes_nothing(mini: Path, tmp_path: Path) -> None:
    plain, one = run(mini, tmp_path / "a"), run(mini, tmp_path / "b", "score.weights.kinds.passenger=1")
    assert {site: set(row.items()) for site, row in one.items()} == {s: set(row.items()) for s, row in plain.items()}


@pytest.mark.slow
def test_weights_are_reported(mini: Path, tmp_path: Path, run_egvs) -> None:  # type: ignore[no-untyped-def]
    weights = ("--set", WEST, "--set", "score.weights.kinds.passenger=2")
    code, printed, told = run_egvs(
        "run", mini, "--out", tmp_path, "--set", "score.rank_by=seen_well", *weights, "--verbose"
    )
    assert code == 0, told
    assert "Vehicles are weighted: passenger 2, zone west 4." in printed
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Vehicles are weighted: passenger 2, zone west 4; all others count 1." in page
    about = parquet.read_metadata(tmp_path / "scores.parquet", "scores")
    assert about["weights"]["kinds"] == {"passenger": 2.0}


@pytest.mark.slow
def test_each_period_is_weighted_separately(mini: Path, tmp_path: Path) -> None:
    halves = 'traffic.periods=[{name="a", length_s=12}, {name="b", begin_s=12, length_s=8}]'
    run(mini, tmp_path / "run", WEST, halves)
    apart = {
        (row["period"], row["site"]): row["seen_well"]
        for row in read_scores_by_period(tmp_path / "run" / "scores_by_period.parquet").to_pylist()
    }
    scenario = loading.load(mini)
    record = TargetRecord.read(tmp_path / "run" / "trajectories.parquet", scenario.roi.grid)
    weight = np.where(record.boxes[:, 0] <= 16.0, 4.0, 1.0)
    scanner, late = Scanner(egvs.build_scene(scenario)), record.numbers[record.frame] >= 24
    for site in scanner.scene.sites:
        worth = saturating_gain(visible_targets(record, Beams.of(scanner.scan_site(site))).points)
        for name, its in (("a", ~late), ("b", late)):
            assert apart[name, site.name] == pytest.approx(np.average(worth[its], weights=weight[its]), rel=1e-12)


def test_warns_of_unused_weights(mini: Path, tmp_path: Path) -> None:
    far = "score.weights.zones.far={weight=4, polygon_m=[[90, 90], [91, 90], [91, 91]]}"
    record = egvs.run(loading.load(mini, [far, "score.weights.kinds.bus=2"]), tmp_path, jobs=1)
    told = [(it.where, it.problem) for it in collect_warnings([record.stages["score"].summary]) if it.rule == "weights"]
    kinds, zones = ("scenario.toml: score.weights.kinds.bus", "scenario.toml: score.weights.zones.far")
    frames = "in the 40 frames examined"
    assert told == [
        (kinds, f"no bus has its centre in the region of interest {frames}"),
        (zones, f"no vehicle has its centre in the zone {frames}"),
    ]


def test_rejects_ranking_without_weighted_vehicles(mini: Path, tmp_path: Path, run_egvs) -> None:  # type: ignore[no-untyped-def]
    none = ("--set", "score.weights.kinds.passenger=0", "--set", "score.rank_by=seen_well")
    code, _, told = run_egvs("run", mini, "--out", tmp_path, *none)
    assert code == 2
    assert (
        "score.rank_by = 'seen_well': no vehicle with a weight above 0 in [score.weights] has its centre in the region"
        in told
    )


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("score.weights.kinds.buss=2", "score.weights.kinds.buss"),
        ("score.weights.kinds.bus=-1", "score.weights.kinds.bus: expected a value greater than or equal to 0, got -1"),
        ("score.weights.zones.z={weight=1, polygon_m=[[0,0],[1,1]]}", "score.weights.zones.z.polygon_m"),
        ("score.weights.zones.z={weight=1, polygon_m=[[0,0],[1,1],[1,0],[0,1]]}", "expected a polygon"),
        ("score.weights.zones.z={weight=1, polygon_m=[[0,0],[1,1],[2,2]]}", "encloses an area (Self"),
        (f"score.weights.zones.z={{weight=1, polygon_m={[[i, i * i] for i in range(3001)]}}}",
         "got 3,001 corners. The limit is 3,000 corners; set EGVS_MAX_CORNERS to raise it"),
        ("score.weights.zones.z={polygon_m=[[0,0],[1,1],[2,0]]}", "score.weights.zones.z.weight: this key is required"),
        ("score.weights.zone={}", "Did you mean zones?"),
    ],
)  # fmt: skip
def test_rejects_wrong_weights(mini: Path, run_egvs, override: str, message: str) -> None:  # type: ignore[no-untyped-def]
    code, _, told = run_egvs("check", mini, "--set", override)
    assert code == 2
    assert message in told, told
