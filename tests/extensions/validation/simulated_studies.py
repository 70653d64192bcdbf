"""Correlation studies with known coefficients: score and detection of sites drawn from a normal distribution."""

from __future__ import annotations

import math

import numpy as np

from egvs.extensions.validation.correlation import JunctionScores, MeasureValues

NOISE = 0.15
"""Standard error of detection, in units of its spread over sites."""


def truth(rho: float, kind: str) -> float:
    """The coefficient of two normal variables whose correlation is rho."""
    if kind == "pearson":
        return rho
    return 6 / math.pi * math.asin(rho / 2) if kind == "spearman" else 2 / math.pi * math.asin(rho)


def junction(
    rng: np.random.Generator, sites: int, rhos: tuple[float, ...], blocks: int = 10, name: str = "made up"
) -> JunctionScores:
    """Scores s0, s1 .. with correlations rhos, and detection measured in blocks that sites have in common.

    A third of the variance between blocks is common to all sites: the same traffic."""
    true = rng.normal(size=sites)
    scores = {f"s{k}": rho * true + math.sqrt(1 - rho**2) * rng.normal(size=sites) for k, rho in enumerate(rhos)}
    noise = math.sqrt(1 / 3) * rng.normal(size=(1, blocks)) + math.sqrt(2 / 3) * rng.normal(size=(sites, blocks))
    means = true[:, None] + NOISE * math.sqrt(blocks) * noise
    left_out = (means.sum(axis=1, keepdims=True) - means) / (blocks - 1)
    return JunctionScores(
        name, tuple(f"c{k:02}" for k in range(sites)), scores, {"ap": MeasureValues(means.mean(axis=1), left_out)}
    )
