"""OpenStreetMap files are read here: XML (``.osm``, may be gzipped) and PBF (``.osm.pbf``), by what they hold, whatever
they are called.

Steps of :func:`read_osm`: check what osmium would let pass (XML only); let osmium read the objects; keep what is
needed:
positions of nodes, tagged nodes, ways, relations, the extract's bounds. :func:`write_streets` writes the streets
alone, for netconvert: so SUMO sees only what was checked here. :func:`write_xml` writes all of a PBF file as XML.

Frame: latitude and longitude in degrees (WGS 84), whole numbers of 1e-7 degree (1 cm), as OpenStreetMap keeps them.
Objects are sorted by their identifiers, so that the order in the file changes nothing. The meaning of tags:
https://wiki.openstreetmap.org/wiki/Map_features.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from egvs.core import files, limits
from egvs.core.errors import InputError
from egvs.core.reading import translate_errors
from egvs.formats import xml
from egvs.formats.xml import PARSER_ENCODINGS

if TYPE_CHECKING:
    import osmium


Tags = dict[str, str]

_KINDS = {"n": "node", "w": "way", "r": "relation"}

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
        """Whether the way is a ring round an area."""
        return len(self.nodes) >= 4 and self.nodes[0] == self.nodes[-1]


@dataclass(frozen=True)
class Relation:
    """A relation with its members: (type, identifier, role)."""

    id: int
    members: tuple[tuple[str, int, str], ...]
    tags: Tags

    def ways(self, *roles: str) -> list[int]:
        """Its members that are ways in one of these roles."""
        return [ref for kind, ref, role in self.members if kind == "way" and role in roles]


@dataclass(frozen=True)
class Bounds:
    """The rectangle that an extract covers, degrees."""

    south_deg: float
    west_deg: float
    north_deg: float
    east_deg: float

    def contains(self, lat_deg: float, lon_deg: float) -> bool:
        """Whether a position lies inside or on the rim."""
        return self.south_deg <= lat_deg <= self.north_deg and self.west_deg <= lon_deg <= self.east_deg


@dataclass(frozen=True)
class OsmExtract:
    """An OpenStreetMap file, read; ``bounds`` are those that it has ``declared``, else those of its nodes."""

    nodes: dict[int, tuple[float, float]]
    node_tags: dict[int, Tags]
    ways: dict[int, Way]
    relations: tuple[Relation, ...]
    bounds: Bounds
    declared: bool


def read_osm(path: Path) -> OsmExtract:
    """Read an OpenStreetMap file; objects that are marked as deleted do not count.

    Raises
    ------
    InputError
        When the file is missing, is no whole OpenStreetMap file, declares entities, or holds a position that is none.
    """
    if not path.is_file():
        raise InputError(path, "no such file", "an OpenStreetMap file (.osm, .osm.pbf)")
    import osmium

    deleted = frozenset() if is_pbf(path) else _check_xml(path)
    nodes, node_tags = dict[int, tuple[float, float]](), dict[int, Tags]()
    ways, relations = dict[int, Way](), dict[int, Relation]()
    most = limits.MAP_OBJECTS.maximum
    with _open_osm(path) as objects:
        box = objects.header.box()
        for number, o in enumerate(objects):
            if number == most:
                raise InputError(
                    path, f"has more than {most:,} objects", f"Use a part of the map. {limits.MAP_OBJECTS.hint}"
                )
            if isinstance(o, osmium.osm.Changeset) or not o.visible or (o.type_str(), o.id) in deleted:
                continue
            match o:
                case osmium.osm.Node():
                    if not o.location.valid():
                        problem = "has no position on the globe"
                        raise InputError(f"{path}: node {o.id}", problem, "a latitude and a longitude")
                    nodes[o.id] = (o.location.lat, o.location.lon)
                    if tags := dict(o.tags):
                        node_tags[o.id] = tags
                case osmium.osm.Way():
                    ways[o.id] = Way(o.id, tuple(node.ref for node in o.nodes), dict(o.tags))
                case osmium.osm.Relation():
                    members = tuple((_KINDS[m.type], m.ref, m.role) for m in o.members)
                    relations[o.id] = Relation(o.id, members, dict(o.tags))
    if not nodes:
        raise InputError(path, "holds no node", "an OpenStreetMap extract with streets")
    return OsmExtract(
        nodes, dict(sorted(node_tags.items())), dict(sorted(ways.items())),
        tuple(relation for _, relation in sorted(relations.items())), _bounds(box, nodes), box.valid(),
    )  # fmt: skip


def is_pbf(path: Path) -> bool:
    """Whether the file's first bytes are those of OpenStreetMap's PBF format, whatever its name says."""
    with path.open("rb") as file:
        return b"OSMHeader" in file.read(64)


def write_xml(path: Path, xml: Path) -> None:
    """Write all objects of an OpenStreetMap file as XML, for programs that read nothing else (netconvert)."""
    import osmium

    with _open_osm(path) as objects:
        header = osmium.io.Header()
        if (box := objects.header.box()).valid():
            header.add_box(box)
        with osmium.SimpleWriter(osmium.io.File(xml, "osm"), header=header, overwrite=True) as writer:
            for o in objects:
                if isinstance(o, osmium.osm.Changeset) or o.visible:
                    writer.add(o)


def write_streets(extract: OsmExtract, xml: Path) -> None:
    """Write the streets (ways with ``highway``), their nodes, and the turn restrictions as an OpenStreetMap file."""
    import osmium
    from osmium.osm import mutable

    streets = [way for way in extract.ways.values() if "highway" in way.tags]
    with osmium.SimpleWriter(osmium.io.File(xml, "osm")) as writer:
        for node in sorted({n for way in streets for n in way.nodes if n in extract.nodes}):
            lat_deg, lon_deg = extract.nodes[node]
            tags = sorted(extract.node_tags.get(node, {}).items())
            writer.add_node(mutable.Node(id=node, location=(lon_deg, lat_deg), tags=tags))
        for way in streets:
            nodes = [n for n in way.nodes if n in extract.nodes]
            writer.add_way(mutable.Way(id=way.id, nodes=nodes, tags=sorted(way.tags.items())))
        for relation in extract.relations:
            if relation.tags.get("type") == "restriction":
                members = [(kind[0], ref, role) for kind, ref, role in relation.members]
                tags = sorted(relation.tags.items())
                writer.add_relation(mutable.Relation(id=relation.id, members=members, tags=tags))


def parse_length_m(text: str) -> float | None:
    """A length as OpenStreetMap writes it ("12", "12.5 m", "40 ft", 40'6"), in metres.

    None when the text is no length, or one of 1000 m and more.
    """
    text = text.strip()
    if match := _FEET_INCHES.fullmatch(text):
        value = (float(match[1]) + float(match[2]) / 12) * _FOOT_M
    elif match := _LENGTH.fullmatch(text):
        unit = (match[2] or "m").lower()
        value = float(match[1].replace(",", ".")) * (1.0 if unit.startswith("m") else _FOOT_M)
    else:
        return None
    return value if value < 1000 else None


def parse_number(text: str) -> float | None:
    """A plain decimal number; None when it is none."""
    return float(text) if _NUMBER.fullmatch(text.strip()) else None


@contextmanager
def _open_osm(path: Path) -> Iterator[osmium.FileProcessor]:
    """The file's objects; what osmium says against them becomes an InputError."""
    import osmium

    with translate_errors(path, "a whole file; fetch it again", "cannot be read as OpenStreetMap data"):
        if is_pbf(path):
            yield osmium.FileProcessor(osmium.io.File(path, "pbf"))
        elif xml.file_encoding(path) in PARSER_ENCODINGS:
            yield osmium.FileProcessor(osmium.io.File(path, "osm.gz" if xml.is_gzip(path) else "osm"))
        else:
            with files.temporary_folder() as folder:
                xml.copy_as_utf8(path, folder / "map.osm")
                yield osmium.FileProcessor(osmium.io.File(folder / "map.osm", "osm"))


def _bounds(box: osmium.osm.Box, nodes: dict[int, tuple[float, float]]) -> Bounds:
    """The rectangle that the file declares, else that of its nodes."""
    if box.valid():
        return Bounds(box.bottom_left.lat, box.bottom_left.lon, box.top_right.lat, box.top_right.lon)
    lats, lons = zip(*nodes.values(), strict=True)
    return Bounds(min(lats), min(lons), max(lats), max(lons))


def _check_xml(path: Path) -> frozenset[tuple[str, int]]:
    """Refuse what osmium would take for 0, or complain of without naming the object.

    Returns what an editor has marked as deleted, which osmium does not see: (first letter of its type, identifier).
    """
    deleted = set()
    for element in xml.iter_elements(path, "osm"):
        name = element.get("id", "")
        if element.tag in _KINDS.values():
            identifier = _integer(path, f"<{element.tag}> id", element.get("id"))
            if element.get("action") == "delete":
                deleted.add((element.tag[0], identifier))
            elif element.tag == "node" and element.get("visible") != "false":
                _degrees(path, f"node {name}: lat", element.get("lat"), 90.0)
                _degrees(path, f"node {name}: lon", element.get("lon"), 180.0)
            for member in element:
                if member.tag != "tag":
                    _integer(path, f"{element.tag} {name}: ref", member.get("ref"))
        elif element.tag == "bounds":
            for key, limit in (("minlat", 90.0), ("minlon", 180.0), ("maxlat", 90.0), ("maxlon", 180.0)):
                _degrees(path, f"bounds: {key}", element.get(key), limit)
    return frozenset(deleted)


def _integer(path: Path, key: str, text: str | None) -> int:
    try:
        return int(text or "")
    except ValueError:
        raise InputError(f"{path}: {key}", repr(text), "a whole number") from None


def _degrees(path: Path, key: str, text: str | None, limit: float) -> None:
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not abs(value) <= limit:
        raise InputError(f"{path}: {key}", repr(text), f"degrees from {-limit:g} to {limit:g}")
