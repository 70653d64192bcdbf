r"""What was found at the sites of a junction, and the same with sites and blocks of frames resampled.

Two things make a correlation uncertain: which sites were looked at, and which frames. A resample draws n of the n sites
with replacement (whole places, where several sites stand at one), and k of the k blocks of frames; the blocks are the
same for all sites, for all see the same traffic.

Average precision is not computed anew for each draw of blocks. It is linear enough in the blocks: with
:math:`\theta_{(g)}` the measure without block g, :math:`\bar\theta` their mean, and block g drawn :math:`w_g` times,

.. math:: \theta^* = \theta + \sqrt{\frac{k-1}{k}} \sum_g w_g (\bar\theta - \theta_{(g)})

The root makes the variance over draws the jackknife's; without it the bootstrap's would be short by (k - 1) / k of k
independent blocks (Efron and Tibshirani 1993, sections 11.5 and 20.3: the bootstrap of the jackknife's linear form).

The scores are taken as they are. What their own traffic leaves open is no part of this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from pipeline.validation.metrics.leave_out import Estimate


@dataclass(frozen=True)
class Measured:
    """A measure of detection at the sites of a junction.

    Attributes
    ----------
    values
        (n,) float64, NaN where it is not defined.
    left_out
        With each block of frames left out, (n, blocks) float64.
    """

    values: NDArray[np.float64]
    left_out: NDArray[np.float64]

    @classmethod
    def of(cls, estimates: Sequence[Estimate]) -> Measured:
        """From the estimate at each site."""
        return cls(np.array([its.value for its in estimates]), np.stack([its.left_out for its in estimates]))

    @property
    def known(self) -> NDArray[np.bool_]:
        """The sites at which it is defined, with and without each block, (n,)."""
        return np.isfinite(self.values) & np.isfinite(self.left_out).all(axis=1)


@dataclass(frozen=True)
class Junction:
    """What was found at the sites of a junction.

    Attributes
    ----------
    name
        Of the junction.
    sites
        Their names, n.
    scores
        By name, (n,) float64 each, turned so that more is better; NaN where a score is not defined.
    measures
        By name, of all the same blocks.
    places
        Where each site stands, for sites that stand at one place (at several heights) are much alike: they are drawn
        together. Empty where each has a place of its own.
    """

    name: str
    sites: tuple[str, ...]
    scores: Mapping[str, NDArray[np.float64]]
    measures: Mapping[str, Measured]
    places: tuple[str, ...] = ()

    @property
    def blocks(self) -> int:
        """How many blocks of frames there are."""
        return int(next(iter(self.measures.values())).left_out.shape[1])

    def known(self, scores: Sequence[str], measure: str) -> NDArray[np.bool_]:
        """The sites at which all of these are defined, (n,) bool."""
        known = self.measures[measure].known.copy()
        for score in scores:
            known &= np.isfinite(self.scores[score])
        return known

    def places_of(self, known: NDArray[np.bool_]) -> int:
        """At how many places some of the sites stand, (n,) bool."""
        if not self.places:
            return int(known.sum())
        return len({place for place, has in zip(self.places, known, strict=True) if has})


@dataclass(frozen=True)
class Draws:
    """Resamples of m sites and k blocks of a junction.

    Attributes
    ----------
    sites
        Rows of the sites drawn, (resamples, m) int64.
    blocks
        How often each block is drawn, (resamples, k) int64.
    """

    sites: NDArray[np.int64]
    blocks: NDArray[np.int64]

    @classmethod
    def of(cls, junction: str, sites: int, blocks: int, resamples: int, seed: int, places: Sequence[str] = ()) -> Draws:
        """The same for the same junction, numbers, places and seed, whatever else is drawn.

        Sites of one place are drawn together: places with as many sites among each other, so that all resamples are of
        as many sites.
        """
        rng = np.random.default_rng(np.random.SeedSequence((seed, crc32(junction.encode()))))
        drawn = rng.multinomial(blocks, np.full(blocks, 1.0 / blocks), resamples)
        at: dict[str | int, list[int]] = {}
        for site in range(sites):
            at.setdefault(places[site] if places else site, []).append(site)
        rows = []
        for size in sorted({len(its) for its in at.values()}):
            alike = np.array([its for its in at.values() if len(its) == size])
            rows.append(alike[rng.integers(0, len(alike), (resamples, len(alike)))].reshape(resamples, -1))
        return cls(np.concatenate(rows, axis=1), drawn)

    def of_score(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """A score, (m,), at the sites drawn, (resamples, m)."""
        return values[self.sites]

    def of_measure(self, measured: Measured, known: NDArray[np.bool_]) -> NDArray[np.float64]:
        """A measure at the sites drawn from those that are known, in the blocks drawn, (resamples, m)."""
        left_out = measured.left_out[known]
        k = left_out.shape[1]
        moved = self.blocks @ (left_out.mean(axis=1, keepdims=True) - left_out).T
        return np.take_along_axis(measured.values[known] + np.sqrt((k - 1) / k) * moved, self.sites, axis=1)
