"""The score stage: which site sees most of what is uncertain, as ``scores.parquet``.

Steps: read ``tpog.parquet``, and the vehicles of some frames where a score asks for them; take the scans site by site
(:mod:`egvs.stages.site_scoring`); score each (:mod:`egvs.scoring.scorer`,
:mod:`egvs.stages.site_scoring`); rank by the score that the scenario names; say how far each score may be
off because the traffic was short. Another gamma, voxel size, score or TPOG needs this stage alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pyarrow as pa

from egvs.artefacts import parquet, readers
from egvs.artefacts.parquet import extra_columns
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import Tpog
from egvs.core.errors import WARNINGS_KEY, Diagnostic
from egvs.effects import registry
from egvs.effects.base import Effect
from egvs.formats.georeference import Georeference
from egvs.scenario.model import SCENARIO_FILE, Scenario
from egvs.scoring import occupancy, score_table, standard_errors
from egvs.scoring.score_table import ScoreColumn
from egvs.scoring.standard_errors import BlockJackknife
from egvs.stages import site_scoring
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary
from egvs.stages.scene_inputs import scan_dependencies, sensor_digests, sensor_settings
from egvs.stages.site_scoring import BeamAudit, ScoredSite, SiteScoring, needs_targets
from egvs.world import geolocation


def dependencies(work: StageContext) -> StageDependencies:
    """Gamma and what to keep; TPOG and scans by hash (without kept scans: what a scan depends on)."""
    scenario, live = work.scenario, work.scene.acting(Effect, "score")
    as_number = scenario.score.model_copy(update={"gamma": scenario.gamma})
    settings: dict[str, Any] = {"name": scenario.name, "score": as_number.model_dump(mode="json")}
    if own := _user_columns(work):
        settings["own_columns"] = {name: column.to_pylist() for name, column in own.items()}
    settings |= geolocation.world_frame_settings(scenario)
    if live:
        settings["effects"] = registry.effect_settings(live)
        settings["sensors"] = sensor_settings(scenario)
    hashes = work.digests(RunFolder.tpog.name, *(name for effect in live for name in effect.reads))
    if needs_targets(work.scenario):
        hashes |= work.digests(RunFolder.trajectories.name)
    if scenario.score.blindspots and (path := work.inputs.common_network_path) is not None:
        hashes["network"] = work.inputs.digest(path)
    if live:
        hashes |= sensor_digests(scenario, work.scene.sites)
    modules = registry.effect_modules(live)
    if scenario.scan.keep:
        return StageDependencies(settings, hashes | work.digests(RunFolder.scans.name), modules=modules)
    cast = scan_dependencies(work)
    read = {**hashes, **cast.files}
    return StageDependencies({**settings, "scan": cast.settings}, read, modules=modules + cast.modules)


def run(
    work: StageContext,
    inputs: StageDependencies,
    audit: bool = False,
    observe: Callable[[ScoredSite], None] | None = None,
    scored_elsewhere: Callable[[SiteScoring], Iterable[ScoredSite]] | None = None,
) -> Summary:
    """Score and rank all sites; write ``scores.parquet``, ``visibility.parquet`` where sites are to be kept,
    ``scores_by_period.parquet`` where the traffic has periods, and ``blindspots.parquet`` unless it is not wanted.

    Parameters
    ----------
    audit
        Check for every beam that the chords of its voxels add up to the clipped segment and that no voxel comes twice.
    observe
        Called with each site as it is scored, in order.
    scored_elsewhere
        Gives all sites in order, as :meth:`SiteScoring.score` scores them: other processes may share that work.

    Returns
    -------
    dict
        ``sites``, ``best`` (names), ``egvs_limit``; with ``audit`` the worst case found.
    """
    wanted, scoring = work.scenario.score, SiteScoring(work, audit=audit)
    tpog, scorer, targets, leave_out, periods = (
        scoring.tpog, scoring.scorer, scoring.targets, scoring.leave_out, scoring.periods,
    )  # fmt: skip
    scored = scored_elsewhere(scoring) if scored_elsewhere is not None else scoring.all_sites()
    done: list[ScoredSite] = []
    with site_scoring.write_site_outputs(work, targets, len(scoring.names)) as details:
        for its in scored:
            if observe is not None:
                observe(its)
            done.append(details.take(its))
            work.progress("sites", len(done), 0)
        about = _metadata(work, inputs, tpog, done)
        details.describe(about)
    judged = {name: _score_column(name, done, leave_out) for name in ("egvs", *wanted.additional)}
    ranking, others = judged[wanted.rank_by], [judged[name] for name in wanted.additional]
    _write_scores(work, done, judged, scorer.limit, about)
    names, worths = [d.site.name for d in done], [d.score for d in done]
    apart = [other for other in others if other.name != "entropy_seen"]
    limits = scorer.limits_by_period
    score_table.write_scores_by_period(
        work.folder.scores_by_period, names, worths, ranking, apart, periods, limits, about
    )
    nothing = ranking.all_zero_warnings(work.scenario.gamma, scorer.limit)
    best = [] if nothing else [name for name, rank in zip(names, ranking.rank, strict=True) if rank == 1]
    summary: Summary = {"sites": len(done), "best": best, "rank_by": wanted.rank_by, "egvs_limit": scorer.limit}
    if wanted.weights.are_given:
        summary["weights"] = wanted.weights.in_words
    if wanted.gamma == "auto":
        summary["gamma_auto"] = work.scenario.gamma
    if wanted.blindspots and (found := next(readers.read_blindspots(work.folder.blindspots, best[:1]), None)):
        summary["missed"] = found.in_words()
    if skipped := work.scene.skipped("score"):
        summary["skipped"] = skipped
    doubts = score_table.period_disagreements(names, ranking, periods)
    doubts += targets.undefined_score_warnings(tpog, [period.tpog for period in periods]) if targets is not None else []
    doubts += [doubt for its in judged.values() for doubt in its.standard_error_warnings()]
    if not nothing:
        doubts += [doubt for its in judged.values() if its is not ranking for doubt in its.unranked_zero_warnings()]
    if ranking.estimate is not None:
        records = [period.name for period in periods] or [""]
        summary |= standard_errors.summarise_uncertainty(ranking.estimate, records)
        doubts = _standard_error_warnings(work.scenario, ranking.estimate, records) + doubts
    if audit:
        summary["audit"] = _worst_audit([d.audit for d in done if d.audit is not None])
    if work.scenario.is_recorded:  # without a network, the record alone knows the road
        doubts += occupancy.warn_sites_in_traffic(work.scene.sites, tpog)
    if doubts := nothing + doubts:
        summary[WARNINGS_KEY] = [doubt.to_json() for doubt in doubts]
    return summary


def _metadata(work: StageContext, inputs: StageDependencies, tpog: Tpog, done: list[ScoredSite]) -> dict[str, Any]:
    """The metadata that all files of the stage have."""
    wanted, sites = work.scenario.score, [d.site.to_json() for d in done]
    grid, gamma = tpog.grid.to_json(), work.scenario.gamma
    about = work.metadata(inputs, gamma=gamma, rank_by=wanted.rank_by, grid=grid, frames=tpog.frames, sites=sites)
    return about | ({"weights": wanted.weights.model_dump(mode="json")} if wanted.weights.are_given else {})


def _score_column(name: str, done: list[ScoredSite], leave_out: BlockJackknife | None) -> ScoreColumn:
    return ScoreColumn.of(name, [(d.score, d.targets) for d in done], None if leave_out is None else leave_out.groups)


def _standard_error_warnings(
    scenario: Scenario, estimate: standard_errors.ScoreUncertainty, records: list[str]
) -> list[Diagnostic]:
    traffic = scenario.traffic
    own = {
        p.name: f"{SCENARIO_FILE}: traffic.periods ({p.name}).length_s"
        for p in traffic.periods
        if p.length_s is not None
    }
    return standard_errors.uncertainty_warnings(
        estimate, f"{SCENARIO_FILE}: traffic.frames", traffic.frame_period_s, records, own
    )


def _write_scores(
    work: StageContext,
    done: list[ScoredSite],
    score_columns: dict[str, ScoreColumn],
    limit: float,
    metadata: dict[str, Any],
) -> None:
    """Write ``scores.parquet``."""
    ranking, sites = score_columns[work.scenario.score.rank_by], [d.site.to_json() for d in done]
    columns: dict[str, Any] = {name: [site[name] for site in sites] for name in sites[0]} if sites else {}
    columns |= {
        "egvs": score_columns["egvs"].values,
        "egvs_limit": np.full(len(done), limit),
        "rank": ranking.rank,
        "entropy_seen": np.array([d.score.entropy_seen for d in done]),
    }
    more = _geographic_columns(done, work.inputs.georeference)
    more |= {name: its.values for name, its in score_columns.items() if name not in columns}
    if score_columns["egvs"].estimate is not None:
        more |= {f"{name}_se": its.se for name, its in score_columns.items()}
        more |= {"egvs_bias": score_columns["egvs"].estimate.bias, "beats_next": ranking.beats_next}
    own = _user_columns(work)
    with parquet.artefact_writer(work.folder.scores, "scores", tuple(more), extra=own) as file:
        file.write(columns | more | own)
        file.describe(metadata)


def _user_columns(work: StageContext) -> dict[str, pa.Array]:
    """The columns of the user's own that the sites have, in the order of the sites."""
    return extra_columns([site.user_columns for site in work.scene.sites], parquet.column_names("scores"))


def _geographic_columns(done: list[ScoredSite], world: Georeference) -> dict[str, Any]:
    """Where the sites are on the Earth; nothing where that is not known."""
    places = [[d.site.pose.x_m, d.site.pose.y_m] for d in done]
    lon_lat_deg = world.lon_lat_deg(np.array(places).reshape(-1, 2))
    return {} if lon_lat_deg is None else {"longitude_deg": lon_lat_deg[:, 0], "latitude_deg": lon_lat_deg[:, 1]}


def _worst_audit(audits: list[BeamAudit]) -> dict[str, float]:
    """The worst case over all sites."""
    return {
        "worst_sum": max(audit.worst_sum for audit in audits),
        "longest_gap_m": max(audit.longest_gap_m for audit in audits),
        "misplaced_chords": sum(audit.misplaced_chords for audit in audits),
        "voxels_visited_twice": sum(audit.voxels_visited_twice for audit in audits),
    }


STAGE = Stage(
    "score",
    __name__,
    dependencies,
    run,
    reads=(RunFolder.tpog, RunFolder.trajectories, RunFolder.scans, RunFolder.statics),
    effect_stages=("scan", "score"),
)
