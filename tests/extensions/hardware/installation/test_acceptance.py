"""A measured scan says how a sensor is installed: its pose, what stands in its way, and whether it is accepted."""

from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import egvs
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions import hardware
from egvs.extensions.hardware.installation import acceptance, acceptance_page, scan_comparison
from egvs.extensions.hardware.installation.acceptance import Acceptance, PoseError, accept
from egvs.extensions.hardware.installation.acceptance_limits import Limits
from egvs.extensions.hardware.installation.planned_sites import PlannedSites
from egvs.extensions.hardware.installation.scan_comparison import ScanComparison, StaticWorld
from egvs.extensions.hardware.registration import PARAMETERS, Registration, StaticSurfaces, register_scan
from egvs.formats import point_clouds
from egvs.runs.run import FolderInUseError, lock_run_folder
from egvs.scoring.visibility import Beams
from egvs.sensors.beam_files import BeamTable
from egvs.sensors.sensor import Sensor, rotation_world_sensor
from egvs.sensors.sites import Pose
from egvs.world.ray_casting import Caster
from tests.conftest import collection, feature
from tests.extensions.hardware.installation.conftest import InstalledRun, write_installed_scenario
from tests.extensions.hardware.installation.simulated_scan import (
    box,
    simulate_scan,
    with_triangles,
    without_elevation,
)
from tests.sensors.yard import room, room_scan

CAR = (4.5, 1.8, 1.5)
TRUCK = box((16.0, 4.0, 2.0), (10.0, 2.5, 4.0))
TILT = r"tilt is off by 1\.(4[5-9]|5)"
TRAFFIC = [box((x, y, 0.75), CAR) for x, y in ((4, 2), (12, -2), (20, 2), (27, -2), (35, 2))] + [TRUCK]


def accept_points(run: InstalledRun, *scans: FloatArray, limits: Limits | None = None) -> Acceptance:
    """Check scans of the sensor at ``pole_a``."""
    paths = [run.write(f"scan{number}.pcd", scan) for number, scan in enumerate(scans)]
    return accept(run.folder, "pole_a", paths, limits)


def pole_at_azimuth(pose: Pose, azimuth_deg: float, distance_m: float, width_m: float) -> FloatArray:
    """A pole from the ground to 8 m, in a direction of the upright sensor."""
    direction = math.radians(pose.yaw_deg + azimuth_deg)
    x_m, y_m = pose.x_m + distance_m * math.cos(direction), pose.y_m + distance_m * math.sin(direction)
    return box((x_m, y_m, 4.0), (width_m, width_m, 8.0))


def failed(result: Acceptance) -> set[str]:
    """The names of the checks that fail."""
    return {check.name for check in result.checks if not check.passed}


@pytest.mark.slow
def test_sensor_as_planned_is_accepted(installed: InstalledRun) -> None:
    result = accept_points(installed, installed.points(TRAFFIC))
    assert failed(result) == set()
    assert result.score is not None
    assert result.score.loss == pytest.approx(0.0, abs=0.01)
    assert result.comparison.nearer_share > 0.02  # the traffic


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pitch_deg", "roll_deg"])
def test_tilt_error_of_one_and_a_half_degrees_is_measured_within_a_tenth(installed: InstalledRun, name: str) -> None:
    pole = pole_at_azimuth(installed.planned, 90.0, 0.8, 0.1)
    result = accept_points(installed, installed.points([*TRAFFIC, pole], **{name: 1.5}))
    assert result.pose.tilt_deg == pytest.approx(1.5, abs=0.1)
    assert result.pose.values[name] == pytest.approx(1.5, abs=0.1)
    assert abs(result.pose.tilt_deg - 1.5) < 5.0 * result.pose.tilt_se_deg
    assert result.pose.position_m < 0.05
    assert failed(result) >= {"tilt", "blocked sectors"}
    assert any(re.match(TILT, reason) for reason in result.reasons)


@pytest.mark.slow
def test_sensor_that_loses_returns_of_the_road_as_planned_is_accepted(tmp_path: Path) -> None:
    """Sweeps of ``egvs clouds``, with losses and traffic, turned from the level frame into the sensor's."""
    folder = write_installed_scenario(tmp_path / "crossing")
    text = (folder / "scenario.toml").read_text()
    rated = "range_m = 100\nrated_range_m = 60\nrated_reflectivity = 0.8"
    (folder / "scenario.toml").write_text(text.replace("range_m = 100", rated))
    scenario = egvs.load(folder)
    egvs.run(scenario, tmp_path / "run", jobs=1)
    egvs.write_clouds(scenario, tmp_path / "clouds", sites=["pole_a"], frames=3, format="pcd")
    pose = PlannedSites.open(tmp_path / "run").site("pole_a").pose
    turn = rotation_world_sensor(0.0, pose.pitch_deg, pose.roll_deg)
    scans = []
    for path in sorted((tmp_path / "clouds").rglob("*.pcd")):
        scans.append(tmp_path / f"{path.stem}.pcd")
        point_clouds.write_points(scans[-1], point_clouds.read_points(path, "cloud")[0] @ turn)
    result = accept(tmp_path / "run", "pole_a", scans)
    assert (len(scans), result.passed, result.reasons) == (3, True, ())
    comparison = result.comparison
    assert comparison.return_share > 0.9
    near = comparison.expected_m <= scan_comparison.SURE_RANGE * 100.0
    assert np.isfinite(comparison.measured_m[near]).mean() < 0.9  # what was expected without losses


@pytest.mark.slow
def test_shift_and_turn_are_measured(installed: InstalledRun) -> None:
    result = accept_points(installed, installed.points(x_m=0.2, z_m=-0.3, yaw_deg=3.0))
    for name, expected in {"x_m": 0.2, "y_m": 0.0, "z_m": -0.3, "yaw_deg": 3.0, "pitch_deg": 0.0}.items():
        assert result.pose.values[name] == pytest.approx(expected, abs=0.03), name
    assert result.pose.position_m == pytest.approx(math.hypot(0.2, 0.3), abs=0.03)
    assert failed(result) == {"position", "yaw"}


@pytest.mark.slow
def test_front_that_points_the_wrong_way_is_reported(installed: InstalledRun) -> None:
    result = accept_points(installed, installed.points(yaw_deg=90.0))
    assert result.pose.values["yaw_deg"] == pytest.approx(90.0, abs=0.1)
    assert "yaw" in failed(result)


@pytest.mark.slow
def test_pole_in_front_of_the_sensor_blocks_the_sector_that_it_covers(installed: InstalledRun) -> None:
    pole = pole_at_azimuth(installed.planned, 90.0, 1.0, 0.15)
    (sector,) = accept_points(installed, installed.points([pole])).comparison.sectors
    half_deg = math.degrees(math.atan(0.075 * math.sqrt(2) / 0.95))  # at most, if it stands cornerwise
    assert 90.0 - half_deg - 1.0 <= sector.first_deg < 90.0 < sector.last_deg <= 90.0 + half_deg + 1.0
    assert sector.width_deg >= 6.0
    assert sector.distance_m == pytest.approx(0.93, abs=0.15)
    assert sector.bearing_deg == pytest.approx(90.0 - (-60.0 + 90.0), abs=2.0)
    assert sector.share > 0.7


@pytest.mark.slow
def test_score_with_obstacle_is_that_of_a_world_with_it(installed: InstalledRun) -> None:
    sites = installed.sites
    site, session = sites.site("pole_a"), sites.session
    sensor = sites.sensor(site)
    pole = pole_at_azimuth(site.pose, 0.0, 1.0, 0.4)
    world = with_triangles(session.scene.world, pole)
    rows = Caster(world, session.scene.roi).scan(
        site.pose.position_m, sensor.directions(*site.pose.angles_deg), sensor.range_m
    )  # fmt: skip
    expected = session.score_beams(site, Beams(site.pose, sensor, rows.ends_m))[session.rank_by]
    scan = simulate_scan(session.scene, sensor, site.pose, site.pose, boxes=[pole])
    score = accept_points(installed, scan).score
    assert score is not None
    assert score.at_measured_pose == pytest.approx(score.planned, abs=0.002)
    assert expected < score.planned - 0.02
    assert score.as_installed == pytest.approx(expected, abs=0.01)


@pytest.mark.slow
def test_vehicles_do_not_block_but_a_low_obstacle_in_all_scans_does(installed: InstalledRun) -> None:
    container = box((8.0, 6.0, 1.5), (2.5, 2.5, 3.0))
    once = accept_points(installed, installed.points([*TRAFFIC, container])).comparison
    assert once.sectors == ()
    moved = [[box((x + shift, 2.0, 0.75), CAR) for x in (8, 20)] for shift in (0.0, 7.0, 14.0)]
    scans = [installed.points([*cars, container], seed=seed) for seed, cars in enumerate(moved)]
    assert len(accept_points(installed, *scans).comparison.sectors) == 1
    assert accept_points(installed, *(installed.points(cars, seed=7) for cars in moved)).comparison.sectors == ()


@pytest.mark.slow
def test_channel_without_returns_is_named(installed: InstalledRun) -> None:
    site = installed.sites.site("pole_a")
    elevation = installed.sites.sensor(site).elevations_deg[5]
    result = accept_points(installed, without_elevation(installed.points(), elevation))
    assert result.comparison.missing_channels == (elevation,)
    assert failed(result) == {"missing channels"}


@pytest.mark.slow
def test_beams_that_do_not_come_back_are_a_sector_without_returns(installed: InstalledRun) -> None:
    points = installed.points()
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    result = accept_points(installed, points[(azimuth < 30.0) | (azimuth > 50.0)])
    (sector,) = result.comparison.sectors
    assert (sector.first_deg, sector.last_deg) == (30.0, 50.0)
    assert not sector.has_returns
    assert "without returns" in result.reasons[0]


@pytest.mark.slow
def test_another_sensor_model_is_noticed(installed: InstalledRun) -> None:
    points = installed.points()
    elevation = np.radians(np.degrees(np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1))))
    below = points[elevation < np.radians(-26)]
    steep = below * [0.5, 0.5, 1.0]  # beams at about -45 degrees, which the sensor does not have
    assert "returns on no beam" in failed(accept_points(installed, np.concatenate([points, steep])))


@pytest.mark.slow
def test_limits_can_be_switched_off(installed: InstalledRun) -> None:
    points = installed.points(pitch_deg=1.5)
    assert failed(accept_points(installed, points, limits=Limits(tilt_deg=math.inf))) == set()


@pytest.mark.slow
def test_standard_error_of_the_tilt_covers_its_error(installed: InstalledRun) -> None:
    results = [accept_points(installed, installed.points(seed=seed, pitch_deg=0.7)) for seed in range(6)]
    scores = [(result.pose.tilt_deg - 0.7) / result.pose.tilt_se_deg for result in results]
    assert np.sqrt(np.mean(np.square(scores))) < 3.0


def test_expected_range_of_a_beam_to_the_ground_is_height_by_sine(installed: InstalledRun) -> None:
    sites = installed.sites
    world = StaticWorld(sites.session.scene, sites.site("pole_a").pose)
    down = np.array([[math.cos(math.radians(30.0)), 0.0, -math.sin(math.radians(30.0))], [0.0, 0.0, 1.0]])
    assert world.ranges_m(Pose(10.0, 12.0, 5.0, -60.0), down, 100.0).tolist() == pytest.approx([10.0, math.inf])
    assert world.heights_m(np.array([[1.0, 2.0, 3.5]])).tolist() == pytest.approx([3.5])


ENDLESS = (-math.inf, math.inf)
CORRIDOR = (-8.0, 6.0)


@pytest.mark.parametrize(
    ("yaw_error_deg", "pitch_error_deg", "roll_error_deg", "tilt_deg"),
    [(3.0, 0.0, 0.0, 0.0), (0.0, 1.5, 0.0, 1.5), (3.0, 1.5, 0.0, 1.5), (3.0, 0.0, 1.5, 1.5), (90.0, 0.0, 0.0, 0.0)],
)
@pytest.mark.parametrize("roll_deg", [0.0, 180.0])
def test_yaw_error_of_a_tilted_sensor_is_no_tilt(
    roll_deg: float, yaw_error_deg: float, pitch_error_deg: float, roll_error_deg: float, tilt_deg: float
) -> None:
    planned = Pose(0.0, 0.0, 4.0, 30.0, -20.0, roll_deg)
    measured = Pose(0.0, 0.0, 4.0, 30.0 + yaw_error_deg, -20.0 + pitch_error_deg, roll_deg + roll_error_deg)
    fit = Registration(measured, 1e-4 * np.eye(6), (), np.zeros(1), np.ones(1, dtype=np.bool_), 0.01, 0.01, True)
    error = PoseError.of(planned, fit)
    assert error.values["yaw_deg"] == pytest.approx(yaw_error_deg)
    assert error.tilt_deg == pytest.approx(tilt_deg)
    assert error.tilt_se_deg == pytest.approx(0.01 if tilt_deg else 0.0, rel=1e-3)


def test_direction_that_no_wall_fixes_fails_the_position() -> None:
    """Between two endless walls along x, nothing tells that the sensor is 1.5 m further along x."""
    planned = Pose(3.0, 1.0, 4.0, 20.0, -1.0, 0.5)
    surfaces = StaticSurfaces(room(ENDLESS, CORRIDOR), planned.position_m)
    fit = register_scan(room_scan(replace(planned, x_m=4.5), ENDLESS, CORRIDOR), surfaces, planned)
    error = PoseError.of(planned, fit)
    assert error.position_m < 0.01
    assert error.position_se_m == math.inf
    assert math.isfinite(error.tilt_se_deg)
    check = acceptance._measured_check("position", error.position_m, error.position_se_m, 0.3, "m")
    assert (check.passed, check.measured) == (False, "cannot be measured")


@pytest.mark.slow
def test_sensor_that_points_backwards_in_a_symmetric_street_fails_the_yaw() -> None:
    planned, walls_y_m = Pose(0.0, 0.0, 4.0, 20.0, 0.0, 0.0), (-12.0, 12.0)
    surfaces = StaticSurfaces(room(ENDLESS, walls_y_m), planned.position_m)
    points = room_scan(replace(planned, yaw_deg=200.2), ENDLESS, walls_y_m)
    fit = register_scan(points, surfaces, planned)
    assert fit.pose.yaw_deg == pytest.approx(20.2, abs=0.05)
    others = acceptance._other_yaws(points, surfaces, fit, planned, "scan")
    assert others == pytest.approx([-159.8], abs=0.1)
    check = acceptance._yaw_check(PoseError.of(planned, fit, others), 2.0)
    assert not check.passed
    assert "cannot be told: it is off by 0.2 or -179.8 degrees" in check.reason
    assert acceptance._yaw_check(PoseError.of(planned, fit, others), math.inf).passed


@pytest.mark.slow
def test_one_yaw_fits_where_the_walls_differ(installed: InstalledRun) -> None:
    assert accept_points(installed, installed.points(TRAFFIC)).pose.other_yaws_deg == ()


@pytest.mark.slow
def test_fit_at_a_worse_yaw_is_not_taken() -> None:
    """The walls ahead and behind are 8 m and 14 m away: turned around, a scan fits half of the room only."""
    planned, walls = Pose(0.0, 0.0, 4.0, 20.0, 0.0, 0.0), ((-14.0, 8.0), (-10.0, 10.0))
    surfaces = StaticSurfaces(room(*walls), planned.position_m)
    points = room_scan(replace(planned, yaw_deg=200.0), *walls)
    good = register_scan(points, surfaces, replace(planned, yaw_deg=199.0))
    worse = replace(good, pose=planned)
    assert acceptance._other_yaws(points, surfaces, good, planned, "scan") == ()
    assert acceptance._other_yaws(points, surfaces, worse, planned, "scan") is None


def unblocked_comparison(missing_channels: tuple[float, ...] = ()) -> ScanComparison:
    """A comparison in which every expected return came back, except for those of some channels."""
    none, beams = np.empty(0), np.empty(0, dtype=np.int64)
    return ScanComparison(
        scans=1, azimuth_deg=none, elevation_deg=none, expected_m=none, measured_m=none, returns=1000, off_beams=0,
        nearer=0, obstacle_beams=beams, obstacle_directions=np.empty((0, 3)), obstacle_ranges_m=none, return_share=1.0,
        sectors=(), missing_channels=missing_channels, unchecked_channels=0, structure_share=1.0,
    )  # fmt: skip


def test_score_that_cannot_be_computed_fails() -> None:
    pose, zero = Pose(0.0, 0.0, 4.0, 0.0, 0.0, 0.0), dict.fromkeys(PARAMETERS, 0.0)
    error = PoseError(pose, pose, zero, zero, 0.0, 0.0, 0.0, 0.0)
    for limit, passed in ((0.05, False), (math.inf, True)):
        (check,) = acceptance._checks(error, unblocked_comparison(), None, Limits(loss=limit))[-1:]
        assert (check.name, check.measured, check.passed) == ("score", "cannot be scored", passed)


def test_missing_channel_of_a_sensor_from_a_table_costs_its_beams() -> None:
    """Channels are named to a hundredth of a degree; the beams of one are those nearest to its elevation."""
    elevation, azimuth = np.meshgrid([-10.123, -5.456, 0.789], np.arange(0.0, 360.0, 2.0))
    sensor = Sensor("table", (), (), 0, 50.0, "", table=BeamTable(elevation.ravel(), azimuth.ravel()))
    assert scan_comparison.channel_elevations_deg(sensor).tolist() == [-10.12, -5.46, 0.79]
    beams = Beams(Pose(0.0, 0.0, 5.0, 30.0, 4.0), sensor, 20.0 * sensor.directions(30.0, 4.0, 0.0))
    left = acceptance._installed_beams(beams, unblocked_comparison(missing_channels=(-5.46,)))
    assert (len(beams.ends_m), len(left.ends_m)) == (540, 360)


# ---- command line


@pytest.mark.slow
def test_command_prints_reason_and_writes_files(installed: InstalledRun, run_egvs: Any, tmp_path: Path) -> None:
    scan = installed.write("tilted.ply", installed.points(TRAFFIC, pitch_deg=1.5))
    words = ("accept", installed.folder, "--site", "pole_a", "--scan", scan, "--out", tmp_path / "out")
    code, printed, _ = run_egvs(*words)
    assert code == 1
    assert re.search(f"failed: {TILT}", printed)
    report = json.loads((tmp_path / "out" / "acceptance_pole_a.json").read_text())
    assert report["passed"] is False
    assert report["pose_error"]["pitch_deg"]["error"] == pytest.approx(1.5, abs=0.1)
    assert report["limits"]["tilt_deg"] == 1.0
    page = (tmp_path / "out" / "acceptance_pole_a.html").read_text()
    assert "Not accepted" in page
    assert page.count("data:image/png") == 6
    yaw_error = report["pose_error"]["yaw_deg"]["error"]
    assert f"<dt>Yaw error</dt><dd>{yaw_error:+z.2f} degrees</dd>" in page  # never -0.00
    code, printed, _ = run_egvs(*words, "--tilt", "2")
    assert (code, "passed" in printed) == (0, True)


def test_folder_in_use_is_refused_before_anything_is_read(run_egvs: Any, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")
    with lock_run_folder(tmp_path):
        code, printed, errors = run_egvs("accept", tmp_path, "--site", "a", "--scan", tmp_path / "no_scan.pcd")
    assert (code, printed) == (2, "")
    assert "another command is using this folder. Repeat egvs accept when it has ended" in errors


@pytest.mark.slow
def test_verdict_is_printed_though_a_command_began_meanwhile(
    installed: InstalledRun, run_egvs: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(folder: Path, *_: object) -> None:
        raise FolderInUseError(f"{folder}: another run is using this folder")

    monkeypatch.setattr(acceptance_page, "add_to_report", refuse)
    scan = installed.write("as_planned.ply", installed.points())
    out = tmp_path / "out"
    code, printed, errors = run_egvs("accept", installed.folder, "--site", "pole_a", "--scan", scan, "--out", out)
    assert (code, "pole_a (wide): passed" in printed) == (2, True)
    assert "its report lacks this verdict" in errors
    assert (out / "acceptance_pole_a.json").is_file()


def test_plan_and_command_have_the_same_default_limits() -> None:
    from inspect import signature

    from egvs.extensions.hardware import installation_commands as installation

    defaults = {name: parameter.default for name, parameter in signature(installation.accept).parameters.items()}
    limits = Limits()
    names = {
        "position": limits.position_m, "tilt": limits.tilt_deg, "yaw": limits.yaw_deg, "blocked": limits.blocked_deg,
        "missing_channels": limits.missing_channels, "returns": limits.returns, "off_beams": limits.off_beams,
        "loss": limits.loss,
    }  # fmt: skip
    assert {name: defaults[name] for name in names} == names


def longitude_and_latitude(points: FloatArray) -> FloatArray:
    """The points as degrees."""
    return points / [90_000.0, 111_000.0, 1.0] + [11.42, 48.76, 0.0]


SPOILED = {
    "millimetres": (lambda points: 1000.0 * points, "expected"),
    "degrees": (longitude_and_latitude, "longitude and latitude"),
    "few": (lambda points: points[:500], "at least 2,000 returns, got 500"),
    "nowhere": (lambda points: np.full((3000, 3), np.nan), "at least 2,000 returns, got 0"),
    "mirrored": (lambda points: points * [1.0, -1.0, 1.0], "as its mirror image"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SPOILED)
def test_rejects_scan_that_cannot_be_one(installed: InstalledRun, run_egvs: Any, tmp_path: Path, name: str) -> None:
    spoil, message = SPOILED[name]
    scan = installed.write(f"{name}.ply", spoil(installed.points()))
    code, printed, errors = run_egvs(
        "accept", installed.folder, "--site", "pole_a", "--scan", scan, "--out", tmp_path / "out"
    )  # fmt: skip
    assert (code, printed) == (2, "")
    assert f"{name}.ply" in errors
    assert message in errors
    assert not (tmp_path / "out").exists()


def write_street(
    folder: Path,
    *more: tuple[str, list[list[float]], float],
    sites: str = "pole_a,10,0,5,0,-5\n",
    mount: str = "upright",
) -> InstalledRun:
    """Make a run of a street whose two sides are alike, about the sensor at (10, 0, 5), with more houses."""
    scenario = write_installed_scenario(folder / "street")
    north = [[-20.0, 9.0], [60.0, 9.0], [60.0, 20.0], [-20.0, 20.0]]
    south = [[x, -y] for x, y in north]
    end = [[70.0, -9.0], [80.0, -9.0], [80.0, 9.0], [70.0, 9.0]]
    houses = (("north", north, 9.0), ("south", south, 9.0), ("end", end, 12.0), *more)
    features = [
        feature({"type": "Polygon", "coordinates": [[*ring, ring[0]]]}, name=name, kind="building", height_m=height)
        for name, ring, height in houses
    ]
    (scenario / "statics.geojson").write_text(collection(*features))
    (scenario / "sites.csv").write_text(f"site,x_m,y_m,z_m,yaw_deg,pitch_deg\n{sites}")
    egvs.run(egvs.load(scenario, [f"sites.mount={mount}"]), folder / "run", jobs=1)
    (folder / "scans").mkdir()
    return InstalledRun(folder / "run", folder / "scans")


@pytest.mark.slow
def test_rejects_mirrored_scan_of_a_street_whose_sides_are_almost_alike(tmp_path: Path) -> None:
    """All but one house fit the mirrored scan at the planned pose."""
    street = write_street(tmp_path, ("kiosk", [[18, 4], [24, 4], [24, 8], [18, 8]], 4.0))
    scan = street.points()
    assert "tilt" not in failed(accept_points(street, scan))
    assert not any("mirror" in note for note in accept_points(street, scan).notes)
    with pytest.raises(InputError, match="fits the static world better as its mirror image"):
        accept_points(street, scan * [1.0, -1.0, 1.0])


@pytest.mark.slow
def test_scan_whose_mirror_image_fits_as_well_gets_a_note(tmp_path: Path) -> None:
    street = write_street(tmp_path)
    for scan in (street.points(), street.points() * [1.0, -1.0, 1.0]):
        assert "the mirror image of the scan fits as well" in " ".join(accept_points(street, scan).notes)


@pytest.mark.slow
def test_rejects_scan_of_another_place(installed: InstalledRun) -> None:
    sites = installed.sites
    here, there = sites.site("pole_a"), sites.site("pole_b")
    sensor = sites.sensor(there)
    elsewhere = simulate_scan(sites.session.scene, sensor, there.pose, there.pose, sigma_m=0.02)
    message = rf"scan0\.pcd: this scan was not taken at {here.name}; it fits {there.name}\. Use --site {there.name}"
    with pytest.raises(InputError, match=message):
        accept_points(installed, elsewhere)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("turn", "message"),
    [
        (np.diag([1.0, -1.0, -1.0]), "it is the other way up.* plan it with mount inverted"),
        (np.diag([1.0, 1.0, -1.0]), "with z reversed"),
    ],
)
def test_names_the_frame_in_which_a_scan_fits(tmp_path: Path, turn: np.ndarray, message: str) -> None:
    kiosk = ("kiosk", [[18, 4], [24, 4], [24, 8], [18, 8]], 4.0)
    street = write_street(tmp_path, kiosk)
    with pytest.raises(InputError, match=message):
        accept_points(street, street.points() @ turn)


@pytest.mark.slow
def test_says_that_a_scan_was_levelled(tmp_path: Path) -> None:
    """Upright, its pose is found and exactly level; upside down, it is not found in the sensor's frame."""
    kiosk = ("kiosk", [[18, 4], [24, 4], [24, 8], [18, 8]], 4.0)
    street = write_street(tmp_path, kiosk, sites="pole_a,10,0,5,0,-5\n")
    points = street.points()
    assert not any("levelled" in note for note in accept_points(street, points).notes)
    level = points @ rotation_world_sensor(0.0, -5.0, 0.0).T
    assert any("was the scan levelled?" in note for note in accept_points(street, level).notes)
    (tmp_path / "hung").mkdir()
    hung = write_street(tmp_path / "hung", kiosk, sites="pole_a,10,0,5,0,-5\n", mount="inverted")
    level = hung.points() @ rotation_world_sensor(0.0, -5.0, 180.0).T
    with pytest.raises(
        InputError, match=r"it was levelled\. .* egvs clouds are levelled: turn them back by T_level_sensor"
    ):
        accept_points(hung, level)


@pytest.mark.slow
def test_names_the_closest_mount_of_another_pole(tmp_path: Path) -> None:
    start = ("start", [[-40, -9], [-30, -9], [-30, 9], [-40, 9]], 12.0)
    kiosk = ("kiosk", [[22, 3], [27, 3], [27, 7], [22, 7]], 4.0)
    rows = "pole_a,10,5,5,-90,-5\nb_level,30,-5,5,90,0\nb_down,30,-5,5,90,-10\nb_high,30,-5,6,90,-10\n"
    street = write_street(tmp_path, start, kiosk, sites=rows)
    there = street.sites.site("b_down")
    scan = simulate_scan(street.sites.session.scene, street.sites.sensor(there), there.pose, there.pose, sigma_m=0.02)
    with pytest.raises(InputError, match=r"it fits b_down\. Use --site b_down"):
        accept_points(street, scan)


@pytest.mark.slow
def test_rejects_scan_that_fits_no_site(installed: InstalledRun) -> None:
    sites = installed.sites
    away = replace(sites.site("pole_a").pose, x_m=21.0, y_m=-20.0)
    nowhere = simulate_scan(sites.session.scene, sites.sensor(sites.site("pole_a")), away, away, sigma_m=0.02)
    with pytest.raises(InputError, match="does not fit the static world around pole_a"):
        accept_points(installed, nowhere)


@pytest.mark.slow
def test_rejects_scan_of_another_pole_of_a_street_whose_poles_are_almost_alike(tmp_path: Path) -> None:
    """Turned by 180 degrees, all but the kiosk fits here, too."""
    start = ("start", [[-40, -9], [-30, -9], [-30, 9], [-40, 9]], 12.0)
    kiosk = ("kiosk", [[22, 3], [27, 3], [27, 7], [22, 7]], 4.0)
    street = write_street(tmp_path, start, kiosk, sites="pole_a,10,5,5,-90,-5\npole_b,30,-5,5,90,-5\n")
    sites = street.sites
    there = sites.site("pole_b")
    scan = simulate_scan(sites.session.scene, sites.sensor(there), there.pose, there.pose, sigma_m=0.02)
    with pytest.raises(InputError, match="this scan was not taken at pole_a; it fits pole_b"):
        accept_points(street, scan)


@pytest.mark.parametrize("option", ["--position", "--loss", "--vehicle-height"])
def test_rejects_limit_that_is_no_number(run_egvs: Any, tmp_path: Path, option: str) -> None:
    code, printed, errors = run_egvs("accept", tmp_path, "--site", "a", "--scan", "scan.ply", option, "nan")
    assert (code, printed) == (2, "")
    assert option in errors and "Traceback" not in errors


def test_rejects_unknown_site_and_missing_options(installed: InstalledRun, run_egvs: Any) -> None:
    scan = installed.write("good.ply", installed.points())
    for words, message in (
        (("--site", "pole_x", "--scan", scan), "no pole or site 'pole_x'. Choose one of pole_a, pole_b."),
        (("--scan", scan), "--site: no site is given"),
        (("--site", "pole_a"), "--scan: no scan is given"),
        (("--site", "pole_a", "--scan", scan.with_name("none.pcd")), "none.pcd"),
    ):
        code, _, errors = run_egvs("accept", installed.folder, *words)
        assert (code, message in errors) == (2, True), errors


@pytest.mark.slow
def test_report_shows_the_sheet_and_the_verdict_while_they_belong_to_the_run(installed: InstalledRun) -> None:
    """1.5 degrees of tilt fail; after a run with another gamma, neither is shown."""
    folder = installed.folder.parent / "reported"
    shutil.copytree(installed.folder, folder)
    hardware.write_sheets(folder, ["pole_a"], kind="svg")
    scan = installed.write("tilted_for_report.pcd", installed.points(pitch_deg=1.5))
    written = hardware.write_acceptance(folder, hardware.accept(folder, "pole_a", [scan]))
    assert [path.name for path in written[2:]] == ["acceptance.json", "report.html"]
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert 'href="sheets/installation_pole_a.svg"' in text
    assert 'href="acceptance/acceptance_pole_a.html"' in text
    assert "tilt is off by 1." in text
    assert egvs.verify(folder) == []
    scenario = egvs.load(installed.folder.parent / "crossing", ["score.gamma=3"])
    egvs.run(scenario, folder, jobs=1)
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert 'id="installation"' not in text
    assert 'id="acceptance"' not in text
