"""Networks as SUMO's plain XML, and their conversion by netconvert.

Plain XML: https://sumo.dlr.de/docs/Networks/PlainXML.html. Frame: x, y, z in metres of the world frame.
"""

from __future__ import annotations

NETWORK_FILE = "network.net.xml"

NETCONVERT_FLAGS = (
    "--offset.disable-normalization", "--no-turnarounds", "--precision", "3", "--output.street-names",
    "--junctions.right-before-left.speed-threshold", "0",
)  # fmt: skip
"""Keeps the frame; adds no turn; where no sign tells, minor roads give way: vehicles that all give way to the right
wait forever."""
