"""Networks as SUMO's plain XML, and their conversion by netconvert.

Plain XML: https://sumo.dlr.de/docs/Networks/PlainXML.html. Frame: x, y, z in metres of the world frame.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from egvs.core import files
from egvs.core.grid import FloatArray
from egvs.creation.plain_network import NETCONVERT_FLAGS, NETWORK_FILE
from egvs.formats.georeference import WorldFrame
from egvs.traffic import sumo

_NO_PROJECTION = "!"

_GENERATED = re.compile(r"<!-- generated on .*?-->\n*", re.DOTALL)

_DIGITS = 3


@dataclass(frozen=True)
class PlainElement:
    """An XML element with its attributes and children."""

    tag: str
    attributes: Mapping[str, str]
    children: tuple[PlainElement, ...] = ()

    def lines(self, indent: str = "    ") -> Iterable[str]:
        """Yield the lines of the element."""
        attributes = "".join(f" {key}={quoteattr(value)}" for key, value in self.attributes.items())
        if not self.children:
            yield f"{indent}<{self.tag}{attributes}/>"
            return
        yield f"{indent}<{self.tag}{attributes}>"
        for child in self.children:
            yield from child.lines(indent + "    ")
        yield f"{indent}</{self.tag}>"


@dataclass
class PlainNetwork:
    """The parts of a network.

    Attributes
    ----------
    frame
        Position of the world frame on the Earth; None if it is unknown.
    nodes, edges, connections, signals
        The elements of the four files.
    """

    frame: WorldFrame | None
    nodes: list[PlainElement] = field(default_factory=list)
    edges: list[PlainElement] = field(default_factory=list)
    connections: list[PlainElement] = field(default_factory=list)
    signals: list[PlainElement] = field(default_factory=list)

    def build(self, flags: Sequence[str] = ()) -> str:
        """Run netconvert and return the text of the network, without dates and paths.

        RunError when netconvert rejects it.
        """
        with files.temporary_folder() as folder:
            arguments = [*self._write(folder), *NETCONVERT_FLAGS, *flags]
            sumo.run_netconvert(arguments, folder, NETWORK_FILE)
            text = (folder / NETWORK_FILE).read_text(encoding="utf-8")
        return _GENERATED.sub("", text, count=1)

    def _write(self, folder: Path) -> list[str]:
        """Write the files and return the arguments of netconvert that name them."""
        location = PlainElement("location", location_attributes(self.frame))
        documents = [
            ("--node-files", "map.nod.xml", "nodes", [location, *self.nodes]),
            ("--edge-files", "map.edg.xml", "edges", self.edges),
            ("--connection-files", "map.con.xml", "connections", self.connections),
        ]
        if self.signals:
            documents.append(("--tllogic-files", "map.tll.xml", "tlLogics", self.signals))
        arguments = []
        for flag, name, root, elements in documents:
            lines = [f"<{root}>", *(line for element in elements for line in element.lines()), f"</{root}>", ""]
            files.write_text(folder / name, "\n".join(lines))
            arguments += [flag, name]
        return arguments


def location_attributes(frame: WorldFrame | None) -> dict[str, str]:
    """Return the attributes of ``<location>``."""
    offset_m, projection = (0.0, 0.0), _NO_PROJECTION
    if frame is not None:
        offset_m, projection = frame.offset_m, frame.projection
    return {
        "netOffset": ",".join(f"{value!r}" for value in offset_m),
        "convBoundary": "0,0,0,0",
        "origBoundary": "0,0,0,0",
        "projParameter": projection,
    }


def format_shape(points_m: FloatArray, z_m: float | None = None) -> str:
    """Format a line (n, 2 or 3) as SUMO does.

    >>> format_shape(np.array([[1.0, 2.0, 0.5], [3.0, 4.0, 0.5]]))
    '1,2,0.5 3,4,0.5'
    """
    if z_m is not None:
        points_m = np.column_stack([points_m[:, :2], np.full(len(points_m), z_m)])
    return " ".join(",".join(format_number(value) for value in point) for point in points_m.tolist())


def format_number(value: float) -> str:
    """Format a length with the digits that netconvert writes."""
    text = f"{value:.{_DIGITS}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
