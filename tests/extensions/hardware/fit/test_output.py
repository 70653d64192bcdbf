"""What is written: a table that a scenario reads, a report with standard errors, an upright empty scan, labels.

Evidence: the directions of the sensor that the table gives, against those that were simulated; files read back.
"""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.extensions.hardware.fit import output
from egvs.extensions.hardware.fit.empty_scan import TRAFFIC
from egvs.extensions.hardware.fit.fit import SensorFit, fit_sensor
from egvs.formats import point_clouds
from egvs.formats.sweep_files import Sweep
from egvs.scenario.sensor_config import SensorConfig
from egvs.sensors.sensor import resolve_sensor
from tests.extensions.hardware.fit.small_sensor import (
    ELEVATIONS_DEG,
    TRUTH,
    returns_of,
    small_fit,
    small_sensor,
    sweep_of,
)


def read_config(text: str, name: str) -> SensorConfig:
    """Read the table as a scenario does."""
    return SensorConfig.from_dict(tomllib.loads(text)["sensors"][name])


def test_sensor_has_the_simulated_beams() -> None:
    config = read_config(output.table_text(small_fit(), "north mast"), "north mast")
    fitted = resolve_sensor("north mast", {"north mast": config}, "test")
    order = np.argsort(ELEVATIONS_DEG)
    expected = small_sensor().directions().reshape(900, 10, 3)[:, order]
    angle = np.degrees(np.arccos(np.clip((fitted.directions().reshape(900, 10, 3) * expected).sum(axis=-1), -1, 1)))
    assert angle.max() < 0.002
    assert fitted.range_sigma_m == pytest.approx(TRUTH.sigma_m, rel=0.1)
    assert 50.0 < fitted.range_m <= 120.0


def test_field_of_view_is_written() -> None:
    sensor = small_sensor((-50.0, 70.0))
    fit = fit_sensor([Sweep("view", sweep_of(TRUTH, sensor))])
    config = read_config(output.table_text(fit, "view"), "view")
    fitted = resolve_sensor("view", {"view": config}, "test")
    order = np.argsort(ELEVATIONS_DEG)
    expected = sensor.directions().reshape(301, 10, 3)[:, order]
    angle = np.degrees(np.arccos(np.clip((fitted.directions().reshape(301, 10, 3) * expected).sum(axis=-1), -1, 1)))
    assert angle.max() < 0.002


@pytest.mark.slow
@pytest.mark.parametrize("view_deg", [(-50.0, 70.0), (130.0, 260.0), (-240.0, 30.0)])
def test_view_of_a_list_is_within_the_limits_of_its_key(view_deg: tuple[float, float]) -> None:
    points = sweep_of(TRUTH, small_sensor(view_deg))
    fit = fit_sensor([Sweep("list", returns_of(points))])
    first_deg, last_deg = read_config(output.table_text(fit, "list"), "list").azimuth_deg or (0.0, 0.0)
    assert -360.0 <= first_deg < last_deg <= 360.0
    assert np.mod(first_deg - view_deg[0] + 180.0, 360.0) - 180.0 == pytest.approx(0.0, abs=3.0)
    assert last_deg - first_deg == pytest.approx(view_deg[1] - view_deg[0], abs=5.0)


def test_empty_sector_is_left_out() -> None:
    fit = replace(small_fit(), empty_sectors_deg=[(100.0, 130.0), (150.0, 210.0)])
    config = read_config(output.table_text(fit, "mast", without_empty_sector=True), "mast")
    assert config.azimuth_deg is not None
    first_deg, last_deg = config.azimuth_deg
    assert (first_deg, last_deg) == (-150.0, pytest.approx(150.0, abs=0.41))
    assert config.azimuths == 751


def test_no_empty_sector_to_leave_out(tmp_path: Path) -> None:
    fit = replace(small_fit(), empty_sectors_deg=[])
    with pytest.raises(InputError, match="no sector without returns"):
        output.write_fit(fit, "mast", tmp_path / "new", without_empty_sector=True)
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_report_has_standard_errors(tmp_path: Path) -> None:
    output.write_fit(small_fit(), "a", tmp_path)
    config = read_config((tmp_path / "sensor.toml").read_text(encoding="utf-8"), "a")
    assert config.rings == 10
    report = json.loads((tmp_path / "fit.json").read_text(encoding="utf-8"))
    elevations = [channel["elevation_deg"] for channel in report["channels"]]
    assert [value["value"] for value in elevations] == pytest.approx(sorted(ELEVATIONS_DEG), abs=1e-3)
    assert all(0 < value["se"] < 0.01 for value in elevations)
    assert report["range_step_m"] == pytest.approx(0.004, abs=1e-6)
    assert report["optics_to_axis_m"]["value"] == pytest.approx(0.03, abs=1e-4)
    assert report["ground_planes"][0]["height_m"] == pytest.approx(TRUTH.height_m, abs=0.01)
    assert report["return_rate_on_smooth_surfaces"]["low"] < 1 - TRUTH.lost
    assert "empty_scan" not in report
    for name in ("angles.png", "ranges.png", "ground.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "empty_scan.png").exists()


@pytest.fixture(scope="module")
def four_sweeps() -> SensorFit:
    """Four sweeps, with a box of 200 pulses, 5 m from the sensor, in the first one."""
    sweeps = [sweep_of(TRUTH, seed=seed).reshape(900, 10, 3) for seed in range(4)]
    box = sweeps[0][100:120]
    with np.errstate(invalid="ignore"):
        box *= 5.0 / np.linalg.norm(box, axis=-1, keepdims=True)
    return fit_sensor([Sweep(str(number), sweep.reshape(-1, 3)) for number, sweep in enumerate(sweeps)])


@pytest.mark.slow
def test_empty_scan_is_upright(tmp_path: Path, four_sweeps: SensorFit) -> None:
    written = output.write_fit(four_sweeps, "four", tmp_path)
    assert {"empty_scan.png", "empty_scan.pcd", "returns.ply"} <= set(written.names)
    points, _ = point_clouds.read_points(tmp_path / "empty_scan.pcd", "scan")
    lowest = points[points[:, 2] < 0.5]
    assert len(lowest) > 500
    assert np.median(lowest[:, 2]) == pytest.approx(0.0, abs=0.02)
    assert np.abs(np.polyfit(lowest[:, 0], lowest[:, 2], 1)[0]) < 2e-3


@pytest.mark.slow
def test_box_in_front_is_traffic(four_sweeps: SensorFit) -> None:
    assert four_sweeps.empty_scan is not None
    in_front = four_sweeps.empty_scan.labels == TRAFFIC
    returned = np.stack([np.isfinite(grid.range_m) for grid in four_sweeps.grids])
    on_box = np.zeros_like(returned)
    on_box[0, :, 100:120] = True
    # Of a pulse on the box, three others returned from the background with a probability of 0.95^3.
    assert 0.75 < in_front[returned & on_box].mean() <= 1.0
    assert not in_front[returned & ~on_box].any()


@pytest.mark.parametrize("name", ["", "a/b", "../x", "[x]", " x", "x\ny", "y" * 80])
def test_rejects_name(name: str) -> None:
    with pytest.raises(InputError, match="--name"):
        output.check_name(name)
