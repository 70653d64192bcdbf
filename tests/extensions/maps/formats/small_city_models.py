"""Hand-made CityGML: boxes and polygons as text. Coordinates are written as they are given."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

Point = tuple[float, float, float]
Ring = Sequence[Point]

SRS = "http://www.opengis.net/def/crs/EPSG/0/6677"
"""Japan Plane Rectangular CS IX: the first axis points north."""


def polygon(outer: Ring, *holes: Ring, name: str = "", tag: str = "Polygon") -> str:
    """A polygon; its rings are closed here."""
    rings = [f"<gml:exterior>{_ring(outer)}</gml:exterior>"]
    rings += [f"<gml:interior>{_ring(hole)}</gml:interior>" for hole in holes]
    return f"<gml:{tag}{_id(name)}>{''.join(rings)}</gml:{tag}>"


def _ring(points: Ring) -> str:
    numbers = " ".join(f"{value!r}" for point in (*points, points[0]) for value in point)
    return f"<gml:LinearRing><gml:posList>{numbers}</gml:posList></gml:LinearRing>"


def _id(name: str) -> str:
    return f' gml:id="{name}"' if name else ""


def nest(content: str, *tags: str) -> str:
    """Content inside elements, the outermost first."""
    for tag in reversed(tags):
        content = f"<x:{tag}>{content}</x:{tag}>"
    return content


def multi_surface(members: Iterable[str], name: str = "") -> str:
    """Polygons, or references in the form ``#name``."""
    return f"<gml:MultiSurface{_id(name)}>{_members(members)}</gml:MultiSurface>"


def solid(members: Iterable[str]) -> str:
    """A solid from polygons, or references in the form ``#name``."""
    shell = f"<gml:CompositeSurface>{_members(members)}</gml:CompositeSurface>"
    return f"<gml:Solid><gml:exterior>{shell}</gml:exterior></gml:Solid>"


def _members(members: Iterable[str]) -> str:
    parts = []
    for member in members:
        if member.startswith("#"):
            parts.append(f'<gml:surfaceMember xlink:href="{member}"/>')
        else:
            parts.append(f"<gml:surfaceMember>{member}</gml:surfaceMember>")
    return "".join(parts)


def box_rings(low: Point, high: Point) -> list[list[Point]]:
    """The six faces of a box, facing outwards where the axes are right-handed: bottom, top, then the sides."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    return [
        [(x0, y0, z0), (x0, y1, z0), (x1, y1, z0), (x1, y0, z0)],
        [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)],
        [(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)],
        [(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)],
        [(x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1)],
        [(x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1)],
    ]


def box(low: Point, high: Point) -> list[str]:
    """The six faces of a box as polygons."""
    return [polygon(ring) for ring in box_rings(low, high)]


def city_object(tag: str, name: str, *content: str) -> str:
    """A member of the model."""
    return f"<core:cityObjectMember><x:{tag}{_id(name)}>{''.join(content)}</x:{tag}></core:cityObjectMember>"


def city_model(*members: str, srs_name: str = SRS, version: str = "2.0") -> str:
    """A whole file. The prefix of the objects is not declared, as in some real files."""
    envelope = (
        f'<gml:boundedBy><gml:Envelope srsName="{srs_name}" srsDimension="3"/></gml:boundedBy>' if srs_name else ""
    )
    namespaces = f'xmlns:core="http://www.opengis.net/citygml/{version}" xmlns:gml="http://www.opengis.net/gml"'
    body = "\n".join(members)
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<core:CityModel {namespaces}>{envelope}\n{body}\n</core:CityModel>\n'
    )


def write_model(path: Path, *members: str, srs_name: str = SRS) -> Path:
    """Write a file and return its path."""
    path.write_text(city_model(*members, srs_name=srs_name), encoding="utf-8")
    return path
