"""Findings of a site are read back as they were written."""

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.validation.sweeps import DetectedBoxes, Detections, PointCounts


def _same(found, again):
    assert len(found.frames) == len(again.frames)
    for one, other in zip(found.frames, again.frames, strict=True):
        np.testing.assert_array_equal(one.boxes, other.boxes)
        np.testing.assert_array_equal(one.scores, other.scores)
        assert other.boxes.shape == (len(other.scores), 7)


@pytest.mark.parametrize("counts", [[2, 0, 1], [0, 0, 3], [3, 0, 0], [0, 0, 0], [1]])
def test_points_come_back(tmp_path, counts):
    found = PointCounts(tuple(np.arange(count, dtype=np.int64) * 7 for count in counts))
    found.write(tmp_path / "points.parquet", {"inputs": "x"})
    again = PointCounts.read(tmp_path / "points.parquet")
    assert [its.tolist() for its in again.points] == [its.tolist() for its in found.points]


@pytest.mark.parametrize("counts", [[2, 0, 1], [0, 0, 3], [3, 0, 0], [0, 0, 0], [1]])
def test_boxes_come_back(tmp_path, counts):
    random = np.random.default_rng(1)
    found = DetectedBoxes(tuple(Detections(random.normal(size=(n, 7)), random.uniform(size=n)) for n in counts))
    found.write(tmp_path / "detections.parquet", {"inputs": "x"})
    _same(found, DetectedBoxes.read(tmp_path / "detections.parquet"))


def test_the_same_findings_are_the_same_bytes(tmp_path):
    found = DetectedBoxes((Detections(np.ones((2, 7)), np.ones(2)), Detections.empty()))
    for name in "ab":
        found.write(tmp_path / name, {"inputs": "x"})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "points.parquet"
    DetectedBoxes((Detections.empty(),)).write(path, {"inputs": "x"})
    with pytest.raises(InputError, match=r"points.parquet: the column 'points' is missing"):
        PointCounts.read(path)
