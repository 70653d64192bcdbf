"""Maps of a run, each an SVG figure seen from above, for the report and for any other page.

- :func:`occupancy`: a field over the region, summed along z, with the static outlines and the sites;
- :func:`site_map`: the sites, coloured by score, numbered by rank;
- :func:`site_view`: what one site sees or misses; :func:`pipeline.report.plan.shared_scale` is the colour scale that
  such figures share.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from pipeline.core.grid import Grid
from pipeline.report import colours, raster
from pipeline.report.labels import Place, is_crowded, name_labels, places_of
from pipeline.report.outlines import Outlines
from pipeline.report.plan import Box, ColourBar, MapSite, Plan, extent
from pipeline.report.raster import ColumnValues


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
    parts += [_titled(_dot(plan, s), f"{s.site}: rank {s.rank}") for s in sites]
    return plan.svg(parts, alt, bar=ColourBar(0.0, peak, label))


def site_map(grid: Grid, values: ColumnValues, outlines: Sequence[Outlines], sites: Sequence[MapSite], alt: str) -> str:
    """The sites over the static outlines: colour by score, number by rank, name beside it; occupied roads faint below.

    Of sites that share a place, the best is in the middle of its rings. Where many sites stand, only the first ten and
    the last keep a name; every site tells its own under the pointer.
    """
    plan = Plan(extent(grid, sites), "sites", north=True)
    places = places_of(sites)
    crowded, low, high = is_crowded(sites), min(s.egvs for s in sites), max(s.egvs for s in sites)
    radius = 8.5 if not crowded else 6.0 if len(places) <= 120 else 4.0
    parts = [
        f'<g class="faint">{_field(plan, grid, values, float(values.max(initial=0.0)))}</g>',
        f"<g>{_outline_paths(plan, outlines)}</g>",
        plan.roi(grid),
    ]
    parts += [_rings(plan, place, low, high, radius, crowded) for place in reversed(places)]
    named = places if not crowded else [*places[:10], places[-1]]
    parts += name_labels(plan, places, named, radius)
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


def _dot(plan: Plan, site: MapSite) -> str:
    return f'<circle class="spot" cx="{plan.x(site.x_m):.1f}" cy="{plan.y(site.y_m):.1f}" r="4"/>'


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
