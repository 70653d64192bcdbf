"""Undefined values: sites without a value of a score or measure, and pools without a coefficient."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.validity.agreement import HELD_OUT, TRAINING, WORDS, candidates
from benchmarks.validity.pools import Pools
from benchmarks.validity.record import Record, measures_of
from benchmarks.validity.tables import Cell, Column, Table


def table(each: Sequence[Pools], records: Sequence[Record]) -> Table:
    """Return every coefficient that is undefined or excludes sites, and scores that could not be computed."""
    rows: list[list[Cell]] = []
    for pools in each:
        for measure in measures_of(pools.detector):
            for pool in (name for name in (TRAINING, HELD_OUT) if name in pools.studies):
                for score in candidates(pools, measure):
                    rho = pools.rho(pool, score, measure)
                    if rho.dropped or rho.why:
                        rows.append([
                            pools.detector, WORDS[measure], pool, score, rho.sites, ", ".join(rho.dropped) or None,
                            rho.why or None,
                        ])  # fmt: skip
    rows += [[None, None, record.junction, None, None, None, what] for record in records for what in record.skipped]
    head = [Column("detector"), Column("measure"), Column("junctions"), Column("score"), Column("sites used", "whole"),
            Column("excluded sites"), Column("reason")]  # fmt: skip
    caption = (
        "Sites where a score or a detection measure is undefined; they are excluded from its coefficients. Scores"
        " without a coefficient or an interval, with the reason. A score that is the same at all sites of one junction"
        " has no coefficient over several junctions."
    )
    return Table("0 left out", "Undefined values", caption, head, rows)
