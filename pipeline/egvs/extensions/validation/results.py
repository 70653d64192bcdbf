"""The result of a validation, and its figure ``validation.png``.

The figure has one column per detector. Above: the score that ranks the sites against the detector's main measure, one
point per site with its standard error. Below: Spearman's rho of every score with that
measure, with 95 % intervals; a score with parameters has one row for each combination of their values. The figure is
readable in greyscale.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from egvs.core import files
from egvs.core.errors import Diagnostic
from egvs.extensions.validation.correlation import Correlation
from egvs.extensions.validation.detection_metrics import ALL_OBJECTS, SiteDetection
from egvs.extensions.validation.detector_results import POINT_COUNTS_NAME
from egvs.extensions.validation.held_out_traffic import TrafficSample
from egvs.extensions.validation.ranking_check import DetectorCheck, RankingCheck
from egvs.extensions.validation.surrogates import Surrogates
from egvs.results.labels import SCORE_LABELS
from egvs.scenario.model import Scenario
from egvs.statistics.ranks import CoefficientKind
from egvs.studies.decision_figure import LabelPlacement

if TYPE_CHECKING:
    from matplotlib.figure import Figure


CORRELATED_BOX_MEASURES = (
    "ap_mean_r40_iou70",
    "ap_bev_r40_iou70",
    "ap_3d_r40_iou70",
    "ap_mean_r40_iou50",
    "ap_mean_r11_iou70",
)
"""Measures of a detector that scores are correlated with; the first is that of tables and figures."""

CORRELATED_POINT_MEASURES = ("seen_20", "seen_1", "seen_5", "log_points")
"""The same for points on vehicles."""


def correlated_measures(detector: str) -> tuple[str, ...]:
    """Return the measures of a detector that scores are correlated with, the main one first."""
    if detector == POINT_COUNTS_NAME:
        return CORRELATED_POINT_MEASURES
    return CORRELATED_BOX_MEASURES


MEASURE_NOUNS = {"ap_mean_r40_iou70": "mean AP of BEV and 3D", "seen_20": "vehicles with 20 points"}
"""The main measures in a sentence."""


def main_measure(detector: str) -> str:
    """Return the measure that tables and figures show for a detector."""
    return correlated_measures(detector)[0]


@dataclass(frozen=True)
class ScoreName:
    """A score and its parameters as canonical JSON."""

    score: str
    parameters: str

    def __str__(self) -> str:
        labels = []
        for name, value in json.loads(self.parameters).items():
            label = _PARAMETER_LABELS.get(name, name)
            if value is True:
                labels.append(label)
            elif isinstance(value, float):
                labels.append(f"{label} {value:g}")
            elif value is not False:
                labels.append(f"{label} {value}")
        return f"{self.score} ({', '.join(labels)})" if labels else self.score


_PARAMETER_LABELS = {"voxel_m": "voxel", "moving_occlusion": "moving occlusion"}


@dataclass(frozen=True)
class ScoreAgreement:
    """How well a score agrees with a measure of a detector."""

    score: ScoreName
    detector: str
    measure: str
    by_kind: Mapping[CoefficientKind, Correlation]


@dataclass(frozen=True)
class Validation:
    """The result of a validation of single sites.

    Attributes
    ----------
    detections
        Rows of ``detection.parquet``.
    surrogates
        Rows of ``surrogates.parquet``.
    agreements
        Rows of ``correlation.parquet``.
    warnings
        Undefined measures, skipped scores, and traffic that is not held out.
    sample
        The size of the held-out traffic.
    ranked
        The score that ranks, by site.
    check
        What the detectors say about the ranking.
    report
        Path of the updated report; None if the folder does not contain a complete run.
    """

    detections: tuple[SiteDetection, ...]
    surrogates: Surrogates
    agreements: tuple[ScoreAgreement, ...]
    warnings: tuple[Diagnostic, ...]
    sample: TrafficSample
    ranked: Mapping[str, float]
    check: RankingCheck
    report: Path | None = None

    @cached_property
    def scores(self) -> tuple[ScoreName, ...]:
        """Every score with each combination of its parameters, in order."""
        return tuple(dict.fromkeys(ScoreName(row.score, row.parameters_json) for row in self.surrogates.rows))

    def egvs_score(self, scenario: Scenario) -> ScoreName:
        """Return EGVS with the parameters of the scenario."""
        gamma = "inf" if scenario.gamma == float("inf") else scenario.gamma
        parameters = {
            "gamma": gamma,
            "voxel_m": scenario.roi.voxel_m,
            "moving_occlusion": "moving_occlusion" in scenario.effects.named,
        }
        return next(name for name in self.scores if name.score == "egvs" and json.loads(name.parameters) == parameters)

    def values_of(self, name: ScoreName) -> dict[str, float]:
        """Return a score's values by site, without a change of sign."""
        rows = self.surrogates.rows
        return {row.site: row.value for row in rows if ScoreName(row.score, row.parameters_json) == name}

    def agreement(self, score: ScoreName, detector: str, measure: str) -> ScoreAgreement:
        """Return one row of :attr:`agreements`."""
        key = (score, detector, measure)
        return next(row for row in self.agreements if (row.score, row.detector, row.measure) == key)


_PERCENT = 100.0
_SIGMAS_95 = 1.96  # half width of a 95 % interval in standard errors
_DOT_COLOUR, _EGVS_COLOUR = "#0072B2", "#D55E00"

_MEASURE_LABELS = {
    "ap_mean_r40_iou70": "AP R40, mean of BEV and 3D, IoU 0.7, %",
    "seen_20": "vehicles with at least 20 points, %",
}


def write_figure(path: Path, scenario: Scenario, validation: Validation) -> None:
    """Write the figure as a PNG."""
    with files.atomic_write(path) as partial:
        validation_figure(scenario, validation).savefig(partial, dpi=150, format="png", metadata={"Software": None})


def validation_figure(scenario: Scenario, validation: Validation) -> Figure:
    """Return the figure, laid out."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    detectors = list(dict.fromkeys(row.detector for row in validation.detections))
    scores = len({str(agreement.score) for agreement in validation.agreements})
    lower_height = 1.2 + 0.17 * scores
    figure = Figure(figsize=(1.5 + 5.2 * len(detectors), 4.4 + lower_height), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, len(detectors), height_ratios=(4.0, lower_height), squeeze=False)
    figure.suptitle(f"Does the score predict detection? {scenario.name}", fontsize=12)

    egvs = validation.egvs_score(scenario)
    scatters = []
    for column, detector in enumerate(detectors):
        scatters.append(_draw_scatter(panels[0, column], validation, detector))
        _draw_ranking(panels[1, column], egvs, validation, detector, with_names=column == 0)

    figure.draw_without_rendering()  # lays out the panels, so that labels can be placed in them
    for column, scatter in enumerate(scatters):
        labels = LabelPlacement(panels[0, column], np.column_stack([scatter.x, scatter.y]))
        for site, x, y in zip(scatter.sites, scatter.x, scatter.y, strict=True):
            labels.add(site, x, y)
    return figure


class _Scatter(NamedTuple):
    """The points of a scatter plot and the sites that they belong to."""

    x: list[float]
    y: list[float]
    sites: list[str]


def _draw_scatter(axes: Any, validation: Validation, detector: str) -> _Scatter:
    """Draw the score that ranks against the detector's main measure."""
    measure = main_measure(detector)
    label = SCORE_LABELS[validation.check.score]
    scale = _PERCENT if label.is_share else 1.0
    x, y, half_width, site_names = [], [], [], []
    for row in validation.detections:
        if row.detector != detector or row.objects_of != ALL_OBJECTS:
            continue
        estimate = row.measures[measure]
        if math.isfinite(estimate.value):
            x.append(scale * validation.ranked[row.site])
            y.append(_PERCENT * estimate.value)
            half_width.append(_SIGMAS_95 * _PERCENT * estimate.se)
            site_names.append(row.site)

    axes.errorbar(x, y, yerr=np.nan_to_num(half_width), fmt="none", ecolor="0.7", elinewidth=1.0, zorder=1)
    axes.scatter(x, y, s=34, facecolors=_DOT_COLOUR, edgecolors="black", linewidths=0.6, zorder=3)
    unit = "%" if label.is_share else label.unit
    axes.set(xlabel=f"{label.noun}, {unit}".rstrip(", "), ylabel=_MEASURE_LABELS[measure])
    check = next((check for check in validation.check.detectors if check.detector == detector), None)
    axes.set_title(f"{detector}: {_format_correlation(check)}", fontsize=10)
    axes.grid(True, color="0.88", linewidth=0.7)
    axes.tick_params(labelsize=8)
    axes.margins(0.12)
    return _Scatter(x, y, site_names)


def _format_correlation(check: DetectorCheck | None) -> str:
    if check is None or check.rho.value is None:
        return "no rank correlation"
    return f"Spearman's rho {check.rho.text}, {check.rho.sites} sites"


def _draw_ranking(axes: Any, egvs: ScoreName, validation: Validation, detector: str, *, with_names: bool) -> None:
    """Draw Spearman's rho of every score, in the order of the scores."""
    measure = main_measure(detector)
    agreements = []
    for agreement in validation.agreements:
        if agreement.detector == detector and agreement.measure == measure:
            agreements.append(agreement)
    for line, agreement in enumerate(agreements):
        spearman = agreement.by_kind["spearman"]
        interval = spearman.interval
        if math.isfinite(interval.low):
            axes.plot([interval.low, interval.high], [line, line], color="0.65", linewidth=1.4, zorder=1)
        is_egvs = agreement.score == egvs
        axes.scatter(
            [spearman.value],
            [line],
            s=26,
            marker="D" if is_egvs else "o",
            facecolors=_EGVS_COLOUR if is_egvs else _DOT_COLOUR,
            edgecolors="black",
            linewidths=0.5,
            zorder=3,
        )

    names = [str(agreement.score) if with_names else "" for agreement in agreements]
    axes.set_yticks(range(len(agreements)), names, fontsize=6.5)
    axes.set_ylim(len(agreements) - 0.5, -0.5)
    axes.set_xlim(-1.05, 1.05)
    axes.axvline(0.0, color="0.5", linewidth=0.8)
    axes.set_xlabel(f"Spearman's rho with {_MEASURE_LABELS[measure]}", fontsize=8)
    axes.grid(True, axis="both", color="0.92", linewidth=0.6)
    axes.tick_params(labelsize=7)
