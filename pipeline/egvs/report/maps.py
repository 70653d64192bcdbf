"""Maps of a run as SVG.

Maps of a run, each an SVG figure seen from above, for the report and for any other page.

- :func:`occupancy`: a field over the region, summed along z, with the static outlines and the sites;
- :func:`site_map`: the sites, coloured by score, numbered by rank;
- :func:`site_view`: what one site sees or misses; such figures share the colour scale
  :func:`egvs.report.svg_figures.shared_scale`;
- :func:`scan_view`: where the beams of its empty scan end;
- :func:`missed_view`: the share of the vehicles that it misses, square by square, with the worst places numbered.

Roads lie under all of them but the empty scan.

Names of sites are placed so that they hide little.

Figures of a plan of several sensors: the map of its poles, and how much each number of sensors is worth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.readers import MAX_LOCATIONS, SiteBlindspots
from egvs.core.grid import Grid
from egvs.report import colours
from egvs.report.basemap import Outlines, Roads, StreetName
from egvs.report.colours import ColumnValues, IndexedImage
from egvs.report.svg_figures import Box, ColourBar, MapFrame, MapSite, extent

StackedSites = list[MapSite]
"""Sites that stand above one another, the best first."""

WIDTH, _TALLEST = 760.0, 560.0
"""Of the maps of a page, in their own units."""
_MAX_LETTERS = 18
"""Letters of a name; longer ones are cut."""
_LABEL_GAP = 4.0
"""Between a spot and its name."""
_CROWDED = 40
"""With more places than this, a map has no room for numbers and names."""
_STREET_NAME_POSITIONS = (0.5, 0.3, 0.7, 0.15, 0.85)
"""Where along its piece of street a name may stand; the first that is free."""
_LABEL_SIDES = ((1, 0), (0, -1), (0, 1), (-1, 0), (0.71, -0.71), (-0.71, -0.71), (0.71, 0.71), (-0.71, 0.71))
"""East, north, south, west, then the diagonals."""


@dataclass(frozen=True)
class Backdrop:
    """What lies under every map: the static outlines, and the roads."""

    outlines: Sequence[Outlines]
    roads: Roads


@dataclass(frozen=True)
class SiteViewFigure:
    """A sensor in its place: the voxels that its beams cross, (nx, ny, nz) bool, and what lies under the figure."""

    site: MapSite
    crossed: NDArray[np.bool_]
    backdrop: Backdrop
    box: Box


def occupancy(
    grid: Grid,
    values: ColumnValues,
    label: str,
    backdrop: Backdrop,
    sites: Sequence[MapSite],
    alt: str,
    width: float = WIDTH,
) -> str:
    """A field over the region of interest, with the roads, the static outlines and the sites."""
    plan = _sites_frame(extent(grid, sites), "tpog", width)
    peak = float(values.max(initial=0.0))
    parts = [
        _road_paths(plan, backdrop.roads),
        _field_image(plan, grid, values, peak),
        _outline_paths(plan, backdrop.outlines),
        plan.roi(grid),
        *_street_names(plan, backdrop.roads.names, sites)[0],
    ]
    for s in sites:
        dot = f'<circle class="spot" cx="{plan.x(s.x_m):.1f}" cy="{plan.y(s.y_m):.1f}" r="4"/>'
        parts.append(_with_title(dot, f"{s.site}: rank {s.rank}"))
    return plan.svg(parts, alt, bar=ColourBar(0.0, peak, label))


def site_map(
    grid: Grid, values: ColumnValues, backdrop: Backdrop, sites: Sequence[MapSite], alt: str, width: float = WIDTH
) -> str:
    """The sites over roads and static outlines: colour by score, number by rank, name beside it; traffic faint below.

    Of sites that share a place, the best is in the middle of its rings. Where many sites stand, only the first ten and
    the last keep a name; every site tells its own under the pointer.
    """
    plan = _sites_frame(extent(grid, sites), "sites", width)
    places = _stack_sites(sites)
    crowded, low, high = is_crowded(sites), min(s.score for s in sites), max(s.score for s in sites)
    streets, street_boxes = _street_names(plan, backdrop.roads.names, sites)
    radius = 8.5 if not crowded else 6.0 if len(places) <= 120 else 4.0
    parts = [*base_layers(plan, grid, values, backdrop), *streets]
    parts += [_site_rings(plan, place, low, high, radius, crowded) for place in reversed(places)]
    named = places if not crowded else [*places[:10], places[-1]]
    parts += _labels(plan, places, named, radius, street_boxes)
    bar = ColourBar(low, high, sites[0].by.label, even=True) if high > low else None
    return plan.svg(parts, alt, bar=bar)


def _sites_frame(box: Box, prefix: str, width: float) -> MapFrame:
    """The frame of a map of all sites; as tall as it needs to be where it is narrow."""
    return MapFrame(box, prefix, width=width, tallest=max(_TALLEST, width), north=True)


def base_layers(plan: MapFrame, grid: Grid, values: ColumnValues, backdrop: Backdrop) -> list[str]:
    """What lies under sites: roads, faint traffic, static outlines, the region."""
    return [
        _road_paths(plan, backdrop.roads),
        f'<g class="faint">{_field_image(plan, grid, values, float(values.max(initial=0.0)))}</g>',
        f"<g>{_outline_paths(plan, backdrop.outlines)}</g>",
        plan.roi(grid),
    ]


def site_view(
    grid: Grid,
    values: ColumnValues,
    peak: float,
    view: SiteViewFigure,
    prefix: str,
    alt: str,
    width: float | None = None,
    label: str = "",
) -> str:
    """Entropy from above that one site sees, or misses; columns of voxels that no beam crosses at any height are
    shaded. Its images carry classes (``shade``, ``field``) by which a page may exchange them.

    Parameters
    ----------
    values
        Entropy summed along z, bits, (nx, ny).
    peak
        The value at the end of the colour scale.
    prefix
        Makes ids unique on a page.
    width
        Of the figure, in its own units; that of a page's panels for None.
    label
        Of a colour scale below it; none without.
    """
    plan = site_view_frame(view.box, prefix) if width is None else _sites_frame(view.box, prefix, width)
    shade = colours.shade_image(np.logical_not(view.crossed.any(axis=2)))
    parts = [
        _road_paths(plan, view.backdrop.roads),
        plan.image(plan.region(grid), shade.uri(colours.SHADE_PALETTE), "shade"),
        _field_image(plan, grid, values, peak),
        _outline_paths(plan, view.backdrop.outlines),
        plan.roi(grid),
        _sensor_mark(plan, view.site),
    ]
    return plan.svg(parts, alt, ColourBar(0.0, peak, label) if label else None)


def scan_view(grid: Grid, image: IndexedImage, view: SiteViewFigure, prefix: str, alt: str) -> str:
    """Where the beams of one site's empty scan end, from above; ``image`` covers the view's box."""
    plan = site_view_frame(view.box, prefix)
    images = (
        plan.image(plan.full_extent, image.uri(colours.DOT_PALETTES[look]), f"field {look}") for look in colours.THEMES
    )
    parts = [_outline_paths(plan, view.backdrop.outlines), *images, plan.roi(grid), _sensor_mark(plan, view.site)]
    return plan.svg(parts, alt)


def missed_view(
    grid: Grid, blindspots: SiteBlindspots, site: MapSite, backdrop: Backdrop, box: Box, prefix: str
) -> str:
    """Which share of the vehicles over each square one site misses, with its worst places numbered. Its
    image carries a class by which a page may exchange it; numbers beyond those of the worst places are hidden."""
    plan, image = site_view_frame(box, prefix), colours.share_image(blindspots.share_missed)
    (x, y), (nx, ny) = blindspots.origin_m, blindspots.share_missed.shape
    place = (
        plan.x(x),
        plan.y(y + ny * blindspots.cell_m),
        nx * blindspots.cell_m * plan.scale,
        ny * blindspots.cell_m * plan.scale,
    )
    parts = [
        _road_paths(plan, backdrop.roads),
        *(plan.image(place, image.uri(colours.SHARE_PALETTES[look]), f"field share {look}") for look in colours.THEMES),
        _outline_paths(plan, backdrop.outlines),
        plan.roi(grid),
        _sensor_mark(plan, site),
        *(_number_mark(number, at) for number, at in enumerate(label_positions(plan, blindspots), 1)),
    ]
    missed = (
        f"{1.0 - blindspots.overall.share:.1%} of the vehicles"
        if blindspots.overall
        else "vehicles, of which there are none"
    )
    bar = ColourBar(0.0, 100.0, "Share of the vehicles that is missed (%)", even=True)
    return plan.svg(parts, f"From above: where {site.site} misses {missed}, square by square.", bar)


def label_positions(plan: MapFrame, blindspots: SiteBlindspots) -> list[tuple[float, float] | None]:
    """Where the numbers of a site's worst places stand on a figure; None for those that it has not."""
    worst = [(round(plan.x(place.x_m), 1), round(plan.y(place.y_m), 1)) for place in blindspots.worst]
    return [*worst, *[None] * (MAX_LOCATIONS - len(worst))]


def _number_mark(number: int, at: tuple[float, float] | None) -> str:
    place = f'transform="translate({at[0]} {at[1]})"' if at else 'display="none"'
    return f'<g class="worst" {place}><circle r="8.5"/><text y="4">{number}</text></g>'


def site_view_frame(box: Box, prefix: str = "") -> MapFrame:
    """The frame of the figures that show one site."""
    return MapFrame(box, prefix, width=460.0, tallest=420.0)


def _sensor_mark(plan: MapFrame, site: MapSite) -> str:
    place = f'transform="translate({plan.x(site.x_m):.1f} {plan.y(site.y_m):.1f})"'
    return f'<path class="sensor" {place} d="M0 -9l7.8 13.5h-15.6z"/>'


def _field_image(plan: MapFrame, grid: Grid, values: ColumnValues, peak: float) -> str:
    if not peak > 0:
        return ""
    image, place = colours.field_image(values, peak), plan.region(grid)
    return "".join(
        plan.image(place, image.uri(colours.FIELD_PALETTES[look]), f"field {look}") for look in colours.THEMES
    )


def _road_paths(plan: MapFrame, roads: Roads) -> str:
    """Junctions, and lanes with a fine line between them: each is drawn twice, the second time a little narrower."""
    outlines = "".join(_closed_path(plan, outline) for outline in roads.junctions)
    by_look: dict[tuple[str, float], list[str]] = {}
    for piece in roads.lanes:
        by_look.setdefault((piece.look, piece.width_m), []).append(_open_path(plan, piece.line))
    wide, narrow = [], []
    for (look, width_m), paths in by_look.items():
        width, d = width_m * plan.scale, "".join(paths)
        wide.append(f'<path class="edge" style="stroke-width:{width:.2f}px" d="{d}"/>')
        narrow.append(f'<path class="lane {look}" style="stroke-width:{max(width - 1.0, 0.6 * width):.2f}px" d="{d}"/>')
    junctions = f'<path class="junction" d="{outlines}"/>' if outlines else ""
    return f'<g class="roads">{"".join(wide)}{junctions}{"".join(narrow)}</g>' if wide else ""


def _street_names(plan: MapFrame, names: Sequence[StreetName], sites: Sequence[MapSite]) -> tuple[list[str], list[Box]]:
    """Names along their streets, where they fit into the frame, onto no site and onto no other name; those of the
    longest pieces first. Also the boxes that they take.
    """
    drawn: list[str] = []
    taken = [_square(plan.x(s.x_m), plan.y(s.y_m), 9.0) for s in sites]
    for name in sorted(names, key=lambda name: -name.length_m):
        (x0, y0), (x1, y1) = ((plan.x(x), plan.y(y)) for x, y in (name.start_m, name.end_m))
        angle, half = math.atan2(y1 - y0, x1 - x0), 3.3 * len(name.text) + 4.0
        for along in _STREET_NAME_POSITIONS:
            x, y = x0 + along * (x1 - x0), y0 + along * (y1 - y0)
            boxes = [
                _square(x + at * math.cos(angle), y + at * math.sin(angle), 7.0) for at in np.arange(-half, half, 7)
            ]
            if all(_within(b, plan) and not any(_overlap(b, other) for other in taken) for b in boxes):
                taken += boxes
                place = f"translate({x:.1f} {y:.1f}) rotate({math.degrees(angle):.1f})"
                drawn.append(f'<text class="street" transform="{place}" dy="4">{escape(name.text)}</text>')
                break
    return drawn, taken[len(sites) :]


def _outline_paths(plan: MapFrame, outlines: Sequence[Outlines]) -> str:
    return "".join(
        f'<path class="{group.look}" fill-rule="evenodd" '
        f'd="{"".join(_closed_path(plan, r[:-1]) for r in group.rings)}"/>'
        for group in outlines
    )


def _open_path(plan: MapFrame, line: NDArray[np.float64]) -> str:
    """The path along some points, (n, 2) metres."""
    xs, ys = plan.x(line[:, 0]), plan.y(line[:, 1])
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in zip(xs.tolist(), ys.tolist(), strict=True))


def _closed_path(plan: MapFrame, ring: NDArray[np.float64]) -> str:
    return _open_path(plan, ring) + "z"


def _with_title(shape: str, title: str) -> str:
    return f"<g><title>{escape(title)}</title>{shape}</g>"


def _site_rings(plan: MapFrame, stack: StackedSites, low: float, high: float, radius: float, crowded: bool) -> str:
    """Rings round each other, the best in the middle, with its rank unless places are crowded."""
    x, y = plan.x(stack[0].x_m), plan.y(stack[0].y_m)
    shown = [*stack[:3], stack[-1]] if len(stack) > 4 else stack
    circles = [
        f'<circle class="q{colours.colour_class(s.score, low, high)}" cx="{x:.1f}" cy="{y:.1f}" '
        f'r="{radius + 3.5 * i:.1f}"/>'
        for i, s in reversed(list(enumerate(shown)))
    ]
    tone = "high" if 2 * colours.colour_class(stack[0].score, low, high) > colours.STEPS else "low"
    rank = "" if crowded else f'<text class="rank {tone}" x="{x:.1f}" y="{y + 3.4:.1f}">{stack[0].rank}</text>'
    title = "; ".join(f"{s.site}: rank {s.rank}, {s.by.with_noun(s.score)}, height {s.z_m:g} m" for s in stack)
    first = " first" if stack[0].rank == 1 else ""
    shown_by = f'class="site{first}" data-site="{escape(stack[0].site)}"'
    return f"<g {shown_by}><title>{escape(title)}</title>{''.join(circles)}{rank}</g>"


def _stack_sites(sites: Sequence[MapSite]) -> list[StackedSites]:
    """Sites that share a place, the best first; places by their best."""
    places: dict[tuple[float, float], StackedSites] = {}
    for site in sorted(sites, key=lambda s: s.rank):
        places.setdefault((site.x_m, site.y_m), []).append(site)
    return list(places.values())


def is_crowded(sites: Sequence[MapSite]) -> bool:
    """Whether the sites stand at too many places for numbers and names."""
    return len(_stack_sites(sites)) > _CROWDED


def has_stacked_sites(sites: Sequence[MapSite]) -> bool:
    """Whether some sites share a place."""
    return len(_stack_sites(sites)) < len(sites)


def _labels(
    plan: MapFrame, places: Sequence[StackedSites], named: Sequence[StackedSites], radius: float, others: Sequence[Box]
) -> list[str]:
    """Names of the ``named`` places, so that they hide little, of ``others`` too; ``radius`` is that of a place's
    innermost ring."""
    taken = [_square(plan.x(p[0].x_m), plan.y(p[0].y_m), _stack_radius(p, radius) + 1) for p in places]
    spots = [(plan.x(p[0].x_m), plan.y(p[0].y_m), _stack_name(p), _stack_radius(p, radius) + _LABEL_GAP) for p in named]
    return _label_spots(plan, spots, [*taken, *others])


def labels(plan: MapFrame, spots: Sequence[tuple[float, float, str, float]]) -> list[str]:
    """Texts beside spots (x, y, text, radius; in the figure's units), so that they hide little."""
    taken = [_square(x, y, radius + 1.0) for x, y, _, radius in spots]
    return _label_spots(plan, [(x, y, text, radius + _LABEL_GAP) for x, y, text, radius in spots], taken)


def _label_spots(plan: MapFrame, spots: Sequence[tuple[float, float, str, float]], hidden: Sequence[Box]) -> list[str]:
    """Texts beside spots: x, y, the text, and how far away it may begin; ``hidden`` should not be.

    Steps, for each: try eight sides at four distances; take the first spot that covers nothing, or else the one that
    covers least; draw a line to one that is further out.
    """
    taken, drawn = list(hidden), []
    for x, y, text, near in spots:
        wide = 7.2 * len(text)
        distances = (near, near + 12, near + 26, near + 42)
        options = [(away, _label_box(x, y, away, wide, side)) for away in distances for side in _LABEL_SIDES]
        inside = [o for o in options if _within(o[1], plan)] or options
        away, box = min(inside, key=lambda o: sum(_overlap(o[1], t) for t in taken))
        taken.append(box)
        if away > near:
            end_x, end_y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
            share = (near - _LABEL_GAP) / math.hypot(
                end_x - x, end_y - y
            )  # from the spot's edge: a rank may stand in it
            start_x, start_y = x + share * (end_x - x), y + share * (end_y - y)
            drawn.append(f'<path class="lead" d="M{start_x:.1f} {start_y:.1f}L{end_x:.1f} {end_y:.1f}"/>')
        drawn.append(f'<text class="label" x="{box[0]:.1f}" y="{box[3] - 3:.1f}">{escape(text)}</text>')
    return drawn


def _stack_radius(stack: StackedSites, radius: float) -> float:
    """Radius of a place's outermost ring."""
    return radius + 3.5 * min(3, len(stack) - 1)


def _stack_name(stack: StackedSites) -> str:
    names = [s.site if len(s.site) <= _MAX_LETTERS else s.site[: _MAX_LETTERS - 1] + "…" for s in stack]
    return ", ".join(names) if len(names) <= 2 else f"{names[0]} +{len(names) - 1}"


def _square(x: float, y: float, half: float) -> Box:
    return x - half, y - half, x + half, y + half


def _label_box(x: float, y: float, away: float, wide: float, side: tuple[float, float]) -> Box:
    """A label's box on one side of a place."""
    dx, dy = side
    left = x + away * dx - wide * (0.0 if dx > 0 else 1.0 if dx < 0 else 0.5)
    top = y + away * dy - 15.0 * (0.0 if dy > 0 else 1.0 if dy < 0 else 0.5)
    return left, top, left + wide, top + 15.0


def _within(box: Box, plan: MapFrame) -> bool:
    right, base = plan.left + plan.frame_width, plan.top + plan.frame_height
    return plan.left + 3 <= box[0] and box[2] <= right - 3 and plan.top + 2 <= box[1] and box[3] <= base - 2


def _overlap(a: Box, b: Box) -> float:
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))


@dataclass(frozen=True)
class PlannedPole:
    """A pole of a plan on a map: where, the numbers of its sensors ("1, 3"), and what they are and add, in words."""

    x_m: float
    y_m: float
    numbers: str
    label: str
    title: str


def plan_map(
    grid: Grid,
    values: ColumnValues,
    backdrop: Backdrop,
    candidates: Sequence[MapSite],
    poles: Sequence[PlannedPole],
    alt: str,
) -> str:
    """The poles of a plan, numbered in their order, over all candidates; traffic faint below."""
    plan = MapFrame(extent(grid, candidates), "plan", north=True)
    parts = base_layers(plan, grid, values, backdrop)
    for x_m, y_m in dict.fromkeys((site.x_m, site.y_m) for site in candidates):
        parts.append(f'<circle class="spot" cx="{plan.x(x_m):.1f}" cy="{plan.y(y_m):.1f}" r="3"/>')
    spots = [(plan.x(pole.x_m), plan.y(pole.y_m)) for pole in poles]
    for pole, (x, y) in zip(poles, spots, strict=True):
        wide = _mark_half_width(pole)
        shape = f'<rect x="{x - wide:.1f}" y="{y - 10:.1f}" width="{2 * wide:.1f}" height="20" rx="10"/>'
        number = f'<text x="{x:.1f}" y="{y + 4:.1f}">{escape(pole.numbers)}</text>'
        parts.append(f'<g class="planned"><title>{escape(pole.title)}</title>{shape}{number}</g>')
    parts += labels(
        plan, [(x, y, pole.label, _mark_half_width(pole)) for pole, (x, y) in zip(poles, spots, strict=True)]
    )
    return plan.svg(parts, alt)


def _mark_half_width(pole: PlannedPole) -> float:
    """Of the mark that holds its numbers."""
    return 10.0 + 3.4 * max(0, len(pole.numbers) - 1)
