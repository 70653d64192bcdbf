"""Correlations of the study: for each junction, and for all training, held-out and unseen junctions together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from benchmarks.validity.junctions import ROLES
from benchmarks.validity.record import Record
from egvs.core import files
from egvs.extensions.validation.correlation import RESAMPLES, Correlation, CorrelationStudy
from egvs.extensions.validation.results import ScoreName
from egvs.statistics.ranks import CoefficientKind

SEED = 2504
"""Seed of the resamples of sites and blocks."""

KIND: CoefficientKind = "spearman"
"""The study compares rankings, because planners choose the first sites of a list."""

GAMMAS = (1.0, 2.0, 5.0, 10.0, 20.0, math.inf)
VOXELS_M = (0.25, 0.5, 1.0)
OCCLUSIONS = (False, True)


@dataclass(frozen=True)
class Setting:
    """EGVS with one choice of its parameters."""

    gamma: float
    voxel_m: float
    occlusion: bool

    def __str__(self) -> str:
        """Return the score's name in a record."""
        parameters = {
            "gamma": "inf" if self.gamma == math.inf else self.gamma,
            "moving_occlusion": self.occlusion,
            "voxel_m": self.voxel_m,
        }
        return str(ScoreName("egvs", files.canonical_json(parameters).decode()))


DEFAULT = Setting(10.0, 0.25, False)
"""The default of a scenario when the study was made."""


class Pools:
    """Correlations of one detector, for each junction and for several together.

    Parameters
    ----------
    records
        Records of one sensor; those with results of the detector are used.
    """

    def __init__(self, records: Sequence[Record], detector: str, resamples: int = RESAMPLES) -> None:
        self.records = [record for record in records if detector in record.detections]
        self.detector, self.resamples = detector, resamples
        self._known: dict[tuple[str, ...], Correlation] = {}

    @cached_property
    def studies(self) -> dict[str, CorrelationStudy]:
        """Studies by name of the junction, or by role."""
        together: dict[str, list[Record]] = {record.junction: [record] for record in self.records}
        for role in ROLES:
            if records := [record for record in self.records if record.role == role]:
                together[role] = records
        return {
            name: CorrelationStudy([record.junction_of(self.detector) for record in records], SEED, self.resamples)
            for name, records in together.items()
        }

    @cached_property
    def scores(self) -> list[str]:
        """Scores that all records contain, in their order."""
        first, *others = (record.scores for record in self.records)
        return [name for name in first if all(name in other for other in others)]

    def settings(self) -> list[Setting]:
        """Those of EGVS that all records have."""
        every = [Setting(g, voxel, occlusion) for occlusion in OCCLUSIONS for voxel in VOXELS_M for g in GAMMAS]
        return [setting for setting in every if str(setting) in self.scores]

    def rho(self, pool: str, score: str, measure: str) -> Correlation:
        """How well a score goes with a measure."""
        if (key := (pool, score, measure)) not in self._known:
            self._known[key] = self.studies[pool].correlation(score, measure, KIND)
        return self._known[key]

    def difference(self, pool: str, first: str, second: str, measure: str) -> Correlation | None:
        """By how much better the first goes; None where it is the same score, or there is no such pool."""
        if first == second or pool not in self.studies:
            return None
        if (key := (pool, first, second, measure)) not in self._known:
            self._known[key] = self.studies[pool].difference(first, second, measure, KIND)
        return self._known[key]

    def best(self, pool: str, names: Sequence[str], measure: str) -> str | None:
        """Return the score with the highest correlation with a measure (the first of equals); None if there is none."""
        known = [(self.rho(pool, name, measure).value, name) for name in names] if pool in self.studies else []
        known = [(rho, name) for rho, name in known if not math.isnan(rho)]
        return max(known, key=lambda pair: pair[0])[1] if known else None

    def indistinguishable(self, pool: str, best: Setting, others: Sequence[Setting], measure: str) -> list[Setting]:
        """Return settings that the data cannot distinguish from the best: the interval of the difference contains 0."""
        settings = []
        for other in others:
            gap = self.difference(pool, str(best), str(other), measure)
            if gap is None or not gap.interval.low > 0.0:
                settings.append(other)
        return settings
