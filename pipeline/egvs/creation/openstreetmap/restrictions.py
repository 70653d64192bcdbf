"""Turn restrictions of OpenStreetMap, and which way may follow another.

A restriction (https://wiki.openstreetmap.org/wiki/Relation:restriction) forbids a turn (``no_...``), or all other turns
(``only_...``), from one way to another over a node, or over further ways. Those that hold for cars at all times are
kept (:attr:`Restrictions.in_force`); for the others, a network is the same at all times and for all vehicles, so they
are only named.

A :class:`Step` is the piece of a way between two of its nodes, in one direction.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from egvs.formats.osm import Member, OsmExtract, Relation, Tags, Way

_CARS = frozenset({"motorcar", "motor_vehicle", "vehicle"})
_ON_ROADS = frozenset({*_CARS, "psv", "bus", "taxi", "hgv", "goods", "motorcycle", "coach", "tourist_bus"})
"""Keys of vehicles of a network; other keys, such as ``bicycle``, are ignored."""

_OLD_TIMES = ("day_on", "day_off", "hour_on", "hour_off", "date_on", "date_off")


class Step(NamedTuple):
    """The piece of a way between the node at a position (``start``) and the next one, or the one before."""

    way: int
    start: int
    forward: bool

    @property
    def end(self) -> int:
        """Position of the node where it ends."""
        return self.start + (1 if self.forward else -1)

    @property
    def reverse(self) -> Step:
        """The same piece, the other way."""
        return Step(self.way, self.end, not self.forward)


@dataclass(frozen=True)
class Restriction:
    """A turn restriction.

    Attributes
    ----------
    id
        Of its relation.
    only
        Whether it permits its turn only, rather than forbidding it.
    sources, targets
        Ways before and after the turn.
    via_nodes, via_ways
        The node of the turn, or the ways over which it leads.
    """

    id: int
    only: bool
    sources: frozenset[int]
    targets: frozenset[int]
    via_nodes: frozenset[int]
    via_ways: tuple[int, ...] = ()


@dataclass(frozen=True)
class Restrictions:
    """The turn restrictions of a map.

    Attributes
    ----------
    in_force
        Those that hold for cars at all times.
    conditional
        Relations that hold at certain times.
    by_vehicle
        Relations that hold for certain vehicles, but not for cars.
    with_exceptions
        Relations in force for cars that except other motor vehicles.
    without_turn
        Relations whose streets are in the map, but do not meet at a node or way with the role ``via``.
    """

    in_force: tuple[Restriction, ...] = ()
    conditional: tuple[int, ...] = ()
    by_vehicle: tuple[int, ...] = ()
    with_exceptions: tuple[int, ...] = ()
    without_turn: tuple[int, ...] = ()


def is_restriction(relation: Relation) -> bool:
    """Return whether a relation is a turn restriction; in an old form, the type names the vehicle."""
    return (relation.tags.get("type") or "").partition(":")[0] == "restriction"


def read_restrictions(extract: OsmExtract) -> Restrictions:
    """Return the turn restrictions of an extract; those whose members are not in it are left out."""
    in_force: list[Restriction] = []
    conditional, by_vehicle, with_exceptions, without_turn = [], [], [], []
    for relation in map(_in_present_form, filter(is_restriction, extract.relations)):
        if not (relation.ways("from") and relation.ways("to")):
            without_turn.append(relation.id)
            continue
        restriction = _parse(relation, extract)
        if restriction is None:
            continue
        if not _has_turn(restriction, extract):
            without_turn.append(relation.id)
            continue
        kind = _kind_for_cars(relation.tags)
        if kind and not any(key in relation.tags for key in _OLD_TIMES):
            in_force.append(replace(restriction, only=kind.startswith("only_")))
            if _excepted(relation.tags) & _ON_ROADS:
                with_exceptions.append(relation.id)
        elif kind or any(_is_kind(relation.tags[key]) for key in relation.tags if key.endswith(":conditional")):
            conditional.append(relation.id)
        elif _kinds(relation.tags):
            by_vehicle.append(relation.id)
    others = map(tuple, (conditional, by_vehicle, with_exceptions, without_turn))
    return Restrictions(tuple(in_force), *others)


def _in_present_form(relation: Relation) -> Relation:
    """Return a restriction with the vehicle in the key ``restriction:motorcar`` instead of the type."""
    _, _, vehicle = relation.tags["type"].partition(":")
    if not vehicle:
        return relation
    renamed = {f"{key}:{vehicle}" if key == "restriction" else key: value for key, value in relation.tags.items()}
    return replace(relation, tags=renamed)


def _parse(relation: Relation, extract: OsmExtract) -> Restriction | None:
    sources = frozenset(way for way in relation.ways("from") if way in extract.ways)
    targets = frozenset(way for way in relation.ways("to") if way in extract.ways)
    nodes = frozenset(member.id for member in relation.members if member.type == "node" and member.role == "via")
    via_ways = tuple(relation.ways("via"))
    if not (sources and targets and all(way in extract.ways for way in via_ways)):
        return None
    via_ways = _in_order(via_ways, sources, extract)
    return Restriction(relation.id, False, sources, targets, frozenset() if via_ways else nodes, via_ways)


def _has_turn(restriction: Restriction, extract: OsmExtract) -> bool:
    """Return whether the streets of a restriction meet where it says; a node outside the map counts as a meeting."""
    ends = [
        {node for way in ways for node in extract.ways[way].nodes}
        for ways in (restriction.sources, restriction.targets)
    ]
    if restriction.via_ways:
        first, last = (extract.ways[restriction.via_ways[index]].nodes for index in (0, -1))
        return bool(ends[0] & {*first} and ends[1] & {*last})
    outside = restriction.via_nodes - extract.nodes.keys()
    return bool(outside or restriction.via_nodes & ends[0] & ends[1])


def _in_order(via_ways: Sequence[int], sources: Collection[int], extract: OsmExtract) -> tuple[int, ...]:
    """Return ways in the order in which they are driven on: each shares a node with the one before."""
    rest = list(via_ways)
    nodes = {node for way in sources for node in extract.ways[way].nodes}
    ordered: list[int] = []
    while rest:
        following = next((way for way in rest if nodes & {*extract.ways[way].nodes}), rest[0])
        rest.remove(following)
        ordered.append(following)
        nodes = {*extract.ways[following].nodes}
    return tuple(ordered)


def _kind_for_cars(tags: Tags) -> str:
    """Return the restriction of cars, such as ``no_left_turn``; empty if there is none."""
    for key in ("restriction", *(f"restriction:{vehicle}" for vehicle in sorted(_CARS))):
        value = tags.get(key, "")
        if _is_kind(value) and not (key == "restriction" and _excepted(tags) & _CARS):
            return value
    return ""


def _kinds(tags: Tags) -> list[str]:
    """Return the restrictions of any motor vehicles."""
    keys = ("restriction", *(f"restriction:{vehicle}" for vehicle in sorted(_ON_ROADS)))
    return [tags[key] for key in keys if _is_kind(tags.get(key, ""))]


def _excepted(tags: Tags) -> set[str]:
    return {vehicle.strip() for vehicle in tags.get("except", "").split(";")}


def _is_kind(value: str) -> bool:
    """Return whether a value forbids turns; ``no_right_turn_on_red`` forbids them at red only."""
    return value.startswith(("no_", "only_")) and not value.endswith("_on_red")


def restrictions_of_pieces(
    relations: Iterable[Relation], cut: Mapping[int, Collection[Way]], ways: Mapping[int, Way]
) -> tuple[Relation, ...]:
    """Let turn restrictions refer to the pieces of ways that were cut: to those that touch the turn.

    Parameters
    ----------
    relations
        All relations of the map.
    cut
        The pieces of each way that was cut, by the identifier that it had.
    ways
        The ways before they were cut.
    """
    return tuple(_of_pieces(relation, cut, ways) if is_restriction(relation) else relation for relation in relations)


def _of_pieces(relation: Relation, cut: Mapping[int, Collection[Way]], ways: Mapping[int, Way]) -> Relation:
    if not any(member.type == "way" and len(cut.get(member.id, ())) > 1 for member in relation.members):
        return relation
    nodes = {member.id for member in relation.members if member.type == "node" and member.role == "via"}
    for way in relation.ways("via"):
        nodes |= {*ways[way].nodes} if way in ways else set()
    members = []
    for member in relation.members:
        pieces = cut.get(member.id, ()) if member.type == "way" else ()
        touching = [piece.id for piece in pieces if nodes & {*piece.nodes}]
        if len(pieces) < 2 or not touching:
            members.append(member)
        elif member.role == "via":
            members += [Member("way", piece, "via") for piece in touching]
        else:
            members.append(Member("way", touching[0], member.role))
    return Relation(relation.id, tuple(members), relation.tags)


@dataclass(frozen=True)
class Progress:
    """How far a path has come on the ways of restrictions that lead over ways: (restriction, number of the way)."""

    entries: frozenset[tuple[Restriction, int]] = frozenset()


@dataclass(frozen=True)
class TurnRules:
    """Tells whether a step may follow another.

    Attributes
    ----------
    restrictions
        Those in force.
    ways
        The ways of the map.
    """

    restrictions: Sequence[Restriction]
    ways: Mapping[int, Way]
    _by_source: dict[int, list[Restriction]] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        for restriction in self.restrictions:
            for source in restriction.sources:
                self._by_source.setdefault(source, []).append(restriction)

    def follow(self, before: Step, after: Step, node: int, progress: Progress) -> tuple[Progress, set[int]]:
        """Return the progress after a turn at a node, and the relations that forbid it; empty if it is permitted."""
        starting = self._by_source.get(before.way, ())
        forbidding = set(_forbidding_at(node, before, after, starting))
        entries = {
            (restriction, 0)
            for restriction in starting
            if restriction.via_ways and restriction.via_ways[0] == after.way != before.way
        }
        for restriction, position in progress.entries:
            ways = restriction.via_ways
            is_last = position == len(ways) - 1
            if after.way == ways[position] and after != before.reverse:
                entries.add((restriction, position))
            elif not is_last and after.way == ways[position + 1]:
                entries.add((restriction, position + 1))
            elif is_last and self._is_forbidden(restriction, after, node):
                forbidding.add(restriction.id)
        return Progress(frozenset(entries)), forbidding

    def _is_forbidden(self, restriction: Restriction, after: Step, node: int) -> bool:
        """Return whether a restriction forbids to leave the last of its ways by a step."""
        if after.way in restriction.targets:
            return not restriction.only
        return restriction.only and any(node in self.ways[way].nodes for way in restriction.targets)


def _forbidding_at(node: int, before: Step, after: Step, starting: Iterable[Restriction]) -> Iterator[int]:
    """Yield the restrictions over a node that forbid a turn."""
    at_node = [restriction for restriction in starting if node in restriction.via_nodes]
    only = [restriction for restriction in at_node if restriction.only]
    if only and not any(after.way in restriction.targets for restriction in only):
        yield from (restriction.id for restriction in only)
    is_along = after.way == before.way and after != before.reverse
    for restriction in at_node:
        if not restriction.only and after.way in restriction.targets and not is_along:
            yield restriction.id
