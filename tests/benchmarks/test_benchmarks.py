"""Do the benchmarks compare like with like?"""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks import alternatives, casting, culling, scaling, steps
from scipy import stats

from egvs.artefacts.frame_boxes import FrameBoxes
from egvs.core.grid import Grid

SHAPE = np.array([12, 6, 4], np.int64)
ALONG = {
    "forwards": ([0.5, 2.5, 1.5], [10.0, 0.0, 0.0], [(i, 2, 1) for i in range(11)]),
    "backwards": ([6.5, 5.5, 1.5], [0.0, -4.0, 0.0], [(6, j, 1) for j in range(1, 6)]),
    "from outside, through": ([3.5, 2.5, 8.5], [0.0, 0.0, -12.0], [(3, 2, k) for k in range(4)]),
    "beside": ([3.5, 8.5, 1.5], [4.0, 0.0, 0.0], []),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", ALONG)
@pytest.mark.parametrize("way", alternatives.MARCHES)
def test_along_an_axis_all_marches_give_the_same_voxels(way: str, case: str) -> None:
    start, extent, crossed = ALONG[case]
    hits = np.zeros(int(SHAPE.prod()), np.uint32)
    alternatives.MARCHES[way](np.array(start), np.array([extent, extent]), SHAPE, 0.25, hits)
    expected = np.zeros(tuple(SHAPE), np.uint32)
    for voxel in crossed:
        expected[voxel] = 2
    assert (hits.reshape(tuple(SHAPE)) == expected).all()


def test_samples_are_the_same_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    o, d = np.array([-2.0, 3.3, 1.7]), rng.uniform(-15, 15, (200, 3))
    found = []
    for chunk in (10, 10**6):
        monkeypatch.setattr(alternatives, "_CHUNK", chunk)
        hits = np.zeros(int(SHAPE.prod()), np.uint32)
        alternatives.sampled(0.5)(o, d, SHAPE, 0.25, hits)
        found.append(hits)
    assert found[0].any() and (found[0] == found[1]).all()


def test_fine_samples_miss_no_voxel_that_a_beam_crosses_at_length() -> None:
    rng = np.random.default_rng(4)
    o, d = np.array([-2.0, 3.3, 1.7]), rng.uniform(-15, 15, (200, 3))
    shares = []
    for way in (alternatives.sampled(1.0), alternatives.sampled(0.01)):
        true, hits = (np.zeros(int(SHAPE.prod()), np.uint32) for _ in range(2))
        alternatives.MARCHES["ours"](o, d, SHAPE, 0.25, true)
        way(o, d, SHAPE, 0.25, hits)
        shares.append(alternatives.error_shares(hits, true)[1])
    assert shares[1] < 0.01 < shares[0]


@pytest.mark.slow
def test_a_box_off_the_faces_occupies_the_same_by_all_ways() -> None:
    grid = Grid((0.0, 0.0, 0.0), 0.5, (12, 6, 4))
    box = np.array(
        [[2.5, 1.5, 0.75, 0.0, 0.0, 1.8, 0.8, 1.3]]
    )  # reaches beyond the centres it covers, not to the next faces
    batch = FrameBoxes(np.array([0]), box)
    ours = alternatives.by_boxes(batch, grid)
    assert ours.sum() == 4 * 2 * 3
    assert (alternatives.occupancy_by_centre(batch, grid) == ours).all()


def test_casts_meet_the_same_wall() -> None:
    wall = np.array([[[5.0, -9.0, -9.0], [5.0, 9.0, -9.0], [5.0, 0.0, 9.0]]])
    o, d = np.zeros(3), np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    for cast in (alternatives.trimesh_caster(wall), alternatives.embree_caster(wall)):
        assert np.abs(cast(o, d, 20.0) - [[5.0, 0.0, 0.0], [-20.0, 0.0, 0.0]]).max() < 1e-6


def test_wrong_counts_both_ways() -> None:
    true, found = np.array([4, 0, 2, 4], np.uint32), np.array([3, 1, 2, 4], np.uint32)
    assert alternatives.error_shares(found, true) == (2 / 3, 0.1, 0.1)


def test_the_slope_is_that_of_the_larger_half() -> None:
    sizes = [1.0, 2.0, 10.0, 100.0, 1000.0]
    assert scaling.slope(sizes, [3.0 * n**1.5 for n in sizes]) == pytest.approx(1.5)
    assert scaling.slope(sizes, [7.0, 7.0, *(n**2 for n in sizes[2:])]) == pytest.approx(2.0)
    assert scaling.slope(sizes[::-1], [5.0] * 5) == pytest.approx(0.0)


def test_a_synthetic_junction_has_the_requested_size(tmp_path) -> None:
    import egvs
    from egvs.sensors import sensor, sites
    from egvs.world import static_world

    scenario = egvs.load(
        scaling.prepare(scaling.Size(sites=7, frames=10, vehicles=3, beams=960, triangles=600), tmp_path / "s")
    )
    assert len(sites.candidate_sites(scenario)) == 7
    assert sensor.resolve_sensor("own", scenario.sensors, "").beams == pytest.approx(960, rel=0.1)
    assert len(static_world.build_world(scenario)[0].faces) == pytest.approx(600, abs=10)
    assert len((scenario.folder / "fcd.csv").read_text().splitlines()) == 1 + 10 * 3


def test_a_bias_is_distinguished_from_scatter() -> None:
    """One site that is 10 % lower, one that only scatters; t is that of two independent means."""
    rng = np.random.default_rng(2)
    against, shares = (rng.normal([0.4, 0.2], [0.004, 0.02], size=(16, 2)) for _ in range(2))
    part, t = steps.change(shares * [0.9, 1.0], against)
    assert part[0] == pytest.approx(-0.1, abs=0.01)
    assert t[0] == pytest.approx(stats.ttest_ind(shares[:, 0] * 0.9, against[:, 0]).statistic)
    assert abs(t[1]) < 3
    assert steps.change(against, against)[1].tolist() == [0.0, 0.0]


@pytest.mark.slow
@pytest.mark.system
def test_tables_of_one_round_are_filled(monkeypatch: pytest.MonkeyPatch) -> None:
    """What they measure is another matter; the type checker reads the dearer tables, such as those of kernels that are
    compiled anew without what they are compared for."""
    monkeypatch.setattr(casting, "_ROUNDS", 1)
    monkeypatch.setattr(culling, "REPEATS", 1)
    shares = [row[1] for row in casting.rows() if row[0].endswith("Embree alone")]
    assert shares == ["1.00 x Embree alone"] * 4
    assert culling._beam_rows()[0][3]
