r"""Finished FCD files: their metadata, the sizes of their vehicles, and their frames.

**Metadata.** Rows alone do not tell whether a time without any was recorded. A Parquet file may declare this under the
metadata key ``egvs``, as one JSON object: frame k is at k times ``period_ms``, ``frames`` is their number, with or
without vehicles, and ``types`` are the sizes of vehicles. Its positions are in the world frame. Its columns are SUMO's.

**Sizes.** FCD files name vehicle types, but not their sizes. In order of precedence: kinds that the scenario names;
``<vType>``\ s of the user's SUMO files (``traffic.vtypes``), where SUMO adds what they leave to its defaults; SUMO's
default types; the metadata of the file; the scenario's default kinds. Metres.

**Frames.** A file without metadata is read once to find its time steps and types. Times are whole milliseconds. In XML,
all time steps must be there; in other formats, steps without vehicles may be missing, and a vehicle that disappears and
returns gets a warning.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
import pyarrow as pa
from pydantic import Field, ValidationError

from egvs.artefacts.frame_boxes import MAX_BOX_M, MIN_BOX_M
from egvs.core import reading
from egvs.core.errors import Diagnostic, InputError
from egvs.core.files import temporary_folder
from egvs.core.numbers import number_or_nan
from egvs.formats import xml
from egvs.scenario.fields import Name, Positive, StrictModel
from egvs.scenario.model import Scenario
from egvs.scenario.traffic_config import VehicleKind
from egvs.traffic import fcd, sumo, sumo_folder, traffic_sources
from egvs.traffic.network import CAR
from egvs.traffic.vehicle_boxes import VehicleSize

Value = TypeVar("Value")

_NEVER = -(2**63)
"""Time of a row that does not exist."""

_MARKER_KEY = "period_ms"
"""Only FCD files have this key in their metadata."""


class DeclaredSize(StrictModel):
    """Size and vClass of a vehicle type."""

    length_m: Positive
    width_m: Positive
    height_m: Positive
    vclass: Name


class FcdMetadata(StrictModel):
    """Metadata of an FCD file: period and number of its frames, and sizes of its vehicle types."""

    period_ms: int = Field(ge=1)
    frames: int = Field(ge=1, le=2**32 - 1)
    types: dict[Annotated[str, Field(min_length=1)], DeclaredSize]

    @property
    def sizes(self) -> dict[str, VehicleSize]:
        """Size of each vehicle type."""
        return {name: VehicleSize(t.length_m, t.width_m, t.height_m, t.vclass) for name, t in self.types.items()}

    @classmethod
    def for_recording(cls, period_ms: int, frames: int, sizes: dict[str, VehicleSize]) -> FcdMetadata:
        """Return the metadata of a file to be written."""
        types = {name: DeclaredSize(**vars(size)) for name, size in sorted(sizes.items())}
        return cls(period_ms=period_ms, frames=frames, types=types)


def read_fcd_metadata(path: Path) -> FcdMetadata | None:
    """Read the metadata of a finished file, if any; InputError if it is invalid."""
    raw = fcd.fcd_metadata(path) if path.is_file() else None
    if raw is None:
        return None
    hint = "Use the original file, or create it again."
    try:
        values: Any = reading.parse_json(raw)
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"its metadata is not valid JSON ({error})", hint) from None
    if not isinstance(values, dict) or _MARKER_KEY not in values:
        return None
    try:
        return FcdMetadata.from_dict({key: value for key, value in values.items() if key != "schema"})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise InputError(path, f"invalid metadata: {key} = {str(first['input'])[:80]}", hint) from None


_SIZE_ATTRIBUTES = ("length", "width", "height")
_NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
"""A number as SUMO reads it: ASCII digits, without underscores."""

_DEFAULT_TYPES = {
    "DEFAULT_VEHTYPE": CAR, "DEFAULT_TAXITYPE": "taxi", "DEFAULT_BIKETYPE": "bicycle", "DEFAULT_RAILTYPE": "rail",
    "DEFAULT_PEDTYPE": "pedestrian", "DEFAULT_CONTAINERTYPE": "container",
}  # fmt: skip
"""Types that SUMO always has, and their vClasses."""

_NETWORK = """\
<net version="1.20">
    <location netOffset="0,0" convBoundary="0,0,9,0" origBoundary="0,0,9,0" projParameter="!"/>
    <edge id="e" from="a" to="b" priority="-1"><lane id="e_0" index="0" speed="9" length="9" shape="0,0 9,0"/></edge>
    <junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0"/>
    <junction id="b" type="dead_end" x="9" y="0" incLanes="e_0" intLanes="" shape="9,0"/>
</net>
"""
"""A minimal network to start SUMO with."""


def size_files(scenario: Scenario) -> list[Path]:
    """Return the files of ``traffic.vtypes``."""
    return [scenario.find(name, "traffic.vtypes") for name in scenario.traffic.vtypes]


def sizes_of_kinds(kinds: Collection[VehicleKind]) -> dict[str, VehicleSize]:
    """Return the sizes of kinds of the fleet."""
    return {k.name: VehicleSize(k.length_m, k.width_m, k.height_m, k.vclass) for k in kinds}


def known_sizes(scenario: Scenario) -> dict[str, VehicleSize]:
    """Return the sizes that are known without starting SUMO: from the scenario, and the metadata of a finished file."""
    traffic = scenario.traffic
    if traffic.fcd is not None:
        metadata = read_fcd_metadata(scenario.find(traffic.fcd, "traffic.fcd"))
        if metadata is not None:
            return metadata.sizes | sizes_of_kinds(traffic.named_kinds)
    return sizes_of_kinds(traffic.kinds)


@dataclass(frozen=True)
class SizedType:
    """The size of a vehicle type, and where it comes from."""

    size: VehicleSize
    source: str

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON."""
        return {**vars(self.size), "source": self.source}


_DEFAULT_KIND, _FILE, _SUMO_DEFAULT = "a default kind", "the FCD file", "SUMO's default type"
_VTYPES, _KINDS = "traffic.vtypes", "traffic.kinds"
"""Sources of sizes."""


def sizes_of_types(
    scenario: Scenario, types: Collection[str], declared: Mapping[str, VehicleSize]
) -> dict[str, SizedType]:
    """Find the sizes of the vehicles of a finished file.

    Parameters
    ----------
    scenario
        The scenario.
    types
        Vehicle types of the file.
    declared
        Sizes in its metadata.

    Returns
    -------
    dict
        Size of each type; may have further types.

    Raises
    ------
    InputError
        When a type has no known size, or a file of vTypes is invalid.
    """
    vtypes = check_types(scenario, types, declared)
    sized: dict[str, SizedType] = {}

    def add(sizes: Mapping[str, VehicleSize], source: str) -> None:
        sized.update({name: SizedType(size, source) for name, size in sizes.items()})

    add(sizes_of_kinds(scenario.traffic.kinds), _DEFAULT_KIND)
    add(declared, _FILE)
    named = sizes_of_kinds(scenario.traffic.named_kinds)
    add(named, _KINDS)
    if vtypes or any(name not in sized for name in types):
        try:
            queried = _query_type_sizes(vtypes)
        except sumo.SumoInputError as error:
            where = ", ".join(map(str, size_files(scenario))) or sumo_folder.traffic_location(scenario)
            hint = "Use types that SUMO can read."
            raise error.for_input(where, "SUMO rejects the vehicle types", hint) from None
        add(queried, _SUMO_DEFAULT)
        vtype_names = {vtype.attrib["id"] for vtype in vtypes}
        add({name: size for name, size in queried.items() if name in vtype_names}, _VTYPES)
        add(named, _KINDS)
    return sized


def check_types(scenario: Scenario, types: Collection[str], declared: Mapping[str, VehicleSize]) -> list[Element]:
    r"""Check that all types of a finished file have a size.

    Parameters
    ----------
    scenario
        The scenario.
    types
        Vehicle types of the file.
    declared
        Sizes in its metadata.

    Returns
    -------
    list of Element
        The ``<vType>``\ s of the scenario's files.

    Raises
    ------
    InputError
        Names all types without a size, or an invalid file of vTypes.
    """
    vtypes = list(_read_vtypes(size_files(scenario)))
    known = {kind.name for kind in scenario.traffic.kinds} | {vtype.attrib["id"] for vtype in vtypes} | set(declared)
    missing = sorted(set(types) - known - _DEFAULT_TYPES.keys())
    if missing:
        names = ", ".join(map(repr, missing))
        problem = f"the sizes of these vehicle types in {scenario.traffic.fcd} are unknown: {names}"
        hint = (
            "For each, add a kind of the same name with length_m, width_m and height_m, or add to vtypes the SUMO file"
            f" that defines its <vType>. Types with known sizes: {', '.join(sorted(known))}."
        )
        raise InputError(f"{sumo_folder.traffic_location(scenario)}.kinds", problem, hint)
    return vtypes


def vehicle_classes(scenario: Scenario, survey: FcdSurvey, vtypes: Collection[Element]) -> dict[str, str]:
    """Return the vClass of each vehicle type of a finished file, without starting SUMO.

    Parameters
    ----------
    scenario
        The scenario.
    survey
        Content of the file.
    vtypes
        From :func:`check_types`.
    """
    of_vtypes = {vtype.attrib["id"]: vtype.get("vClass", CAR) for vtype in vtypes}
    known = _by_type(scenario, survey, lambda size: size.vclass, _DEFAULT_TYPES | of_vtypes)
    return {name: known[name] for name in survey.types}


def vehicle_lengths_m(scenario: Scenario, survey: FcdSurvey, vtypes: Collection[Element]) -> dict[str, float]:
    """Return the length of the vehicle types of a finished file that the scenario or the file states.

    Parameters
    ----------
    scenario
        The scenario.
    survey
        Content of the file.
    vtypes
        From :func:`check_types`.
    """
    of_vtypes = {vtype.attrib["id"]: number_or_nan(vtype.get("length", "")) for vtype in vtypes}
    return _by_type(scenario, survey, lambda size: size.length_m, of_vtypes)


def _by_type(
    scenario: Scenario, survey: FcdSurvey, value_of: Callable[[VehicleSize], Value], of_vtypes: Mapping[str, Value]
) -> dict[str, Value]:
    """Return a value by vehicle type; later sources win: kinds, the file, its <vType>s, kinds with names."""
    kinds, named_kinds = sizes_of_kinds(scenario.traffic.kinds), sizes_of_kinds(scenario.traffic.named_kinds)
    known = {name: value_of(size) for name, size in {**kinds, **survey.sizes}.items()}
    return {**known, **of_vtypes, **{name: value_of(size) for name, size in named_kinds.items()}}


def _read_vtypes(paths: Collection[Path]) -> Iterator[Element]:
    """Yield id, vClass and sizes of each ``<vType>``, at any depth of a file."""
    names: set[str] = set()
    for path in paths:
        has_type = False
        for child in xml.iter_elements(path, ""):
            for vtype in child.iter("vType"):
                has_type = True
                name = vtype.get("id", "")
                if not name:
                    raise InputError(path, "a <vType> has no id", "Add one.")
                if name in names:
                    raise InputError(path, f"a second <vType> {name!r}", "Remove one of them.")
                names.add(name)
                yield _checked_vtype(vtype, f"{path}: vType {name}")
        if not has_type:
            hint = "Use a SUMO file with <vType id=... vClass=... length=.../>."
            raise InputError(path, "the file has no <vType>", hint)


def _checked_vtype(vtype: Element, where: str) -> Element:
    """Return a ``<vType>`` with id, vClass and sizes only; InputError if one is invalid."""
    keys = [key for key in ("id", "vClass", *_SIZE_ATTRIBUTES) if key in vtype.attrib]
    checked = Element("vType", {key: vtype.attrib[key] for key in keys})
    vclass = checked.get("vClass", "passenger")
    if vclass not in sumo.vehicle_classes():
        hint = "Use a vClass of SUMO, e.g. passenger, truck, bus or bicycle."
        raise InputError(f"{where}: vClass", f"unknown vClass {vclass!r}", hint)
    for key in _SIZE_ATTRIBUTES:
        text = checked.get(key, "1")
        if not _NUMBER.fullmatch(text) or not MIN_BOX_M <= float(text) <= MAX_BOX_M:
            hint = f"Use at least {MIN_BOX_M} m and at most {MAX_BOX_M:g} m."
            raise InputError(f"{where}: {key}", f"expected a length, got {text[:80]!r}", hint)
    return checked


def _query_type_sizes(vtypes: Collection[Element]) -> dict[str, VehicleSize]:
    """Query the sizes of some types, and of SUMO's default types, from SUMO."""
    document = Element("additional")
    for vtype in vtypes:
        SubElement(document, vtype.tag, vtype.attrib)
    with temporary_folder() as folder:
        (folder / "minimal.net.xml").write_text(_NETWORK, encoding="utf-8")
        (folder / "types.add.xml").write_bytes(tostring(document, encoding="utf-8"))
        return sumo.query_sizes(["-n", "minimal.net.xml", "-a", "types.add.xml"], folder)


@dataclass(frozen=True)
class FcdSurvey:
    """Content of a finished file.

    Attributes
    ----------
    duration_ms
        Time from the first row to the last.
    time_steps, step_ms
        Number of distinct times, and greatest common divisor of the steps between them.
    types
        Vehicle types.
    metadata
        Metadata, if the file has any.
    returns
        How often a vehicle disappears and returns.
    first_return
        The first of these times, as a text.
    """

    duration_ms: int
    time_steps: int
    step_ms: int
    types: frozenset[str]
    metadata: FcdMetadata | None = None
    returns: int = 0
    first_return: str = ""

    @property
    def sizes(self) -> dict[str, VehicleSize]:
        """Sizes in the metadata."""
        return {} if self.metadata is None else self.metadata.sizes


def survey_fcd(path: Path, until_ms: int | None = None) -> FcdSurvey:
    """Read a finished file to find its time steps and vehicle types; with metadata, only these are read.

    Parameters
    ----------
    path
        The file.
    until_ms
        Stop this long after the first row; None for the complete file.

    Raises
    ------
    InputError
        When the file has no vehicle, or :func:`egvs.traffic.fcd.read_fcd` rejects it.
    """
    import pyarrow.compute as pc

    metadata = read_fcd_metadata(path)
    if metadata is not None:
        duration_ms = (metadata.frames - 1) * metadata.period_ms
        return FcdSurvey(duration_ms, metadata.frames, metadata.period_ms, frozenset(metadata.types), metadata)
    first_ms = None
    last_ms = step_ms = 0
    time_steps = 1
    types: set[str] = set()
    presence = _VehiclePresence()
    for table in fcd.read_fcd(path):
        time_ms = table["time_ms"].to_numpy()
        if first_ms is None:
            first_ms = last_ms = int(time_ms[0])
        steps = np.diff(time_ms, prepend=last_ms)
        time_steps += int(np.count_nonzero(steps))
        step_ms = int(np.gcd.reduce(steps, initial=step_ms))
        last_ms = int(time_ms[-1])
        if until_ms is not None:
            table = table.slice(0, int(np.searchsorted(time_ms, first_ms + until_ms, side="right")))
        presence.add(table)
        types.update(pc.unique(table["type"]).to_pylist())
        if until_ms is not None and last_ms > first_ms + until_ms:
            break
    if first_ms is None:
        raise InputError(path, "the file contains no vehicles", fcd.EXPECTED_FCD)
    returns, first_return = presence.find_returns()
    return FcdSurvey(
        last_ms - first_ms, time_steps, step_ms, frozenset(types), returns=returns, first_return=first_return
    )


class _VehiclePresence:
    """Times between successive rows of the same vehicle, counted by their length."""

    def __init__(self) -> None:
        self._codes: dict[str, int] = {}
        self._last_ms = np.empty(0, dtype=np.int64)
        self._counts: Counter[int] = Counter()
        self._first: dict[int, tuple[int, str]] = {}

    def add(self, table: pa.Table) -> None:
        """Add the next rows of the file."""
        if not table.num_rows:
            return
        names = table["id"].combine_chunks().dictionary_encode()
        known = len(self._codes)
        codes = np.array([self._codes.setdefault(name, len(self._codes)) for name in names.dictionary.to_pylist()])
        self._last_ms = np.append(self._last_ms, np.full(len(self._codes) - known, _NEVER))

        code = codes[names.indices.to_numpy()]
        time_ms = table["time_ms"].to_numpy()
        order = np.argsort(code, kind="stable")  # rows are in order of time
        code, time_ms = code[order], time_ms[order]
        is_first = np.diff(code, prepend=-1) != 0
        previous_ms = np.where(is_first, self._last_ms[code], np.roll(time_ms, 1))
        is_last = np.append(is_first[1:], True)
        self._last_ms[code[is_last]] = time_ms[is_last]

        pause_ms = np.where(previous_ms == _NEVER, 0, time_ms - previous_ms)
        lengths_ms, rows, numbers = np.unique(pause_ms, return_index=True, return_counts=True)
        texts = list(self._codes)
        for length_ms, row, number in zip(lengths_ms.tolist(), rows.tolist(), numbers.tolist(), strict=True):
            if length_ms > 0:
                self._counts[length_ms] += number
                self._first.setdefault(length_ms, (int(previous_ms[row]), texts[code[row]]))

    def find_returns(self) -> tuple[int, str]:
        """Return how often a vehicle is missing for longer than the usual step, and one such time as a text."""
        if not self._counts:
            return 0, ""
        usual_ms = self._counts.most_common(1)[0][0]
        pauses_ms = [length_ms for length_ms in self._counts if length_ms >= fcd.MIN_GAP_STEPS * usual_ms]
        if not pauses_ms:
            return 0, ""
        (since_ms, name), length_ms = min((self._first[length_ms], length_ms) for length_ms in pauses_ms)
        number = sum(self._counts[length_ms] for length_ms in pauses_ms)
        return number, f"{name!r} between {since_ms / 1000:g} s and {(since_ms + length_ms) / 1000:g} s"


def presence_warnings(scenario: Scenario, survey: FcdSurvey) -> Iterator[Diagnostic]:
    """Warn about vehicles of a finished file that disappear and return."""
    if not survey.returns:
        return
    where = f"{sumo_folder.traffic_location(scenario)}.fcd = {scenario.traffic.fcd!r}"
    times = "once" if survey.returns == 1 else f"{survey.returns:,} times"
    problem = f"vehicles disappear and return {times}, e.g. {survey.first_return}; meanwhile they count as absent"
    hint = "Use a file in which each vehicle has a row in every time step of its trip."
    yield Diagnostic("vehicles return", where, problem, hint)


def fcd_window(scenario: Scenario) -> tuple[fcd.FrameWindow, FcdSurvey]:
    """Find the frames in the finished file of a scenario, and its content up to the last one.

    Raises
    ------
    InputError
        When the file has too few frames, or is invalid.
    """
    traffic = scenario.traffic
    where = sumo_folder.traffic_location(scenario)
    assert traffic.fcd is not None
    path = scenario.find(traffic.fcd, "traffic.fcd")
    period_ms = max(1, sumo_folder.to_milliseconds(traffic.frame_period_s, f"{where}.frame_period_s"))
    skip_ms = sumo_folder.to_milliseconds(traffic.warmup_s + (traffic.begin_s or 0.0), f"{where}.warmup_s")
    until_ms = None if traffic.frames is None else skip_ms + (traffic.frames - 1) * period_ms
    survey = _cached_survey(path, path.stat().st_mtime_ns, until_ms)
    frames = traffic.frames or (survey.duration_ms - skip_ms) // period_ms + 1
    if frames < 1:
        problem = f"the duration of {path.name} is {survey.duration_ms / 1000:g} s"
        raise InputError(f"{where}.warmup_s = {traffic.warmup_s:g}", problem, "Use a shorter warm-up.")
    is_complete = survey.metadata is not None
    first_ms = skip_ms if is_complete else None
    window = fcd.FrameWindow(frames, period_ms, first_ms, skip_ms, is_complete)
    fcd.check_span(
        window, survey.duration_ms - skip_ms, survey.step_ms, survey.time_steps, where, file=str(traffic.fcd)
    )
    return window, survey


@lru_cache(maxsize=4)
def _cached_survey(path: Path, _modified_ns: int, until_ms: int | None) -> FcdSurvey:
    return survey_fcd(path, until_ms)


def recorded_frames(scenario: Scenario) -> int:
    """Return the number of frames that a scenario records: ``traffic.frames``, or all of a recording."""
    if scenario.traffic.frames is not None:
        return scenario.traffic.frames
    if scenario.traffic.tracks is not None:
        return traffic_sources.source_of(scenario).frame_count(scenario)
    return fcd_window(scenario)[0].count
