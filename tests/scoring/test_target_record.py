"""Which vehicles are to be seen, where they stand: against shapely, and by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from egvs.artefacts import parquet
from egvs.core.errors import InputError
from egvs.scenario.score_config import DEFAULT_SAMPLED_FRAMES
from egvs.scoring.targets import TargetRecord
from tests.scoring.target_scenes import GRID, axes_of, frame, random_boxes

CAR = (4.0, 2.0, 1.5)


def at(x, y, yaw=0.0, size=CAR):
    """A box on the ground, x and y from the region's corner."""
    return (100.0 + x, 200.0 + y, size[2] / 2, *size, yaw)


def footprint(box, pitch=0.0):
    """What a box covers in plan, as shapely has it: the hull of its corners."""
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T * box[3:6] @ axes_of(box[6], pitch)
    return shapely.MultiPoint(np.array(box[:2]) + corners[:, :2]).convex_hull


def test_rows_are_vehicles_in_the_region_frame_after_frame():
    first = frame(
        [at(5, 5), at(-1, 5), at(8, 9), at(10, 10), at(20, 9)],
        ("taxi", "bus", "pedestrian", "truck", "truck"),
        [0.0, 0.0, 0.0, 0.1, 0.0],
        7,
        ("b", "out", "walker", "a", "a"),
        [0, 0, 0, 0, 1],
    )
    record = TargetRecord.of(
        [first, frame([], number=9), frame([at(6, 5)], ("taxi",), number=12, vehicles=["b"])], GRID
    )
    assert len(record) == 4 and record.numbers.tolist() == [7, 9, 12] and record.frame.tolist() == [0, 0, 0, 2]
    assert [record.vehicles[i] for i in record.vehicle] == ["b", "a", "a", "b"] and record.vehicles == ("a", "b")
    assert [record.kinds[i] for i in record.kind] == ["taxi", "truck", "truck", "taxi"]
    assert record.part.tolist() == [0, 0, 1, 0] and record.pitch_rad.tolist() == [0.0, 0.1, 0.0, 0.0]
    np.testing.assert_array_equal(record.boxes[[0, 3]], [at(5, 5), at(6, 5)])
    np.testing.assert_array_equal(record.row, [0, 3, 4, 5])


def test_a_record_may_be_empty():
    for frames in ([], [frame([])], [frame([at(-9, 5)])]):
        record = TargetRecord.of(frames, GRID)
        assert len(record) == 0 and record.vehicles == () and record.gap_m.shape == (0,)


@pytest.mark.parametrize(
    ("other", "gap_m"),
    [
        (at(16.0, 10.0), 2.0),  # behind one another: 6 m between centres
        (at(10.0, 13.0), 1.0),  # side by side
        (at(17.0, 16.0), 5.0),  # 3 m on and 4 m aside
        (at(13.9, 11.9), 0.0),  # corners overlap
        (at(10.0, 10.0, math.pi / 2), 0.0),  # a cross, no corner of one in the other
        (at(14.0, 10.0), 0.0),  # they touch
        (at(10.0 + 2.0 + math.sqrt(5.0), 10.0, math.atan2(1.0, 2.0)), 0.108),  # by a corner, computed below
    ],
)
def test_gap_to_the_nearest_neighbour(other, gap_m):
    if gap_m == 0.108:
        gap_m = math.sqrt(5.0) - (2.0 * math.cos(math.atan2(1.0, 2.0)) + 1.0 * math.sin(math.atan2(1.0, 2.0)))
    record = TargetRecord.of([frame([at(10.0, 10.0), other])], GRID)
    assert record.gap_m == pytest.approx([gap_m, gap_m], abs=1e-12)


def test_neighbours_are_all_vehicles_of_the_frame_and_parts_but_no_people():
    walker, outside = at(13, 10), at(-3, 10)
    here = frame([at(10, 10), walker, outside], ("taxi", "bicycle", "bus"))
    record = TargetRecord.of([here, frame([at(10, 10)]), frame([at(10, 10), at(20, 10)])], GRID)
    assert record.gap_m.tolist() == [9.0, math.inf, 6.0, 6.0]
    jointed = frame([at(10, 10), at(14.5, 10)], ("truck", "truck"), vehicles=("t", "t"), part=[0, 1])
    assert TargetRecord.of([jointed], GRID).gap_m.tolist() == [0.5, 0.5]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_gaps_are_shapelys(seed):
    rng = np.random.default_rng(seed)
    frames = []
    for number in range(2):
        boxes = random_boxes(rng, int(rng.integers(1, 15)))
        pitch = rng.uniform(-0.3, 0.3, len(boxes)) * rng.integers(0, 2, len(boxes))
        frames.append(frame(boxes, rng.choice(["bus", "pedestrian"], len(boxes), p=[0.8, 0.2]), pitch, number))
    record = TargetRecord.of(frames, GRID)
    gaps = []
    for one in frames:
        prints = [footprint(box, pitch) for box, pitch in zip(one.boxes, one.pitch_rad, strict=True)]
        for row in one.target_rows(GRID.roi):
            others = [p for i, p in enumerate(prints) if i != row and one.kinds[i] == "bus"]
            gaps.append(min((prints[row].distance(p) for p in others), default=math.inf))
    np.testing.assert_allclose(record.gap_m, gaps, atol=1e-9)


def test_frames_are_spread_over_the_record(tmp_path):
    names = ("frame", "vehicle", "part", "kind", "x_m", "y_m", "z_m", "yaw_rad", "pitch_rad")
    columns = {name: [] for name in (*names, "length_m", "width_m", "height_m")}
    for number in range(0, 600, 2):  # every other frame is empty
        for name, value in zip(columns, (number, "v", 0, "bus", 110.0, 205.0, 1.0, 0.0, 0.0, *CAR), strict=True):
            columns[name].append(value)
    path = tmp_path / "trajectories.parquet"
    parquet.write_artefact(path, "trajectories", columns, {"schema": parquet.SCHEMA_VERSION, "frames": 600})
    record = TargetRecord.read(path, GRID)
    assert len(record.numbers) == DEFAULT_SAMPLED_FRAMES == 250 and record.numbers[[0, -1]].tolist() == [1, 598]
    assert len(record) == (record.numbers % 2 == 0).sum()
    assert TargetRecord.read(path, GRID, 3).numbers.tolist() == [100, 300, 500]
    assert len(TargetRecord.read(path, GRID, 0).numbers) == 600
    path.write_bytes(b"no table")
    with pytest.raises(InputError, match=r"trajectories\.parquet"):
        TargetRecord.read(path, GRID)
