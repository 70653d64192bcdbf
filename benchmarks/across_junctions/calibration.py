"""Whether the level of the score is right: the share of vehicles that it expects, beside the share that was found.

*Candidates*: a candidate's expected share comes from the traffic behind the scores, the share found from the unseen
traffic: the mean of recall from above and in 3D (IoU 0.7) over all vehicles, hidden ones too. The error, expected minus
found, is what a planner would see who installs there. Part of it is the model's, part the difference between the two
traffics: the mean probability of the model over the unseen vehicle-frames separates the two.

A candidate that sees nothing is expected to find nothing, and finds nothing. So the root mean square error is that of
the half of the candidates with the highest expected shares. As measured it contains the noise of the share found, so it
is too high. A second one is without it: the mean square of the standard errors is subtracted. The noise of the expected
share stays in both.

*Vehicle-frames* (reliability): the model's probability for each vehicle-frame of the unseen traffic with points, in ten
bins, beside the share of those that was found.

A detector with a model is compared with its own model, another one with the mean of all. All detectors with a model
together are compared with that mean, which is the level that users see.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.across_junctions.models.comparison import models_for
from benchmarks.across_junctions.models.figures import Curves
from benchmarks.across_junctions.models.fitting import curve
from benchmarks.across_junctions.records import VEHICLES, JunctionRecord
from benchmarks.across_junctions.statistics import POINTS, standard_errors
from benchmarks.across_junctions.vehicle_rows import read_rows
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.extensions.validation.correlation import MeasureValues

RECALLS = ("recall_bev_iou70", "recall_3d_iou70")


@dataclass(frozen=True, eq=False)
class Level:
    """Expected and found shares of the n candidates of one junction where both are defined, in points of 100.

    Attributes
    ----------
    score
        Name of the score that expects.
    expected, found, found_se
        (n,) float64; the standard error comes from blocks of frames.
    first_error
        Mean error of the candidates with the highest main score.
    """

    score: str
    expected: FloatArray
    found: FloatArray
    found_se: FloatArray
    first_error: float

    @property
    def error(self) -> FloatArray:
        """Expected minus found, (n,)."""
        return self.expected - self.found

    @property
    def upper_half(self) -> IntArray:
        """Rows of the half of the candidates with the highest expected shares, (ceil(n / 2),) int64."""
        return np.argsort(-self.expected, kind="stable")[: math.ceil(len(self.expected) / 2)]

    @property
    def rms_error(self) -> float:
        """Root mean square error of the upper half; NaN without candidates."""
        return float(np.sqrt(np.mean(self.error[self.upper_half] ** 2))) if len(self.error) else float("nan")

    @property
    def corrected_rms_error(self) -> float:
        """The same without the noise of the share found; NaN without candidates."""
        if not len(self.error):
            return float("nan")
        rows = self.upper_half
        square = float(np.mean(self.error[rows] ** 2) - np.mean(self.found_se[rows] ** 2))
        return float(np.sqrt(max(0.0, square)))


def level(record: JunctionRecord, detectors: Sequence[str], main: str) -> Level:
    """Return the level of ``expected_detections`` at a junction, for the mean over detectors that were run there.

    Parameters
    ----------
    main
        Name of the score that chooses the first candidate.

    Raises
    ------
    InputError
        If the score was not computed with these models.
    """
    score = f"expected_detections (detectors {'+'.join(models_for(detectors))})"
    if score not in record.scores:
        raise InputError(f"{record.name}.scores", f"no {score}", "Measure the part scores again.")
    measures = [record.detections[detector][name] for detector in detectors for name in RECALLS]
    found = MeasureValues(
        np.mean([measure.values for measure in measures], axis=0),
        np.mean([measure.left_out for measure in measures], axis=0),
    )
    expected, choosing = record.scores[score], record.scores[main]
    defined = found.defined & np.isfinite(expected)
    is_first = defined & (choosing == np.nanmax(choosing[defined], initial=-np.inf))
    error = POINTS * (expected - found.values)
    return Level(
        score, POINTS * expected[defined], POINTS * found.values[defined], POINTS * standard_errors(found)[defined],
        float(error[is_first].mean()) if is_first.any() else float("nan"),
    )  # fmt: skip


def predicted_share(folder: Path, record: JunctionRecord, detectors: Sequence[str]) -> float:
    """Return the mean probability of the models over all candidates and unseen vehicle-frames, in points of 100.

    NaN for a junction without the part ``vehicles``.
    """
    if VEHICLES not in record.infos:
        return float("nan")
    each = [site.shipped.mean() for detector in detectors for site in read_rows(folder, record, detector)]
    return POINTS * float(np.mean(each)) if each else float("nan")


def reliability(folder: Path, records: Sequence[JunctionRecord], detector: str) -> Curves:
    """Return probability, share found and number of vehicle-frames with points in each bin, by junction.

    Junctions without the part ``vehicles`` or without the detector are left out.
    """
    curves = {}
    for record in records:
        if VEHICLES in record.infos and detector in record.detections:
            rows = read_rows(folder, record, detector)
            seen = np.concatenate([site.has_points for site in rows])
            chances, hits = (np.concatenate([getattr(site, name) for site in rows]) for name in ("shipped", "hits"))
            curves[record.name] = curve(chances[seen], hits[seen])
    return curves
