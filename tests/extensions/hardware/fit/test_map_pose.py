"""Yaw and position of a sensor from its sweep and the static world of a scenario.

Evidence: simulated sweeps in a yard of known pose; rooms with equal walls; heights of triangles computed by hand.
"""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.simulated_sweeps import WALL_DISTANCES_M, Truth

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.hardware.fit import figures
from egvs.extensions.hardware.fit.fit import fit_sensor
from egvs.extensions.hardware.fit.map_pose import MapPose, fit_map_pose, lowest_surface_m
from egvs.formats import ply
from egvs.formats.sweep_files import Sweep
from egvs.sensors.ground_plane import GroundPlane
from egvs.sensors.sites import Pose
from tests.conftest import collection, feature, write_mini
from tests.extensions.hardware.fit.small_sensor import coarse_sensor, small_fit, sweep_of
from tests.sensors.yard import YARD_POSE, YARD_TRUTH, mesh_of, room, room_scan, yard, yard_scan


def plane(pose: Pose) -> GroundPlane:
    """The ground below a sensor over z = 0."""
    up = np.array([0.0, 0.0, 1.0])
    return GroundPlane(up, pose.z_m, pose.roll_deg, pose.pitch_deg, 0, 0, 0, 100, 1, 0, (0, 1), (0, 1))


def fit(points_m: FloatArray, world: Any, truth: Pose, off_m: tuple[float, float] = (0.0, 0.0)) -> MapPose:
    return fit_map_pose(points_m, plane(truth), world, (truth.x_m + off_m[0], truth.y_m + off_m[1]))


@pytest.mark.slow
@pytest.mark.parametrize("yaw_deg", [-171.3, 33.0])
def test_recovers_yaw(yaw_deg: float) -> None:
    """To 0.1 degrees, from a position that is 1.3 m off; the whole chain from the fitted ground plane."""
    truth = replace(YARD_POSE, yaw_deg=yaw_deg)
    sweep = sweep_of(YARD_TRUTH, coarse_sensor())
    ground = fit_sensor([Sweep("one", sweep)]).plane
    points = sweep[np.isfinite(sweep[:, 0])]
    result = fit_map_pose(points, ground, yard(truth), (truth.x_m + 1.0, truth.y_m - 0.8))
    pose, errors = result.best.pose, result.best.standard_errors
    assert pose.yaw_deg == pytest.approx(yaw_deg, abs=0.1)
    assert abs(pose.yaw_deg - yaw_deg) < 4 * errors["yaw_deg"] < 0.1
    assert pose.x_m == pytest.approx(truth.x_m, abs=0.02)
    assert pose.y_m == pytest.approx(truth.y_m, abs=0.02)
    assert result.shift_m == pytest.approx(np.hypot(1.0, 0.8), abs=0.02)
    assert abs(result.residual_m) < 4 * result.residual_se_m < 0.01
    assert result.warnings == ()


@pytest.mark.slow
def test_equal_walls_are_ambiguous() -> None:
    truth = Pose(3.0, -2.0, 4.0, 20.0)
    square = ((-9.0, 15.0), (-14.0, 10.0))  # 12 m to each side
    result = fit(room_scan(truth, *square), room(*square), truth, (0.4, 0.3))
    yaws = sorted(yaw % 360.0 for yaw in (result.best.pose.yaw_deg, *result.ambiguous_yaws_deg))
    assert yaws == pytest.approx([20.0, 110.0, 200.0, 290.0], abs=0.1)
    (message,) = result.warnings
    assert message.startswith("Ambiguous: the sweep fits as well at a yaw of ")


@pytest.mark.slow
def test_ground_alone_fixes_no_yaw() -> None:
    truth = Pose(0.0, 0.0, 4.0, 20.0)
    endless = (-np.inf, np.inf)
    result = fit(room_scan(truth, endless, endless), room(endless, endless), truth)
    assert result.warnings[0] == "No surface of the static world fixes the yaw."
    assert result.best.standard_errors["yaw_deg"] == np.inf


@pytest.mark.slow
def test_says_that_corridor_has_no_end() -> None:
    truth = Pose(0.0, 0.0, 4.0, 20.0)
    walls = ((-np.inf, np.inf), (-8.0, 5.0))
    result = fit(room_scan(truth, *walls), room(*walls), truth)
    assert "No surface of the static world fixes x, which kept the start value." in result.warnings


@pytest.mark.slow
def test_returns_elsewhere_are_counted() -> None:
    points = yard_scan(coarse_sensor())
    ahead = np.abs(np.degrees(np.arctan2(points[:, 1], points[:, 0]))) < 60.0
    points[ahead] *= np.random.default_rng(0).uniform(0.3, 0.7, (np.count_nonzero(ahead), 1))
    result = fit(points, yard(), YARD_POSE)
    assert result.share_on_surface == pytest.approx(1 - ahead.mean(), abs=0.05)
    assert result.best.pose.yaw_deg == pytest.approx(YARD_POSE.yaw_deg, abs=0.1)


def test_height_of_ground() -> None:
    """A slope z = x / 10, a roof above it, and a cellar below; the ground counts where there is one."""
    square = ((-10, -10), (10, -10), (10, 10), (-10, 10))
    slope, roof, cellar = (
        [np.array([x, y, z(x)]) for x, y in square] for z in (lambda x: x / 10, lambda x: 7.0, lambda x: -3.0)
    )
    assert lowest_surface_m(mesh_of([roof, slope, cellar], ["building", "ground", "building"]), 5.0, 2.0) == 0.5
    assert lowest_surface_m(mesh_of([roof, slope], ["building", "building"]), 5.0, 2.0) == 0.5
    with pytest.raises(InputError, match="--site: the static world has no ground at x = 11, y = 0"):
        lowest_surface_m(mesh_of([slope]), 11.0, 0.0)


@pytest.mark.slow
def test_figure_shows_other_yaws() -> None:
    truth = Pose(0.0, 0.0, 4.0, 20.0)
    square = ((-12.0, 12.0), (-12.0, 12.0))
    result = replace(small_fit(), map_pose=fit(room_scan(truth, *square), room(*square), truth))
    figure = figures.draw_map(result)
    assert figure is not None
    labels = [text.get_text() for axis in figure.axes for text in axis.get_legend().get_texts()]
    assert {"fits as well", "best fit", "walls of the static world"} <= set(labels)
    assert figures.draw_map(small_fit()) is None


# ---- the command


@pytest.fixture
def yard_scenario(tmp_path: Path) -> tuple[Path, Path]:
    """A sweep, and a scenario with four walls around a sensor at (20, 3) with a yaw of 40 degrees."""
    truth = Truth(sigma_m=0.02, lost=0.05, roll_deg=0.0, pitch_deg=0.0)
    ply.write(tmp_path / "sweep.ply", sweep_of(truth, coarse_sensor()))
    folder = write_mini(tmp_path / "yard")
    walls = []
    for number, distance_m in enumerate(WALL_DISTANCES_M):
        angle = np.radians(90.0 * number + 17.0 + 40.0)
        out, along = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        corners = [
            np.array([20.0, 3.0]) + out * (distance_m + depth) + along * side * 150.0
            for depth, side in ((0, -1), (1, -1), (1, 1), (0, 1), (0, -1))
        ]
        ring = [[float(x), float(y)] for x, y in corners]
        walls.append(feature({"type": "Polygon", "coordinates": [ring]}, name=f"wall{number}", height_m=29.0))
    (folder / "statics.geojson").write_text(collection(*walls), encoding="utf-8")
    return tmp_path / "sweep.ply", folder


@pytest.mark.slow
def test_command_fits_yaw(yard_scenario: tuple[Path, Path], tmp_path: Path, run_egvs: Any) -> None:
    sweep, scenario = yard_scenario
    out = tmp_path / "made"
    arguments = ("sensor", "fit", sweep, "--name", "mast", "--out", out, "--scenario", scenario, "--site", "19.2,3.9")
    code, printed, error = run_egvs(*arguments)
    assert code == 0, error
    assert "pose in the world of yard: yaw " in printed
    assert "map.png that the returns lie on the walls" in printed
    pose = json.loads((out / "fit.json").read_text(encoding="utf-8"))["map_pose"]
    assert pose["yaw_deg"]["value"] == pytest.approx(40.0, abs=0.1)
    assert pose["yaw_deg"]["se"] < 0.03
    assert (pose["x_m"]["value"], pose["y_m"]["value"]) == pytest.approx((20.0, 3.0), abs=0.03)
    assert pose["z_m"]["value"] == pytest.approx(4.0, abs=0.02)
    assert pose["warnings"] == []
    assert (out / "map.png").stat().st_size > 10_000
    assert "# Pose in the world of yard: x " in (out / "sensor.toml").read_text(encoding="utf-8")


@pytest.mark.slow
def test_command_fits_a_sensor_that_is_upside_down(tmp_path: Path, run_egvs: Any) -> None:
    """Its sweep is that of an upright one, turned by 180 degrees about x: only the roll differs by these."""
    truth = Truth(sigma_m=0.02, roll_deg=1.5, pitch_deg=-4.0)
    ply.write(tmp_path / "sweep.ply", sweep_of(truth, coarse_sensor()) * (1.0, -1.0, -1.0))
    arguments = ("sensor", "fit", tmp_path / "sweep.ply", "--name", "mast", "--out", tmp_path / "made")
    code, _, error = run_egvs(*arguments)
    assert code == 2
    assert "expected a ground plane below the sensor, got none" in error and "with --mount inverted" in error
    code, printed, error = run_egvs(*arguments, "--mount", "inverted")
    assert code == 0, error
    assert "The sensor is upside down" in printed
    text = (tmp_path / "made" / "sensor.toml").read_text(encoding="utf-8")
    assert tomllib.loads(text)["sensors"]["mast"]["mount"] == "inverted"
    (roll,) = re.findall(r"upside down, roll (\S+) from there", text)
    assert float(roll) == pytest.approx(1.5, abs=0.1)
    (plane, *_) = json.loads((tmp_path / "made" / "fit.json").read_text(encoding="utf-8"))["ground_planes"]
    assert plane["height_m"] == pytest.approx(truth.height_m, abs=0.02)
    assert (plane["roll_deg"], plane["pitch_deg"]) == pytest.approx((1.5 - 180.0, -4.0), abs=0.1)
    assert plane["normal"][2] < -0.99


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--site", "1,2"), "--site: expected --scenario as well"),
        (("--scenario", "yard"), "--scenario: expected --site as well"),
        (("--scenario", "yard", "--site", "1"), "--site: expected two or three coordinates in metres, got '1'"),
        (("--scenario", "yard", "--site", "1,b"), "--site: expected two or three coordinates"),
        (("--scenario", "yard", "--site", "nan,1"), "--site: expected two or three coordinates"),
        (("--scenario", "nowhere", "--site", "1,2"), "nowhere"),
        (("--scenario", "yard", "--site", "90000,3"), "--site: the static world has no ground"),
        (("--scenario", "yard", "--site", "20,3,900"), "fewer than 200 returns lie on the static world"),
    ],
)
def test_rejects_map_options(
    yard_scenario: tuple[Path, Path],
    tmp_path: Path,
    run_egvs: Any,
    monkeypatch: pytest.MonkeyPatch,
    options: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    code, _, error = run_egvs("sensor", "fit", "sweep.ply", "--name", "mast", "--out", "made", *options)
    assert code == 2, error
    assert message in error
    assert "Traceback" not in error
    assert not (tmp_path / "made").exists()
