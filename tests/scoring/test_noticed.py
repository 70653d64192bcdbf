"""What people notice: the curves, their errors, and the score of a run.

Evidence: a curve by hand; the rows of the published table, pooled by hand; a slow twin of the error, value by value;
the columns of a run against a direct sum over vehicles, and against the curves of the file with other code.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

import egvs
from egvs.artefacts import readers
from egvs.artefacts.parquet import read_artefact
from egvs.core.errors import InputError
from egvs.results.levels import NOT_MEASURED
from egvs.scenario.score_config import ScoreConfig, VehicleClass
from egvs.scoring import noticed
from egvs.scoring.noticed import NoticeCurve, pool_adjacent_violators, road_user_groups
from egvs.scoring.standard_errors import BlockGroups, ScoreUncertainty, curve_groups
from egvs.scoring.targets import TargetRecord, TargetVisibility, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scanner
from tests.scoring.target_scenes import GRID, beams_to, frame

TABLE = json.loads(noticed.DATA_FILE.read_text(encoding="utf-8"))
BINS = [(low, high) for low, high in TABLE["bins"]]


def with_points(kinds: tuple[str, ...], points: list[float], range_m: list[float] | None = None) -> TargetVisibility:
    """Road users with these points on them, in one frame."""
    boxes = [(104.0 + 7.0 * i, 210.0, 1.0, 4.0, 2.0, 1.5, 0.0) for i in range(len(kinds))]
    record = TargetRecord.of([frame(boxes, kinds)], GRID, {"pedestrian", "bicycle"})
    visible = visible_targets(record, beams_to((100.0, 200.0, 3.0), [(1.0, 0.0, 0.0)]))
    assert len(visible) == len(points)
    ranges = visible.range_m if range_m is None else np.array(range_m)
    return replace(visible, points=np.array(points), range_m=ranges)


# ---- curves


def test_curve_by_hand() -> None:
    """Nodes at 1, 3 and 15 points: ln 2, ln 4 and ln 16."""
    bins = [(0.0, 0.5), (0.5, 2.0), (1.0, 9.0), (9.0, 25.0)]
    curve = NoticeCurve.of(bins, [0.4, 0.2, 0.6, 0.9], [0.1, 0.1, 0.1, 0.2])
    assert curve.points.tolist() == pytest.approx([1.0, 3.0, 15.0])
    points = np.array([0.0, math.sqrt(2.0) - 1.0, 1.0, math.sqrt(8.0) - 1.0, 3.0, 7.0, 15.0, 1e6])
    assert curve.share(points) == pytest.approx([0.0, 0.1, 0.2, 0.4, 0.6, 0.75, 0.9, 0.9])
    assert curve.errors(points) == pytest.approx(
        np.array([
            [0.0, 0.05, 0.1, 0.05, 0.0, 0.0, 0.0, 0.0],
            [0.0, 0.0, 0.0, 0.05, 0.1, 0.05, 0.0, 0.0],
            [0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.2],
        ])
    )  # fmt: skip


def test_bins_in_the_wrong_order_are_pooled_with_weights() -> None:
    """Of .5 +- .1 and .4 +- .2 the mean is (.5 x 100 + .4 x 25) / 125, with the error 1 / sqrt(125)."""
    shares, pool, pool_se = pool_adjacent_violators(np.array([0.2, 0.5, 0.4, 0.7]), np.array([0.3, 0.1, 0.2, 0.1]))
    assert shares == pytest.approx([0.2, 0.48, 0.48, 0.7])
    assert pool.tolist() == [0, 1, 1, 2]
    assert pool_se == pytest.approx([0.3, 1.0 / math.sqrt(125.0), 0.1])


def test_pooling_goes_back_as_far_as_needed() -> None:
    shares, pool, pool_se = pool_adjacent_violators(np.array([0.5, 0.6, 0.1]), np.ones(3))
    assert shares == pytest.approx([0.4, 0.4, 0.4])
    assert pool.tolist() == [0, 0, 0] and pool_se == pytest.approx([1.0 / math.sqrt(3.0)])


@pytest.mark.parametrize("seed", range(5))
def test_pooled_shares_are_the_best_ascending_ones(seed: int) -> None:
    """No ascending shares on a grid of 0.1 have a smaller weighted sum of squares."""
    rng = np.random.default_rng(seed)
    values, errors = rng.random(4), rng.uniform(0.1, 0.5, 4)
    shares, pool, _ = pool_adjacent_violators(values, errors)
    assert (np.diff(shares) >= -1e-12).all() and (np.diff(pool) >= 0).all()

    def loss(candidate: Any) -> float:
        return float((((np.array(candidate) - values) / errors) ** 2).sum())

    grid = np.linspace(0.0, 1.0, 11)
    ascending = [(a, b, c, d) for a in grid for b in grid for c in grid for d in grid if a <= b <= c <= d]
    assert loss(shares) <= min(loss(candidate) for candidate in ascending) + 1e-12


def test_curves_of_the_table() -> None:
    """Pooled by hand: of cars, 2-10 and 20-100 points; of larger vehicles, 5-20 and from 50 on; of people, 5-20."""
    cars, larger, people = (group.curve for group in road_user_groups())
    assert cars.points == pytest.approx([1.0, math.sqrt(10), math.sqrt(50), math.sqrt(200), math.sqrt(1000),
                                         math.sqrt(5000), math.sqrt(30000), 300.0])  # fmt: skip
    assert cars.shares == pytest.approx([0.32, 0.4584, 0.4584, 0.6, 0.8659, 0.8659, 0.94, 0.96], abs=1e-4)
    assert cars.pool_se == pytest.approx([0.06, 0.0731, 0.14, 0.0384, 0.03, 0.02], abs=1e-4)
    assert larger.shares == pytest.approx([0.3, 0.32, 0.8092, 0.8092, 0.94, 0.9445, 0.9445, 0.9445], abs=1e-4)
    assert people.shares == pytest.approx([0.5, 0.73, 0.7714, 0.7714, 0.93], abs=1e-4)
    for curve in (cars, larger, people):
        assert curve.share(np.zeros(1)).tolist() == [0.0]
        assert (np.diff(curve.share(np.linspace(0.0, 1000.0, 5001))) >= 0.0).all()


def test_every_vclass_has_one_group() -> None:
    listed = [kind for group in road_user_groups() for kind in (*group.measured, *group.others)]
    assert sorted(listed) == sorted(get_args(VehicleClass))


# ---- road users


def test_each_group_takes_its_curve() -> None:
    visible = with_points(("passenger", "bus", "pedestrian", "tram", "motorcycle"), [14.0, 14.0, 14.0, 14.0, 14.0])
    cars, larger, people = (float(group.curve.share(np.array([14.0]))[0]) for group in road_user_groups())
    assert noticed.noticed_chances(visible) == pytest.approx([cars, larger, people, larger, people])
    assert len({cars, larger, people}) == 3


def test_bounds_count_what_is_outside_the_data() -> None:
    """A tram was not labelled as such, and the second car is farther away than any box."""
    visible = with_points(("passenger", "passenger", "tram"), [5.0, 5.0, 200.0], [20.0, 80.5, 20.0])
    chances = noticed.noticed_chances(visible)
    low, high = noticed.noticed_bounds(visible)
    assert low == pytest.approx([chances[0], 0.0, 0.0])
    assert high == pytest.approx([chances[0], 1.0, 1.0])


def test_error_of_a_mean_is_that_of_curves_with_other_values() -> None:
    """Slow twin: shift the value of one pool at a time, and compute the mean of all road users again."""
    rng = np.random.default_rng(3)
    kinds = ("passenger", "bus", "pedestrian", "passenger", "truck")
    visible = with_points(kinds, rng.gamma(1.0, 40.0, 5).tolist())
    squares = []
    for number, group in enumerate(road_user_groups()):
        for pool, se in enumerate(group.curve.pool_se):
            total = 0.0
            for kind, points in zip(kinds, visible.points.tolist(), strict=True):
                of_kind = next(i for i, other in enumerate(road_user_groups()) if kind in other.measured)
                curve = road_user_groups()[of_kind].curve
                shares = curve.shares + (se if of_kind == number else 0.0) * (curve.pool == pool)
                total += float(replace(curve, shares=shares).share(np.array([points]))[0])
            squares.append((total / 5 - noticed.noticed_chances(visible).mean()) ** 2)
    changes = noticed.noticed_errors(visible)
    assert len(changes) == noticed.noticed_pools() == len(squares)
    assert (changes.mean(axis=1) ** 2).sum() == pytest.approx(sum(squares), rel=1e-9)


def test_errors_of_curves_add_to_those_of_the_traffic() -> None:
    """Blocks that deviate by -3, -1, 1, 3 points: error sqrt(5 / 3) points. Curves: 2 points at a, 2 and 1 at b."""
    blocks = (BlockGroups(np.full(4, 10), 0.0),)
    deviations = np.array([-0.03, -0.01, 0.01, 0.03])
    left_out = -deviations / 3.0
    rows = np.array([
        [0.6, *(0.6 + left_out), 0.62, 0.60],
        [0.5, *(0.5 + left_out), 0.52, 0.51],
    ])  # fmt: skip
    estimate = ScoreUncertainty.of(rows, blocks + curve_groups(2))
    traffic = 5.0 / 3.0
    assert 100.0 * estimate.se == pytest.approx([math.sqrt(traffic + 4.0), math.sqrt(traffic + 5.0)])
    # the traffic and the first value of the curves are common to both
    assert 100.0 * estimate.differences(np.array([0]), np.array([1])).se == pytest.approx([1.0])
    assert estimate.bias == pytest.approx([0.0, 0.0], abs=1e-12)
    assert estimate.freedom == 3.0
    # Satterthwaite's: 3 of the traffic, and 10 of all values of the curves together
    expected = (traffic + 5.0) ** 2 / (traffic**2 / 3.0 + 5.0**2 / 10.0)
    assert estimate._freedoms(np.array([1])) == pytest.approx([expected])


# ---- runs


def test_score_is_computed_beside_what_detectors_find() -> None:
    assert ScoreConfig().additional == ("expected_detections", "noticed")
    assert ScoreConfig(rank_by="expected_detections", others=()).additional == ("expected_detections", "noticed")
    assert ScoreConfig(others=("noticed", "expected_detections")).additional == ("noticed", "expected_detections")
    assert ScoreConfig(others=("seen_well",)).additional == ("seen_well",)


def test_noticed_ranks_no_sites(mini: Path) -> None:
    with pytest.raises(InputError, match=r"score\.rank_by"):
        egvs.load(mini, ["score.rank_by=noticed"])


@pytest.mark.slow
def test_columns_are_sums_over_vehicles(mini: Path, tmp_path: Path) -> None:
    """With the curve of cars written down again, and the vehicles of a scan made anew."""
    settings = ["score.rank_by=expected_detections", "tpog.blocks=10"]
    scenario = egvs.load(mini, settings)
    egvs.run(scenario, tmp_path, jobs=1)
    rows = read_artefact(tmp_path / "scores.parquet", "scores")[0].to_pylist()
    levels = read_artefact(tmp_path / "levels.parquet", "levels")[0].to_pylist()
    record = TargetRecord.read(tmp_path / "trajectories.parquet", scenario.roi.grid)
    scanner = Scanner(egvs.build_scene(scenario))
    assert {kind for kind in record.kinds} == {"passenger"}
    nodes = [0.0, 1.0, math.sqrt(10), math.sqrt(50), math.sqrt(200), math.sqrt(1000), math.sqrt(5000),
             math.sqrt(30000), 300.0]  # fmt: skip
    shares = [0.0, 0.32, 0.458352, 0.458352, 0.6, 0.865902, 0.865902, 0.94, 0.96]
    for row, site in zip(rows, scanner.scene.sites, strict=True):
        points = visible_targets(record, Beams.of(scanner.scan_site(site))).points
        direct = np.interp(np.log(1.0 + points), np.log(1.0 + np.array(nodes)), shares).mean()
        assert row["noticed"] == pytest.approx(direct, abs=1e-5)
        assert row["noticed_low"] == row["noticed_high"] == pytest.approx(row["noticed"], rel=1e-12)
        assert 0.0 < row["noticed_se"] < 0.2
        of_all, of_cars = (level for level in levels if level["site"] == row["site"])
        assert (of_all["road_users"], of_cars["road_users"]) == ("all", "cars")
        assert of_all["observations"] == of_cars["observations"] == len(record)
        for name in ("expected_detections", "expected_detections_se", "noticed", "noticed_se"):
            assert of_all[name] == row[name]
            assert of_cars[name] == pytest.approx(row[name], rel=1e-9)


@pytest.mark.slow
def test_groups_have_a_level_each(mini: Path, tmp_path: Path, run_egvs) -> None:  # type: ignore[no-untyped-def]
    """With one of the two vehicles as a bus of the same size: levels of the groups average to that of all."""
    fcd, toml = mini / "fcd.csv", mini / "scenario.toml"
    lines = fcd.read_text(encoding="utf-8").splitlines()
    buses = [line.replace(";car;", ";bus;") if ";west;" in line else line for line in lines]
    fcd.write_text("\n".join(buses) + "\n", encoding="utf-8")
    text = toml.read_text(encoding="utf-8")
    bus = '[[traffic.kinds]]\nname = "bus"\nvclass = "bus"\nlength_m = 4.5\nwidth_m = 1.8\nheight_m = 1.5\n\n'
    toml.write_text(text.replace("[[traffic.kinds]]", f"{bus}[[traffic.kinds]]", 1), encoding="utf-8")
    options = ("--all", "--verbose", "--set", "score.rank_by=expected_detections")
    code, printed, _ = run_egvs("run", mini, "--out", tmp_path, *options)
    assert code == 0
    levels = read_artefact(tmp_path / "levels.parquet", "levels")[0].to_pylist()
    for of_all, *groups in zip(*(levels[start::3] for start in range(3)), strict=True):
        assert [group["road_users"] for group in groups] == ["cars", "larger vehicles"]
        counts = [group["observations"] for group in groups]
        assert sum(counts) == of_all["observations"]
        shares = [group["weight_share"] for group in groups]
        assert shares == pytest.approx([n / sum(counts) for n in counts]) and of_all["weight_share"] == 1.0
        for name in ("expected_detections", "noticed"):
            mean = sum(n * group[name] for n, group in zip(counts, groups, strict=True)) / sum(counts)
            assert of_all[name] == pytest.approx(mean, rel=1e-9)

    best = readers.read_scores(tmp_path / "scores.parquet").to_pylist()
    first = next(row["site"] for row in best if row["rank"] == 1)
    larger = next(row for row in levels if row["site"] == first and row["road_users"] == "larger vehicles")
    (line,) = (line for line in printed.splitlines() if line.startswith("larger vehicles"))
    noticed_text = f"{100.0 * larger['noticed']:.0f} ± {max(10.0, 100.0 * larger['noticed_se']):.0f} %"
    # the sensor has no rated range, so no level of the corrected detectors was measured
    assert line.split()[2] == str(larger["observations"]) and line.split("  ")[-2:] == [NOT_MEASURED, noticed_text]
    page = (tmp_path / "report.html").read_text(encoding="utf-8").replace("\u00a0", " ")
    unknown = f"{NOT_MEASURED} for detectors without losses of returns (see rated_range_m); people would notice"
    assert unknown in " ".join(printed.split()) and unknown in page
    assert "TUM Traffic Intersection Dataset, Zimmer et al. 2023" in page
    assert f'<th scope="row">larger vehicles</th><td class="n">{larger["observations"]}</td>' in page
    assert f'<td class="n">{NOT_MEASURED}</td><td class="n">{noticed_text}</td>' in page
