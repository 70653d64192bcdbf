"""Are the standard errors of scores as large as the errors are?

Evidence: plain twins (leave a block out by hand, compute the score from the definition); closed forms (the mean's
standard error); symmetries; and simulation: on traffic of known occupancy that remembers its past and obeys a signal,
cut into many independent runs, 90 % intervals hold the true score in 86 to 94 % of them. The same over independent runs
of SUMO stands in docs/accuracy.md."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.readers import DISTINCT_PROBABILITY
from egvs.cli.run_tables import ranking_table
from egvs.core.errors import InputError
from egvs.core.grid import Grid
from egvs.results.ranking import RankedSite
from egvs.runs.run_context import open_folder
from egvs.scoring import egvs as scoring_egvs
from egvs.scoring import standard_errors
from egvs.scoring.egvs import EntropyField, binary_entropy
from egvs.scoring.scorer import Scorer
from egvs.scoring.standard_errors import BlockGroups, BlockJackknife, ScoreUncertainty
from egvs.stages.site_scans import empty_scans
from egvs.statistics.blocks import MIN_GROUPS, group_sizes

GRID = Grid.from_json({"origin_m": [0.0, 0.0, 0.0], "voxel_m": 1.0, "shape": [6, 5, 2]})
CELLS = np.arange(60)


def record(frames: np.ndarray, memory: float = 0.0) -> tuple[BlockGroups, ...]:
    """One record's groups; without a memory nothing is widened."""
    return (BlockGroups(frames, memory),)


def left_out_of(blocks: np.ndarray, block_frames: int, cells: np.ndarray = CELLS) -> BlockJackknife:
    """From the counts of blocks, (blocks, n), joined to groups."""
    sizes = group_sizes(len(blocks))
    counts = np.array([part.sum(axis=0) for part in np.split(blocks, np.cumsum(sizes)[:-1])]).astype(np.uint32)
    return BlockJackknife.from_counts(counts, cells, BlockGroups(block_frames * np.array(sizes), 0.0), GRID)


def random_counts(blocks: int, block_frames: int = 20) -> np.ndarray:
    return np.random.default_rng(3).integers(0, block_frames + 1, size=(blocks, 60)).astype(np.uint32)


@pytest.mark.parametrize(("blocks", "groups"), [(2, 2), (7, 7), (19, 19), (20, 10), (23, 10)])
@pytest.mark.parametrize(("gamma", "unit"), [(3.0, 1), (2.5, 4), (float("inf"), 1)])
def test_each_column_is_the_score_without_that_group(blocks: int, groups: int, gamma: float, unit: int) -> None:
    counts = random_counts(blocks)
    leave_out = left_out_of(counts, 20)
    assert leave_out.groups[0].frames.tolist() == [20 * len(p) for p in np.array_split(np.arange(blocks), groups)]
    hits = np.random.default_rng(4).integers(0, 30, size=60).astype(np.uint32 if unit == 1 else np.int64)
    found = leave_out.scores(hits, gamma, unit)
    capped = np.minimum(gamma, hits / unit)
    for column, left_out in enumerate([np.array([], dtype=int), *np.array_split(np.arange(blocks), groups)]):
        kept = np.delete(counts, left_out, axis=0)
        frames = 20 * len(kept)
        by_hand = sum(
            binary_entropy(int(c), frames) * weight
            for c, weight in zip(kept.sum(axis=0, dtype=int), capped, strict=True)
        )
        assert found[column] == pytest.approx(by_hand, rel=1e-12)
    whole = EntropyField.of(counts.sum(axis=0, dtype=np.int64), 20 * blocks, GRID)
    assert found[0] == pytest.approx(whole.score(hits, gamma, unit).egvs, rel=1e-13)
    if np.isfinite(gamma):
        assert leave_out.limits(gamma)[0] == pytest.approx(whole.limit(gamma), rel=1e-13)


def test_voxels_with_equal_counts_share_a_class_and_no_others_do() -> None:
    counts = random_counts(5)
    counts[:, 30:] = counts[:, :30]
    leave_out = left_out_of(counts, 20)
    rows = {tuple(column) for column in counts.T.tolist()}
    assert len(leave_out.entropies_bit) == len(rows)
    assert (leave_out.classes[:30] == leave_out.classes[30:]).all()


def left_out_means(values: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Means of groups (k, n) weighted by their frames: of all, and with each left out, (n, 1 + k)."""
    total = (frames[:, None] * values).sum(axis=0)
    columns = [total / frames.sum()] + [
        (total - f * v) / (frames.sum() - f) for f, v in zip(frames, values, strict=True)
    ]
    return np.array(columns).T


def test_of_a_mean_it_is_the_textbook_s_standard_error_without_bias() -> None:
    values = np.random.default_rng(5).normal(10.0, 2.0, size=(12, 3))
    found = ScoreUncertainty.of(left_out_means(values, np.full(12, 50)), record(np.full(12, 50)))
    assert found.strata[0].joined == 1
    assert found.se == pytest.approx(values.std(axis=0, ddof=1) / np.sqrt(12))
    assert found.bias == pytest.approx(np.zeros(3), abs=1e-9)
    assert found.intervals()[:, 1] - found.intervals()[:, 0] == pytest.approx(2 * 1.795885 * found.se, rel=1e-6)


def test_unequal_groups_weigh_by_their_frames() -> None:
    rng, frames = np.random.default_rng(6), np.array([40, 40, 60, 40, 60, 40, 40, 60, 40, 40])
    errors, said = [], []
    for _ in range(400):
        values = rng.normal(0.0, 1.0, size=(10, 1)) / np.sqrt(frames[:, None])
        found = ScoreUncertainty.of(left_out_means(values, frames), record(frames))
        errors.append(found.scores[0])
        said.append(found.se[0] ** 2)
    assert np.sqrt(np.mean(said)) == pytest.approx(np.std(errors), rel=0.1)


def test_chances_add_up_and_equal_sites_are_even() -> None:
    values = np.random.default_rng(7).normal(0.0, 1.0, size=(10, 3))
    values[:, 2] = values[:, 0]
    found = ScoreUncertainty.of(left_out_means(values, np.full(10, 5)), record(np.full(10, 5)))
    a, b = np.array([0, 1, 0]), np.array([1, 0, 2])
    chances = found.beats(a, b)
    assert chances[0] + chances[1] == pytest.approx(1.0)
    assert chances[2] == 0.5


def test_lag_behind_the_best_site_has_the_error_of_the_block_differences() -> None:
    """Differences of the blocks are 0.1, 0.1, 0.3 and -0.1: mean 0.1, standard error sqrt(0.08 / 3 / 4)."""
    values = np.array([[0.5, 0.6, 0.5], [0.7, 0.8, 0.7], [0.5, 0.8, 0.5], [0.7, 0.6, 0.7]])
    lag = standard_errors.lag_behind_best(
        ScoreUncertainty.of(left_out_means(values, np.full(4, 10)), record(np.full(4, 10)))
    )
    se = (0.08 / 3 / 4) ** 0.5
    assert lag.se == pytest.approx([se, 0.0, se])
    t, root_3 = 0.1 / se, 3.0**0.5  # t has 3 degrees of freedom, whose distribution has a closed form
    chance = 0.5 + (t / root_3 / (1 + t**2 / 3) + np.arctan(t / root_3)) / np.pi
    assert lag.best_beats == pytest.approx([chance, 0.5, chance], abs=1e-6)


def test_a_site_s_error_knows_nothing_of_the_others() -> None:
    values = np.random.default_rng(8).normal(0.0, 1.0, size=(10, 5))
    rows = left_out_means(values, np.full(10, 5))
    order = [3, 0, 4, 1, 2]
    one, other = (
        ScoreUncertainty.of(rows, record(np.full(10, 5))),
        ScoreUncertainty.of(rows[order], record(np.full(10, 5))),
    )
    assert one.strata[0].joined == other.strata[0].joined == 1
    assert (one.se[order] == other.se).all()


def wandering(groups: int, memory: float, seed: int) -> np.ndarray:
    """Left-out means of a series whose groups remember the one before."""
    rng, values = np.random.default_rng(seed), [0.0]
    for _ in range(groups + 20):
        values.append(memory * values[-1] + rng.normal())
    return left_out_means(np.array(values[-groups:])[:, None], np.full(groups, 10))


def test_groups_too_short_for_the_traffic_are_joined_or_warned_of() -> None:
    patient = [ScoreUncertainty.of(wandering(16, 0.9, seed), record(np.full(16, 10))) for seed in range(60)]
    assert np.mean([e.strata[0].joined > 1 for e in patient]) > 0.8
    assert all(e.groups >= MIN_GROUPS for e in patient)
    few = [ScoreUncertainty.of(wandering(7, 0.97, seed), record(np.full(7, 10))) for seed in range(200)]
    warned = [e for e in few if e.strata[0].still_correlated]
    assert warned
    doubts = [standard_errors.uncertainty_warnings(e, "scenario.toml: traffic.frames", 0.5) for e in warned]
    assert all("neighbouring blocks of 10 frames are correlated" in doubt.problem for (doubt,) in doubts)
    assert {doubt.hint for (doubt,) in doubts} == {"Record at least 140 frames, preferably 560."}
    own = {"night": "scenario.toml: traffic.periods (night).length_s"}
    (doubt,) = standard_errors.uncertainty_warnings(warned[0], "scenario.toml: traffic.frames", 0.5, ["night"], own)
    assert (doubt.where, doubt.hint) == (own["night"], "Set length_s to at least 70, preferably 280.")
    (doubt,) = standard_errors.uncertainty_warnings(warned[0], "scenario.toml: traffic.frames", 0.5, ["day"], own)
    assert doubt.where == "scenario.toml: traffic.frames (day)"
    assert doubt.hint == "Record at least 140 frames, preferably 560."
    honest = [ScoreUncertainty.of(wandering(16, 0.0, seed), record(np.full(16, 10))) for seed in range(200)]
    assert np.mean([e.strata[0].joined > 1 for e in honest]) < 0.1


def occupied(runs: int, chains: int, frames: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Occupancy (runs, frames, chains) that remembers some 20 frames and, for half of the voxels, obeys a signal of 80;
    and its p.

    A chain is a two-state Markov chain started in its stationary state, so that p is known exactly.
    """
    p, memory = rng.uniform(0.03, 0.6, size=chains), 0.95
    on = rng.random((runs, chains)) < p
    states = np.empty((runs, frames, chains), dtype=np.bool_)
    for frame in range(frames):
        on = np.where(rng.random((runs, chains)) < memory, on, rng.random((runs, chains)) < p)
        states[:, frame] = on
    green = (np.arange(frames) % 80) < 40
    states[:, :, chains // 2 :] &= green[None, :, None]
    share = np.where(np.arange(chains) >= chains // 2, green.mean(), 1.0)
    return states, p * share


@pytest.mark.slow
@pytest.mark.parametrize(("blocks", "frames"), [(10, 2400), (50, 2400), (5, 1600)])
def test_intervals_cover_the_truth_as_often_as_they_say(
    blocks: int, frames: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        scoring_egvs, "_n_ln_n", functools.cache(scoring_egvs._n_ln_n)
    )  # asked for 2,400 numbers, 200,000 times
    rng = np.random.default_rng(20)
    runs, chains = 200, 60
    states, p = occupied(runs, chains, frames, rng)
    weights = rng.integers(0, 11, size=(3, chains)).astype(np.uint32)
    entropy = -(p * np.log2(p) + (1 - p) * np.log2(1 - p))
    truth = weights @ entropy
    counts = states.reshape(runs, blocks, frames // blocks, chains).sum(axis=2).astype(np.uint32)
    held, ses, scores = [], [], []
    for run in counts:
        leave_out = left_out_of(run, frames // blocks)
        found = ScoreUncertainty.of(np.array([leave_out.scores(w, 10.0) for w in weights]), leave_out.groups)
        low, high = found.intervals().T
        held.append((low <= truth) & (truth <= high))
        ses.append(found.se)
        scores.append(found.scores)
    assert 0.86 <= np.mean(held) <= 0.94
    assert np.sqrt(np.mean(np.square(ses), axis=0)) == pytest.approx(np.std(scores, axis=0), rel=0.15)
    assert (np.mean(scores, axis=0) < truth).all()  # few frames score too low


def test_scores_say_how_sure_they_are(mini: Path, tmp_path: Path) -> None:
    scenario = egvs.load(mini)
    record = egvs.run(scenario, tmp_path / "out")
    rows = egvs.read_scores(tmp_path / "out" / "scores.parquet").to_pylist()
    assert all(row["egvs_se"] > 0 and row["egvs_bias"] < 0 for row in rows)
    assert sorted(row["beats_next"] for row in rows)[-1] == 1.0
    assert record.stages["score"].summary["standard_errors_from"] == "4 blocks of 10 frames (+5 % for autocorrelation)"
    leave_out = BlockJackknife.of(tmp_path / "out" / "tpog.parquet", egvs.read_tpog(tmp_path / "out" / "tpog.parquet"))
    assert leave_out is not None
    work, tpog = open_folder(scenario, tmp_path / "out"), egvs.read_tpog(tmp_path / "out" / "tpog.parquet")
    scorer = Scorer(work.scene, tpog, leave_out=leave_out)
    for scan, row in zip(empty_scans(work), rows, strict=True):
        assert scorer.score(scan.beams).replicates[0] == pytest.approx(row["egvs"], rel=1e-12)


@pytest.mark.slow
def test_many_blocks_are_joined_as_they_are_read(mini: Path, tmp_path: Path) -> None:
    """Group by group, what is read from the file is what the blocks add up to."""
    egvs.run(egvs.load(mini, ["traffic.frames=40", "tpog.blocks=40"]), tmp_path)
    path = tmp_path / "tpog.parquet"
    tpog, table = egvs.read_tpog(path), parquet.read_artefact(path, "tpog")[0].to_pydict()
    dense = np.zeros((40, *tpog.grid.shape), dtype=np.int64)
    dense[tuple(table[name] for name in ("block", "ix", "iy", "iz"))] = table["count"]
    leave_out = BlockJackknife.of(path, tpog)
    assert leave_out is not None
    assert leave_out.groups[0].frames.tolist() == [10] * 4  # two cars that drive through are remembered
    weights = np.arange(tpog.counts.size, dtype=np.uint32) % 7
    found = leave_out.scores(weights, 5.0)
    for column in range(1 + 4):
        kept = np.delete(dense, slice(10 * column - 10, 10 * column) if column else [], axis=0)
        entropy = np.array([binary_entropy(c, len(kept)) for c in range(len(kept) + 1)])[kept.sum(axis=0).ravel()]
        assert found[column] == pytest.approx(float(np.minimum(weights, 5) @ entropy), rel=1e-12)


@pytest.mark.slow
def test_rejects_unknown_block(mini: Path, tmp_path: Path) -> None:
    egvs.run(egvs.load(mini), tmp_path)
    path = tmp_path / "tpog.parquet"
    table, about = parquet.read_artefact(path, "tpog")
    columns = {name: table.column(name).to_numpy() for name in table.column_names}
    parquet.write_artefact(path, "tpog", columns | {"block": np.full(len(table), 4, dtype=np.uint16)}, about)
    with pytest.raises(InputError, match="expected blocks 0 to 3, got 4"):
        BlockJackknife.of(path, egvs.read_tpog(path))


@pytest.mark.slow
@pytest.mark.parametrize("change", ["score.standard_error=false", "tpog.blocks=1"])
def test_without_errors_the_scores_are_the_same(mini: Path, tmp_path: Path, change: str) -> None:
    egvs.run(egvs.load(mini), tmp_path / "with")
    egvs.run(egvs.load(mini, [change]), tmp_path / "without")
    table, plain = (egvs.read_scores(tmp_path / name / "scores.parquet") for name in ("with", "without"))
    assert set(table.column_names) - set(plain.column_names) == {
        "egvs_se",
        "egvs_bias",
        "beats_next",
        "behind_best_se",
        "best_beats",
        "expected_detections_se",
        "noticed_se",
    }
    assert table.select(plain.column_names) == plain
    assert ranking_table(RankedSite.from_table(plain)).caption is None


@pytest.mark.slow
def test_the_ranking_marks_neighbours_that_are_not_separable(mini: Path, tmp_path: Path, run_egvs) -> None:
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,10,12,3\npole_b,30.5,-12,3\npole_c,10,12,3.001\n")
    code, printed, _ = run_egvs("run", mini, "--out", tmp_path / "out", "--all")
    assert code == 0
    assert "~ " in printed
    assert "not separable" in printed
    rows = parquet.read_artefact(tmp_path / "out" / "scores.parquet", "scores")[0].to_pylist()
    unsure = [row["site"] for row in rows if row["beats_next"] < DISTINCT_PROBABILITY]
    assert set(unsure) & {"pole_a", "pole_c"}


def test_an_empty_road_has_no_error() -> None:
    counts = np.zeros((4, 0), dtype=np.uint32)
    leave_out = left_out_of(counts, 10, np.empty(0, dtype=np.int64))
    scores = np.array([leave_out.scores(np.ones(60, dtype=np.uint32), 10.0) for _ in range(2)])
    found = ScoreUncertainty.of(scores, leave_out.groups)
    assert found.se.tolist() == [0.0, 0.0]
    assert standard_errors.beats_next(found).tolist() == [0.5, 1.0]
