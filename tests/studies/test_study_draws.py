"""Units and draws cover the traffic as they should, and rows have the traffic that their options give."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.studies import study_draws, study_settings
from egvs.studies.study_draws import TrafficUnits
from egvs.studies.study_settings import SCENARIO_AS_IS, PricedSetting, SettingValues
from egvs.studies.traffic_scores import RunScores, Window

VALUES = SettingValues()


def run_scores(seed: int, blocks: int = 10) -> RunScores:
    """Three mounts in ten frames per block, one vehicle in each frame."""
    frames = 10 * blocks
    sums = np.random.default_rng(seed).uniform(size=(frames, 3))
    return RunScores(
        mounts=("a", "b", "c"),
        poles=("a", "b", "b"),
        rank_by="expected_detections",
        block=np.repeat(np.arange(blocks), 10),
        weight=np.ones(frames),
        sums={"expected_detections": sums},
        windows=(),
        voxel_scores=np.empty((0, 3)),
    )


def priced(units: float, blocks: int = 0, sampled_frames: int = 100) -> PricedSetting:
    return PricedSetting(SCENARIO_AS_IS, "scenario", units, blocks, sampled_frames)


def test_simulated_run_is_one_unit_and_its_parts_fill_it(junction: Path) -> None:
    units = TrafficUnits.of(egvs.load(junction))
    assert units.parts == (Window(0, 10),)
    assert units.block_counts(VALUES) == [1, 2, 5]
    assert units.windows_in(Window(0, 10), 5) == [Window(0, 5), Window(5, 5)]
    assert set(units.windows(VALUES)) >= {Window(0, 10), Window(9, 1), Window(8, 2), Window(5, 5)}


def test_recording_is_divided_into_equal_parts(mini: Path) -> None:
    units = TrafficUnits.of(egvs.load(mini, ["tpog.blocks=20", "traffic.frames=40"]))
    assert units.parts == tuple(Window(4 * part, 4) for part in range(5))
    assert TrafficUnits.of(egvs.load(mini)).parts == tuple(Window(part, 1) for part in range(4))


def test_draws_of_parts_are_windows_of_one_unit(junction: Path) -> None:
    units = TrafficUnits.of(egvs.load(junction))
    runs = [run_scores(seed) for seed in range(4)]
    found = study_draws.draws(runs, units, priced(0.5, blocks=5))
    assert [draw.units for draw in found] == [(0,), (0,), (1,), (1,), (2,), (2,), (3,), (3,)]
    assert found[1].scores == pytest.approx(runs[0].sums["expected_detections"][50:].mean(axis=0))


def test_draws_of_longer_traffic_are_rings_of_units(junction: Path) -> None:
    units = TrafficUnits.of(egvs.load(junction))
    runs = [run_scores(seed) for seed in range(6)]
    found = study_draws.draws(runs, units, priced(2.0, sampled_frames=200))
    assert [draw.units for draw in found] == [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5), (0, 5)]
    both = np.concatenate([runs[0].sums["expected_detections"], runs[1].sums["expected_detections"]])
    assert found[0].scores == pytest.approx(both.mean(axis=0))
    assert study_draws.draws(runs, units, priced(4.0)) == []  # too few units would be left to judge
    assert study_draws.draws(runs[:5], units, priced(2.0)) == []


def test_long_traffic_has_few_frames_of_each_unit(junction: Path) -> None:
    units = TrafficUnits.of(egvs.load(junction))
    runs = [run_scores(0)]
    scores = study_draws.unit_scores(runs, units, priced(4.0, sampled_frames=40))
    assert scores[0] == pytest.approx(runs[0].score("expected_detections", Window(0, 10), 10))


@pytest.mark.parametrize("name", ["junction", "mini"])
def test_rows_have_the_traffic_of_their_options(name: str, request: pytest.FixtureRequest) -> None:
    folder = request.getfixturevalue(name)
    scenario = egvs.load(folder)
    units = TrafficUnits.of(scenario)
    frames = study_settings.counted_frames(scenario)
    rows = list(study_draws.priced_settings(SCENARIO_AS_IS, scenario, units, VALUES))
    assert rows[0].setting == SCENARIO_AS_IS
    for row in rows:
        changed = egvs.load(folder, row.setting.overrides)
        share = study_settings.counted_frames(changed) / frames
        assert share == pytest.approx(row.units / units.run_units, rel=0.25)  # whole blocks
        assert changed.score.sampled_frames == row.sampled_frames


@pytest.mark.slow
def test_parts_of_a_variant_keep_its_other_options(junction: Path) -> None:
    step = next(s for s in study_settings.list_variants(egvs.load(junction)) if s.knob == "step" and "1 s" in s.name)
    scenario = egvs.load(junction, step.overrides)
    whole, *parts = study_draws.priced_settings(step, scenario, TrafficUnits.of(scenario), VALUES)
    assert whole.setting == step
    for part in parts:
        changed = egvs.load(junction, part.setting.overrides)
        assert (changed.traffic.step_s, changed.traffic.frame_period_s) == (1.0, 1.0)
        assert study_settings.counted_frames(changed) < study_settings.counted_frames(scenario)
