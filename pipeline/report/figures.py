"""The figures of a run's report: the traffic, the sites, and what each site sees and misses.

Steps: take outlines from the static world, and roads from the network that SUMO drove on; draw the map of the sites and
that of the occupancy; draw the views of single sites (:mod:`pipeline.report.site_views`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.artefacts.readers import Tpog
from pipeline.report.drawing import maps
from pipeline.report.drawing.map_frame import extent
from pipeline.report.drawing.maps import Backdrop
from pipeline.report.drawing.outlines import outlines_of
from pipeline.report.drawing.raster import ColumnValues
from pipeline.report.drawing.roads import network_file, roads_within
from pipeline.report.ranking import Ranking, ScoredSite
from pipeline.report.site_views import SiteViews, site_views
from pipeline.scoring.scorer import Scorer
from pipeline.stages.base import Workspace
from pipeline.stages.shared.scene import scene_of
from pipeline.stages.shared.world import world_of


@dataclass(frozen=True)
class Figures:
    """The maps of the traffic and of the sites, SVG text, empty where there is nothing to draw; the views of single
    sites, None where nothing is uncertain; and what lies under the maps, which the legend explains.
    """

    occupancy: str
    sites: str
    views: SiteViews | None
    backdrop: Backdrop


_WIDE = 680.0
"""A figure so wide has room for more words."""


def draw(work: Workspace, ranking: Ranking, choosable: Sequence[ScoredSite], tpog: Tpog) -> Figures:
    """Draw the figures of the run in a workspace; views of the ``choosable`` sites."""
    backdrop = backdrop_of(work, ranking, tpog)
    scorer = Scorer(scene_of(work), tpog, work.path("trajectories.parquet"))
    occupancy = occupancy_map(tpog, ranking, backdrop) if tpog.counts.any() else ""
    views = site_views(work, ranking, choosable, scorer, backdrop) if len(scorer.field.cells) else None
    return Figures(occupancy, sites_map(tpog, ranking, backdrop), views, backdrop)


def backdrop_of(work: Workspace, ranking: Ranking, tpog: Tpog) -> Backdrop:
    """What lies under the maps of a run."""
    box = extent(tpog.grid, ranking.sites)
    return Backdrop(outlines_of(world_of(work), box), roads_within(network_file(work.folder), box))


def _occupied(tpog: Tpog) -> ColumnValues:
    found: ColumnValues = tpog.counts.sum(axis=2) / tpog.frames
    return found


def occupancy_map(tpog: Tpog, ranking: Ranking, backdrop: Backdrop, width: float = maps.WIDTH) -> str:
    """Where traffic is, seen from above, SVG text; ``width`` in the figure's units."""
    occupied = _occupied(tpog)
    busiest = np.unravel_index(int(occupied.argmax()), occupied.shape)
    x, y = (o + (i + 0.5) * tpog.grid.voxel_m for o, i in zip(tpog.grid.origin_m, busiest, strict=False))
    alt = (
        f"Occupancy of the region of interest by traffic, seen from above: "
        f"{np.count_nonzero(occupied) / occupied.size:.0%} of its area is used by vehicles; "
        f"the busiest place is near x = {x:.0f} m, y = {y:.0f} m."
    )
    label = "Occupied voxels in the column"
    if width >= _WIDE:
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
    return maps.site_map(tpog.grid, _occupied(tpog), backdrop, ranking.sites, alt, width)
