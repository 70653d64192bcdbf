"""Read OpenStreetMap files: XML (``.osm``, may be gzipped) and PBF (``.osm.pbf``), recognised by their content.

Steps of :func:`read_osm`: let osmium convert PBF to XML, in a process of its own (:mod:`egvs.formats.reader_process`);
read the tags of the XML, and check identifiers and positions; keep the positions of nodes, tagged nodes, ways,
relations, and the extract's bounds.

Coordinates are latitude and longitude in degrees (WGS 84), in multiples of 1e-7 degree (1 cm), as in OpenStreetMap.
Objects are sorted by identifier, so that their order in the file does not matter. The meaning of tags:
https://wiki.openstreetmap.org/wiki/Map_features.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from egvs.core import files, limits
from egvs.core.errors import InputError
from egvs.core.numbers import number_or_nan
from egvs.formats import xml
from egvs.formats.reader_process import Block, read_blocks, serve

Tags = dict[str, str]

_KINDS = frozenset({"node", "way", "relation"})

_HINT = "Download the extract again, or choose one with streets (.osm, .osm.pbf)."
_MISSING_HINT = "Give the path of an extract (.osm, .osm.pbf)."
_VALUE_HINT = "Correct the object in the file, or download the extract again."

_CANNOT_READ = "cannot be read as OpenStreetMap data"
_VERSION = "0.6"
_DECIMALS = 7

_FOOT_M = 0.3048
_LENGTH = re.compile(r"(\d+(?:\.\d+)?|\d+,\d{1,2}|\.\d+)\s*(m|metres?|meters?|ft|feet|foot|')?", re.IGNORECASE)
_FEET_INCHES = re.compile(r"(\d+)\s*'\s*(\d+(?:\.\d+)?)\s*(?:''|\")")
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


@dataclass(frozen=True)
class Way:
    """A line or ring of nodes."""

    id: int
    nodes: tuple[int, ...]
    tags: Tags

    @property
    def closed(self) -> bool:
        """Whether the way is a ring around an area."""
        return len(self.nodes) >= 4 and self.nodes[0] == self.nodes[-1]


class Member(NamedTuple):
    """A member of a relation: its type ("node", "way", "relation"), identifier and role."""

    type: str
    id: int
    role: str


@dataclass(frozen=True)
class Relation:
    """A relation with its members."""

    id: int
    members: tuple[Member, ...]
    tags: Tags

    def ways(self, *roles: str) -> list[int]:
        """Return the members that are ways in one of these roles."""
        return [member.id for member in self.members if member.type == "way" and member.role in roles]


@dataclass(frozen=True)
class Bounds:
    """The rectangle that an extract covers, degrees."""

    south_deg: float
    west_deg: float
    north_deg: float
    east_deg: float

    def contains(self, lat_deg: float, lon_deg: float) -> bool:
        """Return whether a position is inside or on the boundary."""
        return self.south_deg <= lat_deg <= self.north_deg and self.west_deg <= lon_deg <= self.east_deg

    def meets(self, other: Bounds) -> bool:
        """Return whether two rectangles have a common point."""
        meets_lats = self.south_deg <= other.north_deg and other.south_deg <= self.north_deg
        return meets_lats and self.west_deg <= other.east_deg and other.west_deg <= self.east_deg


@dataclass(frozen=True)
class OsmExtract:
    """The content of an OpenStreetMap file.

    Attributes
    ----------
    nodes
        Latitude and longitude in degrees by identifier.
    node_tags
        Tags of the nodes that have any, by identifier.
    ways
        Ways by identifier.
    relations
        Relations, sorted by identifier.
    bounds
        The rectangle that the file declares, else that of its nodes.
    declared
        Whether the file declares its bounds.
    path
        The file, for messages.
    """

    nodes: dict[int, tuple[float, float]]
    node_tags: dict[int, Tags]
    ways: dict[int, Way]
    relations: tuple[Relation, ...]
    bounds: Bounds
    declared: bool
    path: Path = field(default=Path("extract"), compare=False)

    def way_bounds(self, way: Way) -> Bounds | None:
        """Return the bounding box of a way; None if the extract has none of its nodes."""
        positions = [self.nodes[node] for node in way.nodes if node in self.nodes]
        if not positions:
            return None
        lats_deg, lons_deg = zip(*positions, strict=True)
        return Bounds(min(lats_deg), min(lons_deg), max(lats_deg), max(lons_deg))

    def is_near(self, way: Way, area: Bounds) -> bool:
        """Return whether the bounding box of a way meets an area; a way without positions may be anywhere."""
        bounds = self.way_bounds(way)
        return bounds is None or bounds.meets(area)


def read_osm(path: Path) -> OsmExtract:
    """Read an OpenStreetMap file, without objects that are marked as deleted.

    Raises
    ------
    InputError
        When the file is missing or incomplete, declares entities, has an invalid position, or has no nodes.
    """
    if not path.is_file():
        raise InputError(path, "no such file", _MISSING_HINT)
    limits.checked_size(path, limits.UNPACKED)
    objects = _Objects(path)
    with files.temporary_folder() as folder:
        readable = path
        if is_pbf(path):
            readable = folder / "map.osm"
            _convert_to_xml(path, readable)
        xml.scan_tags(readable, "osm", objects.add, path)
    return objects.extract()


def is_pbf(path: Path) -> bool:
    """Return whether a file starts like OpenStreetMap's PBF format, whatever its name."""
    with path.open("rb") as file:
        return b"OSMHeader" in file.read(64)


def parse_length_m(text: str) -> float | None:
    """Parse a length as in OpenStreetMap ("12", "12.5 m", "40 ft", 40'6"), in metres.

    None when the text is not a length below 1000 m.
    """
    text = text.strip()
    if match := _FEET_INCHES.fullmatch(text):
        value = (float(match[1]) + float(match[2]) / 12) * _FOOT_M
    elif match := _LENGTH.fullmatch(text):
        unit_m = 1.0 if (match[2] or "m").lower().startswith("m") else _FOOT_M
        value = float(match[1].replace(",", ".")) * unit_m
    else:
        return None
    return value if value < 1000 else None


def parse_number(text: str) -> float | None:
    """Parse a plain decimal number; None when the text is not one."""
    return float(text) if _NUMBER.fullmatch(text.strip()) else None


class _Objects:
    """Collects the objects of an XML file from its tags.

    Parameters
    ----------
    path
        The file, for messages.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._n_objects, self._most = 0, limits.MAP_OBJECTS.maximum
        self._numbers: list[int] = []
        self._lats: list[str | None] = []
        self._lons: list[str | None] = []
        self._node_tags: dict[int, Tags] = {}
        self._ways: dict[int, tuple[list[int], Tags]] = {}
        self._relations: dict[int, tuple[list[Member], Tags]] = {}
        self._bounds: Bounds | None = None
        # of the object whose parts follow
        self._kind, self._number = "", 0
        self._refs: list[int] = []
        self._members: list[Member] = []
        self._tags: Tags = {}

    def add(self, name: str, attributes: dict[str, str]) -> None:
        """Add an object, or a part of the object before."""
        if name == "nd":
            self._refs.append(self._integer("ref", attributes))
        elif name == "tag":
            self._tags[attributes.get("k", "")] = attributes.get("v", "")
        elif name in _KINDS:
            self._add_object(name, attributes)
        elif name == "member":
            number, kind = self._integer("ref", attributes), attributes.get("type", "")
            if kind not in _KINDS:
                where = f"{self._path}: {self._kind} {self._number}: type of a member"
                raise InputError(where, f"expected node, way or relation, got {kind!r}", _VALUE_HINT)
            self._members.append(Member(kind, number, attributes.get("role", "")))
        elif name == "bounds" and self._bounds is None:
            keys = "minlat", "minlon", "maxlat", "maxlon"
            south, west, north, east = (
                self._degrees("bounds", key, attributes.get(key), limit)
                for key, limit in zip(keys, (90.0, 180.0) * 2, strict=True)
            )
            self._bounds = Bounds(min(south, north), min(west, east), max(south, north), max(west, east))
        elif name == "osm" and attributes.get("version") != _VERSION:
            problem = f"{_CANNOT_READ} (expected version {_VERSION}, got {attributes.get('version')!r})"
            raise InputError(self._path, problem, _HINT)

    def _add_object(self, kind: str, attributes: dict[str, str]) -> None:
        """Add a node, way or relation; the parts that follow belong to it."""
        self._n_objects += 1
        if self._n_objects > self._most:
            hint = f"Use a smaller extract. {limits.MAP_OBJECTS.hint}"
            raise InputError(self._path, f"has more than {self._most:,} objects", hint)
        self._kind = kind
        self._number = number = self._integer("id", attributes)
        self._refs, self._members, self._tags = [], [], {}
        if attributes.get("action") == "delete" or attributes.get("visible") == "false":
            return
        if kind == "node":
            self._numbers.append(number)
            self._lats.append(attributes.get("lat"))
            self._lons.append(attributes.get("lon"))
            self._node_tags[number] = self._tags
        elif kind == "way":
            self._ways[number] = self._refs, self._tags
        else:
            self._relations[number] = self._members, self._tags

    def _integer(self, key: str, attributes: dict[str, str]) -> int:
        try:
            return int(attributes[key])
        except (KeyError, ValueError):
            where = f"<{self._kind}> id" if key == "id" else f"{self._kind} {self._number}: {key}"
            problem = f"expected a whole number, got {attributes.get(key)!r}"
            raise InputError(f"{self._path}: {where}", problem, _VALUE_HINT) from None

    def _degrees(self, title: str, key: str, text: str | None, limit: float) -> float:
        value = number_or_nan(text or "")
        if not abs(value) <= limit:
            problem = f"expected degrees from {-limit:g} to {limit:g}, got {text!r}"
            raise InputError(f"{self._path}: {title}: {key}", problem, _VALUE_HINT)
        return round(value, _DECIMALS)

    def _node_degrees(self, key: str, texts: list[str | None], limit: float) -> list[float]:
        values = np.array([number_or_nan(text or "") for text in texts])
        for index in np.flatnonzero(~(np.abs(values) <= limit))[:1]:
            self._degrees(f"node {self._numbers[index]}", key, texts[index], limit)
        rounded: list[float] = np.round(values, _DECIMALS).tolist()
        return rounded

    def extract(self) -> OsmExtract:
        """Return all objects; InputError when there are no nodes, or one has no valid position."""
        if not self._numbers:
            raise InputError(self._path, "has no nodes", _HINT)
        lats_deg, lons_deg = self._node_degrees("lat", self._lats, 90.0), self._node_degrees("lon", self._lons, 180.0)
        nodes = dict(zip(self._numbers, zip(lats_deg, lons_deg, strict=True), strict=True))
        node_tags = {number: tags for number, tags in sorted(self._node_tags.items()) if tags}
        ways = {number: Way(number, tuple(refs), tags) for number, (refs, tags) in sorted(self._ways.items())}
        relations = [Relation(number, tuple(parts), tags) for number, (parts, tags) in sorted(self._relations.items())]
        bounds = self._bounds or Bounds(min(lats_deg), min(lons_deg), max(lats_deg), max(lons_deg))
        return OsmExtract(nodes, node_tags, ways, tuple(relations), bounds, self._bounds is not None, self._path)


def _convert_to_xml(path: Path, copy: Path) -> None:
    """Write the objects of a PBF file as XML, with osmium in another process."""
    size = 0
    with closing(read_blocks(__name__, path, str(path), _CANNOT_READ)) as blocks, copy.open("wb") as file:
        for block in blocks:
            size += len(block.content)
            limits.UNPACKED.check_bytes(path, size, f"holds more than {limits.UNPACKED.maximum:,} MB")
            file.write(block.content)


# --- in the other process ---


def _read_file(path: Path) -> Generator[Block, None, None]:
    """Yield the objects of a PBF file as XML, deleted ones left out."""
    import osmium

    objects = osmium.FileProcessor(osmium.io.File(path, "pbf"))
    copy = Path(tempfile.gettempdir()) / "map.osm"
    header = osmium.io.Header()
    if (box := objects.header.box()).valid():
        header.add_box(box)
    with osmium.SimpleWriter(osmium.io.File(copy, "osm"), header=header, overwrite=True) as writer:
        for o in objects:
            if isinstance(o, osmium.osm.Changeset) or o.visible:
                writer.add(o)
    with copy.open("rb") as file:
        while chunk := file.read(limits.MB):
            yield Block({}, chunk)


def _use_one_thread() -> None:
    """Let osmium decompress in one thread: each further one takes memory from the limit."""
    os.environ["OSMIUM_POOL_THREADS"] = "1"


if __name__ == "__main__":
    serve(_read_file, _use_one_thread)
