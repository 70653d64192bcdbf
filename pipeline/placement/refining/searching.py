"""Looks for the lowest loss in a box, by CMA-ES from several starts.

A quarter of what may be tried is spread at random over the box. The covariance matrix adaptation evolution strategy
(Hansen and Ostermeier 2001; the library ``cma``) then begins twice, each time with half of what is left: at the best of
these points, and where the caller stands. It asks for the loss of a few points at a time and learns from their order
alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pipeline.placement.solving.sight import Floats

Losses = Callable[[Floats], Floats]
"""Of points (n, axes), (n,) float64; finite."""

Ends = tuple[list[float | None], list[float | None]]

_SPREAD = 0.25
"""The share of points that are spread over the whole box."""

_STEP = 0.15
"""How far the first points are from where a search begins, as a share of the box's sides."""


def search(losses: Losses, start: Floats, ends: Ends, evaluations: int, rng: np.random.Generator) -> None:
    """Ask for losses until so many points were asked for at most, or nothing changes any more; who answers keeps the
    best.

    Parameters
    ----------
    start
        A point of the box, (axes,).
    ends
        Lowest and highest of each axis; None for one that comes round at 1.
    rng
        The points depend on it and on the losses alone.
    """
    scouts = rng.random((max(1, int(_SPREAD * evaluations)), len(start)))
    at = losses(scouts)
    left = evaluations - len(scouts)
    _evolve(losses, start, ends, left // 2, rng)
    _evolve(losses, scouts[int(np.argmin(at))], ends, left - left // 2, rng)


def _evolve(losses: Losses, start: Floats, ends: Ends, evaluations: int, rng: np.random.Generator) -> None:
    """One search by CMA-ES."""
    from cma import CMAEvolutionStrategy

    options = {
        "bounds": list(ends),
        "randn": lambda *shape: rng.standard_normal(shape),
        "seed": math.nan,  # leaves NumPy's global state alone
        "verbose": -9,
        "verb_log": 0,
    }
    strategy = CMAEvolutionStrategy(start, _STEP, options)
    while evaluations >= strategy.popsize and not strategy.stop():
        asked = strategy.ask()
        strategy.tell(asked, losses(np.array(asked)).tolist())
        evaluations -= len(asked)
