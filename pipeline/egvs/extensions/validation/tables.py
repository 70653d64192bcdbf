"""What ``egvs scores``, ``clouds``, ``validate`` and ``train`` print, and the progress of detector runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from egvs.cli.console import NARROW, Column, console, print_sentences, print_table
from egvs.core.errors import InputError, MissingBackendError
from egvs.core.wording import format_percent, number_of
from egvs.extensions.validation.detection_metrics import ALL_OBJECTS
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME
from egvs.extensions.validation.detector_runs import DetectionListener
from egvs.extensions.validation.remaining_time import RemainingTime
from egvs.extensions.validation.results import main_measure
from egvs.results.labels import SCORE_LABELS
from egvs.scenario.score_config import DEFAULT_SCORE, RankingScore, is_plugin_score, plugin_scores
from egvs.scoring.target_scores import load_vehicle_score

if TYPE_CHECKING:
    from egvs.core.resource_usage import ResourceUsage
    from egvs.extensions.validation.correlation import Correlation
    from egvs.extensions.validation.dataset import WrittenDataset
    from egvs.extensions.validation.detection_metrics import JackknifeEstimate, SiteDetection
    from egvs.extensions.validation.held_out_traffic import TrafficSample
    from egvs.extensions.validation.plan_validation import PlanValidation
    from egvs.extensions.validation.results import ScoreName, Validation
    from egvs.extensions.validation.surrogates import ParameterValue, ScoreEntry
    from egvs.scenario.model import Scenario

_FILE_WIDTH = 160

MIN_ESTIMATE_S = 10.0
"""Shorter times that are left are not printed: one pause of a busy machine would make them wrong."""

_MEASURE_TITLES = {
    "ap_mean_r40_iou70": {
        "ap_bev_r40_iou70": "BEV AP, %",
        "ap_3d_r40_iou70": "3D AP, %",
        "ap_mean_r40_iou70": "mean, %",
    },
    "seen_20": {"seen_20": "vehicles with 20 points, %"},
}
"""Measures of a detector that the table shows, with their titles, by its main measure."""


def print_scores(entries: Iterable[ScoreEntry]) -> None:
    """Print all scores with formula and source; for a score that cannot be loaded, the reason."""
    columns: list[Column[ScoreEntry]] = [
        Column("score", lambda entry: entry.name, "left"),
        Column("formula", _format_formula, "left", wrap=True),
        Column("better", _format_direction, "left"),
        Column("tried with", _format_sweep, "left", wrap=True),
        Column("source", _format_source, "left", wrap=True),
    ]
    print_table(columns, entries, file_width=_FILE_WIDTH)
    ranking = [name for name in (*get_args(RankingScore), *plugin_scores()) if _can_rank(name)]
    others = ", ".join(name for name in ranking if name != DEFAULT_SCORE)
    console(_FILE_WIDTH, soft_wrap=False).print(
        f"[score] rank_by chooses the score that ranks sites: {DEFAULT_SCORE} (recommended), {others}"
    )


def _can_rank(name: str) -> bool:
    """Return whether a score ranks sites: one of this program, or a valid score of vehicles of another package."""
    if not is_plugin_score(name):
        return True
    try:
        load_vehicle_score(name)
    except (InputError, MissingBackendError):
        return False
    return True


def _format_formula(entry: ScoreEntry) -> str:
    return entry.problem if entry.score is None else entry.score.formula


def _format_direction(entry: ScoreEntry) -> str:
    if entry.score is None:
        return "broken"
    return "more" if entry.score.sign > 0 else "less"


def _format_source(entry: ScoreEntry) -> str:
    if entry.score is None:
        return ""
    if entry.package:
        return f"{entry.score.source} (package {entry.package})"
    return entry.score.source


def _format_sweep(entry: ScoreEntry) -> str:
    """Return the values of each parameter that the validation tries."""
    if entry.score is None:
        return ""
    parts = []
    for name, values in entry.score.sweep.items():
        parts.append(f"{name} {', '.join(map(_format_parameter, values))}")
    return "; ".join(parts)


def _format_parameter(value: ParameterValue) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, float):
        return f"{value:g}"
    return str(value)


def print_validation(scenario: Scenario, out: Path, validation: Validation) -> None:
    """Print what each detector finds from each site, how well scores predict it, and what this says of the ranking."""
    _print_sample(validation.sample, next(row for row in validation.detections if row.objects_of == ALL_OBJECTS))
    detectors = list(dict.fromkeys(row.detector for row in validation.detections))
    sites = sorted(validation.ranked, key=lambda site: -validation.ranked[site])
    print_table(_detection_columns(validation, detectors), sites, file_width=_FILE_WIDTH)
    print()
    _print_agreement(validation, validation.egvs_score(scenario), detectors)
    for warning in validation.warnings:
        print(f"warning: {warning}")
    print(f"{out}: detection.parquet, surrogates.parquet, correlation.parquet, validation.png")
    if validation.report:
        print(validation.report)
    print()
    print_sentences(validation.check.sentences)
    if validation.check.warning:
        print_sentences([validation.check.warning])


def _detection_columns(validation: Validation, detectors: Sequence[str]) -> list[Column[str]]:
    """Return the site, the score that ranks, and the measures of each detector.

    Narrow terminals show BEV and 3D of a single detector only; the mean of both is always shown.
    """
    label = SCORE_LABELS[validation.check.score]
    detections = {(row.site, row.detector): row for row in validation.detections if row.objects_of == ALL_OBJECTS}

    def format_detection(detector: str, measure: str, site: str) -> str:
        return _format_percent(detections[site, detector].measures[measure])

    columns = [
        Column[str]("site", str, "left"),
        Column[str](label.head, lambda site: label.value(validation.ranked[site]), wrap=True),
    ]
    with_boxes = [detector for detector in detectors if detector != POINT_COUNTS_NAME]
    for detector in detectors:
        main = main_measure(detector)
        for measure, title in _MEASURE_TITLES[main].items():
            is_detail = measure != main and len(with_boxes) > 1
            text = partial(format_detection, detector, measure)
            min_width = NARROW if is_detail else 0
            columns.append(Column(f"{detector}: {title}", text, wrap=True, min_width=min_width))
    return columns


def _print_sample(sample: TrafficSample, detection: SiteDetection) -> None:
    """Print the size of the held-out traffic."""
    frames = f"{detection.objects:,} vehicles in {sample.frames:,} frames"
    spacing = f"at least {sample.apart_s:g} s apart"
    print(
        f"{sample.vehicles:,} different vehicles in held-out traffic: {frames}, {spacing}; ± gives the standard error"
    )


def _print_agreement(validation: Validation, scenario_score: ScoreName, detectors: Sequence[str]) -> None:
    """Print Spearman's rho of detection with each score; of the scenario's score, only with its own parameters."""
    names = [name for name in validation.scores if name == scenario_score or name.score != scenario_score.score]

    def format_rho(detector: str, score: ScoreName) -> str:
        agreement = validation.agreement(score, detector, main_measure(detector))
        return _format_interval(agreement.by_kind["spearman"])

    columns: list[Column[ScoreName]] = [Column("Spearman's rho with detection", str, "left", wrap=True)]
    columns += [Column(detector, partial(format_rho, detector)) for detector in detectors]
    print_table(columns, names, file_width=_FILE_WIDTH)


def _format_interval(correlation: Correlation) -> str:
    if not math.isfinite(correlation.value):
        return "-"
    interval = correlation.interval
    if not math.isfinite(interval.low):
        return f"{correlation.value:.2f}"
    return f"{correlation.value:.2f} ({interval.low:.2f} to {interval.high:.2f})"


_BOX_COLUMNS = {
    "AP BEV .7, %": "ap_bev_r40_iou70",
    "3D .7": "ap_3d_r40_iou70",
    "mean .7": "ap_mean_r40_iou70",
    "BEV .5": "ap_bev_r40_iou50",
    "3D .5": "ap_3d_r40_iou50",
    "mean .5": "ap_mean_r40_iou50",
}
_POINT_COLUMNS = {"seen with 1 point, %": "seen_1", "5": "seen_5", "20": "seen_20"}


def print_plan_validation(validation: PlanValidation) -> None:
    """Print what each detector finds with 1, 2, ... sensors, and the gain from the last one."""
    rows = [row for row in validation.rows if row.detection.objects_of == ALL_OBJECTS]
    _print_sample(validation.sample, rows[0].detection)
    for detector in dict.fromkeys(row.detection.detector for row in rows):
        measures, gain_measure = _BOX_COLUMNS, "mean .7"
        if detector == POINT_COUNTS_NAME:
            measures, gain_measure = _POINT_COLUMNS, "seen_20"
        columns: list[Column[Any]] = [
            Column(detector, lambda row: str(len(row.sites))),
            Column("with", _format_last_site, "left"),
        ]
        for title, measure in measures.items():
            columns.append(Column(title, partial(_format_measure, measure)))
        columns.append(Column(f"gain, {gain_measure}", _format_gain))
        detector_rows = [row for row in rows if row.detection.detector == detector]
        print_table(columns, detector_rows, file_width=_FILE_WIDTH)
    print(f"fused clouds of the plan by {validation.plan.score} in {validation.plan.path}; gain: over one sensor fewer")
    for warning in validation.warnings:
        print(f"warning: {warning}")
    print(validation.path)


def _format_last_site(row: Any) -> str:
    if len(row.sites) == 1:
        return str(row.sites[0])
    return f"+ {row.sites[-1]}"


def _format_measure(measure: str, row: Any) -> str:
    return _format_percent(row.detection.measures[measure])


def _format_gain(row: Any) -> str:
    if len(row.sites) == 1:
        return ""
    return _format_percent(row.gain)


def _format_percent(estimate: JackknifeEstimate) -> str:
    return f"{100 * estimate.value:.1f} ± {100 * estimate.se:.1f}"


def print_training(out: Path, metadata: Mapping[str, Any]) -> None:
    """Print the average precision on held-out frames during training."""
    columns = [Column[dict[str, Any]]("step", lambda entry: str(entry["step"]))]
    measures = ("ap_bev_r40_iou70", "ap_3d_r40_iou70", "ap_bev_r40_iou50", "recall_bev_iou50")
    columns += [Column(name, partial(_format_precision, name)) for name in measures]
    print_table(columns, metadata["curve"], file_width=_FILE_WIDTH)
    print(f"{out}: {metadata['parameters']:,} parameters, trained on {', '.join(metadata['junctions'])}")


def _format_precision(name: str, entry: Mapping[str, float]) -> str:
    return format_percent(entry[name])


def print_export(dataset: WrittenDataset) -> None:
    """Print what was written for each site."""
    from egvs.extensions.validation.dataset import describe_classes_by_size

    columns: list[Column[Any]] = [
        Column("site", lambda site: site.site, "left"),
        Column("sensor", lambda site: site.sensor, "left", wrap=True),
        Column("frames", lambda site: str(site.frames)),
        Column("points", lambda site: str(site.points)),
        Column("labelled boxes", lambda site: str(site.labelled), wrap=True),
        Column("vehicles in region", lambda site: str(site.in_roi), wrap=True),
        Column("of them labelled", lambda site: str(site.in_roi_labelled), wrap=True),
    ]
    print_table(columns, dataset.sites, file_width=_FILE_WIDTH)
    if by_size := describe_classes_by_size(dataset.sites):
        print(by_size)
    print(f"{dataset.folder}/README.md describes the files ({dataset.kind})")


class DetectorRunDisplay(DetectionListener):
    """Prints the progress of detector runs in lines.

    Parameters
    ----------
    say
        Prints a line.
    """

    NOUN = "site"

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._remaining = RemainingTime((), 1)

    def kind(self, name: str, detectors: Sequence[str]) -> tuple[object, ...]:
        """Return what the time of a site or group depends on; equal ones should take equally long."""
        del name
        return tuple(detectors)

    def begins(self, missing: Mapping[str, Sequence[str]], frames: int, processes: int) -> None:
        """Print how much is left to do.

        Parameters
        ----------
        missing
            Detectors that have to run, by site; none for a site whose results are cached.
        frames
            Frames per site.
        processes
            Worker processes.
        """
        pending = {site: detectors for site, detectors in missing.items() if detectors}
        if not pending:
            self._say(f"all detections from {len(missing)} {self.NOUN}s were cached")
            return

        self._remaining = RemainingTime([self.kind(site, names) for site, names in pending.items()], processes)
        detectors = list(dict.fromkeys(name for names in pending.values() for name in names))
        cached = ""
        if len(pending) < len(missing):
            cached = f" ({len(missing) - len(pending)} of {len(missing)} were cached)"
        sites = number_of(len(pending), self.NOUN)
        workers = f"{processes} process{'es' if processes > 1 else ''}"
        self._say(f"{frames} frames from {sites}{cached}, {', '.join(detectors)}, {workers}")

    def site_done(self, site: str, detectors: Sequence[str], cost: ResourceUsage) -> None:
        """Print one line per site, with the time that is left for the detectors where it can be estimated."""
        self._remaining.unit_done(self.kind(site, detectors), cost.seconds)
        left = ""
        left_s = self._remaining.seconds
        if left_s is not None and left_s >= MIN_ESTIMATE_S:
            left = f" (about {_format_duration(left_s)} left for detectors)"
        self._say(f"{cost.seconds:>8.1f} s   {site}: {', '.join(detectors)}{left}")


class PlanRunDisplay(DetectorRunDisplay):
    """Prints the progress of detector runs on groups of sites."""

    NOUN = "group"

    def kind(self, name: str, detectors: Sequence[str]) -> tuple[object, ...]:
        """Return the detectors and the number of sensors, which the time of a group depends on."""
        return (*detectors, name.count(" + ") + 1)


def _format_duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min"
