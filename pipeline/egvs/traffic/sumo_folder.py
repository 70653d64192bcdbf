"""Prepare the folder that SUMO runs in.

Steps of :func:`prepare_simulation`: find the files that a scenario, or the SUMO configuration that it names, takes its
traffic from; check the times; copy the files; draw trips or sample routes if the scenario names none; add the route
files of extensions; write ``run.sumocfg``. The folder can be opened in sumo-gui.

World frame and units as in SUMO. Times are whole milliseconds, as SUMO counts, so that step, period and warm-up can be
compared exactly.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.wording import number_of
from egvs.scenario.model import Scenario
from egvs.scenario.traffic_config import TrafficConfig
from egvs.traffic import demand, departures, network, signal_plans, town_trips, user_files
from egvs.traffic.fcd import FrameWindow
from egvs.traffic.vehicle_boxes import TrafficHook

CONFIG_FILE, NETWORK_FILE, TRIPS_FILE, VTYPES_FILE = "run.sumocfg", "network.net.xml", "trips.rou.xml", "vtypes.add.xml"
FCD_FILE, COLLISIONS_FILE, STOPS_FILE, LOG_FILE = "fcd.csv", "collisions.xml", "stops.xml", "sumo.log"
STATISTICS_FILE, DRIVEN_ROUTES_FILE = "statistics.xml", "driven.rou.xml"
EXTRA_ROUTES_FILE, PERSONS_FILE = "others.rou.xml", "persons.csv"
_RESERVED_NAMES = frozenset({
    CONFIG_FILE, TRIPS_FILE, VTYPES_FILE, FCD_FILE, COLLISIONS_FILE, STOPS_FILE, LOG_FILE, EXTRA_ROUTES_FILE,
    PERSONS_FILE, STATISTICS_FILE, DRIVEN_ROUTES_FILE,
})  # fmt: skip

OSM_SIGNALS = (
    "--tls.guess-signals", "--tls.join", "--tls.default-type", "actuated", "--default.connection.cont-pos", "0",
)  # fmt: skip
"""Signals and right of way on a network made from OpenStreetMap.

Signals stay green while vehicles arrive, and vehicles give way at the stop line, not on the junction. Measured on a
town with 50 random vehicles for 1000 s: gridlock in two seeds of two with netconvert's defaults, in none with these.
"""

FCD_DIGITS = 8
"""Decimals of SUMO's outputs."""

_DRAWN_DEPART_DELAY_S = 120.0
"""More trips are drawn than fit; those that wait longer are dropped."""

RED_MARGIN_S = 15.0
"""After the longest red phase, the first vehicle at a stop line has this time to start."""

_FCD_ATTRIBUTES = "id,x,y,angle,type,speed"


@dataclass(frozen=True)
class Timing:
    """Begin of the simulation, first frame, frame period and step (milliseconds), and number of frames."""

    begin_ms: int
    first_ms: int
    period_ms: int
    step_ms: int
    frames: int

    @property
    def end_ms(self) -> int:
        """End of the simulation: the step after the last frame."""
        return self.first_ms + (self.frames - 1) * self.period_ms + self.step_ms

    @property
    def simulated_s(self) -> tuple[float, float]:
        """Begin and end of the simulation in seconds."""
        return self.begin_ms / 1000.0, self.end_ms / 1000.0

    def window(self) -> FrameWindow:
        """Return the recorded frames; SUMO records every one."""
        return FrameWindow(self.frames, self.period_ms, self.first_ms, complete=True)


def traffic_location(scenario: Scenario) -> str:
    """Return what messages about ``[traffic]`` refer to."""
    return f"{scenario.file}: traffic"


def to_milliseconds(value_s: float, where: str) -> int:
    """Convert seconds to milliseconds; InputError if they are not a whole number."""
    exact = value_s * 1000.0
    if abs(exact - round(exact)) > 1e-6 * max(1.0, exact):
        problem = "expected a whole number of milliseconds"
        raise InputError(f"{where} = {value_s:g}", problem, "Round it; SUMO counts in milliseconds.")
    return round(exact)


def make_timing(traffic: TrafficConfig, begin_s: float, where: str) -> Timing:
    """Return the times of a simulation.

    Parameters
    ----------
    traffic
        The traffic.
    begin_s
        Begin of the SUMO configuration, used where the scenario has none.
    where
        The traffic table, for messages.

    Raises
    ------
    InputError
        When frame period or warm-up are not whole numbers of steps. (SUMO warns only, and records wrong times.)
    """
    step_ms = to_milliseconds(traffic.step_s, f"{where}.step_s")
    period_ms = _whole_steps_ms(traffic.frame_period_s, step_ms, f"{where}.frame_period_s")
    warmup_ms = _whole_steps_ms(traffic.warmup_s, step_ms, f"{where}.warmup_s")
    begin_ms = to_milliseconds(begin_s if traffic.begin_s is None else traffic.begin_s, f"{where}: begin")
    assert traffic.frames is not None, "a simulation has an end"
    return Timing(begin_ms, begin_ms + warmup_ms, period_ms, step_ms, traffic.frames)


def _whole_steps_ms(value_s: float, step_ms: int, where: str) -> int:
    value_ms = to_milliseconds(value_s, where)
    if value_ms % step_ms:
        steps = value_ms // step_ms
        near = " or ".join(f"{n * step_ms / 1000:g}" for n in (steps, steps + 1) if n)
        problem = f"expected a multiple of the step of {step_ms / 1000:g} s"
        raise InputError(f"{where} = {value_ms / 1000:g}", problem, f"Use {near}, for example, or another step_s.")
    return value_ms


def demand_files(scenario: Scenario) -> user_files.DemandFiles:
    """Return the inputs of a scenario's simulation; InputError if a file is missing."""
    traffic = scenario.traffic
    if traffic.sumocfg is not None:
        inputs = user_files.read_sumocfg(scenario.find(traffic.sumocfg, "traffic.sumocfg"))
        network.check_is_no_map(inputs.files["net-file"][0])
        return inputs
    assert traffic.network is not None
    files: dict[str, tuple[Path, ...]] = {"net-file": (_find_network(scenario, traffic.network, "traffic.network"),)}
    if traffic.routes:
        files["route-files"] = tuple(scenario.find(name, "traffic.routes") for name in traffic.routes)
    return user_files.DemandFiles(files)


def network_path(scenario: Scenario) -> Path | None:
    """Return the network of a scenario, if any: that of the simulation, or ``traffic.roads`` of recorded
    traffic.
    """
    traffic = scenario.traffic
    if traffic.is_finished:
        return None if traffic.roads is None else _find_network(scenario, traffic.roads, "traffic.roads")
    if traffic.network is not None:
        return _find_network(scenario, traffic.network, "traffic.network")
    if traffic.sumocfg is None:
        return None
    return user_files.sumocfg_network_path(scenario.find(traffic.sumocfg, "traffic.sumocfg"))


def _find_network(scenario: Scenario, name: str, key: str) -> Path:
    path = scenario.find(name, key)
    network.check_is_no_map(path)
    return path


def read_network(scenario: Scenario) -> network.Network | None:
    """Read the network of a scenario, if any."""
    path = network_path(scenario)
    return None if path is None else network.read_net_xml(path)


def check_signal_plans(scenario: Scenario, path: Path) -> None:
    """Raise an InputError if a plan of a signal does not fit the network in a file."""
    signal_plans.planned_signals(scenario, path, network.read_net_xml(path))


def copy_network(scenario: Scenario, folder: Path) -> None:
    """Empty a folder, and copy the network of a scenario with recorded traffic to it, if there is one."""
    path = network_path(scenario)
    if path is None:
        return
    traffic = scenario.traffic
    assert traffic.is_finished, "a simulation needs prepare_simulation"
    inputs = [scenario.find(name, "traffic.vtypes") for name in traffic.vtypes]
    inputs += [scenario.find(name, "traffic.tracks") for name in traffic.tracks or ()]
    if traffic.fcd is not None:
        inputs.append(scenario.find(traffic.fcd, "traffic.fcd"))
    _make_empty(folder, [*inputs, path])
    user_files.copy_checked(path, folder / NETWORK_FILE)


def rescue_s(teleport_s: float | None, roads: network.Network) -> float | None:
    """Return after which time SUMO moves a standing vehicle on; None for never.

    This is ``traffic.teleport_s``, or longer if a signal is red for longer: SUMO moves vehicles at red signals as well.

    Parameters
    ----------
    teleport_s
        As in ``[traffic]``.
    roads
        The network.
    """
    if teleport_s is None or not roads.stop_lines:
        return teleport_s
    return max(teleport_s, roads.red_s + RED_MARGIN_S)


def may_have_slopes(scenario: Scenario) -> bool:
    """Whether the network of a scenario may have slopes, or a terrain gives some, without parsing it."""
    path = network_path(scenario)
    return scenario.statics.terrain is not None or (path is not None and network.may_have_slopes(path))


@dataclass(frozen=True)
class SimulationFolder:
    """A folder that SUMO can run in.

    Attributes
    ----------
    folder
        Its path.
    sources
        The user's files that were copied to it.
    options
        Options of SUMO.
    timing
        Times of the simulation.
    roads
        The network.
    vehicles
        Number of vehicles to maintain; None for a demand that is simulated as it is.
    is_generated
        Whether trips or routes were generated, rather than read from a user's files.
    has_counts
        Whether the traffic meets counts.
    has_fixed_count
        Whether each frame must have exactly ``vehicles``, so that a missing frame is noticed.
    has_extra_traffic
        Whether extensions added traffic.
    notes
        Remarks for the user.
    """

    folder: Path
    sources: tuple[Path, ...]
    options: dict[str, str]
    timing: Timing
    roads: network.Network
    vehicles: int | None
    is_generated: bool
    has_counts: bool
    has_fixed_count: bool
    has_extra_traffic: bool
    notes: list[str]

    @property
    def teleport_s(self) -> float | None:
        """Time after which SUMO moves a standing vehicle on; None for never."""
        limit_s = float(self.options["time-to-teleport"])
        return limit_s if limit_s > 0 else None

    @property
    def outputs(self) -> dict[str, str]:
        """Options for the outputs of SUMO that are needed."""
        options = {
            "fcd-output": FCD_FILE,
            "fcd-output.attributes": _FCD_ATTRIBUTES,
            "fcd-output.skip-empty": "true",
            "device.fcd.begin": _format_seconds(self.timing.first_ms),
            "device.fcd.period": _format_seconds(self.timing.period_ms),
            "precision": str(FCD_DIGITS),
            "collision-output": COLLISIONS_FILE,
        }
        if self.roads.has_heights:
            options["fcd-output.attributes"] += ",z,slope"
        if self.has_extra_traffic or not self.is_generated:  # without it, SUMO writes persons among the vehicles
            options["person-fcd-output"] = PERSONS_FILE
        # distinguishes an incomplete file from roads without vehicles
        if not self.has_fixed_count or self.options["time-to-teleport"] != "-1":
            options["statistic-output"] = STATISTICS_FILE
        if self.has_counts:
            options["vehroute-output"] = DRIVEN_ROUTES_FILE
            options |= {"vehroute-output.exit-times": "true", "vehroute-output.write-unfinished": "true"}
        if not self.is_generated:
            options |= {"stop-output": STOPS_FILE, "stop-output.write-unfinished": "true"}
        return options


def prepare_simulation(scenario: Scenario, folder: Path, extensions: Iterable[TrafficHook] = ()) -> SimulationFolder:
    """Prepare the folder of a simulation.

    Parameters
    ----------
    scenario
        The scenario.
    folder
        The folder; it is emptied first.
    extensions
        Add traffic.

    Returns
    -------
    SimulationFolder
        The folder, and what is needed to run SUMO in it.

    Raises
    ------
    InputError
        When an input is wrong.
    """
    traffic = scenario.traffic
    where = traffic_location(scenario)
    inputs = demand_files(scenario)
    timing = make_timing(traffic, inputs.begin_s, where)
    times_s = timing.simulated_s
    user_files.check_demand_size(inputs, *times_s)
    adding = [extension for extension in extensions if extension.ADDS_TRAFFIC]
    extra_files = [EXTRA_ROUTES_FILE.replace("others", f"others{number or ''}") for number in range(len(adding))]

    _make_empty(folder, inputs.all())
    copies, notes = _copy_files(inputs, folder, extra_files)
    if traffic.signals:
        _check_additional_programs(copies, folder, where)
        signal_plans.apply_plans(scenario, folder / copies["net-file"], inputs.files["net-file"][0])
    roads = network.read_net_xml(folder / copies["net-file"], inputs.files["net-file"][0])
    demand_seed, sumo_seed, *extra_seeds = np.random.SeedSequence(scenario.seed).spawn(2 + len(adding))

    if traffic.redraw_departures:
        notes += _redraw_departures(copies, folder, np.random.default_rng(demand_seed))
    is_generated = not traffic.has_user_demand
    vehicles = traffic.vehicles
    depart_delay_s = traffic.max_depart_delay_s
    if is_generated:
        demand.check_kinds(traffic.kinds, where)
        files.write_text(folder / VTYPES_FILE, demand.vtypes_xml(traffic.kinds))
        copies |= {"additional-files": VTYPES_FILE, "route-files": TRIPS_FILE}
        if traffic.counts:
            demand.write_routes(traffic, roads, times_s, demand_seed, folder / TRIPS_FILE, where)
        else:
            notes += _write_trips(scenario, roads, timing, np.random.default_rng(demand_seed), folder)
            if traffic.vehicles_per_h is None:
                vehicles = demand.target_vehicle_count(traffic, roads)
                depart_delay_s = depart_delay_s or _DRAWN_DEPART_DELAY_S

    extra_vehicles = 0
    for extension, name, seed in zip(adding, extra_files, extra_seeds, strict=True):
        extra = extension.plan(scenario, roads, *times_s, np.random.default_rng(seed))
        files.write_text(folder / name, extra.xml)
        copies["route-files"] = ",".join(filter(None, (copies.get("route-files"), name)))
        extra_vehicles += extra.vehicles
        notes += extra.notes

    seed_number = int(sumo_seed.generate_state(1)[0]) & 0x7FFFFFFF
    teleport_s = rescue_s(traffic.teleport_s, roads)
    if teleport_s != traffic.teleport_s:
        notes.append(
            f"teleport_s: vehicles are moved on after {teleport_s:g} s, because a signal is red for {roads.red_s:g} s"
        )
    options = inputs.options | copies | _scenario_options(traffic, timing, seed_number, teleport_s)
    if vehicles is not None:
        options["max-num-vehicles"] = str(vehicles + extra_vehicles)
    if depart_delay_s:
        options["max-depart-delay"] = f"{depart_delay_s:g}"
    lines = [f"    <{key} value={quoteattr(value)}/>" for key, value in options.items()]
    files.write_text(folder / CONFIG_FILE, "\n".join(["<configuration>", *lines, "</configuration>", ""]))
    has_fixed_count = vehicles is not None and traffic.hold == "exactly"
    return SimulationFolder(
        folder, tuple(inputs.all()), options, timing, roads, vehicles, is_generated, bool(traffic.counts),
        has_fixed_count, bool(adding), notes,
    )  # fmt: skip


def _check_additional_programs(copies: Mapping[str, str], folder: Path, where: str) -> None:
    """Raise an InputError if a user's additional file has signal programs, which SUMO would prefer."""
    for name in filter(None, copies.get("additional-files", "").split(",")):
        if b"<tlLogic" in (folder / name).read_bytes():
            problem = f"{name} of the SUMO configuration also contains signal programs (<tlLogic>)"
            raise InputError(f"{where}.signals", problem, "Remove them there, or remove signals.")


def _redraw_departures(copies: Mapping[str, str], folder: Path, rng: np.random.Generator) -> list[str]:
    """Redraw the departures in the copies of demand files; return notes for the user."""
    counts = departures.DepartureCounts()
    for option in user_files.DEMAND_OPTIONS:
        for name in filter(None, copies.get(option, "").split(",")):
            counts += departures.redraw_departures(folder / name, rng)
    total = counts.redrawn + counts.fixed
    return [f"departures of {counts.redrawn} of {total} vehicles and flows are redrawn"]


def _make_empty(folder: Path, inputs: Iterable[Path]) -> None:
    """Make a new, empty folder, so that an earlier run, or a SUMO that still runs, cannot affect this one."""
    for path in inputs:
        if path.resolve().is_relative_to(folder.resolve()):
            hint = "Use another --out, or move the file."
            raise InputError(path, "an input file is in a folder that egvs empties for SUMO", hint)
    files.remove_folder(folder)
    folder.mkdir(parents=True)


def _scenario_options(traffic: TrafficConfig, timing: Timing, seed: int, teleport_s: float | None) -> dict[str, str]:
    """Return the options that the scenario sets, whatever a user's configuration says."""
    options = {
        "seed": str(seed),
        "begin": _format_seconds(timing.begin_ms),
        "end": _format_seconds(timing.end_ms),
        "step-length": _format_seconds(timing.step_ms),
        "threads": "1",
        "lateral-resolution": f"{traffic.lateral_resolution_m:g}",
        "time-to-teleport": "-1" if teleport_s is None else f"{teleport_s:g}",
        "collision.action": "warn",
        "collision.check-junctions": "true",
        "no-step-log": "true",
        "duration-log.disable": "true",
    }
    if traffic.junction_blocker_s is not None:
        options["ignore-junction-blocker"] = f"{traffic.junction_blocker_s:g}"
    if traffic.reroute_at_departure:
        options |= demand.REROUTE_OPTIONS
    return options


def _format_seconds(time_ms: int) -> str:
    return f"{time_ms // 1000}.{time_ms % 1000:03d}"


def as_flags(options: Mapping[str, str]) -> list[str]:
    """Return options as arguments of a command line."""
    return [word for key, value in options.items() for word in (f"--{key}", value)]


def _write_trips(
    scenario: Scenario, roads: network.Network, timing: Timing, rng: np.random.Generator, folder: Path
) -> list[str]:
    """Write random trips; return notes for the user."""
    traffic = scenario.traffic
    where = traffic_location(scenario)
    if traffic.vehicles_per_h is not None:
        return _write_flow(traffic, roads, timing, rng, folder, where)
    pairs = [demand.origin_destination_pairs(roads, kind, traffic, rng, where) for kind in traffic.kinds]
    departs_s = _departures(timing, traffic.trips_per_s)
    trips = demand.draw_trips(roads, traffic.kinds, pairs, departs_s, rng)
    files.write_text(folder / TRIPS_FILE, demand.trips_xml(trips, departs_s))
    return [
        f"{kind.name}: no trip between fringe edges; trips join any two edges that are far apart"
        for kind, kind_pairs in zip(traffic.kinds, pairs, strict=True)
        if not kind_pairs.fringe
    ]


def _departures(timing: Timing, trips_per_s: float) -> FloatArray:
    """Return departures at regular intervals, in seconds."""
    count = int(np.ceil((timing.end_ms - timing.begin_ms) / 1000.0 * trips_per_s))
    return timing.begin_ms / 1000.0 + np.arange(count) / trips_per_s


def _write_flow(
    traffic: TrafficConfig, roads: network.Network, timing: Timing, rng: np.random.Generator, folder: Path, where: str
) -> list[str]:
    """Write the routes of random trips through a town; return notes for the user."""
    assert traffic.vehicles_per_h is not None
    departs_s = _departures(timing, traffic.vehicles_per_h / 3600.0)
    ends = [town_trips.trip_ends(roads, kind, traffic, where) for kind in traffic.kinds]
    trips = town_trips.draw_town_trips(roads, traffic, ends, departs_s.size, rng, where)
    routed = demand.route_trips(trips, folder, NETWORK_FILE, VTYPES_FILE)
    files.write_text(folder / TRIPS_FILE, demand.routes_xml(routed, departs_s))
    if len(routed) == len(trips):
        return []
    return [f"{len(trips) - len(routed)} of {number_of(len(trips), 'trip')} without route left out"]


def _copy_files(
    inputs: user_files.DemandFiles, folder: Path, extra_files: Iterable[str]
) -> tuple[dict[str, str], list[str]]:
    """Copy the input files; return the names of the copies by option, and notes for the user."""
    used = {*_RESERVED_NAMES, *extra_files}
    copies, notes = {}, []
    for option, paths in inputs.files.items():
        names = []
        for path in paths:
            name = NETWORK_FILE if option == "net-file" else user_files.safe_name(path.name)
            while name in used:
                name = f"_{name}"
            used.add(name)
            names.append(name)
            notes += user_files.copy_checked(path, folder / name)
        copies[option] = ",".join(names)
    return copies, notes
