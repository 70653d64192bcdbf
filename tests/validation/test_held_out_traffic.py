"""Held-out traffic: its seed, its frames, and its recording in the store."""

import numpy as np
import pytest

from egvs import load
from egvs.core.errors import InputError
from egvs.validation import held_out_traffic


def test_held_out_traffic_has_other_seed_and_frame_spacing():
    scenario = load("scenarios/nishishinjuku")
    unseen = held_out_traffic.held_out_scenario(scenario, 250)
    assert unseen.seed not in (scenario.seed, *(scenario.model_copy(update={"seed": n}).seed for n in range(100)))
    assert (unseen.traffic.frames, unseen.traffic.frame_period_s) == (250, 2.0)
    assert unseen.traffic.kinds == scenario.traffic.kinds
    assert held_out_traffic.held_out_scenario(scenario, 250).seed == unseen.seed
    other = scenario.model_copy(update={"seed": 2})
    assert held_out_traffic.held_out_scenario(other, 250).seed != unseen.seed


def test_frames_are_spread_over_recording(mini):
    scenario = load(mini)  # a finished file: 40 frames every 0.5 s, so that every fourth is 2 s apart
    assert held_out_traffic.held_out_scenario(scenario, 10) is scenario
    np.testing.assert_array_equal(held_out_traffic.select_frame_numbers(scenario, 40, 10), np.arange(0, 40, 4))
    np.testing.assert_array_equal(held_out_traffic.select_frame_numbers(scenario, 40, 3), [0, 12, 24])
    with pytest.raises(InputError, match=r"--frames: expected at most 10 frames at least 2 s apart, got 11"):
        held_out_traffic.select_frame_numbers(scenario, 40, 11)


def test_recording_is_stored_and_has_requested_frames(mini, tmp_path):
    scenario = load(mini)
    first = held_out_traffic.prepare_held_out_traffic(scenario, tmp_path / "a", 5)
    made_at = first.trajectories.stat().st_mtime_ns
    again = held_out_traffic.prepare_held_out_traffic(scenario, tmp_path / "b", 5)
    assert again.trajectories.stat().st_mtime_ns == made_at  # the same file, from the store
    assert again.keys == first.keys and first.frames == 5
    frames = list(first.read())
    np.testing.assert_array_equal([frame.number for frame in frames], [0, 8, 16, 24, 32])
    assert all(len(frame.boxes) == len(frame.vehicles) == len(frame.kinds) for frame in frames)
    assert first.scene.sites[0].name == "pole_a"
