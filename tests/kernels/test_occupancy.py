"""Is a voxel occupied exactly when a vehicle's box overlaps it by more than 0.1 mm?

Evidence: separating axes in rationals and in 50 digits (tests/oracles/boxes.py); a TPOG by brute force; limits and
symmetries; recorded trajectories moved by a nanometre; and faults put into the kernel on purpose."""

import itertools
import math
import re
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks.numerics import boxes as hunt
from hypothesis import event, given, settings
from hypothesis import strategies as st

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.frame_boxes import FrameBoxes, read_boxes
from egvs.core.errors import InputError
from egvs.core.grid import Grid
from egvs.kernels import occupancy as kernels_occupancy
from egvs.scoring import occupancy as scoring_occupancy
from egvs.stages import traffic
from tests.oracles import boxes as oracle
from tests.stage_runner import run_stage

SHAPE, VOXEL_M = (8, 7, 5), 0.25
SCENARIO = Path(__file__).resolve().parents[2] / "scenarios" / "nishishinjuku"

often = settings(derandomize=True, deadline=None, max_examples=200, database=None)


def grid_of(shape=SHAPE, voxel_m=VOXEL_M, origin_m=(0.0, 0.0, 0.0)):
    return Grid(tuple(origin_m), voxel_m, tuple(shape))


def count(frames, values, grid=None, total=1):
    """Counts by the pipeline's own way in."""
    batch = FrameBoxes(np.asarray(frames, np.int64), np.asarray(values, float).reshape(-1, 8))
    return scoring_occupancy.count_occupancy(batch, grid or grid_of(), total)


def cells_of(box, shape=SHAPE, voxel_m=VOXEL_M):
    """The voxels that one box occupies."""
    counts = count([0], [box], grid_of(shape, voxel_m))
    assert counts.max(initial=0) <= 1
    return {tuple(int(i) for i in cell) for cell in np.argwhere(counts)}


def check(box, shape=SHAPE, voxel_m=VOXEL_M):
    found, (inside, unsure) = cells_of(box, shape, voxel_m), oracle.occupied(box, shape, voxel_m)
    assert found ^ inside <= unsure, box
    return found, unsure


def ulps(value, n):
    for _ in range(abs(n)):
        value = math.nextafter(value, math.copysign(math.inf, n))
    return value


# --- box against voxel ---


def rational_pose(draw):
    turns = []
    for _ in range(2):
        a, b, c = draw(st.sampled_from(oracle.PYTHAGOREAN))
        turns += [Fraction(a, c) * draw(st.sampled_from([-1, 1])), Fraction(b, c) * draw(st.sampled_from([-1, 1]))]
    return turns


@st.composite
def rational_pairs(draw):
    """A box of rational pose, and how it stands to the voxel [0, 1/4)^3: near the 0.1 mm bound as often as far from
    it."""
    sin_yaw, cos_yaw, sin_pitch, cos_pitch = rational_pose(draw)
    axes = oracle.axes_of(sin_yaw, cos_yaw, sin_pitch, cos_pitch)
    half = [Fraction(draw(st.integers(2, 400)), 400) for _ in range(3)]
    centre = [Fraction(draw(st.integers(-512, 512)), 512) for _ in range(3)]
    deep = oracle.depth(centre, axes, half, [Fraction(0)] * 3, Fraction(1, 4))
    if draw(st.booleans()):
        # The same box with other half sizes, so that its depth is 0.1 mm and a little more or less.
        off = draw(st.sampled_from([-1, 1])) * Fraction(draw(st.integers(2, 1000)), 10**9)
        half = [h - deep + oracle.SHRINK_M + off for h in half]
    return centre, axes, half


@pytest.mark.slow
@settings(often, max_examples=400)
@given(rational_pairs())
def test_random_pair_agrees_with_exact_separating_axes(pair):
    centre, axes, half = pair
    if min(half) < Fraction(1, 1000):
        return
    exact = oracle.depth(centre, axes, half, [Fraction(0)] * 3, Fraction(1, 4))
    if abs(exact - oracle.SHRINK_M) <= oracle.MARGIN_M:
        event("within 1e-9 m of the bound")
        return
    event("within 1e-6 m of the bound" if abs(exact - oracle.SHRINK_M) < Fraction(1, 10**6) else "far from the bound")
    floats = [np.array(v, float) for v in (centre, axes, [h - oracle.SHRINK_M for h in half])]
    assert kernels_occupancy.overlaps(*floats, np.zeros(3), 0.25) == (exact > oracle.SHRINK_M)


def test_nearly_parallel_edges():
    """A box turned by less than 1e-6 whose edge passes an edge of the voxel: only the very short cross product parts
    them."""
    rng, unlike = np.random.default_rng(8), 0
    for _ in range(60):
        k = [Fraction(int(n)) for n in rng.choice([-1, 1], 2) * rng.integers(2_000_000, 20_000_000, 2)]
        yaw, pitch = ((2 * n / (n * n + 1), (n * n - 1) / (n * n + 1)) for n in k)
        axes, half = oracle.axes_of(*yaw, *pitch), [Fraction(2), Fraction(3, 10), Fraction(3, 10)]
        at_y, at_z = (Fraction(rng.integers(1, 250).item(), 1000) - Fraction(1, 8) for _ in range(2))
        centre = [Fraction(1, 8)] + [
            Fraction(1, 4)
            + sum((h - oracle.SHRINK_M) * axes[i][a] for i, h in ((1, half[1]), (2, half[2])))
            - at * axes[0][a]
            for a, at in ((1, at_y), (2, at_z))
        ]
        exact = oracle.depth(centre, axes, half, [Fraction(0)] * 3, Fraction(1, 4))
        if abs(exact - oracle.SHRINK_M) > oracle.MARGIN_M:
            floats = [np.array(v, float) for v in (centre, axes, [h - oracle.SHRINK_M for h in half])]
            assert kernels_occupancy.overlaps(*floats, np.zeros(3), 0.25) == (exact > oracle.SHRINK_M)
            unlike += exact < oracle.SHRINK_M
    assert unlike > 10


angle = st.one_of(
    st.builds(lambda k, n: ulps(k * math.pi / 4, n), st.integers(-8, 8), st.integers(-1, 1)),
    st.floats(-7, 7),
    st.sampled_from([1e-300, 5e-324, -1e-17, 1e-12, 1e-9, math.atan2(3, 4), math.atan2(-5, 12)]),
)
slope = st.one_of(
    st.just(0.0),
    st.just(0.0),
    st.sampled_from([-0.0, 5e-324, 1e-310, 1e-17, -1e-13, 1e-12, 1e-9, 1e-4]),
    st.floats(-0.3, 0.3),
    st.floats(-1.6, 1.6),
)
size_m = st.one_of(
    st.integers(1, 8).map(lambda n: n * VOXEL_M),
    st.floats(1e-3, 0.25),
    st.floats(0.1, 3),
    st.sampled_from([1e-3, 0.01, 1.75, 40.0]),
)
where_m = st.one_of(
    st.integers(-4, 20).map(lambda n: n * VOXEL_M / 2),
    st.builds(
        lambda n, s: n * VOXEL_M / 2 + s,
        st.integers(-4, 20),
        st.sampled_from([1e-4, -1e-4, 1.1e-4, 0.9e-4, 1e-9, -1e-9]),
    ),
    st.builds(lambda n, u: ulps(n * VOXEL_M / 2, u), st.integers(-4, 20), st.integers(-2, 2)),
    st.floats(-1, 3),
)
any_box = st.tuples(where_m, where_m, where_m, angle, slope, size_m, size_m, size_m)


@pytest.mark.slow
@often
@given(any_box)
def test_random_box_agrees_with_50_digits(box):
    _, unsure = check(box)
    event(f"flat: {box[4] == 0}; within 1e-9 m of the bound: {bool(unsure)}")


@pytest.mark.slow
@pytest.mark.parametrize("pitch", [0.0, 1e-300, 1e-13, 0.02])
@pytest.mark.parametrize("beside", [-1, 0, 1])
@pytest.mark.parametrize("eighths", range(-4, 5))
def test_yaw_at_and_near_multiples_of_45_degrees(eighths, beside, pitch):
    box = (1.0, 0.875, 0.5, ulps(eighths * math.pi / 4, beside), pitch, 1.0, 0.75, 0.5)
    found, unsure = check(box)
    assert not unsure
    if eighths % 4 == 0 and pitch < 0.01:
        assert found == set(itertools.product((2, 3, 4, 5), (2, 3, 4), (1, 2)))  # its sides coincide with voxel faces
    if eighths % 4 == 2 and pitch < 0.01:
        assert len(found) == 2 * 5 * 4  # half a metre to each side in y, 0.375 m in x: parts of four columns


@pytest.mark.parametrize("pitch", [0.0, 1e-12])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_faces_at_and_0_1_mm_from_voxel_faces(axis, sign, pitch):
    inside = set(itertools.product((2, 3), (2, 3), (2, 3)))
    for move, more in (
        (0.0, False),
        (0.9999e-4, False),
        (1.0001e-4, True),
        (-0.9999e-4, False),
        (1e-9, False),
        (-1e-9, False),
    ):
        box = [0.75, 0.75, 0.75, 0.0, pitch, 0.5, 0.5, 0.5]
        box[axis] += sign * move
        found = cells_of(box)
        assert (found != inside) == more, move
        assert found >= inside
    # A voxel that a side leaves is kept while 0.1 mm of the box reaches into it.
    box = [0.75, 0.75, 0.75, 0.0, pitch, 0.5, 0.5, 0.5]
    box[axis] += sign * (0.25 - 0.9999e-4)
    assert inside - cells_of(box) == {cell for cell in inside if cell[axis] == (2 if sign > 0 else 3)}
    box[axis] = 0.75 + sign * (0.25 - 1.0001e-4)
    assert inside <= cells_of(box)


@pytest.mark.parametrize("pitch", [0.0, 1e-12, 0.1])
def test_box_larger_than_region_fills_it(pitch):
    assert len(cells_of((1.0, 1.0, 0.5, 0.3, pitch, 40.0, 40.0, 40.0))) == math.prod(SHAPE)


@pytest.mark.parametrize("pitch", [0.0, 0.05])
def test_box_thinner_than_voxel(pitch):
    found, unsure = check((1.13, 0.88, 0.63, 0.4, pitch, 1.2, 0.002, 0.003))
    assert found
    assert not unsure


@pytest.mark.parametrize("pitch", [0.0, 1e-12])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_outside_by_one_ulp_and_inside_by_1_mm(axis, pitch):
    for side, edge in ((-1, 0.0), (1, SHAPE[axis] * VOXEL_M)):
        box = [1.1, 0.9, 0.6, 0.0, pitch, 0.5, 0.5, 0.5]
        for n in (-1, 0, 1):
            box[axis] = ulps(edge + side * 0.25, n)
            assert cells_of(box) == set()
        box[axis] = edge + side * 0.249
        assert cells_of(box)


@pytest.mark.slow
def test_pitched_and_flat_agree_as_pitch_goes_to_zero():
    rng = np.random.default_rng(1)
    for _ in range(30):
        box = [*rng.uniform(0, 2, 3), rng.uniform(-7, 7), 0.0, *rng.uniform(0.01, 2, 3)]
        _, unsure = oracle.occupied(box, SHAPE, VOXEL_M)
        for pitch in (5e-324, -1e-310, 1e-200, 1e-99, 1e-17, 1e-13, 1e-11):
            steep = [*box[:4], pitch, *box[5:]]
            assert cells_of(steep) ^ cells_of(box) <= unsure


def test_half_turn_and_swapped_sides_give_same_voxels():
    rng = np.random.default_rng(2)
    for _ in range(60):
        x, y, z, yaw, length, width, height = *rng.uniform(0, 2, 3), rng.uniform(-3, 3), *rng.uniform(0.01, 2, 3)
        same = cells_of((x, y, z, yaw, 0.0, length, width, height))
        assert cells_of((x, y, z, yaw + math.pi, 0.0, length, width, height)) == same
        assert cells_of((x, y, z, yaw + math.pi / 2, 0.0, width, length, height)) == same
        assert cells_of((x, y, z, yaw + math.pi, 0.1, length, width, height)) == cells_of(
            (x, y, z, yaw, -0.1, length, width, height)
        )


@pytest.mark.slow
@pytest.mark.parametrize("voxel_m", [0.1, 0.3, 1.0])
def test_other_voxel_sizes(voxel_m):
    rng = np.random.default_rng(3)
    for _ in range(10):
        box = [
            *rng.integers(0, 12, 3) * voxel_m / 2,
            rng.choice([0.0, math.pi / 2, 0.3]),
            rng.choice([0.0, 0.1]),
            *rng.integers(1, 6, 3) * voxel_m,
        ]
        check(box, (6, 6, 5), voxel_m)


@pytest.mark.slow
def test_margin_holds_at_large_coordinates():
    """The bound that holds: 2**-48 of the largest coordinate or size; 1e-9 m covers boxes of up to 100 km."""
    rng = np.random.default_rng(4)
    for _ in range(25):
        yaw = rng.choice([rng.uniform(-3, 3), 10 ** rng.uniform(-14, -6)])  # nearly parallel edges give short axes
        pitch, far = rng.choice([0.0, 0.01, 1e-12, 1e-9]), 10 ** rng.uniform(2, 5)
        # A long box whose front reaches into the grid.
        tip, forward = (
            rng.uniform(0.3, 1.5, 3),
            np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)]),
        )
        check([*(tip - forward * far / 2), yaw, pitch, far, 0.6, 0.5])


# --- what is no box ---

COLUMNS = ("x_m", "y_m", "z_m", "yaw_rad", "pitch_rad", "length_m", "width_m", "height_m")
GOOD = dict(zip(COLUMNS, (1.0, 1.0, 0.5, 0.1, 0.0, 4.5, 1.8, 1.5), strict=True))


@pytest.mark.parametrize("bad", [0.0, -0.0, -1.0, 5e-324, 0.9e-3, 2001.0, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", COLUMNS)
def test_rejects_invalid_box(name, bad, tmp_path):
    if math.isfinite(bad) and not name.startswith(("length", "width", "height")):
        return
    rows = [GOOD, GOOD | {name: bad}]
    others = {"vehicle": ["a", "b"], "part": [0, 0], "kind": ["passenger"] * 2}
    columns = {"frame": [6, 7], **others} | {c: [row[c] for row in rows] for c in COLUMNS}
    parquet.write_artefact(tmp_path / "trajectories.parquet", "trajectories", columns, {"schema": 1, "frames": 8})
    with pytest.raises(
        InputError, match=r"trajectories.parquet: frame 7: expected finite values and sizes from 0.001 m"
    ) as caught:
        list(read_boxes(tmp_path / "trajectories.parquet", grid_of()))
    assert f"{name} = {bad:g}" in str(caught.value)


# --- the TPOG by brute force ---


def traffic_of(rng, frames, crowd=4):
    """Random vehicles, many of them overlapping, some pitched, some on voxel faces."""
    frame, values = [], []
    for f in range(frames):
        for _ in range(rng.integers(0, crowd + 1)):
            x, y, z = rng.uniform(-0.3, 2.3, 3)
            if rng.random() < 0.3:
                x, y, z = np.rint(np.array([x, y, z]) * 8) / 8
            size = rng.choice([0.25, 0.5, 0.75]) if rng.random() < 0.3 else rng.uniform(0.05, 0.9)
            yaw, pitch = rng.choice([0.0, math.pi / 2, rng.uniform(-3, 3)]), rng.choice([0.0, 0.0, 0.1, -0.4])
            values.append([x, y, z, yaw, pitch, size, rng.uniform(0.05, 0.8), rng.uniform(0.05, 0.8)])
            frame.append(f)
    return np.array(frame, np.int64), np.array(values).reshape(-1, 8)


@pytest.mark.slow
def test_small_traffic_agrees_with_brute_force():
    """Overlapping vehicles count once a frame; blocks add up; row groups need not end where blocks do."""
    rng = np.random.default_rng(5)
    shape, frames = (6, 6, 5), 12
    frame, values = traffic_of(rng, frames, crowd=9)
    expected, ambiguous = oracle.tpog(frame, values, shape, VOXEL_M, frames)
    assert ambiguous == 0
    expected = np.array(expected)
    assert expected.max() >= 3
    assert np.array_equal(count(frame, values, grid_of(shape), frames), expected)
    for blocks, cuts in (
        (1, (3, 4, 9)),
        (3, (1, 5, 6, 7)),
        (4, (2, 11)),
        (12, (5,)),
        (2, ()),
        (6, tuple(range(1, 12))),
    ):
        edges = [0, *np.searchsorted(frame, cuts).tolist(), len(frame)]
        batches = [FrameBoxes(frame[a:b], values[a:b]) for a, b in itertools.pairwise(edges)]
        parts = [
            counts.copy()
            for counts, _ in scoring_occupancy.count_blocks(iter(batches), grid_of(shape), frames // blocks, blocks)
        ]
        assert len(parts) == blocks
        assert np.array_equal(sum(parts), expected), (blocks, cuts)
        for block, part in enumerate(parts):
            first, last = block * frames // blocks, (block + 1) * frames // blocks
            here = (frame >= first) & (frame < last)
            assert np.array_equal(part, count(frame[here] - first, values[here], grid_of(shape), last - first)), (
                blocks,
                block,
            )


def stack(*intervals, pitch=()):
    """Boxes one above the other in the same columns, each from layer a to layer b (exclusive)."""
    rows = []
    for n, (a, b) in enumerate(intervals):
        middle, height = (a + b) / 2 * VOXEL_M, (b - a) * VOXEL_M
        rows.append([0.75, 0.75, middle, 0.0, 1e-12 if n in pitch else 0.0, 0.5, 0.5, height])
    return rows


@pytest.mark.parametrize(
    "intervals",
    [
        [(0, 1), (3, 4)],  # disjoint
        [(0, 2), (2, 4)],  # touching
        [(0, 5), (1, 3)],  # nested
        [(0, 3), (2, 5)],  # overlapping
        [(1, 2), (1, 2)],  # equal
        [(0, 1), (2, 3), (4, 5)],
        [(0, 1), (4, 5), (2, 3)],
        [(0, 1), (4, 5), (1, 4)],  # the third fills the gap
        [(4, 5), (0, 1), (0, 5)],  # the third holds both
        [(2, 3), (0, 1), (4, 5), (1, 2), (3, 4)],
        [(0, 1), (2, 3), (4, 5), (2, 3), (0, 1)],
    ],
    ids=str,
)
def test_vehicles_in_one_column_at_different_heights(intervals):
    for order in itertools.islice(itertools.permutations(intervals), 24):
        for pitch in ((), (0,), (1,), tuple(range(len(order)))):
            counts = count([0] * len(order), stack(*order, pitch=pitch))
            expected = np.zeros(SHAPE, int)
            for a, b in order:
                expected[2:4, 2:4, a:b] = 1
            assert np.array_equal(counts, expected), (order, pitch)


@settings(often, max_examples=60)
@given(
    st.lists(
        st.tuples(
            st.integers(0, 3),
            st.integers(0, 5),
            st.integers(0, 5),
            st.integers(0, 4),
            st.integers(1, 4),
            st.integers(1, 5),
            st.booleans(),
        ),
        max_size=14,
    )
)
def test_random_pile_of_boxes_agrees_with_sets(pile):
    """Boxes on voxel faces: what each occupies is known, so any number may be piled up."""
    pile = sorted(pile)
    frames = [p[0] for p in pile]
    rows, expected = [], np.zeros(SHAPE, int)
    for frame, group in itertools.groupby(pile, key=lambda p: p[0]):
        here = np.zeros(SHAPE, bool)
        for _, i, j, k, wide, high, pitched in group:
            middle, size = np.array([i + wide / 2, j + 0.5, k + high / 2]), np.array([wide, 1, high])
            rows.append([*middle * VOXEL_M, 0.0, 1e-12 * pitched, *size * VOXEL_M])
            here[i : i + wide, j : j + 1, k : k + high] = True
        expected += here
        assert frame >= 0
    assert np.array_equal(count(frames, rows, total=4), expected)


def test_scratch_grows_with_boxes_in_a_column():
    shape = (4, 4, 300)
    order = np.random.default_rng(6).permutation(150)
    rows = [[0.5, 0.5, (2 * n + 0.5) * VOXEL_M, 0.0, 0.0, 0.5, 0.5, VOXEL_M] for n in order]
    counts = count([0] * len(rows), rows, grid_of(shape))
    assert np.array_equal(counts[1:3, 1:3].reshape(4, 300), np.tile([1, 0], (4, 150)))
    assert counts.sum() == 4 * 150


# --- recorded trajectories ---


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """Boxes of a short run of the shipped scenario, in the grid's frame, and its grid."""
    out = tmp_path_factory.mktemp("recorded")
    scenario = egvs.load(SCENARIO, ["traffic.frames=200"])
    run_stage(traffic, scenario, out)
    batches = list(read_boxes(out / "trajectories.parquet", scenario.roi.grid))
    return np.concatenate([b.frame for b in batches]), np.concatenate([b.values for b in batches]), scenario.roi.grid


NUDGES = [sign * 1e-9 * np.eye(8)[axis] for axis in range(3) for sign in (-1, 1)]


@pytest.mark.slow
@pytest.mark.system
def test_moving_recorded_boxes_by_a_nanometre_keeps_counts(recorded):
    frame, values, grid = recorded
    before = count(frame, values, grid, 200)
    assert before.sum() > 100_000
    for nudge in NUDGES:
        assert np.array_equal(count(frame, values + nudge, grid, 200), before)


def with_fault(*replacements):
    """The kernel's source with some text replaced, as plain Python: not compiled, so a fault costs no compilation."""
    source = Path(kernels_occupancy.__file__).read_text(encoding="utf-8")
    for old, new in replacements:
        assert old in source, f"the fault does not fit the source any more: {old}"
        source = source.replace(old, new)
    source = re.sub(r"^_kernel = njit\(.*\)$", "_kernel = lambda function: function", source, flags=re.MULTILINE)
    namespace = {"__name__": "faulty"}
    exec(compile(source, "faulty boxes", "exec"), namespace)
    return SimpleNamespace(**namespace)


def counted_by(kernels, frame, values, shape, voxel_m):
    nx, ny, nz = shape
    steps, seen = np.zeros((nz + 1, nx, ny), np.int32), np.full((3, nx, ny), -1, np.int64)
    kernels.count_boxes(frame, values, np.asarray(shape, np.int64), voxel_m, steps, seen)
    return np.cumsum(steps, axis=0)[:-1].transpose(1, 2, 0)


@pytest.mark.slow
@pytest.mark.system
def test_rule_without_margin_is_unstable_where_0_1_mm_rule_is_stable(recorded):
    frame, values, grid = recorded
    few = (frame < 3) & scoring_occupancy.near_grid(values, grid)
    frame, values = frame[few], values[few]
    for kernels, changes in ((with_fault(), False), (with_fault(("SHRINK_M = 1e-4 + 1e-9", "SHRINK_M = 0.0")), True)):
        before = counted_by(kernels, frame, values, grid.shape, grid.voxel_m)
        moved = [counted_by(kernels, frame, values + nudge, grid.shape, grid.voxel_m) for nudge in NUDGES]
        assert any(not np.array_equal(before, after) for after in moved) == changes


FAULTS = {
    "none": (),
    "not shrunk": (("SHRINK_M = 1e-4 + 1e-9", "SHRINK_M = 0.0"),),
    "shrunk by 1 mm": (("SHRINK_M = 1e-4 + 1e-9", "SHRINK_M = 1e-3"),),
    "wrong sign of yaw": (("box_axes(boxes[b, 3], pitch, axes)", "box_axes(-boxes[b, 3], pitch, axes)"),),
    "wrong sign of pitch": (("box_axes(boxes[b, 3], pitch, axes)", "box_axes(boxes[b, 3], -pitch, axes)"),),
    "whole sizes for half sizes": (("0.5 * boxes[b, 5 + a]", "boxes[b, 5 + a]"),),
    "length and width swapped": (("0.5 * boxes[b, 5 + a]", "0.5 * boxes[b, 5 + (1, 0, 2)[a]]"),),
    "cells rounded out by one": (("min(np.ceil(high / voxel_m)", "min(np.floor(high / voxel_m) + 2.0"),),
    "cells rounded in": (("max(np.floor(low / voxel_m)", "max(np.ceil(low / voxel_m)"),),
    "no cross products": (
        ("if _axis_separates(-z", "if False and _axis_separates(-z"),
        ("if _axis_separates(0.0, z", "if False and _axis_separates(0.0, z"),
    ),
    "counts twice": (("is_new = k < low or k >= high", "is_new = True"),),
    "forgets spare intervals": (("is_new = False", "pass"),),
    "a side forgotten": (
        ("for corner in range(4):\n                    end", "for corner in range(1, 4):\n                    end"),
    ),
}


@pytest.fixture(scope="module")
def hard_boxes():
    """A handful of vehicles, one frame each but for a pile of four, and their counts by brute force."""
    frame = np.array([0, 1, 2, 3, 4, 5, 6, 6, 6, 6])
    values = np.array([
        [1.0, 0.75 + 1e-5, 0.5, 0.0, 0.0, 1.0, 0.5, 0.5],
        [1.0 + 5e-4, 0.75, 0.5, 0.0, 0.0, 1.0, 0.5, 0.5],
        [1.0, 0.8, 0.5, 0.6, 0.0, 1.6, 0.5, 0.5],
        [1.0, 0.8, 0.6, 0.6, 0.3, 1.6, 0.3, 0.2],
        [1.0, 0.8, 0.63, 0.785, 0.785, 1.6, 0.02, 0.03],
        [0.9, 0.8, 0.63, 2.1, -0.5, 1.1, 0.4, 0.1],
        *stack((0, 1), (3, 4), (3, 5), (0, 2)),
    ])  # fmt: skip
    expected, ambiguous = oracle.tpog(frame, values, SHAPE, VOXEL_M, 7)
    assert ambiguous == 0
    return frame, values, np.array(expected)


@pytest.mark.parametrize("fault", list(FAULTS))
def test_detects_fault_in_box_test(fault, hard_boxes):
    frame, values, expected = hard_boxes
    with np.errstate(all="ignore"):
        counts = counted_by(with_fault(*FAULTS[fault]), frame, values, SHAPE, VOXEL_M)
    assert np.array_equal(counts, expected) == (fault == "none")


# --- the long hunt, in short ---


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "seed", "voxel_m"), [(hunt.hostile, 31, 0.25), (hunt.hostile, 32, 0.1), (hunt.vehicles, 33, 0.25)]
)
def test_random_search_finds_no_difference(make, seed, voxel_m):
    row = hunt.hunt("in short", make, seed, 400, SHAPE, voxel_m)
    assert (row.cases, row.mismatches) == (400, 0)


@pytest.mark.slow
def test_fast_depth_of_search_agrees_with_oracle():
    rng = np.random.default_rng(7)
    for box in hunt.hostile(rng, 15, SHAPE, VOXEL_M):
        for cell, exact in itertools.islice(oracle.depths(box, SHAPE, VOXEL_M).items(), 40):
            assert abs(hunt.depth_in(box, np.array(cell) * VOXEL_M, VOXEL_M) - float(exact)) < 1e-11
