"""Rules for traffic that can be checked before it is simulated."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial, wraps
from pathlib import Path

import numpy as np
import pyarrow as pa

from egvs.artefacts import tpog
from egvs.core.errors import Diagnostic, InputError
from egvs.core.grid import BoolArray, FloatArray, Roi
from egvs.effects import registry
from egvs.formats import xml
from egvs.formats.georeference import Georeference
from egvs.scenario.model import Scenario
from egvs.stages import height_checks
from egvs.stages.inputs import CheckInputs, ErrorCollector
from egvs.traffic import (
    class_sizes,
    demand,
    fcd,
    finished_fcd,
    network,
    recording,
    road_check,
    sumo_folder,
    traffic_sources,
    user_files,
)
from egvs.traffic.network import ROAD_VCLASSES
from egvs.traffic.traffic_sources import RecordedTraffic
from egvs.world import clearances, geolocation

_UNUSUAL_SHARE = 0.25
"""A recording has some wrong sizes; if so many of its types have one, the units are wrong."""

Rule = Callable[[CheckInputs], Iterator[Diagnostic]]


def _for_each_period(rule: Rule) -> Rule:
    """Apply a rule to the traffic of every period, and report each finding once."""

    @wraps(rule)
    def check_periods(inputs: CheckInputs) -> Iterator[Diagnostic]:
        findings: list[Diagnostic] = []
        for scenario in inputs.scenario.by_period().values():
            findings += rule(replace(inputs, scenario=scenario))
        yield from dict.fromkeys(findings)

    return check_periods


@_for_each_period
def check_times(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report times that are not multiples of SUMO's step, and a wrong SUMO configuration."""
    scenario = inputs.scenario
    if scenario.traffic.is_finished:
        return
    errors = ErrorCollector()
    demand_files = errors.attempt("traffic", lambda: sumo_folder.demand_files(scenario))
    begin_s = 0.0 if demand_files is None else demand_files.begin_s
    key = sumo_folder.traffic_location(scenario)
    errors.attempt("traffic", lambda: sumo_folder.make_timing(scenario.traffic, begin_s, key))
    yield from errors.findings


@_for_each_period
def check_sumo_files(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report each file that SUMO may not read: damaged, hostile, or with references to other files."""
    if inputs.scenario.traffic.is_finished:
        return
    scenario = inputs.scenario
    try:
        demand = sumo_folder.demand_files(scenario)
        timing = sumo_folder.make_timing(scenario.traffic, demand.begin_s, sumo_folder.traffic_location(scenario))
    except InputError:
        return  # check_times reports it
    errors = ErrorCollector()
    for path in demand.all():
        if path.is_file():
            errors.attempt("traffic", partial(user_files.check_copyable, path))
    if not errors.findings:
        errors.attempt("traffic", partial(user_files.check_demand_size, demand, *timing.simulated_s))
    yield from errors.findings


@_for_each_period
def check_sumo_locations(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report additional files of SUMO, and FCD, that state another offset or projection than the network."""
    scenario = inputs.scenario
    traffic = scenario.traffic
    paths: list[Path] = []
    try:
        if not traffic.is_finished:
            paths = list(sumo_folder.demand_files(scenario).files.get("additional-files", ()))
        elif traffic.fcd is not None and not traffic.fcd_geo:
            paths = [scenario.find(traffic.fcd, "traffic.fcd")]
        expected = geolocation.network_location(scenario)
    except InputError:
        return  # another rule reports it
    if expected is None:
        return
    errors = ErrorCollector()
    for path in paths:
        location = _stated_location(path)
        if location is not None:
            stated = geolocation.StatedLocation(str(path), location)
            errors.attempt(
                "traffic", partial(stated.check_same, expected, "Make it again with the scenario's network.")
            )
    yield from errors.findings


def _stated_location(path: Path) -> network.Location | None:
    """Return the ``<location>`` of an XML file; None for another file, and for one that another rule rejects."""
    with xml.open_bounded(path) as file:
        if not file.read(256).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
            return None
    try:
        return network.read_location(path, "")
    except InputError:
        return None


def check_period_weights(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report weights of periods that make a mix of too many frames."""
    scenario = inputs.scenario
    weights = [period.weight for period in scenario.traffic.periods]
    try:
        frames = [_frames_in_blocks(period) for period in scenario.by_period().values()]
    except InputError:
        return  # check_finished_files reports it
    if not weights or not all(frames):
        return
    errors = ErrorCollector()
    errors.attempt(
        "traffic", partial(tpog.frame_multiplicities, weights, frames, sumo_folder.traffic_location(scenario))
    )
    yield from errors.findings


def _frames_in_blocks(scenario: Scenario) -> int:
    """Number of frames of a period that fill its blocks; a finished file is scanned for them."""
    frames = finished_fcd.recorded_frames(scenario)
    return frames - frames % scenario.tpog.blocks


def check_demand(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report demand files of the user without any vehicle, unless an effect adds traffic."""
    for period, scenario in inputs.scenario.by_period().items():
        errors = ErrorCollector()
        if errors.attempt("traffic", partial(_has_demand, scenario)) is not False:
            continue  # there are vehicles, or check_times reports the error
        traffic = scenario.traffic
        key = sumo_folder.traffic_location(scenario)
        if period:
            key += f".periods ({period})"
        if traffic.sumocfg:
            key += f".sumocfg = {traffic.sumocfg!r}"
        else:
            key += f".routes = {list(traffic.routes)}"
        files = ", ".join(path.name for path in _demand_files(scenario)) or "no route file is named"
        problem = f"no vehicle, trip or flow in its files ({files})"
        hint = "Use route files that contain vehicles. For random trips, give only a network."
        yield Diagnostic("traffic", key, problem, hint, is_error=True)


@_for_each_period
def check_internal_edges(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report a network without edges inside junctions; a warning where the traffic is finished."""
    scenario = inputs.scenario
    try:
        path = sumo_folder.network_path(scenario)
        roads = sumo_folder.read_network(scenario)
    except InputError:
        return  # check_times or the checks of the scene report it
    if path is not None and roads is not None and roads.lacks_internal_edges:
        finding = Diagnostic.of("traffic", network.no_internal_edges_error(path, path))
        yield replace(finding, is_error=not scenario.traffic.is_finished)


@_for_each_period
def check_signals(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report plans of signals that do not fit the network."""
    traffic = inputs.scenario.traffic
    if not traffic.signals or traffic.is_finished:
        return
    try:
        path = sumo_folder.demand_files(inputs.scenario).files["net-file"][0]
    except InputError:
        return  # check_times reports it
    errors = ErrorCollector()
    errors.attempt("traffic", partial(sumo_folder.check_signal_plans, inputs.scenario, path))
    yield from errors.findings


@_for_each_period
def warn_equal_demand(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn if several seeds simulate the same departures of a user's demand, which hides part of the error."""
    traffic = inputs.scenario.traffic
    if traffic.seeds == 1 or not traffic.has_user_demand or traffic.redraw_departures:
        return
    key = f"{sumo_folder.traffic_location(inputs.scenario)}.seeds"
    problem = "all simulations have the same vehicles and departures, so standard errors may be too small"
    yield Diagnostic("seeds", key, problem, "Set redraw_departures = true.")


def _has_demand(scenario: Scenario) -> bool:
    traffic = scenario.traffic
    if traffic.is_finished or not (traffic.sumocfg or traffic.routes):
        return True
    effects, _ = registry.active_traffic_effects(scenario)
    if any(effect.ADDS_TRAFFIC for effect in effects):
        return True
    return user_files.has_vehicles(_demand_files(scenario))


def _demand_files(scenario: Scenario) -> list[Path]:
    files = sumo_folder.demand_files(scenario).files
    return [path for option in user_files.DEMAND_OPTIONS for path in files.get(option, ())]


def check_recorded_positions(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report finished files in other coordinates than the scenario, or unreadable from the start."""
    errors = ErrorCollector()
    names = dict.fromkeys(period.traffic.fcd for period in inputs.scenario.by_period().values())
    for name in names:
        if name is not None:
            errors.attempt("traffic", partial(_check_recorded_position, inputs.scenario, name))
    yield from errors.findings


def _check_recorded_position(scenario: Scenario, name: str) -> None:
    path = scenario.find(name, "traffic.fcd")
    if finished_fcd.read_fcd_metadata(path) is None:
        world = geolocation.scenario_georeference(scenario)
        fcd.check_coordinates(path, world, scenario.traffic.fcd_geo)


_ENOUGH_ROWS = 2000
"""So many rows near the region tell at which height vehicles drive."""


@_for_each_period
def check_traffic_heights(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report recorded traffic whose heights have another zero than the network, or else the ground and the solids."""
    scenario = inputs.scenario
    traffic = scenario.traffic
    if not traffic.is_finished:
        return
    try:
        positions_m = _recorded_positions_m(scenario, inputs.georeference)
    except InputError:
        return  # check_finished_files reports it
    key = f"{sumo_folder.traffic_location(scenario)}.{traffic_sources.source_key(traffic) or 'fcd'}"
    if traffic.fcd is not None:
        key += f" = {traffic.fcd!r}"
    yield from height_checks.compare_traffic(inputs, inputs.carriageway, positions_m, key)


def _recorded_positions_m(scenario: Scenario, world: Georeference) -> FloatArray:
    """Return the first positions of vehicles near the region, on the road, (n, 3), world frame."""
    traffic = scenario.traffic
    tables: Iterable[pa.Table]
    if traffic.fcd is None:
        tables = traffic_sources.source_of(scenario).record(scenario, world).rows
    else:
        path = scenario.find(traffic.fcd, "traffic.fcd")
        tables = fcd.read_fcd(path)
        if finished_fcd.read_fcd_metadata(path) is None:
            tables = fcd.georeference_rows(tables, world, path, traffic.fcd_geo)
    near = [np.empty((0, 3))]
    for table in tables:
        positions_m = np.column_stack([table[name].to_numpy() for name in ("x", "y", "z")])
        near.append(positions_m[_is_near_region(positions_m, scenario.roi.box)])
        if sum(map(len, near)) >= _ENOUGH_ROWS:
            break
    return np.concatenate(near)


def _is_near_region(positions_m: FloatArray, box: Roi) -> BoolArray:
    low_m = np.asarray(box.origin_m[:2]) - clearances.ROI_MARGIN_M
    high_m = np.add(box.origin_m, box.size_m)[:2] + clearances.ROI_MARGIN_M
    is_inside = (positions_m[:, :2] >= low_m) & (positions_m[:, :2] <= high_m)
    is_near: BoolArray = np.all(is_inside, axis=1)
    return is_near


@_for_each_period
def check_finished_files(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report finished files without the requested frames, or whose vehicles have no size, disappear, or fit no road."""
    scenario = inputs.scenario
    errors = ErrorCollector()
    if scenario.traffic.pedestrian_tracks is not None:
        effects, _ = registry.active_traffic_effects(scenario)
        errors.attempt("traffic", lambda: recording.check_recorded_people(scenario, effects))
    if traffic_sources.source_key(scenario.traffic) is not None:
        recorded = errors.attempt(
            "traffic", lambda: traffic_sources.source_of(scenario).record(scenario, inputs.georeference)
        )
        if recorded is not None:
            yield from recorded.warnings
            yield from errors.attempt("traffic", partial(_recorded_findings, scenario, recorded)) or ()
    if scenario.traffic.fcd is None:
        yield from errors.findings
        return
    window = errors.attempt("traffic", lambda: finished_fcd.fcd_window(scenario))
    if window is not None:
        content = window[1]
        vtypes = errors.attempt("traffic", lambda: finished_fcd.check_types(scenario, content.types, content.sizes))
        yield from finished_fcd.presence_warnings(scenario, content)
        if vtypes is not None:
            classes = finished_fcd.vehicle_classes(scenario, content, vtypes)
            lengths_m = finished_fcd.vehicle_lengths_m(scenario, content, vtypes)
            yield from errors.attempt("traffic", partial(_fcd_findings, inputs, classes, lengths_m)) or ()
    yield from errors.findings


def _recorded_findings(scenario: Scenario, recorded: RecordedTraffic) -> list[Diagnostic]:
    """Compare the vehicles of a recording with the roads; people beside simulated vehicles are on no lanes."""
    where = f"{sumo_folder.traffic_location(scenario)}.{traffic_sources.source_key(scenario.traffic)}"
    if scenario.traffic.tracks is None:
        return list(recorded.shared_names.findings(where))
    motor_types = frozenset(name for name, size in recorded.sizes.items() if size.vclass in ROAD_VCLASSES)
    findings = list(class_sizes.warn_unusual_sizes(recorded.sizes, where, _UNUSUAL_SHARE))
    roads = sumo_folder.read_network(scenario)
    compared = road_check.check_tables(
        recorded.rows,
        roads,
        scenario.roi.box,
        motor_types - recorded.uncounted_types,
        recorded.shared_names,
        {name: size.length_m for name, size in recorded.sizes.items()},
        are_centres=True,
    )
    return [*findings, *compared.findings(where)]


def _fcd_findings(inputs: CheckInputs, classes: Mapping[str, str], lengths_m: Mapping[str, float]) -> list[Diagnostic]:
    """Compare the vehicles of a finished FCD file with the roads."""
    scenario = inputs.scenario
    name = scenario.traffic.fcd
    assert name is not None
    path = scenario.find(name, "traffic.fcd")
    rows = fcd.read_fcd(path)
    if finished_fcd.read_fcd_metadata(path) is None:
        rows = fcd.georeference_rows(rows, inputs.georeference, path, scenario.traffic.fcd_geo)
    motor_types = frozenset(name for name, vclass in classes.items() if vclass in ROAD_VCLASSES)
    roads = sumo_folder.read_network(scenario)
    compared = road_check.check_tables(rows, roads, scenario.roi.box, motor_types, lengths_m=lengths_m)
    return list(compared.findings(f"{sumo_folder.traffic_location(scenario)}.fcd = {name!r}"))


def check_vehicle_kinds(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report kinds of vehicles that SUMO does not know or the network does not admit, and unknown edges."""
    traffic = inputs.scenario.traffic
    key = sumo_folder.traffic_location(inputs.scenario)
    if traffic.network is None or traffic.routes:
        return
    for kind in traffic.kinds:
        try:
            demand.check_kinds([kind], key)
        except InputError as error:
            yield Diagnostic.of("traffic", error)
    if inputs.network is None:
        return
    edges = {edge.id for edge in inputs.network.edges}
    for edge_id in sorted(traffic.edge_weights.keys() - edges):
        problem = f"the network has no edge {edge_id!r}"
        yield Diagnostic("traffic", f"{key}.edge_weights", problem, "Use the id of an edge.", is_error=True)
    for kind in traffic.kinds:
        if not any(edge.lanes_for(kind.vclass) for edge in inputs.network.edges):
            problem = f"no lane of the network allows kind {kind.name!r} (vClass {kind.vclass})"
            yield Diagnostic("traffic", f"{key}.kinds", problem, "Use a kind that the network allows.", is_error=True)


def warn_vehicle_sizes(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Warn about kinds of vehicles with a size that no vehicle has: centimetres, feet, length and width swapped."""
    traffic = inputs.scenario.traffic
    key = f"{sumo_folder.traffic_location(inputs.scenario)}.kinds"
    yield from class_sizes.warn_unusual_sizes(finished_fcd.sizes_of_kinds(traffic.named_kinds), key)


@_for_each_period
def check_counts(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report counts at unknown edges or of unknown kinds, and counts on routes that no vehicle can drive."""
    traffic = inputs.scenario.traffic
    key = sumo_folder.traffic_location(inputs.scenario)
    if inputs.network is None or not traffic.counts:
        return
    edges = {edge.id for edge in inputs.network.edges}
    routes = demand.candidate_routes(traffic, inputs.network)
    for count in traffic.counts:
        errors = ErrorCollector()
        errors.attempt("traffic", partial(demand.count_location, count, traffic, routes, key))
        yield from errors.findings
        for edge in (count.edge, count.from_edge, count.to_edge):
            if edge and edge not in edges:
                yield Diagnostic.of("traffic", demand.unknown_edge_error(demand.count_key(count, key), edge))


def check_observed(inputs: CheckInputs) -> Iterator[Diagnostic]:
    """Report a file of observed queues and speeds that is not valid, or that no counts belong to."""
    scenario = inputs.scenario
    if scenario.traffic.observed is None or inputs.network is None:
        return
    from egvs.traffic import observed

    edges = {edge.id for edge in inputs.network.edges}
    for period in scenario.by_period().values():
        for count in period.traffic.counts:
            if not {count.edge, count.from_edge, count.to_edge} - {None} <= edges:
                return  # check_counts reports it
    errors = ErrorCollector()
    errors.attempt("traffic", partial(observed.read_observed, scenario, inputs.network))
    yield from errors.findings
