"""Vector layers of a run, their colours, and their QGIS styles; the latter also for layers of extensions.

Layers of a run: candidate sites, the plan, blind spots, footprints, the region. Geometries are shapely's, in the world
frame, metres, seen from above. Column names end in their unit, as in the artefacts.

The colours are those of the report, in a few classes. Styles are QML files as QGIS writes them
(https://docs.qgis.org/latest/en/docs/user_manual/appendices/qgis_file_formats.html). They are made for each run,
because their rules contain the limits of the classes and, in layers with rows of every site, the name of the site
shown; a static style could have neither.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.core.grid import BoolArray, FloatArray
from egvs.drawing import colours
from egvs.drawing.basemap import network_file, union_of_triangles
from egvs.export.finished_run import FinishedRun
from egvs.sensors.sensor import scenario_sensor
from egvs.sensors.site_feasibility import ground_height_m
from egvs.sensors.sites import Pose
from egvs.traffic import network
from egvs.world.footprints import WORLD_DATUM, Z_DATUM
from egvs.world.mesh import World

JUNCTIONS, SITES, PLAN, MISSED, MISSED_LANES, FOOTPRINTS, REGION = NAMES = (
    "junctions", "sites", "plan", "blindspots", "blindspot_lanes", "footprints", "region",
)  # fmt: skip
"""Layers, the topmost first; a run has no junctions."""

_GROUND, _CELL, _LANE = "ground", "cell", "lane"
_RESERVED = ("fid", "ogc_fid", "geom", "geometry", "wkt")
"""Column names that some formats use themselves."""


@dataclass(frozen=True)
class Layer:
    """Objects of one kind on a map.

    Attributes
    ----------
    name
        One of :data:`NAMES`.
    geometries
        Shapely geometries of one kind, shape (n,), world frame.
    rows
        The attributes of each, n rows.
    colours_by
        The column that determines the colours; empty if all look the same.
    emphasises_low
        Whether small values of that column are dark.
    initial_site
        The site whose rows a map shows at first, in a layer with rows of every site; empty otherwise.
    ground_m
        z of the ground below each point, shape (n,), world frame; None for a ground at z = 0.
    """

    name: str
    geometries: NDArray[np.object_]
    rows: pa.Table
    colours_by: str = ""
    emphasises_low: bool = False
    initial_site: str = ""
    ground_m: FloatArray | None = None

    @property
    def has_points(self) -> bool:
        """Whether the geometries are points."""
        return self.name in (JUNCTIONS, SITES, PLAN, MISSED)

    @property
    def span(self) -> tuple[float, float] | None:
        """The lowest and the highest value of ``colours_by``; None if all are equal, or there are none."""
        if not self.colours_by or self.colours_by not in self.rows.column_names:
            return None
        limits = pc.min_max(self.rows.column(self.colours_by)).as_py()
        low, high = limits["min"], limits["max"]
        if low is None or not high > low:
            return None
        return low, high


def run_layers(run: FinishedRun) -> tuple[list[Layer], list[str]]:
    """Return the layers of a run, the topmost first, and notes on those that are left out."""
    notes: list[str] = []
    layers = [
        _site_layer(run),
        *_plan_layers(run, notes),
        *_blindspot_layers(run, notes),
        *_footprint_layers(run),
        _region_layer(run),
    ]
    return layers, notes


MAX_KML_POLES = 12
"""KML has the blind spots of the best candidate on each of this number of poles."""


def kml_layers(run: FinishedRun, layers: Sequence[Layer], notes: list[str]) -> list[Layer]:
    """Return what a KML file shows of the layers of a run, so that it stays small enough for phones and maps online.

    Of the footprints, those within the range of a sensor; of the blind spots, those of the best candidates on the best
    poles. Notes say what is left out. Sensors get the ground below them, since altitudes count from it.
    """
    scores = parquet.read_artefact(run.artefact(RunFolder.scores.name), "scores")[0]
    best = pa.array(_best_on_poles(scores)[:MAX_KML_POLES])
    shown = []
    for layer in layers:
        if layer.name == FOOTPRINTS:
            kept = _is_in_range(run, scores, layer)
        elif layer.initial_site:
            kept = pc.is_in(layer.rows.column("site"), best).to_numpy(zero_copy_only=False)
        else:
            kept = np.ones(len(layer.rows), dtype=np.bool_)
        if not kept.all():
            counts = f"{kept.sum():,} of {len(kept):,}"
            notes.append(f"{layer.name}: {counts}, {_KML_REASONS[layer.name]}; GeoPackage and GeoJSON files have all")
        if layer.name in (SITES, PLAN):
            run.artefact(RunFolder.statics.name)
            layer = replace(layer, ground_m=ground_heights_m(run.work.world, layer.rows))
        if kept.any():
            shown.append(replace(layer, geometries=layer.geometries[kept], rows=layer.rows.filter(pa.array(kept))))
    return shown


_BEST_ON_POLES = f"those of the best candidate on each of the best {MAX_KML_POLES} poles"
_KML_REASONS = {
    FOOTPRINTS: "those within the range of a sensor", MISSED: _BEST_ON_POLES, MISSED_LANES: _BEST_ON_POLES,
}  # fmt: skip


def ground_heights_m(world: World, rows: pa.Table) -> FloatArray:
    """Return z of the ground below the points in the columns x_m and y_m of a table, shape (n,)."""
    points = zip(rows.column("x_m").to_pylist(), rows.column("y_m").to_pylist(), strict=True)
    return np.array([ground_height_m(world, Pose(x_m, y_m, 0.0)) for x_m, y_m in points], dtype=np.float64)


def _best_on_poles(scores: pa.Table) -> list[str]:
    """Return the best site on each pole, in the order of their ranks."""
    rows = sorted(scores.select(["rank", "site", "pole"]).to_pylist(), key=lambda row: row["rank"])
    best: dict[str, str] = {}
    for row in rows:
        best.setdefault(row["pole"], row["site"])
    return list(best.values())


def _is_in_range(run: FinishedRun, scores: pa.Table, layer: Layer) -> BoolArray:
    """Return which geometries of a layer a beam of any sensor can reach, seen from above."""
    import shapely

    in_range = np.zeros(len(layer.geometries), dtype=np.bool_)
    for name in scores.column("sensor").unique().to_pylist():
        range_m = scenario_sensor(name, run.scenario, f"{run.work.folder.path}: sensor").range_m
        sites = shapely.union_all(point_geometries(scores.filter(pc.equal(scores.column("sensor"), name))))
        in_range |= shapely.dwithin(layer.geometries, sites, range_m)
    return in_range


def best_site(run: FinishedRun) -> str:
    """Return the first of the sites of rank 1."""
    scores = parquet.read_artefact(run.artefact(RunFolder.scores.name), "scores")[0]
    ranked = zip(scores.column("rank").to_pylist(), scores.column("site").to_pylist(), strict=True)
    return str(min(ranked, key=lambda row: row[0])[1])


def _site_layer(run: FinishedRun) -> Layer:
    scores, metadata = parquet.read_artefact(run.artefact(RunFolder.scores.name), "scores")
    first = ["rank", *(name for name in scores.column_names if name != "rank")]
    rows = _with_periods(run, scores.select(first))
    return Layer(SITES, point_geometries(scores), to_plain_table(rows), metadata.get("rank_by", "egvs"))


def _with_periods(run: FinishedRun, scores: pa.Table) -> pa.Table:
    """Add the scores of each period, if the traffic has periods, in columns such as ``rank_in_morning``."""
    if RunFolder.scores_by_period.name not in run.record.stages["score"].artefacts:
        return scores
    by_period = parquet.read_artefact(run.artefact(RunFolder.scores_by_period.name), "scores_by_period")[0]
    for period in by_period.column("period").unique().to_pylist():
        rows = by_period.filter(pc.equal(by_period.column("period"), period)).drop_columns(["period"])
        index = pc.index_in(scores.column("site"), rows.column("site").combine_chunks())
        for name in rows.drop_columns(["site"]).column_names:
            scores = scores.append_column(f"{name}_in_{period}", rows.column(name).take(index))
    return scores


def _plan_layers(run: FinishedRun, notes: list[str]) -> Iterator[Layer]:
    if run.has_outdated_plan:
        notes.append("the plan is left out: it is for other traffic, sites or settings. Run egvs place again")
    if run.plan is None:
        return
    rows = parquet.read_artefact(run.work.folder.placement, "placement")[0].to_pylist()
    table = pa.Table.from_pylist(rows)
    yield Layer(PLAN, point_geometries(table), to_plain_table(table))


def _blindspot_layers(run: FinishedRun, notes: list[str]) -> Iterator[Layer]:
    """Locations as points, and lanes along their centre lines."""
    if not run.scenario.score.blindspots:
        notes.append("blind spots are left out: score.blindspots is false")
        return
    table, _ = parquet.read_artefact(run.artefact(RunFolder.blindspots.name), "blindspots")
    locations = table.filter(pc.not_equal(table.column("by"), _CELL)).drop_columns(["ix", "iy"])
    best = best_site(run)
    yield Layer(MISSED, point_geometries(locations), to_plain_table(locations), "share_found", True, best)

    lines = _lane_lines(run)
    is_lane = pc.equal(locations.column("by"), _LANE)
    has_line = pc.is_in(locations.column("place"), pa.array(list(lines), pa.string()))
    lanes = locations.filter(pc.and_(is_lane, has_line))
    if len(lanes):
        geometries = np.array([lines[name] for name in lanes.column("place").to_pylist()], dtype=object)
        yield Layer(MISSED_LANES, geometries, to_plain_table(lanes), "share_found", True, best)


def _lane_lines(run: FinishedRun) -> dict[str, Any]:
    """Centre lines of the lanes that SUMO drove on, by lane id; empty without a network."""
    import shapely

    path = network_file(run.work.folder.path)
    if path is None:
        return {}
    run.work.digest(path.relative_to(run.work.folder.path).as_posix())
    lines = {}
    for edge in network.read_net_xml(path).edges:
        for number, lane in enumerate(edge.lanes):
            if len(lane.shape_m) > 1:
                lines[f"{edge.id}_{number}"] = shapely.LineString(lane.shape_m[:, :2])
    return lines


def _footprint_layers(run: FinishedRun) -> Iterator[Layer]:
    """Each solid of the static world from above, with its base and its top; without the ground."""
    import shapely

    run.artefact(RunFolder.statics.name)
    world = run.work.world
    if not len(world.faces):
        return
    low, high = world.bounds_xy_m
    (x0, y0), (x1, y1) = (low.min(axis=0) - 1.0).tolist(), (high.max(axis=0) + 1.0).tolist()
    order = np.argsort(world.solid_of_face, kind="stable")
    starts = np.flatnonzero(np.diff(world.solid_of_face[order], prepend=-1))
    rows, shapes = [], []
    for faces in np.split(order, starts[1:]):
        name, kind = world.solids[int(world.solid_of_face[faces[0]])]
        corners = world.triangles_m[faces]
        if kind == _GROUND:
            continue
        shape = union_of_triangles(_with_area(corners[:, :, :2]), (x0, y0, x1, y1))
        parts = [part for part in shapely.get_parts(shape) if part.geom_type == "Polygon" and part.area > 0]
        if not parts:
            continue
        z_m = corners[:, :, 2]
        heights = {"base_m": float(z_m.min()), "height_m": float(z_m.max()), Z_DATUM: WORLD_DATUM}
        rows.append({"name": name, "kind": kind, **heights})
        shapes.append(shapely.MultiPolygon(parts))
    if rows:
        yield Layer(FOOTPRINTS, np.array(shapes, dtype=object), pa.Table.from_pylist(rows))


def _with_area(triangles: FloatArray) -> FloatArray:
    """Triangles, shape (n, 3, 2), without those that are seen edge-on."""
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return triangles[np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) > _MIN_AREA_M2]


_MIN_AREA_M2 = 2e-6


def _region_layer(run: FinishedRun) -> Layer:
    return Layer(REGION, region_geometries([run]), pa.Table.from_pylist([region_row(run)]))


def region_row(run: FinishedRun) -> dict[str, Any]:
    box = run.scenario.roi.box
    return {
        "name": run.scenario.name, "low_m": box.origin_m[2], "high_m": box.origin_m[2] + box.size_m[2],
        "voxel_m": run.scenario.roi.voxel_m, "gamma": f"{run.scenario.gamma:g}", "rank_by": run.scenario.score.rank_by,
    }  # fmt: skip


def region_geometries(runs: Sequence[FinishedRun]) -> NDArray[np.object_]:
    """Return the rectangle of the region of interest of each run."""
    import shapely

    boxes = [run.scenario.roi.box for run in runs]
    corners = [(*box.origin_m[:2], box.origin_m[0] + box.size_m[0], box.origin_m[1] + box.size_m[1]) for box in boxes]
    return np.array([shapely.box(*corner) for corner in corners], dtype=object)


def point_geometries(table: pa.Table) -> NDArray[np.object_]:
    """Return points at the columns x_m and y_m of a table."""
    import shapely

    points: NDArray[np.object_] = shapely.points(table.column("x_m").to_numpy(), table.column("y_m").to_numpy())
    return points


def to_plain_table(table: pa.Table) -> pa.Table:
    """Return a table that every format can store.

    Numbers have 64 bits, NaN becomes null, and names differ in more than their case: the prefix ``given_`` is added to
    a user column with the name of an earlier column, or a name that a format reserves.
    """
    columns: dict[str, Any] = {}
    used = set(_RESERVED)
    for number, name in enumerate(table.column_names):  # by number, because names may be equal
        column = table.column(number).combine_chunks()
        if pa.types.is_integer(column.type):
            column = column.cast(pa.int64())
        elif pa.types.is_floating(column.type):
            column = pc.if_else(pc.is_nan(column), None, column)
        while name.lower() in used:
            name = f"given_{name}"
        used.add(name.lower())
        columns[name] = column
    return pa.table(columns)


N_CLASSES = 9

LAYER_COLOURS = {PLAN: "e8590c", FOOTPRINTS: "d5d8df", REGION: "1d2430"}
"""Colours of layers without classes; the others have :data:`DEFAULT_COLOUR`."""
DEFAULT_COLOUR = "31688e"


@dataclass(frozen=True)
class ColourClass:
    """Values from ``low`` to ``high`` and their colour, RRGGBB; only the last class includes its upper limit."""

    low: float
    high: float
    colour: str
    is_last: bool


def colour_classes(layer: Layer) -> list[ColourClass]:
    """Return classes of equal width for a layer; empty if all rows look the same."""
    if layer.span is None:
        return []
    low, high = layer.span
    edges = [low + (high - low) * number / N_CLASSES for number in range(N_CLASSES)] + [high]
    stops = colours.ON_LIGHT[::-1] if layer.emphasises_low else colours.ON_LIGHT
    step = (len(stops) - 1) // (N_CLASSES - 1)
    return [
        ColourClass(edges[number], edges[number + 1], stops[number * step], number == N_CLASSES - 1)
        for number in range(N_CLASSES)
    ]


def row_colour(layer: Layer, value: float | None) -> str:
    """Return the colour of a row, RRGGBB, for its value of the column that determines it."""
    classes = colour_classes(layer)
    if not classes or value is None or not math.isfinite(value):
        return LAYER_COLOURS.get(layer.name, DEFAULT_COLOUR)
    for colour_class in classes:
        if value < colour_class.high:
            return colour_class.colour
    return classes[-1].colour


_LABEL_COLUMNS = {JUNCTIONS: ("title", "TR,TL,R,L,T"), SITES: ("site", "TR,TL,R,L,T"), PLAN: ("order", "BR,BL,B")}
"""The column of the labels, and where they are put, the best position first: those of the plan are below, because its
sensors are at the positions of sites."""
_SIZES_MM = {JUNCTIONS: "5", PLAN: "4.4", SITES: "3.4", MISSED: "2"}
_INK, _PAPER = "29,36,48,255", "255,255,255,255"


def layer_qml(layer: Layer) -> str:
    """Return the QGIS style of a layer, XML text."""
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
    entries = []
    for colour_class in colour_classes(layer):
        label = f"{colour_class.low:.4g} to {colour_class.high:.4g}"
        entries.append((_class_filter(layer, colour_class), label, colour_class.colour))
    if not entries:
        entries = [(_site_filter(layer), layer.name, LAYER_COLOURS.get(layer.name, DEFAULT_COLOUR))]
    for number, (condition, label, colour) in enumerate(entries):
        rule = ET.SubElement(rules, "rule", key=f"rule{number}", symbol=str(number), label=label)
        if condition:
            rule.set("filter", condition)
        _symbol(symbols, str(number), layer, colour)
    if layer.name == SITES:  # of sites at the same location, the best is on top
        order = ET.SubElement(ET.SubElement(renderer, "orderby"), "orderByClause", asc="0", nullsFirst="0")
        order.text = '"rank"'
    if layer.name in _LABEL_COLUMNS:
        _labelling(root, *_LABEL_COLUMNS[layer.name])
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def raster_qml(low: float, high: float, stops: list[tuple[float, str]]) -> str:
    """Return the QGIS style of a raster with one band; ``stops`` are values and their colours, RRGGBB."""
    root = ET.Element("qgis", version="3.22", styleCategories="Symbology")
    renderer = ET.SubElement(
        ET.SubElement(root, "pipe"), "rasterrenderer", type="singlebandpseudocolor", band="1", opacity="1",
        alphaBand="-1", classificationMin=f"{low!r}", classificationMax=f"{high!r}", nodataColor="",
    )  # fmt: skip
    shader = ET.SubElement(
        ET.SubElement(renderer, "rastershader"), "colorrampshader", colorRampType="INTERPOLATED",
        classificationMode="1", clip="0", minimumValue=f"{low!r}", maximumValue=f"{high!r}",
    )  # fmt: skip
    for value, colour in stops:
        ET.SubElement(shader, "item", value=f"{value!r}", color=f"#{colour}", alpha="255", label=f"{value:.4g}")
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _site_filter(layer: Layer) -> str:
    """Expression of QGIS that selects the initial site; empty if all sites are shown."""
    if not layer.initial_site:
        return ""
    text = layer.initial_site.replace("\\", "\\\\").replace("'", "''")
    return f"\"site\" = '{text}'"


def _class_filter(layer: Layer, colour_class: ColourClass) -> str:
    column = '"' + layer.colours_by.replace('"', '""') + '"'
    upper = "<=" if colour_class.is_last else "<"
    limits = f"{column} >= {colour_class.low!r} AND {column} {upper} {colour_class.high!r}"
    if not layer.initial_site:
        return limits
    return f"{_site_filter(layer)} AND {limits}"


def _symbol(symbols: ET.Element, name: str, layer: Layer, colour: str) -> None:
    rgba = ",".join(str(part) for part in bytes.fromhex(colour)) + ",255"
    alpha = "0.8" if layer.name == FOOTPRINTS else "1"
    if layer.has_points:
        kind, symbol_class = "marker", "SimpleMarker"
        shape = "square" if layer.name == PLAN else "circle"
        options = {"color": rgba, "name": shape, "outline_color": _INK, "outline_width": "0.3",
                   "size": _SIZES_MM[layer.name], "size_unit": "MM"}  # fmt: skip
    elif layer.name == MISSED_LANES:
        kind, symbol_class = "line", "SimpleLine"
        options = {"line_color": rgba, "line_width": "1.2", "line_width_unit": "MM", "capstyle": "flat"}
    elif layer.name == REGION:
        kind, symbol_class = "fill", "SimpleFill"
        options = {"color": rgba, "style": "no", "outline_color": _INK, "outline_width": "0.4",
                   "outline_style": "dash"}  # fmt: skip
    else:
        kind, symbol_class = "fill", "SimpleFill"
        options = {"color": rgba, "style": "solid", "outline_color": "125,132,148,255", "outline_width": "0.4",
                   "outline_style": "solid"}  # fmt: skip
    symbol = ET.SubElement(symbols, "symbol", name=name, type=kind, alpha=alpha, clip_to_extent="1", force_rhr="0")
    symbol_layer = ET.SubElement(symbol, "layer", {"class": symbol_class, "enabled": "1", "locked": "0", "pass": "0"})
    table = ET.SubElement(symbol_layer, "Option", type="Map")
    for key, value in options.items():
        ET.SubElement(table, "Option", name=key, type="QString", value=value)


def _labelling(root: ET.Element, column: str, positions: str) -> None:
    settings = ET.SubElement(ET.SubElement(root, "labeling", type="simple"), "settings", calloutType="simple")
    text = ET.SubElement(settings, "text-style", fieldName=column, isExpression="0", fontSize="9", textColor=_INK)
    ET.SubElement(text, "text-buffer", bufferDraw="1", bufferSize="0.8", bufferSizeUnits="MM", bufferColor=_PAPER)
    ET.SubElement(settings, "placement", placement="6", predefinedPositionOrder=positions, offsetType="1", dist="0.2")
    ET.SubElement(settings, "rendering", obstacle="0")  # else sites at the same location hide the label of each other
