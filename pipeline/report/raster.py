"""Values over the region of interest as indexed PNG images, in data URIs.

The few lines that write PNG are ours: an imaging library takes longer to import than all images to write, and its
compressor may choose other bytes on another processor.
"""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.report.colours import ON_DARK, ON_LIGHT, SHADE, mixed, opacity

ColumnValues = NDArray[np.float64]
"""One value a column of voxels, (nx, ny) float64."""

_MOST_PIXELS = 240_000
"""A raster has no more; larger grids are averaged."""


def field_images(values: ColumnValues, peak: float) -> Iterator[tuple[str, str]]:
    """Class (``day`` for light pages, ``night`` for dark ones) and image of a field, on a square-root scale up to
    ``peak``; nothing where that is 0.
    """
    if not peak > 0:
        return
    share = np.sqrt(np.minimum(shrunk(values, np.mean) / peak, 1.0))
    index = np.where(share > 0, 1 + np.floor(share * 253.999), 0).astype(np.uint8).T[::-1]
    alpha = bytes([0, *(round(255 * opacity(i / 254)) for i in range(255))])
    for look, stops in (("day", ON_LIGHT), ("night", ON_DARK)):
        yield look, _png(index, b"\0\0\0" + b"".join(mixed(n, 254, stops) for n in range(255)), alpha)


def shade_image(shaded: NDArray[np.bool_]) -> str:
    """The image of a shade over columns of voxels, (nx, ny) bool; where columns share a pixel, all must be shaded."""
    index = shrunk(shaded.astype(np.float64), np.min).T[::-1] > 0
    return _png(index, bytes((*SHADE[:3], *SHADE[:3])), bytes((0, SHADE[3])))


def shrunk(values: ColumnValues, how: Callable[..., Any]) -> ColumnValues:
    """Fewer, larger pixels where there are more than ``_MOST_PIXELS``; those at the far edges stand for the columns
    that are left.
    """
    factor = math.ceil(math.sqrt(values.size / _MOST_PIXELS))
    if factor <= 1:
        return values
    nx, ny = (-(-n // factor) for n in values.shape)
    padded = np.pad(values, ((0, nx * factor - values.shape[0]), (0, ny * factor - values.shape[1])), mode="edge")
    smaller: ColumnValues = how(padded.reshape(nx, factor, ny, factor), axis=(1, 3))
    return smaller


def _png(index: NDArray[Any], palette: bytes, alpha: bytes) -> str:
    """Rows of palette indices, the northernmost first, as the data URI of a PNG image."""
    height, width = index.shape
    rows = np.zeros((height, width + 1), dtype=np.uint8)  # each row starts with its filter: none
    rows[:, 1:] = index
    head = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes((8, 3, 0, 0, 0))
    chunks = (
        (b"IHDR", head),
        (b"PLTE", palette),
        (b"tRNS", alpha),
        (b"IDAT", _deflate(rows.tobytes())),
        (b"IEND", b""),
    )
    data = b"\x89PNG\r\n\x1a\n" + b"".join(
        len(body).to_bytes(4, "big") + name + body + zlib.crc32(name + body).to_bytes(4, "big") for name, body in chunks
    )
    return f"data:image/png;base64,{base64.b64encode(data).decode('ascii')}"


def _deflate(data: bytes) -> bytes:
    """A zlib stream from Arrow's compressor, which comes with the package: the system's may give other bytes."""
    gzip: bytes = pa.Codec("gzip", compression_level=6).compress(data, asbytes=True)
    return b"\x78\x9c" + gzip[10:-8] + zlib.adler32(data).to_bytes(4, "big")
