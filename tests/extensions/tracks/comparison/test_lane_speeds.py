"""Speeds by lane: by hand, against scipy, and in a comparison of two runs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import wasserstein_distance

from egvs.artefacts.tpog import read_tpog
from egvs.extensions.tracks.comparison import lane_speeds, speed_figure, tpog_page
from egvs.extensions.tracks.comparison.lane_bins import lane_bins
from egvs.extensions.tracks.comparison.lane_speeds import BIN_M_S, N_BINS, read_lane_speeds, speed_distances
from egvs.extensions.tracks.comparison.tpog_comparison import compare_tpogs
from egvs.scoring.standard_errors import BlockGroups
from egvs.traffic.network import read_net_xml
from tests.extensions.tracks.comparison.test_tpog_comparison import make_run


def test_distance_by_hand() -> None:
    """All at 0 to 0.5 m/s against all at 2 to 2.5 m/s: 2 m/s; half of them: 1 m/s. NaN without speeds."""
    counts = np.zeros((3, N_BINS, 1))
    counts[:2, 0] = 4.0
    others = np.zeros((3, N_BINS, 1))
    others[0, 4], others[1, 0], others[1, 4], others[2, 1] = 10.0, 1.0, 1.0, 1.0
    distances = speed_distances(counts, others)[:, 0]
    assert distances[:2].tolist() == pytest.approx([2.0, 1.0])
    assert np.isnan(distances[2])


def test_distance_is_that_of_scipy() -> None:
    rng = np.random.default_rng(5)
    first, second = rng.integers(0, 9, size=(2, 4, N_BINS, 3)).astype(np.float64)
    middles = BIN_M_S * (np.arange(N_BINS) + 0.5)
    distances = speed_distances(first, second)
    for lane in range(4):
        for column in range(3):
            weights = first[lane, :, column], second[lane, :, column]
            assert distances[lane, column] == pytest.approx(wasserstein_distance(middles, middles, *weights))


def test_pairs_of_rows_of_a_vehicle() -> None:
    """Vehicle 0 is missing in frame 2, vehicle 1 is in all; two frames apart."""
    frame = np.array([0, 0, 1, 1, 2, 3, 3])
    vehicle = np.array([0, 1, 0, 1, 1, 0, 1])
    first, second = lane_speeds._pairs(frame, vehicle, 2)
    assert list(zip(first.tolist(), second.tolist(), strict=True)) == [(1, 4), (2, 5), (3, 6)]
    empty = np.empty(0, dtype=np.int64)
    assert lane_speeds._pairs(empty, empty, 2)[0].size == 0


@pytest.mark.slow
@pytest.mark.system
def test_speeds_of_a_run(tmp_path: Path) -> None:
    """The slow twin: every pair of positions of every vehicle, one by one."""
    out = make_run(tmp_path / "a")
    tpog = read_tpog(out / "tpog.parquet")
    roads = read_net_xml(tmp_path / "a" / "roads.net.xml")
    bins = lane_bins(roads, tpog.grid, np.ones(tpog.grid.shape[0] * tpog.grid.shape[1]))
    table = lane_speeds.traffic_frames.read_trajectories(out / "trajectories.parquet").to_pandas()
    half = tpog.frames // 2
    groups = BlockGroups(np.array([half, tpog.frames - half]), 0.0)
    speeds = read_lane_speeds(out / "trajectories.parquet", 0.5, 1.0, bins, tpog.grid, groups)
    expected = np.zeros_like(speeds.counts)
    for row in table.itertuples():
        later = table[(table.vehicle == row.vehicle) & (table.frame == row.frame + 2)]
        if later.empty:
            continue
        dx_m, dy_m = float(later.x_m.iloc[0]) - row.x_m, float(later.y_m.iloc[0]) - row.y_m
        cell = [
            int(np.floor((value - origin_m) / tpog.grid.voxel_m))
            for value, origin_m in zip((row.x_m + dx_m / 2, row.y_m + dy_m / 2), tpog.grid.origin_m, strict=False)
        ]
        if min(cell) < 0 or cell[0] >= tpog.grid.shape[0] or cell[1] >= tpog.grid.shape[1]:
            continue
        lane = bins.lane[cell[0] * tpog.grid.shape[1] + cell[1]]
        if lane >= 0:
            expected[lane, int(np.hypot(dx_m, dy_m) / 1.0 / BIN_M_S), int(row.frame >= half)] += 1
    assert expected.sum() > 20
    np.testing.assert_array_equal(speeds.counts, expected)
    means = speeds.means_m_s()
    middles = BIN_M_S * (np.arange(N_BINS) + 0.5)
    for lane in np.flatnonzero(expected.sum(axis=(1, 2))):
        mean = (expected[lane].sum(axis=1) * middles).sum() / expected[lane].sum()
        assert means[lane, 0] == pytest.approx(mean, abs=BIN_M_S / 2)


@pytest.mark.slow
@pytest.mark.system
def test_page_compares_speeds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the eastbound car, one drives and the other stands: the distance is the speed of the one that drives."""
    driving, standing = make_run(tmp_path / "a"), make_run(tmp_path / "b", stands_at_m=20.0)
    comparison = compare_tpogs(driving, standing)
    assert all(lane.speed is None for lane in comparison.lanes)
    assert "Speeds are not compared" in tpog_page.render_page(comparison)
    monkeypatch.setattr(lane_speeds, "MIN_VEHICLES", 1)
    comparison = compare_tpogs(driving, standing)
    (lane,) = [lane for lane in comparison.lanes if lane.name == "east_0"]
    assert lane.speed is not None
    recorded, simulated = lane.speed.mean_m_s
    assert simulated.value == pytest.approx(0.0, abs=1e-6)
    assert recorded.value > 1.0
    assert lane.speed.distance_m_s.value == pytest.approx(recorded.value, abs=BIN_M_S)
    page = tpog_page.render_page(comparison)
    assert re.search(r"Speeds on the .*: on average .* m/s recorded and 0\.0 m/s simulated", page)


def test_figure_ends_where_speeds_end() -> None:
    slow, fast = (np.minimum(np.arange(1, N_BINS + 1) / bins, 1.0) for bins in (10, 20))
    assert speed_figure.highest_speed_m_s([slow, fast]) == 10.0
    figure = speed_figure.draw_speeds((slow, fast), 10.0, "Two lines.")
    assert figure.count("<path style=") == 2
    ends = re.findall(r'<path style="[^"]*" d="M[^"]*L(\S+) (\S+)"', figure)
    assert ends == [("348.0", "10.0"), ("348.0", "10.0")]
