"""The section of the report on ``egvs validate``: what detectors find, and whether they confirm the ranking.

A validation is shown if it was computed from the same inputs as the run.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from egvs.artefacts.readers import Rows, read_study
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import StageRecord, have_inputs
from egvs.core.errors import Diagnostic, collect_warnings
from egvs.extensions.validation.files import CHECKSUMS, CORRELATION, DETECTION, FIGURE, MEASURED
from egvs.report.extension_sections import SectionWarning
from egvs.scenario.model import Scenario

if TYPE_CHECKING:
    from egvs.extensions.validation.ranking_check import RankingCheck

_ALL_OBJECTS = "vehicles"
"""Name of the set of all objects in ``detection.parquet``."""

_MEASURE_TITLES = {"ap_mean_r40_iou70": "mean AP", "seen_20": "20 points"}
"""Titles of main measures, in ``detection.parquet``."""

_FURTHER_MEASURES = {"ap_mean_r40_iou70": (("ap_bev_r40_iou70", "BEV AP"), ("ap_3d_r40_iou70", "3D AP"))}
"""Columns and titles of measures that are shown beside a main one."""


@dataclass(frozen=True)
class SiteDetection:
    """Detection from a site by one detector.

    Attributes
    ----------
    value, se
        A share and its standard error; None if not defined.
    rank
        1 is best, equal values share a rank; None without a value.
    """

    value: float | None
    se: float | None
    rank: int | None


@dataclass(frozen=True)
class MeasureColumn:
    """One measure of a detector: its title, and the values by name of the site."""

    title: str
    sites: Mapping[str, SiteDetection]


@dataclass(frozen=True)
class DetectorSummary:
    """What one detector finds from the sites.

    Attributes
    ----------
    name
        The detector.
    columns
        Its measures that the page shows; the last is the main one, whose ranks are shown.
    """

    name: str
    columns: tuple[MeasureColumn, ...]

    @property
    def main(self) -> MeasureColumn:
        """The main measure."""
        return self.columns[-1]


@dataclass(frozen=True)
class ValidationSummary:
    """Results of ``egvs validate``.

    Attributes
    ----------
    detectors
        What each detector finds.
    check
        What the detectors say about the ranking.
    frames, objects
        Frames of the traffic used, and vehicles in them.
    apart_s
        Minimum time between two frames.
    warnings
        Warnings of the validation.
    figure
        PNG in base 64.
    """

    detectors: tuple[DetectorSummary, ...]
    check: RankingCheck
    frames: int
    objects: int
    apart_s: float
    warnings: tuple[Diagnostic, ...]
    figure: str

    @classmethod
    def read(cls, folder: RunFolder, stages: Mapping[str, StageRecord]) -> ValidationSummary | None:
        """Read the validation in a run folder; None if there is none of this run."""
        figure = folder / FIGURE.name
        if not figure.is_file():
            return None
        result = read_validation(folder)
        if result is None:
            return None
        from egvs.extensions.validation.ranking_check import RankingCheck  # only where there is a validation

        detection_rows, _, metadata = result
        if not have_inputs(stages, metadata["stages"]):
            return None
        rows = [row for row in detection_rows if row["objects_of"] == _ALL_OBJECTS]
        names = dict.fromkeys(row["detector"] for row in rows)
        return cls(
            detectors=tuple(_detector_summary(name, metadata["shown"][name], rows) for name in names),
            check=RankingCheck.from_json(metadata["ranking"]),
            frames=metadata["frames"],
            objects=rows[0]["objects"],
            apart_s=metadata["apart_s"],
            warnings=tuple(collect_warnings([metadata])),
            figure=base64.b64encode(figure.read_bytes()).decode("ascii"),
        )


def read_validation(folder: RunFolder) -> tuple[Rows, Rows, dict[str, Any]] | None:
    """Return the rows of ``detection.parquet`` and of ``correlation.parquet``, and the metadata of the latter.

    None where one of them does not exist, or they belong to different validations.
    """
    paths = [folder / DETECTION.name, folder / CORRELATION.name]
    if not all(path.is_file() for path in paths):
        return None
    (detected, detection_metadata), (correlated, metadata) = read_study(
        paths, CHECKSUMS.name, "a validation", "egvs validate"
    )
    if detection_metadata["inputs"] != metadata["inputs"]:
        return None
    return detected, correlated, metadata


def _detector_summary(name: str, measure: str, rows: Sequence[Mapping[str, Any]]) -> DetectorSummary:
    rows = [row for row in rows if row["detector"] == name]
    columns = []
    for column, title in (*_FURTHER_MEASURES.get(measure, ()), (measure, _MEASURE_TITLES.get(measure, measure))):
        values = [row[column] for row in rows if not math.isnan(row[column])]
        sites = {row["site"]: _site_detection(row[column], row[f"{column}_se"], values) for row in rows}
        columns.append(MeasureColumn(title, sites))
    return DetectorSummary(name, tuple(columns))


def _site_detection(value: float, se: float, values: Sequence[float]) -> SiteDetection:
    if math.isnan(value):
        return SiteDetection(None, None, None)
    known_se = None if math.isnan(se) else se
    return SiteDetection(value, known_se, 1 + sum(other > value for other in values))


class MeasuredSection:
    """The section on measured sweeps and labels; see :class:`egvs.report.extension_sections.ReportSection`."""

    name = "measured"
    files = (MEASURED.name,)
    template = Path(__file__).parent / "templates" / "measured.html.j2"

    def read(self, folder: RunFolder, scenario: Scenario, stages: Mapping[str, StageRecord]) -> list[Any] | None:
        """Return the parts of the section; None if the run has no results."""
        del scenario
        if not (folder / MEASURED.name).is_file():
            return None
        from egvs.results.command_entries import current_entries

        entries = current_entries(folder / MEASURED.name, stages)
        return [part for values in entries.values() for part in values["parts"]] or None

    def warnings(self, values: list[Any]) -> Iterator[SectionWarning]:
        """Yield none: one installed sensor does not contradict a ranking of sites."""
        del values
        yield from ()


class DetectedSection:
    """The section, as :class:`egvs.report.extension_sections.ReportSection` describes it."""

    name = "detected"
    files = (DETECTION.name, CORRELATION.name, FIGURE.name)
    template = Path(__file__).parent / "templates" / "detected.html.j2"

    def read(
        self, folder: RunFolder, scenario: Scenario, stages: Mapping[str, StageRecord]
    ) -> ValidationSummary | None:
        """Return the validation of a run; None if there is none."""
        del scenario
        return ValidationSummary.read(folder, stages)

    def warnings(self, values: ValidationSummary) -> Iterator[SectionWarning]:
        """Yield a warning if the detectors contradict the ranking."""
        if reason := values.check.contradiction:
            yield SectionWarning(values.check.warning, "the validation contradicts this", reason, "validation")


SECTION = DetectedSection()
MEASURED_SECTION = MeasuredSection()
