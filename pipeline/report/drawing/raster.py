"""Values over the region of interest as indexed PNG images, in data URIs.

The few lines that write PNG are ours: an imaging library takes longer to import than all images to write, and its
compressor may choose other bytes on another processor.
"""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.report.drawing.colours import ON_DARK, ON_LIGHT, SHADE, mixed, opacity

ColumnValues = NDArray[np.float64]
"""One value a column of voxels, (nx, ny) float64."""

MOST_PIXELS = 240_000
"""A raster has no more; larger grids are averaged."""


LOOKS = ("day", "night")
"""Light pages and dark ones."""


@dataclass(frozen=True)
class IndexedImage:
    """Rows of palette indices, the northernmost first: the parts of a PNG file but for the palette, so that a page may
    join them to any.
    """

    head: bytes
    data: bytes

    @classmethod
    def of(cls, index: NDArray[np.uint8]) -> IndexedImage:
        """From (height, width) uint8."""
        height, width = index.shape
        rows = np.zeros((height, width + 1), dtype=np.uint8)  # each row starts with its filter: none
        rows[:, 1:] = index
        head = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes((8, 3, 0, 0, 0))
        return cls(b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head), _chunk(b"IDAT", _deflate(rows.tobytes())))

    def uri(self, palette: bytes) -> str:
        """The whole image as a data URI."""
        data = self.head + palette + self.data + END
        return f"data:image/png;base64,{base64.b64encode(data).decode('ascii')}"


def field_image(values: ColumnValues, peak: float, most_pixels: int = MOST_PIXELS) -> IndexedImage:
    """A field on a square-root scale up to ``peak``, above 0, for the palettes ``FIELD``."""
    share = np.sqrt(np.minimum(shrunk(values, np.mean, most_pixels) / peak, 1.0))
    return IndexedImage.of(np.where(share > 0, 1 + np.floor(share * 253.999), 0).astype(np.uint8).T[::-1])


def share_image(share: ColumnValues) -> IndexedImage:
    """Shares from 0 to 1 on an even scale, for the palettes ``SHARES``; nothing where one is not a number."""
    known = np.nan_to_num(share, nan=0.0)
    return IndexedImage.of(np.where(np.isnan(share), 0, 1 + np.floor(known * 253.999)).astype(np.uint8).T[::-1])


def shade_image(shaded: NDArray[np.bool_], most_pixels: int = MOST_PIXELS) -> IndexedImage:
    """A shade over columns of voxels, (nx, ny) bool, for ``SHADE_PALETTE``; where columns share a pixel, all must be
    shaded.
    """
    return IndexedImage.of((shrunk(shaded.astype(np.float64), np.min, most_pixels).T[::-1] > 0).astype(np.uint8))


def dots_image(points_m: NDArray[np.float64], box: tuple[float, float, float, float], across: int) -> IndexedImage:
    """How many of some points, (n, 2), lie in each cell of ``box``, for the palettes ``DOTS``; ``across`` cells from
    west to east. A cell's index is twice the count, up to 254.
    """
    cell_m = (box[2] - box[0]) / across
    shape = across, max(1, round((box[3] - box[1]) / cell_m))
    extents = ((box[0], box[2]), (box[1], box[3]))
    counted, _, _ = np.histogram2d(points_m[:, 0], points_m[:, 1], bins=shape, range=extents)
    return IndexedImage.of(np.minimum(2 * counted, 254).astype(np.uint8).T[::-1])


def shrunk(values: ColumnValues, how: Callable[..., Any], most_pixels: int = MOST_PIXELS) -> ColumnValues:
    """Fewer, larger pixels where there are more than ``most_pixels``; those at the far edges stand for the columns
    that are left.
    """
    factor = math.ceil(math.sqrt(values.size / most_pixels))
    if factor <= 1:
        return values
    nx, ny = (-(-n // factor) for n in values.shape)
    padded = np.pad(values, ((0, nx * factor - values.shape[0]), (0, ny * factor - values.shape[1])), mode="edge")
    smaller: ColumnValues = how(padded.reshape(nx, factor, ny, factor), axis=(1, 3))
    return smaller


def _chunk(name: bytes, body: bytes) -> bytes:
    return len(body).to_bytes(4, "big") + name + body + zlib.crc32(name + body).to_bytes(4, "big")


def _palette(colours: bytes, alpha: bytes) -> bytes:
    return _chunk(b"PLTE", colours) + _chunk(b"tRNS", alpha)


def _field_palette(stops: Sequence[str]) -> bytes:
    alpha = bytes([0, *(round(255 * opacity(i / 254)) for i in range(255))])
    return _palette(b"\0\0\0" + b"".join(mixed(n, 254, stops) for n in range(255)), alpha)


def _shares_palette(stops: Sequence[str]) -> bytes:
    return _palette(b"\0\0\0" + b"".join(mixed(n, 254, stops) for n in range(255)), bytes([0, *[255] * 255]))


def _dots_palette(ink: str) -> bytes:
    """One colour, the denser the more points: a single one is visible."""
    return _palette(bytes.fromhex(ink) * 256, bytes([0, *(min(255, 110 + 12 * i) for i in range(255))]))


def _deflate(data: bytes) -> bytes:
    """A zlib stream from Arrow's compressor, which comes with the package: the system's may give other bytes."""
    gzip: bytes = pa.Codec("gzip", compression_level=6).compress(data, asbytes=True)
    return b"\x78\x9c" + gzip[10:-8] + zlib.adler32(data).to_bytes(4, "big")


END = _chunk(b"IEND", b"")
FIELD = {"day": _field_palette(ON_LIGHT), "night": _field_palette(ON_DARK)}
SHARES = {"day": _shares_palette(ON_LIGHT), "night": _shares_palette(ON_DARK)}
DOTS = {"day": _dots_palette("1d2430"), "night": _dots_palette("e6e9ef")}
SHADE_PALETTE = _palette(bytes((*SHADE[:3], *SHADE[:3])), bytes((0, SHADE[3])))
