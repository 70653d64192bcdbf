"""Right of way of Lanelet2 maps, as SUMO's plain XML can state it.

A regulatory element names lanelets that yield and lanelets that have the right of way. Where a connection through the
former crosses one through the latter, SUMO gets a ``<prohibition>``. It holds between pairs of roads, not of lanes;
where two elements contradict each other for the same roads, none is written. Junctions where all lanes stop
(``all_way_stop``) become SUMO's ``allway_stop``. At junctions with traffic lights, the lights alone count.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass

from shapely.geometry import LineString

from egvs.extensions.maps.formats.lanelet2 import LaneletMap
from egvs.extensions.maps.lanelet2.plain_network import PlainElement
from egvs.extensions.maps.lanelet2.road_layout import RoadLayout, Turn

RoadPair = tuple[str, str]
"""The roads that a connection leads from and to."""


@dataclass(frozen=True)
class RightOfWay:
    """Who yields to whom.

    Attributes
    ----------
    prohibitions
        Pairs of connections: the second yields to the first.
    all_way_stops
        Nodes where all stop.
    unused
        Regulatory elements that have no effect in the network.
    """

    prohibitions: tuple[tuple[RoadPair, RoadPair], ...]
    all_way_stops: tuple[str, ...]
    unused: tuple[int, ...]

    def elements(self) -> Iterator[PlainElement]:
        """Yield the prohibitions as plain XML."""
        for prior, yielding in self.prohibitions:
            attributes = {"prohibitor": "->".join(prior), "prohibited": "->".join(yielding)}
            yield PlainElement("prohibition", attributes)


def find_right_of_way(layout: RoadLayout, lanelet_map: LaneletMap, signalised: Collection[str]) -> RightOfWay:
    """Find who yields to whom at the junctions of a map without traffic lights.

    Parameters
    ----------
    layout
        Roads and turns.
    lanelet_map
        The map.
    signalised
        The nodes with traffic lights.
    """
    pairs: set[tuple[RoadPair, RoadPair]] = set()
    stops: set[str] = set()
    unused = []
    for regulation in lanelet_map.regulations.values():
        if regulation.subtype not in ("right_of_way", "all_way_stop"):
            continue
        yielding = _turns_through(layout, regulation.ids("relation", "yield"))
        nodes = {layout.roads[turn.source].end for turn in yielding}
        if regulation.subtype == "all_way_stop":
            stops |= nodes
            is_used = bool(nodes)
        else:
            prior = _turns_through(layout, regulation.ids("relation", "right_of_way"))
            new = {(_roads(a), _roads(b)) for a in prior for b in yielding if _meet(a, b, layout)}
            is_used = bool(new) or not nodes.isdisjoint(signalised)
            pairs |= {(a, b) for a, b in new if layout.roads[a[0]].end not in signalised}
        if not is_used:
            unused.append(regulation.id)
    stops -= set(signalised)
    agreed = sorted((a, b) for a, b in pairs if (b, a) not in pairs)
    return RightOfWay(tuple(agreed), tuple(sorted(stops)), tuple(unused))


def _turns_through(layout: RoadLayout, lanelets: Collection[int]) -> list[Turn]:
    """Return the turns in junctions that use any of some lanelets, or come from one."""
    chosen = set(lanelets)
    turns: dict[Turn, None] = {}
    for turn in layout.turns:
        source = layout.roads[turn.source].lanes[turn.source_lane].key
        if not chosen.isdisjoint(key.id for key in (source, *turn.path)):
            turns |= dict.fromkeys(layout.turns_in_junction(turn))
    return list(turns)


def _meet(a: Turn, b: Turn, layout: RoadLayout) -> bool:
    """Return whether two turns at one node come from different roads and cross or merge."""
    if a.source == b.source or layout.roads[a.source].end != layout.roads[b.source].end:
        return False
    if (a.target, a.target_lane) == (b.target, b.target_lane):
        return True
    return bool(LineString(a.shape_m[:, :2]).intersects(LineString(b.shape_m[:, :2])))


def _roads(turn: Turn) -> RoadPair:
    return turn.source, turn.target
