"""Parts of a network as text, for the maps of junctions."""

from __future__ import annotations

import html
import re

from egvs.creation.junctions import Streets

_ELEMENT = re.compile(r"^    <(edge|junction|connection) [^\n]*?(?:/>|>\n.*?^    </\1>)\n", re.MULTILINE | re.DOTALL)


class NetworkExcerpts:
    """Parts of a network as text: roads for maps and checks, not for a simulation.

    Elements stay as netconvert wrote them.

    Parameters
    ----------
    text
        A network that netconvert wrote.
    """

    def __init__(self, text: str) -> None:
        elements = list(_ELEMENT.finditer(text))
        head = text[: elements[0].start()] if elements else text
        self._head = re.sub(r"^    <type .*\n", "", head, flags=re.MULTILINE)
        self._edges: dict[str, str] = {}
        self._junctions: dict[str, str] = {}
        self._connections: list[tuple[str, str, str]] = []
        for match in elements:
            element, tag = match[0], match[1]
            if tag == "edge":
                self._edges[_attribute(element, "id")] = element
            elif tag == "junction":
                self._junctions[_attribute(element, "id")] = element
            else:
                self._connections.append((_attribute(element, "from"), _attribute(element, "to"), element))

    def near(self, streets: Streets) -> str:
        """Return the part with these streets (from :meth:`egvs.creation.junctions.Streets.near`)."""
        nodes = {node.id for node in streets.network.junctions}
        roads = {edge.id for edge in streets.network.edges}
        edge_ids = [i for i in self._edges if i in roads or _node_of_internal_id(i, 1) in nodes]
        edges = {edge_id: self._edges[edge_id] for edge_id in edge_ids}
        texts = [self._head, *edges.values()]
        for junction_id, element in self._junctions.items():
            if junction_id in nodes or _node_of_internal_id(junction_id, 2) in nodes:
                texts.append(element)
        for source, target, element in self._connections:
            if source in edges and target in edges:
                texts.append(element)
        return "".join([*texts, "\n</net>\n"])


def _attribute(element: str, name: str) -> str:
    match = re.search(rf' {name}="([^"]*)"', element)
    return html.unescape(match[1]) if match else ""


def _node_of_internal_id(internal_id: str, numbers: int) -> str:
    """Return the junction of an internal edge (":J_3") or, with two numbers, of an internal junction (":J_3_0")."""
    if not internal_id.startswith(":"):
        return ""
    return internal_id[1:].rsplit("_", numbers)[0]
