"""A scan is registered to the static world: pose, standard errors, what no surface fixes, and other yaws that fit.

Evidence: scans computed plane by plane at a known pose (``tests/sensors/yard.py``), with noise.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.extensions.hardware import registration
from egvs.extensions.hardware.registration import PARAMETERS, StaticSurfaces, register_scan, search_yaw
from egvs.sensors.sensor import CATALOGUE
from egvs.sensors.sites import Pose
from tests.extensions.hardware.fit.small_sensor import coarse_sensor
from tests.sensors.yard import YARD_POSE, mesh_of, room, room_scan, yard, yard_scan

START = Pose(12.6, -7.5, 4.3, 36.0, -0.5, 0.2)
SQUARE = ((-12.0, 12.0), (-12.0, 12.0))
ENDLESS = (-math.inf, math.inf)


def errors(pose: Pose, truth: Pose) -> np.ndarray:
    """Differences of all parameters, metres and degrees."""
    return np.array([getattr(pose, name) - getattr(truth, name) for name in PARAMETERS])


@pytest.mark.slow
def test_recovers_known_pose() -> None:
    fit = register_scan(yard_scan(CATALOGUE["VLP-16"]), StaticSurfaces(yard(), YARD_POSE.position_m), START)
    assert fit.converged and fit.not_fixed == ()
    assert np.abs(errors(fit.pose, YARD_POSE)[:3]).max() < 0.002
    assert np.abs(errors(fit.pose, YARD_POSE)[3:]).max() < 0.003
    assert fit.on_surface.mean() > 0.98
    assert 0.005 < fit.sigma_m < 0.02  # range noise of 2 cm, times the cosine of the incidence


@pytest.mark.slow
def test_standard_errors_match_scatter() -> None:
    surfaces = StaticSurfaces(yard(), YARD_POSE.position_m)
    scaled = []
    for seed in range(15):
        fit = register_scan(yard_scan(coarse_sensor(), seed), surfaces, START)
        scaled.append(errors(fit.pose, YARD_POSE) / list(fit.standard_errors.values()))
    scatter = np.sqrt(np.mean(np.square(scaled), axis=0))
    assert (scatter > 0.55).all() and (scatter < 1.55).all()  # 15 trials: 0.65 to 1.35 in 95 %


def test_ignores_vehicles_and_trees() -> None:
    """A third of the returns, in sectors, come from in front of the static world."""
    points = yard_scan(CATALOGUE["VLP-16"])
    sector = np.floor(np.degrees(np.arctan2(points[:, 1], points[:, 0])) / 20.0)
    in_front = sector % 3 == 0
    points[in_front] *= np.random.default_rng(0).uniform(0.3, 0.8, (np.count_nonzero(in_front), 1))
    fit = register_scan(points, StaticSurfaces(yard(), YARD_POSE.position_m), START)
    assert np.abs(errors(fit.pose, YARD_POSE)).max() < 0.01
    assert fit.on_surface[in_front].mean() < 0.05
    assert fit.on_surface[~in_front].mean() > 0.98


def test_derivatives_match_differences() -> None:
    pose = replace(YARD_POSE, pitch_deg=20.0, roll_deg=-35.0)
    points = room_scan(pose, (-20.0, 30.0), (-25.0, 12.0))[::7]
    surfaces = StaticSurfaces(room((-20.0, 30.0), (-25.0, 12.0)), pose.position_m)
    rows = np.ones(len(points), dtype=np.bool_)
    parameters = np.array([*pose.position_m, *pose.angles_deg])
    design = registration._design(surfaces.match(points, pose), rows, parameters)
    for column in range(6):
        moved = []
        for sign in (-1, 1):
            changed = parameters.copy()
            changed[column] += sign * 1e-5 * registration._UNITS[column]
            moved.append(surfaces.match(points, registration._pose(changed)).distance_m)
        numerical = (moved[1] - moved[0]) / 2e-5
        same_face = np.abs(numerical - design[:, column]) < 1e-3
        assert same_face.mean() > 0.98  # the others lie next to an edge


def test_position_along_corridor_is_not_fixed() -> None:
    truth = Pose(3.0, 1.0, 4.0, 20.0, -1.0, 0.5)
    points = room_scan(truth, ENDLESS, (-8.0, 6.0))
    surfaces = StaticSurfaces(room(ENDLESS, (-8.0, 6.0)), truth.position_m)
    fit = register_scan(points, surfaces, replace(truth, x_m=3.7, y_m=1.4, yaw_deg=22.0))
    assert fit.not_fixed == ("x_m",)
    assert fit.standard_errors["x_m"] == math.inf
    assert fit.pose.x_m == pytest.approx(3.7, abs=1e-6)
    assert np.abs(errors(fit.pose, truth)[1:]).max() < 0.01


@pytest.mark.parametrize("is_alone", [True, False])
def test_direction_that_one_small_wall_fixes_is_as_uncertain_as_the_wall(is_alone: bool) -> None:
    """In a corridor along x, a gable of 4 m, or one at each end, tells where along it the sensor is."""
    truth = Pose(0.0, 0.0, 4.0, 0.0, 0.0, 0.0)
    gables = [(20.0, 1.0)] if is_alone else [(20.0, 1.0), (-20.0, 1.0)]
    quads = [list(corners.reshape(4, 3)) for corners in room(ENDLESS, (-8.0, 6.0)).vertices_m.reshape(-1, 4, 3)]
    for x_m, y_m in gables:
        ends = ((y_m, 0.0), (y_m + 4.0, 0.0), (y_m + 4.0, 30.0), (y_m, 30.0))
        quads.append([np.array([x_m, y, z]) for y, z in ends])
    points = room_scan(truth, ENDLESS, (-8.0, 6.0), sigma_m=0.0)
    for x_m, y_m in gables:
        ranges_m = np.linalg.norm(points, axis=1)
        at_gable = points * (x_m / np.where(points[:, 0] == 0.0, np.nan, points[:, 0]))[:, None]
        is_stopped = (
            (points[:, 0] * x_m > 0.0) & (np.linalg.norm(at_gable, axis=1) < ranges_m)
            & (at_gable[:, 1] > y_m) & (at_gable[:, 1] < y_m + 4.0)
        )  # fmt: skip
        points = np.where(is_stopped[:, None], at_gable, points)
    points *= 1.0 + 0.01 * np.random.default_rng(0).standard_normal(len(points))[:, None] / 20.0
    fit = register_scan(points, StaticSurfaces(mesh_of(quads), truth.position_m), truth)
    assert fit.not_fixed == ()
    assert fit.pose.x_m == pytest.approx(0.0, abs=0.01)
    if is_alone:
        assert fit.standard_errors["x_m"] == pytest.approx(0.2, rel=0.1)
    else:
        assert fit.standard_errors["x_m"] < 0.02
    assert fit.standard_errors["y_m"] < 0.02


def test_ground_fixes_height_and_tilt_only() -> None:
    truth = Pose(0.0, 0.0, 4.0, 20.0, -1.0, 0.5)
    points = room_scan(truth, ENDLESS, ENDLESS)
    fit = register_scan(
        points, StaticSurfaces(room(ENDLESS, ENDLESS), truth.position_m), replace(truth, z_m=4.2, roll_deg=2.0)
    )
    assert fit.not_fixed == ("x_m", "y_m", "yaw_deg")
    assert np.abs(errors(fit.pose, truth)).max() < 0.01


@pytest.mark.slow
def test_finds_yaw() -> None:
    surfaces = StaticSurfaces(yard(), YARD_POSE.position_m)
    search = search_yaw(yard_scan(coarse_sensor()), surfaces, replace(START, yaw_deg=0.0))
    assert search.best.pose.yaw_deg == pytest.approx(YARD_POSE.yaw_deg, abs=0.02)
    assert search.alternatives and search.equally_good == ()
    assert search.alternatives[0].excess_m > 5 * search.alternatives[0].excess_se_m


@pytest.mark.slow
def test_square_room_has_four_yaws() -> None:
    truth = Pose(0.0, 0.0, 4.0, 20.0, 0.0, 0.0)
    search = search_yaw(room_scan(truth, *SQUARE), StaticSurfaces(room(*SQUARE), truth.position_m), truth)
    yaws = [search.best.pose.yaw_deg, *(other.registration.pose.yaw_deg for other in search.equally_good)]
    assert len(yaws) == 4
    assert sorted(yaw % 360 for yaw in yaws) == pytest.approx([20.0, 110.0, 200.0, 290.0], abs=0.05)


def test_only_chosen_parameters_are_fitted() -> None:
    start = replace(YARD_POSE, x_m=12.4, yaw_deg=35.0)
    surfaces = StaticSurfaces(yard(), YARD_POSE.position_m)
    fit = register_scan(yard_scan(coarse_sensor()), surfaces, start, free=("yaw_deg", "x_m"))
    assert fit.pose.x_m == pytest.approx(12.0, abs=0.01)
    assert fit.pose.yaw_deg == pytest.approx(33.0, abs=0.01)
    assert (fit.pose.y_m, fit.pose.z_m, fit.pose.pitch_deg) == (start.y_m, start.z_m, start.pitch_deg)
    se = fit.standard_errors
    assert [name for name in PARAMETERS if se[name] > 0] == ["x_m", "yaw_deg"]


def test_mast_of_sensor_is_left_out() -> None:
    """A panel of 0.6 m around the sensor would stop the beams ahead of it."""
    world = yard()
    panel = [np.array([12.2, -7.3, 0.0]), np.array([12.2, -6.7, 0.0]), np.array([12.2, -6.7, 9.0])]
    panel.append(np.array([12.2, -7.3, 9.0]))
    quads = [*world.vertices_m.reshape(-1, 4, 3), panel]
    with_mast = mesh_of(quads, ["building"] * 5 + ["mast"])
    points = yard_scan(coarse_sensor())
    plain = register_scan(points, StaticSurfaces(world, YARD_POSE.position_m), START)
    assert register_scan(points, StaticSurfaces(with_mast, YARD_POSE.position_m), START).pose == plain.pose


@pytest.mark.parametrize("search", [False, True])
def test_rejects_scan_without_static_world(search: bool) -> None:
    surfaces = StaticSurfaces(yard(), YARD_POSE.position_m)
    register = search_yaw if search else register_scan
    with pytest.raises(InputError, match="at least 200 returns, got 150"):
        register(np.ones((150, 3)), surfaces, START)
    with pytest.raises(InputError, match="lie on the static world"):
        register(np.random.default_rng(0).normal(0.0, 1.0, (2000, 3)), surfaces, START)
