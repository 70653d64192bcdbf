"""Does the march without divisions list what the exact one counts, and say so where it is not certain?

Evidence: rational arithmetic on the march's hostile corpus and on what Hypothesis makes up; beams of a whole sensor
against the exact march; how few beams are left to that; faults put into the source on purpose."""

import itertools
import re
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import event, given

from egvs.kernels import traversal
from tests.kernels.test_traversal import SHAPE, SOUND, is_near, of_entry, segments, seldom
from tests.oracles import march as oracle

GRID, VOXEL_M = (60, 40, 10), 0.25
SITES = {
    "on planes, inside": (30.0, 20.0, 4.0),
    "on the grid's face": (30.0, 40.0, 8.0),
    "anywhere": (11.3, 7.9, 9.2),
    "outside, on planes": (-8.0, 55.0, 12.0),
    "far away": (-4e5, 3e5, 2e4),
}


def list_voxels(kernels, o, d, shape, voxel_m):
    """The voxels that ``crossed`` lists, once each; None where it is not certain."""
    o, d, shape = np.array(o, float), np.array(d, float), np.asarray(shape, np.int64)
    cells = kernels.cell_buffer(shape)
    count = kernels.traverse_fixed_point(
        o, d, shape, kernels.make_tolerances(o, shape, traversal.CHORD_M / voxel_m), cells
    )
    if count < 0:
        return None
    assert len(set(cells[:count].tolist())) == count
    return {tuple(int(i) for i in np.unravel_index(c, tuple(shape))) for c in cells[:count]}


@cache
def exact(o, d, shape, voxel_m):
    """The voxels by rational arithmetic; None where one is ambiguous."""
    return None if oracle.ambiguous(o, d, shape, voxel_m) else oracle.crossed(o, d, shape, voxel_m)


def agrees_with_exact_march(kernels, o, d, shape, voxel_m):
    """Whether the listed voxels agree with rational arithmetic; True where the kernel is not certain."""
    found = list_voxels(kernels, o, d, shape, voxel_m)
    return found is None or found == exact(tuple(o), tuple(d), tuple(shape), voxel_m)


def in_voxels(entry):
    """Not moved to planes, as the pipeline does: more hostile."""
    start, beam, origin, voxel_m, shape = of_entry(entry)
    return np.subtract(start, origin) / voxel_m, np.array(beam) / voxel_m, shape, voxel_m


def beams(o, n=400, seed=3):
    """Extents from ``o``: to random places, half of them on planes (walls, roofs, the ground), some level."""
    rng = np.random.default_rng(seed)
    ends, axis = rng.uniform(-0.5, 1.5, (n, 3)) * GRID, rng.integers(3, size=(n, 1)) == np.arange(3)
    ends = np.where(axis & (np.arange(n) % 2 == 0)[:, None], np.rint(ends), ends)
    ends[::7, 2] = o[2]
    return ends - o


def exact_hits(o, d, shape, voxel_m, weights):
    """Hits by the lists of the exact march."""
    hits, shape = np.zeros(np.prod(shape), np.int64), np.asarray(shape, np.int64)
    cells, t_cells = np.empty(shape.sum() + 3, np.int64), np.empty((shape.sum() + 3, 2))
    times = traversal.crossing_buffer(shape)
    for beam, weight in zip(d, weights, strict=True):
        count, _, _ = traversal.list_voxels(o, beam, shape, voxel_m, cells, t_cells, times)
        hits[cells[:count]] += weight
    return hits


@pytest.mark.slow
@pytest.mark.parametrize("entry", SOUND, ids=[entry["name"] for entry in SOUND])
def test_hard_segment(entry):
    o, d, shape, voxel_m = in_voxels(entry)
    if is_near(entry, False):
        assert agrees_with_exact_march(traversal, o, d, shape, voxel_m)


@pytest.mark.slow
@seldom
@given(segments())
def test_random_segment_agrees_with_rational_arithmetic(segment):
    o, d, voxel_m = segment
    event("certain" if list_voxels(traversal, o, d, SHAPE, voxel_m) is not None else "not certain")
    assert agrees_with_exact_march(traversal, o, d, SHAPE, voxel_m)


@pytest.mark.parametrize("site", list(SITES))
def test_beams_of_sensor_agree_with_exact_march(site):
    o, shape = np.array(SITES[site]), np.array(GRID, np.int64)
    d = beams(o)
    weights = np.arange(1, len(d) + 1)
    hits, weighted = np.zeros(shape.prod(), np.uint32), np.zeros(shape.prod(), np.int64)
    traversal.count_hits(o, d, shape, VOXEL_M, hits)
    traversal.add_hits(o, d, shape, VOXEL_M, weights, weighted)
    assert hits.sum() > len(d)
    assert np.array_equal(hits, exact_hits(o, d, shape, VOXEL_M, np.ones_like(weights)))
    assert np.array_equal(weighted, exact_hits(o, d, shape, VOXEL_M, weights))


@pytest.mark.parametrize("site", list(SITES))
def test_few_beams_need_the_exact_march(site):
    o = np.array(SITES[site])
    crossing = [beam for beam in beams(o) if exact_hits(o, [beam], GRID, VOXEL_M, [1]).any()]
    left = sum(list_voxels(traversal, o, beam, GRID, VOXEL_M) is None for beam in crossing)
    assert left <= 0.01 * len(crossing)


def test_level_beams_from_a_plane_are_certain():
    o, turn = np.array([30.25, 20.5, 4.0]), np.deg2rad(np.arange(0.7, 360, 7.3))
    for level in np.column_stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))]) * 100:
        found = list_voxels(traversal, o, level, GRID, VOXEL_M)
        assert found is not None
        assert {k for _, _, k in found} == {4}


@pytest.mark.parametrize(
    ("shape", "voxel_m", "o"),
    [
        ((2**20 + 1, 1, 1), 0.25, (0.5, 0.5, 0.5)),
        ((2**12, 2**12, 2**9), 0.25, (0.5, 0.5, 0.5)),
        (GRID, 1e-5, (0.5, 0.5, 0.5)),
        (GRID, VOXEL_M, (1e15, 0.5, 0.5)),
        (GRID, VOXEL_M, (1e300, 0.5, 0.5)),
    ],
    ids=["a long axis", "too many voxels", "voxels as small as the chord", "from too far", "from nowhere"],
)
def test_reports_uncertain_beams(shape, voxel_m, o):
    o, shape = np.array(o), np.array(shape, np.int64)
    near = traversal.make_tolerances(o, shape, traversal.CHORD_M / voxel_m)
    assert near.plane == np.inf
    assert traversal.traverse_fixed_point(o, np.array([3.3, 0.1, 0.2]), shape, near, np.empty(20, np.uint32)) == -1


@pytest.mark.parametrize("axes", list(itertools.permutations(range(3))))
def test_beam_that_misses_an_edge_is_certain(axes):
    """By more than the margin, 4e-6 voxels; a long beam, too."""
    axes = list(axes)
    shape = np.array(GRID, np.int64)[axes]
    for missed, count in ((1e-3, 0), (1e-5, 0), (1e-6, -1)):
        o, d = np.array([-50.0, GRID[1] + missed - 50.0, 0.5])[axes], np.array([100.0, 100.0, 0.0])[axes]
        near = traversal.make_tolerances(o, shape, traversal.CHORD_M / VOXEL_M)
        assert traversal.traverse_fixed_point(o, d, shape, near, traversal.cell_buffer(shape)) == count


def count_along(axis, start, extent, others=0.5, drift=0.0):
    """Number of voxels that the fixed-point traversal lists for a segment along an axis of the grid.

    ``others`` and ``drift``: start and extent along the other two axes.
    """
    shape, o, d = np.array(GRID, np.int64), np.full(3, others), np.full(3, drift)
    o[axis], d[axis] = start, extent
    near = traversal.make_tolerances(o, shape, traversal.CHORD_M / VOXEL_M)
    return traversal.traverse_fixed_point(o, d, shape, near, traversal.cell_buffer(shape))


@pytest.mark.parametrize("plane", [1, 2, 9])
@pytest.mark.parametrize("axis", range(3))
def test_segment_that_begins_or_ends_near_a_plane_is_not_certain(axis, plane):
    """Within the margin of 4e-6; exactly on it, or less than half a chord behind it at the end, it is."""
    for ahead in (-1.0, 1.0):
        to_border = plane + 1.5 if ahead < 0 else GRID[axis] - plane + 1.5
        voxels = plane if ahead < 0 else GRID[axis] - plane
        for aside in (-3e-6, 3e-6):
            assert count_along(axis, plane + aside, ahead * to_border) == -1
        assert count_along(axis, plane, ahead * to_border) == voxels
        assert count_along(axis, plane - ahead * to_border, ahead * (to_border + 3e-6)) == -1
        assert count_along(axis, plane - 0.5 * ahead, ahead * (0.5 + 1e-6)) == 1


@pytest.mark.parametrize("axis", range(3))
def test_segments_outside_the_grid_and_across_a_face(axis):
    assert count_along(axis, -0.5, 1.0) == 1
    assert count_along(axis, -0.5, 5.0, others=-0.5) == 0
    assert count_along(axis, 0.5, 5.0, others=-0.5) == 0
    assert count_along(axis, 0.5, 5.0, others=GRID[0] + 0.5) == 0
    assert count_along(axis, 0.25, 1.0, drift=1.0) == -1, "through edges and corners"


@pytest.mark.parametrize("roundings_beyond", [-2.0, -0.5, 2.0])
@pytest.mark.parametrize("ahead", [-1.0, 1.0])
def test_end_counts_as_no_contact_only_where_rounding_cannot_change_that(ahead, roundings_beyond):
    """Half a chord behind a plane, or less than a rounding nearer: not certain. Two roundings nearer: certain."""
    shape, o = np.array(GRID, np.int64), np.array([20.5, 20.5, 4.5])
    near, cells = traversal.make_tolerances(o, shape, traversal.CHORD_M / VOXEL_M), traversal.cell_buffer(shape)
    d = np.array([ahead * (9.5 + 0.499 * near.chord + roundings_beyond * near.rounding), 0.0, 0.0])
    count = traversal.traverse_fixed_point(o, d, shape, near, cells)
    assert count == (10 if roundings_beyond == -2.0 else -1)


@pytest.mark.parametrize("axes", list(itertools.permutations(range(3))))
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_margins_are_as_wide_as_the_bounds_and_hardly_wider(axes, side):
    """With S = 60 + 70: 16 u S for rounding; beside it the chord, and a digit for the start and for each step."""
    shape, o = np.array([60, 40, 10])[list(axes)], np.array([side * 70.0, 3.0, -8.0])[list(axes)]
    near, digit = traversal.make_tolerances(o, shape, 2.0**-38), 2.0**-40
    assert near.chord == 2.0**-38
    assert near.rounding == 16 * 2.0**-53 * 130
    assert near.chord + near.rounding + 61 * digit < near.plane < 1.002 * near.chord + near.rounding + 65 * digit


@pytest.mark.parametrize("axes", list(itertools.permutations(range(3))))
def test_largest_grids_that_have_margins(axes):
    """Up to 2^20 voxels along an axis, 2^32 in all, and margins of a tenth of a voxel."""
    for shape, chord, is_certain in (
        ((2**20, 2**6, 2**6), 1e-6, True),
        ((2**20 + 1, 2**6, 1), 1e-6, False),
        ((2**12, 2**12, 2**8), 1e-6, True),
        ((2**12, 2**12, 2**8 + 1), 1e-6, False),
        ((60, 40, 10), 0.099, True),
        ((60, 40, 10), 0.101, False),
    ):
        near = traversal.make_tolerances(np.full(3, 0.5), np.array(shape)[list(axes)], chord)
        assert (near.plane < np.inf) == is_certain


@pytest.mark.slow
def test_margin_covers_truncation_of_a_million_steps():
    """Each step is nearly a digit too short, so y is wrong by some 1e-6 where it has just passed a plane: not certain.
    Without room for a whole digit a step, voxels on the wrong side of the plane would be listed."""
    shape, voxel_m, step = np.array([2**20, 2, 2], np.int64), 1e4, (2.0**16 + 0.9999) / 2.0**40
    o, d = np.array([0.5, 1.0 + 5e-7 - step * (2**20 - 40.5), 0.5]), np.array([2.0**20, step * 2.0**20, 0.0])
    cells, near = traversal.cell_buffer(shape), traversal.make_tolerances(o, shape, traversal.CHORD_M / voxel_m)
    assert traversal.traverse_fixed_point(o, d, shape, near, cells) == -1
    count = traversal.traverse_fixed_point(
        o, d, shape, near._replace(plane=near.plane - (2.0**20 + 4.0) / 2.0**40), cells
    )
    truly, t_cells = np.empty(shape.sum() + 3, np.int64), np.empty((shape.sum() + 3, 2))
    times = traversal.crossing_buffer(shape)
    assert count == traversal.list_voxels(o, d, shape, voxel_m, truly, t_cells, times)[0]
    assert len(np.setxor1d(cells[:count], truly[:count])) > 8


@pytest.mark.parametrize("x", [5e-324, 1e-310, 1e-300, 1e200, 1.7e308])
def test_zero_or_overflowing_extents_need_the_exact_march(x):
    for d in itertools.permutations((3.0, x, 0.1)):
        assert list_voxels(traversal, (0.5, 0.5, 0.5), d, SHAPE, VOXEL_M) is None
    assert list_voxels(traversal, (0.5, 0.5, 0.5), (0.0, 0.0, -x), SHAPE, VOXEL_M) is None


# --- faults -----------------------------------------------------------------------------------------------------------


def with_fault(*replacements):
    """The source with some text replaced, as plain Python: not compiled, so a fault costs no compilation."""
    source = Path(traversal.__file__).read_text(encoding="utf-8")
    for old, new in (("_BLOCK_SIZE = 16", "_BLOCK_SIZE = 1"), *replacements):
        assert old in source, f"the fault does not fit the source any more: {old}"
        source = source.replace(old, new)
    source = re.sub(r"^(_kernel|_inlined) = njit\(.*\)$", r"\1 = lambda function: function", source, flags=re.MULTILINE)
    namespace = {"__name__": "faulty"}
    exec(compile(source, "faulty march", "exec"), namespace)
    return SimpleNamespace(**namespace)


FAULTS = {
    "none": (),
    "no room for chords that are no contact": (("1.001 * chord + rounding", "rounding"),),
    "no room for rounding": (("1.001 * chord + rounding + (longest + 4.0) / _ONE", "1e-30"),),
    "the second coordinate is not looked at": (("a & _FRACTION, b & _FRACTION", "a & _FRACTION"),),
    "the first coordinate is not looked at": (("a & _FRACTION, b & _FRACTION", "b & _FRACTION"),),
    "a start near a plane is certain": (("certain = t_first == 0.0 and o == plane", "certain = True"),),
    "from a plane downwards it starts above": (("first = plane - 1.0", "first = plane"),),
    "an end near a plane is certain": (("abs(end - plane) + tolerances.rounding <= tail * abs(d)", "True"),),
    "an end on a plane lies behind it": (("last = plane - 1.0 if d > 0.0 else plane", "last = np.floor(end)"),),
    "a short segment is certain": (("(t_last - t) * largest > 4.0 * tolerances.plane", "True"),),
    "the upper face is in the grid": (("if 0.0 <= o < n else", "if 0.0 <= o <= n else"),),
    "steps of the wrong size": (("_to_fixed_point(axis.d * step)", "_to_fixed_point(axis.d * step * (1.0 + 1e-3))"),),
    "ends at the border only": (("nx, 0.0, 1.0)", "nx, 0.0, np.inf)"),),
    "starts behind the sensor": (("nx, 0.0, 1.0)", "nx, -np.inf, 1.0)"),),
}


def hard_beams():
    """Segments of a few voxels that cut corners and end on planes, beside the corpus: (o, d, shape, voxel_m)."""
    rng = np.random.default_rng(8)
    shape = (9, 7, 5)
    for _ in range(600):
        ends = rng.uniform(-1, 1.2, (2, 3)) * shape
        corner = np.rint(rng.uniform(0, 1, 3) * shape)
        aside = rng.choice([-1.0, 1.0], 3) * 10.0 ** rng.uniform(-6.5, -4.5, 3)
        kind, axis = rng.integers(4), rng.integers(3)
        if kind == 0:  # past a corner, in two axes
            aside[axis] += rng.uniform()
            ends[1] = 2 * (corner + aside) - ends[0]
        if kind == 1:  # ends on a plane, or beside it
            ends[1, axis] = corner[axis] + rng.choice([0.0, aside[axis]])
        if kind == 2:  # starts on a plane, or beside it
            ends[0] = corner + 0.3
            ends[0, axis] = corner[axis] + rng.choice([0.0, aside[axis]])
        if kind == 3:  # hardly leaves its plane
            ends[:, axis] = corner[axis] + rng.choice([0.0, aside[axis]], 2)
        yield ends[0], ends[1] - ends[0], shape, VOXEL_M


CASES = [*(in_voxels(entry) for entry in SOUND if is_near(entry, False)), *hard_beams()]


@pytest.mark.slow
def test_hard_beams_agree_with_rational_arithmetic():
    for o, d, shape, voxel_m in CASES:
        assert agrees_with_exact_march(traversal, o, d, shape, voxel_m)
        expected = exact(tuple(o), tuple(d), tuple(shape), voxel_m)
        if expected is not None:
            hits = np.zeros(shape, np.int64)
            weights = np.array([3])
            traversal.add_hits(o, np.array([d]), np.array(shape), voxel_m, weights, hits.reshape(-1))
            assert {tuple(cell) for cell in np.argwhere(hits == 3).tolist()} == expected


@pytest.mark.slow
@pytest.mark.parametrize("fault", list(FAULTS))
def test_detects_fault(fault):
    faulty = with_fault(*FAULTS[fault])
    shown = 0
    for o, d, shape, voxel_m in CASES:
        try:
            with np.errstate(all="ignore"):
                shown += not agrees_with_exact_march(faulty, o, d, shape, voxel_m)
        except (IndexError, AssertionError, ValueError, OverflowError):
            shown += 1
    assert bool(shown) == (fault != "none"), shown
