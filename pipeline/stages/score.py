"""The score stage: which site sees most of what is uncertain, as ``scores.parquet``.

Steps: read ``tpog.parquet``; take the scans site by site (:mod:`pipeline.stages.shared.scans`); score each
(:mod:`pipeline.scoring.scorer`); rank; say how far each score may be off because the traffic was short. Another gamma,
voxel size or TPOG needs this stage alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.artefacts import schemas, tables
from pipeline.artefacts.foreign_columns import foreign_columns
from pipeline.artefacts.period_ranking import PERIOD_SCORES
from pipeline.artefacts.readers import read_tpog
from pipeline.checks import recorded
from pipeline.core.findings import WARNINGS
from pipeline.core.grid import Grid
from pipeline.core.parallel import in_order
from pipeline.effects import registry
from pipeline.effects.base import Effect
from pipeline.formats.georeference import Georeference
from pipeline.kernels import march
from pipeline.scenario.models import FILE
from pipeline.scoring import uncertainty
from pipeline.scoring.leave_out import LeaveOut
from pipeline.scoring.scorer import Scorer, SiteScore, ranks
from pipeline.scoring.visibility import Beams, in_voxels
from pipeline.sensing.sites import ScannedSite
from pipeline.stages.base import StageInputs, Summary, Workspace
from pipeline.stages.shared import period_scores
from pipeline.stages.shared.scans import SiteBeams, scans
from pipeline.stages.shared.scene import SCANS, scan_inputs, scene_of, sensor_digests, sensor_settings
from pipeline.world import world_frame

NAME = "score"
ARTEFACTS = ("scores.parquet", "visibility.parquet", PERIOD_SCORES)
TRAJECTORIES = "trajectories.parquet"


@dataclass(frozen=True)
class ScoredSite:
    """A site, its score, and what else was asked for: an audit of its beams, its hits in the voxels that it sees."""

    site: ScannedSite
    score: SiteScore
    audit: BeamAudit | None
    visible: dict[str, NDArray[Any]] | None


@dataclass(frozen=True)
class BeamAudit:
    """The worst of some beams, see :func:`pipeline.kernels.march.audit`."""

    worst_sum: float
    longest_gap_m: float
    misplaced_chords: int
    voxels_visited_twice: int


def inputs(work: Workspace) -> StageInputs:
    """Gamma and what to keep; TPOG and scans by hash (without kept scans: what a scan depends on)."""
    scenario, live = work.scenario, scene_of(work).acting(Effect, "score")
    settings: dict[str, Any] = {"name": scenario.name, "score": scenario.score.model_dump(mode="json")}
    if own := _own_columns(work):
        settings["own_columns"] = {name: column.to_pylist() for name, column in own.items()}
    settings |= world_frame.key(scenario)
    if live:
        settings["effects"] = registry.settings(live)
        settings["sensors"] = sensor_settings(scenario)
    hashes = work.digests("tpog.parquet", *(name for effect in live for name in effect.reads))
    if live:
        hashes |= sensor_digests(scenario, scene_of(work).sites)
    modules = registry.modules(live)
    if scenario.scan.keep:
        return StageInputs(settings, hashes | work.digests(SCANS), modules=modules)
    cast = scan_inputs(work)
    read = {**hashes, **cast.files}
    return StageInputs({**settings, "scan": cast.settings}, read, modules=modules + cast.modules)


def run(
    work: Workspace, inputs: StageInputs, audit: bool = False, observe: Callable[[ScoredSite], None] | None = None
) -> Summary:
    """Score and rank all sites; write ``scores.parquet``, ``visibility.parquet`` where sites are to be kept, and
    ``scores_by_period.parquet`` where the traffic has periods.

    Parameters
    ----------
    audit
        Check for every beam that the chords of its voxels add up to the clipped segment and that no voxel comes twice.
    observe
        Called with each site as it is scored, in order.

    Returns
    -------
    dict
        ``sites``, ``best`` (names), ``egvs_limit``; with ``audit`` the worst case found.
    """
    tpog, wanted = read_tpog(work.path("tpog.parquet")), work.scenario.score
    leave_out = LeaveOut.of(work.path("tpog.parquet"), tpog) if wanted.standard_error else None
    periods = period_scores.period_tpogs(work.path("tpog.parquet"), standard_errors=wanted.standard_error)
    scorer = Scorer(scene_of(work), tpog, work.path(TRAJECTORIES), leave_out, periods)

    def score(scan: SiteBeams) -> ScoredSite:
        checked = audit_beams(scan.beams, tpog.grid) if audit else None
        if wanted.keep_visibility == "all" or scan.site.name in wanted.keep_visibility:
            worth, hits = scorer.score_and_hits(scan.beams)
            return ScoredSite(scan.site, worth, checked, _sparse(hits))
        return ScoredSite(scan.site, scorer.score(scan.beams), checked, None)

    done: list[ScoredSite] = []
    for scored in in_order(score, scans(work), work.threads):
        done.append(scored)
        work.progress("sites", len(done), 0)
        if observe is not None:
            observe(scored)
    sites = [d.site.to_json() for d in done]
    about = work.metadata(inputs, gamma=wanted.gamma, grid=tpog.grid.to_json(), frames=tpog.frames, sites=sites)
    _write_visibility(work, done, about)
    estimate = _estimate(done, leave_out)
    more, own = _degrees(done, world_frame.of(work.scenario)) | _error_columns(estimate), _own_columns(work)
    columns = _columns(done, scorer.limit) | more
    with tables.writer(work.path(ARTEFACTS[0]), "scores", tuple(more), foreign=own) as file:
        file.write(columns | own)
        file.describe(about)
    names, worths = [d.site.name for d in done], [d.score for d in done]
    period_scores.write(work.path(ARTEFACTS[2]), names, worths, periods, scorer.limits_by_period, about)
    best = [d.site.name for d, rank in zip(done, columns["rank"], strict=True) if rank == 1]
    summary: Summary = {"sites": len(done), "best": best, "egvs_limit": scorer.limit}
    if skipped := scene_of(work).skipped(NAME):
        summary["skipped"] = skipped
    doubts = period_scores.disagreements(names, worths, periods)
    if estimate is not None:
        records = [period.name for period in periods] or [""]
        summary |= uncertainty.in_words(estimate, records)
        traffic = work.scenario.traffic
        place, period_s = f"{FILE}: traffic.frames", traffic.frame_period_s
        own = {
            p.name: f"{FILE}: traffic.periods ({p.name}).length_s" for p in traffic.periods if p.length_s is not None
        }
        doubts = uncertainty.doubts(estimate, place, period_s, records, own) + doubts
    if audit:
        summary["audit"] = _worst([d.audit for d in done if d.audit is not None])
    if work.scenario.is_recorded:  # without a network, the record alone knows the road
        doubts += recorded.on_the_road(scene_of(work).sites, tpog)
    if doubts:
        summary[WARNINGS] = [doubt.to_json() for doubt in doubts]
    return summary


def _sparse(hits: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """The voxels that are crossed, in order."""
    ix, iy, iz = np.nonzero(hits)
    index = {"ix": ix.astype(np.int32), "iy": iy.astype(np.int32), "iz": iz.astype(np.int32)}
    return {**index, "hits": hits[ix, iy, iz]}


def audit_beams(beams: Beams, grid: Grid) -> BeamAudit:
    """Check each beam of a site, see :func:`pipeline.kernels.march.audit`."""
    o, d, shape = in_voxels(beams, grid)
    return BeamAudit(*march.audit(o, d, shape, grid.voxel_m, np.zeros(int(np.prod(grid.shape)), dtype=np.uint32)))


def _columns(done: list[ScoredSite], limit: float) -> dict[str, Any]:
    scores, sites = np.array([d.score.egvs for d in done]), [d.site.to_json() for d in done]
    columns: dict[str, Any] = {name: [site[name] for site in sites] for name in sites[0]} if sites else {}
    return columns | {
        "egvs": scores,
        "egvs_limit": np.full(len(done), limit),
        "rank": ranks(scores),
        "entropy_seen": np.array([d.score.entropy_seen for d in done]),
    }


def _own_columns(work: Workspace) -> dict[str, pa.Array]:
    """The columns of the user's own that the sites have, in the order of the sites."""
    return foreign_columns([site.own for site in scene_of(work).sites], schemas.names("scores"))


def _degrees(done: list[ScoredSite], world: Georeference) -> dict[str, Any]:
    """Where the sites are on the Earth; nothing where that is not known."""
    places = [[d.site.pose.x_m, d.site.pose.y_m] for d in done]
    lon_lat_deg = world.lon_lat_deg(np.array(places).reshape(-1, 2))
    return {} if lon_lat_deg is None else {"longitude_deg": lon_lat_deg[:, 0], "latitude_deg": lon_lat_deg[:, 1]}


def _estimate(done: list[ScoredSite], leave_out: LeaveOut | None) -> uncertainty.Estimate | None:
    """What leaving blocks out says of all sites; None when it is not asked for, or there is one block only."""
    if leave_out is None:
        return None
    return uncertainty.Estimate.of(np.array([d.score.left_out for d in done]).reshape(len(done), -1), leave_out.groups)


def _error_columns(estimate: uncertainty.Estimate | None) -> dict[str, Any]:
    """The columns of ``scores.parquet`` that say how far a score may be off."""
    if estimate is None:
        return {}
    return {"egvs_se": estimate.se, "egvs_bias": estimate.bias, "beats_next": uncertainty.beats_next(estimate)}


def _worst(audits: list[BeamAudit]) -> dict[str, float]:
    """The worst case over all sites."""
    return {
        "worst_sum": max(audit.worst_sum for audit in audits),
        "longest_gap_m": max(audit.longest_gap_m for audit in audits),
        "misplaced_chords": sum(audit.misplaced_chords for audit in audits),
        "voxels_visited_twice": sum(audit.voxels_visited_twice for audit in audits),
    }


def _write_visibility(work: Workspace, done: list[ScoredSite], about: dict[str, Any]) -> None:
    path = work.path(ARTEFACTS[1])
    kept = [(scored.site.name, scored.visible) for scored in done if scored.visible is not None]
    if not kept:
        path.unlink(missing_ok=True)
        return
    with tables.writer(path, "visibility") as file:
        for site, columns in kept:
            file.write({"site": [site] * len(columns["hits"]), **columns})
        file.describe(about)
