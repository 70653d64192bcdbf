"""KITTI results of other detectors are converted to the world frame; messages name file and line."""

import math

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.extensions.validation import kitti, kitti_results
from egvs.extensions.validation.dataset_files import LevelFrame
from egvs.sensors.sites import Pose

POSES = {"a": Pose(100.0, 200.0, 3.0, yaw_deg=90.0), "b": Pose(-5.0, 2.0, 6.0, yaw_deg=30.0, pitch_deg=-12.0)}
NUMBERS = np.array([0, 8])
CAR = "Car 0 0 0 0 0 50 50 1.5 1.8 4.5 0 3 10 3.141592653589793 0.9"  # 10 m ahead of the sensor, heading left


@pytest.fixture
def folder(tmp_path):
    """Results of two sites, one detector, two frames."""
    for site in POSES:
        (tmp_path / "res" / site / "mine").mkdir(parents=True)
        (tmp_path / "res" / site / "mine" / "000000.txt").write_text(CAR + "\n")
        (tmp_path / "res" / site / "mine" / "000008.txt").write_text("")
    return tmp_path / "res"


def test_car_ahead_that_heads_left_by_hand(folder):
    """Site a looks north from 3 m: the car is 10 m north of it, stands on z = 0 and heads west."""
    results = kitti_results.read_kitti_results(folder, POSES, NUMBERS)
    assert list(results) == ["mine"] and list(results["mine"]) == ["a", "b"]
    first, second = results["mine"]["a"]
    np.testing.assert_allclose(first.boxes[0, :6], [100, 210, 0.75, 4.5, 1.8, 1.5], atol=1e-9)
    assert math.isclose(abs(first.boxes[0, 6]), math.pi, abs_tol=1e-9)
    np.testing.assert_array_equal(first.scores, [0.9])
    assert second.boxes.shape == (0, 7) and second.scores.shape == (0,)


@pytest.mark.parametrize("site", POSES)
def test_world_boxes_survive_conversion(folder, site):
    random = np.random.default_rng(1)
    boxes = np.column_stack(
        [random.uniform(-90, 300, (200, 3)), random.uniform(0.5, 18, (200, 3)), random.uniform(-np.pi, np.pi, 200)]
    )
    scores = random.uniform(-2, 2, 200)
    level = LevelFrame(POSES[site])
    (folder / site / "mine" / "000008.txt").write_text(kitti.format_labels(["Truck"] * 200, level.boxes(boxes), scores))
    results = kitti_results.read_kitti_results(folder, POSES, NUMBERS)["mine"][site][1]
    np.testing.assert_allclose(results.boxes[:, :6], boxes[:, :6], atol=1.1e-6)  # six decimals are written
    np.testing.assert_allclose(kitti.wrap_angle(results.boxes[:, 6] - boxes[:, 6]), 0, atol=1.1e-6)
    np.testing.assert_allclose(results.scores, scores, atol=1e-6)


def test_drops_people_cyclists_and_dont_care(folder):
    lines = [CAR.replace("Car", name) for name in ("Cyclist", "Pedestrian", "Bus", "DontCare")]
    (folder / "a" / "mine" / "000000.txt").write_text("\n".join(lines) + "\n\n")
    assert len(kitti_results.read_kitti_results(folder, POSES, NUMBERS)["mine"]["a"][0].scores) == 1


def test_reads_results_next_to_export_and_in_data_folder(folder):
    for site in POSES:
        (folder / site / "velodyne").mkdir()
        (folder / site / "calib").mkdir()
        for name in ("000000", "000008"):
            (folder / site / "calib" / f"{name}.txt").write_text(kitti.CALIBRATION.replace("1", "1.0e0"))
        (folder / site / "mine").rename(folder / site / "data")
    assert list(kitti_results.read_kitti_results(folder, POSES, NUMBERS)) == ["res"]


@pytest.mark.parametrize(
    ("line", "parts"),
    [
        (CAR.replace("4.5", "nan"), ["'nan'", "a finite number"]),
        (CAR.replace("0.9", "sure"), ["'sure'", "a finite number"]),
        (CAR.replace("0.9", "inf"), ["'inf'", "a finite number"]),
        (CAR.replace("Car", "Horse"), ["unknown class 'Horse'", "Car, Van, Truck"]),
        (CAR.rsplit(" ", 1)[0], ["no score", "16 values"]),
        (CAR + " 1", ["got 17", "16 (a result"]),
        (CAR.rsplit(" ", 2)[0], ["got 14"]),
        (CAR.replace(" 1.8 ", " -1 "), ["got 1.5 x -1 x 4.5 m", "above 0"]),
    ],
)
def test_names_file_and_line_of_wrong_line(folder, line, parts):
    (folder / "b" / "mine" / "000008.txt").write_text(f"{CAR}\n\n{line}\n")
    with pytest.raises(InputError) as error:
        kitti_results.read_kitti_results(folder, POSES, NUMBERS)
    for text in (str(folder / "b" / "mine" / "000008.txt: line 3"), *parts):
        assert text in str(error.value)


def _calibrated(folder, text):
    (folder / "a" / "calib").mkdir()
    for name in ("000000", "000008"):
        (folder / "a" / "calib" / f"{name}.txt").write_text(text)


@pytest.mark.parametrize(
    ("spoil", "parts"),
    [
        (lambda f: f.rename(f.with_name("elsewhere")), ["res: no such folder", "SITE/DETECTOR/000000.txt"]),
        (lambda f: (f / "c").mkdir(), ["c: the folder is not named after a validated site", "Use a, b"]),
        (lambda f: (f / "b").rename(f.parent / "b"), ["b: no such folder"]),
        (lambda f: (f / "b" / "mine").rename(f / "b" / "label_2"), ["b: the folder contains no results"]),
        (lambda f: (f / "b" / "mine").rename(f / "b" / "yours"), ["a: no results of yours"]),
        (lambda f: (f / "a" / "mine" / "000008.txt").unlink(), ["000008.txt: no such file", "each of the 2 frames"]),
        (
            lambda f: (f / "a" / "mine" / "000004.txt").touch(),
            ["000004.txt: expected results of 2 frames", "000000.txt to 000008.txt"],
        ),
        (lambda f: (f / "a" / "mine" / "000008.txt").write_bytes(b"\xff\xfe"), ["000008.txt: the file is not text"]),
        (lambda f: _calibrated(f, "P2: 1 0 0 0"), ["000000.txt: expected R0_rect"]),
        (lambda f: _calibrated(f, kitti.CALIBRATION.replace("0 -1 0 0 0 0 -1", "1 -1 0 0 0 0 -1")), ["Tr_velo_to_cam"]),
    ],
)
def test_rejects_wrong_folder(folder, spoil, parts):
    spoil(folder)
    with pytest.raises(InputError) as error:
        kitti_results.read_kitti_results(folder, POSES, NUMBERS)
    for text in parts:
        assert text in str(error.value)
