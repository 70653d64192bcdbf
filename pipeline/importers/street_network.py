"""A map's streets become a SUMO network: all of an extract's, or those round a junction.

Frame: the network's own x, y in metres. Neither dates nor paths get into the network's text.
"""

from __future__ import annotations

import html
import re
from collections.abc import Sequence
from pathlib import Path

from pipeline.core import files
from pipeline.core.errors import InputError, RunError
from pipeline.formats.osm import Extract, write_streets
from pipeline.importers import junctions, surroundings
from pipeline.importers.junctions import Junction, Streets
from pipeline.traffic import sumo, sumo_folder

ATTRIBUTION = "(c) OpenStreetMap contributors, ODbL"
NETWORK = "network.net.xml"

NETCONVERT = (
    "--geometry.remove", "--junctions.join", *sumo_folder.OSM_SIGNALS,
    "--keep-edges.by-vclass", "passenger,bus,truck", "--remove-edges.isolated",
    "--output.street-names", "--precision", "3",
)  # fmt: skip
"""How streets become a network."""

WALK = ("--sidewalks.guess", "--sidewalks.guess.max-speed", "28", "--crossings.guess")
"""Sidewalks, walking areas at their corners, and crossings between these.

Up to 28 m/s instead of 13.89: that is what netconvert takes a main street without ``maxspeed`` for; not a motorway.
"""


def flags(extract: Extract, *, lefthand: bool, walk: bool) -> list[str]:
    """netconvert's flags for an extract."""
    return [*NETCONVERT, *_boundary(extract), *(["--lefthand"] if lefthand else []), *(WALK if walk else [])]


def network(extract: Extract, osm: Path, flags: Sequence[str]) -> tuple[str, Streets]:
    """The SUMO network that netconvert makes with these flags, as text, and what is in it."""
    right = "an extract with streets for cars (ways with highway=...)"
    missing = InputError(osm, "has no drivable streets that meet", right)
    if not any("highway" in way.tags for way in extract.ways.values()):
        raise missing
    with files.scratch() as work:
        write_streets(extract, work / "streets.osm.xml")
        try:
            sumo.netconvert(["--osm-files", "streets.osm.xml", *flags], work, NETWORK)
            streets = junctions.read(work / NETWORK)
        except (RunError, InputError) as error:
            if re.search(r"No (nodes|edges) loaded|has no road", str(error)):
                raise missing from None
            if isinstance(error, sumo.RefusedError):
                raise InputError(osm, f"holds streets that cannot be used: {error}", "another extract") from None
            raise
        return _without_header((work / NETWORK).read_text(encoding="utf-8")), streets


class Pieces:
    """A network's text in pieces, to write parts of it: roads for maps and checks, nothing that SUMO could run.

    Elements stay as netconvert wrote them, one below the other.
    """

    def __init__(self, text: str) -> None:
        found = list(_ELEMENT.finditer(text))
        self._head = text[: found[0].start()] if found else text
        self._head = re.sub(r"^    <type .*\n", "", self._head, flags=re.MULTILINE)
        self._of_edges = {_attribute(m[0], "id"): m[0] for m in found if m[1] == "edge"}
        self._of_junctions = {_attribute(m[0], "id"): m[0] for m in found if m[1] == "junction"}
        self._connections = [
            (_attribute(m[0], "from"), _attribute(m[0], "to"), m[0]) for m in found if m[1] == "connection"
        ]

    def near(self, streets: Streets) -> str:
        """The part with these streets (:meth:`pipeline.importers.junctions.Streets.near`)."""
        nodes = {node.id for node in streets.network.junctions}
        roads = {edge.id for edge in streets.network.edges}
        edges = {its: text for its, text in self._of_edges.items() if its in roads or _node(its, 1) in nodes}
        kept = (text for its, text in self._of_junctions.items() if its in nodes or _node(its, 2) in nodes)
        links = (text for start, end, text in self._connections if start in edges and end in edges)
        return "".join([self._head, *edges.values(), *kept, *links, "\n</net>\n"])


_ELEMENT = re.compile(r"^    <(edge|junction|connection) [^\n]*?(?:/>|>\n.*?^    </\1>)\n", re.MULTILINE | re.DOTALL)


def _attribute(element: str, name: str) -> str:
    found = re.search(rf' {name}="([^"]*)"', element)
    return html.unescape(found[1]) if found else ""


def _node(its_id: str, numbers: int) -> str:
    """The junction of an edge inside it (":J_3"), or of a point on such an edge (":J_3_0"), which has two numbers."""
    return its_id[1:].rsplit("_", numbers)[0] if its_id.startswith(":") else ""


def cropped(
    extract: Extract, osm: Path, flags: Sequence[str], streets: Streets, junction: Junction, radius_m: float
) -> tuple[str, Streets]:
    """The network of a junction's surroundings, in the frame of the whole network ``streets``."""
    location = streets.network.location
    assert location is not None, "netconvert writes it"
    ((lon_deg, lat_deg),) = streets.to_degrees([junction.at_m])
    east_m, north_m = location.offset_m
    frame = ["--proj", location.projection, "--offset.disable-normalization", "--offset.x", f"{east_m!r}",
             "--offset.y", f"{north_m!r}"]  # fmt: skip
    return network(surroundings.cut_out(extract, (lat_deg, lon_deg), radius_m), osm, [*flags, *frame])


def _boundary(extract: Extract) -> list[str]:
    """Streets that reach beyond the extract's bounds are left whole, those wholly outside are left out."""
    if not extract.declared:
        return []
    b = extract.bounds
    return ["--keep-edges.in-geo-boundary", f"{b.west_deg!r},{b.south_deg!r},{b.east_deg!r},{b.north_deg!r}"]


def _without_header(network: str) -> str:
    """netconvert's first comment holds the date and paths; the attribution takes its place."""
    return re.sub(r"<!-- generated on .*?-->", f"<!-- {ATTRIBUTION} -->", network, count=1, flags=re.DOTALL)
