"""Does a higher mount detect less? The table of C: the same places at four heights, compared place by place.

Intervals resample places and blocks of frames together, as those of correlations do; differences are of the same place
and the same frames. Junctions are taken together as the mean of theirs, weighted by their numbers of places.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.validity.agreement import WORDS
from benchmarks.validity.pools import SEED
from benchmarks.validity.poses import HEIGHTS_M
from benchmarks.validity.record import Record, measures_of
from benchmarks.validity.tables import Cell, Column, Table, with_interval
from pipeline.validation.statistics.correlation import RESAMPLES
from pipeline.validation.statistics.intervals import Interval
from pipeline.validation.statistics.junctions import Draws, Measured

Floats = NDArray[np.float64]


def table(records: Sequence[Record], detectors: Sequence[str]) -> Table:
    """C: means at each height and differences to the lowest; shares and AP in per cent."""
    rows: list[list[Cell]] = []
    for detector in detectors:
        mine = [record for record in records if detector in record.detections]
        for measure in measures_of(detector) if mine else ():
            for name, group in [*((r.junction, [r]) for r in mine), ("all", mine)]:
                rows.append([detector, WORDS[measure], name, *_cells(group, detector, measure)])
    low, *above = HEIGHTS_M
    head = [Column("detector"), Column("measure"), Column("junction"), Column("places", "whole")]
    head += [Column(f"{h:g} m", "one") for h in HEIGHTS_M] + [Column(f"{h:g} less {low:g} m", "one") for h in above]
    caption = (
        "Mean over the places of the grid at each mounting height, and differences at the same places. Shares of"
        " vehicles and AP in per cent (BEV + 3D: up to 200), log points times 100."
    )
    return Table("C heights", "C. Mounting height", caption, head, rows)


def _cells(records: Sequence[Record], detector: str, measure: str) -> list[Cell]:
    places = [by_height(record, detector, measure) for record in records]
    number = sum(len(its[0].values) for its in places)
    if not number:
        return [0, *[None] * (2 * len(HEIGHTS_M) - 1)]
    names = [record.junction for record in records]
    means = [_mean(names, [its[i] for its in places]) for i in range(len(HEIGHTS_M))]
    gaps = [_mean(names, [_less(its[i], its[0]) for its in places]) for i in range(1, len(HEIGHTS_M))]
    return [number, *means, *gaps]


def by_height(record: Record, detector: str, measure: str) -> list[Measured]:
    """The measure at the places that have all heights, one a height, place by place in the same order."""
    its = record.detections[detector][measure]
    row = {record.sites[site].name: i for i, site in enumerate(its.sites)}
    at: dict[str, dict[float, int]] = {}
    for site in (record.sites[i] for i in its.sites):
        if not site.is_given:
            at.setdefault(site.place, {})[site.height_m] = row[site.name]
    measured = its.measured()
    whole = [heights for heights in at.values() if set(heights) == set(HEIGHTS_M)]
    whole = [heights for heights in whole if measured.known[list(heights.values())].all()]
    rows = [[heights[h] for heights in whole] for h in HEIGHTS_M]
    return [Measured(measured.values[chosen], measured.left_out[chosen]) for chosen in rows]


def _less(first: Measured, second: Measured) -> Measured:
    return Measured(first.values - second.values, first.left_out - second.left_out)


def _mean(junctions: Sequence[str], each: Sequence[Measured]) -> Cell:
    """The mean over places of all junctions, in per cent, with its interval."""
    weights = np.array([len(its.values) for its in each], dtype=np.float64)
    value = sum(float(its.values.sum()) for its in each) / weights.sum()
    draws: Floats = np.zeros(RESAMPLES)
    for name, its, weight in zip(junctions, each, weights.tolist(), strict=True):
        if weight:
            drawn = Draws.of(name, len(its.values), its.left_out.shape[1], RESAMPLES, SEED)
            draws += drawn.of_measure(its, np.ones(len(its.values), dtype=np.bool_)).mean(axis=1) * weight
    return with_interval(100.0 * value, Interval.of(100.0 * value, 100.0 * draws / weights.sum()))
