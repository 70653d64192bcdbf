"""Unseen traffic: another seed, and frames that lie further apart."""

import numpy as np
import pytest

from pipeline import load
from pipeline.core.errors import InputError
from pipeline.validation import unseen_traffic


def test_unseen_traffic_has_another_seed_and_frames_further_apart():
    scenario = load("scenarios/nishishinjuku")
    unseen = unseen_traffic.scenario_of(scenario, 250)
    assert unseen.seed not in (scenario.seed, *(scenario.model_copy(update={"seed": n}).seed for n in range(100)))
    assert (unseen.traffic.frames, unseen.traffic.frame_period_s) == (250, 2.0)
    assert unseen.traffic.kinds == scenario.traffic.kinds
    assert unseen_traffic.scenario_of(scenario, 250).seed == unseen.seed
    other = scenario.model_copy(update={"seed": 2})
    assert unseen_traffic.scenario_of(other, 250).seed != unseen.seed


def test_frames_are_spread_over_the_record(mini):
    scenario = load(mini)  # a finished file: 40 frames every 0.5 s, so that every fourth is 2 s apart
    assert unseen_traffic.scenario_of(scenario, 10) is scenario
    np.testing.assert_array_equal(unseen_traffic.numbers(scenario, 40, 10), np.arange(0, 40, 4))
    np.testing.assert_array_equal(unseen_traffic.numbers(scenario, 40, 3), [0, 12, 24])
    with pytest.raises(InputError, match=r"--frames: 11, of traffic with 40 frames every 0.5 s; at most 10"):
        unseen_traffic.numbers(scenario, 40, 11)
