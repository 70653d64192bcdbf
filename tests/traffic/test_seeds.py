"""Several seeds of one scenario: independent simulations that share the frames, and errors from their differences.

Evidence: the textbook's formula on numbers that a person can check; a twin that simulates each seed by itself and adds
up the counts; and each wrong use with its message.
"""

import math

import numpy as np
import pytest

from egvs.artefacts import parquet
from egvs.artefacts.tpog import PeriodBlocks, read_periods, read_tpog
from egvs.core.errors import InputError
from egvs.scenario.loading import load, scenario_from_dict
from egvs.scenario.traffic_config import TrafficConfig
from egvs.scoring.standard_errors import ScoreUncertainty, block_groups, summarise_uncertainty
from egvs.stages import statics, tpog, traffic
from tests.conftest import write_mini
from tests.stage_runner import run_stage

FRAMES = 80
TRAFFIC = {"vehicles": 12, "warmup_s": 20.0, "trips_per_s": 1.0, "step_s": 0.25, "frame_period_s": 0.5}


def trial(town, blocks, seed=1, **keys):
    """The town's scenario with several blocks, and a region around its junctions."""
    values = {
        "name": "trial",
        "seed": seed,
        "roi": {"center_m": [165, 165, 2.5], "size_m": [150, 150, 5], "voxel_m": 1.0},
        "tpog": {"blocks": blocks},
        "sites": {"grid": {"low_m": [0, 0], "high_m": [1, 1], "spacing_m": 1, "heights_m": [3]}},
        "traffic": {"network": "net.xml", **TRAFFIC, **keys},
    }
    return scenario_from_dict(values, town, str(town / "scenario.toml"))


def make_tpog(scenario, out, jobs=1):
    """Simulate, and count; the summary of the traffic."""
    summary = run_stage(traffic, scenario, out, jobs=jobs)
    run_stage(statics, scenario, out)
    run_stage(tpog, scenario, out)
    return summary


def test_error_of_three_simulations_by_hand():
    """Means 10, 12 and 17 of three simulations: mean 13, variance (9 + 1 + 16) / 2 = 13, error sqrt(13 / 3)."""
    groups = block_groups(PeriodBlocks("", 1.0, 300, 50, 400.0, seeds=3))
    assert groups.frames.tolist() == [100, 100, 100]
    without_each = [(12 + 17) / 2, (10 + 17) / 2, (10 + 12) / 2]
    other_site = [13 - 0.5, 14.5 - 0.5, 13.5 - 0.5, 11 - 0.5]  # half a point lower in each simulation
    estimate = ScoreUncertainty.of(np.array([[13, *without_each], other_site]), [groups])
    assert estimate.se == pytest.approx([math.sqrt(13 / 3)] * 2)
    assert estimate.bias == pytest.approx([0, 0])
    assert estimate.freedom == 2
    low, high = estimate.intervals()[0]
    assert (high - low) / 2 == pytest.approx(2.91998558 * math.sqrt(13 / 3))  # t of 2 degrees of freedom, 90 %
    difference = estimate.differences(np.array([0]), np.array([1]))
    assert (difference.values[0], difference.se[0]) == pytest.approx((0.5, 0.0))
    assert summarise_uncertainty(estimate) == {
        "standard_errors_from": "3 simulations of 100 frames, each with its own seed"
    }


def test_simulations_are_neither_joined_nor_widened():
    """Drifting means would join the blocks of one simulation; simulations have no order."""
    means = np.arange(8.0)
    left_out = np.append(means.mean(), (means.sum() - means) / 7)[None]
    seeds = block_groups(PeriodBlocks("", 1.0, 800, 100, 300.0, seeds=8))
    blocks = block_groups(PeriodBlocks("", 1.0, 800, 100, 1.0))
    of_seeds, of_blocks = (ScoreUncertainty.of(left_out, [groups]).strata[0] for groups in (seeds, blocks))
    assert (of_seeds.joined, of_seeds.widening, of_seeds.is_short) == (1, 1.0, False)
    assert of_blocks.joined > 1


def test_intervals_cover_levels_that_blocks_of_one_simulation_miss():
    """Each simulation has a level of its own: blocks of one cannot show it, differences between five do."""
    rng = np.random.default_rng(3)
    seeds = block_groups(PeriodBlocks("", 1.0, 500, 50, 1.0, seeds=5))
    blocks = block_groups(PeriodBlocks("", 1.0, 500, 50, 1.0))
    covered = {"seeds": 0, "blocks": 0}
    for _ in range(500):
        levels = rng.normal(0.0, 1.0, size=5)
        in_blocks = levels[0] + rng.normal(0.0, 0.3, size=10)
        for name, values, groups in (("seeds", levels, seeds), ("blocks", in_blocks, blocks)):
            left_out = np.append(values.mean(), (values.sum() - values) / (len(values) - 1))[None]
            low, high = ScoreUncertainty.of(left_out, [groups]).intervals()[0]
            covered[name] += low <= 0.0 <= high
    assert covered["seeds"] / 500 == pytest.approx(0.9, abs=0.04)
    assert covered["blocks"] / 500 < 0.3


@pytest.mark.slow
@pytest.mark.system
def test_seeds_by_hand_give_the_same_grid(town, tmp_path):
    together = trial(town, blocks=4, frames=2 * FRAMES, seeds=2)
    summary = make_tpog(together, tmp_path / "together", jobs=2)
    first, second = together.by_seed()
    assert (first.seed, first.traffic.frames) == (1, FRAMES)
    assert summary["seeds"] == [1, second.seed]

    counts = 0
    rows = []
    for number, seed in enumerate([1, second.seed], start=1):
        alone = tmp_path / f"alone{number}"
        make_tpog(trial(town, blocks=2, seed=seed, frames=FRAMES), alone)
        counts = counts + read_tpog(alone / "tpog.parquet").counts
        table, _ = parquet.read_artefact(alone / "trajectories.parquet", "trajectories")
        for row in table.to_pylist():
            rows.append(row | {"frame": row["frame"] + (number - 1) * FRAMES, "vehicle": f"{number}:{row['vehicle']}"})
    merged = read_tpog(tmp_path / "together" / "tpog.parquet")
    assert (merged.counts == counts).all()
    assert merged.frames == 2 * FRAMES
    assert merged.counts.any()
    (record,) = read_periods(tmp_path / "together" / "tpog.parquet")
    assert (record.seeds, record.blocks, record.block_frames) == (2, 4, FRAMES // 2)
    table, metadata = parquet.read_artefact(tmp_path / "together" / "trajectories.parquet", "trajectories")
    assert table.to_pylist() == rows
    assert metadata["seeds"] == 2
    assert summary["rows"] == len(rows)


@pytest.mark.slow
@pytest.mark.system
def test_threads_do_not_change_bytes(town, tmp_path):
    setup = trial(town, blocks=3, frames=60, seeds=3)
    for jobs in (1, 3):
        run_stage(traffic, setup, tmp_path / str(jobs), jobs=jobs)
    one, three = ((tmp_path / str(jobs) / "trajectories.parquet").read_bytes() for jobs in (1, 3))
    assert one == three
    assert sorted(path.name for path in (tmp_path / "3" / "sumo").iterdir()) == ["seed1", "seed2", "seed3"]
    assert not list((tmp_path / "3" / "sumo").glob("*/fcd.csv"))


@pytest.mark.slow
@pytest.mark.system
def test_each_period_has_its_simulations(town, tmp_path):
    periods = [{"name": "day", "weight": 2}, {"name": "night", "length_s": 10.0}]
    setup = trial(town, blocks=2, frames=40, seeds=2, periods=periods)
    make_tpog(setup, tmp_path)
    day, night = read_periods(tmp_path / "tpog.parquet")
    assert (day.seeds, day.frames, night.seeds, night.frames) == (2, 40, 2, 20)
    seeds = {run.seed for period in setup.by_period().values() for run in period.by_seed()}
    assert len(seeds) == 4
    table, metadata = parquet.read_artefact(tmp_path / "trajectories.parquet", "trajectories")
    assert (metadata["frames"], metadata["seeds"]) == (60, 2)
    frames = table.column("frame").to_numpy()
    prefixes = np.array([name.partition(":")[0] for name in table.column("vehicle").to_pylist()])
    assert [np.unique(prefixes[frames // 20 == part]).tolist() for part in (0, 1)] == [["1"], ["2"]]
    assert [np.unique(prefixes[frames // 10 == part]).tolist() for part in (4, 5)] == [["1"], ["2"]]


@pytest.mark.slow
@pytest.mark.system
def test_one_seed_is_the_run_without_the_key(town, tmp_path):
    for name, keys in (("without", {}), ("one", {"seeds": 1})):
        make_tpog(trial(town, blocks=2, frames=40, **keys), tmp_path / name)
    for artefact in ("trajectories.parquet", "tpog.parquet"):
        assert (tmp_path / "without" / artefact).read_bytes() == (tmp_path / "one" / artefact).read_bytes()
    assert "seeds" not in parquet.read_metadata(tmp_path / "one" / "tpog.parquet", "tpog")


def test_keys_that_are_not_set_do_not_change_cache_keys():
    """A dump of the traffic is part of the stage key: without several seeds and plans, it is as before these keys."""
    config = TrafficConfig(network="net.xml")
    assert TrafficConfig.model_fields.keys() - config.model_dump().keys() == {"seeds", "signals"}
    assert config.model_copy(update={"seeds": 5}).model_dump()["seeds"] == 5


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (["traffic.seeds=2"], "seeds: expected 1 with fcd, because nothing is simulated, got 2. Remove seeds"),
        (["traffic.network='n.net.xml'", "traffic.seeds=3"],
         "traffic.seeds = 3 does not divide tpog.blocks = 4, and no block spans two simulations."
         " Use tpog.blocks = 3 or 6"),
        (["traffic.network='n.net.xml'", "traffic.seeds=5"], "Use tpog.blocks = 5"),
        (["traffic.seeds=0"], "traffic.seeds"),
    ],
)  # fmt: skip
def test_rejects_seeds_without_simulations(tmp_path, settings, message):
    folder = write_mini(tmp_path / "mini")
    with pytest.raises(InputError) as error:
        load(folder, settings)
    assert message in str(error.value)


def test_rejects_running_sumo_with_several_seeds(town, tmp_path):
    with pytest.raises(InputError, match=r"--traci: expected traffic.seeds = 1, got 2"):
        run_stage(traffic, trial(town, blocks=2, frames=40, seeds=2), tmp_path, traci=("localhost", 1))
