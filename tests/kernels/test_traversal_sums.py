"""Weighted hits, sums over classes of voxels, segments from anywhere, and the audit of beams.

Evidence: rational arithmetic (tests/oracles/march.py); a slow twin that sorts the crossings of all planes; cases that
can be checked by hand."""

from __future__ import annotations

import itertools
from fractions import Fraction
from types import FunctionType

import numpy as np
import pytest

from egvs.kernels import traversal
from tests.oracles import march as oracle

SHAPE, VOXEL_M = (7, 5, 4), 0.25


def random_beams(shape=SHAPE, n=60, seed=12):
    """A sensor, and extents that enter the grid, leave it, end in it, run on planes, miss it or have no length."""
    rng = np.random.default_rng(seed)
    ends = rng.uniform(-0.5, 1.5, (n, 3)) * shape
    ends[::5] = np.rint(ends[::5])
    o = np.array([2.0, 1.5, -0.75])
    ends[::11, rng.integers(3)] = o[rng.integers(3)]
    ends[-1] = o
    return o, ends - o


def flat(voxels, shape=SHAPE):
    return [int(np.ravel_multi_index(voxel, shape)) for voxel in voxels]


@pytest.mark.parametrize("shape", [SHAPE, (1, 1, 1), *itertools.permutations((30, 3, 2))])
def test_hits_and_weighted_hits_agree_with_rational_arithmetic(shape):
    o, d = random_beams(shape)
    weights, expected, expected_weighted = np.arange(3, 3 + len(d)), np.zeros(np.prod(shape)), np.zeros(np.prod(shape))
    for beam, weight in zip(d, weights, strict=True):
        assert not oracle.ambiguous(o, beam, shape, VOXEL_M)
        voxels = flat(oracle.crossed(o, beam, shape, VOXEL_M), shape)
        expected[voxels] += 1
        expected_weighted[voxels] += weight
    hits, weighted = np.full(len(expected), 7, np.uint32), np.full(len(expected), -5, np.int64)
    traversal.count_hits(o, d, np.array(shape), VOXEL_M, hits)
    traversal.add_hits(o, d, np.array(shape), VOXEL_M, weights, weighted)
    assert np.array_equal(hits, 7 + expected)
    assert np.array_equal(weighted, -5 + expected_weighted)
    by_exact_traversal, times = np.zeros(len(expected), np.int64), traversal.crossing_buffer(np.array(shape))
    for beam, weight in zip(d, weights, strict=True):
        traversal.add_to_voxels(o, beam, np.array(shape), VOXEL_M, weight, by_exact_traversal, times)
    assert np.array_equal(by_exact_traversal, expected_weighted)


@pytest.mark.slow
def test_amount_falls_by_the_share_at_which_a_voxel_is_entered():
    """A voxel gets the amount of the last fall before its entry, by exact shares; 0.21 and the like are no entry."""
    o, d = random_beams(seed=13)
    shape, times = np.array(SHAPE), traversal.crossing_buffer(np.array(SHAPE))
    t_falls, amounts = np.array([0.21, 0.33, 0.34, 0.87, np.inf]), np.array([16, 8, 4, 2, 1])
    fallen = set()
    for beam in d:
        hits, expected = np.full(shape.prod(), 100, np.int64), np.full(shape.prod(), 100, np.int64)
        traversal.add_stepwise(o, beam, shape, VOXEL_M, t_falls, amounts, hits, times)
        slabs = [dict((i, first) for i, first, _ in oracle.slabs(o[a], beam[a], SHAPE[a])) for a in range(3)]
        for voxel in oracle.crossed(o, beam, SHAPE, VOXEL_M):
            entered = max(slabs[a][voxel[a]] for a in range(3))
            n_falls = sum(Fraction(t) < entered for t in t_falls[:-1])
            fallen.add(n_falls)
            expected[flat([voxel])] += amounts[n_falls]
        assert np.array_equal(hits, expected)
    assert fallen == {0, 1, 2, 3, 4}


def test_voxel_that_is_entered_at_a_fall_gets_the_amount_before_it():
    o, d, shape = np.array([-1.0, 2.5, 1.5]), np.array([8.0, 0.0, 0.0]), np.array(SHAPE)
    hits = np.zeros(SHAPE, np.int64)
    t_falls, amounts = np.array([0.25, 0.5, np.inf]), np.array([9, 5, 2])
    traversal.add_stepwise(o, d, shape, VOXEL_M, t_falls, amounts, hits.reshape(-1), traversal.crossing_buffer(shape))
    assert hits[:, 2, 1].tolist() == [9, 9, 5, 5, 2, 2, 2], "entered at 1/8, 2/8, ..."
    assert hits.sum() == 34


def test_diagonal_crosses_four_voxels_and_a_miss_none():
    """Through corners: its chords with all other voxels are 0. It enters voxels at 1/6, 3/6 and 5/6."""
    o, shape, hits = np.full(3, 0.5), np.array(SHAPE), np.zeros(SHAPE, np.int64)
    t_falls, amounts, times = np.array([0.5, np.inf]), np.array([8, 1]), traversal.crossing_buffer(shape)
    traversal.add_stepwise(o, np.array([3.0, 3.0, 0.0]), shape, VOXEL_M, t_falls, amounts, hits.reshape(-1), times)
    traversal.add_stepwise(o - 4, np.array([3.0, 3.0, 0.0]), shape, VOXEL_M, t_falls, amounts, hits.reshape(-1), times)
    assert np.argwhere(hits).tolist() == [[0, 0, 0], [1, 1, 0], [2, 2, 0], [3, 3, 0]]
    assert hits[hits > 0].tolist() == [8, 8, 8, 1]


def test_contact_of_less_than_a_micrometre_counts_for_no_beam():
    """Past an edge: 1.4e-6 voxels of 0.25 m."""
    o, d, shape = np.array([0.5, 0.5 + 1e-6, 0.5]), np.array([[1.0, 1.0, 0.0]]), np.array(SHAPE)
    hits, weighted = np.zeros(SHAPE, np.uint32), np.zeros(SHAPE, np.int64)
    traversal.count_hits(o, d, shape, VOXEL_M, hits.reshape(-1))
    traversal.add_hits(o, d, shape, VOXEL_M, np.array([5]), weighted.reshape(-1))
    assert np.argwhere(hits).tolist() == np.argwhere(weighted).tolist() == [[0, 0, 0], [1, 1, 0]]


@pytest.mark.parametrize(("length_m", "contacts"), [(1e-6, 0), (1.01e-6, 1)])
def test_chord_of_a_micrometre_is_no_contact(length_m, contacts):
    o, d, shape = np.array([2.5, 2.5, 1.5]), np.array([0.0, length_m, 0.0]), np.array(SHAPE)  # in voxels of 1 m
    hits, times = np.zeros(shape.prod(), np.int64), traversal.crossing_buffer(shape)
    traversal.add_stepwise(o, d, shape, 1.0, np.array([np.inf]), np.array([1]), hits, times)
    assert hits.sum() == contacts
    traversal.add_to_voxels(o, d, shape, 1.0, 1, hits, times)
    assert hits.sum() == 2 * contacts


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("tiny", [1e-9, 1e-300, 5e-324])
@pytest.mark.parametrize("along", range(3))
def test_component_that_hardly_moves_stays_in_its_row(along, tiny, sign):
    """From outside the grid, so that the part inside begins behind the start."""
    o, d, shape = np.full(3, 0.5), np.full(3, sign * tiny), np.array(SHAPE)
    o[along], d[along] = -4.0, 40.0
    hits, times = np.zeros(shape.prod(), np.int64), traversal.crossing_buffer(shape)
    traversal.add_to_voxels(o, d, shape, VOXEL_M, 1, hits, times)
    row = [tuple(np.where(np.arange(3) == along, k, 0)) for k in range(SHAPE[along])]
    assert np.flatnonzero(hits).tolist() == flat(row)


@pytest.mark.parametrize("along", range(3))
@pytest.mark.parametrize("length", [-1.0, 1.0])
def test_segments_of_one_voxel_across_the_borders(along, length):
    d, shape = np.zeros(3), np.array(SHAPE)
    d[along] = length
    for start in (-0.75, 0.25, SHAPE[along] - 0.25, SHAPE[along] + 0.75):
        o = np.full(3, 0.5)
        o[along] = start
        hits = np.zeros(shape.prod(), np.int64)
        traversal.add_to_voxels(o, d, shape, VOXEL_M, 1, hits, traversal.crossing_buffer(shape))
        assert np.flatnonzero(hits).tolist() == sorted(flat(oracle.crossed(o, d, SHAPE, VOXEL_M)))


@pytest.mark.parametrize(("gamma", "capped", "below"), [(4.0, [2, 0, 1], [3, 0, 1]), (np.inf, [0] * 3, [16, 0, 5])])
def test_classes_of_voxels_are_summed(gamma, capped, below):
    hits = np.array([4, 0, 1, 3, 4, 9, 50], np.uint32)  # the last voxel is in no class
    cells, classes = np.array([5, 0, 2, 1, 3, 4]), np.array([0, 2, 2, 1, 0, 0])
    sums = np.array([10, 20, 30]), np.array([40, 50, 60]), np.array([70, 80, 90])
    traversal.sum_by_class(hits, cells, classes, gamma, *sums)
    assert (sums[0] - [10, 20, 30]).tolist() == capped
    assert (sums[1] - [40, 50, 60]).tolist() == below
    assert (sums[2] - [70, 80, 90]).tolist() == [3, 0, 2]


@pytest.mark.parametrize("axes", list(itertools.permutations(range(3))))
@pytest.mark.parametrize("size", [1.0, 1e-3, 1e150, 1e154, 1e200, 1e307])
@pytest.mark.parametrize(("extent", "length"), [((2, -3, 6), 7), ((0, -3, 4), 5), ((0, 0, 5), 5)])
def test_chord_as_a_share_of_a_segment_of_any_length(axes, size, extent, length):
    d = size * np.array(extent, float)[list(axes)]
    assert traversal._min_chord_share(*d, VOXEL_M) == pytest.approx(4e-6 / length / size, rel=1e-12, abs=1e-320)


def sorted_crossings(o, d):
    """The voxels between any two crossings that follow one another, by the share of the segment, in float64."""
    with np.errstate(all="ignore"):
        planes = [(np.arange(n + 1) - o[a]) / d[a] if d[a] else np.empty(0) for a, n in enumerate(SHAPE)]
    inside = [0 <= o[a] < n for a, n in enumerate(SHAPE) if not d[a]]
    first, last = (max([0.0, *map(min, filter(len, planes))]), min([1.0, *map(max, filter(len, planes))]))
    if not all(inside) or not first < last:
        return []
    shares = sorted({first, last, *(t for axis in planes for t in axis if first < t < last)})
    length = np.ldexp(np.linalg.norm(np.ldexp(d, -600)), 600) if abs(d).max() > 1e100 else np.linalg.norm(d)
    listed = []
    for start, end in itertools.pairwise(shares):
        if end - start > traversal.CHORD_M / VOXEL_M / length:
            voxel = [int(x) for x in o]  # along an axis without extent
            for a in np.flatnonzero(d):
                crossed = np.count_nonzero(planes[a] <= start)
                voxel[a] = crossed - 1 if d[a] > 0 else SHAPE[a] - crossed
            listed.append((tuple(voxel), start, end))
    return listed


@pytest.mark.parametrize("start", [1.0, 1e3, 1e7, 1e12, 2e15, 4e15, 7e15, 9e15, 1e17, 1e200])
def test_segments_from_anywhere_agree_with_sorted_crossings(start):
    """Also where rounding moves a coordinate by many voxels, the crossings of all planes decide alone."""
    rng, shape = np.random.default_rng(14), np.array(SHAPE)
    cells, t_cells, times = np.empty(40, np.int64), np.empty((40, 2)), traversal.crossing_buffer(shape)
    listed = 0
    for _ in range(400 if 1e15 < start < 1e16 else 60):
        through, towards = rng.uniform(0, 1, 3) * SHAPE, rng.normal(size=3)
        towards[rng.random(3) < 0.2] = 0.0
        if not towards.any():
            continue
        o = through - start * towards
        d = rng.choice([1.0, 2.0, 1.0 + 1.0 / start]) * start * towards
        count, _, _ = traversal.list_voxels(o, d, shape, VOXEL_M, cells, t_cells, times)
        expected = sorted_crossings(o, d)
        assert cells[:count].tolist() == flat(voxel for voxel, _, _ in expected)
        assert t_cells[:count].tolist() == [[start, end] for _, start, end in expected]
        listed += count
    assert listed > 0 or start > 1e17


def test_end_that_rounding_moves_by_two_voxels():
    """Found by a search: the last voxel is guessed so far off that more crossings than guessed must be listed."""
    o = np.array([2.1587085536310988e16, 8201562820255005.0, 1184906604654226.8])
    d = np.array([-2.1587085536310988e16, -8201562820255006.0, -1184906604654225.5])
    cells, t_cells, shape = np.empty(40, np.int64), np.empty((40, 2)), np.array(SHAPE)
    times = traversal.crossing_buffer(shape)
    times[:3] = -1.0  # left over from another segment
    count, _, _ = traversal.list_voxels(o, d, shape, VOXEL_M, cells, t_cells, times)
    assert cells[:count].tolist() == flat(voxel for voxel, _, _ in sorted_crossings(o, d)) == [125, 21]


# --- the audit --------------------------------------------------------------------------------------------------------

AXES = list(itertools.permutations(range(3)))
"""The axes along which the grid has 4, 3 and 2 voxels; beams run along the first."""


class Lists:
    """Voxels and shares that beams cross, whatever they are: one list after another; None for a beam that misses."""

    def __init__(self, *lists):
        self._lists = iter(lists)

    def __call__(self, o, d, shape, voxel_m, cells, t_cells, times):
        listed = next(self._lists)
        assert times.shape == traversal.crossing_buffer(shape).shape
        assert len(cells) == len(t_cells) >= shape.sum()
        if listed is None:
            return 0, 1.0, 0.0
        for i, (voxel, start, end) in enumerate(listed):
            cells[i], t_cells[i] = np.ravel_multi_index(voxel, tuple(shape)), (start, end)
        return len(listed), 0.125, 0.625


def audit(axes, *lists):
    """Audit beams of 2 m that enter the grid at a share of 1/8, and leave it at 5/8, with these lists of voxels.

    Numbers are those along the axes with 4, 3 and 2 voxels.
    """
    to_grid = np.argsort(axes)
    shape, o, d = (np.array(values)[to_grid] for values in ((4, 3, 2), (-1.0, 1.5, 0.5), (8.0, 0.0, 0.0)))
    listed = [each and [(tuple(np.array(voxel)[to_grid]), *shares) for voxel, *shares in each] for each in lists]
    names = {**vars(traversal), "list_voxels": Lists(*listed)}
    audit_beams = FunctionType(traversal.audit_beams.__wrapped__.__code__, names)
    return audit_beams(o, np.tile(d, (len(lists), 1)).reshape(-1, 3), shape, VOXEL_M, np.zeros(24, np.uint32))


SOUND = [((i, 1, 0), (1 + i) / 8, (2 + i) / 8) for i in range(4)]


@pytest.mark.parametrize("axes", AXES)
def test_audit_figures(axes):
    assert audit(axes) == audit(axes, SOUND, SOUND, SOUND) == (0.0, 0.0, 0, 0)
    assert audit(axes, SOUND[1:]) == (0.0, 0.25, 0, 0), "1/8 of 2 m is missing"
    assert audit(axes, SOUND, SOUND[:1] + SOUND[2:], SOUND) == (0.0, 0.25, 0, 0)
    assert audit(axes, SOUND[:2], SOUND) == (0.0, 0.5, 0, 0)
    assert audit(axes, SOUND, SOUND, []) == (0.0, 1.0, 0, 0)
    assert audit(axes, None, SOUND[1:], None) == (0.0, 0.25, 0, 0), "a beam that misses the grid has no gap"
    for beside in ((1, 2, 0), (1, 0, 0), (1, 1, 1)):
        wrong = [*SOUND[:1], (beside, 0.25, 0.375), *SOUND[2:]]
        assert audit(axes, SOUND, wrong, SOUND, wrong) == (0.125, 0.0, 2, 0)
    twice = [*SOUND[:2], ((1, 1, 0), 0.375, 0.5), *SOUND[3:]]
    assert audit(axes, twice, SOUND, twice) == (0.0, 0.0, 2, 2)
    extra = [*SOUND[:2], ((0, 2, 1), 0.375, 0.375), ((1, 1, 0), 0.375, 0.375), *SOUND[2:]]
    assert audit(axes, extra, SOUND) == (0.125, 0.0, 1, 1)
    assert audit(axes, [*SOUND, ((3, 1, 0), 0.625, 0.625)]) == (0.125, 0.0, 0, 1)


@pytest.mark.parametrize("axes", AXES)
def test_audit_allows_a_chord_outside_its_voxel_by_a_billionth_of_the_grid(axes):
    """The middle of a chord lies behind the voxel's side by so many voxels; the grid is 4 long."""
    for outside, misplaced in ((3.9e-9, 0), (4.1e-9, 1), (-3.9e-9, 0), (0.25, 1)):
        start, end = SOUND[1][1:]
        assert audit(axes, [*SOUND[:1], ((1, 1, 0), start, end + (1 + 2 * outside) / 8)])[2] == misplaced
        assert audit(axes, [((1, 1, 0), start - (1 + 2 * outside) / 8, end)])[2] == misplaced


@pytest.mark.parametrize("shape", list(itertools.permutations((30, 3, 2))))
def test_audit_of_beams_from_corner_to_corner(shape):
    d, hits = np.array([shape, shape], float), np.zeros(np.prod(shape), np.uint32)
    worst_sum, longest_gap_m, misplaced, doubled = traversal.audit_beams(np.zeros(3), d, np.array(shape), VOXEL_M, hits)
    assert (worst_sum < 1e-12, longest_gap_m < 3e-6, misplaced, doubled) == (True, True, 0, 0)
    assert np.count_nonzero(hits) == 30
