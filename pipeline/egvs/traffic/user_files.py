"""Copy a user's SUMO configuration and demand safely.

**Configuration.** SUMO writes files wherever its options say, so an option is copied only if it is known to change
nothing but the traffic: :data:`FILE_OPTIONS` name files that SUMO reads, :data:`ACCEPTED_OPTIONS` are numbers, names
and switches. Options that affect outputs only, or that the scenario sets itself, are ignored. Any other option is an
error, because ignoring it might change the traffic.

**XML files.** SUMO reads copies only. Each file is first read with the safe parser, which rejects entities and document
types; an element that makes SUMO read another file is an error. If the file makes SUMO write outputs, or is in an
encoding other than UTF-8, the copy is written anew, with the outputs disabled. Detectors, mean data, probes,
calibrators, signal programs and, in any file, ``<param>`` can have outputs. They stay in the copy, because signals and
routes may depend on them.
"""

from __future__ import annotations

import math
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import IO
from xml.etree.ElementTree import Element, tostring
from xml.sax.saxutils import quoteattr

from egvs.core import files, limits
from egvs.core.digests import hash_input
from egvs.core.errors import InputError
from egvs.core.numbers import number_or_nan
from egvs.formats import xml

DEMAND_OPTIONS = ("route-files", "additional-files")
"""SUMO's options for files with vehicles."""

_DEMAND_ELEMENTS = frozenset({"vehicle", "trip", "flow", "include"})


_FLOW_ELEMENTS = frozenset({"flow", "personFlow", "containerFlow"})
_FLOW_RATES = {
    "vehsPerHour": 3600.0, "perHour": 3600.0, "personsPerHour": 3600.0, "containersPerHour": 3600.0, "probability": 1.0,
}  # fmt: skip
"""Attributes of flows with a number of departures, and the seconds in which so many depart."""
_DEPARTING_ELEMENTS = _FLOW_ELEMENTS | {"vehicle", "trip", "person", "container"}
_RANDOM_PERIOD = re.compile(r"exp\((.*)\)")

_SYNONYMS = {
    "n": "net-file", "net": "net-file", "r": "route-files", "route": "route-files", "routes": "route-files",
    "a": "additional-files", "additional": "additional-files", "b": "begin", "e": "end", "w": "weight-files",
    "weights": "weight-files", "x": "weight-attribute", "measure": "weight-attribute", "s": "route-steps",
}  # fmt: skip

FILE_OPTIONS = ("net-file", "route-files", "additional-files", "weight-files")
"""Options for files that SUMO reads."""

_ACCEPTED_TEXT = """
    weight-attribute junction-taz

    step-method.ballistic extrapolate-departpos route-steps ignore-junction-blocker ignore-route-errors
    ignore-accidents intermodal-collision.action collision.stoptime intermodal-collision.stoptime
    collision.check-junctions.mingap collision.mingap-factor keep-after-arrival max-num-vehicles max-num-persons
    max-num-teleports scale scale-suffix time-to-teleport.highways time-to-teleport.highways.min-speed
    time-to-teleport.disconnected time-to-teleport.remove time-to-teleport.remove-constraint time-to-teleport.ride
    time-to-teleport.bidi time-to-teleport.railsignal-deadlock waiting-time-memory startup-wait-threshold
    max-depart-delay sloppy-insert eager-insert emergency-insert insertion-checks random-depart-offset
    lanechange.duration lanechange.overtake-right tls.all-off tls.actuated.show-detectors tls.actuated.jam-threshold
    tls.actuated.detector-length tls.delay_based.detector-range tls.yellow.min-decel railsignal-moving-block
    railsignal.moving-block.default-classes railsignal.moving-block.max-dist railsignal.max-block-length
    railsignal.default-classes slope-centered time-to-impatience default.departspeed default.departlane
    default.action-step-length default.carfollowmodel default.speeddev default.emergencydecel overhead-wire.solver
    overhead-wire.recuperation overhead-wire.substation-current-limits emergencydecel.warning-threshold
    parking.maneuver use-stop-ended use-stop-started pedestrian.model pedestrian.timegap-crossing
    pedestrian.striping.stripe-width pedestrian.striping.dawdling pedestrian.striping.mingap-to-vehicle
    pedestrian.striping.jamtime pedestrian.striping.jamtime.crossing pedestrian.striping.jamtime.narrow
    pedestrian.striping.jamfactor pedestrian.striping.reserve-oncoming pedestrian.striping.reserve-oncoming.junctions
    pedestrian.striping.reserve-oncoming.max pedestrian.striping.legacy-departposlat
    pedestrian.striping.walkingarea-detail ride.stop-tolerance mapmatch.distance mapmatch.junctions mapmatch.taz
    weights.turnaround-penalty weights.reversal-penalty persontrip.walk-opposite-factor

    routing-algorithm weights.random-factor weights.random-factor.dynamic weights.minor-penalty weights.tls-penalty
    weights.priority-factor weights.separate-turns persontrip.walkfactor persontrip.transfer.car-walk
    persontrip.transfer.taxi-walk persontrip.transfer.walk-taxi persontrip.default.group persontrip.taxi.waiting-time
    persontrip.ride-public-line railway.max-train-length replay-rerouting device.rerouting.probability
    device.rerouting.explicit device.rerouting.deterministic device.rerouting.period device.rerouting.pre-period
    device.rerouting.adaptation-weight device.rerouting.adaptation-steps device.rerouting.adaptation-interval
    device.rerouting.cch-update-threshold.factor device.rerouting.cch-update-threshold.constant
    device.rerouting.cch-ensemble device.rerouting.threshold.factor device.rerouting.threshold.constant
    device.rerouting.invalidation device.rerouting.with-taz device.rerouting.mode
    device.rerouting.init-with-loaded-weights device.rerouting.synchronize device.rerouting.railsignal
    device.rerouting.bike-speeds person-device.rerouting.probability person-device.rerouting.explicit
    person-device.rerouting.deterministic person-device.rerouting.period person-device.rerouting.mode
    person-device.rerouting.scope

    device.battery.probability device.battery.explicit device.battery.deterministic device.battery.track-fuel
    device.stationfinder.probability device.stationfinder.explicit device.stationfinder.deterministic
    device.stationfinder.rescueTime device.stationfinder.rescueAction device.stationfinder.reserveFactor
    device.stationfinder.emptyThreshold device.stationfinder.radius device.stationfinder.maxEuclideanDistance
    device.stationfinder.repeat device.stationfinder.chargeType device.stationfinder.waitForCharge
    device.stationfinder.minOpportunityDuration device.stationfinder.saturatedChargeLevel
    device.stationfinder.needToChargeLevel device.stationfinder.opportunisticChargeLevel
    device.stationfinder.replacePlannedStop device.stationfinder.maxDistanceToReplacedStop
    device.stationfinder.chargingStrategy device.stationfinder.checkEnergyForRoute device.elechybrid.probability
    device.elechybrid.explicit device.elechybrid.deterministic

    device.toc.probability device.toc.explicit device.toc.deterministic device.toc.manualType device.toc.automatedType
    device.toc.responseTime device.toc.recoveryRate device.toc.lcAbstinence device.toc.initialAwareness
    device.toc.mrmDecel device.toc.dynamicToCThreshold device.toc.dynamicMRMProbability device.toc.mrmKeepRight
    device.toc.mrmSafeSpot device.toc.mrmSafeSpotDuration device.toc.maxPreparationAccel
    device.toc.ogNewTimeHeadway device.toc.ogNewSpaceHeadway device.toc.ogMaxDecel device.toc.ogChangeRate
    device.toc.useColorScheme device.driverstate.probability device.driverstate.explicit
    device.driverstate.deterministic device.driverstate.initialAwareness
    device.driverstate.errorTimeScaleCoefficient device.driverstate.errorNoiseIntensityCoefficient
    device.driverstate.speedDifferenceErrorCoefficient device.driverstate.headwayErrorCoefficient
    device.driverstate.freeSpeedErrorCoefficient device.driverstate.speedDifferenceChangePerceptionThreshold
    device.driverstate.headwayChangePerceptionThreshold device.driverstate.minAwareness
    device.driverstate.maximalReactionTime device.bluelight.probability device.bluelight.explicit
    device.bluelight.deterministic device.bluelight.reactiondist device.bluelight.mingapfactor
    device.taxi.probability device.taxi.explicit device.taxi.deterministic device.taxi.dispatch-algorithm
    device.taxi.dispatch-algorithm.params device.taxi.dispatch-period device.taxi.dispatch-keep-unreachable
    device.taxi.idle-algorithm device.taxi.vclasses device.glosa.probability device.glosa.explicit
    device.glosa.deterministic device.glosa.range device.glosa.max-speedfactor device.glosa.min-speed
    device.glosa.add-switchtime device.glosa.use-queue device.glosa.override-safety device.glosa.ignore-cfmodel
    device.friction.probability device.friction.explicit device.friction.deterministic device.friction.stdDev
    device.friction.offset

    mesosim meso-ltm meso-edgelength meso-tauff meso-taufj meso-taujf meso-taujj meso-jam-threshold meso-multi-queue
    meso-lane-queue meso-ignore-lanes-by-vclass meso-junction-control meso-junction-control.limited meso-tls-penalty
    meso-tls-flow-penalty meso-minor-penalty meso-overtaking meso-recheck meso-interpolate-pos thread-rngs
"""
ACCEPTED_OPTIONS = frozenset(_ACCEPTED_TEXT.split())
"""Options that change the traffic and neither read nor write a file."""

_IGNORED_TEXT = """
    end random seed step-length threads lateral-resolution time-to-teleport collision.action collision.check-junctions
    precision precision.geo human-readable-time verbose v print-options no-step-log step-log.period
    duration-log.disable duration-log.statistics t no-warnings W suppress-warnings aggregate-warnings log l log-file
    device.toc.file message-log error-log log.timestamps log.processid language write-license write-metadata
    netstate-dump netstate ndump netstate-dump.empty-edges netstate-dump.precision
    tripinfo vehroutes vehroute summary emissions configuration-file c C remote-port num-clients
    device.rerouting.threads routing-threads phemlight-path phemlight-year phemlight-temperature
    pedestrian.jupedsim.wkt pedestrian.jupedsim.wkt.geo pedestrian.jupedsim.py
    quit-on-end Q start S delay d breakpoints B game G game.mode demo D edgedata-files m alternative-net-file N
    selection-file disable-textures T registry-viewport window-size window-pos tracker-interval osg-view
    begin no-internal-links
"""
_IGNORED_OPTIONS = frozenset(_IGNORED_TEXT.split())
_IGNORED_PREFIXES = (
    "save-", "gui-", "osg-", "summary", "xml-validation", "emissions.", "device.fcd.", "person-device.fcd.",
    "device.ssm.", "device.emissions.", "device.tripinfo.", "device.vehroute.", "device.btreceiver.",
    "device.btsender.", "person-device.btsender.", "person-device.btreceiver.", "device.example.",
)  # fmt: skip
"""Options for outputs, logs and the display, and options that the scenario sets itself."""

_TRUE = {"true", "1", "yes", "on", "t", "x"}

_MAX_BEGIN_S = 1e9
"""SUMO counts milliseconds in 64 bits; this is thirty years."""

NULL_FILE = "NUL"
"""SUMO's name, on any system, of an output that is not written."""

_OUTPUT_ATTRIBUTES = frozenset({"file", "output", "dest"})
_OUTPUT_PARAMETERS = ("file", "files", "output")
"""Ends of the keys of a ``<param>`` with an output: ``file`` of a signal, ``device.ssm.file`` of a vehicle or type."""

_INPUT_ATTRIBUTES = frozenset({"href", "edgesFile"})
_INPUT_ELEMENTS = frozenset({"rerouter", "variableSpeedSign"})
"""Elements whose ``file`` is an input."""


@dataclass(frozen=True)
class DemandFiles:
    """Inputs of a simulation: files by SUMO option, other options, and the begin of the configuration."""

    files: dict[str, tuple[Path, ...]]
    options: dict[str, str] = field(default_factory=dict)
    begin_s: float = 0.0

    def all(self) -> list[Path]:
        """Return all files, without duplicates."""
        return list(dict.fromkeys(path for paths in self.files.values() for path in paths))


def has_vehicles(paths: Iterable[Path]) -> bool:
    """Whether a file has a vehicle, trip or flow, or includes a further file. Reads up to the first one.

    An invalid file counts as True: SUMO's error describes it better.
    """
    try:
        for path in paths:
            for child in xml.iter_elements(path, ""):
                if any(element.tag in _DEMAND_ELEMENTS for element in child.iter()):
                    return True
    except InputError:
        return True
    return False


def sumocfg_network_path(path: Path) -> Path | None:
    """Return the network that a configuration names, if any."""
    values = (value.strip() for option, value in _iter_options(path) if option == "net-file")
    return next((path.parent / value for value in values if value), None)


def read_sumocfg(path: Path) -> DemandFiles:
    """Read the options of a configuration that are copied.

    Raises
    ------
    InputError
        When it names no network, a missing file, or an option that is not known to be harmless.
    """
    paths: dict[str, tuple[Path, ...]] = {}
    options: dict[str, str] = {}
    begin_s = 0.0
    for option, value in _iter_options(path):
        where = f"{path}: {option} = {value!r}"
        if option == "begin":
            begin_s = _parse_begin_s(value, path)
        elif option == "no-internal-links" and value.lower() in _TRUE:
            raise InputError(where, "makes vehicles jump across junctions (up to 42 m)", "Remove it.")
        elif option in FILE_OPTIONS:
            paths[option] = tuple(path.parent / name.strip() for name in value.split(",") if name.strip())
            for file in paths[option]:
                if not file.is_file():
                    raise InputError(where, f"no such file ({file})", "Use a path relative to the configuration.")
        elif option in ACCEPTED_OPTIONS:
            options[option] = value
        elif option in _IGNORED_OPTIONS or option.startswith(_IGNORED_PREFIXES) or "output" in option:
            continue  # has no effect on the traffic
        elif value:
            raise InputError(where, "this SUMO option is not supported", "Remove it; see docs/security.md.")
    if not paths.get("net-file"):
        raise InputError(path, "has no net-file", "Add <net-file value=.../> to its <input>.")
    if len(paths["net-file"]) > 1:
        raise InputError(path, f"expected one net-file, got {len(paths['net-file'])}", "Leave the one to simulate.")
    return DemandFiles(paths, options, begin_s)


def _iter_options(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the full name and the value of each option, whatever section it is in."""
    for child in xml.iter_elements(path, ""):
        for element in child.iter():
            value = element.get("value", element.get("v"))
            if value is not None:
                yield _SYNONYMS.get(element.tag, element.tag), os.path.expandvars(value)


def _parse_begin_s(value: str, path: Path) -> float:
    seconds = number_or_nan(value)
    if not 0.0 <= seconds <= _MAX_BEGIN_S:
        problem = f"expected 0 to {_MAX_BEGIN_S:g} seconds"
        raise InputError(f"{path}: begin = {value[:80]!r}", problem, "Use 25200, for example, for seven o'clock.")
    return seconds


def check_demand_size(inputs: DemandFiles, begin_s: float, end_s: float) -> None:
    """Raise an InputError for demand that SUMO would need too much memory for.

    Parameters
    ----------
    inputs
        The inputs of the simulation.
    begin_s, end_s
        The simulated time; what departs at other times does not count.

    Raises
    ------
    InputError
        When more vehicles and people depart than :data:`egvs.core.limits.VEHICLES`, or a route has more edges than
        :data:`egvs.core.limits.ROUTE_EDGES`.
    """
    scale = number_or_nan(inputs.options.get("scale", "1"))
    departures = 0.0
    for path in [path for option in DEMAND_OPTIONS for path in inputs.files.get(option, ())]:
        departures += _count_departures(path, hash_input(path), begin_s, end_s)
        scaled = departures * scale if scale > 0.0 else departures
        actual = f"{scaled:,.0f} vehicles and people depart in {end_s - begin_s:,.0f} s"
        limits.VEHICLES.check(path, scaled, actual)


@lru_cache(maxsize=32)
def _count_departures(path: Path, _content: str, begin_s: float, end_s: float) -> float:
    """Return how many vehicles and people depart in a time; cached, for the check and the simulation.

    InputError when a route is too long.
    """
    departures = 0.0
    for child in xml.iter_elements(path, ""):
        for element in child.iter():
            if element.tag in _FLOW_ELEMENTS:
                departures += _flow_departures(element, begin_s, end_s)
            elif element.tag in _DEPARTING_ELEMENTS:
                depart_s = _parse_clock_s(element.get("depart", ""))
                departures += math.isnan(depart_s) or begin_s <= depart_s <= end_s
            elif element.tag == "route" and element.get("repeat"):
                repeated = number_or_nan(element.get("repeat", ""))
                edges = (repeated + 1.0) * len(element.get("edges", "").split())
                if edges > limits.ROUTE_EDGES.maximum:
                    where = f"{path}: route {element.get('id', '')}".rstrip()
                    limits.ROUTE_EDGES.check(where, edges, f"has {edges:,.0f} edges with repeat={repeated:g}")
    return departures


def _flow_departures(flow: Element, begin_s: float, end_s: float) -> float:
    """Return how many vehicles of a flow depart in a time; 0 for invalid numbers, which SUMO describes better.

    Source: https://sumo.dlr.de/docs/Definition_of_Vehicles,_Vehicle_Types,_and_Routes.html#repeated_vehicles_flows.
    """
    first_s, last_s = (_parse_clock_s(flow.get(key, "")) for key in ("begin", "end"))
    first_s, last_s = (begin_s if math.isnan(first_s) else first_s), (end_s if math.isnan(last_s) else last_s)
    simulated_s = min(last_s, end_s) - max(first_s, begin_s)
    if not simulated_s > 0.0:
        return 0.0
    number = number_or_nan(flow.get("number", ""))
    rates = [number_or_nan(flow.get(key, "")) / seconds for key, seconds in _FLOW_RATES.items()]
    period = flow.get("period", "")
    if random_period := _RANDOM_PERIOD.fullmatch(period):
        rates.append(number_or_nan(random_period[1]))
    elif number_or_nan(period) > 0.0:
        rates.append(1.0 / number_or_nan(period))
    rates = [rate for rate in rates if rate > 0.0]
    if rates:
        departures = max(rates) * simulated_s
        return min(departures, number) if number > 0.0 else departures
    return number * simulated_s / (last_s - first_s) if number > 0.0 else 0.0


def _parse_clock_s(text: str) -> float:
    """Parse a time of SUMO, in seconds or as ``[days:]hours:minutes:seconds``; NaN for any other text."""
    seconds = 0.0
    for part, unit_s in zip(reversed(text.split(":")), (1.0, 60.0, 3600.0, 86400.0), strict=False):
        seconds += number_or_nan(part) * unit_s
    return seconds


def safe_name(name: str) -> str:
    """Replace the characters of a file name that SUMO reads as separators or variables."""
    return re.sub(r"[,;$%]", "_", name)


def copy_checked(path: Path, to: Path) -> list[str]:
    """Write a copy of an XML file that SUMO may read.

    Parameters
    ----------
    path
        The file.
    to
        The copy.

    Returns
    -------
    list of str
        Notes for the user about disabled outputs.

    Raises
    ------
    InputError
        When the file is not well-formed, declares entities, or names a further file that SUMO would read.
    """
    outputs = _count_outputs(path, hash_input(path))
    with files.atomic_write(to) as partial, partial.open("wb") as file:
        if outputs or xml.file_encoding(path) not in ("utf-8", "ascii"):
            _rewrite(path, file)
        else:
            with xml.open_bounded(path) as source:
                shutil.copyfileobj(source, file)
    if not outputs:
        return []
    counts = ", ".join(f"{count} of <{tag}>" for tag, count in outputs)
    return [f"{path.name}: outputs of SUMO are disabled: {counts}"]


def check_copyable(path: Path) -> None:
    """Raise the InputError of :func:`copy_checked`, if any."""
    _count_outputs(path, hash_input(path))


@lru_cache(maxsize=32)
def _count_outputs(path: Path, _content: str) -> tuple[tuple[str, int], ...]:
    """Return the tags of elements with outputs and their numbers; cached, for the check and the copy."""
    counts: Counter[str] = Counter()
    for child in _checked_elements(path):
        counts.update(element.tag for element in child.iter() if _output_keys(element))
    return tuple(sorted(counts.items()))


def _checked_elements(path: Path, on_root: Callable[[Element], None] = lambda root: None) -> Iterator[Element]:
    """Yield the children of the root element, checked; pass the root to ``on_root`` first."""

    def check_root(root: Element) -> None:
        _check_element(root, path)
        if keys := _output_keys(root):  # SUMO accepts any element as the root
            problem = f"its root <{root.tag} {keys[0]}=...> has an output attribute"
            raise InputError(path, problem, "Use a plain root such as <additional>.")
        on_root(root)

    for child in xml.iter_elements(path, "", on_root=check_root):
        for element in child.iter():
            _check_element(element, path)
        yield child


def _rewrite(path: Path, file: IO[bytes]) -> None:
    """Write an XML file anew, as UTF-8, with its outputs disabled."""
    root_tag = ""

    def open_root(root: Element) -> None:
        nonlocal root_tag
        root_tag = root.tag
        attributes = "".join(f" {key}={quoteattr(value)}" for key, value in root.attrib.items() if "}" not in key)
        file.write(f"<{root_tag}{attributes}>\n".encode())

    for child in _checked_elements(path, open_root):
        for element in child.iter():
            for key in _output_keys(element):
                element.set(key, NULL_FILE)
        file.write(tostring(child, encoding="utf-8"))
    file.write(f"</{root_tag}>\n".encode())


def _check_element(element: Element, path: Path) -> None:
    """Raise an InputError for an element in a namespace, or one that makes SUMO read another file."""
    if "}" in element.tag:
        raise InputError(path, f"<{element.tag}> is in a namespace", "Use SUMO's elements without a namespace.")
    inputs = _INPUT_ATTRIBUTES | ({"file"} if element.tag in _INPUT_ELEMENTS else set())
    for key in sorted(inputs & element.attrib.keys()):
        if element.attrib[key] not in ("", NULL_FILE):
            problem = f"<{element.tag} {key}={element.attrib[key]!r}> makes SUMO read another file"
            raise InputError(path, problem, "Move its content into this file.")


def _output_keys(element: Element) -> list[str]:
    """Return the attributes of an element that name an output."""
    keys = sorted(_OUTPUT_ATTRIBUTES & element.attrib.keys())
    if element.tag == "param" and element.get("key", "").lower().endswith(_OUTPUT_PARAMETERS):
        keys.append("value")
    return [key for key in keys if element.get(key, "") not in ("", NULL_FILE)]
