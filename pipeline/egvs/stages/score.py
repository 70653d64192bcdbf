"""The score stage: how much of the occupancy uncertainty each site covers, as ``scores.parquet``.

Steps: read ``tpog.parquet``, and the vehicles of some frames where a score needs them; take the scans site by site and
score them (:mod:`egvs.stages.site_scoring`); rank by the score that the scenario names; estimate how far each score may
be off because the traffic was short. Another gamma, voxel size, score or TPOG needs this stage alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import pyarrow as pa

from egvs.artefacts import parquet, readers
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import Tpog
from egvs.core import plugins
from egvs.core.errors import WARNINGS_KEY, Diagnostic
from egvs.core.grid import FloatArray
from egvs.core.wording import format_percent
from egvs.effects import registry
from egvs.effects.base import Effect
from egvs.formats.georeference import Georeference
from egvs.scenario.model import SCENARIO_FILE, Scenario
from egvs.scenario.score_config import DEFAULT_SCORE, NOTICED, SCORES_GROUP, SCORES_IN_UNITS, is_plugin_score
from egvs.scoring import score_table, standard_errors, zones
from egvs.scoring.score_table import ScoreTable
from egvs.scoring.target_scores import group_score
from egvs.scoring.targets import weighted_mean
from egvs.sensors.sites import Site
from egvs.stages import site_scoring
from egvs.stages.base import Stage, StageContext, StageDependencies, Summary
from egvs.stages.blocked_sites import warn_blocked_sites
from egvs.stages.scene_dependencies import scan_dependencies, sensor_digests, sensor_settings
from egvs.stages.site_scoring import NOTICED_BOUNDS, BeamAudit, ScoredSite, SiteScoring
from egvs.world import clearances, geolocation

MIN_PERIOD_LOSS = 0.01
"""The best site of a period is clearly better, where errors are unknown, by at least 1 percentage point; by scores that
are no shares, by at least 1 %."""


def dependencies(context: StageContext) -> StageDependencies:
    """Return what the scores depend on: the [score] table, the TPOG and the scans.

    Scans count by their hash; where they are not kept, by what a scan depends on.
    """
    scenario = context.scenario
    effects = context.scene.acting(Effect, "score")
    score_config = scenario.score.model_copy(update={"gamma": scenario.gamma})
    settings: dict[str, Any] = {"name": scenario.name, "score": score_config.model_dump(mode="json")}
    user_columns = _user_columns(context)
    if user_columns:
        settings["own_columns"] = {name: column.to_pylist() for name, column in user_columns.items()}
    settings |= geolocation.world_frame_settings(scenario)
    settings |= zones.file_settings(scenario.score.weights.zones, zones.weight_zones(scenario))
    settings |= zones.reported_settings(scenario)

    artefacts = [RunFolder.tpog.name]
    if scenario.score.needs_vehicles:
        artefacts.append(RunFolder.trajectories.name)
    for effect in effects:
        artefacts += effect.reads
    digests = context.digests(*artefacts)
    if scenario.score.blindspots or scenario.score.zones is not None:
        network = context.inputs.common_network_path
        if network is not None:
            digests["network"] = context.inputs.digests.of(network)
    if effects:
        settings["effects"] = registry.effect_settings(effects)
        settings["sensors"] = sensor_settings(scenario)
        digests |= sensor_digests(scenario, context.scene.sites)

    modules = registry.effect_modules(effects)
    if is_plugin_score(scenario.score.rank_by):
        modules += (plugins.plugin_module(SCORES_GROUP, scenario.score.rank_by),)
    if scenario.scan.keep:
        return StageDependencies(settings, digests | context.digests(RunFolder.scans.name), modules=modules)
    scans = scan_dependencies(context)
    settings["scan"] = scans.settings
    return StageDependencies(settings, {**digests, **scans.files}, modules=modules + scans.modules)


def run(
    context: StageContext,
    inputs: StageDependencies,
    audit: bool = False,
    scored_elsewhere: Callable[[SiteScoring], Iterable[ScoredSite]] | None = None,
) -> Summary:
    """Score and rank all sites, and write the files of :class:`egvs.artefacts.run_folder.RunFolder` of this stage.

    Parameters
    ----------
    context
        The run folder, with the artefacts of the stages before.
    inputs
        What the scores depend on.
    audit
        Check for every beam that the chords of its voxels add up to the clipped segment and that no voxel comes twice.
    scored_elsewhere
        Yields all sites in order, as :meth:`SiteScoring.score` scores them, so that other processes can share the work.

    Returns
    -------
    dict
        ``sites``, ``best`` (names), ``rank_by``, ``egvs_limit``; with ``audit`` the worst values found; warnings.
    """
    scoring = SiteScoring(context, audit=audit)  # TPOG by period, vehicles of recorded frames, scorers
    sites = scoring.all_sites() if scored_elsewhere is None else scored_elsewhere(scoring)
    sites = _write_sites(context, inputs, scoring, sites)
    scores = scoring.score_table(sites)
    metadata = _metadata(context, inputs, scoring, sites)
    _write_scores(context, scoring, sites, scores, metadata)
    _write_levels(context, scoring, scores, metadata)
    _write_zones(context, scoring, sites, metadata)
    config = context.scenario.score
    by_period = context.folder.scores_by_period
    score_table.write_scores_by_period(by_period, scores, config.rank_by, config.additional, metadata)
    return _summary(context, scoring, sites, scores, audit)


def _write_sites(
    context: StageContext,
    inputs: StageDependencies,
    scoring: SiteScoring,
    sites: Iterable[ScoredSite],
) -> list[ScoredSite]:
    """Score the sites; write their hits in voxels and their blind spots, if requested, and drop these from memory."""
    scored: list[ScoredSite] = []
    with site_scoring.write_site_outputs(scoring) as outputs:
        for site in sites:
            scored.append(outputs.write(site))
            context.progress("sites", len(scored), 0)
        outputs.describe(_metadata(context, inputs, scoring, scored))
    return scored


def _metadata(
    context: StageContext, inputs: StageDependencies, scoring: SiteScoring, sites: Sequence[ScoredSite]
) -> dict[str, Any]:
    """The metadata that all files of the stage have."""
    config = context.scenario.score
    metadata = context.metadata(
        inputs,
        gamma=context.scenario.gamma,
        rank_by=config.rank_by,
        grid=scoring.tpog.grid.to_json(),
        frames=scoring.tpog.frames,
        sites=[site.site.to_json() for site in sites],
    )
    if config.weights.are_given:
        metadata["weights"] = config.weights.model_dump(mode="json")
    return metadata


def _write_scores(
    context: StageContext,
    scoring: SiteScoring,
    sites: Sequence[ScoredSite],
    scores: ScoreTable,
    metadata: dict[str, Any],
) -> None:
    """Write ``scores.parquet``."""
    config = context.scenario.score
    egvs = scores.column("egvs")
    ranking = scores.column(config.rank_by)
    columns: dict[str, Any] = {}
    if sites:
        rows = [site.site.to_json() for site in sites]
        columns = {name: [row[name] for row in rows] for name in rows[0]}
    columns |= {
        "egvs": egvs.values,
        "egvs_limit": np.full(len(sites), scores.limits[score_table.MIX]),
        "rank": ranking.rank,
        "entropy_seen": scores.column("entropy_seen").values,
    }
    optional = _geographic_columns(sites, context.inputs.georeference)
    for name in ("egvs", *config.additional):
        column = scores.column(name)
        if name not in columns:
            optional[name] = column.values
        if egvs.estimate is not None:
            optional[f"{name}_se"] = column.se
    if scoring.targets is not None and scoring.targets.levels:
        for name in NOTICED_BOUNDS:
            optional[name] = scores.column(group_score(name, readers.ALL_USERS)).values
    if egvs.estimate is not None:
        optional["egvs_bias"] = egvs.estimate.bias
        optional["beats_next"] = ranking.beats_next
        behind_best = ranking.behind_best
        optional["behind_best_se"] = behind_best.se
        optional["best_beats"] = behind_best.best_beats
        if ranking.has_detectors:
            optional["behind_best_detectors_se"] = behind_best.detectors_se
    extra = _user_columns(context)
    if is_plugin_score(config.rank_by):  # the schema cannot name it
        names = (config.rank_by, f"{config.rank_by}_se")
        extra |= {name: pa.array(optional.pop(name)) for name in names if name in optional}
    with parquet.artefact_writer(context.folder.scores, "scores", tuple(optional), extra=extra) as file:
        file.write(columns | optional | extra)
        file.describe(metadata)


def _write_levels(context: StageContext, scoring: SiteScoring, scores: ScoreTable, metadata: dict[str, Any]) -> None:
    """Write ``levels.parquet`` if what detectors find is a score of the run; remove that of an earlier run if not."""
    if scoring.targets is None or not scoring.targets.levels:
        context.folder.levels.unlink(missing_ok=True)
        return
    levels, weight = scoring.targets.levels, scoring.targets.weight
    observations = [np.count_nonzero(members * weight) for members in levels.values()]
    weight_shares = [weighted_mean(members, weight) for members in levels.values()]
    columns: dict[str, Any] = {
        "site": np.repeat(np.array(scores.sites, dtype=object), len(levels)),
        "road_users": list(levels) * len(scores.sites),
        "observations": observations * len(scores.sites),
        "weight_share": weight_shares * len(scores.sites),
    }
    errors = []
    for name in (DEFAULT_SCORE, NOTICED, *NOTICED_BOUNDS):
        by_group = []
        for group in levels:
            is_score_of_run = group == readers.ALL_USERS and name not in NOTICED_BOUNDS
            by_group.append(scores.column(name if is_score_of_run else group_score(name, group)))
        columns[name] = np.column_stack([column.values for column in by_group]).ravel()
        if name not in NOTICED_BOUNDS and scores.groups.get(score_table.MIX):
            errors.append(f"{name}_se")
            columns[errors[-1]] = np.column_stack([column.se for column in by_group]).ravel()
    with parquet.artefact_writer(context.folder.levels, "levels", tuple(errors)) as file:
        file.write(columns)
        file.describe(metadata)


def _write_zones(
    context: StageContext, scoring: SiteScoring, sites: Sequence[ScoredSite], metadata: dict[str, Any]
) -> None:
    """Write ``zones.parquet`` if the scenario has zones; remove that of an earlier run if not."""
    if scoring.zones is None:
        context.folder.zones.unlink(missing_ok=True)
        return

    from egvs.scoring.zone_results import write_zones

    in_zones = [(site.site.name, site.zones) for site in sites if site.zones is not None]
    areas = zones.reported_settings(context.scenario)
    write_zones(context.folder.zones, scoring.zones, in_zones, metadata | areas)


def _user_columns(context: StageContext) -> dict[str, pa.Array]:
    """The user's columns of the sites file, in the order of the sites."""
    rows = [site.user_columns for site in context.scene.sites]
    if not any(rows):
        return {}

    from egvs.artefacts.extra_columns import extra_columns

    return extra_columns(rows, parquet.column_names("scores"))


def _geographic_columns(sites: Sequence[ScoredSite], georeference: Georeference) -> dict[str, Any]:
    """Longitude and latitude of the sites; nothing where they are unknown."""
    positions_m = np.array([[site.site.pose.x_m, site.site.pose.y_m] for site in sites]).reshape(-1, 2)
    lon_lat_deg = georeference.lon_lat_deg(positions_m)
    if lon_lat_deg is None:
        return {}
    return {"longitude_deg": lon_lat_deg[:, 0], "latitude_deg": lon_lat_deg[:, 1]}


def _summary(
    context: StageContext, scoring: SiteScoring, sites: Sequence[ScoredSite], scores: ScoreTable, audit: bool
) -> Summary:
    """The outcome of the stage."""
    config = context.scenario.score
    limit = scores.limits[score_table.MIX]
    ranking = scores.column(config.rank_by)
    best = []
    if np.any(ranking.values > 0):
        best = [scores.sites[i] for i in np.flatnonzero(ranking.rank == 1)]
    summary: Summary = {"sites": len(sites), "best": best, "rank_by": config.rank_by, "egvs_limit": limit}
    if config.weights.are_given:
        summary["weights"] = config.weights.in_words
    if config.gamma == "auto":
        summary["gamma_auto"] = context.scenario.gamma
    if config.blindspots:
        for blindspots in readers.read_blindspots(context.folder.blindspots, best[:1]):
            summary["missed"] = blindspots.in_words()
    if scoring.zones is not None and best:
        worst = readers.worst_zones(readers.read_zones(context.folder.zones, best[0]))
        if worst:
            summary["zones"] = readers.describe_worst_zones(best[0], worst)
    if scoring.zones is not None and (without_results := scoring.zones.describe_for_pedestrians()):
        summary["zones_for_pedestrians"] = without_results
    losses = context.scene.losses
    if losses is not None and losses.acting:
        summary["losses"] = losses.to_json()
    skipped = context.scene.skipped("score")
    if skipped:
        summary["skipped"] = skipped
    if ranking.estimate is not None:
        summary |= standard_errors.summarise_uncertainty(ranking.estimate, scores.periods or (score_table.MIX,))
    if audit:
        summary["audit"] = asdict(BeamAudit.worst([site.audit for site in sites if site.audit is not None]))
    warnings = list(_warnings(context, scoring, sites, scores))
    if not context.scenario.scan.keep:  # the scan stage has not seen these beams
        warnings += warn_blocked_sites({site.site.name: site.near_share for site in sites})
    if warnings:
        summary[WARNINGS_KEY] = [warning.to_json() for warning in warnings]
    return summary


def warn_period_disagreements(scores: ScoreTable, rank_by: str) -> Iterator[Diagnostic]:
    """Warn about each period in which another site is clearly better than the best of the mix.

    Parameters
    ----------
    scores
        Scores of all sites.
    rank_by
        Name of the score that ranks.
    """
    best = scores.column(rank_by).best
    is_share = rank_by not in SCORES_IN_UNITS
    for period, column in scores.by_period(rank_by).items():
        if not best or not column.best or best & column.best or not column.values.max() > 0:
            continue
        mix_best, period_best = min(best), min(column.best)
        loss = (column.values.max() - column.values[mix_best]) / (1.0 if is_share else column.values.max())
        is_clear = loss >= MIN_PERIOD_LOSS
        if column.estimate is not None:
            (chance,) = column.estimate.beats(np.array([period_best]), np.array([mix_best]))
            is_clear = chance >= readers.DISTINCT_PROBABILITY
        if not is_clear:
            continue

        less = f"{100 * loss:.1f} percentage points" if is_share else format_percent(loss)
        problem = (
            f"the best site is {scores.sites[period_best]}; {scores.sites[mix_best]}, the best of the mix, "
            f"has rank {column.rank[mix_best]} and scores {less} less"
        )
        hint = "Decide which period matters most; the best site of the mix need not be the best in any period."
        yield Diagnostic("periods disagree", f"{SCENARIO_FILE}: traffic.periods ({period})", problem, hint)


def _returned_shares(sites: Sequence[ScoredSite]) -> FloatArray:
    """Share of the beams of each site towards the region that meet something; 0 without beams."""
    return np.array([scored.site.returns / max(1, scored.site.beams_in_roi) for scored in sites])


def _warnings(
    context: StageContext, scoring: SiteScoring, sites: Sequence[ScoredSite], scores: ScoreTable
) -> Iterator[Diagnostic]:
    """Warnings about the scores, those about the ranking first."""
    scenario = context.scenario
    rank_by = scenario.score.rank_by
    ranking = scores.column(rank_by)
    others = [scores.column(name) for name in ("egvs", *scenario.score.additional) if name != rank_by]
    yield from score_table.warn_all_zero(ranking, scenario.gamma, scores.limits[score_table.MIX])
    yield from score_table.warn_blind_sites(ranking, scores.sites, _returned_shares(sites))
    if ranking.estimate is not None:
        yield from _warn_short_traffic(scenario, ranking.estimate, scores.periods or (score_table.MIX,))
    yield from warn_period_disagreements(scores, rank_by)
    if scoring.targets is not None:
        yield from scoring.targets.warn_undefined_scores(scoring.tpog, scoring.periods)
    if scoring.zones is not None:
        yield from scoring.zones.warn_empty()
        yield from zones.warn_partly_outside(scenario)
    for column in (ranking, *others):
        yield from score_table.warn_no_standard_error(column)
    if np.any(ranking.values > 0):
        for column in others:
            yield from score_table.warn_additional_all_zero(column)
    if scenario.is_recorded:  # without a network, only the recorded vehicles show where the road is
        yield from _warn_sites_in_traffic(context.scene.sites, scoring.tpog)


def _warn_short_traffic(
    scenario: Scenario, estimate: standard_errors.ScoreUncertainty, records: Sequence[str]
) -> list[Diagnostic]:
    """Warn about each record that is too short for reliable standard errors."""
    traffic = scenario.traffic
    length_keys = {}
    for period in traffic.periods:
        if period.length_s is not None:
            length_keys[period.name] = f"{SCENARIO_FILE}: traffic.periods ({period.name}).length_s"
    key = f"{SCENARIO_FILE}: traffic.frames"
    return standard_errors.uncertainty_warnings(estimate, key, traffic.frame_period_s, records, length_keys)


def _warn_sites_in_traffic(sites: Iterable[Site], tpog: Tpog) -> Iterator[Diagnostic]:
    """Warn about each site that is, no higher than the clearance, where vehicles drive in some frame."""
    grid = tpog.grid
    for site in sites:
        at_m = np.array(site.pose.position_m)
        ix, iy, _ = np.floor((at_m - grid.origin_m) / grid.voxel_m).astype(np.int64)
        if not (0 <= ix < grid.shape[0] and 0 <= iy < grid.shape[1]):
            continue
        column = tpog.counts[ix, iy]
        layers = np.flatnonzero(column)
        if not len(layers):
            continue
        height_m = at_m[2] - (grid.origin_m[2] + layers[0] * grid.voxel_m)
        if height_m <= clearances.CLEARANCE_M:
            share = column.max() / tpog.frames
            yield Diagnostic(
                "sites on the road",
                f"site {site.name}",
                f"vehicles drive through its position ({at_m[0]:g}, {at_m[1]:g}) in {format_percent(share)} "
                "of the frames",
                f"Move it beside the road, or more than {clearances.CLEARANCE_M:g} m above it.",
            )


STAGE = Stage(
    "score",
    __name__,
    dependencies,
    run,
    reads=(RunFolder.tpog, RunFolder.trajectories, RunFolder.scans, RunFolder.statics),
    effect_stages=("scan", "score"),
    code=("egvs.stages.scene_inputs",),
    neutral_options=("scored_elsewhere",),
    prepare=(site_scoring.prepare_targets, site_scoring.prepare_voxels),
)
