"""Measured scans against the static world: right ones pass, each wrong reading of a file is named."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import egvs
from egvs.core.errors import Diagnostic
from egvs.core.grid import FloatArray
from egvs.sensors.measured_scans import check_measured_scans
from egvs.sensors.scanner import Scanner
from egvs.sensors.sensor import rotation_world_sensor
from egvs.sensors.sites import Site
from egvs.stages.inputs import build_scene

SITES = "site,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg,points\npole_a,10,12,3,30,-4,2,p.csv\npole_b,30.5,-12,3,0,0,0,\n"
"""A tilted sensor, whose axes are not those of the world, and another site."""


@pytest.fixture
def scanned(mini: Path) -> Path:
    (mini / "sites.csv").write_text(SITES)
    (mini / "p.csv").write_text("x_m,y_m,z_m\n1,1,1\n")
    return mini


def scan_points(scanner: Scanner, site: Site) -> FloatArray:
    """The returns of a perfect scan of all beams, (n, 3), world frame."""
    sensor = scanner.scene.sensor(site.sensor)
    hits = scanner.sweep_from(site.pose, sensor.directions(*site.pose.angles_deg), sensor.range_m)
    return hits.ends_m[hits.returned] + np.asarray(site.pose.position_m)


def findings(folder: Path, change: Callable[[FloatArray, Scanner], FloatArray], of: int = 0) -> list[Diagnostic]:
    """Findings for a file with the changed scan of the site number ``of``."""
    scanner = Scanner(build_scene(egvs.load(folder)))
    sites = scanner.scene.sites
    points_m = change(scan_points(scanner, sites[of]), scanner)
    np.savetxt(folder / "p.csv", points_m, fmt="%.4f", delimiter=",", header="x_m,y_m,z_m", comments="")
    return list(check_measured_scans(scanner, sites))


def as_measured(points_m: FloatArray, scanner: Scanner) -> FloatArray:
    return points_m


def with_traffic(points_m: FloatArray, scanner: Scanner) -> FloatArray:
    """A third of the beams end on something in front of the static world; ranges have noise of 3 cm."""
    rng = np.random.default_rng(3)
    position_m = np.asarray(scanner.scene.sites[0].pose.position_m)
    range_share = np.where(rng.random(len(points_m)) < 0.33, rng.uniform(0.3, 0.9, len(points_m)), 1.0)
    return position_m + (points_m - position_m) * range_share[:, None] + rng.normal(0.0, 0.03, points_m.shape)


def from_inexact_pose(points_m: FloatArray, scanner: Scanner) -> FloatArray:
    """The true pose is 0.1 m and half a degree off the stated one, and beams end at 40 m at most."""
    position_m = np.asarray(scanner.scene.sites[0].pose.position_m)
    ends_m = (points_m - position_m) @ rotation_world_sensor(0.5, 0.5, 0.0).T
    ends_m = ends_m[np.linalg.norm(ends_m, axis=1) < 40.0]
    return position_m + ends_m + 0.1


@pytest.mark.parametrize("change", [as_measured, with_traffic, from_inexact_pose])
def test_right_scan_has_no_finding(scanned: Path, change: Callable[[FloatArray, Scanner], FloatArray]) -> None:
    assert findings(scanned, change) == []


def in_sensor_frame(points_m: FloatArray, scanner: Scanner) -> FloatArray:
    pose = scanner.scene.sites[0].pose
    return (points_m - np.asarray(pose.position_m)) @ rotation_world_sensor(*pose.angles_deg)


def relative(points_m: FloatArray, scanner: Scanner) -> FloatArray:
    return points_m - np.asarray(scanner.scene.sites[0].pose.position_m)


def mirrored_about_sensor(points_m: FloatArray, scanner: Scanner) -> FloatArray:
    position_m = np.asarray(scanner.scene.sites[0].pose.position_m)
    return position_m + (points_m - position_m) * [1.0, -1.0, 1.0]


def mirrored(points_m: FloatArray, scanner: Scanner) -> FloatArray:
    return points_m * [-1.0, 1.0, 1.0]


def swapped(points_m: FloatArray, scanner: Scanner) -> FloatArray:
    return points_m[:, [1, 0, 2]]


@pytest.mark.parametrize(
    ("change", "of", "name"),
    [
        (in_sensor_frame, 0, "would be in the sensor's frame"),
        (relative, 0, "would be relative to the sensor, along the axes of the world"),
        (mirrored_about_sensor, 0, "would be with y mirrored about the sensor"),
        (mirrored, 0, "would be in the world frame with x mirrored"),
        (swapped, 0, "would be in the world frame with x and y swapped"),
        (as_measured, 1, "would be of site pole_b"),
    ],
)
def test_wrong_reading_is_an_error(
    scanned: Path, change: Callable[[FloatArray, Scanner], FloatArray], of: int, name: str
) -> None:
    """The message has both shares: of the stated reading, and of the one that fits."""
    (finding,) = findings(scanned, change, of)
    assert finding.is_error
    assert "100 % would be" in finding.problem
    assert name in finding.problem
    assert finding.where == "site pole_a: points: p.csv"


def test_scan_of_bare_ground_in_the_sensor_frame_is_an_error(scanned: Path) -> None:
    (scanned / "statics.geojson").write_text('{"type": "FeatureCollection", "crs": null, "features": []}')
    (finding,) = findings(scanned, in_sensor_frame)
    assert (finding.is_error, "in the sensor's frame" in finding.problem) == (True, True)


def test_scan_that_fits_nowhere_gets_a_warning(scanned: Path) -> None:
    rng = np.random.default_rng(1)
    (finding,) = findings(scanned, lambda points_m, _: rng.uniform(4.0, 30.0, points_m.shape))
    assert (finding.rule, finding.is_error) == ("measured scan", False)
    assert "no more in the sensor's frame, mirrored, or from the other sites" in finding.problem


@pytest.mark.parametrize(("copies", "is_error"), [(1.0, True), (0.05, False)])
def test_repeated_points_are_counted(scanned: Path, copies: float, is_error: bool) -> None:
    """In any order; each is a beam of its own for the score."""
    rng = np.random.default_rng(2)
    (finding,) = findings(
        scanned,
        lambda points_m, _: rng.permutation(np.concatenate([points_m, points_m[: int(copies * len(points_m))]])),
    )
    assert (finding.rule, finding.is_error) == ("repeated points", is_error)
    repeated, points = (int(number.replace(",", "")) for number in re.findall(r"[0-9,]+[0-9]", finding.problem))
    assert repeated == pytest.approx(copies * points / (1.0 + copies), abs=1.0)


def test_several_turns_get_a_warning(scanned: Path) -> None:
    """Three turns with noise have no equal points, but more of them than the sensor has beams."""
    rng = np.random.default_rng(2)
    (finding,) = findings(
        scanned,
        lambda points_m, _: np.concatenate([points_m + rng.normal(0.0, 0.02, points_m.shape) for _ in range(3)]),
    )
    assert (finding.rule, finding.is_error) == ("repeated points", False)
    assert "one turn of the sensor has 2,880 beams" in finding.problem


def test_run_rejects_a_scan_in_the_sensor_frame(scanned: Path, run_egvs, tmp_path: Path) -> None:
    findings(scanned, in_sensor_frame)
    code, _, err = run_egvs("run", scanned, "--out", tmp_path / "run")
    assert code == 2
    assert "would be in the sensor's frame" in err
    assert not (tmp_path / "run" / "scans.parquet").exists()
