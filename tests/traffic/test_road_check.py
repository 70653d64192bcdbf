"""Vehicles against roads: what real traffic does is accepted, and each mistake of a file has its message."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from egvs.core.errors import Diagnostic
from egvs.core.grid import FloatArray, Roi
from egvs.traffic import fcd, network
from egvs.traffic.network import Network
from egvs.traffic.road_check import RoadCheck, check_tables
from tests.traffic.test_road_lanes import edge

REGION = Roi((-60.0, -60.0, 0.0), (120.0, 120.0, 5.0))
CROSS = (
    edge("we", "-60,-1.6 60,-1.6") + edge("ew", "60,1.6 -60,1.6") + edge("sn", "1.6,-60 1.6,60")
    + edge("ns", "-1.6,60 -1.6,-60")
    + '<junction id="c" type="priority" x="0" y="0" incLanes="" intLanes="" shape="-6,-6 6,-6 6,6 -6,6"/>'
)  # fmt: skip
"""Two roads of two lanes each, which cross; people drive on the right."""

DRIVES = {"we": (-50.0, -1.6, 90.0), "ew": (50.0, 1.6, 270.0), "sn": (1.6, -50.0, 0.0), "ns": (-1.6, 50.0, 180.0)}
"""Where a vehicle of each lane begins, and its angle in degrees clockwise from north."""

Rows = dict[str, FloatArray]


@pytest.fixture
def roads(tmp_path: Path) -> Network:
    path = tmp_path / "made.net.xml"
    path.write_text(f'<net version="1.20">{CROSS}</net>')
    return network.read_net_xml(path)


def drive(speed_m_s: float = 10.0) -> Rows:
    """One vehicle on each lane, 20 rows of half a second each: columns time_ms, vehicle, x, y, angle."""
    steps = np.arange(20)
    rows = []
    for vehicle, (x_m, y_m, angle_deg) in enumerate(DRIVES.values()):
        way_m = speed_m_s * 0.5 * steps
        along = np.deg2rad(90.0 - angle_deg)
        values = [500 * steps, np.full(20, vehicle), x_m + way_m * np.cos(along), y_m + way_m * np.sin(along)]
        rows.append(np.column_stack([*values, np.full(20, angle_deg)]))
    time_ms, vehicle, x, y, angle = np.concatenate(rows).T
    return {"time_ms": time_ms, "vehicle": vehicle, "x": x, "y": y, "angle": angle}


def counted(rows: Rows, roads: Network | None, vehicle_type: str = "car") -> RoadCheck:
    order = np.argsort(rows["time_ms"], kind="stable")
    n = len(order)
    zeros = np.zeros(n)
    names = [f"v{number:.0f}" for number in rows["vehicle"][order]]
    columns = [rows["time_ms"][order].astype(np.int64), names, [vehicle_type] * n, rows["x"][order], rows["y"][order]]
    table = pa.table([*columns, zeros, rows["angle"][order], zeros, zeros], schema=fcd.FCD_SCHEMA)
    return check_tables([table.slice(0, n // 2), table.slice(n // 2)], roads, REGION, frozenset(["car"]))


def findings(rows: Rows, roads: Network | None) -> dict[str, Diagnostic]:
    return {finding.rule: finding for finding in counted(rows, roads).findings("traffic.fcd")}


def test_traffic_on_its_lanes_has_no_finding(roads: Network) -> None:
    check = counted(drive(), roads)
    assert (check.off_lanes, check.against, check.across, check.names.repeated) == (0, 0, 0, 0)
    assert check.positions >= 60
    assert list(check.findings("traffic.fcd")) == []


def shift(rows: Rows) -> None:
    rows["y"] -= 7.0


def swap(rows: Rows) -> None:
    rows["x"], rows["y"] = rows["y"].copy(), rows["x"].copy()
    rows["angle"] = 90.0 - rows["angle"]


def mirror(rows: Rows) -> None:
    rows["x"] *= -1.0
    rows["angle"] *= -1.0


def reverse(rows: Rows) -> None:
    rows["time_ms"] = rows["time_ms"].max() - rows["time_ms"]


def use_radians(rows: Rows) -> None:
    rows["angle"] = np.deg2rad(rows["angle"])


def use_mathematical_angles(rows: Rows) -> None:
    rows["angle"] = 90.0 - rows["angle"]


def turn_across(rows: Rows) -> None:
    rows["angle"] += 90.0


def turn_a_little(rows: Rows) -> None:
    rows["angle"] += 30.0


def count_in_milliseconds(rows: Rows) -> None:
    """Times that are a thousandth of what they are: nobody drives at 10 km/s."""
    rows["time_ms"] /= 100.0


def interleave_names(rows: Rows) -> None:
    """Two vehicles of one name, never at the same time."""
    rows["time_ms"] += np.where(rows["vehicle"] % 2, 250.0, 0.0)
    rows["vehicle"] = rows["vehicle"] // 2


def turn_half(rows: Rows) -> None:
    """Of every second vehicle."""
    rows["angle"] += np.where(rows["vehicle"] % 2, 180.0, 0.0)


def share_names(rows: Rows) -> None:
    rows["vehicle"] = rows["vehicle"] // 2


@pytest.mark.parametrize(
    ("mistake", "expected"),
    [
        (shift, {"vehicles off their lanes": "are more than 1 m beside every lane that leads their way (median "}),
        (swap, {"vehicles against lanes": "89 % of "}),
        (mirror, {"vehicles against lanes": "89 % of "}),
        (reverse, {"vehicles against lanes": "89 % of ", "headings": "(median of all 180 degrees)"}),
        (use_radians, {"headings": "75 % of "}),
        (use_mathematical_angles, {"headings": "100 % of "}),
        (turn_across, {"headings": "(median of all 90 degrees)"}),
        (turn_a_little, {"headings": "(median of all 30 degrees)"}),
        (count_in_milliseconds, {"jumps": "of 80 rows, faster than 60 m/s"}),
        (interleave_names, {"jumps": "faster than 60 m/s"}),
        (turn_half, {"headings": "50 % of "}),
        (share_names, {"shared names": "got 40 others in 80 rows"}),
    ],
)
def test_mistake_is_an_error_with_its_number(
    roads: Network, mistake: Callable[[Rows], None], expected: dict[str, str]
) -> None:
    rows = drive()
    mistake(rows)
    actual = {rule: finding for rule, finding in findings(rows, roads).items() if finding.is_error}
    assert expected.keys() <= actual.keys()
    for rule, text in expected.items():
        assert text in actual[rule].problem


def test_shift_is_part_of_the_message(roads: Network) -> None:
    rows = drive()
    shift(rows)
    assert "moved by" in findings(rows, roads)["vehicles off their lanes"].problem
    assert "+7.0 m north" in findings(rows, roads)["vehicles off their lanes"].problem


@pytest.mark.parametrize("mistake", [use_radians, share_names])
def test_headings_and_names_need_no_network(mistake: Callable[[Rows], None]) -> None:
    rows = drive()
    mistake(rows)
    assert [finding.is_error for finding in findings(rows, None).values()] == [True]


def overtake(rows: Rows) -> None:
    """One of eight: the last third of one vehicle's way is on the other lane."""
    rows["y"][13:20] = 1.6


def park(rows: Rows) -> None:
    """A vehicle that stands beside the road, with headings that its detector makes up."""
    rows["x"][:20], rows["y"][:20] = -30.0, -9.0
    rows["angle"][:20] = np.linspace(0.0, 360.0, 20)


def leave_road(rows: Rows) -> None:
    """Onto a car park, slowly."""
    rows["x"][15:20] = rows["x"][15]
    rows["y"][15:20] -= 2.0 * np.arange(1, 6)
    rows["angle"][15:20] = 180.0


def keep_right(rows: Rows) -> None:
    """2.4 m beside the middle of the lane: half of the vehicle is on the verge."""
    rows["y"] -= np.where(rows["vehicle"] == 0, 2.4, 0.0)


def back_up(rows: Rows) -> None:
    """Into a gap: 3 of 80 rows against the heading."""
    rows["x"][17:20] = rows["x"][16] - 2.0 * np.arange(1, 4)


@pytest.mark.parametrize("habit", [overtake, park, leave_road, keep_right, back_up])
def test_habits_of_drivers_are_no_errors(roads: Network, habit: Callable[[Rows], None]) -> None:
    rows = drive()
    habit(rows)
    assert not any(finding.is_error for finding in findings(rows, roads).values())


def test_pedestrians_and_bicycles_do_not_count(roads: Network) -> None:
    rows = drive()
    turn_across(rows)
    check = counted(rows, roads, "pedestrian")
    assert (check.positions, check.headings) == (0, 0)


@pytest.mark.parametrize(("step_s", "cut", "expected"), [(0.2, True, True), (0.2, False, False), (1.0, False, False)])
def test_vehicles_that_jump_over_a_junction(roads: Network, step_s: float, cut: bool, expected: bool) -> None:
    """A file from a network without internal links has no rows between the stop lines, 6 m from the middle."""
    steps = np.arange(0.0, 160.0, 12.0 * step_s)  # the junction is passed before the middle, where the table is cut
    rows = []
    for vehicle in range(24):
        x_m, y_m, angle_deg = list(DRIVES.values())[vehicle % 4]
        along = np.deg2rad(90.0 - angle_deg)
        x, y = x_m + (steps + vehicle / 10) * np.cos(along), y_m + (steps + vehicle / 10) * np.sin(along)
        is_outside = np.maximum(np.abs(x), np.abs(y)) > 6.0 if cut else np.ones(len(x), dtype=bool)
        x, y = x[is_outside], y[is_outside]
        time_ms = 1000 * step_s * np.arange(len(x))
        rows.append(np.column_stack([time_ms, np.full(len(x), vehicle), x, y, np.full(len(x), angle_deg)]))
    table = dict(zip(("time_ms", "vehicle", "x", "y", "angle"), np.concatenate(rows).T, strict=True))
    found = findings(table, roads)
    assert ("jumps over junctions" in found) == expected
    assert "jumps" not in found
    if expected:
        assert not found["jumps over junctions"].is_error
        assert "are inside them in 0 rows: the network that SUMO used had no internal links" in str(
            found["jumps over junctions"]
        )


def test_junction_without_lanes_is_road(tmp_path: Path) -> None:
    """In a network without lanes inside junctions, vehicles cross them in any direction."""
    edges = edge("we", "-60,-1.6 -20,-1.6") + edge("out", "20,-1.6 60,-1.6") + edge("up", "1.6,20 1.6,60")
    junction = (
        '<junction id="c" type="priority" x="0" y="0" incLanes="" intLanes="" shape="-20,-20 20,-20 20,20 -20,20"/>'
    )
    path = tmp_path / "made.net.xml"
    path.write_text(f'<net version="1.20">{edges}{junction}</net>')
    rows = {key: values[:20] for key, values in drive().items()}
    assert counted(rows, network.read_net_xml(path)).off_lanes == 0


def test_network_may_end_beside_the_region(tmp_path: Path) -> None:
    """Its lanes end 5 m beyond the region; vehicles drive on for 25 m, where nothing is known."""
    path = tmp_path / "made.net.xml"
    path.write_text(f'<net version="1.20">{edge("we", "-25,-1.6 25,-1.6")}</net>')
    steps = np.arange(20)
    angle = np.full(20, 90.0)
    rows = {"time_ms": 500.0 * steps, "vehicle": 0.0 * steps, "x": -50.0 + 5.0 * steps, "y": angle * 0 - 1.6}
    rows["angle"] = angle
    names = ["v"] * 20
    zeros = np.zeros(20)
    columns = [rows["time_ms"].astype(np.int64), names, ["car"] * 20, rows["x"], rows["y"], zeros, angle, zeros, zeros]
    region = Roi((-20.0, -20.0, 0.0), (40.0, 40.0, 5.0))
    table = pa.table(columns, schema=fcd.FCD_SCHEMA)
    check = check_tables([table], network.read_net_xml(path), region, frozenset(["car"]))
    assert (check.headings, check.positions, check.off_lanes) == (19, 11, 0)


def test_stopped_vehicles_with_noisy_headings_do_not_count(roads: Network) -> None:
    rows = drive(speed_m_s=0.0)
    rng = np.random.default_rng(5)
    rows["x"] += rng.normal(0.0, 0.05, 80)
    rows["angle"] = rng.uniform(0.0, 360.0, 80)
    assert counted(rows, roads).headings == 0
