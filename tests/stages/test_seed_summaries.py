"""The summary of several simulations, by hand."""

import pytest

from egvs.core.progress import SummedProgress
from egvs.stages.seed_summaries import merge_seed_summaries


def summary(**values):
    """The summary of one simulation."""
    return {"frames": 10, "rows": 100, "mean_speed_m_s": 4.0, "flags": ["--seed", "1"], "warnings": []} | values


def test_numbers_add_up_and_means_are_weighted():
    vehicles = [{"fewest": 5, "most": 9, "different": 20}, {"fewest": 7, "most": 12, "different": 30}]
    merged = merge_seed_summaries(
        [summary(vehicles=vehicles[0]), summary(vehicles=vehicles[1], rows=300, mean_speed_m_s=8.0, flags=None)],
        [1, 99],
    )
    assert merged["vehicles"] == {"fewest": 5, "most": 12, "different": 50}
    assert (merged["frames"], merged["rows"], merged["mean_speed_m_s"]) == (20, 400, 7.0)
    assert (merged["seeds"], merged["flags"]) == ([1, 99], {"1": ["--seed", "1"], "2": None})


def test_kinds_may_be_missing_in_a_simulation():
    walkers = {"pedestrian": {"fewest": 1, "most": 3, "mean": 2.0, "different": 4}}
    merged = merge_seed_summaries(
        [
            summary(beside_vehicles=walkers | {"overlapping_pairs": {"car and pedestrian": 1}}),
            summary(beside_vehicles={"overlapping_pairs": {"car and pedestrian": 2}}),
        ],
        [1, 2],
    )
    assert merged["beside_vehicles"] == {
        "pedestrian": {"fewest": 0, "most": 3, "different": 4, "mean": 1.0},
        "overlapping_pairs": {"car and pedestrian": 3},
    }


def test_counts_are_compared_with_the_flow_of_all_simulations():
    fit = {"place": "a", "kind": "", "counted_per_h": 100.0, "geh": 9.9}
    merged = merge_seed_summaries(
        [summary(counts=[fit | {"simulated_per_h": 80.0}]), summary(counts=[fit | {"simulated_per_h": 40.0}])], [1, 2]
    )
    # GEH of 100 and 60: sqrt(2 * 40^2 / 160) = 4.47
    assert merged["counts"] == [fit | {"simulated_per_h": 60.0, "geh": 4.47}]


def test_warnings_of_some_simulations_name_them():
    everywhere = {"topic": "waiting", "where": "traffic", "problem": "many", "hint": ""}
    once = {"topic": "standing", "where": "traffic", "problem": "long", "hint": ""}
    merged = merge_seed_summaries([summary(warnings=[everywhere]), summary(warnings=[once, everywhere])], [1, 2])
    assert merged["warnings"] == [everywhere, once | {"where": "traffic (simulation 2 of 2)"}]


def test_progress_of_parts_is_summed():
    reports = []
    progress = SummedProgress(lambda what, done, total: reports.append((what, done, total)))
    first, second = progress.part(0), progress.part(1)
    first("frames", 3, 10)
    second("frames", 5, 10)
    first("frames", 10, 10)
    assert reports == [("frames", 3, 10), ("frames", 8, 20), ("frames", 15, 20)]


@pytest.mark.parametrize("values", [[{"a": 1}, {"a": 1}], [{"a": 1}, {"a": 2}]])
def test_unknown_keys_remain(values):
    merged = merge_seed_summaries([summary(**value) for value in values], [1, 2])
    assert merged["a"] == (1 if values[0] == values[1] else [1, 2])
