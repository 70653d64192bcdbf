"""Figures of the page: traffic, sites, what each site sees and misses.

Where each site misses vehicles: a map by square metre, and its worst lanes in words.

Steps: read the sites' rows of ``blindspots.parquet``; of each keep the image's data and the sentences, from which the
page draws any site; those of the panels are drawn here.

What each site sees and misses, and its empty scan: the figures of two sites, and the data of all that may be chosen.

Steps, for each site that a reader may choose: march its beams once more; split the entropy, summed along z, into what
the beams cross and what they don't; note where beams end. The best and the last site are drawn. Of every site the
images' data is kept without palettes: the page joins both when a reader chooses another site, in its light or dark
colours. Where these are many, the images have fewer and larger pixels, so that the page stays small.

The figures of a run's report: the traffic, the sites, and what each site sees and misses.

Steps: take outlines from the static world, and roads from the network that SUMO drove on; draw the map of the sites and
that of the occupancy; draw the views of single sites (:mod:`egvs.report.figures`).
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts import readers
from egvs.artefacts.readers import MIN_VEHICLES, LocationVisibility, SiteBlindspots
from egvs.artefacts.tpog import Tpog
from egvs.core.grid import Grid
from egvs.report import colours, formatting, maps, ranking
from egvs.report.basemap import network_file, outlines_of, roads_within
from egvs.report.colours import ColumnValues, IndexedImage
from egvs.report.maps import Backdrop, SiteViewFigure
from egvs.report.ranking import RankedSite, Ranking
from egvs.report.svg_figures import Box, MapSite, extent, shared_scale
from egvs.scoring.egvs import EntropyField
from egvs.scoring.scorer import Scorer
from egvs.scoring.visibility import Beams
from egvs.stages.base import StageContext
from egvs.stages.site_scans import empty_scans


@dataclass(frozen=True)
class BlindspotView:
    """What a panel shows of one site: the figure, SVG text; the share of all vehicles that it misses; its worst places,
    each in words and how many vehicles that rests on; and a sentence on what is not in the list."""

    figure: str
    missed: str
    worst: tuple[tuple[str, str], ...]
    note: str


@dataclass(frozen=True)
class Blindspots:
    """Of all sites that may be chosen; a vehicle with so many ``points`` is seen."""

    sites: dict[str, SiteBlindspots]
    points: float

    def view(self, site: MapSite, grid: Grid, backdrop: Backdrop, box: Box, prefix: str) -> BlindspotView:
        """The figure and the words of one site."""
        its = self.sites[site.site]
        figure = maps.missed_view(grid, its, site, backdrop, box, prefix)
        return BlindspotView(figure, format_missed_share(its), describe_worst_locations(its), blindspot_note(its))

    def choice(self, site: str, box: Box) -> dict[str, Any]:
        """What the page needs to draw one site itself, but for the image."""
        its = self.sites[site]
        numbers = maps.label_positions(maps.site_view_frame(box), its)
        return {
            "numbers": numbers,
            "missed": format_missed_share(its),
            "worst": describe_worst_locations(its),
            "note": blindspot_note(its),
        }

    def image(self, site: str) -> colours.IndexedImage:
        """Of the share that is missed over each square."""
        return colours.share_image(self.sites[site].share_missed)


def read_blindspots(work: StageContext, choosable: Sequence[MapSite]) -> Blindspots | None:
    """Of the ``choosable`` sites; None where the scenario does not ask for it."""
    if not work.scenario.score.blindspots:
        return None
    found = {
        its.site: its for its in readers.read_blindspots(work.folder.blindspots, {site.site for site in choosable})
    }
    return Blindspots(found, next((its.points for its in found.values()), 0.0))


def format_missed_share(site_blindspots: SiteBlindspots) -> str:
    """The share of all vehicles that a site misses."""
    return formatting.format_percent(1.0 - site_blindspots.overall.share) if site_blindspots.overall else "–"


def describe_worst_locations(site_blindspots: SiteBlindspots) -> tuple[tuple[str, str], ...]:
    """The worst places, each in words and what that rests on."""
    return tuple(
        (f"{place.words}: {_missed_percent(place)} seen", _describe_sample(place)) for place in site_blindspots.worst
    )


def blindspot_note(site_blindspots: SiteBlindspots) -> str:
    """What the list does not say: how whole approaches are seen, how many vehicles are on no lane."""
    if site_blindspots.overall is None:
        return "No vehicle in the region."
    if len(site_blindspots.locations) == 1:
        return "Without one network of roads for all the traffic there are no lanes to name: the map alone tells."
    found = []
    if not site_blindspots.worst:
        found.append(f"No lane, turn or crossing with {MIN_VEHICLES} vehicles or more is seen worse than the rest.")
    if approaches := site_blindspots.of_kind("approach"):
        listed = "; ".join(f"{place.words}: {_missed_percent(place)}" for place in approaches)
        found.append(f"Whole approaches, seen: {listed}.")
    if site_blindspots.off_lanes:
        were = "was" if site_blindspots.off_lanes == 1 else "were"
        found.append(
            f"Of {site_blindspots.overall.vehicle_frames:,} vehicles looked at, {site_blindspots.off_lanes:,} "
            f"{were} on no lane."
        )
    return " ".join(found)


def _missed_percent(location: LocationVisibility) -> str:
    return f"{100.0 * location.share:.0f} %"


def _describe_sample(location: LocationVisibility) -> str:
    return (
        f"± {100.0 * location.se:.0f} %, from {location.vehicles:,} vehicles looked at "
        f"{location.vehicle_frames:,} times"
    )


_IMAGE_CELLS = 300
"""Cells of an empty scan's image from west to east."""

MAX_FULL_IMAGES = 40
"""Sites whose images are kept in full; of more, only those of the best and of the last."""

_PALETTES = {"field": colours.FIELD_PALETTES, "scan": colours.DOT_PALETTES, "vehicles": colours.SHARE_PALETTES}
"""Of the images of a site, by the view that they belong to; those of no other view are of the field."""

_COARSE_CELLS, _COARSE_PIXELS = 150, 30_000
"""The same for many sites, and the pixels of a field's image."""


@dataclass(frozen=True)
class SitePanel:
    """The three figures of one site, SVG text, and what stands above and below them."""

    scored: RankedSite
    visible: str
    missed: str
    scan: str
    caption: str
    vehicles: BlindspotView | None


@dataclass(frozen=True)
class SiteViews:
    """The panels of the best and of the last site, their colour scale, and ``data``: JSON from which the page draws
    those of any other; ``is_coarse`` where it draws them with larger pixels; a vehicle with so many ``points`` is seen,
    0 where that is not shown.
    """

    panels: tuple[SitePanel, ...]
    scale: str
    points: float
    data: str
    is_coarse: bool


@dataclass(frozen=True)
class _SiteCoverage:
    """What one site's beams cross, and where they end."""

    scored: RankedSite
    crossed: NDArray[np.bool_]
    visible_bit: ColumnValues
    missed_bit: ColumnValues
    caption: str
    ends_m: NDArray[np.float64]


def site_views(
    work: StageContext, ranking: Ranking, choosable: Sequence[RankedSite], scorer: Scorer, backdrop: Backdrop
) -> SiteViews:
    """Figures and data of the ``choosable`` sites; those of the best and of the last site are drawn."""
    grid, box, is_coarse = scorer.field.grid, extent(scorer.field.grid, choosable), len(choosable) > MAX_FULL_IMAGES
    peak = float(column_entropy(scorer.field, np.ones(len(scorer.field.cells), dtype=np.bool_)).max())
    missed, panels = read_blindspots(work, choosable), dict[str, SitePanel]()
    choices: dict[str, dict[str, Any]] = {}
    for seen in _site_coverages(work, choosable, scorer):
        images = _site_images(seen, peak, box, in_full=not is_coarse or seen.scored in ranking.extremes)
        choices[seen.scored.site] = _panel_data(seen, images, missed, box)
        if seen.scored in ranking.extremes:
            number = ranking.extremes.index(seen.scored)
            panels[seen.scored.site] = _draw_panel(
                seen, grid, peak, images["scan"], missed, backdrop, box, f"view-{number}"
            )
    drawn = tuple(panels[site.site] for site in ranking.extremes)
    data = {
        "sites": {site.site: choices[site.site] for site in choosable},
        "palettes": {
            look: {name: _to_base64(palette[look]) for name, palette in _PALETTES.items()} for look in colours.THEMES
        }
        | {"shade": _to_base64(colours.SHADE_PALETTE)},
        "end": _to_base64(colours.PNG_END),
    }
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")  # no name may end the script
    return SiteViews(
        drawn, shared_scale(peak, "Entropy in the column (bit)"), missed.points if missed else 0.0, text, is_coarse
    )


def _site_images(coverage: _SiteCoverage, peak: float, box: Box, *, in_full: bool) -> dict[str, IndexedImage]:
    pixels, cells = (colours.MAX_PIXELS, _IMAGE_CELLS) if in_full else (_COARSE_PIXELS, _COARSE_CELLS)
    return {
        "seen": colours.field_image(coverage.visible_bit, peak, pixels),
        "missed": colours.field_image(coverage.missed_bit, peak, pixels),
        "scan": colours.dots_image(coverage.ends_m, box, cells),
        "shade": colours.shade_image(np.logical_not(coverage.crossed.any(axis=2)), pixels),
    }


def _site_coverages(work: StageContext, choosable: Sequence[RankedSite], scorer: Scorer) -> Iterator[_SiteCoverage]:
    """In the order of the scans."""
    by_name, field = {site.site: site for site in choosable}, scorer.field
    for scan in empty_scans(work, by_name.keys()):
        scored, crossed = by_name[scan.site.name], scorer.hits(scan.beams) > 0
        here = crossed.ravel()[field.cells]
        caption = ranking.site_caption(scored, int(here.sum()), len(here))
        yield _SiteCoverage(
            scored,
            crossed,
            column_entropy(field, here),
            column_entropy(field, ~here),
            caption,
            _beam_ends_m(scan.beams),
        )


def _beam_ends_m(beams: Beams) -> NDArray[np.float64]:
    """Where beams end on something, x and y in the world frame, (n, 2); those that go on to the sensor's range end on
    nothing.
    """
    met = np.linalg.norm(beams.ends_m, axis=1) < beams.sensor.range_m * (1 - 1e-9)
    ends: NDArray[np.float64] = beams.ends_m[met, :2] + np.asarray(beams.pose.position_m[:2])
    return ends


def _panel_data(
    coverage: _SiteCoverage, images: dict[str, IndexedImage], missed: Blindspots | None, box: Box
) -> dict[str, Any]:
    """What the page needs to draw one site's figures itself."""
    plan, site = maps.site_view_frame(box), coverage.scored
    more = {} if missed is None else {"vehicles": missed.choice(site.site, box)}
    images = images | ({} if missed is None else {"vehicles": missed.image(site.site)})
    return {
        "at": [round(plan.x(site.x_m), 1), round(plan.y(site.y_m), 1)],
        "share": [formatting.format_percent(site.entropy_seen), formatting.format_percent(1 - site.entropy_seen)],
        "caption": coverage.caption,
        "images": {name: [_to_base64(image.head), _to_base64(image.data)] for name, image in images.items()},
        **more,
    }


def _to_base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _draw_panel(
    coverage: _SiteCoverage,
    grid: Grid,
    peak: float,
    scan: IndexedImage,
    missed: Blindspots | None,
    backdrop: Backdrop,
    box: Box,
    prefix: str,
) -> SitePanel:
    site, view = coverage.scored, SiteViewFigure(coverage.scored, coverage.crossed, backdrop, box)
    place = f"{site.site} at x = {site.x_m:g} m, y = {site.y_m:g} m"

    def figure(word: str, values: ColumnValues, share: float) -> str:
        alt = f"From above: the {share:.1%} of the entropy {word} by {place}."
        return maps.site_view(grid, values, peak, view, f"{prefix}-{word}", alt)

    drawn = (
        figure("seen", coverage.visible_bit, site.entropy_seen),
        figure("missed", coverage.missed_bit, 1 - site.entropy_seen),
    )
    ends = maps.scan_view(grid, scan, view, f"{prefix}-scan", f"From above: where the beams of {place} end.")
    vehicles = missed.view(site, grid, backdrop, box, f"{prefix}-vehicles") if missed else None
    return SitePanel(site, *drawn, ends, coverage.caption, vehicles)


def column_entropy(field: EntropyField, which: NDArray[np.bool_]) -> ColumnValues:
    """Entropy summed along z over some of the voxels, (nx, ny) bits; added up in the order of the voxels."""
    nx, ny, nz = field.grid.shape
    summed = np.bincount(field.cells[which] // nz, weights=field.per_cell_bit[which], minlength=nx * ny)
    return summed.astype(np.float64).reshape(nx, ny)


@dataclass(frozen=True)
class Figures:
    """The maps of the traffic and of the sites, SVG text, empty where there is nothing to draw; the views of single
    sites, None where nothing is uncertain; and what lies under the maps, which the legend explains.
    """

    occupancy: str
    sites: str
    views: SiteViews | None
    backdrop: Backdrop


_WIDE_FIGURE = 680.0
"""A figure so wide has room for more words."""


def draw_figures(work: StageContext, ranking: Ranking, choosable: Sequence[RankedSite], tpog: Tpog) -> Figures:
    """Draw the figures of the run in a workspace; views of the ``choosable`` sites."""
    backdrop = make_backdrop(work, ranking, tpog)
    scorer = Scorer(work.scene, tpog, work.folder.trajectories)
    occupancy = occupancy_map(tpog, ranking, backdrop) if tpog.counts.any() else ""
    views = site_views(work, ranking, choosable, scorer, backdrop) if len(scorer.field.cells) else None
    return Figures(occupancy, sites_map(tpog, ranking, backdrop), views, backdrop)


def make_backdrop(work: StageContext, ranking: Ranking, tpog: Tpog) -> Backdrop:
    """What lies under the maps of a run."""
    box = extent(tpog.grid, ranking.sites)
    return Backdrop(outlines_of(work.world, box), roads_within(network_file(work.folder.path), box))


def _mean_occupancy(tpog: Tpog) -> ColumnValues:
    found: ColumnValues = tpog.counts.sum(axis=2) / tpog.frames
    return found


def occupancy_map(tpog: Tpog, ranking: Ranking, backdrop: Backdrop, width: float = maps.WIDTH) -> str:
    """Where traffic is, seen from above, SVG text; ``width`` in the figure's units."""
    occupied = _mean_occupancy(tpog)
    busiest = np.unravel_index(int(occupied.argmax()), occupied.shape)
    x, y = (o + (i + 0.5) * tpog.grid.voxel_m for o, i in zip(tpog.grid.origin_m, busiest, strict=False))
    alt = (
        f"Occupancy of the region of interest by traffic, seen from above: "
        f"{np.count_nonzero(occupied) / occupied.size:.0%} of its area is used by vehicles; "
        f"the busiest place is near x = {x:.0f} m, y = {y:.0f} m."
    )
    label = "Occupied voxels in the column"
    if width >= _WIDE_FIGURE:
        label += ", on average: probabilities summed along z"
    return maps.occupancy(tpog.grid, occupied, label, backdrop, ranking.sites, alt, width)


def sites_map(tpog: Tpog, ranking: Ranking, backdrop: Backdrop, width: float = maps.WIDTH) -> str:
    """The candidate sites by score, SVG text; ``width`` in the figure's units."""
    best, last = ranking.best[0], ranking.last
    alt = (
        f"Map of {len(ranking.sites)} candidate sites by score. "
        f"Best: {best.site} at x = {best.x_m:g} m, y = {best.y_m:g} m; "
        f"last: {last.site} at x = {last.x_m:g} m, y = {last.y_m:g} m."
    )
    return maps.site_map(tpog.grid, _mean_occupancy(tpog), backdrop, ranking.sites, alt, width)
