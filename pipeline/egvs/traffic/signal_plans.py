"""Plans of traffic signals from a scenario: check them, and write them into a network.

Steps of :func:`apply_plans`: find the signal and the links of each movement; check the plan; write its phases, each
followed by yellow and all-red for the links that lose their green.

In a phase, a link has green with right of way ("G"), or gives way to another green ("g"), as the network's right of way
says. Two links that conflict may be green together only if one of them turns and gives way to oncoming traffic, or to
people on a crossing.

World frame, metres, seconds.
"""

from __future__ import annotations

import gzip
import re
from collections.abc import Iterator, Sequence, Set
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from egvs.core import files
from egvs.core.digests import forget_file
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.numbers import number_or_nan
from egvs.core.table_columns import parse_header
from egvs.core.wording import list_first, number_of, shorten_id
from egvs.formats import spreadsheets, xml
from egvs.scenario.model import Scenario
from egvs.scenario.signal_config import SignalConfig, SignalPhaseConfig
from egvs.traffic import network
from egvs.traffic.approaches import (
    TURN_WORDS,
    follow_bend,
    list_approaches,
    names_approach,
    normalise_street,
    parse_side,
    side_distance,
)
from egvs.traffic.signals import CROSSING, Link, Phase, Program, Signal, read_signals, replace_programs

_ALL = "all"
_MOVEMENT_WORDS = {**TURN_WORDS, "crossing": CROSSING, "furt": CROSSING, "alle": _ALL}

_OPPOSITE_COSINE = -0.5
"""Approaches whose directions differ by more than 120 degrees are opposite."""

_GZIP = b"\x1f\x8b"
_MAX_NAMED = 20

CSV_COLUMNS = ("phase", "approach", "movement", "green_s")
CSV_OPTIONAL = ("yellow_s", "all_red_s", "min_green_s", "max_green_s")
_CSV_HINT = f"Columns: {', '.join(CSV_COLUMNS)}; optional: {', '.join(CSV_OPTIONAL)}."


def planned_signals(scenario: Scenario, path: Path, roads: network.Network) -> list[Signal]:
    """Return the signals of a network with the plans of the scenario; parameters and errors of :func:`apply_plans`."""
    programs = _programs(scenario, path, roads)
    signals = read_signals(path, roads)
    return [replace(signal, program=programs.get(signal.id, signal.program)) for signal in signals]


def apply_plans(scenario: Scenario, path: Path, source: Path) -> None:
    """Replace the programs in a network by the plans of the scenario.

    Parameters
    ----------
    scenario
        The plans, ``[traffic.signals]``.
    path
        A copy of its network, which is changed.
    source
        The network, for messages.

    Raises
    ------
    InputError
        When a signal, an approach or a movement is unknown, movements of a phase conflict, one never has green, or the
        phases do not fill the cycle.
    """
    if not scenario.traffic.signals:
        return
    programs = _programs(scenario, path, network.read_net_xml(path, source))
    with files.attach_filename(path):
        content = path.read_bytes()
        if content.startswith(_GZIP):
            content = gzip.decompress(content)
        try:
            text = replace_programs(content.decode("utf-8"), programs)
        except ValueError as error:
            raise InputError(
                source, f"signal programs cannot be replaced: {error}", "Convert it with netconvert."
            ) from None
        forget_file(path)
        files.write_text(path, text)


def signal_files(scenario: Scenario) -> list[Path]:
    """Return the files of the plans of a scenario; InputError where one is missing."""
    paths = []
    for name, config in scenario.traffic.signals.items():
        if config.file is not None:
            paths.append(scenario.find(config.file, f"traffic.signals.{name}.file"))
    return paths


def _programs(scenario: Scenario, path: Path, roads: network.Network) -> dict[str, Program]:
    signals = read_signals(path, roads)
    programs: dict[str, Program] = {}
    for name, config in scenario.traffic.signals.items():
        where = scenario.locate(f"traffic.signals.{name}")
        signal = find_signal(name, signals, where)
        if signal.id in programs:
            raise InputError(where, f"the signal {signal.title} has two plans", "Remove one of them.")
        programs[signal.id] = _plan_program(config, signal, scenario, where)
    return programs


def find_signal(name: str, signals: Sequence[Signal], where: str) -> Signal:
    """Return the signal of a name: its id, the id of a junction, or street names with "/" or "&" between them.

    An id may be shortened as in messages, if it is still that of one signal.
    """
    for signal in signals:
        if name == signal.id or name in signal.nodes:
            return signal
    called = [signal for signal in signals if signal.is_called(name)]
    if len(called) == 1:
        return called[0]
    streets = {normalise_street(street) for street in re.split("[/&]", name)}
    matches = called
    matches = matches or [s for s in signals if streets <= {normalise_street(street) for street in s.streets}]
    if len(matches) == 1:
        return matches[0]
    known = _list_signals(matches or signals)
    if matches:
        raise InputError(where, f"{len(matches)} signals have this name: {known}", "Use an id.")
    raise InputError(where, "the network has no such signal", f"Its signals are: {known}.")


def _list_signals(signals: Sequence[Signal]) -> str:
    """Return streets and ids of signals; an id is complete where its short form is not that of a single signal."""
    short = [signal.title for signal in signals]
    titles = [signal.titled(signal.id) if short.count(signal.title) > 1 else signal.title for signal in signals]
    return list_first(titles, _MAX_NAMED) or "none"


def _plan_program(config: SignalConfig, signal: Signal, scenario: Scenario, where: str) -> Program:
    if config.file is not None:
        path = scenario.find(config.file, f"{where.partition(': ')[2]}.file")
        if config.is_sumo_file:
            return _read_program(path, config, signal)
        config = config.model_copy(update={"phases": _read_table(path, config), "file": None})
        where = str(path)
    return make_program(config, signal, where)


def make_program(config: SignalConfig, signal: Signal, where: str) -> Program:
    """Return the program of a plan with phases.

    Parameters
    ----------
    config
        The plan.
    signal
        Its signal.
    where
        File and key of the plan, for messages.

    Raises
    ------
    InputError
        When an approach or a movement is unknown, movements of a phase conflict, one never has green, or the phases do
        not fill the cycle.
    """
    stated: set[str] = set()
    red: set[str] = set()
    for number, phase in enumerate(config.phases, start=1):
        for text, movements in phase.green.items():
            approach = _links_of_approach(text, signal, f"{where}: phase {number}")[0].approach
            stated.add(approach)
            if not movements:
                red.add(approach)
    greens = [
        _green_links(phase, signal, f"{where}: phase {n}", stated) for n, phase in enumerate(config.phases, start=1)
    ]
    for number, green in enumerate(greens, start=1):
        _check_conflicts(green, signal, f"{where}: phase {number}")
    may_be_red = {link.index for link in signal.links if link.approach in red}
    _check_never_green(may_be_red.union(*greens), signal, where)
    phases = tuple(_phases(config, greens, signal))
    program = Program("static" if config.type == "fixed" else "actuated", config.offset_s, phases)
    if config.cycle_s is not None and abs(program.cycle_s - config.cycle_s) > 1e-6:
        parts = ", ".join(f"{phase.duration_s:g}" for phase in phases)
        problem = f"the phases with yellow and all-red add up to {program.cycle_s:g} s ({parts})"
        raise InputError(f"{where}: cycle_s = {config.cycle_s:g}", problem, f"Use cycle_s = {program.cycle_s:g}.")
    return program


def _green_links(phase: SignalPhaseConfig, signal: Signal, where: str, stated: Set[str] = frozenset()) -> set[int]:
    """Return the positions of the links with green in a phase.

    A street between two nodes of the signal has green with the movements that lead to it, if it is no approach that the
    plan states and no green conflicts with it. A crossing that no phase names has green where no green conflicts with
    it, except turns that give way to people.
    """
    green: set[int] = set()
    for approach, movements in phase.green.items():
        on_approach = _links_of_approach(approach, signal, where)
        ways = {(link.movement, link.way_out) for link in on_approach}
        for movement in movements:
            requested = " ".join(movement.split()).casefold()
            requested = _MOVEMENT_WORDS.get(requested, requested)
            (requested,) = follow_bend([requested], ways, max(link.street for link in on_approach))
            selected = [link for link in on_approach if requested in (_ALL, link.movement)]
            if requested == _ALL:
                selected = [link for link in selected if link.movement != CROSSING]
            if not selected:  # vehicles drive straight on first, and turn behind a street inside the junction
                turning = {link.edge for link in signal.links if link.movement == requested}
                selected = [link for link in on_approach if link.target in turning]
            if not selected:
                problem = f"approach {approach!r} has no movement {movement!r}"
                raise InputError(where, problem, f"Its approaches are: {list_approaches(signal.approaches)}.")
            green |= {link.index for link in selected}
    inside = [link for link in signal.links if link.edge and link.approach not in stated]
    for _ in signal.nodes:
        reached = {link.target for link in signal.links if link.index in green}
        for link in inside:
            is_free = all(agree(link, other) for other in signal.links if other.index in green)
            if link.edge in reached and is_free:
                green.add(link.index)
    vehicles = [link for link in signal.links if link.index in green and link.movement != CROSSING]
    for link in signal.links:
        if link.movement == CROSSING and all(_gives_way_to_people(each, link) for each in vehicles):
            green.add(link.index)
    return green


def _gives_way_to_people(link: Link, crossing: Link) -> bool:
    if crossing.index not in link.foes and link.index not in crossing.foes:
        return True
    return link.movement != "straight" and crossing.index in link.yields_to


def _links_of_approach(approach: str, signal: Signal, where: str) -> list[Link]:
    """Return the links of the approach of this name: the full name, else one of its parts, else that of an alias."""
    side = parse_side(approach)
    name = normalise_street(approach)

    def is_full_name(link: Link) -> bool:
        return name in (normalise_street(link.approach), normalise_street(link.edge))

    def is_part(link: Link) -> bool:
        return (side is not None and side == link.side) or names_approach(name, link.side, link.street)

    def is_alias(link: Link) -> bool:
        return any(names_approach(name, link.side, street) for street in link.aliases)

    def is_beside(link: Link) -> bool:
        return side is not None and link.side != "" and side_distance(side, link.side) == 1

    matches: list[str] = []
    for is_meant in (is_full_name, is_part, is_alias, is_beside):
        matches = matches or list(dict.fromkeys(link.approach for link in signal.links if is_meant(link)))
    if not matches:
        problem = f"the signal {signal.title} has no approach {approach!r}"
        raise InputError(where, problem, f"Its approaches are: {list_approaches(signal.approaches)}.")
    if len(matches) > 1:
        problem = f"approach {approach!r} may be {' or '.join(map(repr, matches))}"
        raise InputError(where, problem, "Use the full name.")
    return [link for link in signal.links if link.approach == matches[0]]


def _check_conflicts(green: set[int], signal: Signal, where: str) -> None:
    links = [link for link in signal.links if link.index in green]
    for a, b in combinations(links, 2):
        if not agree(a, b):
            problem = f"{a.title} and {b.title} conflict, but both have green"
            raise InputError(where, problem, "Use different phases: in the network, neither gives way to the other.")


def agree(a: Link, b: Link) -> bool:
    """Whether two links may have green together.

    They do not conflict, or one of them turns and gives way to people, or to oncoming traffic.
    """
    if a.index == b.index or (b.index not in a.foes and a.index not in b.foes):
        return True
    for turning, other in ((a, b), (b, a)):
        if turning.movement == CROSSING:
            continue
        if other.movement == CROSSING:
            if _gives_way_to_people(turning, other):
                return True
            continue
        assert turning.heading is not None and other.heading is not None
        gives_way = turning.movement != "straight" and other.index in turning.yields_to
        if gives_way and (turning.edge == other.edge or _cosine(turning.heading, other.heading) < _OPPOSITE_COSINE):
            return True
    return False


def _cosine(a: FloatArray, b: FloatArray) -> float:
    return float(a @ b / np.sqrt((a @ a) * (b @ b)))


def _check_never_green(green: set[int], signal: Signal, where: str) -> None:
    red = dict.fromkeys(link.title for link in signal.links if link.index not in green and link.movement != CROSSING)
    if red:
        hint = "Add these movements to a phase, or name their approach without movements if it stays red."
        raise InputError(where, f"never green: {', '.join(red)}", hint)


def _phases(config: SignalConfig, greens: Sequence[set[int]], signal: Signal) -> Iterator[Phase]:
    """Yield each phase, and the yellow and all-red after it for the links that lose their green."""
    is_actuated = config.type == "actuated"
    for number, (phase, green) in enumerate(zip(config.phases, greens, strict=True)):
        limits = (phase.shortest_green_s, phase.longest_green_s) if is_actuated else ()
        yield Phase(phase.green_s, state_of(green, signal), *limits)
        remaining = green & greens[(number + 1) % len(greens)]
        ending = {link.index for link in signal.links if link.index in green - remaining and link.movement != CROSSING}
        yellow_s = config.yellow_s if phase.yellow_s is None else phase.yellow_s
        all_red_s = config.all_red_s if phase.all_red_s is None else phase.all_red_s
        if yellow_s:
            yield Phase(yellow_s, state_of(remaining, signal, ending))
        if all_red_s:
            yield Phase(all_red_s, state_of(remaining, signal))


def state_of(green: Set[int], signal: Signal, yellow: Set[int] = frozenset()) -> str:
    """Return the state with green and yellow links; a green that gives way to green or yellow is "g".

    One position may govern several links; it gives way if one of them does.

    Parameters
    ----------
    green, yellow
        Positions of links.
    signal
        Their signal.
    """
    letters = ["r"] * signal.states
    may_drive = green | yellow
    giving_way = {link.index for link in signal.links if link.yields_to & may_drive}
    for link in signal.links:
        if link.index in green:
            letters[link.index] = "g" if link.index in giving_way else "G"
        elif link.index in yellow:
            letters[link.index] = "y"
    return "".join(letters)


def _read_program(path: Path, config: SignalConfig, signal: Signal) -> Program:
    """Read the program of a signal from a SUMO file: that of its id, or the only one."""
    programs = {}
    try:
        for element in xml.iter_elements(path, ""):
            if element.tag == "tlLogic":
                name = element.attrib["id"]
                if name in programs:
                    problem = f"signal {shorten_id(name)!r} has several programs"
                    raise InputError(path, problem, "Leave the one that is to be simulated.")
                if any("next" in phase.attrib for phase in element.iter("phase")):
                    problem = (
                        f"signal {shorten_id(name)!r}: phases in another order (the attribute next) are not supported"
                    )
                    raise InputError(path, problem, "Write the phases in the order in which they are shown.")
                programs[name] = Program.from_element(element)
    except (KeyError, ValueError) as error:
        raise InputError(path, f"invalid <tlLogic> ({error!r})", "See SUMO's documentation of tlLogic.") from None
    program = programs.get(signal.id)
    if program is None and len(programs) == 1:
        program = next(iter(programs.values()))
    if program is None or not program.phases:
        known = ", ".join(map(shorten_id, programs)) or "none"
        raise InputError(path, f"no <tlLogic> with phases for the signal {signal.title}", f"It has: {known}.")
    never_green = {link.index for link in signal.links}
    for number, phase in enumerate(program.phases, start=1):
        where = f"{path}: phase {number}"
        if len(phase.state) != signal.states:
            problem = f"expected a state of {number_of(signal.states, 'letter')}, got {len(phase.state)}"
            raise InputError(where, problem, f"The signal {signal.title} has {number_of(signal.states, 'link')}.")
        never_green -= {index for index, letter in enumerate(phase.state) if letter in network.MAY_PASS_LETTERS}
        with_right_of_way = [
            link for link in signal.links if phase.state[link.index] == "G" and link.movement != CROSSING
        ]
        for a, b in combinations(with_right_of_way, 2):
            if a.index != b.index and b.index in a.foes:
                problem = f"{a.title} and {b.title} conflict, but both have green with right of way (G)"
                raise InputError(where, problem, "Use g for the one that gives way, or another phase.")
    _check_never_green({link.index for link in signal.links} - never_green, signal, str(path))
    return replace(program, offset_s=program.offset_s + config.offset_s)


def _read_table(path: Path, config: SignalConfig) -> tuple[SignalPhaseConfig, ...]:
    """Read the phases of a plan, in the order in which they first occur."""
    phases: dict[str, dict[str, Any]] = {}

    def parse(where: str, row: dict[str, str]) -> tuple[()]:
        values = phases.setdefault(row["phase"], {"green": {}})
        if row["approach"]:
            values["green"].setdefault(row["approach"], []).extend(row["movement"].split())
        for key in ("green_s", *CSV_OPTIONAL):
            text = row.get(key, "")
            if not text:
                continue
            number = _parse_seconds(text, f"{where}: {key}")
            if values.setdefault(key, number) != number:
                problem = f"expected {values[key]:g} as before in phase {row['phase']!r}, got {number:g}"
                raise InputError(f"{where}: {key}", problem, "Use one value for each phase.")
        return ()

    spreadsheets.parse_rows(path, partial(_check_header, path), parse)
    if not phases:
        raise InputError(path, "expected a phase in each row, got none", _CSV_HINT)
    configs = []
    for name, values in phases.items():
        try:
            configs.append(SignalPhaseConfig.from_dict(values))
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(map(str, first["loc"]))
            raise InputError(
                f"{path}: phase {name!r}: {key}", first["msg"].removeprefix("Value error, "), _CSV_HINT
            ) from None
        unused = sorted({"min_green_s", "max_green_s"} & values.keys())
        if unused and config.type == "fixed":
            problem = f"{', '.join(unused)} has no effect with a fixed plan"
            raise InputError(f"{path}: phase {name!r}", problem, 'Set type = "actuated".')
    return tuple(configs)


def _check_header(path: Path, header: list[str]) -> list[str]:
    """Return the names of the columns; InputError when one is unknown or missing."""
    names = parse_header(path, header, (*CSV_COLUMNS, *CSV_OPTIONAL), _CSV_HINT)
    if missing := [name for name in CSV_COLUMNS if name not in names]:
        raise InputError(path, f"the column {missing[0]!r} is missing", _CSV_HINT)
    return names


def _parse_seconds(text: str, where: str) -> float:
    number = number_or_nan(text)
    if not 0 <= number < 1e5:
        raise InputError(where, f"expected seconds, got {text!r}", "Use a number such as 30.")
    return number
