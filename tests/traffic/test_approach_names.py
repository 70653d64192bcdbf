"""One name per approach, also where its arm is curved.

The arm of Mill Lane comes from the east on y = 10, turns at (10, 10), and ends diagonally at the junction (0, 0). Its
last 10 m point to the north-east. Of the last 30 m, 14.1 m are diagonal and 15.9 m lead east, from the point
(25.9, 10): 21.1 degrees north of east, hence the east side (up to 22.5 degrees).
"""

from pathlib import Path

import numpy as np
import pytest

from egvs.core.grid import Roi
from egvs.scenario.traffic_config import CountConfig
from egvs.scoring.road_locations import RoadLocations
from egvs.traffic import signals
from egvs.traffic.approach_names import ApproachNames, disambiguate_approaches
from egvs.traffic.approaches import ApproachIndex
from egvs.traffic.movements import MovementNames
from egvs.traffic.network import Network, read_net_xml

ONE_PIECE = """
    <edge id="arm" from="e" to="c" name="Mill Lane">
        <lane id="arm_0" index="0" speed="10" length="64.14" shape="60,10 10,10 0,0"/></edge>"""
TWO_PIECES = """
    <edge id="far" from="e" to="p" name="Mill Lane">
        <lane id="far_0" index="0" speed="10" length="50" shape="60,10 10,10"/></edge>
    <edge id="arm" from="p" to="c" name="Mill Lane">
        <lane id="arm_0" index="0" speed="10" length="14.14" shape="10,10 0,0"/></edge>
    <connection from="far" to="arm" fromLane="0" toLane="0" dir="s" state="M"/>"""
REST = """
    <edge id=":c_0" function="internal"><lane id=":c_0_0" index="0" speed="10" length="10" shape="0,0 -10,0"/></edge>
    <edge id=":c_c0" function="crossing" crossingEdges="arm">
        <lane id=":c_c0_0" index="0" allow="pedestrian" speed="1" length="8" shape="6,2 2,6"/></edge>
    <edge id="out" from="c" to="w"><lane id="out_0" index="0" speed="10" length="90" shape="-10,0 -100,0"/></edge>
    <edge id="up" from="c" to="n"><lane id="up_0" index="0" speed="10" length="90" shape="0,10 0,100"/></edge>
    <tlLogic id="c" type="static" programID="0" offset="0"><phase duration="30" state="Gr"/>
        <phase duration="30" state="rG"/></tlLogic>
    <junction id="c" type="traffic_light" x="0" y="0" incLanes="arm_0" intLanes=":c_0_0 :c_c0_0" shape="5,5 -10,-5">
        <request index="0" response="10" foes="10"/><request index="1" response="00" foes="01"/></junction>
    <junction id="e" type="dead_end" x="60" y="10" incLanes="" intLanes="" shape="60,10"/>
    <junction id="p" type="priority" x="10" y="10" incLanes="" intLanes="" shape="10,10"/>
    <junction id="w" type="dead_end" x="-100" y="0" incLanes="out_0" intLanes="" shape="-100,0"/>
    <junction id="n" type="dead_end" x="0" y="100" incLanes="up_0" intLanes="" shape="0,100"/>
    <connection from="arm" to="out" fromLane="0" toLane="0" via=":c_0_0" tl="c" linkIndex="0" dir="s" state="M"/>
    <connection from="arm" to="up" fromLane="0" toLane="0" dir="r" state="M"/>
    <connection from=":c_w0" to=":c_c0" fromLane="0" toLane="0" tl="c" linkIndex="1" dir="s" state="M"/>
</net>
"""


@pytest.fixture(params=[ONE_PIECE, TWO_PIECES], ids=["one piece", "two pieces"])
def path(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    file = tmp_path / "curve.net.xml"
    file.write_text(f'<net version="1.20">{request.param}{REST}')
    return file


@pytest.fixture
def roads(path: Path) -> Network:
    return read_net_xml(path)


def test_heading_is_that_of_the_last_30_m(roads: Network) -> None:
    """From (10 + 30 - 14.142, 10) = (25.858, 10) to (0, 0)."""
    np.testing.assert_allclose(ApproachNames(roads).heading("arm"), [-25.858, -10.0], atol=1e-3)
    np.testing.assert_allclose(ApproachNames(roads).exit_heading("out"), [-30.0, 0.0])


def test_counts_plans_lanes_and_crosswalks_share_the_name(path: Path, roads: Network) -> None:
    name = "Mill Lane (east)"
    index = ApproachIndex.of_flows(
        [CountConfig(from_edge="arm", to_edge="out", per_hour=60.0)], MovementNames(roads, (0.0, 0.0))
    )
    assert index.titles == [name]
    assert MovementNames(roads, (0.0, 0.0)).describe("arm", "out") == f"{name}, straight on to an unnamed street"
    (signal,) = signals.read_signals(path, roads)
    assert [link.title for link in signal.links] == [f"{name} straight", f"{name} crosswalk"]
    locations = RoadLocations.of(roads, Roi((-50.0, -50.0, 0.0), (100.0, 100.0, 5.0))).locations
    words = {location.words for location in locations}
    assert {f"{name} approach", f"{name}, straight-and-right lane", f"{name} crosswalk", "west exit"} <= words
    assert f"{name}, straight movement through the junction" in words


@pytest.mark.parametrize("text", ["Mill Lane (east)", "E (Mill Ln.)", "east Mill Lane", "E", "from the east", "WB"])
def test_every_spelling_means_the_approach(roads: Network, text: str) -> None:
    flows = [CountConfig(from_edge="arm", to_edge="out", per_hour=60.0)]
    index = ApproachIndex.of_flows(flows, MovementNames(roads, (0.0, 0.0)))
    street, side = index.parse_approach(text, "line 2")
    assert (index.find(street, side, (), "line 2")[0].approach_title, side) == ("Mill Lane (east)", "east")


def test_full_name_is_accepted_as_street(roads: Network) -> None:
    flows = [CountConfig(from_edge="arm", to_edge="out", per_hour=60.0)]
    index = ApproachIndex.of_flows(flows, MovementNames(roads, (0.0, 0.0)))
    assert index.find("Mill Ln (east)", None, (), "line 2") == list(index.movements)


def test_equal_names_get_the_edge() -> None:
    assert disambiguate_approaches(["a", "b", "a"], ["1", "2", "3"]) == ["a, edge 1", "b", "a, edge 3"]
