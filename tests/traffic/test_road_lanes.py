"""Heights of roads that are above one another: a bridge across a road, and a viaduct along a road, by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from egvs.traffic import fcd, network, recording
from egvs.traffic.fcd import FrameWindow
from egvs.traffic.road_lanes import RoadLanes
from egvs.world.terrain import triangulate_ground


def edge(name: str, shape: str, width_m: float = 3.2) -> str:
    """One lane, which is an edge."""
    lane = f'<lane id="{name}_0" index="0" length="1" width="{width_m}" shape="{shape}"/>'
    return f'<edge id="{name}" from="{name}a" to="{name}b">{lane}</edge>'


CROSSING = edge("east", "0,0 100,0") + edge("north", "50,-50,6 50,50,6")
"""A road along y = 0 at z = 0, and a bridge at z = 6 along x = 50."""

VIADUCT = edge("below", "0,0 300,0", 7.0) + edge("ramp", "0,-20,0 60,-20,0") + edge("rise", "60,-20,0 120,0,6")
VIADUCT += edge("above", "120,0,6 300,0,6")
"""A wide road along y = 0, and above its part from x = 120 m on a viaduct in the same direction, with a ramp."""


def lanes(folder: Path, edges: str) -> RoadLanes:
    (folder / "made.net.xml").write_text(f'<net version="1.20">{edges}</net>')
    return RoadLanes(network.read_net_xml(folder / "made.net.xml"))


def heights(roads: RoadLanes, xy_m: np.ndarray, yaw_rad: float = np.nan) -> np.ndarray:
    """Heights along one track, whose rows are given in another order than that of their times."""
    order = np.random.default_rng(1).permutation(len(xy_m))
    track = np.zeros(len(xy_m), dtype=np.int64)
    result = np.empty(len(xy_m))
    result[order] = roads.heights_m(track, np.arange(len(xy_m))[order], xy_m[order], np.full(len(xy_m), yaw_rad))
    return result


def line(start: tuple[float, float], end: tuple[float, float], points: int = 60) -> np.ndarray:
    return np.linspace(start, end, points)


@pytest.mark.parametrize("side_m", [-1.4, 0.0, 1.4])
@pytest.mark.parametrize("yaw_rad", [0.0, np.nan], ids=["with heading", "without heading"])
def test_track_below_a_bridge_stays_below(tmp_path: Path, side_m: float, yaw_rad: float) -> None:
    """Also without a heading, by continuity: at x = 50 the middle line of the bridge is the nearest."""
    roads = lanes(tmp_path, CROSSING)
    np.testing.assert_array_equal(heights(roads, line((5, side_m), (95, side_m)), yaw_rad), 0.0)


@pytest.mark.parametrize("yaw_rad", [np.pi / 2, -np.pi / 2, np.nan])
def test_track_on_a_bridge_stays_on_it(tmp_path: Path, yaw_rad: float) -> None:
    """In both directions, as a vehicle that overtakes: on which side it drives says nothing about the level."""
    np.testing.assert_array_equal(heights(lanes(tmp_path, CROSSING), line((50, -40), (50, 40)), yaw_rad), 6.0)


def test_gap_below_the_bridge_does_not_matter(tmp_path: Path) -> None:
    xy_m = np.concatenate([line((5, 0), (44, 0), 20), line((51, 0), (95, 0), 20)])
    np.testing.assert_array_equal(heights(lanes(tmp_path, CROSSING), xy_m), 0.0)


def test_level_follows_the_ramp(tmp_path: Path) -> None:
    """A vehicle on the viaduct is as well on the road below: the ramp decides, before or after in time."""
    roads = lanes(tmp_path, VIADUCT)
    ramp = np.concatenate([line((5, -20), (60, -20)), line((60, -20), (120, 0)), line((121, 0), (290, 0))])
    up = heights(roads, ramp, 0.0)
    assert up[-60:].tolist() == [6.0] * 60
    down = heights(roads, ramp[::-1], 0.0)
    np.testing.assert_array_equal(down, up[::-1])
    np.testing.assert_array_equal(heights(roads, line((5, 0), (290, 0)), 0.0), 0.0)


def test_lowest_level_counts_where_nothing_decides(tmp_path: Path) -> None:
    np.testing.assert_array_equal(heights(lanes(tmp_path, VIADUCT), line((150, 0), (290, 0)), 0.0), 0.0)


def test_each_track_has_its_own_level(tmp_path: Path) -> None:
    """Two vehicles meet at the crossing, one above the other, in the same frames."""
    xy_m = np.concatenate([line((5, 0), (95, 0)), line((50, -40), (50, 40))])
    track, time = np.repeat([0, 1], 60), np.tile(np.arange(60), 2)
    result = lanes(tmp_path, CROSSING).heights_m(track, time, xy_m, np.full(120, np.nan))
    np.testing.assert_array_equal(result, np.repeat([0.0, 6.0], 60))


def test_nearest_lane_has_height_and_direction(tmp_path: Path) -> None:
    """At (62, -21) of the ramp: 2 m along it in x, and beside the road along y = 0."""
    near = lanes(tmp_path, VIADUCT).near(np.array([[90.0, -10.0], [10.0, 30.0]]), 1.0)
    assert (near.row.tolist(), near.distance_m.tolist()) == ([0], [0.0])
    assert near.height_m[0] == pytest.approx(3.0)
    assert near.yaw_rad[0] == pytest.approx(np.arctan2(20, 60))


def test_ground_below_a_bridge_is_the_lower_road(tmp_path: Path) -> None:
    """On the lower road and 3 m around it, the ground is at z = 0; the road at z = 6 begins beyond that."""
    (tmp_path / "made.net.xml").write_text(f'<net version="1.20">{CROSSING}</net>')
    ground = triangulate_ground(network.read_net_xml(tmp_path / "made.net.xml"))
    along = np.arange(5.0, 95.0)
    for side_m in (-1.6, 0.0, 1.6):
        np.testing.assert_array_equal(ground.height_m(along, np.full(len(along), side_m)), 0.0)
    assert ground.height_m(np.array([50.0]), np.array([40.0])).tolist() == [6.0]


FCD = "timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type"


@pytest.mark.parametrize("z", ["", ";vehicle_z"])
def test_finished_file_without_heights_is_on_the_roads(tmp_path: Path, z: str) -> None:
    """Two cars over the crossing; heights that the file has are not changed."""
    rows = [FCD + z]
    for step in range(41):
        rows.append(f"{step};low;{10 + 2 * step};0;90;car" + (";0.25" if z else ""))
        rows.append(f"{step};high;50;{-40 + 2 * step};0;car" + (";5.5" if z else ""))
    path = tmp_path / "fcd.csv"
    path.write_text("\n".join(rows))
    lanes(tmp_path, CROSSING)
    roads = network.read_net_xml(tmp_path / "made.net.xml")
    assert fcd.has_heights(path) is bool(z)
    tables = list(recording.rows_on_roads(fcd.read_fcd(path), path, roads, FrameWindow(41, 1000)))
    heights_m = {name: set() for name in ("low", "high")}
    for row in (row for table in tables for row in table.to_pylist()):
        heights_m[row["id"]].add(row["z"])
    assert heights_m == ({"low": {0.25}, "high": {5.5}} if z else {"low": {0.0}, "high": {6.0}})
