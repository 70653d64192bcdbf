"""Point clouds against every beam with every triangle, and cases calculated by hand."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from egvs.clouds import simulation as cloud_simulation
from egvs.clouds.simulation import CloudSimulator, sweep_rng
from egvs.core.errors import InputError
from egvs.sensors.scanner import Scanner
from egvs.sensors.sites import Pose
from tests.clouds.cloud_scenes import (
    body_triangles,
    build_scene,
    frame_of,
    make_sensor,
    move_scene,
    random_frame,
    slow_first_hits,
    use_boxes_for,
)
from tests.oracles import cast

POSES = {
    "upright": Pose(10.0, 12.0, 3.0),
    "tilted": Pose(12.0, -13.0, 4.5, yaw_deg=77.3, pitch_deg=-11.0),
    "rolled": Pose(30.5, -12.0, 6.0, yaw_deg=-160.0, pitch_deg=-35.0, roll_deg=20.0),
    "down": Pose(25.0, 1.0, 7.0, yaw_deg=10.0, pitch_deg=-90.0),
}
FAR_M = (400_000.0, 3_900_000.0, 120.0)
SENSORS = {
    "rings": {"elevations_deg": [-30, 5], "channels": 9, "azimuth_step_deg": 1.0},
    "field of view": {
        "elevations_deg": [-20, 10], "channels": 12, "azimuth_deg": [-60, 60], "azimuth_step_deg": 0.5,
    },
    "rosette": {
        "pattern": {
            "kind": "rosette", "samples": 3000, "azimuth_deg": [-35, 35], "elevation_deg": [-35, 35], "turns": [12, -7]
        }
    },
}  # fmt: skip
CAR = (4.0, 2.0, 1.5)


def hits_equal(scene, pose, sensor, frame):
    """Compare the first hits with the slow reference; return the number of beams that hit a body."""
    hits = CloudSimulator(scene, pose, sensor, "here").first_hits(frame)
    ranges, owner = slow_first_hits(scene, pose, sensor, frame)
    met = np.isfinite(ranges)
    np.testing.assert_array_equal(np.isfinite(hits.range_m), met)
    np.testing.assert_array_equal(hits.owner, owner)
    np.testing.assert_allclose(hits.range_m[met], ranges[met], rtol=0, atol=1e-9)
    return int((owner >= 0).sum())


@pytest.mark.slow
@pytest.mark.parametrize("name", POSES)
@pytest.mark.parametrize("kind", SENSORS)
def test_ranges_equal_every_beam_against_every_triangle(mini, name, kind):
    scene, pose, sensor = build_scene(mini), POSES[name], make_sensor(**SENSORS[kind])
    random = np.random.default_rng(5)
    frames = [random_frame(random, np.array(pose.position_m) * (1, 1, 0), spread_m=12.0, number=n) for n in range(3)]
    assert sum(hits_equal(scene, pose, sensor, frame) for frame in frames) > 10


@pytest.mark.parametrize("name", POSES)
def test_ranges_are_exact_far_from_origin(mini, name):
    scene = move_scene(build_scene(mini), FAR_M)
    pose = Pose(*np.add(POSES[name].position_m, FAR_M).tolist(), *POSES[name].angles_deg)
    frame = random_frame(np.random.default_rng(6), np.array(pose.position_m) * (1, 1, 0) + (0, 0, FAR_M[2]))
    assert hits_equal(scene, pose, make_sensor(**SENSORS["rings"]), frame) > 10


def test_traffic_all_around_within_and_beyond_range(mini):
    """Bodies behind the sensor, across azimuth 180, straight below, and beyond its range."""
    scene, pose = build_scene(mini), Pose(20.0, 0.0, 6.0)
    around = [(20 + 8 * math.cos(a), 8 * math.sin(a), 0.75, *CAR, a + 0.3, 0.1) for a in np.linspace(-3.1, 3.1, 9)]
    frame = frame_of([*around, (20.3, 0.1, 0.75, *CAR, 0.0, 0.0), (60.0, 0.0, 1.5, 12.0, 2.5, 3.0, 0.0, 0.0)])
    near = make_sensor(elevations_deg=[-89, 0], channels=45, azimuth_step_deg=2.0, range_m=30.0)
    assert hits_equal(scene, pose, near, frame) > 500
    owner = CloudSimulator(scene, pose, near, "here").first_hits(frame).owner
    assert set(owner[owner >= 0]) == set(range(10))  # the last one is out of reach


def test_points_and_intensities_counted_by_hand(mini):
    """A sensor 3 m up, four azimuths, three rings. A box from 1 to 5 m ahead, 1.5 m high; one from 6 m on, 3 m high.

    At -45 and -30 degrees the beams ahead end on the first one's roof, at 1.5 / sin; at -10 degrees on the second one's
    front, at 6 / cos. The other nine, and those that met nothing ahead, end on the ground at 3 / sin.
    """
    scene = build_scene(mini, *use_boxes_for(mini, "sedan", "van"))
    sensor = make_sensor(elevations_deg=[-45, -30, -10], azimuth_step_deg=90.0)
    simulator = CloudSimulator(scene, Pose(10.0, -8.0, 3.0), sensor, "here")
    frame = frame_of([(13.0, -8.0, 0.75, 4.0, 2.0, 1.5, 0, 0), (18.0, -8.0, 1.5, 4.0, 1.7, 3.0, math.pi, 0)])
    cloud = simulator.sweep(frame, sweep_rng(0, "here", 0))
    np.testing.assert_array_equal(cloud.sweep.beam, np.arange(12))
    np.testing.assert_array_equal(cloud.owner, [0, 0, 1, *[-1] * 9])
    np.testing.assert_array_equal(cloud.points_on(2), [2, 1])
    sine, cosine = np.sin(np.radians([45, 30, 10])), np.cos(np.radians([45, 30, 10]))
    ahead = np.array([1.5 / sine[0], 1.5 / sine[1], 6.0 / cosine[2]])
    x, y, z, intensity = cloud.sweep.points.T
    np.testing.assert_allclose(x[:3], ahead * cosine, rtol=1e-6)
    np.testing.assert_allclose(y[:3], 0.0, atol=1e-7)
    np.testing.assert_allclose(z[:3], -ahead * sine, rtol=1e-6)
    np.testing.assert_allclose(intensity[:3], 0.45 * np.array([sine[0], sine[1], cosine[2]]), rtol=1e-6)
    np.testing.assert_allclose(y[3:6], 3.0 * cosine / sine, rtol=1e-6)
    np.testing.assert_allclose(z[3:], -3.0, rtol=1e-6)
    np.testing.assert_allclose(intensity[3:], 0.17 * np.tile(sine, 3), rtol=1e-6)


def test_vehicle_behind_wall_has_no_points(mini):
    scene = build_scene(mini)
    simulator = CloudSimulator(scene, Pose(16.0, -5.0, 3.0), make_sensor(**SENSORS["rings"]), "here")
    hidden, empty = frame_of([(16.0, 10.0, 0.75, 2.0, 1.5, 1.5, 0, 0)]), frame_of([])
    clouds = [simulator.sweep(frame, sweep_rng(0, "here", 0)) for frame in (hidden, empty)]
    assert clouds[0].sweep.points.tobytes() == clouds[1].sweep.points.tobytes()
    assert (clouds[0].owner == -1).all()


def test_enclosed_body_has_no_points(mini):
    simulator = CloudSimulator(build_scene(mini), Pose(10.0, 12.0, 3.0), make_sensor(**SENSORS["rings"]), "here")
    large = (20.0, 12.0, 1.5, 8.0, 3.0, 3.0, 0.0, 0.0)
    cargo = (16.5, 12.0, 2.0, 0.5, 0.5, 0.5, 0.0, 0.0)
    assert simulator.sweep(frame_of([large, cargo], ["truck"] * 2), sweep_rng(0, "a", 0)).points_on(2)[1] == 0


@pytest.mark.parametrize("height_m", [3.0, 2.0])
def test_beams_along_faces_hit_front_or_nothing(mini, height_m):
    """The sensor as high as the roof and in line with the side of a box; beams along both hit its front, or nothing."""
    scene = build_scene(mini, *use_boxes_for(mini, "sedan", "van"))
    sensor = make_sensor(elevations_deg=[0, -10], azimuth_step_deg=90.0)
    simulator = CloudSimulator(scene, Pose(10.0, -8.0, 3.0), sensor, "here")
    frame = frame_of([(15.0, -7.0, height_m / 2, 4.0, 2.0, height_m, 0, 0)])
    hits = simulator.first_hits(frame)
    level, low = hits.range_m[:2]
    assert level == (3.0 if height_m == 3.0 else math.inf)
    assert low == pytest.approx(3.0 / math.cos(math.radians(10))) or height_m == 2.0


def test_ignores_body_around_sensor(mini):
    scene, pose = build_scene(mini), Pose(10.0, 12.0, 3.0)
    simulator = CloudSimulator(scene, pose, make_sensor(**SENSORS["rings"]), "here")
    bus = (*pose.position_m[:2], 2.0, 12.0, 2.5, 4.0, 0.4, 0.0)
    car = (18.0, 12.0, 0.75, *CAR, 0.0, 0.0)
    both, alone = (simulator.first_hits(frame_of(rows)) for rows in ([bus, car], [car]))
    np.testing.assert_array_equal(both.range_m, alone.range_m)
    assert set(both.owner) == {-1, 1}


def test_noise_is_gaussian_along_the_beam(mini):
    sensor = replace(make_sensor(elevations_deg=[-60, -5], channels=60, azimuth_step_deg=1.0), range_sigma_m=0.05)
    simulator = CloudSimulator(build_scene(mini), Pose(10.0, 12.0, 3.0, pitch_deg=-10.0, yaw_deg=30.0), sensor, "here")
    cloud = simulator.sweep(frame_of([]), sweep_rng(3, "here", 0)).sweep
    nominal = sensor.directions()[cloud.beam]
    measured = (cloud.points[:, :3] * nominal).sum(axis=1)
    np.testing.assert_allclose(cloud.points[:, :3], measured[:, None] * nominal, atol=1e-4)
    off = (measured - simulator.view.empty_range_m[cloud.beam]) / 0.05
    assert len(off) > 15_000
    assert abs(off.mean()) < 4 / math.sqrt(len(off))
    assert off.std() == pytest.approx(1.0, abs=4 / math.sqrt(2 * len(off)))
    assert (np.abs(off) > 1.96).mean() == pytest.approx(0.05, abs=0.01)


@pytest.mark.slow
def test_bytes_do_not_depend_on_order_or_threads(mini):
    scene = build_scene(mini, "effects.dropout.share=0.2", "effects.divergence.sub_beams=7")
    scanner, random = Scanner(scene, full_sweep=True), np.random.default_rng(1)
    frames = [random_frame(random, (20.0, 0.0, 0.0), number=n) for n in range(4)]

    def digest(job):
        site, frame = job
        simulator = CloudSimulator.of_site(scene, site, scanner)
        cloud = simulator.sweep(frame, sweep_rng(7, site.name, frame.number))
        return cloud.sweep.points.tobytes() + cloud.sweep.beam.tobytes() + cloud.owner.tobytes()

    jobs = [(site, frame) for site in scene.sites for frame in frames]
    once = [digest(job) for job in jobs]
    assert len(set(once)) == len(jobs)
    assert [digest(job) for job in reversed(jobs)][::-1] == once
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(digest, jobs)) == once
    shared = CloudSimulator.of_site(scene, scene.sites[0], scanner)
    with ThreadPoolExecutor(4) as pool:
        clouds = list(pool.map(lambda f: shared.sweep(f, sweep_rng(7, scene.sites[0].name, f.number)), frames))
    assert [c.sweep.points.tobytes() + c.sweep.beam.tobytes() + c.owner.tobytes() for c in clouds] == once[:4]


def test_full_sweep_contains_scan_of_region(mini):
    scene = build_scene(mini)
    for site in scene.sites:
        sensor = scene.sensor(site.sensor)
        few, all_ = Scanner(scene).scan_site(site).rows, Scanner(scene, full_sweep=True).scan_site(site).rows
        np.testing.assert_array_equal(all_.beam, np.arange(sensor.beams))
        assert len(few.beam) < sensor.beams
        np.testing.assert_array_equal(all_.ends_m[few.beam], few.ends_m)
        np.testing.assert_array_equal(all_.returned[few.beam], few.returned)


def test_rejects_measured_scan(mini):
    scene = build_scene(mini)
    with pytest.raises(
        InputError, match=r"site pole_a: its empty scan was measured \(scan\.pcd\).* Use a site without"
    ):
        CloudSimulator.of_site(scene, replace(scene.sites[0], points="scan.pcd"))


def test_intensity_of_surface_that_is_hit(mini):
    """Reflectivity times the cosine between beam and normal, worked out triangle by triangle in metres."""
    scene, pose, sensor = build_scene(mini), POSES["tilted"], make_sensor(**SENSORS["rings"])
    frame = random_frame(np.random.default_rng(8), np.array(pose.position_m) * (1, 1, 0), spread_m=12.0)
    hits = CloudSimulator(scene, pose, sensor, "here").first_hits(frame)
    on = np.flatnonzero(hits.owner >= 0)
    beams, (corners, _) = sensor.directions(*pose.angles_deg)[on], body_triangles(frame, pose.position_m)
    _, triangle = cast.first_hits(np.zeros(3), beams, corners, edge_m=1e-9)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[triangle]
    cosine = np.abs((normals * beams).sum(axis=1)) / np.linalg.norm(normals, axis=1)
    kinds = [cloud_simulation.body_kind(k, b[3:6].tolist()) for k, b in zip(frame.kinds, frame.boxes, strict=True)]
    surface = [
        part.surface for kind in kinds for part in cloud_simulation.builtin_bodies()[kind] for _ in part.triangles
    ]
    share = np.array([cloud_simulation.REFLECTIVITY[surface[t]] for t in triangle])
    assert len(on) > 100 and len(set(share)) > 2
    np.testing.assert_allclose(hits.intensity[on], share * cosine, rtol=0, atol=1e-9)


@pytest.mark.parametrize("inside_out", [False, True])
def test_user_mesh_is_hit_from_both_sides(mini, inside_out):
    """A user's sphere with triangles facing either way, scaled to a radius of 2 m: ranges by hand."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    if inside_out:
        ball.invert()
    ball.export(mini / "ball.ply")
    scene = build_scene(mini, 'validation.bodies.bus="ball.ply"')
    sensor = make_sensor(elevations_deg=[-2, 2], channels=5, azimuth_deg=[-2, 2], azimuth_step_deg=1.0)
    simulator = CloudSimulator(scene, Pose(10.0, -8.0, 3.0), sensor, "here")
    hits = simulator.first_hits(frame_of([(19.0, -8.0, 3.0, 4.0, 4.0, 4.0, 0.0, 0.0)], ["bus"]))
    along = 9.0 * sensor.directions()[:, 0]
    assert (hits.owner == 0).all()
    np.testing.assert_allclose(hits.range_m, along - np.sqrt(along**2 - 81.0 + 4.0), atol=0.02)
