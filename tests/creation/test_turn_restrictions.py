"""Turns of OpenStreetMap maps in the network: hand-made restrictions, and many random junctions.

What is permitted at a random junction is found by listing all paths over its ways, each of which is tested against each
restriction as the wiki defines it.
"""

from __future__ import annotations

import itertools
import math
import random
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest

from egvs.creation.openstreetmap import street_network
from egvs.creation.openstreetmap.restrictions import read_restrictions
from egvs.creation.openstreetmap.street_network import StreetNetwork
from egvs.formats import osm
from egvs.formats.osm import Bounds, Member, OsmExtract, Relation, Way
from tests.creation.small_maps import XY, degrees

ARM_M, APART_M = 250.0, 7.0
_EDGE = re.compile(r"(-?)(\d+)")


@dataclass
class MapDraft:
    """Ways between positions in metres, and restrictions between them."""

    nodes: dict[XY, int] = field(default_factory=dict)
    ways: dict[int, Way] = field(default_factory=dict)
    relations: list[Relation] = field(default_factory=list)
    signals: bool = False

    def way(self, *points: XY, **tags: str) -> int:
        """Add a street; return its identifier."""
        number = len(self.ways) + 11
        nodes = tuple(self.nodes.setdefault(point, len(self.nodes) + 1) for point in points)
        self.ways[number] = Way(number, nodes, {"highway": "secondary", "name": f"Street {number}", **tags})
        return number

    def restrict(self, kind: str, source: int, via: Sequence[Member], target: int) -> int:
        """Add a turn restriction; return its identifier."""
        number = len(self.relations) + 901
        members = (Member("way", source, "from"), *via, Member("way", target, "to"))
        self.relations.append(Relation(number, members, {"type": "restriction", "restriction": kind}))
        return number

    def via(self, point: XY) -> list[Member]:
        """The node of a turn."""
        return [Member("node", self.nodes[point], "via")]

    def extract(self) -> OsmExtract:
        """Return the map."""
        nodes = {number: degrees(point) for point, number in self.nodes.items()}
        lats, lons = zip(*nodes.values(), strict=True)
        bounds = Bounds(min(lats), min(lons), max(lats), max(lons))
        inner = [number for point, number in self.nodes.items() if math.hypot(*point) < ARM_M / 2]
        tags = {number: {"highway": "traffic_signals"} for number in inner} if self.signals else {}
        return OsmExtract(nodes, tags, self.ways, tuple(self.relations), bounds, False)


def build(extract: OsmExtract, *, walk: bool = False) -> StreetNetwork:
    """Build the network of an extract."""
    flags = street_network.netconvert_flags(extract, lefthand=False, walk=walk)
    return street_network.build_network(extract, Path("map.osm"), flags)


def edge_turns(made: StreetNetwork) -> set[tuple[str, str]]:
    """The edges that are connected for cars, without U-turns at dead ends."""
    roads = made.streets.network
    pairs = {(roads.edges[source].id, roads.edges[target].id) for source, target, _ in roads.links("passenger")}
    return {(a, b) for a, b in pairs if a != f"-{b}" and b != f"-{a}"}


def notes(made: StreetNetwork) -> tuple[str, ...]:
    """The notes on turns, without the one on U-turns."""
    return tuple(note for note in made.notes if "U-turn" not in note and "by road class" not in note)


def divided_road() -> tuple[MapDraft, dict[str, int]]:
    """A street from north to south crosses a divided road."""
    draft = MapDraft(signals=True)
    north, south = (0.0, APART_M), (0.0, -APART_M)
    ways = {
        "north": draft.way((0.0, ARM_M), north),
        "middle": draft.way(north, south),
        "south": draft.way(south, (0.0, -ARM_M)),
        "from east": draft.way((ARM_M, APART_M), north, oneway="yes", lanes="2"),
        "to west": draft.way(north, (-ARM_M, APART_M), oneway="yes", lanes="2"),
        "from west": draft.way((-ARM_M, -APART_M), south, oneway="yes", lanes="2"),
        "to east": draft.way(south, (ARM_M, -APART_M), oneway="yes", lanes="2"),
    }
    return draft, ways


@pytest.mark.slow
@pytest.mark.parametrize("walk", [False, True])
def test_restriction_inside_junction_holds(walk: bool) -> None:
    draft, ways = divided_road()
    relation = draft.restrict("no_left_turn", ways["middle"], draft.via((0.0, -APART_M)), ways["to east"])
    forbidden = str(ways["north"]), str(ways["to east"])
    made = build(draft.extract(), walk=walk)
    free = build(replace(draft.extract(), relations=()), walk=walk)
    assert edge_turns(made) == edge_turns(free) - {forbidden} and forbidden in edge_turns(free)
    street = f"Street {ways['north']} to Street {ways['to east']} at 52.00006,10.00000 (relation {relation})"
    assert notes(made) == (f"1 turn that the map does not permit was closed: {street}.",) and not notes(free)
    assert made.streets.network.cycle_s > 0
    walkways = made.streets.network.walkways, free.streets.network.walkways
    assert walkways[0].crossings == walkways[1].crossings and bool(walkways[0].crossings) == walk


@pytest.mark.slow
def test_restriction_between_objects_with_negative_ids_holds() -> None:
    """Editors give new objects negative numbers: edge -11 is way -11, not way 11 against its direction."""
    draft, ways = divided_road()
    draft.restrict("no_left_turn", ways["middle"], draft.via((0.0, -APART_M)), ways["to east"])
    made = draft.extract()
    negative = replace(
        made,
        nodes={-number: at for number, at in made.nodes.items()},
        node_tags={-number: tags for number, tags in made.node_tags.items()},
        ways={-way.id: Way(-way.id, tuple(-n for n in way.nodes), way.tags) for way in made.ways.values()},
        relations=tuple(
            replace(r, id=-r.id, members=tuple(m._replace(id=-m.id) for m in r.members)) for r in made.relations
        ),
    )
    turns = edge_turns(build(negative))
    assert (f"-{ways['north']}", f"-{ways['to east']}") not in turns
    assert (f"-{ways['north']}", f"-{ways['south']}") in turns and len(turns) == len(edge_turns(build(made)))


@pytest.mark.slow
def test_restriction_over_way_inside_junction_holds() -> None:
    """From the north to the east is forbidden; from the west to the east is not."""
    draft, ways = divided_road()
    draft.restrict("no_left_turn", ways["north"], [Member("way", ways["middle"], "via")], ways["to east"])
    turns = edge_turns(build(draft.extract()))
    assert (str(ways["north"]), str(ways["to east"])) not in turns
    assert (str(ways["north"]), str(ways["south"])) in turns
    assert (str(ways["from west"]), str(ways["to east"])) in turns


@pytest.mark.slow
def test_repaired_network_is_otherwise_the_same() -> None:
    draft, ways = divided_road()
    free = build(draft.extract())
    draft.restrict("no_left_turn", ways["middle"], draft.via((0.0, -APART_M)), ways["to east"])
    made = build(draft.extract())
    assert "origId" not in made.text and "origTo" not in free.text
    before, after = ([lane.text for edge in n.streets.network.edges for lane in edge.lanes] for n in (free, made))
    assert before == after
    assert 'type="actuated"' in made.text and "minDur" in made.text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tags", "is_open", "expected"),
    [
        ({"restriction:conditional": "no_left_turn @ (07:00-09:00)"}, True, "at certain times only, and are left out"),
        ({"restriction": "no_left_turn", "hour_on": "07:00", "hour_off": "09:00"}, True,
         "at certain times only, and are left out"),
        ({"restriction": "no_left_turn", "except": "motorcar"}, True,
         "for certain vehicles only, and were not compared with the network"),
        ({"restriction": "no_left_turn", "except": "bus;bicycle"}, False,
         "for all but certain vehicles; in the network they may hold for these, too"),
    ],
)  # fmt: skip
def test_restrictions_that_a_network_cannot_keep_are_named(tags: dict[str, str], is_open: bool, expected: str) -> None:
    draft, ways = divided_road()
    relation = draft.restrict("", ways["middle"], draft.via((0.0, -APART_M)), ways["to east"])
    draft.relations = [replace(draft.relations[0], tags={"type": "restriction", **tags})]
    made = build(draft.extract())
    assert ((str(ways["north"]), str(ways["to east"])) in edge_turns(made)) == is_open
    assert notes(made)[-1] == f"Turn restrictions that hold {expected}: 1 (relation {relation})."


@pytest.mark.slow
@pytest.mark.parametrize("via", [None, (0.0, ARM_M)])
def test_restriction_whose_streets_do_not_meet_at_its_node_is_named(via: XY | None) -> None:
    draft, ways = divided_road()
    members = [] if via is None else draft.via(via)
    relation = draft.restrict("no_left_turn", ways["middle"], members, ways["to east"])
    (note,) = notes(build(draft.extract()))
    assert note.startswith("Turn restrictions whose streets do not meet at their via, and which are left out")
    assert note.endswith(f"1 (relation {relation}).")


@pytest.mark.slow
def test_restriction_without_a_target_is_named() -> None:
    draft, ways = divided_road()
    relation = draft.restrict("no_left_turn", ways["middle"], draft.via((0.0, -APART_M)), ways["to east"])
    draft.relations = [replace(draft.relations[0], members=draft.relations[0].members[:-1])]
    (note,) = notes(build(draft.extract()))
    assert note.startswith("Turn restrictions whose streets do not meet") and f"(relation {relation})" in note


@pytest.mark.slow
def test_only_permitted_way_may_be_no_street() -> None:
    """All turns would be closed; the footway is drawn to the middle of the junction."""
    draft, ways = divided_road()
    path = draft.way((0.0, -APART_M), (30.0, -40.0), highway="footway")
    relation = draft.restrict("only_left_turn", ways["from west"], draft.via((0.0, -APART_M)), path)
    made = build(draft.extract())
    assert any("whose only permitted street is not in the network" in n and str(relation) in n for n in notes(made))
    assert (str(ways["from west"]), str(ways["to east"])) in edge_turns(made)


@pytest.mark.slow
def test_turn_that_is_forbidden_at_red_is_open() -> None:
    """netconvert would close it."""
    draft, ways = divided_road()
    draft.restrict("no_right_turn_on_red", ways["from west"], draft.via((0.0, -APART_M)), ways["south"])
    made = build(draft.extract())
    assert (str(ways["from west"]), str(ways["south"])) in edge_turns(made)


def test_restriction_over_street_between_junctions_is_named() -> None:
    """SUMO has no way to say that only those who come from one street may not turn."""
    draft = MapDraft()
    here, there = (0.0, 0.0), (150.0, 0.0)
    source, via = draft.way((-ARM_M, 0.0), here), draft.way(here, there)
    draft.way(there, (150.0 + ARM_M, 0.0))
    target = draft.way(there, (150.0, ARM_M))
    draft.way(here, (0.0, ARM_M))
    relation = draft.restrict("no_left_turn", source, [Member("way", via, "via")], target)
    (note,) = notes(build(draft.extract()))
    assert note.startswith("Turn restrictions that lead over a street between two junctions")
    assert note.endswith(f"the turns stay open: 1 (relation {relation}).")


@pytest.mark.parametrize(
    ("arrows", "number"),
    [("through|through", 1), ("left;through|through", 0), ("through|left", 2), ("|", 0), ("through|through|left", 0)],
)
def test_arrows_on_lanes_are_compared(arrows: str, number: int) -> None:
    """The right lane leads straight on, the left one straight on and to the left."""
    draft = MapDraft()
    middle = (0.0, 0.0)
    source = draft.way((-ARM_M, 0.0), middle, oneway="yes", lanes="2", **{"turn:lanes": arrows})
    ahead = draft.way(middle, (ARM_M, 0.0), oneway="yes", lanes="2")
    target = draft.way(middle, (0.0, ARM_M))
    made = build(draft.extract())
    lanes = {(c.source_lane, made.streets.network.edges[c.target].id) for c in made.streets.network.connections
             if made.streets.network.edges[c.source].id == str(source)}  # fmt: skip
    assert lanes == {(0, str(ahead)), (1, str(ahead)), (1, str(target))}
    found = [note for note in notes(made) if "turn:lanes" in note]
    assert [int(note.split()[0]) for note in found] == ([number] if number else [])
    if number == 1:
        turn = f"Street {source} to Street {target} at 52.00000,10.00000"
        assert found == [f"1 connection of lanes does not follow the arrows of the map (turn:lanes): {turn}."]


def test_restriction_follows_the_piece_of_a_street_that_was_cut() -> None:
    """Street 11 leaves the circle and returns; its shorter piece, which leads to the turn, gets another identifier."""
    draft = MapDraft()
    turn, aside = (30.0, 0.0), (-40.0, 0.0)
    source = draft.way((-60.0, 20.0), aside, (-40.0, -400.0), (30.0, -400.0), (30.0, -60.0), turn)
    target = draft.way(turn, (150.0, 0.0))
    draft.way(turn, (30.0, 150.0))
    draft.way(aside, turn)
    relation = draft.restrict("no_right_turn", source, draft.via(turn), target)
    cut = street_network.cut_surroundings(draft.extract(), degrees((0.0, 0.0)), 100.0)
    (restriction,) = read_restrictions(cut).in_force
    (piece,) = restriction.sources
    assert draft.nodes[turn] in cut.ways[piece].nodes and restriction.id == relation


def random_map(seed: int) -> tuple[MapDraft, list[int]]:
    """A junction of two roads, each divided or not, with an arm fewer at times; return it with the inner ways."""
    rng = random.Random(seed)
    draft = MapDraft(signals=rng.random() < 0.5)
    lines: list[list[tuple[float, int]]] = [
        [(-APART_M, 1), (APART_M, -1)] if rng.random() < 0.6 else [(0.0, rng.choice([0, 0, 0, 1, -1]))]
        for _ in range(2)
    ]
    lines[1] = [(offset, -sign) for offset, sign in lines[1]]  # northbound traffic keeps to the east
    missing = rng.randrange(8)
    inner = []
    for axis in (0, 1):
        for offset, sign in lines[axis]:
            crossing = sorted(other for other, _ in lines[1 - axis])
            stations = [-ARM_M, *crossing, ARM_M]
            if len(lines[axis]) == 1 and missing == axis:
                stations = stations[1:]
            points = [(station, offset) if axis == 0 else (offset, station) for station in stations]
            for start, end in itertools.pairwise(points):
                tags = {"lanes": str(rng.choice([1, 2, 3] if sign else [2, 4]))}
                if sign:
                    tags["oneway"] = "yes"
                way = draft.way(*((end, start) if sign < 0 else (start, end)), **tags)
                if math.hypot(*start) < ARM_M and math.hypot(*end) < ARM_M:
                    inner.append(way)
    for _ in range(rng.randrange(5)):
        paths = [path for path in all_paths(draft, inner) if len(path.ways) > 1]
        path = rng.choice(paths)
        first = rng.randrange(len(path.ways) - 1)
        last = rng.randrange(first + 1, min(first + 3, len(path.ways)))
        kind = rng.choice(["no_left_turn", "no_right_turn", "no_straight_on", "only_straight_on", "only_right_turn"])
        via = [Member("way", way, "via") for way in path.ways[first + 1 : last]]
        via = via or [Member("node", path.nodes[first], "via")]
        draft.restrict(kind, path.ways[first], via, path.ways[last])
    return draft, inner


@dataclass(frozen=True)
class WayPath:
    """Ways through a junction, and the nodes between them."""

    ways: tuple[int, ...]
    nodes: tuple[int, ...]
    starts_forward: bool
    ends_forward: bool


def all_paths(draft: MapDraft, inner: Sequence[int]) -> Iterator[WayPath]:
    """Yield all paths over the inner ways from street to street that use no way twice."""

    def follow(path: tuple[int, ...], nodes: tuple[int, ...], node: int, forward: bool) -> Iterator[WayPath]:
        for number, way in draft.ways.items():
            if number in path or node not in (way.nodes[0], way.nodes[-1]):
                continue
            along = way.nodes[0] == node
            if not along and way.tags.get("oneway") == "yes":
                continue
            longer = (*path, number), (*nodes, node)
            if number in inner:
                yield from follow(*longer, way.nodes[-1] if along else way.nodes[0], forward)
            else:
                yield WayPath(*longer, forward, along)

    for number, way in draft.ways.items():
        if number in inner:
            continue
        for forward in (True,) if way.tags.get("oneway") == "yes" else (True, False):
            yield from follow((number,), (), way.nodes[-1] if forward else way.nodes[0], forward)


def is_forbidden(path: WayPath, relation: Relation, draft: MapDraft) -> bool:
    """Whether a restriction forbids a path."""
    (source,), via, (target,) = relation.ways("from"), tuple(relation.ways("via")), relation.ways("to")
    nodes = [member.id for member in relation.members if member.type == "node"]
    only = relation.tags["restriction"].startswith("only_")
    for position in range(len(path.ways) - 1 - len(via)):
        if path.ways[position : position + 1 + len(via)] != (source, *via):
            continue
        at = path.nodes[position + len(via)]
        is_at_turn = at in nodes if nodes else at in draft.ways[target].nodes
        if is_at_turn and (path.ways[position + 1 + len(via)] == target) != only:
            return True
    return False


def is_permitted(path: WayPath, draft: MapDraft) -> bool:
    """Whether no restriction forbids a path; several ``only_`` at one turn permit one turn each."""
    forbidding = [relation for relation in draft.relations if is_forbidden(path, relation, draft)]
    only = [relation for relation in forbidding if relation.tags["restriction"].startswith("only_")]
    if len(forbidding) > len(only):
        return False
    return all(
        any(
            other.tags["restriction"].startswith("only_")
            and [m for m in other.members if m.role != "to"] == [m for m in relation.members if m.role != "to"]
            and not is_forbidden(path, other, draft)
            for other in draft.relations
            if other is not relation
        )
        and not relation.ways("via")
        for relation in only
    )


def heading_deg(draft: MapDraft, way: int, forward: bool) -> float:
    """Direction of a straight way."""
    points = {number: point for point, number in draft.nodes.items()}
    (x0, y0), (x1, y1) = (points[node] for node in (draft.ways[way].nodes[0], draft.ways[way].nodes[-1]))
    return math.degrees(math.atan2(y1 - y0, x1 - x0)) + (0.0 if forward else 180.0)


def check_random_map(seed: int) -> int:
    """Check a map; return how many turns were repaired."""
    draft, inner = random_map(seed)
    made = build(draft.extract())
    roads = {edge.id for edge in made.streets.network.edges}
    permitted: set[tuple[str, str]] = set()
    required: set[tuple[str, str]] = set()
    for path in all_paths(draft, inner):
        source = f"{'' if path.starts_forward else '-'}{path.ways[0]}"
        target = f"{'' if path.ends_forward else '-'}{path.ways[-1]}"
        if not is_permitted(path, draft):
            continue
        permitted.add((source, target))
        turned = heading_deg(draft, path.ways[-1], path.ends_forward) - heading_deg(
            draft, path.ways[0], path.starts_forward
        )
        if abs((turned + 180.0) % 360.0 - 180.0) < 150.0 and len(path.ways) <= 4:
            required.add((source, target))
    turns = edge_turns(made)
    names = " ".join(made.notes)
    assert turns <= permitted, f"open: {turns - permitted}, {made.notes}"
    for source, target in required - turns:
        if {source, target} <= roads:
            title = f"Street {abs(int(source))} to Street {abs(int(target))}"
            assert title in names, f"lost: {source} to {target}, {made.notes}"
    return sum("closed" in note or "added" in note for note in made.notes)


@pytest.mark.slow
def test_random_junctions_have_the_turns_of_the_map() -> None:
    assert sum(check_random_map(seed) for seed in range(6))


@pytest.mark.slow
def test_many_random_junctions_have_the_turns_of_the_map() -> None:
    assert sum(check_random_map(seed) for seed in range(6, 120)) > 20


KIND = '<tag k="type" v="restriction"/>'


def test_restrictions_are_read_as_the_map_states_them(tmp_path: Path) -> None:
    """A file with a restriction in each of the forms of the wiki."""
    path = tmp_path / "map.osm"
    members = '<member type="way" ref="1" role="from"/><member type="node" ref="2" role="via"/>'
    forms = [
        '<tag k="restriction" v="no_left_turn"/>',
        '<tag k="restriction" v="only_straight_on"/><tag k="except" v="motor_vehicle"/>',
        '<tag k="restriction:motorcar" v="no_left_turn"/>',
        '<tag k="restriction:hgv" v="no_left_turn"/>',
        '<tag k="restriction" v="no_left_turn"/><tag k="hour_on" v="07:00"/><tag k="hour_off" v="09:00"/>',
        '<tag k="restriction:conditional" v="no_left_turn @ (Sa)"/>',
        '<tag k="restriction" v="loading_only"/>',
        '<tag k="type" v="restriction:motorcar"/><tag k="restriction" v="no_left_turn"/>',
        '<tag k="type" v="restriction:bus"/><tag k="restriction" v="no_left_turn"/>',
    ]
    relations = "".join(
        f'<relation id="{number}">{members}<member type="way" ref="2" role="to"/>'
        f"{form if 'type' in form else KIND + form}</relation>"
        for number, form in enumerate(forms, 1)
    )
    nodes = "".join(f'<node id="{number}" lat="52" lon="{10 + number / 1000}"/>' for number in (1, 2, 3))
    ways = '<way id="1"><nd ref="1"/><nd ref="2"/></way><way id="2"><nd ref="2"/><nd ref="3"/></way>'
    path.write_text(f'<osm version="0.6">{nodes}{ways}{relations}</osm>')
    found = read_restrictions(osm.read_osm(path))
    assert [restriction.id for restriction in found.in_force] == [1, 3, 8]
    assert (found.by_vehicle, found.conditional, found.with_exceptions) == ((2, 4, 9), (5, 6), ())
