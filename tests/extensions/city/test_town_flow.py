"""The trial that finds what a town carries."""

import pytest

from egvs.extensions.city import town_flow
from egvs.extensions.city.town_flow import FlowTrial
from egvs.traffic import sumo_folder
from tests.traffic.helpers import netgenerate


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

    monkeypatch.setattr(town_flow._TownTrial, "first_flow", lambda _: 1000)
    monkeypatch.setattr(town_flow._TownTrial, "run_light_traffic", lambda *_: None)
    monkeypatch.setattr(town_flow._TownTrial, "run", run)
    found = town_flow.find_flow(network, 10.0)
    assert simulated == flows
    assert (found.vehicles_per_h, found.reroute) == result
    assert found.is_confirmed is (limits[0] > 0)


@pytest.mark.slow
def test_town_carries_its_flow_and_repeats(tmp_path):
    path = netgenerate(tmp_path, "--grid", "--grid.number", "3", "--grid.attach-length", "100", "--no-turnarounds",
                       "--default-junction-type", "traffic_light")  # fmt: skip
    found = town_flow.find_flow(path.read_text(), 10.0)
    assert found.is_confirmed and 500 < found.vehicles_per_h < 12 * 1800  # twelve one-lane entries
    assert [run.vehicles_per_h for run in found.runs if run.is_carried][-1] == found.vehicles_per_h
    assert found == town_flow.find_flow(path.read_text(), 10.0)


@pytest.mark.slow
def test_search_continues_after_an_interruption(tmp_path, monkeypatch):
    """Simulations that were complete are not repeated, and their result is the same."""
    network = netgenerate(tmp_path, "--grid", "--grid.number", "2", "--grid.attach-length", "100").read_text()
    run_sumo, simulated, steps = town_flow.capacity.run_sumo, [], []

    def run(*arguments):
        if len(simulated) == 2:
            raise KeyboardInterrupt
        simulated.append(arguments)
        return run_sumo(*arguments)

    monkeypatch.setattr(town_flow.capacity, "run_sumo", run)
    with pytest.raises(KeyboardInterrupt):
        town_flow.find_flow(network, 10.0)
    monkeypatch.setattr(town_flow.capacity, "run_sumo", lambda *a: simulated.append(a) or run_sumo(*a))
    found = town_flow.find_flow(network, 10.0, lambda what, *_: steps.append(what))
    assert len(simulated) == 1 + len(found.runs)  # and light traffic, each once
    assert steps[:2] == ["draws trips", "simulates light traffic"] and len(steps) == 2 + len(found.runs)
    monkeypatch.setenv("EGVS_STORE", "")
    assert town_flow.find_flow(network, 10.0) == found


@pytest.mark.slow
def test_first_flow_loads_busiest_junction(tmp_path):
    """All trips of a crossing pass its one junction, which has four lanes."""
    netgenerate(tmp_path, "--grid", "--grid.number", "1", "--grid.attach-length", "150", "--no-turnarounds")
    (tmp_path / sumo_folder.NETWORK_FILE).write_bytes((tmp_path / "net.xml").read_bytes())
    trial = town_flow._TownTrial(tmp_path, 10.0)
    assert trial.first_flow() == 0.6 * 1800
