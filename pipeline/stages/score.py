"""The score stage: which site sees most of what is uncertain, as ``scores.parquet``.

Steps: read ``tpog.parquet``, and the vehicles of some frames where a score asks for them; take the scans site by site
(:mod:`pipeline.stages.shared.scans`); score each (:mod:`pipeline.scoring.scorer`,
:mod:`pipeline.stages.shared.target_scores`); rank by the score that the scenario names; say how far each score may be
off because the traffic was short. Another gamma, voxel size, score or TPOG needs this stage alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pyarrow as pa

from pipeline.artefacts import blindspots, schemas, tables
from pipeline.artefacts.blindspots import BLINDSPOTS
from pipeline.artefacts.foreign_columns import foreign_columns
from pipeline.artefacts.period_ranking import PERIOD_SCORES
from pipeline.artefacts.readers import Tpog
from pipeline.checks import recorded
from pipeline.core.findings import WARNINGS, Finding
from pipeline.effects import registry
from pipeline.effects.base import Effect
from pipeline.formats.georeference import Georeference
from pipeline.scenario.models import FILE, Scenario
from pipeline.scoring import uncertainty
from pipeline.scoring.leave_out import LeaveOut
from pipeline.stages.base import StageInputs, Summary, Workspace
from pipeline.stages.shared import period_scores, site_details
from pipeline.stages.shared.blindspots import network_digests
from pipeline.stages.shared.judged import Judged
from pipeline.stages.shared.scene import SCANS, scan_inputs, scene_of, sensor_digests, sensor_settings
from pipeline.stages.shared.site_scoring import BeamAudit, ScoredSite, SiteScoring, asks_targets
from pipeline.stages.shared.target_scores import TPOG, TRAJECTORIES
from pipeline.world import world_frame

NAME = "score"
ARTEFACTS = ("scores.parquet", site_details.VISIBILITY, PERIOD_SCORES, BLINDSPOTS)


def inputs(work: Workspace) -> StageInputs:
    """Gamma and what to keep; TPOG and scans by hash (without kept scans: what a scan depends on)."""
    scenario, live = work.scenario, scene_of(work).acting(Effect, "score")
    as_number = scenario.score.model_copy(update={"gamma": scenario.gamma})
    settings: dict[str, Any] = {"name": scenario.name, "score": as_number.model_dump(mode="json")}
    if own := _own_columns(work):
        settings["own_columns"] = {name: column.to_pylist() for name, column in own.items()}
    settings |= world_frame.key(scenario)
    if live:
        settings["effects"] = registry.settings(live)
        settings["sensors"] = sensor_settings(scenario)
    hashes = work.digests(TPOG, *(name for effect in live for name in effect.reads))
    if asks_targets(work.scenario):
        hashes |= work.digests(TRAJECTORIES)
    if scenario.score.blindspots:
        hashes |= network_digests(scenario)
    if live:
        hashes |= sensor_digests(scenario, scene_of(work).sites)
    modules = registry.modules(live)
    if scenario.scan.keep:
        return StageInputs(settings, hashes | work.digests(SCANS), modules=modules)
    cast = scan_inputs(work)
    read = {**hashes, **cast.files}
    return StageInputs({**settings, "scan": cast.settings}, read, modules=modules + cast.modules)


def run(
    work: Workspace,
    inputs: StageInputs,
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
    with site_details.writing(work, targets, len(scoring.names)) as details:
        for its in scored:
            if observe is not None:
                observe(its)
            done.append(details.take(its))
            work.progress("sites", len(done), 0)
        about = _about(work, inputs, tpog, done)
        details.describe(about)
    judged = {name: _judged(name, done, leave_out) for name in ("egvs", *wanted.asked)}
    ranking, others = judged[wanted.rank_by], [judged[name] for name in wanted.asked]
    _write_scores(work, done, judged, scorer.limit, about)
    names, worths = [d.site.name for d in done], [d.score for d in done]
    apart = [other for other in others if other.name != "entropy_seen"]
    limits = scorer.limits_by_period
    period_scores.write(work.path(ARTEFACTS[2]), names, worths, ranking, apart, periods, limits, about)
    nothing = ranking.nothing(work.scenario.gamma, scorer.limit)
    best = [] if nothing else [name for name, rank in zip(names, ranking.rank, strict=True) if rank == 1]
    summary: Summary = {"sites": len(done), "best": best, "rank_by": wanted.rank_by, "egvs_limit": scorer.limit}
    if wanted.weights.are_given:
        summary["weights"] = wanted.weights.in_words
    if wanted.gamma == "auto":
        summary["gamma_auto"] = work.scenario.gamma
    if wanted.blindspots and (found := next(blindspots.read(work.path(BLINDSPOTS), best[:1]), None)):
        summary["missed"] = found.in_words()
    if skipped := scene_of(work).skipped(NAME):
        summary["skipped"] = skipped
    doubts = period_scores.disagreements(names, ranking, periods)
    doubts += targets.doubts(tpog, [period.tpog for period in periods]) if targets is not None else []
    doubts += [doubt for its in judged.values() for doubt in its.doubts()]
    if not nothing:
        doubts += [doubt for its in judged.values() if its is not ranking for doubt in its.idle()]
    if ranking.estimate is not None:
        records = [period.name for period in periods] or [""]
        summary |= uncertainty.in_words(ranking.estimate, records)
        doubts = _doubts_of_errors(work.scenario, ranking.estimate, records) + doubts
    if audit:
        summary["audit"] = _worst([d.audit for d in done if d.audit is not None])
    if work.scenario.is_recorded:  # without a network, the record alone knows the road
        doubts += recorded.on_the_road(scene_of(work).sites, tpog)
    if doubts := nothing + doubts:
        summary[WARNINGS] = [doubt.to_json() for doubt in doubts]
    return summary


def _about(work: Workspace, inputs: StageInputs, tpog: Tpog, done: list[ScoredSite]) -> dict[str, Any]:
    """The metadata that all files of the stage have."""
    wanted, sites = work.scenario.score, [d.site.to_json() for d in done]
    grid, gamma = tpog.grid.to_json(), work.scenario.gamma
    about = work.metadata(inputs, gamma=gamma, rank_by=wanted.rank_by, grid=grid, frames=tpog.frames, sites=sites)
    return about | ({"weights": wanted.weights.model_dump(mode="json")} if wanted.weights.are_given else {})


def _judged(name: str, done: list[ScoredSite], leave_out: LeaveOut | None) -> Judged:
    return Judged.of(name, [(d.score, d.targets) for d in done], None if leave_out is None else leave_out.groups)


def _doubts_of_errors(scenario: Scenario, estimate: uncertainty.Estimate, records: list[str]) -> list[Finding]:
    traffic = scenario.traffic
    own = {p.name: f"{FILE}: traffic.periods ({p.name}).length_s" for p in traffic.periods if p.length_s is not None}
    return uncertainty.doubts(estimate, f"{FILE}: traffic.frames", traffic.frame_period_s, records, own)


def _write_scores(
    work: Workspace, done: list[ScoredSite], judged: dict[str, Judged], limit: float, about: dict[str, Any]
) -> None:
    """Write ``scores.parquet``."""
    ranking, sites = judged[work.scenario.score.rank_by], [d.site.to_json() for d in done]
    columns: dict[str, Any] = {name: [site[name] for site in sites] for name in sites[0]} if sites else {}
    columns |= {
        "egvs": judged["egvs"].values,
        "egvs_limit": np.full(len(done), limit),
        "rank": ranking.rank,
        "entropy_seen": np.array([d.score.entropy_seen for d in done]),
    }
    more = _degrees(done, world_frame.of(work.scenario))
    more |= {name: its.values for name, its in judged.items() if name not in columns}
    if judged["egvs"].estimate is not None:
        more |= {f"{name}_se": its.se for name, its in judged.items()}
        more |= {"egvs_bias": judged["egvs"].estimate.bias, "beats_next": ranking.beats_next}
    own = _own_columns(work)
    with tables.writer(work.path(ARTEFACTS[0]), "scores", tuple(more), foreign=own) as file:
        file.write(columns | more | own)
        file.describe(about)


def _own_columns(work: Workspace) -> dict[str, pa.Array]:
    """The columns of the user's own that the sites have, in the order of the sites."""
    return foreign_columns([site.own for site in scene_of(work).sites], schemas.names("scores"))


def _degrees(done: list[ScoredSite], world: Georeference) -> dict[str, Any]:
    """Where the sites are on the Earth; nothing where that is not known."""
    places = [[d.site.pose.x_m, d.site.pose.y_m] for d in done]
    lon_lat_deg = world.lon_lat_deg(np.array(places).reshape(-1, 2))
    return {} if lon_lat_deg is None else {"longitude_deg": lon_lat_deg[:, 0], "latitude_deg": lon_lat_deg[:, 1]}


def _worst(audits: list[BeamAudit]) -> dict[str, float]:
    """The worst case over all sites."""
    return {
        "worst_sum": max(audit.worst_sum for audit in audits),
        "longest_gap_m": max(audit.longest_gap_m for audit in audits),
        "misplaced_chords": sum(audit.misplaced_chords for audit in audits),
        "voxels_visited_twice": sum(audit.voxels_visited_twice for audit in audits),
    }
