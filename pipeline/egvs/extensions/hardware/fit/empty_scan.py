"""The empty scan of a site, from several sweeps with traffic: per pulse the farthest range that persists.

Vehicles hide the background and never lie behind it. So the background of a pulse is its farthest range that occurs in
at least three sweeps and a fifth of them; single returns farther away (reflections, spray) do not persist. A vehicle
that stands still in all sweeps counts as background: take sweeps that are minutes apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from egvs.core.grid import FloatArray
from egvs.extensions.hardware.fit.beam_angles import BeamAngles

MIN_SWEEPS = 3
MIN_RETURNS, MIN_SHARE = 3, 0.2
TOLERANCE_M, TOLERANCE_SHARE = 0.15, 0.005
"""Ranges of one surface differ by at most 0.15 m and 0.5 %, twice that for a return in front of it."""

BACKGROUND, TRAFFIC, UNKNOWN = 0, 1, 2
"""Labels of returns: on (or behind) the background, in front of it, of a pulse without a known background."""


@dataclass(frozen=True)
class EmptyScanFit:
    """The background, and the labels of all returns.

    Attributes
    ----------
    range_m
        (channels, azimuths); NaN for a pulse whose background is unknown.
    labels
        Label of each pulse's return in each sweep, (sweeps, channels, azimuths) uint8; of no meaning without a return.
    counts
        Number of returns with each label.
    """

    range_m: FloatArray
    labels: NDArray[np.uint8]
    counts: tuple[int, int, int]


def fit_empty_scan(grids: list[FloatArray]) -> EmptyScanFit:
    """Return the background of at least :data:`MIN_SWEEPS` sweeps, whose ranges are (channels, azimuths) each."""
    stack = np.stack(grids)
    needed = max(MIN_RETURNS, math.ceil(MIN_SHARE * len(grids)))
    ascending = np.sort(stack, axis=0)  # NaN last
    background = np.full(stack.shape[1:], np.nan)
    for index in range(len(grids) - needed, -1, -1):
        # The farthest range of this group of ``needed`` neighbours must be near its nearest.
        near, far = ascending[index], ascending[index + needed - 1]
        with np.errstate(invalid="ignore"):
            persists = np.isnan(background) & (far - near <= tolerance_m(far))
        background[persists] = np.median(ascending[index : index + needed], axis=0)[persists]
    with np.errstate(invalid="ignore"):
        in_front = stack < background - 2.0 * tolerance_m(background)
    labels = np.where(np.isnan(background), UNKNOWN, np.where(in_front, TRAFFIC, BACKGROUND)).astype(np.uint8)
    returned = np.isfinite(stack)
    counts = np.bincount(labels[returned], minlength=3)
    return EmptyScanFit(background, labels, (int(counts[0]), int(counts[1]), int(counts[2])))


def tolerance_m(range_m: FloatArray) -> FloatArray:
    """Return how far apart ranges of one surface may be."""
    return TOLERANCE_M + TOLERANCE_SHARE * range_m


def points_of(range_m: FloatArray, angles: BeamAngles) -> FloatArray:
    """Return the points at these ranges of all pulses, (channels, azimuths, 3), in the sensor's frame."""
    return angles.origins_m() + angles.directions() * range_m[..., None]
