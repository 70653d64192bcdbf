"""Terrain at points of the world frame: through reference systems, tiles, triangles, alignments."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shapely.geometry import box

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.creation.alignment import check_used
from egvs.creation.map_parts import Alignment, MapContext
from egvs.creation.terrain.ground_heights import CombinedTerrain, TinTerrain, ground_points
from egvs.extensions.maps.terrain import landxml as landxml_terrain
from egvs.extensions.maps.terrain import rasters
from egvs.extensions.maps.terrain.triangles import tin_terrain
from egvs.formats.georeference import WorldFrame
from tests.extensions.maps.formats.test_landxml import FACES, landxml
from tests.extensions.maps.formats.test_rasters import EAST, NORTH, plane_cells, plane_m, write_ascii, write_tiff

FRAME = WorldFrame("EPSG:32632", (-EAST, -NORTH))
WINDOW = box(0, 0, 120, 80)
CONTEXT = MapContext(FRAME, WINDOW)


@pytest.mark.slow
def test_raster_in_the_projection_of_the_network(tmp_path: Path) -> None:
    terrain = rasters.read_terrain([write_tiff(tmp_path / "a.tif", plane_cells())], CONTEXT)
    xy_m = np.array([[5.0, 5.0], [33.0, 47.0], [114.0, 74.0]])
    assert terrain.height_m(xy_m) == pytest.approx(plane_m(xy_m[:, 0] + EAST, xy_m[:, 1] + NORTH), abs=1e-9)
    assert terrain.notes == (f"{tmp_path}/a.tif: terrain of 8 x 12 cells, 99.4 to 103.4 m high.",)


@pytest.mark.slow
def test_raster_in_degrees(tmp_path: Path) -> None:
    """A plane in UTM, sampled on a fine grid of degrees: the error of a cell of 1 m is below a centimetre."""
    rasterio = pytest.importorskip("rasterio")
    lon_lat = FRAME.to_degrees(np.array([[-20.0, -20.0], [140.0, 100.0]]))
    (west, south), (east, north) = lon_lat
    step = 1e-5
    columns, rows = math.ceil((east - west) / step), math.ceil((north - south) / step)
    lon, lat = np.meshgrid(west + step * (np.arange(columns) + 0.5), north - step * (np.arange(rows) + 0.5))
    x, y = FRAME.from_lon_lat(np.column_stack([lon.ravel(), lat.ravel()])).T
    cells = plane_m(x + EAST, y + NORTH).reshape(rows, columns)
    transform = rasterio.Affine(step, 0, west, 0, -step, north)
    path = write_tiff(tmp_path / "a.tif", cells, crs="EPSG:4326", transform=transform)
    terrain = rasters.read_terrain([path], CONTEXT)
    xy_m = np.random.default_rng(2).uniform([0, 0], [120, 80], (100, 2))
    assert terrain.height_m(xy_m) == pytest.approx(plane_m(xy_m[:, 0] + EAST, xy_m[:, 1] + NORTH), abs=1e-3)


def test_tiles_complete_each_other(tmp_path: Path) -> None:
    cells = plane_cells(8, 12)
    west, east = cells.copy(), cells.copy()
    west[:, 6:], east[:, :5] = np.nan, np.nan
    paths = [
        write_ascii(tmp_path / name, np.nan_to_num(tile, nan=-9999))
        for name, tile in (("w.asc", west), ("e.asc", east))
    ]
    for path in paths:
        path.with_suffix(".prj").write_text("EPSG:32632")
    terrain = rasters.read_terrain(paths, CONTEXT)
    xy_m = np.array([[20.0, 40.0], [57.0, 33.0], [100.0, 60.0]])
    assert terrain.height_m(xy_m) == pytest.approx(plane_m(xy_m[:, 0] + EAST, xy_m[:, 1] + NORTH), abs=1e-5)
    assert [note.rpartition(";")[2] for note in terrain.notes] == [" 48 cells have no data.", " 40 cells have no data."]


@pytest.mark.slow
def test_share_without_heights_is_reported(tmp_path: Path) -> None:
    path = write_tiff(tmp_path / "a.tif", plane_cells())
    terrain = rasters.read_terrain([path], MapContext(FRAME, box(0, 0, 240, 80)))
    assert terrain.notes[-1] == "The terrain has no height in 50.0 % of the region."
    assert np.isnan(terrain.height_m(np.array([[121.0, 10.0], [10.0, 81.0]]))).all()


def test_local_grid_needs_an_alignment(tmp_path: Path) -> None:
    """The local axes are turned by 90 degrees: local (x, y) is world (60 - y, 10 + x)."""
    rows, columns = 6, 5
    cells = (np.arange(columns) + 0.5)[None, :] * 2.0 + np.zeros((rows, 1))  # 0.2 m a metre of local x
    path = write_ascii(tmp_path / "a.asc", cells, "xllcorner 0\nyllcorner 0\ncellsize 10\n")
    with pytest.raises(InputError, match=r"declares no coordinate reference system.*--align"):
        rasters.read_terrain([path], CONTEXT)
    turned = Alignment(np.array([[0.0, 0.0], [50.0, 0.0]]), np.array([[60.0, 10.0], [60.0, 60.0]]))
    terrain = rasters.read_terrain([path], MapContext(None, WINDOW, turned))
    assert terrain.height_m(np.array([[30.0, 20.0], [20.0, 45.0]])) == pytest.approx([2.0, 7.0])


@pytest.mark.slow
@pytest.mark.parametrize(("context", "message"), [
    (MapContext(FRAME, box(5000, 5000, 5100, 5100)), "the terrain has no height in the region"),
    (MapContext(None, WINDOW), "the road map has no reference system"),
])  # fmt: skip
def test_rejects_rasters_elsewhere(context: MapContext, message: str, tmp_path: Path) -> None:
    path = write_tiff(tmp_path / "a.tif", plane_cells())
    with pytest.raises(InputError) as error:
        rasters.read_terrain([path], context)
    assert message in str(error.value) and "a.tif" in str(error.value)


def test_rejects_other_files(tmp_path: Path) -> None:
    (tmp_path / "a.tif").write_text("no raster")
    with pytest.raises(
        InputError, match="expected a GeoTIFF or an ASCII grid, got a file that starts with b'no raster'"
    ):
        rasters.read_terrain([tmp_path / "a.tif"], CONTEXT)


def slow_tin_height(vertices: FloatArray, faces: np.ndarray, x: float, y: float) -> float:
    """Solve for the plane of each triangle that contains a point, one by one; the lowest."""
    heights = []
    for face in faces:
        corners = vertices[face]
        matrix = np.column_stack([corners[:, 0], corners[:, 1], np.ones(3)])
        shares = np.linalg.solve(matrix.T, np.array([x, y, 1.0]))
        if shares.min() >= -1e-12:
            heights.append(float(shares @ corners[:, 2]))
    return min(heights, default=math.nan)


@pytest.mark.slow
def test_triangles_against_one_by_one() -> None:
    from scipy.spatial import Delaunay

    rng = np.random.default_rng(3)
    vertices = rng.uniform([0, 0, 0], [100, 100, 20], (60, 3))
    faces = np.asarray(Delaunay(vertices[:, :2]).simplices, dtype=np.int64)
    faces[::2] = faces[::2, ::-1]  # orientation does not matter
    points = rng.uniform(-10, 110, (300, 2))
    expected = [slow_tin_height(vertices, faces, x, y) for x, y in points]
    assert TinTerrain(vertices, faces).height_m(points) == pytest.approx(expected, nan_ok=True, abs=1e-9)
    assert np.isnan(expected).sum() > 20


def test_lower_of_two_triangles_counts() -> None:
    low = np.array([[0.0, 0, 1], [10, 0, 1], [0, 10, 1]])
    terrain = TinTerrain(np.concatenate([low + np.array([0, 0, 5]), low]), np.array([[0, 1, 2], [3, 4, 5]]))
    assert terrain.height_m(np.array([[2.0, 2.0], [0.0, 5.0], [9.0, 9.0]])) == pytest.approx(
        [1, 1, math.nan], nan_ok=True
    )


def test_landxml_surface_by_hand(tmp_path: Path) -> None:
    """The square rises from 50 m to 54 m at its north-eastern corner; its diagonal 7-9 rises evenly."""
    (tmp_path / "s.xml").write_text(landxml(FACES, '<CoordinateSystem epsgCode="32632"/>'))
    frame = WorldFrame("EPSG:32632", (-1000.0, -2000.0))
    terrain = landxml_terrain.read_terrain([tmp_path / "s.xml"], MapContext(frame, box(0, 0, 10, 10)))
    points = np.array([[5.0, 5.0], [10.0, 5.0], [2.0, 8.0], [11.0, 5.0]])
    assert terrain.height_m(points) == pytest.approx([52, 52, 50.8, math.nan], nan_ok=True)
    assert "2 triangles in the region, 50.0 to 54.0 m high" in terrain.notes[0]
    assert terrain.notes[1].endswith("1 hidden face was left out.")
    with pytest.raises(InputError, match="no triangle in the region"):
        landxml_terrain.read_terrain([tmp_path / "s.xml"], MapContext(frame, box(500, 0, 510, 10)))


def test_triangles_outside_the_window_are_left_out() -> None:
    vertices = np.array([[0.0, 0, 1], [10, 0, 1], [0, 10, 1], [900, 900, 9], [910, 900, 9], [900, 910, 9]])
    faces = np.array([[0, 1, 2], [3, 4, 5], [0, 1, 1]])
    context = MapContext(WorldFrame("EPSG:32632"), box(0, 0, 100, 100))
    terrain = tin_terrain(vertices, faces, "EPSG:32632", "relief.gml", context, ["A note."])
    assert terrain.faces.tolist() == [[0, 1, 2]] and terrain.notes[1] == "A note."
    assert terrain.notes[0].endswith("2 outside it or without area were left out.")


def test_first_terrain_that_knows_counts() -> None:
    triangle = np.array([[0.0, 0, 1], [10, 0, 1], [0, 10, 1]])
    one = TinTerrain(triangle, np.array([[0, 1, 2]]), ("one",))
    other = TinTerrain(triangle * [10, 10, 7], np.array([[0, 1, 2]]), ("other",))
    both = CombinedTerrain((one, other))
    assert both.notes == ("one", "other")
    assert both.height_m(np.array([[1.0, 1.0], [30.0, 30.0], [99.0, 99.0]])) == pytest.approx(
        [1, 7, math.nan], nan_ok=True
    )


def test_ground_points_are_a_grid_of_known_heights(monkeypatch: pytest.MonkeyPatch) -> None:
    terrain = TinTerrain(np.array([[0.0, 0, 1], [10, 0, 2], [0, 10, 1]]), np.array([[0, 1, 2]]))
    points = ground_points(terrain, box(0, 0, 12, 10), 5.0)
    assert points.tolist() == [[0, 0, 1], [5, 0, 1.5], [10, 0, 2], [0, 5, 1], [5, 5, 1.5], [0, 10, 1]]
    monkeypatch.setenv("EGVS_MAX_GROUND_POINTS", "5")
    with pytest.raises(InputError, match="needs 9 points in the region"):
        ground_points(terrain, box(0, 0, 12, 10), 5.0)


def test_surface_outside_the_region_is_left_out_and_counted(tmp_path: Path) -> None:
    """Two tiles of LandXML, one of them 5 km away; both far away are an error."""
    head = '<CoordinateSystem epsgCode="32632"/>'
    near, far = tmp_path / "near.xml", tmp_path / "far.xml"
    for path, start_m in ((near, 0), (far, 5000)):
        corners = ((7, 0, 0), (8, 9, 0), (9, 9, 9), (3, 0, 9))
        rows = [f'<P id="{number}">{NORTH + start_m + y} {EAST + start_m + x} 50</P>' for number, x, y in corners]
        path.write_text(landxml(FACES, head, "".join(rows)))
    context = MapContext(FRAME, box(-2000, -2000, 2000, 2000))
    alone = landxml_terrain.read_terrain([near], context)
    both = landxml_terrain.read_terrain([far, near], context)
    assert both.notes == (*alone.notes, "1 of 2 terrain surfaces outside the region was left out.")
    xy_m = np.array([[1.0, 0.5]])
    assert both.height_m(xy_m) == alone.height_m(xy_m) and np.isfinite(alone.height_m(xy_m)).all()
    with pytest.raises(InputError, match=r"far.xml: the terrain has no triangle in the region"):
        landxml_terrain.read_terrain([far], context)


def test_coordinates_beyond_the_earth_are_rejected() -> None:
    """A damaged number such as 1e304 would else become a polygon around everything."""
    here = np.array([[0.0, 0.0], [100.0, 0.0]])
    for crs, name in ((None, "local metres"), ("EPSG:32632", "EPSG:32632")):
        context = MapContext(FRAME, WINDOW, Alignment(here, here))
        with pytest.raises(InputError, match=rf"a.shp: \(1e\+304, 5\) cannot be converted from {name}"):
            context.to_world(np.array([[1.0, 2.0], [1e304, 5.0]]), crs, "a.shp")


def test_alignment_that_no_file_needs_is_rejected() -> None:
    here = np.array([[0.0, 0.0], [100.0, 0.0]])
    context = MapContext(FRAME, WINDOW, Alignment(here, here))
    context.to_world(np.array([[EAST, NORTH]]), "EPSG:32632", "a.tif")
    with pytest.raises(InputError, match="--align: no file needs it: all files declare a reference system"):
        check_used(context)
    replace(context, window=box(0, 0, 1, 1)).to_world(np.zeros((1, 2)), None, "b.ply")
    check_used(context)
    check_used(MapContext(FRAME, WINDOW))


@pytest.mark.slow
def test_impossible_heights_are_rejected(tmp_path: Path) -> None:
    """-9999 that the file does not declare as unknown, and a damaged number."""
    cells = plane_cells()
    cells[3, 4] = -9999.0
    path = write_tiff(tmp_path / "a.tif", cells)
    with pytest.raises(InputError, match=r"a.tif: expected heights of -1,000 to 9,000 m, got -9999 m"):
        rasters.read_terrain([path], CONTEXT)
    corners = np.array([[EAST, NORTH, 50.0], [EAST + 50, NORTH, 50.0], [EAST, NORTH + 50, 5e6]])
    with pytest.raises(InputError, match=r"b.xml: expected heights of -1,000 to 9,000 m, got 5e\+06 m"):
        tin_terrain(corners, np.array([[0, 1, 2]]), "EPSG:32632", "b.xml", CONTEXT)
