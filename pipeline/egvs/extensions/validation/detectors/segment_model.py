"""What the ``range_image`` detector learnt about segments: kind, box and confidence of each.

The model is a JSON file beside this module, ``range_image.json``: boosted decision trees, one per line, and how they
were made (``python -m benchmarks.range_image_model``). It has

- a classifier of segments: one vehicle of a kind of :data:`VEHICLE_KINDS`, something else, or several road users;
- for each kind of vehicle, how far the four sides of a vehicle and its roof lie beyond the visible points
  (:data:`MARGINS`): the sizes that are usual for the kind are in these trees;
- the share of views and overlaps (from above and in space; 0.5 and 0.7) in which the resulting box is right.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.kernels.boosted_trees import add_tree_values

MODEL_FILE = Path(__file__).with_name("range_image.json")

VEHICLE_KINDS = ("car", "van", "long")
"""Kinds of vehicles: cars; vans; lorries, buses, trailers and trams."""

SEGMENT_KINDS = (*VEHICLE_KINDS, "other", "several")
"""Kinds of segments: ``other`` is a pedestrian, a two-wheeler or nothing, ``several`` more than one road user."""

MARGINS = ("low_a", "high_a", "low_b", "high_b", "top")
"""What is learnt of a box, in metres: how far its sides are beyond the rectangle of the points, and its roof above."""


@dataclass(frozen=True, eq=False)
class BoostedTrees:
    """A sum of decision trees.

    Attributes
    ----------
    base
        Added to the sum.
    starts, feature, threshold, below, above, value
        Nodes of all trees, see :func:`egvs.kernels.boosted_trees.add_tree_values`.
    """

    base: float
    starts: IntArray
    feature: IntArray
    threshold: FloatArray
    below: IntArray
    above: IntArray
    value: FloatArray

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> BoostedTrees:
        """Return the trees of one part of the file: ``base``, and for each tree five lists of its nodes."""
        columns: list[list[float]] = [[], [], [], [], []]
        starts = [0]
        for tree in content["trees"]:
            for column, values in zip(columns, tree, strict=True):
                column += values
            starts.append(len(columns[0]))
        feature, threshold, below, above, value = (np.array(column, dtype=np.float64) for column in columns)
        whole = [numbers.astype(np.int64) for numbers in (feature, below, above)]
        return cls(
            float(content["base"]), np.array(starts, dtype=np.int64), whole[0], threshold, whole[1], whole[2], value
        )

    def predict(self, features: FloatArray) -> FloatArray:
        """Return the sum for each row of features (n, f), (n,) float64."""
        total = np.full(len(features), self.base)
        add_tree_values(
            np.ascontiguousarray(features.T), self.starts, self.feature, self.threshold, self.below, self.above,
            self.value, total,
        )  # fmt: skip
        return total


@dataclass(frozen=True, eq=False)
class SegmentModel:
    """The complete model.

    Attributes
    ----------
    kinds
        Of each of :data:`SEGMENT_KINDS`, the logarithm of its probability, up to a constant.
    margins
        Of each of :data:`VEHICLE_KINDS`, in the order of :data:`MARGINS`, metres.
    confidence
        The share of views and overlaps in which a box is right.
    """

    kinds: tuple[BoostedTrees, ...]
    margins: Mapping[str, tuple[BoostedTrees, ...]]
    confidence: BoostedTrees

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> SegmentModel:
        """Return the model from the content of its file."""
        margins = {}
        for kind in VEHICLE_KINDS:
            margins[kind] = tuple(BoostedTrees.from_json(content["margins"][kind][name]) for name in MARGINS)
        kinds = tuple(BoostedTrees.from_json(content["kinds"][kind]) for kind in SEGMENT_KINDS)
        return cls(kinds, margins, BoostedTrees.from_json(content["confidence"]))

    def kind_probabilities(self, features: FloatArray) -> FloatArray:
        """Return the probability of each of :data:`SEGMENT_KINDS`, (n, kinds) float64, from features (n, f)."""
        logits = np.column_stack([trees.predict(features) for trees in self.kinds])
        weights = np.exp(logits - logits.max(axis=1, keepdims=True, initial=-np.inf))
        probabilities: FloatArray = weights / weights.sum(axis=1, keepdims=True)
        return probabilities

    def margins_m(self, features: FloatArray, kind: IntArray) -> FloatArray:
        """Return :data:`MARGINS` of segments, (n, 5) float64.

        Parameters
        ----------
        features
            (n, f) float64.
        kind
            Index into :data:`VEHICLE_KINDS`, (n,) int64.
        """
        margins = np.zeros((len(features), len(MARGINS)))
        for number, name in enumerate(VEHICLE_KINDS):
            rows = np.flatnonzero(kind == number)
            for column, trees in enumerate(self.margins[name]):
                margins[rows, column] = trees.predict(features[rows])
        return margins


@cache
def read_model(path: Path = MODEL_FILE) -> SegmentModel:
    """Read a model.

    Raises
    ------
    InputError
        If the file is missing or is not such a model.
    """
    try:
        return SegmentModel.from_json(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as error:
        problem = f"expected a model of segments, got {type(error).__name__}: {error}"
        raise InputError(path, problem, "Install egvs again.") from None


@cache
def model_digest(path: Path = MODEL_FILE) -> str:
    """Return the sha256 of the model's file."""
    return files.hash_file(path)
