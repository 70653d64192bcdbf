"""The figures of a run's report: the traffic, the sites, and what the best and the worst site see and miss.

Steps: take outlines from the static world; draw the map of the sites and that of the occupancy; march the beams of the
best and of the worst site once more; split the entropy, summed along z, into what they see and what they miss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.readers import Tpog
from pipeline.report import maps
from pipeline.report.map_frame import extent, shared_scale
from pipeline.report.maps import SiteView
from pipeline.report.outlines import Outlines, outlines_of
from pipeline.report.ranking import Ranking, ScoredSite
from pipeline.report.raster import ColumnValues
from pipeline.scoring.egvs import EntropyField
from pipeline.scoring.scorer import Scorer
from pipeline.stages.base import Workspace
from pipeline.stages.shared.scans import scans
from pipeline.stages.shared.scene import scene_of
from pipeline.stages.shared.world import world_of


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
    """The maps of the traffic and of the sites, the views of the best and of the worst site with their colour scale,
    and the outlines that the legend explains. Figures are SVG text, empty where there is nothing to draw.
    """

    occupancy: str
    sites: str
    views: tuple[SeenAndMissed, ...]
    scale: str
    outlines: tuple[Outlines, ...]


def draw(work: Workspace, ranking: Ranking, tpog: Tpog) -> Figures:
    """Draw the figures of the run in a workspace."""
    outlines = outlines_of(world_of(work), extent(tpog.grid, ranking.sites))
    occupied = tpog.counts.sum(axis=2) / tpog.frames
    scorer = Scorer(scene_of(work), tpog, work.path("trajectories.parquet"))
    occupancy = _occupancy(tpog, occupied, ranking, outlines) if tpog.counts.any() else ""
    views, scale = _views(work, ranking, scorer, outlines) if len(scorer.field.cells) else ((), "")
    return Figures(occupancy, _sites(tpog, occupied, ranking, outlines), views, scale, outlines)


def _occupancy(tpog: Tpog, occupied: ColumnValues, ranking: Ranking, outlines: Sequence[Outlines]) -> str:
    busiest = np.unravel_index(int(occupied.argmax()), occupied.shape)
    x, y = (o + (i + 0.5) * tpog.grid.voxel_m for o, i in zip(tpog.grid.origin_m, busiest, strict=False))
    alt = (
        f"Occupancy of the region of interest by traffic, seen from above: "
        f"{np.count_nonzero(occupied) / occupied.size:.0%} of its area is used by vehicles; "
        f"the busiest place is near x = {x:.0f} m, y = {y:.0f} m."
    )
    label = "Occupied voxels in the column, on average: probabilities summed along z"
    return maps.occupancy(tpog.grid, occupied, label, outlines, ranking.sites, alt)


def _sites(tpog: Tpog, occupied: ColumnValues, ranking: Ranking, outlines: Sequence[Outlines]) -> str:
    best, last = ranking.best[0], ranking.last
    alt = (
        f"Map of {len(ranking.sites)} candidate sites by score. "
        f"Best: {best.site} at x = {best.x_m:g} m, y = {best.y_m:g} m; "
        f"last: {last.site} at x = {last.x_m:g} m, y = {last.y_m:g} m."
    )
    return maps.site_map(tpog.grid, occupied, outlines, ranking.sites, alt)


def _views(
    work: Workspace, ranking: Ranking, scorer: Scorer, outlines: Sequence[Outlines]
) -> tuple[tuple[SeenAndMissed, ...], str]:
    """What the best and the worst site see and miss, and the colour scale of these figures."""
    field, extremes = scorer.field, ranking.extremes
    names = [site.site for site in extremes]
    titles = ("The site",) if len(ranking.sites) == 1 else ("Best site", "Last site")
    peak = float(_columns(field, np.ones(len(field.cells), dtype=np.bool_)).max())
    box = extent(field.grid, extremes)
    views: dict[int, SeenAndMissed] = {}
    for scan in scans(work, names):
        i = names.index(scan.site.name)
        view = SiteView(extremes[i], scorer.hits(scan.beams) > 0, outlines, box)
        views[i] = _seen_and_missed(extremes[i], titles[i], field, peak, view, f"view-{i}")
    return tuple(views[i] for i in sorted(views)), shared_scale(peak, "Entropy in the column (bit)")


def _seen_and_missed(
    scored: ScoredSite, title: str, field: EntropyField, peak: float, view: SiteView, prefix: str
) -> SeenAndMissed:
    crossed = view.crossed.ravel()[field.cells]

    def figure(word: str, which: NDArray[np.bool_], share: float) -> str:
        place = f"{scored.site} at x = {scored.x_m:g} m, y = {scored.y_m:g} m"
        alt = f"From above: the {share:.1%} of the entropy {word} by {place}."
        return maps.site_view(field.grid, _columns(field, which), peak, view, f"{prefix}-{word}", alt)

    seen = figure("seen", crossed, scored.entropy_seen)
    missed = figure("missed", ~crossed, 1 - scored.entropy_seen)
    return SeenAndMissed(scored, title, seen, missed, int(crossed.sum()), len(crossed))


def _columns(field: EntropyField, which: NDArray[np.bool_]) -> ColumnValues:
    """Entropy summed along z over some of the voxels, (nx, ny) bits; added up in the order of the voxels."""
    nx, ny, nz = field.grid.shape
    summed = np.bincount(field.cells[which] // nz, weights=field.per_cell_bit[which], minlength=nx * ny)
    return summed.astype(np.float64).reshape(nx, ny)
