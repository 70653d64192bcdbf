"""A user's SUMO configuration and demand: what is taken over, copied safely.

Tells whether the files of a user's demand bring any vehicle, before they are simulated.

Files are read only as far as the first vehicle, so it costs next to nothing where there is one.

Reads of a user's SUMO configuration what may be taken over.

SUMO writes wherever an option tells it to, so an option is taken over only where it is known to change nothing but the
traffic: :data:`FILE_OPTIONS` are files that it reads, :data:`ACCEPTED_OPTIONS` are numbers, names and switches. What
only writes, shows
or tells, and what the scenario decides itself, is left out. Any other option is an error: unheard, it might change the
traffic.

Copies the XML that SUMO is to read, so that SUMO reads nothing that was not read here first.

Steps: read every element with the safe parser, which refuses entities and document types; refuse what makes SUMO read a
further file; where something makes SUMO write one, or the file is in another encoding than UTF-8, write it anew, with
the outputs going nowhere. SUMO reads the copy alone, so that it cannot understand a file in another way than it was
understood here.

By detectors, mean data, probes, calibrators, signal programs and, in any file, ``<param>``, SUMO can be told to write.
None of that is the traffic's, so it is not written; the detectors and devices themselves stay, because signals and
routes may depend on them.
"""

from __future__ import annotations

import math
import os
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import IO
from xml.etree.ElementTree import Element, tostring
from xml.sax.saxutils import quoteattr

from egvs.core import files
from egvs.core.errors import InputError
from egvs.formats import xml

DEMAND_OPTIONS = ("route-files", "additional-files")
"""SUMO's options that name files with vehicles."""

_VEHICLE_ELEMENTS = frozenset({"vehicle", "trip", "flow"})
_INCLUDE_ELEMENTS = frozenset({"include"})


def has_vehicles(paths: Iterable[Path]) -> bool:
    """Whether any of these files has a ``<vehicle>``, ``<trip>`` or ``<flow>``, or includes files that may.

    What cannot be read is left to SUMO, which says what is wrong with it.
    """
    try:
        return any(
            element.tag in _VEHICLE_ELEMENTS | _INCLUDE_ELEMENTS
            for path in paths
            for child in xml.iter_elements(path, "")
            for element in child.iter()
        )
    except InputError:
        return True


_SYNONYMS = {
    "n": "net-file", "net": "net-file", "r": "route-files", "route": "route-files", "routes": "route-files",
    "a": "additional-files", "additional": "additional-files", "b": "begin", "e": "end", "w": "weight-files",
    "weights": "weight-files", "x": "weight-attribute", "measure": "weight-attribute", "s": "route-steps",
}  # fmt: skip

FILE_OPTIONS = ("net-file", "route-files", "additional-files", "weight-files")
"""Options that name files which SUMO reads; each is read here first."""

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
"""What only writes, shows or tells, or is the scenario's to decide: nothing is lost without it."""

_TRUE = {"true", "1", "yes", "on", "t", "x"}


@dataclass(frozen=True)
class DemandFiles:
    """The files that the traffic comes from: SUMO option -> files, and the other options of a user's configuration."""

    files: dict[str, tuple[Path, ...]]
    options: dict[str, str] = field(default_factory=dict)
    begin_s: float = 0.0

    def all(self) -> list[Path]:
        """Every file, once."""
        return list(dict.fromkeys(path for paths in self.files.values() for path in paths))


def sumocfg_network_path(path: Path) -> Path | None:
    """The network that the configuration ``path`` names; None where it names none."""
    return next((path.parent / value for key, value in _read_options(path) if key == "net-file" and value), None)


def read_sumocfg(path: Path) -> DemandFiles:
    """What is taken over of the configuration ``path``.

    InputError when it names no network, a file that is missing, or an option that is not known to be harmless.
    """
    files: dict[str, tuple[Path, ...]] = {}
    options, begin_s = {}, 0.0
    for key, value in _read_options(path):
        if key == "begin":
            begin_s = _parse_seconds(value, path)
        elif key == "no-internal-links" and value.lower() in _TRUE:
            what = "lets vehicles jump over junctions (up to 42 m)"
            raise InputError(f"{path}: {key} = {value!r}", what, "remove it")
        elif key in FILE_OPTIONS:
            files[key] = _option_files(path, key, value)
        elif key in ACCEPTED_OPTIONS:
            options[key] = value
        elif value and not _is_ignored(key):
            what = "is no option of SUMO that is taken over"
            raise InputError(f"{path}: {key} = {value!r}", what, "remove it; docs/security.md says which are")
    if "net-file" not in files:
        raise InputError(path, "names no net-file", "<net-file value=.../> in its <input>")
    return DemandFiles(files, options, begin_s)


def _is_ignored(key: str) -> bool:
    return key in _IGNORED_OPTIONS or key.startswith(_IGNORED_PREFIXES) or "output" in key


def _option_files(path: Path, key: str, value: str) -> tuple[Path, ...]:
    pieces = tuple(path.parent / piece.strip() for piece in value.split(",") if piece.strip())
    for missing in (piece for piece in pieces if not piece.is_file()):
        what = f"no such file ({missing})"
        raise InputError(f"{path}: {key} = {value!r}", what, "a path relative to the configuration")
    return pieces


def _read_options(path: Path) -> Iterator[tuple[str, str]]:
    """Every option with its value; sections are only for readers."""
    for child in xml.iter_elements(path, ""):
        for element in child.iter():
            value = element.get("value", element.get("v"))
            if value is not None:
                yield _SYNONYMS.get(element.tag, element.tag), os.path.expandvars(value)


def _parse_seconds(value: str, path: Path) -> float:
    try:
        seconds = float(value)
    except ValueError:
        seconds = math.nan
    if not 0.0 <= seconds <= _MAX_BEGIN_S:
        right = f"0 to {_MAX_BEGIN_S:g}, for example 25200 for seven o'clock"
        raise InputError(f"{path}: begin = {value[:80]!r}", "is no number of seconds", right)
    return seconds


_MAX_BEGIN_S = 1e9
"""SUMO counts milliseconds in 64 bits; this is thirty years."""

NULL_FILE = "NUL"
"""SUMO's own name, on any system, of an output that is not written."""

_OUTPUT_ATTRIBUTES = frozenset({"file", "output", "dest"})
_OUTPUT_PARAMETERS = ("file", "files", "output")
"""How the keys of such a ``<param>`` end: ``file`` of a signal, ``device.ssm.file`` of a vehicle or its type."""

_INPUT_ATTRIBUTES = frozenset({"href", "edgesFile"})
_INPUT_ELEMENTS = frozenset({"rerouter", "variableSpeedSign"})
"""Elements whose ``file`` is read."""


def safe_name(name: str) -> str:
    """A file's name without what SUMO reads as more than a name: lists, variables of the environment."""
    return "".join("_" if sign in ",;$%" else sign for sign in name)


def copy_checked(path: Path, to: Path) -> list[str]:
    """Write a copy of the XML file ``path`` that SUMO may read; what the user should know of it.

    InputError when it is not well-formed, declares entities, or names a further file that SUMO would read.
    """
    unwritten = _count_outputs(path, files.hash_file(path))
    with files.atomic_write(to) as partial, partial.open("wb") as file:
        if unwritten or xml.file_encoding(path) not in ("utf-8", "ascii"):
            _rewrite(path, file)
        else:
            with xml.open_bounded(path) as source:
                shutil.copyfileobj(source, file)
    if not unwritten:
        return []
    told = ", ".join(f"{count} of <{tag}>" for tag, count in unwritten)
    return [f"{path.name}: SUMO's outputs that it asks for are not written: {told}"]


def check_copyable(path: Path) -> None:
    """InputError where :func:`copy_checked` would refuse a file."""
    _count_outputs(path, files.hash_file(path))


@lru_cache(maxsize=32)
def _count_outputs(path: Path, _content: str) -> tuple[tuple[str, int], ...]:
    """The elements of a file that ask for an output, and how many; read once for the check and the copy."""
    found: Counter[str] = Counter()
    for child in _checked_elements(path):
        found.update(element.tag for element in child.iter() if _output_keys(element))
    return tuple(sorted(found.items()))


def _checked_elements(path: Path, on_root: Callable[[Element], None] = lambda root: None) -> Iterator[Element]:
    """The children of the root, when nothing in the file has SUMO read a further one."""

    def check_root(root: Element) -> None:
        _check_element(root, path)
        if keys := _output_keys(root):  # SUMO takes any element for the root
            raise InputError(
                path, f"its root <{root.tag} {keys[0]}=...> asks for an output", "a root like <additional>"
            )
        on_root(root)

    for child in xml.iter_elements(path, "", on_root=check_root):
        for element in child.iter():
            _check_element(element, path)
        yield child


def _rewrite(path: Path, file: IO[bytes]) -> None:
    """Write a file anew, as UTF-8, with outputs that go nowhere."""
    roots: list[Element] = []

    def open_root(root: Element) -> None:
        roots.append(root)
        named = "".join(f" {key}={quoteattr(value)}" for key, value in root.attrib.items() if "}" not in key)
        file.write(f"<{root.tag}{named}>\n".encode())

    for child in _checked_elements(path, open_root):
        for element in child.iter():
            for key in _output_keys(element):
                element.set(key, NULL_FILE)
        file.write(tostring(child, encoding="utf-8"))
    file.write(f"</{roots[0].tag}>\n".encode())


def _check_element(element: Element, path: Path) -> None:
    if "}" in element.tag:
        raise InputError(path, f"<{element.tag}> is in a namespace", "SUMO's elements, which have none")
    read = _INPUT_ATTRIBUTES | ({"file"} if element.tag in _INPUT_ELEMENTS else set())
    for key in sorted(read & element.attrib.keys()):
        if element.attrib[key] not in ("", NULL_FILE):
            what = f"<{element.tag} {key}={element.attrib[key]!r}> has SUMO read a further file"
            raise InputError(path, what, "its content in this file itself")


def _output_keys(element: Element) -> list[str]:
    """The attributes by which an element asks for an output."""
    keys = sorted(_OUTPUT_ATTRIBUTES & element.attrib.keys())
    if element.tag == "param" and element.get("key", "").lower().endswith(_OUTPUT_PARAMETERS):
        keys.append("value")
    return [key for key in keys if element.get(key, "") not in ("", NULL_FILE)]
