"""Do the intervals of correlations hold the truth as often as they say?

``python -m benchmarks.coverage [STUDIES]`` makes up as many studies (1000) of each kind whose truth is known: 13 or 40
sites drawn from a normal distribution of score and detection, detection measured with an error of 0.15 of its spread in
10 blocks that all sites share. It prints in what share of them the 95 % interval holds the truth, and how wide the
intervals are. The truth is that of all sites there could be, in endless traffic. Five minutes on one core.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from typing import Any

import numpy as np
from tests.validation import simulated_studies

from egvs.validation.correlation import COEFFICIENT_KINDS, ConfidenceInterval, Correlation, CorrelationStudy

SITES, RHOS, STUDIES, RESAMPLES = (13, 40), (0.0, 0.5, 0.8, 0.95), 1000, 1000
PAIR = (0.8, 0.5)


def line(what: str, found: list[Correlation], truth: float) -> str:
    """One row of the table."""
    intervals: list[ConfidenceInterval] = [its.interval for its in found if not np.isnan(its.interval.low)]
    low, high = (np.array([getattr(its, end) for its in intervals]) for end in ("low", "high"))
    held = (low <= truth) & (truth <= high)
    return (
        f"{what} | {truth:+.2f} | {held.mean():.1%} | {(truth < low).mean():.1%} | {(truth > high).mean():.1%}"
        f" | {np.median(high - low):.2f} | {len(found) - len(intervals)}"
    )


def main() -> None:
    """Make up studies, and print a table."""
    studies = int(sys.argv[1]) if len(sys.argv) > 1 else STUDIES
    rng = np.random.default_rng(0)
    print("sites, rho, coefficient | truth | held | truth below | truth above | median width | no interval")
    for sites in SITES:
        for rho in RHOS:
            single: dict[Any, list[Correlation]] = defaultdict(list)
            for seed in range(studies):
                study = CorrelationStudy([simulated_studies.junction(rng, sites, (rho,))], seed, RESAMPLES)
                for kind in COEFFICIENT_KINDS:
                    single[kind].append(study.correlation("s0", "ap", kind))
            for kind in COEFFICIENT_KINDS:
                print(line(f"{sites}, {rho}, {kind}", single[kind], simulated_studies.truth(rho, kind)), flush=True)
        both: dict[Any, list[Correlation]] = defaultdict(list)
        for seed in range(studies):
            study = CorrelationStudy([simulated_studies.junction(rng, sites, PAIR)], seed, RESAMPLES)
            for kind in COEFFICIENT_KINDS:
                both[kind].append(study.difference("s0", "s1", "ap", kind))
        for kind in COEFFICIENT_KINDS:
            truth = simulated_studies.truth(PAIR[0], kind) - simulated_studies.truth(PAIR[1], kind)
            print(line(f"{sites}, {PAIR[0]} less {PAIR[1]}, {kind}", both[kind], truth), flush=True)


if __name__ == "__main__":
    main()
