"""Clouds with mixed returns: a plate before a wall by hand, and all cones of a scene against a slow reference."""

from __future__ import annotations

import math

import numpy as np
import pytest

from egvs.clouds import simulation
from egvs.clouds.simulation import CloudSimulator, sweep_rng
from egvs.sensors.sites import Pose
from tests.clouds.cloud_scenes import body_triangles, build_scene, frame_of, make_sensor
from tests.conftest import collection, feature
from tests.effects.test_mixed_returns import SEVEN, slow_return
from tests.oracles import cast

EMPTY = frame_of([])
MIXED = "effects.mixed_returns={}"
CONE_MRAD = 6.0
STEP_DEG = 0.05


def write_plate_and_wall(folder, gap_m):
    """A plate 20 m ahead, to the right (y < 0) of the origin, and a wall behind it on both sides."""
    walls = []
    for name, x, y0, y1 in (("plate", 20.0, -6.0, 0.0), ("wall", 20.0 + gap_m, -6.0, 6.0)):
        ring = [[x, y0], [x + 0.1, y0], [x + 0.1, y1], [x, y1], [x, y0]]
        polygon = {"type": "Polygon", "coordinates": [ring]}
        walls.append(feature(polygon, name=name, kind="building", height_m=8))
    (folder / "statics.geojson").write_text(collection(*walls))


def level_beams(**keys):
    """A sensor with one level ring of beams, up to 10 degrees to both sides."""
    keys = {"divergence_mrad": [CONE_MRAD, CONE_MRAD], "azimuth_step_deg": STEP_DEG, **keys}
    return make_sensor(elevations_deg=[0.0], azimuth_deg=[-10, 10], **keys)


def returns_of(folder, pose, sensor, *settings, seed=1):
    """Range and intensity by beam number of a sweep of an empty road."""
    simulator = CloudSimulator(build_scene(folder, *settings), pose, sensor, "here")
    sweep = simulator.sweep(EMPTY, sweep_rng(seed, "here", 0)).sweep
    range_m = np.sqrt((sweep.points[:, :3].astype(np.float64) ** 2).sum(axis=1))
    return dict(zip(sweep.beam.tolist(), zip(range_m.tolist(), sweep.points[:, 3].tolist(), strict=True), strict=True))


@pytest.mark.parametrize(
    ("gap_m", "setting", "range_m", "intensity"),
    [
        # A quarter of the cone is on the plate: r = (.25 / 20 + .75 / 20.5) / (.25 / 400 + .75 / 420.25).
        (0.5, "{}", 20.3704, 0.24),
        # Two metres apart: the wall is stronger (.75 / 484 against .25 / 400), the plate first.
        (2.0, "{}", 22.0, 0.18),
        (2.0, "{returns='first'}", 20.0, 0.06),
        (2.0, "{pulse_ns=14}", 21.4252, 0.24),
    ],
)
def test_range_of_a_beam_at_the_edge_of_a_plate(mini, gap_m, setting, range_m, intensity):
    """The axis of beam 200 passes 1 mm left of the plate; three of the ring's six sub-beams, 3/12, are right of it."""
    write_plate_and_wall(mini, gap_m)
    result = returns_of(mini, Pose(0.0, 0.001, 3.0), level_beams(), f"effects.mixed_returns={setting}")
    assert result[200] == (pytest.approx(range_m, abs=2e-3), pytest.approx(intensity, rel=1e-3))


@pytest.mark.slow
def test_share_of_mixed_points_along_an_edge_is_that_of_the_footprint(mini):
    """With 7 sub-beams a cone is as wide as its full angle: beams nearer to the edge than half of it are mixed.

    The edge is at azimuth -yaw. Over evenly spaced yaws the mean number of mixed beams is width / step = 6.875.
    """
    write_plate_and_wall(mini, 0.5)
    scene_settings = (MIXED,)
    mixed_beams = []
    yaws_deg = 1.0 + (np.arange(16) + 0.5) / 16 * STEP_DEG
    for yaw_deg in yaws_deg:
        result = returns_of(mini, Pose(0.0, 0.0, 3.0, yaw_deg=yaw_deg), level_beams(), *scene_settings)
        assert len(result) == 401
        azimuths_deg = -10.0 + STEP_DEG * np.arange(401)
        on_x_m = np.array([result[beam][0] for beam in range(401)]) * np.cos(np.radians(azimuths_deg + yaw_deg))
        between = (on_x_m > 20.0 + 1e-4) & (on_x_m < 20.5 - 1e-4)
        away_mrad = 1e3 * np.abs(np.tan(np.radians(azimuths_deg + yaw_deg)))
        np.testing.assert_array_equal(between, away_mrad < CONE_MRAD / 2)
        mixed_beams.append(between.sum())
    assert np.mean(mixed_beams) == pytest.approx(CONE_MRAD / (1e3 * math.radians(STEP_DEG)), abs=0.1)


def test_points_away_from_edges_are_those_without_the_effect(mini):
    """Beams farther than a cone from the plate's edge, and all beams before a wall alone: same bytes."""
    write_plate_and_wall(mini, 0.5)
    pose = Pose(0.0, 0.0, 3.0)
    plain, mixed = returns_of(mini, pose, level_beams()), returns_of(mini, pose, level_beams(), MIXED)
    differing = [beam for beam in plain if plain[beam] != mixed[beam]]
    assert differing and all(abs(beam - 200) * math.radians(STEP_DEG) < 1e-3 * CONE_MRAD / 2 for beam in differing)

    polygon = {"type": "Polygon", "coordinates": [[[20, -30], [21, -30], [21, 30], [20, 30], [20, -30]]]}
    (mini / "statics.geojson").write_text(collection(feature(polygon, name="wall", kind="building", height_m=8)))
    assert returns_of(mini, pose, level_beams()) == returns_of(mini, pose, level_beams(), MIXED)


def test_same_seed_gives_same_bytes(mini):
    write_plate_and_wall(mini, 0.5)
    sensor = level_beams(range_sigma_m=0.02)
    first, again, other = (returns_of(mini, Pose(0.0, 0.0, 3.0), sensor, MIXED, seed=seed) for seed in (1, 1, 2))
    assert first == again != other


def test_dim_returns_of_edges_are_lost_more_often(mini):
    """Near the edge of a plate before nothing, half of the pulse is lost; losses see half the reflectivity."""
    ring = [[20, -6], [20.1, -6], [20.1, 0], [20, 0], [20, -6]]
    plate = feature({"type": "Polygon", "coordinates": [ring]}, name="plate", kind="building", height_m=8)
    (mini / "statics.geojson").write_text(collection(plate))
    losses = "effects.range_limit={rated_range_m=20, rated_reflectivity=0.2, dropout=0, softness=0.01}"
    pose = Pose(0.0, -0.001, 3.0)  # the axis of beam 200 is on the plate, with 3/4 of the cone: 0.75 x 0.24 = 0.18
    assert 200 in returns_of(mini, pose, level_beams(), losses)
    kept = returns_of(mini, pose, level_beams(), losses, MIXED)
    assert 200 not in kept and 190 in kept and 100 in kept


FINE = {"elevations_deg": [-32, 0], "channels": 24, "azimuth_deg": [-80, 20], "azimuth_step_deg": 1.0}


@pytest.mark.parametrize("sub_beams", [7, 19])
def test_all_returns_agree_with_slow_reference(mini, sub_beams):
    """A car, a person and a truck before house, lamp and ground: every cone against every triangle."""
    position_m = (10.0, 12.0, 5.0)
    rows = [(15.0, 2.0, 0.75, 4.5, 1.8, 1.5, 0.4, 0.0), (19.5, 4.5, 0.9, 0.6, 0.6, 1.8, 0.0, 0.0)]
    frame = frame_of([*rows, (24.0, 6.0, 1.7, 9.0, 2.5, 3.4, 1.2, 0.05)], ["passenger", "pedestrian", "truck"])
    setting = f"effects.mixed_returns={{sub_beams={sub_beams}, divergence_mrad=[12, 6]}}"
    scene, sensor = build_scene(mini, setting), make_sensor(**FINE)
    pose = Pose(*position_m, yaw_deg=-30.0)
    cloud = CloudSimulator(scene, pose, sensor, "here").sweep(frame, sweep_rng(1, "here", 0))

    offsets, weight = ring_nodes(sub_beams)
    corners, reflectivity, surface = surfaces(scene, frame, position_m)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.sqrt((normals**2).sum(axis=1, keepdims=True))
    axes = sensor.directions(*pose.angles_deg)
    sideways = np.column_stack([-axes[:, 1], axes[:, 0], np.zeros(len(axes))])
    sideways /= np.sqrt((sideways**2).sum(axis=1, keepdims=True))
    upwards = np.cross(axes, sideways)
    rays = axes[:, None] + 12e-3 * offsets[:, :1] * sideways[:, None] + 6e-3 * offsets[:, 1:] * upwards[:, None]
    rays /= np.sqrt((rays**2).sum(axis=2, keepdims=True))
    hit_m, which = cast.first_hits(np.zeros(3), rays.reshape(-1, 3), corners, edge_m=1e-9)
    hit_m[hit_m > sensor.range_m] = np.inf
    cosine = np.abs((normals[which] * rays.reshape(-1, 3)).sum(axis=1))

    shape = (len(axes), len(weight))
    expected, edges = {}, 0
    for beam, (range_m, level, owner) in enumerate(
        zip(
            hit_m.reshape(shape),
            (reflectivity[which] * cosine).reshape(shape),
            surface[which].reshape(shape),
            strict=True,
        )
    ):
        if np.isinf(range_m).all():
            continue
        main, merged_m, power = 0, range_m[0], 1.0
        if np.isinf(range_m).any() or len(set(owner.tolist())) > 1:
            edges += 1
            parts = (array.tolist() for array in (range_m, weight, level, owner))
            main, merged_m, power = slow_return(*parts, 5.0, "strongest")
        expected[beam] = (merged_m, min(power * level[main], 1.0), max(int(owner[main]), -1))
    assert list(expected) == cloud.sweep.beam.tolist() and edges > 100
    far_m = np.sqrt((cloud.sweep.points[:, :3].astype(np.float64) ** 2).sum(axis=1))
    wanted = np.array(list(expected.values()))
    np.testing.assert_allclose(far_m, wanted[:, 0], atol=1e-5)
    same = np.isclose(cloud.sweep.points[:, 3], wanted[:, 1], rtol=0, atol=1e-5)
    assert (~same).mean() < 1e-3  # a tyre and the paint beside it in one plane: either is hit
    np.testing.assert_array_equal(cloud.owner, wanted[:, 2])
    plain = CloudSimulator(build_scene(mini), pose, sensor, "here").sweep(frame, sweep_rng(1, "here", 0))
    assert len(set(cloud.sweep.beam) & set(plain.sweep.beam)) > 0.95 * len(plain.sweep.beam)


def ring_nodes(sub_beams):
    """Nodes in full angles and weights: rings of 6 and 12, whose radii and weights solve a Gauss-Radau rule."""
    root = math.sqrt(3.0)
    rings = [(0.5, 6, 0.0, 0.5)]
    if sub_beams == 19:
        inner, outer = (root + 1) / (2 * root) / (3 - root), (root - 1) / (2 * root) / (3 + root)
        rings = [(math.sqrt((3 - root) / 8), 6, 0.0, inner), (math.sqrt((3 + root) / 8), 12, 15.0, outer)]
    offsets, weights = [(0.0, 0.0)], [1.0 - sum(ring[3] for ring in rings)]
    for radius, count, first_deg, weight in rings:
        for number in range(count):
            turn = math.radians(first_deg + 360 / count * number)
            offsets.append((radius * math.cos(turn), radius * math.sin(turn)))
            weights.append(weight / count)
    assert sub_beams == 19 or weights == pytest.approx(SEVEN)
    return np.array(offsets), np.array(weights)


def surfaces(scene, frame, position_m):
    """Triangles relative to the sensor, their reflectivity, and their object: a box, or below 0 a static solid."""
    moving, owner = body_triangles(frame, position_m)
    bodies, levels = simulation.builtin_bodies(), []
    for number, kind in enumerate(frame.kinds):
        size_m = frame.boxes[number, 3:6].tolist()
        for part in bodies[simulation.body_kind(kind, size_m)]:
            levels += [simulation.REFLECTIVITY[part.surface]] * len(part.triangles)
    still = scene.world.triangles_m - np.asarray(position_m)
    by_solid = simulation.solid_reflectivity(kind for _, kind in scene.world.solids)
    solid = scene.world.solid_of_face
    return (
        np.concatenate([moving, still]),
        np.concatenate([levels, by_solid[solid]]),
        np.concatenate([owner, -2 - solid.astype(np.int64)]),
    )
