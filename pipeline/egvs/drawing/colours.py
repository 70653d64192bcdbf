"""Colours of the figures, for light and dark pages; rasters as indexed PNG images in data URIs.

The scale is viridis (van der Walt, Smith 2015; CC0), which also works for colour-blind readers and in greyscale. On
light pages the largest value is darkest, on dark pages brightest, so that it always stands out. Colours are mixed in
integers and are therefore the same on every machine.

:data:`SHAPE_STYLES` says what each kind of shape looks like. On a page, shapes have classes, and :data:`STYLE_SHEET`
gives these the colours of the light or dark theme; in a file for print, :func:`shape_attributes` writes the final
colours on each shape.

PNG files are written by the few lines below, because an imaging library takes longer to import than all images take to
write, and its compressor may write other bytes on another processor.
"""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from egvs.core.grid import BoolArray, FloatArray

_VIRIDIS = (
    "440154", "48186a", "472d7b", "424086", "3b528b", "33638d", "2c728e", "26828e", "21918c",
    "1fa088", "28ae80", "3fbc73", "5ec962", "84d44b", "addc30", "d8e219", "fde725",
)  # fmt: skip
"""17 evenly spaced colours."""

SHADES = {"day": (128, 128, 136, 84), "night": (218, 126, 82, 166)}
"""RGBA of the shade over columns that no beam crosses; on dark pages brown, unlike buildings, roads and the scale."""

Colour = tuple[int, int, int]
"""Red, green, blue, 0 to 255."""

_LIGHT_SOLIDS: Mapping[str, Colour] = {
    "building": (205, 208, 216), "ground": (225, 222, 214), "tree_crown": (150, 190, 165), "lanes": (112, 118, 130),
    "junctions": (112, 118, 130), "markings": (250, 250, 250), "other": (150, 154, 166),
}  # fmt: skip
_DARK_SOLIDS: Mapping[str, Colour] = {
    "building": (66, 70, 82), "ground": (34, 36, 42), "tree_crown": (52, 88, 66), "lanes": (52, 56, 66),
    "junctions": (52, 56, 66), "markings": (150, 154, 164), "other": (92, 96, 108),
}  # fmt: skip

_FADE = 0.22
"""Below this share of the scale, colours fade into the page."""


def solid_colour(kind: str, *, is_dark: bool = False) -> Colour:
    """Return the colour of a mesh of the static world or the road in three dimensions.

    Parameters
    ----------
    kind
        Kind of solid, e.g. ``"building"``, or ``"lanes"``; others have one common colour.
    is_dark
        Whether the page is dark.

    Examples
    --------
    >>> solid_colour("ground"), solid_colour("fence") == solid_colour("other")
    ((225, 222, 214), True)
    """
    solids = _DARK_SOLIDS if is_dark else _LIGHT_SOLIDS
    return solids.get(kind, solids["other"])


def interpolate_colour(step: int, steps: int, stops: Sequence[str]) -> bytes:
    """Return a colour of a scale as RGB.

    Parameters
    ----------
    step, steps
        Position on the scale: ``step / steps``, 0 to 1.
    stops
        Evenly spaced colours of the scale, RRGGBB.
    """
    first, part = divmod(step * (len(stops) - 1), steps)
    low = bytes.fromhex(stops[first])
    high = bytes.fromhex(stops[min(first + 1, len(stops) - 1)])
    return bytes((a * (steps - part) + b * part + steps // 2) // steps for a, b in zip(low, high, strict=True))


STEPS = len(_VIRIDIS) - 1
"""The classes ``q0`` .. ``q16`` are evenly spaced colours of the scale, from its low end."""

ON_LIGHT = _VIRIDIS[::-1]
ON_DARK = tuple(interpolate_colour(i, STEPS, _VIRIDIS[6:]).hex() for i in range(STEPS + 1))
"""Without the darkest colours, which have a contrast of less than 3:1 to a dark page."""


def opacity(share: float) -> float:
    """Return the opacity of a colour at this share of the scale."""
    return min(1.0, 0.2 + 0.8 * share / _FADE)


def colour_class(value: float, low: float, high: float) -> int:
    """Return the number of the class of a value on a linear scale."""
    if not high > low:
        return STEPS
    return round(STEPS * (value - low) / (high - low))


@dataclass(frozen=True)
class Theme:
    """Colours of figures on a light or on a dark background; ``scale`` is the colour scale."""

    ink: str
    large: str
    large_line: str
    green: str
    green_line: str
    small: str
    halo: str
    road: str
    road_edge: str
    walk: str
    cycle: str
    rail: str
    street: str
    low: str
    high: str
    scale: Sequence[str]


LIGHT = Theme(
    ink="#1d2430", large="#d5d8df", large_line="#7d8494", green="#9fc3b6", green_line="#5f8f80", small="#4d5564",
    halo="#ffffff", road="#e4e7ed", road_edge="#b9c0cc", walk="#f6efe2", cycle="#f3dedb", rail="#dcd6e6",
    street="#4a5262", low="#14181f", high="#ffffff", scale=ON_LIGHT,
)  # fmt: skip
DARK = Theme(
    ink="#e6e9ef", large="#46526b", large_line="#9aa5ba", green="#2f5b4f", green_line="#6fa493", small="#a9b2c3",
    halo="#12161d", road="#232a36", road_edge="#717c90", walk="#2e2a20", cycle="#3a2827", rail="#2d2838",
    street="#b6becc", low="#ffffff", high="#14181f", scale=ON_DARK,
)  # fmt: skip

SHAPE_STYLES: Mapping[str, Mapping[str, str]] = {
    "axis": {"stroke": "{ink}", "stroke-opacity": ".45", "fill": "none"},
    "grid": {"stroke": "{ink}", "stroke-opacity": ".09", "fill": "none"},
    "north": {"fill": "{ink}"},
    "roi": {"stroke": "{ink}", "stroke-width": "1.6", "stroke-dasharray": "7 4", "fill": "none"},
    "large": {"fill": "{large}", "stroke": "{large_line}"},
    "green": {"fill": "{green}", "fill-opacity": ".45", "stroke": "{green_line}", "stroke-dasharray": "2 2"},
    "small": {"fill": "{small}", "stroke": "{small}", "stroke-width": ".5"},
    "faint": {"opacity": ".45"},
    "roads": {"fill": "none", "stroke-linejoin": "round"},
    "edge": {"stroke": "{road_edge}"},
    "junction": {"fill": "{road}"},
    "drive": {"stroke": "{road}"},
    "walk": {"stroke": "{walk}"},
    "cycle": {"stroke": "{cycle}"},
    "rail": {"stroke": "{rail}"},
    "street": {"font-size": "11px", "font-style": "italic", "fill": "{street}", "text-anchor": "middle"},
    "street-halo": {"stroke": "{halo}", "stroke-width": "3", "stroke-linejoin": "round"},
    "site": {"stroke": "{ink}", "stroke-width": "1.2"},
    "first": {"stroke-width": "2.6"},
    "rank": {"font-size": "9.5px", "font-weight": "700", "text-anchor": "middle", "stroke": "none"},
    "low": {"fill": "{low}"},
    "high": {"fill": "{high}"},
    "label": {"font-weight": "600"},
    "label-halo": {"stroke": "{halo}", "stroke-width": "3.5", "stroke-linejoin": "round"},
    "spot": {"fill": "{halo}", "stroke": "{ink}", "stroke-width": "1.3"},
    "lead": {"stroke": "{ink}", "stroke-width": ".9", "fill": "none"},
    "sensor": {"fill": "#e8590c", "stroke": "{halo}", "stroke-width": "1.5"},
}
"""SVG properties by the class of a shape; ``{ink}`` etc. are colours of a :class:`Theme`."""

_PAGE_RULES = """
.plan { display: block; width: 100%; height: auto; font: 12px system-ui, "DejaVu Sans", sans-serif; }
.plan text { fill: currentColor; }
.plan .share.day { opacity: .88; }
.plan .worst circle { fill: var(--halo); stroke: currentColor; stroke-width: 1.4; }
.plan .worst text { font-weight: 700; font-size: 11px; text-anchor: middle; }
.plan .view { fill: #3d85c6; fill-opacity: .08; stroke: #3d85c6; stroke-width: 1.4; stroke-linejoin: round; }
.plan .planned rect { fill: #2b6cb0; stroke: var(--halo); stroke-width: 1.6; }
.plan .planned text { fill: #ffffff; font-weight: 700; font-size: 11.5px; text-anchor: middle; }
.plan .step rect { fill: #31688e; } .plan .step path { stroke: currentColor; stroke-width: 2.4; fill: none; }
.plan .night { display: none; }
"""

_DARK_RULES = """
.plan .day { display: none; } .plan .night { display: inline; }
"""


def shape_attributes(name: str, theme: Theme) -> dict[str, str]:
    """Return the SVG attributes of a shape in the colours of a theme.

    Parameters
    ----------
    name
        A key of :data:`SHAPE_STYLES`, or ``q0`` .. ``q16`` for a colour of the scale; any other has no attributes.
    theme
        The colours.
    """
    if name[:1] == "q" and name[1:].isdigit():
        colour = f"#{theme.scale[int(name[1:])]}"
        return {"fill": colour, "stop-color": colour}
    return {key: value.format(**asdict(theme)) for key, value in SHAPE_STYLES.get(name, {}).items()}


def _style_sheet() -> str:
    names = [field.name for field in fields(Theme) if field.name not in ("ink", "scale")]
    on_page = {name: f"var(--{name.replace('_', '-')})" for name in names} | {"ink": "currentColor"}
    rules = []
    for name, properties in SHAPE_STYLES.items():
        body = "; ".join(f"{key}: {value.format(**on_page)}" for key, value in properties.items())
        if name.endswith("-halo"):  # the stroke first, then the letters
            name = name.removesuffix("-halo")
            body += "; paint-order: stroke"
        rules.append(f".plan .{name} {{ {body}; }}\n")
    return (
        f"{_theme_rules(LIGHT, names)}{_PAGE_RULES}{''.join(rules)}"
        f"@media screen and (prefers-color-scheme: dark) {{{_theme_rules(DARK, names)}{_DARK_RULES}}}\n"
    )


def _theme_rules(theme: Theme, names: Sequence[str]) -> str:
    variables = " ".join(f"--{name.replace('_', '-')}: {getattr(theme, name)};" for name in names)
    classes = "".join(f".q{i}{{fill:#{colour};stop-color:#{colour}}}" for i, colour in enumerate(theme.scale))
    return f"\n.plan {{ {variables} color: {theme.ink}; }}\n{classes}"


STYLE_SHEET = _style_sheet()
"""Rules of the figures' classes; a page with figures needs them once."""

ColumnValues = FloatArray
"""One value per column of voxels, shape (nx, ny)."""

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

MAX_PIXELS = 240_000
"""Maximum number of pixels; larger grids are averaged."""

THEMES = ("day", "night")
"""Classes of the images for light and for dark pages."""


@dataclass(frozen=True)
class IndexedImage:
    """Parts of a PNG file without the palette, so that a page can join them with the palette of its theme."""

    head: bytes
    data: bytes

    @classmethod
    def from_indices(cls, index: NDArray[np.uint8]) -> IndexedImage:
        """Return an image of palette indices, shape (height, width), from the northernmost row."""
        height, width = index.shape
        rows = np.zeros((height, width + 1), dtype=np.uint8)  # the first byte of a row is its filter: none
        rows[:, 1:] = index
        head = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes((8, 3, 0, 0, 0))
        return cls(PNG_SIGNATURE + _png_chunk(b"IHDR", head), _png_chunk(b"IDAT", _deflate(rows.tobytes())))

    def uri(self, palette: bytes) -> str:
        """Return the complete image as a data URI."""
        data = self.head + palette + self.data + PNG_END
        return f"data:image/png;base64,{base64.b64encode(data).decode('ascii')}"


def rgb_image_uri(rgb: NDArray[np.uint8]) -> str:
    """Return an image of colours, shape (height, width, 3), as a PNG in a data URI."""
    height, width, _ = rgb.shape
    rows = np.zeros((height, 1 + 3 * width), dtype=np.uint8)  # the first byte of a row is its filter: none
    rows[:, 1:] = rgb.reshape(height, -1)
    head = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes((8, 2, 0, 0, 0))
    chunks = _png_chunk(b"IHDR", head) + _png_chunk(b"IDAT", _deflate(rows.tobytes())) + PNG_END
    return f"data:image/png;base64,{base64.b64encode(PNG_SIGNATURE + chunks).decode('ascii')}"


def field_image(values: ColumnValues, peak: float, max_pixels: int = MAX_PIXELS) -> IndexedImage:
    """Return values on a square-root scale up to ``peak`` (above 0), for :data:`FIELD_PALETTES`."""
    share = np.sqrt(np.minimum(downsample(values, np.mean, max_pixels) / peak, 1.0))
    return IndexedImage.from_indices(np.where(share > 0, 1 + np.floor(share * 253.999), 0).astype(np.uint8).T[::-1])


def share_image(share: ColumnValues) -> IndexedImage:
    """Return shares, 0 to 1, on a linear scale, for :data:`SHARE_PALETTES`; NaN is transparent."""
    known = np.nan_to_num(share, nan=0.0)
    return IndexedImage.from_indices(
        np.where(np.isnan(share), 0, 1 + np.floor(known * 253.999)).astype(np.uint8).T[::-1]
    )


def shade_image(shaded: BoolArray, max_pixels: int = MAX_PIXELS) -> IndexedImage:
    """Return a shade over columns of voxels, shape (nx, ny), for :data:`SHADE_PALETTES`.

    A pixel of several columns is shaded if all of them are.
    """
    return IndexedImage.from_indices(
        (downsample(shaded.astype(np.float64), np.min, max_pixels).T[::-1] > 0).astype(np.uint8)
    )


def dots_image(points_m: FloatArray, box: tuple[float, float, float, float], across: int) -> IndexedImage:
    """Return the number of points in each cell of a box, for :data:`DOT_PALETTES`.

    Parameters
    ----------
    points_m
        x, y, shape (n, 2).
    box
        x0, y0, x1, y1 in metres.
    across
        Number of cells from west to east.
    """
    cell_m = (box[2] - box[0]) / across
    shape = across, max(1, round((box[3] - box[1]) / cell_m))
    extents = ((box[0], box[2]), (box[1], box[3]))
    counted, _, _ = np.histogram2d(points_m[:, 0], points_m[:, 1], bins=shape, range=extents)
    # an index is twice the count, up to 254
    return IndexedImage.from_indices(np.minimum(2 * counted, 254).astype(np.uint8).T[::-1])


def downsample(values: ColumnValues, how: Callable[..., Any], max_pixels: int = MAX_PIXELS) -> ColumnValues:
    """Combine columns into at most ``max_pixels`` larger pixels.

    Parameters
    ----------
    values
        Values of the columns.
    how
        Combines an array over axes, e.g. ``np.mean``.
    max_pixels
        Maximum number of pixels. Values at the north and east edges are repeated to fill the last pixels.
    """
    factor = math.ceil(math.sqrt(values.size / max_pixels))
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


def category_palette(categories: Sequence[str]) -> bytes:
    """Return a palette of one colour per index, RRGGBB or, with its opacity, RRGGBBAA, for :meth:`IndexedImage.uri`."""
    rgba = [bytes.fromhex(colour.ljust(8, "f")) for colour in categories]
    return _palette(b"".join(colour[:3] for colour in rgba), bytes(colour[3] for colour in rgba))


def _field_palette(stops: Sequence[str]) -> bytes:
    alpha = bytes([0, *(round(255 * opacity(i / 254)) for i in range(255))])
    return _palette(_scale_colours(stops), alpha)


def _shares_palette(stops: Sequence[str]) -> bytes:
    return _palette(_scale_colours(stops), bytes([0, *[255] * 255]))


def _scale_colours(stops: Sequence[str]) -> bytes:
    return b"\0\0\0" + b"".join(interpolate_colour(n, 254, stops) for n in range(255))


def _dots_palette(ink: str) -> bytes:
    """One colour, more opaque for more points; a single point is visible."""
    return _palette(bytes.fromhex(ink) * 256, bytes([0, *(min(255, 110 + 12 * i) for i in range(255))]))


def _shade_palette(rgba: tuple[int, int, int, int]) -> bytes:
    """A transparent colour, and the shade."""
    return _palette(bytes((*rgba[:3], *rgba[:3])), bytes((0, rgba[3])))


def _deflate(data: bytes) -> bytes:
    """Return a zlib stream by Arrow's compressor, which is the same everywhere; the system's zlib is not."""
    gzip: bytes = pa.Codec("gzip", compression_level=6).compress(data, asbytes=True)
    return b"\x78\x9c" + gzip[10:-8] + zlib.adler32(data).to_bytes(4, "big")


PNG_END = _png_chunk(b"IEND", b"")
FIELD_PALETTES = {"day": _field_palette(ON_LIGHT), "night": _field_palette(ON_DARK)}
SHARE_PALETTES = {"day": _shares_palette(ON_LIGHT), "night": _shares_palette(ON_DARK)}
DOT_PALETTES = {"day": _dots_palette("1d2430"), "night": _dots_palette("e6e9ef")}
SHADE_PALETTES = {theme: _shade_palette(rgba) for theme, rgba in SHADES.items()}
