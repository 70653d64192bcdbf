"""Effects act on clouds: dice with the chances that they give the score, and one weighted row of each beam."""

import json
import math

import numpy as np
import pytest

from egvs.effects.base import Detect
from egvs.sensors.sites import Pose
from egvs.validation.cloud_simulation import CloudSimulator, sweep_rng
from tests.conftest import BUILDING, collection, feature
from tests.validation.cloud_scenes import build_scene, frame_of, make_sensor, random_frame

FINE = {"elevations_deg": [-40, -2], "channels": 40, "azimuth_step_deg": 1.0}
POSE = Pose(10.0, 12.0, 5.0)
SWEEPS = 20


@pytest.mark.parametrize(
    "settings",
    [
        ["effects.dropout.share=0.3"],
        ["effects.rain.rate_mm_h=200"],
        ["effects.fog.visibility_m=60", "effects.dropout.share=0.1"],
        ["effects.range_limit.reflectivity=0.05", "effects.range_limit.rated_range_m=60"],
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


def test_dropout_of_all_returns(mini):
    simulator = CloudSimulator(build_scene(mini, "effects.dropout.share=1"), POSE, make_sensor(**FINE), "here")
    assert len(simulator.sweep(frame_of([]), sweep_rng(1, "here", 0)).sweep.points) == 0


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
    from egvs.validation.cloud_simulation import _cumulate_weights

    beam, weight = np.array([0, 0, 0, 2, 2, 3]), np.array([0.1, 0.2, 0.7, 0.25, 0.25, 1.0])
    np.testing.assert_allclose(_cumulate_weights(beam, weight), [0.1, 0.3, 1.0, 2.25, 2.5, 4.0], rtol=0, atol=1e-15)
    assert _cumulate_weights(beam, weight)[2] == 1.0


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
