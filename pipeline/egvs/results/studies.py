"""Results of ``egvs accuracy``: what each setting costs and loses, and which one is recommended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from egvs.artefacts.readers import read_accuracy
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import StageRecord, have_inputs

APPROXIMATES, MEASURES, SCENARIO = "approximates", "measures", "scenario"
"""Kinds of settings: those that approximate the decision of the scenario, those that measure something else, and its
own one."""


@dataclass(frozen=True)
class SettingResult:
    """One setting: a row of ``accuracy.parquet``, whose schema describes the columns."""

    setting: str
    kind: str
    knob: str
    overrides: str
    seconds: float
    statics_s: float
    scan_s: float
    traffic_s: float
    tpog_s: float
    score_s: float
    measured: bool
    frames: int
    sampled_frames: int
    draws: int
    probability: float
    probability_se: float
    loss_points: float
    loss_se_points: float
    error: float
    tau: float
    best: str
    best_share: float
    front: bool = False
    recommended: bool = False

    @property
    def label(self) -> str:
        """Name in a sentence."""
        return "the scenario's own setting" if self.kind == SCENARIO else self.setting

    @property
    def is_listed(self) -> bool:
        """Whether reports show it: the scenario's own one, and those that are recommended or on the Pareto front."""
        return self.kind == SCENARIO or self.front or self.recommended

    @property
    def approximates(self) -> bool:
        """Whether it may be recommended: it gives the scenario's scores, with more or less accuracy."""
        return self.kind in (SCENARIO, APPROXIMATES)


@dataclass(frozen=True)
class Tolerance:
    """What a setting must meet.

    Attributes
    ----------
    loss_points
        Largest expected loss, in percentage points of vehicles found.
    score
        Largest relative error of the score, which counts instead if it is given.
    """

    loss_points: float
    score: float | None = None

    def admits(self, row: SettingResult) -> bool:
        """Whether a setting is within the tolerance."""
        if self.score is not None:
            return row.error <= self.score
        return row.loss_points <= self.loss_points

    def excess(self, row: SettingResult) -> float:
        """Return the loss or error that counts."""
        return row.loss_points if self.score is None else row.error


@dataclass(frozen=True)
class AccuracyResults:
    """An accuracy study of a run: its settings, one of which is recommended, and what a setting must meet."""

    settings: tuple[SettingResult, ...]
    tolerance: Tolerance

    @classmethod
    def read(cls, folder: RunFolder, stages: Mapping[str, StageRecord]) -> AccuracyResults | None:
        """Read the study in a run folder; None if there is none of a run with these stages."""
        study = read_accuracy(folder.accuracy)
        if study is None:
            return None
        rows, metadata = study
        if not have_inputs(stages, metadata["stages"]):
            return None
        tolerance = Tolerance(metadata["tolerance"], metadata.get("score_tolerance"))
        return cls(tuple(SettingResult(**row) for row in rows), tolerance)

    @property
    def recommended(self) -> SettingResult:
        """The recommended setting."""
        return next(setting for setting in self.settings if setting.recommended)
