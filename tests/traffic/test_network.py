"""Reading SUMO networks."""

import math
from pathlib import Path

import pytest

from egvs.core.errors import InputError
from egvs.traffic import network
from egvs.world import terrain
from tests.traffic.helpers import SMALL_NET


def test_reads_edges_connections_and_signal_cycle(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(SMALL_NET)
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


def test_reads_lanes_junctions_sidewalks_and_location(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(WALKED)
    roads = network.read_net_xml(path)
    assert [edge.function for edge in roads.all_edges] == ["walkingarea", "crossing", "", "", ""]
    first = roads.edges[0]
    assert (first.name, first.start_m, first.end_m) == ("High Street", (-100, 0), (0, 0))
    assert first.lanes[0].shape_m.tolist() == [[-100, 0, 0], [-50, 0, 1.5], [0, 0, 0]]
    assert (first.lanes[0].width_m, first.lanes[1].width_m, first.lanes[0].length_m) == (2, None, 99.5)
    assert roads.has_heights and network.may_have_slopes(path)
    signal, end = roads.junctions
    assert (signal.id, signal.type, signal.at_m) == ("j", "traffic_light", (0.5, -2))
    assert signal.incoming_lanes == ("in_0", "in_1") and signal.shape_m.shape == (3, 3)
    assert end.incoming_lanes == () and end.shape_m.shape == (0, 3)
    assert roads.location == network.Location("+proj=utm +zone=54", (-100.5, 20))
    walks = roads.walkways
    assert (walks.areas, walks.crossings) == (1, 1)
    parts = {walk.edge: walk.part for walk in walks.sidewalks}
    assert parts["in"] == parts["out"] != parts["alone"]


def test_rejects_invalid_shape_when_it_is_used(tmp_path):
    path = tmp_path / "n.net.xml"
    path.write_text(WALKED.replace("0,0 5,5", "0,0 near,1 5,5"))
    with pytest.raises(InputError, match=r"n\.net\.xml: lane out_0: invalid coordinates in a shape \(.*'near'"):
        _ = network.read_net_xml(path).edges[1].lanes[0].shape_m


def test_rejects_shapes_longer_than_any_street() -> None:
    """A wrong digit in an exponent; what samples lanes would need gigabytes."""
    assert network.Shape("0,0 999999,0", "lane x").shape_m.shape == (2, 3)
    with pytest.raises(InputError, match=r"lane x: expected a shape of at most 1,000,000 m, got 94,400,016 m"):
        _ = network.Shape("0,0 4,0 9.44e7,0 9.44e7,16", "lane x").shape_m


@pytest.mark.parametrize("far", ["2147483648", "-1e300", "nan", "inf"])
def test_rejects_coordinates_beyond_the_earth(tmp_path: Path, far: str) -> None:
    """Of a road; of a lane that is not a road's, when somebody asks for it."""
    text = '<net><edge id="e" from="a" to="b"><lane id="e_0" shape="0,0,1 {},9,2"/></edge></net>'
    (tmp_path / "n.net.xml").write_text(text.format(far))
    with pytest.raises(InputError, match=rf"n.net.xml: invalid <edge id='e'>.*coordinate {far} is beyond 1e\+08 m"):
        network.read_net_xml(tmp_path / "n.net.xml")
    shape = network.Shape(f"0,0 {far},1", "n.net.xml: lane x")
    with pytest.raises(InputError, match=rf"n.net.xml: lane x: invalid coordinates in a shape \(the coordinate {far}"):
        _ = shape.shape_m


def test_speed_limit_of_zero_closes_a_lane(tmp_path: Path) -> None:
    path = tmp_path / "n.net.xml"
    text = '<net><edge id="e" from="a" to="b"><lane id="e_0" speed="{}" length="20" shape="0,0 20,0"/></edge></net>'
    path.write_text(text.format("0"))
    (edge,) = network.read_net_xml(path).edges
    assert (edge.lanes_for("passenger"), edge.seconds) == (0, math.inf)
    path.write_text(text.format("10"))
    (edge,) = network.read_net_xml(path).edges
    assert (edge.lanes_for("passenger"), edge.seconds) == (1, 2.0)
    path.write_text(text.format("-10"))
    with pytest.raises(InputError, match=r"n\.net\.xml: invalid <edge id='e'>.*'e_0' has .* the speed -10"):
        network.read_net_xml(path)


def test_rejects_ground_with_too_many_points(tmp_path: Path) -> None:
    """Roads of 90,000 km on a hill."""
    edge = '<edge id="e{0}" from="a" to="b"><lane id="e{0}_0" shape="0,{0},1 9e5,9,200"/></edge>'
    (tmp_path / "n.net.xml").write_text(f"<net>{''.join(map(edge.format, range(100)))}</net>")
    message = (
        r"n.net.xml: is so large that its ground needs [0-9,]+ points\. The limit is 2,000,000 points; set "
        r"EGVS_MAX_GROUND"
    )
    with pytest.raises(InputError, match=message):
        terrain.triangulate_ground(network.read_net_xml(tmp_path / "n.net.xml"), where="n.net.xml")


def test_red_phases_of_signals(tmp_path):
    """The longest ones, around the end of the cycle and with the longest phases of actuated signals."""
    path = tmp_path / "n.net.xml"
    path.write_text("""<net>
  <edge id="in" from="a" to="j"><lane id="in_0" index="0" shape="0,0 50,0"/><lane id="in_1" index="1" shape="0,3 50,3"/>
    <lane id="in_2" index="2" shape="0,6 50,6"/></edge>
  <edge id="out" from="j" to="b"><lane id="out_0" index="0" shape="60,0 90,0"/></edge>
  <tlLogic id="t" type="actuated" programID="0" offset="0">
    <phase duration="10" state="rrr"/><phase duration="20" maxDur="50" state="Grr"/>
    <phase duration="4" state="yrr"/><phase duration="5" state="rsr"/>
  </tlLogic>
  <connection from="in" to="out" fromLane="0" toLane="0" dir="s" state="o" tl="t" linkIndex="0"/>
  <connection from="in" to="out" fromLane="1" toLane="0" dir="s" state="o" tl="t" linkIndex="1"/>
  <connection from="in" to="out" fromLane="2" toLane="0" dir="s" state="o" tl="t" linkIndex="2"/>
</net>""")
    roads = network.read_net_xml(path)
    assert [(line.at_m, line.red_s) for line in roads.stop_lines] == [((50.0, 0.0), 19.0), ((50.0, 3.0), 64.0)]
    assert (roads.red_s, roads.cycle_s) == (64.0, 69.0)
