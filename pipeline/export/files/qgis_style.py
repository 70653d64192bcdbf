"""Styles as QGIS keeps them (QML), which a GeoPackage carries in its table ``layer_styles``.

A layer's rules stand for the classes of its column; where a layer has rows of every site, its rules show those of one,
and a user exchanges the name in their filters.

https://docs.qgis.org/latest/en/docs/user_manual/appendices/qgis_file_formats.html
"""

from __future__ import annotations

from xml.etree import ElementTree as ET

from pipeline.export.colouring import OTHER, PLAIN, Shade, shades
from pipeline.export.layers import FOOTPRINTS, JUNCTIONS, MISSED, MISSED_LANES, PLAN, REGION, SITES, Layer

_LABELS = {JUNCTIONS: ("title", "TR,TL,R,L,T"), SITES: ("site", "TR,TL,R,L,T"), PLAN: ("order", "BR,BL,B")}
"""The column that a thing is labelled with, and where, the best place first: a plan's sensor hangs where a site is."""
_SIZES_MM = {JUNCTIONS: "5", PLAN: "4.4", SITES: "3.4", MISSED: "2"}
_INK, _PAPER = "29,36,48,255", "255,255,255,255"


def qml(layer: Layer) -> str:
    """The style of a layer, XML text."""
    root = ET.Element(
        "qgis", version="3.22", styleCategories="Symbology|Labeling", labelsEnabled=str(int(layer.name in _LABELS))
    )
    renderer = ET.SubElement(
        root, "renderer-v2", type="RuleRenderer", symbollevels="0", forceraster="0",
        enableorderby=str(int(layer.name == SITES)),
    )  # fmt: skip
    rules = ET.SubElement(renderer, "rules", key="root")
    symbols = ET.SubElement(renderer, "symbols")
    entries = [(_filter(layer, shade), _label(shade), shade.colour) for shade in shades(layer)]
    if not entries:
        entries = [(_of_site(layer), layer.name, PLAIN.get(layer.name, OTHER))]
    for number, (wanted, label, colour) in enumerate(entries):
        rule = ET.SubElement(rules, "rule", key=f"rule{number}", symbol=str(number), label=label)
        if wanted:
            rule.set("filter", wanted)
        _symbol(symbols, str(number), layer, colour)
    if layer.name == SITES:  # of those at one place the best is seen
        order = ET.SubElement(ET.SubElement(renderer, "orderby"), "orderByClause", asc="0", nullsFirst="0")
        order.text = '"rank"'
    if layer.name in _LABELS:
        _labelling(root, *_LABELS[layer.name])
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def raster_qml(low: float, high: float, stops: list[tuple[float, str, str]]) -> str:
    """The style of a raster of one band: ``stops`` are values, colours (RRGGBB) and labels."""
    root = ET.Element("qgis", version="3.22", styleCategories="Symbology")
    renderer = ET.SubElement(
        ET.SubElement(root, "pipe"), "rasterrenderer", type="singlebandpseudocolor", band="1", opacity="1",
        alphaBand="-1", classificationMin=f"{low!r}", classificationMax=f"{high!r}", nodataColor="",
    )  # fmt: skip
    shader = ET.SubElement(
        ET.SubElement(renderer, "rastershader"), "colorrampshader", colorRampType="INTERPOLATED",
        classificationMode="1", clip="0", minimumValue=f"{low!r}", maximumValue=f"{high!r}",
    )  # fmt: skip
    for value, colour, label in stops:
        ET.SubElement(shader, "item", value=f"{value!r}", color=f"#{colour}", alpha="255", label=label)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _of_site(layer: Layer) -> str:
    return f'"site" = {_text(layer.shows)}' if layer.shows else ""


def _filter(layer: Layer, shade: Shade) -> str:
    column = '"' + layer.colours_by.replace('"', '""') + '"'
    upper = "<=" if shade.is_last else "<"
    within = f"{column} >= {shade.low!r} AND {column} {upper} {shade.high!r}"
    return " AND ".join(filter(None, (_of_site(layer), within)))


def _label(shade: Shade) -> str:
    return f"{shade.low:.4g} to {shade.high:.4g}"


def _text(value: str) -> str:
    """A text in QGIS's expressions."""
    return "'" + value.replace("\\", "\\\\").replace("'", "''") + "'"


def _symbol(symbols: ET.Element, name: str, layer: Layer, colour: str) -> None:
    rgb = ",".join(str(part) for part in bytes.fromhex(colour))
    if layer.is_of_points:
        shape = "square" if layer.name == PLAN else "circle"
        kind, drawn = "marker", "SimpleMarker"
        options = {"color": f"{rgb},255", "name": shape, "outline_color": _INK, "outline_width": "0.3",
                   "size": _SIZES_MM[layer.name], "size_unit": "MM"}  # fmt: skip
    elif layer.name == MISSED_LANES:
        kind, drawn = "line", "SimpleLine"
        options = {"line_color": f"{rgb},255", "line_width": "1.2", "line_width_unit": "MM", "capstyle": "flat"}
    else:
        kind, drawn = "fill", "SimpleFill"
        style = "no" if layer.name == REGION else "solid"
        edge = _INK if layer.name == REGION else "125,132,148,255"
        options = {"color": f"{rgb},255", "style": style, "outline_color": edge, "outline_width": "0.4",
                   "outline_style": "dash" if layer.name == REGION else "solid"}  # fmt: skip
    symbol = ET.SubElement(symbols, "symbol", name=name, type=kind, alpha="0.8" if layer.name == FOOTPRINTS else "1",
                           clip_to_extent="1", force_rhr="0")  # fmt: skip
    one = ET.SubElement(symbol, "layer", {"class": drawn, "enabled": "1", "locked": "0", "pass": "0"})
    table = ET.SubElement(one, "Option", type="Map")
    for key, value in options.items():
        ET.SubElement(table, "Option", name=key, type="QString", value=value)


def _labelling(root: ET.Element, column: str, places: str) -> None:
    settings = ET.SubElement(ET.SubElement(root, "labeling", type="simple"), "settings", calloutType="simple")
    text = ET.SubElement(settings, "text-style", fieldName=column, isExpression="0", fontSize="9", textColor=_INK)
    ET.SubElement(text, "text-buffer", bufferDraw="1", bufferSize="0.8", bufferSizeUnits="MM", bufferColor=_PAPER)
    ET.SubElement(settings, "placement", placement="6", predefinedPositionOrder=places, offsetType="1", dist="0.2")
    ET.SubElement(settings, "rendering", obstacle="0")  # else sites at one place hide the label of each other
