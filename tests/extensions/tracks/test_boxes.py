"""Rotations against SciPy, checks of rows, names of classes, values of JSON documents."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from egvs.core.errors import InputError
from egvs.extensions.tracks.boxes import (
    Box,
    BoxRows,
    ClassNames,
    Pose,
    front_of,
    is_rotation,
    make_tracks,
    to_rotations,
    yaw_of,
)
from egvs.extensions.tracks.formats.documents import Node
from egvs.extensions.tracks.model import TrackFrame


def test_rotations_equal_those_of_scipy() -> None:
    quaternions = np.random.default_rng(5).normal(size=(200, 4))
    expected = Rotation.from_quat(quaternions).as_matrix()
    rotations = to_rotations(quaternions)
    np.testing.assert_allclose(rotations, expected, atol=1e-14)
    front = Rotation.from_quat(quaternions).apply([1, 0, 0])
    np.testing.assert_allclose(yaw_of(rotations), np.arctan2(front[:, 1], front[:, 0]), atol=1e-12)
    assert all(is_rotation(rotation) for rotation in rotations)
    assert not is_rotation(-np.eye(3)) and not is_rotation(1.01 * np.eye(3)) and not is_rotation(np.full((3, 3), 1e300))
    assert np.isnan(to_rotations(np.zeros(4))).all()
    fronts = np.array([front_of(*quaternion) for quaternion in quaternions.tolist()])
    np.testing.assert_allclose(fronts / np.linalg.norm(quaternions, axis=1, keepdims=True) ** 2, front, atol=1e-12)


def test_pose_moves_box_as_scipy() -> None:
    rng = np.random.default_rng(6)
    for _ in range(50):
        rotation, turn = Rotation.random(rng=rng), Rotation.random(rng=rng)
        centre, shift = rng.normal(size=(2, 3))
        box = Pose.from_arrays(rotation.as_matrix(), shift).box(centre, front_of(*turn.as_quat()), (4, 2, 1))
        front = (rotation * turn).apply([1, 0, 0])
        expected = [*(rotation.apply(centre) + shift), np.arctan2(front[1], front[0]), 4, 2, 1]
        np.testing.assert_allclose(box, expected, atol=1e-12)
    assert math.isnan(Pose().box((1, 2, 3), (0, 0, 0), (1, 1, 1)).yaw_rad)
    assert Pose().box((1, 2, 3), (0, 1, 0), (4, 2, 1)) == (1, 2, 3, math.pi / 2, 4, 2, 1)


def test_rows_become_tracks() -> None:
    rows = BoxRows(Path("file"))
    rows.add(Path("file"), "b", "car", 0.5, Box(1, 2, math.nan, 0.3, 4, 2, math.nan))
    rows.add(Path("file"), "a", "bus", 0.6, Box(3, 4, 5, math.nan, 0, 0, 0))
    tracks = rows.to_tracks(TrackFrame("EPSG:25832"), ["note"])
    assert tracks.names == ("a", "b") and tracks.classes == ("bus", "car")
    assert tracks.track.tolist() == [1, 0] and tracks.time_s.tolist() == [0.5, 0.6]
    np.testing.assert_equal(tracks.z_m, [math.nan, 5])
    np.testing.assert_equal(tracks.yaw_rad, [0.3, math.nan])
    assert tracks.frame.crs == "EPSG:25832" and tracks.sources == ("note",)


@pytest.mark.parametrize(
    ("name", "time_s", "values", "expected"),
    [
        ("a", math.nan, (0, 0, 0, 0, 1, 1, 1), "time_s: expected a number between -1e+10 and 1e+10, got nan"),
        ("a", 1, (math.inf, 0, 0, 0, 1, 1, 1), "file: track 'a', time 1 s: x_m: expected a number"),
        ("a", 1, (0, math.nan, 0, 0, 1, 1, 1), "y_m: expected a number"),
        ("a", 1, (0, 0, math.inf, 0, 1, 1, 1), "z_m: expected a number"),
        ("a", 1, (0, 0, 0, 1e9, 1, 1, 1), "yaw_rad: expected a number between -10000 and 10000, got 1e+09"),
        ("a", 1, (0, 0, 0, 0, 1, 101, 1), "width_m: expected a number between 0 and 100, got 101"),
        ("x" * 201, 1, (0, 0, 0, 0, 1, 1, 1), "expected a name of at most 200 characters, got 201"),
    ],
)
def test_impossible_row_is_rejected(name: str, time_s: float, values: tuple[float, ...], expected: str) -> None:
    rows = BoxRows(Path("folder"))
    with pytest.raises(InputError) as error:
        rows.add(Path("file"), name, "car", time_s, Box(*values))
        rows.to_tracks(TrackFrame(), [])
    assert expected in str(error.value)
    keys = ("time_s", "x_m", "y_m", "z_m", "yaw_rad", "length_m", "width_m", "height_m")
    columns = dict(zip(keys, np.array([(time_s, *values)], dtype=np.float64).T, strict=True))
    with pytest.raises(InputError) as error:
        make_tracks(Path("file"), [name], ["car"], columns, TrackFrame(), [])
    assert expected in str(error.value)


def test_names_of_classes() -> None:
    names = ClassNames({"largecar": "car"}, {"pole"})
    texts = ["Large_Car", "POLE", "pole", "UFO", *(f"kind {letter}" for letter in "abcdefghijkl")]
    assert [names.convert(text) for text in texts] == ["car", None, None, *["other"] * 13]
    assert names.sentences()[0] == "boxes of static classes left out: 1 POLE, 1 pole"
    assert names.sentences()[1].endswith("1 kind i, 3 of further classes")
    assert ClassNames({}, ()).sentences() == []


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (True, "got True"),
        (None, "got None"),
        ("one", "got 'one'"),
        (math.inf, "got inf"),
        ("nan", "got 'nan'"),
        ([], "[]"),
    ],
)
def test_values_that_are_no_number(value: Any, expected: str) -> None:
    with pytest.raises(InputError, match="file: key: expected a number, got") as error:
        Node(value, "file: key").number()
    assert expected in str(error.value)


def test_values_of_document() -> None:
    node = Node({"a": {"b": [1, "2.5"]}, "none": None}, "file: ")
    assert node.get("a").get("b").numbers(2) == [1.0, 2.5]
    assert node.find("none") is None and node.find("c") is None
    assert [(key, member.value) for key, member in node.get("a").members()] == [("b", [1, "2.5"])]
    with pytest.raises(InputError, match=r"file: a\.c: is missing\."):
        node.get("a").get("c")
    with pytest.raises(InputError, match=r"file: a\.b: expected 3 numbers, got 2\."):
        node.get("a").get("b").numbers(3)
    with pytest.raises(InputError, match=r"file: a: expected a list, got \{"):
        node.get("a").elements()
    with pytest.raises(InputError, match=r"file: a\.b\.1: expected an object, got '2\.5'"):
        node.get("a").get("b").elements()[1].find("x")
    with pytest.raises(InputError, match=r"file: a\.b\.0: expected a text, got 1"):
        node.get("a").get("b").elements()[0].text()
