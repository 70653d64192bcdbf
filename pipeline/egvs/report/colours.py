"""Colour scales, light and dark; rasters as indexed PNG.

The colours of the figures: one scale for light pages and one for dark ones, and the style sheet of the classes.

The scale is viridis (van der Walt, Smith 2015; CC0), the same for every kind of colour vision, and in grey. On light
pages the largest value is darkest, on dark pages brightest: what matters stands out on both. Colours are mixed in whole
numbers, so that they are the same on every machine.

Values over the region of interest as indexed PNG images, in data URIs.

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

_VIRIDIS = (
    "440154", "48186a", "472d7b", "424086", "3b528b", "33638d", "2c728e", "26828e", "21918c",
    "1fa088", "28ae80", "3fbc73", "5ec962", "84d44b", "addc30", "d8e219", "fde725",
)  # fmt: skip
"""17 even places of the scale."""

SHADE = (128, 128, 136, 84)
"""What no beam crosses, RGBA."""

_FADE = 0.22
"""Below this share of the scale a colour fades into the page."""


def interpolate_colour(at: int, steps: int, stops: Sequence[str]) -> bytes:
    """The colour at ``at / whole`` of a scale, RGB."""
    first, part = divmod(at * (len(stops) - 1), steps)
    pair = stops[first], stops[min(first + 1, len(stops) - 1)]
    low, high = (bytes.fromhex(stop) for stop in pair)
    return bytes((a * (steps - part) + b * part + steps // 2) // steps for a, b in zip(low, high, strict=True))


STEPS = len(_VIRIDIS) - 1
"""The classes ``q0`` .. ``q16`` are the even places of the scale, from its low end."""
ON_LIGHT = _VIRIDIS[::-1]
ON_DARK = tuple(
    interpolate_colour(i, STEPS, _VIRIDIS[3:]).hex() for i in range(STEPS + 1)
)  # the darkest would vanish there


def opacity(share: float) -> float:
    """How much a colour at this share of the scale covers the page."""
    return min(1.0, 0.2 + 0.8 * share / _FADE)


def colour_class(value: float, low: float, high: float) -> int:
    """The number of the class that ``value`` has on an even scale."""
    return round(STEPS * (value - low) / (high - low)) if high > low else STEPS


def _colour_rules(stops: Sequence[str]) -> str:
    return "".join(f".q{i}{{fill:#{c};stop-color:#{c}}}" for i, c in enumerate(stops))


STYLE_SHEET = f"""
.plan {{ --large: #d5d8df; --large-line: #7d8494; --green: #9fc3b6; --green-line: #5f8f80; --small: #4d5564; \
--halo: #ffffff; --road: #e4e7ed; --road-edge: #b9c0cc; --walk: #f6efe2; --cycle: #f3dedb; --rail: #dcd6e6; \
--street: #4a5262;
  display: block; width: 100%; height: auto; color: #1d2430; font: 12px system-ui, "DejaVu Sans", sans-serif; }}
.plan text {{ fill: currentColor; }}
.plan .axis {{ stroke: currentColor; stroke-opacity: .45; fill: none; }}
.plan .grid {{ stroke: currentColor; stroke-opacity: .09; fill: none; }}
.plan .roi {{ stroke: currentColor; stroke-width: 1.6; stroke-dasharray: 7 4; fill: none; }}
.plan .large {{ fill: var(--large); stroke: var(--large-line); }}
.plan .green {{ fill: var(--green); fill-opacity: .45; stroke: var(--green-line); stroke-dasharray: 2 2; }}
.plan .small {{ fill: var(--small); stroke: var(--small); stroke-width: .5; }}
.plan .faint {{ opacity: .45; }}
.plan .roads path {{ fill: none; stroke-linejoin: round; }}
.plan .roads .edge {{ stroke: var(--road-edge); }}
.plan .roads .junction {{ fill: var(--road); }}
.plan .roads .drive {{ stroke: var(--road); }} .plan .roads .walk {{ stroke: var(--walk); }}
.plan .roads .cycle {{ stroke: var(--cycle); }} .plan .roads .rail {{ stroke: var(--rail); }}
.plan .street {{ font-size: 11px; font-style: italic; fill: var(--street); text-anchor: middle; \
paint-order: stroke; stroke: var(--halo); stroke-width: 3px; stroke-linejoin: round; }}
.plan .site circle {{ stroke: currentColor; stroke-width: 1.2; }}
.plan .first circle {{ stroke-width: 2.6; }}
.plan .site .rank {{ font-size: 9.5px; font-weight: 700; text-anchor: middle; stroke: none; }}
.plan .low {{ fill: #14181f; }} .plan .high {{ fill: #ffffff; }}
.plan .label {{ font-weight: 600; paint-order: stroke; stroke: var(--halo); stroke-width: 3.5px; \
stroke-linejoin: round; }}
.plan .spot {{ fill: var(--halo); stroke: currentColor; stroke-width: 1.3; }}
.plan .lead {{ stroke: currentColor; stroke-width: .9; fill: none; }}
.plan .sensor {{ fill: #e8590c; stroke: var(--halo); stroke-width: 1.5; }}
.plan .share {{ opacity: .88; }}
.plan .worst circle {{ fill: var(--halo); stroke: currentColor; stroke-width: 1.4; }}
.plan .worst text {{ font-weight: 700; font-size: 11px; text-anchor: middle; }}
.plan .planned rect {{ fill: #e8590c; stroke: var(--halo); stroke-width: 1.6; }}
.plan .planned text {{ fill: #ffffff; font-weight: 700; font-size: 11.5px; text-anchor: middle; }}
.plan .step rect {{ fill: #31688e; }} .plan .step path {{ stroke: currentColor; stroke-width: 2.4; fill: none; }}
.plan image {{ image-rendering: pixelated; }}
.plan .night {{ display: none; }}
{_colour_rules(ON_LIGHT)}
@media screen and (prefers-color-scheme: dark) {{
.plan {{ --large: #343b48; --large-line: #7f889a; --green: #2f5b4f; --green-line: #6fa493; --small: #a9b2c3; \
--halo: #12161d; --road: #232a36; --road-edge: #414a5a; --walk: #2e2a20; --cycle: #3a2827; --rail: #2d2838; \
--street: #b6becc;
  color: #e6e9ef; }}
.plan .low {{ fill: #ffffff; }} .plan .high {{ fill: #14181f; }}
.plan .day {{ display: none; }} .plan .night {{ display: inline; }}
{_colour_rules(ON_DARK)}
}}
"""
"""What the figures' classes look like; a page that holds figures holds this once."""

ColumnValues = NDArray[np.float64]
"""One value a column of voxels, (nx, ny) float64."""

MAX_PIXELS = 240_000
"""A raster has no more; larger grids are averaged."""

THEMES = ("day", "night")
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
        return cls(b"\x89PNG\r\n\x1a\n" + _png_chunk(b"IHDR", head), _png_chunk(b"IDAT", _deflate(rows.tobytes())))

    def uri(self, palette: bytes) -> str:
        """The whole image as a data URI."""
        data = self.head + palette + self.data + PNG_END
        return f"data:image/png;base64,{base64.b64encode(data).decode('ascii')}"


def field_image(values: ColumnValues, peak: float, most_pixels: int = MAX_PIXELS) -> IndexedImage:
    """A field on a square-root scale up to ``peak``, above 0, for the palettes ``FIELD``."""
    share = np.sqrt(np.minimum(downsample(values, np.mean, most_pixels) / peak, 1.0))
    return IndexedImage.of(np.where(share > 0, 1 + np.floor(share * 253.999), 0).astype(np.uint8).T[::-1])


def share_image(share: ColumnValues) -> IndexedImage:
    """Shares from 0 to 1 on an even scale, for the palettes ``SHARES``; nothing where one is not a number."""
    known = np.nan_to_num(share, nan=0.0)
    return IndexedImage.of(np.where(np.isnan(share), 0, 1 + np.floor(known * 253.999)).astype(np.uint8).T[::-1])


def shade_image(shaded: NDArray[np.bool_], most_pixels: int = MAX_PIXELS) -> IndexedImage:
    """A shade over columns of voxels, (nx, ny) bool, for ``SHADE_PALETTE``; where columns share a pixel, all must be
    shaded.
    """
    return IndexedImage.of((downsample(shaded.astype(np.float64), np.min, most_pixels).T[::-1] > 0).astype(np.uint8))


def dots_image(points_m: NDArray[np.float64], box: tuple[float, float, float, float], across: int) -> IndexedImage:
    """How many of some points, (n, 2), lie in each cell of ``box``, for the palettes ``DOTS``; ``across`` cells from
    west to east. A cell's index is twice the count, up to 254.
    """
    cell_m = (box[2] - box[0]) / across
    shape = across, max(1, round((box[3] - box[1]) / cell_m))
    extents = ((box[0], box[2]), (box[1], box[3]))
    counted, _, _ = np.histogram2d(points_m[:, 0], points_m[:, 1], bins=shape, range=extents)
    return IndexedImage.of(np.minimum(2 * counted, 254).astype(np.uint8).T[::-1])


def downsample(values: ColumnValues, how: Callable[..., Any], most_pixels: int = MAX_PIXELS) -> ColumnValues:
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


def _png_chunk(name: bytes, body: bytes) -> bytes:
    return len(body).to_bytes(4, "big") + name + body + zlib.crc32(name + body).to_bytes(4, "big")


def _palette(colours: bytes, alpha: bytes) -> bytes:
    return _png_chunk(b"PLTE", colours) + _png_chunk(b"tRNS", alpha)


def _field_palette(stops: Sequence[str]) -> bytes:
    alpha = bytes([0, *(round(255 * opacity(i / 254)) for i in range(255))])
    return _palette(b"\0\0\0" + b"".join(interpolate_colour(n, 254, stops) for n in range(255)), alpha)


def _shares_palette(stops: Sequence[str]) -> bytes:
    return _palette(
        b"\0\0\0" + b"".join(interpolate_colour(n, 254, stops) for n in range(255)), bytes([0, *[255] * 255])
    )


def _dots_palette(ink: str) -> bytes:
    """One colour, the denser the more points: a single one is visible."""
    return _palette(bytes.fromhex(ink) * 256, bytes([0, *(min(255, 110 + 12 * i) for i in range(255))]))


def _deflate(data: bytes) -> bytes:
    """A zlib stream from Arrow's compressor, which comes with the package: the system's may give other bytes."""
    gzip: bytes = pa.Codec("gzip", compression_level=6).compress(data, asbytes=True)
    return b"\x78\x9c" + gzip[10:-8] + zlib.adler32(data).to_bytes(4, "big")


PNG_END = _png_chunk(b"IEND", b"")
FIELD_PALETTES = {"day": _field_palette(ON_LIGHT), "night": _field_palette(ON_DARK)}
SHARE_PALETTES = {"day": _shares_palette(ON_LIGHT), "night": _shares_palette(ON_DARK)}
DOT_PALETTES = {"day": _dots_palette("1d2430"), "night": _dots_palette("e6e9ef")}
SHADE_PALETTE = _palette(bytes((*SHADE[:3], *SHADE[:3])), bytes((0, SHADE[3])))
