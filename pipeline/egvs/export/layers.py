"""Vector layers of a run or a city, their colours and QGIS styles.

The vector layers of a run: candidate sites, the plan, where vehicles are missed, footprints, the region.

Geometries are shapely's, in the world frame, metres, seen from above. A column is named with its unit, as in the
artefacts.

The vector layers of a city's run: junctions, the plan, the candidate sites of all junctions.

The colours of exported layers: those of the report, in a few even classes.

Styles as QGIS keeps them (QML), which a GeoPackage carries in its table ``layer_styles``.

A layer's rules stand for the classes of its column; where a layer has rows of every site, its rules show those of one,
and a user exchanges the name in their filters.

https://docs.qgis.org/latest/en/docs/user_manual/appendices/qgis_file_formats.html
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.artefacts.readers import read_placement
from egvs.artefacts.run_folder import PLACEMENT_FILES, RunFolder
from egvs.city import results
from egvs.core.errors import InputError
from egvs.export.finished_run import FinishedRun
from egvs.report import colours
from egvs.report.basemap import network_file, union_of_triangles
from egvs.traffic import network

JUNCTIONS, SITES, PLAN, MISSED, MISSED_LANES, FOOTPRINTS, REGION = NAMES = (
    "junctions", "sites", "plan", "blindspots", "blindspot_lanes", "footprints", "region",
)  # fmt: skip
"""Layers, those on top first; a city's run alone has junctions."""

_GROUND, _CELL, _LANE = "ground", "cell", "lane"
_RESERVED = ("fid", "ogc_fid", "geom", "geometry", "wkt")
"""Names of columns that some formats have of their own."""


@dataclass(frozen=True)
class Layer:
    """Things of one kind on a map.

    Attributes
    ----------
    name
        One of :data:`NAMES`.
    geometries
        (n,) shapely geometries of one kind, world frame.
    rows
        What is known of each, n rows.
    colours_by
        The column that colours it; empty where all look the same.
    emphasises_low
        Whether small values of that column are the dark ones.
    initial_site
        The site whose rows a map shows at first, of a layer that has rows of each site; empty for all.
    """

    name: str
    geometries: NDArray[np.object_]
    rows: pa.Table
    colours_by: str = ""
    emphasises_low: bool = False
    initial_site: str = ""

    @property
    def has_points(self) -> bool:
        """Whether its geometries are points."""
        return self.name in (JUNCTIONS, SITES, PLAN, MISSED)

    @property
    def span(self) -> tuple[float, float] | None:
        """The lowest and the highest value of ``colours_by``; None where they do not differ, or there are none."""
        if not self.colours_by or self.colours_by not in self.rows.column_names:
            return None
        found = pc.min_max(self.rows.column(self.colours_by)).as_py()
        low, high = found["min"], found["max"]
        return (low, high) if low is not None and high > low else None


def run_layers(run: FinishedRun) -> tuple[list[Layer], list[str]]:
    """The layers that a run has, those on top first, and what was left out and why, in words."""
    notes: list[str] = []
    makers: tuple[Callable[[FinishedRun, list[str]], Iterator[Layer]], ...] = (
        _site_layers, _plan_layers, _blindspot_layers, _footprint_layers, _region_layers,
    )  # fmt: skip
    return [layer for make in makers for layer in make(run, notes)], notes


def best_site(run: FinishedRun) -> str:
    """The first of the sites of rank 1."""
    scores = parquet.read_artefact(run.artefact(RunFolder.scores.name), "scores")[0]
    ranked = zip(scores.column("rank").to_pylist(), scores.column("site").to_pylist(), strict=True)
    return str(min(ranked, key=lambda row: row[0])[1])


def _site_layers(run: FinishedRun, notes: list[str]) -> Iterator[Layer]:
    del notes
    scores, about = parquet.read_artefact(run.artefact(RunFolder.scores.name), "scores")
    first = ["rank", *(name for name in scores.column_names if name != "rank")]
    rows = _with_periods(run, scores.select(first))
    yield Layer(SITES, point_geometries(scores), to_plain_table(rows), about.get("rank_by", "egvs"))


def _with_periods(run: FinishedRun, scores: pa.Table) -> pa.Table:
    """Beside the scores those of each period alone, where traffic has periods: ``rank_in_morning``."""
    if RunFolder.scores_by_period.name not in run.record.stages["score"].artefacts:
        return scores
    alone = parquet.read_artefact(run.artefact(RunFolder.scores_by_period.name), "scores_by_period")[0]
    for period in alone.column("period").unique().to_pylist():
        its = alone.filter(pc.equal(alone.column("period"), period)).drop_columns(["period"])
        row = pc.index_in(scores.column("site"), its.column("site").combine_chunks())
        for name in its.drop_columns(["site"]).column_names:
            scores = scores.append_column(f"{name}_in_{period}", its.column(name).take(row))
    return scores


def _plan_layers(run: FinishedRun, notes: list[str]) -> Iterator[Layer]:
    found = read_placement(*(run.work.path(name) for name in PLACEMENT_FILES))
    if found is None:
        return
    rows, _, about = found
    if any(name not in run.record.stages or run.record.stages[name].inputs != key
           for name, key in about["stages"].items()):  # fmt: skip
        notes.append("the plan is left out: it was made of other traffic, sites or settings; egvs place makes it anew")
        return
    table = pa.Table.from_pylist(rows)
    yield Layer(PLAN, point_geometries(table), to_plain_table(table))


def _blindspot_layers(run: FinishedRun, notes: list[str]) -> Iterator[Layer]:
    """Places as points; lanes along their middle line too."""
    if not run.scenario.score.blindspots:
        notes.append("blind spots are left out: score.blindspots is off")
        return
    table, _ = parquet.read_artefact(run.artefact(RunFolder.blindspots.name), "blindspots")
    places = table.filter(pc.not_equal(table.column("by"), _CELL)).drop_columns(["ix", "iy"])
    best = best_site(run)
    yield Layer(MISSED, point_geometries(places), to_plain_table(places), "share_seen", True, best)
    lines = _lanes_of(run)
    known = [by == _LANE and name in lines for by, name in _pairs(places)]
    lanes = places.filter(pa.array(known, pa.bool_()))
    if len(lanes):
        along = np.array([lines[name] for _, name in _pairs(lanes)], dtype=object)
        yield Layer(MISSED_LANES, along, to_plain_table(lanes), "share_seen", True, best)


def _pairs(places: pa.Table) -> Iterator[tuple[str, str]]:
    return zip(places.column("by").to_pylist(), places.column("place").to_pylist(), strict=True)


def _lanes_of(run: FinishedRun) -> dict[str, Any]:
    """The middle line of each lane of the network that SUMO drove on, by SUMO's id; none where it did not run."""
    import shapely

    if (path := network_file(run.work.folder.path)) is None:
        return {}
    run.work.digest(path.relative_to(run.work.folder.path).as_posix())
    roads = network.read_net_xml(path)
    lanes = ((f"{edge.id}_{which}", lane.shape_m) for edge in roads.edges for which, lane in enumerate(edge.lanes))
    return {name: shapely.LineString(shape_m[:, :2]) for name, shape_m in lanes if len(shape_m) > 1}


def _footprint_layers(run: FinishedRun, notes: list[str]) -> Iterator[Layer]:
    """Each solid of the static world from above, with its lowest and its highest point; without the ground."""
    import shapely

    del notes
    run.artefact(RunFolder.statics.name)
    world = run.work.world
    if not len(world.faces):
        return
    low, high = world.bounds_xy_m
    (x0, y0), (x1, y1) = (low.min(axis=0) - 1.0).tolist(), (high.max(axis=0) + 1.0).tolist()
    box = x0, y0, x1, y1
    order = np.argsort(world.solid_of_face, kind="stable")
    starts = np.flatnonzero(np.diff(world.solid_of_face[order], prepend=-1))
    rows, shapes = [], []
    for faces in np.split(order, starts[1:]):
        name, kind = world.solids[int(world.solid_of_face[faces[0]])]
        corners = world.triangles_m[faces]
        shape = union_of_triangles(_with_area(corners[:, :, :2]), box)
        parts = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon" and part.area > 0]
        if kind == _GROUND or not parts:
            continue
        z_m = corners[:, :, 2]
        rows.append({"name": name, "kind": kind, "base_m": float(z_m.min()), "height_m": float(z_m.max())})
        shapes.append(shapely.MultiPolygon(parts))
    if rows:
        yield Layer(FOOTPRINTS, np.array(shapes, dtype=object), pa.Table.from_pylist(rows))


def _with_area(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Those of triangles (n, 3, 2) that are not seen on edge."""
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return triangles[np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) > _MIN_AREA_M2]


_MIN_AREA_M2 = 2e-6


def _region_layers(run: FinishedRun, notes: list[str]) -> Iterator[Layer]:
    import shapely

    del notes
    roi = run.scenario.roi
    (x, y, z), (w, h, tall) = roi.box.origin_m, roi.box.size_m
    row = {
        "name": run.scenario.name, "low_m": z, "high_m": z + tall, "voxel_m": roi.voxel_m,
        "gamma": f"{run.scenario.gamma:g}", "rank_by": run.scenario.score.rank_by,
    }  # fmt: skip
    yield Layer(REGION, np.array([shapely.box(x, y, x + w, y + h)], dtype=object), pa.Table.from_pylist([row]))


def point_geometries(table: pa.Table) -> NDArray[np.object_]:
    """Where the rows of a table stand: its columns x_m and y_m."""
    import shapely

    found: NDArray[np.object_] = shapely.points(table.column("x_m").to_numpy(), table.column("y_m").to_numpy())
    return found


def to_plain_table(table: pa.Table) -> pa.Table:
    """A table that every format can hold: numbers of 64 bits, null for what is not a number, and names that differ in
    more than their case; a user's own column that is called as one here, or as one of a format, gets ``given_``."""
    columns: dict[str, Any] = {}
    taken = set(_RESERVED)
    for number, name in enumerate(table.column_names):  # names that are equal too
        column = table.column(number).combine_chunks()
        if pa.types.is_integer(column.type):
            column = column.cast(pa.int64())
        elif pa.types.is_floating(column.type):
            column = pc.if_else(pc.is_nan(column), None, column)
        free = name
        while free.lower() in taken:
            free = f"given_{free}"
        taken.add(free.lower())
        columns[free] = column
    return pa.table(columns)


_JUNCTION_COLUMN = "junction"


def is_city(folder: Path) -> bool:
    """Whether a folder is that of a city's run."""
    return (folder / results.JUNCTIONS_TABLE).is_file()


def city_name(folder: Path) -> str:
    """The city's name."""
    return str(parquet.read_metadata(folder / results.JUNCTIONS_TABLE, "city")["city"]["name"])


def open_any_run(folder: Path) -> FinishedRun:
    """The run of one of its junctions: all of them lie in one reference system."""
    return FinishedRun.open(results.junction_run_folder(folder, _junction_names(folder)[0]))


def city_layers(folder: Path) -> tuple[list[Layer], list[str]]:
    """The layers that a city's run has, those on top first, and what was left out and why, in words.

    InputError where a junction's scores are other ones by now than those of the city's run.
    """
    rows, about = parquet.read_artefact(folder / results.JUNCTIONS_TABLE, "city")
    if about["inputs"] != results.hash_scores(folder, _junction_names(folder)):
        found = "is not of the junctions' scores as they are now"
        raise InputError(folder / results.JUNCTIONS_TABLE, found, "egvs city run makes it anew")
    layers, notes = [Layer(JUNCTIONS, point_geometries(rows), to_plain_table(rows), "gain")], list[str]()
    scores = results.read_city_scores(folder)
    planned = results.read_plan(folder, _junction_names(folder))
    if planned is not None and planned.sensors:
        sensors, _ = parquet.read_artefact(folder / results.PLAN_TABLE, "city_plan")
        layers.append(Layer(PLAN, point_geometries(sensors), to_plain_table(sensors)))
    elif planned is None and (folder / results.PLAN_TABLE).is_file():
        notes.append("the plan is left out: it was made of other junctions or settings; egvs city place makes it anew")
    first = ["rank", *(name for name in scores.column_names if name != "rank")]
    layers.append(Layer(SITES, point_geometries(scores), to_plain_table(scores.select(first)), about["rank_by"]))
    return layers, notes


def _junction_names(folder: Path) -> list[str]:
    """The junctions of the run, sorted."""
    names: list[str] = (
        parquet.read_artefact(folder / results.JUNCTIONS_TABLE, "city")[0].column(_JUNCTION_COLUMN).to_pylist()
    )
    return sorted(names)


N_CLASSES = 9

LAYER_COLOURS = {PLAN: "e8590c", FOOTPRINTS: "d5d8df", REGION: "1d2430"}
"""The colour of layers that have one only; ``OTHER`` is that of the others."""
DEFAULT_COLOUR = "31688e"


@dataclass(frozen=True)
class ColourClass:
    """Values from ``low`` to ``high`` and their colour, RRGGBB; the last class holds its upper end."""

    low: float
    high: float
    colour: str
    is_last: bool


def colour_classes(layer: Layer) -> list[ColourClass]:
    """The classes of a layer's column, evenly spaced; none where all look the same."""
    if (span := layer.span) is None:
        return []
    low, high = span
    edges = [low + (high - low) * number / N_CLASSES for number in range(N_CLASSES)] + [high]
    stops = colours.ON_LIGHT[::-1] if layer.emphasises_low else colours.ON_LIGHT
    step = (len(stops) - 1) // (N_CLASSES - 1)
    return [
        ColourClass(edges[number], edges[number + 1], stops[number * step], number == N_CLASSES - 1)
        for number in range(N_CLASSES)
    ]


def row_colour(layer: Layer, value: float | None) -> str:
    """The colour of a row, RRGGBB, by its value of the layer's column."""
    found = colour_classes(layer)
    if not found or value is None or not math.isfinite(value):
        return LAYER_COLOURS.get(layer.name, DEFAULT_COLOUR)
    return next((its.colour for its in found if value < its.high), found[-1].colour)


_LABEL_COLUMNS = {JUNCTIONS: ("title", "TR,TL,R,L,T"), SITES: ("site", "TR,TL,R,L,T"), PLAN: ("order", "BR,BL,B")}
"""The column that a thing is labelled with, and where, the best place first: a plan's sensor hangs where a site is."""
_SIZES_MM = {JUNCTIONS: "5", PLAN: "4.4", SITES: "3.4", MISSED: "2"}
_INK, _PAPER = "29,36,48,255", "255,255,255,255"


def layer_qml(layer: Layer) -> str:
    """The style of a layer, XML text."""
    root = ET.Element(
        "qgis",
        version="3.22",
        styleCategories="Symbology|Labeling",
        labelsEnabled=str(int(layer.name in _LABEL_COLUMNS)),
    )
    renderer = ET.SubElement(
        root, "renderer-v2", type="RuleRenderer", symbollevels="0", forceraster="0",
        enableorderby=str(int(layer.name == SITES)),
    )  # fmt: skip
    rules = ET.SubElement(renderer, "rules", key="root")
    symbols = ET.SubElement(renderer, "symbols")
    entries = [(_class_filter(layer, shade), _class_label(shade), shade.colour) for shade in colour_classes(layer)]
    if not entries:
        entries = [(_site_filter(layer), layer.name, LAYER_COLOURS.get(layer.name, DEFAULT_COLOUR))]
    for number, (wanted, label, colour) in enumerate(entries):
        rule = ET.SubElement(rules, "rule", key=f"rule{number}", symbol=str(number), label=label)
        if wanted:
            rule.set("filter", wanted)
        _symbol(symbols, str(number), layer, colour)
    if layer.name == SITES:  # of those at one place the best is seen
        order = ET.SubElement(ET.SubElement(renderer, "orderby"), "orderByClause", asc="0", nullsFirst="0")
        order.text = '"rank"'
    if layer.name in _LABEL_COLUMNS:
        _labelling(root, *_LABEL_COLUMNS[layer.name])
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


def _site_filter(layer: Layer) -> str:
    return f'"site" = {_quote_text(layer.initial_site)}' if layer.initial_site else ""


def _class_filter(layer: Layer, shade: ColourClass) -> str:
    column = '"' + layer.colours_by.replace('"', '""') + '"'
    upper = "<=" if shade.is_last else "<"
    within = f"{column} >= {shade.low!r} AND {column} {upper} {shade.high!r}"
    return " AND ".join(filter(None, (_site_filter(layer), within)))


def _class_label(shade: ColourClass) -> str:
    return f"{shade.low:.4g} to {shade.high:.4g}"


def _quote_text(value: str) -> str:
    """A text in QGIS's expressions."""
    return "'" + value.replace("\\", "\\\\").replace("'", "''") + "'"


def _symbol(symbols: ET.Element, name: str, layer: Layer, colour: str) -> None:
    rgb = ",".join(str(part) for part in bytes.fromhex(colour))
    if layer.has_points:
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
