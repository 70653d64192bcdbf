r"""Finished FCD files: vehicle sizes, metadata, frames.

What a file of floating car data may say of itself, so that it need not be guessed from its rows.

Rows alone do not tell whether a time without any was watched. A Parquet file may say it, as one JSON object under the
metadata key ``egvs``: that frame k is at k times ``period_ms`` on its clock, and how many there are, with vehicles or
without; how large the vehicles of each type are. Its positions are metres of the world frame then. The file's columns
stay those of SUMO, so that whatever reads SUMO's Parquet reads it.

Finds how large the vehicles of a finished FCD file are, which itself names their types alone.

Steps: read the ``<vType>``\ s of the user's SUMO files (``traffic.vtypes``); ask SUMO for what they leave to its
defaults, which follow from the vClass; lay the scenario's own kinds over them; name every type that is still missing.
What the file itself states (:mod:`egvs.traffic.finished_fcd`) counts where neither says otherwise. Metres.

Looks a finished file of floating car data through before its rows are taken. Times are whole milliseconds.

A file that states its frames (:mod:`egvs.traffic.finished_fcd`) need not be looked through: time steps without
rows are frames without vehicles then.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
import pyarrow.compute as pc
from pydantic import Field, ValidationError

from egvs.artefacts.traffic_frames import MAX_BOX_M, MIN_BOX_M
from egvs.core import reading
from egvs.core.errors import InputError
from egvs.core.files import temporary_folder
from egvs.formats import xml
from egvs.scenario.fields import Name, Positive, StrictModel
from egvs.scenario.model import Scenario
from egvs.scenario.traffic_config import VehicleKind
from egvs.traffic import fcd, sumo, sumo_folder
from egvs.traffic.fcd import FrameWindow, check_span
from egvs.traffic.vehicle_boxes import VehicleSize

_MARKER_KEY = "period_ms"
"""A key that no other file of this program has there."""


class DeclaredSize(StrictModel):
    """A type of vehicles."""

    length_m: Positive
    width_m: Positive
    height_m: Positive
    vclass: Name


class FcdMetadata(StrictModel):
    """What a file says of itself."""

    period_ms: int = Field(ge=1)
    frames: int = Field(ge=1, le=2**32 - 1)
    types: dict[Annotated[str, Field(min_length=1)], DeclaredSize]

    @property
    def sizes(self) -> dict[str, VehicleSize]:
        """The types' sizes."""
        return {name: VehicleSize(t.length_m, t.width_m, t.height_m, t.vclass) for name, t in self.types.items()}

    @classmethod
    def for_recording(cls, period_ms: int, frames: int, sizes: dict[str, VehicleSize]) -> FcdMetadata:
        """For a file that is to be written."""
        return cls(
            period_ms=period_ms,
            frames=frames,
            types={name: DeclaredSize(**vars(size)) for name, size in sorted(sizes.items())},
        )


def read_fcd_metadata(path: Path) -> FcdMetadata | None:
    """What a finished file says of itself; None where it says nothing.

    InputError where what it says makes no sense.
    """
    if not path.is_file() or (raw := fcd.fcd_metadata(path)) is None:
        return None
    right = "an unaltered file; make it again"
    try:
        values: Any = reading.parse_json(raw)
    except (ValueError, RecursionError) as error:
        raise InputError(path, f"its metadata is no JSON ({error})", right) from None
    if not isinstance(values, dict) or _MARKER_KEY not in values:
        return None
    try:
        return FcdMetadata.from_dict({key: value for key, value in values.items() if key != "schema"})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise InputError(path, f"its metadata says {key} = {str(first['input'])[:80]}", right) from None


_SIZES = ("length", "width", "height")
_NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
"""As SUMO reads it, which knows no digits but these, and no underscores."""

_SUMO_DEFAULT_TYPES = frozenset(f"DEFAULT_{what}TYPE" for what in ("VEH", "TAXI", "BIKE", "RAIL", "PED", "CONTAINER"))
"""Types that SUMO has without being told."""

_NETWORK = """\
<net version="1.20">
    <location netOffset="0,0" convBoundary="0,0,9,0" origBoundary="0,0,9,0" projParameter="!"/>
    <edge id="e" from="a" to="b" priority="-1"><lane id="e_0" index="0" speed="9" length="9" shape="0,0 9,0"/></edge>
    <junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0"/>
    <junction id="b" type="dead_end" x="9" y="0" incLanes="e_0" intLanes="" shape="9,0"/>
</net>
"""
"""The least that SUMO starts with."""


def size_files(scenario: Scenario) -> list[Path]:
    """The files that the scenario names for sizes."""
    return [scenario.find(name, "traffic.vtypes") for name in scenario.traffic.vtypes]


def kind_sizes(kinds: Collection[VehicleKind]) -> dict[str, VehicleSize]:
    """Sizes of the fleet's kinds."""
    return {k.name: VehicleSize(k.length_m, k.width_m, k.height_m, k.vclass) for k in kinds}


def known_sizes(scenario: Scenario) -> dict[str, VehicleSize]:
    """The sizes that need no asking of SUMO: of the scenario's kinds, and those that its finished file states."""
    traffic = scenario.traffic
    itself = None if traffic.fcd is None else read_fcd_metadata(scenario.find(traffic.fcd, "traffic.fcd"))
    return kind_sizes(traffic.kinds) if itself is None else itself.sizes | kind_sizes(traffic.named_kinds)


def sizes_of_types(
    scenario: Scenario, types: Collection[str], declared: Mapping[str, VehicleSize]
) -> dict[str, VehicleSize]:
    """The sizes of the vehicles of a finished file, which are of these ``types``; ``declared`` are those that it
    states.

    InputError naming all types without a known size, or what is wrong with a file of vTypes.
    """
    traffic, vtypes = scenario.traffic, check_types(scenario, types, declared)
    sizes = kind_sizes(traffic.kinds) | dict(declared) | kind_sizes(traffic.named_kinds)
    if vtypes or any(name not in sizes for name in types):
        try:
            sizes |= _query_sizes(vtypes) | kind_sizes(traffic.named_kinds)
        except sumo.SumoInputError as error:
            place = ", ".join(map(str, size_files(scenario))) or sumo_folder.traffic_key(scenario)
            raise InputError(place, f"SUMO does not take its types: {error}", "types that SUMO reads") from None
    return sizes


def check_types(scenario: Scenario, types: Collection[str], declared: Mapping[str, VehicleSize]) -> list[Element]:
    r"""The ``<vType>``\ s of the scenario's files.

    InputError naming all ``types`` that neither these nor the scenario's kinds give a size, and that are not the
    file's ``declared``; or what is wrong with a file.
    """
    vtypes = list(_vtypes(size_files(scenario)))
    known = {kind.name for kind in scenario.traffic.kinds} | {vtype.attrib["id"] for vtype in vtypes} | set(declared)
    if missing := sorted(name for name in set(types) - known if name not in _SUMO_DEFAULT_TYPES):
        each, have = ("each", "have") if len(missing) > 1 else ("that", "has")
        raise InputError(
            f"{sumo_folder.traffic_key(scenario)}.kinds",
            f"vehicle type{'s' * (len(missing) > 1)} {', '.join(map(repr, missing))} of {scenario.traffic.fcd} {have}"
            " no known size",
            f"a kind of {each} name with length_m, width_m and height_m, or the SUMO file with their <vType> in vtypes"
            f" (known: {', '.join(sorted(known))})",
        )
    return vtypes


def _vtypes(paths: Collection[Path]) -> Iterator[Element]:
    """Identifier, vClass and sizes of every ``<vType>``, wherever it stands in a file; InputError for a wrong one."""
    seen: dict[str, Path] = {}
    for path in paths:
        before = len(seen)
        for child in xml.iter_elements(path, ""):
            for vtype in child.iter("vType"):
                name = vtype.get("id", "")
                if not name or name in seen:
                    found = f"a second <vType> {name!r}" if name else "a <vType> without id"
                    raise InputError(path, found, "each <vType> once, with an id")
                seen[name] = path
                yield _checked_type(vtype, f"{path}: vType {name}")
        if len(seen) == before:
            raise InputError(path, "has no <vType>", "a SUMO file with <vType id=... vClass=... length=.../>")


def _checked_type(vtype: Element, where: str) -> Element:
    kept = Element("vType", {key: vtype.attrib[key] for key in ("id", "vClass", *_SIZES) if key in vtype.attrib})
    if (vclass := kept.get("vClass", "passenger")) not in sumo.vehicle_classes():
        raise InputError(f"{where}: vClass", repr(vclass), "a vClass of SUMO, e.g. passenger, truck, bus or bicycle")
    for key in _SIZES:
        text = kept.get(key, "1")
        size_m = float(text) if _NUMBER.fullmatch(text) else math.nan
        if not MIN_BOX_M <= size_m <= MAX_BOX_M:
            right = f"a length of at least {MIN_BOX_M} m and at most {MAX_BOX_M:g} m"
            raise InputError(f"{where}: {key}", repr(text[:80]), right)
    return kept


def _query_sizes(vtypes: Collection[Element]) -> dict[str, VehicleSize]:
    """The sizes that SUMO gives these types, and its own ones."""
    document = Element("additional")
    for vtype in vtypes:
        SubElement(document, vtype.tag, vtype.attrib)
    with temporary_folder() as folder:
        (folder / "least.net.xml").write_text(_NETWORK, encoding="utf-8")
        (folder / "types.add.xml").write_bytes(tostring(document, encoding="utf-8"))
        named = ["-n", "least.net.xml", "-a", "types.add.xml", "--route-steps", "0"]
        with sumo.serve_traci(named, folder) as connection:
            return {name: sumo.query_size(connection, name) for name in connection.vehicletype.getIDList()}


@dataclass(frozen=True)
class FcdSurvey:
    """What a finished file holds: the time from its first row to its last, its time steps, and their greatest common
    divisor; the types of its vehicles; what it states itself, if it does."""

    lasts_ms: int
    time_steps: int
    step_ms: int
    types: frozenset[str]
    metadata: FcdMetadata | None = None

    @property
    def sizes(self) -> dict[str, VehicleSize]:
        """The sizes that the file itself states."""
        return {} if self.metadata is None else self.metadata.sizes


def survey_fcd(path: Path, until_ms: int | None = None) -> FcdSurvey:
    """Look a finished file through, to ``until_ms`` after its first row or to its end.

    InputError as :func:`egvs.traffic.fcd.read_fcd`, and when it holds no vehicle.
    """
    if (itself := read_fcd_metadata(path)) is not None:
        lasts_ms = (itself.frames - 1) * itself.period_ms
        return FcdSurvey(lasts_ms, itself.frames, itself.period_ms, frozenset(itself.types), itself)
    first_ms, last_ms, types = None, 0, set[str]()
    time_steps, step_ms = 1, 0
    for table in fcd.read_fcd(path):
        time_ms = table["time_ms"].to_numpy()
        if first_ms is None:
            first_ms = last_ms = int(time_ms[0])
        steps = np.diff(time_ms, prepend=last_ms)
        time_steps += int(np.count_nonzero(steps))
        step_ms = int(np.gcd.reduce(steps, initial=step_ms))
        if until_ms is not None:
            table = table.slice(0, int(np.searchsorted(time_ms, first_ms + until_ms, side="right")))
        types.update(pc.unique(table["type"]).to_pylist())
        last_ms = int(time_ms[-1])
        if until_ms is not None and last_ms > first_ms + until_ms:
            break
    if first_ms is None:
        raise InputError(path, "holds no vehicle", fcd.EXPECTED_FCD)
    return FcdSurvey(last_ms - first_ms, time_steps, step_ms, frozenset(types))


def fcd_window(scenario: Scenario) -> tuple[FrameWindow, FcdSurvey]:
    """Which rows of a scenario's finished file are frames, and what the file holds as far as they reach.

    InputError when the file does not hold these frames, or is no sound file.
    """
    traffic, place = scenario.traffic, sumo_folder.traffic_key(scenario)
    assert traffic.fcd is not None
    path = scenario.find(traffic.fcd, "traffic.fcd")
    period_ms = max(1, sumo_folder.to_milliseconds(traffic.frame_period_s, f"{place}.frame_period_s"))
    skip_ms = sumo_folder.to_milliseconds(traffic.warmup_s + (traffic.begin_s or 0.0), f"{place}.warmup_s")
    until_ms = None if traffic.frames is None else skip_ms + (traffic.frames - 1) * period_ms
    found = _cached_survey(path, path.stat().st_mtime_ns, until_ms)
    frames = traffic.frames or (found.lasts_ms - skip_ms) // period_ms + 1
    if frames < 1:
        lasts = f"{path.name} lasts {found.lasts_ms / 1000:g} s"
        raise InputError(f"{place}.warmup_s = {traffic.warmup_s:g}", lasts, "a shorter warm-up")
    if found.metadata is None:
        wanted = FrameWindow(frames, period_ms, skip_ms=skip_ms)
    else:
        wanted = FrameWindow(frames, period_ms, first_ms=skip_ms, skip_ms=skip_ms, complete=True)
    check_span(wanted, found.lasts_ms - skip_ms, found.step_ms, found.time_steps, place, str(traffic.fcd))
    return wanted, found


@lru_cache(maxsize=4)
def _cached_survey(path: Path, _modified_ns: int, until_ms: int | None) -> FcdSurvey:
    return survey_fcd(path, until_ms)


def recorded_frames(scenario: Scenario) -> int:
    """Frames that a scenario records: as it says, or all of a finished file."""
    return fcd_window(scenario)[0].count if scenario.traffic.frames is None else scenario.traffic.frames
