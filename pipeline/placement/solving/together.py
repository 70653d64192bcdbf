"""A set of candidates at work: what they see together, what each further one would add."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from pipeline.core.parallel import in_order
from pipeline.kernels.placement import together as kernels
from pipeline.placement.solving.sight import Floats, Ints, Row
from pipeline.placement.solving.terms import Term


class Together:
    """What a set of candidates sees. Totals are whole numbers: neither order nor threads matter.

    Parameters
    ----------
    terms
        The sums that may be asked for.
    chosen
        Candidates to begin with.
    threads
        That gains of many are worked out on.
    """

    def __init__(self, terms: Sequence[Term], chosen: Iterable[int] = (), threads: int = 1) -> None:
        self._threads = threads
        self._sights = {(id(term.sight), term.each_once): term.sight for term in terms}
        self._totals = {key: np.zeros(sight.number, dtype=np.int64) for key, sight in self._sights.items()}
        self.chosen: list[int] = []
        for candidate in chosen:
            self.add(candidate)

    def add(self, candidate: int) -> None:
        """One more."""
        self._change(candidate, 1)
        self.chosen.append(candidate)

    def remove(self, candidate: int) -> None:
        """One less; ValueError where it is not there."""
        self.chosen.remove(candidate)
        self._change(candidate, -1)

    def _change(self, candidate: int, times: int) -> None:
        for key, sight in self._sights.items():
            first, last = int(sight.starts[candidate]), int(sight.starts[candidate + 1])
            kernels.add(first, last, sight.cells, sight.amounts, key[1], np.int64(times), self._totals[key])

    def value(self, term: Term) -> float:
        """The sum for this set, rounded once."""
        return term.exact(self._totals[id(term.sight), term.each_once])

    def value_with(self, term: Term, row: Row) -> float:
        """The sum for this set and a pose that sees ``row``, rounded once."""
        totals = self._totals[id(term.sight), term.each_once].copy()
        kernels.add(0, len(row.cells), row.cells, row.amounts, term.each_once, np.int64(1), totals)
        return term.exact(totals)

    def gains(self, term: Term, candidates: Ints) -> Floats:
        """What each of some candidates would add, (n,) float64; off by rounding alone (1e-11 of the sum)."""
        totals, sight = self._totals[id(term.sight), term.each_once], term.sight

        def of(rows: Ints) -> Floats:
            gained = np.empty(len(rows))
            entries = sight.starts, sight.cells, sight.amounts
            kernels.gains(rows, *entries, term.each_once, totals, term.weight, term.curve, term.scale, gained)
            return gained

        return spread(of, candidates, self._threads)

    def totals(self, term: Term) -> Ints:
        """The amounts in each cell, (cells,); not to be written to."""
        return self._totals[id(term.sight), term.each_once]


def spread(work: Callable[[Ints], Floats], candidates: Ints, threads: int) -> Floats:
    """``work`` for some candidates, on some threads."""
    if threads == 1 or len(candidates) < _FEW:
        return work(candidates)
    parts = np.array_split(candidates, 4 * threads)
    return np.concatenate(list(in_order(work, parts, threads)))


_FEW = 64
"""Candidates for which threads are not worth starting."""
