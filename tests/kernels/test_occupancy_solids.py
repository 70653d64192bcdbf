"""Which voxels does static geometry fill, and is a point inside a solid?

Evidence: triangles clipped to shrunk cubes in rationals; solids whose filled voxels are known; solid angles for winding
numbers; points exactly and nearly above edges and vertices."""

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from egvs.core.grid import Grid
from egvs.kernels import occupancy as kernels_occupancy
from egvs.scoring import occupancy as scoring_occupancy
from egvs.world.mesh import World
from tests.oracles import boxes as oracle

SHAPE, VOXEL_M = (6, 6, 6), 0.25
GRID = Grid((0.0, 0.0, 0.0), VOXEL_M, SHAPE)
SHRINK_M = Fraction(1, 10**4)

often = settings(derandomize=True, deadline=None, max_examples=200, database=None)


# --- triangles --------------------------------------------------------------------------------------------------------


def clipped(corners, low, high):
    """A convex polygon cut to the closed box [low, high], in rationals (Sutherland and Hodgman 1974)."""
    polygon = [[Fraction(x) for x in corner] for corner in corners]
    for axis in range(3):
        for bound, side in ((low[axis], 1), (high[axis], -1)):
            kept = []
            for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
                p_in, q_in = side * (p[axis] - bound) >= 0, side * (q[axis] - bound) >= 0
                if p_in:
                    kept.append(p)
                if p_in != q_in:
                    share = (bound - p[axis]) / (q[axis] - p[axis])
                    kept.append([a + share * (b - a) for a, b in zip(p, q, strict=True)])
            polygon = kept
    return polygon


def reaches(triangle, cell, voxel_m, margin_m=Fraction(1, 10**9)):
    """Whether a triangle reaches deeper than 0.1 mm into a voxel; None where a margin more or less turns the answer."""
    answers = []
    for inset in (SHRINK_M - margin_m, SHRINK_M + margin_m):
        low = [i * Fraction(voxel_m) + inset for i in cell]
        high = [(i + 1) * Fraction(voxel_m) - inset for i in cell]
        answers.append(bool(clipped(triangle, low, high)))
    return answers[0] if answers[0] == answers[1] else None


def touched(triangle, shape=SHAPE, voxel_m=VOXEL_M):
    filled = np.zeros(shape, bool)
    kernels_occupancy.mark_triangle_voxels(np.array([triangle], float), np.asarray(shape, np.int64), voxel_m, filled)
    return filled


def check_triangle(triangle, shape=(3, 3, 3), voxel_m=VOXEL_M):
    filled, unsure = touched(triangle, shape, voxel_m), 0
    for cell in itertools.product(*map(range, shape)):
        exact = reaches(triangle, cell, voxel_m)
        unsure += exact is None
        assert exact is None or filled[cell] == exact, (triangle, cell)
    return unsure


where = st.one_of(
    st.integers(-2, 8).map(lambda n: n / 8),
    st.builds(
        lambda n, e: n / 8 + e, st.integers(-2, 8), st.sampled_from([1e-4, -1e-4, 1.1e-4, -0.9e-4, 1e-9, -1e-9, 1e-5])
    ),
    st.floats(-0.5, 1.25),
)
corner = st.tuples(where, where, where)


@pytest.mark.slow
@often
@given(corner, corner, corner)
def test_random_triangle_agrees_with_rational_clipping(a, b, c):
    event(f"within 1e-9 m of the bound: {check_triangle((a, b, c)) > 0}")


@pytest.mark.slow
@often
@given(corner, corner, st.floats(0, 1), st.sampled_from([0.0, 1e-3, 1e-5, 1e-7]), st.tuples(*[st.floats(-1, 1)] * 3))
def test_slivers_and_degenerate_triangles(a, b, share, width, offset):
    c = tuple(x + share * (y - x) + width * w for x, y, w in zip(a, b, offset, strict=True))
    check_triangle((a, b, c))


@pytest.mark.slow
@often
@given(corner, st.sampled_from([1e-2, 1e-3, 1e-4, 1e-6]), st.tuples(corner, corner))
def test_tiny_triangles(a, size, others):
    b, c = (tuple(x + size * y for x, y in zip(a, other, strict=True)) for other in others)
    check_triangle((a, b, c))


@pytest.mark.parametrize("size", [1e-5, 1e-7])
def test_tiny_triangles_at_a_corner(size):
    """Only the triangle's own plane parts it from the cube there, and its normal is as short as its area."""
    rng = np.random.default_rng(7)
    for _ in range(60):
        outwards = -np.abs(rng.normal(size=3))
        outwards /= np.linalg.norm(outwards)
        along = np.cross(outwards, rng.normal(size=3))
        along /= np.linalg.norm(along)
        across, turn = np.cross(outwards, along), rng.uniform(0, 6)
        middle = 0.25 + 1e-4 + outwards * rng.uniform(-1, 1) * size / 10
        check_triangle(
            [middle + size * (math.cos(turn + k) * along + math.sin(turn + k) * across) for k in (0.0, 2.1, 4.2)],
            (2, 2, 2),
        )


@pytest.mark.slow
def test_long_triangles():
    rng = np.random.default_rng(1)
    for _ in range(60):
        inner = rng.uniform(0, 0.75, (1, 3))
        check_triangle(np.concatenate([inner, rng.uniform(-200, 200, (2, 3))]))


@pytest.mark.slow
@pytest.mark.parametrize("voxel_m", [0.1, 0.3])
def test_other_voxel_sizes(voxel_m):
    rng = np.random.default_rng(2)
    for _ in range(30):
        check_triangle(rng.integers(-1, 8, (3, 3)) * voxel_m / 2, voxel_m=voxel_m)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(
    ("height", "layers"),
    [
        (0.0, []),
        (0.5, []),
        (0.5 + 9e-5, []),
        (0.5 - 9e-5, []),
        (0.5 + 1.1e-4, [2]),
        (0.5 - 1.1e-4, [1]),
        (0.6, [2]),
        (1.5, []),
    ],
)
def test_plane_near_voxel_faces(axis, height, layers):
    far = np.array([[-9.0, -9.0], [20.0, -9.0], [-9.0, 20.0]])
    triangle = np.insert(far, axis, height, axis=1)
    expected = np.zeros(SHAPE, bool)
    expected[(slice(None),) * axis + (layers,)] = True
    assert np.array_equal(touched(triangle), expected)


# --- solids -----------------------------------------------------------------------------------------------------------

QUADS = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]  # faces of a box, outwards


def box(low, high, yaw=0.0, pitch=0.0, inward=False, flip=False):
    """Corners and triangles of a box between two corners, turned about its centre; ``flip`` uses the other
    diagonals."""
    corners = np.array(list(itertools.product(*zip(low, high, strict=True))), float)  # index 4 x + 2 y + z
    middle = corners.mean(axis=0)
    axes = np.array(oracle.axes_of(math.sin(yaw), math.cos(yaw), math.sin(pitch), math.cos(pitch)))
    faces = []
    for q in QUADS:
        a, b, c, d = q[1:] + q[:1] if flip else q
        faces += [(a, b, c), (a, c, d)]
    faces = np.array(faces)
    turned = corners if yaw == pitch == 0 else middle + (corners - middle) @ axes
    return turned, faces[:, ::-1] if inward else faces


def prism(centre, radius, low, high, sides):
    """An upright prism of many sides."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.column_stack([centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle)])
    corners = [*[(*p, low) for p in ring], *[(*p, high) for p in ring], (*centre, low), (*centre, high)]
    faces = []
    for i in range(sides):
        j = (i + 1) % sides
        faces += [
            (i, j, sides + j),
            (i, sides + j, sides + i),
            (2 * sides, j, i),
            (2 * sides + 1, sides + i, sides + j),
        ]
    return np.array(corners), np.array(faces)


def sphere(centre, radius, rings=24, sides=48):
    """A sphere of triangles, its poles along z."""
    corners = [(0.0, 0.0, -1.0), (0.0, 0.0, 1.0)]
    for r in range(1, rings):
        z, w = -math.cos(math.pi * r / rings), math.sin(math.pi * r / rings)
        corners += [
            (w * math.cos(2 * math.pi * s / sides), w * math.sin(2 * math.pi * s / sides), z) for s in range(sides)
        ]

    def at(r, s):
        return 2 + (r - 1) * sides + s % sides

    faces = []
    for s in range(sides):
        faces += [(0, at(1, s + 1), at(1, s)), (1, at(rings - 1, s), at(rings - 1, s + 1))]
        for r in range(1, rings - 1):
            faces += [(at(r, s), at(r, s + 1), at(r + 1, s + 1)), (at(r, s), at(r + 1, s + 1), at(r + 1, s))]
    return np.asarray(centre) + radius * np.array(corners), np.array(faces)


def world_of(*parts):
    """A world of solids, each (corners, faces) or a list of such (one solid of several shells)."""
    vertices, faces, owner, n = [], [], [], 0
    for solid, shells in enumerate(parts):
        for corners, triangles in shells if isinstance(shells, list) else [shells]:
            vertices.append(corners)
            faces.append(triangles + n)
            owner += [solid] * len(triangles)
            n += len(corners)
    names = tuple((f"solid {i}", "building") for i in range(len(parts)))
    return World(np.concatenate(vertices), np.concatenate(faces).astype(np.int32), np.array(owner, np.int32), names)


def filled_by(*parts, grid=GRID):
    return scoring_occupancy.static_voxels(world_of(*parts), grid)


def cells(*ranges):
    """A bool array that is True in the product of the index ranges."""
    found = np.zeros(SHAPE, bool)
    found[np.ix_(*[list(r) for r in ranges])] = True
    return found


@pytest.mark.parametrize("inward", [False, True], ids=["outward", "inward"])
@pytest.mark.parametrize("flip", [False, True])
def test_box_on_voxel_faces_fills_only_its_voxels(inward, flip):
    found = filled_by(box((0.25, 0.5, 0.25), (1.25, 1.0, 1.0), inward=inward, flip=flip))
    assert np.array_equal(found, cells(range(1, 5), range(2, 4), range(1, 4)))


@pytest.mark.parametrize("inward", [False, True], ids=["outward", "inward"])
def test_box_between_voxel_centres(inward):
    """Its sides run through voxel centres: edges, corners and the diagonals of its roof lie exactly above them."""
    for low, high in (((0.125, 0.125, 0.125), (1.375, 1.375, 1.375)), ((0.375, 0.125, 0.625), (0.875, 1.125, 1.125))):
        expected = cells(*(range(int(a // VOXEL_M), int(b // VOXEL_M) + 1) for a, b in zip(low, high, strict=True)))
        assert np.array_equal(filled_by(box(low, high, inward=inward)), expected)


@pytest.mark.slow
@settings(often, max_examples=60)
@given(
    st.floats(-4, 4),
    st.sampled_from([0.0, 0.2, -0.5]),
    st.tuples(*[st.floats(0.1, 1.3)] * 3),
    st.tuples(*[st.floats(0.05, 1.4)] * 3),
    st.booleans(),
)
def test_rotated_box_agrees_with_separating_axes(yaw, pitch, centre, size, inward):
    """A box fills the voxels that, made 0.1 mm smaller, it still overlaps."""
    low, high = np.subtract(centre, np.divide(size, 2)), np.add(centre, np.divide(size, 2))
    found = filled_by(box(low, high, yaw, pitch, inward))
    middle, axes, half = oracle.exact_box((*((low + high) / 2), yaw, pitch, *(high - low)))
    with oracle.mpmath.workdps(oracle.DIGITS):
        inset = oracle.mpmath.mpf(1) / 10**4
        normals = oracle.parting(axes, half, VOXEL_M - 2 * inset)
        for cell in itertools.product(*map(range, SHAPE)):
            deep = oracle.depth_at([(i + 0.5) * VOXEL_M - c for i, c in zip(cell, middle, strict=True)], half, normals)
            assert abs(deep) < 1e-9 or found[cell] == (deep > 0), cell


def distances(centre, axes):
    """Least and largest distance of each voxel, made 0.1 mm smaller, from a point (or from a line: fewer axes)."""
    near2, far2 = np.zeros(SHAPE), np.zeros(SHAPE)
    for axis in axes:
        middle = (np.arange(SHAPE[axis]) + 0.5) * VOXEL_M - centre[axis]
        half = VOXEL_M / 2 - 1e-4
        near, far = np.maximum(np.abs(middle) - half, 0), np.abs(middle) + half
        form = [1, 1, 1]
        form[axis] = -1
        near2, far2 = near2 + (near**2).reshape(form), far2 + (far**2).reshape(form)
    return np.sqrt(near2), np.sqrt(far2)


@pytest.mark.parametrize("centre", [(0.75, 0.75, 0.75), (0.625, 0.625, 0.625), (0.7, 0.66, 0.81)])
def test_sphere(centre):
    radius, rings, sides = 0.55, 24, 48
    found = filled_by(sphere(centre, radius, rings, sides))
    near, _ = distances(centre, (0, 1, 2))
    inner = radius * math.cos(math.pi / rings) * math.cos(math.pi / sides)  # of the sphere inside all triangles
    assert found[near < inner - 1e-6].all()
    assert not found[near > radius + 1e-6].any()
    assert found.sum() > 50


@pytest.mark.parametrize("centre", [(0.75, 0.75), (0.625, 0.625), (0.7, 0.66)])
def test_cylinder(centre):
    radius, sides = 0.55, 64
    found = filled_by(prism(centre, radius, 0.25, 1.0, sides))
    near, _ = distances((*centre, 0.0), (0, 1))
    layers = np.zeros(SHAPE, bool)
    layers[:, :, 1:4] = True
    near = np.broadcast_to(near, SHAPE)
    assert found[(near < radius * math.cos(math.pi / sides) - 1e-6) & layers].all()
    assert not found[(near > radius + 1e-6) | ~layers].any()


def test_nested_overlapping_and_hollow_solids():
    outer, inner = ((0.25, 0.25, 0.25), (1.25, 1.25, 1.25)), ((0.5, 0.5, 0.5), (1.0, 1.0, 1.0))
    whole = cells(range(1, 5), range(1, 5), range(1, 5))
    for inner_inward, outer_inward in itertools.product((False, True), repeat=2):
        parts = box(*outer, inward=outer_inward), box(*inner, inward=inner_inward)
        assert np.array_equal(filled_by(*parts), whole), "two solids: each is a solid whichever way it faces"
        assert np.array_equal(filled_by(*parts[::-1]), whole)
    hollow = [box(*outer), box(*inner, inward=True)]
    expected = whole & ~cells(range(2, 4), range(2, 4), range(2, 4))
    assert np.array_equal(filled_by(hollow), expected), "one solid of two shells has a hollow"
    assert np.array_equal(filled_by([(c, f[:, ::-1]) for c, f in hollow]), expected)
    apart = box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), box((0.5, 0.5, 0.5), (1.5, 1.5, 1.5))
    assert np.array_equal(
        filled_by(*apart), cells(range(4), range(4), range(4)) | cells(range(2, 6), range(2, 6), range(2, 6))
    )


def test_solid_around_region_and_solid_outside_it():
    assert filled_by(box((-5, -5, -5), (9, 9, 9), yaw=0.3)).all()
    assert not filled_by(box((1.5, 0, 0), (3, 3, 3))).any()
    assert not filled_by(box((0, 0, 1.5), (1.5, 1.5, 3))).any(), "a roof above the region fills nothing of it"
    assert not filled_by(box((0, 0, -3), (1.5, 1.5, 0))).any()


@pytest.mark.parametrize("z", [0.0, -0.0, 0.9e-4, -1.0])
def test_ground_plane_fills_nothing(z):
    ground = (
        np.array([[-500, -500, z], [500, -500, z], [500, 500, z], [-500, 500, z]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
    )
    assert not filled_by(ground).any()


def test_same_voxels_400_km_from_origin():
    shift = (393216.0, 3932160.0, 64.0)
    parts = box((0.3, 0.25, 0.0), (1.1, 1.25, 1.0), yaw=0.4), prism((0.625, 0.625), 0.4, 0.0, 1.25, 12)
    parts = [(np.round(corners * 2**12) / 2**12, faces) for corners, faces in parts]
    there = [(corners + shift, faces) for corners, faces in parts]
    assert np.array_equal(filled_by(*parts), filled_by(*there, grid=Grid(shift, VOXEL_M, SHAPE)))


# --- winding numbers of points ----------------------------------------------------------------------------------------


def winding(point, corners, faces):
    totals = np.zeros(1, np.int64)
    n = len(faces)
    kernels_occupancy.point_winding_numbers(
        np.asarray(point, float), corners[faces], np.zeros(n, np.int64), np.ones(1, np.int64).repeat(n), totals
    )
    return int(totals[0])


def solid_angles(points, corners, faces):
    """Winding numbers (n,) of points (n, 3) as sums of solid angles (van Oosterom and Strackee 1983)."""
    a, b, c = (corners[faces[:, i]] - np.asarray(points)[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
    volume = np.einsum("nij,nij->ni", a, np.cross(b, c))
    below = la * lb * lc + (a * b).sum(2) * lc + (b * c).sum(2) * la + (c * a).sum(2) * lb
    return 2 * np.arctan2(volume, below).sum(axis=1) / (4 * np.pi)


def expected_inside(point, corners, faces):
    """The winding number by solid angles where it is the same all round the point, None near the surface."""
    beside = np.asarray(point) + 2e-4 * np.array(list(itertools.product((-1, 0, 1), repeat=3)))
    found = solid_angles(beside, corners, faces)
    return round(found[0]) if np.abs(found - round(found[0])).max() < 1e-6 else None


SHAPES = {
    "box": box((0.25, 0.25, 0.25), (1.25, 1.0, 1.0)),
    "box, inward": box((0.25, 0.25, 0.25), (1.25, 1.0, 1.0), inward=True),
    "rotated box": box((0.25, 0.25, 0.25), (1.25, 1.0, 1.0), yaw=0.7, pitch=0.4),
    "prism": prism((0.625, 0.625), 0.5, 0.25, 1.0, 7),
    "sphere": sphere((0.75, 0.75, 0.75), 0.5, 6, 8),
}


@pytest.mark.parametrize("name", list(SHAPES))
def test_points_agree_with_solid_angles(name):
    corners, faces = SHAPES[name]
    rng = np.random.default_rng(3)
    points = np.concatenate([rng.uniform(0, 1.5, (300, 3)), rng.integers(0, 13, (200, 3)) / 8])
    tried = 0
    for point in points:
        exact = expected_inside(point, corners, faces)
        if exact is None:
            continue
        tried += 1
        assert winding(point, corners, faces) == exact, point
    assert tried > 250


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SHAPES))
def test_points_exactly_and_nearly_above_edges_and_vertices(name):
    """Below, above and inside, on the vertical through every corner and through points of every edge, and a few ulps
    beside."""
    corners, faces = SHAPES[name]
    rng = np.random.default_rng(4)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    on = [corners[i, :2] for i in range(len(corners))]
    on += [(1 - s) * corners[i, :2] + s * corners[j, :2] for i, j in edges for s in (0.5, rng.random())]
    low, high = corners[:, 2].min(), corners[:, 2].max()
    for at in on:
        for _ in range(3):
            xy = [x + n * math.ulp(x) for x, n in zip(at, rng.integers(-3, 4, 2), strict=True)]
            assert winding((*xy, low - 0.1), corners, faces) == 0
            assert winding((*xy, high + 0.1), corners, faces) == 0
            for z in rng.uniform(low, high, 2):
                exact = expected_inside((*xy, z), corners, faces)
                assert exact is None or winding((*xy, z), corners, faces) == exact, (*xy, z)


def test_fan_around_a_point_counts_once():
    """Triangles round a common vertex: a vertical that passes within a few ulps of it crosses exactly one of them."""
    rng = np.random.default_rng(5)
    for _ in range(150):
        n = rng.integers(3, 9)
        angle = np.sort((np.arange(n) + rng.uniform(-0.2, 0.2, n)) * 2 * np.pi / n)
        middle = np.array([*rng.choice([0.125, 0.3, 1.7, 5.3, 12.1, 393216.7], 2), 1.0])
        ring = middle + np.column_stack(
            [*(rng.uniform(0.5, 30, n) * np.array([np.cos(angle), np.sin(angle)])), np.zeros(n)]
        )
        for _ in range(20):
            x, y = (c + k * math.ulp(c) for c, k in zip(middle[:2], rng.integers(-3, 4, 2), strict=True))
            signs = [
                kernels_occupancy.vertical_crossing(np.array([middle, ring[i], ring[(i + 1) % n]]), x, y)[0]
                for i in range(n)
            ]
            assert sorted(map(abs, signs)) == [0] * (n - 1) + [1]


def test_steep_wall_is_crossed_between_its_ends():
    """However steep a triangle is: the crossing lies between its lowest and its highest corner."""
    rng = np.random.default_rng(6)
    crossed = 0
    for _ in range(2000):
        a = rng.uniform(0, 1, 3)
        wall = a + np.array([[0.0, 0.0, 0.0], [1.0, 0.3, 0.0], [0.5, 0.15 + 10 ** rng.uniform(-6, -3), 5.0]])
        at = a[:2] + rng.uniform(0, 1) * np.array([1.0, 0.3]) + [0.0, 10 ** rng.uniform(-7, -4)]
        sign, z = kernels_occupancy.vertical_crossing(wall, *at)
        crossed += sign != 0
        assert sign == 0 or a[2] <= z <= a[2] + 5.0
    assert crossed > 100
