r"""How well two lists of values go together: Pearson's r, Spearman's rho, Kendall's tau-b, for many resamples at once.

Each is a cosine of two vectors that are made from one list each,

.. math:: c = \frac{\sum_k a_k b_k}{\sqrt{\sum_k a_k^2} \sqrt{\sum_k b_k^2}}

- Pearson: a are the values less their mean.
- Spearman: a are the ranks less their mean; equal values share the mean of their ranks.
- Kendall: a are the signs of the differences of all pairs; a pair of equal values has 0 (tau-b: Kendall, Biometrika 33,
  1945).

So each list is prepared once, whatever it is compared with. A list whose values are all the same has no coefficient
(NaN), and neither has one of fewer than three.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

Kind = Literal["pearson", "spearman", "kendall"]

KINDS: tuple[Kind, ...] = ("pearson", "spearman", "kendall")

FEWEST = 3
"""Values that a coefficient needs: two always go together perfectly."""

SAME = 1e-12
"""Values that scatter by less than this share of the largest are all the same."""


@dataclass(frozen=True)
class Form:
    """A list of values prepared for one kind of coefficient, many resamples of it.

    Attributes
    ----------
    vector
        (resamples, d): float64, or int8 for Kendall's signs.
    norm
        Their lengths, (resamples,) float64; NaN where all values are the same.
    """

    vector: NDArray[Any]
    norm: NDArray[np.float64]

    @classmethod
    def of(cls, values: NDArray[np.float64], kind: Kind) -> Form:
        """From (resamples, n) float64."""
        if kind == "kendall":
            first, second = np.triu_indices(values.shape[1], 1)
            a, b = values[:, first], values[:, second]
            vector: NDArray[Any] = (a > b).astype(np.int8) - (a < b).astype(np.int8)
            norm = np.sqrt(np.count_nonzero(vector, axis=1))
        else:
            vector = rankdata(values, axis=1) if kind == "spearman" else values
            vector = vector - vector.mean(axis=1, keepdims=True)
            norm = np.sqrt((vector**2).sum(axis=1))
        spread = np.ptp(values, axis=1) > SAME * np.abs(values).max(axis=1, initial=0.0)
        return cls(vector, np.where(spread & (values.shape[1] >= FEWEST), norm, np.nan))

    def with_(self, other: Form) -> NDArray[np.float64]:
        """The coefficient with another list, (resamples,) float64, -1 to 1."""
        if self.vector.dtype == np.int8:
            product = (self.vector * other.vector).sum(axis=1, dtype=np.int32).astype(np.float64)
        else:
            product = np.einsum("ij,ij->i", self.vector, other.vector)
        found: NDArray[np.float64] = np.clip(product / self.norm / other.norm, -1.0, 1.0)
        return found
