"""The trial that finds what a network carries."""

import pytest

from egvs.scenario.traffic_config import CountConfig
from egvs.traffic import capacity, sumo_folder
from egvs.traffic.capacity import FlowTrial, TrialRun
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


@pytest.mark.parametrize(
    ("keys", "carried"),
    [
        ({}, True), ({"longest_standing_s": 210.0}, False), ({"waiting": 5}, False), ({"share_queuing": 0.15}, False),
    ],
)  # fmt: skip
def test_flow_is_carried(keys, carried):
    values = {"vehicles_per_h": 100, "reroute": True, "longest_standing_s": 200.0, "waiting": 4, "share_queuing": 0.1}
    assert FlowTrial(**(values | keys)).is_carried is carried


@pytest.mark.parametrize(
    ("limits", "flows", "result"),
    [
        # (largest flow with and without rerouting at departure), flows of the simulations, result
        ((1300, 900), [1000, 1250, 1562, -1562], (1250, True)),
        ((1300, 1700), [1000, 1250, 1562, -1562, -1952], (1562, False)),
        ((700, 0), [1000, 800, 640, -800], (640, True)),
        ((700, 900), [1000, 800, 640, -800, -1000], (800, False)),
        ((1e9, 0), [1000, 1250, 1562, 1952, 2440, 3050], (3050, True)),
        ((0, 0), [1000, 800, 640, 512, 410, 328], (262, True)),
    ],
)
def test_flows_are_raised_until_one_is_not_carried(monkeypatch, tmp_path, limits, flows, result):
    """Flows with routes on empty streets are negative here."""
    network = netgenerate(tmp_path, "--grid", "--grid.number", "2").read_text()
    simulated = []

    def run(trial, per_h, reroute):
        simulated.append(per_h if reroute else -per_h)
        waiting = 0 if per_h <= limits[0 if reroute else 1] else 9
        trial.runs.append(FlowTrial(per_h, reroute, 0.0, waiting, 0.0))
        return trial.runs[-1]

    monkeypatch.setattr(capacity._TownTrial, "first_flow", lambda _: 1000)
    monkeypatch.setattr(capacity._TownTrial, "run_light_traffic", lambda *_: None)
    monkeypatch.setattr(capacity._TownTrial, "run", run)
    found = capacity.find_flow(network, 10.0)
    assert simulated == flows
    assert (found.vehicles_per_h, found.reroute) == result
    assert found.is_confirmed is (limits[0] > 0)


@pytest.mark.slow
def test_town_carries_its_flow_and_repeats(tmp_path):
    path = netgenerate(tmp_path, "--grid", "--grid.number", "3", "--grid.attach-length", "100", "--no-turnarounds",
                       "--default-junction-type", "traffic_light")  # fmt: skip
    found = capacity.find_flow(path.read_text(), 10.0)
    assert found.is_confirmed and 500 < found.vehicles_per_h < 12 * 1800  # twelve one-lane entries
    assert [run.vehicles_per_h for run in found.runs if run.is_carried][-1] == found.vehicles_per_h
    assert found == capacity.find_flow(path.read_text(), 10.0)


@pytest.mark.slow
def test_first_flow_loads_busiest_junction(tmp_path):
    """All trips of a crossing pass its one junction, which has four lanes."""
    netgenerate(tmp_path, "--grid", "--grid.number", "1", "--grid.attach-length", "150", "--no-turnarounds")
    (tmp_path / sumo_folder.NETWORK_FILE).write_bytes((tmp_path / "net.xml").read_bytes())
    trial = capacity._TownTrial(tmp_path, 10.0)
    assert trial.first_flow() == 0.6 * 1800


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
