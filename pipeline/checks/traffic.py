"""Rules for traffic: what can be known of it before it is simulated."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial, wraps
from pathlib import Path

from pipeline.artefacts import periods
from pipeline.checks.subject import Refusals, Subject
from pipeline.core.errors import InputError
from pipeline.core.findings import Finding
from pipeline.effects import on_traffic
from pipeline.scenario.models import Scenario
from pipeline.traffic import fcd, network, sumo, sumo_folder
from pipeline.traffic.demand import counts as demand
from pipeline.traffic.demand import given, trips
from pipeline.traffic.finished import sizes, stated, survey
from pipeline.traffic.guarded import copies
from pipeline.world import world_frame

Rule = Callable[[Subject], Iterator[Finding]]


def _of_each_period(rule: Rule) -> Rule:
    """The rule for the traffic of every period, each finding once."""

    @wraps(rule)
    def of_all(subject: Subject) -> Iterator[Finding]:
        alone = (replace(subject, scenario=scenario) for scenario in subject.scenario.by_period().values())
        yield from dict.fromkeys(finding for one in alone for finding in rule(one))

    return of_all


@_of_each_period
def times(subject: Subject) -> Iterator[Finding]:
    """An error where times do not fit SUMO's step, or its configuration is wrong."""
    scenario, refusals = subject.scenario, Refusals()
    place = sumo_folder.place_of(scenario)
    if scenario.traffic.fcd is None:
        given = refusals.unless_refused("traffic", lambda: sumo_folder.sources(scenario))
        begin_s = 0.0 if given is None else given.begin_s
        refusals.unless_refused("traffic", lambda: sumo_folder.timing(scenario.traffic, begin_s, place))
    yield from refusals.found


@_of_each_period
def readable(subject: Subject) -> Iterator[Finding]:
    """An error for each file that SUMO may not read: damaged, hostile, or one that pulls in another."""
    refusals = Refusals()
    try:
        given = [] if subject.scenario.traffic.fcd is not None else sumo_folder.sources(subject.scenario).all()
    except InputError:
        return  # which is told elsewhere
    for path in given:
        if path.is_file() and not network.is_osm(path):
            refusals.unless_refused("traffic", partial(copies.check, path))
    yield from refusals.found


def weights(subject: Subject) -> Iterator[Finding]:
    """An error where periods' weights make a mix of too many frames."""
    scenario, refusals = subject.scenario, Refusals()
    shares = [period.weight for period in scenario.traffic.periods]
    try:
        frames = [_whole_frames(alone) for alone in scenario.by_period().values()]
    except InputError:
        return  # of a finished file that is wrong, which is told elsewhere
    if shares and all(frames):
        refusals.unless_refused("traffic", partial(periods.times, shares, frames, sumo_folder.place_of(scenario)))
    yield from refusals.found


def _whole_frames(alone: Scenario) -> int:
    """Frames of one period that fill whole blocks; a finished file is looked through for them."""
    frames = survey.recorded_frames(alone)
    return frames - frames % alone.tpog.blocks


def demand_there(subject: Subject) -> Iterator[Finding]:
    """An error where a demand of the user's brings no vehicle, and no effect does."""
    for period, alone in subject.scenario.by_period().items():
        refusals = Refusals()
        if refusals.unless_refused("traffic", partial(_is_demand_there, alone)) is not False:
            continue  # or it cannot be read, which is told elsewhere
        traffic = alone.traffic
        named = f"sumocfg = {traffic.sumocfg!r}" if traffic.sumocfg else f"routes = {list(traffic.routes)}"
        key = f"{sumo_folder.place_of(alone)}{f'.periods ({period})' if period else ''}.{named}"
        files = ", ".join(path.name for path in _demand_files(alone)) or "no route file is named"
        what = f"no vehicle, trip or flow in its files ({files})"
        cure = "route files with vehicles, or a network alone: trips are drawn for it"
        yield Finding("traffic", key, what, cure, is_error=True)


def _is_demand_there(alone: Scenario) -> bool:
    traffic = alone.traffic
    if traffic.fcd is not None or not (traffic.sumocfg or traffic.routes):
        return True
    if any(effect.ADDS_TRAFFIC for effect in on_traffic.live(alone)[0]):
        return True
    return given.bring_vehicles(_demand_files(alone))


def _demand_files(alone: Scenario) -> list[Path]:
    files = sumo_folder.sources(alone).files
    return [path for option in given.OPTIONS for path in files.get(option, ())]


def recorded_places(subject: Subject) -> Iterator[Finding]:
    """An error where a finished file is in other coordinates than the scenario, or cannot be read from its start."""
    whole, refusals = subject.scenario, Refusals()
    for name in dict.fromkeys(alone.traffic.fcd for alone in whole.by_period().values()):
        if name is not None:
            refusals.unless_refused("traffic", partial(_check_place, whole, name))
    yield from refusals.found


def _check_place(scenario: Scenario, name: str) -> None:
    path = scenario.find(name, "traffic.fcd")
    if stated.read(path) is None:
        fcd.check_place(path, world_frame.of(scenario))


@_of_each_period
def finished(subject: Subject) -> Iterator[Finding]:
    """An error where a finished file does not hold the frames that are asked for, or vehicles of unknown size."""
    scenario, refusals = subject.scenario, Refusals()
    if scenario.traffic.fcd is None:
        return
    if (taken := refusals.unless_refused("traffic", lambda: survey.window(scenario))) is not None:
        held = taken[1]
        refusals.unless_refused("traffic", lambda: sizes.check_types(scenario, held.types, held.sizes))
    yield from refusals.found


def kinds(subject: Subject) -> Iterator[Finding]:
    """An error for each kind of vehicle that SUMO or the network does not admit, and for each unknown edge."""
    traffic, place = subject.scenario.traffic, sumo_folder.place_of(subject.scenario)
    if traffic.network is None or traffic.routes:
        return
    for kind in traffic.kinds:
        try:
            trips.check_kinds([kind], sumo.vehicle_classes(), place)
        except InputError as error:
            yield Finding.of("traffic", error)
    if subject.network is None:
        return
    edges = {edge.id for edge in subject.network.edges}
    for unknown in sorted(traffic.edge_weights.keys() - edges):
        found = f"the network has no edge {unknown!r}"
        yield Finding("traffic", f"{place}.edge_weights", found, "the id of an edge", is_error=True)
    for kind in traffic.kinds:
        if not any(edge.lanes_for(kind.vclass) for edge in subject.network.edges):
            found = f"kind {kind.name!r} (vClass {kind.vclass}) may use no lane of the network"
            yield Finding("traffic", f"{place}.kinds", found, "a kind that the network admits", is_error=True)


@_of_each_period
def counts(subject: Subject) -> Iterator[Finding]:
    """An error for each count at an edge, or of a kind, that is not there, or on a way that nobody can drive."""
    traffic, place = subject.scenario.traffic, sumo_folder.place_of(subject.scenario)
    if subject.network is None or not traffic.counts:
        return
    edges, ways = {edge.id for edge in subject.network.edges}, demand.ways_of(traffic, subject.network)
    for count in traffic.counts:
        where, refusals = demand.where_of(count, place), Refusals()
        refusals.unless_refused("traffic", partial(demand.place_of, count, traffic, ways, place))
        yield from refusals.found
        for edge in filter(None, (count.edge, count.from_edge, count.to_edge)):
            if edge not in edges:
                yield Finding("traffic", where, f"the network has no edge {edge!r}", "the id of an edge", is_error=True)
