"""The site plan: layers, positions and labels as ezdxf reads them, and views that a person can check by hand."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import shapely

from egvs.core.errors import InputError
from egvs.export import drawing
from egvs.export.drawing import DXF_VERSION, LAYERS, VIEW_PREFIX, View, ground_view
from egvs.export.export import export_run
from egvs.export.finished_run import ExportCrs
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Pose
from tests.export.conftest import OFFSET_M

ezdxf = pytest.importorskip("ezdxf", reason="the extra egvs[gis] is not installed")


def make_sensor(elevations: tuple[float, ...], azimuth_deg: tuple[float, float] | None = None) -> Sensor:
    return Sensor("test", elevations, (0.0,) * len(elevations), 360, 100.0, "test", azimuth_deg=azimuth_deg)


def test_view_of_a_level_sensor_is_a_ring() -> None:
    """At 3 m, a beam 30 degrees down meets the ground at 3 / tan 30; a level one ends after 100 m."""
    view = ground_view(make_sensor((-30.0, 0.0)), Pose(10.0, 20.0, 3.0), 3.0)
    assert view.is_full_circle
    outer, inner = (np.hypot(*(points - [10.0, 20.0]).T) for points in (view.outer_m, view.inner_m))
    assert outer == pytest.approx(np.full(180, 100.0))
    assert inner == pytest.approx(np.full(180, 3.0 / math.tan(math.radians(30.0))))


def test_view_of_a_sector_begins_and_ends_at_its_azimuths() -> None:
    """Yaw 180 turns the sector from -30..30 degrees to 150..210; the middles of 2 degree sectors are drawn."""
    view = ground_view(make_sensor((-10.0,), (-30.0, 29.0)), Pose(0.0, 0.0, 2.0, yaw_deg=180.0), 2.0)
    angles = np.degrees(np.arctan2(view.outer_m[:, 1], view.outer_m[:, 0])) % 360.0
    assert not view.is_full_circle
    assert angles == pytest.approx(np.arange(151.0, 210.0, 2.0))
    assert np.hypot(*view.outer_m.T) == pytest.approx(np.full(30, 2.0 / math.tan(math.radians(10.0))))


def test_view_of_a_tilted_sensor_is_nearest_in_front() -> None:
    """Tilted 10 degrees down, a beam at 0 points 10 degrees down in front and 10 degrees up behind."""
    view = ground_view(make_sensor((0.0,)), Pose(0.0, 0.0, 4.0, pitch_deg=-10.0), 4.0)
    distance_m = np.hypot(*view.outer_m.T)
    front, behind = view.outer_m[:, 0].argmax(), view.outer_m[:, 0].argmin()
    assert distance_m[view.outer_m[:, 0] > 0].min() == pytest.approx(4.0 / math.tan(math.radians(10.0)), rel=1e-3)
    assert distance_m[behind] == pytest.approx(100.0 * math.cos(math.radians(10.0)), rel=1e-3)
    assert view.outer_m[front, 0] > 0 > view.outer_m[behind, 0]


def test_view_without_ground_reaches_the_range() -> None:
    view = ground_view(make_sensor((-30.0,)), Pose(0.0, 0.0, 3.0), math.inf)
    assert np.hypot(*view.outer_m.T) == pytest.approx(np.full(180, 100.0 * math.cos(math.radians(30.0))))
    assert not len(view.inner_m)


def _draw(view: View) -> list[list[tuple[float, float]]]:
    """Draw a view, and read its outlines with ezdxf."""
    document = ezdxf.new(DXF_VERSION)
    drawing._draw_view(document.modelspace(), view, "0", ExportCrs("", "world frame", None, is_degrees=False))
    assert not document.audit().errors
    lines = document.modelspace().query("LWPOLYLINE")
    assert all(line.closed for line in lines)
    return [[(x, y) for x, y in line.get_points("xy")] for line in lines]


def test_sector_without_ground_is_closed_at_the_sensor() -> None:
    """29 triangles of 2 degrees with sides of 100 m, from 151 to 209 degrees; not only the segment beyond the chord."""
    (outline,) = _draw(ground_view(make_sensor((0.0,), (-30.0, 29.0)), Pose(5.0, 6.0, 2.0, yaw_deg=180.0), math.inf))
    area = shapely.Polygon(outline)
    assert area.is_valid
    assert area.area == pytest.approx(29 * 0.5 * 100.0**2 * math.sin(math.radians(2.0)))
    assert area.covers(shapely.Point(4.0, 6.0)) and not area.covers(shapely.Point(6.0, 6.0))
    assert (5.0, 6.0) in outline


def test_view_of_a_tilted_sensor_begins_at_the_sensor_where_no_beam_meets_the_ground() -> None:
    """4 m high and tilted by 10 degrees, beams meet the ground in front, 22.7 m away; behind, none does."""
    view = ground_view(make_sensor((0.0,)), Pose(0.0, 0.0, 4.0, pitch_deg=-10.0), 4.0)
    outer, hole = (shapely.Polygon(outline) for outline in _draw(view))
    assert outer.is_valid and hole.is_valid
    assert hole.covers(shapely.Point(20.0, 0.0)) and not hole.covers(shapely.Point(23.0, 0.0))
    assert not hole.covers(shapely.Point(-0.1, 0.0)) and outer.covers(shapely.Point(-50.0, 0.0))
    assert sum(point == (0.0, 0.0) for point in hole.exterior.coords[:-1]) == 1


@pytest.mark.slow
def test_drawing_has_sites_at_eastings_and_northings_with_labels(located: Path, tmp_path: Path) -> None:
    done = export_run(located, "dxf", out=tmp_path / "plan.dxf")
    assert done.reference == "ETRS89 / UTM zone 32N"
    document = ezdxf.readfile(tmp_path / "plan.dxf")
    assert not document.audit().errors
    assert document.header["$INSUNITS"] == 6  # metres
    assert ("Reference system", "ETRS89 / UTM zone 32N") in document.header.custom_vars.properties
    names = {layer.dxf.name for layer in document.layers}
    assert {layer.name for layer in LAYERS} <= names
    assert {f"{VIEW_PREFIX}pole_a", f"{VIEW_PREFIX}pole & _b_"} <= names

    model = document.modelspace()
    sites = {insert.get_attrib_text("SITE"): insert for insert in model.query("INSERT")}
    assert sites.keys() == {"pole_a", "pole & <b>"}
    assert tuple(sites["pole_a"].dxf.insert) == pytest.approx((10.0 - OFFSET_M[0], 12.0 - OFFSET_M[1], 3.0))
    assert sites["pole_a"].get_attrib_text("BEARING_DEG") == "90.00"  # yaw 0 is east
    assert sites["pole_a"].get_attrib_text("HEIGHT_M") == "3.000"
    labels = [text.plain_text() for text in model.query('MTEXT[layer=="EGVS-SITE-LABELS"]')]
    assert labels == ["pole_a  z 3.00 m  090°  0.0° down", "pole & <b>  z 3.25 m  090°  0.0° down"]


def test_only_the_view_of_the_best_site_is_switched_on(located: Path, tmp_path: Path) -> None:
    export_run(located, "dxf", out=tmp_path / "plan.dxf")
    document = ezdxf.readfile(tmp_path / "plan.dxf")
    views = {layer.dxf.name: layer.is_on() for layer in document.layers if layer.dxf.name.startswith(VIEW_PREFIX)}
    assert sorted(views.values()) == [False, True]


@pytest.mark.slow
@pytest.mark.system  # SUMO drives in this run
def test_drawing_has_roads_kerbs_buildings_and_plan(on_roads: Path, tmp_path: Path) -> None:
    export_run(on_roads, "dxf", out=tmp_path / "plan.dxf")
    document = ezdxf.readfile(tmp_path / "plan.dxf")
    assert not document.audit().errors
    model = document.modelspace()
    count = {layer.name: len(model.query(f'*[layer=="{layer.name}"]')) for layer in LAYERS}
    assert count["EGVS-LANES"] > 15
    assert count["EGVS-KERBS"] >= 1
    assert count["EGVS-BUILDINGS"] == 1
    assert count["EGVS-FURNITURE"] == 1  # the lamp
    assert count["EGVS-REGION"] == 1
    assert count["EGVS-PLAN"] == 4  # two squares and their numbers
    house = model.query('LWPOLYLINE[layer=="EGVS-BUILDINGS"]').first
    corners = {(round(x + OFFSET_M[0], 3), round(y + OFFSET_M[1], 3)) for x, y in house.get_points("xy")}
    assert corners == {(150, 206), (158, 206), (158, 209.5), (150, 209.5)}


def test_rejects_degrees(located: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="dxf files are always in metres"):
        export_run(located, "dxf", crs="wgs84", out=tmp_path / "plan.dxf")
    assert not list(tmp_path.iterdir())
