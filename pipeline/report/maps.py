"""Maps of a run, each an SVG figure seen from above, for the report and for any other page.

- :func:`occupancy`: a field over the region, summed along z, with the static outlines and the sites;
- :func:`site_map`: the sites, coloured by score, numbered by rank;
- :func:`site_view`: what one site sees or misses; such figures share the colour scale
  :func:`pipeline.report.map_frame.shared_scale`.

Names of sites are placed so that they hide little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from pipeline.core.grid import Grid
from pipeline.report import colours, raster
from pipeline.report.map_frame import Box, ColourBar, MapSite, Plan, extent
from pipeline.report.outlines import Outlines
from pipeline.report.raster import ColumnValues

Place = list[MapSite]
"""Sites that stand above one another, the best first."""

_LONGEST = 18
"""Letters of a name; longer ones are cut."""
_CROWDED = 40
"""With more places than this, a map has no room for numbers and names."""
_SIDES = ((1, 0), (0, -1), (0, 1), (-1, 0), (0.71, -0.71), (-0.71, -0.71), (0.71, 0.71), (-0.71, 0.71))
"""East, north, south, west, then the diagonals."""


@dataclass(frozen=True)
class SiteView:
    """A sensor in its place, and what a figure of it shows: the voxels that its beams cross, (nx, ny, nz) bool, and the
    static outlines within a box.
    """

    site: MapSite
    crossed: NDArray[np.bool_]
    outlines: Sequence[Outlines]
    box: Box


def occupancy(
    grid: Grid, values: ColumnValues, label: str, outlines: Sequence[Outlines], sites: Sequence[MapSite], alt: str
) -> str:
    """A field over the region of interest, with the static outlines and the sites."""
    plan = Plan(extent(grid, sites), "tpog", north=True)
    peak = float(values.max(initial=0.0))
    parts = [_field(plan, grid, values, peak), _outline_paths(plan, outlines), plan.roi(grid)]
    for s in sites:
        dot = f'<circle class="spot" cx="{plan.x(s.x_m):.1f}" cy="{plan.y(s.y_m):.1f}" r="4"/>'
        parts.append(_titled(dot, f"{s.site}: rank {s.rank}"))
    return plan.svg(parts, alt, bar=ColourBar(0.0, peak, label))


def site_map(grid: Grid, values: ColumnValues, outlines: Sequence[Outlines], sites: Sequence[MapSite], alt: str) -> str:
    """The sites over the static outlines: colour by score, number by rank, name beside it; occupied roads faint below.

    Of sites that share a place, the best is in the middle of its rings. Where many sites stand, only the first ten and
    the last keep a name; every site tells its own under the pointer.
    """
    plan = Plan(extent(grid, sites), "sites", north=True)
    places = _places(sites)
    crowded, low, high = is_crowded(sites), min(s.egvs for s in sites), max(s.egvs for s in sites)
    radius = 8.5 if not crowded else 6.0 if len(places) <= 120 else 4.0
    parts = [
        f'<g class="faint">{_field(plan, grid, values, float(values.max(initial=0.0)))}</g>',
        f"<g>{_outline_paths(plan, outlines)}</g>",
        plan.roi(grid),
    ]
    parts += [_rings(plan, place, low, high, radius, crowded) for place in reversed(places)]
    named = places if not crowded else [*places[:10], places[-1]]
    parts += _labels(plan, places, named, radius)
    return plan.svg(parts, alt, bar=ColourBar(low, high, "EGVS (bit)", even=True) if high > low else None)


def site_view(grid: Grid, values: ColumnValues, peak: float, view: SiteView, prefix: str, alt: str) -> str:
    """Entropy from above that one site sees, or misses; columns of voxels that no beam crosses at any height are
    shaded.

    Parameters
    ----------
    values
        Entropy summed along z, bits, (nx, ny).
    peak
        The value at the end of the colour scale.
    prefix
        Makes ids unique on a page.
    """
    plan, site = Plan(view.box, prefix, width=460.0, tallest=420.0), view.site
    x, y = plan.x(site.x_m), plan.y(site.y_m)
    parts = [
        plan.image(grid, raster.shade_image(np.logical_not(view.crossed.any(axis=2))), "shadow"),
        _field(plan, grid, values, peak),
        _outline_paths(plan, view.outlines),
        plan.roi(grid),
        _titled(f'<path class="sensor" d="M{x:.1f} {y - 9:.1f}l7.8 13.5h-15.6z"/>', f"{site.site}, the sensor"),
    ]
    return plan.svg(parts, alt)


def _field(plan: Plan, grid: Grid, values: ColumnValues, peak: float) -> str:
    return "".join(plan.image(grid, png, look) for look, png in raster.field_images(values, peak))


def _outline_paths(plan: Plan, outlines: Sequence[Outlines]) -> str:
    def path(ring: NDArray[np.float64]) -> str:
        xs = plan.left + (ring[:-1, 0] - plan.box[0]) * plan.scale
        ys = plan.top + (plan.box[3] - ring[:-1, 1]) * plan.scale
        return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in zip(xs.tolist(), ys.tolist(), strict=True)) + "z"

    return "".join(
        f'<path class="{group.look}" fill-rule="evenodd" d="{"".join(path(ring) for ring in group.rings)}"/>'
        for group in outlines
    )


def _titled(shape: str, title: str) -> str:
    return f"<g><title>{escape(title)}</title>{shape}</g>"


def _rings(plan: Plan, place: Place, low: float, high: float, radius: float, crowded: bool) -> str:
    """Rings round each other, the best in the middle, with its rank unless places are crowded."""
    x, y = plan.x(place[0].x_m), plan.y(place[0].y_m)
    shown = [*place[:3], place[-1]] if len(place) > 4 else place
    circles = [
        f'<circle class="q{colours.step(s.egvs, low, high)}" cx="{x:.1f}" cy="{y:.1f}" r="{radius + 3.5 * i:.1f}"/>'
        for i, s in reversed(list(enumerate(shown)))
    ]
    tone = "high" if 2 * colours.step(place[0].egvs, low, high) > colours.STEPS else "low"
    rank = "" if crowded else f'<text class="rank {tone}" x="{x:.1f}" y="{y + 3.4:.1f}">{place[0].rank}</text>'
    title = "; ".join(f"{s.site}: rank {s.rank}, EGVS {s.egvs:,.0f} bit, height {s.z_m:g} m" for s in place)
    first = " first" if place[0].rank == 1 else ""
    return f'<g class="site{first}"><title>{escape(title)}</title>{"".join(circles)}{rank}</g>'


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


def _labels(plan: Plan, places: Sequence[Place], named: Sequence[Place], radius: float) -> list[str]:
    """Names of the ``named`` places, so that they hide little; ``radius`` is that of a place's innermost ring.

    Steps, for each: try eight sides at four distances; take the first spot that covers nothing, or else the one that
    covers least; draw a line to one that is further out.
    """
    taken = [_square(plan.x(p[0].x_m), plan.y(p[0].y_m), _reach(p, radius) + 1) for p in places]
    drawn = []
    for place in named:
        x, y = plan.x(place[0].x_m), plan.y(place[0].y_m)
        text, near = _name(place), _reach(place, radius) + 4.0
        wide = 7.2 * len(text)
        distances = (near, near + 12, near + 26, near + 42)
        options = [(away, _beside(x, y, away, wide, side)) for away in distances for side in _SIDES]
        inside = [o for o in options if _within(o[1], plan)] or options
        away, box = min(inside, key=lambda o: sum(_overlap(o[1], t) for t in taken))
        taken.append(box)
        if away > near:
            end_x, end_y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
            drawn.append(f'<path class="lead" d="M{x:.1f} {y:.1f}L{end_x:.1f} {end_y:.1f}"/>')
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
