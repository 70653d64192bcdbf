"""Labels of two sensors of one place, or detections, without sweeps.

Evidence: lists that are made here, in which each labeller notices road users by the curves of people. The share of one
list in the other is then the level that is printed. Poses, formats, headings and gaps change nothing of that.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.validation.measured.label_agreement import (
    AgreementRequest,
    AgreementRow,
    ComparedList,
    compare_lists,
)
from egvs.extensions.validation.measured.list_poses import SAME, find_pose
from tests.extensions.validation.measured import two_sensors
from tests.extensions.validation.measured.two_sensors import POSES, SENSOR, Labels

COLUMNS = {"type": "label", "length_m": "l", "width_m": "w", "height_m": "h"}
Lists = tuple[list[Labels], list[Labels]]


@pytest.fixture(scope="module")
def lists() -> Lists:
    """Two lists of 150 s."""
    return two_sensors.make_lists(seed=3, sweeps=150)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory, lists: Lists) -> tuple[Path, Path]:
    """Both as OpenLABEL with poses."""
    folder = tmp_path_factory.mktemp("lists")
    first, second = lists
    return (
        two_sensors.write_openlabel(folder / "south", first, POSES[0]),
        two_sensors.write_openlabel(folder / "north", second, POSES[1]),
    )


@pytest.fixture(scope="module")
def tested(folders: tuple[Path, Path]) -> list[ComparedList]:
    """Both lists, each tested by the other."""
    return compare_lists(AgreementRequest(folders, sensors=(SENSOR,)))


def total(tested: ComparedList, group: str = "cars") -> AgreementRow:
    return next(row for row in tested.rows if row.group == group and row.high == 80.0 and row.low == 0.0)


@pytest.mark.slow
def test_printed_level_is_the_measured_one(tested: list[ComparedList]) -> None:
    for item in tested:
        cars = total(item)
        assert cars.boxes > 200 and cars.objects > 30 and cars.people is not None and cars.difference is not None
        assert cars.difference.value == pytest.approx(cars.people.value - cars.found.value)
        assert 0.0 < cars.difference.se < 0.05
        assert abs(cars.difference.value) < 3 * cars.difference.se
        assert 0.3 < cars.found.value < 0.9 and cars.by_chance.value < 0.15


def test_curve_by_points(tested: list[ComparedList]) -> None:
    """Few points are noticed less often than many."""
    for item in tested:
        cars = [row for row in item.point_rows if row.group == "cars"]
        few = sum(row.found.value * row.boxes for row in cars if row.high <= 5) / sum(
            row.boxes for row in cars if row.high <= 5
        )
        many = sum(row.found.value * row.boxes for row in cars if row.low >= 50) / sum(
            row.boxes for row in cars if row.low >= 50
        )
        assert few < 0.5 < 0.75 < many
        assert sum(row.boxes for row in cars) == total(item).boxes


@pytest.mark.slow
def test_poses_from_files_or_boxes(tmp_path: Path, lists: Lists, tested: list[ComparedList]) -> None:
    """The sensors are 13.9 m apart, turned by 35 degrees, and 0.5 m apart in height."""
    paths = tuple(
        two_sensors.write_openlabel(tmp_path / name, labels, None)
        for name, labels in zip(("south", "north"), lists, strict=True)
    )
    without = compare_lists(AgreementRequest(paths, sensors=(SENSOR,)))
    assert any("13.9 m apart, by their poses in s110_base" in note for note in tested[0].notes)
    assert any("by their boxes, they are 13.9 m apart, turned by 35.0 degrees" in note for note in without[0].notes)
    assert any("7.50 m below the sensor (pitch -1.60, roll 1.50" in note for note in without[0].notes)
    for one, other in zip(tested, without, strict=True):
        assert total(one).found.value == pytest.approx(total(other).found.value, abs=0.01)
        assert total(one).people.value == pytest.approx(total(other).people.value, abs=0.02)  # type: ignore[union-attr]


@pytest.mark.slow
def test_tables_and_lists_in_one_frame(tmp_path: Path, lists: Lists, tested: list[ComparedList]) -> None:
    first, second = lists
    paths = two_sensors.write_table(tmp_path / "a.csv", first), two_sensors.write_table(tmp_path / "b.csv", second)
    by_table = compare_lists(AgreementRequest(paths, sensors=(SENSOR, SENSOR), columns=COLUMNS))
    assert total(by_table[0]).found.value == pytest.approx(total(tested[0]).found.value, abs=0.01)
    assert any("Headings are taken as x-ccw, which the labels do not state" in note for note in by_table[0].notes)
    same = compare_lists(AgreementRequest((paths[0], paths[0]), columns=COLUMNS))
    assert total(same[0]).found.value == 1.0 and total(same[0]).people is None
    assert not any("apart" in note for note in same[0].notes)


def detections_of(labels: list[Labels], seed: int = 5) -> tuple[list[Labels], list[FloatArray]]:
    """Return 80 % of the boxes, at scores from 0.4 on, and two of nothing in each sweep, below."""
    rng = np.random.default_rng(seed)
    detections, scores = [], []
    for item in labels:
        rows = np.flatnonzero(rng.random(len(item.names)) < 0.8)
        nothing = np.array([[x, 200.0, -7.0, 4.0, 2.0, 1.5, 0.0] for x in (0.0, 30.0)])
        boxes = np.concatenate([item.boxes[rows] + [0.9, 0, 0, 0, 0, 0, 0], nothing])
        names = tuple(f"d{row}" for row in range(len(boxes)))
        classes = (*(item.classes[row] for row in rows.tolist()), "CAR", "CAR")
        detections.append(Labels(names, classes, boxes, item.time_s))
        scores.append(np.concatenate([rng.uniform(0.4, 1.0, len(rows)), [0.1, 0.2]]))
    return detections, scores


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["kitti", "table", "openlabel"])
def test_detections_take_the_place_of_a_second_list(tmp_path: Path, lists: Lists, kind: str) -> None:
    labels, columns = lists[0], COLUMNS if kind == "table" else None
    detections, scores = detections_of(labels)
    if kind == "kitti":
        of = two_sensors.write_dair(tmp_path / "labels", labels)
        found = two_sensors.write_kitti(tmp_path / "detections", detections, scores)
    elif kind == "table":
        of = two_sensors.write_table(tmp_path / "labels.csv", labels)
        found = two_sensors.write_table(tmp_path / "detections.csv", detections, scores)
    else:
        of = two_sensors.write_openlabel(tmp_path / "labels", labels, POSES[0])
        found = two_sensors.write_openlabel(tmp_path / "detections", detections, None, scores)
    (result,) = compare_lists(AgreementRequest((of,), found, sensors=(SENSOR,), columns=columns))
    assert result.is_detections and result.sweeps == len(labels)
    cars = total(result)
    assert cars.found_nearer.value == pytest.approx(0.8, abs=0.08) and cars.people is not None
    everything, low, *_, high = result.score_rows
    assert everything.detections == sum(len(item.names) for item in detections) and everything.alone >= 2.0
    assert low.score == 0.3 and low.alone < 0.2 and low.found_nearer == everything.found_nearer
    assert high.found_nearer.value < low.found_nearer.value


def test_empty_sweeps_of_a_detector_count(tmp_path: Path, lists: Lists) -> None:
    """A sweep without detections is a sweep in which nothing was found, not one that is missing."""
    labels = lists[0][:20]
    nothing = [replace(item, names=(), classes=(), boxes=np.empty((0, 7))) for item in labels]
    of = two_sensors.write_dair(tmp_path / "labels", labels)
    for name, write in (("kitti", two_sensors.write_kitti), ("dair", two_sensors.write_dair)):
        mixed = [*labels[:10], *nothing[10:]]
        (result,) = compare_lists(AgreementRequest((of,), write(tmp_path / name, mixed)))
        boxes = sum(len(item.names) for item in labels)
        found = sum(row.found.value * row.boxes for row in result.rows if row.low == 0.0 and row.high == 80.0)
        assert result.sweeps == 20
        assert found < boxes - sum(len(item.names) for item in labels[10:]) + 0.5


def test_places_that_a_list_never_labels_are_left_out(tmp_path: Path) -> None:
    """One list has another car in each sweep at a place where the other one never has any, and one where both have."""
    size, both, here = (4.2, 1.9, 1.6), [], []
    for number in range(30):
        near = [[20.0 + (number % 7), 3.0, -6.2, *size, 0.0], [5.0, 25.0 + number % 5, -6.2, *size, 1.6]]
        far = [-45.0 + number % 6, 4.0, -6.2, *size, 0.0]
        time_s = two_sensors.FIRST_S + 10.0 * number
        both.append(Labels(("a", f"b{number}"), ("CAR", "CAR"), np.array(near), time_s))
        here.append(Labels(("a", f"b{number}", f"c{number}"), ("CAR",) * 3, np.array([*near, far]), time_s))
    paths = tuple(
        two_sensors.write_openlabel(tmp_path / name, labels, POSES[0])
        for name, labels in (("first", both), ("second", here))
    )
    (first, second) = compare_lists(AgreementRequest(paths))
    expected = "30 boxes at places where this list never has one, although 20 or more different objects were there"
    assert any(expected in note and "with them, it has 67 % of the cars" in note for note in first.notes)
    assert (total(first).boxes, total(first).found.value) == (60, 1.0)
    assert not any("at places" in note for note in second.notes) and total(second).found.value == 1.0


def test_few_sweeps_say_so(tmp_path: Path, lists: Lists) -> None:
    paths = tuple(
        two_sensors.write_openlabel(tmp_path / name, labels[40:43], pose)
        for name, labels, pose in zip(("south", "north"), lists, POSES, strict=True)
    )
    (first, _) = compare_lists(AgreementRequest(paths, sensors=(SENSOR,)))
    notes = " ".join(first.notes)
    assert "fewer than 5 times 20 s" in notes and "an anchor, not a validation" in notes
    assert math.isnan(total(first).by_chance.value)


@pytest.mark.slow
def test_lists_of_other_instants_are_refused(tmp_path: Path, folders: tuple[Path, Path], lists: Lists) -> None:
    later = [replace(item, time_s=item.time_s + 5000.0) for item in lists[1]]
    other = two_sensors.write_openlabel(tmp_path / "north", later, POSES[1])
    with pytest.raises(InputError, match=r"expected sweeps of the same instants as north .*got others"):
        compare_lists(AgreementRequest((folders[0], other)))
    named = two_sensors.write_kitti(tmp_path / "named", lists[1])
    with pytest.raises(InputError, match=r"expected sweeps named as those of"):
        compare_lists(AgreementRequest((folders[0], named)))


def test_lists_without_road_users_in_reach_are_refused(tmp_path: Path, lists: Lists) -> None:
    labels = lists[0][:10]
    of = two_sensors.write_openlabel(tmp_path / "labels", labels, None)
    unknown = [replace(item, classes=("OTHER",) * len(item.names)) for item in labels]
    far = [replace(item, boxes=item.boxes + np.array([500.0, 0, 0, 0, 0, 0, 0])) for item in labels]
    for name, boxes in (("unknown", unknown), ("far", far)):
        path = two_sensors.write_openlabel(tmp_path / name, boxes, None)
        with pytest.raises(InputError, match=rf"{name}: expected vehicles or people within 120 m.*got none"):
            compare_lists(AgreementRequest((path,), of))


@pytest.mark.slow
def test_a_detector_that_finds_nothing_has_no_labelled_area(tmp_path: Path, lists: Lists) -> None:
    labels = lists[0]
    nothing = [replace(item, names=(), classes=(), boxes=np.empty((0, 7))) for item in labels]
    of = two_sensors.write_kitti(tmp_path / "labels", labels)
    (result,) = compare_lists(AgreementRequest((of,), two_sensors.write_kitti(tmp_path / "none", nothing)))
    cars = sum(item.classes.count("CAR") for item in labels)
    assert total(result).found.value == 0.0 and sum(row.boxes for row in result.rows if row.group == "cars") >= cars
    assert any("the frames of the lists may differ" in note for note in result.notes)


@pytest.mark.slow
def test_frames_that_do_not_fit_are_refused() -> None:
    """Boxes that have nothing to do with one another."""
    rng = np.random.default_rng(1)
    centres = [(rng.uniform(-60, 60, (12, 2)), rng.uniform(-60, 60, (12, 2))) for _ in range(30)]
    with pytest.raises(InputError, match=r"the frames of the lists do not fit.*--site"):
        find_pose(centres, "a, b")


def test_pose_is_recovered_and_shared_frame_detected() -> None:
    rng = np.random.default_rng(2)
    centres, same = [], []
    for _ in range(20):
        first = rng.uniform(-50, 50, (8, 2))
        angle = math.radians(121.0)
        turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        centres.append((first, (first @ turn + (8.0, -20.0))[2:] + 0.1 * rng.standard_normal((6, 2))))
        same.append((first, first[2:]))
    pose = find_pose(centres, "a, b")
    assert math.degrees(pose.turn_rad) == pytest.approx(121.0, abs=0.2)
    assert (pose.x_m, pose.y_m) == pytest.approx((8.0, -20.0), abs=0.1)
    assert find_pose(same, "a, b") == SAME


@pytest.mark.slow
def test_prints_tables_and_writes_the_page(folders: tuple[Path, Path], tmp_path: Path, run_egvs: Any) -> None:
    out = tmp_path / "out"
    south, north = folders
    code, printed, error = run_egvs("validate", "--labels", south, "--labels", north, "--sensor", SENSOR, "--out", out)
    assert code == 0, error
    assert "Of what north has, what do the labels south have? (± 2 se)" in printed
    assert "people should notice" in printed and "labelled within 3 m" in printed
    values = json.loads((out / "against.json").read_text(encoding="utf-8"))
    assert [item["name"] for item in values] == ["south", "north"] and values[0]["rows"][0]["group"] == "cars"
    page = (out / "against.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 2 and "people should notice" in page and "Of what south has" in page


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--labels", "{0}"), "--labels: expected two lists without sweeps, got one"),
        (("--labels", "{0}", "--labels", "{1}", "--detections", "{1}"), "--labels: expected the labels of one sensor"),
        (("--labels", "{0}", "--labels", "{1}", *(("--sensor", SENSOR) * 3)), "--sensor: expected one sensor for each"),
        (("--labels", "{0}", "--labels", "{1}", "--site", "a"), "--site: expected a scenario, and a site for each"),
        (("--labels", "{0}", "--labels", "{1}", "--sensor", "OS1"), "--sensor: unknown sensor 'OS1'"),
        (("--labels", "{0}", "--labels", "{0}/none"), "none"),
    ],
)
def test_wrong_input_gives_one_message(
    folders: tuple[Path, Path], tmp_path: Path, run_egvs: Any, arguments: tuple[str, ...], message: str
) -> None:
    out = tmp_path / "out"
    code, _, error = run_egvs("validate", *(text.format(*folders) for text in arguments), "--out", out)
    assert code == 2 and message in error and "Traceback" not in error
    assert not out.exists()
