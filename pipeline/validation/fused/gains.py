r"""How much more is found with one sensor more, and how sure that is.

Both clouds are of the same frames, so the difference is told more sharply than either: it is jackknifed itself, with
each block of frames left out of both (:mod:`pipeline.validation.metrics.leave_out`).

.. math:: g_k = m_k - m_{k-1}, \qquad g_{k(b)} = m_{k(b)} - m_{k-1(b)}
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.validation.agreement import main_measure
from pipeline.validation.detection import ALL, SiteDetection
from pipeline.validation.fused.plans import Group
from pipeline.validation.metrics.leave_out import BLOCKS, Estimate, blocks_of

_SAME_OBJECTS = (ALL, "cars")
"""Sets of objects that are the same for any number of sensors."""

_NONE = Estimate(math.nan, np.full(BLOCKS, math.nan), math.nan)


@dataclass(frozen=True)
class FusedDetection:
    """What one detector finds with the first sensors of a plan, of one set of objects.

    Attributes
    ----------
    gain
        By how much the measure that the detector is shown by is more than with one sensor less; of the first, than with
        none. NaN for sets of objects that depend on the sensors.
    """

    sites: tuple[str, ...]
    detection: SiteDetection
    gain: Estimate


def with_gains(groups: Sequence[Group], rows: Sequence[SiteDetection]) -> tuple[FusedDetection, ...]:
    """Rows of groups, each of which has one sensor more than the one before, with their gains."""
    by_row = {(row.site, row.detector, row.objects_of): row for row in rows}
    before = {group.name: other.name for other, group in itertools.pairwise(groups)}
    sites = {group.name: tuple(site.name for site in group.sites) for group in groups}
    found = []
    for row in rows:
        measure, gain = main_measure(row.detector), _NONE
        if row.objects_of in _SAME_OBJECTS:
            gain = row.measures[measure]
            if row.site in before:
                less = by_row[before[row.site], row.detector, row.objects_of].measures[measure]
                gain = difference(gain, less, row.frames)
        found.append(FusedDetection(sites[row.site], row, gain))
    return tuple(found)


def difference(one: Estimate, other: Estimate, frames: int) -> Estimate:
    """One measure less another one of the same frames."""
    values = np.concatenate([[one.value - other.value], one.left_out - other.left_out])
    return Estimate.of(values, np.bincount(blocks_of(frames)))
