"""The section of the report on zones: shares found by zone and class, on a map and in a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from egvs.artefacts.readers import ALL_USERS, ZoneVisibility, read_plan_zones, read_zone_areas, read_zones
from egvs.artefacts.run_folder import RunFolder
from egvs.core.grid import Grid
from egvs.drawing import maps
from egvs.drawing.maps import Backdrop, MapZone
from egvs.drawing.svg_figures import extent
from egvs.results.ranking import RankedSite
from egvs.stages.base import StageContext


@dataclass(frozen=True)
class ZoneTable:
    """Shares found in words, by zone and class.

    Attributes
    ----------
    classes
        Plurals of the classes, the heads of the columns.
    rows
        For each zone its number on the map, its name, and for each class the share found and the number of road users,
        as text; None where there were none.
    """

    classes: tuple[str, ...]
    rows: tuple[tuple[int, str, tuple[tuple[str, str] | None, ...]], ...]

    @classmethod
    def of(cls, zones: Sequence[ZoneVisibility], numbers: Mapping[str, int]) -> ZoneTable:
        """Arrange the rows of an artefact; ``numbers`` are those of the zones on the map."""
        all_first = sorted(zones, key=lambda zone: zone.user_class != "all")
        heads = {zone.user_class: zone.class_plural for zone in all_first}
        by_key = {(zone.zone, zone.user_class): zone for zone in zones}
        rows = []
        for name in dict.fromkeys(zone.zone for zone in zones):
            cells: list[tuple[str, str] | None] = []
            for user_class in heads:
                zone = by_key.get((name, user_class))
                cells.append(None if zone is None else (zone.share_text, f"of {zone.road_users:,}"))
            rows.append((numbers[name], name, tuple(cells)))
        return cls(tuple(heads.values()), tuple(rows))


@dataclass(frozen=True)
class ZoneSection:
    """Zones of the best site, and of the plan if there is one.

    Attributes
    ----------
    site
        Name of the site.
    map
        SVG text.
    table, plan
        Shares found from the site, and by the plan; the latter is None without a plan of this run.
    """

    site: str
    map: str
    table: ZoneTable
    plan: ZoneTable | None

    @classmethod
    def read(
        cls, work: StageContext, best: RankedSite, grid: Grid, backdrop: Backdrop, *, has_plan: bool
    ) -> ZoneSection | None:
        """Read the zones of a run; None where no road user was in any.

        Parameters
        ----------
        work
            A run of a scenario with zones.
        best
            The best site.
        grid, backdrop
            Contents of the map.
        has_plan
            Whether the run has a plan.
        """
        zones = read_zones(work.folder.zones, best.site)
        if not zones:
            return None
        areas = read_zone_areas(work.folder.zones)
        numbers = {name: number for number, name in enumerate(areas, start=1)}
        shown = []
        for zone in zones:
            if zone.user_class == ALL_USERS:
                title = f"{zone.zone}: {zone.share_text} of {zone.road_users:,} road users found"
                shown.append(MapZone(areas[zone.zone], numbers[zone.zone], zone.share, title))
        alt = f"Map of {len(shown)} zones by the share of road users that is found from {best.site}."
        figure = maps.zone_map(grid, shown, best, backdrop, extent(grid, [best]), alt)
        plan = None
        plan_path: Path = RunFolder(work.folder.path).plan_zones
        if has_plan and plan_path.is_file():
            plan = ZoneTable.of(read_plan_zones(plan_path), numbers)
        return cls(best.site, figure, ZoneTable.of(zones, numbers), plan)
