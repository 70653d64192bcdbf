"""Read OpenStreetMap files: XML (``.osm``, may be gzipped) and PBF (``.osm.pbf``), recognised by their content.

Steps of :func:`read_osm`: check values that osmium does not check (XML only); read the objects with osmium; keep the
positions of nodes, tagged nodes, ways, relations, and the extract's bounds. :func:`write_xml` converts a PBF file to
XML.

Coordinates are latitude and longitude in degrees (WGS 84), in multiples of 1e-7 degree (1 cm), as in OpenStreetMap.
Objects are sorted by identifier, so that their order in the file does not matter. The meaning of tags:
https://wiki.openstreetmap.org/wiki/Map_features.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from egvs.core import files, limits
from egvs.core.errors import InputError
from egvs.core.numbers import number_or_nan
from egvs.core.reading import COMPLETE_FILE, translate_errors
from egvs.formats import xml
from egvs.formats.xml import PARSER_ENCODINGS

if TYPE_CHECKING:
    import osmium


Tags = dict[str, str]

_KINDS = {"n": "node", "w": "way", "r": "relation"}

_HINT = "Download the extract again, or choose one with streets (.osm, .osm.pbf)."
_MISSING_HINT = "Give the path of an extract (.osm, .osm.pbf)."
_VALUE_HINT = "Correct the object in the file, or download the extract again."

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
    """

    nodes: dict[int, tuple[float, float]]
    node_tags: dict[int, Tags]
    ways: dict[int, Way]
    relations: tuple[Relation, ...]
    bounds: Bounds
    declared: bool


def read_osm(path: Path) -> OsmExtract:
    """Read an OpenStreetMap file, without objects that are marked as deleted.

    Raises
    ------
    InputError
        When the file is missing or incomplete, declares entities, has an invalid position, or has no nodes.
    """
    if not path.is_file():
        raise InputError(path, "no such file", _MISSING_HINT)
    import osmium

    deleted = frozenset() if is_pbf(path) else _check_values_and_find_deleted(path)
    nodes: dict[int, tuple[float, float]] = {}
    node_tags: dict[int, Tags] = {}
    ways: dict[int, Way] = {}
    relations: dict[int, Relation] = {}
    limit = limits.MAP_OBJECTS.maximum
    with _open_osm(path) as objects:
        box = objects.header.box()
        for number, o in enumerate(objects):
            if number == limit:
                hint = f"Use a smaller extract. {limits.MAP_OBJECTS.hint}"
                raise InputError(path, f"has more than {limit:,} objects", hint)
            if isinstance(o, osmium.osm.Changeset) or not o.visible or (o.type_str(), o.id) in deleted:
                continue
            match o:
                case osmium.osm.Node():
                    if not o.location.valid():
                        raise InputError(f"{path}: node {o.id}", "has no valid position", _VALUE_HINT)
                    nodes[o.id] = (o.location.lat, o.location.lon)
                    if tags := dict(o.tags):
                        node_tags[o.id] = tags
                case osmium.osm.Way():
                    ways[o.id] = Way(o.id, tuple(node.ref for node in o.nodes), dict(o.tags))
                case osmium.osm.Relation():
                    members = tuple(Member(_KINDS[m.type], m.ref, m.role) for m in o.members)
                    relations[o.id] = Relation(o.id, members, dict(o.tags))
    if not nodes:
        raise InputError(path, "has no nodes", _HINT)
    node_tags = dict(sorted(node_tags.items()))
    ways = dict(sorted(ways.items()))
    ordered = tuple(relations[number] for number in sorted(relations))
    return OsmExtract(nodes, node_tags, ways, ordered, _bounds(box, nodes), box.valid())


def is_pbf(path: Path) -> bool:
    """Return whether a file starts like OpenStreetMap's PBF format, whatever its name."""
    with path.open("rb") as file:
        return b"OSMHeader" in file.read(64)


def write_xml(path: Path, xml: Path) -> None:
    """Write all objects of an OpenStreetMap file as XML, the only format that netconvert reads."""
    import osmium

    with _open_osm(path) as objects:
        header = osmium.io.Header()
        if (box := objects.header.box()).valid():
            header.add_box(box)
        with osmium.SimpleWriter(osmium.io.File(xml, "osm"), header=header, overwrite=True) as writer:
            for o in objects:
                if isinstance(o, osmium.osm.Changeset) or o.visible:
                    writer.add(o)


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


@contextmanager
def _open_osm(path: Path) -> Iterator[osmium.FileProcessor]:
    """Open a file to read its objects; osmium's errors become an InputError."""
    import osmium

    with translate_errors(path, COMPLETE_FILE, "cannot be read as OpenStreetMap data"):
        if is_pbf(path):
            yield osmium.FileProcessor(osmium.io.File(path, "pbf"))
        elif xml.file_encoding(path) in PARSER_ENCODINGS:
            yield osmium.FileProcessor(osmium.io.File(path, "osm.gz" if xml.is_gzip(path) else "osm"))
        else:
            with files.temporary_folder() as folder:
                xml.copy_as_utf8(path, folder / "map.osm")
                yield osmium.FileProcessor(osmium.io.File(folder / "map.osm", "osm"))


def _bounds(box: osmium.osm.Box, nodes: dict[int, tuple[float, float]]) -> Bounds:
    """Return the rectangle that the file declares, else that of its nodes."""
    if box.valid():
        return Bounds(box.bottom_left.lat, box.bottom_left.lon, box.top_right.lat, box.top_right.lon)
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
