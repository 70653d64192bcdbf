"""What is not defined: sites that a score or a measure says nothing of, and pools that so have no coefficient."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.validity.agreement import HELD_OUT, TRAINING, WORDS, candidates
from benchmarks.validity.pools import Pools
from benchmarks.validity.record import Record, measures_of
from benchmarks.validity.tables import Cell, Column, Table


def table(each: Sequence[Pools], records: Sequence[Record]) -> Table:
    """Every coefficient of the pools that is from fewer sites than others, or is not there; scores not worked out."""
    rows: list[list[Cell]] = []
    for pools in each:
        for measure in measures_of(pools.detector):
            for pool in (name for name in (TRAINING, HELD_OUT) if name in pools.studies):
                for score in candidates(pools, measure):
                    its = pools.rho(pool, score, measure)
                    if its.dropped or its.why:
                        rows.append([
                            pools.detector, WORDS[measure], pool, score, its.sites, ", ".join(its.dropped) or None,
                            its.why or None,
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
