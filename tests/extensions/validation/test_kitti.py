"""Boxes to KITTI files and back, and one box whose values are computed by hand."""

import math

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.extensions.validation import kitti

BOX = np.array([[10.0, 2.0, -3.0, 4.5, 1.8, 1.5, 0.0]])


def test_label_of_car_ahead_by_hand():
    """10 m ahead and 2 m to the left; its bottom 3.75 m below the camera; its turn about y (down) is -90 degrees."""
    (line,) = kitti.format_labels(["Car"], BOX).splitlines()
    words = line.split()
    assert words[:3] == ["Car", "0.00", "0"]
    np.testing.assert_allclose(
        [float(word) for word in words[8:15]], [1.5, 1.8, 4.5, -2, 3.75, 10, -math.pi / 2], atol=1e-6
    )
    np.testing.assert_allclose(float(words[3]), -math.pi / 2 - math.atan2(-2, 10), atol=1e-6)


def test_round_trip_of_boxes(tmp_path):
    random = np.random.default_rng(3)
    boxes = np.column_stack(
        [random.uniform(-90, 90, (500, 3)), random.uniform(0.3, 18, (500, 3)), random.uniform(-np.pi, np.pi, 500)]
    )
    boxes[:4, 6] = [-np.pi, np.pi / 2, -np.pi / 2, 0.0]
    scores = random.uniform(-3, 3, 500)
    (tmp_path / "a.txt").write_text(kitti.format_labels(["Bus"] * 500, boxes, scores))
    objects = kitti.read_labels(tmp_path / "a.txt")
    np.testing.assert_allclose(objects.boxes[:, :6], boxes[:, :6], atol=1e-5)
    np.testing.assert_allclose(kitti.wrap_angle(objects.boxes[:, 6] - boxes[:, 6]), 0, atol=1e-5)
    np.testing.assert_allclose(objects.scores, scores, atol=1e-6)
    assert objects.names == ("Bus",) * 500


def test_calibration_transforms_points_like_boxes():
    """Tr_velo_to_cam, multiplied as readers of KITTI do, maps the centre of a box's bottom to the label's position."""
    text = dict(line.split(": ") for line in kitti.CALIBRATION.splitlines())
    velo_to_cam = np.array(text["Tr_velo_to_cam"].split(), dtype=float).reshape(3, 4)
    bottom = np.append(BOX[0, :3] - (0, 0, BOX[0, 5] / 2), 1.0)
    np.testing.assert_allclose(velo_to_cam @ bottom, kitti.to_camera(BOX)[0, 3:6])
    assert list(text)[2:6] == ["P2", "P3", "R0_rect", "Tr_velo_to_cam"]  # some readers go by the line number


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("Car 0 0 0 0 0 50 50 1 1 4 0 0 9", "line 1: expected 15 values (a label) or 16 (a result with score), got 14"),
        ("Car 0 0 0 0 0 50 50 1 1 4 0 nan 9 0", "line 1: expected a finite number, got 'nan'"),
        ("Car 0 0 0 0 0 50 50 1 1 4 0 0 9 0 high", "line 1: expected a finite number, got 'high'"),
        ("Car 0 0 0 0 0 50 50 1 1 4 0 0 1_0 0", "line 1: expected a finite number, got '1_0'"),
        ("Car 0 0 0 0 0 50 50 1 0 4 0 0 9 0", "line 1: expected height, width and length above 0, got 1 x 0 x 4 m"),
    ],
)
def test_rejects_invalid_line(tmp_path, line, message):
    (tmp_path / "a.txt").write_text(line)
    with pytest.raises(InputError) as caught:
        kitti.read_labels(tmp_path / "a.txt")
    assert message in str(caught.value)


def test_reads_empty_file_and_rejects_missing_and_binary_ones(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        kitti.read_labels(tmp_path / "b.txt")
    (tmp_path / "a.txt").write_text("DontCare -1 -1 -10 0 0 9 9 -1 -1 -1 -1000 -1000 -1000 -10\n\n")
    assert kitti.read_labels(tmp_path / "a.txt").boxes.shape == (0, 7)
    (tmp_path / "a.txt").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="the file is not text"):
        kitti.read_labels(tmp_path / "a.txt")
