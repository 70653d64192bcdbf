r"""Estimates how far a score may be off because the traffic was short.

The TPOG keeps its counts block by block. Leave one group of blocks out, compute every site's score from the rest, and
do so for each group: the delete-a-group jackknife. With k groups of T_g frames, h_g = T / T_g, the score S of all
frames and S_(g) of all but group g (Busing, Meijer, van der Leeden, Statistics and Computing 9, 1999),

.. math:: \tilde S = k S - \sum_g (1 - T_g / T) S_{(g)}, \qquad P_g = h_g S - (h_g - 1) S_{(g)}, \qquad
          se^2 = \frac{1}{k} \sum_g \frac{(P_g - \tilde S)^2}{h_g - 1}, \qquad bias = S - \tilde S

and an interval is :math:`S - bias \pm t_{k-1} \, se`. The entropy is concave, so that few frames score too low: the
bias is below 0 and shrinks like 1 / T. Of a TPOG that was mixed from several records, the variances and the biases add
up, and t has the degrees of freedom of Satterthwaite (Biometrics Bulletin 2, 1946).

Why not the bootstrap, resampling blocks with replacement? Measured over independent runs of SUMO (docs/accuracy.md),
with 10 blocks its standard errors are too short, its intervals cover 81 % where 90 % was asked for, it takes hundreds
of scores a site instead of ten, and it needs random numbers. The jackknife's intervals cover 89 %.

Groups must be long beside the traffic's memory: how blocks are joined to groups stands in
:mod:`pipeline.scoring.leave_out`. What a record that is short beside its memory still hides widens the error
(:func:`pipeline.scoring.memory.widening`). When neighbouring groups are alike all the same, they are joined in pairs.
Groups shorter than the window that the memory itself is estimated in, and groups that stay alike, give a warning.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr, stdtrit

from pipeline.artefacts.readers import SEPARABLE
from pipeline.core.findings import Finding
from pipeline.scoring import memory
from pipeline.scoring.leave_out import FEWEST, LONG, Groups

LEVEL = 0.9
"""Confidence of intervals."""

_ALIKE = 1.645
"""One-sided 5 % point of the normal distribution, for the test of neighbouring groups."""


@dataclass(frozen=True)
class Stratum:
    """What leaving out the groups of one record says of the scores of n sites.

    Attributes
    ----------
    pseudo
        Pseudo-values, (k, n) float64: what each group by itself says of the score.
    spread
        h_g - 1 of each group, (k,) float64.
    centre
        The score without its bias of this record, (n,) float64.
    widening
        What the scatter of the groups is multiplied by.
    groups
        As the record was cut, before any were joined.
    alike
        Lag-one autocorrelation of these groups.
    joined
        How many of them were joined to one, because neighbours were alike.
    still_alike
        Whether neighbours are alike all the same, so that the errors are too small.
    """

    pseudo: NDArray[np.float64]
    spread: NDArray[np.float64]
    centre: NDArray[np.float64]
    widening: float
    groups: Groups
    alike: float
    joined: int
    still_alike: bool

    @classmethod
    def of(cls, scores: NDArray[np.float64], without: NDArray[np.float64], groups: Groups) -> Stratum:
        """From the scores of all frames, (n,), and with each group left out, (k, n)."""
        frames = groups.frames
        h = groups.total / frames
        corrected = len(h) * scores - ((1.0 - 1.0 / h)[:, None] * without).sum(axis=0)
        pseudo = h[:, None] * scores - (h - 1.0)[:, None] * without
        alike = autocorrelation(pseudo)
        joined, low = 1, alike
        while low > _limit(len(pseudo)) and len(pseudo) // 2 >= FEWEST:
            pseudo, frames = _in_pairs(pseudo, frames)
            joined, low = 2 * joined, autocorrelation(pseudo)
        wider = memory.widening(groups.memory, groups.total, len(frames)) if groups.memory else 1.0
        still_alike = low > _limit(len(pseudo))
        return cls(pseudo, groups.total / frames - 1.0, corrected, wider, groups, alike, joined, still_alike)

    def variance(self, a: NDArray[np.int64], b: NDArray[np.int64] | None = None) -> NDArray[np.float64]:
        """Squared standard error of the scores of sites a (m,), or of what they are above those of sites b (m,)."""
        pseudo, centre = self.pseudo[:, a], self.centre[a]
        if b is not None:
            pseudo, centre = pseudo - self.pseudo[:, b], centre - self.centre[b]
        within: NDArray[np.float64] = ((pseudo - centre) ** 2 / self.spread[:, None]).sum(axis=0) / len(pseudo)
        return self.widening**2 * within

    @property
    def is_short(self) -> bool:
        """Whether groups are shorter than the window that the memory was estimated in."""
        return self.groups.total < len(self.pseudo) * memory.WINDOW * self.groups.memory


@dataclass(frozen=True)
class Estimate:
    """What leaving groups out says of the scores of n sites.

    Attributes
    ----------
    scores
        Of all frames, (n,) float64.
    strata
        What each record says that the TPOG was counted in; one unless it is a mix.
    """

    scores: NDArray[np.float64]
    strata: tuple[Stratum, ...]

    @classmethod
    def of(cls, left_out: NDArray[np.float64], groups: Sequence[Groups]) -> Estimate:
        """From the scores with each group left out, (n, 1 + k), and the groups, k in all."""
        ends = np.cumsum([len(part.frames) for part in groups])
        columns = np.split(left_out[:, 1:].T, ends[:-1])
        strata = (Stratum.of(left_out[:, 0], part, its) for part, its in zip(columns, groups, strict=True))
        return cls(left_out[:, 0], tuple(strata))

    @cached_property
    def bias(self) -> NDArray[np.float64]:
        """What is expected to be wrong with ``scores`` because frames are few, (n,) float64."""
        wrong: NDArray[np.float64] = sum(
            (self.scores - part.centre for part in self.strata), np.zeros(len(self.scores))
        )
        return wrong

    @property
    def groups(self) -> int:
        """k, after joining."""
        return sum(len(part.pseudo) for part in self.strata)

    @cached_property
    def freedom(self) -> float:
        """Degrees of freedom of t: k - 1; of a mix, Satterthwaite's for all sites together."""
        free = [len(part.pseudo) - 1.0 for part in self.strata]
        shares = np.array([part.variance(self._all) for part in self.strata])
        total = shares.sum(axis=0)
        parts = (shares[:, total > 0] / total[total > 0]).sum(axis=1)
        if len(free) == 1 or not parts.any():
            return math.fsum(free)
        return float(parts.sum() ** 2 / (parts**2 / np.array(free)).sum())

    @property
    def _all(self) -> NDArray[np.int64]:
        return np.arange(len(self.scores))

    @cached_property
    def se(self) -> NDArray[np.float64]:
        """Standard error of each score, (n,) float64."""
        return self._error(self._all)

    def quantile(self, level: float = LEVEL) -> float:
        """How many standard errors an interval of this confidence reaches to each side."""
        return float(stdtrit(self.freedom, 0.5 + 0.5 * level))

    def intervals(self, level: float = LEVEL) -> NDArray[np.float64]:
        """Lower and upper end for the score that endless traffic would give, (n, 2) float64."""
        reach, middle = self.quantile(level) * self.se, self.scores - self.bias
        return np.column_stack([middle - reach, middle + reach])

    def differences(
        self, a: NDArray[np.int64], b: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Scores of sites a (m,) less those of sites b (m,), and their standard errors, with what two have in common
        taken out."""
        return self.scores[a] - self.scores[b], self._error(a, b)

    def beats(self, a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.float64]:
        """Chance (m,) that endless traffic would give sites a (m,) the higher score; one half when nothing tells two
        apart."""
        gap, error = self.differences(a, b)
        with np.errstate(divide="ignore", invalid="ignore"):
            chance = stdtr(self.freedom, gap / error)
        # A rounding to 1e-6: the last bits of a t distribution are the machine's own.
        rounded: NDArray[np.float64] = np.round(np.where(gap == 0.0, 0.5, chance), 6).astype(np.float64)
        return rounded

    def times_needed(self, a: int, b: int, level: float = SEPARABLE) -> float:
        """How many times the traffic at hand would tell sites a and b apart; infinite for equal scores."""
        gap, error = self.differences(np.array([a]), np.array([b]))
        with np.errstate(divide="ignore", invalid="ignore"):
            times = float((stdtrit(self.freedom, level) * error[0] / gap[0]) ** 2)
        return math.inf if math.isnan(times) else times

    def _error(self, a: NDArray[np.int64], b: NDArray[np.int64] | None = None) -> NDArray[np.float64]:
        error: NDArray[np.float64] = np.sqrt(sum((part.variance(a, b) for part in self.strata), np.zeros(len(a))))
        return error


def autocorrelation(series: NDArray[np.float64]) -> float:
    """Lag-one autocorrelation of groups, (k, n), all sites pooled; 0 where nothing varies."""
    centred = series - series.mean(axis=0)
    scale = np.sqrt((centred**2).sum(axis=0))
    centred = centred[:, scale > 0] / scale[scale > 0]
    return float((centred[1:] * centred[:-1]).sum(axis=0).mean()) if centred.size else 0.0


def _limit(groups: int) -> float:
    """Independent groups have an autocorrelation above this once in 20 (Kendall and Ord, Time Series, 1990: mean and
    variance)."""
    return -1.0 / groups + _ALIKE * math.sqrt((groups - 2) / (groups**2 - 1.0)) if groups > 2 else 1.0


def _in_pairs(pseudo: NDArray[np.float64], frames: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Join neighbouring groups in pairs; of an odd number, the last three."""
    starts = np.arange(0, len(frames) - 1, 2)
    joined = np.add.reduceat(frames, starts)
    return np.add.reduceat(frames[:, None] * pseudo, starts, axis=0) / joined[:, None], joined


def order(scores: NDArray[np.float64]) -> NDArray[np.int64]:
    """Sites by score, best first; equal scores in the order of the sites."""
    return np.argsort(-scores, kind="stable")


def beats_next(estimate: Estimate) -> NDArray[np.float64]:
    """Chance that each site truly scores above the one next in rank, (n,); 1 for the last."""
    ranked, chance = order(estimate.scores), np.ones(len(estimate.scores))
    chance[ranked[:-1]] = estimate.beats(ranked[:-1], ranked[1:])
    return chance


def in_words(estimate: Estimate, names: Sequence[str] = ("",)) -> dict[str, object]:
    """For a stage's summary: how the errors came about; ``names`` of the periods, one a record."""
    each = [
        f"{name}: {words}" if name else words
        for name, words in zip(names, map(_groups_in_words, estimate.strata), strict=True)
    ]
    return {"standard_errors_from": "; ".join(each)}


def _groups_in_words(part: Stratum) -> str:
    each = f"{len(part.pseudo)} groups of {part.groups.total // len(part.pseudo)} frames"
    joined = f", joined because neighbours were alike (autocorrelation {part.alike:.2f})" if part.joined > 1 else ""
    widened = f", widened by {part.widening - 1.0:.0%}" if part.widening >= 1.005 else ""
    return each + joined + widened


def doubts(
    estimate: Estimate,
    place: str,
    frame_period_s: float,
    names: Sequence[str] = ("",),
    own_lengths: Mapping[str, str] | None = None,
) -> list[Finding]:
    """Why standard errors cannot be trusted: a warning for each record that is short beside its memory.

    Parameters
    ----------
    place
        The key that says how many frames the traffic lasts.
    names
        Of the periods, one a record.
    own_lengths
        Period -> the key that says how many seconds it lasts, for those that have one.
    """
    own = own_lengths or {}
    return [
        _doubt(part, own.get(name, f"{place} ({name})" if name else place), frame_period_s, in_seconds=name in own)
        for part, name in zip(estimate.strata, names, strict=True)
        if part.is_short or part.still_alike
    ]


def _doubt(part: Stratum, place: str, frame_period_s: float, *, in_seconds: bool) -> Finding:
    frames, lasts = part.groups.total, part.groups.memory
    wide = f", though widened by {part.widening - 1.0:.0%}," if part.widening >= 1.005 else ""
    found = (
        f"{frames} frames ({frames * frame_period_s:g} s) are short beside the traffic's memory of"
        f" {lasts * frame_period_s:.3g} s: standard errors{wide} may be too small"
    )
    if not part.is_short:
        found = (
            f"neighbouring groups of {frames // len(part.pseudo)} frames are alike: standard errors may be too small"
        )
    enough = max(2 * frames if part.still_alike else 0, math.ceil(FEWEST * memory.WINDOW * lasts))
    better = round(LONG / memory.WINDOW) * enough
    cure = f"at least {enough} frames, better {better}"
    if in_seconds:
        cure = f"length_s of at least {enough * frame_period_s:g}, better {better * frame_period_s:g}"
    return Finding("traffic's memory", place, found, cure)
