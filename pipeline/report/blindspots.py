"""Where each site misses vehicles: a map by square metre, and its worst lanes in words.

Steps: read the sites' rows of ``blindspots.parquet``; of each keep the image's data and the sentences, from which the
page draws any site; those of the panels are drawn here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.artefacts import blindspots
from pipeline.artefacts.blindspots import BLINDSPOTS, FEWEST_VEHICLES, PlaceSeen, SiteBlindspots
from pipeline.core.grid import Grid
from pipeline.report import wording
from pipeline.report.drawing import maps, raster
from pipeline.report.drawing.map_frame import Box, MapSite
from pipeline.report.drawing.maps import Backdrop
from pipeline.stages.base import Workspace


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
        return BlindspotView(figure, missed(its), worst_in_words(its), note(its))

    def choice(self, site: str, box: Box) -> dict[str, Any]:
        """What the page needs to draw one site itself, but for the image."""
        its = self.sites[site]
        numbers = maps.numbers_at(maps.view_plan(box), its)
        return {"numbers": numbers, "missed": missed(its), "worst": worst_in_words(its), "note": note(its)}

    def image(self, site: str) -> raster.IndexedImage:
        """Of the share that is missed over each square."""
        return raster.share_image(self.sites[site].share_missed)


def read(work: Workspace, choosable: Sequence[MapSite]) -> Blindspots | None:
    """Of the ``choosable`` sites; None where the scenario does not ask for it."""
    if not work.scenario.score.blindspots:
        return None
    found = {its.site: its for its in blindspots.read(work.path(BLINDSPOTS), {site.site for site in choosable})}
    return Blindspots(found, next((its.points for its in found.values()), 0.0))


def missed(its: SiteBlindspots) -> str:
    """The share of all vehicles that a site misses."""
    return wording.share(1.0 - its.whole.share) if its.whole else "–"


def worst_in_words(its: SiteBlindspots) -> tuple[tuple[str, str], ...]:
    """The worst places, each in words and what that rests on."""
    return tuple((f"{place.words}: {_per_cent(place)} seen", _rests_on(place)) for place in its.worst)


def note(its: SiteBlindspots) -> str:
    """What the list does not say: how whole approaches are seen, how many vehicles are on no lane."""
    if its.whole is None:
        return "No vehicle in the region."
    if len(its.places) == 1:
        return "Without one network of roads for all the traffic there are no lanes to name: the map alone tells."
    found = []
    if not its.worst:
        found.append(f"No lane, turn or crossing with {FEWEST_VEHICLES} vehicles or more is seen worse than the rest.")
    if approaches := its.of_kind("approach"):
        listed = "; ".join(f"{place.words}: {_per_cent(place)}" for place in approaches)
        found.append(f"Whole approaches, seen: {listed}.")
    if its.off_lanes:
        were = "was" if its.off_lanes == 1 else "were"
        found.append(f"Of {its.whole.vehicle_frames:,} vehicles looked at, {its.off_lanes:,} {were} on no lane.")
    return " ".join(found)


def _per_cent(place: PlaceSeen) -> str:
    return f"{100.0 * place.share:.0f} %"


def _rests_on(place: PlaceSeen) -> str:
    return f"± {100.0 * place.se:.0f} %, from {place.vehicles:,} vehicles looked at {place.vehicle_frames:,} times"
