"""A junction made ready for validation, through the store of all runs."""

import numpy as np

from egvs import load
from egvs.validation import held_out_traffic


def test_a_record_is_made_once_and_its_frames_are_those_asked_for(mini, tmp_path):
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
