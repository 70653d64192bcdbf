"""Does a higher mount detect less? The table of C: the same places at four heights, compared place by place.

Intervals resample places and blocks of frames together, as those of correlations do; differences are of the same place
and the same frames. Junctions of one role are taken together: the mean of theirs, weighted by their numbers of places.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.validity.agreement import WORDS
from benchmarks.validity.junctions import ROLES
from benchmarks.validity.looking_from import FAST, FEW_PLACES
from benchmarks.validity.low_models import LOW, SENSOR
from benchmarks.validity.pools import SEED
from benchmarks.validity.poses import HEIGHTS_M
from benchmarks.validity.record import Record, measures_of
from benchmarks.validity.tables import Cell, Column, Table, with_interval
from egvs.validation.correlation import MIN_POLES, RESAMPLES, ConfidenceInterval, MeasureValues, Resamples
from egvs.validation.detectors.pointpillars import PointPillars

Floats = NDArray[np.float64]


LESS = {LOW: PointPillars.NAME, SENSOR: LOW}
"""Detectors that are compared with others: what training at one height does, and what the convention does."""


def table(records: Sequence[Record], detectors: Sequence[str]) -> Table:
    """C: means at each height and differences to the lowest; shares and AP in per cent."""
    rows: list[list[Cell]] = []
    for what, first, second, few in _compared(detectors):
        mine = [record for record in records if {first, second or first} <= set(record.detections)]
        for measure in measures_of(first) if mine else ():
            groups = [
                *((r.junction, [r]) for r in mine),
                *((role, [r for r in mine if r.role == role]) for role in ROLES),
            ]
            for name, group in ((name, group) for name, group in groups if group):
                each = [by_height(record, first, second, measure, few) for record in group]
                rows.append([what, WORDS[measure], name, *_cells([r.junction for r in group], each)])
    low, *above = HEIGHTS_M
    head = [Column("detector"), Column("measure"), Column("junction"), Column("locations", "whole")]
    head += [Column(f"{h:g} m", "one") for h in HEIGHTS_M] + [Column(f"{h:g} minus {low:g} m", "one") for h in above]
    caption = (
        "Mean over the grid locations at each mounting height, and differences at the same locations. Shares of"
        " vehicles and AP in per cent (BEV + 3D: up to 200), log points times 100. For two detectors: the first minus"
        " the second, at the same sites."
    )
    return Table("C heights", "C. Mounting height", caption, head, rows)


def _compared(detectors: Sequence[str]) -> Iterator[tuple[str, str, str | None, int | None]]:
    """What a row is called, its detector, one that is taken from it, and from how many places at most."""
    for name in detectors:
        yield name, name, None, None
    if any(name in detectors for name in LESS):
        for name in FAST:
            if name in detectors:
                yield f"{name}, first {FEW_PLACES} locations", name, None, FEW_PLACES
    for first, second in LESS.items():
        if first in detectors and second in detectors:
            yield f"{first} minus {second}", first, second, None


def _cells(junctions: Sequence[str], each: Sequence[list[MeasureValues]]) -> list[Cell]:
    number = sum(len(its[0].values) for its in each)
    if not number:
        return [0, *[None] * (2 * len(HEIGHTS_M) - 1)]
    means = [_mean(junctions, [its[i] for its in each]) for i in range(len(HEIGHTS_M))]
    gaps = [_mean(junctions, [_less(its[i], its[0]) for its in each]) for i in range(1, len(HEIGHTS_M))]
    return [number, *means, *gaps]


def by_height(record: Record, detector: str, less: str | None, measure: str, few: int | None) -> list[MeasureValues]:
    """The measure at the places that have all heights, one a height, place by place in the same order.

    Parameters
    ----------
    less
        Another detector, whose measure is taken from it.
    few
        The first so many places; all when None.
    """
    every = [_places(record, name, measure) for name in (detector, less) if name is not None]
    shared = [place for place in every[0] if all(place in its for its in every)][:few]
    found = []
    for height_m in HEIGHTS_M:
        each = []
        for name, places in zip((detector, less), every, strict=False):
            assert name is not None
            measured, rows = record.detections[name][measure].measured(), [places[place][height_m] for place in shared]
            each.append(MeasureValues(measured.values[rows], measured.left_out[rows]))
        found.append(each[0] if less is None else _less(*each))
    return found


def _places(record: Record, detector: str, measure: str) -> dict[str, dict[float, int]]:
    """Of each place of the grid where the measure is defined at all heights, the row of each height."""
    its = record.detections[detector][measure]
    at: dict[str, dict[float, int]] = {}
    for row, site in enumerate(record.sites[i] for i in its.sites):
        if not site.is_given:
            at.setdefault(site.place, {})[site.height_m] = row
    known = its.measured().defined
    return {
        place: rows for place, rows in at.items() if set(rows) == set(HEIGHTS_M) and known[list(rows.values())].all()
    }


def _less(first: MeasureValues, second: MeasureValues) -> MeasureValues:
    return MeasureValues(first.values - second.values, first.left_out - second.left_out)


def _mean(junctions: Sequence[str], each: Sequence[MeasureValues]) -> Cell:
    """The mean over places of all junctions, in per cent, with its interval."""
    weights = np.array([len(its.values) for its in each], dtype=np.float64)
    value = sum(float(its.values.sum()) for its in each) / weights.sum()
    draws: Floats = np.zeros(RESAMPLES)
    for name, its, weight in zip(junctions, each, weights.tolist(), strict=True):
        if weight:
            drawn = Resamples.draw(name, len(its.values), its.left_out.shape[1], RESAMPLES, SEED)
            draws += drawn.resample_measure(its, np.ones(len(its.values), dtype=np.bool_)).mean(axis=1) * weight
    if 0 < min(filter(None, weights.tolist())) < MIN_POLES:
        return with_interval(100.0 * value, ConfidenceInterval.undefined("too few places"))
    return with_interval(100.0 * value, ConfidenceInterval.from_resamples(100.0 * value, 100.0 * draws / weights.sum()))
