"""Differences of scores of sites in several runs, with standard errors.

Runs with the same traffic have their errors in common: a busy quarter of an hour is busy for all sites and sensors. The
block jackknife leaves out the same groups of frames in all of them, so the error of a difference is computed from the
differences of the replicates (:mod:`egvs.scoring.standard_errors`), as within a run. The same holds for the detectors
of a score. Replicates are not kept in a run
folder. So the sites that are compared are scored again from its artefacts, and must get the recorded scores.

Where that is not possible, or the traffic differs, errors are taken as independent: the squared standard errors are
added.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.progress import ProgressCallback, no_progress
from egvs.results.ranking import RankedSite
from egvs.results.sensors import ScoreDifference
from egvs.runs.run_context import open_folder
from egvs.runs.stage_registry import recorded_digests
from egvs.scenario.effects_config import EffectsConfig
from egvs.scenario.loading import scenario_from_dict
from egvs.scoring.score_table import ScoreColumn
from egvs.scoring.standard_errors import BlockGroups, ScoreUncertainty
from egvs.sensors.return_model import REFLECTIVITY_INTERVAL
from egvs.stages.site_scoring import SiteScoring


class SiteOfRun(NamedTuple):
    """A site of a finished run."""

    folder: Path
    site: RankedSite


class _SiteKey(NamedTuple):
    folder: Path
    name: str


@dataclass(frozen=True, eq=False)
class SiteReplicates:
    """Scores of sites of a run: of all traffic, then with each group of blocks left out.

    Attributes
    ----------
    names
        Names of the sites, n.
    values
        The score that ranks, (n, 1 + k) float64.
    groups
        The groups that are left out, k in all.
    """

    names: tuple[str, ...]
    values: FloatArray
    groups: tuple[BlockGroups, ...]


class ScoreDifferences:
    """Differences of scores of sites in some runs; :meth:`of` makes it.

    Parameters
    ----------
    traffic
        Run folder -> sha256 of its trajectories; empty if unknown.
    """

    def __init__(self, traffic: Mapping[Path, str]) -> None:
        self._traffic = traffic
        self._failures: dict[Path, str] = {}
        self._pools: list[ScoreUncertainty] = []
        self._rows: dict[_SiteKey, tuple[int, int]] = {}

    @classmethod
    def of(cls, sites: Collection[SiteOfRun], progress: ProgressCallback = no_progress) -> ScoreDifferences:
        """Score sites again, those of runs with the same traffic together.

        Parameters
        ----------
        sites
            The sites that are to be compared.
        progress
            Called with the number of runs that are done.
        """
        recorded: dict[Path, dict[str, RankedSite]] = {}
        for folder, site in sites:
            recorded.setdefault(folder, {})[site.site] = site
        differences = cls({folder: traffic_digest(folder) for folder in recorded})
        # by traffic and frames of each group of each record: sites for which both are the same have paired replicates
        pools: dict[tuple[str, tuple[tuple[int, ...], ...]], dict[Path, SiteReplicates]] = {}
        for number, (folder, sites_of_run) in enumerate(recorded.items(), start=1):
            digest = differences._traffic[folder]
            if differences._count_sites(digest, recorded) > 1:
                result = read_replicates(folder, sites_of_run)
                if isinstance(result, str):
                    differences._failures[folder] = result
                else:
                    frames = tuple(tuple(record.frames.tolist()) for record in result.groups)
                    pools.setdefault((digest, frames), {})[folder] = result
            progress("runs", number, len(recorded))
        for members in pools.values():
            differences._add_pool(members)
        return differences

    def _count_sites(self, digest: str, recorded: Mapping[Path, Mapping[str, RankedSite]]) -> int:
        """Number of sites with this traffic; none if it is unknown."""
        if not digest:
            return 0
        return sum(len(sites) for folder, sites in recorded.items() if self._traffic[folder] == digest)

    def _add_pool(self, members: Mapping[Path, SiteReplicates]) -> None:
        """Add runs with the same groups of the same traffic; the longest of their autocorrelation times counts."""
        rows = [values for result in members.values() for values in result.values]
        groups = []
        for records in zip(*(result.groups for result in members.values()), strict=True):
            longest = max(record.autocorrelation_frames for record in records)
            groups.append(replace(records[0], autocorrelation_frames=longest))
        keys = [_SiteKey(folder, name) for folder, result in members.items() for name in result.names]
        for row, key in enumerate(keys):
            self._rows[key] = len(self._pools), row
        self._pools.append(ScoreUncertainty.of(np.array(rows), groups))

    def why_independent(self, first: Path, second: Path) -> str:
        """Return why the errors of two runs are taken as independent; empty where they are not, or nothing is compared.

        Parameters
        ----------
        first, second
            The run folders.
        """
        if first not in self._traffic or second not in self._traffic:
            return ""
        if not self._traffic[first] or self._traffic[first] != self._traffic[second]:
            return "their traffic differs"
        for folder in (first, second):
            if folder in self._failures:
                return f"{folder}: {self._failures[folder]}"
        pools = {pool for key, (pool, _) in self._rows.items() if key.folder in (first, second)}
        return "" if len(pools) == 1 else "their traffic is divided into different blocks, or their detectors differ"

    def between(self, first: SiteOfRun, second: SiteOfRun) -> ScoreDifference:
        """Return the score of the first site minus that of the second."""
        here = self._rows.get(_SiteKey(first.folder, first.site.site))
        there = self._rows.get(_SiteKey(second.folder, second.site.site))
        if here is None or there is None or here[0] != there[0]:
            return ScoreDifference.of_independent(first.site, second.site)
        uncertainty = self._pools[here[0]]
        a, b = np.array([here[1]]), np.array([there[1]])
        se = float(uncertainty.differences(a, b).se[0])
        better = float(uncertainty.beats(a, b)[0])
        return ScoreDifference(first.site.score - second.site.score, se, better, is_paired=True)


def traffic_digest(folder: Path) -> str:
    """Return the sha256 of the trajectories of a run; empty if unknown."""
    return RunRecord.read(folder).digests.get(RunFolder.trajectories.name, "")


def read_replicates(folder: Path, sites: Mapping[str, RankedSite]) -> SiteReplicates | str:
    """Return the replicates of some sites of a run, or the reason why there are none.

    Parameters
    ----------
    folder
        The run folder.
    sites
        The sites by name, with their recorded scores.
    """
    try:
        column, names = _score_again(folder, sites)
    except InputError as error:
        return str(error).rstrip(".")
    if len(names) < len(sites) or column.values.tolist() != [sites[name].score for name in names]:
        return "its scores cannot be computed again; repeat egvs run"
    if column.replicates is None or column.estimate is None:
        return "it has no standard errors"
    return SiteReplicates(names, column.replicates, column.groups)


def interval_changes(folder: Path, sites: Mapping[str, RankedSite]) -> dict[str, float] | None:
    """Return by how much scores change from the lowest to the highest reflectivity that the evidence allows.

    Parameters
    ----------
    folder
        The run folder.
    sites
        The sites by name, with their recorded scores.

    Returns
    -------
    dict or None
        Change of the score that ranks, by site; 0 without losses. None where scores cannot be computed again, or the
        scenario sets a reflectivity.
    """
    changes = dict.fromkeys(sites, 0.0)
    low, high = REFLECTIVITY_INTERVAL
    try:
        record = RunRecord.read(folder)
        config = EffectsConfig.from_dict(record.scenario.get("effects", {})).range_limit
        if config and config.reflectivity is not None:
            return None
        sensors = {site.sensor for site in sites.values()}
        if not config:
            sensors = set(record.stages["score"].summary.get("losses", {}).get("on", ()))
        affected = {name: site for name, site in sites.items() if site.sensor in sensors}
        if not affected:
            return changes
        column, names = _score_again(folder, affected, reflectivity=high)
        lowest, _ = _score_again(folder, affected, reflectivity=low)
    except InputError:
        return None
    differences = (column.values - lowest.values).tolist()
    return changes | dict(zip(names, differences, strict=True))


def _score_again(
    folder: Path, sites: Mapping[str, RankedSite], reflectivity: float | None = None
) -> tuple[ScoreColumn, tuple[str, ...]]:
    """Return the score that ranks, of the sites of a run, and their names in the order of the run.

    With the losses that road users of another ``reflectivity`` have, if one is given. InputError if the scenario folder
    does not exist, or an artefact was changed.
    """
    record = RunRecord.read(folder)
    record_path = RunFolder(folder).run_record
    source = Path(os.path.normpath(folder / record.scenario_folder))
    if not source.is_dir():
        raise InputError(record_path, f"the scenario folder {source} does not exist")
    scenario = scenario_from_dict(record.scenario, source, str(record_path))
    score = scenario.score.model_copy(update={"blindspots": False, "others": (), "keep_visibility": ()})
    scenario = scenario.model_copy(update={"score": score})
    if reflectivity is not None:
        effects = scenario.effects.model_dump()
        effects["range_limit"] = effects.get("range_limit", {}) | {"reflectivity": reflectivity}
        scenario = scenario.model_copy(update={"effects": EffectsConfig.from_dict(effects)})

    context = open_folder(scenario, folder, recorded=recorded_digests(record))
    context.digests(RunFolder.tpog.name, RunFolder.trajectories.name)  # refuses files that were changed
    scoring = SiteScoring(context)
    scored = list(scoring.all_sites(sites.keys()))
    names = tuple(site.site.name for site in scored)
    return scoring.score_table(scored).column(score.rank_by), names
