"""Every beam ends on the surface that it hits first, to a nanometre, and no beam leaks."""

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st

from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.kernels import ray_triangle
from egvs.scenario import loading
from egvs.sensors.scanner import Scanner
from egvs.sensors.sensor import CATALOGUE
from egvs.stages.inputs import build_scene
from egvs.world.mesh import World
from egvs.world.ray_casting import Caster, _split_large, touches_sensor, with_planes
from tests.oracles import cast

ROI = Roi((0.0, 0.0, 0.0), (100.0, 100.0, 10.0))


def world_of(triangles):
    vertices = np.asarray(triangles, dtype=np.float64).reshape(-1, 3)
    faces = np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)
    return World(vertices, faces, np.zeros(len(faces), dtype=np.int32), (("scene", "test"),))


def caster(triangles, roi=ROI):
    return Caster(world_of(triangles), roi)


def towards(o, points):
    d = np.asarray(points, dtype=np.float64) - o
    return d / np.linalg.norm(d, axis=1)[:, None]


def random_directions(rng, n):
    return towards(np.zeros(3), rng.normal(size=(n, 3)))


def cast_both(triangles, o, d):
    """Ranges of the pipeline and of the brute force."""
    o = np.asarray(o, dtype=np.float64)
    return caster(triangles).first_hits(o, d)[0], cast.first_hits(o, d, triangles)[0]


def quad(a, b, c, d):
    return np.array([[a, b, c], [a, c, d]], dtype=np.float64)


def turned(degrees):
    return trimesh.transformations.rotation_matrix(np.radians(degrees), [0, 0, 1])[:3, :3]


def box_ranges(o, d, low, high):
    """How far a ray from inside a box goes: the nearest of the planes ahead."""
    with np.errstate(divide="ignore"):
        return np.where(d > 0, (high - o) / d, np.where(d < 0, (low - o) / d, np.inf)).min(axis=1)


@pytest.mark.parametrize(
    ("end", "range_m", "ambiguous"),
    [
        ((40.0, 0.0), 100.0, False),  # sine 0.0125
        ((49.0, 0.0), 100.0, False),  # sine 0.011
        ((51.0, 0.0), 100.0, True),  # sine 0.0098
        ((51.0, 0.0), 40.0, False),  # as shallow, but so far away that the beam has ended
        ((1.0, 39.99999), 100.0, True),  # 1e-5 m from an edge
        ((1.0, 39.9999), 100.0, False),
    ],
)
def test_hits_near_edges_and_at_shallow_angles_are_ambiguous(end, range_m, ambiguous):
    """A large triangle on the ground, a sensor 0.5 m above it at x = 0; what a float32 caster proposed is always
    triangle 0."""
    triangles, planes, _ = with_planes(np.array([[[-500.0, 40.0, 0.0], [0.0, -900.0, 0.0], [500.0, 40.0, 0.0]]]))
    o = np.array([0.0, 0.0, 0.5])
    d = towards(o, [[*end, 0.0]])
    ranges, result = np.empty(1), np.empty(1, np.int64)
    nearest, owner = np.zeros(1, np.int32), np.array([0, -1], np.int32)
    beam, hit, ends, returned = np.zeros(1, np.uint32), np.empty(1, np.int64), np.empty((1, 3)), np.empty(1, np.bool_)
    mesh, rays = ray_triangle.TriangleMesh(triangles, planes), ray_triangle.Rays(o, beam, d, range_m)
    hits = ray_triangle.Hits(ranges, hit, ends, returned)
    count = ray_triangle.resolve_hits(nearest, owner, mesh, rays, hits, result)
    assert ranges[0] == pytest.approx(np.linalg.norm([*end, 0.5]), abs=1e-9)
    assert bool(count) == ambiguous


@pytest.mark.parametrize("degrees", [0.0, 37.0, 45.0, 90.0, 123.456])
@pytest.mark.parametrize("graze_deg", [0.1, 1.0, 30.0, 89.9])
def test_wall_seen_at_an_angle(degrees, graze_deg):
    """A wall 300 m long, 0.2 m to the sensor's left; the beam meets it at 0.2 m / sin(angle)."""
    turn = turned(degrees)
    wall = quad([-50, 0.2, -5], [250, 0.2, -5], [250, 0.2, 5], [-50, 0.2, 5]) @ turn.T + [50, 50, 5]
    tilt = np.radians(np.linspace(-2, 2, 401))[:, None]
    flat = np.array([np.cos(np.radians(graze_deg)), np.sin(np.radians(graze_deg)), 0.0])
    d = (np.cos(tilt) * flat + np.sin(tilt) * [0.0, 0.0, 1.0]) @ turn.T
    ranges, _ = caster(wall).first_hits(np.array([50.0, 50.0, 5.0]), d)
    true = 0.2 / (np.cos(tilt[:, 0]) * flat[1])
    assert np.abs(ranges - true).max() < 1e-9


def test_sphere_of_many_triangles():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=8.0)
    centre, o = np.array([60.0, 40.0, 5.0]), np.array([5.3, 12.7, 4.1])
    rng = np.random.default_rng(2)
    d = towards(o, centre + 10.0 * random_directions(rng, 3000))
    result, true = cast_both(ball.triangles + centre, o, d)
    assert not cast.differ(result, true).any()
    hit = np.isfinite(result)
    off = np.linalg.norm(o + d[hit] * result[hit, None] - centre, axis=1)
    inner = np.abs((ball.triangles[:, 0] * ball.face_normals).sum(axis=1)).min()
    assert 1000 < hit.sum() < 3000
    assert off.min() > inner - 1e-9
    assert off.max() < 8.0 + 1e-9


def test_thin_pole_far_away():
    """A pole of 0.1 m at 150 m: exactly the beams that pass its edges inside meet it."""
    o = np.array([0.0, 50.0, 5.0])
    pole = trimesh.creation.box((0.1, 0.1, 8.0)).triangles + np.array([150.05, 50.0, 5.0])
    y = np.linspace(-0.08, 0.08, 1601)
    y = y[np.abs(np.abs(y) - 0.05) > 2e-6]
    result, _ = caster(pole).first_hits(
        o, towards(o, np.column_stack([np.full_like(y, 150.0), 50 + y, np.full_like(y, 4.9)]))
    )
    assert (np.isfinite(result) == (np.abs(y) < 0.05)).all()
    hit = np.isfinite(result)
    assert np.abs(result[hit] - np.sqrt(150.0**2 + y[hit] ** 2 + 0.01)).max() < 1e-9


@pytest.mark.parametrize("graze_deg", [0.1, 5.0, 90.0])
@pytest.mark.parametrize("first", [0, 1])
def test_two_walls_a_millimetre_apart(graze_deg, first):
    walls = [quad([-400, y, 0], [400, y, 0], [400, y, 10], [-400, y, 10]) for y in (50.001, 50.002)]
    o = np.array([10.3, 50.0005, 5.0])
    rng = np.random.default_rng(3)
    angle = np.radians(graze_deg + 0.01 * rng.random(2000))
    d = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(2000)])
    ranges, _ = caster(np.concatenate([walls[first], walls[1 - first]])).first_hits(o, d)
    assert np.abs(ranges - 0.0005 / np.sin(angle)).max() < 1e-9


@pytest.mark.parametrize("start", [(30.0, 50.123, 1.0), (20.0, 50.0, 4.5), (1.0, 50.0, -40.0)])
@pytest.mark.parametrize("width_m", [1e-1, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7])
def test_fan_of_slivers(width_m, start):
    """A roof of needles that share a tip: as one plane, without a gap."""
    n = 600
    rim = np.column_stack([np.zeros(n + 1), 50 + (np.arange(n + 1) - n / 2) * width_m, np.full(n + 1, 5.0)])
    tip = np.array([100.0, 50.0, 5.0])
    fan = np.stack([rim[:-1], rim[1:], np.broadcast_to(tip, (n, 3))], axis=1)
    rng = np.random.default_rng(4)
    s = rng.random((1500, 1)) * 0.99
    target = tip * s + (rim[[0]] + rng.random((1500, 1)) * (rim[[-1]] - rim[[0]])) * (1 - s)
    o = np.array(start)
    result, true = cast_both(fan, o, towards(o, target))
    assert not cast.differ(result, true).any()
    assert np.abs(result - np.linalg.norm(target - o, axis=1)).max() < 1e-6


def test_hits_needle_close_to_its_sides():
    """A cable of 2 mm, 100 m long; beams that pass 0.1 to 3 micrometres inside its sides, where no fin stands in the
    way."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
        cable = np.array([[[-50.0, -1e-3, 0.0], [-50.0, 1e-3, 0.0], [50.0, 0.0, 0.0]]])
        x, inside = rng.uniform(-0.5, 0.5, 500), 10.0 ** rng.uniform(-7, -5.5, 500)
        y = rng.choice([-1, 1], 500) * (1e-3 * (50 - x) / 100 - inside)
        target = np.column_stack([x, y, np.zeros(500)]) @ turn.T + [50, 50, 5]
        o = turn @ np.array([0.0, 0.0, 30.0]) + [50, 50, 5]
        result, _ = caster(cable @ turn.T + [50, 50, 5]).first_hits(o, towards(o, target))
        assert np.abs(result - np.linalg.norm(target - o, axis=1)).max() < 1e-6


def test_ignores_duplicates_and_triangles_without_area():
    rng = np.random.default_rng(5)
    scene = rng.random((200, 3, 3)) * [100, 100, 10]
    o, d = np.array([50.0, 50.0, 5.0]), random_directions(rng, 2000)
    points = np.repeat(scene[:50, :1], 3, axis=1)
    lines = scene[50:100].copy()
    lines[:, 2] = lines[:, 0] * 0.5 + lines[:, 1] * 0.5
    dirty = np.concatenate([scene, scene[::3], scene[::5, ::-1], points, lines])
    clean, _ = caster(scene).first_hits(o, d)
    assert (clean == caster(scene[::-1]).first_hits(o, d)[0]).all()
    assert not cast.differ(caster(dirty).first_hits(o, d)[0], clean).any()


def test_no_leak_through_t_junctions():
    """One large triangle meets three small ones along a side whose corners it does not share."""
    at = np.array([0.0, 1 / 3, 0.7, 1.0])
    side = np.array([20.0, 10.0, 2.0]) + at[:, None] * np.array([50.0, 70.0, 6.0])
    left, right = np.array([10.0, 80.0, 5.0]), np.array([80.0, 20.0, 6.0])
    scene = np.concatenate([[[side[0], side[3], left]], [[side[i], right, side[i + 1]] for i in range(3)]])
    rng = np.random.default_rng(6)
    s = np.concatenate([rng.random((5000, 1)) * 0.998 + 0.001, at[1:3, None]])
    o = np.array([40.0, 50.0, 20.0])
    result, true = cast_both(scene, o, towards(o, side[0] + s * (side[3] - side[0])))
    assert np.isfinite(result).all()
    assert not cast.differ(result, true).any()


def test_no_leak_at_a_closed_box():
    low, high, o = np.array([10.0, 20.0, 1.0]), np.array([70.0, 90.0, 8.0]), np.array([33.3, 44.4, 5.5])
    box = trimesh.creation.box((60, 70, 7)).triangles + (low + high) / 2
    rng = np.random.default_rng(7)
    edges = low + (high - low) * np.where(
        np.eye(3)[rng.integers(0, 3, 5000)] > 0, rng.random((5000, 1)), rng.integers(0, 2, (5000, 3))
    )
    d = np.concatenate([random_directions(rng, 95_000), towards(o, edges)])
    ranges, _ = caster(box).first_hits(o, d)
    assert np.abs(ranges - box_ranges(o, d, low, high)).max() < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (50.0, 50.0, 5.0)])
def test_no_leak_at_vertices_and_edges_of_sphere(centre):
    """10,242 vertices and 30,720 edges, aimed at exactly from inside; Embree alone leaks at 34 vertices of the
    first."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=10.0)
    o = np.array([3.0, 2.0, 1.0]) + centre
    targets = np.concatenate([ball.vertices, ball.vertices[ball.edges_unique].mean(axis=1)]) + centre
    assert len(targets) == 10_242 + 30_720
    ranges, ambiguous = caster(ball.triangles + centre).first_hits(o, towards(o, targets))
    assert np.abs(ranges - np.linalg.norm(targets - o, axis=1)).max() < 1e-5
    assert ambiguous == len(targets)


@pytest.mark.parametrize("graze_deg", [0.1, 0.5, 2.0, 30.0])
@pytest.mark.parametrize("size_m", [20.0, 150.0])
def test_no_leak_along_a_surface_of_many_triangles(graze_deg, size_m):
    """Aimed at the sides and corners of its triangles, from low above it."""
    rng = np.random.default_rng(8)
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.3, 0.6, 0.9]))[:3, :3]
    at = np.linspace(-size_m / 2, size_m / 2, 41)
    points = np.stack([*np.meshgrid(at, at, indexing="ij"), np.zeros((41, 41))], axis=-1) @ turn.T + [50, 50, 5]
    a, b, c, d = points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]
    surface = np.concatenate([np.stack(three, axis=-2).reshape(-1, 3, 3) for three in ((a, b, c), (a, c, d))])
    o = turn @ np.array([-0.2 * size_m, 0.033 * size_m, np.tan(np.radians(graze_deg)) * 0.4 * size_m]) + [50, 50, 5]
    chosen, side, s = rng.integers(0, len(surface), 20_000), rng.integers(0, 3, 20_000), rng.random((20_000, 1))
    s[:5000] = 0.0
    targets = surface[chosen, side] * (1 - s) + surface[chosen, (side + 1) % 3] * s
    ranges, _ = caster(surface).first_hits(o, towards(o, targets))
    assert np.abs(ranges - np.linalg.norm(targets - o, axis=1)).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("height_m", [2.0, 0.3])
def test_error_at_feet_of_poles_is_below_1_mm(height_m):
    """Where surfaces stand on each other, a beam may be given the farther of the two only when it is less than 1 mm
    behind."""
    rng = np.random.default_rng(12)
    ground = quad([-600, -600, 0], [700, -600, 0], [700, 700, 0], [-600, 700, 0])
    positions = np.column_stack([rng.uniform(20, 150, 40), rng.uniform(30, 70, 40), np.full(40, 4.75)])
    pole = trimesh.creation.cylinder(radius=0.09, height=9.5, sections=16).triangles
    scene = np.concatenate([ground, *(pole + site for site in positions)])
    o, n = np.array([0.0, 50.0, height_m]), 8000
    corners = scene[2:].reshape(-1, 3)
    corners = corners[
        (corners[:, 2] == 0) & (np.linalg.norm(corners - np.repeat(positions, len(pole) * 3, axis=0), axis=1) > 4.75)
    ]
    spread = 10.0 ** rng.uniform(-6, -3.5, (n, 3)) * rng.choice([-1, 1], (n, 3))
    target = corners[rng.integers(0, len(corners), n)] + spread
    result, true = cast_both(scene, o, towards(o, target))
    assert not cast.differ(result, true, 1e-5).mean() > 1e-3
    assert np.abs(result - true)[np.isfinite(true)].max() < 1e-3
    assert (np.isfinite(result) == np.isfinite(true)).all()


COARSE = st.tuples(*[st.integers(0, 8).map(lambda v: v * 1.25)] * 3)


@pytest.mark.slow
@settings(derandomize=True, max_examples=60, deadline=None)
@given(corners=st.lists(st.tuples(COARSE, COARSE, COARSE), min_size=1, max_size=25), start=COARSE)
def test_lattice_scenes_agree_with_brute_force(corners, start):
    """Corners, starts and targets on one coarse lattice: every ray is a coincidence."""
    scene, o = np.array(corners), np.asarray(start) + np.array([0.3, 0.2, 0.1])
    lattice = np.stack(np.meshgrid(*[np.arange(9) * 1.25] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    targets = np.concatenate([lattice, scene.mean(axis=1), scene[:, :2].mean(axis=1)])
    result, true = cast_both(scene, o, towards(o, targets))
    assert not cast.differ(result, true).any()


@pytest.mark.slow
@settings(derandomize=True, max_examples=40, deadline=None)
@example(seed=0, thin=-7.0, size=14.0)  # beam 136 aims at a needle 0.17 micrometres high; float64 places it 4 um off
@given(seed=st.integers(0, 2**32 - 1), thin=st.floats(-8, 0), size=st.floats(0.01, 40))
def test_random_scenes_agree_with_brute_force(seed, thin, size):
    """Triangles of any size and thinness; rays aimed at corners, sides, faces, and anywhere."""
    rng = np.random.default_rng(seed)
    scene = rng.random((60, 1, 3)) * [100, 100, 10] + rng.normal(size=(60, 3, 3)) * size
    scene[::3, 2] = (
        scene[::3, 0] + (scene[::3, 1] - scene[::3, 0]) * rng.random((20, 1)) + rng.normal(size=(20, 3)) * 10.0**thin
    )
    o = np.array([50.0, 50.0, 20.0])
    weights = rng.dirichlet([1, 1, 1], 60)[:, :, None]
    targets = [
        scene.reshape(-1, 3),
        scene[:, :2].mean(axis=1),
        (scene * weights).sum(axis=1),
        rng.random((100, 3)) * 100,
    ]
    d = towards(o, np.concatenate(targets))
    result, true = cast_both(scene, o, d)
    # A needle's plane is known no better than its height allows: where two ways to compute differ, exact arithmetic
    # tells what may come out.
    assert all(cast.allowed(result[ray], o, d[ray], scene) for ray in np.flatnonzero(cast.differ(result, true)))


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="seen along its length, a lone spike's fins end before float32's rounding does")
def test_hits_far_tip_of_spike_along_its_length():
    """A lone triangle 40 m long and 6 cm high, 87 m away, at 2.5 degrees; the beam is aimed at its very tip."""
    spike = np.array([[[50.0, 50.0, 5.0], [16.58, 45.34, -16.48], [18.29, 45.63, -15.48]]])
    o = np.array([-21.11, 41.95, -44.47])
    result, true = cast_both(spike, o, towards(o, spike[0, :1]))
    assert np.isfinite(true).all()
    assert not cast.differ(result, true).any()


@pytest.mark.slow
@pytest.mark.parametrize("degrees", range(1, 90, 8))
def test_sensor_on_wall_is_not_blocked(degrees):
    """Rounding must not tell on which side of the wall the sensor stands."""
    turn, centre = turned(degrees), np.array([50.3, 49.9, 3.0])
    house = trimesh.creation.box((10, 8, 6)).triangles @ turn.T + centre
    directions = CATALOGUE["VLP-16"].directions()[::7]
    outwards = directions @ turn[:, 0] > 1e-3
    for offsets in (-1e-9, -1e-13, 0.0, 1e-13, 1e-9):
        o = turn @ np.array([5.0 + offsets, 1.3, 0.7]) + centre
        assert np.isinf(caster(house).first_hits(o, directions)[0][outwards]).all()
    assert touches_sensor(house - o).sum() in (1, 2)
    deep = turn @ np.array([4.99, 1.3, 0.7]) + centre
    assert np.isfinite(caster(house).first_hits(deep, directions)[0]).all()
    assert not touches_sensor(house - deep).any()


@pytest.mark.slow
def test_moved_scene_gives_identical_scan():
    shift = np.array([393216.0, 3932160.0, 64.0])
    rng = np.random.default_rng(9)
    scene = np.round(rng.random((500, 3, 3)) * [100, 100, 10] * 2**20) / 2**20
    o, d = np.array([12.5, 50.25, 5.75]), CATALOGUE["VLP-32C"].directions(12.3)[::5]
    here = caster(scene).scan(tuple(o), d, 200.0)
    there = caster(scene + shift, Roi(tuple(shift), ROI.size_m)).scan(tuple(o + shift), d, 200.0)
    assert (here.beam == there.beam).all()
    assert (here.ends_m == there.ends_m).all()
    assert (here.returned == there.returned).all()
    assert here.ambiguous == there.ambiguous


# UTM 54N of Nishi-Shinjuku, Japan Plane Rectangular IX, an MGRS square with heights above the ellipsoid
@pytest.mark.parametrize(
    "offset", [(382741.3, 3950216.7, 41.2), (-12345.678, -34567.891, 38.9), (54321.987, 65432.123, 1234.5)]
)
def test_georeferenced_scene_loses_no_digits(offset):
    offset = np.array(offset)
    rng = np.random.default_rng(10)
    scene = rng.random((300, 3, 3)) * [100, 100, 10]
    o, d = np.array([50.0, 50.0, 5.0]), random_directions(rng, 3000)
    there = caster(scene + offset, Roi(tuple(offset), ROI.size_m)).first_hits(o, d)[0]
    true, _ = cast.first_hits(o, d, scene)
    wrong = cast.differ(there, true, 1e-6)  # coordinates of 4e6 m are multiples of 5e-10 m
    assert wrong.sum() <= 1


def test_beam_without_hit_ends_at_range():
    wall = quad([50, -500, -500], [50, 500, -500], [50, 500, 500], [50, -500, 500])
    d = CATALOGUE["VLP-16"].directions()
    scan = caster(wall).scan((10.0, 50.0, 5.0), d, 60.0)
    length = np.linalg.norm(scan.ends_m, axis=1)
    facing = d[scan.beam][:, 0] * 60.0 >= 40.0
    assert (scan.returned == facing).all()
    assert np.allclose(length[~scan.returned], 60.0, rtol=1e-15)
    assert np.allclose(scan.ends_m[scan.returned, 0], 40.0, rtol=1e-15)


@pytest.mark.slow
def test_only_beams_that_can_meet_the_region_are_cast():
    d = CATALOGUE["VLP-16"].directions(33.0)
    o = np.array([-20.0, 30.0, 12.0])
    scan = caster(np.empty((0, 3, 3))).scan(tuple(o), d, 70.0)
    cells = (np.array(ROI.size_m) / 10).astype(int)
    true = [len(cast.crossed(o, 70.0 * way, np.zeros(3), 10.0, cells)) > 0 for way in d]
    assert scan.beam.tolist() == np.flatnonzero(true).tolist()
    assert not scan.returned.any()
    assert 0 < len(scan.beam) < len(d)


def test_world_without_triangles_or_with_one():
    d = random_directions(np.random.default_rng(11), 100)
    o = np.array([50.0, 50.0, 5.0])
    assert np.isinf(caster(np.empty((0, 3, 3))).first_hits(o, d)[0]).all()
    flat = np.repeat([[[1.0, 1.0, 1.0]]], 3, axis=1)
    assert np.isinf(caster(flat).first_hits(o, d)[0]).all()
    one = np.array([[[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 100.0, 0.0]]])
    assert not cast.differ(*cast_both(one, o, d)).any()
    assert caster(one).first_hits(o, d[:0])[0].shape == (0,)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_rejects_triangle_that_is_not_finite(value):
    scene = np.ones((2, 3, 3))
    scene[1, 2, 0] = value
    with pytest.raises(InputError, match="expected finite coordinates"):
        caster(scene)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "site"), [("nishishinjuku", 4), ("ingolstadt", 1)])
def test_shipped_scene_agrees_with_brute_force(name, site):
    """Every fifth beam of a site against all triangles; ``make numerics`` holds every beam of every site against
    them."""
    loaded = loading.load(f"scenarios/{name}")
    scene = build_scene(loaded)
    site, world = scene.sites[site], scene.world
    scan = Scanner(scene).scan_site(site).rows
    chosen = slice(None, None, 5)
    d = CATALOGUE[site.sensor].directions(*site.pose.angles_deg)[scan.beam[chosen]]
    corners = world.triangles_m - np.asarray(loaded.roi.box.origin_m)
    true, _ = cast.first_hits(np.asarray(site.pose.position_m) - loaded.roi.box.origin_m, d, corners)
    reach = CATALOGUE[site.sensor].range_m
    assert (scan.returned[chosen] == (true <= reach)).all()
    assert np.abs(scan.ends_m[chosen] - d * np.minimum(true, reach)[:, None]).max() < 1e-9
    assert scan.ambiguous < 0.01 * len(scan.beam)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [np.int64, np.float32])
def test_ends_are_float64_for_other_types_of_directions(dtype):
    wall = quad((10.3, 0, 0), (10.3, 9, 0), (10.3, 9, 9), (10.3, 0, 9))
    swept = caster(wall).sweep((0.0, 5.0, 3.0), np.array([[1, 0, 0], [0, -1, 0]], dtype), 20.7)
    assert swept.ends_m.dtype == np.float64
    assert np.array_equal(swept.ends_m, [[10.3, 0.0, 0.0], [0.0, -20.7, 0.0]])


def meets(o, ends, size):
    """Whether each segment shares more than CHORD_M with the box, by one quotient for each crossing."""
    with np.errstate(all="ignore"):
        t = np.sort([(0.0 - o) / ends, (size - o) / ends], axis=0)
        stays = ends == 0.0
        low = np.where(stays, 0.0, t[0]).max(axis=1, initial=0.0)
        high = np.where(stays, np.where((o >= 0.0) & (size - o >= 0.0), 1.0, -1.0), t[1]).min(axis=1, initial=1.0)
        x, y, z = ends.T
        return (high - low) * np.sqrt(x * x + y * y + z * z) > ray_triangle.CHORD_M


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 1.0, 200.0, 1e5]))
def test_can_meet_box_agrees_with_quotients(seed, reach):
    """At random, along axes, along the box's faces, and past its edges with a chord of about CHORD_M."""
    rng, size = np.random.default_rng(seed), np.array([40.0, 20.0, 5.0])
    o = rng.choice([rng.uniform(-50, 90, 3), size * rng.integers(-1, 3, 3), size * rng.random(3)], axis=0)
    edge = np.column_stack([size[0] * rng.integers(0, 2, 400), size[1] * rng.integers(0, 2, 400), rng.random(400) * 5])
    inwards = np.where(edge[:, :2] == 0.0, 1.0, -1.0) * rng.choice([0.5, 0.7, 0.71, 1.0, 3.0], (400, 1)) * 1e-6
    past = np.concatenate([edge[:, :2] + inwards * rng.random((400, 2)), edge[:, 2:]], axis=1)
    ends = np.concatenate([(past - o) * rng.choice([0.9, 1.0, 1.5], (400, 1)), random_directions(rng, 400) * reach])
    ends *= rng.choice([1.0, 0.0], ends.shape, p=[0.9, 0.1])
    ends[::50, 0], ends[1::50, 2] = 1e-300, -5e-324
    result = np.empty(len(ends), dtype=np.bool_)
    ray_triangle.can_meet_box(o, ends, size, result)
    np.testing.assert_array_equal(result, meets(o, ends, size))


def test_can_meet_box_is_exact_for_chords_at_the_limit():
    """Through a box no thicker than CHORD_M: which beams share a longer piece with it, rounding alone says."""
    rng, size, o = np.random.default_rng(9), np.array([ray_triangle.CHORD_M, 20.0, 5.0]), np.array([0.0, 10.0, 2.5])
    offsets = np.array([1.0, 0.0, 0.0]) + rng.uniform(-1e-8, 1e-8, (20_000, 3)) * [0.0, 1.0, 1.0]
    ends = offsets * rng.uniform(1.0, 300.0, (20_000, 1))
    true = meets(o, ends, size)
    per = 1.0 / ends[:, 0]
    chord = size[0] * per * np.sqrt((ends**2).sum(axis=1))
    assert (true != (chord > ray_triangle.CHORD_M)).mean() > 0.01  # so products alone would not do
    result = np.empty(len(ends), dtype=np.bool_)
    for n in range(2000):  # alone: one in doubt has those beside it measured too
        ray_triangle.can_meet_box(o, ends[n : n + 1], size, result[n : n + 1])
    np.testing.assert_array_equal(result[:2000], true[:2000])


@pytest.mark.slow
def test_select_beams_agrees_with_can_meet_box():
    """The beams that are cast, of a whole turn, from within the region, above it, beside it and far away."""
    size, d = np.array([40.0, 20.0, 5.0]), random_directions(np.random.default_rng(3), 20_011)
    for o in ([20.0, 10.0, 2.0], [20.0, 10.0, 9.0], [-3.0, 5.0, 4.0], [300.0, 5.0, 40.0]):
        beam, result = np.empty(len(d), dtype=np.uint32), np.empty(len(d), dtype=np.bool_)
        count = ray_triangle.select_beams(np.array(o), d, size, 60.0, beam)
        ray_triangle.can_meet_box(np.array(o), d, size, result, 60.0)
        np.testing.assert_array_equal(beam[:count], np.flatnonzero(result))
        np.testing.assert_array_equal(result, meets(np.array(o), d * 60.0, size))


def fan(slivers, reach, turn_deg):
    """Slivers from one corner to the points of a line, in a plane that climbs."""
    far = np.column_stack([np.full(slivers + 1, reach), np.linspace(-reach, reach, slivers + 1)])
    flat = np.stack([np.zeros((slivers, 2)), far[:-1], far[1:]], axis=1) @ turned(turn_deg)[:2, :2].T
    return np.dstack([flat + 50.0, 1.0 + flat @ [0.03, -0.02]])


def test_pieces_of_slivers_have_their_area_and_plane():
    slivers_and_quad = np.concatenate([fan(12, 180.0, 31.0), quad((0, 0, 0), (9, 0, 0), (9, 9, 0), (0, 9, 0))])
    pieces, owner = _split_large(slivers_and_quad)
    assert len(slivers_and_quad) < len(pieces) <= 2 * len(slivers_and_quad)
    assert (owner[-2:] != len(slivers_and_quad) - 1).all() and (
        owner == len(slivers_and_quad) - 1
    ).sum() == 1  # the quad stays as it is
    area = np.linalg.norm(np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]), axis=1)
    true = np.linalg.norm(
        np.cross(slivers_and_quad[:, 1] - slivers_and_quad[:, 0], slivers_and_quad[:, 2] - slivers_and_quad[:, 0]),
        axis=1,
    )
    assert np.bincount(owner, area) == pytest.approx(true, rel=1e-12)
    for corner in range(3):
        np.testing.assert_allclose(along_plane(pieces[:, corner], slivers_and_quad[owner]), 0.0, atol=1e-12)


def along_plane(points, triangles):
    """How far each point lies beside the plane of its triangle."""
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return ((points - triangles[:, 0]) * normal).sum(axis=1) / np.linalg.norm(normal, axis=1)


@pytest.mark.parametrize("turn_deg", [0.0, 31.0])
@pytest.mark.parametrize("height_m", [0.05, 4.0])
def test_no_leak_at_fan_of_large_slivers(turn_deg, height_m):
    """Beams at the cuts, at the sides, and at anything, steep and nearly along the plane, against brute force."""
    rng, slivers = np.random.default_rng(5), fan(60, 150.0, turn_deg)
    pieces, _ = _split_large(slivers)
    assert len(pieces) > 100
    sides = 0.5 * (pieces + np.roll(pieces, 1, axis=1)).reshape(-1, 3)
    share = rng.dirichlet([1, 1, 1], len(slivers) * 40)
    inside = (np.repeat(slivers, 40, axis=0) * share[:, :, None]).sum(axis=1)
    o = np.array([50.0, 50.0, 1.0 + height_m]) + (turned(turn_deg) @ [20.0, 3.0, 0.0])
    d = towards(o, np.concatenate([pieces.reshape(-1, 3), sides, inside]))
    result, true = cast_both(slivers, o, d)
    assert np.isfinite(true).mean() > 0.9
    assert not cast.differ(result, true).any()
