"""Lays out the folder that SUMO runs in.

Steps: find the files that a scenario, or the SUMO configuration that it names, takes its traffic from; check its times;
copy the files, draw trips where none are given, add the route files of extensions, and write ``run.sumocfg``. The
folder opens in sumo-gui.

World frame and units as in SUMO; times are whole milliseconds, SUMO's own unit, so that step, period and warm-up are
compared exactly.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from egvs.core import files
from egvs.core.errors import InputError
from egvs.formats import osm
from egvs.scenario.model import Scenario
from egvs.scenario.traffic_config import TrafficConfig
from egvs.traffic import demand, network, sumo, user_files
from egvs.traffic.fcd import FrameWindow
from egvs.traffic.user_files import DemandFiles
from egvs.traffic.vehicle_boxes import TrafficHook

CONFIG_FILE, NETWORK_FILE, TRIPS_FILE, VTYPES_FILE = "run.sumocfg", "network.net.xml", "trips.rou.xml", "vtypes.add.xml"
FCD_FILE, COLLISIONS_FILE, STOPS_FILE, LOG_FILE = "fcd.csv", "collisions.xml", "stops.xml", "sumo.log"
STATISTICS_FILE, DRIVEN_ROUTES_FILE = "statistics.xml", "driven.rou.xml"
"""What SUMO adds up itself where nothing is held; who left which edge when, where vehicles were counted."""
EXTRA_ROUTES_FILE, PERSONS_FILE, MAP_FILE = "others.rou.xml", "persons.csv", "map.osm.xml"
"""Route file of an extension (those of further ones count up), and what SUMO records of persons."""

OSM_SIGNALS = (
    "--tls.guess-signals", "--tls.join", "--tls.default-type", "actuated", "--default.connection.cont-pos", "0",
)  # fmt: skip
"""Signals and right of way on a network made from OpenStreetMap.

Signals stay green while vehicles come; who has to give way waits at the stop line, not on the junction. Measured on a
town with 50 drawn vehicles, 1000 s: with netconvert's fixed programs gridlock in two seeds of two, with these none.
"""

_OSM_FLAGS = ("--geometry.remove", "--junctions.join", *OSM_SIGNALS, "--sidewalks.guess", "--crossings.guess")
FCD_DIGITS = 8
"""Decimals that SUMO writes."""

_DRAWN_DEPART_DELAY_S = 120.0
"""More trips are drawn than start, so that those of long ago make room."""

_ATTRIBUTES = "id,x,y,angle,type,speed"


@dataclass(frozen=True)
class Timing:
    """When frames are recorded, in whole milliseconds from the simulation's zero."""

    begin_ms: int
    first_ms: int
    period_ms: int
    step_ms: int
    frames: int

    @property
    def end_ms(self) -> int:
        """The simulation ends when the last frame is recorded."""
        return self.first_ms + (self.frames - 1) * self.period_ms + self.step_ms

    def window(self) -> FrameWindow:
        """Every step of this time is recorded."""
        return FrameWindow(self.frames, self.period_ms, self.first_ms, complete=True)


def traffic_key(scenario: Scenario) -> str:
    """Where messages about the traffic point to."""
    return f"{scenario.file}: traffic"


def to_milliseconds(value_s: float, where: str) -> int:
    """Seconds as whole milliseconds."""
    exact = value_s * 1000.0
    if abs(exact - round(exact)) > 1e-6 * max(1.0, exact):
        raise InputError(f"{where} = {value_s:g}", "is no whole number of milliseconds", "SUMO counts in milliseconds")
    return round(exact)


def make_timing(traffic: TrafficConfig, begin_s: float, where: str) -> Timing:
    """The times; period and warm-up are whole numbers of steps (SUMO itself only warns, and records wrong times).

    ``begin_s`` is the configuration's, for a scenario without its own.
    """
    step = to_milliseconds(traffic.step_s, f"{where}.step_s")
    if step < 1:
        raise InputError(f"{where}.step_s = {traffic.step_s:g}", "is below a millisecond", "at least 0.001")
    values = []
    for key in ("frame_period_s", "warmup_s"):
        value = to_milliseconds(getattr(traffic, key), f"{where}.{key}")
        if value % step:
            near = " or ".join(f"{n * step / 1000:g}" for n in (value // step, value // step + 1) if n)
            what, right = f"is no whole number of steps of {step / 1000:g} s", f"for example {near}, or another step_s"
            raise InputError(f"{where}.{key} = {value / 1000:g}", what, right)
        values.append(value)
    begin = to_milliseconds(begin_s if traffic.begin_s is None else traffic.begin_s, f"{where}: begin")
    assert traffic.frames is not None, "what is simulated has an end"
    return Timing(begin, begin + values[1], values[0], step, traffic.frames)


def demand_files(scenario: Scenario) -> DemandFiles:
    """The files that a simulation reads; InputError when the scenario, or its configuration, names a missing one."""
    traffic = scenario.traffic
    if traffic.sumocfg is not None:
        return user_files.read_sumocfg(scenario.find(traffic.sumocfg, "traffic.sumocfg"))
    assert traffic.network is not None
    files: dict[str, tuple[Path, ...]] = {"net-file": (scenario.find(traffic.network, "traffic.network"),)}
    if traffic.routes:
        files["route-files"] = tuple(scenario.find(name, "traffic.routes") for name in traffic.routes)
    return DemandFiles(files)


def network_path(scenario: Scenario) -> Path | None:
    """The network that a scenario or its configuration simulates, or the roads that it names beside a finished file;
    None where it names none."""
    traffic = scenario.traffic
    if traffic.fcd is not None:
        return None if traffic.roads is None else scenario.find(traffic.roads, "traffic.roads")
    if traffic.network is not None:
        return scenario.find(traffic.network, "traffic.network")
    if traffic.sumocfg is None:
        return None
    return user_files.sumocfg_network_path(scenario.find(traffic.sumocfg, "traffic.sumocfg"))


def read_network(scenario: Scenario) -> network.Network | None:
    """The network of :func:`network_path`, a map of OpenStreetMap converted first.

    InputError when the scenario, its configuration or its network is wrong.
    """
    path = network_path(scenario)
    if path is None or not network.is_osm(path):
        return None if path is None else network.read_net_xml(path)
    with files.temporary_folder() as folder:
        convert_osm(path, folder / NETWORK_FILE)
        return network.read_net_xml(folder / NETWORK_FILE, path)


def copy_network(scenario: Scenario, folder: Path) -> None:
    """A fresh folder with a copy of the roads that a scenario names beside a finished file, if it does."""
    if (path := network_path(scenario)) is None:
        return
    assert scenario.traffic.fcd is not None, "what is simulated is laid out otherwise"
    own = [scenario.find(scenario.traffic.fcd, "traffic.fcd"), path]
    _make_empty(folder, [*own, *(scenario.find(name, "traffic.vtypes") for name in scenario.traffic.vtypes)])
    if network.is_osm(path):
        convert_osm(path, folder / NETWORK_FILE)
    else:
        user_files.copy_checked(path, folder / NETWORK_FILE)


def may_have_heights(scenario: Scenario) -> bool:
    """Whether the network may go up and down: a quick look, so that for a flat one nothing more is read or imported."""
    path = network_path(scenario)
    return path is not None and network.may_have_heights(path)


@dataclass(frozen=True)
class SimulationFolder:
    """A folder that SUMO can run in."""

    folder: Path
    given: tuple[Path, ...]
    """The user's files of which it holds copies."""
    options: dict[str, str]
    timing: Timing
    roads: network.Network
    vehicles: int | None
    """How many are to be held in the network; None where the demand is taken as it is."""
    drawn: bool
    """Whether the traffic is made here, of drawn trips or counts, and is not a user's."""
    counted: bool
    """Whether it follows counts."""
    exactly: bool
    """Whether each recorded frame must have that many, so that one that is missing is noticed."""
    adds_traffic: bool
    """Whether extensions added traffic to it."""
    notes: list[str]

    @property
    def outputs(self) -> dict[str, str]:
        """What this program has SUMO write."""
        wanted = {
            "fcd-output": FCD_FILE,
            "fcd-output.attributes": _ATTRIBUTES + (",z,slope" if self.roads.has_heights else ""),
            "fcd-output.skip-empty": "true",
            "device.fcd.begin": _format_seconds(self.timing.first_ms),
            "device.fcd.period": _format_seconds(self.timing.period_ms),
            "precision": str(FCD_DIGITS),
            "collision-output": COLLISIONS_FILE,
        }
        if self.adds_traffic or not self.drawn:  # else SUMO writes a user's persons among the vehicles
            wanted |= {"person-fcd-output": PERSONS_FILE}
        if not self.exactly:  # else nothing would tell a file that ends too early from roads that got empty
            wanted |= {"statistic-output": STATISTICS_FILE}
        if self.counted:
            wanted |= {"vehroute-output": DRIVEN_ROUTES_FILE, "vehroute-output.exit-times": "true",
                       "vehroute-output.write-unfinished": "true"}  # fmt: skip
        return wanted if self.drawn else wanted | {"stop-output": STOPS_FILE, "stop-output.write-unfinished": "true"}


def prepare_simulation(scenario: Scenario, folder: Path, extensions: Iterable[TrafficHook] = ()) -> SimulationFolder:
    """Lay out the folder, with the traffic that ``extensions`` add."""
    traffic, place = scenario.traffic, traffic_key(scenario)
    given = demand_files(scenario)
    when = make_timing(traffic, given.begin_s, place)
    adding = [extension for extension in extensions if extension.ADDS_TRAFFIC]
    others = [EXTRA_ROUTES_FILE.replace("others", f"others{number or ''}") for number in range(len(adding))]
    _make_empty(folder, given.all())
    named, left_out = _copy_files(given, folder, others)
    roads = network.read_net_xml(folder / named["net-file"], given.files["net-file"][0])
    demand_seed, sumo_seed, *other_seeds = np.random.SeedSequence(scenario.seed).spawn(2 + len(adding))
    drawn, notes = traffic.sumocfg is None and not traffic.routes, []
    vehicles, times = traffic.vehicles, (when.begin_ms / 1000.0, when.end_ms / 1000.0)
    if drawn:
        demand.check_kinds(traffic.kinds, sumo.vehicle_classes(), place)
        files.write_text(folder / VTYPES_FILE, demand.vtypes_xml(traffic.kinds))
        named |= {"additional-files": VTYPES_FILE, "route-files": TRIPS_FILE}
        if traffic.counts:
            demand.write_routes(traffic, roads, times, demand_seed, folder / TRIPS_FILE, place)
        else:
            notes = _write_trips(scenario, roads, when, np.random.default_rng(demand_seed), folder)
            vehicles = demand.target_vehicle_count(traffic, roads)
    others_at_most = 0
    for extension, name, seed in zip(adding, others, other_seeds, strict=True):
        plan = extension.plan(scenario, roads, *times, np.random.default_rng(seed))
        files.write_text(folder / name, plan.xml)
        named["route-files"] = ",".join(filter(None, (named.get("route-files"), name)))
        others_at_most, notes = others_at_most + plan.vehicles, [*notes, *plan.notes]
    number = int(sumo_seed.generate_state(1)[0]) & 0x7FFFFFFF
    options = given.options | named | _scenario_options(traffic, when, number)
    if vehicles is not None:
        options["max-num-vehicles"] = str(vehicles + others_at_most)
    if delay_s := traffic.max_depart_delay_s or (_DRAWN_DEPART_DELAY_S if drawn and not traffic.counts else None):
        options["max-depart-delay"] = f"{delay_s:g}"
    files.write_text(folder / CONFIG_FILE, _config_xml(options))
    exactly, notes = vehicles is not None and traffic.hold == "exactly", left_out + notes
    return SimulationFolder(
        folder, tuple(given.all()), options, when, roads, vehicles, drawn, bool(traffic.counts), exactly, bool(adding),
        notes,
    )  # fmt: skip


def _make_empty(folder: Path, given: Iterable[Path]) -> None:
    """An empty folder, so that nothing of an earlier run, nor a SUMO that still writes, gets into this one."""
    for path in given:
        if path.resolve().is_relative_to(folder.resolve()):
            what = "lies in the folder that is made anew for SUMO"
            raise InputError(path, what, "another --out, or the file elsewhere")
    if folder.is_symlink():
        folder.unlink()
    elif folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)


def _scenario_options(traffic: TrafficConfig, when: Timing, seed: int) -> dict[str, str]:
    """What the scenario decides, whatever a user's configuration says; see the traps of SUMO behind each."""
    return {
        "seed": str(seed),
        "begin": _format_seconds(when.begin_ms),
        "end": _format_seconds(when.end_ms),
        "step-length": _format_seconds(when.step_ms),
        "threads": "1",
        "lateral-resolution": f"{traffic.lateral_resolution_m:g}",
        "time-to-teleport": "-1",
        "collision.action": "warn",
        "collision.check-junctions": "true",
        "no-step-log": "true",
        "duration-log.disable": "true",
    }


def _format_seconds(time_ms: int) -> str:
    return f"{time_ms // 1000}.{time_ms % 1000:03d}"


def as_flags(options: Mapping[str, str]) -> list[str]:
    """Options as one would type them."""
    return [word for key, value in options.items() for word in (f"--{key}", value)]


def _write_trips(
    scenario: Scenario, roads: network.Network, when: Timing, rng: np.random.Generator, folder: Path
) -> list[str]:
    """Write drawn trips; what the user should know of them."""
    traffic, place = scenario.traffic, traffic_key(scenario)
    pairs = [demand.origin_destination_pairs(roads, kind, traffic, rng, place) for kind in traffic.kinds]
    count = int(np.ceil((when.end_ms - when.begin_ms) / 1000.0 * traffic.trips_per_s))
    departs_s = when.begin_ms / 1000.0 + np.arange(count) / traffic.trips_per_s
    trips = demand.draw_trips(roads, traffic.kinds, pairs, departs_s, rng)
    files.write_text(folder / TRIPS_FILE, demand.trips_xml(trips, departs_s))
    return [
        f"{kind.name}: no trip between fringe edges; trips join any two edges that are far apart"
        for kind, kind_pairs in zip(traffic.kinds, pairs, strict=True)
        if not kind_pairs.fringe
    ]


def _copy_files(given: DemandFiles, folder: Path, others: Iterable[str]) -> tuple[dict[str, str], list[str]]:
    """Copy every file into the folder, so that it can be moved and opened elsewhere; ``others`` are taken names.

    The copies' names by option, and what was left out of them.
    """
    taken = {
        CONFIG_FILE,
        TRIPS_FILE,
        VTYPES_FILE,
        FCD_FILE,
        COLLISIONS_FILE,
        STOPS_FILE,
        LOG_FILE,
        EXTRA_ROUTES_FILE,
        PERSONS_FILE,
        MAP_FILE,
        STATISTICS_FILE,
        DRIVEN_ROUTES_FILE,
        *others,
    }
    values, notes = {}, []
    for option, paths in given.files.items():
        names = []
        for path in paths:
            name = NETWORK_FILE if option == "net-file" else user_files.safe_name(path.name)
            while name in taken:
                name = f"_{name}"
            taken.add(name)
            if option == "net-file" and network.is_osm(path):
                convert_osm(path, folder / name)
            else:
                notes += user_files.copy_checked(path, folder / name)
            names.append(name)
        values[option] = ",".join(names)
    return values, notes


def convert_osm(path: Path, network_path: Path) -> None:
    """Turn a map of OpenStreetMap into a network; its world frame starts at the network's south-west corner."""
    content = _convert_osm_once(path, files.hash_file(path))
    with files.attach_filename(network_path):
        network_path.write_bytes(content)


@lru_cache(maxsize=1)
def _convert_osm_once(path: Path, _content: str) -> bytes:
    """The network of a map, converted once for the check and the traffic."""
    with files.temporary_folder() as folder:
        if osm.is_pbf(path):  # netconvert reads XML only
            osm.write_xml(path, folder / MAP_FILE)
        else:
            user_files.copy_checked(path, folder / MAP_FILE)
        try:
            sumo.run_netconvert(["--osm-files", MAP_FILE, *_OSM_FLAGS], folder, NETWORK_FILE)
        except sumo.SumoInputError as error:
            raise InputError(
                path, f"is no map that streets can be made of: {error}", "a whole map; fetch it again"
            ) from None
        return (folder / NETWORK_FILE).read_bytes()


def _config_xml(options: Mapping[str, str]) -> str:
    lines = [f"    <{key} value={quoteattr(value)}/>" for key, value in options.items()]
    return "\n".join(["<configuration>", *lines, "</configuration>", ""])
