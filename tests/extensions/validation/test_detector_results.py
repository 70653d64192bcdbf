"""Object classes by vClass; detections and point counts in their files."""

import tomllib

import numpy as np
import pytest

from egvs.clouds import simulation as cloud_simulation
from egvs.clouds.sweeps import Detections
from egvs.core.errors import InputError
from egvs.extensions.validation import detector_results
from egvs.extensions.validation.detector_results import CAR_VCLASSES, DetectedBoxes, PointCounts


def test_every_vclass_with_body_has_class():
    known = tomllib.loads(cloud_simulation.BODIES_FILE.read_text())["classes"]
    assert {name for name in known if detector_results.object_class(name, 4.5) == "Misc"} == set()
    assert {name for name in known if detector_results.object_class(name, 4.5) == "Car"} == CAR_VCLASSES
    assert {detector_results.object_class(name, 4.5) for name in known} | {"Trailer", "Misc"} == set(
        detector_results.CLASSES
    )


def test_rear_parts_are_trailers_except_of_buses():
    assert [detector_results.object_class("truck", 4.5, part) for part in (0, 1)] == ["Truck", "Trailer"]
    assert [detector_results.object_class("bus", 4.5, part) for part in (0, 1)] == ["Bus", "Bus"]
    assert detector_results.object_class("ship", 4.5) == "Misc"


@pytest.mark.parametrize(
    ("length_m", "name"), [(4.5, "Car"), (6.5, "Car"), (7.1, "Truck"), (12, "Bus"), (16.5, "Truck")]
)
def test_vclass_of_cars_with_another_length_has_class_of_its_size(length_m, name):
    assert {detector_results.object_class(vclass, length_m) for vclass in CAR_VCLASSES} == {name}
    assert detector_results.object_class("delivery", length_m) == "Van"


def _same(detections, again):
    assert len(detections.frames) == len(again.frames)
    for one, other in zip(detections.frames, again.frames, strict=True):
        np.testing.assert_array_equal(one.boxes, other.boxes)
        np.testing.assert_array_equal(one.scores, other.scores)
        assert other.boxes.shape == (len(other.scores), 7)


@pytest.mark.parametrize("counts", [[2, 0, 1], [0, 0, 3], [3, 0, 0], [0, 0, 0], [1]])
def test_points_survive_file(tmp_path, counts):
    detections = PointCounts(tuple(np.arange(count, dtype=np.int64) * 7 for count in counts))
    detections.write(tmp_path / "points.parquet", {"inputs": "x"})
    again = PointCounts.read(tmp_path / "points.parquet")
    assert [entry.tolist() for entry in again.points] == [entry.tolist() for entry in detections.points]


@pytest.mark.parametrize("counts", [[2, 0, 1], [0, 0, 3], [3, 0, 0], [0, 0, 0], [1]])
def test_boxes_survive_file(tmp_path, counts):
    random = np.random.default_rng(1)
    detections = DetectedBoxes(tuple(Detections(random.normal(size=(n, 7)), random.uniform(size=n)) for n in counts))
    detections.write(tmp_path / "detections.parquet", {"inputs": "x"})
    _same(detections, DetectedBoxes.read(tmp_path / "detections.parquet"))


def test_equal_detections_have_equal_bytes(tmp_path):
    detections = DetectedBoxes((Detections(np.ones((2, 7)), np.ones(2)), Detections.empty()))
    for name in "ab":
        detections.write(tmp_path / name, {"inputs": "x"})
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_rejects_file_of_other_artefact(tmp_path):
    path = tmp_path / "points.parquet"
    DetectedBoxes((Detections.empty(),)).write(path, {"inputs": "x"})
    with pytest.raises(InputError, match=r"points.parquet: the column 'points' is missing"):
        PointCounts.read(path)
