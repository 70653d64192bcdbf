r"""What no plan can exceed, proved from tangents.

f is concave, so it lies below its tangent at any t0, and with :math:`t_c = \sum_s a_s(c)`

.. math:: F(S) \le \sum_c w_c \big(f(t_{0c}) - f'(t_{0c})\, t_{0c}\big) + \sum_{s \in S} \sum_c w_c f'(t_{0c})\, a_s(c)

a constant and a number for each candidate: the largest sum that the rules allow bounds every plan. It holds for
whatever t0 is tried (for :math:`\min(t, s)` with any slope from 0 to 1, through the corner); good ones come of the
relaxation in which sensors are put up in shares, by Frank and Wolfe's steps (1956). With t0 the totals of a set it is
the bound of Nemhauser, Wolsey and Fisher (1978), :math:`F(S) + \sum` of the largest gains, or above that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline.kernels.placement import together as kernels
from pipeline.placement.solving.rules import Rules
from pipeline.placement.solving.sight import Floats, Ints
from pipeline.placement.solving.terms import Term
from pipeline.placement.solving.together import spread

ROUNDING = 1e-9
"""Bounds are raised by this share: their sums are off by less than 1e-11 of it."""


@dataclass(frozen=True, eq=False)
class Tangent:
    """F(S) is at most ``constant`` plus the sum of ``slope`` over S, for every set S of some candidates.

    Attributes
    ----------
    slope
        Of all candidates, (n,) float64; 0 for those that it says nothing of.
    """

    constant: float
    slope: Floats

    def room(self, rules: Rules, chosen: Sequence[int], candidates: Ints) -> tuple[float, Floats, Ints, Floats]:
        """Of plans that hold ``chosen`` and otherwise some of ``candidates``: what none exceeds; what none exceeds that
        holds each of the candidates, (k,); and what :meth:`Rules.most` picks."""
        slope = self.slope[candidates]
        most, picked, share = rules.most(slope, candidates, chosen)
        whole = self.constant + float(self.slope[list(chosen)].sum()) + most
        room = np.full(len(candidates), whole)
        if not np.isfinite(rules.budget) and len(picked):  # it takes the place of the least one, or of a better one
            least = float(self.slope[picked].min())
            room = np.minimum(whole, whole - least + slope)
        return whole * (1.0 + ROUNDING), room * (1.0 + ROUNDING), picked, share


@dataclass(frozen=True, eq=False)
class Bound:
    """What no plan exceeds.

    Attributes
    ----------
    value
        The bound, never below the value of the plan that is known.
    tangent
        The one that proves it; None where no plan can exceed what is known.
    candidates
        Those that some better plan may hold, ascending.
    """

    value: float
    tangent: Tangent | None
    candidates: Ints


def bounded(
    term: Term,
    rules: Rules,
    chosen: Sequence[int],
    candidates: Ints,
    *,
    known: float,
    steps: int,
    threads: int,
    enough: float = 0.0,
) -> Bound:
    """The best bound on plans that hold ``chosen`` and otherwise some of ``candidates``.

    Candidates that a tangent leaves no room for (a plan with one of them cannot exceed what is known) are dropped on
    the way, so later steps cost less.

    Parameters
    ----------
    known
        The value of a plan; minus infinity where none is known. Nothing below it is looked for.
    steps
        Of Frank and Wolfe's, at most; each takes one pass through what all candidates see.
    enough
        A bound above what is known by this share, or less, ends the search.
    """
    sight, alive = term.sight, candidates
    fixed = np.zeros(sight.number)
    for candidate in chosen:
        _add(term, candidate, 1.0, fixed)
    mine = np.array(chosen, dtype=np.int64)
    value, best, totals, stalled = np.inf, None, fixed.copy(), 0
    for step in range(steps):
        slope, constant = _slope(term, totals, 0.5 / (1.0 + step / 4.0))

        def rise(rows: Ints, slope: Floats = slope) -> Floats:
            summed = np.empty(len(rows))
            kernels.slopes(rows, sight.starts, sight.cells, sight.amounts, term.each_once, slope, summed)
            return summed

        rises = np.zeros(len(sight))
        rises[alive], rises[mine] = spread(rise, alive, threads), rise(mine)
        tangent = Tangent(constant, rises)
        top, room, picked, share = tangent.room(rules, chosen, alive)
        alive = alive[room > known]
        stalled = 0 if best is None or top < value * (1.0 - _WORTHWHILE) else stalled + 1
        if top < value:
            value, best = top, tangent
        if value <= known + enough * abs(known) or not len(alive) or stalled > _PATIENCE:
            break
        goal = fixed.copy()
        for candidate, part in zip(picked.tolist(), share.tolist(), strict=True):
            _add(term, candidate, part, goal)
        totals += (goal - totals) / (step + 1.0)
    return Bound(max(value if len(alive) else known, known), best, alive)


_WORTHWHILE, _PATIENCE = 2e-4, 10
"""Steps that lower the bound by less than this share, one after another, before the search ends."""


def _add(term: Term, candidate: int, share: float, totals: Floats) -> None:
    sight = term.sight
    first, last = int(sight.starts[candidate]), int(sight.starts[candidate + 1])
    kernels.add(first, last, sight.cells, sight.amounts, term.each_once, share, totals)


def _slope(term: Term, totals: Floats, width: float) -> tuple[Floats, float]:
    """Of w f at ``totals``, (cells,); and where all the tangents together start at t = 0. The corner of a capped term
    is rounded over this share of the cap."""
    scale, weight = term.scale, term.weight
    if term.curve == kernels.CAPPED:
        if not np.isfinite(scale):
            return weight, 0.0
        share = np.clip((scale - totals) / (width * scale) + 0.5, 0.0, 1.0) if scale > 0.0 else np.zeros(len(weight))
        return weight * share, float((weight * (1.0 - share)).sum() * scale)
    if term.curve == kernels.LOGARITHM:
        slope = weight / (scale + totals)
        return slope, float((weight * np.log1p(totals / scale) - slope * totals).sum())
    left = np.exp(-totals / scale)
    slope = weight * left / scale
    return slope, float((weight * (1.0 - left) - slope * totals).sum())
