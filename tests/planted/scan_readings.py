"""Measured scans in other frames, mirrored, repeated, of another site."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tests.planted.case import Case, file
from tests.planted.heights import HILL_M
from tests.planted.reference_systems import EAST_M, NORTH_M
from tests.planted.scenes import Scene, street
from tests.planted.truth import (
    STREET,
    FloatArray,
    Mount,
    returned_points,
    score_of_beams,
    scores,
)
from tests.planted.units import FOOT_M


def scan(change: Callable[[FloatArray, Mount], FloatArray], of: str = "pole_a") -> Callable[[Scene], str]:
    """Write the points of a perfect scan, changed."""

    def content(scene: Scene) -> str:
        points_m = change(returned_points(scene.truth, of), dict(scene.truth.mounts)["pole_a"])
        return "x_m,y_m,z_m\n" + "".join("{:.6f},{:.6f},{:.6f}\n".format(*point) for point in points_m)

    return content


def as_it_is(points_m: FloatArray, _mount: Mount) -> FloatArray:
    """The points in the world frame."""
    return points_m


def in_sensor_frame(points_m: FloatArray, mount: Mount) -> FloatArray:
    """The points in the frame of the sensor: the columns of the rotation are its axes in the world."""
    return (points_m - mount.position_m) @ mount.to_world(np.eye(3)).T


def measured() -> Scene:
    """The street with a measured scan at the first site."""
    scene = street()
    scene.replace("sites.csv", "roll_deg", "roll_deg,points")
    scene.replace("sites.csv", ",2\n", ",2,scan.csv\n")
    scene.replace("sites.csv", ",137.3,0,0\n", ",137.3,0,0,\n")
    scene.files["scan.csv"] = scan(as_it_is)(scene)
    return scene


def measured_scores() -> dict[str, float]:
    """A measured scan has its returns only."""
    mount = dict(STREET.mounts)["pole_a"]
    ends_m = np.round(returned_points(STREET, "pole_a"), 6) - mount.position_m
    return {**scores(STREET), "pole_a": score_of_beams(STREET, mount.position_m, ends_m)}


def scan_case(name: str, change: Callable[[FloatArray, Mount], FloatArray], words: str, of: str = "pole_a") -> Case:
    """A case of a measured scan."""
    plant = file("scan.csv", scan(change, of))
    return Case(name, measured, plant, "scan.csv", words, scores=measured_scores)


def scan_warning(name: str, change: Callable[[FloatArray, Mount], FloatArray], words: str) -> Case:
    """A case of a measured scan that may be right."""
    return replace(scan_case(name, change, words), is_error=False)


def turned(yaw_deg: float, pitch_deg: float) -> Callable[[FloatArray, Mount], FloatArray]:
    """Turn the points about the sensor and the axes of the world."""
    turn = Mount(0.0, 0.0, 0.0, yaw_deg, pitch_deg)
    return lambda points_m, mount: mount.position_m + turn.to_world(points_m - mount.position_m)


SCANS = (
    scan_warning(
        "scan with two returns for each beam",
        lambda points_m, _: np.concatenate([points_m, points_m + 0.001]),
        "1,232 points, but one turn of the sensor has 840 beams",
    ),
    scan_warning(
        "scan with y up",
        lambda points_m, _: points_m[:, [0, 2, 1]],
        "1 % of 616 compared points are on surfaces of the static world",
    ),
    scan_warning(
        "scan a metre too high",
        lambda points_m, _: points_m + np.array([0.0, 0.0, 1.0]),
        "100 % would be if moved by (+0.0, +0.0, -1.0) m",
    ),
    scan_warning(
        "scan a metre too far east",
        lambda points_m, _: points_m + np.array([1.0, 0.0, 0.0]),
        "100 % would be if moved by (-1.0, +0.0, +0.0) m",
    ),
    scan_warning(
        "scan half a metre too far north",
        lambda points_m, _: points_m + np.array([0.0, 0.5, 0.0]),
        "100 % would be if moved by (+0.0, -0.5, +0.0) m",
    ),
    scan_warning(
        "scan pitched by three degrees", turned(0.0, -3.0), "100 % would be if turned by 3.0 degrees about the sensor"
    ),
    scan_warning("scan turned by ten degrees", turned(10.0, 0.0), "degrees about the sensor"),
    scan_warning(
        "scan in millimetres",
        lambda points_m, _: points_m * 1000.0,
        "0 % of 616 compared points are on surfaces of the static world",
    ),
    scan_case("scan in the sensor's frame", in_sensor_frame, "would be in the sensor's frame"),
    scan_case(
        "scan relative to the sensor",
        lambda points_m, mount: points_m - mount.position_m,
        "would be relative to the sensor",
    ),
    scan_case("scan mirrored", lambda points_m, _: points_m * [1.0, -1.0, 1.0], "with y mirrored"),
    scan_case(
        "scan mirrored about the sensor",
        lambda points_m, mount: mount.position_m + (points_m - mount.position_m) * [-1.0, 1.0, 1.0],
        "with x mirrored about the sensor",
    ),
    scan_case("scan with x and y swapped", lambda points_m, _: points_m[:, [1, 0, 2]], "with x and y swapped"),
    scan_case("scan of another site", as_it_is, "would be of site pole_b", of="pole_b"),
    scan_case(
        "scan with each point twice",
        lambda points_m, _: np.concatenate([points_m, points_m]),
        "expected each point once",
    ),
    scan_case("scan in feet", lambda points_m, _: points_m / FOOT_M, "would be in feet"),
    scan_case(
        "scan in eastings and northings",
        lambda points_m, _: points_m + np.array([EAST_M, NORTH_M, 0.0]),
        "read as metres of the world frame",
    ),
    scan_case(
        "scan above sea level",
        lambda points_m, _: points_m + np.array([0.0, 0.0, HILL_M]),
        "none of 616 points lies on a beam that can meet the region",
    ),
)
