"""A made-up junction.

The road "in" comes from the west on y = 0 and ends at x = -10; "out" leads east from x = 10; "north" leads north from
(0, 10). The speed limit is 10 m/s. Straight on, the junction's lane is the line from (-10, 0) to (10, 0); the left turn
waits at (0, 0).
"""

from __future__ import annotations

from pathlib import Path

from egvs.traffic.network import Network, read_net_xml

NETWORK = """<net version="1.20">
    <location netOffset="0.00,0.00" convBoundary="-110,0,110,110" origBoundary="0,0,0,0" projParameter="!"/>
    <edge id=":c_0" function="internal"><lane id=":c_0_0" index="0" speed="10" length="20" shape="-10,0 10,0"/></edge>
    <edge id=":c_1" function="internal"><lane id=":c_1_0" index="0" speed="10" length="10" shape="-10,0 0,0"/></edge>
    <edge id=":c_2" function="internal"><lane id=":c_2_0" index="0" speed="10" length="10" shape="0,0 0,10"/></edge>
    <edge id="in" from="w" to="c"><lane id="in_0" index="0" speed="10" length="100" shape="-110,0 -10,0"/></edge>
    <edge id="out" from="c" to="e"><lane id="out_0" index="0" speed="10" length="100" shape="10,0 110,0"/></edge>
    <edge id="north" from="c" to="n"><lane id="north_0" index="0" speed="10" length="100" shape="0,10 0,110"/></edge>
    <junction id="c" type="priority" x="0" y="0" incLanes="in_0" intLanes=":c_0_0 :c_1_0" shape="-10,-5 10,5"/>
    <junction id="w" type="dead_end" x="-110" y="0" incLanes="" intLanes="" shape="-110,0"/>
    <junction id="e" type="dead_end" x="110" y="0" incLanes="out_0" intLanes="" shape="110,0"/>
    <junction id="n" type="dead_end" x="0" y="110" incLanes="north_0" intLanes="" shape="0,110"/>
    <junction id=":c_2_0" type="internal" x="0" y="0" incLanes=":c_1_0" intLanes=":c_0_0"/>
    <connection from="in" to="out" fromLane="0" toLane="0" via=":c_0_0" dir="s" state="M"/>
    <connection from="in" to="north" fromLane="0" toLane="0" via=":c_1_0" dir="l" state="m"/>
    <connection from=":c_0" to="out" fromLane="0" toLane="0" dir="s" state="M"/>
    <connection from=":c_1" to="north" fromLane="0" toLane="0" via=":c_2_0" dir="l" state="m"/>
    <connection from=":c_2" to="north" fromLane="0" toLane="0" dir="l" state="M"/>
</net>
"""


def read_network(folder: Path) -> Network:
    """Return the network."""
    path = folder / "crossing.net.xml"
    path.write_text(NETWORK, encoding="utf-8")
    return read_net_xml(path)
