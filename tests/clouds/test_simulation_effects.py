"""Effects act on clouds: dice with the chances that they give the score, and one weighted row of each beam."""

import json
import math

import numpy as np
import pytest

from egvs.clouds.simulation import CloudSimulator, sweep_rng
from egvs.effects.base import Detect
from egvs.effects.returns import ReturnProbability
from egvs.scoring.targets import TargetRecord, visible_targets
from egvs.scoring.visibility import Beams
from egvs.sensors.return_model import ReturnModel
from egvs.sensors.scanner import Scanner
from egvs.sensors.sites import Pose
from tests.clouds.cloud_scenes import build_scene, frame_of, make_sensor, random_frame, use_boxes_for
from tests.conftest import BUILDING, collection, feature

FINE = {"elevations_deg": [-40, -2], "channels": 40, "azimuth_step_deg": 1.0}
POSE = Pose(10.0, 12.0, 5.0)
SWEEPS = 20


@pytest.mark.parametrize(
    "settings",
    [
        ["effects.dropout.share=0.3"],
        ["effects.rain.rate_mm_h=200"],
        ["effects.fog.visibility_m=60", "effects.dropout.share=0.1"],
    ],
    ids=lambda settings: settings[0].split(".")[1],
)
def test_lost_returns_have_probability_of_score(mini, settings):
    scene, sensor = build_scene(mini, *settings), make_sensor(**FINE)
    simulator = CloudSimulator(scene, POSE, sensor, "here")
    frame = random_frame(np.random.default_rng(2), (20.0, 5.0, 0.0))
    hits = simulator.first_hits(frame)
    met = np.flatnonzero(np.isfinite(hits.range_m))
    chance = np.prod([e.detect(hits.range_m[met], sensor) for e in scene.acting(Detect)], axis=0)
    detected = np.zeros(len(hits.range_m))
    for number in range(SWEEPS):
        detected[simulator.sweep(frame, sweep_rng(1, "here", number)).sweep.beam] += 1
    assert detected[np.isinf(hits.range_m)].sum() == 0
    near = hits.range_m[met] < np.median(hits.range_m[met])
    for some in (near, ~near):
        spread = math.sqrt(SWEEPS * (chance * (1 - chance))[some].sum())
        assert abs(detected[met[some]].sum() - SWEEPS * chance[some].sum()) < 4 * spread


def test_scenario_sets_the_losses_of_road_users_only(mini):
    """A reflectivity or an incidence of road users leaves the returns from the static world as they are, one by one."""
    frame = random_frame(np.random.default_rng(2), (20.0, 5.0, 0.0))
    static, moving = [], []
    for more in ("", ", reflectivity=0.001", ", incidence_deg=85", ", reflectivity=3"):
        scene = build_scene(mini, f"effects.range_limit={{rated_range_m=40, rated_reflectivity=0.1{more}}}")
        simulator = CloudSimulator(scene, POSE, make_sensor(**FINE), "here")
        on_body = simulator.first_hits(frame).owner >= 0
        beam = simulator.sweep(frame, sweep_rng(1, "here", 0)).sweep.beam
        static.append(beam[~on_body[beam]].tolist())
        moving.append(int(on_body[beam].sum()))
    assert static[0] == static[1] == static[2] == static[3] and len(static[0]) > 100
    assert moving[1] < moving[2] < moving[0] < moving[3]


def test_dropout_of_all_returns(mini):
    simulator = CloudSimulator(build_scene(mini, "effects.dropout.share=1"), POSE, make_sensor(**FINE), "here")
    assert len(simulator.sweep(frame_of([]), sweep_rng(1, "here", 0)).sweep.points) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [["effects.divergence.sub_beams=19"], ["effects.mount_sway.tilt_deg=1", "effects.mount_sway.samples=9"]],
    ids=lambda settings: settings[0].split(".")[1],
)
def test_draws_one_row_per_beam_by_weight(mini, settings):
    scene, sensor = build_scene(mini, *settings), make_sensor(**FINE)
    simulator = CloudSimulator(scene, POSE, sensor, "here")
    weight = simulator._scanner.scan(POSE, sensor).rows.weight
    drawn = np.zeros(len(weight))
    random = sweep_rng(1, "here", 0)
    for _ in range(60):
        rows = simulator._draw_rows(simulator._cumulated_weight, random)
        np.testing.assert_array_equal(simulator._beam[rows], np.arange(sensor.beams))
        drawn[rows] += 1
    of_rank = np.arange(len(weight)) % (len(weight) // sensor.beams)
    share = np.bincount(of_rank, drawn) / drawn.sum()
    np.testing.assert_allclose(share, np.bincount(of_rank, weight) / sensor.beams, atol=0.005)


def test_weighted_beam_returns_once_along_nominal_direction(mini):
    sensor = make_sensor(**FINE)
    frame = random_frame(np.random.default_rng(2), (20.0, 5.0, 0.0))
    simulator = CloudSimulator(build_scene(mini, "effects.mount_sway.tilt_deg=2"), POSE, sensor, "here")
    cloud = simulator.sweep(frame, sweep_rng(1, "here", 0)).sweep
    assert (np.diff(cloud.beam.astype(int)) > 0).all() and len(cloud.beam) > 1000
    far = np.sqrt((cloud.points[:, :3].astype(np.float64) ** 2).sum(axis=1))
    np.testing.assert_allclose(cloud.points[:, :3], far[:, None] * sensor.directions()[cloud.beam], atol=1e-4)
    plain = CloudSimulator(build_scene(mini), POSE, sensor, "here").first_hits(frame)
    assert (np.abs(far - plain.range_m[cloud.beam]) > 0.05).mean() > 0.3


def test_cumulated_weights_close_to_one_are_one(mini):
    from egvs.clouds.simulation import _cumulate_weights

    beam, weight = np.array([0, 0, 0, 2, 2, 3]), np.array([0.1, 0.2, 0.7, 0.25, 0.25, 1.0])
    np.testing.assert_allclose(_cumulate_weights(beam, weight), [0.1, 0.3, 1.0, 2.25, 2.5, 4.0], rtol=0, atol=1e-15)
    assert _cumulate_weights(beam, weight)[2] == 1.0


@pytest.mark.slow
def test_foliage_returns_some_beams_and_transmits_others(mini):
    tree = feature(
        {"type": "Polygon", "coordinates": [[[13, -12], [15, -12], [15, -4], [13, -4], [13, -12]]]},
        name="tree", kind="tree_crown", height_m=7, base_m=1,
    )  # fmt: skip
    house = feature({"type": "Polygon", "coordinates": BUILDING}, name="house", kind="building", height_m=6)
    (mini / "statics.geojson").write_text(collection(tree, house))
    scene = build_scene(mini, "effects.foliage.leaf_area_density=0.7")
    assert [effect.NAME for effect in scene.effects] == ["foliage"]
    sensor = make_sensor(elevations_deg=[-20, -5], channels=30, azimuth_deg=[-20, 20], azimuth_step_deg=0.5)
    simulator = CloudSimulator(scene, Pose(8.0, -8.0, 4.0), sensor, "here")
    frame = frame_of([(20.0, -8.0, 1.5, 8.0, 2.5, 3.0, 1.4, 0.0)], ["bus"])
    share = through = 0.0
    for number in range(SWEEPS):
        cloud = simulator.sweep(frame, sweep_rng(1, "here", number))
        x = cloud.sweep.points[:, 0] + 8.0
        leaves = (cloud.owner == -1) & (x > 13.0 - 1e-6) & (x < 15.0 + 1e-6) & (cloud.sweep.points[:, 2] > -3.0 + 1e-3)
        share += leaves.sum() / len(x) / SWEEPS
        through += cloud.points_on(1)[0] / SWEEPS
        assert set(np.round(cloud.sweep.points[leaves, 3], 6)) == {np.float32(0.3)}
    plain = CloudSimulator(build_scene(mini), Pose(8.0, -8.0, 4.0), sensor, "here")
    assert plain.sweep(frame, sweep_rng(1, "here", 0)).points_on(1)[0] < 0.2 * through
    assert 0.2 < share < 0.8
    assert json.dumps(scene.skipped("scan")) == "[]"


CAR = [(10.0, 17.0, 0.75, 4.5, 1.8, 1.5, 0.4, 0.0)]
NO_LOSSES = "grazing_loss=0, dark_share=0, glass_loss=0"


def sweep_with(mini, *settings, number=0, noise_m=0.0):
    """A labelled sweep of a car, and its simulator."""
    sensor = make_sensor(**FINE, range_sigma_m=noise_m)
    simulator = CloudSimulator(build_scene(mini, *settings), POSE, sensor, "here")
    return simulator.sweep(frame_of(CAR), sweep_rng(1, "here", number)), simulator


@pytest.mark.parametrize("setting", [f"surface_losses={{{NO_LOSSES}}}", "range_noise={footprint_mrad=0}"])
def test_echo_effects_without_losses_change_no_byte(mini, setting):
    plain, _ = sweep_with(mini, noise_m=0.03)
    result, _ = sweep_with(mini, f"effects.{setting}", noise_m=0.03)
    assert result.sweep.points.tobytes() == plain.sweep.points.tobytes()
    assert result.sweep.beam.tobytes() == plain.sweep.beam.tobytes()


def test_dark_vehicles_lose_all_returns_and_the_ground_none(mini):
    plain, _ = sweep_with(mini)
    dark, _ = sweep_with(mini, "effects.surface_losses={grazing_loss=0, dark_share=1, dark_loss=1, glass_loss=0}")
    assert plain.points_on(1)[0] > 20 and dark.points_on(1)[0] == 0
    np.testing.assert_array_equal(dark.sweep.beam, plain.sweep.beam[plain.owner < 0])


def test_opaque_to_lidar_windows_leave_only_paint_and_tyres(mini):
    """Intensity is reflectivity times cosine: windows (10 %) give at most 0.1."""
    plain, simulator = sweep_with(mini)
    lost, _ = sweep_with(mini, "effects.surface_losses={grazing_loss=0, dark_share=0, glass_loss=1}")
    surfaces = simulator._bodies.surfaces[simulator.first_hits(frame_of(CAR)).triangle]
    on_car = plain.sweep.beam[plain.owner == 0]
    is_glass = surfaces[on_car] == "glass"
    assert is_glass.sum() > 3
    assert (plain.sweep.points[plain.owner == 0][is_glass, 3] <= 0.1 + 1e-6).all()
    np.testing.assert_array_equal(lost.sweep.beam[lost.owner == 0], on_car[~is_glass])
    assert (lost.owner < 0).sum() == (plain.owner < 0).sum()


def test_grazing_loss_on_flat_ground_has_its_probability(mini):
    """From 5 m, a beam at elevation e meets the ground at an incidence of 90 - e degrees."""
    setting = (
        "effects.surface_losses={grazing_deg=80, grazing_width_deg=3, grazing_loss=0.8, dark_share=0, glass_loss=0}"
    )
    simulator = sweep_with(mini)[1]
    echoes = simulator._echoes(simulator._beam, simulator.first_hits(frame_of([])), frame_of([]))
    on_ground = np.abs(echoes.range_m * echoes.cosine - 5.0) < 1e-6
    assert on_ground.sum() > 2000
    chance = 1 - 0.8 / (1 + np.exp(-(np.degrees(np.arccos(echoes.cosine[on_ground])) - 80) / 3))
    kept = np.zeros(len(on_ground))
    other = CloudSimulator(build_scene(mini, setting), POSE, make_sensor(**FINE), "here")
    for number in range(SWEEPS):
        kept[other.sweep(frame_of([]), sweep_rng(1, "here", number)).sweep.beam] += 1
    spread = math.sqrt(SWEEPS * (chance * (1 - chance)).sum())
    assert abs(kept[on_ground].sum() - SWEEPS * chance.sum()) < 4 * spread


def test_range_noise_adds_to_the_noise_of_the_sensor(mini):
    """On flat ground: variances of the sensor (2 cm) and of the footprint add."""
    simulator = sweep_with(mini, "effects.range_noise={footprint_mrad=1, max_sigma_m=9}", noise_m=0.02)[1]
    hits = simulator.first_hits(frame_of([]))
    echoes = simulator._echoes(simulator._beam, hits, frame_of([]))
    sine = np.sqrt(1 - echoes.cosine**2)
    expected = np.hypot(0.02, 1e-3 * echoes.range_m * sine / np.maximum(echoes.cosine, 1e-9))
    scaled = []
    for number in range(3):
        cloud = simulator.sweep(frame_of([]), sweep_rng(1, "here", number)).sweep
        range_m = np.sqrt((cloud.points[:, :3].astype(np.float64) ** 2).sum(axis=1))
        scaled.append((range_m - hits.range_m[cloud.beam]) / expected[cloud.beam])
    scaled = np.concatenate(scaled)
    assert abs(scaled.std() - 1.0) < 4 / math.sqrt(2 * len(scaled))
    assert abs(scaled.mean()) < 4 / math.sqrt(len(scaled))


def test_vehicle_draws_are_even_and_fixed_by_name_and_seed():
    from egvs.clouds.simulation import vehicle_draws

    names = [f"car.{number}" for number in range(2000)]
    draws = vehicle_draws(names, 1)
    assert draws[7] == vehicle_draws([names[7]], 1)[0] != vehicle_draws([names[7]], 2)[0]
    assert abs((draws < 0.12).mean() - 0.12) < 4 * math.sqrt(0.12 * 0.88 / 2000)


@pytest.mark.slow
def test_points_on_vehicles_are_those_that_scores_expect(mini):
    """Windows return less and the rest of a body more than the formula of scores; the sum is the same."""
    rated = ("effects.range_limit={rated_range_m=40, rated_reflectivity=0.1}",)
    scene, sensor = build_scene(mini, *rated), make_sensor(**{**FINE, "azimuth_step_deg": 0.25})
    simulator = CloudSimulator(scene, POSE, sensor, "here")
    frame = random_frame(np.random.default_rng(2), (20.0, 5.0, 0.0))
    hits = simulator.first_hits(frame)
    model = ReturnModel(40.0, 0.1)
    on_body = hits.owner >= 0
    by_score = model.probability(hits.range_m[on_body])
    assert 0.2 < by_score.mean() < 0.9

    is_glass = simulator._bodies.surfaces[hits.triangle[on_body]] == "glass"
    kept = np.zeros(len(is_glass))
    draws = 60
    rows = np.flatnonzero(on_body)
    for number in range(draws):
        kept += np.isin(rows, simulator.sweep(frame, sweep_rng(1, "here", number)).sweep.beam)
    spread = math.sqrt(draws * (by_score * (1 - by_score)).sum())
    assert abs(kept.sum() - draws * by_score.sum()) < 4 * spread + 0.02 * draws * by_score.sum()
    assert kept[is_glass].sum() < draws * by_score[is_glass].sum() - 4 * math.sqrt(draws * is_glass.sum()) / 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "kind"),
    [
        (["effects.range_limit={rated_range_m=30}"], "pedestrian"),
        (["effects.range_limit={rated_range_m=30, reflectivity=0.05}", "effects.dropout.share=0.2"], "pedestrian"),
    ],
    ids=["by_class", "of_all"],
)
def test_mean_count_of_points_is_that_of_the_scores(mini, settings, kind):
    """Boxes as bodies, of a class without windows: over many sweeps, they have as many points as scores expect."""
    settings = [*settings, "effects.range_limit.rated_reflectivity=0.1", *use_boxes_for(mini, "pedestrian", "sedan")]
    scene, sensor = build_scene(mini, *settings), make_sensor(**FINE)
    rows = [(x, y, 0.8, 4.4, 1.8, 1.5, yaw, 0.0) for x, y, yaw in ((14, 4, 0.3), (22, 6, 1.2), (19, -4, 2.0))]
    frame = frame_of(rows, [kind] * len(rows))
    record = TargetRecord.of([frame], scene.scenario.roi.grid, {"pedestrian"})
    assert len(record) == len(rows)
    beams = Beams.of(Scanner(scene).scan(POSE, sensor))
    expected = visible_targets(record, beams, ReturnProbability.of(scene, sensor)).points
    met = visible_targets(record, beams).points
    assert (expected < 0.9 * met).all() and (expected > 5.0).all()

    simulator = CloudSimulator(scene, POSE, sensor, "here")
    counts = np.zeros(len(rows))
    sweeps = 200
    for number in range(sweeps):
        counts += simulator.sweep(frame, sweep_rng(3, "here", number)).points_on(len(rows))
    standard_error = np.sqrt(expected / sweeps)
    assert (np.abs(counts / sweeps - expected) < 4 * standard_error).all()
