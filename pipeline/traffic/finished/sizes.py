"""Finds how large the vehicles of a finished FCD file are, which itself names their types alone.

Steps: read the ``<vType>``\\ s of the user's SUMO files (``traffic.vtypes``); ask SUMO for what they leave to its
defaults, which follow from the vClass; lay the scenario's own kinds over them; name every type that is still missing.
What the file itself states (:mod:`pipeline.traffic.finished.stated`) counts where neither says otherwise. Metres.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, tostring

from pipeline.artefacts.recorded_boxes import LARGEST_M, SMALLEST_M
from pipeline.core.errors import InputError
from pipeline.core.files import scratch
from pipeline.formats import safe_xml
from pipeline.scenario.models import Scenario
from pipeline.scenario.traffic import VehicleKind
from pipeline.traffic import live, sumo, sumo_folder
from pipeline.traffic.boxes import Size
from pipeline.traffic.finished import stated

_SIZES = ("length", "width", "height")
_NUMBER = re.compile(r"[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?")
"""As SUMO reads it, which knows no digits but these, and no underscores."""

_SUMO_OWN = frozenset(f"DEFAULT_{what}TYPE" for what in ("VEH", "TAXI", "BIKE", "RAIL", "PED", "CONTAINER"))
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


def files(scenario: Scenario) -> list[Path]:
    """The files that the scenario names for sizes."""
    return [scenario.find(name, "traffic.vtypes") for name in scenario.traffic.vtypes]


def kind_sizes(kinds: Collection[VehicleKind]) -> dict[str, Size]:
    """Sizes of the fleet's kinds."""
    return {k.name: Size(k.length_m, k.width_m, k.height_m, k.vclass) for k in kinds}


def known_sizes(scenario: Scenario) -> dict[str, Size]:
    """The sizes that need no asking of SUMO: of the scenario's kinds, and those that its finished file states."""
    traffic = scenario.traffic
    itself = None if traffic.fcd is None else stated.read(scenario.find(traffic.fcd, "traffic.fcd"))
    return kind_sizes(traffic.kinds) if itself is None else itself.sizes | kind_sizes(traffic.own_kinds)


def of_types(scenario: Scenario, types: Collection[str], own: Mapping[str, Size]) -> dict[str, Size]:
    """The sizes of the vehicles of a finished file, which are of these ``types``; ``own`` are those that it states.

    InputError naming all types without a known size, or what is wrong with a file of vTypes.
    """
    traffic, vtypes = scenario.traffic, check_types(scenario, types, own)
    sizes = kind_sizes(traffic.kinds) | dict(own) | kind_sizes(traffic.own_kinds)
    if vtypes or any(name not in sizes for name in types):
        try:
            sizes |= _asked(vtypes) | kind_sizes(traffic.own_kinds)
        except sumo.RefusedError as error:
            place = ", ".join(map(str, files(scenario))) or sumo_folder.place_of(scenario)
            raise InputError(place, f"SUMO does not take its types: {error}", "types that SUMO reads") from None
    return sizes


def check_types(scenario: Scenario, types: Collection[str], own: Mapping[str, Size]) -> list[Element]:
    r"""The ``<vType>``\ s of the scenario's files.

    InputError naming all ``types`` that neither these nor the scenario's kinds give a size, and that are not the
    file's ``own``; or what is wrong with a file.
    """
    vtypes = list(_vtypes(files(scenario)))
    known = {kind.name for kind in scenario.traffic.kinds} | {vtype.attrib["id"] for vtype in vtypes} | set(own)
    if missing := sorted(name for name in set(types) - known if name not in _SUMO_OWN):
        each, have = ("each", "have") if len(missing) > 1 else ("that", "has")
        raise InputError(
            f"{sumo_folder.place_of(scenario)}.kinds",
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
        for child in safe_xml.children(path, ""):
            for vtype in child.iter("vType"):
                name = vtype.get("id", "")
                if not name or name in seen:
                    found = f"a second <vType> {name!r}" if name else "a <vType> without id"
                    raise InputError(path, found, "each <vType> once, with an id")
                seen[name] = path
                yield _checked(vtype, f"{path}: vType {name}")
        if len(seen) == before:
            raise InputError(path, "has no <vType>", "a SUMO file with <vType id=... vClass=... length=.../>")


def _checked(vtype: Element, place: str) -> Element:
    kept = Element("vType", {key: vtype.attrib[key] for key in ("id", "vClass", *_SIZES) if key in vtype.attrib})
    if (vclass := kept.get("vClass", "passenger")) not in sumo.vehicle_classes():
        raise InputError(f"{place}: vClass", repr(vclass), "a vClass of SUMO, e.g. passenger, truck, bus or bicycle")
    for key in _SIZES:
        text = kept.get(key, "1")
        size_m = float(text) if _NUMBER.fullmatch(text) else math.nan
        if not SMALLEST_M <= size_m <= LARGEST_M:
            right = f"a length of at least {SMALLEST_M} m and at most {LARGEST_M:g} m"
            raise InputError(f"{place}: {key}", repr(text[:80]), right)
    return kept


def _asked(vtypes: Collection[Element]) -> dict[str, Size]:
    """The sizes that SUMO gives these types, and its own ones."""
    document = Element("additional")
    for vtype in vtypes:
        SubElement(document, vtype.tag, vtype.attrib)
    with scratch() as folder:
        (folder / "least.net.xml").write_text(_NETWORK, encoding="utf-8")
        (folder / "types.add.xml").write_bytes(tostring(document, encoding="utf-8"))
        named = ["-n", "least.net.xml", "-a", "types.add.xml", "--route-steps", "0"]
        with sumo.served(named, folder) as connection:
            return {name: live.ask_size(connection, name) for name in connection.vehicletype.getIDList()}
