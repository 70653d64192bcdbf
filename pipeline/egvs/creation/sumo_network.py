"""Read roads of a SUMO network (``.net.xml``), which is used as it is."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

from egvs.core.digests import open_input
from egvs.core.errors import InputError
from egvs.creation.driving_side import side_in_frame
from egvs.creation.map_parts import RoadMap, RoadOptions
from egvs.traffic import network
from egvs.world.geolocation import network_world_frame

_GENERATOR = re.compile(r"<!-- generated on .*?-->\s*", re.DOTALL)
_LEFTHAND = re.compile(r'<net [^>]*lefthand="(?:true|1)"')
_GZIP = b"\x1f\x8b"


def read_roads(path: Path, options: RoadOptions) -> RoadMap:
    """Return a network without netconvert's comment, which contains a date and paths.

    Parameters
    ----------
    path
        The network, gzipped or not.
    options
        The side of traffic and ``walk`` must not be set: both are fixed in a network.

    Raises
    ------
    InputError
        When the network is damaged, or an option is set.
    """
    if options.lefthand or options.righthand or options.walk:
        option = "--lefthand" if options.lefthand else "--righthand" if options.righthand else "--walk"
        hint = "Leave it out, or make the network anew with netconvert."
        raise InputError(option, f"the SUMO network {path} has its own side of the road and sidewalks", hint)
    roads = network.read_net_xml(path)
    if roads.lacks_internal_edges:
        raise network.no_internal_edges_error(path, path)
    text = _GENERATOR.sub("", _read_text(path), count=1)
    notes = () if _LEFTHAND.search(text) else _side_notes(roads)
    return RoadMap(text, notes=notes, has_heights=roads.has_heights, keeps_heights=True)


def _side_notes(roads: network.Network) -> tuple[str, ...]:
    """Return a sentence on a network for right-hand traffic in a country with left-hand traffic."""
    evidence = side_in_frame(network_world_frame(roads.location), roads.edges[0].start_m)
    if evidence is None or evidence.side == "right":
        return ()
    return (f"Traffic drives on the right in the network, although {evidence.reason}: make it anew with --lefthand.",)


def _read_text(path: Path) -> str:
    with open_input(path) as content:
        data = content.read()
    if data.startswith(_GZIP):
        data = gzip.decompress(data)  # its size was checked when the network was read
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(path, "the network is not UTF-8 text", "Write it again with netconvert.") from None
