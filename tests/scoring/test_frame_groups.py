"""Standard errors of means over vehicle-frames: groups left out by hand, a closed form, simulation, periods."""

from __future__ import annotations

import math

import numpy as np
import pytest

import egvs
from egvs.artefacts.tpog import PeriodBlocks
from egvs.scoring.standard_errors import ScoreUncertainty
from egvs.scoring.targets import FrameGroups, TargetRecord, weighted_mean
from tests.conftest import write_mini
from tests.scoring.target_scenes import GRID, frame


def record_of(vehicles, numbers=None) -> TargetRecord:
    """Frames with as many vehicles each."""
    numbers = range(len(vehicles)) if numbers is None else numbers
    boxes = [[(102.0 + 3 * i, 210.0, 1.0, 2.0, 1.0, 1.5, 0.0) for i in range(count)] for count in vehicles]
    return TargetRecord.of([frame(its, number=n) for its, n in zip(boxes, numbers, strict=True)], GRID)


def period(frames, block_frames, name="", times=1, memory=0.01) -> PeriodBlocks:
    return PeriodBlocks(name, 1.0, frames, block_frames, memory, times)


def test_a_group_is_left_out_of_both_sums():
    record = record_of([1, 0, 3, 2, 0, 4, 2, 1])
    values = np.arange(13.0) ** 2
    found = FrameGroups.of([period(8, 2)], [8], record)
    means = found.means(values)
    assert means.shape == (5,) and means[0] == weighted_mean(values) and found.weight.tolist() == [1.0] * 13
    for group in range(4):
        left = record.frame // 2 != group
        assert means[1 + group] == pytest.approx(values[left].mean())


def test_weights_of_vehicles_count_in_both_sums():
    record = record_of([1, 0, 3, 2])
    values, weight = np.arange(6.0), np.array([1.0, 0.0, 2.0, 1.0, 3.0, 0.5])
    means = FrameGroups.of([period(4, 2)], [4], record).means(values, weight)
    left = record.frame >= 2
    assert means[0] == weighted_mean(values, weight)
    assert means[1] == pytest.approx(np.average(values[left], weights=weight[left]))


def test_without_vehicles_in_all_other_groups_nothing_is_left():
    means = FrameGroups.of([period(4, 1)], [4], record_of([0, 3, 0, 0])).means(np.arange(3.0))
    assert means[[0, 1, 3, 4]].tolist() == [1.0] * 4 and math.isnan(means[2])
    none = FrameGroups.of([period(4, 1)], [4], record_of([0, 0, 0, 0])).means(np.empty(0))
    assert np.isnan(none).all()


def test_replayed_frames_belong_to_the_block_that_they_were_recorded_in():
    # 10 frames recorded, 2 blocks of 4: the last two fill no block, and belong to the last
    record = record_of([1, 1, 1, 1], [0, 3, 4, 9])
    means = FrameGroups.of([period(8, 4)], [10], record).means(np.array([0.0, 2.0, 4.0, 10.0]))
    assert means.tolist() == [4.0, 7.0, 1.0]


def test_a_mix_counts_frames_as_often_as_it_takes_them_and_keeps_each_records_weight():
    # night: 4 frames of which the mix takes each once, two are replayed; day: 2 frames, each three times, both replayed
    periods = [period(4, 2, "night"), period(2, 1, "day", times=3)]
    record = record_of([1, 2, 1, 3], [0, 2, 4, 5])
    values = np.array([1.0, 5.0, 6.0, 20.0, 30.0, 31.0, 32.0])
    found = FrameGroups.of(periods, [4, 2], record)
    assert found.weight.tolist() == [2.0, 2.0, 2.0, 3.0, 3.0, 3.0, 3.0]
    means = found.means(values)
    night, day = 2.0 * values[:3].sum(), 3.0 * values[3:].sum()
    assert means[0] == pytest.approx((night + day) / (6 + 12))
    assert means[1] == pytest.approx((2 * 2.0 * 11.0 + day) / (2 * 4 + 12))  # the other half of the night, twice
    assert means[4] == pytest.approx((night + 2 * 3.0 * 20.0) / (6 + 6))
    estimate = ScoreUncertainty.of(means[None], found.groups)
    assert len(estimate.strata) == 2 and estimate.se[0] > 0


def test_the_standard_error_of_a_plain_mean_is_that_of_its_groups():
    """With a vehicle in every frame the ratio is a mean, and leaving out equal groups gives its textbook error."""
    rng = np.random.default_rng(2)
    values = rng.normal(size=200)
    found = FrameGroups.of([period(200, 20)], [200], record_of([1] * 200))
    estimate = ScoreUncertainty.of(found.means(values)[None], found.groups)
    groups = values.reshape(10, 20).mean(axis=1)
    assert estimate.se[0] == pytest.approx(groups.std(ddof=1) / math.sqrt(10), rel=0.01)
    assert estimate.bias[0] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
def test_the_standard_error_is_as_large_as_the_error_is():
    """On made-up traffic whose vehicles come in numbers, and are seen the worse the more there are."""
    rng = np.random.default_rng(4)
    groups, errors, scores = [period(200, 20)], [], []
    for _ in range(100):
        vehicles = rng.poisson(3.0, 200)
        record = record_of(vehicles)
        values = np.exp(-0.1 * vehicles[record.frame]) + 0.1 * rng.normal(size=len(record))
        found = FrameGroups.of(groups, [200], record)
        estimate = ScoreUncertainty.of(found.means(values)[None], found.groups)
        errors.append(estimate.se[0])
        scores.append(estimate.scores[0])
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(scores), rel=0.2)


@pytest.mark.slow
def test_of_a_run(tmp_path):
    scenario = egvs.load(write_mini(tmp_path / "mini"), ["tpog.blocks=4"])
    egvs.run(scenario, tmp_path / "run", jobs=1)
    tpog, trajectories = tmp_path / "run" / "tpog.parquet", tmp_path / "run" / "trajectories.parquet"
    record = TargetRecord.read(trajectories, scenario.roi.grid)
    found = FrameGroups.read(tpog, trajectories, record)
    assert found is not None and len(record.numbers) == 40
    values = np.arange(float(len(record)))
    means = found.means(values)
    assert means[0] == weighted_mean(values) and len(means) == 5
    assert means[1] == pytest.approx(values[record.numbers[record.frame] >= 10].mean())
    one = egvs.load(tmp_path / "mini", ["tpog.blocks=1"])
    egvs.run(one, tmp_path / "one", jobs=1)
    assert (
        FrameGroups.read(tmp_path / "one" / "tpog.parquet", tmp_path / "one" / "trajectories.parquet", record) is None
    )


@pytest.mark.slow
def test_of_a_run_with_periods(tmp_path):
    halves = '[{name="a", length_s=12, weight=3}, {name="b", begin_s=12, length_s=8}]'
    scenario = egvs.load(write_mini(tmp_path / "mini"), [f"traffic.periods={halves}", "tpog.blocks=4"])
    egvs.run(scenario, tmp_path / "run", jobs=1)
    tpog, trajectories = tmp_path / "run" / "tpog.parquet", tmp_path / "run" / "trajectories.parquet"
    record = TargetRecord.read(trajectories, scenario.roi.grid)
    found = FrameGroups.read(tpog, trajectories, record)
    assert found is not None and len(found.groups) == 2
    share = [found.weight[record.numbers[record.frame] < 24], found.weight[record.numbers[record.frame] >= 24]]
    frames = [24, 16]
    assert share[0][0] * frames[0] == pytest.approx(3 * share[1][0] * frames[1])  # weights 3 and 1 of the whole
    assert len(found.means(np.ones(len(record)))) == 1 + sum(len(its.frames) for its in found.groups)
