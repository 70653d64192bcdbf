"""How much a ranking depends on assumed heights of buildings, for ``egvs compare --assumed-heights``.

``egvs new`` notes in each footprint where its height is from (``height_from``). The scenario runs as it is, and with
all assumed heights of buildings 30 % lower and higher; traffic is the same and comes from the store. Then the ranks of
the best five sites are compared.

The changed footprints are written to the run folders, as ``assumed_heights_1.geojson`` and so on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egvs.artefacts.run_folder import RunFolder
from egvs.core.platform import relative_path
from egvs.core.wording import format_percent
from egvs.results.labels import ScoreLabel, join_names
from egvs.results.ranking import RankedSite, Ranking
from egvs.runs import run_names
from egvs.runs.run_sources import SettingsSource
from egvs.scenario.model import Scenario
from egvs.scenario.settings import format_overrides
from egvs.studies.footprint_files import read_document, write_if_changed
from egvs.world.footprints import WORLD_DATUM, Z_DATUM

OPTION = "--assumed-heights"

FACTORS = (0.7, 1.3)
"""Heights are multiplied by these."""

ASSUMED_SOURCES = frozenset({"default", "type", "neighbours"})
"""Values of ``height_from`` of heights that no map, table or measurement gives."""

BEST = 5
"""How many of the best sites are compared."""

_KIND = "building"


@dataclass(frozen=True)
class HeightRun:
    """A run with changed heights.

    Attributes
    ----------
    factor
        What assumed heights are multiplied by; 1 for the scenario as it is.
    scenario
        The scenario with these heights.
    folder
        The run folder.
    """

    factor: float
    scenario: Scenario
    folder: Path

    @property
    def label(self) -> str:
        """The heights in words."""
        return "as assumed" if self.factor == 1.0 else format_percent(self.factor - 1, 0, signed=True)


@dataclass(frozen=True)
class HeightRuns:
    """Runs that differ in the assumed heights of buildings.

    Attributes
    ----------
    runs
        The scenario as it is, then one run for each of :data:`FACTORS`; only the former if no height is assumed.
    buildings, assumed
        Number of footprints of buildings, and of those with an assumed height.
    """

    runs: tuple[HeightRun, ...]
    buildings: int
    assumed: int


@dataclass(frozen=True)
class RankedAgain:
    """A site, its rank in each run, and its score in each run; None in runs in which it was not possible."""

    name: str
    ranks: tuple[int | None, ...]
    scores: tuple[float | None, ...]


@dataclass(frozen=True)
class HeightSensitivity:
    """How ranks depend on assumed heights.

    Attributes
    ----------
    runs
        The compared runs, the scenario as it is first.
    sites
        The sites that are among the best :data:`BEST` in any run, by their rank in the first.
    label
        Label of the score that ranks.
    """

    runs: HeightRuns
    sites: tuple[RankedAgain, ...]
    label: ScoreLabel

    def conclusion(self) -> Iterator[str]:
        """Yield sentences: what is assumed, whether the best site stays, and which of the best five change."""
        counts = self.runs
        yield (
            f"The heights of {counts.assumed:,} of {counts.buildings:,} buildings are assumed; they were changed by"
            f" {join_names([run.label for run in counts.runs[1:]])}."
        )
        changes = False
        for number, height_run in enumerate(counts.runs[1:], start=1):
            change = self._change(number)
            if change:
                changes = True
                yield f"At {height_run.label}, {change}."
        if not changes:
            yield f"The best {min(BEST, len(self.sites))} sites are the same, in the same order."

    def _change(self, number: int) -> str:
        """Describe what is different in a run; empty if nothing is."""
        leaving = [site.name for site in self.sites if _is_best(site.ranks[0]) and not _is_best(site.ranks[number])]
        entering = [site.name for site in self.sites if not _is_best(site.ranks[0]) and _is_best(site.ranks[number])]
        moved = [site.name for site in self.sites if _is_best(site.ranks[0]) and site.ranks[0] != site.ranks[number]]
        first = [site.name for site in self.sites if site.ranks[0] == 1]
        first_there = [site.name for site in self.sites if site.ranks[number] == 1]
        parts = []
        if first != first_there:
            parts.append(f"{join_names(first_there)} is best instead of {join_names(first)}")
        if leaving:
            parts.append(f"{join_names(leaving)} leaves the best {BEST}")
        if entering:
            parts.append(f"{join_names(entering)} enters them")
        if not parts and moved:
            parts.append(f"the best {BEST} are the same in another order")
        return ", ".join(parts)


def prepare_runs(path: Path, overrides: Sequence[str] = ()) -> HeightRuns:
    """Return the runs of a scenario with changed heights, and write their footprints; nothing is run yet.

    Parameters
    ----------
    path
        The scenario, or a run, whose settings are used.
    overrides
        Further settings of all runs, as in :func:`egvs.load`.

    Raises
    ------
    InputError
        When the scenario is wrong, or its footprints cannot be read.
    """
    source = SettingsSource(path)
    base = source.load_variant(overrides)
    folder = source.folder(base) if not overrides else run_names.run_folder(base.name, base.overrides)
    documents = [read_document(base.find(name, "statics.footprints")) for name in base.statics.footprints]
    buildings = sum(_is_building(feature) for document in documents for feature in document["features"])
    assumed = sum(_is_assumed(feature) for document in documents for feature in document["features"])
    runs = [HeightRun(1.0, base, folder)]
    if assumed:
        for factor in FACTORS:
            runs.append(_changed_run(source, base, overrides, documents, factor))
    return HeightRuns(tuple(runs), buildings, assumed)


def compare_heights(height_runs: HeightRuns, run_one: Callable[[int, HeightRun], None]) -> HeightSensitivity:
    """Run the scenario with all heights, and compare the ranks of the best sites.

    Parameters
    ----------
    height_runs
        From :func:`prepare_runs`.
    run_one
        Brings one run up to date; called with its number, from 1.
    """
    rankings = []
    for number, height_run in enumerate(height_runs.runs, start=1):
        run_one(number, height_run)
        rankings.append(Ranking.read(RunFolder(height_run.folder).scores))
    names = dict.fromkeys(site.site for ranking in rankings for site in ranking.sites if _is_best(site.rank))
    by_name = [{site.site: site for site in ranking.sites} for ranking in rankings]
    sites = [_ranked_again(name, by_name) for name in names]
    return HeightSensitivity(height_runs, tuple(sorted(sites, key=_first_rank)), rankings[0].best[0].by)


def _first_rank(site: RankedAgain) -> float:
    rank = site.ranks[0]
    return float("inf") if rank is None else rank


def _ranked_again(name: str, by_name: Sequence[Mapping[str, RankedSite]]) -> RankedAgain:
    sites = [sites.get(name) for sites in by_name]
    ranks = tuple(None if site is None else site.rank for site in sites)
    return RankedAgain(name, ranks, tuple(None if site is None else site.score for site in sites))


def _is_best(rank: int | None) -> bool:
    return rank is not None and rank <= BEST


def _changed_run(
    source: SettingsSource, base: Scenario, overrides: Sequence[str], documents: Sequence[dict[str, Any]], factor: float
) -> HeightRun:
    """Write the footprints of a run, and return it."""
    folder = run_names.run_folder(base.name, {**base.overrides, "assumed_heights": factor})
    names = []
    for number, document in enumerate(documents, start=1):
        path = folder / f"assumed_heights_{number}.geojson"
        write_if_changed(path, scale_heights(document, factor))
        names.append(relative_path(path.resolve(), base.folder.resolve()))
    scenario = source.load_variant((*overrides, *format_overrides({"statics.footprints": names})))
    return HeightRun(factor, scenario, folder)


def scale_heights(document: Mapping[str, Any], factor: float) -> dict[str, Any]:
    """Return a GeoJSON FeatureCollection with the assumed heights of buildings multiplied by a factor.

    Heights in z of the world frame are multiplied from their underside, which stays.
    """
    features = []
    for feature in document["features"]:
        if _is_assumed(feature):
            properties = dict(feature["properties"])
            zero_m = properties.get("base_m") or 0.0 if properties.get(Z_DATUM) == WORLD_DATUM else 0.0
            for key in ("height_m", "base_m"):
                if key in properties and isinstance(properties[key], int | float):
                    properties[key] = round(zero_m + (properties[key] - zero_m) * factor, 3)
            feature = {**feature, "properties": properties}
        features.append(feature)
    return {**document, "features": features}


def _is_building(feature: Any) -> bool:
    properties = feature.get("properties") if isinstance(feature, dict) else None
    return isinstance(properties, dict) and properties.get("kind") == _KIND


def _is_assumed(feature: Any) -> bool:
    return _is_building(feature) and feature["properties"].get("height_from") in ASSUMED_SOURCES
