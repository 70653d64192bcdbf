"""Unseen traffic: another seed, and frames that lie further apart."""

import numpy as np
import pytest

from egvs import load
from egvs.core.errors import InputError
from egvs.validation import held_out_traffic


def test_unseen_traffic_has_another_seed_and_frames_further_apart():
    scenario = load("scenarios/nishishinjuku")
    unseen = held_out_traffic.held_out_scenario(scenario, 250)
    assert unseen.seed not in (scenario.seed, *(scenario.model_copy(update={"seed": n}).seed for n in range(100)))
    assert (unseen.traffic.frames, unseen.traffic.frame_period_s) == (250, 2.0)
    assert unseen.traffic.kinds == scenario.traffic.kinds
    assert held_out_traffic.held_out_scenario(scenario, 250).seed == unseen.seed
    other = scenario.model_copy(update={"seed": 2})
    assert held_out_traffic.held_out_scenario(other, 250).seed != unseen.seed


def test_frames_are_spread_over_the_record(mini):
    scenario = load(mini)  # a finished file: 40 frames every 0.5 s, so that every fourth is 2 s apart
    assert held_out_traffic.held_out_scenario(scenario, 10) is scenario
    np.testing.assert_array_equal(held_out_traffic.select_frame_numbers(scenario, 40, 10), np.arange(0, 40, 4))
    np.testing.assert_array_equal(held_out_traffic.select_frame_numbers(scenario, 40, 3), [0, 12, 24])
    with pytest.raises(InputError, match=r"--frames: expected at most 10 frames at least 2 s apart, got 11"):
        held_out_traffic.select_frame_numbers(scenario, 40, 11)
