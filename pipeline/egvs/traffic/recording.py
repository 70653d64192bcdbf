"""FCD of a scenario from whichever source it names: simulated, finished, live over TraCI.

Records the rows of floating car data from a SUMO that is already running, over TraCI.

Steps: check that its clock fits the scenario's; subscribe to everybody on the road; step it through the recording, and
give the rows of each frame as SUMO's own FCD file would have them. World frame and units as in SUMO; times are whole
milliseconds.

Adds up how the boxes of a recording behave: how many there are, how fast, who stands, who overlaps.

World frame, metres, metres per second. Vehicles that stand are followed from group to group.

Gets the rows of floating car data of a scenario's traffic, from whichever source it names.

The three sources: SUMO as a subprocess, which writes its FCD file into the run's folder; a SUMO that is already
running; a finished file, of which nothing is promised.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import pyarrow as pa

from egvs.core.errors import Diagnostic, InputError, RunError
from egvs.core.grid import Roi
from egvs.core.runtime import ProgressCallback
from egvs.formats import xml
from egvs.formats.georeference import Georeference
from egvs.scenario.model import Scenario
from egvs.traffic import demand, fcd, finished_fcd, network, sumo, sumo_folder
from egvs.traffic.demand import CountFit
from egvs.traffic.fcd import FrameWindow
from egvs.traffic.finished_fcd import kind_sizes
from egvs.traffic.sumo import query_size
from egvs.traffic.sumo_folder import (
    COLLISIONS_FILE,
    CONFIG_FILE,
    DRIVEN_ROUTES_FILE,
    FCD_DIGITS,
    FCD_FILE,
    LOG_FILE,
    PERSONS_FILE,
    STATISTICS_FILE,
    STOPS_FILE,
    SimulationFolder,
    Timing,
    as_flags,
)
from egvs.traffic.vehicle_boxes import TrafficHook, VehicleSize


@dataclass
class TraciObservations:
    """What :func:`record_live` learns beside the rows.

    Attributes
    ----------
    sizes
        Of the types of everybody who was there, asked for when first needed.
    collided
        Pairs that collided while frames were recorded.
    stopped_on_purpose
        Vehicles that stand at the end because they are told to.
    """

    sizes: dict[str, VehicleSize] = field(default_factory=dict)
    collided: set[tuple[str, str]] = field(default_factory=set)
    stopped_on_purpose: set[str] = field(default_factory=set)


def record_live(
    connection: Any, when: Timing, observations: TraciObservations, address: str, *, persons: bool = False
) -> Iterator[pa.Table]:
    """Step a running SUMO through the recording, and give its rows as its FCD file would have them.

    After a step, TraCI's clock is one step ahead of the state that it shows: what SUMO's FCD calls time t is seen at
    t + step.
    """
    _check_clock(connection, when, address)
    watched = _Subscriptions(connection, observations.sizes, persons)
    while (shown_ms := round(connection.simulation.getTime() * 1000)) < when.end_ms:
        connection.simulationStep()
        watched.follow()
        if shown_ms < when.first_ms:
            continue
        observations.collided |= {(c.collider, c.victim) for c in connection.simulation.getCollisions()}
        if (shown_ms - when.first_ms) % when.period_ms == 0 and (rows := watched.rows()):
            if shown_ms + when.step_ms >= when.end_ms:
                stopped = {name for name in watched.vehicles() if connection.vehicle.isStopped(name)}
                observations.stopped_on_purpose |= stopped
            yield _rows_to_table(shown_ms, rows)


def _check_clock(connection: Any, when: Timing, address: str) -> None:
    step = round(connection.simulation.getDeltaT() * 1000)
    if step != when.step_ms:
        right = f"traffic.step_s = {when.step_ms / 1000:g}"
        raise InputError(f"--traci {address}", f"that SUMO's step is {step / 1000:g} s", right)
    now, first = round(connection.simulation.getTime() * 1000), f"the first frame at {when.first_ms / 1000:g} s"
    if now > when.first_ms:
        raise RunError(
            f"--traci {address}: that SUMO is at {now / 1000:g} s already, after {first}; start it anew, or set a"
            " longer traffic.warmup_s"
        )
    if (when.first_ms - now) % when.step_ms:
        steps = f"from {now / 1000:g} s, steps of {step / 1000:g} s"
        raise RunError(f"--traci {address}: {steps} do not meet {first}")


class _Subscriptions:
    """Subscriptions to every vehicle on the road, and to every person where these are wanted."""

    def __init__(self, connection: Any, sizes: dict[str, VehicleSize], persons: bool) -> None:
        tc = sumo.traci_constants()
        self._connection, self._sizes = connection, sizes
        self._variables = (tc.VAR_POSITION3D, tc.VAR_ANGLE, tc.VAR_SLOPE, tc.VAR_SPEED, tc.VAR_TYPE)
        self._invalid = tc.INVALID_DOUBLE_VALUE
        for name in connection.vehicle.getIDList():
            connection.vehicle.subscribe(name, self._variables)
        connection.simulation.subscribe((tc.VAR_DEPARTED_VEHICLES_IDS,))
        self._departed = tc.VAR_DEPARTED_VEHICLES_IDS
        self._persons: set[str] | None = set() if persons else None

    def follow(self) -> None:
        """Subscribe to the vehicles that departed in this step, and to persons who are new."""
        for name in self._connection.simulation.getSubscriptionResults()[self._departed]:
            self._connection.vehicle.subscribe(name, self._variables)
        if self._persons is not None:
            there = set(self._connection.person.getIDList())
            for name in sorted(there - self._persons):
                self._connection.person.subscribe(name, self._variables)
            self._persons = there

    def vehicles(self) -> list[str]:
        """The names of all vehicles on the road."""
        position = self._variables[0]
        results = self._connection.vehicle.getAllSubscriptionResults()
        return [name for name, values in results.items() if values[position][0] != self._invalid]

    def rows(self) -> list[tuple[str, str, list[float]]]:
        """(id, type, [x, y, z, angle, slope, speed]) of everybody, rounded as SUMO rounds in its files."""
        rows = list(self._rows(self._connection.vehicle))
        if self._persons is not None:  # people stand upright, see fcd.read
            persons = self._rows(self._connection.person)
            rows += [(name, vtype, [*n[:4], 0.0, n[5]]) for name, vtype, n in persons]
        return rows

    def _rows(self, domain: Any) -> Iterator[tuple[str, str, list[float]]]:
        position, angle, slope, speed, vtype = self._variables
        for name, values in domain.getAllSubscriptionResults().items():
            if values[position][0] == self._invalid:
                continue  # between two places of a teleport
            if values[vtype] not in self._sizes:
                self._sizes[values[vtype]] = query_size(self._connection, values[vtype])
            numbers = (*values[position], values[angle], values[slope], values[speed])
            yield name, values[vtype], [float(f"{n:.{FCD_DIGITS}f}") for n in numbers]


def _rows_to_table(time_ms: int, rows: list[tuple[str, str, list[float]]]) -> pa.Table:
    names, types, numbers = zip(*rows, strict=True)
    columns = np.array(numbers).T
    return pa.table([np.full(len(rows), time_ms), pa.array(names), pa.array(types), *columns], schema=fcd.FCD_SCHEMA)


def describe_distance(at_m: tuple[float, float], roi: Roi) -> str:
    """How far from the region of interest a place lies, in words."""
    low, size = roi.origin_m, roi.size_m
    off_m = math.hypot(*(max(low[i] - at_m[i], at_m[i] - low[i] - size[i], 0.0) for i in (0, 1)))
    return f"{off_m:.0f} m from the region of interest" if off_m else "in the region of interest"


_MIN_PATIENCE_S = 180.0
_MAX_WAITING_SHARE = 0.02
_ROOTS = {
    COLLISIONS_FILE: "collisions",
    STOPS_FILE: "stops",
    STATISTICS_FILE: "statistics",
    DRIVEN_ROUTES_FILE: "routes",
}


@dataclass(frozen=True)
class RecordingSummary:
    """What SUMO did: ``flags`` and ``sumo_seconds`` are None of one that somebody else started."""

    sumo: str
    sumo_seconds: float | None
    flags: list[str] | None
    collisions: int
    notes: list[str] = field(default_factory=list)
    counts: list[CountFit] = field(default_factory=list)
    """Counted against simulated, in the order of the scenario."""
    warnings: list[Diagnostic] = field(default_factory=list)


@dataclass(frozen=True)
class Recording:
    """Rows of FCD as they arrive, and what is known about them.

    Attributes
    ----------
    rows, persons
        Vehicles, and the persons that are recorded beside them; None where they are among the vehicles, or not wanted.
    sizes
        Of each type; of a running SUMO filled as rows come.
    patience_s
        How long a vehicle may stand through to the last frame; None where nothing is promised.
    vehicles
        How many are to be in each frame; None where nothing is promised.
    stopped_on_purpose
        Vehicles that may stand longer; of a running SUMO filled as rows come.
    summary
        To be asked for when the rows are through; None of a finished file.
    source
        For messages about rows: the finished file, or the files that SUMO ran; empty of a running SUMO.
    """

    rows: Iterable[pa.Table]
    window: FrameWindow
    sizes: Mapping[str, VehicleSize]
    where: str
    patience_s: float | None = None
    vehicles: int | None = None
    stopped_on_purpose: Set[str] = frozenset()
    persons: Iterable[pa.Table] | None = None
    summary: Callable[[], RecordingSummary | None] = lambda: None
    source: str = ""


def record_traffic(
    scenario: Scenario,
    folder: Path,
    extensions: Sequence[TrafficHook],
    progress: ProgressCallback,
    traci: tuple[str, int] | None,
    world: Georeference,
) -> AbstractContextManager[Recording]:
    """The recording of a scenario's traffic; SUMO runs in ``folder``, or listens at ``traci`` already. A finished file
    may be in degrees, which ``world`` brings into the world frame.

    InputError when the scenario has a finished file that was to be recorded live, or an extension refuses it.
    """
    if scenario.traffic.fcd is not None and traci is not None:
        raise InputError("--traci", "the scenario names a finished FCD file", "network or sumocfg in [traffic]")
    for refusal in filter(None, (extension.refuses(scenario) for extension in extensions)):
        raise refusal
    if scenario.traffic.fcd is not None:
        return _record_finished(scenario, folder, world)
    if traci is not None:
        return _record_running(scenario, *traci, extensions)
    return _record_simulated(scenario, folder, progress, extensions)


@contextmanager
def _record_finished(scenario: Scenario, folder: Path, world: Georeference) -> Iterator[Recording]:
    """From a file; nothing is simulated, so nothing is promised about it."""
    name, place = scenario.traffic.fcd, sumo_folder.traffic_key(scenario)
    assert name is not None
    sumo_folder.copy_network(scenario, folder)
    when, held = finished_fcd.fcd_window(scenario)
    path, sizes = scenario.find(name, "traffic.fcd"), finished_fcd.sizes_of_types(scenario, held.types, held.sizes)
    rows = fcd.read_fcd(path)
    if held.metadata is None:
        rows = fcd.georeference_rows(rows, world, path, scenario.traffic.fcd_geo)
    yield Recording(rows, when, sizes, place, source=f"{place}.fcd = {name!r}")


@contextmanager
def _record_simulated(
    scenario: Scenario, folder: Path, progress: ProgressCallback, extensions: Sequence[TrafficHook]
) -> Iterator[Recording]:
    """From SUMO as a subprocess; its FCD file is removed once it is read."""
    prepared = sumo_folder.prepare_simulation(scenario, folder, extensions)
    with _translate_sumo_errors(prepared, scenario):
        sizes = kind_sizes(scenario.traffic.kinds) if prepared.drawn else type_sizes(prepared)
    for extension in extensions:
        sizes |= extension.sizes()
    path, persons = folder / FCD_FILE, folder / PERSONS_FILE
    try:
        with _translate_sumo_errors(prepared, scenario):
            seconds, flags = round(simulate(prepared, progress), 3), as_flags(prepared.options | prepared.outputs)
        crashes = _collisions(prepared)
        met, warnings = _compare_counts(scenario, prepared)
        warnings += [*_collision_warning(crashes, scenario), *_insertion_warning(prepared, scenario)]
        summary = RecordingSummary(sumo.sumo_version(), seconds, flags, len(crashes), prepared.notes, met, warnings)
        yield Recording(
            fcd.read_fcd(path) if _has_rows(path) else (),
            prepared.timing.window(),
            sizes,
            sumo_folder.traffic_key(scenario),
            max_standing_s(prepared.roads.cycle_s),
            prepared.vehicles,
            _planned_stops(prepared),
            None if not prepared.adds_traffic else (fcd.read_fcd(persons, "person") if _has_rows(persons) else ()),
            lambda: summary,
            f"{sumo_folder.traffic_key(scenario)} ({_user_file_names(prepared)})",
        )
    finally:
        for written in (path, persons, folder / DRIVEN_ROUTES_FILE, folder / STATISTICS_FILE):
            written.unlink(missing_ok=True)


@contextmanager
def _translate_sumo_errors(prepared: SimulationFolder, scenario: Scenario) -> Iterator[None]:
    """What SUMO refuses came from the scenario: an InputError that names the files."""
    try:
        yield
    except sumo.SumoInputError as error:
        right = "what SUMO runs without an error; it read copies of these files"
        raise InputError(
            sumo_folder.traffic_key(scenario), f"SUMO cannot run {_user_file_names(prepared)}: {error}", right
        ) from None


def _user_file_names(prepared: SimulationFolder) -> str:
    return ", ".join(path.name for path in prepared.given)


@contextmanager
def _record_running(scenario: Scenario, host: str, port: int, extensions: Sequence[TrafficHook]) -> Iterator[Recording]:
    """From a SUMO that somebody else started."""
    given = sumo_folder.demand_files(scenario)
    when = sumo_folder.make_timing(scenario.traffic, given.begin_s, sumo_folder.traffic_key(scenario))
    net_file = given.files["net-file"][0]
    cycle_s = 0.0 if network.is_osm(net_file) else network.read_net_xml(net_file).cycle_s
    observations = TraciObservations()
    persons = any(extension.ADDS_TRAFFIC for extension in extensions)
    with sumo.connect_traci(host, port) as connection:
        version = sumo.parse_version(connection.getVersion()[1])
        yield Recording(
            record_live(connection, when, observations, f"{host}:{port}", persons=persons),
            when.window(),
            observations.sizes,
            sumo_folder.traffic_key(scenario),
            max_standing_s(cycle_s),
            scenario.traffic.vehicles,
            observations.stopped_on_purpose,
            summary=lambda: RecordingSummary(version, None, None, len(observations.collided)),
        )


def max_standing_s(cycle_s: float) -> float:
    """How long a vehicle may stand through to the last frame: two signal cycles, and not less than three minutes."""
    return max(_MIN_PATIENCE_S, 2.0 * cycle_s)


def simulate(prepared: SimulationFolder, progress: ProgressCallback) -> float:
    """Run SUMO in the folder; return the seconds that it took."""
    when, path = prepared.timing, prepared.folder / FCD_FILE

    def watch() -> None:
        if (now_ms := _last_time_ms(path)) is not None:
            done = (now_ms - when.first_ms) // when.period_ms
            progress("frames simulated", min(when.frames, max(0, done)), when.frames)

    start = perf_counter()
    flags = ["-c", CONFIG_FILE, *as_flags(prepared.outputs)]
    sumo.run_program("sumo", flags, prepared.folder, prepared.folder / LOG_FILE, watch)
    check_complete(prepared)
    return perf_counter() - start


def check_complete(prepared: SimulationFolder) -> None:
    """RunError where SUMO did not write a file to its end: on a full disk it ends without a word or an error."""
    folder, outputs = prepared.folder, prepared.outputs.values()
    for name in (
        name
        for name in (FCD_FILE, PERSONS_FILE, COLLISIONS_FILE, STOPS_FILE, STATISTICS_FILE, DRIVEN_ROUTES_FILE)
        if name in outputs
    ):
        if name in _ROOTS:
            sumo.check_xml_complete(folder / name, _ROOTS[name])
        else:
            sumo.check_table_complete(folder / name)
    last_ms = prepared.timing.end_ms - prepared.timing.step_ms
    if (
        STATISTICS_FILE in outputs
        and _vehicle_counts(prepared)["running"]
        and (_last_time_ms(folder / FCD_FILE) or 0) < last_ms
    ):
        raise sumo.truncated_file_error(folder / FCD_FILE)


def _last_time_ms(path: Path) -> int | None:
    """The time of the last whole row of a CSV that is being written."""
    if not path.is_file():
        return None
    lines = sumo.last_bytes(path).split(b"\n")
    try:
        return round(float(lines[-2].split(b";")[0]) * 1000) if len(lines) > 2 else None
    except ValueError:
        return None


def type_sizes(prepared: SimulationFolder) -> dict[str, VehicleSize]:
    """Sizes of all types of a user's demand; asked of SUMO, since its defaults depend on the vClass."""
    with sumo.serve_traci(["-c", CONFIG_FILE, "--route-steps", "0"], prepared.folder) as connection:
        return {name: sumo.query_size(connection, name) for name in connection.vehicletype.getIDList()}


@dataclass(frozen=True)
class Collision:
    """Where two vehicles collided first: the lane, and the point in the world frame; None where SUMO names none."""

    lane: str
    at_m: tuple[float, float] | None

    @property
    def location(self) -> str:
        """The junction or the edge."""
        lane = self.lane
        return f"junction {lane[1:].rsplit('_', 2)[0]}" if lane.startswith(":") else f"edge {lane.rpartition('_')[0]}"


def _collisions(prepared: SimulationFolder) -> dict[tuple[str, str], Collision]:
    """Pairs of vehicles that SUMO saw collide while frames were recorded, and where they did so first."""
    pairs: dict[tuple[str, str], Collision] = {}
    for c in xml.iter_elements(prepared.folder / COLLISIONS_FILE, "collisions"):
        if float(c.get("time", "0")) * 1000.0 >= prepared.timing.first_ms:
            x_m, y_m = [*map(float, c.get("colliderFront", "nan,nan").split(","))][:2]
            crash = Collision(c.get("lane", ""), (x_m, y_m) if math.isfinite(x_m + y_m) else None)
            pairs.setdefault((c.get("collider", ""), c.get("victim", "")), crash)
    return pairs


def _collision_warning(crashes: dict[tuple[str, str], Collision], scenario: Scenario) -> list[Diagnostic]:
    """A warning that vehicles collided, with the junctions and edges where most did, and how far these are."""
    if not crashes:
        return []
    places, at_m = Counter(crash.location for crash in crashes.values()), {c.location: c.at_m for c in crashes.values()}
    shown = ", ".join(
        f"{n} at {place}"
        + (f" ({describe_distance(spot_m, scenario.roi.box)})" if (spot_m := at_m[place]) is not None else "")
        for place, n in places.most_common(3)
    )
    pairs = f"{len(crashes)} pairs" if len(crashes) > 1 else "a pair"
    found = f"{pairs} of vehicles collided, and drove on through each other: {shown}"
    cure = "look at these places in sumo-gui: right of way, signals, how long the waiting room on a junction is"
    return [Diagnostic("collisions", sumo_folder.traffic_key(scenario), found, cure)]


def _insertion_warning(prepared: SimulationFolder, scenario: Scenario) -> list[Diagnostic]:
    """A warning that many vehicles of a demand could not start for want of room."""
    if prepared.vehicles is not None:
        return []
    vehicles = _vehicle_counts(prepared)
    loaded, waiting = vehicles["loaded"], vehicles["waiting"]
    if waiting <= _MAX_WAITING_SHARE * loaded:
        return []
    found = f"{waiting} of {loaded} vehicles could not start to the end: the streets where they start are full"
    return [Diagnostic("waiting", sumo_folder.traffic_key(scenario), found, "less demand there, or more lanes")]


def _vehicle_counts(prepared: SimulationFolder) -> dict[str, int]:
    """How many vehicles were loaded, run at the end, and wait to start."""
    (vehicles,) = (e for e in xml.iter_elements(prepared.folder / STATISTICS_FILE, "statistics") if e.tag == "vehicles")
    return {key: int(vehicles.get(key, "0")) for key in ("loaded", "running", "waiting")}


def _compare_counts(scenario: Scenario, prepared: SimulationFolder) -> tuple[list[CountFit], list[Diagnostic]]:
    """Counted against simulated, and what to know of it."""
    if not prepared.counted:
        return [], []
    first_s, end_s = prepared.timing.first_ms / 1000.0, prepared.timing.end_ms / 1000.0
    passed = demand.count_fits(scenario.traffic, prepared.folder / DRIVEN_ROUTES_FILE, first_s, end_s)
    return passed, demand.count_warnings(passed, (end_s - first_s) / 3600.0, sumo_folder.traffic_key(scenario))


def _planned_stops(prepared: SimulationFolder) -> set[str]:
    """Vehicles of a user's demand that stop where a ``<stop>`` tells them to."""
    if prepared.drawn:
        return set()
    return {s.get("id", "") for s in xml.iter_elements(prepared.folder / STOPS_FILE, "stops")}


def _has_rows(path: Path) -> bool:
    """Where nobody moved, SUMO writes no header, only a line's end."""
    return path.stat().st_size > 1
