"""Find the approaches of a junction by the names that planners use: street, and side on which vehicles arrive.

The vehicles of the approach on the north side come *from* the north and head south (southbound, "SB"); its name is
"North Street (north)", see :mod:`egvs.traffic.approach_names`.

:class:`ApproachIndex` finds the movements that a planner's words mean. Names of streets are compared without case
and punctuation, and with common abbreviations written out (St, Rd, Ave, Str., Straße).
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.scenario.traffic_config import CountConfig
from egvs.traffic.approach_names import approach_name
from egvs.traffic.directions import CLOCKWISE, COMPASS, U_TURN, arrival_side
from egvs.traffic.movements import MovementNames
from egvs.traffic.network import Edge

TURN_WORDS = {
    "left": "left", "l": "left", "links": "left", "linksabbieger": "left",
    "straight": "straight", "straight on": "straight", "through": "straight", "thru": "straight", "t": "straight",
    "s": "straight", "geradeaus": "straight", "g": "straight",
    "right": "right", "r": "right", "rechts": "right", "rechtsabbieger": "right",
    "u-turn": U_TURN, "uturn": U_TURN, "u turn": U_TURN, "u": U_TURN, "back": U_TURN, "wenden": U_TURN,
}  # fmt: skip
"""What planners write for the turns of :data:`egvs.traffic.directions.TURNS`."""

_SIDES = {
    "east": "e o ost osten", "north-east": "ne no nordost", "north": "n nord norden", "north-west": "nw nordwest",
    "west": "w westen", "south-west": "sw suedwest", "south": "s sued sueden", "south-east": "se so suedost",
}  # fmt: skip
"""What people write for each of :data:`~egvs.traffic.directions.COMPASS` beside its name, in English and German."""

_SIDE_WORDS = {word: side for side in COMPASS for word in (side, side.replace("-", ""), *_SIDES[side].split())}
_BOUND = {f"{words.split()[0]}b": side for side, words in _SIDES.items()}
"""Abbreviations of headings: "nb" for northbound."""

_ABBREVIATIONS = {
    "st": "street", "str": "street", "strasse": "street", "rd": "road", "ave": "avenue", "av": "avenue",
    "blvd": "boulevard", "dr": "drive", "ln": "lane", "hwy": "highway", "pl": "place", "platz": "place",
    "sq": "square", "ct": "court", "pkwy": "parkway",
}  # fmt: skip

_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue"})
_LANE_GROUP = re.compile(r"(NB|NEB|EB|SEB|SB|SWB|WB|NWB)([LTRU]{1,4})")


def normalise_street(name: str) -> str:
    """Return a name in the form in which names of streets are compared.

    >>> normalise_street("Main St.") == normalise_street("MAIN STREET")
    True
    >>> normalise_street("Süd-Straße") == normalise_street("Suedstr.")
    True
    """
    text = unicodedata.normalize("NFKC", name).casefold().translate(_UMLAUTS)
    words = re.sub(r"[^\w]+", " ", text).split()
    words = [re.sub(r"(?<=\w)(strasse|str)$", " street", word) for word in words]
    words = [_ABBREVIATIONS.get(word, word) for word in " ".join(words).split()]
    return "".join(words)


def parse_side(text: str) -> str | None:
    """Return the side on which vehicles arrive, a value of ``COMPASS``; None if the text is no direction.

    >>> parse_side("N"), parse_side("from north"), parse_side("northbound"), parse_side("NB"), parse_side("Ost")
    ('north', 'north', 'south', 'south', 'east')
    """
    words = " ".join(unicodedata.normalize("NFKC", text).casefold().translate(_UMLAUTS).split())
    word = re.sub(r"^(from (the )?|von |aus )", "", words)
    if word in _SIDE_WORDS:
        return _SIDE_WORDS[word]
    heading = _BOUND.get(word) or _SIDE_WORDS.get(word.removesuffix("bound").rstrip("- "))
    if heading is None:
        return None
    return COMPASS[(COMPASS.index(heading) + 4) % 8]


def parse_lane_group(text: str) -> tuple[str, tuple[str, ...]] | None:
    """Return side and turns of a lane group as signal engineers write it; None for other words.

    >>> parse_lane_group("NBL"), parse_lane_group("EBTR")
    (('south', ('left',)), ('west', ('straight', 'right')))
    """
    match = _LANE_GROUP.fullmatch(text.strip().upper())
    if match is None:
        return None
    side = parse_side(match[1])
    assert side is not None
    return side, tuple(dict.fromkeys(TURN_WORDS[letter.casefold()] for letter in match[2]))


def approach_spellings(side: str, street: str) -> frozenset[str]:
    """Return what a user may write for an approach, in the form of :func:`normalise_street`.

    >>> normalise_street("North St. (north)") in approach_spellings("north", "North Street")
    True
    >>> former = normalise_street("N (Mill Ln)"), normalise_street("north Mill Lane")
    >>> approach_spellings("north", "Mill Lane").issuperset(former)
    True
    """
    name = normalise_street(street)
    words = [word.replace("-", "") for word, meant in _SIDE_WORDS.items() if meant == side]
    return frozenset(spelling for word in words for spelling in (name + word, word + name))


def names_approach(name: str, side: str, street: str) -> bool:
    """Return whether a name in the form of :func:`normalise_street` is that of a street, or of the approach there.

    >>> names_approach(normalise_street("Möser Str. (Nord)"), "north", "Möserstraße")
    True
    """
    return bool(street) and (
        name == normalise_street(street) or (bool(side) and name in approach_spellings(side, street))
    )


def list_approaches(turns: Mapping[str, Iterable[str]]) -> str:
    """Return the names of approaches, each with its turns.

    >>> list_approaches({"North Street (north)": ["left", "right"], "east": []})
    'North Street (north) (left, right); east'
    """
    texts = {name: ", ".join(filter(None, words)) for name, words in turns.items()}
    return "; ".join(f"{name} ({text})" if text else name for name, text in texts.items())


def follow_bend(turns: Iterable[str], ways: Set[tuple[str, str]], street: str) -> tuple[str, ...]:
    """Return turns of an approach; without a way straight on, "straight" is the only turn that stays on the street.

    Parameters
    ----------
    turns
        Values of :data:`~egvs.traffic.directions.TURNS`.
    ways
        Turn and street of each way out of the junction.
    street
        Street of the approach.

    >>> follow_bend(["straight"], {("left", "Ring Road"), ("right", "Mill Lane")}, "Ring Road")
    ('left',)
    """
    bends = {turn for turn, way_out in ways if street and way_out == street} - {U_TURN}
    (bend,) = bends if len(bends) == 1 and "straight" not in dict(ways) else {"straight"}
    return tuple(bend if turn == "straight" else turn for turn in turns)


@dataclass(frozen=True)
class ApproachMovement:
    """A movement of a junction.

    Attributes
    ----------
    flow
        The edges, and the assumed vehicles per hour.
    side, street, turn
        Side on which the vehicles arrive, street there (may be empty), and turn.
    edges, heading
        The edges to the junction, and the direction (2,) of arrival.
    aliases
        Other streets that lead to the approach.
    way_out
        Street on which the vehicles leave; may be empty.
    """

    flow: CountConfig
    side: str
    street: str
    turn: str
    edges: tuple[Edge, ...]
    heading: FloatArray
    aliases: tuple[str, ...] = ()
    way_out: str = ""

    @property
    def approach_title(self) -> str:
        """E.g. ``"Main Street (north)"``."""
        return approach_name(self.side, self.street)

    def is_called(self, name: str) -> bool:
        """Whether a name in the form of :func:`normalise_street` is its street, or its approach."""
        return names_approach(name, self.side, self.street)

    def has_alias(self, name: str) -> bool:
        """Whether a name is that of another street that leads to the approach."""
        return any(names_approach(name, self.side, street) for street in self.aliases)


@dataclass(frozen=True)
class ApproachIndex:
    """The movements of a junction, found by the names of planners."""

    movements: tuple[ApproachMovement, ...]

    @classmethod
    def of_flows(cls, flows: Iterable[CountConfig], names: MovementNames) -> ApproachIndex:
        """Name the movements of flows from one edge to another.

        Parameters
        ----------
        flows
            Counts; those on a single edge are approaches without a turn.
        names
            Of the network.
        """
        movements = []
        for flow in flows:
            movement = names.movement(flow.edge or flow.from_edge or "", flow.to_edge)
            side = arrival_side(movement.heading)
            edges, street, heading, turn, aliases, way_out = movement
            movements.append(ApproachMovement(flow, side, street, turn, edges, heading, aliases, way_out))
        return cls(tuple(movements))

    def parse_approach(self, text: str, where: str) -> tuple[str, str]:
        """Return street (empty if the text has none) and side of an approach that a planner means.

        Raises
        ------
        InputError
            When the text is neither a direction nor the name of an approach.
        """
        side = parse_side(text)
        if side is not None:
            return "", side
        name = normalise_street(text)
        for alias in (False, True):
            for move in self.movements:
                for street in move.aliases if alias else (move.street,):
                    if name in approach_spellings(move.side, street):
                        return move.street, move.side
        problem = f"expected the side on which vehicles arrive, or the name of an approach, got {text!r}"
        hint = f"Use N, north or southbound; none arrive on a one-way street that leads away. {self.hint}"
        raise InputError(f"{where}: approach", problem, hint)

    def find(self, street: str, side: str | None, turns: Sequence[str], where: str) -> list[ApproachMovement]:
        """Return the movements that a planner means.

        Parameters
        ----------
        street
            Name of the street of the approach; any if empty.
        side
            Side on which the vehicles arrive; any if None. Without an approach on exactly this side, one on a
            neighbouring side is taken.
        turns
            Turns; any if empty. Without a way straight on, "straight" is the turn that stays on the street.
        where
            File and line, for messages.

        Raises
        ------
        InputError
            When no approach, several different approaches, or no movement has these names.
        """
        name = normalise_street(street)
        called = [move for move in self.movements if not name or move.is_called(name)]
        otherwise = [move for move in self.movements if move.has_alias(name)]
        if not called and not otherwise:
            raise InputError(where, f"no approach of the junction is called {street!r}", self.hint)
        candidates = _on_side(called, side) or _on_side(otherwise, side)
        words = " ".join(word for word in (street, f"from the {side}" if side else "") if word)
        approaches = dict.fromkeys(move.approach_title for move in candidates)
        if not approaches:
            raise InputError(where, f"no approach of the junction is {words!r}", self.hint)
        if len(approaches) > 1:
            problem = f"{words!r} may be {' or '.join(approaches)}"
            raise InputError(where, problem, f"Give street and approach. {self.hint}")
        turns = follow_bend(turns, {(move.turn, move.way_out) for move in candidates}, candidates[0].street)
        moves = [move for move in candidates if not turns or move.turn in turns]
        missing = sorted(set(turns) - {move.turn for move in moves})
        if missing:
            problem = f"the approach {next(iter(approaches))} has no movement {' or '.join(missing)}"
            raise InputError(where, problem, f"Correct the row, or lanes and one-way streets of the map. {self.hint}")
        return moves

    @property
    def hint(self) -> str:
        """The approaches of the junction with their turns, as a sentence."""
        turns = {title: {m.turn for m in self.movements if m.approach_title == title} for title in self.titles}
        return f"The approaches are: {list_approaches({title: sorted(words) for title, words in turns.items()})}."

    @property
    def titles(self) -> list[str]:
        """The approaches, in the order of the compass."""
        sides = sorted(self.movements, key=lambda move: (CLOCKWISE.index(COMPASS.index(move.side)), move.street))
        return list(dict.fromkeys(move.approach_title for move in sides))


def _on_side(movements: Sequence[ApproachMovement], side: str | None) -> list[ApproachMovement]:
    """Return the movements that arrive on a side, or else on a neighbouring one; all if the side is None."""
    near = [move for move in movements if side is None or side_distance(move.side, side) <= 1]
    return [move for move in near if move.side == side] or near


def side_distance(first: str, second: str) -> int:
    """Return the number of compass points between two sides, 0 to 4."""
    apart = abs(COMPASS.index(first) - COMPASS.index(second))
    return min(apart, 8 - apart)
