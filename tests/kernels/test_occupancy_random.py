"""Which voxels do random boxes, triangles and solids fill?

Evidence: slow twins that try every voxel, in float64: separating axes, solid angles; triangles clipped in rationals."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from egvs.kernels import occupancy
from tests.kernels.test_occupancy_solids import box, prism, reaches, solid_angles, sphere, touched, winding
from tests.oracles import boxes as oracle

GRIDS = [((8, 7, 5), 0.25), *[(shape, 0.25) for shape in itertools.permutations((9, 4, 2))], ((8, 7, 5), 2.0)]
"""Shape, and edge length of a voxel."""


def random_boxes(shape, voxel_m, n, seed):
    """Boxes in and beside the grid, half of them pitched, from slabs to cubes."""
    rng = np.random.default_rng(seed)
    middles = rng.uniform(-0.3, 1.3, (n, 3)) * np.array(shape) * voxel_m
    angles = np.column_stack([rng.uniform(-4, 4, n), rng.uniform(-1.6, 1.6, n) * rng.integers(0, 2, n)])
    angles[::15, 1], angles[7::15, 1] = 1.0, -1.0
    return np.column_stack([middles, angles, 10 ** rng.uniform(-2, 0.3, (n, 3)) * 4 * voxel_m])


def float_axes(yaw_rad, pitch_rad):
    return np.array(oracle.axes_of(math.sin(yaw_rad), math.cos(yaw_rad), math.sin(pitch_rad), math.cos(pitch_rad)))


def is_occupied(values, shape, voxel_m):
    """For each voxel of a grid, by all fifteen axes: whether the box reaches deeper into it than 0.1 mm."""
    low = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) * voxel_m
    gap, half = low + voxel_m / 2 - values[:3], values[5:] / 2
    normals = oracle.parting(float_axes(*values[3:5]), half, voxel_m)
    depth = np.min([(reach - abs(gap @ np.array(n))) / shrinks for n, reach, shrinks in normals], axis=0)
    depth = np.minimum(depth, half.min())
    assert abs(depth - 1e-4).min() > 2e-9
    return depth > 1e-4


@pytest.mark.parametrize(("shape", "voxel_m"), GRIDS)
def test_random_boxes_fill_the_voxels_that_they_reach_into(shape, voxel_m):
    """Each alone in its frame; the state of the counts is handed from call to call."""
    nx, ny, nz = shape
    steps, latest = np.zeros((nz + 1, nx, ny), np.int32), np.full((3, nx, ny), -1, np.int64)
    boxes, before = random_boxes(shape, voxel_m, 90, seed=3), np.zeros((nz, nx, ny), np.int64)
    for frame, values in enumerate(boxes):
        occupancy.count_boxes(np.array([frame]), values[None], np.array(shape), voxel_m, steps, latest)
        counts = np.cumsum(steps, axis=0)
        assert not counts[-1].any()
        assert np.array_equal((counts[:-1] - before).transpose(1, 2, 0), is_occupied(values, shape, voxel_m)), values
        before = counts[:-1]
    occupancy.sum_layers(steps)
    assert np.array_equal(steps[:-1], before)


@pytest.mark.parametrize(("shape", "voxel_m"), GRIDS)
def test_overlapping_boxes_of_a_frame_count_once(shape, voxel_m):
    nx, ny, nz = shape
    steps, latest = np.zeros((nz + 1, nx, ny), np.int32), np.full((3, nx, ny), -1, np.int64)
    boxes, frames = random_boxes(shape, voxel_m, 48, seed=4), np.repeat([0, 1, 5, 6], [20, 4, 12, 12])
    expected = np.zeros(shape, np.int64)
    for frame in set(frames):
        expected += np.any([is_occupied(values, shape, voxel_m) for values in boxes[frames == frame]], axis=0)
    for part in (frames < 5, frames >= 5):
        occupancy.count_boxes(frames[part], boxes[part], np.array(shape), voxel_m, steps, latest)
    assert expected.max() >= 3
    assert np.array_equal(np.cumsum(steps, axis=0)[:-1].transpose(1, 2, 0), expected)


def count_layers(frames, layers, n_layers, n_columns=64):
    """Counts of frames, (columns, layers), of boxes of one voxel by so many columns, from a layer up to another."""
    boxes = [[0.5, n_columns / 2, (a + b) / 2, 0.0, 0.0, 1.0, n_columns, b - a] for a, b in layers]
    steps, latest = np.zeros((n_layers + 1, 1, n_columns), np.int32), np.full((3, 1, n_columns), -1, np.int64)
    occupancy.count_boxes(np.array(frames), np.array(boxes), np.array([1, n_columns, n_layers]), 1.0, steps, latest)
    occupancy.sum_layers(steps)
    return steps[:-1, 0].T


def test_boxes_above_one_another_count_once_in_each_frame():
    """Two intervals a column, whose 64 columns just fit into the scratch memory; three frames alike; a frame apart."""
    assert count_layers([0, 0], [(0, 1), (2, 3)], 4).tolist() == [[1, 0, 1, 0]] * 64
    assert count_layers([0, 0, 1, 1, 7, 7], [(0, 1), (2, 3)] * 3, 4).tolist() == [[3, 0, 3, 0]] * 64
    assert count_layers([3, 3, 4], [(0, 1), (2, 3), (2, 4)], 4).tolist() == [[1, 0, 2, 1]] * 64


def test_grown_scratch_memory_keeps_its_intervals():
    """A box through all layers adds only what none of 100 boxes in every second layer has occupied."""
    apart = [(2 * n, 2 * n + 1) for n in np.random.default_rng(9).permutation(100).tolist()]
    counts = count_layers([0] * 101, [*apart, (0, 200)], 200, n_columns=3)
    assert counts.tolist() == [[1] * 200] * 3


def test_weights_are_added_to_the_hits_of_cells():
    hits = np.array([10, 20, 30, 40])
    occupancy.accumulate(np.array([3, 0, 3]), np.array([1, 2, 5]), hits)
    assert hits.tolist() == [12, 20, 30, 46]


def test_random_pairs_of_box_and_voxel():
    """Boxes whose depth in a voxel is set to a few micrometres more or less than the bound."""
    rng, n_overlapping = np.random.default_rng(5), 0
    for values in random_boxes((1, 1, 1), 0.25, 1200, seed=6):
        middle, axes, low = values[:3], float_axes(*values[3:5]), rng.uniform(-0.2, 0.2, 3)
        depth = oracle.depth(middle, axes, values[5:] / 2, low, 0.25)
        beyond_m = rng.choice([-1.0, 1.0]) * 10 ** rng.uniform(-8, -2)
        half = values[5:] / 2 - depth + beyond_m  # what is left of it after 0.1 mm from each side
        if half.min() > 1e-3:
            n_overlapping += beyond_m > 0
            assert occupancy.overlaps(middle, axes, half, low, 0.25) == (beyond_m > 0)
    assert n_overlapping > 50


@pytest.mark.parametrize(
    ("shape", "voxel_m"), [((3, 3, 3), 0.25), ((4, 1, 2), 0.25), ((2, 4, 1), 0.25), ((1, 2, 4), 0.25), ((3, 2, 2), 2.0)]
)
def test_random_triangles_agree_with_rational_clipping(shape, voxel_m):
    """Large ones, small ones and slivers, some of whose corners lie on planes between voxels."""
    rng = np.random.default_rng(7)
    for _ in range(40):
        triangle = rng.uniform(-0.5, 1.5, (1, 3)) * np.array(shape) * voxel_m
        triangle = triangle + rng.normal(size=(3, 3)) * 10 ** rng.uniform(-3, 0) * 4 * voxel_m
        if rng.random() < 0.3:
            triangle[2] = triangle[0] + rng.random() * (triangle[1] - triangle[0]) + rng.normal(size=3) * 1e-5
        if rng.random() < 0.3:
            triangle = np.where(rng.random((3, 3)) < 0.5, np.rint(triangle * 8) / 8, triangle)
        filled = touched(triangle, shape, voxel_m)
        for cell in itertools.product(*map(range, shape)):
            exact, centre = reaches(triangle, cell, voxel_m), (np.array(cell) + 0.5) * voxel_m
            if exact is not None:
                assert filled[cell] == exact
                assert occupancy.triangle_intersects_cube(triangle, centre, voxel_m / 2 - 1e-4) == exact


def random_solids(shape, voxel_m, seed):
    """Turned boxes, prisms and spheres, as corners and faces: in the grid, beside it and around it."""
    rng = np.random.default_rng(seed)
    for kind in range(12):
        middle, size = rng.uniform(-0.1, 1.1, (2, 3)) * np.array(shape) * voxel_m
        radius = abs(size[0]) + 0.4 * voxel_m
        yield (
            box(middle - size, middle + abs(size) + 0.01, rng.uniform(-3, 3), rng.uniform(-1, 1)),
            prism(middle[:2], radius, middle[2] - 1.6 * voxel_m, middle[2] + 2.8 * voxel_m, 5 + kind),
            sphere(middle, radius, 4, 5 + kind),
        )[kind % 3]


@pytest.mark.parametrize(("shape", "voxel_m"), GRIDS)
def test_winding_numbers_agree_with_solid_angles(shape, voxel_m):
    """Of voxel centres and of points; the triangles of some solids face inwards, and have the sign -1."""
    centres = (np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) * voxel_m
    turns = np.zeros((*shape[:2], shape[2] + 1), np.int32)
    expected, point_winding = np.zeros(len(centres)), np.full((len(centres), 12), 7)
    for number, (corners, faces) in enumerate(random_solids(shape, voxel_m, seed=8)):
        sign = (-1) ** number
        signs, solids, triangles = np.full(len(faces), sign), np.full(len(faces), number), corners[faces]
        occupancy.add_winding_numbers(triangles, signs, np.array(shape), voxel_m, turns)
        expected_here = sign * solid_angles(centres, corners, faces)
        expected += expected_here
        for point, totals, expected_turns in zip(centres[::5], point_winding, expected_here[::5], strict=False):
            occupancy.point_winding_numbers(point, triangles, solids, signs, totals)
            assert totals[number] == pytest.approx(7 + expected_turns, abs=1e-6)
    assert abs(expected).max() > 0.9
    assert np.cumsum(turns, axis=2)[:, :, :-1].reshape(-1) == pytest.approx(expected, abs=1e-6)
    assert not np.cumsum(turns, axis=2)[:, :, -1].any()


def test_point_on_the_floor_is_inside_and_on_the_roof_outside():
    corners, faces = box((0.0, 0.0, 1.0), (4.0, 3.0, 2.0))
    turns = [winding((1.1, 1.7, z), corners, faces) for z in (0.9, 1.0, 1.9, 2.0, 2.1)]
    assert [abs(n) for n in turns] == [0, 1, 1, 0, 0]


@pytest.mark.slow
def test_smallest_triangles_of_the_lattice():
    """Twice the areas of the three parts around the point (0, 1) are 1, the smallest area that counts."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [-1, 3, 0]]) * occupancy.SNAP_M + [0.0, 0.0, 6.0]
    corners[2, 2] = 9.0
    assert occupancy.vertical_crossing(corners, 0.0, occupancy.SNAP_M) == (1, 7.0)
    assert occupancy.vertical_crossing(corners[::-1], 0.0, occupancy.SNAP_M) == (-1, 7.0)
    assert occupancy.vertical_crossing(corners, 0.0, 3 * occupancy.SNAP_M) == (0, 0.0)
    assert occupancy.vertical_crossing(corners * 1e-3, 0.0, 0.0) == (0, 0.0)


def test_sides_are_decided_from_61_micrometres_on():
    """The lattice moves a point and a side by half of that each."""
    for at in np.random.default_rng(10).uniform(0.0, 5.0, 200):
        corners = np.array([[at, -1.0, 2.0], [at + 4.0, -1.0, 2.0], [at, 7.0, 2.0]])
        assert [occupancy.vertical_crossing(corners, at + x, 0.3)[0] for x in (-6.2e-5, 6.2e-5)] == [0, 1]


def test_solids_of_100_km_fit_into_64_bits():
    corners = np.array([[0.0, 0.0, 5.0], [1e5, 0.0, 5.0], [0.0, 1e5, 5.0]])
    assert occupancy.vertical_crossing(corners, 3e4, 4e4) == (1, pytest.approx(5.0))
    assert occupancy.vertical_crossing(corners, 6e4, 5e4) == (0, 0.0)


@pytest.mark.parametrize("pitch", [0.0, 1e-12])
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("move_m", [-1e-4, 1e-4])
def test_side_on_the_bound_is_no_contact(axis, move_m, pitch):
    """0.1 mm behind a plane to the last digit, whichever binary numbers those decimals are."""
    for cell in range(1, 5):
        steps, latest = np.zeros((8, 7, 7), np.int32), np.full((3, 7, 7), -1, np.int64)
        values = np.array([[0.3, 0.3, 0.3, 0.0, pitch, 0.2, 0.2, 0.2]])
        values[0, axis] = (2 * cell + 2) / 20 + move_m
        occupancy.count_boxes(np.array([0]), values, np.full(3, 7), 0.1, steps, latest)
        expected = np.zeros((7, 7, 7), bool)
        inside = [slice(2, 4)] * 3
        inside[axis] = slice(cell, cell + 2)
        expected[tuple(inside)] = True
        assert np.array_equal(np.cumsum(steps, axis=0)[:-1].transpose(1, 2, 0), expected)
