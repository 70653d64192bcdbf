"""What does an OpenStreetMap file say?

Steps of :func:`read`: parse as XML without entities (may be gzipped), check every number once, keep what is needed:
positions of nodes, tagged nodes, ways, relations, the extract's bounds. :func:`streets_xml` writes the streets alone,
for netconvert: so SUMO sees only what was checked here.

Frame: latitude and longitude in degrees (WGS 84). Objects are sorted by their identifiers, so that the order in the
file changes nothing. The meaning of tags: https://wiki.openstreetmap.org/wiki/Map_features."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element
from xml.sax.saxutils import quoteattr

from pipeline.core.errors import InputError
from pipeline.formats import safe_xml as safexml

Tags = dict[str, str]

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

    def holds(self, lat_deg: float, lon_deg: float) -> bool:
        """Whether a position lies inside or on the rim."""
        return self.south_deg <= lat_deg <= self.north_deg and self.west_deg <= lon_deg <= self.east_deg


@dataclass(frozen=True)
class Extract:
    """An OpenStreetMap file, read. ``declared`` is false where it names no bounds (then ``bounds`` are those of its
    nodes)."""

    nodes: dict[int, tuple[float, float]]
    node_tags: dict[int, Tags]
    ways: dict[int, Way]
    relations: tuple[Relation, ...]
    bounds: Bounds
    declared: bool


def read(path: Path) -> Extract:
    """Read an ``.osm`` file (XML, may be gzipped).

    Raises
    ------
    InputError
        When the file is missing, is no whole OpenStreetMap XML file, declares a document type or entities, or holds a
        position that is none.
    """
    if not path.is_file():
        raise InputError(path, "no such file", "an OpenStreetMap file (.osm)")
    with path.open("rb") as file:
        if b"OSMHeader" in file.read(64):
            raise InputError(path, "is in the PBF format", "XML; convert it: osmium cat in.osm.pbf -o out.osm")
    builder = _Builder(path)
    for element in safexml.children(path, "osm"):
        builder.take(element)
    return builder.extract()


def streets_xml(extract: Extract) -> str:
    """The extract's streets (ways with ``highway``), their nodes, and the turn restrictions, as an OpenStreetMap
    file."""
    streets = [way for way in extract.ways.values() if "highway" in way.tags]
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<osm version="0.6">']
    for node in sorted({n for way in streets for n in way.nodes if n in extract.nodes}):
        lat_deg, lon_deg = extract.nodes[node]
        lines.append(f'<node id="{node}" lat="{lat_deg!r}" lon="{lon_deg!r}">')
        lines += [*_tag_lines(extract.node_tags.get(node, {})), "</node>"]
    for way in streets:
        lines += [f'<way id="{way.id}">', *(f'<nd ref="{n}"/>' for n in way.nodes if n in extract.nodes)]
        lines += [*_tag_lines(way.tags), "</way>"]
    for relation in extract.relations:
        if relation.tags.get("type") == "restriction":
            lines.append(f'<relation id="{relation.id}">')
            lines += [
                f'<member type={quoteattr(kind)} ref="{ref}" role={quoteattr(role)}/>'
                for kind, ref, role in relation.members
            ]
            lines += [*_tag_lines(relation.tags), "</relation>"]
    return "\n".join([*lines, "</osm>", ""])


def length_m(text: str) -> float | None:
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


def number(text: str) -> float | None:
    """A plain decimal number; None when it is none."""
    return float(text) if _NUMBER.fullmatch(text.strip()) else None


class _Builder:
    """Collects the file's objects one by one."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._nodes: dict[int, tuple[float, float]] = {}
        self._node_tags: dict[int, Tags] = {}
        self._ways: dict[int, Way] = {}
        self._relations: dict[int, Relation] = {}
        self._bounds: Bounds | None = None

    def take(self, element: Element) -> None:
        """Take one child of <osm>; objects marked as deleted by an editor do not count."""
        if element.get("action") == "delete" or element.get("visible") == "false":
            return
        if element.tag == "node":
            self._take_node(element)
        elif element.tag == "way":
            way = Way(self._id(element), tuple(self._ref(element, nd) for nd in element.iter("nd")), _tags(element))
            self._ways[way.id] = way
        elif element.tag == "relation":
            members = tuple(
                (m.get("type", ""), self._ref(element, m), m.get("role", "")) for m in element.iter("member")
            )
            relation = Relation(self._id(element), members, _tags(element))
            self._relations[relation.id] = relation
        elif element.tag == "bounds":
            keys = (("minlat", 90.0), ("minlon", 180.0), ("maxlat", 90.0), ("maxlon", 180.0))
            self._bounds = Bounds(*(self._degrees(element, key, limit) for key, limit in keys))

    def extract(self) -> Extract:
        """What was collected, sorted."""
        if not self._nodes:
            raise InputError(self._path, "holds no node", "an OpenStreetMap extract with streets")
        lats, lons = zip(*self._nodes.values(), strict=True)
        bounds = self._bounds or Bounds(min(lats), min(lons), max(lats), max(lons))
        return Extract(
            self._nodes, dict(sorted(self._node_tags.items())), dict(sorted(self._ways.items())),
            tuple(r for _, r in sorted(self._relations.items())), bounds, self._bounds is not None,
        )  # fmt: skip

    def _take_node(self, element: Element) -> None:
        identifier = self._id(element)
        self._nodes[identifier] = (self._degrees(element, "lat", 90.0), self._degrees(element, "lon", 180.0))
        if tags := _tags(element):
            self._node_tags[identifier] = tags

    def _id(self, element: Element) -> int:
        return self._integer(element.get("id"), f"<{element.tag}> id")

    def _ref(self, element: Element, member: Element) -> int:
        return self._integer(member.get("ref"), f"{element.tag} {element.get('id')}: ref")

    def _integer(self, text: str | None, key: str) -> int:
        try:
            return int(text or "")
        except ValueError:
            raise InputError(f"{self._path}: {key}", repr(text), "a whole number") from None

    def _degrees(self, element: Element, key: str, limit: float) -> float:
        text = element.get(key)
        try:
            value = float(text or "")
        except ValueError:
            value = math.nan
        if not abs(value) <= limit:
            place = f"{self._path}: {element.tag} {element.get('id', '')}".rstrip()
            raise InputError(f"{place}: {key}", repr(text), f"degrees from {-limit:g} to {limit:g}")
        return value


def _tags(element: Element) -> Tags:
    return {tag.get("k", ""): tag.get("v", "") for tag in element.iter("tag")}


def _tag_lines(tags: Tags) -> list[str]:
    return [f"<tag k={quoteattr(key)} v={quoteattr(value)}/>" for key, value in sorted(tags.items())]
