"""Scores of scans: EGVS, scores over vehicles, standard errors, blind spots."""

from __future__ import annotations

from typing import TYPE_CHECKING

from egvs.core.lazy import lazy_exports

if TYPE_CHECKING:
    from egvs.scoring.egvs import EntropyField, Score, binary_entropy
    from egvs.scoring.scorer import Scorer, SiteScore

__all__ = ["EntropyField", "Score", "Scorer", "SiteScore", "binary_entropy"]

__getattr__, __dir__ = lazy_exports(
    __name__, {"egvs": ["EntropyField", "Score", "binary_entropy"], "scorer": ["Scorer", "SiteScore"]}
)
