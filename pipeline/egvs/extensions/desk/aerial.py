"""An aerial picture below the map: a GeoTIFF of the user's, or a PNG or JPEG with a world file.

GDAL reads the picture in a confined process (:mod:`egvs.formats.reader_process`), which cuts out the part that the map
shows, and writes it anew as JPEG, or as PNG where it is transparent, with at most :data:`MOST_PIXELS` a side. The part
is kept as ``aerial.jpg`` or ``aerial.png``, with a world file in metres of the world frame, which is a file of six
lines (https://en.wikipedia.org/wiki/World_file): any GIS opens both, and they may be put there by hand.
"""

from __future__ import annotations

import io
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core import files, limits, plugins
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.numbers import number_or_nan
from egvs.formats import georeference
from egvs.formats.gdal_drivers import keep_driver
from egvs.formats.georeference import WorldFrame
from egvs.formats.reader_process import Block, read_blocks, serve

SUFFIXES = (".tif", ".tiff", ".png", ".jpg", ".jpeg")
STEM = "aerial"
MOST_PIXELS = 3000

_DRIVERS = {
    b"II*\x00": "GTiff", b"MM\x00*": "GTiff", b"II+\x00": "GTiff", b"MM\x00+": "GTiff", b"\x89PNG": "PNG",
    b"\xff\xd8\xff": "JPEG",
}  # fmt: skip
"""GDAL's driver by the beginning of a file."""

_WORLD_SUFFIXES = {".jpg": ".jgw", ".png": ".pgw"}
_NO_TRANSFORM = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
_CANNOT_READ = "cannot be read as a picture"
_MOST_WORLD_BYTES = 1000
_EDGE_POINTS = 20


@dataclass(frozen=True)
class AerialPicture:
    """A picture that the page has sent.

    Attributes
    ----------
    path, name
        The file, and what the user calls it.
    world_file
        Text of its world file; empty without one.
    crs
        Its reference system, if a file beside it states one.
    """

    path: Path
    name: str
    world_file: str = ""
    crs: str = ""

    def save(self, folder: Path, frame: WorldFrame | None, bounds_m: tuple[float, float, float, float]) -> None:
        """Write the part within bounds (x0, y0, x1, y1 in the world frame), in place of the picture in a folder.

        Raises
        ------
        InputError
            If it is no picture, does not say where it is, or is somewhere else; nothing is changed.
        """
        plugins.require_libraries(f"{self.name}: an aerial picture", "gis", "rasterio")
        plugins.require_libraries(f"{self.name}: an aerial picture", "explore", "PIL")
        if frame is None:
            hint = "Make the scenario from a map, or add [crs] to scenario.toml."
            raise InputError(self.name, "the scenario does not say where on the Earth it is", hint)
        limits.checked_size(self.path, limits.FILE)
        with self.path.open("rb") as file:
            head = file.read(4)
        driver = next((name for start, name in _DRIVERS.items() if head.startswith(start)), None)
        if driver is None:
            raise InputError(self.name, "is no GeoTIFF, PNG or JPEG", "Choose a picture of one of these kinds.")
        request = {
            "driver": driver, "transform": self._world_transform(), "crs": self.crs, "projection": frame.projection,
            "offset_m": frame.offset_m, "bounds_m": bounds_m,
        }  # fmt: skip
        blocks = list(read_blocks(__name__, self.path, self.name, _CANNOT_READ, [json.dumps(request)]))
        if len(blocks) != 1:
            raise InputError(self.name, _CANNOT_READ)
        suffix = blocks[0].values["suffix"]
        with files.atomic_write(folder / f"{STEM}{suffix}") as temp_path:
            temp_path.write_bytes(blocks[0].content)
        lines = "".join(f"{value!r}\n" for value in blocks[0].values["world"])
        files.write_text(folder / f"{STEM}{_WORLD_SUFFIXES[suffix]}", lines)
        remove_picture(folder, except_suffix=suffix)

    def _world_transform(self) -> list[float]:
        if not self.world_file:
            return _NO_TRANSFORM
        numbers = _parse_world(self.world_file)
        if numbers is None:
            raise InputError(f"{self.name}: its world file", "expected six lines with a number each")
        a, d, b, e, c, f = numbers  # of the middle of the first pixel
        return [a, b, c - (a + b) / 2, d, e, f - (d + e) / 2]


def _parse_world(text: str) -> list[float] | None:
    numbers = [number_or_nan(word) for word in text.split()]
    return numbers if len(numbers) == 6 and all(map(math.isfinite, numbers)) else None


def find_picture(folder: Path) -> Path | None:
    """Return the picture in a folder; None without one, or if it leads elsewhere."""
    paths = (folder / f"{STEM}{suffix}" for suffix in _WORLD_SUFFIXES)
    return next((path for path in paths if path.is_file() and path.resolve().parent == folder.resolve()), None)


def describe_picture(folder: Path) -> dict[str, Any] | None:
    """Return a key of the picture in a folder, and the matrix from its pixels to the world frame, as in SVG."""
    path = find_picture(folder)
    world = folder / "none" if path is None else path.with_suffix(_WORLD_SUFFIXES[path.suffix])
    if path is None or not world.is_file() or world.stat().st_size > _MOST_WORLD_BYTES:
        return None
    numbers = _parse_world(world.read_text(encoding="utf-8", errors="replace"))
    if numbers is None:
        return None
    a, d, b, e, c, f = numbers
    return {"key": str(path.stat().st_mtime_ns), "matrix": [a, d, b, e, c - (a + b) / 2, f - (d + e) / 2]}


def remove_picture(folder: Path, except_suffix: str = "") -> None:
    """Remove the pictures in a folder with their world files, except one of a suffix."""
    for picture, world in _WORLD_SUFFIXES.items():
        if picture != except_suffix:
            (folder / f"{STEM}{picture}").unlink(missing_ok=True)
            (folder / f"{STEM}{world}").unlink(missing_ok=True)


# --- in the other process ---


def _keep_one_driver() -> None:
    import rasterio

    with rasterio.Env() as environment:
        keep_driver(json.loads(sys.argv[2])["driver"], environment.drivers())


def _read_file(path: Path) -> Iterator[Block]:
    import warnings

    import rasterio
    from PIL import Image
    from rasterio.enums import ColorInterp, Resampling
    from rasterio.errors import NotGeoreferencedWarning

    request = json.loads(sys.argv[2])
    alone = {"GDAL_PAM_ENABLED": "NO", "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_NUM_THREADS": "1"}
    warnings.simplefilter("ignore", NotGeoreferencedWarning)
    with rasterio.Env(**alone), rasterio.open(path, driver=request["driver"]) as file:
        if file.dtypes[0] != "uint8":
            hint = "Convert it, for example with gdal_translate -ot Byte -scale."
            raise InputError(path, f"expected 8 bits a colour, got {file.dtypes[0]}", hint)
        limits.POINTS.check(path, math.prod(file.block_shapes[0]), "has too many pixels in one block")
        window, corners_m = _shown_part(file, path, request)
        (top, bottom), (left, right) = window
        reduction = max(1.0, max(bottom - top, right - left) / MOST_PIXELS)
        shape = (max(1, round((bottom - top) / reduction)), max(1, round((right - left) / reduction)))
        has_palette = file.colorinterp[0] is ColorInterp.palette
        way = Resampling.nearest if has_palette else Resampling.average
        bands = [1, 2, 3] if file.count >= 3 else [1, 1, 1]
        colours = np.moveaxis(file.read(bands, window=window, out_shape=(3, *shape), resampling=way), 0, -1)
        if has_palette:
            table = np.zeros((256, 4), dtype=np.uint8)
            for index, colour in file.colormap(1).items():
                table[index] = colour
            colours = table[colours[:, :, 0], :3]
        mask = file.dataset_mask(window=window, out_shape=shape)
    suffix, picture = ".jpg", Image.fromarray(np.ascontiguousarray(colours))
    if not mask.all():
        suffix = ".png"
        picture.putalpha(Image.fromarray(mask))
    encoded = io.BytesIO()
    picture.save(encoded, "PNG" if suffix == ".png" else "JPEG", quality=85, compress_level=1)
    yield Block({"suffix": suffix, "world": _world_numbers(corners_m, shape)}, encoded.getvalue())


def _shown_part(
    file: Any, path: Path, request: dict[str, Any]
) -> tuple[tuple[tuple[int, int], tuple[int, int]], FloatArray]:
    """Return the rows and columns within the bounds, and the corners of this part in the world frame, (4, 2)."""
    frame = WorldFrame(request["projection"], tuple(request["offset_m"]))
    transform = [float(value) for value in file.transform[:6]]
    if transform == _NO_TRANSFORM:
        transform = request["transform"]
    if transform == _NO_TRANSFORM:
        hint = "Choose its world file (.pgw, .jgw, .tfw) together with it, or a GeoTIFF."
        raise InputError(path, "does not say where it is", hint)
    a, b, c, d, e, f = transform
    if not abs(a * e - b * d) > 0:
        raise InputError(path, "the pixels of its world file have no area")
    stated = file.crs.to_wkt() if file.crs else request["crs"]
    crs = stated or frame.projection
    system = georeference.parse_crs(crs, str(path)).name
    x0, y0, x1, y1 = request["bounds_m"]
    along = np.linspace(0.0, 1.0, _EDGE_POINTS)
    xs, ys = (mesh.ravel() for mesh in np.meshgrid(x0 + (x1 - x0) * along, y0 + (y1 - y0) * along))
    x, y = frame.to_crs(np.column_stack([xs, ys]), crs).T - [[c], [f]]
    column, row = (e * x - b * y) / (a * e - b * d), (a * y - d * x) / (a * e - b * d)
    if not np.isfinite(column + row).all():
        raise InputError(path, "does not show this junction: its reference system does not reach here")
    left, right = max(0, math.floor(column.min())), min(file.width, math.ceil(column.max()))
    top, bottom = max(0, math.floor(row.min())), min(file.height, math.ceil(row.max()))
    corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]], dtype=np.float64)
    if left >= right or top >= bottom:
        middle = np.array([[file.width / 2, file.height / 2]])
        away_m = frame.from_crs(_pixels_to_crs(middle, transform), crs)[0] - [(x0 + x1) / 2, (y0 + y1) / 2]
        problem = (
            f"does not show this junction, but a place {georeference.format_distance(float(np.hypot(*away_m)))} away"
        )
        hint = f"It was read in {system}." if stated else (
            f"It states no reference system, so that of the scenario was assumed, {system}. Choose its .prj file"
            " together with it, or save it as GeoTIFF with its system."
        )  # fmt: skip
        raise InputError(path, problem, hint)
    return ((top, bottom), (left, right)), frame.from_crs(_pixels_to_crs(corners, transform), crs)


def _pixels_to_crs(pixels: FloatArray, transform: list[float]) -> FloatArray:
    a, b, c, d, e, f = transform
    return np.column_stack([pixels @ [a, b] + c, pixels @ [d, e] + f])


def _world_numbers(corners_m: FloatArray, shape: tuple[int, int]) -> list[float]:
    """Return the lines of the world file that fits the corners of a picture of some rows and columns best."""
    rows, columns = shape
    pixels = np.array([[0, 0, 1], [columns, 0, 1], [columns, rows, 1], [0, rows, 1]], dtype=np.float64)
    (a, d), (b, e), (c, f) = np.linalg.lstsq(pixels, corners_m, rcond=None)[0].tolist()
    return [a, d, b, e, c + (a + b) / 2, f + (d + e) / 2]


if __name__ == "__main__":
    serve(_read_file, _keep_one_driver)
