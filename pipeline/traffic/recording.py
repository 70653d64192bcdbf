"""Gets the rows of floating car data of a scenario's traffic, from whichever source it names.

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

import pyarrow as pa

from pipeline.core.errors import InputError
from pipeline.core.findings import Finding
from pipeline.core.progress import Progress
from pipeline.formats import safe_xml
from pipeline.formats.georeference import Georeference
from pipeline.scenario.models import Scenario
from pipeline.traffic import fcd, live, network, sumo, sumo_folder
from pipeline.traffic.boxes import Size
from pipeline.traffic.demand import counts
from pipeline.traffic.demand.counts import MetCount
from pipeline.traffic.extensions import TrafficExtension
from pipeline.traffic.finished import sizes as finished_sizes
from pipeline.traffic.finished import survey
from pipeline.traffic.finished.sizes import kind_sizes
from pipeline.traffic.frames import Window
from pipeline.traffic.guarded import endings
from pipeline.traffic.sumo_folder import (
    COLLISIONS,
    CONFIG,
    DRIVEN,
    FCD,
    LOG,
    PERSONS,
    STATISTICS,
    STOPS,
    Prepared,
    as_flags,
)
from pipeline.traffic.tally import beside

_LEAST_PATIENCE_S = 180.0
_MOST_WAITING = 0.02
_ROOTS = {COLLISIONS: "collisions", STOPS: "stops", STATISTICS: "statistics", DRIVEN: "routes"}


@dataclass(frozen=True)
class RecordingSummary:
    """What SUMO did: ``flags`` and ``sumo_seconds`` are None of one that somebody else started."""

    sumo: str
    sumo_seconds: float | None
    flags: list[str] | None
    collisions: int
    notes: list[str] = field(default_factory=list)
    counts: list[MetCount] = field(default_factory=list)
    """Counted against simulated, in the order of the scenario."""
    warnings: list[Finding] = field(default_factory=list)


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
    window: Window
    sizes: Mapping[str, Size]
    place: str
    patience_s: float | None = None
    vehicles: int | None = None
    stopped_on_purpose: Set[str] = frozenset()
    persons: Iterable[pa.Table] | None = None
    summary: Callable[[], RecordingSummary | None] = lambda: None
    source: str = ""


def record(
    scenario: Scenario,
    folder: Path,
    extensions: Sequence[TrafficExtension],
    progress: Progress,
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
        return _finished(scenario, folder, world)
    if traci is not None:
        return _running(scenario, *traci, extensions)
    return _simulated(scenario, folder, progress, extensions)


@contextmanager
def _finished(scenario: Scenario, folder: Path, world: Georeference) -> Iterator[Recording]:
    """From a file; nothing is simulated, so nothing is promised about it."""
    name, place = scenario.traffic.fcd, sumo_folder.place_of(scenario)
    assert name is not None
    sumo_folder.lay_roads(scenario, folder)
    when, held = survey.window(scenario)
    path, sizes = scenario.find(name, "traffic.fcd"), finished_sizes.of_types(scenario, held.types, held.sizes)
    rows = fcd.read(path) if held.stated is not None else fcd.located(fcd.read(path), world, path)
    yield Recording(rows, when, sizes, place, source=f"{place}.fcd = {name!r}")


@contextmanager
def _simulated(
    scenario: Scenario, folder: Path, progress: Progress, extensions: Sequence[TrafficExtension]
) -> Iterator[Recording]:
    """From SUMO as a subprocess; its FCD file is removed once it is read."""
    prepared = sumo_folder.prepare(scenario, folder, extensions)
    with _sumo_runs(prepared, scenario):
        sizes = kind_sizes(scenario.traffic.kinds) if prepared.drawn else type_sizes(prepared)
    for extension in extensions:
        sizes |= extension.sizes()
    path, persons = folder / FCD, folder / PERSONS
    try:
        with _sumo_runs(prepared, scenario):
            seconds, flags = round(simulate(prepared, progress), 3), as_flags(prepared.options | prepared.outputs)
        crashes = _collisions(prepared)
        met, warnings = _met(scenario, prepared)
        warnings += [*_crashed(crashes, scenario), *_waiting(prepared, scenario)]
        summary = RecordingSummary(sumo.version(), seconds, flags, len(crashes), prepared.notes, met, warnings)
        yield Recording(
            fcd.read(path) if _has_rows(path) else (),
            prepared.timing.window(),
            sizes,
            sumo_folder.place_of(scenario),
            patience_s(prepared.roads.cycle_s),
            prepared.vehicles,
            _stopped_on_purpose(prepared),
            None if not prepared.adds_traffic else (fcd.read(persons, "person") if _has_rows(persons) else ()),
            lambda: summary,
            f"{sumo_folder.place_of(scenario)} ({_names(prepared)})",
        )
    finally:
        for written in (path, persons, folder / DRIVEN, folder / STATISTICS):
            written.unlink(missing_ok=True)


@contextmanager
def _sumo_runs(prepared: Prepared, scenario: Scenario) -> Iterator[None]:
    """What SUMO refuses came from the scenario: an InputError that names the files."""
    try:
        yield
    except sumo.RefusedError as error:
        right = "what SUMO runs without an error; it read copies of these files"
        raise InputError(
            sumo_folder.place_of(scenario), f"SUMO cannot run {_names(prepared)}: {error}", right
        ) from None


def _names(prepared: Prepared) -> str:
    return ", ".join(path.name for path in prepared.given)


@contextmanager
def _running(scenario: Scenario, host: str, port: int, extensions: Sequence[TrafficExtension]) -> Iterator[Recording]:
    """From a SUMO that somebody else started."""
    given = sumo_folder.sources(scenario)
    when = sumo_folder.timing(scenario.traffic, given.begin_s, sumo_folder.place_of(scenario))
    net_file = given.files["net-file"][0]
    cycle_s = 0.0 if network.is_osm(net_file) else network.read(net_file).cycle_s
    observations = live.LiveObservations()
    persons = any(extension.ADDS_TRAFFIC for extension in extensions)
    with sumo.connected(host, port) as connection:
        version = sumo.version_in(connection.getVersion()[1])
        yield Recording(
            live.poll(connection, when, observations, f"{host}:{port}", persons=persons),
            when.window(),
            observations.sizes,
            sumo_folder.place_of(scenario),
            patience_s(cycle_s),
            scenario.traffic.vehicles,
            observations.stopped_on_purpose,
            summary=lambda: RecordingSummary(version, None, None, len(observations.collided)),
        )


def patience_s(cycle_s: float) -> float:
    """How long a vehicle may stand through to the last frame: two signal cycles, and not less than three minutes."""
    return max(_LEAST_PATIENCE_S, 2.0 * cycle_s)


def simulate(prepared: Prepared, progress: Progress) -> float:
    """Run SUMO in the folder; return the seconds that it took."""
    when, path = prepared.timing, prepared.folder / FCD

    def watch() -> None:
        if (now_ms := _last_time_ms(path)) is not None:
            done = (now_ms - when.first_ms) // when.period_ms
            progress("frames simulated", min(when.frames, max(0, done)), when.frames)

    start = perf_counter()
    flags = ["-c", CONFIG, *as_flags(prepared.outputs)]
    sumo.run("sumo", flags, prepared.folder, prepared.folder / LOG, watch)
    check_whole(prepared)
    return perf_counter() - start


def check_whole(prepared: Prepared) -> None:
    """RunError where SUMO did not write a file to its end: on a full disk it ends without a word or an error."""
    folder, outputs = prepared.folder, prepared.outputs.values()
    for name in (name for name in (FCD, PERSONS, COLLISIONS, STOPS, STATISTICS, DRIVEN) if name in outputs):
        if name in _ROOTS:
            endings.check_xml(folder / name, _ROOTS[name])
        else:
            endings.check_table(folder / name)
    last_ms = prepared.timing.end_ms - prepared.timing.step_ms
    if STATISTICS in outputs and _vehicles(prepared)["running"] and (_last_time_ms(folder / FCD) or 0) < last_ms:
        raise endings.cut(folder / FCD)


def _last_time_ms(path: Path) -> int | None:
    """The time of the last whole row of a CSV that is being written."""
    if not path.is_file():
        return None
    lines = endings.tail(path).split(b"\n")
    try:
        return round(float(lines[-2].split(b";")[0]) * 1000) if len(lines) > 2 else None
    except ValueError:
        return None


def type_sizes(prepared: Prepared) -> dict[str, Size]:
    """Sizes of all types of a user's demand; asked of SUMO, since its defaults depend on the vClass."""
    with sumo.served(["-c", CONFIG, "--route-steps", "0"], prepared.folder) as connection:
        return {name: live.ask_size(connection, name) for name in connection.vehicletype.getIDList()}


@dataclass(frozen=True)
class Crash:
    """Where two vehicles collided first: the lane, and the point in the world frame; None where SUMO names none."""

    lane: str
    at_m: tuple[float, float] | None

    @property
    def place(self) -> str:
        """The junction or the edge."""
        lane = self.lane
        return f"junction {lane[1:].rsplit('_', 2)[0]}" if lane.startswith(":") else f"edge {lane.rpartition('_')[0]}"


def _collisions(prepared: Prepared) -> dict[tuple[str, str], Crash]:
    """Pairs of vehicles that SUMO saw collide while frames were recorded, and where they did so first."""
    pairs: dict[tuple[str, str], Crash] = {}
    for c in safe_xml.children(prepared.folder / COLLISIONS, "collisions"):
        if float(c.get("time", "0")) * 1000.0 >= prepared.timing.first_ms:
            x_m, y_m = [*map(float, c.get("colliderFront", "nan,nan").split(","))][:2]
            crash = Crash(c.get("lane", ""), (x_m, y_m) if math.isfinite(x_m + y_m) else None)
            pairs.setdefault((c.get("collider", ""), c.get("victim", "")), crash)
    return pairs


def _crashed(crashes: dict[tuple[str, str], Crash], scenario: Scenario) -> list[Finding]:
    """A warning that vehicles collided, with the junctions and edges where most did, and how far these are."""
    if not crashes:
        return []
    places, at_m = Counter(crash.place for crash in crashes.values()), {c.place: c.at_m for c in crashes.values()}
    shown = ", ".join(
        f"{n} at {place}" + (f" ({beside(spot_m, scenario.roi.box)})" if (spot_m := at_m[place]) is not None else "")
        for place, n in places.most_common(3)
    )
    pairs = f"{len(crashes)} pairs" if len(crashes) > 1 else "a pair"
    found = f"{pairs} of vehicles collided, and drove on through each other: {shown}"
    cure = "look at these places in sumo-gui: right of way, signals, how long the waiting room on a junction is"
    return [Finding("collisions", sumo_folder.place_of(scenario), found, cure)]


def _waiting(prepared: Prepared, scenario: Scenario) -> list[Finding]:
    """A warning that many vehicles of a demand could not start for want of room."""
    if prepared.vehicles is not None:
        return []
    vehicles = _vehicles(prepared)
    loaded, waiting = vehicles["loaded"], vehicles["waiting"]
    if waiting <= _MOST_WAITING * loaded:
        return []
    found = f"{waiting} of {loaded} vehicles could not start to the end: the streets where they start are full"
    return [Finding("waiting", sumo_folder.place_of(scenario), found, "less demand there, or more lanes")]


def _vehicles(prepared: Prepared) -> dict[str, int]:
    """How many vehicles were loaded, run at the end, and wait to start."""
    (vehicles,) = (e for e in safe_xml.children(prepared.folder / STATISTICS, "statistics") if e.tag == "vehicles")
    return {key: int(vehicles.get(key, "0")) for key in ("loaded", "running", "waiting")}


def _met(scenario: Scenario, prepared: Prepared) -> tuple[list[MetCount], list[Finding]]:
    """Counted against simulated, and what to know of it."""
    if not prepared.counted:
        return [], []
    first_s, end_s = prepared.timing.first_ms / 1000.0, prepared.timing.end_ms / 1000.0
    passed = counts.met(scenario.traffic, prepared.folder / DRIVEN, first_s, end_s)
    return passed, counts.findings(passed, (end_s - first_s) / 3600.0, sumo_folder.place_of(scenario))


def _stopped_on_purpose(prepared: Prepared) -> set[str]:
    """Vehicles of a user's demand that stop where a ``<stop>`` tells them to."""
    if prepared.drawn:
        return set()
    return {s.get("id", "") for s in safe_xml.children(prepared.folder / STOPS, "stops")}


def _has_rows(path: Path) -> bool:
    """Where nobody moved, SUMO writes no header, only a line's end."""
    return path.stat().st_size > 1
