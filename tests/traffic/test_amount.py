"""How much traffic there is: what is asked for, else the user's demand as it is, else what the network's lanes have."""

import shutil

import numpy as np
import pytest

from egvs.core.errors import InputError, RunError
from egvs.scenario.loading import load
from egvs.stages import traffic
from egvs.traffic import demand, network
from tests.stages import run_stage
from tests.traffic.helpers import car, drawn, scenario

CONFIG = """<configuration>
  <input><net-file value="net.xml"/><route-files value="own.rou.xml"/></input>
</configuration>
"""
SHORT = {"frames": 5, "warmup_s": 5.0, "frame_period_s": 0.25}


@pytest.fixture
def crowded(town, tmp_path):
    """A user's configuration: sixty cars that are all under way from the first second on."""
    roads = network.read_net_xml(town / "net.xml")
    pairs = demand.origin_destination_pairs(roads, car(), drawn(min_trip_m=200), np.random.default_rng(0), "place")
    ends = [(roads.edges[o].id, roads.edges[t].id) for o, t in zip(pairs.origin, pairs.target, strict=True)]
    trips = (
        f'<trip id="t{i}" depart="0" departLane="free" departPos="random_free" from="{start}" to="{end}"/>'
        for i, (start, end) in enumerate(ends * (60 // len(ends) + 1))
        if i < 60
    )
    (tmp_path / "own.rou.xml").write_text(f"<routes>{''.join(trips)}</routes>")
    (tmp_path / "own.sumocfg").write_text(CONFIG)
    shutil.copy(town / "net.xml", tmp_path)
    return tmp_path


@pytest.mark.parametrize("source", [{"sumocfg": "own.sumocfg"}, {"network": "net.xml", "routes": ["own.rou.xml"]}])
def test_a_users_demand_is_taken_as_it_is(crowded, source):
    result = run_stage(traffic, scenario(crowded, **source, **SHORT), crowded / "out")
    assert result["vehicles"] == {"fewest": 60, "most": 60, "different": 60}
    assert not {"--max-num-vehicles", "--max-depart-delay"} & set(result["flags"])


def test_a_users_demand_is_capped_where_that_is_asked_for(crowded):
    keys = {"sumocfg": "own.sumocfg", "vehicles": 20, "max_depart_delay_s": 7, **SHORT}
    result = run_stage(traffic, scenario(crowded, **keys), crowded / "out")
    assert result["vehicles"]["fewest"] == result["vehicles"]["most"] == 20
    assert result["flags"][result["flags"].index("--max-depart-delay") + 1] == "7"


def lane_km(town):
    lanes = (lane for edge in network.read_net_xml(town / "net.xml").edges for lane in edge.lanes)
    return sum(lane.length_m for lane in lanes) / 1000


def test_drawn_trips_follow_the_lanes_of_the_network(town, tmp_path):
    assert lane_km(town) == pytest.approx(5, abs=0.5)
    keys = {"network": "net.xml", "frames": 40, "warmup_s": 60.0}
    for density, more in ((4.0, {}), (7.0, {"vehicles_per_lane_km": 7.0})):
        result = run_stage(traffic, scenario(town, **keys, **more), tmp_path)
        assert result["vehicles"]["fewest"] == result["vehicles"]["most"] == round(density * lane_km(town))


def test_a_network_that_cannot_hold_what_its_lanes_call_for_says_so(town, tmp_path):
    keys = {"network": "net.xml", "frames": 40, "warmup_s": 60.0, "vehicles_per_lane_km": 100.0}
    with pytest.raises(RunError, match=r"4\d\d vehicles are in 0 of 40 frames.*vehicles_per_lane_km"):
        run_stage(traffic, scenario(town, **keys), tmp_path)


def test_lanes_that_the_fleet_may_not_use_do_not_count(tmp_path):
    lane = '<lane id="{0}_0" index="0" length="{1}" shape="0,0 {1},0" {2}/>'
    roads = [("road", 500, ""), ("bus", 250, 'allow="bus"'), ("path", 4000, 'allow="pedestrian"')]
    edges = "".join(f'<edge id="{id}" from="a" to="b">{lane.format(id, m, who)}</edge>' for id, m, who in roads)
    (tmp_path / "net.xml").write_text(f"<net>{edges}</net>")
    bus = car(name="coach", vclass="bus")
    net, dense = network.read_net_xml(tmp_path / "net.xml"), {"vehicles_per_lane_km": 40.0}
    assert demand.target_vehicle_count(drawn(kinds=(car(),), **dense), net) == 20
    assert demand.target_vehicle_count(drawn(kinds=(car(), bus), **dense), net) == 30
    assert demand.target_vehicle_count(drawn(kinds=(car(),), vehicles_per_lane_km=0.1), net) == 1
    assert demand.target_vehicle_count(drawn(vehicles=3), net) == 3


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('routes = ["r.xml"]\nvehicles_per_lane_km = 3', r"vehicles_per_lane_km has no effect with routes"),
        ("vehicles = 5\nvehicles_per_lane_km = 3", r"vehicles_per_lane_km has no effect with vehicles"),
    ],
)
def test_a_density_that_acts_on_nothing_is_refused(tmp_path, keys, message):
    (tmp_path / "scenario.toml").write_text(
        '[roi]\ncenter_m = [0, 0, 2.5]\nsize_m = [50, 100, 5]\n[sites]\nfile = "s.csv"\n'
        f'[traffic]\nnetwork = "net.xml"\n{keys}\n'
    )
    with pytest.raises(InputError, match=message):
        load(tmp_path)
