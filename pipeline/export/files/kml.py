"""Writes layers as one KML document that Google Earth colours: a folder a layer, of blind spots one a site.

KML knows degrees only. Sensors hang at their height above the ground as the scenario has it.

https://docs.ogc.org/is/12-007r2/12-007r2.html
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from pipeline.export.colouring import colour
from pipeline.export.layers import FOOTPRINTS, JUNCTIONS, MISSED, MISSED_LANES, PLAN, REGION, SITES, Layer
from pipeline.export.reference import Reference

_NAMESPACE = "http://www.opengis.net/kml/2.2"
_DOT = "http://maps.google.com/mapfiles/kml/shapes/placemark_circle.png"
"""Google Earth's own round mark; where it is not to be had, a mark of the program's stands there."""

_NONE = re.compile("[\x00-\x08\x0b-\x1f\ud800-\udfff\ufffe\uffff]")
"""Signs that XML cannot hold."""
_TITLES = {
    SITES: "site", PLAN: "site", MISSED: "words", MISSED_LANES: "words", FOOTPRINTS: "name", REGION: "name",
    JUNCTIONS: "junction",
}  # fmt: skip
"""The column that a thing is called by."""
_ALPHA = {FOOTPRINTS: "a0", REGION: "00"}


def write(path: Path, name: str, layers: Sequence[Layer], reference: Reference) -> None:
    """Write a document; ``reference`` is in degrees."""
    root = ET.Element("kml", xmlns=_NAMESPACE)
    document = ET.SubElement(root, "Document")
    ET.SubElement(document, "name").text = _clean(name)
    used: dict[str, tuple[Layer, str]] = {}
    for layer in layers:
        folder = ET.SubElement(document, "Folder")
        ET.SubElement(folder, "name").text = layer.name
        folders: dict[str, ET.Element] = {}
        for row, shape in zip(layer.rows.to_pylist(), reference.geometries(layer.geometries), strict=True):
            into, site = folder, row["site"] if layer.shows else ""
            if layer.shows:
                if site not in folders:
                    folders[site] = ET.SubElement(folder, "Folder")
                    ET.SubElement(folders[site], "name").text = _clean(site)
                into = folders[site]
            paint = colour(layer, row.get(layer.colours_by))
            used.setdefault(style := f"{layer.name}-{paint}", (layer, paint))
            _placemark(into, layer, row, shape, style, site == layer.shows)
    for number, (style, (layer, paint)) in enumerate(used.items(), start=1):
        document.insert(number, _style(style, layer, paint))
    ET.indent(root)
    path.write_bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


def _placemark(
    folder: ET.Element, layer: Layer, row: Mapping[str, Any], shape: Any, style: str, is_shown: bool
) -> None:
    mark = ET.SubElement(folder, "Placemark")
    ET.SubElement(mark, "name").text = _clean(str(row[_TITLES[layer.name]]))
    ET.SubElement(mark, "visibility").text = str(int(is_shown))
    ET.SubElement(mark, "styleUrl").text = f"#{style}"
    extended = ET.SubElement(mark, "ExtendedData")
    for key, value in row.items():
        if value is not None:
            data = ET.SubElement(extended, "Data", name=_clean(key))
            ET.SubElement(data, "value").text = _clean(repr(value) if isinstance(value, float) else str(value))
    _geometry(mark, shape, row.get("z_m") if layer.is_of_points else None)


def _geometry(parent: ET.Element, shape: Any, z_m: float | None) -> None:
    import shapely

    match shape.geom_type:
        case "Point":
            point = ET.SubElement(parent, "Point")
            if z_m is not None:
                ET.SubElement(point, "extrude").text = "1"
                ET.SubElement(point, "altitudeMode").text = "relativeToGround"
            ET.SubElement(point, "coordinates").text = _coordinates(shape, z_m)
        case "LineString":
            line = ET.SubElement(parent, "LineString")
            ET.SubElement(line, "tessellate").text = "1"
            ET.SubElement(line, "coordinates").text = _coordinates(shape)
        case "Polygon":
            polygon = ET.SubElement(parent, "Polygon")
            for ring, where in ((shape.exterior, "outer"), *((hole, "inner") for hole in shape.interiors)):
                border = ET.SubElement(polygon, f"{where}BoundaryIs")
                ET.SubElement(ET.SubElement(border, "LinearRing"), "coordinates").text = _coordinates(ring)
        case _:
            several = ET.SubElement(parent, "MultiGeometry")
            for part in shapely.get_parts(shape):
                _geometry(several, part, z_m)


def _coordinates(shape: Any, z_m: float | None = None) -> str:
    import shapely

    height = "" if z_m is None else f",{z_m!r}"
    return " ".join(f"{x!r},{y!r}{height}" for x, y in shapely.get_coordinates(shape).tolist())


def _style(name: str, layer: Layer, paint: str) -> ET.Element:
    """Colours are written alpha, blue, green, red."""
    code = f"ff{paint[4:]}{paint[2:4]}{paint[:2]}"
    style = ET.Element("Style", id=name)
    icon = ET.SubElement(style, "IconStyle")
    ET.SubElement(icon, "color").text = code
    ET.SubElement(icon, "scale").text = "0.8" if layer.name == MISSED else "1.1"
    ET.SubElement(ET.SubElement(icon, "Icon"), "href").text = _DOT
    line = ET.SubElement(style, "LineStyle")
    ET.SubElement(line, "color").text = code
    ET.SubElement(line, "width").text = "5" if layer.name == MISSED_LANES else "2"
    ET.SubElement(ET.SubElement(style, "PolyStyle"), "color").text = _ALPHA.get(layer.name, "ff") + code[2:]
    return style


def _clean(text: str) -> str:
    """A text without signs that XML cannot hold."""
    return _NONE.sub("", text)
