"""Rules for traffic: what can be known of it before it is simulated."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial, wraps
from pathlib import Path

from egvs.artefacts import tpog
from egvs.core.errors import Diagnostic, InputError
from egvs.effects import registry
from egvs.scenario.model import Scenario
from egvs.stages.inputs import CheckInputs, ErrorCollector
from egvs.traffic import demand, fcd, finished_fcd, network, sumo, sumo_folder, user_files
from egvs.world import geolocation

Rule = Callable[[CheckInputs], Iterator[Diagnostic]]


def _for_each_period(rule: Rule) -> Rule:
    """The rule for the traffic of every period, each finding once."""

    @wraps(rule)
    def of_all(subject: CheckInputs) -> Iterator[Diagnostic]:
        alone = (replace(subject, scenario=scenario) for scenario in subject.scenario.by_period().values())
        yield from dict.fromkeys(finding for one in alone for finding in rule(one))

    return of_all


@_for_each_period
def check_times(subject: CheckInputs) -> Iterator[Diagnostic]:
    """An error where times do not fit SUMO's step, or its configuration is wrong."""
    scenario, refusals = subject.scenario, ErrorCollector()
    place = sumo_folder.traffic_key(scenario)
    if scenario.traffic.fcd is None:
        given = refusals.attempt("traffic", lambda: sumo_folder.demand_files(scenario))
        begin_s = 0.0 if given is None else given.begin_s
        refusals.attempt("traffic", lambda: sumo_folder.make_timing(scenario.traffic, begin_s, place))
    yield from refusals.findings


@_for_each_period
def check_sumo_files(subject: CheckInputs) -> Iterator[Diagnostic]:
    """An error for each file that SUMO may not read: damaged, hostile, or one that pulls in another."""
    refusals = ErrorCollector()
    try:
        given = [] if subject.scenario.traffic.fcd is not None else sumo_folder.demand_files(subject.scenario).all()
    except InputError:
        return  # which is told elsewhere
    for path in given:
        if path.is_file() and not network.is_osm(path):
            refusals.attempt("traffic", partial(user_files.check_copyable, path))
    yield from refusals.findings


def check_period_weights(subject: CheckInputs) -> Iterator[Diagnostic]:
    """An error where periods' weights make a mix of too many frames."""
    scenario, refusals = subject.scenario, ErrorCollector()
    shares = [period.weight for period in scenario.traffic.periods]
    try:
        frames = [_frames_in_blocks(alone) for alone in scenario.by_period().values()]
    except InputError:
        return  # of a finished file that is wrong, which is told elsewhere
    if shares and all(frames):
        refusals.attempt(
            "traffic", partial(tpog.frame_multiplicities, shares, frames, sumo_folder.traffic_key(scenario))
        )
    yield from refusals.findings


def _frames_in_blocks(alone: Scenario) -> int:
    """Frames of one period that fill whole blocks; a finished file is looked through for them."""
    frames = finished_fcd.recorded_frames(alone)
    return frames - frames % alone.tpog.blocks


def check_demand(subject: CheckInputs) -> Iterator[Diagnostic]:
    """An error where a demand of the user's brings no vehicle, and no effect does."""
    for period, alone in subject.scenario.by_period().items():
        refusals = ErrorCollector()
        if refusals.attempt("traffic", partial(_has_demand, alone)) is not False:
            continue  # or it cannot be read, which is told elsewhere
        traffic = alone.traffic
        named = f"sumocfg = {traffic.sumocfg!r}" if traffic.sumocfg else f"routes = {list(traffic.routes)}"
        key = f"{sumo_folder.traffic_key(alone)}{f'.periods ({period})' if period else ''}.{named}"
        files = ", ".join(path.name for path in _demand_files(alone)) or "no route file is named"
        what = f"no vehicle, trip or flow in its files ({files})"
        cure = "route files with vehicles, or a network alone: trips are drawn for it"
        yield Diagnostic("traffic", key, what, cure, is_error=True)


def _has_demand(alone: Scenario) -> bool:
    traffic = alone.traffic
    if traffic.fcd is not None or not (traffic.sumocfg or traffic.routes):
        return True
    if any(effect.ADDS_TRAFFIC for effect in registry.active_traffic_effects(alone)[0]):
        return True
    return user_files.has_vehicles(_demand_files(alone))


def _demand_files(alone: Scenario) -> list[Path]:
    files = sumo_folder.demand_files(alone).files
    return [path for option in user_files.DEMAND_OPTIONS for path in files.get(option, ())]


def check_recorded_positions(subject: CheckInputs) -> Iterator[Diagnostic]:
    """An error where a finished file is in other coordinates than the scenario, or cannot be read from its start."""
    whole, refusals = subject.scenario, ErrorCollector()
    for name in dict.fromkeys(alone.traffic.fcd for alone in whole.by_period().values()):
        if name is not None:
            refusals.attempt("traffic", partial(_check_recorded_position, whole, name))
    yield from refusals.findings


def _check_recorded_position(scenario: Scenario, name: str) -> None:
    path = scenario.find(name, "traffic.fcd")
    if finished_fcd.read_fcd_metadata(path) is None:
        world = geolocation.scenario_georeference(scenario)
        fcd.check_coordinates(path, world, scenario.traffic.fcd_geo)


@_for_each_period
def check_finished_files(subject: CheckInputs) -> Iterator[Diagnostic]:
    """An error where a finished file does not hold the frames that are asked for, or vehicles of unknown size."""
    scenario, refusals = subject.scenario, ErrorCollector()
    if scenario.traffic.fcd is None:
        return
    if (taken := refusals.attempt("traffic", lambda: finished_fcd.fcd_window(scenario))) is not None:
        held = taken[1]
        refusals.attempt("traffic", lambda: finished_fcd.check_types(scenario, held.types, held.sizes))
    yield from refusals.findings


def check_vehicle_kinds(subject: CheckInputs) -> Iterator[Diagnostic]:
    """An error for each kind of vehicle that SUMO or the network does not admit, and for each unknown edge."""
    traffic, place = subject.scenario.traffic, sumo_folder.traffic_key(subject.scenario)
    if traffic.network is None or traffic.routes:
        return
    for kind in traffic.kinds:
        try:
            demand.check_kinds([kind], sumo.vehicle_classes(), place)
        except InputError as error:
            yield Diagnostic.of("traffic", error)
    if subject.network is None:
        return
    edges = {edge.id for edge in subject.network.edges}
    for unknown in sorted(traffic.edge_weights.keys() - edges):
        found = f"the network has no edge {unknown!r}"
        yield Diagnostic("traffic", f"{place}.edge_weights", found, "the id of an edge", is_error=True)
    for kind in traffic.kinds:
        if not any(edge.lanes_for(kind.vclass) for edge in subject.network.edges):
            found = f"kind {kind.name!r} (vClass {kind.vclass}) may use no lane of the network"
            yield Diagnostic("traffic", f"{place}.kinds", found, "a kind that the network admits", is_error=True)


@_for_each_period
def check_counts(subject: CheckInputs) -> Iterator[Diagnostic]:
    """An error for each count at an edge, or of a kind, that is not there, or on a way that nobody can drive."""
    traffic, place = subject.scenario.traffic, sumo_folder.traffic_key(subject.scenario)
    if subject.network is None or not traffic.counts:
        return
    edges, ways = {edge.id for edge in subject.network.edges}, demand.candidate_routes(traffic, subject.network)
    for count in traffic.counts:
        where, refusals = demand.count_key(count, place), ErrorCollector()
        refusals.attempt("traffic", partial(demand.count_location, count, traffic, ways, place))
        yield from refusals.findings
        for edge in filter(None, (count.edge, count.from_edge, count.to_edge)):
            if edge not in edges:
                yield Diagnostic.of("traffic", demand.unknown_edge_error(where, edge))
