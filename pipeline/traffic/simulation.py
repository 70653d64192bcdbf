"""How does a scenario become a run of SUMO?

Steps: lay out a folder that opens in sumo-gui (``run.sumocfg``, demand, vTypes, a copy of the network); run ``sumo``
there as a subprocess, which writes its floating car data to a file; or record the same from a SUMO that is already
running. Where an effect brings people on foot and on bicycles, they are a further route file of the same simulation.

World frame and units as in SUMO; times are whole milliseconds, SUMO's own unit, so that step, period and warm-up are
compared exactly.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import quoteattr

import numpy as np
import pyarrow as pa

from pipeline.core import files
from pipeline.core.errors import InputError, RunError
from pipeline.core.progress import Progress
from pipeline.formats import safe_xml as safexml
from pipeline.scenario.models import Scenario
from pipeline.scenario.traffic import TrafficModel
from pipeline.traffic import demand, fcd, network, sumo
from pipeline.traffic.boxes import Size

if TYPE_CHECKING:
    from pipeline.effects.traffic.pedestrians_bicycles import PedestriansBicycles

CONFIG, NETWORK, TRIPS, VTYPES = "run.sumocfg", "network.net.xml", "trips.rou.xml", "vtypes.add.xml"
FCD, COLLISIONS, STOPS, LOG = "fcd.csv", "collisions.xml", "stops.xml", "sumo.log"
OTHERS, PERSONS = "others.rou.xml", "persons.csv"
_SYNONYMS = {
    "n": "net-file",
    "net": "net-file",
    "r": "route-files",
    "routes": "route-files",
    "route": "route-files",
    "a": "additional-files",
    "additional": "additional-files",
    "b": "begin",
    "e": "end",
    "F": "weight-files",
}
_DROPPED = {
    "end",
    "random",
    "start",
    "quit-on-end",
    "human-readable-time",
    "verbose",
    "remote-port",
    "num-clients",
    "log",
    "message-log",
    "error-log",
    "device.rerouting.threads",
    "precision",
    "configuration-file",
    "game",
    "demo",
}
_DROPPED_STARTS = ("save-", "gui-", "osg-", "device.fcd.", "summary", "game.")
_TRUE = {"true", "1", "yes", "on", "t", "x"}
_OSM_FLAGS = (
    "--geometry.remove",
    "--junctions.join",
    "--tls.guess-signals",
    "--tls.join",
    "--sidewalks.guess",
    "--crossings.guess",
)
_PRECISION = 8
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

    def window(self) -> fcd.Window:
        """Every step of this time is recorded."""
        return fcd.Window(self.frames, self.period_ms, self.first_ms, complete=True)


@dataclass(frozen=True)
class Sources:
    """The files that the traffic comes from: SUMO option -> files, and the other options of a user's configuration."""

    files: dict[str, tuple[Path, ...]]
    options: dict[str, str] = field(default_factory=dict)
    begin_s: float = 0.0

    def all(self) -> list[Path]:
        """Every file, once."""
        return list(dict.fromkeys(path for paths in self.files.values() for path in paths))


def place(scenario: Scenario) -> str:
    """Where messages about the traffic point to."""
    return f"{scenario.file}: traffic"


def milliseconds(value_s: float, where: str) -> int:
    """Seconds as whole milliseconds."""
    exact = value_s * 1000.0
    if abs(exact - round(exact)) > 1e-6 * max(1.0, exact):
        raise InputError(f"{where} = {value_s:g}", "is no whole number of milliseconds", "SUMO counts in milliseconds")
    return round(exact)


def timing(traffic: TrafficModel, begin_s: float, where: str) -> Timing:
    """Check that period and warm-up are whole numbers of steps (SUMO itself only warns, and records the wrong
    times)."""
    step = milliseconds(traffic.step_s, f"{where}.step_s")
    if step < 1:
        raise InputError(f"{where}.step_s = {traffic.step_s:g}", "is below a millisecond", "at least 0.001")
    values = []
    for key in ("frame_period_s", "warmup_s"):
        value = milliseconds(getattr(traffic, key), f"{where}.{key}")
        if value % step:
            near = " or ".join(f"{n * step / 1000:g}" for n in (value // step, value // step + 1) if n)
            raise InputError(
                f"{where}.{key} = {value / 1000:g}",
                f"is no whole number of steps of {step / 1000:g} s",
                f"for example {near}, or another step_s",
            )
        values.append(value)
    begin = milliseconds(begin_s, f"{where}: begin")
    return Timing(begin, begin + values[1], values[0], step, traffic.frames)


def sources(scenario: Scenario) -> Sources:
    """The files that a simulation reads.

    Raises
    ------
    InputError
        When the scenario, or a configuration that it names, names a file that is not there.
    """
    traffic = scenario.traffic
    if traffic.sumocfg is not None:
        return _configured(scenario.find(traffic.sumocfg, "traffic.sumocfg"))
    assert traffic.network is not None
    files: dict[str, tuple[Path, ...]] = {"net-file": (scenario.find(traffic.network, "traffic.network"),)}
    if traffic.routes:
        files["route-files"] = tuple(scenario.find(name, "traffic.routes") for name in traffic.routes)
    return Sources(files)


def _configured(path: Path) -> Sources:
    """What a user's configuration names. Outputs and what the scenario decides itself are not taken over."""
    files: dict[str, tuple[Path, ...]] = {}
    options, begin_s = {}, 0.0
    for key, value in _options(path):
        pieces = tuple(path.parent / piece.strip() for piece in value.split(",") if piece.strip())
        if key == "begin":
            begin_s = _seconds(value, path)
        elif key == "no-internal-links" and value.lower() in _TRUE:
            raise InputError(
                f"{path}: {key} = {value!r}", "lets vehicles jump over junctions (up to 42 m)", "remove it"
            )
        elif key in _DROPPED or key.startswith(_DROPPED_STARTS) or "output" in key:
            continue
        elif key.endswith(("-file", "-files")):
            for piece in pieces:
                if not piece.is_file():
                    raise InputError(
                        f"{path}: {key} = {value!r}", f"no such file ({piece})", "a path relative to the configuration"
                    )
            files[key] = pieces
        else:
            options[key] = value
    if "net-file" not in files:
        raise InputError(path, "names no net-file", "<net-file value=.../> in its <input>")
    return Sources(files, options, begin_s)


def _options(path: Path) -> Iterator[tuple[str, str]]:
    """Every option with its value; sections are only for readers."""
    for child in safexml.children(path, ""):
        for element in child.iter():
            value = element.get("value", element.get("v"))
            if value is not None:
                yield _SYNONYMS.get(element.tag, element.tag), os.path.expandvars(value)


def _seconds(value: str, path: Path) -> float:
    try:
        return float(value)
    except ValueError:
        raise InputError(
            f"{path}: begin = {value!r}", "is no number of seconds", "for example 25200 for seven o'clock"
        ) from None


@dataclass(frozen=True)
class Prepared:
    """A folder that SUMO can run in."""

    folder: Path
    options: dict[str, str]
    timing: Timing
    has_heights: bool
    cycle_s: float
    drawn: bool
    notes: tuple[str, ...]
    crowd: bool = False
    """Whether people on foot and on bicycles are there too."""

    @property
    def config(self) -> list[str]:
        """The flags that start this run, without outputs."""
        return ["-c", CONFIG]

    @property
    def outputs(self) -> dict[str, str]:
        """What this program has SUMO write."""
        attributes = _ATTRIBUTES + (",z,slope" if self.has_heights else "")
        wanted = {
            "fcd-output": FCD,
            "fcd-output.attributes": attributes,
            "fcd-output.skip-empty": "true",
            "device.fcd.begin": _text(self.timing.first_ms),
            "device.fcd.period": _text(self.timing.period_ms),
            "precision": str(_PRECISION),
            "collision-output": COLLISIONS,
        }
        if self.crowd or not self.drawn:  # else SUMO writes a user's persons among the vehicles
            wanted |= {"person-fcd-output": PERSONS}
        return wanted if self.drawn else wanted | {"stop-output": STOPS, "stop-output.write-unfinished": "true"}


def prepare(scenario: Scenario, folder: Path, crowd: PedestriansBicycles | None = None) -> Prepared:
    """Lay out the folder. ``crowd`` brings people on foot and on bicycles."""
    traffic, where = scenario.traffic, place(scenario)
    given = sources(scenario)
    when = timing(traffic, given.begin_s, where)
    folder.mkdir(parents=True, exist_ok=True)
    named = _copies(given, folder)
    roads = network.read(folder / named["net-file"], given.files["net-file"][0])
    demand_seed, sumo_seed, crowd_seed = np.random.SeedSequence(scenario.seed).spawn(3)
    drawn, notes = traffic.sumocfg is None and not traffic.routes, []
    if drawn:
        notes = _draw(scenario, roads, when, np.random.default_rng(demand_seed), folder)
        named |= {"additional-files": VTYPES, "route-files": TRIPS}
    vehicles = traffic.vehicles
    if crowd is not None:
        path, times = folder / named["net-file"], (when.begin_ms / 1000.0, when.end_ms / 1000.0)
        plan = crowd.plan(scenario, path, roads, *times, np.random.default_rng(crowd_seed))
        files.write_text(folder / OTHERS, plan.xml)
        named["route-files"] = ",".join(name for name in (named.get("route-files"), OTHERS) if name)
        vehicles, notes = vehicles + plan.slots, [*notes, *plan.notes]
    options = (
        given.options | named | _settings(traffic, when, int(sumo_seed.generate_state(1)[0]) & 0x7FFFFFFF, vehicles)
    )
    files.write_text(folder / CONFIG, _config_xml(options))
    return Prepared(folder, options, when, roads.has_heights, roads.cycle_s, drawn, tuple(notes), crowd is not None)


def _settings(traffic: TrafficModel, when: Timing, seed: int, vehicles: int) -> dict[str, str]:
    """What the scenario decides, whatever a user's configuration says; see the traps of SUMO behind each."""
    return {
        "seed": str(seed),
        "begin": _text(when.begin_ms),
        "end": _text(when.end_ms),
        "step-length": _text(when.step_ms),
        "threads": "1",
        "lateral-resolution": f"{traffic.lateral_resolution_m:g}",
        "max-num-vehicles": str(vehicles),
        "max-depart-delay": f"{traffic.max_depart_delay_s:g}",
        "time-to-teleport": "-1",
        "collision.action": "warn",
        "collision.check-junctions": "true",
        "no-step-log": "true",
        "duration-log.disable": "true",
    }


def _text(time_ms: int) -> str:
    return f"{time_ms // 1000}.{time_ms % 1000:03d}"


def _draw(
    scenario: Scenario, roads: network.Network, when: Timing, rng: np.random.Generator, folder: Path
) -> list[str]:
    traffic, where = scenario.traffic, place(scenario)
    demand.check_kinds(traffic.kinds, sumo.vehicle_classes(), where)
    pairs = [demand.pairs(roads, kind, traffic, rng, where) for kind in traffic.kinds]
    departs_s = (
        np.arange(int(np.ceil((when.end_ms - when.begin_ms) / 1000.0 * traffic.trips_per_s))) / traffic.trips_per_s
    )
    trips = demand.draw(roads, traffic.kinds, pairs, departs_s, rng)
    files.write_text(folder / TRIPS, demand.trips_xml(trips, departs_s))
    files.write_text(folder / VTYPES, demand.vtypes_xml(traffic.kinds))
    return [
        f"{kind.name}: no trip between fringe edges; trips join any two edges that are far apart"
        for kind, found in zip(traffic.kinds, pairs, strict=True)
        if not found.fringe
    ]


def _copies(given: Sources, folder: Path) -> dict[str, str]:
    """Copy every file into the folder, so that it can be moved and opened elsewhere."""
    taken, values = {CONFIG, TRIPS, VTYPES, FCD, COLLISIONS, STOPS, LOG, OTHERS, PERSONS}, {}
    for option, paths in given.files.items():
        names = []
        for path in paths:
            name = path.name.replace(",", "_")
            if option == "net-file":
                name = NETWORK + (".gz" if safexml.is_gzip(path) and not network.is_osm(path) else "")
            while name in taken:
                name = f"_{name}"
            taken.add(name)
            if option == "net-file" and network.is_osm(path):
                convert_osm(path, folder / name)
            else:
                shutil.copyfile(path, folder / name)
            names.append(name)
        values[option] = ",".join(names)
    return values


def convert_osm(path: Path, network_path: Path) -> None:
    """Turn a map of OpenStreetMap into a network; its world frame starts at the network's south-west corner."""
    source = os.path.relpath(path, network_path.parent)
    sumo.run("netconvert", ["--osm-files", source, *_OSM_FLAGS, "-o", network_path.name], network_path.parent)


def _config_xml(options: Mapping[str, str]) -> str:
    lines = [f"    <{key} value={quoteattr(value)}/>" for key, value in options.items()]
    return "\n".join(["<configuration>", *lines, "</configuration>", ""])


def simulate(prepared: Prepared, progress: Progress) -> float:
    """Run SUMO in the folder; return the seconds that it took."""
    when, path = prepared.timing, prepared.folder / FCD

    def watch() -> None:
        if (now_ms := _last_time_ms(path)) is not None:
            progress(
                "frames simulated", min(when.frames, max(0, (now_ms - when.first_ms) // when.period_ms)), when.frames
            )

    start = perf_counter()
    flags = [word for key, value in prepared.outputs.items() for word in (f"--{key}", value)]
    sumo.run("sumo", [*prepared.config, *flags], prepared.folder, prepared.folder / LOG, watch)
    return perf_counter() - start


def _last_time_ms(path: Path) -> int | None:
    """The time of the last whole row of a CSV that is being written."""
    if not path.is_file():
        return None
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 512))
        lines = file.read().split(b"\n")
    try:
        return round(float(lines[-2].split(b";")[0]) * 1000) if len(lines) > 2 else None
    except ValueError:
        return None


def flags(prepared: Prepared) -> list[str]:
    """Every flag of the run, as one would type it in its folder."""
    return [word for key, value in (prepared.options | prepared.outputs).items() for word in (f"--{key}", value)]


def type_sizes(prepared: Prepared) -> dict[str, Size]:
    """Ask SUMO for the sizes of all vehicle types of a user's demand, since its defaults depend on the vClass."""
    with sumo.served([*prepared.config, "--route-steps", "0"], prepared.folder) as connection:
        return {name: ask_size(connection, name) for name in connection.vehicletype.getIDList()}


def ask_size(connection: Any, name: str) -> Size:
    """One vehicle type's size over TraCI."""
    types = connection.vehicletype
    return Size(types.getLength(name), types.getWidth(name), types.getHeight(name), types.getVehicleClass(name))


def collisions(prepared: Prepared) -> int:
    """Different pairs of vehicles that SUMO saw collide while frames were recorded."""
    pairs = {
        (c.get("collider"), c.get("victim"))
        for c in safexml.children(prepared.folder / COLLISIONS, "collisions")
        if float(c.get("time", "0")) * 1000.0 >= prepared.timing.first_ms
    }
    return len(pairs)


def stopped_on_purpose(prepared: Prepared) -> set[str]:
    """Vehicles of a user's demand that stop where a ``<stop>`` tells them to."""
    if prepared.drawn:
        return set()
    return {s.get("id", "") for s in safexml.children(prepared.folder / STOPS, "stops")}


class Polled(Mapping[str, Size]):
    """Sizes of vehicle types, asked from a running SUMO when first needed."""

    def __init__(self) -> None:
        self._known: dict[str, Size] = {}

    def learn(self, connection: Any, name: str) -> None:
        """Ask for a type once."""
        if name not in self._known:
            self._known[name] = ask_size(connection, name)

    def __getitem__(self, name: str) -> Size:
        return self._known[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._known)

    def __len__(self) -> int:
        return len(self._known)


@dataclass
class Seen:
    """What :func:`poll` notices beside the rows."""

    sizes: Polled = field(default_factory=Polled)
    collided: set[tuple[str, str]] = field(default_factory=set)
    on_purpose: set[str] = field(default_factory=set)
    persons: bool = False
    """Whether persons are wanted too."""


def poll(connection: Any, when: Timing, seen: Seen, address: str) -> Iterator[pa.Table]:
    """Step a running SUMO through the recording, and give its rows as its FCD file would have them.

    After a step, TraCI's clock is one step ahead of the state that it shows: what SUMO's FCD calls time t is seen at t
    + step."""
    _check_clock(connection, when, address)
    watch = _Watch(connection, seen.persons)
    while (shown_ms := round(connection.simulation.getTime() * 1000)) < when.end_ms:
        connection.simulationStep()
        watch.follow()
        if shown_ms < when.first_ms:
            continue
        seen.collided |= {(c.collider, c.victim) for c in connection.simulation.getCollisions()}
        if (shown_ms - when.first_ms) % when.period_ms == 0 and (rows := watch.rows(seen.sizes)):
            if shown_ms + when.step_ms >= when.end_ms:
                seen.on_purpose |= {name for name in watch.vehicles() if connection.vehicle.isStopped(name)}
            yield _as_table(shown_ms, rows)


def _check_clock(connection: Any, when: Timing, address: str) -> None:
    step = round(connection.simulation.getDeltaT() * 1000)
    if step != when.step_ms:
        raise InputError(
            f"--traci {address}", f"that SUMO's step is {step / 1000:g} s", f"traffic.step_s = {when.step_ms / 1000:g}"
        )
    now = round(connection.simulation.getTime() * 1000)
    if now > when.first_ms:
        raise RunError(
            f"--traci {address}: that SUMO is at {now / 1000:g} s already, after the first frame at {when.first_ms / 1000:g} s;"
            " start it anew, or set a longer traffic.warmup_s"
        )
    if (when.first_ms - now) % when.step_ms:
        raise RunError(
            f"--traci {address}: from {now / 1000:g} s, steps of {step / 1000:g} s do not meet the first frame at"
            f" {when.first_ms / 1000:g} s"
        )


class _Watch:
    """Subscriptions to every vehicle on the road, and to every person where these are wanted."""

    def __init__(self, connection: Any, persons: bool) -> None:
        tc = sumo.constants()
        self._connection = connection
        self._wanted = (tc.VAR_POSITION3D, tc.VAR_ANGLE, tc.VAR_SLOPE, tc.VAR_SPEED, tc.VAR_TYPE)
        self._invalid = tc.INVALID_DOUBLE_VALUE
        for name in connection.vehicle.getIDList():
            connection.vehicle.subscribe(name, self._wanted)
        connection.simulation.subscribe((tc.VAR_DEPARTED_VEHICLES_IDS,))
        self._departed = tc.VAR_DEPARTED_VEHICLES_IDS
        self._persons: set[str] | None = set() if persons else None

    def follow(self) -> None:
        """Subscribe to the vehicles that departed in this step, and to persons who are new."""
        for name in self._connection.simulation.getSubscriptionResults()[self._departed]:
            self._connection.vehicle.subscribe(name, self._wanted)
        if self._persons is not None:
            there = set(self._connection.person.getIDList())
            for name in sorted(there - self._persons):
                self._connection.person.subscribe(name, self._wanted)
            self._persons = there

    def vehicles(self) -> list[str]:
        """The names of all vehicles on the road."""
        position = self._wanted[0]
        results = self._connection.vehicle.getAllSubscriptionResults()
        return [name for name, values in results.items() if values[position][0] != self._invalid]

    def rows(self, sizes: Polled) -> list[tuple[str, str, list[float]]]:
        """(id, type, [x, y, z, angle, slope, speed]) of everybody, rounded as SUMO rounds in its files."""
        found = self._rows(self._connection.vehicle, sizes)
        if self._persons is not None:  # people stand upright, see fcd.read
            found += [
                (name, vtype, [*n[:4], 0.0, n[5]]) for name, vtype, n in self._rows(self._connection.person, sizes)
            ]
        return found

    def _rows(self, domain: Any, sizes: Polled) -> list[tuple[str, str, list[float]]]:
        position, angle, slope, speed, vtype = self._wanted
        found = []
        for name, values in domain.getAllSubscriptionResults().items():
            if values[position][0] == self._invalid:
                continue  # between two places of a teleport
            sizes.learn(self._connection, values[vtype])
            numbers = (*values[position], values[angle], values[slope], values[speed])
            found.append((name, values[vtype], [float(f"{n:.{_PRECISION}f}") for n in numbers]))
        return found


def _as_table(time_ms: int, rows: list[tuple[str, str, list[float]]]) -> pa.Table:
    names, types, numbers = zip(*rows, strict=True)
    columns = np.array(numbers).T
    return pa.table([np.full(len(rows), time_ms), pa.array(names), pa.array(types), *columns], schema=fcd.SCHEMA)
