"""Read Lanelet2 maps: the points, bounds, lanelets and regulatory elements of an OSM-XML file, plain or gzipped.

Steps of :func:`read_lanelet2`: parse nodes, ways and relations with the safe XML parser; check each number and that
each reference exists; keep the relations of type ``lanelet`` and ``regulatory_element``. Positions are as in the file:
:mod:`egvs.extensions.maps.formats.lanelet2_projection` converts them to metres,
:mod:`egvs.extensions.maps.formats.lanelet2_graph` finds out which way lanelets run and how they are connected.

The format: https://github.com/fzi-forschungszentrum-informatik/Lanelet2, lanelet2_core/doc/LaneletPrimitives.md and
lanelet2_io; Autoware's additions (``local_x``, ``local_y``, ``turn_direction``, ``MetaInfo``):
https://github.com/autowarefoundation/autoware_lanelet2_extension, docs.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree.ElementTree import Element

from egvs.core import limits
from egvs.core.errors import InputError
from egvs.core.numbers import number_or_nan
from egvs.formats import xml
from egvs.formats.osm import Member, Tags, Way

MAX_HEIGHT_M = 20_000.0
"""No ground is higher."""

_MIN_POINTS = 2
# Without a literal at its beginning, the search takes 15 times as long.
_LANELET_TAG = re.compile(rb"""v\s*=\s*["']lanelet["']""")
_CHUNK_BYTES, _OVERLAP_BYTES = 1 << 20, 64
_VALUE_HINT = "Correct the object in a map editor, or export the map again."
_INCOMPLETE_HINT = "Export the complete map again; a part of it seems to be missing."
_MISSING_HINT = "Give the path of a Lanelet2 map (.osm)."
_NO_LANELETS_HINT = "Give a Lanelet2 map: an .osm file with relations of type=lanelet."


@dataclass(frozen=True)
class MapPoint:
    """A point of a map, as in the file.

    Attributes
    ----------
    lat_deg, lon_deg
        NaN where the file states only local coordinates.
    local_m
        ``local_x``, ``local_y`` in metres; None if absent.
    height_m
        ``ele`` in metres; None if absent.
    """

    lat_deg: float
    lon_deg: float
    local_m: tuple[float, float] | None = None
    height_m: float | None = None


@dataclass(frozen=True)
class Lanelet:
    """A lanelet: the identifiers of its bounds and regulatory elements, and its tags."""

    id: int
    left: int
    right: int
    regulations: tuple[int, ...]
    tags: Tags


@dataclass(frozen=True)
class Regulation:
    """A regulatory element: a traffic light, a right of way, a speed limit.

    Attributes
    ----------
    id
        Identifier.
    members
        Its lines and lanelets, with their roles: ``refers``, ``ref_line``, ``right_of_way``, ``yield``.
    tags
        Its tags.
    """

    id: int
    members: tuple[Member, ...]
    tags: Tags

    @property
    def subtype(self) -> str:
        """The kind: ``traffic_light``, ``right_of_way``, ``speed_limit``."""
        return self.tags.get("subtype", "")

    def ids(self, kind: str, *roles: str) -> list[int]:
        """Return the members of a kind ("node", "way", "relation") in one of these roles."""
        return [member.id for member in self.members if member.type == kind and member.role in roles]


@dataclass(frozen=True)
class LaneletMap:
    """The content of a Lanelet2 file.

    Attributes
    ----------
    points
        Points by identifier.
    lines
        Ways by identifier: bounds, stop lines, traffic lights, markings.
    lanelets, regulations
        By identifier.
    is_autoware
        Whether the file follows Autoware's conventions: it has ``local_x``, ``local_y`` or a ``MetaInfo``.
    incomplete
        Identifiers of lanelets that are left out, since they do not have one left and one right bound.
    missing_members
        How many members of regulatory elements are not in the file.
    path
        The file, for messages.
    """

    points: dict[int, MapPoint]
    lines: dict[int, Way]
    lanelets: dict[int, Lanelet]
    regulations: dict[int, Regulation]
    is_autoware: bool = False
    incomplete: tuple[int, ...] = ()
    missing_members: int = 0
    path: Path = field(default=Path("map"), compare=False)


def is_lanelet2(path: Path) -> bool:
    """Return whether an XML file has a tag with the value ``lanelet``; InputError when its gzip is damaged."""
    with xml.open_bounded(path) as file:
        rest = b""
        while chunk := file.read(_CHUNK_BYTES):
            data = rest + chunk
            if _LANELET_TAG.search(data):
                return True
            rest = data[-_OVERLAP_BYTES:]
    return False


def read_lanelet2(path: Path) -> LaneletMap:
    """Read a Lanelet2 file, without objects that are marked as deleted.

    Parameters
    ----------
    path
        An ``.osm`` file, plain or gzipped.

    Raises
    ------
    InputError
        When the file is missing, damaged or incomplete, declares entities, has an invalid number, or has no
        lanelets. The message names the object.
    """
    if not path.is_file():
        raise InputError(path, "no such file", _MISSING_HINT)
    reader = _Reader(path)
    for number, element in enumerate(xml.iter_elements(path, "osm")):
        if number >= limits.MAP_OBJECTS.maximum:
            limits.MAP_OBJECTS.check(path, number + 1, f"has more than {limits.MAP_OBJECTS.maximum:,} objects")
        reader.add(element)
    return reader.finish()


def parse_number(where: str, text: str | None, limit: float = math.inf, unit: str = "a number") -> float:
    """Parse a number of a map; InputError unless it is finite and within ``[-limit, limit]``."""
    value = number_or_nan(text or "")
    if not math.isfinite(value) or abs(value) > limit:
        expected = unit if math.isinf(limit) else f"{unit} from {-limit:g} to {limit:g}"
        raise InputError(where, f"expected {expected}, got {text!r}", _VALUE_HINT)
    return value


class _Reader:
    """Collects the objects of one file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._points: dict[int, MapPoint] = {}
        self._lines: dict[int, Way] = {}
        self._lanelets: dict[int, tuple[tuple[Member, ...], Tags]] = {}
        self._regulations: dict[int, tuple[tuple[Member, ...], Tags]] = {}
        self._is_autoware = False

    def add(self, element: Element) -> None:
        """Add one child of the root."""
        if element.tag == "MetaInfo":
            self._is_autoware = True
        if element.tag not in ("node", "way", "relation"):
            return
        identifier = self._parse_id(element.tag, "id", element.get("id"))
        if element.get("action") == "delete" or element.get("visible") == "false":
            return
        where = f"{self._path}: {element.tag} {identifier}"
        tags = {tag.get("k", ""): tag.get("v", "") for tag in element if tag.tag == "tag"}
        if element.tag == "node":
            self._check_new(where, identifier, self._points)
            self._points[identifier] = self._parse_point(where, element, tags)
        elif element.tag == "way":
            self._check_new(where, identifier, self._lines)
            nodes = tuple(self._parse_id(f"way {identifier}", "ref", n.get("ref")) for n in element if n.tag == "nd")
            self._lines[identifier] = Way(identifier, nodes, tags)
        else:
            self._add_relation(where, identifier, element, tags)

    def finish(self) -> LaneletMap:
        """Check all references and return the map."""
        lanelets: dict[int, Lanelet] = {}
        incomplete = []
        for identifier, (members, tags) in sorted(self._lanelets.items()):
            lanelet = self._make_lanelet(identifier, members, tags)
            if lanelet is None:
                incomplete.append(identifier)
            else:
                lanelets[identifier] = lanelet
        if not lanelets:
            raise InputError(self._path, "has no lanelets with two bounds", _NO_LANELETS_HINT)
        self._check_nodes()
        regulations = {}
        missing = 0
        for identifier, (members, tags) in sorted(self._regulations.items()):
            present = tuple(member for member in members if self._has(member))
            missing += len(members) - len(present)
            regulations[identifier] = Regulation(identifier, present, tags)
        return LaneletMap(
            self._points, self._lines, lanelets, regulations, self._is_autoware, tuple(incomplete), missing, self._path
        )

    def _add_relation(self, where: str, identifier: int, element: Element, tags: Tags) -> None:
        kind = tags.get("type")
        if kind not in ("lanelet", "regulatory_element"):
            return
        relations = self._lanelets if kind == "lanelet" else self._regulations
        self._check_new(where, identifier, relations)
        members = []
        for member in element:
            if member.tag == "member":
                ref = self._parse_id(f"relation {identifier}", "ref", member.get("ref"))
                members.append(Member(member.get("type", ""), ref, member.get("role", "")))
        relations[identifier] = tuple(members), tags

    def _parse_point(self, where: str, element: Element, tags: Mapping[str, str]) -> MapPoint:
        local_m = None
        if "local_x" in tags or "local_y" in tags:
            self._is_autoware = True
            x, y = (parse_number(f"{where}: {key}", tags.get(key), unit="metres") for key in ("local_x", "local_y"))
            local_m = x, y
        lat_deg = self._parse_degrees(where, "lat", element.get("lat"), 90.0, local_m is not None)
        lon_deg = self._parse_degrees(where, "lon", element.get("lon"), 180.0, local_m is not None)
        height_m = None
        if "ele" in tags:
            height_m = parse_number(f"{where}: ele", tags["ele"], MAX_HEIGHT_M, "a height in metres")
        return MapPoint(lat_deg, lon_deg, local_m, height_m)

    @staticmethod
    def _parse_degrees(where: str, key: str, text: str | None, limit: float, is_optional: bool) -> float:
        if is_optional and not text:
            return math.nan
        return parse_number(f"{where}: {key}", text, limit, "degrees")

    def _parse_id(self, owner: str, key: str, text: str | None) -> int:
        try:
            return int(text or "")
        except ValueError:
            where = f"{self._path}: {owner}: {key}"
            raise InputError(where, f"expected a whole number, got {text!r}", _VALUE_HINT) from None

    @staticmethod
    def _check_new(where: str, identifier: int, known: Mapping[int, object]) -> None:
        if identifier in known:
            raise InputError(where, "the identifier occurs twice", _VALUE_HINT)

    def _make_lanelet(self, identifier: int, members: tuple[Member, ...], tags: Tags) -> Lanelet | None:
        """Return a lanelet, or None unless it has one left and one right bound."""
        where = f"{self._path}: lanelet {identifier}"
        bounds = []
        for role in ("left", "right"):
            ways = [member.id for member in members if member.type == "way" and member.role == role]
            for way in ways:
                if way not in self._lines:
                    raise InputError(where, f"its {role} bound, way {way}, is not in the file", _INCOMPLETE_HINT)
            if len(ways) != 1 or len(set(self._lines[ways[0]].nodes)) < _MIN_POINTS:
                return None
            bounds.append(ways[0])
        regulations = (m.id for m in members if m.type == "relation" and m.role == "regulatory_element")
        present = tuple(number for number in regulations if number in self._regulations)
        return Lanelet(identifier, bounds[0], bounds[1], present, tags)

    def _check_nodes(self) -> None:
        for line in self._lines.values():
            for node in line.nodes:
                if node not in self._points:
                    where = f"{self._path}: way {line.id}"
                    raise InputError(where, f"node {node} is not in the file", _INCOMPLETE_HINT)

    def _has(self, member: Member) -> bool:
        match member.type:
            case "node":
                return member.id in self._points
            case "way":
                return member.id in self._lines
        return member.id in self._lanelets or member.id in self._regulations
