"""How many vehicles are seen well where: a hidden lane by hand, and against plain Python and shapely."""

from __future__ import annotations

import math
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from egvs.core.grid import Grid
from egvs.scoring.blindspots import VehicleSpots, cells_of
from egvs.scoring.road_locations import RoadLocations
from egvs.scoring.targets import TargetRecord
from tests.scoring.roads import GRID, read
from tests.scoring.target_scenes import frame

CAR = (4.0, 1.8, 1.5)


def car(x, y, yaw=0.0):
    """A car whose front is at x, y."""
    return (x - 2.0 * math.cos(yaw), y - 2.0 * math.sin(yaw), 0.75, *CAR, yaw)


def spots_of(record, roads=None, weight=None, period=None) -> VehicleSpots:
    weight = np.ones(len(record)) if weight is None else np.array(weight)
    period = np.zeros(len(record), dtype=np.int64) if period is None else np.array(period)
    return VehicleSpots.of(record, roads, weight, period)


def by_place(spots: VehicleSpots, counts) -> dict[tuple[str, str], int]:
    """Counts of the places that are no squares."""
    names = [(place.by, place.name) for place in spots.locations]
    return dict(zip(names, np.asarray(counts)[: len(names)].tolist(), strict=True))


def well_visible(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points, and a certain detection with at least 20 of them."""
    return points, (points >= 20).astype(np.float64)


def test_a_hidden_lane_by_hand(tmp_path: Path) -> None:
    """Two frames of a two-lane approach: of three cars in the left-turn lane one is seen, of three others all."""
    first = frame([car(25, -1.6), car(20, -1.6), car(25, -4.8), car(32, -4.8)], vehicles=("a", "b", "c", "d"))
    later = frame([car(29, -1.6), car(20, 10), car(41, -4.8)], number=9, vehicles=("b", "e", "c"))
    record = TargetRecord.of([first, later], GRID)
    spots = spots_of(record, RoadLocations.of(read(tmp_path), GRID.roi))
    found = spots.visibility(*well_visible(np.array([19.0, 20.0, 25.0, 1000.0, 0.0, 21.0, 20.0])))
    assert by_place(spots, spots.vehicle_frames) == {
        ("all", ""): 7,
        ("no lane", ""): 1,
        ("approach", "near"): 4,
        ("exit", "out"): 1,
        ("lane", "near_1"): 1,
        ("lane", "near_2"): 3,
        ("lane", "out_0"): 1,
        ("turn", "near:straight"): 1,
        ("crossing", ":j_c0_0"): 1,
    }
    assert by_place(spots, spots.vehicles) == {
        ("all", ""): 5,
        ("no lane", ""): 1,
        ("approach", "near"): 3,
        ("exit", "out"): 1,
        ("lane", "near_1"): 1,
        ("lane", "near_2"): 2,
        ("lane", "out_0"): 1,
        ("turn", "near:straight"): 1,
        ("crossing", ":j_c0_0"): 1,
    }
    assert by_place(spots, found.with_points) == {
        ("all", ""): 5,
        ("no lane", ""): 1,
        ("approach", "near"): 2,
        ("exit", "out"): 1,
        ("lane", "near_1"): 1,
        ("lane", "near_2"): 1,
        ("lane", "out_0"): 1,
        ("turn", "near:straight"): 1,
        ("crossing", ":j_c0_0"): 1,
    }
    assert found.share == pytest.approx(found.with_points / spots.vehicle_frames)
    left = [place.name for place in spots.locations].index("near_2")
    assert spots.at_m[left].tolist() == pytest.approx([(23 + 18 + 27) / 3, -1.6])


def test_squares_by_hand() -> None:
    """A car over four squares from west to east, and half of those beside; both ways round the same."""
    record = TargetRecord.of([frame([(12.0, -17.5, 0.75, 4.0, 0.9, 1.5, yaw) for yaw in (0.0, math.pi)])], GRID)
    spots = spots_of(record)
    assert spots.cells.tolist() == [[10, 2], [11, 2], [12, 2], [13, 2]]
    assert spots.vehicle_frames.tolist() == [2, 2, 2, 2, 2] and spots.vehicles.tolist() == [2, 2, 2, 2, 2]
    assert spots.at_m[1:].tolist() == [[10.5, -17.5], [11.5, -17.5], [12.5, -17.5], [13.5, -17.5]]
    assert [place.by for place in spots.locations] == ["all"]


def test_a_vehicle_that_covers_no_middle_is_where_its_own_is() -> None:
    row, cell = cells_of(np.array([(3.05, -19.05, 0.5, 0.4, 0.3, 1.0, 0.3)]), GRID.roi)
    assert (row.tolist(), cell.tolist()) == ([0], [[3, 0]])


def test_squares_end_with_the_region() -> None:
    odd = Grid((0.0, 0.0, 0.0), 0.5, (5, 3, 4))  # 2.5 m x 1.5 m: the last squares reach out of it
    row, cell = cells_of(np.array([(1.0, 1.0, 0.5, 9.0, 9.0, 1.0, 0.0)]), odd.roi)
    assert cell.tolist() == [[x, y] for x in range(3) for y in range(2)] and set(row.tolist()) == {0}


def slow_cells(box, roi):
    """Every square of the region, with shapely."""
    x, y, _, length, width, _, yaw = box
    c, s = math.cos(yaw), math.sin(yaw)
    corners = [
        (x + a * c * length / 2 - b * s * width / 2, y + a * s * length / 2 + b * c * width / 2)
        for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))
    ]
    area = shapely.buffer(shapely.Polygon(corners), -1e-4, join_style="mitre")
    (ox, oy, _), (w, h, _) = roi.origin_m, roi.size_m
    return {
        (i, j)
        for i in range(math.ceil(w))
        for j in range(math.ceil(h))
        if area.contains(shapely.Point(ox + i + 0.5, oy + j + 0.5))
        or (math.floor(x - ox), math.floor(y - oy)) == (i, j)
    }


@pytest.mark.slow
@given(st.integers(0, 10_000))
def test_counts_against_plain_python(seed):
    rng, small = np.random.default_rng(seed), Grid((100.0, 200.0, 0.0), 0.5, (25, 16, 8))
    frames = []
    for number in range(3):
        count = int(rng.integers(0, 5))
        boxes = np.column_stack([
            rng.uniform(99, 113, count), rng.uniform(199, 209, count), np.ones(count), rng.uniform(0.3, 9, count),
            rng.uniform(0.3, 3, count), np.ones(count), rng.uniform(-4, 4, count),
        ])  # fmt: skip
        names = [f"v{i}" for i in rng.permutation(6)[:count]]
        frames.append(frame(boxes, number=number, vehicles=names))
    record = TargetRecord.of(frames, small)
    points, weight = rng.integers(0, 40, len(record)).astype(np.float64), rng.uniform(0.5, 3, len(record))
    period = (record.frame > 0).astype(np.int64)
    spots = spots_of(record, weight=weight, period=period)
    chances = rng.uniform(0, 1, len(record))
    found = spots.visibility(points, chances)
    who, counted, well, weighed = defaultdict(set), defaultdict(int), defaultdict(int), defaultdict(list)
    for i in range(len(record)):
        for cell in slow_cells(record.boxes[i], small.roi):
            who[cell].add((record.vehicle[i], record.frame[i] > 0))
            counted[cell] += 1
            well[cell] += int(points[i] >= 20)
            weighed[cell] += [(record.vehicle[i], record.frame[i] > 0, weight[i], chances[i])]
    first = len(spots.locations)
    assert first == (1 if len(record) else 0)
    cells = list(map(tuple, spots.cells.tolist()))
    assert cells == sorted(counted)
    assert spots.vehicle_frames[first:].tolist() == [counted[cell] for cell in cells]
    assert spots.vehicles[first:].tolist() == [len(who[cell]) for cell in cells]
    assert found.with_points[first:].tolist() == [well[cell] for cell in cells]
    assert found.with_points[:first].tolist() == [int((points >= 20).sum())] * first
    slow = [share_slowly(weighed[cell]) for cell in cells]
    assert found.share[first:] == pytest.approx([share for share, _ in slow])
    assert found.se[first:] == pytest.approx([se for _, se in slow], nan_ok=True)


def share_slowly(rows):
    """A ratio of sums over vehicles, and its textbook error, of (vehicle, period, weight, chance)."""
    total = math.fsum(weight for *_, weight, _ in rows)
    share = math.fsum(weight * seen for *_, weight, seen in rows) / total
    vehicles = {row[:2] for row in rows}
    squares = [math.fsum(w * (seen - share) for *who, w, seen in rows if tuple(who) == its) ** 2 for its in vehicles]
    count = len(vehicles)
    return share, math.sqrt(math.fsum(squares) * count / (count - 1)) / total if count > 1 else math.nan


def test_the_standard_error_is_that_of_vehicles_looked_at_once_or_always_alike() -> None:
    """Ten cars, of which four are missed: as of ten throws of a coin, however often each is looked at."""
    cars = [car(5 + 5 * i, 10) for i in range(10)]
    once = TargetRecord.of([frame(cars)], GRID)
    often = TargetRecord.of([frame(cars, number=number) for number in range(7)], GRID)
    points = np.where(np.arange(10) < 4, 0.0, 50.0)
    for record, its in ((once, points), (often, np.tile(points, 7))):
        found = spots_of(record).visibility(*well_visible(its))
        assert (found.share[0], found.se[0]) == pytest.approx((0.6, math.sqrt(0.6 * 0.4 / 9)))
    assert np.isnan(spots_of(once).visibility(*well_visible(points)).se[1:]).all()  # one car over each square


def test_cars_of_one_name_in_two_periods_are_two() -> None:
    frames = [frame([car(20, 10)], number=number) for number in (0, 1)]
    record = TargetRecord.of(frames, GRID)
    assert spots_of(record, period=[0, 0]).vehicles.tolist()[0] == 1
    assert spots_of(record, period=[0, 1]).vehicles.tolist()[0] == 2


def test_weights_count_in_shares() -> None:
    record = TargetRecord.of([frame([car(20, 10), car(40, 10)])], GRID)
    spots = spots_of(record, weight=[3.0, 1.0])
    found = spots.visibility(*well_visible(np.array([20.0, 0.0])))
    assert (found.with_points[0], found.share[0], spots.weights[0]) == (1, 0.75, 4.0)


def test_a_rear_part_is_where_its_own_front_is(tmp_path: Path) -> None:
    train = frame([car(34, -4.8), car(29.5, -4.8)], vehicles=("bus", "bus"), part=[0, 1])
    spots = spots_of(TargetRecord.of([train], GRID), RoadLocations.of(read(tmp_path), GRID.roi))
    found = by_place(spots, spots.vehicle_frames)
    assert (found["turn", "near:straight"], found["lane", "near_1"], found["all", ""]) == (1, 1, 2)
    assert by_place(spots, spots.vehicles)["all", ""] == 1


def test_people_whom_a_score_counts_are_no_vehicles(tmp_path: Path) -> None:
    walk = (38.0, -4.8, 0.9, 0.5, 0.5, 1.8, 1.6)
    mixed = frame([walk, car(41, -4.8), walk], ("pedestrian", "passenger", "bicycle"), vehicles=("a", "b", "c"))
    roads = RoadLocations.of(read(tmp_path), GRID.roi)
    both = spots_of(TargetRecord.of([mixed], GRID, people=("pedestrian", "bicycle")), roads)
    alone = spots_of(TargetRecord.of([mixed], GRID), roads)
    assert by_place(both, both.vehicle_frames) == by_place(alone, alone.vehicle_frames)
    assert both.cells.tolist() == alone.cells.tolist()
    assert (
        both.visibility(*well_visible(np.array([50.0, 0.0, 50.0]))).with_points.sum()
        == 0
        < both.visibility(*well_visible(np.array([0.0, 20.0, 0.0]))).with_points.sum()
    )


def test_crossings_against_shapely(tmp_path: Path) -> None:
    """Also a bus whose rear alone reaches onto it, and a car that ends at its very edge, which does not."""
    rng = np.random.default_rng(3)
    boxes = [
        (*rng.uniform((30, -10), (46, 3)), 0.75, *rng.uniform((2, 1), (12, 3)), 1.5, rng.uniform(-4, 4))
        for _ in range(60)
    ]
    boxes += [car(36.0, -4.8), car(36.001, -4.8)]
    record = TargetRecord.of([frame(boxes)], GRID)
    spots = spots_of(record, RoadLocations.of(read(tmp_path), GRID.roi))
    area, on = shapely.box(36, -8, 40, 1), 0
    for x, y, _, length, width, _, yaw in record.boxes:
        half, turn = shapely.box(-length / 2, -width / 2, length / 2, width / 2), (math.cos(yaw), math.sin(yaw))
        placed = shapely.transform(
            half,
            lambda p, t=turn, x=x, y=y: np.column_stack(
                [x + p[:, 0] * t[0] - p[:, 1] * t[1], y + p[:, 0] * t[1] + p[:, 1] * t[0]]
            ),
        )
        on += placed.intersection(area).area > 1e-3
    assert by_place(spots, spots.vehicle_frames)["crossing", ":j_c0_0"] == on


def test_no_vehicles(tmp_path: Path) -> None:
    record = TargetRecord.of([frame([])], GRID)
    spots = spots_of(record, RoadLocations.of(read(tmp_path), GRID.roi))
    assert len(spots) == 0 and spots.visibility(np.empty(0), np.empty(0)).share.shape == (0,)
