r"""Scores over vehicles: points on target, share of well visible vehicles, expected detections.

Each score is the weighted mean of a function of what a site sees of each of the N vehicle-frames of a record
(:func:`egvs.scoring.targets.weighted_mean`).

*Points*: a concave gain g of the points :math:`n_i` on a vehicle, with occlusion by all others.

.. math:: \frac{1}{N} \sum_{i=1}^{N} g(n_i)

The first point on a vehicle counts more than the hundredth, so that one vehicle with many points does not make up for
one without. g(0) = 0: a vehicle without a point is in a blind spot of the site.

*Expected detections*: the probability that a detector finds the vehicle, from what the site sees of it.

.. math:: \frac{1}{N} \sum_{i=1}^{N} p(x_i), \qquad p(x) = \frac{1}{1 + e^{-b - \sum_t f_t(x)}}

x are :data:`FEATURES`, f_t the trees of a boosted model. The model rises with points, points on sides, spans and the
gap to the neighbour, and falls with the hole between points, with the depression angle and with the spacing of points
(:data:`MONOTONICITY`); range, length and angle of view may have either effect. A vehicle without any point is never
detected.

*Point spacing*: the mean distance of neighbouring points on the vehicle, perpendicular to the line of sight,

.. math:: d = \sqrt{A / n_{alone}}, \quad A = \cos\delta\,(L H s + W H \sqrt{1 - s^2}) + L W |\sin\delta|

with the points :math:`n_{alone}` that it has without other road users in the way, and the silhouette A of a level box
of length L, width W and height H, seen at the angle :math:`\delta` below the horizon and with the sine s between line
of sight and length. It puts sensors of any number of channels, and ranges, on one scale.

There is one model per detector; p is the mean over :data:`DETECTORS`, or the model that ``[score] detector`` names. The
standard error contains how far they disagree (:mod:`egvs.scoring.standard_errors`).

The parameters of the model are in ``target_scores.json`` beside this module. They were trained on the detections of
each detector at junctions that no result is quoted for (``benchmarks/across_junctions`` fits them again;
docs/validity.md shows their accuracy elsewhere). Those junctions had few sizes of vehicles and no losses of returns, so
the models are *corrected for streets*: the logit is scaled and shifted, and further trees are added, which also know
the size of vehicles that are not cars (``street_corrections.json``, made by ``python -m benchmarks.across_junctions
levels``). The models without correction have names of their own, such as ``cluster_uncorrected``. A detection
is a box that overlaps the vehicle by more than 0.7, in the mean of the overlaps from above and in 3D.

*Noticed*: the share of vehicles that people notice in the sweeps, from curves over points that were measured with
labelled sweeps (:mod:`egvs.scoring.noticed`).

*People*: pedestrians and bicycles, for whom there is no model, are expected by points. The share of them that is found
is the share of their observations with at least :data:`PEOPLE_POINTS` points.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, get_args

import numpy as np

from egvs.core import plugins
from egvs.core.errors import InputError, RunError
from egvs.core.grid import FloatArray, IntArray
from egvs.core.special import expit
from egvs.kernels.boosted_trees import add_tree_values
from egvs.scenario.score_config import (
    MEAN_DETECTORS,
    SCORES_GROUP,
    UNCORRECTED,
    Detector,
    is_plugin_score,
    is_vehicle_score,
)
from egvs.scoring.blindspots import SpotVisibility
from egvs.scoring.noticed import CARS, group_members, noticed_chances
from egvs.scoring.targets import SEEN_WELL_POINTS, TargetVisibility, weighted_mean

Gain = Callable[[FloatArray], FloatArray]
"""Gain of points (n,) on vehicles, (n,)."""

TargetScore = Callable[[TargetVisibility, Sequence[str]], FloatArray]
"""Score of each vehicle-frame as a site sees it, or several together, by some detectors, (n,); most scores are the same
for any detector."""

MODEL_FILE = Path(__file__).with_name("target_scores.json")

CORRECTIONS_FILE = Path(__file__).with_name("street_corrections.json")
"""Corrections of the models for streets."""

DETECTORS: tuple[str, ...] = MEAN_DETECTORS
"""Detectors that the score is the mean over, unless one is chosen."""

MODELLED: tuple[str, ...] = tuple(name for name in get_args(Detector) if not name.endswith(UNCORRECTED))
"""All detectors that have a model."""

ISOLATED_GAP_M = 20.0
"""A neighbour farther away than this has no influence."""

MAX_SPACING_M = 5.0
"""Largest spacing of points, also of a vehicle that no beam would meet."""

PEOPLE_POINTS = 20.0
"""Pedestrians and bicycles with at least as many points count as found: there is no model of detectors of people."""

MONOTONICITY = {
    "log_points": 1,
    "log_points_on_sides": 1,
    "length_share": 1,
    "width_share": 1,
    "hole_m": -1,
    "gap_m": 1,
    "depression_deg": -1,
    "length_m": 0,
    "range_m": 0,
    "side": 0,
    "log_spacing": -1,
}
"""For each feature: 1 if the probability may only rise with it, -1 if it may only fall, 0 for either."""

FEATURES = tuple(MONOTONICITY)
"""Features of the model, see :class:`egvs.scoring.targets.TargetVisibility`: logarithms of 1 + points, gaps of at most
:data:`ISOLATED_GAP_M`, and the logarithm of :func:`point_spacing_m`."""


CORRECTION_FEATURES = (*FEATURES, "larger_length_m", "larger_width_m", "larger_height_m")
"""Features of corrected models: also the size of vehicles that are not cars; 0 for cars."""


@dataclass(frozen=True)
class SiteTargetScores:
    """The scores of one site over vehicles, by name.

    Attributes
    ----------
    scores
        Of all vehicle-frames, then with each group of frames left out, then with each detector left out where the
        score depends on several, or with each value of its curves shifted by a standard error, (1 + k,) or (1 + k + d,)
        float64; (1,) without standard errors. NaN where no vehicle counts. Scores of groups of road users are named by
        :func:`group_score`.
    by_period
        Scores in each period alone, in their order; empty without periods.
    missed
        Visibility of vehicles by place; None unless requested.
    """

    scores: Mapping[str, FloatArray]
    by_period: tuple[Mapping[str, float], ...] = ()
    missed: SpotVisibility | None = None


def group_score(score: str, group: str) -> str:
    """Return the name of a score of one group of road users."""
    return f"{score} of {group}"


def log_points(points: FloatArray) -> FloatArray:
    r"""Return :math:`g(n) = \ln(1 + n)`."""
    return np.log1p(points)


def saturating_gain(points: FloatArray) -> FloatArray:
    r"""Return :math:`g(n) = 1 - e^{-n / n_0}`, from 0 to 1, with :data:`SEEN_WELL_POINTS`."""
    return -np.expm1(-points / SEEN_WELL_POINTS)


def points_on_target(visible: TargetVisibility, gain: Gain = log_points, weight: FloatArray | None = None) -> float:
    """Return the mean gain of a site's points; NaN without any vehicle.

    Parameters
    ----------
    visible
        What the site sees.
    gain
        Gain of the points on a vehicle.
    weight
        Weight of each vehicle-frame, (n,) float64, 0 or above; equal weights where it is None.
    """
    return weighted_mean(gain(visible.points), weight)


def seen_well(visible: TargetVisibility, weight: FloatArray | None = None) -> float:
    """Return the share of well visible vehicles, 0 to 1; parameters as in :func:`points_on_target`."""
    return points_on_target(visible, saturating_gain, weight)


def expected_detections(
    visible: TargetVisibility, detectors: Sequence[str] = DETECTORS, weight: FloatArray | None = None
) -> float:
    """Return the share of vehicles that detectors are expected to find, 0 to 1; NaN without any vehicle.

    Parameters
    ----------
    visible
        What the site sees.
    detectors
        Detectors whose probabilities are averaged.
    weight
        Weight of each vehicle-frame, (n,) float64, 0 or above; equal weights where it is None.
    """
    if not len(visible):
        return math.nan
    return weighted_mean(detection_chances(visible, detectors), weight)


def detection_chances(visible: TargetVisibility, detectors: Sequence[str] = DETECTORS) -> FloatArray:
    """Return the probability that each vehicle-frame is detected, averaged over detectors, (n,) float64, 0 to 1.

    Raises
    ------
    KeyError
        For a detector without a model.
    """
    chances: FloatArray = np.mean(chances_by_detector(visible, detectors), axis=0)
    return chances


def chances_by_detector(visible: TargetVisibility, detectors: Sequence[str]) -> FloatArray:
    """Return the probability that each detector detects each vehicle-frame, (d, n) float64, 0 to 1.

    Raises
    ------
    KeyError
        For a detector without a model.
    """
    features = correction_features(visible)
    chances = np.array([detectability_model(name).chances(features) for name in detectors])
    return np.where(visible.points > 0.0, chances, 0.0)


def detectability_features(visible: TargetVisibility) -> FloatArray:
    """Return :data:`FEATURES` of what a site sees, (n, f) float64."""
    return np.column_stack([
        np.log1p(visible.points),
        np.log1p(visible.points_on_sides),
        visible.length_share,
        visible.width_share,
        visible.hole_m,
        np.minimum(visible.record.gap_m, ISOLATED_GAP_M),
        visible.depression_deg,
        visible.record.boxes[:, 3],
        visible.range_m,
        visible.side,
        np.log(point_spacing_m(visible)),
    ])  # fmt: skip


def correction_features(visible: TargetVisibility) -> FloatArray:
    """Return :data:`CORRECTION_FEATURES` of what a site sees, (n, g) float64; the first are those of all models."""
    are_cars = group_members(visible.record)[CARS]
    sizes_m = np.where(are_cars[:, None], 0.0, visible.record.boxes[:, 3:6])
    return np.column_stack([detectability_features(visible), sizes_m])


def point_spacing_m(visible: TargetVisibility) -> FloatArray:
    """Return the spacing of the points on each vehicle without other road users in the way, (n,) float64.

    It is in metres, at most :data:`MAX_SPACING_M`. Several sensors together have the spacing of all their points.
    """
    length_m, width_m, height_m = visible.record.boxes[:, 3:6].T
    depression_rad = np.deg2rad(visible.depression_deg)
    end_on = np.sqrt(np.maximum(1.0 - visible.side**2, 0.0))
    upright_m2 = height_m * (length_m * visible.side + width_m * end_on)
    area_m2 = np.cos(depression_rad) * upright_m2 + np.abs(np.sin(depression_rad)) * length_m * width_m
    alone = visible.points_alone
    per_point_m2 = np.divide(area_m2, alone, out=np.full(len(visible), np.inf), where=alone > 0.0)
    spacing_m: FloatArray = np.minimum(np.sqrt(per_point_m2), MAX_SPACING_M)
    return spacing_m


@dataclass(frozen=True, eq=False)
class DetectabilityModel:
    """Boosted trees over :data:`FEATURES`, in the form that :func:`egvs.kernels.boosted_trees.add_tree_values` takes.

    Attributes
    ----------
    base
        b, the logit before any tree.
    starts
        Nodes starts[t] to starts[t + 1] are those of tree t, (trees + 1,) int64.
    feature, threshold
        Index of the feature that a node splits, -1 for a leaf, (nodes,) int64; and where, (nodes,) float64.
    left, right
        Children of each node, counted from the first of its tree, (nodes,) int64.
    value
        Value of each leaf, (nodes,) float64.
    """

    base: float
    starts: IntArray
    feature: IntArray
    threshold: FloatArray
    left: IntArray
    right: IntArray
    value: FloatArray

    @classmethod
    def of(cls, entry: dict[str, Any]) -> DetectabilityModel:
        """Parse an entry of the file: a tree is a list of nodes [feature, threshold, left, right] or [value]."""
        starts = np.append(0, np.cumsum([len(tree) for tree in entry["trees"]], dtype=np.int64))
        feature = np.full(starts[-1], -1, dtype=np.int64)
        left, right = np.zeros(starts[-1], dtype=np.int64), np.zeros(starts[-1], dtype=np.int64)
        threshold, value = np.zeros(starts[-1]), np.zeros(starts[-1])
        nodes = [node for tree in entry["trees"] for node in tree]
        for i, node in enumerate(nodes):
            if len(node) == 4:
                feature[i], threshold[i], left[i], right[i] = node
            else:
                value[i] = node[0]
        return cls(entry["base"], starts, feature, threshold, left, right, value)

    def chances(self, features: FloatArray) -> FloatArray:
        """Return the probability for each row of :data:`FEATURES` (n, f), or of more features, (n,), 0 to 1.

        Raises
        ------
        ValueError
            If a tree needs a feature that the rows do not have.
        """
        if self.feature.max(initial=-1) >= features.shape[1]:
            raise ValueError(f"expected {self.feature.max() + 1} features, got {features.shape[1]}")
        columns = np.ascontiguousarray(features.T)
        logit = np.full(len(features), self.base)
        nodes = self.feature, self.threshold, self.left, self.right, self.value
        add_tree_values(columns, self.starts, *nodes, logit)
        chance: FloatArray = expit(logit)
        return chance


@cache
def detectability_model(detector: str) -> DetectabilityModel:
    """Return the model of one of :data:`MODELLED`; of ``NAME_uncorrected``, the one without correction."""
    if detector.endswith(UNCORRECTED):
        return uncorrected_model(detector.removesuffix(UNCORRECTED))
    correction = json.loads(CORRECTIONS_FILE.read_text(encoding="utf-8"))["detectors"].get(detector)
    if correction is None:
        return uncorrected_model(detector)
    return DetectabilityModel.of(corrected_entry(_model_entry(detector), correction))


@cache
def uncorrected_model(detector: str) -> DetectabilityModel:
    """Return the model of one of :data:`MODELLED` without correction for streets."""
    return DetectabilityModel.of(_model_entry(detector))


def _model_entry(detector: str) -> dict[str, Any]:
    entry: dict[str, Any] = json.loads(MODEL_FILE.read_text(encoding="utf-8"))["detectors"][detector]
    return entry


def corrected_entry(entry: Mapping[str, Any], correction: Mapping[str, Any]) -> dict[str, Any]:
    """Return an entry of the file of models with its correction.

    Parameters
    ----------
    entry
        ``base`` and ``trees`` of a model.
    correction
        ``scale``, by which the leaves are multiplied, the new ``base``, and further ``trees``.
    """
    scale = correction["scale"]
    trees = [[[scale * node[0]] if len(node) == 1 else node for node in tree] for tree in entry["trees"]]
    return {"base": correction["base"], "trees": [*trees, *correction["trees"]]}


def expected_by_points(points: FloatArray) -> FloatArray:
    """Return whether people on foot or on bicycles count as found, (n,) float64: 1 from :data:`PEOPLE_POINTS` on.

    Examples
    --------
    >>> expected_by_points(np.array([0.0, 19.0, 20.0, 300.0])).tolist()
    [0.0, 0.0, 1.0, 1.0]
    """
    return (points >= PEOPLE_POINTS).astype(np.float64)


def expected_by_detector(visible: TargetVisibility, detectors: Sequence[str]) -> FloatArray:
    """Return the probability that each detector finds each vehicle-frame of a record, (d, n) float64, 0 to 1.

    There is no model of people; see :func:`expected_by_points`.
    """
    if not len(visible):
        return np.empty((len(detectors), 0))
    chances = chances_by_detector(visible, detectors)
    return np.where(visible.record.are_people, expected_by_points(visible.points), chances)


def _score_detection(visible: TargetVisibility, detectors: Sequence[str]) -> FloatArray:
    chances: FloatArray = expected_by_detector(visible, detectors).mean(axis=0)
    return chances


def _score_points(visible: TargetVisibility, _: Sequence[str]) -> FloatArray:
    return log_points(visible.points)


def _score_seen_well(visible: TargetVisibility, _: Sequence[str]) -> FloatArray:
    return saturating_gain(visible.points)


def _score_noticed(visible: TargetVisibility, _: Sequence[str]) -> FloatArray:
    return noticed_chances(visible)


@dataclass(frozen=True)
class VehicleScore:
    """A score of another package, an entry point of the group ``egvs.scores``, by which sites are ranked and planned.

    A site's score is the weighted mean over vehicle-frames. Several sensors count as independent: with values p and q,
    a vehicle counts 1 - (1 - p) (1 - q).

    Attributes
    ----------
    name
        Name of its entry point.
    formula
        What it computes, in words.
    source
        Where it is published.
    function
        Returns the value of each vehicle-frame from what a site sees of it, (n,) float64, 0 to 1. The same input always
        gives the same values.
    """

    name: str
    formula: str
    source: str
    function: Callable[[TargetVisibility], FloatArray]

    def __call__(self, visible: TargetVisibility, _: Sequence[str] = ()) -> FloatArray:
        """Return the value of each vehicle-frame; a RunError for anything but one number from 0 to 1 for each."""
        try:
            values = np.asarray(self.function(visible))
        except Exception as error:  # a foreign function may do anything
            raise RunError(f"score {self.name}: its function raised {error!r}") from error
        n_vehicles = len(visible.points)
        if values.shape != (n_vehicles,) or values.dtype.kind not in "fiub":
            actual = f"{values.dtype} of shape {values.shape}"
        elif n_vehicles and not (values.min() >= 0.0 and values.max() <= 1.0):
            actual = f"values from {values.min():g} to {values.max():g}"
        else:
            return values.astype(np.float64)
        raise RunError(f"score {self.name}: expected {n_vehicles} numbers from 0 to 1, got {actual}")


def load_vehicle_score(name: str) -> VehicleScore:
    """Return the score of another package.

    Raises
    ------
    InputError
        When there is no such score, or it cannot rank sites.
    MissingBackendError
        When it cannot be loaded.
    """
    score = plugins.load_plugin(SCORES_GROUP, name)
    if not isinstance(score, VehicleScore):
        problem = f"{name!r} is a {type(score).__name__}, which cannot rank sites"
        hint = f"Use an {VehicleScore.__module__}.{VehicleScore.__name__}; egvs validate compares other scores."
        raise InputError("score.rank_by", problem, hint)
    if score.name != name:
        problem = f"expected the name {name!r} of its entry point, got {score.name!r}"
        raise plugins.plugin_error(SCORES_GROUP, name, problem)
    return score


class _TargetScores(dict[str, TargetScore]):
    """Scores by name, with those of other packages, which are loaded when they are used."""

    def __missing__(self, name: str) -> TargetScore:
        if not is_plugin_score(name):
            raise KeyError(name)
        return load_vehicle_score(name)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and is_vehicle_score(name)


TARGET_SCORES = _TargetScores(
    expected_detections=_score_detection,
    noticed=_score_noticed,
    points_on_target=_score_points,
    seen_well=_score_seen_well,
)
"""Scores of vehicle-frames by the names that ``[score] rank_by`` and ``additional`` use."""
