"""The whole fit: sensors of the catalogue, coverage of the intervals, and a real sweep beside a freeway.

Evidence: simulated sweeps, whose sensors, noise and losses are known; for the real sweep, values that other programs
found in it (elevations by ALICE-LRI, second differences and return shares by a few lines of NumPy).
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.sensor_fit import SENSORS, angle_errors, fit_list, hard_truth, interval_hits
from benchmarks.simulated_sweeps import Truth, simulate_sweep

from egvs.core.errors import InputError
from egvs.extensions.hardware.fit.beam_angles import fit_beam_angles
from egvs.extensions.hardware.fit.calibration import read_calibrated_pose
from egvs.extensions.hardware.fit.empty_scan import TRAFFIC
from egvs.extensions.hardware.fit.fit import SensorFit, fit_sensor
from egvs.formats.sweep_files import Sweep, read_sweeps
from egvs.sensors.sensor import CATALOGUE
from egvs.statistics.intervals import Estimate
from tests.extensions.hardware.fit.small_sensor import (
    OUSTER_AXIS_M,
    OUSTER_ELEVATIONS_DEG,
    OUSTER_FRAME_M,
    ouster_sweep,
)

REAL = Path(__file__).parents[5] / "shared" / "real"
CHENGDU, TUMTRAF = REAL / "chengdu", REAL / "tumtraf"


@pytest.mark.slow
@pytest.mark.parametrize("name", SENSORS)
def test_sensors_of_the_catalogue(name: str) -> None:
    """Lists of returns in random order: elevations to 0.01 degrees, offsets to a millimetre, and the pose."""
    sensor = CATALOGUE[name]
    rng = np.random.default_rng(1)
    truth = hard_truth(sensor)
    fit = fit_list(simulate_sweep(sensor, truth, rng), rng)
    errors = angle_errors(sensor, truth, fit)
    assert errors.elevation_deg < 0.01
    assert errors.azimuth_deg < 0.01
    assert errors.offset_mm < 1.0
    assert abs(errors.height_m) < 0.01
    assert abs(errors.tilt_deg) < 0.02


@pytest.mark.slow
@pytest.mark.nightly
def test_intervals_contain_the_true_values() -> None:
    """40 trials; ``python -m benchmarks.sensor_fit intervals`` makes 200."""
    hits = interval_hits(40, seed=7)
    assert np.mean(hits["range noise, 5 to 25 m"]) >= 0.85
    assert np.mean(hits["return rate, smooth surfaces"]) >= 0.85
    for what in ("range noise, by range", "range noise, by channel", "return rate, by range and incidence"):
        assert np.mean(hits[what]) >= 0.91


@pytest.mark.slow
def test_beams_off_the_axis() -> None:
    """A twin of an Ouster on a gantry: all beams, both offsets, and the height over the ground."""
    points, channel = ouster_sweep()
    returned = np.isfinite(points[:, 0])
    fit = fit_sensor([Sweep("twin", points[returned], ring=channel[returned])])
    angles = fit.angles
    assert angles.channels == 40
    assert np.abs(angles.elevation_deg - OUSTER_ELEVATIONS_DEG).max() < 0.002
    assert angles.axis_distance_m == pytest.approx(OUSTER_AXIS_M, abs=2e-4)
    assert np.abs(angles.origins_m()[..., 2] - OUSTER_FRAME_M).max() < 5e-4
    assert (angles.azimuths, angles.direction) == (512, 1)
    assert (fit.grids[0].off_grid, fit.grids[0].repeated) == (0, 0)
    truth = Truth()
    # The plane is below the origin of the frame, 36 mm below the optics.
    assert fit.plane.height_m == pytest.approx(truth.height_m - OUSTER_FRAME_M, abs=0.02)
    assert fit.plane.roll_deg == pytest.approx(truth.roll_deg, abs=0.1)
    assert fit.plane.pitch_deg == pytest.approx(truth.pitch_deg, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("instant", ["1646667310_053239541", "1646667315_454719936"])
def test_tumtraf_sweeps(instant: str) -> None:
    """An installed OS1-64, below horizon: its beams, the road under labelled cars, and its calibrated pose.

    People put the boxes of cars onto the road, so their bottoms say where the road is: 8.2 m below the sensor. The
    calibration puts the sensor 7.48 m above the origin of a map, which is 0.7 m above the road.
    """
    if not TUMTRAF.is_dir():
        pytest.skip("shared/real/tumtraf is not beside the checkout")
    name = f"{instant}_s110_lidar_ouster_south"
    (sweep,) = read_sweeps([TUMTRAF / f"{name}.pcd.gz"])
    fit = fit_sensor([sweep])
    angles = fit.angles
    assert (angles.channels, angles.azimuths, angles.direction, fit.has_file_rings) == (64, 2048, -1, True)
    # The maker states angles to 0.01 degrees, and 15.806 mm and 36.18 mm for this model.
    assert np.abs(angles.elevation_deg - np.round(angles.elevation_deg, 2)).max() < 1e-3
    assert angles.axis_distance_m == pytest.approx(0.015806, abs=5e-5)
    assert angles.origins_m()[..., 2].mean() == pytest.approx(0.03618, abs=5e-5)
    assert fit.grids[0].off_grid == 0
    # Without the field, the same rings are found from the points.
    found, layout = fit_beam_angles([replace(sweep, ring=None)])
    assert (layout.has_file_rings, found.channels) == (False, 64)
    assert np.abs(np.sort(found.elevation_deg) - np.sort(angles.elevation_deg)).max() < 1e-3

    document = json.loads((TUMTRAF / f"{name}.json").read_text(encoding="utf-8"))
    (frame,) = document["openlabel"]["frames"].values()
    boxes = [item["object_data"] for item in frame["objects"].values() if item["object_data"]["type"] == "CAR"]
    centres = np.array([box["cuboid"]["val"] for box in boxes])
    bottoms = centres[:, :3] - centres[:, 9:] * (0.0, 0.0, 0.5)
    near = np.hypot(bottoms[:, 0], bottoms[:, 1]) < 40.0
    assert np.count_nonzero(near) >= 5
    assert np.abs(np.median(fit.plane.distance_m(bottoms[near]))) < 0.15

    calibrated = read_calibrated_pose(TUMTRAF / "calib_s110_lidar_ouster_south.json", fit.plane)
    assert (calibrated.frame, calibrated.pose.z_m) == ("s110_base", 7.48077521)
    assert calibrated.ground_z_m == pytest.approx(-0.77, abs=0.05)
    assert calibrated.ground_tilt_deg < 1.0


@pytest.fixture(scope="module")
def chengdu() -> SensorFit:
    """The sweep of a real 80-beam LiDAR beside a freeway, and ten float16 sweeps of it."""
    if not CHENGDU.is_dir():
        pytest.skip("shared/real/chengdu is not beside the checkout")
    return fit_sensor(read_sweeps([CHENGDU / "sweep.pcd.gz", CHENGDU / "frames.npz"]))


@pytest.mark.slow
def test_chengdu_angles(chengdu: SensorFit) -> None:
    """Beams on multiples of 0.01 degrees, as the maker states them; -24.9 without the offset."""
    angles = chengdu.angles
    assert (chengdu.layout, angles.channels, angles.azimuths, angles.direction) == ("channel fastest", 80, 1800, -1)
    steepest = int(np.argmin(angles.elevation_deg))
    assert angles.elevation_deg[steepest] == pytest.approx(-25.0, abs=0.005)
    assert angles.offset_m[steepest] == pytest.approx(0.015, abs=0.003)
    assert np.abs(angles.elevation_deg - np.round(angles.elevation_deg, 2)).max() < 0.002
    assert chengdu.range_step_m == pytest.approx(0.005, abs=1e-6)
    assert np.ptp(np.mod(angles.azimuth_offset_deg, 360.0)) == pytest.approx(13.5, abs=2.0)
    assert chengdu.max_range_m == pytest.approx(229.9, abs=0.1)
    (start_deg, end_deg) = max(chengdu.empty_sectors_deg, key=lambda sector: sector[1] - sector[0])
    assert end_deg - start_deg == pytest.approx(54.0, abs=5.0)


@pytest.mark.slow
def test_chengdu_noise_and_returns(chengdu: SensorFit) -> None:
    assert chengdu.sigma_m is not None
    assert chengdu.sigma_m.value == pytest.approx(0.006, abs=0.001)
    on_road = {noise.from_m: noise.sigma_m.value for noise in chengdu.noise_on_road}
    assert on_road[25.0] == pytest.approx(0.010, abs=0.003)
    assert on_road[40.0] == pytest.approx(0.03, abs=0.015)
    towards: dict[float, Estimate] = {rate.from_m: rate.rate for rate in chengdu.rates_towards_road}
    assert all(0.93 <= towards[start].value <= 1.0 for start in (10, 15, 20, 25, 30, 35, 40, 45))
    assert 0.5 < towards[50].value < 0.8
    assert 0.4 < towards[55].value < 0.7
    road = {rate.from_m: rate.rate.value for rate in chengdu.road_rates}
    assert min(road[start] for start in (10, 20, 30, 35)) > 0.99
    assert road[60] < 0.4


@pytest.mark.slow
def test_chengdu_ground_and_traffic(chengdu: SensorFit) -> None:
    plane = chengdu.plane
    assert plane.height_m == pytest.approx(3.7, abs=0.1)
    assert 0.2 < np.hypot(plane.roll_deg, plane.pitch_deg) < 0.8
    assert any(6.0 < other.height_m < 8.0 for other in chengdu.planes[1:])
    assert chengdu.empty_scan is not None
    labels = chengdu.empty_scan.labels
    heights = [chengdu.plane_view.height_m(grid.range_m) for grid in chengdu.grids]
    near_road = chengdu.plane_view.on_road & (chengdu.plane_view.range_m < 45.0)
    above = np.concatenate([height[near_road & (labels[i] == TRAFFIC)] for i, height in enumerate(heights)])
    above = above[np.isfinite(above)]
    assert len(above) > 1000
    assert np.mean((above > 0.2) & (above < 4.5)) > 0.9  # vehicles stand on the road


@pytest.mark.slow
@pytest.mark.parametrize(("has_ground", "hint"), [(True, "it was probably levelled"), (False, "neither levelled nor")])
def test_azimuths_without_a_step_may_be_those_of_a_levelled_sweep(has_ground: bool, hint: str) -> None:
    """Rings at random azimuths, over exactly level ground or within a round wall."""
    rng = np.random.default_rng(0)
    elevation = np.radians(np.repeat(np.linspace(-20.0, -5.0, 12), 400))
    azimuth = rng.uniform(-np.pi, np.pi, len(elevation))
    radius_m = 4.0 / np.tan(-elevation) if has_ground else np.full(len(elevation), 10.0)
    x, y = radius_m * np.cos(azimuth), radius_m * np.sin(azimuth)
    points_m = np.column_stack([x, y, radius_m * np.tan(elevation)])
    with pytest.raises(InputError, match=f"have no common step.*{hint}"):
        fit_sensor([Sweep("sweep", points_m)])
