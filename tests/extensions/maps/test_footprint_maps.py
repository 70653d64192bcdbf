"""Buildings from GeoJSON and GIS files: which columns give their heights, and what is left out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from egvs.core.errors import InputError
from egvs.creation.map_parts import DEFAULT_BUILDING_M, Alignment, MapContext
from egvs.extensions.maps.buildings import footprint_maps
from egvs.formats.georeference import WorldFrame

FRAME = WorldFrame("EPSG:25832", (-540_000.0, -5_630_000.0))
CONTEXT = MapContext(FRAME, shapely.box(-100, -100, 100, 100))


def square(x_m: float, y_m: float, size_m: float = 10.0) -> list[list[float]]:
    """A ring in longitude and latitude."""
    corners = [(0, 0), (size_m, 0), (size_m, size_m), (0, size_m), (0, 0)]
    degrees: list[list[float]] = FRAME.to_degrees(np.array([[x_m + x, y_m + y] for x, y in corners])).tolist()
    return degrees


def feature(ring: Any, **columns: object) -> dict[str, Any]:
    return {"type": "Feature", "properties": columns, "geometry": {"type": "Polygon", "coordinates": [ring]}}


def write(path: Path, *features: Any, **members: object) -> Path:
    document = {"type": "FeatureCollection", "features": list(features)} | members
    path.write_text(json.dumps(document), encoding="utf-8")
    return path


def read(path: Path, context: MapContext = CONTEXT) -> footprint_maps.SolidMap:
    return footprint_maps.read_solids([path], context)


def test_degrees_without_declaration_are_wgs84(tmp_path: Path) -> None:
    (solid,) = read(write(tmp_path / "a.geojson", feature(square(20, 30), height=9))).solids
    assert (solid.kind, solid.height_m, solid.height_source) == ("building", 9.0, "height")
    np.testing.assert_allclose(solid.geometry.bounds, (20, 30, 30, 40), atol=1e-6)


@pytest.mark.parametrize(
    ("columns", "height_m", "source"),
    [
        ({"height_m": 7.5, "levels": 9}, 7.5, "height"),
        ({"Height": "12 m"}, 12.0, "height"),
        ({"measuredHeight": 8}, 8.0, "height"),
        ({"height": -9999, "storeysAboveGround": 4}, 12.0, "levels"),
        ({"height": None, "num_floors": 2}, 6.0, "levels"),
        ({"building:levels": "3"}, 9.0, "levels"),
        ({"height": "tall", "levels": 9999}, DEFAULT_BUILDING_M, "default"),
        ({"height": True}, DEFAULT_BUILDING_M, "default"),
        ({}, DEFAULT_BUILDING_M, "default"),
    ],
)
def test_heights_from_columns(tmp_path: Path, columns: dict[str, object], height_m: float, source: str) -> None:
    result = read(write(tmp_path / "a.geojson", feature(square(0, 0), **columns)))
    assert [(solid.height_m, solid.height_source) for solid in result.solids] == [(height_m, source)]
    assert result.counts.heights == {"building": {source: 1}}


def test_unusable_values_are_counted(tmp_path: Path) -> None:
    path = write(tmp_path / "a.geojson", feature(square(0, 0), height="tall", levels=9999))
    assert read(path).counts.unreadable == {"height": 1, "levels": 1}


def test_holes_bases_and_several_parts(tmp_path: Path) -> None:
    outer, hole = square(0, 0, 20), square(5, 5, 10)[::-1]
    parts = {"type": "MultiPolygon", "coordinates": [[outer, hole], [square(40, 0)]]}
    courtyard = {"type": "Feature", "properties": {"name": "c", "height": 9, "min_height": 3}, "geometry": parts}
    (solid,) = read(write(tmp_path / "a.geojson", courtyard)).solids
    assert (solid.name, solid.base_m) == ("c", 3.0)
    assert solid.geometry.area == pytest.approx(20 * 20 - 10 * 10 + 10 * 10, abs=1e-3)


def test_houses_that_share_walls_all_remain(tmp_path: Path) -> None:
    degrees = [[square(10.0 * x, 10.0 * y)] for x in range(-4, 4) for y in range(-4, 4)]
    block = {"type": "Feature", "properties": {}, "geometry": {"type": "MultiPolygon", "coordinates": degrees}}
    (solid,) = read(write(tmp_path / "a.geojson", block)).solids
    assert solid.geometry.area == pytest.approx(80 * 80, rel=1e-6)


def test_what_is_left_out_is_counted(tmp_path: Path) -> None:
    crossing = [square(0, 0)[index] for index in (0, 2, 1, 3, 0)]
    path = write(
        tmp_path / "a.geojson",
        feature(square(0, 0), name="a"),
        feature(square(0, 0), name="a"),
        feature(square(5000, 0)),
        feature([*square(0, 0)[:2], *square(0, 0)[1::-1]]),
        feature(crossing, name="bow tie"),
        feature(square(0, 0), height=3, base_m=4),
        {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": [9.6, 50.8]}},
        {"type": "Feature", "properties": None, "geometry": None},
    )
    result = read(path)
    assert [solid.name for solid in result.solids] == ["a", "a#2", "bow tie"]
    assert result.counts.dropped == {
        "out_of_range": {"building": 1},
        "degenerate": {"building": 1},
        "no_height": {"building": 1},
        "no_outline": {"building": 2},
    }


def test_heights_of_corners_are_ignored(tmp_path: Path) -> None:
    ring = [[*point, 99.0] for point in square(0, 0)]
    (solid,) = read(write(tmp_path / "a.geojson", feature(ring, height=5))).solids
    assert (solid.geometry.has_z, solid.height_m) == (False, 5.0)


def test_declared_system_and_local_metres(tmp_path: Path) -> None:
    ring = [[540_000 + x, 5_630_000 + y] for x, y in ((0, 0), (10, 0), (10, 20), (0, 0))]
    crs = {"type": "name", "properties": {"name": "EPSG:25832"}}
    (solid,) = read(write(tmp_path / "a.geojson", feature(ring), crs=crs)).solids
    np.testing.assert_allclose(solid.geometry.bounds, (0, 0, 10, 20), atol=1e-6)

    local = write(tmp_path / "b.geojson", feature([[0, 0], [10, 0], [10, 20], [0, 0]]), crs=None)
    with pytest.raises(InputError, match=r"b.geojson: feature 0: the file declares no coordinate reference system"):
        read(local)
    alignment = Alignment(np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[50.0, 0.0], [50.0, 1.0]]))
    (solid,) = read(local, MapContext(FRAME, CONTEXT.window, alignment)).solids
    np.testing.assert_allclose(solid.geometry.bounds, (30, 0, 50, 10), atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".gpkg", ".shp", ".parquet"])
def test_gis_files(tmp_path: Path, suffix: str) -> None:
    geopandas = pytest.importorskip("geopandas", reason="needs the extra gis")
    ring = np.array([[540_000, 5_630_000], [540_010, 5_630_000], [540_010, 5_630_020]])
    table = geopandas.GeoDataFrame(
        {"height": [7.5, None], "floors": [None, 3.0]}, geometry=[shapely.Polygon(ring), shapely.Polygon(ring + 30)],
        crs="EPSG:25832",
    )  # fmt: skip
    path = tmp_path / f"a{suffix}"
    if suffix == ".parquet":
        table.to_parquet(path)
    else:
        table.to_file(path)
    result = read(path)
    assert [(solid.height_m, solid.height_source) for solid in result.solids] == [(7.5, "height"), (9.0, "levels")]
    np.testing.assert_allclose(result.solids[1].geometry.bounds, (30, 30, 40, 50), atol=1e-6)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "a.geojson: is not valid JSON"),
        ("[]", "a.geojson: expected a GeoJSON FeatureCollection, got no features list"),
        ('{"features": [3]}', "feature 0: expected a GeoJSON feature"),
        ('{"features": [{"geometry": {"type": "Polygon"}}]}', "feature 0: geometry: expected a GeoJSON geometry"),
        ('{"features": [{"geometry": {"type": "Polygon", "coordinates": [[[0,0],[1,0],[1,NaN],[0,0]]]}}]}',
         "feature 0: geometry: expected finite coordinates"),
        ('{"features": [{"geometry": {"type": "Polygon", "coordinates": [[[0,0],[500,0],[9,9],[0,0]]]}}]}',
         r"feature 0: geometry: expected longitude and latitude in degrees, got \(500, 0\)"),
        ('{"crs": {"type": "name", "properties": {"name": "EPSG:0"}}, "features": []}', "a.geojson: crs: unknown"),
    ],
)  # fmt: skip
def test_rejects_damaged_file(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "a.geojson").write_text(content)
    with pytest.raises(InputError, match=message):
        read(tmp_path / "a.geojson")


def named(crs: str) -> dict[str, Any]:
    return {"type": "name", "properties": {"name": crs}}


def test_a_system_whose_geoid_grid_is_missing_places_footprints(tmp_path: Path) -> None:
    ring = [[540_020.0, 5_630_030.0], [540_030.0, 5_630_030.0], [540_030.0, 5_630_040.0], [540_020.0, 5_630_030.0]]
    crs = "+proj=utm +zone=32 +ellps=GRS80 +geoidgrids=no_such_grid.gtx +vunits=m +units=m +no_defs"
    (solid,) = read(write(tmp_path / "a.geojson", feature(ring, height=9), crs=named(crs))).solids
    np.testing.assert_allclose(solid.geometry.bounds, (20, 30, 30, 40), atol=1e-6)


@pytest.mark.slow
def test_an_alignment_replaces_a_system_that_proj_does_not_know(tmp_path: Path) -> None:
    path = write(tmp_path / "a.geojson", feature([[0, 0], [9, 0], [9, 9], [0, 0]]), crs=named("Town grid"))
    points = np.array([[0.0, 0.0], [50.0, 0.0]])
    (solid,) = read(path, MapContext(FRAME, CONTEXT.window, Alignment(points, points))).solids
    np.testing.assert_allclose(solid.geometry.bounds, (0, 0, 9, 9), atol=1e-6)
    with pytest.raises(
        InputError, match=r"unknown coordinate reference system 'Town grid'.* Or: Give two of its points"
    ):
        read(path)
