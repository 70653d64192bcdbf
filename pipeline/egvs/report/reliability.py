"""What a reader must know to judge a ranking, beyond its standard errors: one sentence per reason to be careful."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from egvs.core.errors import Diagnostic
from egvs.core.wording import format_percent
from egvs.report.ranking_text import FROM_SENSOR_NOTE
from egvs.results.labels import join_names
from egvs.results.ranking import RankedSite, Ranking
from egvs.results.study_results import STUDY
from egvs.scenario.score_config import DEFAULT_SCORE, FROM_SENSOR

MIN_TILT_DEG = 5.0
"""A sensor is called tilted from this pitch on."""

_PITCH_TOLERANCE_DEG = 3.0  # no note on a mount that is aimed slightly up

_ERROR_NOTE = "± is the error of a finite {} only"
_SEEDS_NOTE = "± is the error of finite simulations only, from the differences between {} of them"
_ERROR_NOTE_OF_DETECTORS = "± contains the error of a finite {}, and how far the detectors ({}) disagree"
_SEEDS_NOTE_OF_DETECTORS = (
    "± contains the error of finite simulations, from the differences between {} of them, and how far the detectors "
    "({}) disagree"
)
_SIZE_NOTE = (
    "The order of sites by this score was validated better than its size: on simulated streets, the shares found "
    "differed from the expected ones by {} to {} percentage points by street (root mean square), {} for larger "
    "vehicles; the error in the answer contains that. For a detector without a model it was {} to {} "
    "(docs/validity.md)."
)
_NO_SIZE_NOTE = (
    "The order of sites by this score was validated better than its size: the share found was not measured on "
    "simulated streets. For a detector without a model, it was off by {} to {} percentage points (docs/validity.md)."
)
_NOTICED_NOTE = (
    "Found: a box overlaps the vehicle by more than 0.7 (IoU); noticed: people label it within 3 m, by curves from one "
    "junction. Its ± is at least 10 points, by which they were off at another junction (docs/certainty.md)."
)
_COVERAGE_NOTE = "The recorded tracks cover {} of the {}; elsewhere the traffic is unknown."
_TILT_NOTE = (
    "The tilt of {} is outside the range of the validation (pitch {:g} to {:g} degrees, positive is up; roll up to "
    "{:g} degrees; docs/validity.md)."
)


def describe_reliability(
    ranking: Ranking, traffic: Mapping[str, Any] | None = None, detectors: Sequence[str] = ()
) -> list[str]:
    """Return the reasons to be careful with a ranking, in sentences.

    - With several simulations: that errors come from their differences.
    - By ``expected_detections``: what the standard errors contain, and how far the size of the score was validated, and
      what counts as found and as noticed.
    - The tilt of the best site is outside the range of the validation study.
    - The traffic was recorded: what share of the region the recording covers.
    - The best site is the lowest, the highest or the most tilted of those on its pole, so that others may be better.

    Parameters
    ----------
    ranking
        The ranking. Without a best site, there is no reason.
    traffic
        Summary of the traffic stage, if it is known.
    detectors
        Detectors that the score that ranks averages over; empty for a score without detectors.
    """
    best = ranking.sites[0]
    if not best.score > 0.0 or ranking.is_tie:
        return []
    sentences = []
    recordings = _track_summaries(traffic or {})
    seeds = _count_seeds(traffic or {})
    notes = []
    if ranking.has_errors and (seeds > 1 or ranking.by.name == DEFAULT_SCORE):
        notes.append(_error_note(seeds, "recording" if recordings else "simulation", detectors))
    if ranking.by.name == DEFAULT_SCORE:
        if len(detectors) > 1 and not ranking.has_errors:
            notes.append(f"The score is the mean over the detectors {join_names(detectors)}.")
        notes.append(FROM_SENSOR_NOTE if FROM_SENSOR in detectors else _size_note(detectors))
        if best.noticed is not None:
            notes.append(_NOTICED_NOTE)
    if notes:
        sentences.append(" ".join(notes))
    sentences += [
        _COVERAGE_NOTE.format(format_percent(coverage["share"], 0), coverage["of"]) for coverage in recordings
    ]
    (low_deg, high_deg), roll_deg = STUDY.larger_study.pitch_deg, STUDY.larger_study.roll_deg
    is_pitched = not low_deg - _PITCH_TOLERANCE_DEG <= best.pitch_deg <= high_deg + _PITCH_TOLERANCE_DEG
    if is_pitched or abs(best.pose.side_tilt_deg) > roll_deg:  # upside down is no tilt
        sentences.append(_TILT_NOTE.format(best.site, low_deg, high_deg, roll_deg))
    if limits := describe_limits(ranking):
        sentences.append(limits)
    return sentences


def _size_note(detectors: Sequence[str]) -> str:
    """Return how far the size of the score was validated."""
    levels = STUDY.street_levels
    measured = [name for name in detectors if name in levels.error_points]
    if not measured:
        return _NO_SIZE_NOTE.format(*levels.other_detector_error_points)
    by_street = [points for name in measured for points in levels.street_error_points[name]]
    larger = max(levels.error_points[name]["larger vehicles"] for name in measured)
    return _SIZE_NOTE.format(min(by_street), max(by_street), f"{larger:g}", *levels.other_detector_error_points)


def _error_note(seeds: int, traffic: str, detectors: Sequence[str]) -> str:
    """Return what standard errors contain."""
    if len(detectors) > 1:
        names = ", ".join(detectors)
        if seeds > 1:
            return f"{_SEEDS_NOTE_OF_DETECTORS.format(seeds, names)}."
        return f"{_ERROR_NOTE_OF_DETECTORS.format(traffic, names)}."
    note = _SEEDS_NOTE.format(seeds) if seeds > 1 else _ERROR_NOTE.format(traffic)
    for detector in detectors:
        note += f"; the score is that of the detector {detector}"
    return f"{note}."


def _count_seeds(traffic: Mapping[str, Any]) -> int:
    """Return the number of simulations of the traffic, or of each of its periods; 1 if it is not known."""
    periods = traffic.get("periods", {"": traffic})
    return max([1, *(len(summary.get("seeds", ())) for summary in periods.values())])


def _track_summaries(traffic: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the coverage of recorded tracks, of each period."""
    periods = traffic.get("periods", {"": traffic})
    tracks = [summary["tracks"] for summary in periods.values() if "tracks" in summary]
    return [summary["coverage"] for summary in tracks if "coverage" in summary]


def describe_limits(ranking: Ranking) -> str:
    """Return a sentence if the best site is at the end of the heights or tilts on its pole; else empty."""
    best = ranking.sites[0]
    others = [site for site in ranking.sites if (site.pole, site.sensor) == (best.pole, best.sensor)]
    limits = list(_limits(best, others))
    return f"The best mount is the {join_names(limits)} of those tried: one beyond may be better." if limits else ""


def _limits(best: RankedSite, on_pole: Sequence[RankedSite]) -> Iterator[str]:
    """Yield the limits of the mounts on a pole that its best one has reached, e.g. "lowest"."""
    heights_m = {site.z_m for site in on_pole}
    if len(heights_m) > 1 and best.z_m in (min(heights_m), max(heights_m)):
        yield "lowest" if best.z_m == min(heights_m) else "highest"
    pitches_deg = {site.pitch_deg for site in on_pole}
    steepest_deg, flattest_deg = min(pitches_deg), max(pitches_deg)
    if steepest_deg < flattest_deg and steepest_deg <= -MIN_TILT_DEG and best.pitch_deg in (steepest_deg, flattest_deg):
        yield "steepest" if best.pitch_deg == steepest_deg else "least tilted"


# ---- warnings

_BY_SEVERITY = (
    ("no vehicles",),
    ("no ranking",),
    ("traffic in the region",),
    (
        "overlaps in roi",
        "overlaps",
        "collisions",
        "waiting",
        "standing",
        "teleports",
        "jumps",
        "traffic through solids",
    ),
    ("sites on lanes", "blocked sites", "measured scan", "vehicles off their lanes", "vehicles against lanes"),
    ("rated range",),
    ("mesh units", "mesh axes", "few beams", "beam angles", "upward beams", "blind sites", "track alignment"),
)
"""Rules of warnings that make a result worthless or uncertain, that tell of traffic that cannot be, of sites where no
sensor can stand, of a key on which losses of returns depend, and of scenes that are not as they are in reality; all
other warnings are less serious."""


def by_severity(warnings: Iterable[Diagnostic]) -> list[Diagnostic]:
    """Return different warnings, the most serious first; equally serious ones in their order."""
    order = {rule: number for number, rules in enumerate(_BY_SEVERITY) for rule in rules}
    distinct = dict.fromkeys(warnings)
    return sorted(distinct, key=lambda warning: order.get(warning.rule, len(_BY_SEVERITY)))
