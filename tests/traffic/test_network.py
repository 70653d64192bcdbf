"""Is a network read as SUMO means it, and do drawn trips keep to it?"""

import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.traffic import demand, network, sumo
from egvs.world import terrain
from tests.traffic.helpers import car, drawn

NET = """<net version="1.20">
  <edge id=":j_0" function="internal"><lane id=":j_0_0" index="0" speed="9" length="9" shape="0,0 1,1"/></edge>
  <edge id="in" from="a" to="j"><lane id="in_0" index="0" disallow="bus" shape="-100,0 0,0"/></edge>
  <edge id="back" from="j" to="a"><lane id="back_0" index="0" shape="0,3 -100,3"/></edge>
  <edge id="out" from="j" to="b"><lane id="out_0" index="0" shape="0,0 100,0"/>
    <lane id="out_1" index="1" allow="bicycle" shape="0,-3 100,-3"/></edge>
  <tlLogic id="j" type="actuated" programID="0" offset="0">
    <phase duration="30" maxDur="50" state="GG"/><phase duration="5" state="yy"/></tlLogic>
  <connection from="in" to="out" fromLane="0" toLane="0" via=":j_0_0" dir="s" state="o"/>
  <connection from="in" to="back" fromLane="0" toLane="0" dir="t" state="o"/>
  <connection from=":j_0" to="out" fromLane="0" toLane="0" dir="s" state="o"/>
</net>
"""


def test_network_is_read(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(NET)
    roads = network.read_net_xml(path)
    assert [e.id for e in roads.edges] == ["in", "back", "out"]
    assert roads.cycle_s == 55
    assert not roads.has_heights
    assert [e.lanes_for("passenger") for e in roads.edges] == [1, 1, 1]
    assert [e.lanes_for("bus") for e in roads.edges] == [0, 1, 1]
    assert roads.links("passenger").tolist() == [[0, 2, 0], [0, 1, 1]]
    assert roads.links("bus").tolist() == []


WALKED = """<net><location netOffset="-100.50,20.00" projParameter="+proj=utm +zone=54"/>
  <edge id=":j_w0" function="walkingarea"><lane id=":j_w0_0" index="0" allow="pedestrian" shape="0,0 1,0 1,1"/></edge>
  <edge id=":j_c0" function="crossing"><lane id=":j_c0_0" allow="pedestrian" width="4" shape="0,0 9,0"/></edge>
  <edge id="in" from="a" to="j" name="High Street"><lane id="in_0" index="0" allow="pedestrian" length="99.5"
    width="2.00" shape="-100,0 -50,0,1.5 0,0"/><lane id="in_1" index="1" shape="-100,3 0,3"/></edge>
  <edge id="out" from="j" to="b"><lane id="out_0" index="0" allow="pedestrian" shape="0,0 5,5"/></edge>
  <edge id="alone" from="c" to="d"><lane id="alone_0" index="0" allow="pedestrian" shape="0,9 9,9"/></edge>
  <junction id="j" type="traffic_light" x="0.5" y="-2" incLanes="in_0 in_1" shape="0,0 1,0 1,1"/>
  <junction id="a" type="dead_end" x="-100" y="0" incLanes="" shape=""/>
  <connection from="in" to=":j_w0" fromLane="0" toLane="0" dir="s"/>
  <connection from=":j_w0" to=":j_c0" fromLane="0" toLane="0" dir="s"/>
  <connection from="out" to=":j_c0" fromLane="0" toLane="0" dir="s"/></net>
"""


def test_lanes_junctions_sidewalks_and_the_location_are_views_of_one_reading(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(WALKED)
    roads = network.read_net_xml(path)
    assert [edge.function for edge in roads.all_edges] == ["walkingarea", "crossing", "", "", ""]
    first = roads.edges[0]
    assert (first.name, first.start_m, first.end_m) == ("High Street", (-100, 0), (0, 0))
    assert first.lanes[0].shape_m.tolist() == [[-100, 0, 0], [-50, 0, 1.5], [0, 0, 0]]
    assert (first.lanes[0].width_m, first.lanes[1].width_m, first.lanes[0].length_m) == (2, None, 99.5)
    assert roads.has_heights and network.may_have_heights(path)
    signal, end = roads.junctions
    assert (signal.id, signal.type, signal.at_m) == ("j", "traffic_light", (0.5, -2))
    assert signal.incoming_lanes == ("in_0", "in_1") and signal.shape_m.shape == (3, 3)
    assert end.incoming_lanes == () and end.shape_m.shape == (0, 3)
    assert roads.location == network.Location("+proj=utm +zone=54", (-100.5, 20))
    walks = roads.walkways
    assert (walks.areas, walks.crossings) == (1, 1)
    parts = {walk.edge: walk.part for walk in walks.sidewalks}
    assert parts["in"] == parts["out"] != parts["alone"]


def test_a_shape_without_coordinates_is_named_when_it_is_asked_for(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(WALKED.replace("0,0 5,5", "0,0 near,1 5,5"))
    with pytest.raises(InputError, match=r"n\.net\.xml: lane out_0: invalid coordinates in a shape \(.*'near'"):
        _ = network.read_net_xml(path).edges[1].lanes[0].shape_m


def test_maps_of_openstreetmap_are_known_by_their_names():
    names = ["a.osm", "a.osm.xml", "a.osm.gz", "a.osm.xml.gz", "a.osm.pbf", "a.net.xml", "a.net.xml.gz"]
    assert [network.is_osm(Path(name)) for name in names] == [True] * 5 + [False] * 2


def test_trips_join_the_fringe_and_do_not_turn_back(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(NET)
    found = demand.origin_destination_pairs(
        network.read_net_xml(path), car(), drawn(), np.random.default_rng(0), "place"
    )
    assert (found.origin.tolist(), found.target.tolist(), found.fringe) == ([0], [2], True)


def test_edge_weights_go_before_lanes(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(NET)
    roads, rng = network.read_net_xml(path), np.random.default_rng(0)
    assert demand.origin_destination_pairs(roads, car(), drawn(), rng, "place").weight.tolist() == [1]
    assert demand.origin_destination_pairs(
        roads, car(), drawn(edge_weights={"out": 7}), rng, "place"
    ).weight.tolist() == [7]
    with pytest.raises(InputError, match=r"edge_weights: the network has no edge 'away'"):
        demand.origin_destination_pairs(roads, car(), drawn(edge_weights={"away": 7}), rng, "place")


def test_rejects_kind_without_trips(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(NET)
    roads, rng = network.read_net_xml(path), np.random.default_rng(0)
    with pytest.raises(InputError, match=r"kind 'boat' \(vClass ship\) can make no trip of at least 300 m"):
        demand.origin_destination_pairs(roads, car(name="boat", vclass="ship"), drawn(min_trip_m=300), rng, "place")
    roads = network.Network(tuple(e for e in roads.edges if e.id == "in"), ())
    with pytest.raises(InputError, match=r"kind 'bus' \(vClass bus\) may use no lane"):
        demand.origin_destination_pairs(roads, car(name="bus", vclass="bus"), drawn(), rng, "place")


def test_trips_follow_shares_lanes_and_the_least_length(town):
    roads = network.read_net_xml(town / "net.xml")
    rng = np.random.default_rng(0)
    kinds = [car(share=3), car(name="van", vclass="delivery")]
    pairs = [demand.origin_destination_pairs(roads, kind, drawn(min_trip_m=200), rng, "place") for kind in kinds]
    departs_s = np.arange(4000) / 4
    trips = demand.draw_trips(roads, kinds, pairs, departs_s, rng)
    assert Counter(kind for kind, _, _ in trips)["car"] == pytest.approx(3000, abs=150)
    edges = {e.id: e for e in roads.edges}
    assert {len(edges) for _ in trips} == {24}
    for _, origin, target in trips:
        assert math.dist(edges[origin].start_m, edges[target].end_m) >= 200
        assert edges[origin].from_node != edges[target].to_node
    assert len({(a, b) for _, a, b in trips}) == 8 * 7 - 2 * (
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
        demand.check_kinds([kind], sumo.vehicle_classes(), "place")


def test_a_kinds_attributes_go_before_ours():
    text = demand.vtypes_xml([car(attributes={"maxSpeedLat": 2, "color": "1,0,0"})])
    assert 'maxSpeedLat="2.0"' in text and 'color="1,0,0"' in text and 'lcMaxSpeedLatFactor="0.2"' in text


@pytest.mark.parametrize("far", ["2147483648", "-1e300", "nan", "inf"])
def test_a_coordinate_of_no_place_on_earth_is_refused(tmp_path: Path, far: str) -> None:
    """Of a road; of a lane that is not a road's, when somebody asks for it."""
    text = '<net><edge id="e" from="a" to="b"><lane id="e_0" shape="0,0,1 {},9,2"/></edge></net>'
    (tmp_path / "n.net.xml").write_text(text.format(far))
    with pytest.raises(InputError, match=rf"n.net.xml: invalid <edge id='e'>.*coordinate {far} is beyond 1e\+08 m"):
        network.read_net_xml(tmp_path / "n.net.xml")
    shape = network.Shape(f"0,0 {far},1", "n.net.xml: lane x")
    with pytest.raises(InputError, match=rf"n.net.xml: lane x: invalid coordinates in a shape \(the coordinate {far}"):
        _ = shape.shape_m


def test_a_ground_of_too_many_points_is_refused(tmp_path: Path) -> None:
    """A road of 90,000 km on a hill."""
    text = '<net><edge id="e" from="a" to="b"><lane id="e_0" shape="0,0,1 9e7,9,200"/></edge></net>'
    (tmp_path / "n.net.xml").write_text(text)
    told = (
        r"n.net.xml: reaches so far that its ground takes [0-9,]+ points\. The limit is 2,000,000 points; set "
        r"EGVS_MAX_GROUND"
    )
    with pytest.raises(InputError, match=told):
        terrain.triangulate_ground(network.read_net_xml(tmp_path / "n.net.xml"), where="n.net.xml")
