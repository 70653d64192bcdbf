"""How crowded vehicles are as seen from a site: by hand, and against a twin made of shapely and plain geometry."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from benchmarks.across_junctions.models import crowding
from benchmarks.across_junctions.models.crowding import MAX_BESIDE_DEG, MAX_LINK_GAP, NEIGHBOUR_M, measure_crowding
from benchmarks.across_junctions.models.crowding_kernels import RAY_SHARES
from shapely import affinity

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.scoring.target_scores import MAX_SPACING_M, point_spacing_m
from tests.scoring.target_scenes import axes_of, beams_to, entered_m, frame, random_boxes, seen
from tests.scoring.test_visible_targets import AT, fan


def box(x, y, length=4.0, width=2.0, yaw=0.0):
    """A box of 1.5 m height, x and y from the sensor."""
    return (AT[0] + x, AT[1] + y, 0.75, length, width, 1.5, yaw)


@pytest.mark.slow
def test_a_queue_ahead_by_hand():
    # three cars in a line along x: 10 to 14, 16 to 20, 23 to 27
    queue = [box(12.0, 0.0), box(18.0, 0.0), box(25.0, 0.0)]
    found = measure_crowding(seen([frame(queue)], fan()))
    # the outer rays are at 98 % of the half width of what is shared, at most 4 degrees: cosines above 0.995
    assert found.front_gap_m == pytest.approx([NEIGHBOUR_M, 2.0, 3.0], rel=6e-3)
    assert found.behind_gap_m == pytest.approx([2.0, 3.0, NEIGHBOUR_M], rel=6e-3)
    assert found.beside_gap_deg.tolist() == [MAX_BESIDE_DEG] * 3 and found.beside_gap_m.tolist() == [NEIGHBOUR_M] * 3
    assert found.incidence_deg[0] == pytest.approx(math.degrees(math.atan(0.25 / 12.0)))
    # end on: 2 m wide, 1.5 m high, and a little of the roof
    visible = seen([frame(queue[:1])], fan())
    tilt = math.atan(0.25 / 12.0)
    area = math.cos(tilt) * 3.0 + math.sin(tilt) * 8.0
    assert point_spacing_m(visible) == pytest.approx([math.sqrt(area / visible.points_alone[0])])


@pytest.mark.slow
def test_adjacent_lanes_by_hand():
    # sides at y = 1 and 2.2 from x = 20 to 24, seen from the origin: the near corner of the upper car is at (24, 2.2),
    # the far one of the lower car at (20, 1)
    found = measure_crowding(seen([frame([box(22.0, 0.0), box(22.0, 3.2)])], fan()))
    angle = math.atan(2.2 / 24.0) - math.atan(1.0 / 20.0)
    assert found.beside_gap_deg == pytest.approx([math.degrees(angle)] * 2)
    assert found.beside_gap_m == pytest.approx([angle * 20.0, angle * math.hypot(20.0, 2.2)])
    assert found.front_gap_m.tolist() == found.behind_gap_m.tolist() == [NEIGHBOUR_M] * 2
    assert found.hidden_share.tolist() == [0.0, 0.0]


def test_points_closer_than_the_linking_distance_by_hand():
    # rears at x = 20 and y from -2.2 to -0.2 and 0.1 to 2.1: 0.3 m apart, and their outermost points a little more
    visible = seen([frame([box(22.0, -1.2), box(22.0, 1.1)])], fan())
    found = measure_crowding(visible)
    gap = 0.3  # beams are 7 cm apart there, so both outermost points lie up to that far inside
    assert (found.link_gap > gap / 0.6).all() and (found.link_gap < (gap + 0.15) / 0.6).all()
    alone = measure_crowding(seen([frame([box(22.0, -1.2)])], fan()))
    assert alone.link_gap.tolist() == [MAX_LINK_GAP]


def test_a_vehicle_hidden_by_half_and_one_that_no_beam_would_meet():
    beams = beams_to(AT, [[30.0, -1.5, 0.0], [30.0, 1.5, 0.0]])
    hidden, near = box(20.0, 0.0, width=6.0), box(10.0, 1.0, length=2.0, width=1.5)
    visible = seen([frame([hidden, near, box(20.0, -9.0)])], beams)
    found, spacing_m = measure_crowding(visible), point_spacing_m(visible)
    assert found.hidden_share.tolist() == [0.5, 0.0, 0.0]
    assert spacing_m[2] == MAX_SPACING_M and found.link_gap[2] == MAX_LINK_GAP
    assert found.front_gap_m[0] == pytest.approx(7.0, rel=2e-3)  # from x = 11 to 18


def test_a_sensor_above_a_vehicle_has_every_neighbour_behind_it():
    found = measure_crowding(seen([frame([box(0.0, 0.0), box(6.0, 0.0)])], fan()))
    assert found.behind_gap_m[0] == pytest.approx(2.0, rel=6e-3)  # from x = 2 to 4
    assert found.front_gap_m[1] == pytest.approx(2.0, rel=6e-3)
    assert found.front_gap_m[0] == NEIGHBOUR_M and (found.beside_gap_deg == MAX_BESIDE_DEG).all()


def test_people_are_no_neighbours_and_vehicles_outside_the_region_are():
    people = frame([box(12.0, 0.0), box(8.0, 0.0)], ("passenger", "pedestrian"))
    assert measure_crowding(seen([people], fan())).front_gap_m.tolist() == [NEIGHBOUR_M]
    outside = frame([(138.0, 210.0, 0.75, 3.0, 2.0, 1.5, 0.0), (143.0, 210.0, 0.75, 3.0, 2.0, 1.5, 0.0)])
    visible = seen([outside], fan())
    found = measure_crowding(visible)
    assert found.behind_gap_m == pytest.approx([2.0], rel=6e-3) and found.link_gap.tolist() == [MAX_LINK_GAP]


def test_parts_of_one_vehicle_are_no_neighbours():
    """A truck from x = 10 to 14 with its trailer from 14.5 to 20.5, and a car from 23 to 27, which is theirs."""
    parts = np.array([box(12.0, 0.0), box(17.5, 0.0, length=6.0), box(25.0, 0.0)])
    articulated = TrafficFrame(
        0, ("lorry", "lorry", "car"), ("trailer", "trailer", "passenger"), parts, np.zeros(3), np.array([0, 1, 0])
    )
    found = measure_crowding(seen([articulated], fan()))
    assert found.front_gap_m == pytest.approx([NEIGHBOUR_M, NEIGHBOUR_M, 2.5], rel=6e-3)
    assert found.behind_gap_m == pytest.approx([9.0, 2.5, NEIGHBOUR_M], rel=6e-3)
    apart = TrafficFrame(0, ("a", "b", "car"), ("trailer", "trailer", "passenger"), parts, np.zeros(3))
    assert measure_crowding(seen([apart], fan())).behind_gap_m[0] == pytest.approx(0.5, rel=6e-3)


def test_no_vehicle_and_frames_do_not_mix():
    assert len(measure_crowding(seen([frame([])], fan())).link_gap) == 0
    found = measure_crowding(seen([frame([box(12.0, 0.0)]), frame([box(18.0, 0.0)], number=1)], fan()))
    assert found.front_gap_m.tolist() == found.behind_gap_m.tolist() == [NEIGHBOUR_M] * 2


def test_linking_distance_is_that_of_the_detector():
    from egvs.extensions.validation.detectors.clustering import Density

    assert Density().reach_m == crowding.LINK_M and Density().reach_per_range == crowding.LINK_PER_RANGE


def test_classes():
    kinds = ("passenger", "taxi", "delivery", "trailer", "coach", "moped", "tram")
    boxes = [box(10.0 + 4.0 * i, 0.0, length=3.0) for i in range(7)]
    visible = seen([frame(boxes, kinds)], beams_to(AT, []))
    names = [crowding.CLASSES[i] for i in crowding.vehicle_classes(visible.record)]
    assert names == ["car", "car", "van", "truck", "bus", "motorcycle", "car"]


# ---- the twin: polygons of shapely, angles of corners, rays cut with outlines


def outline(b):
    shape = shapely.box(-b[3] / 2, -b[4] / 2, b[3] / 2, b[4] / 2)
    return affinity.translate(affinity.rotate(shape, b[6], origin=(0, 0), use_radians=True), b[0], b[1])


def span(shape, x, y):
    """Azimuths of the right and the left end; the left is the larger."""
    if shape.contains(shapely.Point(x, y)):
        centre = math.atan2(shape.centroid.y - y, shape.centroid.x - x)
        return centre - math.pi, centre + math.pi
    corners = [math.atan2(cy - y, cx - x) for cx, cy in list(shape.exterior.coords)[:4]]
    turns = [(a - corners[0] + math.pi) % (2 * math.pi) - math.pi for a in corners]
    return corners[0] + min(turns), corners[0] + max(turns)


def ray_cut(shape, x, y, azimuth):
    ray = shapely.LineString([(x, y), (x + 500 * math.cos(azimuth), y + 500 * math.sin(azimuth))])
    cut = ray.intersection(shape)
    if cut.is_empty:
        return None
    ranges = [math.hypot(cx - x, cy - y) for cx, cy in cut.coords]
    return min(ranges), max(ranges)


def gaps_slowly(boxes, row, x, y):
    """Front, behind, beside gap (rad) of one box among those of its frame."""
    shapes, sensor = [outline(b) for b in boxes], shapely.Point(x, y)
    front, behind, beside = NEIGHBOUR_M, NEIGHBOUR_M, math.radians(MAX_BESIDE_DEG)
    near = [shape.distance(sensor) for shape in shapes]
    far = [max(math.hypot(cx - x, cy - y) for cx, cy in shape.exterior.coords) for shape in shapes]
    for other in range(len(boxes)):
        if other == row or shapes[row].distance(shapes[other]) > NEIGHBOUR_M:
            continue
        (a, b), (c, d) = span(shapes[row], x, y), span(shapes[other], x, y)
        middle, turn = (a + b) / 2, ((c + d) / 2 - (a + b) / 2 + math.pi) % (2 * math.pi) - math.pi
        low, high = max((a - b) / 2, turn - (d - c) / 2), min((b - a) / 2, turn + (d - c) / 2)
        if low >= high:
            if near[other] < far[row] and near[row] < far[other]:
                beside = min(beside, low - high)
            continue
        for share in RAY_SHARES:
            azimuth = middle + low + share * (high - low)
            own, its = ray_cut(shapes[row], x, y, azimuth), ray_cut(shapes[other], x, y, azimuth)
            if own is None or its is None:
                continue
            if its[1] <= own[0]:
                front = min(front, own[0] - its[1])
            elif own[1] <= its[0]:
                behind = min(behind, its[0] - own[1])
            elif near[other] < near[row]:
                front = 0.0
            else:
                behind = 0.0
    return front, behind, beside, near[row]


@pytest.mark.parametrize("seed", range(12))
def test_gaps_agree_with_the_twin(seed):
    rng = np.random.default_rng(seed)
    boxes = random_boxes(rng, 14)
    at = (100 + rng.uniform(-10, 50), 200 + rng.uniform(-10, 30), 4.0)
    visible = seen([frame(boxes)], beams_to(at, [[5.0, 0.0, 0.0]]))
    found = measure_crowding(visible)
    for i, row in enumerate(visible.record.row):
        front, behind, beside, near = gaps_slowly(boxes, row, *at[:2])
        assert found.front_gap_m[i] == pytest.approx(front, abs=1e-6)
        assert found.behind_gap_m[i] == pytest.approx(behind, abs=1e-6)
        assert found.beside_gap_deg[i] == pytest.approx(math.degrees(beside), abs=1e-6)
        arc = NEIGHBOUR_M if beside >= math.radians(MAX_BESIDE_DEG) else min(beside * near, NEIGHBOUR_M)
        assert found.beside_gap_m[i] == pytest.approx(arc, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_shares_spacing_and_point_gaps_agree_with_the_twin(seed):
    rng = np.random.default_rng(100 + seed)
    boxes = random_boxes(rng, 8)
    boxes[:, 2] = boxes[:, 5] / 2
    at = (92.0, 190.0, 5.0)
    ends = np.column_stack([rng.uniform(5, 60, 900), rng.uniform(5, 50, 900), rng.uniform(-9, 0, 900)])
    visible = seen([frame(boxes)], beams_to(at, ends))
    found, spacing_m = measure_crowding(visible), point_spacing_m(visible)
    origin = np.array(at)
    first, alone = {}, dict.fromkeys(range(len(boxes)), 0)
    for end in ends:
        length = float(np.linalg.norm(end))
        met = [entered_m(b, 0.0, origin, end / length) for b in boxes]
        for row, t in enumerate(met):
            alone[row] += t < length
        row = int(np.argmin(met))
        if met[row] < length:
            first.setdefault(row, []).append(origin + end / length * met[row])
    rectangles = {}
    for row, points in first.items():
        along = (np.array(points) - boxes[row, :3]) @ axes_of(boxes[row, 6], 0.0).T
        low, high = along.min(axis=0), along.max(axis=0)
        corners = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
        turned = [
            (boxes[row, 0] + u * math.cos(boxes[row, 6]) - v * math.sin(boxes[row, 6]),
             boxes[row, 1] + u * math.sin(boxes[row, 6]) + v * math.cos(boxes[row, 6]))
            for u, v in corners
        ]  # fmt: skip
        rectangles[row] = shapely.MultiPoint(turned).convex_hull
    targets = visible.record.row.tolist()
    assert any(row in rectangles for row in targets)
    for i, row in enumerate(targets):
        b, away = boxes[row], origin - boxes[row, :3]
        range_flat = math.hypot(away[0], away[1])
        reach = max(0.6, 0.02 * range_flat)
        gaps = [
            rectangles[row].distance(rectangles[other])
            for other in targets
            if other != row and row in rectangles and other in rectangles
        ]
        assert found.link_gap[i] == pytest.approx(min([*gaps, MAX_LINK_GAP * reach]) / reach, abs=1e-5)
        sight = away / np.linalg.norm(away)
        faces = np.abs(axes_of(b[6], 0.0) @ sight)  # cosines of the incidence on front, side, roof
        area = faces @ [b[4] * b[5], b[3] * b[5], b[3] * b[4]]
        spacing = min(math.sqrt(area / alone[row]), MAX_SPACING_M) if alone[row] else MAX_SPACING_M
        assert spacing_m[i] == pytest.approx(spacing)
        assert found.incidence_deg[i] == pytest.approx(math.degrees(math.acos(max(faces[:2]))))
        share = 1.0 - len(first.get(row, [])) / alone[row] if alone[row] else 0.0
        assert found.hidden_share[i] == pytest.approx(share)


def test_pairs_are_listed_once_for_all_sites():
    record = seen([frame([box(12.0, 0.0), box(18.0, 0.0)])], fan()).record
    assert crowding.neighbour_pairs(record) is crowding.neighbour_pairs(record)
    assert crowding.neighbour_pairs(record).boxes.tolist() == [1, 0]
