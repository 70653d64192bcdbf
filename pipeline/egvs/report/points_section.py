"""The section of the report on points on target: maps of the best sites, and of the overlap of a plan's sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from egvs.core.grid import Grid
from egvs.core.wording import format_percent
from egvs.drawing import maps
from egvs.drawing.maps import Backdrop
from egvs.drawing.svg_figures import Box, ColourClasses, extent
from egvs.results.ranking import RankedSite
from egvs.scoring.points_map import CLASS_LABELS, OVERLAP_POINTS, PointsMap, overlap_map
from egvs.sensors.sites import Site
from egvs.stages.base import StageContext
from egvs.stages.points_maps import points_maps, target_positions
from egvs.stages.site_scans import empty_scans

MAPPED_POLES = 2
"""The best site on each of this number of best poles is mapped."""


Map = tuple[str, str, str]
"""Title of a map, the map (SVG text), and a summary."""


@dataclass(frozen=True)
class PointsSection:
    """Maps of points on target of the best sites, and of the overlap of a plan; at least one map of a site."""

    sites: tuple[Map, ...]
    overlap: tuple[Map, ...]
    overlap_points: int = int(OVERLAP_POINTS)

    @classmethod
    def draw(
        cls,
        work: StageContext,
        best: Sequence[RankedSite],
        plan: Sequence[Site],
        grid: Grid,
        backdrop: Backdrop,
        *,
        moved: bool,
    ) -> PointsSection | None:
        """Draw the maps; None where the traffic does not come from one road network with lanes in the region.

        Parameters
        ----------
        work
            The run.
        best
            Sites to map.
        plan
            Sensors of a plan; empty without one.
        grid, backdrop
            Contents of the maps.
        moved
            Whether the sensors of the plan were moved from their candidates.
        """
        positions = [each for each in target_positions(work, grid) if len(each.boxes)]
        if not positions:
            return None
        box = extent(grid, best)
        by_name = {site.site: site for site in best}
        scans = ((scan.site.name, scan.beams) for scan in empty_scans(work, by_name.keys()))
        mapped = {(site, points.target.name): points for site, points in points_maps(work, positions, scans)}
        figures: list[Map] = []
        for site in best:
            for positions_of_target in positions:
                points = mapped[site.site, positions_of_target.target.name]
                figures.append(_site_figure(site, points, backdrop, box, f"points-{len(figures)}"))
        overlap: list[Map] = []
        if len(plan) > 1:
            from egvs.stages.plan_scans import plan_beams

            from_sensors = [points for _, points in points_maps(work, positions, plan_beams(work, plan, moved=moved))]
            for positions_of_target in positions:
                of_target = [points for points in from_sensors if points.target is positions_of_target.target]
                overlap.append(_overlap_figure(of_target, plan, backdrop, box, f"overlap-{len(overlap)}"))
        return cls(tuple(figures), tuple(overlap))


def cell_grid(points: PointsMap) -> Grid:
    """Return the grid of the squares of a map."""
    nx, ny = points.values.shape
    return Grid((*points.origin_m, 0.0), points.cell_m, (nx, ny, 1))


def _site_figure(site: RankedSite, points: PointsMap, backdrop: Backdrop, box: Box, prefix: str) -> Map:
    classes = ColourClasses(CLASS_LABELS, f"Points on a {points.target.name}")
    shares = {limit: format_percent(points.share_with(limit)) for limit in (1.0, OVERLAP_POINTS)}
    summary = f"{shares[1.0]} of the surface with any point, {shares[OVERLAP_POINTS]} with {OVERLAP_POINTS:g} or more"
    alt = f"From above: points that a {points.target.name} gets from {site.site}; {summary}."
    at_m = [(site.x_m, site.y_m)]
    figure = maps.classes_view(cell_grid(points), points.classes, classes, at_m, backdrop, box, prefix, alt)
    return (f"{site.site}: {points.target.name}", figure, summary)


def _overlap_figure(
    sensors: Sequence[PointsMap], plan: Sequence[Site], backdrop: Backdrop, box: Box, prefix: str
) -> Map:
    overlap = overlap_map(sensors)
    target = overlap.target.name
    classes = ColourClasses(
        tuple(str(count) for count in range(len(sensors) + 1)), f"Sensors with {OVERLAP_POINTS:g} points or more"
    )
    once, twice = (format_percent(overlap.share_with(count)) for count in (1.0, 2.0))
    summary = f"{once} of the surface by one sensor or more, {twice} by two or more"
    alt = f"From above: number of sensors of the plan that see a {target} well; {summary}."
    at_m = [(site.pose.x_m, site.pose.y_m) for site in plan]
    figure = maps.classes_view(cell_grid(overlap), overlap.values, classes, at_m, backdrop, box, prefix, alt)
    return (f"The plan: {target}", figure, summary)
