"""A made-up network: an eastbound road with a left-turn lane, cut in two before the junction, and what it meets."""

from __future__ import annotations

from pathlib import Path

from egvs.core.grid import Grid
from egvs.traffic import network
from egvs.traffic.network import Network

GRID = Grid((0.0, -20.0, 0.0), 1.0, (60, 40, 5))
"""60 m to the east from 0, 40 m to the north from -20; the junction is at its middle, 30 to 36 m to the east."""

NETWORK = """<net version="1.20">
    <edge id=":j_0" function="internal"><lane id=":j_0_0" index="0" length="6" shape="30,-4.8 36,-4.8"/></edge>
    <edge id=":j_1" function="internal"><lane id=":j_1_0" index="0" length="3" shape="30,-1.6 33,-1"/></edge>
    <edge id=":j_2" function="internal"><lane id=":j_2_0" index="0" length="5" shape="33,-1 35,4"/></edge>
    <edge id=":p_0" function="internal">
        <lane id=":p_0_0" index="0" length="0.1" shape="15,-4.8 15.1,-4.8"/>
        <lane id=":p_0_1" index="1" length="0.1" shape="15,-4.8 15.1,-1.6"/></edge>
    <edge id=":j_c0" function="crossing"><lane id=":j_c0_0" index="0" allow="pedestrian" width="4" length="9"
        shape="38,-8 38,1"/></edge>
    <edge id=":j_w0" function="walkingarea"><lane id=":j_w0_0" index="0" allow="pedestrian" width="4" length="3"
        shape="36,-8 40,-8 40,-10"/></edge>
    <edge id="far" from="w" to="p" name="High Street">
        <lane id="far_0" index="0" length="30" shape="-15,-4.8 15,-4.8"/></edge>
    <edge id="near" from="p" to="j" name="High Street">
        <lane id="near_0" index="0" allow="pedestrian" width="2" length="15" shape="15,-8 30,-8"/>
        <lane id="near_1" index="1" disallow="pedestrian" length="15" shape="15.1,-4.8 30,-4.8"/>
        <lane id="near_2" index="2" disallow="pedestrian" length="15" shape="15.1,-1.6 30,-1.6"/></edge>
    <edge id="out" from="j" to="e" name="High Street">
        <lane id="out_0" index="0" length="84" shape="36,-4.8 120,-4.8"/></edge>
    <edge id="up" from="j" to="n"><lane id="up_0" index="0" length="76" shape="35,4 35,80"/></edge>
    <edge id="back" from="e" to="w" name="High Street">
        <lane id="back_0" index="0" length="135" shape="120,1.6 -15,1.6"/></edge>
    <junction id="j" type="priority" x="33" y="-2" incLanes="" intLanes="" shape="30,-8 36,-8 36,4 30,4"/>
    <junction id="p" type="priority" x="15" y="-4.8" incLanes="" intLanes="" shape="15,-8 15.1,0"/>
    <junction id=":j_2_0" type="internal" x="33" y="-1" incLanes=":j_1_0 back_0" intLanes=""/>
    <connection from="far" to="near" fromLane="0" toLane="1" via=":p_0_0" dir="s" state="M"/>
    <connection from="far" to="near" fromLane="0" toLane="2" via=":p_0_1" dir="s" state="M"/>
    <connection from="near" to="out" fromLane="1" toLane="0" via=":j_0_0" dir="s" state="M"/>
    <connection from="near" to="up" fromLane="2" toLane="0" via=":j_1_0" dir="l" state="m"/>
    <connection from=":j_1" to="up" fromLane="0" toLane="0" via=":j_2_0" dir="l" state="m"/>
</net>
"""


def read(folder: Path, text: str = NETWORK) -> Network:
    """The network, through its file."""
    path = folder / "made.net.xml"
    path.write_text(text)
    return network.read_net_xml(path)
