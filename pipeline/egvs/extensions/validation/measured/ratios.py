"""Ratios of sums over labelled boxes, with errors from leaving out one object at a time, in all sweeps."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from egvs.core.grid import FloatArray, IntArray
from egvs.statistics.blocks import jackknife_variance

FEW_OBJECTS = 5
"""Ratios of fewer objects have no error that means anything."""


@dataclass(frozen=True)
class Ratio:
    """A ratio of sums over boxes, and its standard error; NaN without measured points, or with too few objects."""

    value: float
    se: float


def ratio_of_sums(above: FloatArray, below: FloatArray | IntArray, objects: IntArray) -> Ratio:
    """Return the ratio of two sums over boxes, with its standard error from leaving out one object at a time.

    Parameters
    ----------
    above, below
        Of each box, (n,).
    objects
        Object that each box is of, (n,) int64.
    """
    numbers, group = np.unique(objects, return_inverse=True)
    top, bottom = np.bincount(group, weights=above), np.bincount(group, weights=below)
    if not bottom.sum():
        return Ratio(math.nan, math.nan)
    value = float(top.sum() / bottom.sum())
    rest = bottom.sum() - bottom
    if len(numbers) < FEW_OBJECTS or not rest.all():
        return Ratio(value, math.nan)
    return Ratio(value, math.sqrt(float(jackknife_variance((top.sum() - top) / rest))))
