"""Where does a score fail? The table of E: the sites whose rank by score is farthest from their rank by detection.

With each stand numbers that say why it may be: how many vehicles it never sees or sees with few points, what static
geometry and other vehicles hide, how far vehicles are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.stats import rankdata

from benchmarks.validity.agreement import TRAINING, WORDS, candidates
from benchmarks.validity.pools import DEFAULT, Pools, Setting
from benchmarks.validity.record import Record, measures_of
from benchmarks.validity.tables import Cell, Column, Table, number
from egvs.validation.sweeps import POINT_COUNTS_NAME

WORST = 3
"""Sites that are named a junction and score."""

_PER_CENT = 100.0

COLUMNS = [
    Column("junction"), Column("score"), Column("site"), Column("height, m", "one"), Column("detection", "one"),
    Column("rank by score", "whole"), Column("rank by detection", "whole"), Column("number of sites", "whole"),
    Column("never seen, %", "one"), Column("1 to 19 points, %", "one"), Column("hidden by statics, %", "one"),
    Column("hidden by traffic, %", "one"), Column("mean distance, m", "one"),
]  # fmt: skip


def tables(each: Sequence[Pools]) -> Iterator[Table]:
    """E: a table a detector, for the default EGVS and the score that is best on training junctions."""
    for pools in each:
        measure = measures_of(pools.detector)[0]
        best = pools.best(TRAINING, candidates(pools, measure), measure) if TRAINING in pools.studies else None
        names = list(dict.fromkeys(name for name in (str(DEFAULT), best) if name is not None))
        rows = [
            row for record in pools.records for name in names for row in worst(record, pools.detector, measure, name)
        ]
        caption = (
            f"The {WORST} sites of each junction whose ranks by score and by {WORDS[measure]} ({pools.detector}) differ"
            " most; rank 1 is best. Detection in per cent. Hidden by statics: share of the traffic's entropy in voxels"
            " that no beam crosses. Hidden by traffic: share of the rest that moving occlusion removes."
        )
        yield Table(f"E {pools.detector}", "E. Where scores fail", caption, COLUMNS, rows)


def worst(record: Record, detector: str, measure: str, score: str) -> list[list[Cell]]:
    """Rows of the sites with the largest differences of ranks; of equals the first."""
    its = record.detections[detector][measure]
    sites = np.array(its.sites)
    values, foretold = np.array(its.values), np.array(record.scores[score])[sites]
    known = np.isfinite(values) & np.isfinite(foretold)
    sites, values, foretold = sites[known], values[known], foretold[known]
    by_score, by_detection = (rankdata(-its, method="min") for its in (foretold, values))
    far = np.argsort(-np.abs(by_score - by_detection), kind="stable")[:WORST]
    return [
        [
            record.junction, score, record.sites[sites[i]].name, number(record.sites[sites[i]].height_m),
            number(_PER_CENT * values[i]), int(by_score[i]), int(by_detection[i]), len(sites),
            *_why(record, int(sites[i])),
        ]
        for i in far.tolist()
    ]  # fmt: skip


def _why(record: Record, site: int) -> list[Cell]:
    points = record.detections[POINT_COUNTS_NAME]
    seen_1, seen_20 = (points[name].values[site] for name in ("seen_1", "seen_20"))
    seen = record.scores["entropy_seen"][site]
    alone, in_traffic = (str(Setting(1.0, DEFAULT.voxel_m, occlusion)) for occlusion in (False, True))
    crossed = record.scores[alone][site]
    hidden = 1.0 - record.scores[in_traffic][site] / crossed if crossed > 0 else math.nan
    shares = (1.0 - seen_1, seen_1 - seen_20, 1.0 - seen, hidden)
    return [*(number(_PER_CENT * share) for share in shares), number(record.sites[site].distance_m)]
