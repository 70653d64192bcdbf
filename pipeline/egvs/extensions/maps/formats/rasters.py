"""Read rasters of heights: GeoTIFF (rasterio in a process of its own, extra ``gis``) and ASCII grids (``.asc``).

A raster is a grid of cells; the height of a cell is that at its middle. Between the middles of four cells, heights are
interpolated bilinearly; up to half a cell outside the outermost middles, they are constant. A height is unknown (NaN)
outside the raster, and where a cell that counts has no data.

Coordinates are in the raster's own system, in the order x (easting, longitude), y; heights in metres. An ASCII grid
declares no system, but a ``.prj`` file of the same name may lie beside it. Sources: GeoTIFF 1.1 (OGC 19-008r4); Esri
ASCII raster format
(https://desktop.arcgis.com/en/arcmap/latest/manage-data/raster-and-images/esri-ascii-raster-format.htm).
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from egvs.core import limits, plugins
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.numbers import parse_decimal
from egvs.core.reading import COMPLETE_FILE, translate_errors
from egvs.formats import georeference, xml
from egvs.formats.gdal_drivers import keep_driver
from egvs.formats.reader_process import Block, read_blocks, serve

_DRIVER = "GTiff"
_CANNOT_READ = "cannot be read as GeoTIFF"
_TIFF_STARTS = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
_FOOT_M, _SURVEY_FOOT_M = 0.3048, 1200 / 3937
_UNITS_M = {
    "": None, "m": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0, "ft": _FOOT_M, "foot": _FOOT_M,
    "feet": _FOOT_M, "us survey foot": _SURVEY_FOOT_M, "us-ft": _SURVEY_FOOT_M, "ussurveyfoot": _SURVEY_FOOT_M,
}  # fmt: skip
_ASCII_KEYS = ("ncols", "nrows", "xllcorner", "yllcorner", "xllcenter", "yllcenter", "cellsize", "nodata_value")
_ASCII_HINT = "An ASCII grid begins with ncols, nrows, xllcorner, yllcorner and cellsize; then come the rows."
_CHUNK_BYTES, _MAX_WORD_BYTES, _MAX_HEADER_LINES = 1 << 20, 1000, 100
_MAX_CELLS_A_SIDE = 1_000_000
_MAX_COORDINATE = 1e9
_MIN_CELL_AREA = 1e-20
_TO_SPACES = bytes.maketrans(b"\n\r\t\f\v", b"     ")
_DEFAULT_NODATA = -9999.0


@dataclass(frozen=True, eq=False)
class HeightGrid:
    """Heights on a grid.

    Attributes
    ----------
    heights_m
        (rows, columns) float64; NaN where unknown.
    transform
        a, b, c, d, e, f: x = a column + b row + c and y = d column + e row + f, counted from the outer corner of the
        first cell.
    crs
        The reference system of x and y, in a form that PROJ knows; None if the file declares none.
    """

    heights_m: FloatArray
    transform: tuple[float, float, float, float, float, float]
    crs: str | None

    def height_m(self, xy: FloatArray) -> FloatArray:
        """Return heights (n,) at points (n, 2) of the grid's system; NaN where unknown."""
        rows, columns = self.heights_m.shape
        column, row = _cell_coordinates(self.transform, xy)
        with np.errstate(invalid="ignore"):
            is_inside = (column >= 0) & (column <= columns) & (row >= 0) & (row <= rows)
        heights = np.full(len(xy), np.nan)
        u = np.clip(column[is_inside] - 0.5, 0.0, columns - 1.0)
        v = np.clip(row[is_inside] - 0.5, 0.0, rows - 1.0)
        left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
        right, bottom = np.minimum(left + 1, columns - 1), np.minimum(top + 1, rows - 1)
        across, down = u - left, v - top
        total = np.zeros(len(u))
        for y, x, share in (
            (top, left, (1 - down) * (1 - across)),
            (top, right, (1 - down) * across),
            (bottom, left, down * (1 - across)),
            (bottom, right, down * across),
        ):
            # a cell without data does not matter where its share is 0
            total += np.where(share == 0.0, 0.0, share * self.heights_m[y, x])
        heights[is_inside] = total
        return heights


@dataclass(frozen=True)
class RasterHeader:
    """What a raster says of itself: rows, columns, transform and reference system as in :class:`HeightGrid`."""

    rows: int
    columns: int
    transform: tuple[float, float, float, float, float, float]
    crs: str | None


def is_geotiff(head: bytes) -> bool:
    """Return whether a file starts like a TIFF."""
    return head.startswith(_TIFF_STARTS)


def is_ascii_grid(head: bytes) -> bool:
    """Return whether a file starts like an ASCII grid."""
    return head[:200].lstrip().lower().startswith(b"ncols")


def read_geotiff_header(path: Path) -> RasterHeader:
    """Return size and georeference of a GeoTIFF.

    Raises
    ------
    InputError
        When the file is damaged, has several bands, or has no georeference.
    MissingExtraError
        When rasterio is not installed.
    """
    return _header(_read_tiff(path, None).values)


def read_geotiff(path: Path, bounds: tuple[float, float, float, float]) -> HeightGrid:
    """Read the part of a GeoTIFF that covers a rectangle.

    Parameters
    ----------
    path
        The file.
    bounds
        Lowest x, lowest y, highest x and highest y, in the file's system.

    Returns
    -------
    HeightGrid
        With one cell more on each side, if there is one. Without cells where the rectangle is outside the raster.

    Raises
    ------
    InputError
        When the file is damaged, has several bands or no georeference, or the part is too large.
    MissingExtraError
        When rasterio is not installed.
    """
    part = _read_tiff(path, bounds)
    header = _header(part.values)
    top, bottom, left, right = part.values["window"]
    if top >= bottom or left >= right:
        return HeightGrid(np.empty((0, 0)), header.transform, header.crs)
    heights_m = np.frombuffer(part.content).reshape(bottom - top, right - left) * part.values["scale"]
    heights_m = (heights_m + part.values["offset"]) * _tiff_unit_m(part.values["unit"], header.crs, path)
    heights_m[~np.isfinite(heights_m)] = np.nan
    a, b, c, d, e, f = header.transform
    transform = (a, b, c + a * left + b * top, d, e, f + d * left + e * top)
    return HeightGrid(heights_m, transform, header.crs)


def read_ascii_grid(path: Path) -> HeightGrid:
    """Read an ASCII grid, gzipped or not; heights are metres.

    Raises
    ------
    InputError
        When the file is damaged or too large.
    """
    limits.checked_size(path, limits.FILE)
    with xml.open_bounded(path) as file, translate_errors(path):
        header, first_row = _read_ascii_header(file, path)
        rows, columns = int(header["nrows"]), int(header["ncols"])
        values = np.empty(rows * columns)
        filled = 0
        for words in _words(first_row, file, path):
            if filled + len(words) > len(values):
                raise InputError(path, f"has more than {rows} x {columns} heights", _ASCII_HINT)
            values[filled : filled + len(words)] = _parse_heights(words, path)
            filled += len(words)
    if filled < len(values):
        raise InputError(path, f"expected {rows} x {columns} heights, got {filled}", COMPLETE_FILE)
    values[(values == header.get("nodata_value", _DEFAULT_NODATA)) | ~np.isfinite(values)] = np.nan
    return HeightGrid(values.reshape(rows, columns), _ascii_transform(header, path), _crs_beside(path))


def _cell_coordinates(
    transform: tuple[float, float, float, float, float, float], xy: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return column and row (n,) of points (n, 2), counted from the outer corner of the first cell."""
    a, b, c, d, e, f = transform
    determinant = a * e - b * d
    x, y = xy[:, 0] - c, xy[:, 1] - f
    return (e * x - b * y) / determinant, (a * y - d * x) / determinant


def _window(header: RasterHeader, bounds: tuple[float, float, float, float]) -> tuple[int, int, int, int]:
    """Return the first row, the row after the last, and likewise columns, of the cells around a rectangle."""
    x0, y0, x1, y1 = bounds
    corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])
    column, row = _cell_coordinates(header.transform, corners)
    left, right = max(0, math.floor(column.min()) - 1), min(header.columns, math.ceil(column.max()) + 1)
    top, bottom = max(0, math.floor(row.min()) - 1), min(header.rows, math.ceil(row.max()) + 1)
    return top, bottom, left, right


def _read_tiff(path: Path, bounds: tuple[float, float, float, float] | None) -> Block:
    """Return the header of a TIFF and, within bounds, its cells; another process reads the file."""
    plugins.require_libraries(f"{path.name}: reading GeoTIFF", "gis", "rasterio")
    limits.checked_size(path, limits.FILE)
    with path.open("rb") as file:
        if not is_geotiff(file.read(4)):
            raise InputError(path, f"{_CANNOT_READ} (it does not begin like a TIFF)", COMPLETE_FILE)
    blocks = list(read_blocks(__name__, path, str(path), _CANNOT_READ, [json.dumps(bounds)]))
    if len(blocks) != 1:
        raise InputError(path, _CANNOT_READ, COMPLETE_FILE)
    return blocks[0]


def _header(values: Mapping[str, Any]) -> RasterHeader:
    return RasterHeader(values["rows"], values["columns"], tuple(values["transform"]), values["crs"])


def _tiff_unit_m(unit: str, crs: str | None, path: Path) -> float:
    """Return the unit of heights: of the band, else of the reference system."""
    if unit not in _UNITS_M:
        raise InputError(path, f"expected heights in metres or feet, got {unit!r}", "Convert the heights to metres.")
    unit_m = _UNITS_M[unit]
    if unit_m is not None:
        return unit_m
    return 1.0 if crs is None else georeference.height_unit_m(crs, str(path))


def _read_ascii_header(file: IO[bytes], path: Path) -> tuple[dict[str, float], bytes]:
    """Return the values by key, and the first line after them."""
    header: dict[str, float] = {}
    for _ in range(_MAX_HEADER_LINES):
        line = xml.read_line(file, path)
        words = line.split()
        key = words[0].decode("ascii", "replace").lower() if words else ""
        if line and not words:
            continue
        if key not in _ASCII_KEYS:
            break
        if key in header or len(words) != 2:
            raise InputError(path, f"invalid line {line[:60]!r} of the header", _ASCII_HINT)
        header[key] = _parse_number(words[1], f"{path}: {key}")
    _check_ascii_header(header, path)
    return header, line


def _check_ascii_header(header: dict[str, float], path: Path) -> None:
    for key in ("ncols", "nrows", "cellsize"):
        value = header.get(key)
        if value is None:
            raise InputError(f"{path}: {key}", "is missing", _ASCII_HINT)
        is_count = key == "cellsize" or (value == int(value) and value <= _MAX_CELLS_A_SIDE)
        if not (0 < value < _MAX_COORDINATE and is_count):
            raise InputError(f"{path}: {key}", f"expected a number above 0, got {value:g}", _ASCII_HINT)
    limits.POINTS.check(path, header["ncols"] * header["nrows"], "has too many cells")


def _ascii_transform(header: dict[str, float], path: Path) -> tuple[float, float, float, float, float, float]:
    cell = header["cellsize"]
    origin = []
    for axis in "xy":
        corner, centre = header.get(f"{axis}llcorner"), header.get(f"{axis}llcenter")
        if corner is None and centre is not None:
            corner = centre - cell / 2
        if corner is None:
            raise InputError(f"{path}: {axis}llcorner", "is missing", _ASCII_HINT)
        if not abs(corner) <= _MAX_COORDINATE:
            raise InputError(f"{path}: {axis}llcorner", f"expected a coordinate, got {corner:g}", _ASCII_HINT)
        origin.append(corner)
    return cell, 0.0, origin[0], 0.0, -cell, origin[1] + header["nrows"] * cell


def _words(first: bytes, file: IO[bytes], path: Path) -> Iterator[list[bytes]]:
    """Yield the words of a line and of the rest of a file, chunk by chunk; a file may have a billion empty lines."""
    yield first.split()
    rest = b""
    while chunk := file.read(_CHUNK_BYTES):
        complete, _, rest = (rest + chunk).translate(_TO_SPACES).rpartition(b" ")
        if len(rest) > _MAX_WORD_BYTES:
            raise InputError(path, f"expected heights, got {rest[:60]!r}", _ASCII_HINT)
        yield complete.split()
    yield rest.split()


def _parse_heights(words: list[bytes], path: Path) -> FloatArray:
    heights = np.empty(len(words))
    for number, word in enumerate(words):
        try:
            heights[number] = float(word)
        except ValueError:
            heights[number] = np.inf
        if b"_" in word or np.isinf(heights[number]):  # Python accepts _ between digits
            raise InputError(path, f"expected heights, got {word[:60]!r}", _ASCII_HINT)
    return heights


def _parse_number(text: bytes, where: str) -> float:
    try:
        return parse_decimal(text.decode("ascii"))
    except ValueError:
        raise InputError(where, f"expected a number, got {text[:40]!r}", _ASCII_HINT) from None


def _crs_beside(path: Path) -> str | None:
    """Return the reference system in the ``.prj`` file beside a grid; None without such a file."""
    name = path.name.removesuffix(".gz").rpartition(".")[0] or path.name
    beside = path.with_name(f"{name}.prj")
    if not beside.is_file():
        return None
    crs = limits.read_bytes(beside, limits.DOCUMENT).decode("utf-8", "replace").strip()
    georeference.parse_crs(crs, str(beside))
    return crs


# --- in the other process ---


def _keep_one_driver() -> None:
    import rasterio

    with rasterio.Env() as environment:
        keep_driver(_DRIVER, environment.drivers())


def _read_file(path: Path) -> Iterator[Block]:
    import warnings

    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    bounds = json.loads(sys.argv[2])
    alone = {"GDAL_PAM_ENABLED": "NO", "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_NUM_THREADS": "1"}
    warnings.simplefilter("ignore", NotGeoreferencedWarning)
    with rasterio.Env(**alone), rasterio.open(path, driver=_DRIVER) as file:
        header = _tiff_header(file, path)
        values: dict[str, Any] = asdict(header)
        if bounds is None:
            yield Block(values)
            return
        top, bottom, left, right = _window(header, bounds)
        values["window"] = (top, bottom, left, right)
        if top >= bottom or left >= right:
            yield Block(values)
            return
        limits.POINTS.check(path, (bottom - top) * (right - left), "has too many cells in the region")
        cells = file.read(1, window=((top, bottom), (left, right)), masked=True)
        values |= {"scale": file.scales[0], "offset": file.offsets[0], "unit": (file.units[0] or "").strip().lower()}
        yield Block(values, np.ma.filled(cells.astype(np.float64), np.nan).tobytes())


def _tiff_header(file: Any, path: Path) -> RasterHeader:
    if file.count != 1:
        problem = f"expected one band of heights, got {file.count}"
        raise InputError(path, problem, "Save the heights alone, for example with gdal_translate -b 1.")
    if np.dtype(file.dtypes[0]).kind not in "iuf":
        raise InputError(path, f"expected heights as real numbers, got {file.dtypes[0]}")
    rows, columns = int(file.height), int(file.width)
    block_rows, block_columns = file.block_shapes[0]
    limits.POINTS.check(path, block_rows * block_columns, "has too many cells in one block")
    transform = tuple(float(value) for value in file.transform[:6])
    a, b, c, d, e, f = transform
    if (a, b, c, d, e, f) == (1.0, 0.0, 0.0, 0.0, 1.0, 0.0):
        hint = "Export it with its georeference, as GeoTIFF."
        raise InputError(path, "the image has no georeference", hint)
    is_small = all(abs(value) <= _MAX_COORDINATE for value in transform)  # false for NaN
    if not is_small or not abs(a * e - b * d) > _MIN_CELL_AREA:
        raise InputError(path, f"invalid georeference {transform}", COMPLETE_FILE)
    crs = file.crs.to_wkt() if file.crs else None
    return RasterHeader(rows, columns, (a, b, c, d, e, f), crs)


if __name__ == "__main__":
    serve(_read_file, _keep_one_driver)
