"""Whether the level of the score is right: the share of vehicles that it expects, beside the share that was found.

*Candidates*: a candidate's expected share comes from the traffic behind the scores, the share found from the unseen
traffic: the mean of recall from above and in 3D (IoU 0.7) over all vehicles, hidden ones too. The difference is what a
planner would see who installs there.

*Vehicle-frames* (reliability): the model's probability for each vehicle-frame of the unseen traffic, in ten bins,
beside the share of those that was found. It leaves out that the two traffics differ.

A detector with a model is compared with its own model, another one with the mean of all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.across_junctions.records import VEHICLES, JunctionRecord
from benchmarks.across_junctions.vehicle_rows import read_rows
from benchmarks.detectability import figures
from benchmarks.detectability.fitting import curve
from egvs.core.grid import FloatArray
from egvs.scoring.target_scores import DETECTORS

RECALLS = ("recall_bev_iou70", "recall_3d_iou70")

NEAR_POINTS = 5.0
"""An expected share is near what was found if it is at most so many points of 100 away."""


@dataclass(frozen=True, eq=False)
class Level:
    """Expected and found shares of the candidates of one junction, in points of 100.

    Attributes
    ----------
    score
        Name of the score that expects.
    expected, found
        (n,) float64, of the candidates where both are defined.
    """

    score: str
    expected: FloatArray
    found: FloatArray

    @property
    def error(self) -> FloatArray:
        """Expected minus found, (n,)."""
        return self.expected - self.found

    @property
    def mean_absolute_error(self) -> float:
        """Mean of the absolute errors; NaN without candidates."""
        return float(np.abs(self.error).mean()) if len(self.error) else float("nan")

    @property
    def near(self) -> float:
        """Share of the candidates within :data:`NEAR_POINTS`, 0 to 1."""
        return float((np.abs(self.error) <= NEAR_POINTS).mean()) if len(self.error) else float("nan")

    @property
    def error_of_first(self) -> float:
        """Mean error of the candidates with the highest expected share: where a planner would install."""
        is_first = self.expected == self.expected.max(initial=-np.inf)
        return float(self.error[is_first].mean()) if len(self.error) else float("nan")


def level(record: JunctionRecord, detector: str, score: str) -> Level:
    """Return the level of a score at a junction where a detector was run."""
    found = np.mean([record.detections[detector][name].values for name in RECALLS], axis=0)
    expected = record.scores[score]
    defined = np.isfinite(found) & np.isfinite(expected)
    return Level(score, 100.0 * expected[defined], 100.0 * found[defined])


def score_of(detector: str, variants: Sequence[str]) -> str:
    """Return the variant of ``expected_detections`` that expects what a detector finds.

    Parameters
    ----------
    variants
        Names of all variants; the one with most detectors is used for a detector that has none of its own.
    """
    own = [name for name in variants if name.endswith(f"(detectors {detector})")] if detector in DETECTORS else []
    return own[0] if own else max(variants, key=lambda name: name.count("+"))


def draw(folder: Path, records: Sequence[JunctionRecord], out: Path) -> list[Path]:
    """Write the reliability diagrams of each detector at junctions that did not train the score; return the files."""
    paths = []
    unseen = [record for record in records if record.role != "training"]
    for detector in sorted({name for record in unseen for name in record.detections}):
        if curves := reliability(folder, unseen, detector):
            paths.append(out / f"reliability_{detector}.png")
            figures.draw_reliability(paths[-1], detector, curves, "predicted by the shipped models")
    return paths


def reliability(folder: Path, records: Sequence[JunctionRecord], detector: str) -> figures.Curves:
    """Return probability, share found and number of vehicle-frames in each bin, by junction.

    Junctions without the part ``vehicles`` or without the detector are left out.
    """
    curves = {}
    for record in records:
        if VEHICLES in record.infos and detector in record.detections:
            rows = read_rows(folder, record, detector)
            chances, hits = (np.concatenate([getattr(site, name) for site in rows]) for name in ("shipped", "hits"))
            curves[record.name] = curve(chances, hits)
    return curves
