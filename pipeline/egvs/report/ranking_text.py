"""Sentences about a ranking, for the report and the terminal: the best site, its lead, and what makes it clearer.

:func:`ranking_disagreement` compares the EGVS with the recommended score by the evidence of the validation study
(:mod:`egvs.results.study_results`); a setting that was not measured is not in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from egvs.artefacts.run_record import StageRecord
from egvs.core.wording import by_number, format_percent, list_first
from egvs.results.labels import SCORE_LABELS, ScoreLabel, format_probability, join_names
from egvs.results.levels import MIN_NOTICED_LEAD, NO_DETECTORS, NOT_MEASURED, DetectionLevel
from egvs.results.ranking import CLOSE_SHARE, RankedSite, Ranking
from egvs.results.study_results import STUDY
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import DEFAULT_SCORE, FROM_SENSOR

MIN_RELEVANT_LEAD = 0.001
"""Poles whose scores differ by less are equally good; of shares as it is, of others relative to the best score."""

_MIN_LEAD = 0.0005
"""Shares that differ by less than this look the same with one decimal."""

COMPARED_SITES = 3
"""Number of best sites that :func:`ranking_disagreement` compares."""

_NO_TITLES: Mapping[str, str] = {}

RHO_RANGE = (
    "{:.2f} to {:.2f}, depending on junction and detector; among sites of equal height, {:.2f} to {:.2f} (before the "
    "models were corrected for streets; after it {:.2f} to {:.2f} at {} of the 6 junctions)".format(
        *STUDY.larger_study.rho, *STUDY.larger_study.rho_at_equal_height, *STUDY.street_levels.rho_in_larger_study,
        STUDY.street_levels.junctions_of_larger_study,
    )
)  # fmt: skip
"""Rank correlation of the recommended score with detection, over the held-out junctions and the detectors of the larger
study (docs/validity.md)."""

FROM_SENSOR_NOTE = (
    "This detector measures heights from the sensor, and the score for it was tested at "
    f"{STUDY.heights_from_sensor.sites} sites of one junction only (docs/validity.md)."
)


def level(site: RankedSite, found: DetectionLevel) -> str:
    """Return what a site achieves: what detectors should find and, beside it, what people would notice.

    Parameters
    ----------
    site
        The site.
    found
        What is known of the share that detectors find; without detectors for a score that has none.

    Returns
    -------
    str
        E.g. "detectors should find 84 ± 6 % of vehicles; people would notice 90 ± 10 %". For a score without detectors
        it begins with a verb: "sees 60.0 % of vehicles well".
    """
    detectors = found.detectors
    if not detectors:
        return site.by.sentence(site.score)
    names = "detectors" if len(detectors) > 1 else f"the detector {detectors[0]}"
    if found.is_measured:
        text = f"{names} {site.by.says.format(found.text(site.score, site.score_se))}"
        if found.range is not None:
            outside = format_percent(found.range.outside, 0)
            text += f" (nothing is known of the {outside} that are not {' or '.join(found.range.measured)})"
    else:
        without = "" if found.has_losses else " without losses of returns (see rated_range_m)"
        text = f"{NOT_MEASURED} for {names}{without}"
    if site.noticed is not None:
        text += f"; people would notice {site.noticed.text}"
    return text


def noticed_preference(ranking: Ranking) -> str:
    """Return a sentence if people would notice clearly more from another pole than from the best one; else empty."""
    best = ranking.sites[0]
    if ranking.by.name != DEFAULT_SCORE or not ranking.has_noticed or ranking.is_tie:
        return ""
    shares = {site.site: site.noticed for site in ranking.sites if site.noticed is not None}
    other = max(ranking.sites, key=lambda site: shares[site.site].value)
    if other.pole == best.pole or shares[other.site].value - shares[best.site].value < MIN_NOTICED_LEAD:
        return ""
    return (
        f"People would notice more from {other.site} ({shares[other.site].cell}) than from {best.site} "
        f"({shares[best.site].cell}); sites are ranked by what detectors should find."
    )


def headline(
    ranking: Ranking, has_traffic: bool, found: DetectionLevel = NO_DETECTORS, titles: Mapping[str, str] = _NO_TITLES
) -> str:
    """Return the result in one sentence.

    Parameters
    ----------
    ranking
        The sites.
    has_traffic
        Whether there is any traffic in the region.
    found
        As for :func:`level`.
    titles
        What people call the sites (:func:`egvs.results.ranking.site_titles`); by default their names.
    """
    detectors = found.detectors
    best, count = ranking.best, len(ranking.sites)
    top = best[0]
    title = titles.get(top.site, top.site)
    comma = "," if "," in title else ""
    subject = title[0].upper() + title[1:] if title.startswith(("pole ", "site ")) else title
    if not has_traffic:
        return "No traffic in the region: the sites cannot be ranked"
    if not top.score > 0:
        return "No site sees any of the traffic" if count > 1 else f"{subject}{comma} sees none of the traffic"

    by_egvs = top.rank_by == "egvs"
    result = level(top, found)
    if by_egvs:
        result = f"sees {format_percent(top.entropy_seen)} of the traffic’s uncertainty"
    of_first = f"; from {title}, {result}" if detectors else f": {title}{comma} {result}"
    if count == 1:
        return f"{subject}, the only site{':' if detectors else ','} {result}"
    if ranking.is_tie:
        text = f"All {count} sites score the same"
        if by_egvs and len({site.entropy_seen for site in best}) > 1:
            return text
        return f"{text}: {result}" if detectors else f"{text}: each {result}"
    if len(best) > 4:
        return f"{top.site} and {len(best) - 1} others share first place among {count} sites{of_first}"
    if len(best) > 1:
        names = join_names([site.site for site in best])
        return f"{names} share first place among {count} sites{of_first}"
    text = f"{subject}{comma} is the best of {count} sites"
    if by_egvs:
        return text
    return f"{text}: {result}" if detectors else f"{text}: it {result}"


def more_frames_hint(scenario: Scenario, by: ScoreLabel, recorded: int) -> str:
    """Return a sentence on the setting that reduces the standard errors of a score.

    It is ``score.sampled_frames`` for a score over vehicles of less than half of the recorded frames, otherwise longer
    traffic. Four times as many frames halve the errors, if they are independent.

    Parameters
    ----------
    scenario
        The scenario of the run.
    by
        The score that ranks.
    recorded
        Number of recorded frames.
    """
    sampled = scenario.score.sampled_frames
    if by.counts_vehicles and 2 * sampled < recorded:
        return f"More frames may separate them: --set score.sampled_frames={min(4 * sampled, recorded)}."
    if scenario.is_recorded:
        return "A longer recording may separate them."
    if scenario.traffic.periods:
        return "More traffic may separate them: longer periods, or more traffic.frames."
    return f"More traffic may separate them: --set traffic.frames={4 * recorded}."


def recorded_frames_hint(scenario: Scenario, ranking: Ranking, stages: Mapping[str, StageRecord]) -> str:
    """Return :func:`more_frames_hint` for a run with these records of its stages; empty without the traffic's.

    Where differences between detectors are most of the error of the lead over the best site on another pole, more
    frames do not help; then it names the option that compares the detectors.
    """
    rival = _best_on_another_pole(ranking)
    if rival is not None and rival.is_lag_by_detectors:
        options = " and ".join(f"--detector {name}" for name in scenario.score.ranking_detectors)
        return f"The detectors disagree about this difference, and more traffic does not change that: see {options}."
    if "traffic" not in stages:
        return ""
    return more_frames_hint(scenario, ranking.by, stages["traffic"].summary["frames"])


def short_lead(ranking: Ranking) -> str:
    """Return how far the best site is ahead of the best one on another pole, and whether that is clear.

    The next site takes the place of the latter where there is one pole. Empty if no site leads.
    """
    if ranking.is_tie or not ranking.best[0].score > 0:
        return ""
    rival, name = ranking.sites[len(ranking.best)], ""
    if (on_another_pole := _best_on_another_pole(ranking)) is not None:
        rival, name = on_another_pole, on_another_pole.pole
    text = f"{by_number(len(ranking.best), 'It leads', 'They lead')} {name or rival.site}"
    text += f" by {_format_gap(ranking, rival)}"
    if rival.best_beats is None:
        return f"{text}."
    probability = format_probability(rival.best_beats)
    if rival.is_below_best:
        return f"{text} (better with a probability of {probability})."
    return f"{text}. That is not clear: the probability that it is better is {probability}."


def lead(ranking: Ranking, hint: str = "") -> str:
    """Return sentences about the lead of the best site and the sites close to it; empty if none leads.

    Parameters
    ----------
    ranking
        The sites.
    hint
        Sentence on what helps where poles cannot be told apart; left out for mounts of one pole, and where the poles
        differ by less than :data:`MIN_RELEVANT_LEAD`.
    """
    if ranking.is_tie or not ranking.best[0].score > 0:
        return ""
    second = ranking.sites[len(ranking.best)]
    subject = by_number(len(ranking.best), "It leads", "They lead")
    text = f"{subject} the next site, {second.site}, by {_format_gap(ranking, second)}"
    text += f"{_format_probability(ranking, second, 'better')}."
    rival = _best_on_another_pole(ranking)
    # ``beats_next`` of the last of the best refers to the second
    is_separable = ranking.best[-1].is_separable and second.is_below_best
    if not is_separable:
        text += f" These {'poles' if second is rival else 'sites'} cannot be told apart."
    if rival is not None and rival is not second:
        text += f" The best site on another pole, {rival.site}, is behind by {_format_gap(ranking, rival)}"
        text += f"{_format_probability(ranking, rival, 'worse')}."
        is_separable = rival.is_below_best
        if not is_separable:
            text += " These poles cannot be told apart."
    if hint and rival is not None and not is_separable and _relative_gap(ranking, rival) >= MIN_RELEVANT_LEAD:
        text += f" {hint}"
    if len(ranking.close) > 1:
        names = list_first([site.site for site in ranking.close], 4)
        text += f" {len(ranking.close)} other sites score within {format_percent(CLOSE_SHARE, 0)} of the best: {names}."
    return text


def _best_on_another_pole(ranking: Ranking) -> RankedSite | None:
    """Return the best site that is on no pole of a best one; None without such a site."""
    best_poles = {site.pole for site in ranking.best}
    return next((site for site in ranking.sites if site.pole not in best_poles), None)


def _format_probability(ranking: Ranking, site: RankedSite, comparison: str) -> str:
    """Return how probable the lead of the best site is, in brackets; empty if that is unknown."""
    if site.best_beats is None:
        return ""
    owner = "it is" if len(ranking.best) == 1 or comparison == "worse" else "they are"
    return f" ({owner} truly {comparison} with a probability of {format_probability(site.best_beats)})"


def _relative_gap(ranking: Ranking, site: RankedSite) -> float:
    """Return how far a site is behind the best one: in share, or relative to the best score for scores in units."""
    best_score = ranking.best[0].score
    gap = best_score - site.score
    return gap if ranking.by.is_share else gap / best_score


def _format_gap(ranking: Ranking, second: RankedSite) -> str:
    """Return the lead of the best site: in percentage points for shares, relative to its score otherwise."""
    best_score = ranking.best[0].score
    is_share = ranking.by.is_share
    gap, error = _relative_gap(ranking, second), second.behind_best_se
    gap_text = f"{100.0 * gap:.1f}" if gap >= _MIN_LEAD else "less than 0.1"
    if error is not None:
        if not is_share:
            error /= best_score
        decimals = 1 if error >= _MIN_LEAD else 2
        gap_text = f"{100.0 * gap:.{decimals}f} ± {100.0 * error:.{decimals}f}"
    if is_share:
        return f"{gap_text} percentage points"
    owner = by_number(len(ranking.best), "its", "their")
    return f"{gap_text} % of {owner} score"


def entropy_seen_note(ranking: Ranking) -> str:
    """Return a sentence on the site that sees most entropy; empty if a score other than the EGVS ranks."""
    top = max(ranking.best, key=lambda site: site.entropy_seen)
    most = max(ranking.sites, key=lambda site: site.entropy_seen)
    if ranking.is_tie or top.rank_by != "egvs" or not top.egvs > 0:
        return ""
    if most.entropy_seen - top.entropy_seen < _MIN_LEAD:
        subject = "It" if len(ranking.best) == 1 else top.site
        return (
            f"{subject} also sees the largest share of the traffic’s uncertainty, {format_percent(top.entropy_seen)}."
        )
    return (
        f"{most.site}, rank {most.rank}, sees more of the traffic’s uncertainty "
        f"({format_percent(most.entropy_seen)} against {format_percent(top.entropy_seen)}), but with fewer beams. "
        "One beam is enough for a voxel to count as seen, but not to detect a vehicle."
    )


# ---- evidence of the validation study


def egvs_setting(gamma: float, voxel_m: float, *, moving_occlusion: bool = False) -> str:
    """Return the key of an EGVS setting in :attr:`egvs.results.study_results.FirstStudy.rho`."""
    occlusion = "moving occlusion, " if moving_occlusion else ""
    return f"egvs (gamma {gamma:g}, {occlusion}voxel {voxel_m:g})"


def ranking_disagreement(
    sites: Sequence[RankedSite],
    egvs: str,
    rho: Mapping[str, Mapping[str, float]] = STUDY.first_study.rho,
    detectors: Sequence[str] = (),
) -> str:
    """Return sentences if the EGVS and the recommended score have different best sites; empty otherwise.

    Parameters
    ----------
    sites
        Sites with both scores; the result is empty if one is missing.
    egvs
        The EGVS setting of the run, from :func:`egvs_setting`.
    rho
        The evidence, by score and detector; that of the first study by default.
    detectors
        Detectors that the recommended score stands for.
    """
    by_egvs, by_other = best_sites(sites, "egvs"), best_sites(sites, DEFAULT_SCORE)
    if not by_egvs or not by_other or (by_egvs[0] == by_other[0] and set(by_egvs) == set(by_other)):
        return ""
    noun = SCORE_LABELS[DEFAULT_SCORE].noun
    evidence = FROM_SENSOR_NOTE if FROM_SENSOR in detectors else _describe_evidence(noun, egvs, rho)
    return f"The best sites by EGVS are {join_names(by_egvs)}; by {noun} they are {join_names(by_other)}. {evidence}"


def best_sites(sites: Sequence[RankedSite], name: str) -> tuple[str, ...]:
    """Return the best sites by one score, equal ones in the order of the sites; empty if a value is missing."""
    values = [site.value_of(name) for site in sites]
    if any(value is None for value in values):
        return ()
    ranked = sorted(zip(sites, values, strict=True), key=lambda pair: -float(pair[1] or 0.0))
    return tuple(site.site for site, _ in ranked[:COMPARED_SITES])


def _describe_evidence(noun: str, egvs: str, rho: Mapping[str, Mapping[str, float]]) -> str:
    """Sentences on how well both scores predicted detection in the study."""
    recommended, this_egvs = rho.get(DEFAULT_SCORE, {}), rho.get(egvs, {})
    detectors = [detector for detector in recommended if detector in this_egvs]
    if not detectors:
        text = "How well this setting of the EGVS predicts detection was not measured."
        if recommended:
            text += f" The rank correlation of {noun} with detection is {RHO_RANGE}; see docs/validity.md."
        return text

    is_better = [recommended[detector] > this_egvs[detector] for detector in detectors]
    if all(is_better):
        verdict = f"{noun} was the better predictor of detection"
    elif any(is_better):
        verdict = "neither score was consistently the better predictor of detection"
    else:
        verdict = "the EGVS was the better predictor of detection"
    values = join_names([f"{recommended[name]:.2f} against {this_egvs[name]:.2f} ({name})" for name in detectors])
    where = "At the held-out junctions of the validation study"
    return f"{where}, {verdict}: mean rank correlation {values}. That of {noun} is {RHO_RANGE}; see docs/validity.md."
