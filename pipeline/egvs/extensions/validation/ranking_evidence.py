"""Compares the ranking of a scenario with detection: the numbers of :mod:`egvs.extensions.validation.ranking_check`.

Steps: compute the ranking as the run does, with its periods and weights; correlate the score that ranks with each
detector's main measure, over all sites and among sites of equal mounting height; find the site that detects best, and
what the first site in the ranking loses against it, on the same frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from egvs.artefacts.readers import read_scores
from egvs.core.grid import BoolArray
from egvs.extensions.validation import detection_metrics, ranking_check
from egvs.extensions.validation.correlation import MIN_POLES, CorrelationStudy, JunctionScores, MeasureValues
from egvs.extensions.validation.detection_metrics import ALL_OBJECTS, BLOCKS, SiteDetection
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME
from egvs.extensions.validation.ranking_check import DetectorCheck, RankCorrelation, RankingCheck, none_if_nan
from egvs.extensions.validation.results import MEASURE_NOUNS, main_measure
from egvs.runs import run as runs
from egvs.scenario.model import Scenario
from egvs.sensors import site_feasibility
from egvs.sensors.scene import Scene
from egvs.stages.base import StageContext

HEIGHT_STEP_M = 0.5
"""Mounting heights above the ground are equal if they round to the same multiple of this."""

_RANKING = "ranking"
"""Name of the score that ranks, in the correlation."""


@dataclass(frozen=True)
class SiteRanking:
    """The ranking of a scenario's sites.

    Attributes
    ----------
    score
        Name of the score that ranks.
    values
        Its value at each site, in the order of the sites.
    first
        The sites of rank 1.
    """

    score: str
    values: Mapping[str, float]
    first: tuple[str, ...]

    @classmethod
    def compute(cls, context: StageContext) -> SiteRanking:
        """Rank the sites as a run does, in a folder with the stages before the score."""
        runs.ensure_stages(context, "tpog", "score")  # the last TPOG in the folder may have voxels of another size
        score = context.scenario.score.rank_by
        rows = read_scores(context.folder.scores).to_pylist()
        first = tuple(row["site"] for row in rows if row["rank"] == 1)
        return cls(score, {row["site"]: float(row[score]) for row in rows}, first)


def mounting_heights_m(scene: Scene) -> tuple[float, ...]:
    """Return the height of each site above the ground, rounded; the world's z where there is no ground."""
    heights_m = []
    for site in scene.sites:
        ground_m = 0.0
        if scene.scenario.statics.ground:
            ground_m = site_feasibility.ground_height_m(scene.world, site.pose)
        heights_m.append(HEIGHT_STEP_M * round((site.pose.z_m - ground_m) / HEIGHT_STEP_M))
    return tuple(heights_m)


def check_ranking(
    scenario: Scenario,
    ranking: SiteRanking,
    rows: Sequence[SiteDetection],
    poles: Sequence[str],
    heights_m: Sequence[float],
) -> RankingCheck:
    """Compare a ranking with what each detector finds.

    Parameters
    ----------
    scenario
        The scenario; its seed is that of the resamples.
    ranking
        The ranking.
    rows
        Detection at each site.
    poles, heights_m
        Pole and mounting height of each site, in the order of the sites.
    """
    checks = []
    for detector in dict.fromkeys(row.detector for row in rows):
        by_site = {row.site: row for row in rows if row.detector == detector and row.objects_of == ALL_OBJECTS}
        check = _check_detector(scenario, ranking, by_site, _SiteGroups(tuple(poles), tuple(heights_m)))
        if check is not None:
            checks.append(check)
    return RankingCheck(ranking.score, ranking_check.sort_checks(checks))


@dataclass(frozen=True)
class _SiteGroups:
    """Pole and mounting height of each site."""

    poles: tuple[str, ...]
    heights_m: tuple[float, ...]


def _check_detector(
    scenario: Scenario, ranking: SiteRanking, by_site: Mapping[str, SiteDetection], groups: _SiteGroups
) -> DetectorCheck | None:
    """Compare a ranking with one detector; None if the first site, or every site, has no measure."""
    detector = next(iter(by_site.values())).detector
    measure = main_measure(detector)
    estimates = {site: row.measures[measure] for site, row in by_site.items()}
    values = {site: estimate.value for site, estimate in estimates.items() if math.isfinite(estimate.value)}
    first_sites = [site for site in ranking.first if site in values]
    if not first_sites:
        return None
    first = max(first_sites, key=lambda site: values[site])
    best = max(values, key=lambda site: values[site])
    if values[best] == values[first]:
        best = first
    frames = by_site[best].frames
    loss = detection_metrics.estimate_difference(estimates[best], estimates[first], frames)

    score = np.array([ranking.values[site] for site in by_site])
    measured = MeasureValues.from_estimates(list(estimates.values()))
    junction = JunctionScores(scenario.name, tuple(by_site), {_RANKING: score}, {measure: measured}, groups.poles)
    return DetectorCheck(
        detector=detector,
        measure=MEASURE_NOUNS[measure],
        returns_boxes=detector != POINT_COUNTS_NAME,
        first=first,
        first_value=values[first],
        best=best,
        best_value=values[best],
        best_se=none_if_nan(estimates[best].se),
        loss=loss.value,
        loss_se=none_if_nan(loss.se),
        blocks=BLOCKS,
        rho=_correlate([junction], measure, scenario.seed),
        same_height=_correlate_same_height(junction, measure, groups.heights_m, scenario.seed),
    )


def _correlate(junctions: Sequence[JunctionScores], measure: str, seed: int) -> RankCorrelation:
    correlation = CorrelationStudy(junctions, seed).correlation(_RANKING, measure, "spearman")
    return RankCorrelation(
        value=none_if_nan(correlation.value),
        low=none_if_nan(correlation.interval.low),
        high=none_if_nan(correlation.interval.high),
        sites=correlation.sites,
        groups=len(junctions),
        why=correlation.why,
    )


def _correlate_same_height(
    junction: JunctionScores, measure: str, heights_m: Sequence[float], seed: int
) -> RankCorrelation | None:
    """Correlate within each mounting height that has enough poles; None where all sites have the same height."""
    distinct_m = sorted(set(heights_m))
    if len(distinct_m) < 2:
        return None
    parts = []
    for height_m in distinct_m:
        selected = np.array(heights_m) == height_m
        part = _select_sites(junction, selected, f"{height_m:g} m")
        if part.count_poles(part.defined_sites([_RANKING], measure)) >= MIN_POLES:
            parts.append(part)
    if not parts:
        why = f"no mounting height has sites on {MIN_POLES} poles"
        return RankCorrelation(None, None, None, 0, 0, why)
    return _correlate(parts, measure, seed)


def _select_sites(junction: JunctionScores, selected: BoolArray, part: str) -> JunctionScores:
    """Return some sites of a junction, (n,) bool, as a part of it."""
    rows = np.flatnonzero(selected)
    measures = {}
    for name, measure in junction.measures.items():
        measures[name] = MeasureValues(measure.values[rows], measure.left_out[rows])
    return JunctionScores(
        name=junction.name,
        sites=tuple(junction.sites[row] for row in rows),
        scores={name: values[rows] for name, values in junction.scores.items()},
        measures=measures,
        poles=junction.selected_poles(selected),
        part=part,
    )
