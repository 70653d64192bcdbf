"""How does a run look from above?

Each figure is SVG text, made of world-frame metres (x east, y north; north is up), for the report and for any other
page:

- :func:`occupancy`: a field over the region, summed along z, with the static footprints and the sites;
- :func:`site_map`: the sites, coloured by score, numbered by rank;
- :func:`view`: what one site sees or misses; :func:`scale` is the colour scale that such figures share.

The text is written here, not by a plotting library: colours then follow the page (light, dark, print) through the
classes in ``STYLE``, lettering stays text, and the bytes depend on no installed font. Rasters are indexed PNG images,
one for light pages, where the largest value is darkest, and one for dark pages, where it is brightest: what matters
stands out on both. :func:`standalone` makes a file of a figure."""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.core.grid import Grid
from pipeline.world.mesh import World

Box = tuple[float, float, float, float]
"""x0, y0, x1, y1 in the world frame, metres."""

Field2 = NDArray[np.float64]
"""One value a column of voxels, (nx, ny) float64."""

# Viridis (van der Walt, Smith 2015; CC0) at 17 even places: the same for every kind of colour vision, and in grey.
_VIRIDIS = (
    "440154", "48186a", "472d7b", "424086", "3b528b", "33638d", "2c728e", "26828e", "21918c",
    "1fa088", "28ae80", "3fbc73", "5ec962", "84d44b", "addc30", "d8e219", "fde725",
)  # fmt: skip
_STEPS = len(_VIRIDIS) - 1
_DAY = _VIRIDIS[::-1]


def _mixed(at: int, whole: int, stops: Sequence[str]) -> tuple[int, ...]:
    """The colour at ``at / whole`` of a scale, RGB; in whole numbers, so that it is the same everywhere."""
    first, part = divmod(at * (len(stops) - 1), whole)
    pair = stops[first], stops[min(first + 1, len(stops) - 1)]
    low, high = ([int(stop[i : i + 2], 16) for i in (0, 2, 4)] for stop in pair)
    return tuple((a * (whole - part) + b * part + whole // 2) // whole for a, b in zip(low, high, strict=True))


# The darkest colours would vanish on a dark page.
_NIGHT = tuple(bytes(_mixed(i, _STEPS, _VIRIDIS[3:])).hex() for i in range(_STEPS + 1))

_FADE = 0.22
"""Below this share of the scale a colour fades into the page."""
_SHADE = (128, 128, 136, 84)

_PIXELS = 240_000
"""A raster has no more; larger grids are averaged."""
_WIDTH, _TALLEST = 760.0, 560.0
_SMALL = 4.0
"""Square metres of footprint below which a solid is street furniture."""
_GREEN = ("tree", "crown", "canopy", "hedge", "bush", "vegetation", "forest", "wood")
_LONGEST_LABEL, _CROWDED = 18, 40


def _style() -> str:
    light = "".join(f".q{i}{{fill:#{c};stop-color:#{c}}}" for i, c in enumerate(_DAY))
    dark = "".join(f".q{i}{{fill:#{c};stop-color:#{c}}}" for i, c in enumerate(_NIGHT))
    return f"""
.plan {{ --large: #d5d8df; --large-line: #7d8494; --green: #9fc3b6; --green-line: #5f8f80; --small: #4d5564; --halo: #ffffff;
  display: block; width: 100%; height: auto; color: #1d2430; font: 12px system-ui, "DejaVu Sans", sans-serif; }}
.plan text {{ fill: currentColor; }}
.plan .axis {{ stroke: currentColor; stroke-opacity: .45; fill: none; }}
.plan .grid {{ stroke: currentColor; stroke-opacity: .09; fill: none; }}
.plan .roi {{ stroke: currentColor; stroke-width: 1.6; stroke-dasharray: 7 4; fill: none; }}
.plan .large {{ fill: var(--large); stroke: var(--large-line); }}
.plan .green {{ fill: var(--green); fill-opacity: .45; stroke: var(--green-line); stroke-dasharray: 2 2; }}
.plan .small {{ fill: var(--small); stroke: var(--small); stroke-width: .5; }}
.plan .faint {{ opacity: .45; }}
.plan .site circle {{ stroke: currentColor; stroke-width: 1.2; }}
.plan .first circle {{ stroke-width: 2.6; }}
.plan .site .rank {{ font-size: 9.5px; font-weight: 700; text-anchor: middle; stroke: none; }}
.plan .low {{ fill: #14181f; }} .plan .high {{ fill: #ffffff; }}
.plan .label {{ font-weight: 600; paint-order: stroke; stroke: var(--halo); stroke-width: 3.5px; stroke-linejoin: round; }}
.plan .spot {{ fill: var(--halo); stroke: currentColor; stroke-width: 1.3; }}
.plan .lead {{ stroke: currentColor; stroke-width: .9; fill: none; }}
.plan .sensor {{ fill: #e8590c; stroke: var(--halo); stroke-width: 1.5; }}
.plan image {{ image-rendering: pixelated; }}
.plan .night {{ display: none; }}
{light}
@media screen and (prefers-color-scheme: dark) {{
.plan {{ --large: #343b48; --large-line: #7f889a; --green: #2f5b4f; --green-line: #6fa493; --small: #a9b2c3; --halo: #12161d;
  color: #e6e9ef; }}
.plan .low {{ fill: #ffffff; }} .plan .high {{ fill: #14181f; }}
.plan .day {{ display: none; }} .plan .night {{ display: inline; }}
{dark}
}}
"""


STYLE = _style()
"""What the figures' classes look like; a page that holds figures holds this once."""


@dataclass(frozen=True)
class Layer:
    """Footprints of one look (``large``, ``green`` or ``small``): what they are, and their rings (n, 2), world frame,
    metres."""

    look: str
    kinds: tuple[str, ...]
    rings: tuple[NDArray[np.float64], ...]


@dataclass(frozen=True)
class Spot:
    """A candidate site on a map, with its score."""

    site: str
    x_m: float
    y_m: float
    z_m: float
    egvs: float
    rank: int


@dataclass(frozen=True)
class Stand:
    """A sensor in its place: where it stands, which voxels its beams cross, (nx, ny, nz) bool, and what a figure of it
    shows."""

    spot: Spot
    crossed: NDArray[np.bool_]
    layers: Sequence[Layer]
    box: Box


# ---- what stands there


def footprints(world: World, box: Box) -> tuple[Layer, ...]:
    """The outlines of the static world seen from above within ``box``, buildings first, trees last; without the
    ground."""
    import shapely

    corners = world.triangles_m[:, :, :2]
    low, high = world.bounds_xy_m
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area_m2 = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    shown = (area_m2 > 1e-6) & (high > box[:2]).all(axis=1) & (low < box[2:]).all(axis=1)
    kinds = (
        np.array([kind for _, kind in world.solids])[world.solid_of_face]
        if len(world.faces)
        else np.empty(0, dtype=str)
    )
    found: dict[str, tuple[list[str], list[Any]]] = {look: ([], []) for look in ("large", "small", "green")}
    for kind in sorted(set(kinds[shown].tolist()) - {"ground"}):
        mine = shown & (kinds == kind)
        shape = shapely.union_all(shapely.polygons(corners[mine]))
        names, shapes = found[_look(kind, shape.area / len(np.unique(world.solid_of_face[mine])))]
        names.append(kind.replace("_", " "))
        shapes.append(shape)
    frame = shapely.box(box[0] - 1.0, box[1] - 1.0, box[2] + 1.0, box[3] + 1.0)
    return tuple(
        Layer(look, tuple(names), tuple(_rings(shapely.intersection(shapely.union_all(shapes), frame))))
        for look, (names, shapes) in found.items()
        if names
    )


def _look(kind: str, area_m2: float) -> str:
    if area_m2 < _SMALL and "crown" not in kind:
        return "small"
    return "green" if any(word in kind.lower() for word in _GREEN) else "large"


def _rings(shape: Any) -> Iterable[NDArray[np.float64]]:
    import shapely

    for part in shapely.get_parts(shape):
        if part.geom_type == "Polygon":
            yield from (shapely.get_coordinates(ring) for ring in (part.exterior, *part.interiors))


# ---- the figures


def extent(grid: Grid, spots: Sequence[Spot]) -> Box:
    """The region of interest and all sites, with a margin, in metres."""
    (x0, y0, _), (w, h, _) = grid.origin_m, grid.roi.size_m
    xs, ys = [x0, x0 + w, *(s.x_m for s in spots)], [y0, y0 + h, *(s.y_m for s in spots)]
    margin = 0.04 * max(max(xs) - min(xs), max(ys) - min(ys))
    return min(xs) - margin, min(ys) - margin, max(xs) + margin, max(ys) + margin


def occupancy(grid: Grid, field: Field2, label: str, layers: Sequence[Layer], spots: Sequence[Spot], alt: str) -> str:
    """A field over the region of interest, with footprints' outlines and the sites."""
    plan = _Plan(extent(grid, spots), "tpog", north=True)
    peak = float(field.max(initial=0.0))
    parts = [_image(plan, grid, field, peak), _outlines(plan, layers), plan.roi(grid)]
    parts += [_group(_dot(plan, s), f"{s.site}: rank {s.rank}") for s in spots]
    return plan.svg(parts, alt, bar=_Bar(0.0, peak, label))


def site_map(grid: Grid, field: Field2, layers: Sequence[Layer], spots: Sequence[Spot], alt: str) -> str:
    """The sites over the static footprints: colour by score, number by rank, name beside it; occupied roads faint
    below.

    Of sites that share a place, the best is in the middle of its rings. Where many sites stand, only the first ten and
    the last keep a name; every site tells its own under the pointer."""
    plan = _Plan(extent(grid, spots), "sites", north=True)
    places = _places(spots)
    low, high = min(s.egvs for s in spots), max(s.egvs for s in spots)
    crowded = is_crowded(spots)
    radius = 8.5 if not crowded else 6.0 if len(places) <= 120 else 4.0
    parts = [
        f'<g class="faint">{_image(plan, grid, field, float(field.max(initial=0.0)))}</g>',
        f"<g>{_outlines(plan, layers)}</g>",
        plan.roi(grid),
    ]
    parts += [_place(plan, place, low, high, radius, crowded) for place in reversed(places)]
    named = places if not crowded else [*places[:10], places[-1]]
    parts += _labels(plan, places, named, radius)
    return plan.svg(parts, alt, bar=_Bar(low, high, "EGVS (bit)", even=True) if high > low else None)


def is_crowded(spots: Sequence[Spot]) -> bool:
    """Whether the sites stand at too many places for numbers and names."""
    return len(_places(spots)) > _CROWDED


def has_rings(spots: Sequence[Spot]) -> bool:
    """Whether some sites share a place."""
    return len(_places(spots)) < len(spots)


def view(grid: Grid, field: Field2, peak: float, stand: Stand, name: str, alt: str) -> str:
    """Entropy from above that one site sees, or misses; columns of voxels that no beam crosses at any height are
    shaded.

    Parameters
    ----------
    field
        Entropy summed along z, bits, (nx, ny).
    peak
        The value at the end of the colour scale.
    name
        Makes ids unique on a page.
    """
    plan, spot = _Plan(stand.box, name, width=460.0, tallest=420.0), stand.spot
    unseen = _fewer(np.asarray(~stand.crossed.any(axis=2), dtype=np.float64), np.min)
    shade = _png(unseen.T[::-1] > 0, bytes((*_SHADE[:3], *_SHADE[:3])), bytes((0, _SHADE[3])))
    x, y = plan.x(spot.x_m), plan.y(spot.y_m)
    parts = [
        plan.image(grid, shade, "shadow"),
        _image(plan, grid, field, peak),
        _outlines(plan, stand.layers),
        plan.roi(grid),
        _group(f'<path class="sensor" d="M{x:.1f} {y - 9:.1f}l7.8 13.5h-15.6z"/>', f"{spot.site}, the sensor"),
    ]
    return plan.svg(parts, alt)


def scale(peak: float, label: str) -> str:
    """The colour scale that several figures share, alone."""
    bar = _Bar(0.0, peak, label)
    return _open(460.0, 52.0, f"Colour scale: {label}, 0 to {peak:.3g}") + bar.svg("scale", 16.0, 4.0, 428.0) + "</svg>"


def standalone(figure: str) -> str:
    """A figure as the content of a file of its own."""
    head, _, rest = figure.partition(">")
    return f'{head} xmlns="http://www.w3.org/2000/svg"><style>{STYLE}</style>{rest}\n'


# ---- drawing


class _Plan:
    """From world metres to a figure's units, and what every plan has: axes, frame, colour bar."""

    def __init__(
        self, box: Box, name: str, width: float = _WIDTH, tallest: float = _TALLEST, north: bool = False
    ) -> None:
        self.box, self.name, self.width, self.north = box, name, width, north
        self._ticks = [_nice(box[0], box[2], 9 if width > 600 else 6), _nice(box[1], box[3], 6)]
        self.left = 34.0 + 7.0 * max(len(t) for _, t in self._ticks[1])
        self.top, right = 12.0, 40.0 if north else 16.0
        self.scale = min((width - self.left - right) / (box[2] - box[0]), tallest / (box[3] - box[1]))
        self.w, self.h = (box[2] - box[0]) * self.scale, (box[3] - box[1]) * self.scale
        self.left += (width - self.left - right - self.w) / 2

    def x(self, x_m: float) -> float:
        """Rightwards with east."""
        return self.left + (x_m - self.box[0]) * self.scale

    def y(self, y_m: float) -> float:
        """Downwards with south."""
        return self.top + (self.box[3] - y_m) * self.scale

    def rectangle(self, grid: Grid) -> tuple[float, float, float, float]:
        """x, y, width, height of the region of interest."""
        (x, y, _), (w, h, _) = grid.origin_m, grid.roi.size_m
        return self.x(x), self.y(y + h), w * self.scale, h * self.scale

    def roi(self, grid: Grid) -> str:
        """The region of interest."""
        x, y, w, h = self.rectangle(grid)
        return f'<rect class="roi" x="{x:.1f}" y="{y:.1f}" width="{w:.1f}" height="{h:.1f}"/>'

    def image(self, grid: Grid, png: str, look: str) -> str:
        """A raster over the region of interest."""
        x, y, w, h = self.rectangle(grid)
        place = f'x="{x:.2f}" y="{y:.2f}" width="{w:.2f}" height="{h:.2f}"'
        return f'<image class="{look}" {place} preserveAspectRatio="none" href="{png}"/>'

    def svg(self, parts: Iterable[str], alt: str, bar: _Bar | None = None) -> str:
        """The whole figure."""
        base = self.top + self.h
        tall = base + 40.0 + (56.0 if bar else 0.0)
        frame = f'<rect x="{self.left:.1f}" y="{self.top:.1f}" width="{self.w:.1f}" height="{self.h:.1f}"/>'
        clip = f'<clipPath id="{self.name}-clip">{frame}</clipPath>'
        drawing = "\n".join(parts)
        return "\n".join(
            (
                _open(self.width, tall, alt),
                f'<defs>{clip}</defs>{self._axes(base)}\n<g clip-path="url(#{self.name}-clip)">{drawing}</g>',
                self._north() if self.north else "",
                bar.svg(self.name, self.left, base + 46.0, self.w) if bar else "",
                "</svg>",
            )
        )

    def _axes(self, base: float) -> str:
        right = self.left + self.w
        lines, ticks, texts = [], [f"M{self.left:.1f} {self.top:.1f}h{self.w:.1f}v{self.h:.1f}h{-self.w:.1f}z"], []
        for value, text in self._ticks[0]:
            x = self.x(value)
            lines.append(f"M{x:.1f} {self.top:.1f}V{base:.1f}")
            ticks.append(f"M{x:.1f} {base:.1f}v5")
            texts.append(f'<text x="{x:.1f}" y="{base + 18:.1f}" text-anchor="middle">{text}</text>')
        for value, text in self._ticks[1]:
            y = self.y(value)
            lines.append(f"M{self.left:.1f} {y:.1f}H{right:.1f}")
            ticks.append(f"M{self.left:.1f} {y:.1f}h-5")
            texts.append(f'<text x="{self.left - 8:.1f}" y="{y + 4:.1f}" text-anchor="end">{text}</text>')
        wide = 7.0 * max(len(t) for _, t in self._ticks[1])
        side, middle = self.left - 16.0 - wide, self.top + self.h / 2
        texts.append(
            f'<text x="{self.left + self.w / 2:.1f}" y="{base + 34:.1f}" text-anchor="middle">x, east (m)</text>'
        )
        texts.append(
            f'<text transform="translate({side:.1f} {middle:.1f}) rotate(-90)" text-anchor="middle">y, north (m)</text>'
        )
        return f'<path class="grid" d="{"".join(lines)}"/><path class="axis" d="{"".join(ticks)}"/>{"".join(texts)}'

    def _north(self) -> str:
        x, y = self.left + self.w + 20.0, self.top
        arrow = f'<path d="M{x:.1f} {y + 14:.1f}l7 24l-7 -6l-7 6z" fill="currentColor"/>'
        return f'<g>{arrow}<text x="{x:.1f}" y="{y + 10:.1f}" text-anchor="middle" font-weight="700">N</text></g>'


@dataclass(frozen=True)
class _Bar:
    """A colour bar: from ``low`` to ``high`` (above it), with a square-root scale unless ``even``."""

    low: float
    high: float
    label: str
    even: bool = False

    def svg(self, name: str, x: float, y: float, width: float) -> str:
        stops = "".join(self._stop(i) for i in range(_STEPS + 1))
        fill = f'<linearGradient id="{name}-scale">{stops}</linearGradient>'
        bar = f'<rect class="axis" style="fill:url(#{name}-scale)" x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="12"/>'
        ticks = "".join(
            f'<path class="axis" d="M{at:.1f} {y + 12:.1f}v4"/>'
            f'<text x="{at:.1f}" y="{y + 28:.1f}" text-anchor="middle">{text}</text>'
            for at, text in self._ticks(x, width)
        )
        note = "" if self.even else " · square-root scale"
        title = f'<text x="{x + width / 2:.1f}" y="{y + 44:.1f}" text-anchor="middle">{escape(self.label)}{note}</text>'
        return f"<g>{fill}{bar}{ticks}{title}</g>"

    def _stop(self, i: int) -> str:
        opacity = 1.0 if self.even else _opacity(i / _STEPS)
        return f'<stop class="q{i}" offset="{i / _STEPS:.4f}" stop-opacity="{opacity:.2f}"/>'

    def _ticks(self, x: float, width: float) -> list[tuple[float, str]]:
        """Round values, no closer to each other than their lettering allows; on a square-root scale, finer towards
        zero."""
        span = self.high - self.low
        values = _nice(self.low, self.high, 6)
        if not self.even:
            values = [*_nice(0.0, span / 25, 2), *_nice(0.0, span / 4, 4), *values]
        placed: list[tuple[float, str]] = []
        for value in sorted({value for value, _ in values}, reverse=True):
            text = f"{value:,.6g}"
            share = (value - self.low) / span
            at = x + width * (share if self.even else math.sqrt(share))
            if all(abs(at - other) > 5.0 * (len(text) + len(shown)) for other, shown in placed):
                placed.append((at, text))
        return placed


def _open(width: float, height: float, alt: str) -> str:
    return f'<svg class="plan" viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(alt)}">'


def _nice(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """Round values between two others, at most about ``most``, and how they are written."""
    span = high - low
    if not span > 0:
        return []
    exponent = math.floor(math.log10(span / most))
    tens = [(m, e) for e in (exponent - 1, exponent, exponent + 1) for m in (1, 2, 5)]
    size, power = next((float(f"{m}e{e}"), e) for m, e in tens if float(f"{m}e{e}") >= 0.999 * span / most)
    first, last = math.ceil(low / size - 1e-9), math.floor(high / size + 1e-9)
    return [(i * size, f"{i * size:,.{max(0, -power)}f}") for i in range(first, last + 1)]


def _outlines(plan: _Plan, layers: Sequence[Layer]) -> str:
    def path(ring: NDArray[np.float64]) -> str:
        xs = plan.left + (ring[:-1, 0] - plan.box[0]) * plan.scale
        ys = plan.top + (plan.box[3] - ring[:-1, 1]) * plan.scale
        return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in zip(xs.tolist(), ys.tolist(), strict=True)) + "z"

    return "".join(
        f'<path class="{layer.look}" fill-rule="evenodd" d="{"".join(path(ring) for ring in layer.rings)}"/>'
        for layer in layers
    )


def _group(drawn: str, title: str) -> str:
    return f"<g><title>{escape(title)}</title>{drawn}</g>"


def _dot(plan: _Plan, spot: Spot) -> str:
    return f'<circle class="spot" cx="{plan.x(spot.x_m):.1f}" cy="{plan.y(spot.y_m):.1f}" r="4"/>'


# ---- sites and their names


def _places(spots: Sequence[Spot]) -> list[list[Spot]]:
    """Sites that share a place, the best first; places by their best."""
    found: dict[tuple[float, float], list[Spot]] = {}
    for spot in sorted(spots, key=lambda s: s.rank):
        found.setdefault((spot.x_m, spot.y_m), []).append(spot)
    return list(found.values())


def _place(plan: _Plan, place: list[Spot], low: float, high: float, radius: float, crowded: bool) -> str:
    """Rings round each other, the best in the middle, with its rank unless places are crowded."""
    x, y = plan.x(place[0].x_m), plan.y(place[0].y_m)
    rings = [*place[:3], place[-1]] if len(place) > 4 else place
    circles = [
        f'<circle class="q{_class(s.egvs, low, high)}" cx="{x:.1f}" cy="{y:.1f}" r="{radius + 3.5 * i:.1f}"/>'
        for i, s in reversed(list(enumerate(rings)))
    ]
    tone = "high" if 2 * _class(place[0].egvs, low, high) > _STEPS else "low"
    rank = "" if crowded else f'<text class="rank {tone}" x="{x:.1f}" y="{y + 3.4:.1f}">{place[0].rank}</text>'
    title = "; ".join(f"{s.site}: rank {s.rank}, EGVS {s.egvs:,.0f} bit, height {s.z_m:g} m" for s in place)
    first = " first" if place[0].rank == 1 else ""
    return f'<g class="site{first}"><title>{escape(title)}</title>{"".join(circles)}{rank}</g>'


def _class(egvs: float, low: float, high: float) -> int:
    return round(_STEPS * (egvs - low) / (high - low)) if high > low else _STEPS


def _labels(plan: _Plan, places: Sequence[list[Spot]], named: Sequence[list[Spot]], radius: float) -> list[str]:
    """Names beside their places: in the first free spot round it, further out with a line, or where they hide least."""
    taken = [_square(plan.x(p[0].x_m), plan.y(p[0].y_m), radius + 3.5 * min(3, len(p) - 1) + 1) for p in places]
    drawn = []
    for place in named:
        x, y = plan.x(place[0].x_m), plan.y(place[0].y_m)
        text, near = _name(place), radius + 3.5 * min(3, len(place) - 1) + 4.0
        wide = 7.2 * len(text)
        options = [
            (d, _beside(x, y, d, wide, side)) for d in (near, near + 12, near + 26, near + 42) for side in range(8)
        ]
        inside = [o for o in options if _within(o[1], plan)] or options
        away, box = min(inside, key=lambda o: sum(_overlap(o[1], t) for t in taken))
        taken.append(box)
        if away > near:
            drawn.append(
                f'<path class="lead" d="M{x:.1f} {y:.1f}L{(box[0] + box[2]) / 2:.1f} {(box[1] + box[3]) / 2:.1f}"/>'
            )
        drawn.append(f'<text class="label" x="{box[0]:.1f}" y="{box[3] - 3:.1f}">{escape(text)}</text>')
    return drawn


def _name(place: list[Spot]) -> str:
    names = [s.site if len(s.site) <= _LONGEST_LABEL else s.site[: _LONGEST_LABEL - 1] + "…" for s in place]
    return ", ".join(names) if len(names) <= 2 else f"{names[0]} +{len(names) - 1}"


def _square(x: float, y: float, half: float) -> Box:
    return x - half, y - half, x + half, y + half


_SIDES = ((1, 0), (0, -1), (0, 1), (-1, 0), (0.71, -0.71), (-0.71, -0.71), (0.71, 0.71), (-0.71, 0.71))


def _beside(x: float, y: float, away: float, wide: float, side: int) -> Box:
    """A label's box: east, north, south, west, then the diagonals."""
    dx, dy = _SIDES[side]
    left = x + away * dx - wide * (0.0 if dx > 0 else 1.0 if dx < 0 else 0.5)
    top = y + away * dy - 15.0 * (0.0 if dy > 0 else 1.0 if dy < 0 else 0.5)
    return left, top, left + wide, top + 15.0


def _within(box: Box, plan: _Plan) -> bool:
    right, base = plan.left + plan.w, plan.top + plan.h
    return plan.left + 3 <= box[0] and box[2] <= right - 3 and plan.top + 2 <= box[1] and box[3] <= base - 2


def _overlap(a: Box, b: Box) -> float:
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))


# ---- rasters


def _image(plan: _Plan, grid: Grid, field: Field2, peak: float) -> str:
    """A field as two images, one for light pages and one for dark ones."""
    if not peak > 0:
        return ""
    share = np.sqrt(np.minimum(_fewer(field, np.mean) / peak, 1.0))
    index = np.where(share > 0, 1 + np.floor(share * 253.999), 0).astype(np.uint8).T[::-1]
    alpha = bytes([0, *(round(255 * _opacity(i / 254)) for i in range(255))])
    return "".join(
        plan.image(grid, _png(index, b"\0\0\0" + _palette(stops), alpha), look)
        for look, stops in (("day", _DAY), ("night", _NIGHT))
    )


def _fewer(field: Field2, how: Callable[..., Any]) -> Field2:
    """Fewer, larger pixels where there are more than ``_PIXELS``; those at the far edges stand for the columns that are
    left."""
    factor = math.ceil(math.sqrt(field.size / _PIXELS))
    if factor <= 1:
        return field
    nx, ny = (-(-n // factor) for n in field.shape)
    padded = np.pad(field, ((0, nx * factor - field.shape[0]), (0, ny * factor - field.shape[1])), mode="edge")
    smaller: Field2 = how(padded.reshape(nx, factor, ny, factor), axis=(1, 3))
    return smaller


def _opacity(share: float) -> float:
    return min(1.0, 0.2 + 0.8 * share / _FADE)


def _palette(stops: Sequence[str]) -> bytes:
    """255 colours between the stops, RGB."""
    return b"".join(bytes(_mixed(n, 254, stops)) for n in range(255))


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
    """A zlib stream from Arrow's compressor, which comes with the package: the system's may give other bytes
    elsewhere."""
    gzip: bytes = pa.Codec("gzip", compression_level=6).compress(data, asbytes=True)
    return b"\x78\x9c" + gzip[10:-8] + zlib.adler32(data).to_bytes(4, "big")
