"""What is known of a run beside its artefacts: the stages as ``run.json`` has them, and an accuracy study.

Both may be missing: stages that ran one by one in a notebook leave no ``run.json``, and few runs are studied. The page
then says that it does not know."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from pipeline.artefacts.readers import read_accuracy
from pipeline.artefacts.run_record import RECORD, RunRecord, StageRecord

STAGES = ("traffic", "statics", "tpog", "scan", "score")
"""Those that the page shows."""

ACCURACY = ("accuracy.parquet", "accuracy.png")
"""Shown where an accuracy study of the same settings and files was made in the run's folder."""

_UNSTABLE = ("sumo_seconds",)
"""What a stage's summary holds that another run would say differently."""


@dataclass(frozen=True)
class ShownStage:
    """What the page says of a stage; empty where ``run.json`` says nothing.

    Attributes
    ----------
    stage
        Its name.
    inputs
        Digest of what it read.
    artefacts
        File name -> sha256.
    summary
        What the stage said of its outcome, without what another run would say differently.
    seconds, peak_mb
        What it cost; None where that is not known.
    """

    stage: str
    inputs: str = ""
    artefacts: Mapping[str, str] = field(default_factory=dict)
    summary: Mapping[str, Any] = field(default_factory=dict)
    seconds: float | None = None
    peak_mb: float | None = None

    @classmethod
    def of(cls, stage: str, record: StageRecord) -> ShownStage:
        """From what ``run.json`` holds of it."""
        summary = {key: value for key, value in record.summary.items() if key not in _UNSTABLE}
        cost = record.cost.to_json()
        return cls(stage, record.inputs, record.artefacts, summary, cost["seconds"], cost["peak_mb"])


@dataclass(frozen=True)
class ShownRun:
    """What the page says of the stages before the report."""

    stages: Mapping[str, ShownStage]

    @classmethod
    def read(cls, out: Path) -> ShownRun:
        """From ``out / "run.json"``; empty where there is none, InputError where it is damaged."""
        known = RunRecord.read(out).stages if (out / RECORD).is_file() else {}
        return cls({name: ShownStage.of(name, known[name]) if name in known else ShownStage(name) for name in STAGES})

    @property
    def total_s(self) -> float:
        """Seconds of all stages together."""
        return math.fsum(stage.seconds or 0.0 for stage in self.stages.values())

    @property
    def longest_s(self) -> float:
        """Seconds of the longest stage; 0 where none is known."""
        return max((stage.seconds or 0.0 for stage in self.stages.values()), default=0.0)

    @property
    def artefacts(self) -> list[tuple[str, str]]:
        """File name and sha256 of what all stages wrote."""
        return [pair for stage in self.stages.values() for pair in stage.artefacts.items()]


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
    def read(cls, out: Path, run: ShownRun) -> StudySummary | None:
        """A study of what the run ran on: its own setting, the reference, the front, the default; None where there is
        no such study."""
        table, figure = (out / name for name in ACCURACY)
        study = read_accuracy(table) if figure.is_file() else None
        if study is None:
            return None
        rows, about = study
        if any(name not in run.stages or run.stages[name].inputs != key for name, key in about["stages"].items()):
            return None
        names = [column.name for column in fields(StudiedSetting)]
        settings = (StudiedSetting(**{name: row[name] for name in names}) for row in rows)
        shown = tuple(
            s for s in settings if s.kind in ("scenario", "reference") or s.front or s.recommended or s.default
        )
        return cls(shown, about["tolerance"], base64.b64encode(figure.read_bytes()).decode("ascii"))

    @property
    def best(self) -> StudiedSetting | None:
        """The recommended setting."""
        return next((setting for setting in self.settings if setting.recommended), None)
