"""Read OpenStreetMap files: XML (``.osm``, may be gzipped) and PBF (``.osm.pbf``), recognised by their content.

Steps of :func:`read_osm`: check values that osmium does not check (XML only); read the objects with osmium, in a
process of its own (:mod:`egvs.formats.reader_process`); keep the positions of nodes, tagged nodes, ways, relations, and
the extract's bounds. :func:`write_xml` converts a PBF file to XML.

Coordinates are latitude and longitude in degrees (WGS 84), in multiples of 1e-7 degree (1 cm), as in OpenStreetMap.
Objects are sorted by identifier, so that their order in the file does not matter. The meaning of tags:
https://wiki.openstreetmap.org/wiki/Map_features.
"""

from __future__ import annotations

import json
import os
import re
import sys
import tempfile
from collections.abc import Generator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from egvs.core import files, limits
from egvs.core.errors import InputError
from egvs.core.numbers import number_or_nan
from egvs.formats import xml
from egvs.formats.reader_process import Block, read_blocks, serve
from egvs.formats.xml import PARSER_ENCODINGS

if TYPE_CHECKING:
    import osmium


Tags = dict[str, str]

_KINDS = {"n": "node", "w": "way", "r": "relation"}

_HINT = "Download the extract again, or choose one with streets (.osm, .osm.pbf)."
_MISSING_HINT = "Give the path of an extract (.osm, .osm.pbf)."
_VALUE_HINT = "Correct the object in the file, or download the extract again."

_CANNOT_READ = "cannot be read as OpenStreetMap data"
_STEPS_PER_DEG = 10_000_000
_RECORDS_AT_ONCE = 100_000

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


def read_osm(path: Path) -> OsmExtract:
    """Read an OpenStreetMap file, without objects that are marked as deleted.

    Raises
    ------
    InputError
        When the file is missing or incomplete, declares entities, has an invalid position, or has no nodes.
    """
    if not path.is_file():
        raise InputError(path, "no such file", _MISSING_HINT)
    deleted = frozenset() if is_pbf(path) else _check_values_and_find_deleted(path)
    nodes: dict[int, tuple[float, float]] = {}
    node_tags: dict[int, Tags] = {}
    ways: dict[int, Way] = {}
    relations: dict[int, Relation] = {}
    with closing(_read_objects(path, "records")) as blocks:
        header = next(blocks, None)
        box = header.values["box"] if header is not None else None
        for block in blocks:
            match block.values["type"]:
                case "nodes":
                    _add_nodes(path, block.content, deleted, nodes)
                case "tags":
                    node_tags |= {
                        node: tags for node, tags in json.loads(bytes(block.content)) if ("n", node) not in deleted
                    }
                case "ways":
                    for number, refs, tags in json.loads(bytes(block.content)):
                        if ("w", number) not in deleted:
                            ways[number] = Way(number, tuple(refs), tags)
                case "relations":
                    for number, members, tags in json.loads(bytes(block.content)):
                        if ("r", number) not in deleted:
                            relations[number] = Relation(number, tuple(Member(*member) for member in members), tags)
    if not nodes:
        raise InputError(path, "has no nodes", _HINT)
    node_tags = dict(sorted(node_tags.items()))
    ways = dict(sorted(ways.items()))
    ordered = tuple(relations[number] for number in sorted(relations))
    return OsmExtract(nodes, node_tags, ways, ordered, _bounds(box, nodes), box is not None, path)


def is_pbf(path: Path) -> bool:
    """Return whether a file starts like OpenStreetMap's PBF format, whatever its name."""
    with path.open("rb") as file:
        return b"OSMHeader" in file.read(64)


def write_xml(path: Path, xml: Path) -> None:
    """Write all objects of an OpenStreetMap file as XML, the only format that netconvert reads."""
    with closing(_read_objects(path, "xml")) as blocks, xml.open("wb") as file:
        for block in blocks:
            file.write(block.content)


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


def _read_objects(path: Path, answer: str) -> Generator[Block, None, None]:
    """Yield what another process reads with osmium, as :func:`_read_file` describes it."""
    with ExitStack() as stack:
        readable, form = path, "pbf"
        if not is_pbf(path):
            form = "osm.gz" if xml.is_gzip(path) else "osm"
            if xml.file_encoding(path) not in PARSER_ENCODINGS:
                readable, form = stack.enter_context(files.temporary_folder()) / "map.osm", "osm"
                xml.copy_as_utf8(path, readable)
        size = 0
        for block in read_blocks(__name__, readable, str(path), _CANNOT_READ, [form, answer]):
            size += len(block.content)
            limits.UNPACKED.check_bytes(path, size, f"holds more than {limits.UNPACKED.maximum:,} MB")
            yield block


def _add_nodes(
    path: Path, content: bytes | memoryview, deleted: frozenset[tuple[str, int]], nodes: dict[int, tuple[float, float]]
) -> None:
    """Add the positions of a block of nodes."""
    numbers, lats, lons = np.frombuffer(content, dtype="<i8").reshape(3, -1)
    if deleted:
        is_deleted = np.isin(numbers, [number for kind, number in deleted if kind == "n"])
        numbers, lats, lons = numbers[~is_deleted], lats[~is_deleted], lons[~is_deleted]
    is_valid = (np.abs(lats) <= 90 * _STEPS_PER_DEG) & (np.abs(lons) <= 180 * _STEPS_PER_DEG)
    if not is_valid.all():
        raise InputError(f"{path}: node {numbers[~is_valid][0]}", "has no valid position", _VALUE_HINT)
    positions = zip((lats / _STEPS_PER_DEG).tolist(), (lons / _STEPS_PER_DEG).tolist(), strict=True)
    nodes.update(zip(numbers.tolist(), positions, strict=True))


def _bounds(box: list[float] | None, nodes: dict[int, tuple[float, float]]) -> Bounds:
    """Return the rectangle that the file declares, else that of its nodes."""
    if box is not None:
        return Bounds(*box)
    lats, lons = zip(*nodes.values(), strict=True)
    return Bounds(min(lats), min(lons), max(lats), max(lons))


def _check_values_and_find_deleted(path: Path) -> frozenset[tuple[str, int]]:
    """Reject values that osmium reads as 0, or whose object its messages do not name.

    Returns the objects that an editor has marked as deleted, which osmium ignores: (first letter of type, identifier).
    """
    deleted = set()
    for element in xml.iter_elements(path, "osm"):
        name = element.get("id", "")
        if element.tag in _KINDS.values():
            identifier = _parse_integer(path, f"<{element.tag}> id", element.get("id"))
            if element.get("action") == "delete":
                deleted.add((element.tag[0], identifier))
            elif element.tag == "node" and element.get("visible") != "false":
                _check_degrees(path, f"node {name}: lat", element.get("lat"), 90.0)
                _check_degrees(path, f"node {name}: lon", element.get("lon"), 180.0)
            for member in element:
                if member.tag != "tag":
                    _parse_integer(path, f"{element.tag} {name}: ref", member.get("ref"))
        elif element.tag == "bounds":
            for key, limit in (("minlat", 90.0), ("minlon", 180.0), ("maxlat", 90.0), ("maxlon", 180.0)):
                _check_degrees(path, f"bounds: {key}", element.get(key), limit)
    return frozenset(deleted)


def _parse_integer(path: Path, key: str, text: str | None) -> int:
    try:
        return int(text or "")
    except ValueError:
        raise InputError(f"{path}: {key}", f"expected a whole number, got {text!r}", _VALUE_HINT) from None


def _check_degrees(path: Path, key: str, text: str | None, limit: float) -> None:
    value = number_or_nan(text or "")
    if not abs(value) <= limit:
        problem = f"expected degrees from {-limit:g} to {limit:g}, got {text!r}"
        raise InputError(f"{path}: {key}", problem, _VALUE_HINT)


# --- in the other process ---


def _read_file(path: Path) -> Generator[Block, None, None]:
    """Yield the objects of a file, deleted ones left out: as records, or as XML.

    Records: a block with the declared bounds (south, west, north, east in degrees, or None), then blocks of nodes
    (identifiers, latitudes and longitudes in multiples of 1e-7 degree, (3, n) int64), and blocks of tags, ways and
    relations as lists in JSON.
    """
    import osmium

    form, answer = sys.argv[2:]
    objects = osmium.FileProcessor(osmium.io.File(path, form))
    yield from _xml_blocks(objects) if answer == "xml" else _record_blocks(objects, path)


def _xml_blocks(objects: osmium.FileProcessor) -> Generator[Block, None, None]:
    import osmium

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


def _record_blocks(objects: osmium.FileProcessor, path: Path) -> Generator[Block, None, None]:
    box = objects.header.box()
    corners = (box.bottom_left, box.top_right)
    yield Block({"box": [degrees for at in corners for degrees in (at.lat, at.lon)] if box.valid() else None})

    records = _Records()
    limit = limits.MAP_OBJECTS.maximum
    for number, o in enumerate(objects):
        if number == limit:
            hint = f"Use a smaller extract. {limits.MAP_OBJECTS.hint}"
            raise InputError(path, f"has more than {limit:,} objects", hint)
        records.add(o)
        if records.size >= _RECORDS_AT_ONCE:
            yield from records.blocks()
            records = _Records()
    yield from records.blocks()


class _Records:
    """Objects of a file as numbers and lists.

    Attributes
    ----------
    size
        Number of nodes, references, members and tags.
    """

    def __init__(self) -> None:
        self.size = 0
        self._nodes: tuple[list[int], list[int], list[int]] = ([], [], [])
        self._lists: dict[str, list[Any]] = {"tags": [], "ways": [], "relations": []}

    def add(self, o: Any) -> None:
        """Add an object; changesets and deleted objects are ignored."""
        kind = o.type_str()
        if kind == "c" or not o.visible:
            return
        tags = dict(o.tags) if len(o.tags) else {}
        self.size += 1 + len(tags)
        if kind == "n":
            location = o.location
            for values, value in zip(self._nodes, (o.id, location.y, location.x), strict=True):
                values.append(value)
            if tags:
                self._lists["tags"].append((o.id, tags))
        elif kind == "w":
            refs = [node.ref for node in o.nodes]
            self.size += len(refs)
            self._lists["ways"].append((o.id, refs, tags))
        else:
            members = [(_KINDS[member.type], member.ref, member.role) for member in o.members]
            self.size += len(members)
            self._lists["relations"].append((o.id, members, tags))

    def blocks(self) -> Generator[Block, None, None]:
        """Yield what has been added."""
        if self._nodes[0]:
            yield Block({"type": "nodes"}, np.array(self._nodes, dtype="<i8").tobytes())
        for kind, rows in self._lists.items():
            if rows:
                yield Block({"type": kind}, json.dumps(rows).encode())


def _use_one_thread() -> None:
    """Let osmium decompress in one thread: each further one takes memory from the limit."""
    os.environ["OSMIUM_POOL_THREADS"] = "1"


if __name__ == "__main__":
    serve(_read_file, _use_one_thread)
