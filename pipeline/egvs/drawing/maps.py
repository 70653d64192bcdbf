"""Maps of a run as SVG figures, seen from above, for the report and for other pages.

- :func:`occupancy`: values over the region, summed along z, with the static outlines and the sites;
- :func:`site_map`: the sites, coloured by score, numbered by rank;
- :func:`site_view`: what one site sees or misses; these share the colour scale
  :func:`egvs.drawing.svg_figures.shared_scale`;
- :func:`scan_view`: where the beams of an empty scan end;
- :func:`missed_view`: the share of vehicles that a site misses in each cell, with the worst locations numbered;
- :func:`classes_view`: values of square metres in classes, such as points on target;
- :func:`zone_map`: zones, coloured by the share of road users that is found there, and numbered;
- :func:`plan_map`: the poles of a plan.

All but the empty scan have roads in the background. Labels are placed so that they hide little.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any, NamedTuple

import numpy as np

from egvs.artefacts.readers import MAX_LOCATIONS, SiteBlindspots
from egvs.core.grid import BoolArray, FloatArray, Grid
from egvs.core.wording import format_percent
from egvs.drawing import colours
from egvs.drawing.basemap import Outlines, Roads, StreetName
from egvs.drawing.colours import ColumnValues, IndexedImage
from egvs.drawing.svg_figures import (
    PAGE_STYLE,
    Box,
    ColourBar,
    ColourClasses,
    FigureStyle,
    MapFrame,
    Rectangle,
    extent,
    text_width,
)
from egvs.results.labels import shorten_name
from egvs.results.ranking import RankedSite

StackedSites = list[RankedSite]
"""Sites at the same x, y, the best first."""

_MAX_HEIGHT = 560.0
_LABEL_GAP = 4.0
"""Gap between a spot and its label, in the figure's units."""
_LABEL_HEIGHT = 15.0
_BOLD = 1.1
"""Labels are bold, which makes them wider."""
_NARROW = 500.0
"""Figures of less than this width have room for the names of poles, but not of candidates."""
_CROWDED = 40
"""A map with more locations than this has no room for numbers and names."""
_STREET_NAME_POSITIONS = (0.5, 0.3, 0.7, 0.15, 0.85)
"""Positions of a street name along its street; the first that is free is used."""
_LABEL_SIDES = ((1, 0), (0, -1), (0, 1), (-1, 0), (0.71, -0.71), (-0.71, -0.71), (0.71, 0.71), (-0.71, 0.71))
"""East, north, south, west, then the diagonals."""


@dataclass(frozen=True)
class Backdrop:
    """What every map shows in the background: static outlines and roads."""

    outlines: Sequence[Outlines]
    roads: Roads


@dataclass(frozen=True)
class SiteViewFigure:
    """A sensor, the voxels that its beams cross (shape (nx, ny, nz)), and the background of the figure."""

    site: RankedSite
    crossed: BoolArray
    backdrop: Backdrop
    box: Box


class MapScale(NamedTuple):
    """The prefix of ids in a map, different for each on a page, and the value at which its colours end."""

    prefix: str
    peak: float


def occupancy(
    grid: Grid,
    values: ColumnValues,
    label: str,
    backdrop: Backdrop,
    sites: Sequence[RankedSite],
    alt: str,
    style: FigureStyle = PAGE_STYLE,
    scale: MapScale | None = None,
) -> str:
    """Return a map of values over the region of interest, with roads, static outlines and sites.

    Parameters
    ----------
    grid, values
        The voxel grid, and a value per column.
    label
        Title of the colour bar.
    backdrop
        Roads and outlines.
    sites
        Shown as circles.
    alt
        Text for people who do not see the figure.
    style
        Width and colours.
    scale
        For one of several maps on a page; by default the colours end at the largest value.
    """
    scale = scale or MapScale("tpog", float(values.max(initial=0.0)))
    plan, peak = _sites_frame(extent(grid, sites), scale.prefix, style), scale.peak
    names, _ = street_names(plan, backdrop.roads.names, [(site.x_m, site.y_m) for site in sites])
    parts = [
        road_paths(plan, backdrop.roads),
        _field_image(plan, grid, values, peak),
        _outline_paths(plan, backdrop.outlines),
        plan.roi(grid),
        *names,
    ]
    for site in sites:
        dot = f'<circle {style.shape("spot")} cx="{plan.x(site.x_m):.1f}" cy="{plan.y(site.y_m):.1f}" r="4"/>'
        parts.append(f"<g><title>{escape(f'{site.site}: rank {site.rank}')}</title>{dot}</g>")
    return plan.svg(parts, alt, bar=ColourBar(0.0, peak, label))


def site_map(
    grid: Grid,
    values: ColumnValues,
    backdrop: Backdrop,
    sites: Sequence[RankedSite],
    alt: str,
    style: FigureStyle = PAGE_STYLE,
) -> str:
    """Return a map of the sites: colour by score, number by rank, a label beside each; traffic faint below.

    Sites at the same location are rings, the best innermost. Where there are many, only the first ten and the last
    have labels; the others show their name under the pointer. See :func:`occupancy` for the parameters.
    """
    plan = _sites_frame(extent(grid, sites), "sites", style)
    stacks = _stack_sites(sites)
    crowded = is_crowded(sites)
    scores = [site.score for site in sites]
    low, high = min(scores), max(scores)
    names, street_boxes = street_names(plan, backdrop.roads.names, [(site.x_m, site.y_m) for site in sites])
    radius = 8.5
    labelled = stacks
    if crowded:
        radius = 6.0 if len(stacks) <= 120 else 4.0
        labelled = [*stacks[:10], stacks[-1]]
    parts = [*base_layers(plan, grid, values, backdrop), *names]
    parts += [_site_rings(plan, stack, low, high, radius, crowded) for stack in reversed(stacks)]
    parts += _stack_labels(plan, stacks, labelled, radius, [*street_boxes, *_outline_boxes(plan.region(grid))])
    bar = None
    if high > low:
        by = sites[0].by
        bar = ColourBar(by.axis_factor * low, by.axis_factor * high, by.axis_title, even=True)
    return plan.svg(parts, alt, bar=bar)


def _sites_frame(box: Box, prefix: str, style: FigureStyle) -> MapFrame:
    """Frame of a map of all sites; at least as high as wide if the area needs it."""
    return MapFrame(box, prefix, width=style.width, tallest=max(_MAX_HEIGHT, style.width), north=True, style=style)


def base_layers(plan: MapFrame, grid: Grid, values: ColumnValues, backdrop: Backdrop) -> list[str]:
    """Return the layers below the sites: roads, faint traffic, static outlines, the region."""
    traffic = _field_image(plan, grid, values, float(values.max(initial=0.0)))
    return [
        road_paths(plan, backdrop.roads),
        f"<g {plan.style.shape('faint')}>{traffic}</g>",
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
    style: FigureStyle | None = None,
    label: str = "",
) -> str:
    """Return the entropy that one site sees or misses, from above; columns that no beam crosses are shaded.

    A page can replace the images, which have the classes ``shade`` and ``field``.

    Parameters
    ----------
    grid, values
        The voxel grid, and the entropy of each column, bits.
    peak
        Value at the end of the colour scale.
    view
        The sensor and the voxels that its beams cross.
    prefix
        Makes ids unique on a page.
    alt
        Text for people who do not see the figure.
    style
        Width and colours; by default those of a panel of the report.
    label
        Title of a colour bar below the map; no bar by default.
    """
    if style is None:
        plan = site_view_frame(view.box, prefix)
    else:
        plan = _sites_frame(view.box, prefix, style)
    shade = colours.shade_image(np.logical_not(view.crossed.any(axis=2)))
    parts = [
        road_paths(plan, view.backdrop.roads),
        *_shade_images(plan, grid, shade),
        _field_image(plan, grid, values, peak),
        _outline_paths(plan, view.backdrop.outlines),
        plan.roi(grid),
        _sensor_mark(plan, view.site.x_m, view.site.y_m),
    ]
    if not label:
        return plan.svg(parts, alt)
    return plan.svg(parts, alt, ColourBar(0.0, peak, label))


def scan_view(grid: Grid, image: IndexedImage, view: SiteViewFigure, prefix: str, alt: str) -> str:
    """Return where the beams of an empty scan end, from above; ``image`` covers the box of the view."""
    plan = site_view_frame(view.box, prefix)
    images = []
    for theme in colours.THEMES:
        images.append(plan.image(plan.full_extent, image.uri(colours.DOT_PALETTES[theme]), f"field {theme}"))
    outlines = _outline_paths(plan, view.backdrop.outlines)
    return plan.svg([outlines, *images, plan.roi(grid), _sensor_mark(plan, view.site.x_m, view.site.y_m)], alt)


def missed_view(
    grid: Grid, blindspots: SiteBlindspots, site: RankedSite, backdrop: Backdrop, box: Box, prefix: str
) -> str:
    """Return the share of vehicles that a site misses in each cell, with the worst locations numbered.

    A page can replace the image, which has the class ``share``; unused numbers are hidden. See :func:`site_view` for
    the parameters.
    """
    plan = site_view_frame(box, prefix)
    parts = [road_paths(plan, backdrop.roads), *_share_images(plan, blindspots)]
    parts += [_outline_paths(plan, backdrop.outlines), plan.roi(grid), _sensor_mark(plan, site.x_m, site.y_m)]
    for number, position in enumerate(label_positions(plan, blindspots), start=1):
        transform = 'display="none"'
        if position:
            transform = f'transform="translate({position[0]} {position[1]})"'
        parts.append(_numbered_mark(transform, number))

    alt = f"From above: no vehicles for {site.site} to see."
    if blindspots.overall:
        missed = 1.0 - blindspots.overall.share
        alt = f"From above: {format_percent(missed)} of the vehicles are not found from {site.site}; share by cell."
    bar = ColourBar(0.0, 100.0, "Share of vehicles not found (%)", even=True)
    return plan.svg(parts, alt, bar)


def classes_view(
    grid: Grid,
    values: ColumnValues,
    classes: ColourClasses,
    sites: Sequence[tuple[float, float]],
    backdrop: Backdrop,
    box: Box,
    prefix: str,
    alt: str,
) -> str:
    """Return classes of square cells, from above, with the sensors.

    Parameters
    ----------
    grid, values
        Grid of the cells, and the number of the class of each, (nx, ny) float64; NaN for a cell without colour.
    classes
        Their names.
    sites
        x, y of the sensors, world frame, metres.
    backdrop, box
        Background and extent of the map.
    prefix
        Makes ids unique on a page.
    alt
        Text for people who do not see the figure.
    """
    plan = site_view_frame(box, prefix)
    image = colours.share_image(values / (len(classes.labels) - 1))
    parts = [road_paths(plan, backdrop.roads)]
    for theme in colours.THEMES:
        parts.append(plan.image(plan.region(grid), image.uri(colours.SHARE_PALETTES[theme]), f"field share {theme}"))
    parts += [_outline_paths(plan, backdrop.outlines), plan.roi(grid)]
    parts += [_sensor_mark(plan, x_m, y_m) for x_m, y_m in sites]
    return plan.svg(parts, alt, classes)


@dataclass(frozen=True)
class MapZone:
    """A zone on a map: its area (shapely, world frame), its number, the share found, and a text for the pointer."""

    area: Any
    number: int
    share: float
    title: str


def _numbered_mark(transform: str, number: int) -> str:
    """Return a number in a circle, which is larger for two digits."""
    classes, radius = ("worst two-digits", 10.5) if number > 9 else ("worst", 8.5)
    return f'<g class="{classes}" {transform}><circle r="{radius}"/><text y="4">{number}</text></g>'


def zone_map(grid: Grid, zones: Sequence[MapZone], site: RankedSite, backdrop: Backdrop, box: Box, alt: str) -> str:
    """Return zones coloured by the share found, and numbered; small zones lie above large ones.

    See :func:`classes_view` for the parameters.
    """
    plan = MapFrame(box, "zones", north=True)
    parts = [road_paths(plan, backdrop.roads), _outline_paths(plan, backdrop.outlines), plan.roi(grid)]
    numbers = []
    for zone in sorted(zones, key=lambda zone: -zone.area.area):
        rings = []
        for polygon in getattr(zone.area, "geoms", [zone.area]):
            rings += [polygon.exterior, *polygon.interiors]
        d = "".join(_closed_path(plan, np.asarray(ring.coords)[:-1, :2]) for ring in rings)
        colour = plan.style.shape(f"q{colours.colour_class(zone.share, 0.0, 1.0)}")
        shape = f'<path {colour} fill-rule="evenodd" stroke="currentColor" stroke-width="1" d="{d}"/>'
        parts.append(f"<g><title>{escape(zone.title)}</title>{shape}</g>")
        middle = zone.area.representative_point()
        at = f'transform="translate({plan.x(middle.x):.1f} {plan.y(middle.y):.1f})"'
        numbers.append(_numbered_mark(at, zone.number))
    parts += [*numbers, _sensor_mark(plan, site.x_m, site.y_m)]
    return plan.svg(parts, alt, ColourBar(0.0, 100.0, "Share of all road users found (%)", even=True))


def label_positions(plan: MapFrame, blindspots: SiteBlindspots) -> list[tuple[float, float] | None]:
    """Return the positions of the numbers of the worst locations on a figure; None for unused numbers."""
    worst = [(round(plan.x(location.x_m), 1), round(plan.y(location.y_m), 1)) for location in blindspots.worst]
    return [*worst, *[None] * (MAX_LOCATIONS - len(worst))]


def site_view_frame(box: Box, prefix: str = "") -> MapFrame:
    """Return the frame of the figures of a single site."""
    return MapFrame(box, prefix, width=460.0, tallest=420.0)


def _sensor_mark(plan: MapFrame, x_m: float, y_m: float) -> str:
    position = f'transform="translate({plan.x(x_m):.1f} {plan.y(y_m):.1f})"'
    return f'<path {plan.style.shape("sensor")} {position} d="M0 -9l7.8 13.5h-15.6z"/>'


def _field_image(plan: MapFrame, grid: Grid, values: ColumnValues, peak: float) -> str:
    if not peak > 0:
        return ""
    image, rectangle = colours.field_image(values, peak), plan.region(grid)
    images = []
    for theme in plan.style.image_themes:
        images.append(plan.image(rectangle, image.uri(colours.FIELD_PALETTES[theme]), f"field {theme}"))
    return "".join(images)


def _shade_images(plan: MapFrame, grid: Grid, shade: IndexedImage) -> Iterator[str]:
    for theme in plan.style.image_themes:
        yield plan.image(plan.region(grid), shade.uri(colours.SHADE_PALETTES[theme]), f"shade {theme}")


def road_paths(plan: MapFrame, roads: Roads) -> str:
    """Junctions, and lanes with a fine line between them: each lane is drawn twice, the second time narrower."""
    paths_of: dict[tuple[str, float], list[str]] = {}
    for piece in roads.lanes:
        paths_of.setdefault((piece.css_class, piece.width_m), []).append(_open_path(plan, piece.line))
    if not paths_of:
        return ""
    edges, lanes = [], []
    for (css_class, width_m), paths in paths_of.items():
        width, d = width_m * plan.scale, "".join(paths)
        narrow = max(width - 1.0, 0.6 * width)
        edges.append(f'<path {plan.style.shape("edge")} style="stroke-width:{width:.2f}px" d="{d}"/>')
        lanes.append(f'<path {plan.style.shape("lane", css_class)} style="stroke-width:{narrow:.2f}px" d="{d}"/>')
    outlines = "".join(_closed_path(plan, outline) for outline in roads.junctions)
    junctions = ""
    if outlines:
        junctions = f'<path {plan.style.shape("junction")} d="{outlines}"/>'
    return f"<g {plan.style.shape('roads')}>{''.join(edges)}{junctions}{''.join(lanes)}</g>"


def street_names(
    plan: MapFrame, names: Sequence[StreetName], points_m: Iterable[tuple[float, float]]
) -> tuple[list[str], list[Box]]:
    """Return street names and the boxes that they cover: within the map, clear of points and of each other.

    Names on the longest streets come first; a name that finds no room is left out.
    """
    drawn: list[str] = []
    covered: list[Box] = []
    point_boxes = [_square(plan.x(x_m), plan.y(y_m), 9.0) for x_m, y_m in dict.fromkeys(points_m)]
    for name in sorted(names, key=lambda name: -name.length_m):
        x0, y0 = plan.x(name.start_m[0]), plan.y(name.start_m[1])
        x1, y1 = plan.x(name.end_m[0]), plan.y(name.end_m[1])
        angle, half = math.atan2(y1 - y0, x1 - x0), 3.3 * len(name.text) + 4.0
        for along in _STREET_NAME_POSITIONS:
            x, y = x0 + along * (x1 - x0), y0 + along * (y1 - y0)
            boxes = []
            for offset in np.arange(-half, half, 7):
                boxes.append(_square(x + offset * math.cos(angle), y + offset * math.sin(angle), 7.0))
            if all(_is_free(box, plan, [*point_boxes, *covered]) for box in boxes):
                covered += boxes
                position = f'transform="translate({x:.1f} {y:.1f}) rotate({math.degrees(angle):.1f})" dy="4"'
                drawn.append(plan.style.text_with_halo("street", position, name.text))
                break
    return drawn, covered


def _is_free(box: Box, plan: MapFrame, covered: Sequence[Box]) -> bool:
    return _within(box, plan) and not any(_overlap(box, other) for other in covered)


def _outline_paths(plan: MapFrame, outlines: Sequence[Outlines]) -> str:
    paths = []
    for group in outlines:
        d = "".join(_closed_path(plan, ring[:-1]) for ring in group.rings)
        paths.append(f'<path {plan.style.shape(group.css_class)} fill-rule="evenodd" d="{d}"/>')
    return "".join(paths)


def _open_path(plan: MapFrame, line: FloatArray) -> str:
    """SVG path along points, shape (n, 2), metres."""
    xs, ys = plan.x(line[:, 0]), plan.y(line[:, 1])
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in zip(xs.tolist(), ys.tolist(), strict=True))


def _closed_path(plan: MapFrame, ring: FloatArray) -> str:
    return _open_path(plan, ring) + "z"


def _site_rings(plan: MapFrame, stack: StackedSites, low: float, high: float, radius: float, crowded: bool) -> str:
    """Concentric rings, the best site innermost, with its rank unless the map is crowded."""
    best = stack[0]
    x, y = plan.x(best.x_m), plan.y(best.y_m)
    displayed = stack
    if len(stack) > 4:
        displayed = [*stack[:3], stack[-1]]
    shapes = []
    for i, site in reversed(list(enumerate(displayed))):
        colour = plan.style.shape(f"q{colours.colour_class(site.score, low, high)}")
        shapes.append(f'<circle {colour} cx="{x:.1f}" cy="{y:.1f}" r="{radius + 3.5 * i:.1f}"/>')
    if not crowded:
        is_dark = 2 * colours.colour_class(best.score, low, high) > colours.STEPS
        tone = "high" if is_dark else "low"
        text_style = plan.style.shape("rank", tone)
        shapes.append(f'<text {text_style} x="{x:.1f}" y="{y + 3.4:.1f}">{best.rank}</text>')

    sites = [f"{site.site}: rank {site.rank}, {site.by.with_noun(site.score)}, height {site.z_m:g} m" for site in stack]
    group = plan.style.shape("site")
    if best.rank == 1:
        group = plan.style.shape("site", "first")
    title = f"<title>{escape('; '.join(sites))}</title>"
    return f'<g {group} data-site="{escape(best.site)}">{title}{"".join(shapes)}</g>'


def _stack_sites(sites: Sequence[RankedSite]) -> list[StackedSites]:
    """Sites by location, the location of the best site first."""
    stacks: dict[tuple[float, float], StackedSites] = {}
    for site in sorted(sites, key=lambda site: site.rank):
        stacks.setdefault((site.x_m, site.y_m), []).append(site)
    return list(stacks.values())


def is_crowded(sites: Sequence[RankedSite]) -> bool:
    """Return whether the sites have too many locations for numbers and names."""
    return len(_stack_sites(sites)) > _CROWDED


def has_stacked_sites(sites: Sequence[RankedSite]) -> bool:
    """Return whether several sites have the same location."""
    return len(_stack_sites(sites)) < len(sites)


def describe_names(sites: Sequence[RankedSite]) -> str:
    """Return rank and name of the best site at each location, for screens where a map has no labels.

    Empty for a crowded map, which has no numbers.
    """
    if is_crowded(sites):
        return ""
    return ", ".join(f"{stack[0].rank}\u00a0{stack[0].site}" for stack in _stack_sites(sites))


class LabelSpot(NamedTuple):
    """A spot that gets a label: its centre and radius in the figure's units."""

    x: float
    y: float
    text: str
    radius: float


def _stack_labels(
    plan: MapFrame,
    stacks: Sequence[StackedSites],
    labelled: Sequence[StackedSites],
    radius: float,
    covered: Sequence[Box],
) -> list[str]:
    """Labels of some stacks; ``radius`` is that of the innermost ring, ``covered`` are boxes to leave free."""
    circles = [_square(spot.x, spot.y, spot.radius + 1) for spot in (_stack_spot(plan, s, radius) for s in stacks)]
    return _label_spots(plan, [_stack_spot(plan, stack, radius) for stack in labelled], [*circles, *covered])


def _outline_boxes(rectangle: Rectangle) -> list[Box]:
    """Narrow boxes along the sides of a rectangle, so that labels are placed beside its outline."""
    x, y, width, height = rectangle
    sides = [(x, y, x + width, y), (x, y + height, x + width, y + height)]
    sides += [(x, y, x, y + height), (x + width, y, x + width, y + height)]
    return [(x0 - 2.0, y0 - 2.0, x1 + 2.0, y1 + 2.0) for x0, y0, x1, y1 in sides]


def _stack_spot(plan: MapFrame, stack: StackedSites, radius: float) -> LabelSpot:
    names = [shorten_name(site.site) for site in stack]
    text = ", ".join(names)
    poles = {site.site.partition("@")[0] for site in stack}
    if len(names) > 1 and plan.width < _NARROW and len(poles) == 1:
        text = shorten_name(poles.pop())
    elif len(names) > 2:
        text = f"{names[0]} +{len(names) - 1}"
    outer_radius = radius + 3.5 * min(3, len(stack) - 1)
    return LabelSpot(plan.x(stack[0].x_m), plan.y(stack[0].y_m), text, outer_radius)


def labels(plan: MapFrame, spots: Sequence[tuple[float, float, str, float]], covered: Sequence[Box] = ()) -> list[str]:
    """Return labels beside spots (x, y, text, radius; in the figure's units), clear of each other and ``covered``."""
    circles = [_square(x, y, radius + 1.0) for x, y, _, radius in spots]
    return _label_spots(plan, [LabelSpot(*spot) for spot in spots], [*circles, *covered])


def _label_spots(plan: MapFrame, spots: Sequence[LabelSpot], circles: Sequence[Box]) -> list[str]:
    """Labels beside spots, at the position among eight sides and four distances that covers least.

    A line leads to a label that is not next to its spot.
    """
    covered, drawn = list(circles), []
    for spot in spots:
        near = spot.radius + _LABEL_GAP
        options = []
        for distance in (near, near + 12, near + 26, near + 42):
            options += [(distance, _label_box(spot, distance, side)) for side in _LABEL_SIDES]
        inside = [option for option in options if _within(option[1], plan)] or options
        distance, box = min(inside, key=lambda option: sum(_overlap(option[1], other) for other in covered))
        covered.append(box)
        if distance > near:
            drawn.append(_label_line(plan, spot, box))
        position = f'x="{box[0]:.1f}" y="{box[3] - 3:.1f}"'
        drawn.append(plan.style.text_with_halo("label", position, spot.text))
    return drawn


def _label_line(plan: MapFrame, spot: LabelSpot, box: Box) -> str:
    """A line from the edge of a spot, which may have a number in it, to the middle of its label."""
    end_x, end_y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    share = spot.radius / math.hypot(end_x - spot.x, end_y - spot.y)
    start_x, start_y = spot.x + share * (end_x - spot.x), spot.y + share * (end_y - spot.y)
    return f'<path {plan.style.shape("lead")} d="M{start_x:.1f} {start_y:.1f}L{end_x:.1f} {end_y:.1f}"/>'


def _square(x: float, y: float, half: float) -> Box:
    return x - half, y - half, x + half, y + half


def _label_box(spot: LabelSpot, distance: float, side: tuple[float, float]) -> Box:
    """Box of a label on one side of a spot."""
    dx, dy = side
    width = _BOLD * text_width(spot.text)
    left = spot.x + distance * dx - width * _share_before(dx)
    top = spot.y + distance * dy - _LABEL_HEIGHT * _share_before(dy)
    return left, top, left + width, top + _LABEL_HEIGHT


def _share_before(direction: float) -> float:
    """Share of a label that lies left of, or above, its anchor."""
    if direction > 0:
        return 0.0
    if direction < 0:
        return 1.0
    return 0.5


def _within(box: Box, plan: MapFrame) -> bool:
    edge, base = plan.left + plan.frame_width, plan.top + plan.frame_height
    return plan.left + 3 <= box[0] and box[2] <= edge - 3 and plan.top + 2 <= box[1] and box[3] <= base - 2


def _overlap(a: Box, b: Box) -> float:
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))


@dataclass(frozen=True)
class PlannedPole:
    """A pole of a plan on a map: the numbers of its sensors ("1, 3"), a label, and a text under the pointer."""

    x_m: float
    y_m: float
    numbers: str
    label: str
    title: str

    @property
    def half_width(self) -> float:
        """Half the width of the mark with the numbers, in the figure's units."""
        return 10.0 + 3.4 * max(0, len(self.numbers) - 1)


def answer_map(
    grid: Grid,
    backdrop: Backdrop,
    candidates: Sequence[RankedSite],
    poles: Sequence[PlannedPole],
    views_m: Sequence[FloatArray],
    missed: SiteBlindspots | None,
    alt: str,
) -> str:
    """Return the junction from above with the chosen poles, their fields of view, and where vehicles are not found.

    Parameters
    ----------
    grid
        The voxel grid of the region.
    backdrop
        Roads and outlines.
    candidates
        All sites, small circles.
    poles
        The chosen poles, numbered in their order.
    views_m
        Outlines of fields of view in the world frame, (n, 2) each.
    missed
        The share of the vehicles over each cell that the chosen sensors miss; None if it is unknown.
    alt
        Text for people who do not see the figure.
    """
    box = extent(grid, [])
    plan = MapFrame(box, "answer", width=640.0, tallest=560.0, north=True)
    parts = [road_paths(plan, backdrop.roads)]
    bar = None
    if missed is not None:
        parts += _share_images(plan, missed)
        bar = ColourBar(0.0, 100.0, "Share of vehicles not found (%)", even=True)
    parts += [_outline_paths(plan, backdrop.outlines), plan.roi(grid)]
    parts += [f'<path class="view" d="{_closed_path(plan, view_m)}"/>' for view_m in views_m if len(view_m) > 2]
    points_m = dict.fromkeys((site.x_m, site.y_m) for site in candidates)
    names, street_boxes = street_names(
        plan, backdrop.roads.names, [*points_m, *((pole.x_m, pole.y_m) for pole in poles)]
    )
    parts += names
    for x_m, y_m in points_m:
        parts.append(f'<circle class="spot" cx="{plan.x(x_m):.1f}" cy="{plan.y(y_m):.1f}" r="3"/>')
    spots = []
    for pole in poles:
        x, y, half = plan.x(pole.x_m), plan.y(pole.y_m), pole.half_width
        shape = f'<rect x="{x - half:.1f}" y="{y - 10:.1f}" width="{2 * half:.1f}" height="20" rx="10"/>'
        number = f'<text x="{x:.1f}" y="{y + 4:.1f}">{escape(pole.numbers)}</text>'
        parts.append(f'<g class="planned"><title>{escape(pole.title)}</title>{shape}{number}</g>')
        spots.append(LabelSpot(x, y, pole.label, half))
    return plan.svg([*parts, *labels(plan, spots, [*street_boxes, *_outline_boxes(plan.region(grid))])], alt, bar)


def _share_images(plan: MapFrame, blindspots: SiteBlindspots) -> Iterator[str]:
    """Yield the share of vehicles that are missed in each cell, as an image for each theme."""
    image = colours.share_image(blindspots.share_missed)
    (x, y), (nx, ny), cell_m = blindspots.origin_m, blindspots.share_missed.shape, blindspots.cell_m
    rectangle = (plan.x(x), plan.y(y + ny * cell_m), nx * cell_m * plan.scale, ny * cell_m * plan.scale)
    for theme in colours.THEMES:
        yield plan.image(rectangle, image.uri(colours.SHARE_PALETTES[theme]), f"field share {theme}")
