"""Queues and speeds on an approach: numbers that can be checked by hand, and a slow twin."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egvs.traffic import approach_queues
from egvs.traffic.approach_queues import ApproachPath, VehicleFrames, measure_approach, queue_lengths_m

# vehicles arrive from the south on x = 2 and stop at y = 0
PATH = ApproachPath("North Street (south)", np.array([[2.0, 0.0], [2.0, -150.0], [2.0, -400.0]]), 3.0)


def frames(*rows: tuple[int, int, float, float], yaw_rad: float = math.pi / 2, period_s: float = 1.0) -> VehicleFrames:
    """Boxes of 4 m from rows of frame, vehicle, x and y."""
    frame, vehicle, x_m, y_m = np.array(rows, dtype=np.float64).T
    return VehicleFrames(
        frame.astype(np.int64), vehicle.astype(np.int64), np.column_stack([x_m, y_m]),
        np.full(len(frame), yaw_rad), np.full(len(frame), 4.0), period_s,
    )  # fmt: skip


def standing(*y_m: float, count: int = 10) -> list[tuple[int, int, float, float]]:
    return [(frame, number, 2.0, y) for number, y in enumerate(y_m) for frame in range(count)]


def test_queue_reaches_to_the_rear_of_its_last_vehicle() -> None:
    traffic = measure_approach(PATH, frames(*standing(-3.0, -10.0, -17.0)), 0, 10)
    assert traffic.queue_m == traffic.mean_queue_m == 19.0
    assert (traffic.speed_kmh, traffic.vehicles) == (0.0, 3)


def test_vehicle_far_behind_is_no_part_of_the_queue() -> None:
    boxes = frames(*standing(-3.0, -27.0, -60.0))  # gaps of 20 m and of 29 m
    assert measure_approach(PATH, boxes, 0, 10).queue_m == 29.0


def test_stop_far_from_the_stop_line_is_no_queue() -> None:
    assert measure_approach(PATH, frames(*standing(-30.0)), 0, 10).queue_m == 0.0


def test_oncoming_crossing_and_distant_vehicles_do_not_count() -> None:
    oncoming = frames(*standing(-3.0), yaw_rad=-math.pi / 2)
    crossing = frames(*standing(-3.0), yaw_rad=0.0)
    beside = frames(*[(frame, 0, 6.0, -3.0) for frame in range(10)])
    beyond = frames(*standing(5.0))
    for boxes in (oncoming, crossing, beside, beyond):
        traffic = measure_approach(PATH, boxes, 0, 10)
        assert (traffic.queue_m, traffic.vehicles) == (0.0, 0)
        assert math.isnan(traffic.speed_kmh)


def test_speed_is_distance_by_time_in_the_last_100_m() -> None:
    drives = [(frame, 0, 2.0, -90.0 + 10.0 * frame) for frame in range(8)]  # 36 km/h
    fast = [(frame, 1, 2.0, -380.0 + 20.0 * frame) for frame in range(8)]  # not within 100 m
    stands = [(frame, 2, 2.0, -3.0) for frame in range(8)]
    traffic = measure_approach(PATH, frames(*drives, *fast, *stands), 0, 8)
    assert traffic.speed_kmh == pytest.approx(18.0)
    assert traffic.vehicles == 3


def test_period_between_frames_and_window_count() -> None:
    boxes = frames(*standing(-3.0, count=5), *[(frame, 9, 2.0, -50.0 + frame) for frame in range(5, 10)], period_s=0.5)
    assert measure_approach(PATH, boxes, 0, 5).queue_m == 5.0
    later = measure_approach(PATH, boxes, 5, 10)
    assert (later.queue_m, later.speed_kmh) == (0.0, pytest.approx(7.2))


def test_queue_that_is_compared_is_the_95th_percentile() -> None:
    boxes = frames(*[(frame, 0, 2.0, -3.0) for frame in range(100)], *[(frame, 1, 2.0, -10.0) for frame in range(0, 4)])
    traffic = measure_approach(PATH, boxes, 0, 100)
    assert traffic.queue_m == 5.0
    assert traffic.mean_queue_m == pytest.approx(5.0 + 4 * 7.0 / 100)


def test_speeds_need_consecutive_frames() -> None:
    boxes = frames((0, 0, 2.0, -9.0), (1, 0, 2.0, -7.0), (3, 0, 2.0, -1.0), (2, 1, 2.0, -5.0))
    assert boxes.speeds_m_s().tolist()[:2] == [2.0, 2.0]
    assert np.isnan(boxes.speeds_m_s()[2:]).all()


def plain_queue_m(vehicles: list[tuple[float, float]]) -> float:
    """Return the length of a queue of vehicles (distance of the centre, half the length): the slow twin."""
    length_m = 0.0
    for distance_m, half_m in sorted(vehicles):
        if distance_m - half_m - length_m > approach_queues.MAX_GAP_M:
            break
        length_m = max(length_m, distance_m + half_m)
    return length_m


@pytest.mark.slow
@given(
    st.lists(
        st.tuples(st.integers(0, 3), st.floats(0, 200), st.just(2.0)),
        max_size=30,
    )
)
def test_queues_agree_with_the_slow_twin(vehicles: list[tuple[int, float, float]]) -> None:
    frame = np.array([row[0] for row in vehicles], dtype=np.int64)
    distance_m = np.array([row[1] for row in vehicles], dtype=np.float64)
    half_m = np.array([row[2] for row in vehicles], dtype=np.float64)
    expected = [plain_queue_m([row[1:] for row in vehicles if row[0] == number]) for number in range(4)]
    assert queue_lengths_m(frame, distance_m, half_m, 4).tolist() == expected
