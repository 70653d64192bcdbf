"""Rasters of heights: a plane is exact between the cells; no data, edges, units, damaged files."""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.extensions.maps.formats.rasters import HeightGrid, is_ascii_grid, is_geotiff, read_ascii_grid, read_geotiff
from egvs.formats import xml

pytestmark = pytest.mark.system

EAST, NORTH, CELL_M = 500_000.0, 5_400_000.0, 10.0


def plane_m(x: FloatArray, y: FloatArray) -> FloatArray:
    """A plane that rises by 3 % to the east, and falls by 1 % to the north."""
    return 100 + 0.03 * (x - EAST) - 0.01 * (y - NORTH)


def plane_cells(rows: int = 8, columns: int = 12) -> FloatArray:
    """Heights at the middles of cells, from the north."""
    x = EAST + CELL_M * (np.arange(columns) + 0.5)
    y = NORTH + CELL_M * (rows - np.arange(rows) - 0.5)
    return plane_m(x[None, :], y[:, None])


def write_tiff(path: Path, cells: np.ndarray, **profile: Any) -> Path:
    rasterio = pytest.importorskip("rasterio")
    rows, columns = cells.shape[-2:]
    units, scale = profile.pop("units", None), profile.pop("scale", None)
    options = {
        "driver": "GTiff", "width": columns, "height": rows, "count": 1, "dtype": cells.dtype.name,
        "crs": "EPSG:32632", "transform": rasterio.Affine(CELL_M, 0, EAST, 0, -CELL_M, NORTH + rows * CELL_M),
    } | profile  # fmt: skip
    with rasterio.open(path, "w", **options) as file:
        file.write(cells if cells.ndim == 3 else cells[None])
        if units is not None:
            file.units = (units,)
        if scale is not None:
            file.scales = (scale,)
    return path


def write_ascii(path: Path, cells: FloatArray, head: str = "") -> Path:
    rows, columns = cells.shape
    head = head or f"xllcorner {EAST}\nyllcorner {NORTH}\ncellsize {CELL_M}\nNODATA_value -9999\n"
    body = "\n".join(" ".join(f"{value:.6f}" for value in row) for row in cells)
    path.write_text(f"ncols {columns}\nnrows {rows}\n{head}{body}\n", encoding="utf-8")
    return path


EVERYWHERE = (EAST - 1e4, NORTH - 1e4, EAST + 1e4, NORTH + 1e4)


def both(folder: Path, cells: FloatArray) -> list[HeightGrid]:
    tiff = write_tiff(folder / "a.tif", np.where(np.isnan(cells), -9999, cells), nodata=-9999)
    ascii_grid = write_ascii(folder / "a.asc", np.where(np.isnan(cells), -9999, cells))
    return [read_geotiff(tiff, EVERYWHERE), read_ascii_grid(ascii_grid)]


@pytest.mark.slow
def test_plane_is_exact_between_the_middles_of_cells(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    xy = np.column_stack([EAST + rng.uniform(5, 115, 200), NORTH + rng.uniform(5, 75, 200)])
    for grid in both(tmp_path, plane_cells()):
        assert grid.height_m(xy) == pytest.approx(plane_m(*xy.T), abs=1e-5)


@pytest.mark.slow
def test_height_is_that_of_the_cell_by_hand(tmp_path: Path) -> None:
    """Four cells 1 2 / 3 4: their common corner is 2.5, three quarters to the right in the lower row 3.75."""
    cells = np.array([[1.0, 2.0], [3.0, 4.0]])
    points = np.array([[10.0, 10.0], [12.5, 5.0], [5.0, 5.0], [0.0, 0.0], [19.9, 19.9], [20.1, 5.0], [5.0, -0.1]])
    expected = [2.5, 3.75, 3.0, 3.0, 2.0, math.nan, math.nan]  # constant up to the border, unknown outside
    for grid in both(tmp_path, cells):
        assert grid.height_m(points + np.array([EAST, NORTH])) == pytest.approx(expected, nan_ok=True)


@pytest.mark.slow
def test_no_data_is_no_height_but_only_where_it_counts(tmp_path: Path) -> None:
    cells = plane_cells()
    cells[3, 4] = np.nan  # its middle is (45, 45) from the corner
    points = np.array([[45.0, 45.0], [44.0, 52.0], [35.0, 45.0], [55.0, 55.0], [34.0, 45.0], [70.0, 20.0]])
    for grid in both(tmp_path, cells):
        heights = grid.height_m(points + np.array([EAST, NORTH]))
        assert np.isnan(heights).tolist() == [True, True, False, False, False, False]


@pytest.mark.slow
def test_reads_only_the_part_around_a_rectangle(tmp_path: Path) -> None:
    path = write_tiff(tmp_path / "a.tif", plane_cells(400, 600))
    bounds = (EAST + 1000, NORTH + 1000, EAST + 1100, NORTH + 1200)
    grid = read_geotiff(path, bounds)
    assert grid.heights_m.shape == (22, 12)  # and a cell more on each side
    at = np.array([[EAST + 1033, NORTH + 1187]])
    assert grid.height_m(at) == pytest.approx(plane_m(*at.T), abs=1e-9)
    assert read_geotiff(path, (0.0, 0.0, 1.0, 1.0)).heights_m.size == 0


@pytest.mark.slow
@pytest.mark.parametrize(("profile", "factor"), [
    ({"units": "ft"}, 0.3048), ({"units": "metre"}, 1.0), ({"scale": 0.1}, 0.1),
    ({"crs": "EPSG:32632+5703"}, 1.0), ({"crs": "EPSG:32632+6360"}, 1200 / 3937),
])  # fmt: skip
def test_heights_are_metres(profile: dict[str, Any], factor: float, tmp_path: Path) -> None:
    path = write_tiff(tmp_path / "a.tif", np.full((3, 3), 100, dtype=np.int16), **profile)
    at = np.array([[EAST + 15, NORTH + 15]])
    assert read_geotiff(path, EVERYWHERE).height_m(at) == pytest.approx([100 * factor], rel=1e-6)


def test_grid_at_centres_and_with_a_projection_file(tmp_path: Path) -> None:
    head = f"xllcenter {EAST + 5}\nyllcenter {NORTH + 5}\ncellsize {CELL_M}\n"
    path = write_ascii(tmp_path / "a.asc", plane_cells(), head)
    assert read_ascii_grid(path).crs is None
    (tmp_path / "a.prj").write_text("EPSG:25832")
    grid = read_ascii_grid(path)
    at = np.array([[EAST + 33, NORTH + 41]])
    assert grid.crs == "EPSG:25832" and grid.height_m(at) == pytest.approx(plane_m(*at.T), abs=1e-5)
    (tmp_path / "a.asc.gz").write_bytes(gzip.compress(path.read_bytes()))
    assert read_ascii_grid(tmp_path / "a.asc.gz").crs == "EPSG:25832"
    assert is_ascii_grid(path.read_bytes()[:100]) and not is_geotiff(path.read_bytes()[:100])


GOOD = "ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2\n3 4\n"

BROKEN_ASCII = {
    "truncated": (GOOD[:-4], "expected 2 x 2 heights, got 2"),
    "too many": (GOOD + "5\n", "has more than 2 x 2 heights"),
    "word": (GOOD.replace("3 4", "3 four"), "expected heights, got b'four'"),
    "underscore": (GOOD.replace("3 4", "3 4_0"), "expected heights"),
    "infinite": (GOOD.replace("3 4", "3 inf"), "expected heights, got b'inf'"),
    "endless word": (GOOD + "1" * 5000, "expected heights, got b'1111"),
    "empty lines": (GOOD.replace("cellsize", "\n" * 200 + "cellsize"), "cellsize: is missing"),
    "no cell size": (GOOD.replace("cellsize 1\n", ""), "cellsize: is missing"),
    "no corner": (GOOD.replace("xllcorner 0\n", ""), "xllcorner: is missing"),
    "twice": (GOOD.replace("nrows 2", "ncols 2"), "invalid line"),
    "negative": (GOOD.replace("ncols 2", "ncols -2"), "ncols: expected a number above 0, got -2"),
    "fraction": (GOOD.replace("ncols 2", "ncols 1.5"), "ncols: expected a number above 0, got 1.5"),
    "nan": (GOOD.replace("cellsize 1", "cellsize nan"), "cellsize: expected a number"),
    "huge": (GOOD.replace("ncols 2\nnrows 2", "ncols 1000000\nnrows 1000000"), "too many cells"),
    "far": (GOOD.replace("xllcorner 0", "xllcorner 1e300"), "xllcorner: expected a coordinate"),
}


def test_billion_empty_lines_are_read_in_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small file that is packed: 30 MB of empty lines are some chunks, not thirty million lines."""
    calls = []
    monkeypatch.setattr(xml, "read_line", lambda file, path: calls.append(1) or file.readline())
    (tmp_path / "a.asc.gz").write_bytes(gzip.compress(GOOD.encode() + b"\n" * 30_000_000, 1))
    assert read_ascii_grid(tmp_path / "a.asc.gz").heights_m.tolist() == [[1, 2], [3, 4]]
    assert len(calls) == 6
    wrapped = GOOD.replace("1 2\n3 4\n", "1\t2 3\r\n\r\n4")
    (tmp_path / "b.asc").write_text(wrapped, newline="")
    assert read_ascii_grid(tmp_path / "b.asc").heights_m.tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize("case", BROKEN_ASCII)
def test_rejects_broken_ascii_grids(case: str, tmp_path: Path) -> None:
    text, message = BROKEN_ASCII[case]
    (tmp_path / "a.asc").write_text(text)
    with pytest.raises(InputError) as error:
        read_ascii_grid(tmp_path / "a.asc")
    assert message in str(error.value) and "a.asc" in str(error.value)


def _truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:300])


def _text(path: Path) -> None:
    path.write_bytes(b"II*\x00 and then text")


def _bands(path: Path) -> None:
    write_tiff(path, np.zeros((3, 4, 4), dtype=np.uint8), count=3)


def _nowhere(path: Path) -> None:
    import rasterio

    write_tiff(path, np.zeros((4, 4)), transform=rasterio.Affine.identity())


def _far(path: Path) -> None:
    import rasterio

    write_tiff(path, np.zeros((4, 4)), transform=rasterio.Affine(1e-300, 0, 0, 0, -10, 0))


def _complex(path: Path) -> None:
    write_tiff(path, np.zeros((4, 4), dtype=np.complex64))


def _fathoms(path: Path) -> None:
    write_tiff(path, np.zeros((4, 4)), units="fathom")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
@pytest.mark.parametrize(("damage", "message"), [
    (_truncated, "cannot be read as GeoTIFF"), (_text, "cannot be read as GeoTIFF"),
    (_bands, "expected one band of heights, got 3"), (_nowhere, "the image has no georeference"),
    (_far, "invalid georeference"),
    (_complex, "expected heights as real numbers, got complex64"), (_fathoms, "metres or feet, got 'fathom'"),
])  # fmt: skip
def test_rejects_broken_tiffs(damage: Callable[[Path], None], message: str, tmp_path: Path) -> None:
    path = write_tiff(tmp_path / "a.tif", plane_cells(60, 60))
    damage(path)
    with pytest.raises(InputError) as error:
        read_geotiff(path, EVERYWHERE)
    assert message in str(error.value) and "a.tif" in str(error.value)


@pytest.mark.slow
def test_part_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_tiff(tmp_path / "a.tif", plane_cells(30, 30), blockxsize=16, blockysize=16, tiled=True)
    monkeypatch.setenv("EGVS_MAX_POINTS", "500")
    with pytest.raises(InputError, match=r"has too many cells in the region.*EGVS_MAX_POINTS"):
        read_geotiff(path, EVERYWHERE)
    assert read_geotiff(path, (EAST, NORTH, EAST + 50, NORTH + 50)).heights_m.size < 500
