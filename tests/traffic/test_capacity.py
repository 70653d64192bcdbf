"""The trial that finds what a network carries."""

import pytest

from egvs.scenario.traffic_config import CountConfig
from egvs.traffic import capacity, sumo_folder
from egvs.traffic.capacity import TrialRun
from tests.traffic.helpers import netgenerate

FLOWS = [CountConfig(edge="a", per_hour=300), CountConfig(from_edge="a", to_edge="b", per_hour=3)]


def run_of(share, **keys):
    return TrialRun(
        **({"share": share, "scheduled": 100, "arrived": 95, "longest_standing_s": 60.0, "waiting": 0} | keys)
    )


@pytest.mark.parametrize(
    ("keys", "carried"),
    [
        ({}, True), ({"arrived": 90}, True), ({"arrived": 89}, False), ({"longest_standing_s": 200.0}, True),
        ({"longest_standing_s": 210.0}, False), ({"waiting": 4}, True), ({"waiting": 5}, False),
    ],
)  # fmt: skip
def test_run_is_carried(keys, carried):
    assert run_of(1.0, **keys).is_carried is carried


def test_flows_are_scaled_to_whole_vehicles():
    scaled = capacity.scale_flows(FLOWS, 0.1)
    assert [flow.per_hour for flow in scaled] == [30.0, 1.0]
    assert [flow.title for flow in scaled] == ["a", "a to b"]


@pytest.mark.parametrize(
    ("limit", "shares", "result"),
    [
        (2.0, [1.0], 1.0),
        (0.85, [1.0, 0.7, 0.85, 0.925, 0.887], 0.782),
        (0.5, [1.0, 0.7, 0.49, 0.595, 0.542, 0.516], 0.451),
        (0.01, [1.0, 0.7, 0.49, 0.343, 0.24, 0.168], 0.155),
    ],
)
def test_shares_are_bisected(monkeypatch, tmp_path, limit, shares, result):
    """The network carries all shares up to a limit. Of a share below 1, 92 % are used."""
    network = netgenerate(tmp_path, "--grid", "--grid.number", "2").read_text()
    monkeypatch.setattr(
        capacity, "_simulate", lambda folder, roads, flows, share, *_: run_of(share, waiting=0 if share <= limit else 9)
    )
    found = capacity.find_capacity(network, FLOWS, 10.0)
    assert [run.share for run in found.runs] == shares
    assert found.share == result
    assert found.is_everything is (result == 1.0)
    assert found.is_confirmed is (limit > 0.1)


def test_longest_standing_time_allows_small_moves(tmp_path):
    """One moves 1 m in 10 s, which is less than 2 m from where it stopped until 20 s later."""
    lines = ["timestep_time;vehicle_id;vehicle_x;vehicle_y"]
    for number in range(10):
        lines += [f"{10 * number};still;5;{0 if number < 7 else 50}", f"{10 * number};creeps;{number};0"]
    path = tmp_path / "fcd.csv"
    path.write_text("\n".join(lines) + "\n")
    standing = capacity._standing(path)
    assert standing.longest_s == 60.0
    assert standing.share_at_rest == (6 + 2 + 5) / 20  # the first row of each stand does not count
    assert (standing.at_m, standing.since_s) == ((5.0, 0.0), 0.0)
    path.write_text("\n")
    assert capacity._standing(path) == (0.0, 0.0, None, 0.0)


def test_jam_is_that_of_the_last_run_that_was_not_carried():
    runs = (
        run_of(1.0, longest_standing_s=300.0, longest_standing_at="A"),
        run_of(0.7, longest_standing_s=250.0, longest_standing_at="B (x 1 m, y 2 m) from 40 s on"),
        run_of(0.5, longest_standing_at="C"),
    )
    assert capacity.Capacity(0.46, runs).jam == "a vehicle stood for 250 s at B (x 1 m, y 2 m) from 40 s on"
    assert capacity.Capacity(1.0, runs[2:]).jam == ""


def test_vehicles_should_arrive_one_mean_trip_after_departure(tmp_path):
    """Trips last 40 to 60 s: who departs in the last 50 s of the trial has not arrived yet."""
    departs = [0, 249, 600, 849, 850, 899]
    routes, trips = tmp_path / "routes.xml", tmp_path / "trips.xml"
    routes.write_text("<routes>" + "".join(f'<vehicle id="{d}" depart="{d}"/>' for d in departs) + "</routes>")
    text = "".join(f'<tripinfo id="{d}" arrival="1" duration="{d}"/>' for d in (40, 50, 60))
    trips.write_text(f"<tripinfos>{text}</tripinfos>")
    assert capacity._arrivals(routes, trips) == (4, 3)
    trips.write_text("<tripinfos/>")
    assert capacity._arrivals(routes, trips) == (6, 0)


@pytest.mark.slow
def test_crossing_carries_little_traffic_and_not_too_much(tmp_path):
    path = netgenerate(tmp_path, "--grid", "--grid.number", "1", "--grid.attach-length", "150", "--no-turnarounds",
                       "--default-junction-type", "traffic_light")  # fmt: skip
    network = path.read_text()

    def flows(per_hour):
        sides = ["left", "right", "top", "bottom"]
        return [
            CountConfig(from_edge=f"{a}0A0", to_edge=f"A0{b}0", per_hour=per_hour)
            for a in sides
            for b in sides
            if a != b
        ]

    little = capacity.find_capacity(network, flows(20), 10.0)
    assert little.is_everything and len(little.runs) == 1
    much = capacity.find_capacity(network, flows(400), 10.0)  # 1,200 vehicles an hour on each of four lanes
    assert 0.1 < much.share < 0.8 and much.is_confirmed
    assert little == capacity.find_capacity(network, flows(20), 10.0)
    assert sumo_folder.NETWORK_FILE not in [p.name for p in tmp_path.iterdir()]
