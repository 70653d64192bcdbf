r"""Whether simulated detection confirms a ranking: the rule, its numbers, and sentences about them.

``egvs validate`` measures detection from every site on the same frames, and stores one :class:`DetectorCheck` per
detector in the metadata of ``correlation.parquet``. Only detectors that return boxes can contradict a ranking; counts
of points on vehicles cannot.

**A detector contradicts a ranking** if one of the following holds.

1. *Another site detects significantly better than the first one.* With :math:`d` the difference of their measures
   (mean AP of BEV and 3D, the best site minus the first one), which is at least :data:`MIN_LOSS`, and :math:`s` its
   standard error,

   .. math:: d / s > t_{k-1,\; 1 - \alpha / m}, \qquad \alpha = 0.05, \quad m = (n - 1) D

   Both sites see the same frames, so :math:`s` is the jackknife error of the difference itself over the k blocks of
   frames (paired). The best site is the best of n - 1 others by chance too, and D detectors are tried, so the level is
   divided by m (Bonferroni). Without an error (:math:`s = 0`, or NaN) nothing is claimed.
2. *The order of the sites is wrong.* The 95 % interval of Spearman's rho lies below :data:`MIN_RHO`. At a rho of 0.5,
   the order of two sites is right in about two of three cases; at 0 in one of two.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from egvs.core.special import stdtrit
from egvs.core.wording import by_number, number_of
from egvs.results.labels import SCORE_LABELS, ScoreLabel

ALPHA = 0.05
"""Probability of a contradiction by chance, over all sites and detectors."""

MIN_LOSS = 0.01
"""Smallest loss that contradicts a ranking: one point of AP."""

MIN_RHO = 0.5
"""A rank correlation whose interval lies below this contradicts a ranking."""

SATURATED = 0.995
"""Shares of detection from here on leave no room for differences between sites."""


@dataclass(frozen=True)
class RankCorrelation:
    """Spearman's rho with its 95 % interval; None where it is not defined.

    Attributes
    ----------
    value, low, high
        The coefficient and the ends of its interval.
    sites
        Number of sites.
    groups
        Number of groups (mounting heights) within which sites are compared.
    why
        Why there is no value, or no interval; empty where there are both.
    """

    value: float | None
    low: float | None
    high: float | None
    sites: int
    groups: int = 1
    why: str = ""

    @property
    def text(self) -> str:
        """The coefficient and its interval: "0.91 (0.75 to 0.98)"."""
        if self.value is None:
            return "-"
        if self.low is None or self.high is None:
            return f"{self.value:.2f}"
        return f"{self.value:.2f} ({self.low:.2f} to {self.high:.2f})"

    @property
    def is_undecided(self) -> bool:
        """Whether the sign is unknown: there is no interval, or it contains 0."""
        return self.low is None or self.high is None or self.low <= 0.0 <= self.high


@dataclass(frozen=True)
class DetectorCheck:
    """What one detector says about a ranking.

    Attributes
    ----------
    detector, measure
        Its name, and its measure in words.
    returns_boxes
        Whether it returns boxes; otherwise points on vehicles are counted.
    first, first_value
        The best site by the score that ranks, and its measure. Of several, the one that detects best.
    best, best_value, best_se
        The site that detects best, its measure and the standard error.
    loss, loss_se
        ``best_value`` minus ``first_value``, and the standard error of this difference on the same frames.
    blocks
        Number of blocks of frames that the errors come from.
    rho
        Rank correlation of the score that ranks with the measure, over all sites.
    same_height
        The same among sites of equal mounting height; None where all sites have the same height.
    """

    detector: str
    measure: str
    returns_boxes: bool
    first: str
    first_value: float
    best: str
    best_value: float
    best_se: float | None
    loss: float
    loss_se: float | None
    blocks: int
    rho: RankCorrelation
    same_height: RankCorrelation | None

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> DetectorCheck:
        """Read what :meth:`to_json` returned."""
        values = dict(value)
        values["rho"] = RankCorrelation(**values["rho"])
        if values["same_height"] is not None:
            values["same_height"] = RankCorrelation(**values["same_height"])
        return cls(**values)

    def to_json(self) -> dict[str, Any]:
        """Return the form in the metadata of ``correlation.parquet``."""
        return asdict(self)

    def loses_by(self, comparisons: int) -> bool:
        """Whether another site detects significantly better than the first one.

        Parameters
        ----------
        comparisons
            Number of sites and detectors that are compared with the first one.
        """
        if self.loss_se is None or not self.loss_se > 0.0 or self.loss < MIN_LOSS:
            return False
        return self.loss / self.loss_se > float(stdtrit(self.blocks - 1, 1.0 - ALPHA / max(comparisons, 1)))

    @property
    def has_wrong_order(self) -> bool:
        """Whether the interval of rho lies below :data:`MIN_RHO`."""
        return self.rho.high is not None and self.rho.high < MIN_RHO

    @property
    def loss_text(self) -> str:
        """The loss with its standard error: "8.3 ± 1.1 AP points"."""
        error = "" if self.loss_se is None else f" ± {100 * self.loss_se:.1f}"
        unit = "AP points" if self.returns_boxes else "percentage points"
        return f"{100 * self.loss:z.1f}{error} {unit}"


@dataclass(frozen=True)
class RankingCheck:
    """What all detectors say about a ranking.

    Attributes
    ----------
    score
        Name of the score that ranks.
    detectors
        One entry per detector for which a site has a measure; those that return boxes come first.
    """

    score: str
    detectors: tuple[DetectorCheck, ...]

    @classmethod
    def from_json(cls, value: Mapping[str, Any]) -> RankingCheck:
        """Read what :meth:`to_json` returned."""
        return cls(value["score"], tuple(DetectorCheck.from_json(entry) for entry in value["detectors"]))

    def to_json(self) -> dict[str, Any]:
        """Return the form in the metadata of ``correlation.parquet``."""
        return {"score": self.score, "detectors": [detector.to_json() for detector in self.detectors]}

    @property
    def deciding(self) -> tuple[DetectorCheck, ...]:
        """The detectors that return boxes; without any, the counts of points."""
        with_boxes = tuple(detector for detector in self.detectors if detector.returns_boxes)
        return with_boxes or self.detectors

    @property
    def comparisons(self) -> int:
        """Number of comparisons with the first site, over all detectors that return boxes."""
        return sum(detector.rho.sites - 1 for detector in self.detectors if detector.returns_boxes)

    @property
    def contradiction(self) -> str:
        """How the detectors contradict the ranking, as a clause; empty if they do not (see the module)."""
        for detector in self.detectors:
            if detector.returns_boxes and detector.loses_by(self.comparisons):
                return (
                    f"with {detector.detector}, detection is better from {detector.best} than from the first site, "
                    f"{detector.first}, by {detector.loss_text} ({detector.measure})"
                )
        for detector in self.detectors:
            if detector.returns_boxes and detector.has_wrong_order:
                return (
                    f"with {detector.detector}, the order of the sites by detection is another one "
                    f"(rank correlation {detector.rho.text})"
                )
        return ""

    @property
    def warning(self) -> str:
        """The contradiction in one sentence; empty if there is none."""
        if not self.contradiction:
            return ""
        return f"The validation contradicts the ranking: {self.contradiction}."

    @property
    def sentences(self) -> list[str]:
        """What a planner can conclude: two sentences for each deciding detector."""
        label = SCORE_LABELS[self.score]
        return [f"{_describe_prediction(label, check)} {_describe_choice(check)}" for check in self.deciding]


def _describe_prediction(label: ScoreLabel, check: DetectorCheck) -> str:
    """Say whether the score predicts detection here, over all sites and among those of equal height."""
    rho = check.rho
    start = f"With {check.detector}, " if check.returns_boxes else "No detector ran; by points on vehicles, "
    count = f"{number_of(rho.sites, 'site')} {by_number(rho.sites, 'is', 'are')}"
    unknown = f"{start}{count} too few, or too similar, to tell whether {label.noun} predicts detection here"
    if rho.value is None:
        return f"{unknown} ({rho.why})."
    if rho.low is None:
        return f"{unknown}: rho is {rho.text}, without an interval ({rho.why})."
    if rho.is_undecided:
        return f"{unknown}: rho is {rho.text}, and the interval contains 0."

    verdict = "predicts detection here"
    if check.has_wrong_order:
        verdict = "predicts detection poorly here"
    if rho.high is not None and rho.high < 0.0:
        verdict = "ranks the sites here the wrong way round"
    overall = f"rho {rho.text} over {rho.sites} sites"
    return f"{start}{label.noun} {verdict}: {overall}{_describe_same_height(check.same_height)}."


def _describe_same_height(rho: RankCorrelation | None) -> str:
    """Return a clause on sites of equal height; empty where all sites have the same height."""
    if rho is None:
        return ""
    if rho.value is None:
        return f"; among sites of equal height there are too few to tell ({rho.why})"
    heights = number_of(rho.groups, "height")
    clause = f"{rho.text} among sites of equal height ({rho.sites} sites at {heights})"
    if rho.is_undecided:
        return f", but {clause}, which are too few, or too similar, to tell"
    return f", and {clause}"


def _describe_choice(check: DetectorCheck) -> str:
    """Say which site detects best, and what is lost by following the ranking."""
    error = "" if check.best_se is None else f" ± {100 * check.best_se:.1f}"
    best = f"{check.best} detects best ({check.measure} {100 * check.best_value:.1f}{error} %)"
    if not check.returns_boxes:
        best = f"{check.best} has most {check.measure} ({100 * check.best_value:.1f}{error} %)"
    if check.best == check.first:
        text = f"{best}, and is also first in the ranking: nothing is lost by following it."
        if check.best_value >= SATURATED:
            text += " Values so near 100 % cannot tell the best sites apart; more frames may."
        return text
    text = f"{best}; following the ranking, to {check.first}, loses {check.loss_text}"
    if check.loss_se is None or check.loss <= 2.0 * check.loss_se:
        return f"{text}, which may be chance."
    return f"{text}."


def none_if_nan(value: float) -> float | None:
    """Return None for NaN, which JSON lacks."""
    return None if math.isnan(value) else float(value)


def sort_checks(checks: Sequence[DetectorCheck]) -> tuple[DetectorCheck, ...]:
    """Return checks of detectors that return boxes first, otherwise in their order."""
    return tuple(sorted(checks, key=lambda check: not check.returns_boxes))
