"""Random trips, and routes that meet counts."""

import math
import re
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.stages import traffic
from egvs.traffic import demand, network, sumo
from egvs.traffic.count_fit import geh
from egvs.traffic.demand import RouteFinder
from tests.stage_runner import run_stage
from tests.traffic.helpers import SMALL, SMALL_NET, car, drawn, netgenerate, scenario

LASTING = {"frames": 900, "warmup_s": 100.0, "frame_period_s": 1.0, "step_s": 0.5}


KINDS = [
    {"name": "car", "share": 3, "length_m": 4.5, "width_m": 1.75, "height_m": 1.5},
    {"name": "truck", "vclass": "truck", "share": 1, "length_m": 7.6, "width_m": 2.3, "height_m": 3.0},
]


@pytest.fixture(scope="module")
def cross(tmp_path_factory):
    """A crossing A0 of four two-way streets; left0A0 leads from the west into it, A0right0 out of it to the east."""
    folder = tmp_path_factory.mktemp("cross")
    netgenerate(folder, "--grid", "--grid.number", "1", "--grid.attach-length", "150", "-L", "2",
                "--no-turnarounds")  # fmt: skip
    return folder


def scenario_with_counts(folder, rows, **keys):
    return scenario(folder, network="net.xml", kinds=KINDS, counts=rows, **(LASTING | keys))


def turn(start, end, per_hour, kind=""):
    return {"from_edge": f"{start}0A0", "to_edge": f"A0{end}0", "per_hour": per_hour, "kind": kind}


@pytest.mark.slow
def test_routes_meet_counts_of_turns_edge_and_kind(cross, tmp_path):
    rows = [
        turn("left", "right", 300), turn("left", "top", 80), turn("bottom", "left", 120),
        {"edge": "top0A0", "per_hour": 200}, turn("left", "right", 60, "truck"),
    ]  # fmt: skip
    result = run_stage(traffic, scenario_with_counts(cross, rows), tmp_path)
    met = result["counts"]
    assert [c["place"] for c in met] == [
        "left0A0 to A0right0", "left0A0 to A0top0", "bottom0A0 to A0left0", "top0A0", "left0A0 to A0right0"
    ]  # fmt: skip
    assert [c["counted_per_h"] for c in met] == [300, 80, 120, 200, 60] and met[-1]["kind"] == "truck"
    assert all(c["geh"] < 5 for c in met), met
    assert [c["geh"] for c in met] == pytest.approx(
        [geh(c["counted_per_h"], c["simulated_per_h"]) for c in met], abs=0.011
    )
    assert result["warnings"] == [] and "--max-num-vehicles" not in result["flags"]
    routes = (tmp_path / "sumo" / "trips.rou.xml").read_text()
    kinds = Counter(re.findall(r'id="fleet\.\d+" type="(\w+)"', routes))
    assert kinds.total() == pytest.approx(700 * 1000.25 / 3600, abs=5)
    assert 0.1 < kinds["truck"] / kinds.total() < 0.4  # a quarter by share
    assert set(re.findall(r'id="truck\.\d+" type="(\w+)"', routes)) == {"truck"}
    assert not {"driven.rou.xml", "candidates.rou.xml", "counts.xml"} & {f.name for f in (tmp_path / "sumo").iterdir()}


@pytest.mark.slow
def test_the_same_seed_gives_the_same_traffic(cross, tmp_path):
    rows = [turn("left", "right", 300), {"edge": "top0A0", "per_hour": 200}]

    def routes(seed, name):
        run_stage(traffic, scenario_with_counts(cross, rows, seed=seed, frames=20, warmup_s=10.0), tmp_path / name)
        return (tmp_path / name / "sumo" / "trips.rou.xml").read_bytes()

    assert routes(1, "a") == routes(1, "b") != routes(2, "c")


@pytest.mark.slow
def test_warns_about_counts_above_lane_capacity(cross, tmp_path):
    result = run_stage(traffic, scenario_with_counts(cross, [turn("left", "top", 9000)], frames=300), tmp_path)
    warning, waiting = result["warnings"]
    assert (warning["rule"], waiting["rule"]) == ("counts", "waiting")
    assert not warning["is_error"]
    assert re.search(r"the count of left0A0 to A0top0 exceeds .*: \d+(\.\d)? of 9000 vehicles an", waiting["problem"])
    assert re.search(r"misses 1 of 1 count .*left0A0 to A0top0: \d+(\.\d)? instead of 9000", warning["problem"])


@pytest.mark.slow
def test_simulated_flow_does_not_depend_on_frame_period(cross, tmp_path):
    """SUMO ends with the last frame: 19 minutes of 20 are simulated, and the rate is that of these."""
    lasting = {"frames": 20, "frame_period_s": 60.0, "warmup_s": 60.0}
    (met,) = run_stage(traffic, scenario_with_counts(cross, [turn("left", "right", 300)], **lasting), tmp_path)[
        "counts"
    ]
    routes = (tmp_path / "sumo" / "trips.rou.xml").read_text()
    assert routes.count("<vehicle") == 100  # 300 an hour in 1200.5 s
    assert met["simulated_per_h"] == pytest.approx(300, abs=8)  # 285 if divided by 20 minutes


def test_rejects_kind_called_fleet(cross, tmp_path):
    kinds = [KINDS[0] | {"name": "fleet"}, KINDS[1]]
    rows = [turn("left", "right", 300), turn("left", "right", 60, "fleet")]
    model = scenario(cross, network="net.xml", kinds=kinds, counts=rows, **LASTING)
    with pytest.raises(InputError, match=r"counts \(left0A0 to A0right0\): a kind is called 'fleet'"):
        run_stage(traffic, model, tmp_path)


def test_candidate_routes_over_a_location_are_no_detours(town):
    roads = network.read_net_xml(town / "net.xml")
    ways = RouteFinder(roads, "passenger")
    inner = next(edge for edge in roads.edges if (edge.from_node, edge.to_node) == ("A0", "A1"))
    where = ways.locate(inner.id, None, "place")
    ends = {edge.id: (edge.from_node, edge.to_node) for edge in roads.edges}
    result = ways.candidates([where], drawn(), np.random.default_rng(1), "place")
    assert len(result) > 3
    for way in result:
        assert inner.id in way and len(set(way)) == len(way) and ways.may_drive(way)
        assert ends[way[0]][0] != ends[way[-1]][1]
        assert len(way) <= 4  # in, along, and out at once or one street on; never round the block
    assert not ways.may_drive([where.edges[0], where.edges[0]])


LOOP_NET = """<net version="1.20">
  <edge id="in" from="w" to="j"><lane id="in_0" index="0" speed="10" length="90" shape="-100,0 -10,0"/></edge>
  <edge id="side" from="s" to="j"><lane id="side_0" index="0" speed="10" length="90" shape="0,-100 0,-10"/></edge>
  <edge id="mid" from="j" to="k"><lane id="mid_0" index="0" speed="10" length="30" shape="10,0 40,0"/></edge>
  <edge id="back" from="k" to="j"><lane id="back_0" index="0" speed="10" length="30" shape="40,8 10,8"/></edge>
  <edge id="out" from="j" to="w2"><lane id="out_0" index="0" speed="10" length="90" shape="-10,8 -100,8"/></edge>
  <edge id="on" from="k" to="e"><lane id="on_0" index="0" speed="10" length="90" shape="50,0 140,0"/></edge>
  <connection from="in" to="mid" fromLane="0" toLane="0" dir="s" state="o"/>
  <connection from="side" to="mid" fromLane="0" toLane="0" dir="r" state="o"/>
  <connection from="mid" to="on" fromLane="0" toLane="0" dir="s" state="o"/>
  <connection from="mid" to="back" fromLane="0" toLane="0" dir="l" state="o"/>
  <connection from="back" to="out" fromLane="0" toLane="0" dir="s" state="o"/>
</net>
"""
"""A dual carriageway (in, out) at a signal j: whoever leaves by out has turned at k, and passes j twice."""


@pytest.fixture
def loop_routes(tmp_path):
    path = tmp_path / "loop.net.xml"
    path.write_text(LOOP_NET)
    return RouteFinder(network.read_net_xml(path), "passenger")


def test_routes_pass_no_node_twice(loop_routes):
    where = loop_routes.locate("mid", None, "place")
    result = loop_routes.candidates([where], drawn(), np.random.default_rng(1), "place")
    assert sorted(result) == [("in", "mid", "on"), ("side", "mid", "on")]
    assert loop_routes.has_route_without_loop(where)


def test_rare_ends_are_used_where_all_others_make_loops(loop_routes):
    """Sixty draws miss the exit with the small weight."""
    where = loop_routes.locate("mid", None, "place")
    weights = {"on": 1e-12, "side": 1e-12}
    result = loop_routes.candidates([where], drawn(edge_weights=weights), np.random.default_rng(1), "place")
    assert sorted(result) == [("in", "mid", "on"), ("side", "mid", "on")]


def test_count_that_is_only_possible_with_a_loop_is_a_last_resort(loop_routes):
    where = loop_routes.locate("in", "out", "place")
    assert not loop_routes.has_route_without_loop(where)
    result = loop_routes.candidates([where], drawn(), np.random.default_rng(1), "place")
    assert result == [("in", "mid", "back", "out")]
    assert loop_routes.has_route_without_loop(loop_routes.locate("in", "on", "place"))


def test_isolated_location_is_a_route_of_its_own(tmp_path):
    """A network without fringe, where an edge weight of 0 excludes no counted vehicle."""
    netgenerate(tmp_path, "--spider", "--spider.arm-number", "3", "--spider.circle-number", "1")
    roads = network.read_net_xml(tmp_path / "net.xml")
    ways, edge = RouteFinder(roads, "passenger"), roads.edges[0].id
    where = ways.locate(edge, None, "place")
    for weights in ({}, {edge: 0.0}):
        assert ways.candidates([where], drawn(edge_weights=weights), np.random.default_rng(1), "place") == [(edge,)]


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([{"edge": "nowhere", "per_hour": 1}], r"traffic\.counts \(nowhere\): the network has no edge 'nowhere'"),
        (
            [turn("left", "right", 10, "tram")],
            r"counts \(left0A0 to .*\): the fleet has no vehicle kind 'tram'.*car, truck",
        ),
        (
            [{"from_edge": "A0top0", "to_edge": "left0A0", "per_hour": 5}],
            r"\(A0top0 to left0A0\): there is no route from 'A0top0' to 'left0A0'",
        ),
        ([{"edge": "a", "to_edge": "b", "per_hour": 1}], r"expected either edge, or both from_edge and to_edge"),
        ([{"to_edge": "b", "per_hour": 1}], r"expected either edge, or both from_edge and to_edge"),
        ([{"from_edge": "b", "to_edge": "b", "per_hour": 1}], r"from_edge and to_edge are both 'b'"),
        ([{"edge": "a", "per_hour": -1}], r"per_hour"),
        ([{"edge": "", "per_hour": 1}], r"counts\.0\.edge: expected at least 1 character, got ''"),
        (
            [{"edge": "a", "per_hour": 1}, {"edge": "a", "per_hour": 9}],
            r"counts: expected one count for each location and kind, got two for a",
        ),
        ([{"edge": "a", "per_hour": 0}], r"counts: expected at least one count with per_hour above 0"),
    ],
)
def test_rejects_wrong_count(cross, tmp_path, rows, message):
    with pytest.raises(InputError, match=message):
        run_stage(traffic, scenario_with_counts(cross, rows), tmp_path)


def test_trips_connect_fringe_edges_without_turnarounds(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(SMALL_NET)
    result = demand.origin_destination_pairs(
        network.read_net_xml(path), car(), drawn(), np.random.default_rng(0), "place"
    )
    assert (result.origin.tolist(), result.target.tolist(), result.fringe) == ([0], [2], True)


@pytest.mark.parametrize("seed", range(5))
def test_reached_edges_are_those_of_a_search_from_each_source(seed):
    rng = np.random.default_rng(seed)
    n_edges = 40
    links = np.column_stack([rng.integers(0, n_edges, (50, 2)), np.zeros(50, dtype=int)])
    sources = np.sort(rng.choice(n_edges, 11, replace=False))
    reached = demand._reached_edges(links, sources, n_edges)
    assert reached.shape == (11, n_edges)
    for row, source in zip(reached, sources.tolist(), strict=True):
        expected, pending = {source}, [source]
        while pending:
            edge = pending.pop()
            after = {b for a, b, _ in links.tolist() if a == edge} - expected
            expected |= after
            pending += after
        assert set(np.flatnonzero(row).tolist()) == expected


def test_edge_weights_override_lane_counts(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(SMALL_NET)
    roads, rng = network.read_net_xml(path), np.random.default_rng(0)
    assert demand.origin_destination_pairs(roads, car(), drawn(), rng, "place").weight.tolist() == [1]
    assert demand.origin_destination_pairs(
        roads, car(), drawn(edge_weights={"out": 7}), rng, "place"
    ).weight.tolist() == [7]
    with pytest.raises(InputError, match=r"edge_weights: the network has no edge 'away'"):
        demand.origin_destination_pairs(roads, car(), drawn(edge_weights={"away": 7}), rng, "place")


def test_rejects_kind_without_trips(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(SMALL_NET)
    roads, rng = network.read_net_xml(path), np.random.default_rng(0)
    with pytest.raises(InputError, match=r"kind 'boat' \(vClass ship\) cannot make any trip of at least 300 m"):
        demand.origin_destination_pairs(roads, car(name="boat", vclass="ship"), drawn(min_trip_m=300), rng, "place")
    roads = network.Network(tuple(e for e in roads.edges if e.id == "in"), ())
    with pytest.raises(InputError, match=r"no lane of the network allows kind 'bus' \(vClass bus\)"):
        demand.origin_destination_pairs(roads, car(name="bus", vclass="bus"), drawn(), rng, "place")


def test_trips_follow_shares_lanes_and_minimum_length(town):
    roads = network.read_net_xml(town / "net.xml")
    rng = np.random.default_rng(0)
    kinds = [car(share=3), car(name="van", vclass="delivery")]
    pairs = [demand.origin_destination_pairs(roads, kind, drawn(min_trip_m=200), rng, "place") for kind in kinds]
    departs_s = np.arange(4000) / 4
    trips = demand.draw_trips(roads, kinds, pairs, departs_s, rng)
    assert Counter(trip.kind for trip in trips)["car"] == pytest.approx(3000, abs=150)
    edges = {e.id: e for e in roads.edges}
    assert {len(edges) for _ in trips} == {24}
    for trip in trips:
        assert math.dist(edges[trip.origin].start_m, edges[trip.target].end_m) >= 200
        assert edges[trip.origin].from_node != edges[trip.target].to_node
    assert len({(trip.origin, trip.target) for trip in trips}) == 8 * 7 - 2 * (
        4 + 4
    )  # neighbours at a corner and along a side lie closer


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (car(vclass="car"), r"kind 'car' has the unknown vClass 'car'.*passenger"),
        (car(attributes={"length": 3}), r"kind 'car' has length among its attributes"),
    ],
)
def test_rejects_wrong_kind(kind, message):
    with pytest.raises(InputError, match=message):
        demand.check_kinds([kind], "place")


def test_common_vehicle_classes_are_those_of_sumo():
    assert sumo.vehicle_classes() > sumo.COMMON_VEHICLE_CLASSES
    assert sumo.is_vehicle_class("tram") and not sumo.is_vehicle_class("car")


def test_attributes_of_a_kind_override_defaults():
    text = demand.vtypes_xml([car(attributes={"maxSpeedLat": 2, "color": "1,0,0"})])
    assert 'maxSpeedLat="2.0"' in text and 'color="1,0,0"' in text and 'lcMaxSpeedLatFactor="0.2"' in text


def lane_km(town):
    lanes = (lane for edge in network.read_net_xml(town / "net.xml").edges for lane in edge.lanes)
    return sum(lane.length_m for lane in lanes) / 1000


@pytest.mark.slow
def test_number_of_vehicles_is_proportional_to_lane_length(town, tmp_path):
    assert lane_km(town) == pytest.approx(5, abs=0.5)
    keys = {"network": "net.xml", "frames": 40, "warmup_s": 60.0}
    for density, more in ((4.0, {}), (7.0, {"vehicles_per_lane_km": 7.0})):
        result = run_stage(traffic, scenario(town, **keys, **more), tmp_path)
        assert result["vehicles"]["fewest"] == result["vehicles"]["most"] == round(density * lane_km(town))


@pytest.mark.slow
@pytest.mark.parametrize("reroute", [False, True])
def test_flow_departs_at_regular_intervals(town, tmp_path, reroute):
    keys = {"network": "net.xml", "frames": 100, "frame_period_s": 1.0, "warmup_s": 200.0, "vehicles_per_h": 600.0}
    result = run_stage(traffic, scenario(town, **keys, reroute_at_departure=reroute), tmp_path / "first")
    routes = (tmp_path / "first" / "sumo" / "trips.rou.xml").read_text()
    departs_s = [float(text) for text in re.findall(r'<vehicle [^>]*depart="([^"]*)"', routes)]
    assert departs_s == [6.0 * i for i in range(50)]  # 299.25 s
    assert routes.count("<route ") == 50 and "<trip" not in routes
    flags = result["flags"]
    assert "--max-num-vehicles" not in flags and "--max-depart-delay" not in flags
    assert ("--device.rerouting.probability" in flags) is reroute
    assert 0 < result["vehicles"]["fewest"] < result["vehicles"]["most"] < 50

    again = scenario(town, **keys, reroute_at_departure=reroute)
    run_stage(traffic, again, tmp_path / "second")
    first, second = (tmp_path / name / "trajectories.parquet" for name in ("first", "second"))
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.slow
def test_routes_equal_those_of_dijkstra(town, tmp_path):
    """Contraction hierarchies find ways that are as fast as those of an independent search."""
    from scipy.sparse.csgraph import dijkstra

    roads = network.read_net_xml(town / "net.xml")
    files = {"net.xml": (town / "net.xml").read_text(), "vtypes.xml": demand.vtypes_xml([car()])}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    pairs = demand.origin_destination_pairs(roads, car(), drawn(), np.random.default_rng(0), "place")
    trips = demand.draw_trips(roads, [car()], [pairs], np.arange(40.0), np.random.default_rng(1))
    routed = demand.route_trips(trips, tmp_path, "net.xml", "vtypes.xml")
    assert [trip.number for trip in routed] == list(range(40))
    finder = RouteFinder(roads, "passenger")
    index = {edge.id: i for i, edge in enumerate(roads.edges)}
    seconds = dijkstra(finder._graph)
    for trip, route in zip(trips, routed, strict=True):
        edges = route.edges.split()
        assert (edges[0], edges[-1]) == (trip.origin, trip.target)
        ways_s = sum(finder._graph[index[a], index[b]] for a, b in pairwise(edges))
        assert ways_s == pytest.approx(seconds[index[edges[0]], index[edges[-1]]], rel=0.02)
    assert {path.name for path in tmp_path.iterdir()} == {"net.xml", "vtypes.xml"}


def test_vehicle_density_ignores_lanes_closed_to_the_fleet(tmp_path):
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


@pytest.mark.slow
def test_ring_road_gets_trips_between_any_edges_and_a_note(tmp_path):
    netgenerate(
        tmp_path,
        "--spider",
        "--spider.arm-number",
        "6",
        "--spider.circle-number",
        "1",
        "--spider.omit-center",
        name="ring.net.xml",
    )
    result = run_stage(
        traffic, scenario(tmp_path, **(SMALL | {"network": "ring.net.xml", "vehicles": 5})), tmp_path / "out"
    )
    assert result["notes"] and "no trip between fringe edges" in result["notes"][0]
