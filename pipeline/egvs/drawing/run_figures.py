"""Figures of the report: maps of the traffic and of the sites, and views of what each site sees and misses.

For each site that a reader can choose, its beams are traced once more; the entropy, summed along z, is split into what
the beams cross and what they do not; blind spots come from ``blindspots.parquet``. The views of the best and of the
last site are drawn here. For the other sites the page has the data of the images without palettes, and joins both when
a reader chooses a site, in its light or dark colours. If there are many sites, these images have fewer pixels, so that
the page stays small.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from egvs.artefacts import readers
from egvs.artefacts.readers import MIN_VEHICLES, LocationVisibility, SiteBlindspots
from egvs.artefacts.tpog import Tpog
from egvs.core.grid import BoolArray, FloatArray, Grid
from egvs.core.threads import map_ordered
from egvs.core.wording import by_number, format_percent
from egvs.drawing import colours, maps
from egvs.drawing.basemap import network_file, roads_within, world_outlines
from egvs.drawing.colours import ColumnValues, IndexedImage
from egvs.drawing.maps import Backdrop, SiteViewFigure
from egvs.drawing.svg_figures import PAGE_STYLE, Box, FigureStyle, extent, shared_scale
from egvs.results.labels import format_count, format_number
from egvs.results.ranking import RankedSite, Ranking
from egvs.scoring.egvs import EntropyField
from egvs.scoring.scorer import Scorer
from egvs.scoring.visibility import Beams
from egvs.stages.base import StageContext
from egvs.stages.site_scans import SiteScan, empty_scans

MAX_FULL_IMAGES = 40
"""With more sites than this, only the best and the last have images in full resolution."""

_SCAN_CELLS, _COARSE_SCAN_CELLS = 300, 150
"""Cells of the image of an empty scan, from west to east."""
_COARSE_PIXELS = 30_000
"""Maximum number of pixels of the other images in coarse resolution."""

_PALETTES = {
    "field": colours.FIELD_PALETTES,
    "scan": colours.DOT_PALETTES,
    "vehicles": colours.SHARE_PALETTES,
    "shade": colours.SHADE_PALETTES,
}
"""Palettes by view; views that are not listed use that of ``field``."""

_WIDE_FIGURE = 680.0
"""A figure of at least this width has room for a longer label."""


@dataclass(frozen=True)
class Figures:
    """Figures of a run.

    Attributes
    ----------
    occupancy, sites
        Maps, SVG text; ``occupancy`` is empty if there is no traffic.
    views
        Views of single sites; None if nothing is uncertain.
    backdrop
        Background of the maps, which the legend explains.
    """

    occupancy: str
    sites: str
    views: SiteViews | None
    backdrop: Backdrop


@dataclass(frozen=True)
class SiteViews:
    """Views of single sites.

    Attributes
    ----------
    panels
        Those of the best and of the last site.
    scale
        Their colour scale, SVG text.
    data
        JSON from which the page draws any other site.
    is_coarse
        Whether the images of the other sites have a coarse resolution.
    """

    panels: tuple[SitePanel, ...]
    scale: str
    data: str
    is_coarse: bool


@dataclass(frozen=True)
class SitePanel:
    """Figures of one site, SVG text, and the texts next to them.

    ``vehicles`` has the ``figure`` of its blind spots, and :func:`blindspot_texts`.
    """

    scored: RankedSite
    visible: str
    missed: str
    scan: str
    caption: str
    vehicles: dict[str, Any] | None


def draw_figures(work: StageContext, ranking: Ranking, choosable: Sequence[RankedSite], tpog: Tpog) -> Figures:
    """Draw the figures of a run; views are made of the ``choosable`` sites."""
    backdrop = make_backdrop(work, ranking, tpog)
    scorer = Scorer(work.scene, tpog, work.folder.trajectories)
    occupancy, views = "", None
    if tpog.counts.any():
        occupancy = occupancy_map(tpog, ranking, backdrop)
    if len(scorer.field.cells):
        views = site_views(work, ranking, choosable, scorer, backdrop)
    return Figures(occupancy, sites_map(tpog, ranking, backdrop), views, backdrop)


def make_backdrop(work: StageContext, ranking: Ranking, tpog: Tpog) -> Backdrop:
    """Return the background of the maps of a run."""
    box = extent(tpog.grid, ranking.sites)
    return Backdrop(world_outlines(work.world, box), roads_within(network_file(work.folder.path), box))


def _mean_occupancy(tpog: Tpog) -> ColumnValues:
    mean: ColumnValues = tpog.counts.sum(axis=2) / tpog.frames
    return mean


def occupancy_map(tpog: Tpog, ranking: Ranking, backdrop: Backdrop, style: FigureStyle = PAGE_STYLE) -> str:
    """Return a map of the traffic, SVG text."""
    mean = _mean_occupancy(tpog)
    ix, iy = np.unravel_index(int(mean.argmax()), mean.shape)
    x = tpog.grid.origin_m[0] + (ix + 0.5) * tpog.grid.voxel_m
    y = tpog.grid.origin_m[1] + (iy + 0.5) * tpog.grid.voxel_m
    alt = (
        f"Occupancy of the region of interest by traffic, seen from above: "
        f"vehicles use {format_percent(np.count_nonzero(mean) / mean.size, 0)} of its area; "
        f"the busiest location is near x = {x:.0f} m, y = {y:.0f} m."
    )
    label = "Occupied voxels in the column"
    if style.width >= _WIDE_FIGURE:
        label += ", on average: probabilities summed along z"
    return maps.occupancy(tpog.grid, mean, label, backdrop, ranking.sites, alt, style)


def sites_map(tpog: Tpog, ranking: Ranking, backdrop: Backdrop, style: FigureStyle = PAGE_STYLE) -> str:
    """Return a map of the candidate sites, SVG text."""
    best, last = ranking.best[0], ranking.last
    alt = (
        f"Map of {len(ranking.sites)} candidate sites by score. "
        f"Best: {best.site} at x = {best.x_m:g} m, y = {best.y_m:g} m; "
        f"last: {last.site} at x = {last.x_m:g} m, y = {last.y_m:g} m."
    )
    return maps.site_map(tpog.grid, _mean_occupancy(tpog), backdrop, ranking.sites, alt, style)


# ---- views of single sites


@dataclass(frozen=True)
class _SiteCoverage:
    """Voxels that the beams of a site cross, and where the beams end."""

    scored: RankedSite
    crossed: BoolArray
    visible_bit: ColumnValues
    missed_bit: ColumnValues
    caption: str
    ends_m: FloatArray


def site_views(
    work: StageContext, ranking: Ranking, choosable: Sequence[RankedSite], scorer: Scorer, backdrop: Backdrop
) -> SiteViews:
    """Draw the views of the best and of the last site, and return the data of all ``choosable`` sites."""
    box = extent(scorer.field.grid, choosable)
    is_coarse = len(choosable) > MAX_FULL_IMAGES
    peak = float(column_entropy(scorer.field, np.ones(len(scorer.field.cells), dtype=np.bool_)).max())
    site_of_name = {site.site: site for site in choosable}
    blindspots: dict[str, SiteBlindspots] = {}
    if work.scenario.score.blindspots:
        blindspots = {spots.site: spots for spots in readers.read_blindspots(work.folder.blindspots, set(site_of_name))}

    def draw_images(scan: SiteScan) -> tuple[_SiteCoverage, dict[str, IndexedImage]]:
        site = site_of_name[scan.site.name]
        coverage = _site_coverage(site, scan.beams, scorer)
        return coverage, _site_images(coverage, peak, box, in_full=site in ranking.extremes or not is_coarse)

    panels: dict[str, SitePanel] = {}
    site_data: dict[str, dict[str, Any]] = {}
    for coverage, images in map_ordered(draw_images, empty_scans(work, site_of_name.keys()), work.threads):
        site = coverage.scored
        site_data[site.site] = _panel_data(coverage, images, blindspots.get(site.site), box)
        if site in ranking.extremes:
            prefix = f"view-{ranking.extremes.index(site)}"
            panels[site.site] = _draw_panel(
                coverage, scorer.field.grid, peak, images["scan"], blindspots.get(site.site), backdrop, box, prefix
            )

    palettes: dict[str, dict[str, str]] = {}
    for theme in colours.THEMES:
        palettes[theme] = {view: _to_base64(palette[theme]) for view, palette in _PALETTES.items()}
    data = {
        "sites": {site.site: site_data[site.site] for site in choosable},
        "palettes": palettes,
        "end": _to_base64(colours.PNG_END),
    }
    return SiteViews(
        panels=tuple(panels[site.site] for site in ranking.extremes),
        scale=shared_scale(peak, "Entropy in the column (bit)"),
        data=json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"),  # a name must not end the script
        is_coarse=is_coarse,
    )


def _site_coverage(site: RankedSite, beams: Beams, scorer: Scorer) -> _SiteCoverage:
    field, crossed = scorer.field, scorer.hits(beams) > 0
    visible = crossed.ravel()[field.cells]
    return _SiteCoverage(
        scored=site,
        crossed=crossed,
        visible_bit=column_entropy(field, visible),
        missed_bit=column_entropy(field, ~visible),
        caption=site_caption(site, int(visible.sum()), len(visible)),
        ends_m=_hit_positions_m(beams),
    )


def _hit_positions_m(beams: Beams) -> FloatArray:
    """Positions where beams hit something, x and y in the world frame, shape (n, 2)."""
    is_hit = np.linalg.norm(beams.ends_m, axis=1) < beams.sensor.range_m * (1 - 1e-9)
    ends: FloatArray = beams.ends_m[is_hit, :2] + np.asarray(beams.pose.position_m[:2])
    return ends


_VIEW_STEP_DEG = 2
"""Width of the sectors of a field of view."""


def view_outline_m(beams: Beams) -> FloatArray:
    """Return the field of view of a sensor from above, in the world frame, (n, 2).

    In each sector of azimuths it reaches as far as the farthest beam that points down: to the ground, to the first
    object, or to the range of the sensor. Sectors without such beams are at the sensor.
    """
    down_m = beams.ends_m[beams.ends_m[:, 2] < 0.0, :2]
    azimuth_deg = np.degrees(np.arctan2(down_m[:, 1], down_m[:, 0])) % 360.0
    sector = (azimuth_deg // _VIEW_STEP_DEG).astype(np.int64)
    reach_m = np.zeros(360 // _VIEW_STEP_DEG)
    np.maximum.at(reach_m, np.minimum(sector, len(reach_m) - 1), np.hypot(down_m[:, 0], down_m[:, 1]))
    middle_rad = np.radians((np.arange(len(reach_m)) + 0.5) * _VIEW_STEP_DEG)
    outward = np.column_stack((np.cos(middle_rad), np.sin(middle_rad)))
    outline_m: FloatArray = outward * reach_m[:, None] + np.asarray(beams.pose.position_m[:2])
    return outline_m


def column_entropy(field: EntropyField, which: BoolArray) -> ColumnValues:
    """Return the entropy of some of the uncertain voxels, summed along z.

    Parameters
    ----------
    field
        Entropy of the uncertain voxels.
    which
        The voxels that count, shape (n_voxels,).

    Returns
    -------
    ndarray
        Bits, shape (nx, ny).
    """
    nx, ny, nz = field.grid.shape
    summed = np.bincount(field.cells[which] // nz, weights=field.per_cell_bit[which], minlength=nx * ny)
    return summed.astype(np.float64).reshape(nx, ny)


def _site_images(coverage: _SiteCoverage, peak: float, box: Box, *, in_full: bool) -> dict[str, IndexedImage]:
    pixels, cells = _COARSE_PIXELS, _COARSE_SCAN_CELLS
    if in_full:
        pixels, cells = colours.MAX_PIXELS, _SCAN_CELLS
    return {
        "seen": colours.field_image(coverage.visible_bit, peak, pixels),
        "missed": colours.field_image(coverage.missed_bit, peak, pixels),
        "scan": colours.dots_image(coverage.ends_m, box, cells),
        "shade": colours.shade_image(np.logical_not(coverage.crossed.any(axis=2)), pixels),
    }


def _panel_data(
    coverage: _SiteCoverage, images: dict[str, IndexedImage], blindspots: SiteBlindspots | None, box: Box
) -> dict[str, Any]:
    """Data from which the page draws the figures of one site."""
    plan, site = maps.site_view_frame(box), coverage.scored
    data: dict[str, Any] = {
        "at": [round(plan.x(site.x_m), 1), round(plan.y(site.y_m), 1)],
        "share": [format_percent(site.entropy_seen), format_percent(1 - site.entropy_seen)],
        "caption": coverage.caption,
    }
    if blindspots is not None:
        images = images | {"vehicles": colours.share_image(blindspots.share_missed)}
        data["vehicles"] = {"numbers": maps.label_positions(plan, blindspots), **blindspot_texts(blindspots)}
    data["images"] = {name: [_to_base64(image.head), _to_base64(image.data)] for name, image in images.items()}
    return data


def _to_base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _draw_panel(
    coverage: _SiteCoverage,
    grid: Grid,
    peak: float,
    scan: IndexedImage,
    blindspots: SiteBlindspots | None,
    backdrop: Backdrop,
    box: Box,
    prefix: str,
) -> SitePanel:
    site = coverage.scored
    view = SiteViewFigure(site, coverage.crossed, backdrop, box)
    where = f"{site.site} at x = {site.x_m:g} m, y = {site.y_m:g} m"
    share = site.entropy_seen
    visible = maps.site_view(
        grid, coverage.visible_bit, peak, view, f"{prefix}-seen",
        f"From above: the {format_percent(share)} of the entropy seen by {where}.",
    )  # fmt: skip
    missed = maps.site_view(
        grid, coverage.missed_bit, peak, view, f"{prefix}-missed",
        f"From above: the {format_percent(1 - share)} of the entropy missed by {where}.",
    )  # fmt: skip
    ends = maps.scan_view(grid, scan, view, f"{prefix}-scan", f"From above: where the beams of {where} end.")
    vehicles = None
    if blindspots is not None:
        figure = maps.missed_view(grid, blindspots, site, backdrop, box, f"{prefix}-vehicles")
        vehicles = {"figure": figure, **blindspot_texts(blindspots)}
    return SitePanel(site, visible, missed, ends, coverage.caption, vehicles)


# ---- blind spots


def blindspot_texts(site_blindspots: SiteBlindspots) -> dict[str, Any]:
    """Return what the page says about the blind spots of a site.

    Returns
    -------
    dict
        ``missed``, the share of all vehicles that the site misses; ``worst``, the worst locations, and the sample that
        each is based on; and a ``note`` on what this list does not show.
    """
    return {
        "missed": format_missed_share(site_blindspots),
        "worst": describe_worst_locations(site_blindspots),
        "note": blindspot_note(site_blindspots),
    }


def format_missed_share(site_blindspots: SiteBlindspots) -> str:
    """Return the share of all vehicles that a site misses."""
    if site_blindspots.overall is None:
        return "–"
    return format_percent(1.0 - site_blindspots.overall.share)


def describe_worst_locations(site_blindspots: SiteBlindspots) -> tuple[tuple[str, str], ...]:
    """Return the worst locations, and the sample that each is based on."""
    described = []
    for location in site_blindspots.worst:
        described.append((f"{location.words}: {_format_share(location)} found", _describe_sample(location)))
    return tuple(described)


def blindspot_note(site_blindspots: SiteBlindspots) -> str:
    """Return a remark on what the list of the worst locations does not show."""
    if site_blindspots.overall is None:
        return "No vehicle in the region."
    if len(site_blindspots.locations) == 1:
        return "The traffic does not come from one road network, so there are no lanes to list; see the map."
    sentences = []
    if not site_blindspots.worst:
        sentences.append(f"No lane, turn or crossing with {MIN_VEHICLES} vehicles or more is below the average.")
    if approaches := site_blindspots.of_kind("approach"):
        shares = ", ".join(
            f"{approach.words.removesuffix(' approach')} {_format_share(approach)}" for approach in approaches
        )
        sentences.append(f"Share of vehicles found on each approach: {shares}.")
    if site_blindspots.off_lanes:
        verb = by_number(site_blindspots.off_lanes, "was", "were")
        sentences.append(
            f"{site_blindspots.off_lanes:,} of {site_blindspots.overall.vehicle_frames:,} observed vehicles "
            f"{verb} not on a lane."
        )
    return " ".join(sentences)


def _format_share(location: LocationVisibility) -> str:
    return format_percent(location.share, 0)


def _describe_sample(location: LocationVisibility) -> str:
    return (
        f"± {format_percent(location.se, 0)}, from {location.vehicles:,} vehicles in "
        f"{location.vehicle_frames:,} observations"
    )


def site_caption(site: RankedSite, visible_voxels: int, voxels: int) -> str:
    """Return the position and the counts of one site."""
    return (
        f"{site.site}: rank {site.rank}, {site.by.with_noun(site.score)}, at x = {format_number(site.x_m)} m, "
        f"y = {format_number(site.y_m)} m, z = {format_number(site.z_m)} m, with a {site.sensor}. "
        f"It sees {format_count(visible_voxels)} of {format_count(voxels)} uncertain voxels. "
        f"{format_count(site.beams_in_roi)} of its beams can reach the region; {format_count(site.returns)} of "
        "them hit the ground or an object."
    )
