"""What was measured at the sites of one junction with one sensor: all that the analyses start from, kept as JSON.

Numbers are kept in full, so that analyses of what was kept and of what was just measured are the same. What was
measured with a clock is not in here.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Set
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from egvs.core import files
from egvs.validation.correlation import JunctionScores, MeasureValues
from egvs.validation.detection_metrics import BLOCKS
from egvs.validation.sweeps import POINT_COUNTS_NAME

COUNTED = ("seen_20", "log_points")
BOXED = ("ap_combined_r40_iou70", "ap_combined_r40_iou50")
"""What detection is measured by; the first is what a detector is shown by."""

BESIDE_COUNTED, BESIDE_BOXED = ("seen_1", "seen_5"), ("ap_bev_r40_iou70", "ap_3d_r40_iou70")
"""Kept beside them: of points on vehicles to explain failures, of boxes since their standard errors are aimed at."""


def measures_of(detector: str) -> tuple[str, ...]:
    """The measures of a detector."""
    return COUNTED if detector == POINT_COUNTS_NAME else BOXED


def beside_of(detector: str) -> tuple[str, ...]:
    """What is kept beside them."""
    return BESIDE_COUNTED if detector == POINT_COUNTS_NAME else BESIDE_BOXED


@dataclass(frozen=True)
class StudySite:
    """A site: its name, the place that it shares with sites of other heights, its height above the ground, its mean
    horizontal distance to vehicles."""

    name: str
    place: str
    height_m: float
    distance_m: float
    is_given: bool


@dataclass(frozen=True)
class Estimates:
    """One measure of one detector, at the sites that it looked from.

    Attributes
    ----------
    sites
        Their numbers among the sites of the record.
    values, se
        One a site; NaN where it is not defined.
    left_out
        With each block of frames left out, one list a site.
    """

    sites: list[int]
    values: list[float]
    se: list[float]
    left_out: list[list[float]]

    def only(self, sites: Set[int]) -> Estimates:
        """At some of the sites."""
        rows = [row for row, site in enumerate(self.sites) if site in sites]
        return Estimates(
            [self.sites[row] for row in rows],
            [self.values[row] for row in rows],
            [self.se[row] for row in rows],
            [self.left_out[row] for row in rows],
        )

    def measured(self) -> MeasureValues:
        """As the statistics take it."""
        return MeasureValues(np.array(self.values, dtype=np.float64), np.array(self.left_out).reshape(-1, BLOCKS))


@dataclass(frozen=True)
class Record:
    """What was measured.

    Attributes
    ----------
    key
        Hash of everything that it depends on.
    objects
        Vehicle-frames that a detector should find.
    scores
        By name, one a site, turned so that more is better.
    detections
        By detector and measure.
    skipped
        What of the scores could not be worked out, as told.
    """

    key: str
    junction: str
    role: str
    sensor: str
    frames: int
    objects: int
    seeds: dict[str, int]
    sites: list[StudySite]
    scores: dict[str, list[float]]
    detections: dict[str, dict[str, Estimates]]
    skipped: list[str] = field(default_factory=list)

    def write(self, path: Path) -> None:
        """As JSON."""
        with files.atomic_write(path) as partial:
            partial.write_text(json.dumps(asdict(self), indent=None, separators=(",", ":")) + "\n", encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> Record:
        """The inverse of :meth:`write`."""
        value = json.loads(path.read_text(encoding="utf-8"))
        sites = [StudySite(**site) for site in value.pop("sites")]
        found = {d: {m: Estimates(**its) for m, its in by.items()} for d, by in value.pop("detections").items()}
        return cls(sites=sites, detections=found, **value)

    def junction_of(self, detector: str) -> JunctionScores:
        """The sites that a detector looked from, with all scores."""
        by_measure = self.detections[detector]
        rows = next(iter(by_measure.values())).sites
        values = {name: np.array(its, dtype=np.float64)[rows] for name, its in self.scores.items()}
        measures = {name: its.measured() for name, its in by_measure.items()}
        its = [self.sites[row] for row in rows]
        return JunctionScores(
            self.junction, tuple(site.name for site in its), values, measures, tuple(site.place for site in its)
        )

    def only(self, wanted: Callable[[StudySite], bool]) -> Record:
        """What was found from some of the sites."""
        kept = {number for number, site in enumerate(self.sites) if wanted(site)}
        found = {
            detector: {measure: its.only(kept) for measure, its in by_measure.items()}
            for detector, by_measure in self.detections.items()
        }
        return replace(self, detections=found)
