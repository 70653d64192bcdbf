"""The figures of a run's report: the traffic, the sites, and what the best and the worst site see and miss.

Steps: take outlines from the static world; draw the map of the sites and that of the occupancy; march the beams of the
best and of the worst site once more; split the entropy, summed along z, into what they see and what they miss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.readers import Tpog
from pipeline.report import maps
from pipeline.report.maps import SiteView
from pipeline.report.outlines import Outlines, outlines_of
from pipeline.report.plan import extent, shared_scale
from pipeline.report.ranking import Ranking, ScoredSite
from pipeline.report.raster import ColumnValues
from pipeline.scoring.egvs import EntropyField
from pipeline.scoring.scorer import Scorer
from pipeline.stages.base import Workspace
from pipeline.stages.scan_source import scans
from pipeline.stages.scene import scene_of
from pipeline.stages.world import world_of


@dataclass(frozen=True)
class SeenAndMissed:
    """What one site sees and misses: both figures, and voxels with entropy that it sees, of all."""

    scored: ScoredSite
    title: str
    seen: str
    missed: str
    voxels_seen: int
    voxels: int


@dataclass(frozen=True)
class Figures:
    """The report's figures, SVG text; empty where there is nothing to draw.

    Attributes
    ----------
    occupancy, sites
        The maps of the traffic and of the sites.
    views
        Of the best and of the worst site.
    scale
        The colour scale of the views.
    outlines
        What the legend of the maps explains.
    """

    occupancy: str
    sites: str
    views: tuple[SeenAndMissed, ...]
    scale: str
    outlines: tuple[Outlines, ...]


def draw(work: Workspace, ranking: Ranking, tpog: Tpog) -> Figures:
    """Draw the figures of the run in a workspace."""
    outlines = outlines_of(world_of(work), extent(tpog.grid, ranking.on_map))
    occupied = tpog.counts.sum(axis=2) / tpog.frames
    field = EntropyField.of(tpog.counts, tpog.frames, tpog.grid)
    views, scale = _views(work, ranking, tpog, field, outlines) if len(field.cells) else ((), "")
    return Figures(
        _occupancy(tpog, occupied, ranking, outlines) if tpog.counts.any() else "",
        _sites(tpog, occupied, ranking, outlines),
        views,
        scale,
        outlines,
    )


def _occupancy(tpog: Tpog, occupied: ColumnValues, ranking: Ranking, outlines: Sequence[Outlines]) -> str:
    grid = tpog.grid
    busiest = np.unravel_index(int(occupied.argmax()), occupied.shape)
    x, y = (o + (i + 0.5) * grid.voxel_m for o, i in zip(grid.origin_m, busiest, strict=False))
    alt = (
        f"Occupancy of the region of interest by traffic, seen from above: "
        f"{np.count_nonzero(occupied) / occupied.size:.0%} of its area is used by vehicles; "
        f"the busiest place is near x = {x:.0f} m, y = {y:.0f} m."
    )
    label = "Occupied voxels in the column, on average: probabilities summed along z"
    return maps.occupancy(grid, occupied, label, outlines, ranking.on_map, alt)


def _sites(tpog: Tpog, occupied: ColumnValues, ranking: Ranking, outlines: Sequence[Outlines]) -> str:
    best, last = ranking.best[0], ranking.last
    alt = (
        f"Map of {len(ranking.sites)} candidate sites by score. "
        f"Best: {best.site} at x = {best.x_m:g} m, y = {best.y_m:g} m; "
        f"last: {last.site} at x = {last.x_m:g} m, y = {last.y_m:g} m."
    )
    return maps.site_map(tpog.grid, occupied, outlines, ranking.on_map, alt)


def _views(
    work: Workspace, ranking: Ranking, tpog: Tpog, field: EntropyField, outlines: Sequence[Outlines]
) -> tuple[tuple[SeenAndMissed, ...], str]:
    """What the best and the worst site see and miss, and the colour scale of these figures."""
    extremes = {site.site: site for site in ranking.extremes}
    peak = float(_columns(field, np.ones(len(field.cells), dtype=np.bool_)).max())
    box = extent(field.grid, [site.on_map for site in extremes.values()])
    titles = ("The site",) if len(ranking.sites) == 1 else ("Best site", "Last site")
    views: dict[str, SeenAndMissed] = {}
    scorer = Scorer(scene_of(work), tpog, work.path("trajectories.parquet"))
    for scan in scans(work, extremes.keys()):
        name = scan.site.name
        number = list(extremes).index(name)
        view = SiteView(extremes[name].on_map, scorer.hits(scan.beams) > 0, outlines, box)
        views[name] = _seen_and_missed(extremes[name], titles[number], field, peak, view, f"view-{number}")
    return tuple(views[name] for name in extremes), shared_scale(peak, "Entropy in the column (bit)")


def _seen_and_missed(
    scored: ScoredSite, title: str, field: EntropyField, peak: float, view: SiteView, prefix: str
) -> SeenAndMissed:
    crossed = view.crossed.ravel()[field.cells]
    figures = {}
    for word, which, share in (
        ("seen", crossed, scored.entropy_seen),
        ("missed", ~crossed, 1 - scored.entropy_seen),
    ):
        alt = (
            f"From above: the {share:.1%} of the entropy {word} by {scored.site} "
            f"at x = {scored.x_m:g} m, y = {scored.y_m:g} m."
        )
        figures[word] = maps.site_view(field.grid, _columns(field, which), peak, view, f"{prefix}-{word}", alt)
    return SeenAndMissed(scored, title, figures["seen"], figures["missed"], int(crossed.sum()), len(crossed))


def _columns(field: EntropyField, which: NDArray[np.bool_]) -> ColumnValues:
    """Entropy summed along z over some of the voxels, (nx, ny) bits; added up in the order of the voxels."""
    nx, ny, nz = field.grid.shape
    summed = np.bincount(field.cells[which] // nz, weights=field.per_cell_bit[which], minlength=nx * ny)
    return summed.astype(np.float64).reshape(nx, ny)
