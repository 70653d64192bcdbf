"""What validation found, as its parts hand it on: detection at each site, every score, and how well they agree."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from pipeline.core.findings import Finding
from pipeline.scenario.models import Scenario
from pipeline.validation.detection import SiteDetection
from pipeline.validation.site_findings import POINTS
from pipeline.validation.statistics.coefficients import Kind
from pipeline.validation.statistics.correlation import Correlation
from pipeline.validation.surrogates.gathering import Surrogates

BOXED = (
    "ap_combined_r40_iou70",
    "ap_bev_r40_iou70",
    "ap_3d_r40_iou70",
    "ap_combined_r40_iou50",
    "ap_combined_r11_iou70",
)
"""Measures of a detector that scores are correlated with; the first is the paper's, and the figure's."""

COUNTED = ("seen_20", "seen_1", "seen_5", "log_points")
"""The same of points on vehicles."""


def main_measure(detector: str) -> str:
    """The measure by which a detector is shown."""
    return (COUNTED if detector == POINTS else BOXED)[0]


@dataclass(frozen=True)
class ScoreName:
    """A score with its parameters, canonical JSON."""

    score: str
    parameters: str

    def __str__(self) -> str:
        values = json.loads(self.parameters)
        told = [f"{_SHORT.get(name, name)} {_word(value)}" for name, value in values.items() if value is not False]
        return f"{self.score} ({', '.join(told).replace(' on', '')})" if told else self.score


_SHORT = {"voxel_m": "voxel", "moving_occlusion": "moving occlusion"}


def _word(value: object) -> str:
    return "on" if value is True else f"{value:g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Agreement:
    """How well a score goes with a measure."""

    score: ScoreName
    detector: str
    measure: str
    by_kind: Mapping[Kind, Correlation]


@dataclass(frozen=True)
class Validation:
    """What came out.

    Attributes
    ----------
    detections
        Rows of ``detection.parquet``.
    agreements
        Rows of ``correlation.parquet``.
    doubts
        What a reader should know: what is not defined, or was not unseen.
    report
        The page that shows it; None where the folder holds no whole run.
    """

    detections: tuple[SiteDetection, ...]
    surrogates: Surrogates
    agreements: tuple[Agreement, ...]
    doubts: tuple[Finding, ...]
    report: Path | None = None

    def own_score(self, scenario: Scenario) -> ScoreName:
        """EGVS as the scenario has it."""
        own = {
            "gamma": "inf" if scenario.gamma == float("inf") else scenario.gamma,
            "voxel_m": scenario.roi.voxel_m,
            "moving_occlusion": "moving_occlusion" in scenario.effects.named,
        }
        return next(name for name in self.scores if name.score == "egvs" and json.loads(name.parameters) == own)

    @cached_property
    def scores(self) -> tuple[ScoreName, ...]:
        """Every score with each choice of its parameters, in order."""
        return tuple(dict.fromkeys(ScoreName(row.score, row.parameters_json) for row in self.surrogates.rows))

    def values_of(self, name: ScoreName) -> dict[str, float]:
        """A score's values by site, as they are."""
        rows = self.surrogates.rows
        return {row.site: row.value for row in rows if ScoreName(row.score, row.parameters_json) == name}

    def agreement(self, score: ScoreName, detector: str, measure: str) -> Agreement:
        """One row."""
        return next(
            its for its in self.agreements if (its.score, its.detector, its.measure) == (score, detector, measure)
        )
