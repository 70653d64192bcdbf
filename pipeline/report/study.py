"""An accuracy study of what a run ran on: the settings that the page shows, and the study's figure."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path

from pipeline.artefacts.readers import read_accuracy
from pipeline.artefacts.run_record import StageRecord

ACCURACY = ("accuracy.parquet", "accuracy.png")
"""Shown where an accuracy study of the same settings and files was made in the run's folder."""


@dataclass(frozen=True)
class StudiedSetting:
    """One setting of an accuracy study: the columns of ``accuracy.parquet`` that the page shows."""

    setting: str
    kind: str
    overrides: str
    seconds: float
    error: float
    error_se: float
    tau: float
    regret: float
    best_kept: bool
    default: bool
    front: bool
    recommended: bool


@dataclass(frozen=True)
class StudySummary:
    """What ``egvs accuracy`` found: the settings that the page shows, and the figure in base 64."""

    settings: tuple[StudiedSetting, ...]
    tolerance: float
    figure: str

    @classmethod
    def read(cls, out: Path, stages: Mapping[str, StageRecord]) -> StudySummary | None:
        """A study of what ``stages`` ran on: the scenario's own setting, the reference, the front, the default; None
        where there is no such study.
        """
        table, figure = (out / name for name in ACCURACY)
        study = read_accuracy(table) if figure.is_file() else None
        if study is None:
            return None
        rows, about = study
        if any(name not in stages or stages[name].inputs != key for name, key in about["stages"].items()):
            return None
        names = [column.name for column in fields(StudiedSetting)]
        settings = (StudiedSetting(**{name: row[name] for name in names}) for row in rows)
        kinds = ("scenario", "reference")
        shown = tuple(s for s in settings if s.kind in kinds or s.front or s.recommended or s.default)
        return cls(shown, about["tolerance"], base64.b64encode(figure.read_bytes()).decode("ascii"))

    @property
    def best(self) -> StudiedSetting | None:
        """The recommended setting."""
        return next((setting for setting in self.settings if setting.recommended), None)
