"""Record the floating car data (FCD) of a scenario from its source.

A scenario has one of three sources: SUMO as a subprocess, which writes an FCD file to the run's folder; a SUMO that is
already running, over TraCI; a finished file. :func:`record_traffic` returns a :class:`Recording` with the rows of any
of them. World frame and units as in SUMO; times are whole milliseconds.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pyarrow as pa

from egvs.core import limits, threads
from egvs.core.errors import Diagnostic, InputError, RunError
from egvs.core.progress import ProgressCallback
from egvs.core.resource_usage import peak_memory_of
from egvs.core.wording import number_of, shorten_id
from egvs.formats import xml
from egvs.formats.georeference import Georeference
from egvs.scenario.model import Scenario
from egvs.scenario.traffic_config import TrafficConfig
from egvs.traffic import fcd, finished_fcd, locks, network, sumo, sumo_folder, traffic_sources
from egvs.traffic.count_fit import CountFit, count_fits, missed_count_warnings
from egvs.traffic.locks import DemandKey, RegionWatch, WatchedRegion, describe_distance
from egvs.traffic.road_lanes import RoadLanes
from egvs.traffic.sumo_folder import SimulationFolder, Timing
from egvs.traffic.traffic_sources import RecordedTraffic
from egvs.traffic.vehicle_boxes import TrafficHook, VehicleSize

_MIN_STANDING_LIMIT_S = 180.0
_MAX_WAITING_SHARE = 0.02
_TABLES = (sumo_folder.FCD_FILE, sumo_folder.PERSONS_FILE)
_XML_ROOTS = {
    sumo_folder.COLLISIONS_FILE: "collisions",
    sumo_folder.STOPS_FILE: "stops",
    sumo_folder.STATISTICS_FILE: "statistics",
    sumo_folder.DRIVEN_ROUTES_FILE: "routes",
}


@dataclass(frozen=True)
class RecordingSummary:
    """What SUMO did.

    ``flags`` and ``sumo_seconds`` are None if it was already running, ``sumo_peak_mb`` where it is not known.
    """

    sumo: str
    sumo_seconds: float | None
    flags: list[str] | None
    collisions: int
    teleports: int = 0
    sumo_peak_mb: float | None = None
    notes: list[str] = field(default_factory=list)
    counts: list[CountFit] = field(default_factory=list)
    warnings: list[Diagnostic] = field(default_factory=list)


@dataclass(frozen=True)
class Recording:
    """FCD rows of a scenario, and what is known about them.

    Attributes
    ----------
    rows
        Tables of :data:`egvs.traffic.fcd.FCD_SCHEMA`, in order of time.
    window
        Which time steps are frames.
    sizes
        Size of each vehicle type; of a running SUMO, filled while rows are read.
    where
        The traffic table, for messages.
    standing_limit_s
        How long a vehicle may stand at the end of the recording; None for a finished file.
    vehicles
        Number of vehicles to maintain; None without such a number.
    stopped_on_purpose
        Vehicles that may stand longer; of a running SUMO, filled while rows are read.
    persons
        Rows of persons, where they are not among ``rows``.
    summary
        Returns the summary after ``finish``; None for a finished file.
    source
        Source of the rows, for messages; empty for a running SUMO.
    roads
        The simulated network, for messages; None if it is not known.
    finish
        Waits for the end of the simulation after all rows have been read, and raises its error.
    is_live
        Whether rows are read while they are simulated.
    teleports
        Returns the vehicles that SUMO moved on, after ``finish``.
    locked
        Why a watched region is locked, by name; only locked regions. None where no region was watched.
    types
        The vehicle types of a finished file with their sizes.
    uncounted_types
        Types that do not count as vehicles: people on foot and on bicycles among recorded tracks.
    tracks
        What was read, changed and left out of recorded tracks, as JSON; None for other traffic.
    warnings
        Warnings about the source.
    unknown_boxes
        Gaps in recorded tracks, as JSON.
    """

    rows: Iterable[pa.Table]
    window: fcd.FrameWindow
    sizes: Mapping[str, VehicleSize]
    where: str
    standing_limit_s: float | None = None
    vehicles: int | None = None
    stopped_on_purpose: Set[str] = frozenset()
    persons: Iterable[pa.Table] | None = None
    summary: Callable[[], RecordingSummary | None] = lambda: None
    source: str = ""
    roads: network.Network | None = None
    finish: Callable[[], Any] = lambda: None
    is_live: bool = False
    teleports: Callable[[], Sequence[locks.Teleport]] = list
    locked: Mapping[str, str] | None = None
    types: Mapping[str, finished_fcd.SizedType] = field(default_factory=dict)
    uncounted_types: frozenset[str] = frozenset()
    tracks: Mapping[str, Any] | None = None
    warnings: Sequence[Diagnostic] = ()
    unknown_boxes: Sequence[Mapping[str, Any]] = ()


def record_traffic(
    scenario: Scenario,
    folder: Path,
    extensions: Sequence[TrafficHook],
    progress: ProgressCallback,
    traci: tuple[str, int] | None,
    world: Georeference,
    regions: Mapping[str, WatchedRegion] | None = None,
    *,
    live: bool = False,
) -> AbstractContextManager[Recording]:
    """Record the traffic of a scenario.

    Parameters
    ----------
    scenario
        The scenario.
    folder
        The folder for SUMO.
    extensions
        Add traffic.
    progress
        Reports simulated frames.
    traci
        Host and port of a running SUMO.
    world
        Converts a finished file in degrees to the world frame.
    regions
        SUMO is stopped, with an error, as soon as the traffic in all these regions is locked. They are watched if the
        demand is generated: vehicles of a user's demand may stop on purpose.
    live
        Rows of a generated demand may be read while SUMO simulates; otherwise it ends before the block begins.

    Returns
    -------
    context manager of Recording
        SUMO, and its temporary files, end with the block.

    Raises
    ------
    InputError
        When ``traci`` is given for recorded traffic, or an extension does not support the scenario.
    """
    if scenario.traffic.is_finished and traci is not None:
        hint = "Set network or sumocfg in [traffic] instead."
        raise InputError("--traci", "the traffic of the scenario was recorded before", hint)
    for extension in extensions:
        error = extension.scenario_error(scenario)
        if error is not None:
            raise error
    if scenario.traffic.fcd is not None:
        return _record_finished(scenario, folder, world)
    if scenario.traffic.tracks is not None:
        return _record_tracks(scenario, folder, world)
    if traci is not None:
        return _record_running(scenario, *traci, extensions)
    return _record_simulated(scenario, folder, progress, extensions, regions or {}, world, live)


@contextmanager
def _record_finished(scenario: Scenario, folder: Path, world: Georeference) -> Iterator[Recording]:
    name = scenario.traffic.fcd
    assert name is not None
    where = sumo_folder.traffic_location(scenario)
    sumo_folder.copy_network(scenario, folder)
    window, survey = finished_fcd.fcd_window(scenario)
    path = scenario.find(name, "traffic.fcd")
    sized = finished_fcd.sizes_of_types(scenario, survey.types, survey.sizes)
    sizes = {vehicle_type: sized_type.size for vehicle_type, sized_type in sized.items()}
    types = {vehicle_type: sized[vehicle_type] for vehicle_type in sorted(survey.types)}
    rows = fcd.read_fcd(path)
    if survey.metadata is None:
        rows = fcd.georeference_rows(rows, world, path, scenario.traffic.fcd_geo)
    rows = rows_on_roads(rows, path, sumo_folder.read_network(scenario), window)
    yield Recording(rows, window, sizes, where, source=f"{where}.fcd = {name!r}", types=types)


def rows_on_roads(
    tables: Iterable[pa.Table], path: Path, roads: network.Network | None, window: fcd.FrameWindow
) -> Iterator[pa.Table]:
    """Set vehicles on the roads below them, if the network has heights and their file has none.

    Parameters
    ----------
    tables
        Rows of :data:`egvs.traffic.fcd.FCD_SCHEMA`. Those that get a height are held in memory.
    path
        The file that they are from.
    roads
        The network; None without one.
    window
        Which time steps are frames; later rows are left out.

    Yields
    ------
    pyarrow.Table
        The rows.

    Raises
    ------
    InputError
        When there are more rows than memory may hold.
    """
    if roads is None or not roads.has_heights or fcd.has_heights(path):
        yield from tables
        return
    rows: list[pa.Table] = []
    n_rows = 0
    for table in tables:
        rows.append(table)
        n_rows += table.num_rows
        limits.ROWS.check(path, n_rows, f"has more than {limits.ROWS.maximum:,} rows without a height")
        first_ms = rows[0]["time_ms"][0].as_py() + window.skip_ms if window.first_ms is None else window.first_ms
        if table["time_ms"][-1].as_py() > first_ms + window.count * window.period_ms:
            break
    if not rows:
        return
    table = pa.concat_tables(rows).combine_chunks()
    names = table["id"].combine_chunks().dictionary_encode()
    xy_m = np.column_stack([table["x"].to_numpy(), table["y"].to_numpy()])
    yaw_rad = np.deg2rad(90.0 - table["angle"].to_numpy())
    heights_m = RoadLanes(roads).heights_m(names.indices.to_numpy(), table["time_ms"].to_numpy(), xy_m, yaw_rad)
    yield table.set_column(table.schema.get_field_index("z"), fcd.FCD_SCHEMA.field("z"), pa.array(heights_m))


@contextmanager
def _record_tracks(scenario: Scenario, folder: Path, world: Georeference) -> Iterator[Recording]:
    where = sumo_folder.traffic_location(scenario)
    sumo_folder.copy_network(scenario, folder)
    recorded = traffic_sources.source_of(scenario).record(scenario, world)
    yield Recording(
        recorded.rows, recorded.window, recorded.sizes, where, source=f"{where}.tracks", **_values_of(recorded)
    )


def _values_of(recorded: RecordedTraffic) -> dict[str, Any]:
    """Return what is known about recorded road users, as attributes of a :class:`Recording`."""
    return {
        "uncounted_types": recorded.uncounted_types,
        "tracks": recorded.summary,
        "warnings": recorded.warnings,
        "unknown_boxes": recorded.unknown_boxes,
    }


@contextmanager
def _record_simulated(
    scenario: Scenario,
    folder: Path,
    progress: ProgressCallback,
    extensions: Sequence[TrafficHook],
    regions: Mapping[str, WatchedRegion],
    world: Georeference,
    live: bool,
) -> Iterator[Recording]:
    where = sumo_folder.traffic_location(scenario)
    people = _recorded_people(scenario, extensions, world)
    prepared = sumo_folder.prepare_simulation(scenario, folder, extensions)
    sources = ", ".join(path.name for path in prepared.sources)
    try:
        sizes = finished_fcd.sizes_of_kinds(scenario.traffic.kinds)
        if not prepared.is_generated:
            sizes = sumo.query_sizes(["-c", sumo_folder.CONFIG_FILE], folder)
        for extension in extensions:
            sizes |= extension.sizes()
        watch = None
        if regions and prepared.is_generated:
            fcd, log = folder / sumo_folder.FCD_FILE, folder / sumo_folder.LOG_FILE
            watch = RegionWatch(
                fcd, log, prepared.timing, regions, prepared.roads, sizes, demand_key(scenario), prepared.teleport_s
            )
        with threads.run_in_thread(partial(simulate, prepared, progress, watch)) as simulation:
            is_live = live and prepared.is_generated
            if not is_live:
                simulation.result()
            has_people = prepared.has_extra_traffic
            persons = _read_rows(folder / sumo_folder.PERSONS_FILE, "person", simulation) if has_people else None
            people_values: dict[str, Any] = {}
            if people is not None:
                persons = people.rows
                sizes |= people.sizes
                people_values = _values_of(people)
            yield Recording(
                _read_rows(folder / sumo_folder.FCD_FILE, "vehicle", simulation),
                prepared.timing.window(),
                sizes,
                where,
                standing_limit_s(prepared.roads.cycle_s),
                prepared.vehicles,
                _planned_stops(prepared),
                persons,
                partial(_summarize, scenario, prepared, simulation),
                f"{where} ({sources})",
                prepared.roads,
                simulation.result,
                is_live,
                partial(_read_teleports, prepared, scenario),
                None if watch is None else watch.locked,
                **people_values,
            )
    except sumo.SumoInputError as error:
        hint = "Correct these files; SUMO read copies of them."
        raise error.for_input(where, f"SUMO cannot run {sources}", hint) from None
    finally:
        for name in (*_TABLES, sumo_folder.DRIVEN_ROUTES_FILE, sumo_folder.STATISTICS_FILE):
            (folder / name).unlink(missing_ok=True)


def _recorded_people(
    scenario: Scenario, extensions: Sequence[TrafficHook], world: Georeference
) -> RecordedTraffic | None:
    """Read the recorded pedestrians of a scenario, if there are any; InputError where others are simulated."""
    if scenario.traffic.pedestrian_tracks is None:
        return None
    check_recorded_people(scenario, extensions)
    return traffic_sources.source_of(scenario).record(scenario, world)


def check_recorded_people(scenario: Scenario, extensions: Iterable[TrafficHook]) -> None:
    """Raise an InputError when people are recorded (``traffic.pedestrian_tracks``) and simulated as well."""
    are_simulated = any(extension.ADDS_TRAFFIC for extension in extensions)
    if are_simulated and scenario.traffic.pedestrian_tracks is not None:
        where = f"{sumo_folder.traffic_location(scenario)}.pedestrian_tracks"
        problem = "pedestrians are recorded, and an effect simulates others"
        raise InputError(where, problem, "Remove effects.pedestrians_bicycles, or pedestrian_tracks.")


def _read_rows(path: Path, element: str, simulation: Future[Any]) -> Iterable[pa.Table]:
    """Read an FCD file that SUMO writes until a simulation ends; the error of the simulation comes first."""
    return fcd.read_growing_fcd(path, element, lambda: simulation.done() and simulation.result() is not None)


def _summarize(
    scenario: Scenario, prepared: SimulationFolder, simulation: Future[tuple[float, float | None]]
) -> RecordingSummary:
    """Return what SUMO did, after its end."""
    seconds, peak_mb = simulation.result()
    collisions = _read_collisions(prepared)
    fits, warnings = _compare_counts(scenario, prepared)
    teleports = _read_teleports(prepared, scenario)
    warnings += [
        *_collision_warning(collisions, scenario),
        *_insertion_warning(prepared, scenario, fits),
        *_teleport_warning(teleports, prepared, scenario),
    ]
    flags = sumo_folder.as_flags(prepared.options | prepared.outputs)
    return RecordingSummary(
        sumo.sumo_version(), seconds, flags, len(collisions), len(teleports), peak_mb, prepared.notes, fits, warnings
    )


@contextmanager
def _record_running(scenario: Scenario, host: str, port: int, extensions: Sequence[TrafficHook]) -> Iterator[Recording]:
    where = sumo_folder.traffic_location(scenario)
    inputs = sumo_folder.demand_files(scenario)
    timing = sumo_folder.make_timing(scenario.traffic, inputs.begin_s, where)
    net_file = inputs.files["net-file"][0]
    cycle_s = network.read_net_xml(net_file).cycle_s
    observations = TraciObservations()
    persons = any(extension.ADDS_TRAFFIC for extension in extensions)
    with sumo.connect_traci(host, port) as connection:
        version = sumo.parse_version(connection.getVersion()[1])
        yield Recording(
            record_live(connection, timing, observations, f"{host}:{port}", persons=persons),
            timing.window(),
            observations.sizes,
            where,
            standing_limit_s(cycle_s),
            scenario.traffic.vehicles,
            observations.stopped_on_purpose,
            summary=lambda: RecordingSummary(version, None, None, len(observations.collisions)),
        )


@dataclass
class TraciObservations:
    """What :func:`record_live` observes in addition to rows.

    Attributes
    ----------
    sizes
        Size of each vehicle type, queried when its first vehicle appears.
    collisions
        Pairs of vehicles that collided in the recorded time.
    stopped_on_purpose
        Vehicles at a planned stop in the last frame.
    """

    sizes: dict[str, VehicleSize] = field(default_factory=dict)
    collisions: set[tuple[str, str]] = field(default_factory=set)
    stopped_on_purpose: set[str] = field(default_factory=set)


def record_live(
    connection: Any, timing: Timing, observations: TraciObservations, address: str, *, persons: bool = False
) -> Iterator[pa.Table]:
    """Step a running SUMO through the recording; yield the rows of each frame as in its FCD file.

    After a step, TraCI's clock is one step ahead of the state that it shows: the state at time t of SUMO's FCD is
    available at t + step.

    Parameters
    ----------
    connection
        The TraCI connection.
    timing
        Times of the recording.
    observations
        Filled while rows are read.
    address
        Host and port, for messages.
    persons
        Whether persons are recorded, too.

    Yields
    ------
    pyarrow.Table
        Rows of :data:`egvs.traffic.fcd.FCD_SCHEMA`.
    """
    _check_clock(connection, timing, address)
    subscriptions = _Subscriptions(connection, observations.sizes, persons)
    while (time_ms := round(connection.simulation.getTime() * 1000)) < timing.end_ms:
        connection.simulationStep()
        subscriptions.update()
        if time_ms < timing.first_ms:
            continue
        observations.collisions |= {(c.collider, c.victim) for c in connection.simulation.getCollisions()}
        if (time_ms - timing.first_ms) % timing.period_ms == 0 and (rows := subscriptions.rows()):
            if time_ms + timing.step_ms >= timing.end_ms:
                stopped = {name for name in subscriptions.vehicles() if connection.vehicle.isStopped(name)}
                observations.stopped_on_purpose |= stopped
            ids, types, numbers = zip(*rows, strict=True)
            arrays = [np.full(len(rows), time_ms), pa.array(ids), pa.array(types), *np.array(numbers).T]
            yield pa.table(arrays, schema=fcd.FCD_SCHEMA)


def _check_clock(connection: Any, timing: Timing, address: str) -> None:
    """Raise an error if the step or the time of a running SUMO does not fit the recording."""
    where = f"--traci {address}"
    step_s = connection.simulation.getDeltaT()
    if round(step_s * 1000) != timing.step_ms:
        problem = f"expected steps of {timing.step_ms / 1000:g} s, got {step_s:g} s"
        raise InputError(where, problem, "Set traffic.step_s to the step of the running SUMO.")
    now_ms = round(connection.simulation.getTime() * 1000)
    first_frame = f"the first frame at {timing.first_ms / 1000:g} s"
    if now_ms > timing.first_ms:
        hint = "Restart it, or set a longer traffic.warmup_s."
        raise RunError(f"{where}: SUMO is already at {now_ms / 1000:g} s, after {first_frame}. {hint}")
    if (timing.first_ms - now_ms) % timing.step_ms:
        raise RunError(f"{where}: steps of {step_s:g} s from {now_ms / 1000:g} s on do not hit {first_frame}")


class _Subscriptions:
    """TraCI subscriptions to all vehicles, and to all persons if requested."""

    def __init__(self, connection: Any, sizes: dict[str, VehicleSize], persons: bool) -> None:
        constants = sumo.traci_constants()
        self._connection = connection
        self._sizes = sizes
        self._position, self._angle = constants.VAR_POSITION3D, constants.VAR_ANGLE
        self._slope, self._speed, self._type = constants.VAR_SLOPE, constants.VAR_SPEED, constants.VAR_TYPE
        self._variables = (self._position, self._angle, self._slope, self._speed, self._type)
        self._invalid = constants.INVALID_DOUBLE_VALUE
        self._departed = constants.VAR_DEPARTED_VEHICLES_IDS
        for name in connection.vehicle.getIDList():
            connection.vehicle.subscribe(name, self._variables)
        connection.simulation.subscribe((self._departed,))
        self._persons: set[str] | None = set() if persons else None

    def update(self) -> None:
        """Subscribe to the vehicles that departed in this step, and to new persons."""
        for name in self._connection.simulation.getSubscriptionResults()[self._departed]:
            self._connection.vehicle.subscribe(name, self._variables)
        if self._persons is not None:
            present = set(self._connection.person.getIDList())
            for name in sorted(present - self._persons):
                self._connection.person.subscribe(name, self._variables)
            self._persons = present

    def vehicles(self) -> list[str]:
        """Return the names of all vehicles on the road."""
        return [name for name, _ in self._results(self._connection.vehicle)]

    def rows(self) -> list[tuple[str, str, list[float]]]:
        """Return each vehicle and person, rounded as in SUMO's files: id, type; x, y, z, angle, slope, speed."""
        rows = [self._row(name, values) for name, values in self._results(self._connection.vehicle)]
        if self._persons is not None:
            for name, values in self._results(self._connection.person):
                rows.append(self._row(name, values))
                rows[-1][2][4] = 0.0  # no slope, as in fcd.read_fcd
        return rows

    def _results(self, domain: Any) -> Iterator[tuple[str, Any]]:
        """Yield the subscribed values of vehicles or persons, except those that are being teleported."""
        for name, values in domain.getAllSubscriptionResults().items():
            if values[self._position][0] != self._invalid:
                yield name, values

    def _row(self, name: str, values: Any) -> tuple[str, str, list[float]]:
        vtype = values[self._type]
        if vtype not in self._sizes:
            self._sizes[vtype] = sumo.query_size(self._connection, vtype)
        numbers = (*values[self._position], values[self._angle], values[self._slope], values[self._speed])
        return name, vtype, [float(f"{number:.{sumo_folder.FCD_DIGITS}f}") for number in numbers]


def standing_limit_s(cycle_s: float) -> float:
    """Return how long a vehicle may stand at the end of a recording: two signal cycles, at least three minutes."""
    return max(_MIN_STANDING_LIMIT_S, 2.0 * cycle_s)


def demand_key(scenario: Scenario) -> DemandKey:
    """Return the key that sets how much traffic there is, with its period, and how to reduce the traffic."""
    traffic = scenario.traffic
    if traffic.sumocfg is not None:
        return _demand_key(scenario, "sumocfg", "Reduce its demand, or correct the signals and connections there.")
    if traffic.routes:
        return _demand_key(scenario, "routes", "Reduce the demand, or correct the signals and connections there.")
    if traffic.counts:
        return _demand_key(scenario, "counts", "Lower per_hour of the counts, or correct the signals there.")
    for key in ("vehicles", "vehicles_per_h", "vehicles_per_lane_km"):
        if key in traffic.model_fields_set and getattr(traffic, key) is not None:
            return _demand_key(scenario, key, f"Lower {key}, or correct the signals and connections there.")
    density = TrafficConfig.model_fields["vehicles_per_lane_km"].default
    hint = f"Set traffic.vehicles_per_lane_km below {density:g}, or correct the signals and connections there."
    return _demand_key(scenario, "network", hint)


def _demand_key(scenario: Scenario, key: str, hint: str) -> DemandKey:
    """Return a key of ``[traffic]``, or of the period that sets it itself."""
    if key in scenario.period_keys:
        return DemandKey(f"{scenario.file}: traffic.periods ({scenario.period}).{key}", hint)
    where = f"{sumo_folder.traffic_location(scenario)}.{key}"
    if scenario.period:
        where += f" (period {scenario.period})"
    return DemandKey(where, hint)


def simulate(
    prepared: SimulationFolder, progress: ProgressCallback, region_watch: RegionWatch | None = None
) -> tuple[float, float | None]:
    """Run SUMO; return its seconds, and its peak memory (MB of 2**20 bytes; None where it is not known).

    Parameters
    ----------
    prepared
        Its folder.
    progress
        Reports simulated frames.
    region_watch
        Stops SUMO as soon as all its regions are locked.

    Raises
    ------
    RunError
        When all regions are locked, or an output is not complete.
    """
    timing = prepared.timing
    peaks_mb: list[float] = []

    def watch(process: int) -> None:
        peak_mb = peak_memory_of(process)
        if peak_mb is not None:
            peaks_mb.append(peak_mb)
        now_ms = _last_time_ms(prepared.folder / sumo_folder.FCD_FILE)
        if now_ms is not None:
            frames = (now_ms - timing.first_ms) // timing.period_ms
            progress("frames simulated", min(timing.frames, max(0, frames)), timing.frames)
        if region_watch is not None:
            region_watch.update()

    start = perf_counter()
    flags = ["-c", sumo_folder.CONFIG_FILE, *sumo_folder.as_flags(prepared.outputs)]
    steps = (timing.end_ms - timing.begin_ms) // timing.step_ms
    sumo.run_program("sumo", flags, prepared.folder, prepared.folder / sumo_folder.LOG_FILE, watch, steps)
    check_complete(prepared)
    if region_watch is not None:
        region_watch.finish()
    progress("frames simulated", timing.frames, timing.frames)
    peak_mb = round(max(peaks_mb), 1) if peaks_mb else None
    return round(perf_counter() - start, 3), peak_mb


def check_complete(prepared: SimulationFolder) -> None:
    """Raise a RunError if an output of SUMO is not complete: on a full disk it ends without an error."""
    folder = prepared.folder
    outputs = prepared.outputs.values()
    for name in _TABLES:
        if name in outputs:
            sumo.check_table_complete(folder / name)
    for name, root in _XML_ROOTS.items():
        if name in outputs:
            sumo.check_xml_complete(folder / name, root)
    if sumo_folder.STATISTICS_FILE in outputs and _vehicle_counts(prepared)["running"]:
        last_ms = _last_time_ms(folder / sumo_folder.FCD_FILE) or 0
        if last_ms < prepared.timing.end_ms - prepared.timing.step_ms:
            raise sumo.incomplete_file_error(folder / sumo_folder.FCD_FILE)


def _last_time_ms(path: Path) -> int | None:
    """Return the time of the last complete row of a CSV file that is being written."""
    lines = sumo.read_tail(path).split(b"\n")
    if len(lines) <= 2:
        return None
    try:
        return round(float(lines[-2].split(b";")[0]) * 1000)
    except ValueError:
        return None


@dataclass(frozen=True)
class Collision:
    """The first collision of two vehicles: its lane, and its coordinates in the world frame, if SUMO reports them."""

    lane: str
    at_m: tuple[float, float] | None

    @property
    def location(self) -> str:
        """The junction or the edge, e.g. ``"junction J1"``."""
        if self.lane.startswith(":"):
            return f"junction {shorten_id(self.lane[1:].rsplit('_', 2)[0])}"
        return f"edge {self.lane.rpartition('_')[0]}"


def _read_collisions(prepared: SimulationFolder) -> dict[tuple[str, str], Collision]:
    """Read the first collision of each pair of vehicles in the recorded time."""
    collisions: dict[tuple[str, str], Collision] = {}
    for element in xml.iter_elements(prepared.folder / sumo_folder.COLLISIONS_FILE, "collisions"):
        if float(element.get("time", "0")) * 1000.0 >= prepared.timing.first_ms:
            x_m, y_m = [float(value) for value in element.get("colliderFront", "nan,nan").split(",")[:2]]
            at_m = (x_m, y_m) if math.isfinite(x_m + y_m) else None
            pair = element.get("collider", ""), element.get("victim", "")
            collisions.setdefault(pair, Collision(element.get("lane", ""), at_m))
    return collisions


def _collision_warning(collisions: dict[tuple[str, str], Collision], scenario: Scenario) -> list[Diagnostic]:
    """Warn about collisions, with the junctions and edges where most happened."""
    if not collisions:
        return []
    numbers = Counter(collision.location for collision in collisions.values())
    at_m = {collision.location: collision.at_m for collision in collisions.values()}
    locations = []
    for location, number in numbers.most_common(3):
        point_m = at_m[location]
        distance = "" if point_m is None else f" ({describe_distance(point_m, scenario.roi.box)})"
        locations.append(f"{number} at {location}{distance}")
    pairs = number_of(len(collisions), "pair")
    problem = f"{pairs} of vehicles collided and drove through each other: {', '.join(locations)}"
    hint = "In sumo-gui, check right of way, signals and the waiting space on the junctions there."
    return [Diagnostic("collisions", sumo_folder.traffic_location(scenario), problem, hint)]


def _read_teleports(prepared: SimulationFolder, scenario: Scenario) -> list[locks.Teleport]:
    """Return the vehicles that SUMO moved on in the recorded time."""
    if scenario.traffic.teleport_s is None:
        return []
    log = (prepared.folder / sumo_folder.LOG_FILE).read_text(encoding="utf-8", errors="replace")
    return locks.read_teleports(log, prepared.timing.first_ms / 1000.0)


def _teleport_warning(
    teleports: Sequence[locks.Teleport], prepared: SimulationFolder, scenario: Scenario
) -> list[Diagnostic]:
    limit_s = prepared.teleport_s
    if not teleports or limit_s is None:
        return []
    counts = _vehicle_counts(prepared)
    vehicles = counts["loaded"] - counts["waiting"]
    names = locks.StreetNames(prepared.roads)
    return locks.teleport_warning(teleports, vehicles, limit_s, names, scenario.roi.box, demand_key(scenario))


def _insertion_warning(prepared: SimulationFolder, scenario: Scenario, fits: Sequence[CountFit]) -> list[Diagnostic]:
    """Warn if many vehicles of a demand had no space to start, and name the movement that exceeds the network most."""
    if prepared.vehicles is not None:
        return []
    counts = _vehicle_counts(prepared)
    loaded, waiting = counts["loaded"], counts["waiting"]
    if waiting <= _MAX_WAITING_SHARE * loaded:
        return []
    problem = (
        f"{waiting:,} of {number_of(loaded, 'vehicle')} could not start, because the streets where they start are full"
    )
    if fits:
        worst = max(fits, key=lambda fit: fit.counted_per_h - fit.simulated_per_h)
        problem += (
            f"; the count of {worst.place} exceeds what the network can carry: {worst.simulated_per_h:g} of"
            f" {worst.counted_per_h:g} vehicles an hour passed"
        )
    return [
        Diagnostic("waiting", sumo_folder.traffic_location(scenario), problem, "Reduce the demand there, or add lanes.")
    ]


def _vehicle_counts(prepared: SimulationFolder) -> dict[str, int]:
    """Return the numbers of vehicles that were loaded, are running at the end, and wait to start."""
    elements = xml.iter_elements(prepared.folder / sumo_folder.STATISTICS_FILE, "statistics")
    (vehicles,) = (element for element in elements if element.tag == "vehicles")
    return {key: int(vehicles.get(key, "0")) for key in ("loaded", "running", "waiting")}


def _compare_counts(scenario: Scenario, prepared: SimulationFolder) -> tuple[list[CountFit], list[Diagnostic]]:
    """Compare simulated flows with the counts of a scenario, if it has any."""
    if not prepared.has_counts:
        return [], []
    first_s, end_s = prepared.timing.first_ms / 1000.0, prepared.timing.end_ms / 1000.0
    fits = count_fits(scenario.traffic, prepared.folder / sumo_folder.DRIVEN_ROUTES_FILE, first_s, end_s)
    return fits, missed_count_warnings(fits, (end_s - first_s) / 3600.0, sumo_folder.traffic_location(scenario))


def _planned_stops(prepared: SimulationFolder) -> set[str]:
    """Return the vehicles of a user's demand that have a ``<stop>``."""
    if prepared.is_generated:
        return set()
    return {stop.get("id", "") for stop in xml.iter_elements(prepared.folder / sumo_folder.STOPS_FILE, "stops")}
