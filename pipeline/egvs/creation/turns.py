"""Compare the turns of a network with those of its map, and repair the network.

netconvert opens turns that a map forbids, and loses others. Each reader of roads finds out which turns its map permits;
:func:`compare_turns` compares them with those that netconvert built; :func:`patch_network` lets netconvert close and
add connections; :func:`turn_notes` says what was repaired, and what still differs.

Turns are compared as the reader knows them: from lane to lane, or from edge to edge.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar
from xml.etree.ElementTree import Element
from xml.sax.saxutils import quoteattr

from egvs.core import files
from egvs.core.wording import by_number, list_first, number_of
from egvs.formats import xml
from egvs.traffic import sumo
from egvs.traffic.network import CAR, TURNAROUNDS, Permission

MOST_LISTED = 5

_PATCH_FILE, _SIGNALS_FILE = "turns.con.xml", "signals.nod.xml"
_LANE = re.compile(r'<lane id="([^"]*)"[^>]*>')
_CHANGE = re.compile(r' change(?:Left|Right)="[^"]*"')

Turn = TypeVar("Turn", bound=tuple[Any, ...])


class Connection(NamedTuple):
    """A connection of a network: edge and lane before it, edge and lane after it."""

    source: str
    source_lane: int
    target: str
    target_lane: int

    def __str__(self) -> str:
        return f"{self.source}_{self.source_lane} -> {self.target}_{self.target_lane}"


@dataclass
class BuiltTurns:
    """The connections of a network.

    Attributes
    ----------
    connections
        Those between roads that cars may use.
    u_turns
        Those that lead back to the road that they come from.
    ends
        The nodes where each edge starts and ends.
    """

    connections: set[Connection] = field(default_factory=set)
    u_turns: set[Connection] = field(default_factory=set)
    ends: dict[str, tuple[str, str]] = field(default_factory=dict)

    @classmethod
    def read(cls, network: Path) -> BuiltTurns:
        """Read a ``.net.xml``."""
        turns = cls()
        for element in xml.iter_elements(network, "net"):
            turns.add(element)
        return turns

    def add(self, element: Element) -> None:
        """Take an element of a ``.net.xml``; only edges and connections count."""
        if element.tag == "edge" and not element.get("function"):
            self.ends[element.attrib["id"]] = element.get("from", ""), element.get("to", "")
            return
        is_on_roads = element.tag == "connection" and ":" not in (element.attrib["from"][:1], element.attrib["to"][:1])
        if is_on_roads and Permission.from_attributes(element.attrib).admits(CAR):
            source_lane, target_lane = int(element.attrib["fromLane"]), int(element.attrib["toLane"])
            connection = Connection(element.attrib["from"], source_lane, element.attrib["to"], target_lane)
            self.connections.add(connection)
            if element.get("dir") in TURNAROUNDS:
                self.u_turns.add(connection)

    def can_connect(self, source: str, target: str) -> bool:
        """Return whether an edge ends at the node where another one starts: only such edges can be connected."""
        return source in self.ends and target in self.ends and self.ends[source][1] == self.ends[target][0]

    @property
    def edge_pairs(self) -> set[tuple[str, str]]:
        """The edges that are connected."""
        return {(connection.source, connection.target) for connection in self.connections}


@dataclass(frozen=True)
class TurnComparison(Generic[Turn]):
    """How the turns of a network differ from those of its map.

    Attributes
    ----------
    lost
        Turns of the map that the network lacks, sorted.
    added
        Turns of the network that the map does not have, sorted.
    """

    lost: tuple[Turn, ...]
    added: tuple[Turn, ...]


def compare_turns(permitted: Set[Turn], built: Set[Turn], tolerated: Iterable[Turn] = ()) -> TurnComparison[Turn]:
    """Compare the turns of a map with those of a network.

    Parameters
    ----------
    permitted
        Turns that the map permits.
    built
        Turns of the network.
    tolerated
        Further turns that the network may have.

    Returns
    -------
    TurnComparison
        Empty where both agree.
    """
    lost, added = permitted - built, built - permitted - set(tolerated)
    return TurnComparison(tuple(sorted(lost)), tuple(sorted(added)))


def patch_network(
    folder: Path,
    name: str,
    patched: str,
    *,
    removed: Iterable[Connection],
    added: Iterable[Connection],
    flags: Sequence[str],
    signals: Mapping[str, Collection[str]] | None = None,
) -> None:
    """Let netconvert remove and add connections of a network, and signals.

    Parameters
    ----------
    folder
        The folder of the network.
    name, patched
        The network, and the one to write.
    removed
        Connections of the network.
    added
        Connections to add, of edges that share a node (:meth:`BuiltTurns.can_connect`): with any other, netconvert
        rejects the network.
    flags
        Further flags of netconvert.
    signals
        Nodes that get signals, by the id of the signal.
    """
    elements = [f"<delete {_attributes(connection)}/>" for connection in sorted(set(removed))]
    elements += [f"<connection {_attributes(connection)}/>" for connection in sorted(set(added))]
    files.write_text(folder / _PATCH_FILE, "\n".join(["<connections>", *elements, "</connections>", ""]))
    arguments = ["-s", name, "-x", _PATCH_FILE, *flags]
    if signals:
        nodes = [
            f'<node id={quoteattr(node)} type="traffic_light" tl={quoteattr(signal)}/>'
            for signal, governed in signals.items()
            for node in governed
        ]
        files.write_text(folder / _SIGNALS_FILE, "\n".join(["<nodes>", *nodes, "</nodes>", ""]))
        arguments += ["-n", _SIGNALS_FILE]
    sumo.run_netconvert(arguments, folder, patched)
    original = (folder / name).read_text(encoding="utf-8")
    text = (folder / patched).read_text(encoding="utf-8")
    files.write_text(folder / patched, _restore_lane_changes(original, text))


def _attributes(connection: Connection) -> str:
    source, source_lane, target, target_lane = connection
    return (
        f"from={quoteattr(source)} to={quoteattr(target)}"
        f' fromLane="{source_lane}" toLane="{target_lane}"'
    )  # fmt: skip


def _restore_lane_changes(original: str, text: str) -> str:
    """Give lanes the limits of lane changes (``changeLeft``, ``changeRight``) that netconvert dropped on reading."""
    limits = {match[1]: _CHANGE.findall(match[0]) for match in _LANE.finditer(original)}

    def restore(match: re.Match[str]) -> str:
        missing = [limit for limit in limits.get(match[1], ()) if limit.split("=")[0] + "=" not in match[0]]
        end = "/>" if match[0].endswith("/>") else ">"
        return match[0].removesuffix(end) + "".join(missing) + end if missing else match[0]

    return _LANE.sub(restore, text)


def turn_notes(
    *,
    closed: Collection[str] = (),
    opened: Collection[str] = (),
    lost: Collection[str] = (),
    added: Collection[str] = (),
) -> tuple[str, ...]:
    """Return sentences on the turns that were repaired, and on those that still differ, each with its places.

    Parameters
    ----------
    closed, opened
        What was repaired: turns that only the network had, and turns that only the map had.
    lost, added
        What still differs: turns that only the map has, and turns that only the network has.
    """
    rows = (
        (closed, "that the map does not permit", ("was", "were"), "closed"),
        (opened, "of the map that netconvert had left out", ("was", "were"), "added"),
        (lost, "of the map", ("is", "are"), "missing in the network"),
        (added, "of the network", ("is", "are"), "not permitted by the map"),
    )
    notes = []
    for names, which, verbs, what in rows:
        if names:
            verb = by_number(len(names), *verbs)
            notes.append(f"{number_of(len(names), 'turn')} {which} {verb} {what}: {list_turns(names)}.")
    return tuple(notes)


def list_turns(names: Iterable[str]) -> str:
    """Return the first of some turns, without repetitions, and the number of the others."""
    return list_first(list(dict.fromkeys(names)), MOST_LISTED, "; ")


def lanes_of_pairs(connections: Iterable[Connection]) -> Mapping[tuple[str, str], list[Connection]]:
    """Group connections by their edges."""
    by_pair: dict[tuple[str, str], list[Connection]] = {}
    for connection in connections:
        by_pair.setdefault((connection.source, connection.target), []).append(connection)
    return by_pair
