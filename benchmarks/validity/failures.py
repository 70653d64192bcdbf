"""Table E: where a score fails, i.e. the sites whose ranks by score and by detection differ most.

Further columns help to explain it: vehicles that are never seen or have few points, what static geometry and other
vehicles hide, and the distance of vehicles.
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
from egvs.clouds.sweeps import POINT_COUNTS_NAME

WORST = 3
"""Number of sites per junction and score."""

_PER_CENT = 100.0

COLUMNS = [
    Column("junction"), Column("score"), Column("site"), Column("height, m", "one"), Column("detection", "one"),
    Column("rank by score", "whole"), Column("rank by detection", "whole"), Column("number of sites", "whole"),
    Column("never seen, %", "one"), Column("1 to 19 points, %", "one"), Column("hidden by statics, %", "one"),
    Column("hidden by traffic, %", "one"), Column("mean distance, m", "one"),
]  # fmt: skip


def tables(each: Sequence[Pools]) -> Iterator[Table]:
    """E: yield a table per detector, for the default EGVS and the best score on training junctions."""
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
    """Return rows of the sites with the largest differences of ranks; the first ones of equals."""
    estimates = record.detections[detector][measure]
    sites = np.array(estimates.sites)
    values, scores = np.array(estimates.values), np.array(record.scores[score])[sites]
    known = np.isfinite(values) & np.isfinite(scores)
    sites, values, scores = sites[known], values[known], scores[known]
    by_score, by_detection = (rankdata(-estimates, method="min") for estimates in (scores, values))
    far = np.argsort(-np.abs(by_score - by_detection), kind="stable")[:WORST]
    return [
        [
            record.junction, score, record.sites[sites[i]].name, number(record.sites[sites[i]].height_m),
            number(_PER_CENT * values[i]), int(by_score[i]), int(by_detection[i]), len(sites),
            *_explanation(record, int(sites[i])),
        ]
        for i in far.tolist()
    ]  # fmt: skip


def _explanation(record: Record, site: int) -> list[Cell]:
    points = record.detections[POINT_COUNTS_NAME]
    seen_1, seen_20 = (points[name].values[site] for name in ("seen_1", "seen_20"))
    entropy_seen = record.scores["entropy_seen"][site]
    alone, in_traffic = (str(Setting(1.0, DEFAULT.voxel_m, occlusion)) for occlusion in (False, True))
    crossed = record.scores[alone][site]
    hidden = 1.0 - record.scores[in_traffic][site] / crossed if crossed > 0 else math.nan
    shares = (1.0 - seen_1, seen_1 - seen_20, 1.0 - entropy_seen, hidden)
    return [*(number(_PER_CENT * share) for share in shares), number(record.sites[site].distance_m)]
