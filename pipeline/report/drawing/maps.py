"""Maps of a run, each an SVG figure seen from above, for the report and for any other page.

- :func:`occupancy`: a field over the region, summed along z, with the static outlines and the sites;
- :func:`site_map`: the sites, coloured by score, numbered by rank;
- :func:`site_view`: what one site sees or misses; such figures share the colour scale
  :func:`pipeline.report.drawing.map_frame.shared_scale`;
- :func:`scan_view`: where the beams of its empty scan end;
- :func:`missed_view`: the share of the vehicles that it misses, square by square, with the worst places numbered.

Roads lie under all of them but the empty scan.

Names of sites are placed so that they hide little.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.blindspots import MOST_PLACES, SiteBlindspots
from pipeline.core.grid import Grid
from pipeline.report.drawing import colours, raster
from pipeline.report.drawing.map_frame import Box, ColourBar, MapSite, Plan, extent
from pipeline.report.drawing.outlines import Outlines
from pipeline.report.drawing.raster import ColumnValues, IndexedImage
from pipeline.report.drawing.roads import Roads, StreetName

Place = list[MapSite]
"""Sites that stand above one another, the best first."""

WIDTH, _TALLEST = 760.0, 560.0
"""Of the maps of a page, in their own units."""
_LONGEST = 18
"""Letters of a name; longer ones are cut."""
_GAP = 4.0
"""Between a spot and its name."""
_CROWDED = 40
"""With more places than this, a map has no room for numbers and names."""
_ALONG = (0.5, 0.3, 0.7, 0.15, 0.85)
"""Where along its piece of street a name may stand; the first that is free."""
_SIDES = ((1, 0), (0, -1), (0, 1), (-1, 0), (0.71, -0.71), (-0.71, -0.71), (0.71, 0.71), (-0.71, 0.71))
"""East, north, south, west, then the diagonals."""


@dataclass(frozen=True)
class Backdrop:
    """What lies under every map: the static outlines, and the roads."""

    outlines: Sequence[Outlines]
    roads: Roads


@dataclass(frozen=True)
class SiteView:
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
    plan = _plan_of(extent(grid, sites), "tpog", width)
    peak = float(values.max(initial=0.0))
    parts = [
        _road_paths(plan, backdrop.roads),
        _field(plan, grid, values, peak),
        _outline_paths(plan, backdrop.outlines),
        plan.roi(grid),
        *_street_names(plan, backdrop.roads.names, sites)[0],
    ]
    for s in sites:
        dot = f'<circle class="spot" cx="{plan.x(s.x_m):.1f}" cy="{plan.y(s.y_m):.1f}" r="4"/>'
        parts.append(_titled(dot, f"{s.site}: rank {s.rank}"))
    return plan.svg(parts, alt, bar=ColourBar(0.0, peak, label))


def site_map(
    grid: Grid, values: ColumnValues, backdrop: Backdrop, sites: Sequence[MapSite], alt: str, width: float = WIDTH
) -> str:
    """The sites over roads and static outlines: colour by score, number by rank, name beside it; traffic faint below.

    Of sites that share a place, the best is in the middle of its rings. Where many sites stand, only the first ten and
    the last keep a name; every site tells its own under the pointer.
    """
    plan = _plan_of(extent(grid, sites), "sites", width)
    places = _places(sites)
    crowded, low, high = is_crowded(sites), min(s.score for s in sites), max(s.score for s in sites)
    streets, street_boxes = _street_names(plan, backdrop.roads.names, sites)
    radius = 8.5 if not crowded else 6.0 if len(places) <= 120 else 4.0
    parts = [*ground(plan, grid, values, backdrop), *streets]
    parts += [_rings(plan, place, low, high, radius, crowded) for place in reversed(places)]
    named = places if not crowded else [*places[:10], places[-1]]
    parts += _labels(plan, places, named, radius, street_boxes)
    bar = ColourBar(low, high, sites[0].by.label, even=True) if high > low else None
    return plan.svg(parts, alt, bar=bar)


def _plan_of(box: Box, prefix: str, width: float) -> Plan:
    """The frame of a map of all sites; as tall as it needs to be where it is narrow."""
    return Plan(box, prefix, width=width, tallest=max(_TALLEST, width), north=True)


def ground(plan: Plan, grid: Grid, values: ColumnValues, backdrop: Backdrop) -> list[str]:
    """What lies under sites: roads, faint traffic, static outlines, the region."""
    return [
        _road_paths(plan, backdrop.roads),
        f'<g class="faint">{_field(plan, grid, values, float(values.max(initial=0.0)))}</g>',
        f"<g>{_outline_paths(plan, backdrop.outlines)}</g>",
        plan.roi(grid),
    ]


def site_view(
    grid: Grid,
    values: ColumnValues,
    peak: float,
    view: SiteView,
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
    plan = view_plan(view.box, prefix) if width is None else _plan_of(view.box, prefix, width)
    shade = raster.shade_image(np.logical_not(view.crossed.any(axis=2)))
    parts = [
        _road_paths(plan, view.backdrop.roads),
        plan.image(plan.region(grid), shade.uri(raster.SHADE_PALETTE), "shade"),
        _field(plan, grid, values, peak),
        _outline_paths(plan, view.backdrop.outlines),
        plan.roi(grid),
        _sensor(plan, view.site),
    ]
    return plan.svg(parts, alt, ColourBar(0.0, peak, label) if label else None)


def scan_view(grid: Grid, image: IndexedImage, view: SiteView, prefix: str, alt: str) -> str:
    """Where the beams of one site's empty scan end, from above; ``image`` covers the view's box."""
    plan = view_plan(view.box, prefix)
    images = (plan.image(plan.whole, image.uri(raster.DOTS[look]), f"field {look}") for look in raster.LOOKS)
    parts = [_outline_paths(plan, view.backdrop.outlines), *images, plan.roi(grid), _sensor(plan, view.site)]
    return plan.svg(parts, alt)


def missed_view(grid: Grid, seen: SiteBlindspots, site: MapSite, backdrop: Backdrop, box: Box, prefix: str) -> str:
    """Which share of the vehicles over each square one site misses, with its worst places numbered. Its
    image carries a class by which a page may exchange it; numbers beyond those of the worst places are hidden."""
    plan, image = view_plan(box, prefix), raster.share_image(seen.share_missed)
    (x, y), (nx, ny) = seen.origin_m, seen.share_missed.shape
    place = plan.x(x), plan.y(y + ny * seen.cell_m), nx * seen.cell_m * plan.scale, ny * seen.cell_m * plan.scale
    parts = [
        _road_paths(plan, backdrop.roads),
        *(plan.image(place, image.uri(raster.SHARES[look]), f"field share {look}") for look in raster.LOOKS),
        _outline_paths(plan, backdrop.outlines),
        plan.roi(grid),
        _sensor(plan, site),
        *(_numbered(number, at) for number, at in enumerate(numbers_at(plan, seen), 1)),
    ]
    missed = f"{1.0 - seen.whole.share:.1%} of the vehicles" if seen.whole else "vehicles, of which there are none"
    bar = ColourBar(0.0, 100.0, "Share of the vehicles that is missed (%)", even=True)
    return plan.svg(parts, f"From above: where {site.site} misses {missed}, square by square.", bar)


def numbers_at(plan: Plan, seen: SiteBlindspots) -> list[tuple[float, float] | None]:
    """Where the numbers of a site's worst places stand on a figure; None for those that it has not."""
    worst = [(round(plan.x(place.x_m), 1), round(plan.y(place.y_m), 1)) for place in seen.worst]
    return [*worst, *[None] * (MOST_PLACES - len(worst))]


def _numbered(number: int, at: tuple[float, float] | None) -> str:
    place = f'transform="translate({at[0]} {at[1]})"' if at else 'display="none"'
    return f'<g class="worst" {place}><circle r="8.5"/><text y="4">{number}</text></g>'


def view_plan(box: Box, prefix: str = "") -> Plan:
    """The frame of the figures that show one site."""
    return Plan(box, prefix, width=460.0, tallest=420.0)


def _sensor(plan: Plan, site: MapSite) -> str:
    place = f'transform="translate({plan.x(site.x_m):.1f} {plan.y(site.y_m):.1f})"'
    return f'<path class="sensor" {place} d="M0 -9l7.8 13.5h-15.6z"/>'


def _field(plan: Plan, grid: Grid, values: ColumnValues, peak: float) -> str:
    if not peak > 0:
        return ""
    image, place = raster.field_image(values, peak), plan.region(grid)
    return "".join(plan.image(place, image.uri(raster.FIELD[look]), f"field {look}") for look in raster.LOOKS)


def _road_paths(plan: Plan, roads: Roads) -> str:
    """Junctions, and lanes with a fine line between them: each is drawn twice, the second time a little narrower."""
    outlines = "".join(_closed(plan, outline) for outline in roads.junctions)
    by_look: dict[tuple[str, float], list[str]] = {}
    for piece in roads.lanes:
        by_look.setdefault((piece.look, piece.width_m), []).append(_open(plan, piece.line))
    wide, narrow = [], []
    for (look, width_m), paths in by_look.items():
        width, d = width_m * plan.scale, "".join(paths)
        wide.append(f'<path class="edge" style="stroke-width:{width:.2f}px" d="{d}"/>')
        narrow.append(f'<path class="lane {look}" style="stroke-width:{max(width - 1.0, 0.6 * width):.2f}px" d="{d}"/>')
    junctions = f'<path class="junction" d="{outlines}"/>' if outlines else ""
    return f'<g class="roads">{"".join(wide)}{junctions}{"".join(narrow)}</g>' if wide else ""


def _street_names(plan: Plan, names: Sequence[StreetName], sites: Sequence[MapSite]) -> tuple[list[str], list[Box]]:
    """Names along their streets, where they fit into the frame, onto no site and onto no other name; those of the
    longest pieces first. Also the boxes that they take.
    """
    drawn: list[str] = []
    taken = [_square(plan.x(s.x_m), plan.y(s.y_m), 9.0) for s in sites]
    for name in sorted(names, key=lambda name: -name.length_m):
        (x0, y0), (x1, y1) = ((plan.x(x), plan.y(y)) for x, y in (name.start_m, name.end_m))
        angle, half = math.atan2(y1 - y0, x1 - x0), 3.3 * len(name.text) + 4.0
        for along in _ALONG:
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


def _outline_paths(plan: Plan, outlines: Sequence[Outlines]) -> str:
    return "".join(
        f'<path class="{group.look}" fill-rule="evenodd" d="{"".join(_closed(plan, r[:-1]) for r in group.rings)}"/>'
        for group in outlines
    )


def _open(plan: Plan, line: NDArray[np.float64]) -> str:
    """The path along some points, (n, 2) metres."""
    xs, ys = plan.x(line[:, 0]), plan.y(line[:, 1])
    return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in zip(xs.tolist(), ys.tolist(), strict=True))


def _closed(plan: Plan, ring: NDArray[np.float64]) -> str:
    return _open(plan, ring) + "z"


def _titled(shape: str, title: str) -> str:
    return f"<g><title>{escape(title)}</title>{shape}</g>"


def _rings(plan: Plan, place: Place, low: float, high: float, radius: float, crowded: bool) -> str:
    """Rings round each other, the best in the middle, with its rank unless places are crowded."""
    x, y = plan.x(place[0].x_m), plan.y(place[0].y_m)
    shown = [*place[:3], place[-1]] if len(place) > 4 else place
    circles = [
        f'<circle class="q{colours.step(s.score, low, high)}" cx="{x:.1f}" cy="{y:.1f}" r="{radius + 3.5 * i:.1f}"/>'
        for i, s in reversed(list(enumerate(shown)))
    ]
    tone = "high" if 2 * colours.step(place[0].score, low, high) > colours.STEPS else "low"
    rank = "" if crowded else f'<text class="rank {tone}" x="{x:.1f}" y="{y + 3.4:.1f}">{place[0].rank}</text>'
    title = "; ".join(f"{s.site}: rank {s.rank}, {s.by.told(s.score)}, height {s.z_m:g} m" for s in place)
    first = " first" if place[0].rank == 1 else ""
    shown_by = f'class="site{first}" data-site="{escape(place[0].site)}"'
    return f"<g {shown_by}><title>{escape(title)}</title>{''.join(circles)}{rank}</g>"


def _places(sites: Sequence[MapSite]) -> list[Place]:
    """Sites that share a place, the best first; places by their best."""
    places: dict[tuple[float, float], Place] = {}
    for site in sorted(sites, key=lambda s: s.rank):
        places.setdefault((site.x_m, site.y_m), []).append(site)
    return list(places.values())


def is_crowded(sites: Sequence[MapSite]) -> bool:
    """Whether the sites stand at too many places for numbers and names."""
    return len(_places(sites)) > _CROWDED


def has_shared_places(sites: Sequence[MapSite]) -> bool:
    """Whether some sites share a place."""
    return len(_places(sites)) < len(sites)


def _labels(
    plan: Plan, places: Sequence[Place], named: Sequence[Place], radius: float, others: Sequence[Box]
) -> list[str]:
    """Names of the ``named`` places, so that they hide little, of ``others`` too; ``radius`` is that of a place's
    innermost ring."""
    taken = [_square(plan.x(p[0].x_m), plan.y(p[0].y_m), _reach(p, radius) + 1) for p in places]
    spots = [(plan.x(p[0].x_m), plan.y(p[0].y_m), _name(p), _reach(p, radius) + _GAP) for p in named]
    return _beside_spots(plan, spots, [*taken, *others])


def labels(plan: Plan, spots: Sequence[tuple[float, float, str, float]]) -> list[str]:
    """Texts beside spots (x, y, text, radius; in the figure's units), so that they hide little."""
    taken = [_square(x, y, radius + 1.0) for x, y, _, radius in spots]
    return _beside_spots(plan, [(x, y, text, radius + _GAP) for x, y, text, radius in spots], taken)


def _beside_spots(plan: Plan, spots: Sequence[tuple[float, float, str, float]], hidden: Sequence[Box]) -> list[str]:
    """Texts beside spots: x, y, the text, and how far away it may begin; ``hidden`` should not be.

    Steps, for each: try eight sides at four distances; take the first spot that covers nothing, or else the one that
    covers least; draw a line to one that is further out.
    """
    taken, drawn = list(hidden), []
    for x, y, text, near in spots:
        wide = 7.2 * len(text)
        distances = (near, near + 12, near + 26, near + 42)
        options = [(away, _beside(x, y, away, wide, side)) for away in distances for side in _SIDES]
        inside = [o for o in options if _within(o[1], plan)] or options
        away, box = min(inside, key=lambda o: sum(_overlap(o[1], t) for t in taken))
        taken.append(box)
        if away > near:
            end_x, end_y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
            share = (near - _GAP) / math.hypot(end_x - x, end_y - y)  # from the spot's edge: a rank may stand in it
            start_x, start_y = x + share * (end_x - x), y + share * (end_y - y)
            drawn.append(f'<path class="lead" d="M{start_x:.1f} {start_y:.1f}L{end_x:.1f} {end_y:.1f}"/>')
        drawn.append(f'<text class="label" x="{box[0]:.1f}" y="{box[3] - 3:.1f}">{escape(text)}</text>')
    return drawn


def _reach(place: Place, radius: float) -> float:
    """Radius of a place's outermost ring."""
    return radius + 3.5 * min(3, len(place) - 1)


def _name(place: Place) -> str:
    names = [s.site if len(s.site) <= _LONGEST else s.site[: _LONGEST - 1] + "…" for s in place]
    return ", ".join(names) if len(names) <= 2 else f"{names[0]} +{len(names) - 1}"


def _square(x: float, y: float, half: float) -> Box:
    return x - half, y - half, x + half, y + half


def _beside(x: float, y: float, away: float, wide: float, side: tuple[float, float]) -> Box:
    """A label's box on one side of a place."""
    dx, dy = side
    left = x + away * dx - wide * (0.0 if dx > 0 else 1.0 if dx < 0 else 0.5)
    top = y + away * dy - 15.0 * (0.0 if dy > 0 else 1.0 if dy < 0 else 0.5)
    return left, top, left + wide, top + 15.0


def _within(box: Box, plan: Plan) -> bool:
    right, base = plan.left + plan.frame_width, plan.top + plan.frame_height
    return plan.left + 3 <= box[0] and box[2] <= right - 3 and plan.top + 2 <= box[1] and box[3] <= base - 2


def _overlap(a: Box, b: Box) -> float:
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
