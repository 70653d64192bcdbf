"""Writes a site plan as a DXF drawing (AutoCAD 2010), for planning offices.

Coordinates are metres: eastings and northings of the scenario's reference system, or those of the world frame where the
scenario has none. They are not shifted; a drawing in a national grid has coordinates of millions of metres. North is
up, and angles are those of the grid: the bearing of a sensor's front is clockwise from grid north, and the pitch is
negative where the front points down.

The base map comes from the run: centre lines, sidewalks and street names of the network, footprints of the static
world, the region of interest. Kerbs are the outline of the network's junctions and of all lanes that vehicles drive on,
at their full width; they are not surveyed.

The view of a site is the area on level ground, at the height of its pole's foot, between the nearest and the farthest
point that its beams reach, without buildings: with :math:`h` the height above the ground and :math:`d` the direction of
a beam of range :math:`R`, the beam ends at the horizontal distance

.. math:: \\min(R,\\; h / {-d_z}) \\sqrt{d_x^2 + d_y^2}

(the second term only for beams that point down). For each azimuth, the outer edge is the largest of these distances and
the inner edge, around the area below the sensor that no beam reaches, is the smallest one of the beams that meet the
ground. Where none of an azimuth does, the view begins at the sensor.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.drawing.basemap import network_file, roads_within, solid_group
from egvs.export.finished_run import ExportCrs, FinishedRun
from egvs.export.layers import FOOTPRINTS, PLAN, REGION, SITES, Layer
from egvs.sensors.sensor import Sensor, scenario_sensor
from egvs.sensors.site_feasibility import ground_height_m
from egvs.sensors.sites import Pose, grid_bearing_deg
from egvs.traffic import network
from egvs.world.carriageway import Carriageway

if TYPE_CHECKING:
    from ezdxf.document import Drawing
    from ezdxf.layouts.layout import Modelspace

    from egvs.drawing.svg_figures import Box

Points = FloatArray

MAP_MARGIN_M = 60.0
"""The base map reaches this far beyond the region of interest and the sites."""

DXF_VERSION = "R2010"
_METRES = 6  # $INSUNITS
_SECTOR_DEG = 2.0
_LABEL_M, _STREET_M = 0.9, 1.8
_SITE_RADIUS_M, _ARROW_M = 0.5, 3.0
_LABEL_ROTATION_DEG = 45.0
"""Sites often stand in rows along the axes."""
_GAP_M = 0.3
"""Gaps between lanes up to twice this width belong to the carriageway."""
_MIN_AREA_M2 = 4.0
"""Smaller islands are gaps between lanes."""
_SITE_BLOCK = "EGVS_SITE"


@dataclass(frozen=True)
class DrawingLayer:
    """A layer of the drawing: name, colour (AutoCAD Color Index), line weight in 0.01 mm."""

    name: str
    colour: int
    weight: int = 18


LANES = DrawingLayer("EGVS-LANES", 8, 13)
WALKWAYS = DrawingLayer("EGVS-WALKWAYS", 9, 13)
KERBS = DrawingLayer("EGVS-KERBS", 7, 35)
STREETS = DrawingLayer("EGVS-STREET-NAMES", 8)
BUILDINGS = DrawingLayer("EGVS-BUILDINGS", 252, 35)
TREES = DrawingLayer("EGVS-TREES", 92)
FURNITURE = DrawingLayer("EGVS-FURNITURE", 251)
ROI = DrawingLayer("EGVS-REGION", 6, 50)
POLES = DrawingLayer("EGVS-SITES", 5, 35)
LABELS = DrawingLayer("EGVS-SITE-LABELS", 5)
PLANNED = DrawingLayer("EGVS-PLAN", 30, 50)
LAYERS = (LANES, WALKWAYS, KERBS, STREETS, BUILDINGS, TREES, FURNITURE, ROI, POLES, LABELS, PLANNED)
"""All layers except those of the views, one per site: ``EGVS-VIEW-<site>``."""

VIEW_PREFIX = "EGVS-VIEW-"
_VIEW_COLOUR = 140
_GROUP_LAYERS = {"large": BUILDINGS, "green": TREES, "small": FURNITURE}
_SITE_TAGS = ("SITE", "SENSOR", "HEIGHT_M", "BEARING_DEG", "PITCH_DEG", "RANK")


def write_dxf(path: Path, run: FinishedRun, layers: Sequence[Layer], reference: ExportCrs) -> list[str]:
    """Write the site plan of a run.

    Parameters
    ----------
    path
        The file.
    run
        The run.
    layers
        Its layers, from :func:`egvs.export.layers.run_layers`.
    reference
        A reference system in metres.

    Returns
    -------
    list of str
        Notes on what was left out.
    """
    from ezdxf import options  # type: ignore[attr-defined]  # documented, but not in an __all__
    from ezdxf.filemanagement import new

    by_name = {layer.name: layer for layer in layers}
    sites = by_name[SITES]
    box = _map_box(by_name[REGION], sites)
    keeps_metadata = options.write_fixed_meta_data_for_testing
    options.write_fixed_meta_data_for_testing = True  # no times, no random identifiers
    try:
        document = new(DXF_VERSION, setup=True, units=_METRES)
        document.header["$MEASUREMENT"] = 1
        document.header.custom_vars.append("Scenario", _plain_text(run.scenario.name))
        document.header.custom_vars.append("Reference system", _plain_text(reference.description))
        for layer in LAYERS:
            document.layers.add(layer.name, color=layer.colour, lineweight=layer.weight)
        model = document.modelspace()
        _draw_roads(model, run, box, reference)
        notes = _draw_footprints(model, by_name.get(FOOTPRINTS), box, reference)
        for shape in reference.geometries(by_name[REGION].geometries):
            _draw_area(model, shape, ROI)
        _draw_sites(document, run, sites, reference)
        if PLAN in by_name:
            _draw_plan(model, by_name[PLAN], reference)
        (x0, y0), (x1, y1) = reference.from_world(np.array([box[:2], box[2:]], dtype=np.float64)).tolist()
        document.set_modelspace_vport(height=1.1 * (y1 - y0), center=((x0 + x1) / 2, (y0 + y1) / 2))
        document.saveas(path)
    finally:
        options.write_fixed_meta_data_for_testing = keeps_metadata
    return notes


@dataclass(frozen=True)
class View:
    """The area on level ground that the beams of a sensor reach.

    Attributes
    ----------
    outer_m, inner_m
        Farthest and nearest point for each azimuth, (n, 2) each, world frame. Where no beam meets the ground,
        ``inner_m`` has the position of the sensor, once for neighbouring azimuths, or nothing for a full circle.
    is_full_circle
        Whether there is a point for every azimuth.
    """

    outer_m: Points
    inner_m: Points
    is_full_circle: bool


def ground_view(sensor: Sensor, pose: Pose, height_m: float) -> View:
    """Return the view of a sensor; see the module for the definition.

    Parameters
    ----------
    sensor, pose
        The sensor, and its pose in the world frame.
    height_m
        Height above the ground, > 0; infinite without a ground.
    """
    rays = sensor.directions(pose.yaw_deg, pose.pitch_deg, pose.roll_deg)
    reach_m = np.full(len(rays), sensor.range_m)
    is_down = rays[:, 2] < 0
    reach_m[is_down] = np.minimum(sensor.range_m, height_m / -rays[is_down, 2])
    on_ground = is_down & (reach_m < sensor.range_m)
    distance_m = reach_m * np.hypot(rays[:, 0], rays[:, 1])
    sectors = round(360.0 / _SECTOR_DEG)
    sector = (np.degrees(np.arctan2(rays[:, 1], rays[:, 0])) // _SECTOR_DEG).astype(np.int64) % sectors
    outer_m = np.full(sectors, -1.0)
    np.maximum.at(outer_m, sector, distance_m)
    inner_m = np.full(sectors, np.inf)
    np.minimum.at(inner_m, sector[on_ground], distance_m[on_ground])
    has_beam = outer_m >= 0
    order = _from_widest_gap(has_beam)
    angle = np.radians((np.arange(sectors) + 0.5) * _SECTOR_DEG)
    unit = np.column_stack([np.cos(angle), np.sin(angle)])
    center = np.array([pose.x_m, pose.y_m])
    is_full_circle = bool(has_beam.all())
    near_m = np.where(np.isfinite(inner_m), inner_m, 0.0)[order]
    at_sensor = near_m == 0.0
    follows = np.roll(at_sensor, 1)
    follows[0] &= is_full_circle
    kept = ~(at_sensor & follows)  # the position of the sensor once for neighbouring azimuths
    inner_points_m = center + near_m[kept, None] * unit[order[kept]]
    return View(center + outer_m[order, None] * unit[order], inner_points_m, is_full_circle)


def _from_widest_gap(has_beam: BoolArray) -> IntArray:
    """Return the sectors with beams, counter-clockwise, beginning after the widest gap."""
    order = np.flatnonzero(has_beam)
    gaps = np.diff(order, append=order[0] + len(has_beam))
    return np.roll(order, -(int(np.argmax(gaps)) + 1))


def _map_box(region: Layer, sites: Layer) -> Box:
    import shapely

    bounds = shapely.total_bounds(np.concatenate([region.geometries, sites.geometries]))
    x0, y0, x1, y1 = (float(value) for value in bounds)
    return (x0 - MAP_MARGIN_M, y0 - MAP_MARGIN_M, x1 + MAP_MARGIN_M, y1 + MAP_MARGIN_M)


def _draw_roads(model: Modelspace, run: FinishedRun, box: Box, reference: ExportCrs) -> None:
    path = network_file(run.work.folder.path)
    if path is None:
        return
    run.work.digest(path.relative_to(run.work.folder.path).as_posix())
    roads = roads_within(path, box)
    for piece in roads.lanes:
        layer = WALKWAYS if piece.css_class == "walk" else LANES
        model.add_lwpolyline(reference.from_world(piece.line).tolist(), dxfattribs={"layer": layer.name})
    for shape in _carriageway(path, box):
        for outline in reference.geometries(np.array([shape], dtype=object)):
            _draw_area(model, outline, KERBS)
    for name in roads.names:
        start, end = reference.from_world(np.array([name.start_m, name.end_m])).tolist()
        angle = math.degrees(math.atan2(end[1] - start[1], end[0] - start[0]))
        middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
        attributes = {
            "layer": STREETS.name, "char_height": _STREET_M, "insert": middle, "rotation": angle, "attachment_point": 5,
        }  # fmt: skip
        model.add_mtext(_mtext(name.text), dxfattribs=attributes)


def _carriageway(path: Path, box: Box) -> Iterator[Any]:
    """Yield the parts of the carriageway within a box: lanes at their full width, and junctions without sidewalks."""
    import shapely

    carriageway = Carriageway.of(network.read_net_xml(path))
    frame = shapely.box(*box)
    areas = []
    for lane in carriageway.lanes:
        if shapely.intersects(shapely.LineString(lane.shape_m[:, :2]), frame):
            areas.append(lane.area(margin_m=_GAP_M))
    junctions, corners = (
        shapely.union_all([shapely.make_valid(shapely.Polygon(shape.shape_m[:, :2])) for shape in shapes])
        for shapes in (carriageway.junctions, carriageway.corners)
    )
    area = shapely.union_all([*areas, shapely.difference(junctions, corners)])
    outline = shapely.buffer(area, -_GAP_M, join_style="mitre")
    for part in shapely.get_parts(shapely.intersection(outline, frame)):
        if part.geom_type == "Polygon" and part.area > _MIN_AREA_M2:
            holes = [ring for ring in part.interiors if shapely.Polygon(ring).area > _MIN_AREA_M2]
            yield shapely.Polygon(part.exterior, holes)


def _draw_footprints(model: Modelspace, layer: Layer | None, box: Box, reference: ExportCrs) -> list[str]:
    import shapely

    if layer is None:
        return []
    is_near = shapely.intersects(layer.geometries, shapely.box(*box))
    shapes = reference.geometries(layer.geometries[is_near])
    for row, shape in zip(layer.rows.filter(is_near.tolist()).to_pylist(), shapes, strict=True):
        group = _GROUP_LAYERS[solid_group(row["kind"], shape.area)]
        for part in shapely.get_parts(shape):
            _draw_area(model, part, group)
    if is_near.all():
        return []
    return [
        f"{FOOTPRINTS}: {is_near.sum():,} of {len(is_near):,}, those within {MAP_MARGIN_M:g} m of the region and the "
        "sites; GeoPackage and GeoJSON files have all"
    ]


def _draw_area(model: Modelspace, shape: Any, layer: DrawingLayer) -> None:
    """Draw the outline of a polygon, and those of its holes."""
    import shapely

    for ring in (shape.exterior, *shape.interiors):
        points = shapely.get_coordinates(ring)[:-1].tolist()
        model.add_lwpolyline(points, close=True, dxfattribs={"layer": layer.name})


def _draw_sites(document: Drawing, run: FinishedRun, layer: Layer, reference: ExportCrs) -> None:
    """Draw each site as a block with attributes, one label per pole, and the view of each site on its own layer.

    Only the view of the best site is switched on.
    """
    model = document.modelspace()
    _define_site_block(document)
    rows = layer.rows.to_pylist()
    positions = reference.from_world(np.array([[row["x_m"], row["y_m"]] for row in rows], dtype=np.float64)).tolist()
    used: set[str] = set()
    labels: dict[str, list[int]] = {}
    for number, (row, (east, north)) in enumerate(zip(rows, positions, strict=True)):
        labels.setdefault(row["pole"], []).append(number)
        insert = model.add_blockref(
            _SITE_BLOCK, (east, north, row["z_m"]), dxfattribs={"layer": POLES.name, "rotation": row["yaw_deg"]}
        )
        insert.add_auto_attribs(dict(zip(_SITE_TAGS, _site_texts(row), strict=True)))
        view_layer = _unique_layer_name(VIEW_PREFIX + row["site"], used)
        view = document.layers.add(view_layer, color=_VIEW_COLOUR, lineweight=18)
        if row["rank"] > 1:
            view.off()
        _draw_view(model, _site_view(run, row), view_layer, reference)
    for numbers in labels.values():
        east, north = positions[numbers[0]]
        text = "\\P".join(_label(rows[number]) for number in numbers)
        attributes = {
            "layer": LABELS.name, "char_height": _LABEL_M, "insert": (east + 0.5, north + 0.5), "attachment_point": 4,
            "rotation": _LABEL_ROTATION_DEG,
        }  # fmt: skip
        model.add_mtext(text, dxfattribs=attributes)


def _site_view(run: FinishedRun, row: Mapping[str, Any]) -> View:
    pose = Pose(*(float(row[name]) for name in ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")))
    sensor = scenario_sensor(row["sensor"], run.scenario, f"{run.work.folder.path}: sensor")
    height_m = math.inf
    if run.scenario.statics.ground:
        height_m = pose.z_m - ground_height_m(run.work.world, pose)
    return ground_view(sensor, pose, height_m)


def _draw_view(model: Modelspace, view: View, layer: str, reference: ExportCrs) -> None:
    attributes = {"layer": layer}
    outer = reference.from_world(view.outer_m).tolist()
    inner = reference.from_world(view.inner_m).tolist()
    if view.is_full_circle:
        model.add_lwpolyline(outer, close=True, dxfattribs=attributes)
        if len(inner) > 2:
            model.add_lwpolyline(inner, close=True, dxfattribs=attributes)
        return
    model.add_lwpolyline([*outer, *reversed(inner)], close=True, dxfattribs=attributes)


def _define_site_block(document: Drawing) -> None:
    """Define the symbol of a site: a circle, and an arrow along the sensor's front (the x axis of the block)."""
    block = document.blocks.new(_SITE_BLOCK)
    block.add_circle((0, 0), _SITE_RADIUS_M, dxfattribs={"layer": "0"})
    block.add_line((0, 0), (_ARROW_M, 0), dxfattribs={"layer": "0"})
    tip = [(_ARROW_M - 0.6, 0.3), (_ARROW_M, 0), (_ARROW_M - 0.6, -0.3)]
    block.add_lwpolyline(tip, dxfattribs={"layer": "0"})
    for number, tag in enumerate(_SITE_TAGS):
        attribute = block.add_attdef(tag, (0, -1.0 - number), dxfattribs={"layer": "0", "height": _LABEL_M})
        attribute.is_invisible = True


def _draw_plan(model: Modelspace, layer: Layer, reference: ExportCrs) -> None:
    """Draw a square around each sensor of the plan, with its number."""
    size_m = 1.6 * _SITE_RADIUS_M
    for number, shape in enumerate(reference.geometries(layer.geometries), start=1):
        x, y = shape.x, shape.y
        corners = [
            (x - size_m, y - size_m),
            (x + size_m, y - size_m),
            (x + size_m, y + size_m),
            (x - size_m, y + size_m),
        ]
        model.add_lwpolyline(corners, close=True, dxfattribs={"layer": PLANNED.name})
        attributes = {
            "layer": PLANNED.name, "char_height": 1.5 * _LABEL_M, "insert": (x - size_m, y - size_m),
            "attachment_point": 3,
        }  # fmt: skip
        model.add_mtext(str(number), dxfattribs=attributes)


def _site_texts(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the values of :data:`_SITE_TAGS`."""
    return (
        _plain_text(row["site"]), _plain_text(row["sensor"]), f"{row['z_m']:.3f}",
        f"{grid_bearing_deg(row['yaw_deg']):.2f}", f"{row['pitch_deg'] + 0.0:.2f}", str(row["rank"]),
    )  # fmt: skip


def _label(row: Mapping[str, Any]) -> str:
    bearing = round(grid_bearing_deg(row["yaw_deg"])) % 360
    pitch_deg = row["pitch_deg"]
    tilt = f"{abs(pitch_deg):.1f}° {'up' if pitch_deg > 0 else 'down'}"
    return _mtext(f"{row['site']}  z {row['z_m']:.2f} m  {bearing:03d}°  {tilt}")


def _mtext(text: str) -> str:
    """Return text for MTEXT, without the characters that begin its codes."""
    return re.sub(r"[\\{}^]", "_", _plain_text(text))


def _plain_text(text: str) -> str:
    """Return text of one line, without control characters and codes such as ``%%d``."""
    return re.sub(r"[\x00-\x1f\x7f]+", " ", text).replace("%%", "% %")


def _unique_layer_name(name: str, used: set[str]) -> str:
    """Return a valid layer name that differs from all others in more than case."""
    valid = re.sub(r"[<>/\\\":;?*|=`,\x00-\x1f\x7f]", "_", name)[:200]
    unique, number = valid, 2
    while unique.lower() in used:
        unique, number = f"{valid}_{number}", number + 1
    used.add(unique.lower())
    return unique
