"""Measurements at the sites of one junction with one sensor, saved as JSON; all analyses start from them.

Numbers are saved with all digits, so analyses of saved and of new measurements are the same. Measured times are not
included.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Set
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from egvs.clouds.sweeps import POINT_COUNTS_NAME
from egvs.core import files
from egvs.extensions.validation.correlation import JunctionScores, MeasureValues
from egvs.extensions.validation.detection_metrics import BLOCKS

COUNTED = ("seen_20", "log_points")
BOXED = ("ap_mean_r40_iou70", "ap_mean_r40_iou50")
"""Measures of detection; tables show the first one of each."""

FURTHER_COUNT_MEASURES, FURTHER_BOX_MEASURES = ("seen_1", "seen_5"), ("ap_bev_r40_iou70", "ap_3d_r40_iou70")
"""Further measures: of points, to explain failures; of boxes, for their standard errors."""


def measures_of(detector: str) -> tuple[str, ...]:
    """Return the measures of a detector."""
    return COUNTED if detector == POINT_COUNTS_NAME else BOXED


def further_measures(detector: str) -> tuple[str, ...]:
    """Return further measures that are saved."""
    return FURTHER_COUNT_MEASURES if detector == POINT_COUNTS_NAME else FURTHER_BOX_MEASURES


@dataclass(frozen=True)
class StudySite:
    """A site: name, location (shared by sites of other heights), height above the ground, mean distance to vehicles."""

    name: str
    place: str
    height_m: float
    distance_m: float
    is_given: bool


@dataclass(frozen=True)
class Estimates:
    """One measure of one detector, at the sites where it ran.

    Attributes
    ----------
    sites
        Indices of the sites in the record.
    values, se
        One per site; NaN if undefined.
    left_out
        Values with each block of frames left out, one list per site.
    """

    sites: list[int]
    values: list[float]
    se: list[float]
    left_out: list[list[float]]

    def only(self, sites: Set[int]) -> Estimates:
        """Return the estimates at some of the sites."""
        rows = [row for row, site in enumerate(self.sites) if site in sites]
        return Estimates(
            [self.sites[row] for row in rows],
            [self.values[row] for row in rows],
            [self.se[row] for row in rows],
            [self.left_out[row] for row in rows],
        )

    def measured(self) -> MeasureValues:
        """Return the values as the statistics need them."""
        return MeasureValues(np.array(self.values, dtype=np.float64), np.array(self.left_out).reshape(-1, BLOCKS))


@dataclass(frozen=True)
class Record:
    """All measurements of one junction and sensor.

    Attributes
    ----------
    key
        Hash of everything that it depends on.
    objects
        Vehicle-frames that a detector should find.
    scores
        One value per site, by name, with a sign such that more is better.
    detections
        By detector and measure.
    skipped
        Scores that could not be computed, with the reason.
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
        """Write JSON."""
        with files.atomic_write(path) as partial:
            partial.write_text(json.dumps(asdict(self), indent=None, separators=(",", ":")) + "\n", encoding="utf-8")

    @classmethod
    def read(cls, path: Path) -> Record:
        """Read what :meth:`write` wrote."""
        value = json.loads(path.read_text(encoding="utf-8"))
        sites = [StudySite(**site) for site in value.pop("sites")]
        detections = {
            d: {m: Estimates(**entry) for m, entry in by.items()} for d, by in value.pop("detections").items()
        }
        return cls(sites=sites, detections=detections, **value)

    def junction_of(self, detector: str) -> JunctionScores:
        """Return the sites where a detector ran, with all scores."""
        by_measure = self.detections[detector]
        rows = next(iter(by_measure.values())).sites
        values = {name: np.array(entry, dtype=np.float64)[rows] for name, entry in self.scores.items()}
        measures = {name: entry.measured() for name, entry in by_measure.items()}
        entry = [self.sites[row] for row in rows]
        return JunctionScores(
            self.junction, tuple(site.name for site in entry), values, measures, tuple(site.place for site in entry)
        )

    def only(self, is_selected: Callable[[StudySite], bool]) -> Record:
        """Return the measurements at some of the sites."""
        selected = {number for number, site in enumerate(self.sites) if is_selected(site)}
        detections = {
            detector: {measure: entry.only(selected) for measure, entry in by_measure.items()}
            for detector, by_measure in self.detections.items()
        }
        return replace(self, detections=detections)
