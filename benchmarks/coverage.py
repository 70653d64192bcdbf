"""Check that confidence intervals of correlations contain the truth as often as they should.

``python -m benchmarks.coverage [STUDIES]`` generates random studies (1000 of each kind) with a known truth: 13 or 40
sites whose score and detection are normally distributed; detection is measured with an error of 0.15 standard
deviations in 10 blocks that all sites share. It prints how many of the 95 % intervals contain the truth, and their
width. The truth is that of infinitely many sites and frames. Takes five minutes on one core.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from typing import Any

import numpy as np
from tests.extensions.validation import simulated_studies

from egvs.extensions.validation.correlation import ConfidenceInterval, Correlation, CorrelationStudy
from egvs.statistics.ranks import COEFFICIENT_KINDS

SITES, RHOS, STUDIES, RESAMPLES = (13, 40), (0.0, 0.5, 0.8, 0.95), 1000, 1000
PAIR = (0.8, 0.5)


def line(what: str, correlations: list[Correlation], truth: float) -> str:
    """Return a row of the table."""
    intervals: list[ConfidenceInterval] = [one.interval for one in correlations if not np.isnan(one.interval.low)]
    low, high = (np.array([getattr(interval, end) for interval in intervals]) for end in ("low", "high"))
    contained = (low <= truth) & (truth <= high)
    return (
        f"{what} | {truth:+.2f} | {contained.mean():.1%} | {(truth < low).mean():.1%} | {(truth > high).mean():.1%}"
        f" | {np.median(high - low):.2f} | {len(correlations) - len(intervals)}"
    )


def main() -> None:
    """Generate studies, and print the table."""
    studies = int(sys.argv[1]) if len(sys.argv) > 1 else STUDIES
    rng = np.random.default_rng(0)
    print("sites, rho, coefficient | truth | contained | truth below | truth above | median width | no interval")
    for sites in SITES:
        for rho in RHOS:
            single: dict[Any, list[Correlation]] = defaultdict(list)
            for seed in range(studies):
                study = CorrelationStudy([simulated_studies.junction(rng, sites, (rho,))], seed, RESAMPLES)
                for kind in COEFFICIENT_KINDS:
                    single[kind].append(study.correlation("s0", "ap", kind))
            for kind in COEFFICIENT_KINDS:
                print(line(f"{sites}, {rho}, {kind}", single[kind], simulated_studies.truth(rho, kind)), flush=True)
        differences: dict[Any, list[Correlation]] = defaultdict(list)
        for seed in range(studies):
            study = CorrelationStudy([simulated_studies.junction(rng, sites, PAIR)], seed, RESAMPLES)
            for kind in COEFFICIENT_KINDS:
                differences[kind].append(study.difference("s0", "s1", "ap", kind))
        for kind in COEFFICIENT_KINDS:
            truth = simulated_studies.truth(PAIR[0], kind) - simulated_studies.truth(PAIR[1], kind)
            print(line(f"{sites}, {PAIR[0]} less {PAIR[1]}, {kind}", differences[kind], truth), flush=True)


if __name__ == "__main__":
    main()
