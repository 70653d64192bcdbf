"""Errors of differences between runs: by hand, against the probabilities of one run, and where they are unknown."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.scoring.standard_errors import BlockGroups
from egvs.studies.paired_errors import ScoreDifferences, SiteOfRun, SiteReplicates
from egvs.studies.run_comparison import compare_runs
from tests.studies.test_run_comparison import found

OTHER_SENSOR = ["sites.replace_sensor=other"]


@pytest.fixture
def junction_with_two_sensors(mini: Path) -> Path:
    """The small scenario with a second sensor, which no site has."""
    file = mini / "scenario.toml"
    sensor = (
        "[sensors.other]\nelevations_deg = [-20, -3]\nchannels = 10\nazimuth_step_deg = 1.5\nrange_m = 90\n\n[score]"
    )
    file.write_text(file.read_text().replace("[score]", sensor))
    return mini


def mean_replicates(by_block: list[float]) -> list[float]:
    """The mean of blocks of equal length, then without each of them."""
    total = sum(by_block)
    return [total / len(by_block), *((total - value) / (len(by_block) - 1) for value in by_block)]


def test_paired_error_is_that_of_the_block_differences() -> None:
    """Differences of the blocks are 0.1, 0.1, 0.3 and -0.1: mean 0.1, standard error sqrt(0.08 / 3 / 4)."""
    groups = (BlockGroups(np.full(4, 10), 0.0),)
    first, second = Path("first"), Path("second")
    blocks = {first: [0.5, 0.7, 0.5, 0.7], second: [0.6, 0.8, 0.8, 0.6]}
    differences = ScoreDifferences(dict.fromkeys(blocks, "the same traffic"))
    replicates = {
        folder: SiteReplicates(("pole",), np.array([mean_replicates(values)]), groups)
        for folder, values in blocks.items()
    }
    differences._add_pool(replicates)
    here, there = SiteOfRun(second, found("pole", 0.7)), SiteOfRun(first, found("pole", 0.6))
    difference = differences.between(here, there)
    assert difference.is_paired
    assert difference.value == pytest.approx(0.1)
    assert difference.se == pytest.approx((0.08 / 3 / 4) ** 0.5)
    assert differences.why_independent(first, second) == ""
    assert differences.between(there, there).se == 0.0


PERIODS = 'traffic.periods=[{name="a", length_s=12, weight=1}, {name="b", begin_s=12, length_s=8, weight=2}]'


@pytest.mark.parametrize("overrides", [(), pytest.param((PERIODS,), marks=pytest.mark.slow)], ids=["whole", "periods"])
def test_sensors_of_one_run_are_compared_as_neighbours_in_its_ranking(
    overrides: tuple[str, ...], junction_with_two_sensors: Path
) -> None:
    """With two sites, ``beats_next`` of the best one is the probability that it is better than the other."""
    scenario = junction_with_two_sensors
    (scenario / "sites.csv").write_text("site,x_m,y_m,z_m,sensor\none,10,12,3,small\ntwo,10,12,4,other\n")
    egvs.run(egvs.load(scenario, overrides), scenario / "run")
    scores = egvs.read_scores(scenario / "run" / "scores.parquet").to_pylist()
    best, worst = sorted(scores, key=lambda row: row["rank"])
    comparison = compare_runs([scenario / "run"])
    assert [run.sensors for run in comparison.runs] == [(best["sensor"],), (worst["sensor"],)]
    (pole,) = comparison.poles
    difference = pole.differences[1]
    assert difference is not None
    assert difference.is_paired
    assert difference.value == worst["egvs"] - best["egvs"]
    assert 1.0 - (difference.better or 0.0) == pytest.approx(best["beats_next"], abs=2e-6)
    assert comparison.notes == ()
    assert comparison.sensors is not None
    assert comparison.sensors.sensors == (worst["sensor"], best["sensor"])


@pytest.mark.slow
def test_runs_with_the_same_traffic_are_paired(junction_with_two_sensors: Path, tmp_path: Path) -> None:
    scenario = junction_with_two_sensors
    egvs.run(egvs.load(scenario), tmp_path / "a")
    egvs.run(egvs.load(scenario, OTHER_SENSOR), tmp_path / "b")
    comparison = compare_runs([tmp_path / "a", tmp_path / "b"])
    assert comparison.by == "pole"
    for pole in comparison.poles:
        difference = pole.differences[1]
        assert difference is not None
        assert difference.is_paired
        assert difference.se is not None
        first, second = sorted(mount.egvs_se or 0.0 for mount in pole.mounts if mount is not None)
        assert second - first - 1e-9 <= difference.se <= second + first + 1e-9  # for any correlation
        assert difference.se != pytest.approx(np.hypot(first, second))
    assert comparison.notes == ()


@pytest.mark.slow
def test_reason_is_noted_where_errors_are_independent(junction_with_two_sensors: Path, tmp_path: Path) -> None:
    scenario = junction_with_two_sensors
    egvs.run(egvs.load(scenario), tmp_path / "a")
    egvs.run(egvs.load(scenario, [*OTHER_SENSOR, "tpog.blocks=5"]), tmp_path / "blocks")
    egvs.run(egvs.load(scenario, [*OTHER_SENSOR, "traffic.frames=32"]), tmp_path / "short")
    egvs.run(egvs.load(scenario, [*OTHER_SENSOR, "score.standard_error=false"]), tmp_path / "without")
    moved = tmp_path / "moved" / scenario.name
    shutil.copytree(scenario, moved)
    egvs.run(egvs.load(moved, OTHER_SENSOR), tmp_path / "lost")
    shutil.rmtree(moved)
    for name, reason in (
        ("blocks", "their traffic is divided into different blocks"),
        ("short", "their traffic differs"),
        ("without", f"{tmp_path / 'without'}: it has no standard errors"),
        ("lost", "the scenario folder"),
    ):
        comparison = compare_runs([tmp_path / "a", tmp_path / name])
        (note,) = comparison.notes
        assert note.startswith("standard errors of differences between A and B are those of independent scores: ")
        assert reason in note
        difference = comparison.poles[0].differences[1]
        assert difference is not None
        assert not difference.is_paired
        assert (difference.se is None) == (name == "without")
